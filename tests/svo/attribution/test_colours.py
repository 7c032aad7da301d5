"""Colours and normals of surface voxels against exact clipping in rational numbers, dense sampling,
and analytic cases; the same on every device, in any order of the triangles."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli import run as run_command
from helpers.cli import told
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import MemoryLimitError, MeshError, VoxtoolError
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh import srgb
from voxtool.mesh.appearance import Appearance, Material, Texture
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.attribution import materials
from voxtool.svo.attribution.colours import SurfaceAttributesJob, plan_attributes
from voxtool.svo.attribution.surface_pass import INSIDE_COLOUR
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.attributes import BITS, check_attributes
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.voxelize import plan_voxelize

BOTH, ALL = ("colour", "normal"), ("colour", "normal", "area")
RED, BLUE, GREEN = (255, 0, 0, 255), (0, 0, 255, 255), (0, 255, 0, 255)


def grid_of(*shape: int, pitch: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Grid:
    return Grid((shape * 3)[:3], (0.0, 0.0, 0.0), pitch)


def mesh_of(vertices: Any, faces: Any, appearance: Appearance | None = None) -> Mesh:
    return Mesh(
        np.array(vertices, np.float64).reshape(-1, 3),
        np.array(faces, np.int32).reshape(-1, 3),
        appearance=appearance,
    )


def job_of(
    mesh: Mesh, device: Device, grid: Grid, mode: str = "surface26", colour: str = "mean",
    names: tuple[str, ...] = BOTH, **options: Any,
) -> SurfaceAttributesJob:  # fmt: skip
    inner = plan_voxelize(mesh, grid, mode, device=device, **options)
    return plan_attributes(inner, mesh, names, colour=colour)


def run(*args: Any, **options: Any) -> Octree:
    octree = job_of(*args, **options).run()
    octree.validate()
    leaves = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
    check_attributes(octree.attributes, octree.bricks, leaves)
    return octree


def values_of(octree: Octree, name: str) -> dict[tuple[int, ...], np.ndarray]:
    """The values of the voxels that have one."""
    attribute = octree.attribute(name)
    held = attribute.held(octree.bricks)
    low = morton_decode(octree.levels()[-1].codes) * 4
    bits = morton_decode(np.arange(64, dtype=np.uint64))
    brick, bit = np.nonzero((held[:, None] & BITS) != 0)
    voxels = (low[brick] + bits[bit]).tolist()
    return {tuple(v): value for v, value in zip(voxels, attribute.values, strict=True)}


# ---- an oracle in rational numbers: each triangle's polygon in a voxel, cut by planes in space

Corner = tuple[Fraction, ...]  # x, y, z and u, v of the triangle


def cut(polygon: list[Corner], value: Any) -> list[Corner]:
    """The part of a polygon where a linear function of its corners is not negative."""
    kept: list[Corner] = []
    for a, b in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
        fa, fb = value(a), value(b)
        if fa >= 0:
            kept.append(a)
        if fa * fb < 0:
            t = fa / (fa - fb)
            kept.append(tuple(p + (q - p) * t for p, q in zip(a, b, strict=True)))
    return kept


def area_of(polygon: list[Corner]) -> Fraction:
    """The area in u and v, times two."""
    pairs = zip(polygon, [*polygon[1:], *polygon[:1]], strict=True)
    return sum((a[3] * b[4] - b[3] * a[4] for a, b in pairs), Fraction(0))


def integrate(polygon: list[Corner], value: Any) -> np.ndarray:
    """Twice the integral in u and v of what is at most quadratic: by the middles of edges."""
    total = np.zeros(4)
    for b, c in pairwise(polygon[1:]):
        corners = [polygon[0], b, c]
        area = area_of(corners)
        middles = [tuple((p + q) / 2 for p, q in zip(corners[i - 1], corners[i], strict=True))
                   for i in range(3)]  # fmt: skip
        total += float(area) * sum(value(m) for m in middles) / 3
    return total


def wrapped(i: int, size: int, wrap: str) -> int:
    if wrap == "clamp":
        return min(max(i, 0), size - 1)
    if wrap == "mirror":
        i %= 2 * size
        return i if i < size else 2 * size - 1 - i
    return i % size


def texture_at(texture: Texture, s: Fraction, r: Fraction, i: int, j: int) -> np.ndarray:
    """The light at a place of the cell (i, j)."""
    height, width, _ = texture.pixels.shape

    def texel(i: int, j: int) -> np.ndarray:
        at = texture.pixels[wrapped(j, height, texture.wrap[1]), wrapped(i, width, texture.wrap[0])]
        return np.append(srgb.to_linear(at[:3]), at[3] / 255)

    if texture.filter == "nearest":
        return texel(i, j)
    x, y = float(s - i), float(r - j)
    top = texel(i, j) * (1 - x) + texel(i + 1, j) * x
    return top * (1 - y) + (texel(i, j + 1) * (1 - x) + texel(i + 1, j + 1) * x) * y


def colour_over(mesh: Mesh, face: int, polygon: list[Corner]) -> np.ndarray:
    """Twice the integral of the colour of a face in u and v."""
    seen = mesh.appearance
    assert seen is not None
    number = int(seen.material[face])
    material = seen.materials[number] if number >= 0 else Material("")
    base = np.array(material.colour)
    if seen.colours is not None:
        a, b, c = seen.colours[mesh.faces[face]]
        assert material.texture is None
        return integrate(
            polygon, lambda p: base * (a + (b - a) * float(p[3]) + (c - a) * float(p[4]))
        )
    texture = material.texture
    if texture is None:
        return float(area_of(polygon)) * base
    assert seen.uv is not None
    corners = [[Fraction(float(x)) for x in row] for row in seen.uv[face]]
    shift = Fraction(0) if texture.filter == "nearest" else Fraction(1, 2)
    height, width, _ = texture.pixels.shape

    def along(p: Corner, axis: int) -> Fraction:
        a, b, c = (corner[axis] for corner in corners)
        return (a + (b - a) * p[3] + (c - a) * p[4]) * (width, height)[axis] - shift

    total = np.zeros(4)
    s, r = ([along(p, axis) for p in polygon] for axis in (0, 1))
    for i in range(math.floor(min(s)), math.ceil(max(s)) + 1):
        column = cut(
            cut(polygon, lambda p, i=i: along(p, 0) - i), lambda p, i=i: i + 1 - along(p, 0)
        )
        for j in range(math.floor(min(r)), math.ceil(max(r)) + 1):
            cell = cut(
                cut(column, lambda p, j=j: along(p, 1) - j), lambda p, j=j: j + 1 - along(p, 1)
            )
            total += integrate(
                cell,
                lambda p, i=i, j=j: texture_at(texture, along(p, 0), along(p, 1), i, j),
            )
    return base * total


def exact(
    mesh: Mesh, grid: Grid
) -> dict[tuple[int, ...], list[tuple[float, np.ndarray, np.ndarray]]]:
    """Of each voxel, the area, the area times the colour, and the vector area of each part."""
    found: dict[tuple[int, ...], list[tuple[float, np.ndarray, np.ndarray]]] = {}
    fixed = grid.to_fixed(mesh.vertices)
    for face, corners in enumerate(fixed[mesh.faces].astype(object)):
        a, b, c = ([Fraction(int(x), 256) for x in corner] for corner in corners)
        p, q = ([v - u for u, v in zip(a, o, strict=True)] for o in (b, c))
        normal = np.array([float(p[i - 2] * q[i - 1] - p[i - 1] * q[i - 2]) for i in range(3)])
        uv = [(Fraction(0), Fraction(0)), (Fraction(1), Fraction(0)), (Fraction(0), Fraction(1))]
        triangle = [(*corner, *at) for corner, at in zip((a, b, c), uv, strict=True)]
        ranges = [
            range(max(math.ceil(min(x)) - 1, 0), min(math.floor(max(x)) + 1, n))
            for x, n in zip(zip(a, b, c, strict=True), grid.shape, strict=True)
        ]
        for voxel in np.ndindex(*map(len, ranges)):
            low = tuple(r[i] for r, i in zip(ranges, voxel, strict=True))
            polygon = triangle
            for axis in range(3):
                polygon = cut(polygon, lambda p, k=axis, at=low: p[k] - at[k])
                polygon = cut(polygon, lambda p, k=axis, at=low: at[k] + 1 - p[k])
            share = float(area_of(polygon)) if len(polygon) > 2 else 0.0
            if share <= 0:
                continue
            halved = any(
                min(x) == max(x) and x[0].denominator == 1 and 0 < x[0] < n
                for x, n in zip(zip(a, b, c, strict=True), grid.shape, strict=True)
            )  # it lies in the common side of two voxels
            of = 0.25 if halved else 0.5
            length = math.sqrt((normal * normal).sum())
            light = colour_over(mesh, face, polygon) if mesh.appearance else np.zeros(4)
            found.setdefault(low, []).append(
                (share * length * of, light * length * of, normal * share * of)
            )
    return found


def assert_exact(mesh: Mesh, device: Device, grid: Grid) -> None:
    octree = run(mesh, device, grid, names=ALL)
    colours, normals, areas = (values_of(octree, name) for name in ALL)
    parts = exact(mesh, grid)
    assert parts.keys() <= colours.keys()
    assert not any(area for voxel, area in areas.items() if voxel not in parts)
    for voxel, rows in parts.items():
        area = sum(row[0] for row in rows)
        assert abs(areas[voxel] - area) < 1e-8 + 1e-6 * area
        if area < 1e-3:  # rounding to 2^-32 shows beside such areas
            continue
        light = np.sum([row[1] for row in rows], axis=0) / area
        near = np.array([light - 1e-6, light + 1e-6])
        low, high = srgb.to_levels((np.clip(near[:, :3], 0, 1) * srgb.ONE).astype(np.int64))
        got = colours[voxel]
        assert (low <= got[:3]).all(), (voxel, light, got)
        assert (got[:3] <= high).all(), (voxel, light, got)
        assert abs(got[3] - 255 * light[3]) < 0.5 + 1e-3
        vector = np.sum([row[2] for row in rows], axis=0)
        length = math.sqrt((vector * vector).sum())
        if length > 1e-3 * area:
            assert np.abs(normals[voxel] - vector / length).max() < 1e-5


# ---- random soups


def soup(rng: np.random.Generator, count: int, kind: str) -> Mesh:
    """Triangles anywhere in 8 voxels, with colours of a kind."""
    vertices = rng.integers(-256, 9 * 256, (3 * count, 3)) / 256
    if rng.random() < 0.5:  # on the planes between voxels
        vertices = np.rint(vertices)
    faces = np.arange(3 * count).reshape(-1, 3)
    material = rng.integers(-1, 3, count).astype(np.int32)
    textures: list[Texture | None] = [None] * 3
    uv = colours = None
    if kind == "textures":
        wraps = ("repeat", "mirror", "clamp")
        textures = [
            Texture(
                rng.integers(0, 256, (*rng.integers(1, 5, 2), 4)).astype(np.uint8),
                (wraps[rng.integers(3)], wraps[rng.integers(3)]),
                ("linear", "nearest")[rng.integers(2)],
            )
            for _ in range(3)
        ]
        uv = rng.uniform(-1, 2, (count, 3, 2)).round(2)
    if kind == "vertices":
        colours = rng.random((3 * count, 4))
    materials = tuple(Material(f"{i}", tuple(rng.random(4)), textures[i]) for i in range(3))
    return mesh_of(vertices, faces, Appearance(materials, material, uv, colours))


@pytest.mark.parametrize("kind", ["materials", "vertices", "textures"])
@settings(max_examples=6)
@given(seed=st.integers(0, 1 << 32))
def test_random_soups_are_exact(kind: str, seed: int, device: Device) -> None:
    rng = np.random.default_rng(seed)
    assert_exact(soup(rng, int(rng.integers(1, 4)), kind), device, grid_of(8))


@pytest.mark.parametrize("kind", ["materials", "vertices", "textures"])
@pytest.mark.parametrize("colour", ["mean", "nearest"])
def test_the_order_of_triangles_does_not_show(kind: str, colour: str, device: Device) -> None:
    """Nor that of the work-items: shares of large triangles, other predicates, blocks."""
    rng = np.random.default_rng(7)
    mesh = soup(rng, 40, kind)
    seen = mesh.appearance
    assert seen is not None
    job = job_of(mesh, device, grid_of(16), colour=colour)
    digest = job.run().digest()
    tiled = {"tiled": True, "tiled_nodes": True, "column_tile": 2}
    for forced in (tiled, {"wide": True, "blocked": True, "code_bits": 64}):
        assert job.with_(**forced).run().digest() == digest, forced
    order = rng.permutation(len(mesh.faces))
    turned = Appearance(
        seen.materials, seen.material[order], None if seen.uv is None else seen.uv[order],
        seen.colours,
    )  # fmt: skip
    other = mesh_of(mesh.vertices, mesh.faces[order], turned)
    octree = run(mesh, device, grid_of(16), colour=colour)
    again = run(other, device, grid_of(16), colour=colour)
    area = run(mesh, device, grid_of(16), names=("area",)).attribute("area").values
    area = area[area > 0]
    assert (area > 1e-3).mean() > 0.8
    for name in BOTH:
        one, two = (values_of(each, name) for each in (octree, again))
        assert one.keys() == two.keys()
        differ = sum(not np.array_equal(one[voxel], two[voxel]) for voxel in one)
        assert differ <= len(one) - len(area) + (colour == "nearest") * 3  # of touched voxels alone


def test_every_device_agrees(devices: list[Device]) -> None:
    rng = np.random.default_rng(3)
    for kind in ("vertices", "textures"):
        mesh = soup(rng, 60, kind)
        for colour in ("mean", "nearest"):
            digests = {run(mesh, each, grid_of(32), colour=colour).digest() for each in devices}
            assert len(digests) == 1


@pytest.fixture
def devices() -> list[Device]:
    from conftest import opened, usable_devices

    return [opened(index) for index, _ in usable_devices()]


# ---- analytic cases


def square(z: float, colours: Any, side: float = 8.0) -> Mesh:
    """Two triangles across x = y, at a height."""
    corners = [(0, 0, z), (side, 0, z), (side, side, z), (0, side, z)]
    materials = tuple(Material(f"{i}", colour) for i, colour in enumerate(colours))
    faces = [(0, 1, 2), (0, 2, 3)]
    return mesh_of(corners, faces, Appearance(materials, np.array([0, 1], np.int32)))


def test_half_red_half_blue(device: Device) -> None:
    """Along the diagonal half of each voxel has either colour, so half of the light."""
    mesh = square(2.5, [(1, 0, 0, 1), (0, 0, 1, 1)])
    octree = run(mesh, device, grid_of(8))
    colours = values_of(octree, "colour")
    assert len(colours) == 64
    half = int(srgb.to_levels(np.array(srgb.ONE // 2)))
    assert half == 188
    for (i, j, k), colour in colours.items():
        assert k == 2
        expected = (half, 0, half, 255) if i == j else RED if i > j else BLUE
        assert tuple(colour) == expected
    assert all(normal.tolist() == [0, 0, 1] for normal in values_of(octree, "normal").values())
    nearest = values_of(run(mesh, device, grid_of(8), colour="nearest"), "colour")
    for (i, j, _), colour in nearest.items():
        assert tuple(colour) == (RED if i >= j else BLUE)  # of equal parts the lowest triangle's


def checkered(filter: str, size: int = 8, repeats: float = 1.0) -> Mesh:
    """The square with a texture of black and white texels, one a voxel."""
    i, j = np.mgrid[:size, :size]
    pixels = np.where((i + j)[..., None] % 2 == 0, 255, 0) * np.ones(4, int)
    pixels[..., 3] = 255
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float) * repeats
    uv = corners[[(0, 1, 2), (0, 2, 3)]]
    texture = Texture(pixels.astype(np.uint8), ("repeat", "repeat"), filter)
    mesh = square(2.5, [(1, 1, 1, 1)] * 2)
    seen = Appearance((Material("a", texture=texture),), np.zeros(2, np.int32), uv)
    return replace(mesh, appearance=seen)


def test_a_checkerboard(device: Device) -> None:
    octree = run(checkered("nearest"), device, grid_of(8))
    for (i, j, _), colour in values_of(octree, "colour").items():
        assert tuple(colour) == ((255, 255, 255, 255) if (i + j) % 2 == 0 else (0, 0, 0, 255))
    # Bilinear: a voxel is a texel, whose mean is 3/4 of its own light, twice, and 1/4 of others'
    own = 0.75 * 0.75 + 0.25 * 0.25
    for (i, j, _), colour in values_of(
        run(checkered("linear"), device, grid_of(8)), "colour"
    ).items():
        light = own if (i + j) % 2 == 0 else 1 - own
        assert colour[0] == srgb.to_levels(np.array(int(light * srgb.ONE)))
    for repeats in (8.0, 31.0, 1000.0):  # many texels a voxel, then samples
        colours = values_of(
            run(checkered("nearest", repeats=repeats), device, grid_of(8)), "colour"
        )
        light = srgb.to_linear(np.array([colour[0] for colour in colours.values()], np.uint8))
        assert np.abs(light - 0.5).max() < (0.004 if repeats < 32 else 0.1)


def test_nearest_invents_no_colours(device: Device) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 256, (7, 5, 4)).astype(np.uint8)
    known = {tuple(one) for one in pixels.reshape(-1, 4).tolist()}
    uv = rng.uniform(-2, 2, (30, 3, 2))
    mesh = soup(rng, 30, "materials")
    seen = Appearance((Material("a", texture=Texture(pixels)),), np.zeros(30, np.int32), uv)
    octree = run(replace(mesh, appearance=seen), device, grid_of(16), colour="nearest")
    found = {tuple(colour) for colour in octree.attribute("colour").values.tolist()}
    assert len(found) > 10
    assert found <= known
    corners = Appearance((), np.full(30, -1, np.int32), None, np.eye(4)[rng.integers(0, 3, 90)])
    octree = run(replace(mesh, appearance=corners), device, grid_of(16), colour="nearest")
    found = {tuple(colour) for colour in octree.attribute("colour").values.tolist()}
    assert found == {(*one[:3], 0) for one in (RED, GREEN, BLUE)}


def test_colours_against_dense_sampling(devices: list[Device]) -> None:
    """Another algorithm: points of a fine lattice on each triangle, each in its voxel."""
    rng = np.random.default_rng(11)
    mesh = soup(rng, 3, "vertices")
    seen = mesh.appearance
    assert seen is not None
    assert seen.colours is not None
    n, sums = 1500, np.zeros((5, 512))
    u, v = (np.mgrid[:n, :n] + 1 / 3).reshape(2, -1) / n
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    for face, corners in enumerate(mesh.faces):
        a, b, c = mesh.vertices[corners]
        x = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        area = np.linalg.norm(np.cross(b - a, c - a)) / 2 / len(u)
        p, q, r = seen.colours[corners]
        material = int(seen.material[face])
        base = np.array(seen.materials[material].colour) if material >= 0 else np.ones(4)
        light = base * (p + u[:, None] * (q - p) + v[:, None] * (r - p))
        inside = ((x > 0) & (x < 8)).all(axis=1)
        voxels = np.floor(x[inside]).astype(int) @ (64, 8, 1)
        sums[4] += area * np.bincount(voxels, minlength=512)
        for total, of_points in zip(sums[:4], light[inside].T, strict=True):
            total += area * np.bincount(voxels, of_points, 512)
    sums = sums.T.reshape(8, 8, 8, 5)
    for device in devices:
        colours = values_of(run(mesh, device, grid_of(8)), "colour")
        tried = 0
        for voxel, colour in colours.items():
            if sums[voxel][4] > 0.1:
                tried += 1
                light = sums[voxel][:3] / sums[voxel][4]
                assert np.abs(srgb.to_linear(colour[:3]) - light).max() < 0.01
        assert tried > 10


def test_touched_voxels_have_the_lowest_triangle(device: Device) -> None:
    """Two triangles end on a plane between voxels: the voxels beyond are touched by both."""
    corners = [(0, 0, 2.5), (4, 1, 2.5), (0, 2, 2.5), (0, 0, 2.6), (4, 1, 2.5), (0, 2, 2.6)]
    faces = np.arange(6).reshape(2, 3)
    materials = (Material("r", (1, 0, 0, 1)), Material("b", (0, 0, 1, 1)))
    for order in ([0, 1], [1, 0]):
        look_ = Appearance(materials, np.array(order, np.int32))
        for colour in ("mean", "nearest"):
            octree = run(mesh_of(corners, faces, look_), device, grid_of(8), colour=colour)
            found = values_of(octree, "colour")[4, 1, 2]
            assert tuple(found) == (RED, BLUE)[order[0]]
            assert tuple(values_of(octree, "colour")[4, 0, 2]) == (RED, BLUE)[order[0]]
    point = mesh_of([(1.5, 1.5, 1.5)] * 3 + [(3, 1.5, 1.5)], [(0, 1, 2), (0, 1, 3)],
                    Appearance(materials, np.array([1, 0], np.int32)))  # fmt: skip
    octree = run(point, device, grid_of(8))
    assert tuple(values_of(octree, "colour")[1, 1, 1]) == BLUE
    assert tuple(values_of(octree, "colour")[2, 1, 1]) == RED
    assert not octree.attribute("normal").values.any()


def test_normals_of_a_tilted_plane_in_stretched_voxels(device: Device) -> None:
    corners = [(0, 0, 1.1), (8, 0, 3.1), (8, 8, 5.1), (0, 8, 3.1)]
    mesh = mesh_of(corners, [(0, 1, 2), (0, 2, 3)])
    octree = run(mesh, device, grid_of(8, 16, 5, pitch=(1.0, 0.5, 2.0)), names=("normal",))
    normal = np.array([-0.25, -0.25, 1.0]) / math.sqrt(1.125)
    assert np.abs(octree.attribute("normal").values - normal).max() < 1e-6
    both = mesh_of(corners, [(0, 1, 2), (0, 2, 3), (1, 0, 2), (0, 3, 2)])
    found = run(both, device, grid_of(8), names=("normal",)).attribute("normal").values
    assert not found.any()  # they cancel


def test_areas_add_up(device: Device) -> None:
    """Those of a box on the planes between voxels, in voxels that are no cubes; at every level."""
    box = np.array([(x, y, z) for x in (2, 8) for y in (0, 3) for z in (2.0, 12.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh = mesh_of(box, [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    octree = run(mesh, device, grid_of(8, 8, 8, pitch=(1.0, 0.5, 2.0)), names=("area",))
    attribute = octree.attribute("area")
    assert attribute.values.sum(dtype=np.float64) == 2 * (6 * 3 + 3 * 10 + 10 * 6)
    assert values_of(octree, "area")[2, 3, 4] == 0.5 * 0.5 * 2  # half of its side across x
    assert values_of(octree, "area")[7, 3, 4] == 0.5 * 2  # the grid ends at this one
    for size in range(4):
        cells = np.concatenate(
            list(AttributeImage(VoxelImage.of(octree, level=size), "area").slabs())
        )
        assert abs(cells.sum(dtype=np.float64) - 216) < 1e-4, size


def test_the_command_states_the_area(here: Path) -> None:
    run_command("voxelize bunny.obj --dim 64 --mode surface26 --attributes area -o a.svo.h5")
    total = told("svo-info a.svo.h5 --json")["attributes"]["area"]["sum"]
    mesh = load_mesh("bunny.obj")
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    exact = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert abs(total / exact - 1) < 1e-3  # vertices are moved to the lattice
    assert f", {total:.9g} in total\n" in run_command("svo-info a.svo.h5").stdout


# ---- modes


@pytest.mark.parametrize("options", [{}, {"with_surface": True}, {"fill": "flood"}])
def test_solids_have_values_on_the_surface(options: dict[str, Any], device: Device) -> None:
    box = np.array([(x, y, z) for x in (1.3, 6.2) for y in (1.3, 6.2) for z in (1.3, 6.2)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    materials = tuple(Material(f"{i}", (i / 8, 1.0, 0.5, 1.0)) for i in range(6))
    mesh = mesh_of(box, faces, Appearance(materials, np.repeat(np.arange(6), 2).astype(np.int32)))
    surface = run(mesh, device, grid_of(8))
    solid = run(mesh, device, grid_of(8), mode="solid", **options)
    attribute = solid.attribute("colour")
    assert attribute.masks is not None
    assert tuple(attribute.default) == INSIDE_COLOUR
    expected = values_of(surface, "colour")
    found = values_of(solid, "colour")
    occupied = {tuple(v) for v in solid.occupied().tolist()}
    touched = expected.keys() & occupied
    assert found.keys() >= touched  # exposed ones have values, too: test_exposed.py
    assert all(np.array_equal(found[voxel], expected[voxel]) for voxel in touched)
    assert len(occupied) > len(found)
    thin = run(mesh, device, grid_of(8), mode="surface6")
    assert values_of(thin, "colour").keys() <= expected.keys()
    assert thin.attribute("colour").masks is None
    window = run(mesh, device, grid_of(8), mode="solid", window=((2, 0, 4), (4, 8, 4)), **options)
    for voxel, value in values_of(window, "colour").items():
        i, j, k = voxel
        assert np.array_equal(value, found[i + 2, j, k + 4])


def test_plans_and_refusals(device: Device) -> None:
    mesh = checkered("linear")
    job = job_of(mesh, device, grid_of(8))
    plan = job.describe()
    assert plan["attributes"] == ["colour", "normal"]
    assert plan["texels"] == 64
    assert job.stages[-1] == "attributes"
    assert "a second scan of the surface" in job.left_out
    assert job.run().plan["colour"] == "mean"
    solid = job_of(mesh, device, grid_of(8), mode="solid", fill="flood")
    assert solid.stages[-3:] == ("surface", "attributes", "exposed voxels")
    assert "values of exposed voxels" in job.left_out
    assert "values of exposed voxels" not in solid.left_out
    assert solid.cost.device > job_of(mesh, device, grid_of(8), names=("area",)).cost.device
    assert materials.texels_of(mesh.appearance) == 64  # pyright: ignore[reportArgumentType]
    with pytest.raises(
        MeshError, match="it has no colours, no materials and no textures: give a mesh"
    ):
        job_of(replace(mesh, appearance=None), device, grid_of(8))
    with pytest.raises(VoxtoolError, match="give one or more of colour, normal, area, each"):
        job_of(mesh, device, grid_of(8), names=("colour", "colour"))
    with pytest.raises(VoxtoolError, match="colour 'x' is unknown: choose one of mean, nearest"):
        job_of(mesh, device, grid_of(8), colour="x")
    large = checkered("linear", 512)
    with pytest.raises(MemoryLimitError, match=r"colour and normal of about .* surface voxels"):
        job_of(large, device, grid_of(8), max_memory=1 << 20).run()
