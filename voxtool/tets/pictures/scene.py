"""A tetrahedral volume as a scene: its options, sizes and drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from voxtool.camera import checked_colour
from voxtool.choices import METHODS
from voxtool.errors import VoxtoolError, human, printable
from voxtool.tets.pictures.integrate import TABLE, Integral, integrator_of
from voxtool.tets.pictures.project import MAX_PAIRS, PENDING, CellProjection, Projection
from voxtool.tets.pictures.raycast import cast
from voxtool.tets.pictures.surfaces import Surfaces, surfaces_of
from voxtool.tets.pictures.transfer import LocalTransfer, TransferFunction, default_transfer
from voxtool.tets.pictures.view import (
    MAX_ENTRIES,
    DeviceVolume,
    ShownCells,
    Viewpoint,
    are_skewed,
    kept_cells,
    part_of,
)
from voxtool.tets.pictures.walk import walk

if TYPE_CHECKING:
    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.tets.volume.volume import TetVolume


TRANSPARENT = "transparent cells"
STEEP = 24.0  # extinction per local length; the largest by which float32 draws
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class VolumeScene:
    """A tetrahedral volume through a transfer function.

    transfer : colours and extinctions of scalars; by default `default_transfer`, or with isovalues
        nothing but the surfaces.
    method : "raycast", or "projection".
    integrator : "linear", exact for the transfer function; "average", the mean of both ends of a
        segment; "sampled:N", N points in each cell; "preintegrated", from a table.
    isovalues : scalars whose surfaces are drawn, lit from both sides.
    opacity : the surfaces', more than 0, at most 1.
    colour : the surfaces'; by default that of the transfer function at their scalar.
    kept : (blocks,) bool, the blocks of cells that are drawn; by default those that the transfer
        function does not leave transparent.
    lanes : rays that a work-item follows side by side, 1 or 16; by default what suits the device.
    pending : fragments of a ray that the buffer of cell projection holds.
    max_pairs, max_entries : pairs of a cell and a tile, in cell projection, and entries of rays, in
        ray casting, beyond which a picture is refused.
    table : scalars and lengths along the sides of the pre-integrated table.
    buckets : buckets in which control points are searched, as in Integral; no picture differs.

    Raises
    ------
    VoxtoolError : an unknown method or integrator, an extinction that float32 does not hold, or
        isovalues of a volume with one scalar a cell.
    """

    kind: ClassVar[str] = "volume"
    samples: ClassVar[int] = 1

    content: TetVolume
    transfer: TransferFunction | None = None
    method: str = "raycast"
    integrator: str = "linear"
    isovalues: Sequence[float] = ()
    opacity: float = 1.0
    colour: Sequence[float] | None = None
    kept: np.ndarray | None = None
    lanes: int | None = None
    pending: int = PENDING
    max_pairs: int = MAX_PAIRS
    max_entries: int = MAX_ENTRIES
    table: tuple[int, int] = TABLE
    buckets: int | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise VoxtoolError(f"method {self.method!r} is unknown: choose {', '.join(METHODS)}")
        integrator_of(self.integrator)
        if self.colour is not None:
            checked_colour(self.colour)
        _ = self.local, self.surfaces

    @cached_property
    def shown_through(self) -> TransferFunction:
        """The transfer function: by default `default_transfer`, or none beside isosurfaces."""
        if self.transfer is not None:
            return self.transfer
        if self.isovalues:
            return TransferFunction([self.content.scalar_range[0]], [BLACK], [0.0])  # pyright: ignore
        return default_transfer(self.content)

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """The isosurfaces in the volume's frame; None if there are none."""
        if not self.isovalues:
            return None
        colours = self.transfer or default_transfer(self.content)
        found = surfaces_of(self.content, self.isovalues, colours, self.colour, self.opacity)
        return found if len(found.isovalues) else None

    @cached_property
    def local(self) -> LocalTransfer:
        """The transfer function in the volume's frame."""
        return self.shown_through.local(self.content)

    @cached_property
    def walks(self) -> bool:
        """True if extinction is so steep that pictures are drawn in float64, by either method."""
        linear = self.integrator == "linear" and self.content.layout != "hexahedra"
        return linear and self.local.steepest > STEEP

    @cached_property
    def blocks(self) -> np.ndarray:
        """(blocks,) bool: the blocks of cells that are drawn."""
        if self.kept is not None:
            return self.kept
        low, high = self.content.ranges.T
        if self.walks:  # points are not rounded to float32
            low, high = np.nextafter(low, np.float32(-1)), np.nextafter(high, np.float32(2))
        shown = ~self.local.transparent(low, high)
        return shown | self.surfaces.blocks(self.content) if self.surfaces else shown

    @cached_property
    def cells_shown(self) -> int:
        """The number of cells in these blocks."""
        return int(np.count_nonzero(kept_cells(self.content, self.blocks)))

    @cached_property
    def drawn(self) -> TetVolume:
        """The volume that is on the device: the part that is drawn if that is less than half."""
        few = 0 < 2 * self.cells_shown < len(self.content.cells)
        return part_of(self.content, self.blocks) if few else self.content

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of drawing, in order."""
        table = ("preintegrate",) if self.integrator == "preintegrated" else ()
        if self.walks:
            return ("upload", "ray entries", "ray walking")
        if self.method == "projection":
            return ("upload", *table, "cell projection", "tile lists", "compositing")
        return ("upload", *table, "cell setup", "ray entries", "ray casting")

    @property
    def left_out(self) -> dict[str, str]:
        """Reasons by the name of what is not drawn or computed."""
        out, count = {}, len(self.content.cells)
        if self.cells_shown < count:
            hidden = count - self.cells_shown
            less = sum(self.content.sizes().values()) - sum(self.drawn.sizes().values())
            saved = f"; {human(less)} of textures are not uploaded" if less else ""
            out[TRANSPARENT] = (
                f"the transfer function leaves {hidden:,} of {count:,} transparent{saved}"
            )
        if self.walks:
            out[f"{self.method} in float32"] = (
                f"extinctions are up to {self.local.steepest:.3g} per local length, and more than "
                f"{STEEP:g} shows its rounding"
            )
        if self.integrator != "preintegrated":
            out["pre-integrated table"] = f"the integrator is {self.integrator}"
        return out

    @property
    def counts(self) -> dict[str, int]:
        """The sizes of the volume, by name."""
        return {"cells": len(self.content.cells), "cells_shown": self.cells_shown}

    @property
    def device_bytes(self) -> int:
        """Bytes on the device: the textures, and the records of cells and vertices for a view."""
        volume = self.drawn
        cell, vertex = (8, 32) if self.walks else (64, 16)
        view = cell * len(volume.cells) + vertex * len(volume.vertices)
        return sum(volume.sizes().values()) + view

    def points(self) -> np.ndarray:
        """Return (V, 3) float64, world units: the vertices, whatever the transfer function
        shows."""
        return self.content.points()

    def local_rays(self, rays: Rays) -> Rays:
        """Return rays in the volume's frame; see Rays.local."""
        return rays.local(self.content.origin, self.content.scale)

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        """Return the picture, (H, W, 4) float32, premultiplied: one value a ray."""
        if self.walks or are_skewed(rays):
            return self._walk(rays, device)
        if self.method == "projection":
            return self.project(rays, device).picture
        return cast(self.drawn, *self._on_device(rays, device), self.max_entries)

    def _walk(self, rays: Rays, device: Device) -> np.ndarray:
        """Return the picture in float64, by either method.

        Raises
        ------
        VoxtoolError : another integrator than "linear", or cells that are no tetrahedra.
        """
        if self.integrator != "linear" or self.content.layout == "hexahedra":
            raise VoxtoolError(
                "rays whose right and down are not perpendicular to each other and to the "
                "direction need tetrahedra and the integrator linear: choose these, or other rays"
            )
        volume, shown = self.shown_on(device)
        view = Viewpoint.of(self.local_rays(rays), self.content, device, exact=True)
        return walk(self.drawn, volume, shown, view, self.local, self.surfaces, self.max_entries)

    def project(self, rays: Rays, device: Device) -> Projection:
        """Return the picture by cell projection, and the work that it took."""
        cells = self._on_device(rays, device)
        return CellProjection(*cells, pending=self.pending, max_pairs=self.max_pairs).run()

    def shown_on(self, device: Device) -> tuple[DeviceVolume, ShownCells]:
        """Return the volume on a device, and its drawn cells."""
        volume = DeviceVolume.of(self.drawn, device)
        kept = self.blocks if self.drawn is self.content else np.ones(len(self.drawn.ranges), bool)
        return volume, volume.shown(self.drawn, kept)

    def _on_device(
        self, rays: Rays, device: Device
    ) -> tuple[DeviceVolume, ShownCells, Viewpoint, Integral]:
        """Return the volume, its drawn cells, the viewpoint and the integrator on a device."""
        volume, shown = self.shown_on(device)
        integral = Integral(
            self.content, self.local, volume, self.integrator, self.lanes, self.table,
            self.surfaces, self.buckets,
        )  # fmt: skip
        return volume, shown, Viewpoint.of(self.local_rays(rays), self.content, device), integral

    def why_empty(self) -> str:
        """Return the reason why no view shows anything, or ""."""
        if self.cells_shown:
            return ""
        low, high = self.content.scalar_range
        if self.isovalues and self.transfer is None:
            return (
                f"{printable(self.content.scalar)} is from {low:.6g} to {high:.6g}, so no surface "
                "has these isovalues: choose others"
            )
        return (
            f"the transfer function is transparent from {low:.6g} to {high:.6g}, where "
            f"{printable(self.content.scalar)} is: choose another"
        )
