"""Pictures of octrees against slabs of boxes in plain numpy, analytic planes, and symmetries."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.octree import ball, octree_from_dense

from voxtool.camera import Camera, Rays
from voxtool.errors import VoxtoolError, VoxtoolWarning
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.pictures.rendering import render
from voxtool.svo.cells.ray_links import coverages
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.layout import INSIDE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.pictures.raycast import COLOUR, cast, depths

AMBIENT = 0.08


def placed(octree: Octree, origin=(0.0, 0.0, 0.0), pitch=(1.0, 1.0, 1.0)) -> Octree:
    return replace(octree, grid=Grid(octree.grid.shape, origin, pitch))


def every_ray(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) origins and directions, as the class says."""
    width, height = rays.size
    x = (np.arange(width) + 0.5 - width / 2)[None, :, None]
    y = (np.arange(height) + 0.5 - height / 2)[:, None, None]
    step = x * rays.right + y * rays.down
    if rays.perspective:
        return np.broadcast_to(rays.origin, step.shape), rays.direction + step
    return rays.origin + step, np.broadcast_to(rays.direction, step.shape)


def boxes(octree: Octree, level: int | str, least: float = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the (N, 3) low and high corners, in the world, of what a level draws: cubes that hold
    something, at least this share of theirs."""
    side = 1 if level == "voxel" else 4 << int(level)
    dense = octree.to_dense()
    padded = np.zeros([-(-n // side) * side for n in dense.shape], bool)
    padded[tuple(map(slice, dense.shape))] = dense
    a, b, c = (n // side for n in padded.shape)
    counts = padded.reshape(a, side, b, side, c, side).sum(axis=(1, 3, 5))
    cells = np.argwhere(counts >= max(least * side**3, 1))
    pitch, origin = np.array(octree.grid.pitch), np.array(octree.grid.origin)
    return origin + pitch * side * cells, origin + pitch * side * (cells + 1)


def nearest(low: np.ndarray, high: np.ndarray, rays: Rays) -> np.ndarray:
    """(H, W) depths at which rays meet the first of some boxes: every slab of every box."""
    origins, directions = every_ray(rays)
    depths = np.full(origins.shape[:2], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for row in range(len(depths)):
            o, d = origins[row, :, None], directions[row, :, None]
            a, b = (low - o) / d, (high - o) / d
            enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
            if rays.perspective:
                enter = np.maximum(enter, 0)
            met = np.where(enter <= leave, enter, np.inf)
            depths[row] = met.min(axis=1, initial=np.inf)
    return depths


def clear_of_edges(low: np.ndarray, high: np.ndarray, near: np.ndarray, rays: Rays) -> np.ndarray:
    """(H, W): whether a ray meets the same in boxes that are a little larger, or smaller."""
    more, less = nearest(low - near, high + near, rays), nearest(low + near, high - near, rays)
    return np.isclose(more, less, rtol=0, atol=1e3 * near.max())


def check_depths(found: np.ndarray, expected: np.ndarray, clear: np.ndarray, **tolerance) -> int:
    """Compare depths at rays that are clear of edges; return how many of them meet something."""
    assert np.array_equal(np.isfinite(found)[clear], np.isfinite(expected)[clear])
    finite = clear & np.isfinite(expected)
    np.testing.assert_allclose(found[finite], expected[finite], **tolerance)
    return np.count_nonzero(finite)


def cameras(octree: Octree, rng: np.random.Generator) -> list[Camera]:
    """From outside and from within, in perspective and orthographic."""
    origin, pitch = np.array(octree.grid.origin), np.array(octree.grid.pitch)
    extent = pitch * octree.grid.shape
    found = []
    for fov in (None, 20.0, 70.0):
        target = origin + extent * rng.uniform(0.3, 0.7, 3)
        way = rng.normal(size=3)
        way /= np.sqrt((way**2).sum())
        eye = target + 1.5 * extent.max() * way
        found.append(Camera(tuple(eye), tuple(target), (0.1, 1, 0.2), fov, 1.2 * extent.max()))
    eye = origin + extent * rng.uniform(0.1, 0.9, 3)
    found.append(Camera(tuple(eye), tuple(origin + extent * rng.uniform(0, 1, 3)), fov=90.0))
    return found


def patterns() -> list[Octree]:
    rng = np.random.default_rng(5)
    scattered = rng.random((8, 8, 8)) < 0.1
    odd = rng.random((21, 9, 13)) < 0.03
    blocks = np.kron(rng.random((4, 3, 4)) < 0.3, np.ones((8, 8, 8))).astype(bool)
    blocks[rng.random(blocks.shape) < 0.02] = True
    return [
        octree_from_dense(scattered),
        placed(octree_from_dense(odd), (-1e3, 7.5, 0.1), (0.1, 0.25, 0.07)),
        placed(octree_from_dense(blocks), (0, 0, 0), (2.0, 1.0, 3.0)),
        octree_from_dense(rng.random((16, 16, 16)) < 0.05, mode="surface26", fill="none"),
    ]


@pytest.mark.parametrize("which", range(4))
def test_first_hits(device: Device, which: int):
    """Each ray meets the nearest box, at its depth; but those that pass an edge within 1e-6."""
    octree = patterns()[which]
    pitch = np.array(octree.grid.pitch)
    met = 0
    for number, camera in enumerate(cameras(octree, np.random.default_rng(which))):
        rays = camera.rays(19, 26)
        for level in ("voxel", 0, 1) if number % 2 else ("voxel", octree.depth - 1):
            low, high = boxes(octree, level)
            expected = nearest(low, high, rays)
            clear = clear_of_edges(low, high, 1e-6 * pitch, rays)
            assert clear.mean() > 0.95
            found = depths(octree, rays, level=level, device=device)
            met += check_depths(found, expected, clear, rtol=1e-12, atol=1e-9 * pitch.max())
            picture = cast(octree, rays, level=level, device=device)
            assert np.array_equal(picture[..., 3], np.isfinite(found).astype(np.float32))
            assert not picture[np.isinf(found)].any()
            assert (picture[np.isfinite(found)] > 0).all()
    assert met > 500


@pytest.mark.parametrize("which", range(4))
def test_nodes_by_coverage(device: Device, which: int):
    """Each ray meets the nearest node of which at least a share is set: also just that share."""
    octree = patterns()[which]
    pitch = np.array(octree.grid.pitch)
    met, shown = 0, set()
    for camera in cameras(octree, np.random.default_rng(which))[:3]:
        rays = camera.rays(19, 26)
        for level in range(octree.depth):
            found = np.unique(coverages(octree, level))
            for least in (0.05, found[len(found) // 2], found[-1], 1.0):
                if least == 0:
                    continue
                low, high = boxes(octree, level, least)
                shown.add((level, len(low)))
                expected = nearest(low, high, rays)
                clear = clear_of_edges(low, high, 1e-6 * pitch, rays)
                for drawn in (octree, MergedOctree.of(octree)):
                    depth = depths(drawn, rays, level=level, isovalue=least, device=device)
                    met += check_depths(depth, expected, clear, rtol=1e-12, atol=1e-9 * pitch.max())
                picture = cast(octree, rays, level=level, isovalue=least, device=device)
                assert np.array_equal(picture[..., 3], np.isfinite(depth).astype(np.float32))
    assert met > 500
    assert len(shown) > 2 * octree.depth


def test_nothing_of_enough_coverage(device: Device):
    """The warning names the largest coverage that there is, which draws something."""
    octree = patterns()[0]
    with pytest.warns(VoxtoolWarning, match="level 1 at most") as told:
        picture = render(octree, size=(9, 9), level=1, isovalue=1, device=device)
    assert not picture.any()
    most = float(re.findall("at most ([0-9.]+) is", str(told[0].message))[0])
    assert most == pytest.approx(coverages(octree, 1).max(), rel=1e-2)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_rays_along_axes(device: Device, axis: int, sign: int):
    """Straight on, through the edges, faces and middles of voxels: all of the half-open square is
    met, at its exact depth, and nothing beyond; of an inside leaf, and of bricks."""
    leaf = np.ones((16, 16, 16), bool)
    bricks = leaf.copy()
    bricks[tuple(5 if a == axis else 11 for a in range(3))] = False  # out of sight
    direction, right, down = np.zeros((3, 3))
    direction[axis], right[axis - 2], down[axis - 1] = sign, 0.5, 0.5
    for shift in (0.0, 0.25):  # to quarters and three quarters; to wholes and halves
        origin = 8 + shift * (right + down) / 0.5
        origin[axis] = -3 if sign > 0 else 20
        rays = Rays(origin, direction, right, down, False, (40, 40))
        u = 8 + shift + 0.5 * (np.arange(40) + 0.5 - 20)
        inside = (u >= 0) & (u < 16)
        expected = np.where(inside[:, None] & inside, 3.0 if sign > 0 else 4.0, np.inf)
        for dense in (leaf, bricks):
            scene = placed(octree_from_dense(dense))
            for level in ("voxel", 0, 1, 2):
                assert np.array_equal(depths(scene, rays, level=level, device=device), expected)


@pytest.mark.parametrize("perspective", [False, True])
def test_rays_through_edges(device: Device, perspective: bool):
    """Along diagonals, from voxel edge to voxel edge, a wall has no hole."""
    dense = np.zeros((32, 32, 32), bool)
    dense[12:14] = True
    octree = placed(octree_from_dense(dense))
    for way in ((1, 1, 0), (1, -1, 0), (1, 1, 1), (1, -1, -1), (-1, 1, 0), (-1, -1, 1)):
        eye = np.where(np.array(way) > 0, 2.0, 30.0)
        direction = np.array(way, float)
        right, down = np.array([0, 0, 1 / 16]), np.array([0, 1 / 16, 0])
        rays = Rays(eye, direction, right, down, perspective, (17, 17))  # the middle is at 0
        low, high = np.array([[12.0, 0, 0]]), np.array([[14.0, 32, 32]])
        found = depths(octree, rays, device=device)
        clear = clear_of_edges(low, high, np.array([0, 1e-9, 1e-9]), rays)
        assert clear.mean() > 0.85
        assert np.array_equal(found[clear], nearest(low, high, rays)[clear])
        assert found[8, 8] == (10 if way[0] > 0 else 16)


def test_rays_between_voxels_that_share_an_edge(device: Device):
    """A ray through an edge goes on to the voxel across, and the two beside it are not met."""
    beside, across = np.zeros((2, 8, 8, 8), bool)
    beside[3, 4], beside[4, 3] = True, True
    across[3, 3], across[4, 4] = True, True
    scenes = []
    for sign in (-1, 1):
        far = [4 - 8.0 * sign, 4 - 8.0 * sign, 4.5]
        scenes += [(sign, far, beside, np.inf), (sign, far, across, 7)]
        for step, expected in ((-1, np.inf), (1, 1)):  # where it enters the grid
            dense = np.zeros((8, 8, 8), bool)
            dense[0 if sign > 0 else 7, 4 if step == sign else 3] = True
            scenes.append((sign, [4 - 5.0 * sign, 4 - sign, 4.5], dense, expected))
    right, down = np.array([[0, 0, 0.1], [0, 0, 0.2]])
    for sign, eye, dense, expected in scenes:
        rays = Rays(np.array(eye), np.array([sign, sign, 0.0]), right, down, False, (3, 3))
        octree = placed(octree_from_dense(dense))
        assert (depths(octree, rays, device=device) == expected).all()


def test_within(device: Device):
    """From inside a set voxel it is met at once; from a cave, its walls, wherever one looks."""
    solid = placed(octree_from_dense(np.ones((32, 32, 32), bool)))
    cave = np.ones((32, 32, 32), bool)
    cave[9:23, 9:23, 9:23] = False
    cave_renderer = placed(octree_from_dense(cave))
    rng = np.random.default_rng(2)
    low, high = np.full((1, 3), 9.0), np.full((1, 3), 23.0)
    for _ in range(4):
        eye, target = rng.uniform(10, 22, (2, 3))
        rays = Camera(tuple(eye), tuple(target), fov=120.0).rays(24, 24)
        picture = cast(solid, rays, device=device)
        assert (picture[..., 3] == 1).all()
        assert np.isfinite(picture).all()
        assert not depths(solid, rays, device=device).any()
        _, directions = every_ray(rays)
        far = np.maximum((low - eye) / directions, (high - eye) / directions).min(axis=2)
        np.testing.assert_allclose(depths(cave_renderer, rays, device=device), far, rtol=1e-12)


def test_behind_the_eye(device: Device):
    """Perspective rays begin at the eye, orthographic ones are whole lines."""
    octree = placed(octree_from_dense(np.ones((8, 8, 8), bool)))
    away = Camera((4, 4, 20), (4, 4, 30), fov=40.0)
    assert not cast(octree, away.rays(9, 9), device=device).any()
    lines = replace(away, fov=None, height=4.0).rays(9, 9)
    assert (depths(octree, lines, device=device) == -20).all()


# --- light ---------------------------------------------------------------------------------------


def brightness(normal: np.ndarray, rays: Rays) -> float:
    normal = normal / np.sqrt((normal**2).sum())
    return AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * (normal * rays.light()).sum()) ** 2


def b_spline(x: np.ndarray, degree: int) -> np.ndarray:
    """De Boor's recursion, on knots at distance 1 about 0."""
    if degree == 0:
        return ((x >= -0.5) & (x < 0.5)).astype(float)
    h = (degree + 1) / 2
    left, right = b_spline(x + 0.5, degree - 1), b_spline(x - 0.5, degree - 1)
    return ((h + x) * left + (h - x) * right) / degree


def coverage_gradient(octree: Octree, side: int, points: np.ndarray) -> np.ndarray:
    """(N, 3): at points in voxels, of the spline over all the corners of all cells of a side."""
    n = octree.grid.side // side
    cube = np.zeros((octree.grid.side,) * 3)
    cube[tuple(map(slice, octree.grid.shape))] = octree.to_dense()
    means = np.pad(cube.reshape(n, side, n, side, n, side).mean(axis=(1, 3, 5)), 1)
    for axis in range(3):
        means = (np.delete(means, 0, axis) + np.delete(means, -1, axis)) / 2
    x = points[:, :, None] / side - np.arange(n + 1)  # (N, axis, corner)
    value = b_spline(x, 2)
    slope = b_spline(x + 0.5, 1) - b_spline(x - 0.5, 1)
    along = [[slope if a == b else value for b in range(3)] for a in range(3)]
    return np.stack(
        [np.einsum("ijk,pi,pj,pk->p", means, f[0][:, 0], f[1][:, 1], f[2][:, 2]) for f in along],
        axis=1,
    )


@pytest.mark.parametrize("which", range(4))
def test_light(device: Device, which: int):
    """The light on each hit is that of the spline's gradient half a cell before it."""
    octree = patterns()[which]
    origin, pitch = np.array(octree.grid.origin), np.array(octree.grid.pitch)
    lit, bent = 0, 0
    for camera in cameras(octree, np.random.default_rng(which)):
        rays = camera.rays(13, 11)
        levels = [("voxel", None), *itertools.product(range(octree.depth), (None, 0.1))]
        for level, least in levels:
            how = {"level": level, "isovalue": least, "device": device}
            away = depths(octree, rays, **how)
            met = np.isfinite(away)
            origins, views = (v[met] for v in every_ray(rays))
            side = 2 if level == "voxel" else min(4 << int(level), octree.grid.side // 2)
            way = views / pitch
            way /= np.sqrt((way**2).sum(axis=1, keepdims=True))
            points = (origins + away[met][:, None] * views - origin) / pitch - side / 2 * way
            into = coverage_gradient(octree, side, points) / pitch * pitch.max()
            views = views / np.sqrt((views**2).sum(axis=1, keepdims=True))
            along = (into * views).sum(axis=1)
            into -= np.minimum(along, 0)[:, None] * views
            size = np.sqrt((into**2).sum(axis=1))
            sure = size > 1e-6
            expected = [brightness(-n, rays) for n in into[sure]]
            found = cast(octree, rays, colour=(1, 1, 1), **how)[met][sure, 0]
            np.testing.assert_allclose(found, expected, atol=1e-4)
            lit += np.count_nonzero(sure)
            bent += np.count_nonzero(along[sure] < -1e-3)
    assert lit > 500
    assert bent > 5


@pytest.mark.parametrize("mode", ["solid", "surface26"])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.3, 0.2), (-0.7, 0.4), (0.9, -0.8)])
def test_planes_are_smooth(device: Device, slopes: tuple[float, float], mode: str):
    """The light on a plane of voxels is that on the plane, though it is a stair of no cubes."""
    n = 64
    x, y, z = np.indices((n, n, n)) + 0.5
    height = n / 2 + slopes[0] * (x - n / 2) + slopes[1] * (y - n / 2)
    dense = z < height
    if mode == "surface26":
        dense &= z > height - 2
    pitch = np.array([1.0, 0.5, 0.7])
    octree = placed(octree_from_dense(dense, mode, "parity"), (3, 4, 5), tuple(pitch))
    middle = octree.grid.to_world(np.full((1, 3), n / 2))[0]
    normal = np.array([-slopes[0], -slopes[1], 1]) / pitch
    for way in (normal, normal * (1, 1, 3), normal + np.array([0.4, 0, 0])):
        eye = middle + 100 * way / np.abs(way).max()
        rays = Camera(tuple(eye), tuple(middle), fov=None, height=12.0).rays(48, 48)
        picture = cast(octree, rays, colour=(1, 0.5, 0.25), device=device)
        expected = brightness(normal, rays)
        error = picture[..., 0] - expected
        assert abs(error.mean()) < 0.01
        assert error.std() < (0.025 if mode == "solid" else 0.045)  # a stair's faces: 0.2
        assert np.array_equal(picture[..., 1], picture[..., 0] / 2)
        assert np.array_equal(picture[..., 2], picture[..., 0] / 4)


def test_faces_where_coverage_is_constant(device: Device):
    """Deep inside, light falls on the faces of voxels."""
    octree = placed(octree_from_dense(np.ones((64, 64, 64), bool)))
    for axis in range(3):
        for sign in (-1, 1):
            way = np.full(3, 0.01)
            way[axis] = sign
            up = tuple(np.roll((1.0, 0.0, 0.0), axis + 1))
            rays = Camera((32.5, 32.5, 32.5), tuple(32.5 + way), up, fov=5.0).rays(3, 3)
            picture = cast(octree, rays, colour=(1, 1, 1), device=device)
            faces = [brightness(-np.sign(way) * e, rays) for e in np.eye(3)]
            assert min(abs(picture[1, 1, 0] - f) for f in faces) < 1e-6


# --- the rest of the contract --------------------------------------------------------------------


@pytest.mark.parametrize("which", range(4))
def test_what_a_ray_meets_does_not_depend_on_its_neighbours(device: Device, which: int):
    """One ray at a time, and rays side by side, draw the same; also where the rays of a packet are
    mirrored differently."""
    octree = patterns()[which]
    for camera in cameras(octree, np.random.default_rng(9)):
        for level in ("voxel", 0, 1):
            alone, together = (
                cast(octree, camera.rays(26, 19), level=level, lanes=lanes, device=device)
                for lanes in (1, 16)
            )
            assert np.array_equal(alone, together)


def test_frames(device: Device):
    """Pictures may have any size, and are the same after others."""
    octree = octree_from_dense(ball((32, 32, 32)))
    low = np.array(octree.grid.origin)
    camera = Camera.fit(low, low + 32 * np.array(octree.grid.pitch))
    first = cast(octree, camera.rays(37, 11), device=device)
    assert first.shape == (11, 37, 4)
    assert first.dtype == np.float32
    assert 0 < first[..., 3].mean() < 1
    assert (first[..., :3] <= np.array(COLOUR, np.float32)).all()
    assert cast(octree, camera.rays(1, 1), device=device).shape == (1, 1, 4)
    assert np.array_equal(first, cast(octree, camera.rays(37, 11), device=device))


def test_refined_nodes_that_are_empty(device: Device):
    """Nodes that a triangle touches may hold no voxel: no level draws them, nor an empty root."""
    full = octree_from_dense(np.ones((32, 32, 32), bool), mode="surface26", fill="none")
    bricks = np.zeros_like(full.bricks)
    bricks[-1] = 1 << 63
    octree = replace(full, bricks=bricks)
    corner = octree.grid.to_world(np.array([[0, 0, 0], [32, 32, 32]]))
    rays = Camera.fit(corner[0], corner[1]).rays(64, 64)
    assert not cast(octree_from_dense(np.zeros((32, 32, 32), bool)), rays, device=device).any()
    shares = [
        cast(octree, rays, level=level, device=device)[..., 3].mean()
        for level in ("voxel", 0, 1, 2, 3)
    ]
    assert 0 < shares[0] < shares[1] < shares[2] < shares[3] < shares[4]


def deep_octree(dim: int, voxel: tuple[int, int, int]) -> Octree:
    """Return an octree of one voxel in which, on each level, the first node that does not lead to
    the voxel is an inside leaf."""
    octree = Octree.from_voxels([voxel], Grid((dim, dim, dim), (0, 0, 0), (1, 1, 1)))
    nodes = octree.nodes.copy()
    for first in octree.offsets[1:-2]:
        nodes["child"][first + (1 if nodes["child"][first] else 0)] = INSIDE
    return replace(octree, nodes=nodes)


@pytest.mark.parametrize("voxel", [(65535, 65535, 65535), (32768, 32767, 40001), (0, 1, 65535)])
def test_deepest_octree(device: Device, voxel: tuple[int, int, int]):
    """One voxel of 65,536 a side is met where it is, from near and from far away."""
    octree = deep_octree(65536, voxel)
    octree.validate()
    low, high = [], []
    for level in octree.levels():
        low.append(level.cells[level.inside])
        high.append(level.cells[level.inside] + level.side)
    low = np.concatenate([*low, [voxel]]).astype(float)
    high = np.concatenate([*high, [np.array(voxel) + 1]]).astype(float)
    seen = 0
    for way in ((1, 0.3, 0.2), (-0.4, 1, -0.3), (0.2, -0.5, 1), (-1, -1.1, -0.9)):
        for distance in (3.0, 200_000.0):
            eye = np.array(voxel) + 0.5 + distance * np.array(way)
            flat = Camera(tuple(eye), tuple(np.array(voxel) + 0.5), fov=None, height=3.0)
            for camera in (flat, replace(flat, fov=0.02), replace(flat, fov=50.0)):
                rays = camera.rays(21, 21)
                found, expected = depths(octree, rays, device=device), nearest(low, high, rays)
                clear = clear_of_edges(low, high, np.full(3, 1e-6), rays)
                seen += check_depths(found, expected, clear, rtol=0, atol=1e-8)
                assert np.isfinite(cast(octree, rays, device=device)).all()
    assert seen > 1000


@pytest.mark.parametrize(
    "request_",
    [
        *({"level": level} for level in ("voxels", "0", -1, 3, 0.0, None)),
        *({"colour": c} for c in ((1, 1), (1, 1, 2), (0, -0.1, 0), "red", (np.nan, 0, 0), 1, None)),
    ],
)
def test_unknown_levels_and_colours(device: Device, request_):
    octree = octree_from_dense(ball((16, 16, 16)))
    rays = Camera((9, 9, 9), (0, 0, 0)).rays(4, 4)
    message = "give red, green and blue between 0 and 1"
    if "level" in request_:
        message = re.escape(f"level {request_['level']!r}: choose 'voxel' or a level from 0 to 2")
    with pytest.raises(VoxtoolError, match=message):
        cast(octree, rays, **request_, device=device)


def test_far_eyes(device: Device):
    octree = placed(octree_from_dense(ball((16, 16, 16))), (0, 0, 0), (1e-9, 1e-9, 1e-9))
    middle = (8e-9, 8e-9, 8e-9)
    assert not cast(octree, Camera((0, 0, 1e3), (0, 0, 2e3)).rays(4, 4), device=device).any()
    assert cast(octree, Camera((8e-9, 8e-9, 1e3), middle).rays(1, 1), device=device).all()
    for far in (1e4, 1e20, 1e270):
        with pytest.raises(VoxtoolError, match="choose a nearer --eye"):
            cast(octree, Camera((0, 0, far), middle).rays(4, 4), device=device)
    with pytest.raises(VoxtoolError, match=r"eye at .*1e.305.*: coordinates must be finite"):
        Camera((0, 0, 1e305), middle).rays(4, 4)
