"""Exposed voxels against brute force: neighbours in a dense array, and the nearest of all faces in
rational numbers. The same in windows of the grid, in any order of the search, on every device."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.grid import Grid
from voxtool.mesh import srgb
from voxtool.mesh.appearance import Appearance, Material, Texture
from voxtool.mesh.joining import join
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.attribution import nearest_surface
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.attribution.labels import plan_labels
from voxtool.svo.attribution.nearest_surface import GRAINS, NearestSurface
from voxtool.svo.attribution.surface_pass import INSIDE_COLOUR
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.attributes import BITS, check_attributes
from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

TRIED = 60  # voxels of an octree whose nearest faces the oracle finds
BETWEEN = Fraction(0.6180339887498949)  # between whole grains
NAMES = ("colour", "normal", "area")


def grid_of(n: int) -> Grid:
    return Grid((n, n, n), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def painted(mesh: Mesh) -> Mesh:
    """The mesh with a colour of its own for each face."""
    faces = np.arange(len(mesh.faces))
    colours = [(1.0, (f % 7) / 7, (f // 7) / 64, 1.0) for f in faces.tolist()]
    materials = tuple(Material(str(f), colours[f]) for f in faces.tolist())
    return replace(mesh, appearance=Appearance(materials, faces.astype(np.int32)))


def coloured(mesh: Mesh, grid: Grid, device: Device, names: Any = NAMES, **options: Any) -> Octree:
    inner = plan_voxelize(mesh, grid, "solid", device=device, **options)
    octree = plan_attributes(inner, mesh, names).run()
    octree.validate()
    leaves = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
    check_attributes(octree.attributes, octree.bricks, leaves)
    return octree


def dense(octree: Octree, name: str) -> np.ndarray:
    """The values of all voxels, (x, y, z) or (x, y, z, channels); the default inside, 0 outside."""
    attribute, set_ = octree.attribute(name), octree.to_dense()
    found = np.zeros((octree.grid.side,) * 3 + attribute.values.shape[1:], attribute.values.dtype)
    found[: set_.shape[0], : set_.shape[1], : set_.shape[2]][set_] = attribute.blank
    bits = (attribute.held(octree.bricks)[:, None] & BITS) != 0
    brick, bit = np.nonzero(bits)
    voxels = 4 * morton_decode(octree.levels()[-1].codes)[brick] + BRICK_VOXELS[bit]
    found[tuple(voxels.T)] = attribute.values
    return found[: set_.shape[0], : set_.shape[1], : set_.shape[2]]


# ---- the oracle


def exposed_of(set_: np.ndarray) -> np.ndarray:
    padded = np.pad(set_, 1)
    around = [
        padded[i : i + set_.shape[0], j : j + set_.shape[1], k : k + set_.shape[2]]
        for i, j, k in np.ndindex(3, 3, 3)
    ]
    return set_ & ~np.logical_and.reduce(around)


def dot(a: Any, b: Any) -> Any:
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a: Any, b: Any) -> tuple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def less(a: Any, b: Any) -> tuple:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def nearest_point(corners: list, p: tuple) -> tuple[Fraction, Fraction, Fraction]:
    """The squared distance of a point to a triangle, and where the nearest point is: u and v."""
    a, b, w = less(corners[1], corners[0]), less(corners[2], corners[0]), less(p, corners[0])
    n = cross(a, b)
    square = dot(n, n)
    if square:
        u, v = Fraction(dot(cross(w, b), n), square), Fraction(dot(cross(a, w), n), square)
        if u >= 0 and v >= 0 and u + v <= 1:
            return Fraction(dot(n, w) ** 2, square), u, v
    found = []
    one, none = Fraction(1), Fraction(0)
    places = [(none, none), (one, none), (none, one)]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        side, way = less(corners[j], corners[i]), less(p, corners[i])
        length = dot(side, side)
        t = min(max(Fraction(dot(way, side), length), none), one) if length else none
        rest = [x - t * y for x, y in zip(way, side, strict=True)]
        (u0, v0), (u1, v1) = places[i], places[j]
        found.append((dot(rest, rest), u0 + t * (u1 - u0), v0 + t * (v1 - v0)))
    return min(found, key=lambda one: one[0])


def nearest_face(triangles: list, voxel: tuple) -> tuple[int, Fraction, Fraction]:
    """The first of the nearest faces that have an area, and where its nearest point is."""
    p = tuple(256 * int(i) + 128 for i in voxel)
    best: tuple = (math.inf,)
    for face, corners in enumerate(triangles):
        if not any(cross(less(corners[1], corners[0]), less(corners[2], corners[0]))):
            continue
        square, u, v = nearest_point(corners, p)
        grains = math.floor(square * int(GRAINS) + BETWEEN)
        if grains < best[0]:
            best = grains, face, u, v
    return best[1:]


def some_of(voxels: np.ndarray) -> np.ndarray:
    """Some voxels of a dense array, (n, 3)."""
    found = np.argwhere(voxels)
    return found[np.random.default_rng(1).permutation(len(found))[:TRIED]]


def on_lattice(mesh: Mesh, grid: Grid) -> list:
    fixed = grid.to_fixed(mesh.vertices)
    return [[tuple(map(int, fixed[k])) for k in face] for face in mesh.faces.tolist()]


def check(mesh: Mesh, octree: Octree, touched: np.ndarray) -> int:
    """Compare all values with the oracle; return how many voxels it decided."""
    set_ = octree.to_dense()
    exposed, triangles = exposed_of(set_), on_lattice(mesh, octree.grid)
    colours, normals, areas = (dense(octree, name) for name in NAMES)
    bare = exposed & ~touched
    deeper = set_ & ~exposed & ~touched
    assert (colours[deeper] == INSIDE_COLOUR).all()
    assert not normals[deeper].any()
    assert not areas[bare | deeper].any()
    assert not (colours[exposed] == INSIDE_COLOUR).all(axis=1).any()
    seen = mesh.appearance
    assert seen is not None
    for voxel in some_of(bare):
        face, _, _ = nearest_face(triangles, tuple(voxel))
        light = np.array(seen.materials[seen.material[face]].colour)
        level = srgb.to_levels((light[:3] * srgb.ONE).astype(np.int64))
        assert (colours[tuple(voxel)][:3] == level).all(), voxel
        a, b, c = (np.array(corner, np.float64) for corner in triangles[face])
        normal = np.cross(b - a, c - a)
        assert np.abs(normals[tuple(voxel)] - normal / np.linalg.norm(normal)).max() < 1e-6
    return int(bare.sum())


# ---- random meshes


def parts(rng: np.random.Generator, n: int) -> Mesh:
    """Tetrahedra and boxes that may overlap, reach beyond the grid, or be turned inside out."""
    vertices, faces, count = [], [], 0
    for _ in range(rng.integers(1, 4)):
        if rng.random() < 0.5:
            low = rng.integers(-256, 256 * n // 2, 3)
            high = low + rng.integers(300, 256 * n // 2, 3)
            points, own = meshes.box(low.tolist(), high.tolist())
        else:
            points = rng.integers(-256, 256 * n + 256, (4, 3))
            own = np.array([(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)])
        vertices.append(points / 256)
        faces.append(own[:, ::-1] + count if rng.random() < 0.3 else own + count)
        count += len(points)
    return meshes.mesh_of(np.concatenate(vertices), np.concatenate(faces))


FILLS = [
    {"fill": "parity"}, {"fill": "nonzero"}, {"fill": "winding"}, {"fill": "flood", "gap": 3},
    {"with_surface": True},
]  # fmt: skip


@pytest.mark.parametrize("options", FILLS, ids=str)
@settings(max_examples=4)
@given(seed=st.integers(0, 1 << 32))
def test_against_rational_numbers(options: dict[str, Any], seed: int, device: Device) -> None:
    """Also of open meshes, where the fill leaks along rows and floods close gaps."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(8, 14))
    mesh, grid = parts(rng, n), grid_of(n)
    if rng.random() < 0.5:
        kept = rng.random(len(mesh.faces)) < 0.8
        mesh = replace(mesh, faces=mesh.faces[kept] if kept.any() else mesh.faces)
    mesh = painted(mesh)
    octree = coloured(mesh, grid, device, **options)
    assert octree.set_digest() == voxelize(mesh, grid, device=device, **options).set_digest()
    check(mesh, octree, voxelize(mesh, grid, "surface26", device=device).to_dense())


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5])
def test_leaves_beside_the_outside_are_refined(shift: float, device: Device) -> None:
    """Faces between the centres of a node's last voxels and the next; a box cut by the grid."""
    low, high = (8 - shift, 16 - shift, -9.0), (32 - shift, 32 - shift, 51.0)
    mesh = painted(meshes.mesh_of(*meshes.box(low, high)))
    octree = coloured(mesh, grid_of(40), device)
    plain = voxelize(mesh, grid_of(40), device=device)
    assert octree.set_digest() == plain.set_digest()
    found = check(mesh, octree, voxelize(mesh, grid_of(40), "surface26", device=device).to_dense())
    assert found > 500


# ---- colours at points


@pytest.mark.parametrize("colour", ["mean", "nearest"])
@pytest.mark.parametrize("kind", ["vertices", "texture"])
def test_colours_at_the_nearest_point(kind: str, colour: str, device: Device) -> None:
    """Of a ball with a cavity, to which edges and corners are nearest."""
    rng = np.random.default_rng(4)
    ball, cavity = meshes.icosphere(1, 8, 7.3), meshes.icosphere(0, 8, 4.2)
    mesh, grid = meshes.mesh_of(*meshes.join(ball, (cavity[0], cavity[1][:, ::-1]))), grid_of(16)
    n, uv, corners, texture = len(mesh.faces), None, None, None
    if kind == "vertices":
        corners = rng.random((len(mesh.vertices), 4))
    else:
        uv = rng.uniform(-1, 2, (n, 3, 2)).round(2)
        texture = Texture(rng.integers(0, 256, (5, 4, 4)).astype(np.uint8))
    look = Appearance((Material("a", texture=texture),), np.zeros(n, np.int32), uv, corners)
    mesh = replace(mesh, appearance=look)
    inner = plan_voxelize(mesh, grid, "solid", fill="nonzero", device=device)
    octree = plan_attributes(inner, mesh, ("colour",), colour=colour).run()
    bare = exposed_of(octree.to_dense())
    bare &= ~voxelize(mesh, grid, "surface26", device=device).to_dense()
    assert bare.sum() > 100
    found, triangles = dense(octree, "colour"), on_lattice(mesh, grid)
    for voxel in some_of(bare):
        face, u, v = nearest_face(triangles, tuple(voxel))
        shares = np.array([float(1 - u - v), float(u), float(v)])
        if corners is not None:
            own = corners[mesh.faces[face]]
            light = own[np.argmax(shares)] if colour == "nearest" else shares @ own
        else:
            assert uv is not None
            assert texture is not None
            light = texture_at(texture, shares @ uv[face], colour)
        scaled = (np.array([light - 1e-6, light + 1e-6])[:, :3] * srgb.ONE).astype(np.int64)
        low, high = srgb.to_levels(np.clip(scaled, 0, srgb.ONE))
        level = found[tuple(voxel)][:3]
        assert ((low <= level) & (level <= high)).all(), (voxel, face, light)


def texture_at(texture: Texture, uv: np.ndarray, colour: str) -> np.ndarray:
    """The light at a place: bilinear, or of the texel there."""
    pixels = texture.pixels
    height, width, _ = pixels.shape
    lights = np.concatenate([srgb.to_linear(pixels[..., :3]), pixels[..., 3:] / 255], axis=2)
    s, r = uv[0] * width, uv[1] * height
    if colour == "nearest":
        return lights[math.floor(r) % height, math.floor(s) % width]
    s, r = s - 0.5, r - 0.5
    i, j = math.floor(s), math.floor(r)
    x, y = s - i, r - j
    rows = [
        lights[k % height, i % width] * (1 - x) + lights[k % height, (i + 1) % width] * x
        for k in (j, j + 1)
    ]
    return rows[0] * (1 - y) + rows[1] * y


# ---- what does not show


@pytest.mark.parametrize("fill", ["parity", "flood"])
def test_windows_of_the_grid(fill: str, device: Device) -> None:
    """Voxels of a window have what they have in the whole grid, also beside its border."""
    rng = np.random.default_rng(8)
    mesh, grid = painted(parts(rng, 24)), grid_of(24)
    whole = coloured(mesh, grid, device, fill=fill)
    for low, shape in (
        ((2, 0, 5), (14, 24, 8)),
        ((8, 16, 0), (16, 8, 24)),
        ((0, 0, 0), (13, 9, 10)),
    ):
        window = coloured(mesh, grid, device, fill=fill, window=(low, shape))
        part = tuple(slice(a, a + n) for a, n in zip(low, shape, strict=True))
        for name in NAMES:
            assert np.array_equal(dense(window, name), dense(whole, name)[part]), name


def test_the_order_of_the_search(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Faces near the voxels first, a few at once, in packets or alone."""
    mesh, grid = painted(meshes.mesh_of(*meshes.icosphere(2, 32, 28))), grid_of(64)
    voxels = np.random.default_rng(2).integers(0, 64, (9000, 3))
    search = partial(NearestSurface, mesh, grid, sampled=False, device=device, max_memory=1)
    monkeypatch.setattr(nearest_surface, "REACH", 1000)
    centres = 256 * voxels + 128
    found = search().nearest(voxels, centres)
    for voxel, face in zip(voxels[:9].tolist(), found[:9].tolist(), strict=True):
        assert nearest_face(on_lattice(mesh, grid), tuple(voxel))[0] == face
    monkeypatch.setattr(nearest_surface, "LEAST_AT_ONCE", 90)
    assert np.array_equal(search().nearest(voxels, centres), found)
    monkeypatch.setattr(nearest_surface, "REACH", 1)
    far = np.abs(np.linalg.norm(voxels - 31.5, axis=1) - 28)
    for own in np.argsort(far)[[0, 1000, 5000, -1]].tolist():
        one = slice(own, own + 1)
        assert search().nearest(voxels[one], centres[one]) == found[own]


def test_every_device_agrees(devices: list[Device]) -> None:
    mesh = painted(parts(np.random.default_rng(12), 40))
    digests = {coloured(mesh, grid_of(40), device, fill="nonzero").digest() for device in devices}
    assert len(digests) == 1


@pytest.fixture
def devices() -> list[Device]:
    from conftest import opened, usable_devices

    return [opened(index) for index, _ in usable_devices()]


def test_labels_of_exposed_voxels(device: Device) -> None:
    """Each set voxel has the label of a part that it is in, so exposed ones have, too; leaves that
    are refined for colours keep theirs."""
    both = join([
        meshes.mesh_of(*meshes.box((7.7, 15.6, -9.0), (31.7, 31.6, 51.0)), "low"),
        meshes.mesh_of(*meshes.box((27.7, 25.6, 11.0), (37.7, 37.6, 51.0)), "high"),
    ])  # fmt: skip
    mesh, grid = painted(both), grid_of(48)
    plain = plan_labels(mesh, grid, "solid", labels="file", device=device)
    octree = plan_attributes(plain, mesh, ("colour",)).run()
    octree.validate()
    labels = plain.run()
    assert len(octree.bricks) > len(labels.bricks)
    assert octree.set_digest() == labels.set_digest()
    first, second = (
        np.concatenate(list(AttributeImage(VoxelImage.of(one), "label").slabs()))
        for one in (octree, labels)
    )
    assert np.array_equal(first, second)
    assert octree.attribute("label").masks is None
