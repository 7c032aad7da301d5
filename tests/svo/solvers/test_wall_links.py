"""Links of lattices to the wall: compared with rational arithmetic, and shapes with a formula."""

from __future__ import annotations

import itertools
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, told
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.choices import LATTICES
from voxtool.svo.solvers.wall_links import CROSSED, NO_LINK, STEPS, UNCROSSED, plan_wall_links

UNIT = 256  # of the fixed-point lattice, in a voxel
Vector = tuple[Fraction, ...]


# ---- the oracle: whole numbers and fractions of them


def cross(a: Any, b: Any) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def dot(a: Any, b: Any) -> Any:
    return sum(x * y for x, y in zip(a, b, strict=True))


def minus(a: Any, b: Any) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def first_on(link: Any, triangle: Any) -> Fraction | None:
    """The least t from 0 to 1 for which t link lies in the triangle, by clipping."""
    a, b, c = triangle
    normal = cross(minus(b, a), minus(c, a))
    if not any(normal):
        return first_on_segment(link, *longest(triangle))
    low, high = Fraction(0), Fraction(1)
    height, slope = dot(normal, a), dot(normal, link)
    if slope:
        low = high = Fraction(height, slope)
        if not 0 <= low <= 1:
            return None
    elif height:
        return None
    for u, v in ((a, b), (b, c), (c, a)):
        inwards = cross(normal, minus(v, u))  # inside: inwards . (t link - u) >= 0
        gain, start = dot(inwards, link), -dot(inwards, u)
        if not gain:
            if start < 0:
                return None
        elif gain > 0:
            low = max(low, Fraction(-start, gain))
        else:
            high = min(high, Fraction(-start, gain))
    return low if low <= high else None


def longest(triangle: Any) -> Any:
    return max(
        itertools.combinations(triangle, 2),
        key=lambda ends: dot(minus(*ends), minus(*ends)),
    )


def first_on_segment(link: Any, a: Any, b: Any) -> Fraction | None:
    """The least t from 0 to 1 for which t link lies between a and b."""
    edge = minus(b, a)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        det = link[j] * edge[i] - link[i] * edge[j]
        if det:  # t link - s edge = a in these two coordinates
            t = Fraction(a[j] * edge[i] - a[i] * edge[j], det)
            s = Fraction(a[j] * link[i] - a[i] * link[j], det)
            meets = all(t * p == q + s * e for p, q, e in zip(link, a, edge, strict=True))
            return t if meets and 0 <= t <= 1 and 0 <= s <= 1 else None
    if any(cross(link, a)):
        return None
    size = dot(link, link)
    ends = sorted((Fraction(dot(a, link), size), Fraction(dot(b, link), size)))
    if any(edge) and any(cross(link, edge)):
        return None
    return max(ends[0], Fraction(0)) if ends[1] >= 0 and ends[0] <= 1 else None


def expected(octree: voxtool.Octree, mesh: voxtool.Mesh, lattice: str, fluid: str) -> dict:
    """The place of each link that crosses the wall; None if no triangle crosses it."""
    dense = octree.to_dense() if fluid == "set" else ~octree.to_dense()
    fixed = octree.grid.to_fixed(mesh.vertices).tolist()
    triangles = [[fixed[k] for k in face] for face in mesh.faces.tolist()]
    found = {}
    for voxel in np.argwhere(dense).tolist():
        centre = [UNIT * n + UNIT // 2 for n in voxel]
        near = [
            [minus(v, centre) for v in t]
            for t in triangles
            if all(
                min(v[i] for v in t) <= centre[i] + UNIT
                and max(v[i] for v in t) >= centre[i] - UNIT
                for i in range(3)
            )
        ]
        for link, step in enumerate(STEPS[: LATTICES[lattice]].tolist()):
            end = np.add(voxel, step)
            if (end < 0).any() or (end >= dense.shape).any() or dense[tuple(end)]:
                continue
            places = [first_on([UNIT * s for s in step], t) for t in near]
            held = [p for p in places if p is not None]
            found[(*voxel, link)] = min(held) if held else None
    return found


def check(octree: voxtool.Octree, mesh: voxtool.Mesh, devices: Any, **decisions: Any) -> None:
    for lattice, fluid in (("D3Q27", "unset"), ("D3Q19", "set")):
        wanted = expected(octree, mesh, lattice, fluid)
        for device in devices:
            job = plan_wall_links(octree, mesh, lattice, fluid, device=device)
            compare(job, job.with_(**decisions).run(), wanted)


def compare(job: Any, links: voxtool.WallLinks, wanted: dict) -> None:
    assert job.plan.links == links.count == len(wanted)
    assert links.voxels.tolist() == [list(v) for v in sorted({key[:3] for key in wanted})]
    assert (links.places[links.flags == NO_LINK] == -1).all()
    rows, columns = np.nonzero(links.flags)
    for row, link in zip(rows.tolist(), columns.tolist(), strict=True):
        place = wanted[(*links.voxels[row].tolist(), link)]
        assert links.flags[row, link] == (UNCROSSED if place is None else CROSSED)
        # single precision of a double that is off by a few units in its last place
        assert links.places[row, link] == pytest.approx(
            0.5 if place is None else float(place), rel=2**-23, abs=0
        )


def octree_and_mesh(seed: int, coarse: int) -> tuple[voxtool.Octree, voxtool.Mesh]:
    """Random voxels, and triangles whose corners are multiples of 1/256 voxel times `coarse`."""
    random = np.random.default_rng(seed)
    grid = voxtool.Grid((8, 6, 7), (0, 0, 0), (1, 1, 1))
    octree = voxtool.Octree.from_voxels(np.argwhere(random.random(grid.shape) < 0.5), grid)
    corners = random.integers(-1, 9 * UNIT // coarse, (24, 3)) * (coarse / UNIT)
    corners[8:16] = np.clip(corners[:8] + random.integers(-1, 2, (8, 3)), 0, 8)
    return octree, voxtool.mesh_from_arrays(corners, random.integers(0, 24, (40, 3)))


# ---- the tests

RANDOM = pytest.mark.filterwarnings("ignore:no triangle crosses")


@RANDOM
@pytest.mark.parametrize("coarse", [1, 64, 128])
def test_random_triangles(devices, coarse: int) -> None:
    """Also those that pass through centres, edges that links lie on, and segments and points."""
    for seed in range(3):
        check(*octree_and_mesh(seed, coarse), devices)


@RANDOM
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 16, 128]), st.booleans())
def test_any_triangles(seed: int, coarse: int, wide: bool) -> None:
    check(*octree_and_mesh(seed, coarse), [None], wide=wide)


def test_links_in_planes_of_triangles(device) -> None:
    """A closed box whose faces lie on centres: links in its faces begin on the mesh."""
    mesh = meshes.mesh_of(*meshes.box((1.5, 1.5, 1.5), (4.5, 3.5, 4.5)))
    grid = voxtool.Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))
    octree = voxtool.voxelize(mesh, grid, "solid", fill="parity", device=device)
    check(octree, mesh, [device])
    check(octree, mesh, [device], wide=True)


@RANDOM
def test_triangles_of_many_voxels(device) -> None:
    """Beyond 4096 voxels, products take 128 bits."""
    grid = voxtool.Grid((8192, 8192, 64), (0, 0, 0), (1, 1, 1))
    random = np.random.default_rng(5)
    corners = np.array([[3.1, 7.7, 4.2], [8180.3, 55.5, 60.9], [4001.2, 8100.7, 33.3]])
    weights = random.dirichlet((1, 1, 1), 12)
    voxels = np.floor(weights @ corners).astype(int)
    octree = voxtool.Octree.from_voxels(np.unique(voxels, axis=0), grid)
    mesh = voxtool.mesh_from_arrays(corners, [[0, 1, 2]])
    links = plan_wall_links(octree, mesh, "D3Q27", device=device).run()
    triangle = grid.to_fixed(mesh.vertices).tolist()
    assert (links.flags == CROSSED).any()
    for row, link in np.argwhere(links.flags).tolist():
        centre = (UNIT * links.voxels[row] + UNIT // 2).tolist()
        near = [minus(v, centre) for v in triangle]
        place = first_on((UNIT * STEPS[link].astype(int)).tolist(), near)
        assert (place is not None) == (links.flags[row, link] == CROSSED)
        if place is not None:
            assert links.places[row, link] == pytest.approx(float(place), rel=2**-23, abs=0)


def test_a_plane_and_a_ball(device) -> None:
    """A box: the places follow from its side alone. A ball: the points are between its sphere
    and the planes of its triangles, to what the rounding of their corners is off."""
    mesh = meshes.mesh_of(*meshes.box((2.25, 2.25, 2.25), (6.75, 6.75, 6.75)))
    grid = voxtool.Grid((9, 9, 9), (0, 0, 0), (1, 1, 1))
    octree = voxtool.voxelize(mesh, grid, device=device)
    links = voxtool.wall_links(octree, mesh, "D3Q27", device=device)
    assert links.uncrossed == 0
    assert set(links.places[links.flags == CROSSED].tolist()) == {0.75}
    mesh = meshes.mesh_of(*meshes.icosphere(4))
    octree = voxtool.voxelize(mesh, dim=40, device=device)
    links = voxtool.wall_links(octree, mesh, "D3Q27", device=device)
    assert links.uncrossed == 0
    rows, columns = np.nonzero(links.flags)
    start = octree.grid.to_world(links.voxels[rows] + 0.5)
    points = start + links.places[rows, columns, None] * STEPS[columns] * octree.grid.pitch
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    planes = (normals * corners[:, 0]).sum(axis=1) / np.linalg.norm(normals, axis=1)
    rounding = octree.grid.pitch[0] * np.sqrt(3) / (2 * UNIT)
    off = 1 - np.linalg.norm(points, axis=1)
    assert -rounding <= off.min() <= off.max() <= 1 - planes.min() + rounding


def test_directions() -> None:
    """The rest, then shells; each link is followed by the opposite one."""
    assert len(np.unique(STEPS, axis=0)) == 27
    assert (STEPS[1::2] == -STEPS[2::2]).all()
    assert np.abs(STEPS).sum(axis=1).tolist() == [0] + [1] * 6 + [2] * 12 + [3] * 8


@RANDOM
def test_chunks_make_the_same(device, monkeypatch) -> None:
    octree, mesh = octree_and_mesh(1, 1)
    links = plan_wall_links(octree, mesh, "D3Q27", device=device).run()
    monkeypatch.setattr("voxtool.svo.solvers.wall_links.CHUNK", 7)
    assert plan_wall_links(octree, mesh, "D3Q27", device=device).run().digest() == links.digest()


def test_holes_are_marked(device) -> None:
    """Links through the hole of an open box, which the fill rule closed."""
    mesh = meshes.mesh_of(*meshes.open_box((2.25, 2.25, 2.25), (6.75, 6.75, 6.75)))
    grid = voxtool.Grid((9, 9, 9), (0, 0, 0), (1, 1, 1))
    octree = voxtool.voxelize(mesh, grid, fill="winding", device=device)
    with pytest.warns(voxtool.MeshWarning, match=r"no triangle crosses .* put the wall there"):
        links = voxtool.wall_links(octree, mesh, device=device)
    assert 0 < links.uncrossed < links.count
    assert set(links.places[links.flags == UNCROSSED].tolist()) == {0.5}


# ---- files and the command line


def test_files(here: Path) -> None:
    report = told("export bunny.svo.h5 --links D3Q19 --source bunny.obj -o a.npz --json")
    run("export bunny.svo.h5 --links D3Q19 --source bunny.obj -o a.h5")
    links = voxtool.wall_links("bunny.svo.h5", "bunny.obj")
    assert report["digest"] == links.digest()
    with np.load("a.npz") as arrays, h5py.File("a.h5") as h5:
        for name in ("directions", "voxels", "places", "flags"):
            assert np.array_equal(arrays[name], getattr(links, name))
            assert np.array_equal(h5[name][()], getattr(links, name))
        assert tuple(arrays["shape"]) == links.grid.shape
        assert tuple(h5.attrs["origin"]) == links.grid.origin
        assert h5.attrs["format"] == b"voxtool-links"
        assert h5.attrs["source_sha256"].decode() == links.source_sha256
    voxtool.write_wall_links(links, "b.npz")
    assert Path("a.npz").read_bytes() == Path("b.npz").read_bytes()


def test_plans_and_refusals(here: Path) -> None:
    command = "export bunny.svo.h5 --links D3Q27 --source bunny.obj"
    plan = told(f"{command} -o a.npz --plan --json")
    report = told(f"{command} -o a.npz --json")
    assert (plan["voxels"], plan["links"]) == (report["voxels"], report["links"])
    assert Path("a.npz").stat().st_size <= plan["bytes"]
    assert "of 1 kB allowed: choose a smaller dim" in fail(f"{command} -o b.npz --max-bytes 1000")
    assert "10 kB of memory are too few to find the links" in fail(
        f"{command} -o b.npz --max-memory 10000"
    )
    assert "MB of memory" in fail(f"{command} -o b.npz --max-memory 1M")
    assert "--level, --invert: not with --links" in fail(
        f"{command} --level 1 --invert -o b.npz", 2
    )
    assert "needs --source MESH" in fail("export bunny.svo.h5 --links D3Q27 -o b.npz", 2)
    assert "go with --links" in fail("export bunny.svo.h5 --fluid set -o b.npz", 2)
    assert "end it in one of .npz, .h5" in fail(f"{command} -o b.vti")
    voxtool.write_mesh(meshes.mesh_of(*meshes.box(0, 1)), "other.obj")
    assert "the octree was not made from it" in fail(command.replace("bunny.obj", "other.obj"))
    assert not Path("b.npz").exists()
