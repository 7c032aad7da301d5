"""The light of the segment of a ray in a cell, by each integrator.

Kernels: kernels/tets/pictures/integrate.cl; kernels/tets/pictures/integrate.h is used by ray
casting and projection.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.opencl import Array, Device
    from voxtool.tets.pictures.surfaces import Surfaces
    from voxtool.tets.pictures.transfer import LocalTransfer
    from voxtool.tets.pictures.view import DeviceVolume
    from voxtool.tets.volume.volume import TetVolume

SOURCE = "tets/pictures/integrate.cl"
INTEGRATORS = ("linear", "preintegrated", "average", "sampled")
MOST_SAMPLES = 1 << 12  # points in a cell
BUCKETS = 256  # parts of the scalars, in which the search for a control point begins,
MANY = 128  # where there are at least MANY points; with fewer all are compared
TABLE = 128, 32  # scalars and lengths along the sides of the pre-integrated table

HEADERS = {
    "tets/pictures/integrators.h": program.c_constants(
        **{name.upper(): number for number, name in enumerate(INTEGRATORS)}
    )
}


class Integral:
    """A transfer function on a device, an integrator, and isosurfaces.

    lanes : rays that a work-item follows side by side, 1 or 16; by default what suits the device.
    arguments, options : the kernels', by name.
    table : scalars and lengths along the sides of the pre-integrated table.
    buckets : equal parts of the scalars, a power of two, for each of which a table holds where the
        search for a control point begins; 0 for no table; by default BUCKETS with many points.
    """

    def __init__(
        self,
        volume: TetVolume,
        transfer: LocalTransfer,
        on_device: DeviceVolume,
        integrator: str,
        lanes: int | None = None,
        table: tuple[int, int] = TABLE,
        surfaces: Surfaces | None = None,
        buckets: int | None = None,
    ) -> None:
        name, samples = integrator_of(integrator)
        device = on_device.device
        self.lanes = lanes or device.lanes
        self.arguments: dict[str, Any] = {
            "points": device.put(transfer.points),
            "rows": device.put(transfer.rows),
            "below": None,
            "count": len(transfer.points),
            "table": None,
            "longest": 1,
            "samples": samples,
        }
        self.options: dict[str, int | str] = {"LANES": self.lanes, "INTEGRATOR": name.upper()}
        if buckets is None:
            buckets = BUCKETS if len(transfer.points) >= MANY else 0
        if buckets:
            self.options["BUCKETS"] = buckets
            self.arguments["below"] = device.put(transfer.below(buckets))
        if volume.constant:
            self.options["CONSTANT"] = 1
        if surfaces is not None:
            self.options |= surfaces.options(volume)
            self.arguments |= surfaces.arguments(device)
            self.arguments["gradients"] = on_device.arguments["gradients"]
        if name == "preintegrated":
            self.options |= {"SCALARS": table[0], "LENGTHS": table[1]}
            self.arguments["longest"] = on_device.longest(volume)
            self.arguments["table"] = self._preintegrate(device, *table)

    def _preintegrate(self, device: Device, scalars: int, lengths: int) -> Array:
        """Return the pre-integrated transfer function, (scalars, scalars, lengths, 4) float32."""
        entries = scalars * scalars * lengths
        with device.stage("preintegrate"):
            table = device.empty(4 * entries, np.float32)
            options = {"LANES": 1, "SCALARS": scalars, "LENGTHS": lengths}
            kernel = device.kernel(SOURCE, "preintegrate", **options)
            kernel(entries, **{**self.arguments, "table": table})
        return table


def integrator_of(text: str) -> tuple[str, int]:
    """Return the name of an integrator and its samples a cell; raise VoxtoolError if unknown."""
    found = re.fullmatch(r"([a-z]+)(?::([0-9]{1,4}))?", text)
    name, count = (found[1], found[2]) if found else ("", None)
    if name not in INTEGRATORS or (count is not None) != (name == "sampled"):
        known = ", ".join(f"{n}:N" if n == "sampled" else n for n in INTEGRATORS)
        raise VoxtoolError(f"integrator {text!r} is unknown: choose {known}")
    samples = int(count or 1)
    if not 1 <= samples <= MOST_SAMPLES:
        raise VoxtoolError(f"{samples} samples a cell: choose 1 to {MOST_SAMPLES}")
    return name, samples
