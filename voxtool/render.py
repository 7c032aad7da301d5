"""How a picture will be made: what is cast at what, and what it will take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from voxtool.errors import MemoryLimitError, count_of, human

RAY_BYTES = 16  # of a ray's colour and opacity, float32


@dataclass(frozen=True)
class RenderPlan:
    """How a picture will be made.

    kind : "octree", "field" or "volume".
    width, height : of the picture, pixels; samples x samples rays a pixel.
    stages : that will run, in order; left_out : what is not done, and why.
    counts : of what the rays are cast at, by name.
    scene_bytes : of that on the device.
    """

    kind: str
    width: int
    height: int
    samples: int
    stages: tuple[str, ...]
    left_out: dict[str, str]
    counts: dict[str, int]
    scene_bytes: int

    @property
    def rays(self) -> int:
        return self.width * self.height * self.samples**2

    @property
    def device_bytes(self) -> int:
        """Memory on the device: what is looked at, and the rays' colours."""
        return self.scene_bytes + RAY_BYTES * self.rays

    @property
    def host_bytes(self) -> int:
        """Memory beside it: the rays' colours as they are read back, and the pixels in float64 and
        as integers."""
        return RAY_BYTES * self.rays + 6 * RAY_BYTES * self.width * self.height

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Refuse what needs more memory.

        Parameters
        ----------
        max_memory, max_allocation : bytes that the device may use in all, and in one buffer.

        Raises
        ------
        MemoryLimitError : says how much, and what to do instead.
        """
        if self.device_bytes <= max_memory and RAY_BYTES * self.rays <= max_allocation:
            return
        mend = "choose a smaller --size or fewer --samples"
        if self.scene_bytes > max_memory:
            mend = f"the {self.kind} alone is too large"
        each, buffer = self.samples**2, RAY_BYTES * self.rays
        raise MemoryLimitError(
            f"a picture of {self.width} x {self.height} pixels, {count_of(each, 'ray')} each, "
            f"would need {human(self.device_bytes)} of memory ({human(buffer)} in one buffer), of "
            f"{human(max_memory)} ({human(max_allocation)}) allowed: {mend} (see --max-memory)"
        )

    def as_dict(self) -> dict[str, Any]:
        """All of it: JSON types only."""
        return {
            "kind": self.kind,
            "size": [self.width, self.height],
            "samples": self.samples,
            "rays": self.rays,
            "stages": list(self.stages),
            "left_out": self.left_out,
            **self.counts,
            "predicted_device_bytes": self.device_bytes,
        }
