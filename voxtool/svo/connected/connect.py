"""The voxels that keep the thin parts of a solid in one piece.

Candidates are voxels that touch the mesh about parts that are thinner than two voxels
(thin_parts.py). With the solid they are thinned (thinning.py): those go first in which the mesh has
the least area, and the voxels of the solid stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.attribution.pieces import areas_of, list_pieces
from voxtool.svo.components import Components
from voxtool.svo.connected.thin_parts import Bricks, Solid, find_thin_parts
from voxtool.svo.connected.thinning import Thinning
from voxtool.svo.layout import BRICK_SIDE, descend, unite_bricks
from voxtool.svo.octree import Octree
from voxtool.svo.scan import TOUCHED, ActiveNodes, Scan
from voxtool.svo.tiling import Tiling


@dataclass(frozen=True)
class Added:
    """Voxels that are added to a solid.

    bricks : they, in the grid
    pieces : 26-connected components before
    """

    bricks: Bricks
    pieces: int


def find_added(
    octree: Octree,
    surface: Bricks,
    areas_in: Callable[[np.ndarray], np.ndarray],
    max_memory: int,
) -> Added:
    """Return the voxels that connect the thin parts of a solid.

    Parameters
    ----------
    surface : Bricks
        The voxels that the mesh touches.
    areas_in : callable
        Returns the area of the mesh in each voxel, (m,) int64, of masks of the surface's bricks.
    max_memory : int
        Bytes that may be taken.
    """
    voxels = Tiling.of(octree, 0)
    solid = Solid(voxels)
    frame = morton_encode(np.full((1, 3), voxels.corner // BRICK_SIDE))
    thin = find_thin_parts(solid, Bricks(surface.codes | frame, surface.masks), max_memory)
    candidates = thin.codes[thin.added]
    if not len(candidates):
        return Added(Bricks(surface.codes[:0], surface.masks[:0]), solid.pieces)
    masks = np.zeros_like(surface.masks)
    own = Bricks(*_united(candidates ^ frame << np.uint64(6)))
    masks[np.searchsorted(surface.codes, own.codes)] = own.masks
    mantissa, exponent = np.frexp(areas_in(masks).astype(np.float64))
    weights = 2 * exponent.astype(np.int64) + (mantissa >= 0.75)  # two steps for twice the area
    stays = Thinning(thin.codes, thin.added, thin.covered).run(weights, thin.subfields)
    return Added(Bricks(*_united(thin.codes[stays & thin.added] ^ frame << np.uint64(6))), solid.pieces)


def _united(voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bricks and masks of voxels, given by ascending Morton codes."""
    return unite_bricks(voxels >> np.uint64(6), np.uint64(1) << (voxels & np.uint64(63)))


def connect(octree: Octree, scan: Scan, active: ActiveNodes, max_memory: int) -> Octree:
    """Return a solid with the voxels that connect its thin parts.

    Parameters
    ----------
    scan, active : Scan, ActiveNodes
        Of the mesh, and of its level-1 nodes.
    max_memory : int
        Bytes that may be taken.
    """
    codes = descend(active.nodes.get().astype(np.uint64))
    surface = Bricks(codes, scan.voxels(TOUCHED, active).take())
    found = find_added(octree, surface, partial(areas_in, scan, active), max_memory)
    facts = {"added": int(np.bitwise_count(found.bricks.masks).sum()), "pieces": found.pieces}
    if facts["added"]:
        bricks = octree.bricks.copy()
        places = np.searchsorted(octree.levels()[-1].codes, found.bricks.codes)
        bricks[places] |= found.bricks.masks
        octree = replace(octree, bricks=bricks)
        facts["became"] = len(Components.of(Tiling.of(octree, 0), 26).sizes)
    return replace(octree, plan={**octree.plan, "connected": {"became": found.pieces, **facts}})


def areas_in(scan: Scan, active: ActiveNodes, masks: np.ndarray) -> np.ndarray:
    """Return the area of the mesh in each voxel of the masks of the active nodes' bricks, (n,)
    int64, of which UNITS_OF_AREA are a face of a voxel."""
    bricks = Bricks(descend(active.nodes.get().astype(np.uint64)), masks)
    counts = np.bitwise_count(masks)
    starts = np.cumsum(counts) - counts
    put = scan.device.put
    found = list_pieces(scan, active, put(masks), put(starts.astype(np.uint32)), TOUCHED)
    areas = areas_of(scan, found, morton_decode(bricks.where(masks)))
    voxels = found.voxels.get(0, found.n)
    return np.bincount(voxels, areas, int(counts.sum())).astype(np.int64)
