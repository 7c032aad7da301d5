"""The rules that tell inside from outside, on every device."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import model
from helpers import meshes, oracles
from helpers.signs import winding
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from svo.voxelization.test_voxelize import assert_contract, lattice_grid, lattice_mesh

from voxtool import Grid, Mesh, load_mesh, mesh_from_arrays
from voxtool.errors import MemoryLimitError, MeshWarning, VoxtoolError
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.fill.caps import find_boundary, find_caps
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

UNIT = oracles.UNIT
DOUBT = 1e-6  # what the winding number is good for
SHAPES = st.sampled_from([(8, 8, 8), (16, 16, 16), (16, 9, 5), (7, 12, 16)])


def run(device: Device, mesh, shape, fill: str, **options) -> Octree:
    octree = voxelize(lattice_mesh(*mesh), lattice_grid(shape), fill=fill, device=device, **options)
    octree.validate()
    return octree


def centres(shape) -> np.ndarray:
    """(N, 3) in 1/256 voxel."""
    return np.indices(shape).reshape(3, -1).T * UNIT + UNIT // 2


def numbers(triangles: np.ndarray, shape) -> np.ndarray:
    """The winding number about each voxel's shifted centre: whole crossings along x, and the angles
    of the strips that the boundary sweeps towards +x.

    The shift along y and z is a real one here, so small that it decides ties alone: edge functions
    are whole numbers, and change by less than one.
    """
    found = oracles.numbers(triangles, shape).astype(np.float64).ravel()
    points = centres(shape) + np.array([0, 1e-5, 1e-10])
    for p, q, times in oracles.boundary(triangles):
        a, b = np.array(p) - points, np.array(q) - points
        u, v = a[:, 1] + 1j * a[:, 2], b[:, 1] + 1j * b[:, 2]
        ahead = [
            np.where(c[:, 0] > 0, r + c[:, 0], np.abs(w) ** 2 / (r + np.abs(c[:, 0])))
            for c, w, r in ((a, u, length(a)), (b, v, length(b)))
        ]
        found += times * np.angle(np.conj(u) * v + ahead[0] * ahead[1]) / (2 * np.pi)
    return found.reshape(shape)


def length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt((vectors**2).sum(axis=1))


def near_boundary(triangles: np.ndarray, shape, reach: float) -> np.ndarray:
    """Voxels whose centres are so near, in 1/256 voxel, to the boundary that nothing is certain."""
    points, near = centres(shape), np.zeros(np.prod(shape), bool)
    for p, q, _ in oracles.boundary(triangles):
        way, edge = points - np.array(p), np.array(q) - np.array(p)
        t = np.clip((way * edge).sum(axis=1) / (edge**2).sum(), 0, 1)
        near |= length(way - t[:, None] * edge) < reach
    return near.reshape(shape)


def assert_winding(device: Device, mesh, shape) -> tuple[Octree, np.ndarray]:
    """Check that an octree holds the voxels of winding number 1/2 or more; return it, and the
    voxels in doubt."""
    octree = run(device, mesh, shape, "winding")
    job = plan_voxelize(lattice_mesh(*mesh), lattice_grid(shape), fill="winding", device=device)
    assert job.with_(most_left=1.0).run().digest() == octree.digest()
    triangles = mesh[0][mesh[1]]
    some = oracles.counted(triangles)
    found = numbers(some, shape)
    doubt = (np.abs(found - 0.5) < DOUBT) | near_boundary(some, shape, 0.5)
    dense = octree.to_dense()
    assert np.array_equal(dense[~doubt], found[~doubt] >= 0.5)
    assert octree.fill == "winding"
    assert_contract(octree, triangles, True)
    return octree, doubt


# ---- the oracle


def test_the_oracle_is_the_sum_of_solid_angles() -> None:
    rng = np.random.default_rng(5)
    shape = (7, 6, 5)
    for vertices, faces in (
        meshes.random_triangles(rng, 6, shape),
        meshes.open_box((300, 310, 290), (1500, 1300, 1100), missing=3),
        mobius(shape),
    ):
        triangles = vertices[faces]
        expected = winding(centres(shape), triangles).reshape(shape)
        assert np.allclose(numbers(triangles, shape), expected, atol=1e-6)


def mobius(shape) -> tuple[np.ndarray, np.ndarray]:
    """A band of 16 x 1 squares that is half a turn twisted, in 1/256 voxel."""
    t = 2 * np.pi * np.arange(16)[:, None] / 16
    s = np.array([-0.35, 0.35])
    r = 1 + s * np.cos(t / 2)
    x, y = r * np.cos(t), r * np.sin(t)
    points = np.stack([x, y, s * np.sin(t / 2)], axis=-1)
    size = min(shape) / 3.2
    vertices = meshes.fixed(points.reshape(-1, 3) * size + np.array(shape) / 2 + [0.01, 0.02, 0.03])
    faces = []
    for i in range(16):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < 15 else (1, 0)  # the ends meet upside down
        faces += [(a, c, b), (b, c, d)]
    return vertices, np.array(faces)


# ---- winding


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=30)
def test_any_triangles_by_winding(device: Device, data, shape) -> None:
    assert_winding(device, data.draw(meshes.fixed_triangles(shape)), shape)


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=30)
def test_meshes_with_holes_by_winding(device: Device, data, shape) -> None:
    """Holes on lattice planes, through centres, with edges along rows: ties of every kind."""
    vertices, faces = data.draw(meshes.closed_meshes(shape))
    kept = data.draw(st.lists(st.booleans(), min_size=len(faces), max_size=len(faces)))
    flipped = data.draw(st.lists(st.integers(0, 9), min_size=len(faces), max_size=len(faces)))
    faces = np.where((np.array(flipped) == 0)[:, None], faces[:, ::-1], faces)
    assume(any(kept))
    assert_winding(device, (vertices, faces[kept]), shape)


@pytest.mark.parametrize("missing", range(6))
@pytest.mark.parametrize("place", [0, 128])
def test_a_box_without_a_side(device: Device, missing: int, place: int) -> None:
    """Whatever side it is, and where it falls between centres or on them, most is inside."""
    low, high = np.array([2, 2, 2]) * UNIT + place, np.array([19, 18, 17]) * UNIT + place
    mesh = meshes.open_box(low, high, missing)
    octree, _ = assert_winding(device, mesh, (22, 21, 20))
    assert 0.8 < octree.count / (17 * 16 * 15) <= 1 + 1 / 15  # the layer of the lid may be inside


@pytest.mark.slow
def test_soups_by_winding(device: Device) -> None:
    """Spheres of triangles that share nothing: some missing, some twice, some turned."""
    rng = np.random.default_rng(2)
    shape = (16, 16, 16)
    vertices, faces = meshes.icosphere(2, 8.01, 5.6)
    fixed = meshes.fixed(vertices)
    for missing, turned in ((0.0, 0.0), (0.2, 0.0), (0.1, 0.1)):
        some = faces[rng.random(len(faces)) >= missing]
        back = rng.random(len(some)) < turned
        some[back] = some[back, ::-1]
        corners = fixed[some].reshape(-1, 3)
        loose = corners + rng.integers(-6, 7, corners.shape), np.arange(len(corners)).reshape(-1, 3)
        octree = run(device, loose, shape, "winding")
        expected = winding(centres(shape), loose[0][loose[1]]).reshape(shape)
        assert (np.abs(expected - 0.5) > DOUBT).all()
        assert np.array_equal(octree.to_dense(), expected >= 0.5)
        assert octree.count > 0.5 * 4 / 3 * np.pi * 5.6**3


def test_a_band_and_a_plane_hold_nothing(device: Device) -> None:
    """A surface that bounds nothing: beside it the number is just below 1/2, or just above it."""
    shape = (32, 32, 32)
    band = mobius(shape)
    plane = np.array([[900, 900, 4000], [7000, 900, 4000], [7000, 7000, 4000], [900, 7000, 4000]])
    for mesh in (band, (plane, np.array([[0, 1, 2], [0, 2, 3]]))):
        octree, doubt = assert_winding(device, mesh, shape)
        assert not doubt.any()
        surface = voxelize(lattice_mesh(*mesh), lattice_grid(shape), "surface26", device=device)
        assert octree.count <= surface.count


def test_the_number_is_of_the_whole_mesh(device: Device) -> None:
    """Faces beyond the grid count, on every side, and a window holds the voxels of the whole."""
    shape = (24, 24, 24)
    vertices, faces = meshes.icosphere(2, (12.1, 11.9, 12.2), 15.0)  # beyond on every side
    mesh = meshes.fixed(vertices), faces[7:]
    octree, doubt = assert_winding(device, mesh, shape)
    assert not doubt.any()
    whole = octree.to_dense()
    for low, size in (((3, 2, 1), (20, 9, 14)), ((0, 12, 0), (24, 12, 11))):
        part = run(device, mesh, shape, "winding", window=(low, size))
        expected = whole[tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))]
        assert np.array_equal(part.to_dense(), expected)


@given(data=st.data())
@settings(max_examples=15)
def test_order_changes_nothing(device: Device, data) -> None:
    shape = (16, 16, 16)
    vertices, faces = data.draw(meshes.closed_meshes(shape))
    faces = faces[1:]
    order = data.draw(st.permutations(range(len(faces))))
    for fill in ("nonzero", "winding", "flood"):
        one = run(device, (vertices, faces), shape, fill)
        other = run(device, (vertices, np.roll(faces[order], 1, axis=1)), shape, fill)
        assert one.digest() == other.digest()


def test_with_the_surface(device: Device) -> None:
    mesh = meshes.open_box((300, 310, 290), (4500, 4300, 4100), missing=1)
    shape = (20, 20, 20)
    for fill in ("nonzero", "winding", "flood"):
        solid = run(device, mesh, shape, fill).to_dense()
        both = run(device, mesh, shape, fill, with_surface=True)
        surface = voxelize(lattice_mesh(*mesh), lattice_grid(shape), "surface26", device=device)
        assert np.array_equal(both.to_dense(), solid | surface.to_dense())
        assert_contract(both, mesh[0][mesh[1]], True)


def test_paths_for_large_scenes_agree(device: Device) -> None:
    mesh = meshes.open_box((700, 710, 690), (14500, 13300, 12100), missing=2)
    large = {"wide": True, "code_bits": 64, "blocked": True, "tiled": True, "tiled_nodes": True}
    for fill in ("nonzero", "winding", "flood"):
        job = plan_voxelize(lattice_mesh(*mesh), lattice_grid((70, 60, 50)), device=device)
        job = job.with_(fill=fill)
        digest = run(device, mesh, (70, 60, 50), fill).digest()
        assert job.run().digest() == job.with_(**large).run().digest() == digest


def test_caps_close_what_is_open() -> None:
    rng = np.random.default_rng(1)
    vertices, faces = meshes.icosphere(3, 100.0, 90.0)
    fixed = meshes.fixed(vertices).astype(np.int32)
    for share in (0.0, 0.05, 0.5):
        kept = faces[rng.random(len(faces)) >= share].astype(np.int32)
        caps = find_caps(fixed, find_boundary(Mesh(vertices.astype(np.float64), kept)))
        assert not oracles.boundary(fixed[np.concatenate([kept, caps.faces])])
        assert len(caps.faces) == len(caps.loops) - 2 * caps.holes
        edges = oracles.boundary(fixed[kept])
        assert len(caps.edges) == sum(abs(times) for *_, times in edges)
        assert (caps.holes == 0) == (share == 0)
    moebius = mobius((32, 32, 32))
    boundary = find_boundary(mesh_from_arrays(*moebius))
    caps = find_caps(moebius[0].astype(np.int32), boundary)
    assert not oracles.boundary(moebius[0][np.concatenate([moebius[1], caps.faces])])


@pytest.mark.parametrize("fill", ["winding", "nonzero"])
def test_repeated_faces_count_once(device: Device, fill: str) -> None:
    vertices, faces = meshes.icosphere(1, 10.0, 9.0)
    vertices, shape = meshes.fixed(vertices), (20,) * 3
    once = run(device, (vertices, faces), shape, fill)
    front, back = faces[:20], faces[:20, ::-1]
    for more in ([front], [front] * 9, [front, back[:, [1, 2, 0]], front]):
        doubled = np.concatenate([faces, *more])
        assert run(device, (vertices, doubled), shape, fill).digest() == once.digest()
    octree = run(device, (vertices, np.concatenate([front, back])), shape, fill)
    assert octree.count == 0


@pytest.mark.parametrize("mode", ["solid", "surface26", "surface6"])
def test_repeated_large_faces_are_scanned_once(device: Device, mode: str) -> None:
    """By parity, an even number of copies cancels, but still refines the octree."""
    vertices, faces = meshes.box((3 * UNIT,) * 3, (29 * UNIT,) * 3)
    grid, fill = lattice_grid((32,) * 3), {"fill": "parity"} if mode == "solid" else {}
    for copies, kept in ((1, 12), (3, 12), (4, 24 if fill else 12)):
        turned = np.roll(faces[:, ::-1], 1, axis=1)
        many = np.concatenate([faces, *[turned] * (copies - 1)])
        job = plan_voxelize(lattice_mesh(vertices, many), grid, mode, device=device, **fill)
        assert job.plan.survey.triangles == kept
        octree = job.run()
        once = voxelize(lattice_mesh(vertices, faces), grid, mode, device=device, **fill)
        if copies < 4 or not fill:
            assert octree.digest() == once.digest()
        else:
            assert octree.count == 0
            assert np.array_equal(octree.offsets, once.offsets)


def test_faces_alone_cancel_with_their_caps(device: Device) -> None:
    """The pages of a book, and triangles apart, need no crossings; a face beside others does."""
    random = np.random.default_rng(4)
    apart = random.integers(0, 32 * UNIT, (30, 3)), np.arange(30).reshape(-1, 3)
    book = random.integers(0, 32 * UNIT, (12, 3)), np.array([[0, 1, i] for i in range(2, 12)])
    strip = random.integers(0, 32 * UNIT, (4, 3)), np.array([[0, 1, 2], [2, 1, 3]])
    for (vertices, faces), alone, caps_of in ((apart, 10, 10), (book, 10, 10), (strip, 0, 2)):
        job = plan_voxelize(
            lattice_mesh(vertices, faces), lattice_grid((32,) * 3), fill="winding", device=device
        )
        caps = job.lattice.caps
        assert caps is not None
        assert len(caps.faces) == caps_of
        assert job.lattice.closed.size == 3 * (len(faces) + caps_of - 2 * alone)
        assert not oracles.boundary(vertices[job.lattice.faces.get().reshape(-1, 3)])


def test_walls_of_two_shells_count_twice(device: Device) -> None:
    """If they counted once, what two closed shells share would be a hole."""
    low, high = np.array([3, 3, 3]) * UNIT, np.array([13, 12, 11]) * UNIT
    low_box, high_box = (meshes.box(low, (*high[:2], z * UNIT)) for z in (8, 13))
    mesh = meshes.join(low_box, high_box)
    octree, doubt = assert_winding(device, mesh, (16, 16, 16))
    assert octree.count == 10 * 9 * 10
    assert not doubt.any()


# ---- nonzero


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=30)
def test_nonzero_is_what_crossings_do_not_cancel(device: Device, data, shape) -> None:
    mesh = data.draw(st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape, parts=3)))
    octree = run(device, mesh, shape, "nonzero")
    triangles = mesh[0][mesh[1]]
    expected = oracles.numbers(oracles.counted(triangles), shape) != 0
    assert np.array_equal(octree.to_dense(), expected)
    assert_contract(octree, triangles, True)


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=30)
def test_closed_meshes_need_whole_numbers_only(device: Device, data, shape) -> None:
    mesh = data.draw(meshes.closed_meshes(shape, parts=3))
    octree, doubt = assert_winding(device, mesh, shape)
    assert octree.plan["holes"] == octree.plan["cap_triangles"] == 0
    assert not doubt.any()


# ---- shells that overlap, nest, or face the wrong way


def test_overlapping_cubes_unite(device: Device) -> None:
    one, other = meshes.box((2, 2, 2), (10, 10, 10)), meshes.box((6, 6, 6), (14, 14, 14))
    vertices, faces = meshes.join(one, other)
    for fill, count in (("parity", 2 * 512 - 2 * 64), ("nonzero", 960), ("winding", 960)):
        assert run(device, (vertices * UNIT, faces), (16,) * 3, fill).count == count


@pytest.mark.parametrize("turned", [False, True])
def test_nested_boxes(device: Device, turned: bool) -> None:
    """A box in a box: a cavity by parity; by the others only if it faces inward."""
    inner = meshes.box((6, 6, 6), (10, 10, 10))
    if turned:
        inner = inner[0], inner[1][:, ::-1]
    mesh = meshes.join(meshes.box((2, 2, 2), (14, 14, 14)), inner)
    mesh = mesh[0] * UNIT, mesh[1]
    for fill in ("parity", "nonzero", "winding"):
        hollow = turned or fill == "parity"
        assert run(device, mesh, (16,) * 3, fill).count == 12**3 - hollow * 4**3
    assert run(device, mesh, (16,) * 3, "flood").count == 14**3  # of the surface, too


def test_a_box_that_is_inside_out(device: Device) -> None:
    vertices, faces = meshes.box((2 * UNIT,) * 3, (12 * UNIT,) * 3)
    mesh = vertices, faces[:, ::-1]
    counts = {fill: run(device, mesh, (16,) * 3, fill).count for fill in ("nonzero", "winding")}
    assert counts == {"nonzero": 1000, "winding": 0}


def test_a_box_with_turned_faces(device: Device) -> None:
    """Two turned faces of twelve: the number falls by twice what they subtend."""
    vertices, faces = meshes.box((2 * UNIT,) * 3, (30 * UNIT,) * 3)
    faces[:2] = faces[:2, ::-1]
    assert not assert_winding(device, (vertices, faces), (32,) * 3)[1].any()
    assert run(device, (vertices, faces), (32,) * 3, "parity").count == 28**3


def test_caps_close_crowded_holes(device: Device) -> None:
    """The cap of an open box is its missing side, so nothing changes but the warning."""
    mesh = mesh_from_arrays(*meshes.open_box(0, (4, 3, 2)))
    job = plan_voxelize(mesh, Grid.fit(mesh, 24), fill="winding", device=device)
    with pytest.warns(MeshWarning, match="more boundary loops near one voxel"):
        crowded = job.with_(crowd=0).run()
    assert crowded.digest() == job.run().digest()


def test_the_same_twice_is_the_same(device: Device) -> None:
    vertices, faces = meshes.open_box((300, 310, 290), (4500, 4300, 4100))
    for times in (2, 40):
        mesh = vertices, np.tile(faces, (times, 1))
        assert not assert_winding(device, mesh, (20, 20, 20))[1].any()


def test_holes_may_not_outgrow_the_memory(device: Device) -> None:
    vertices, faces = meshes.box((256, 256, 256), (60000, 60000, 60000))
    corner = vertices, faces[[0, 2, 4, 6, 8]]  # a saddle, which no fan is near to
    with pytest.raises(MemoryLimitError, match="near the holes of this mesh"):
        run(device, corner, (256,) * 3, "winding", max_memory=10_000_000)


# ---- flood


@given(data=st.data(), shape=SHAPES, gap=st.integers(0, 5))
@settings(max_examples=30)
def test_flood_agrees_with_the_oracle(device: Device, data, shape, gap: int) -> None:
    mesh = data.draw(st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape)))
    surface = voxelize(lattice_mesh(*mesh), lattice_grid(shape), "surface26", device=device)
    octree = run(device, mesh, shape, "flood", gap=gap)
    assert octree.fill == ("flood" if gap == 0 else f"flood+gap{gap}")
    assert np.array_equal(octree.to_dense(), oracles.flood(surface.to_dense(), gap))
    assert_contract(octree, mesh[0][mesh[1]], True)


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_gaps_are_closed_up_to_their_width(device: Device, width: int) -> None:
    """A box has a slit of `width` free voxels across one side."""
    vertices, faces = meshes.box((UNIT * 8 + 9,) * 3, (UNIT * 24 + 9,) * 3)
    side = np.array([8, 8, 24]) * UNIT + 9
    strips = []
    for low, high in ((8 * UNIT + 9, 15 * UNIT + 9), ((16 + width) * UNIT + 9, 24 * UNIT + 9)):
        corners = np.array([side] * 4)
        corners[:, 0] = low, high, high, low
        corners[2:, 1] = 24 * UNIT + 9
        strips.append((corners, np.array([[0, 1, 2], [0, 2, 3]])))
    mesh = meshes.join((vertices, np.delete(faces, (10, 11), axis=0)), *strips)
    for gap in range(6):
        octree = run(device, mesh, (32,) * 3, "flood", gap=gap)
        closed = -(-gap // 2) * 2 >= width
        assert (octree.count > 15**3) == closed, gap
        assert octree.count <= 17**3  # no fatter


@given(data=st.data(), shape=SHAPES, gap=st.integers(0, 3))
@settings(max_examples=15)
def test_a_window_of_a_flood_is_part_of_the_whole(device: Device, data, shape, gap: int) -> None:
    mesh = data.draw(st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape)))
    low = [data.draw(st.integers(0, n - min(n, 8))) for n in shape]
    size = [data.draw(st.integers(min(n, 8), n - a)) for a, n in zip(low, shape, strict=True)]
    if max(size) < 8:
        return
    whole = run(device, mesh, shape, "flood", gap=gap).to_dense()
    part = run(device, mesh, shape, "flood", gap=gap, window=(low, size))
    box = tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))
    assert part.grid.shape == tuple(size)
    assert np.array_equal(part.to_dense(), whole[box])
    at_window = mesh[0][mesh[1]] - UNIT * np.array(low)
    assert_contract(part, at_window, True)


@pytest.mark.parametrize("gap", [0, 4])
def test_slabs_give_the_same_flood(device: Device, gap: int) -> None:
    """A spiral corridor leads through all slabs and back, past a closed chamber in each."""
    shape = (48, 24, 300)
    boxes = [((4, 4, 4), (44, 20, 296)), ((9, 9, 20), (13, 15, 280)), ((20, 9, 30), (24, 15, 290))]
    parts = [meshes.box(*(np.array(ends) * UNIT + 9).tolist()) for ends in boxes]
    walls = [_sheet((16, 4, 4), (16, 20, 240)), _sheet((30, 4, 60), (30, 20, 296))]
    hull = np.delete(parts[0][1], (0, 1), axis=0)
    mesh = meshes.join((parts[0][0], hull), *parts[1:], *walls)
    grid = lattice_grid(shape)
    job = plan_voxelize(lattice_mesh(*mesh), grid, fill="flood", gap=gap, device=device)
    whole = job.run()
    assert 0 < whole.count < 40 * 16 * 292
    for slabs in (2, 5):
        assert job.with_(slabs=slabs).run().digest() == whole.digest()


@pytest.mark.parametrize("ceiling", [193, 197])
def test_slabs_grow_from_air_beyond_their_faces(device: Device, ceiling: int) -> None:
    """The air in a bell ends a few voxels below a slab, and comes from far below: it grows into the
    slab where a gap is closed."""
    vertices, faces = meshes.box((30 * UNIT, 30 * UNIT, 10 * UNIT + 9), (90 * UNIT,) * 3)
    vertices[vertices[:, 2] > 10 * UNIT + 9, 2] = ceiling * UNIT + 128
    mesh = vertices, faces[(vertices[faces][:, :, 2] > 10 * UNIT + 9).any(axis=1)]
    grid = lattice_grid((128, 128, 512))
    job = plan_voxelize(lattice_mesh(*mesh), grid, fill="flood", gap=12, device=device)
    assert job.with_(slabs=8).run().digest() == job.run().digest()


def _sheet(low, high) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle of one x."""
    corners = np.array([low, (low[0], high[1], low[2]), high, (low[0], low[1], high[2])])
    return corners * UNIT + 9, np.array([[0, 1, 2], [0, 2, 3]])


def test_a_flood_in_slabs_fits_less_memory(device: Device) -> None:
    mesh, grid = lattice_mesh(*meshes.box(300, 500 * UNIT)), lattice_grid((512,) * 3)
    whole = plan_voxelize(mesh, grid, fill="flood", device=device)
    assert whole.plan.slabs == 1
    less = whole.cost.device * 6 // 10
    job = plan_voxelize(mesh, grid, fill="flood", device=device, max_memory=less)
    assert job.plan.slabs > 1
    assert job.cost.device <= less
    assert f"in {job.plan.slabs} slabs" in dict(job.plan.rows())["fill"]
    with pytest.raises(MemoryLimitError, match=r"dim \d+ is the largest that fits"):
        run(device, meshes.box(300, 500 * UNIT), (512,) * 3, "flood", max_memory=less // 10)


@pytest.mark.parametrize("gap", [16, 18, 26])
def test_gaps_may_reach_over_nodes(device: Device, gap: int) -> None:
    """Steps beyond a node of 8 voxels are made in rounds."""
    mesh, shape = meshes.open_box((UNIT * 6 + 9,) * 3, (UNIT * 20 + 9,) * 3), (26, 24, 25)
    surface = voxelize(lattice_mesh(*mesh), lattice_grid(shape), "surface26", device=device)
    found = run(device, mesh, shape, "flood", gap=gap).to_dense()
    assert np.array_equal(found, oracles.flood(surface.to_dense(), gap))


def test_a_gap_goes_with_flood(device: Device) -> None:
    mesh = meshes.box(300, 2000)
    for fill, gap, message in (
        ("winding", 1, "goes with fill 'flood'"),
        ("flood", -1, "choose from 0 to 16 voxels"),
        ("flood", 17, "choose from 0 to 16 voxels"),
    ):
        with pytest.raises(VoxtoolError, match=message):
            run(device, mesh, (16,) * 3, fill, gap=gap)


# ---- auto


def test_auto_is_parity_where_that_is_right(device: Device) -> None:
    box = meshes.box(300, 3000)
    turned = box[0], np.concatenate([box[1][:1, ::-1], box[1][1:]])
    for mesh in (box, meshes.open_box(300, 3000), turned):
        fill = "parity" if mesh is box else "winding"
        assert run(device, mesh, (16,) * 3, "auto").fill == fill
        stages = []
        with device.reporting(stages.append):
            job = plan_voxelize(lattice_mesh(*mesh), lattice_grid((16,) * 3), device=device)
            assert job.watertight == (fill == "parity")
            octree = job.run()
            assert job.run().digest() == octree.digest()  # planned once, run again
        assert octree.plan["fill"] == fill
        planned = 2 if mesh is turned else 1  # rules are compared, and the survey
        assert [s for s in stages if s in job.stages] == [*job.stages, *job.stages[planned:]]


# ---- findings


FLAT = np.array([[300, 300, 999], [3000, 300, 999], [300, 3000, 999]]), np.array([[0, 1, 2]])
BOX = meshes.box(300, 3000)
SPECK = meshes.box(300, 310)


@pytest.mark.parametrize(
    ("mesh", "mode", "fill", "message"),
    [
        (FLAT, "solid", "winding", "it is flat and encloses nothing: choose fill flood"),
        ((BOX[0], BOX[1][:, ::-1]), "solid", "winding", "it is inside out"),
        (SPECK, "solid", "parity", "no voxel's centre is inside it"),
        ((BOX[0] + 99999, BOX[1]), "solid", "auto", "it lies outside the grid"),
        ((BOX[0] + 99999, BOX[1]), "surface6", "auto", "it lies outside the grid"),
    ],
)
def test_an_empty_octree_says_why(device: Device, mesh, mode: str, fill: str, message: str) -> None:
    grid = lattice_grid((16,) * 3)
    with pytest.warns(MeshWarning, match=f"sets no voxel: {message}"):
        assert not voxelize(lattice_mesh(*mesh), grid, mode, fill=fill, device=device).count


def test_notes_and_warnings_name_what_is_open(device: Device) -> None:
    mesh, grid = lattice_mesh(*meshes.open_box(300, 3000)), lattice_grid((16,) * 3)
    for fill in ("parity", "nonzero"):
        with pytest.warns(MeshWarning, match="4 boundary edges.* rows of voxels along x leak"):
            voxelize(mesh, grid, fill=fill, device=device)
    job = plan_voxelize(mesh, grid, device=device)
    octree = job.run()
    assert not list(job.findings(octree))
    assert "1 hole, filled where its winding number is 1/2 or more" in job.notes(octree)[0]
    assert not job.with_(fill="flood").notes(job.with_(fill="flood").run())


# ---- real models


@pytest.mark.parametrize("name", ["stanford-bunny", "teapot", "suzanne"])
def test_open_models_do_not_leak(device: Device, name: str) -> None:
    mesh = load_mesh(model(f"{name}.obj"))
    octree = voxelize(mesh, Grid.fit(mesh, 100), device=device)
    assert octree.fill == "winding"
    dense = octree.to_dense()
    for axis in range(3):
        assert not dense.take([0, 1, 2, -3, -2, -1], axis).any()


def test_missing_faces_change_the_volume_little(device: Device) -> None:
    mesh = load_mesh(model("spot.obj"))
    grid = Grid.fit(mesh, 100)
    whole = voxelize(mesh, grid, fill="parity", device=device).count
    rng = np.random.default_rng(1)
    for missing, most in ((0.01, 0.01), (0.05, 0.02), (0.2, 0.1)):
        faces = mesh.faces[rng.random(len(mesh.faces)) >= missing]
        found = voxelize(Mesh(mesh.vertices, faces), grid, fill="winding", device=device).count
        assert abs(found / whole - 1) < most
