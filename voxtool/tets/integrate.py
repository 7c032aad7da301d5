"""The light of a ray's part in a cell, by any integrator.

Kernels: kernels/tets/integrate.cl; kernels/tets/integrate.h is for those who follow rays.
"""

from __future__ import annotations

import re
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.opencl import Array, Device
    from voxtool.tets.transfer import LocalTransfer
    from voxtool.tets.volume import TetVolume

SOURCE = "tets/integrate.cl"
INTEGRATORS = ("linear", "preintegrated", "average", "sampled")
MOST_SAMPLES = 1 << 12  # points in a cell
SCALARS, LENGTHS = 128, 32  # sides of the pre-integrated table
LANES = 16  # rays that a work-item of a CPU follows side by side

HEADERS = {
    "tets/integrators.h": program.c_constants(
        **{name.upper(): number for number, name in enumerate(INTEGRATORS)},
        SCALARS=SCALARS,
        LENGTHS=LENGTHS,
    )
}


class Integral:
    """A transfer function on a device, and an integrator.

    lanes : rays that a work-item of this device follows side by side.
    arguments : the kernels' parameters points, rows, count, table, longest and samples.
    options : of kernels.
    """

    def __init__(
        self, volume: TetVolume, transfer: LocalTransfer, device: Device, integrator: str
    ) -> None:
        """
        Parameters
        ----------
        integrator : as integrator_of takes it.

        Raises
        ------
        VoxtoolError : an unknown integrator.
        """
        name, samples = integrator_of(integrator)
        self.volume = volume
        self.device = device
        self.lanes = LANES if device.info.kind == "CPU" else 1
        self.transfer = (
            device.put(transfer.points),
            device.put(transfer.rows),
            np.int32(len(transfer.points)),
        )
        table, longest = device.empty(0, np.float32), np.float32(1)  # nobody looks there
        if name == "preintegrated":
            table, longest = self.preintegrate(), self.longest
        self.arguments = (*self.transfer, table, longest, np.uint32(samples))
        self.options: dict[str, int | str] = {
            "LANES": self.lanes,
            "INTEGRATOR": name.upper(),
            **({"CONSTANT": 1} if volume.constant else {}),
        }

    def preintegrate(self) -> Array:
        """The pre-integrated transfer function: (SCALARS, SCALARS, LENGTHS, 4) float32."""
        entries = SCALARS * SCALARS * LENGTHS
        with self.device.stage("preintegrate"):
            table = self.device.empty(4 * entries, np.float32)
            preintegrate = self.device.kernel(SOURCE, "preintegrate", LANES=1)
            preintegrate(entries, *self.transfer, self.longest, table)
        return table

    @cached_property
    def longest(self) -> np.float32:
        """The longest way through a cell: between two of its vertices, local."""
        x, y, z, _ = self.volume.vertices[self.volume.cells].T
        longest = np.float32(0)
        for one in range(len(x)):
            for other in range(one):
                dx, dy, dz = x[one] - x[other], y[one] - y[other], z[one] - z[other]
                longest = max(longest, (dx * dx + dy * dy + dz * dz).max())
        return np.sqrt(longest)


def integrator_of(text: str) -> tuple[str, int]:
    """The name of an integrator, and its samples a cell.

    Raises
    ------
    VoxtoolError : there is none of this name.
    """
    found = re.fullmatch(r"([a-z]+)(?::([0-9]{1,4}))?", text)
    name, count = (found[1], found[2]) if found else ("", None)
    if name not in INTEGRATORS or (count is not None) != (name == "sampled"):
        known = ", ".join(f"{n}:N" if n == "sampled" else n for n in INTEGRATORS)
        raise VoxtoolError(f"integrator {text!r} is unknown: choose {known}")
    samples = int(count or 1)
    if not 1 <= samples <= MOST_SAMPLES:
        raise VoxtoolError(f"{samples} samples a cell: choose 1 to {MOST_SAMPLES}")
    return name, samples
