"""Ray casting of tetrahedral volumes: section 4 of the text.

Rays go from cell to cell. A ray leaves a cell by the nearest plane among those that it goes out by,
and the scalar is linear on the way; the transfer function's control points cut the way into pieces,
and each is integrated in closed form (Moreland and Angel 2004). What a viewpoint makes of a cell's
planes and gradient is worked out once a frame: then a step has no division.

Kernels: kernels/tets/view.cl, raycast.cl.
"""

from __future__ import annotations

import re
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import open_device, program
from voxtool.tets.project import CellProjection
from voxtool.tets.transfer import default
from voxtool.tets.view import (
    NOWHERE,
    ON_PLANE,
    Viewpoint,
    VisibleCells,
    VolumeTextures,
    cell_at,
)
from voxtool.tets.volume import BLOCK

if TYPE_CHECKING:
    from voxtool.camera import Rays
    from voxtool.opencl import Array, Device
    from voxtool.tets.project import Projection
    from voxtool.tets.transfer import LocalTransfer, TransferFunction
    from voxtool.tets.volume import TetVolume

SOURCE = "tets/raycast.cl"
INTEGRATORS = ("linear", "preintegrated", "average", "sampled")
METHODS = ("raycast", "projection")
LANES = 16  # rays that a work-item of a CPU follows side by side
MOST_STILL = 1 << 12  # steps that a ray takes at one place before it is given up
MOST_SAMPLES = 1 << 12
SLOTS, MANY_SLOTS = (
    3,
    7,
)  # ways out that a record holds: of a tetrahedron with the eye outside, of all
SCALARS, LENGTHS = 128, 32  # sides of the pre-integrated table

program.generated["tets/raycast.h"] = program.c_constants(
    **{name.upper(): number for number, name in enumerate(INTEGRATORS)},
    MOST_STILL=MOST_STILL,
    SCALARS=SCALARS,
    LENGTHS=LENGTHS,
)


def render_tet(
    volume: TetVolume,
    rays: Rays,
    transfer: TransferFunction | None = None,
    *,
    method: str = "raycast",
    integrator: str = "linear",
    device: Device | None = None,
) -> np.ndarray:
    """The picture of a volume, as VolumeRenderer.render, for a single use; by default through the
    transfer function that shows something of any data."""
    transfer = default(volume) if transfer is None else transfer
    return VolumeRenderer(volume, device).render(rays, transfer, method, integrator)


class VolumeRenderer:
    """A volume on a device, uploaded once and looked at many times."""

    def __init__(self, volume: TetVolume, device: Device | None = None) -> None:
        """Upload the volume's textures.

        Raises
        ------
        DeviceError : there is no device.
        MemoryLimitError : the volume does not fit on it.
        """
        self.volume = volume
        self.device = device or open_device()
        self._textures = VolumeTextures(volume, self.device)
        self._shown: tuple[TransferFunction, LocalTransfer, VisibleCells] | None = None

    def render(
        self,
        rays: Rays,
        transfer: TransferFunction,
        method: str = "raycast",
        integrator: str = "linear",
    ) -> np.ndarray:
        """The picture of rays.

        Parameters
        ----------
        rays : world units.
        transfer : colours and extinctions of scalars, extinctions per world unit.
        method : "raycast" or "projection".
        integrator : "linear", exact for the transfer function; "average", the mean of both ends of
            a cell; "sampled:N", N points in each cell; "preintegrated", from a table.

        Returns
        -------
        (H, W, 4) float32: red, green and blue, premultiplied, and alpha.

        Raises
        ------
        VoxtoolError : an unknown method or integrator.
        MemoryLimitError : the device has no memory for a frame.
        """
        name, samples = integrator_of(integrator)
        if method not in METHODS:
            raise VoxtoolError(f"method {method!r} is unknown: choose {', '.join(METHODS)}")
        if method == "projection":
            return self.project(rays, transfer, integrator).picture
        local, visible = self._show(transfer)
        return self._cast(rays, local, visible, name, samples)

    def project(
        self, rays: Rays, transfer: TransferFunction, integrator: str = "linear"
    ) -> Projection:
        """What `render` gives by the method "projection", and what it took; raises the same."""
        name, samples = integrator_of(integrator)
        local, visible = self._show(transfer)
        table = self._preintegrate(local) if name == "preintegrated" else self._no_table
        project = CellProjection(visible, local, self._lanes, name, samples, table)
        return project(Viewpoint.of(rays, self.volume, self.device))

    def shown(self, transfer: TransferFunction) -> VisibleCells:
        """The cells that a transfer function does not leave transparent."""
        return self._show(transfer)[1]

    def _show(self, transfer: TransferFunction) -> tuple[LocalTransfer, VisibleCells]:
        """The transfer function in the volume's frame, and the cells that it shows; kept for the
        next frame."""
        if self._shown is None or self._shown[0] is not transfer:
            local = transfer.local(self.volume)
            self._shown = transfer, local, VisibleCells(self._textures, local)
        return self._shown[1:]

    def _cast(
        self, rays: Rays, transfer: LocalTransfer, visible: VisibleCells, name: str, samples: int
    ) -> np.ndarray:
        device, volume = self.device, self.volume
        view = Viewpoint.of(rays, volume, device)
        eye = view.rays.origin
        inside = view.rays.perspective and bool((np.abs(eye) <= 1 + ON_PLANE).all())
        eye_cell = self._visible_cell(eye, visible) if inside else NOWHERE
        slots = MANY_SLOTS if inside or volume.layout == "hexahedra" else SLOTS
        records = visible.look(view, slots)
        entries = visible.enter(view)
        width, height = rays.size
        lanes = self._lanes
        table = self._preintegrate(transfer) if name == "preintegrated" else self._no_table
        with device.stage("cast"):
            picture = device.empty(4 * width * height, np.float32)
            cast = device.kernel(
                SOURCE,
                "cast",
                LANES=lanes,
                SLOTS=slots,
                INTEGRATOR=name.upper(),
                **({"CONSTANT": 1} if volume.constant else {}),
                **view.options,
            )
            tiles = -(-width // 4) * -(-height // 4)
            cast(
                16 * tiles // lanes,
                records,
                entries.ends,
                entries.entries,
                device.put(transfer.points),
                device.put(transfer.rows),
                np.int32(len(transfer.points)),
                *table,
                np.uint32(samples),
                np.int32(eye_cell),
                *view.arguments(),
                np.int32(width),
                np.int32(height),
                picture,
                local=1 if lanes > 1 else 64,
            )
        return picture.take().reshape(height, width, 4)

    @property
    def _lanes(self) -> int:
        """Rays that a work-item of the device follows side by side."""
        return LANES if self.device.info.kind == "CPU" else 1

    @cached_property
    def _no_table(self) -> tuple[Array, np.float32]:
        """In place of the pre-integrated transfer function, for those who do not look there."""
        return self.device.empty(0, np.float32), np.float32(1)

    def _preintegrate(self, transfer: LocalTransfer) -> tuple[Array, np.float32]:
        """The pre-integrated transfer function, and the length of its longest segment."""
        device, entries = self.device, SCALARS * SCALARS * LENGTHS
        with device.stage("preintegrate"):
            table, longest = device.empty(4 * entries, np.float32), self._longest
            preintegrate = device.kernel("tets/preintegrate.cl", "preintegrate", LANES=1)
            preintegrate(
                entries,
                device.put(transfer.points),
                device.put(transfer.rows),
                np.int32(len(transfer.points)),
                longest,
                table,
            )
        return table, longest

    @cached_property
    def _longest(self) -> np.float32:
        """The longest way through a cell: between two of its vertices, local."""
        x, y, z, _ = self.volume.vertices[self.volume.cells].T
        longest = np.float32(0)
        for one in range(len(x)):
            for other in range(one):
                dx, dy, dz = x[one] - x[other], y[one] - y[other], z[one] - z[other]
                longest = max(longest, (dx * dx + dy * dy + dz * dz).max())
        return np.sqrt(longest)

    def _visible_cell(self, point: np.ndarray, visible: VisibleCells) -> int:
        """The visible cell that a point of the local frame is in, or NOWHERE."""
        cell = cell_at(self.volume, point)
        return cell if cell != NOWHERE and visible.kept[cell // BLOCK] else NOWHERE


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
