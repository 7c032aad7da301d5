"""What `voxtool render` shows, an octree, a distance field or a volume, with the same questions to
each: where is it, what will be done, what is the picture, and why could there be nothing in it?"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from voxtool.adf.bounds import half_diagonals
from voxtool.adf.field import DistanceField
from voxtool.adf.hashing import cell_of
from voxtool.errors import VoxtoolError, printable
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.tets.volume import TetVolume


FINEST = 5  # level from the root on, of the cubes around what there is to see


class Scene(ABC):
    """Something that rays are cast at."""

    kind: ClassVar[str]
    samples: ClassVar[int]  # along a pixel's side, by default
    stages: tuple[str, ...]  # of drawing it, in order

    @abstractmethod
    def points(self) -> np.ndarray:
        """(N, 3) float64, world units: within their convex hull is all that there is to see."""

    @abstractmethod
    def device_bytes(self) -> int:
        """Of it on the device."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Of what it is made of, by name."""

    @abstractmethod
    def left_out(self) -> dict[str, str]:
        """What is not drawn or done, and why."""

    @abstractmethod
    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        """(H, W, 4) float32, premultiplied: a value a ray."""

    def legend(self, height: int, background: Sequence[float] | None) -> np.ndarray:
        """What explains it, to stand beside the picture over this background: nothing, mostly."""
        return np.empty((height, 0, 4), np.float32)

    @abstractmethod
    def nothing(self) -> str:
        """Why there is nothing to see, from wherever one looks; or ""."""


class OctreeScene(Scene):
    """The voxels of an octree, or the nodes of a level."""

    kind = "octree"
    samples = 2
    stages = ("coverage", "ray casting")

    def __init__(
        self, octree: Octree, level: int | str | None = None, colour: Sequence[float] | None = None
    ) -> None:
        self.octree = octree
        self.level = level if isinstance(level, int) else None  # None: voxels
        if self.level is not None and not 0 <= self.level < octree.depth:
            raise VoxtoolError(
                f"level {level}: choose voxel, or a level from 0 to {octree.depth - 1}, those that "
                f"an octree of dim {octree.grid.dim} has"
            )
        self.options = _given(level=level, colour=colour)

    def points(self) -> np.ndarray:
        """The corners of coarse nodes, but none beyond the bricks or what is drawn for them."""
        grid, finest = self.octree.grid, BRICK_SIDE << (self.level or 0)
        if not self.octree.count:
            corners = _cube_corners(np.zeros((1, 3), np.int64), np.array(grid.shape))
            return np.array(grid.origin) + np.array(grid.pitch) * corners
        coarse = max(self.octree.depth - 1 - FINEST, 0)
        low, high, cubes = np.array(grid.shape), np.zeros(3, np.int64), []
        for level in self.octree.levels():
            held = level.inside if level.number else self.octree.bricks != 0
            if held.any():
                low = np.minimum(low, level.cells[held].min(axis=0))
                high = np.maximum(high, level.cells[held].max(axis=0) + level.side)
            if level.number >= coarse:
                shown = level.inside | level.refined if level.number == coarse else level.inside
                cells = level.cells[shown] // finest * finest
                cubes.append(_cube_corners(cells, max(level.side, finest)))
        low, high = low // finest * finest, -(-high // finest) * finest
        corners = np.clip(np.concatenate(cubes), low, high)
        return np.array(grid.origin) + np.array(grid.pitch) * corners

    def device_bytes(self) -> int:
        return self.octree.nbytes

    def counts(self) -> dict[str, int]:
        return {"nodes": len(self.octree.nodes), "bricks": len(self.octree.bricks)}

    def left_out(self) -> dict[str, str]:
        if self.level is None:
            return {}
        return {f"what is finer than level {self.level}": "its nodes are drawn as cubes"}

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        from voxtool.svo.raycast import render_svo

        return render_svo(self.octree, rays, device=device, **self.options)

    def nothing(self) -> str:
        return "" if self.octree.count else "no voxel of the octree is set"


class FieldScene(Scene):
    """The surface of a distance field, or one at a distance from it."""

    kind = "field"
    samples = 2
    stages = ("upload", "ray casting")

    def __init__(
        self,
        field: DistanceField,
        offset: float | None = None,
        colour: Sequence[float] | None = None,
    ) -> None:
        from voxtool.adf.raycast import least_shown

        self.field = field
        self.offset = offset or (least_shown(field) if field.sign == "none" else 0.0)
        self.options = _given(offset=offset, colour=colour)

    def points(self) -> np.ndarray:
        """The corners of the leaves that the surface passes, or of coarser cells that it may."""
        field, offset = self.field, self.offset / self.field.side
        every = field.blocks.astype(np.uint64)  # ascending
        count = int(np.searchsorted(every, 8**FINEST))  # of those above level FINEST
        blocks, voxels = every[:count], field.voxels[:count]
        levels = cell_of(blocks)[0] + 1  # of their children
        near = half_diagonals(levels) + field.tolerance
        passed = []
        for z, y, x in itertools.product((0, 1), repeat=3):
            children = blocks << np.uint64(3) | np.uint64(4 * z + 2 * y + x)
            corners = voxels[:, z : z + 2, y : y + 2, x : x + 2].reshape(-1, 8) - offset
            crossed = (corners.min(axis=1) <= 0) & (corners.max(axis=1) >= 0)
            places = np.minimum(np.searchsorted(every, children), len(every) - 1)
            refined = every[places] == children
            # where a sign jumps, a surface may be far off
            found = np.abs(corners).min(axis=1) <= near
            found &= np.where(refined, levels == FINEST, crossed)
            passed.append(children[found])
        shown = np.concatenate(passed)
        levels, cells = cell_of(shown if len(shown) else np.ones(1, np.uint64))
        sides = np.ldexp(1.0, -levels)[:, None]
        return np.array(field.origin) + field.side * _cube_corners(cells * sides, sides)

    def device_bytes(self) -> int:
        return sum(size for name, size in self.field.sizes().items() if name != "bounds")

    def counts(self) -> dict[str, int]:
        return {"blocks": len(self.field.voxels)}

    def left_out(self) -> dict[str, str]:
        if self.field.bounds is None:
            return {}
        return {"the texture of bounds": "a surface does not need it"}

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        from voxtool.adf.raycast import render_adf

        return render_adf(self.field, rays, device=device, **self.options)

    def nothing(self) -> str:
        ends = self.field.voxels.min(), self.field.voxels.max()
        low, high = (self.field.side * float(end) for end in ends)
        if low <= self.offset <= high:
            return ""
        return (
            f"the field has distances from {low:.6g} to {high:.6g}, so no surface at "
            f"{self.offset:g}: choose another --offset"
        )


class VolumeScene(Scene):
    """A tetrahedral volume as a transfer function shows it."""

    kind = "volume"
    samples = 1

    def __init__(
        self,
        volume: TetVolume,
        transfer_file: str | None = None,
        map_name: str | None = None,
        opacity_range: tuple[float, float] | None = None,
        unit_distance: float | None = None,
        method: str | None = None,
        integrator: str | None = None,
    ) -> None:
        from voxtool.files.transfer import read_transfer
        from voxtool.tets.integrate import integrator_of
        from voxtool.tets.transfer import DEFAULT_MAP, default_unit_distance, named
        from voxtool.tets.view import kept_blocks
        from voxtool.tets.volume import BLOCK

        self.volume = volume
        self.method = method or "raycast"
        self.integrator = integrator or "linear"
        self.preintegrated = integrator_of(self.integrator)[0] == "preintegrated"
        if transfer_file is not None:
            self.transfer = read_transfer(transfer_file)
        else:
            self.transfer = named(
                map_name or DEFAULT_MAP,
                *volume.scalar_range,
                unit_distance or default_unit_distance(volume) or 1.0,
                opacity_range,
            )
        table = ("preintegrate",) if self.preintegrated else ()
        self.stages = ("upload", *table, "look", "entries", "ray casting")
        if self.method == "projection":
            self.stages = ("upload", *table, "project", "tiles", "composite")
        kept = kept_blocks(volume, self.transfer.local(volume))
        self.kept = int(np.count_nonzero(np.repeat(kept, BLOCK)[: len(volume.cells)]))

    def points(self) -> np.ndarray:
        """All vertices: another transfer function moves nothing."""
        volume = self.volume
        return np.array(volume.origin) + volume.scale * volume.vertices[:, :3].astype(np.float64)

    def device_bytes(self) -> int:
        """With what is worked out of its cells and vertices for a viewpoint."""
        volume = self.volume
        view = 64 * len(volume.cells) + 16 * len(volume.vertices)
        return sum(volume.sizes().values()) + view

    def counts(self) -> dict[str, int]:
        return {"cells": len(self.volume.cells), "cells_shown": self.kept}

    def left_out(self) -> dict[str, str]:
        out = {}
        if self.kept < len(self.volume.cells):
            share = f"{len(self.volume.cells) - self.kept:,} cells"
            out[share] = "the transfer function leaves them transparent"
        if not self.preintegrated:
            out["pre-integrated table"] = f"the integrator is {self.integrator}"
        return out

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        from voxtool.tets.render import VolumeRenderer

        return VolumeRenderer(self.volume, device).render(
            rays, self.transfer, self.method, self.integrator
        )

    def nothing(self) -> str:
        if self.kept:
            return ""
        low, high = self.volume.scalar_range
        return (
            f"the transfer function is transparent from {low:.6g} to {high:.6g}, where "
            f"{printable(self.volume.scalar)} is: choose another"
        )

    def legend(self, height: int, background: Sequence[float] | None) -> np.ndarray:
        """The transfer function, to stand beside a picture."""
        from voxtool.plots.legend import draw_legend

        volume = self.volume
        return draw_legend(
            self.transfer,
            volume.scalar_range,
            printable(volume.scalar),
            height,
            unit=printable(volume.units),
            background=background,
        )


def _cube_corners(low: np.ndarray, side: Any) -> np.ndarray:
    """(8 N, 3): the corners of N boxes with these low corners and sides."""
    ways = np.array(list(itertools.product((0, 1), repeat=3)))
    return (low + ways[:, None] * side).reshape(-1, 3)


def scene_class(content: Octree | DistanceField | TetVolume) -> type[Any]:
    """The scene that shows this."""
    if isinstance(content, Octree):
        return OctreeScene
    return FieldScene if isinstance(content, DistanceField) else VolumeScene


def _given(**options: Any) -> dict[str, Any]:
    """Those that are not None: the others have their own defaults."""
    return {name: value for name, value in options.items() if value is not None}
