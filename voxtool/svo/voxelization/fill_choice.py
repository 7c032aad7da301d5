"""The fill rule that "auto" takes for a mesh that is not watertight.

A consistent mesh (consistency.py) is filled by winding numbers, and nothing is compared. For any
other mesh rules are tried in order, on a grid of DIM voxels around it whatever grid is asked for:
winding numbers of the mesh as it is, if its edges agree, and of the oriented mesh
(spatial/orientation.py); then floods with smaller and smaller gaps. The first rule that keeps
enough of the outer surface (kept_share.py) is taken; a flood without a gap keeps all of it.

Holes let the flood in, so that walls between overlapping parts count as outer surface too: solids
lose those walls, and crusts keep them. Winding numbers are therefore taken as well where edges
agree, every part encloses a volume, and what they lose of the outer surface is inside the solid.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator

import numpy as np

from voxtool.errors import MeshWarning, count_of
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial.fill_rule import Inside
from voxtool.spatial.orientation import orient
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.consistency import agree, encloses
from voxtool.svo.voxelization.fill.caps import Boundary
from voxtool.svo.voxelization.kept_share import Share, outer_surface, share_of, share_within

DIM = 128  # of the grid on which rules are compared
MOVED = 37 / 256, 53 / 256, 91 / 256  # voxels
GAPS = 3, 1, 0  # voxels of that grid, of floods
LAST = "flood", GAPS[-1]
HELD = ", and the rest is inside"


def choose(
    mesh: Mesh, boundary: Boundary, device: Device, voxelized: Callable[..., Octree]
) -> Inside:
    """Return what is inside of a mesh that is not consistent.

    voxelized(mesh, grid, mode, fill=, gap=, device=) returns an octree.
    """
    grid = _grid(mesh)
    surface = voxelized(mesh, grid, "surface26", device=device)
    flooded = voxelized(mesh, grid, "solid", fill="flood", device=device)
    outer = outer_surface(surface, flooded, device)
    lost: Share | None = None
    for oriented, fill, gap, turned in _candidates(mesh, boundary, device):
        with warnings.catch_warnings(action="ignore", category=MeshWarning):  # nothing is taken yet
            result = voxelized(oriented or mesh, grid, "solid", fill=fill, gap=gap, device=device)
        share = share_of(outer, result, device)
        held = (
            fill == "winding"
            and not share.enough
            and share_within(outer, result, device).enough
            and encloses(oriented or mesh, device)
        )
        if share.enough or held or (fill, gap) == LAST:
            why = _reason(fill, gap, turned, share, lost) + HELD * held
            return Inside(
                oriented, fill, why=why, compared=True, gap=gap, pitch=grid.pitch[0],
                turned=turned,
            )  # fmt: skip
        lost = lost or share
    raise AssertionError("the last rule is taken")


def _grid(mesh: Mesh) -> Grid:
    """Return the grid on which rules are compared: on either side of a sheet through voxel centres
    winding numbers are 1/2, so it is moved, by which symmetric sheets and slopes avoid them."""
    fitted = Grid.fit(mesh, DIM)
    moved = (a - p * by for a, p, by in zip(fitted.origin, fitted.pitch, MOVED, strict=True))
    x, y, z = moved
    return Grid(fitted.shape, (x, y, z), fitted.pitch)


def _candidates(
    mesh: Mesh, boundary: Boundary, device: Device
) -> Iterator[tuple[Mesh | None, str, int, int]]:
    """Yield oriented meshes if faces are reversed, rules and gaps, and the number of such faces."""
    agreed = agree(boundary)
    if agreed:
        yield None, "winding", 0, 0
    with device.stage("orientation"):
        oriented = orient(mesh, device)
    turned = int(np.count_nonzero(oriented.reversed))
    if turned:
        yield oriented.mesh, "winding", 0, turned
    elif not agreed:
        yield None, "winding", 0, 0
    for gap in GAPS:
        yield None, "flood", gap, 0


def _reason(fill: str, gap: int, turned: int, share: Share, lost: Share | None) -> str:
    """Return why a rule was taken; `lost` is the share of the first one that was not."""
    kept = f"keep {share} of its outer surface"
    if fill == "winding":
        faces = f"{count_of(turned, 'face')} turned outward; " if turned else ""
        return f"{faces}winding numbers {kept}"
    rule = f"flood with a gap of {gap} of {DIM} voxels" if gap else "flood"
    return f"winding numbers keep {lost} of its outer surface, {rule} keeps {share}"
