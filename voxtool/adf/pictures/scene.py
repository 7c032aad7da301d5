"""Distance fields as scenes, for `voxtool.render`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from voxtool.adf.field.cells import cell_of, half_diagonals
from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.raycast import COLOUR, NODE_BYTES, cast, checked_offset, local_offset
from voxtool.adf.queries.textures import check_search, search_bytes
from voxtool.camera import Rays, box_corners, checked_colour
from voxtool.opencl import Device

FINEST_LEVEL = 5  # of the boxes that bound the surface


@dataclass(frozen=True, eq=False)
class FieldScene:
    """The surface of a distance field, or an offset surface; see voxtool/pictures/rendering.py.

    offset: distance of the surface drawn, world units, rounded to float32; negative inside. colour:
    red, green and blue, from 0 to 1. search: how the hash is searched for leaves, "linear",
    "binary", "coherent" or "bottom-up", which the picture does not show; by default blocks know
    their children's, and nothing is searched. lanes: rays that a work-item follows side by side, 1
    or 16 (with a search 1), which the picture does not show; by default what suits the device.
    VoxtoolError is raised if the offset is not finite, or there is no such colour or search.
    """

    kind: ClassVar[str] = "field"
    samples: ClassVar[int] = 2

    content: DistanceField
    offset: float = 0.0
    colour: Sequence[float] = COLOUR
    search: str | None = None
    lanes: int | None = None

    def __post_init__(self) -> None:
        checked_offset(self.content, self.offset)
        checked_colour(self.colour)
        if self.search is not None:
            check_search(self.search)

    @property
    def stages(self) -> tuple[str, ...]:
        return ("upload", "marking", "ray casting")

    @property
    def left_out(self) -> dict[str, str]:
        out = {}
        if not self.search:
            out["the textures of cells and the hash"] = "a block knows its children's"
        if self.content.bounds is not None:
            out["the texture of bounds"] = "rays do not need error bounds"
        return out

    @property
    def counts(self) -> dict[str, int]:
        return {"blocks": len(self.content.voxels)}

    @property
    def device_bytes(self) -> int:
        voxels = self.content.voxels
        searched = search_bytes(self.content) if self.search else 0
        return voxels.nbytes + NODE_BYTES * len(voxels) + searched

    def points(self) -> np.ndarray:
        """Return points whose convex hull contains the surface, (N, 3) float64, world units: the
        corners of the leaves that it crosses, or of coarser cells that it may cross."""
        field = self.content
        offset = local_offset(field, self.offset)
        every = field.blocks.astype(np.uint64)  # ascending
        count = int(np.searchsorted(every, 8**FINEST_LEVEL))  # of those above that level
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
            # near a sign discontinuity, a crossed cell may be far from the surface
            found = np.abs(corners).min(axis=1) <= near
            found &= np.where(refined, levels == FINEST_LEVEL, crossed)
            passed.append(children[found])
        shown = np.concatenate(passed)
        levels, cells = cell_of(shown if len(shown) else np.ones(1, np.uint64))
        sides = np.ldexp(1.0, -levels)[:, None]
        return np.array(field.origin) + field.side * box_corners(cells * sides, sides)

    def local_rays(self, rays: Rays) -> Rays:
        """Return rays in units of the field's side from its corner; see Rays.local."""
        return rays.local(self.content.origin, self.content.side)

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        return cast(self, rays, device)

    def why_empty(self) -> str:
        field, offset = self.content, checked_offset(self.content, self.offset)
        low, high = (field.side * float(v) for v in (field.voxels.min(), field.voxels.max()))
        if low <= offset <= high:
            return ""
        return (
            f"the field has distances from {low:.6g} to {high:.6g}, so no surface at {offset:g}: "
            "choose another offset"
        )
