"""The bounds by which winding numbers near holes are decided, each by itself, against float64."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest
from helpers import meshes
from helpers.signs import winding
from svo.voxelization.fill.test_fill import UNIT, centres
from svo.voxelization.test_voxelize import lattice_grid, lattice_mesh

from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Device
from voxtool.svo.octree.layout import BRICK
from voxtool.svo.voxelization.fill.rows import list_crossings
from voxtool.svo.voxelization.fill.winding import NearHoles
from voxtool.svo.voxelization.scan_conversion import Scan
from voxtool.svo.voxelization.voxelize import plan_voxelize

EXACT = 1e-9  # of the oracles


def near_holes(device: Device, vertices: np.ndarray, faces: np.ndarray, side: int) -> NearHoles:
    mesh, grid = lattice_mesh(vertices, faces), lattice_grid((side,) * 3)
    job = plan_voxelize(mesh, grid, fill="winding", device=device)
    crossings = list_crossings(Scan(job.lattice, job.plan))
    return NearHoles(job.lattice, job.plan, 1 << 30, crossings)


def soup(seed: int, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Few large triangles, small ones, and needles, in a cube of this side."""
    rng = np.random.default_rng(seed)
    kinds = [
        meshes.random_triangles(rng, n, (side,) * 3, size)[0]
        for n, size in ((2, None), (6, side / 6), (9, 0.5))
    ]
    needles = kinds[0].reshape(-1, 3, 3).copy()
    needles[:, 2] = needles[:, 1] + rng.integers(-3, 4, (2, 3))
    vertices = np.concatenate([*kinds, needles.reshape(-1, 3)])
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


@pytest.mark.parametrize("level", [2, 3, 4])
def test_expansions_keep_their_bounds(device: Device, level: int) -> None:
    """About the voxel beyond the middle of a block, without caps between its voxels."""
    vertices, faces = soup(level, 12)
    holes = near_holes(device, vertices, faces, 32)
    blocks = np.arange((32 >> level) ** 3, dtype=np.uint64)
    blocks = blocks[~holes._meet_caps(blocks, level)]
    found = holes._expand(blocks, level)
    finite = np.isfinite(found[:, -1])
    assert finite.sum() >= 3
    unit = float(holes._arguments["frame"][3])
    caps = vertices[faces[:, ::-1]].astype(np.float64)  # those of triangles that are alone
    tightest = np.inf
    for block, (*terms, rest) in zip(blocks[finite], found[finite], strict=True):
        size = 1 << level
        cells = np.indices((size,) * 3).reshape(3, -1).T[:: size**3 // 16]
        cells = np.concatenate([[[size // 2] * 3], cells, [[0] * 3, [size - 1] * 3]])
        points = (morton_decode(block[None])[0] * size + cells) * UNIT + UNIT // 2
        at = winding(points, caps)
        x, y, z = ((points - points[0]) * unit).T
        a, b, c, xx, yy, zz, yz, xz, xy, *cubic = terms
        change = a * x + b * y + c * z + xx * x * x + yy * y * y + zz * z * z
        change += yz * y * z + xz * x * z + xy * x * y
        xyz = [x**3, y**3, z**3, x*x*y, x*x*z, y*y*x, y*y*z, z*z*x, z*z*y, x*y*z]  # fmt: skip
        change += cubic @ np.array(xyz)
        error = np.abs(at - at[0] - change).max()
        assert error <= rest + EXACT
        tightest = min(tightest, rest / max(error, EXACT))
    assert tightest < 1000  # the bounds are of use


def cosines(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) the least length of a triangle's vector at a point [Oosterom 1983], over the product of
    the distances to its corners: small near edges and triangles."""
    a, b, c = (triangles[:, None, i] - points for i in range(3))
    x, y, z = (np.sqrt((v * v).sum(axis=-1)) for v in (a, b, c))
    ab, bc, ca = ((u * v).sum(axis=-1) for u, v in ((a, b), (b, c), (c, a)))
    along = x * y * z + ab * z + bc * x + ca * y
    return (np.hypot(along, (a * np.cross(b, c)).sum(axis=-1)) / (x * y * z)).min(axis=0)


def decided(holes: NearHoles, side: int, doubt: float) -> np.ndarray:
    """(bricks, 64) bool: the voxels of a cube of this side that sums without moments decide, with
    this margin, by bricks and as `voxels_of` orders them."""
    every = copy(holes._windings[0])
    every.reach = 1e6  # no triangle is farther away
    device, bricks = every.device, morton_encode(np.indices((side // 4,) * 3).reshape(3, -1).T)
    n = len(bricks)
    inside, left = (device.empty(n, BRICK) for _ in range(2))
    holes._kernel("decide_bricks")(
        n, bricks=device.put(bricks), inside=inside, open=left, same=device.empty(n, np.uint8),
        moments=every._sum_moments(), reach=every.reach, most=1 << 20, doubt=doubt,
        **holes._arguments,
    )  # fmt: skip
    bit = morton_encode(centres((4, 4, 4)) // UNIT)
    return left.take()[:, None] >> bit & np.uint64(1) == 0


def voxels_of(side: int) -> np.ndarray:
    """(bricks * 64, 3) centres of the voxels of a cube of this side."""
    corners = 4 * np.indices((side // 4,) * 3).reshape(3, -1).T[:, None]
    cells = corners + centres((4, 4, 4)) // UNIT
    return cells.reshape(-1, 3) * UNIT + UNIT // 2


@pytest.mark.parametrize("seed", range(3))
def test_single_precision_knows_its_error(device: Device, seed: int) -> None:
    """Without moments, and with any other margin, a voxel that is decided is farther from 1/2 than
    that margin. The margins are the distances of voxels near edges, where errors are large."""
    vertices, faces = soup(seed, 16)
    holes = near_holes(device, vertices, faces, 16)
    triangles, points = vertices[faces].astype(np.float64), voxels_of(16)
    distance = np.abs(winding(points, triangles) - 0.5).reshape(-1, 64)
    assert decided(holes, 16, 0.0).mean() > 0.95
    nearest = np.argsort(cosines(triangles, points))[:80]
    for doubt in distance.ravel()[nearest] + EXACT:
        assert (distance[decided(holes, 16, doubt)] > doubt - EXACT).all()


@pytest.mark.parametrize(("count", "size"), [(1, 1.0), (300, 1.0), (300, 2.5)])
def test_dipoles_know_their_error(device: Device, count: int, size: float) -> None:
    """Small triangles around bricks, which count as dipoles there, or at the corners alone."""
    rng = np.random.default_rng(count)
    vertices = meshes.random_triangles(rng, count, (24,) * 3, size)[0]
    faces = np.arange(len(vertices)).reshape(-1, 3)
    holes = near_holes(device, vertices, faces, 24)
    distance = np.abs(winding(voxels_of(24), vertices[faces].astype(np.float64)) - 0.5)
    assert decided(holes, 24, 0.0).mean() > 0.95
    for doubt in rng.choice(distance, 60, replace=False) + EXACT:
        found = decided(holes, 24, doubt).ravel()
        assert (distance[found] > doubt - EXACT).all()
