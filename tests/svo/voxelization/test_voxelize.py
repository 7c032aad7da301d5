"""The voxelizer against the oracles, analytic solids and invariants, on every device."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import model
from helpers import meshes, oracles
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.counts import check_topology
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.morton import morton_decode
from voxtool.opencl import Device, open_device
from voxtool.svo.octree.build import DeviceOctree
from voxtool.svo.octree.layout import NODE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.fill.rows import refuse_beyond
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize, voxelize

MODES = ("surface26", "surface6", "solid")
SHAPES = st.sampled_from([(8, 8, 8), (16, 16, 16), (16, 9, 5), (7, 12, 16), (24, 20, 30)])


def lattice_grid(shape) -> Grid:
    """A grid whose units are the world's."""
    return Grid(tuple(shape), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def lattice_mesh(vertices, faces) -> Mesh:
    """A mesh of vertices given in 1/256 voxel."""
    return Mesh(
        np.ascontiguousarray(np.asarray(vertices, np.float64).reshape(-1, 3) / 256),
        np.ascontiguousarray(faces, np.int32),
    )


def planned(device, mesh, shape, mode, **options) -> VoxelizeJob:
    """By parity by default."""
    options = {"fill": "parity", "device": device, **options}
    return plan_voxelize(lattice_mesh(*mesh), lattice_grid(shape), mode, **options)


def run(device, mesh, shape, mode, **options) -> Octree:
    octree = planned(device, mesh, shape, mode, **options).run()
    octree.validate()
    return octree


def assert_voxels(octree: Octree, mode: str, triangles) -> None:
    """The octree holds the voxels that the oracle of a mode finds."""
    expected = getattr(oracles, mode)(triangles, octree.grid.shape)
    assert {tuple(v) for v in octree.occupied().tolist()} == expected, mode
    assert octree.count == len(expected)


def assert_contract(octree: Octree, triangles, solid: bool) -> None:
    """The octree refines exactly the nodes that its contract names."""
    active = oracles.active_nodes(triangles, octree.grid.shape, solid)
    expected = oracles.expected_octree_nodes(active, octree.to_dense())
    for level in octree.levels():
        if level.number == 0:
            continue
        cells = morton_decode(level.codes)
        assert {tuple(c) for c in cells[level.refined].tolist()} == expected.refined[level.number]
        assert {tuple(c) for c in cells[level.inside].tolist()} == expected.inside[level.number]


@pytest.mark.parametrize("reach", [64, (1 << 22) - 64])  # huge triangles take the wide path
@given(data=st.data(), shape=SHAPES)
@settings(max_examples=60)
def test_any_triangles_agree_with_the_oracles(device: Device, reach, data, shape) -> None:
    vertices, faces = data.draw(meshes.fixed_triangles(shape, reach=reach))
    triangles = vertices[faces]
    for mode in MODES:
        octree = run(device, (vertices, faces), shape, mode)
        assert_voxels(octree, mode, triangles)
        assert_contract(octree, triangles, mode == "solid")


def test_ties_agree_with_the_oracles(device: Device) -> None:
    """Single triangles with corners at corners and centres of voxels and of their sides, one edge
    along an axis: planes and edges in many directions pass through centres."""
    rng = np.random.default_rng(11)
    for axis in 16 * [0, 1, 2]:
        vertices = 128 * rng.integers(0, 9, (3, 3))
        vertices[2, np.arange(3) != axis] = vertices[0, np.arange(3) != axis]
        octree = run(device, (vertices, np.array([[0, 1, 2]])), (8, 5, 5), "surface6")
        assert_voxels(octree, "surface6", vertices[None])


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=60)
def test_closed_meshes_agree_with_the_oracles(device: Device, data, shape) -> None:
    vertices, faces = data.draw(meshes.closed_meshes(shape))
    triangles = vertices[faces]
    solid = run(device, (vertices, faces), shape, "solid")
    assert_voxels(solid, "solid", triangles)
    assert_contract(solid, triangles, True)
    both = run(device, (vertices, faces), shape, "solid", with_surface=True)
    surface = run(device, (vertices, faces), shape, "surface26")
    assert np.array_equal(both.to_dense(), solid.to_dense() | surface.to_dense())


LARGE = dict.fromkeys(("wide", "blocked", "tiled", "tiled_nodes"), True)
LARGE |= {"code_bits": 64, "column_tile": 4}


@pytest.mark.parametrize(
    "forced",
    [
        {"wide": True},
        {"code_bits": 64},
        {"blocked": True},
        LARGE,
        {**LARGE, "entry": True},
        {**LARGE, "regions": True},
        {"propagation": "levels"},
        {"propagation": "levels", "code_bits": 64},
        {"plane_tiles": True},
        {"plane_tiles": True, "wide": True},
        {"overlap": "base"},
        {**LARGE, "overlap": "base"},
        {"addressing": "descent"},
        {"addressing": "jumps"},
        {**LARGE, "addressing": "jumps", "propagation": "levels"},
        {"morton": "table"},
        {**LARGE, "morton": "table"},
    ],
)
@given(data=st.data(), shape=SHAPES)
@settings(max_examples=25)
def test_paths_for_large_scenes_agree(device: Device, forced: dict, data, shape) -> None:
    """Forced on small scenes, they give the octree of the path for small ones, bit for bit."""
    mesh = data.draw(st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape)))
    for mode in MODES:
        job = planned(device, mesh, shape, mode)
        assert job.run().digest() == job.with_(**forced).run().digest()


def test_flips_of_closed_meshes_are_propagated_by_levels(device: Device) -> None:
    """Rows are walked only where those that enter a leaf differ, or it reaches beyond the grid."""
    large = meshes.box((9, 5, 3), (70, 60, 50))
    for (vertices, faces), shape, walked in (
        (meshes.join(large, meshes.octahedron((40, 30, 30), 20)), (100, 90, 61), False),
        (large, (43, 90, 90), True),
        (meshes.open_box((10, 10, 10), (30, 31, 29), missing=1), (64, 64, 64), True),
    ):
        job = planned(device, (256 * vertices, faces), shape, "solid")
        began: list[str] = []
        assert job.with_(propagation="levels").run(began.append).digest() == job.run().digest()
        assert "levels" in began
        assert ("rows" in began) == walked


@pytest.mark.parametrize("addressing", ["descent", "jumps"])
def test_nodes_of_a_model_are_found_in_the_octree(device: Device, addressing: str) -> None:
    """Also for a surface that is added to an open solid, after the fill has refined the octree."""
    mesh = load_mesh(model("stanford-bunny.obj"))
    for mode, more in (("surface26", {}), ("surface6", {}), ("solid", {"with_surface": True})):
        grid = Grid.fit(mesh, 100)
        job = plan_voxelize(mesh, grid, mode, fill="parity", device=device, **more)
        began: list[str] = []
        assert job.with_(addressing=addressing).run(began.append).digest() == job.run().digest()
        assert ("refine open rows" in began) == (mode == "solid")


@pytest.mark.parametrize("mode", ["surface26", "solid"])
def test_tables_of_morton_codes_have_two_bytes(device: Device, mode: str) -> None:
    low = np.array((2030, 60, 4060))
    vertices, faces = meshes.box(256 * low, 256 * (low + 29))
    job = planned(device, (vertices, faces), (4096, 100, 4096), mode)
    assert job.with_(morton="table").run().digest() == job.run().digest()


@cache
def larger_than_a_share() -> tuple[tuple[int, ...], tuple[np.ndarray, np.ndarray], dict]:
    """A grid, triangles of more than 64 columns, and their voxels by mode."""
    shape = (90, 80, 70)
    vertices, faces = meshes.random_triangles(np.random.default_rng(7), 3, shape, margin=20)
    sliver = np.array([[0, 0, 0], [256 * 90, 256 * 79, 256 * 69], [300, 256 * 70, 17]])
    vertices = np.concatenate([vertices, sliver])
    faces = np.concatenate([faces, [[9, 10, 11], [9, 10, 9]]])
    triangles = vertices[faces]
    expected = {
        mode: oracles.to_dense(getattr(oracles, mode)(triangles, shape), shape) for mode in MODES
    }
    return shape, (vertices, faces), expected


@pytest.mark.slow
def test_triangles_larger_than_a_share(device: Device) -> None:
    """Triangles of more than 64 columns are shared among work-items."""
    shape, mesh, expected = larger_than_a_share()
    for mode, voxels in expected.items():
        job = planned(device, mesh, shape, mode)
        assert job.plan.tiled
        assert np.array_equal(job.run().to_dense(), voxels), mode


# ---- analytic


@given(
    low=st.tuples(*[st.integers(0, 256 * 6)] * 3),
    size=st.tuples(*[st.integers(1, 9)] * 3),
)
@settings(max_examples=60)
def test_an_aligned_box_has_its_voxels(device: Device, low, size) -> None:
    """n x m x l voxels whatever the place of its faces on the lattice: centres on a face count on
    one side and not on the other."""
    high = [a + 256 * n for a, n in zip(low, size, strict=True)]
    octree = run(device, meshes.box(low, high), (16, 16, 16), "solid")
    assert octree.count == size[0] * size[1] * size[2]


@pytest.mark.parametrize("place", [0, 1, 127, 128, 129, 255])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_aligned_faces_lose_nothing(device: Device, axis: int, place: int) -> None:
    """A square across the grid sets a whole layer, or two where it lies between layers."""
    at = 256 * 5 + place
    square = np.array([[at, 0, 0], [at, 4096, 0], [at, 4096, 4096], [at, 0, 4096]])
    mesh = (np.roll(square, axis, axis=1), np.array([[0, 1, 2], [0, 2, 3]]))
    thin = run(device, mesh, (16, 16, 16), "surface6").to_dense()
    thick = run(device, mesh, (16, 16, 16), "surface26").to_dense()
    layers = np.flatnonzero(thick.any(axis=tuple({0, 1, 2} - {axis})))
    assert layers.tolist() == ([4, 5] if place == 0 else [5])
    assert thick.take(layers, axis).all()
    one = np.flatnonzero(thin.any(axis=tuple({0, 1, 2} - {axis})))
    assert len(one) == 1
    assert thin.take(one, axis).all()


@pytest.mark.parametrize(("subdivisions", "tolerance"), [(3, 0.012), (5, 0.002)])
def test_volume_of_a_sphere(device: Device, subdivisions: int, tolerance: float) -> None:
    """The volume is that of the polyhedron within the error of counting centres, and that of the
    ball within the polyhedron's own deficit."""
    centre = np.array([64.37, 63.71, 64.11])
    vertices, faces = meshes.icosphere(subdivisions, centre, 56.0)
    octree = run(device, (meshes.fixed(vertices), faces), (128,) * 3, "solid")
    a, b, c = vertices[faces].transpose(1, 0, 2) - centre
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
    assert octree.count == pytest.approx(volume, rel=1e-4)
    assert octree.count == pytest.approx(4 / 3 * np.pi * 56**3, rel=tolerance)


# ---- invariants


@given(data=st.data())
@settings(max_examples=40)
def test_order_and_orientation_change_nothing(device: Device, data) -> None:
    shape = (16, 16, 16)
    vertices, faces = data.draw(
        st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape))
    )
    order = data.draw(st.permutations(range(len(faces))))
    turned = faces[order].copy()
    for i, turn in enumerate(data.draw(st.lists(st.integers(0, 5), min_size=len(faces)))):
        if i < len(turned):
            turned[i] = np.roll(turned[i][:: 1 if turn < 3 else -1], turn)
    for mode in MODES:
        one = run(device, (vertices, faces), shape, mode)
        other = run(device, (vertices, turned), shape, mode)
        assert one.digest() == other.digest(), mode


@given(data=st.data(), step=st.tuples(*[st.integers(0, 8)] * 3))
@settings(max_examples=40)
def test_whole_voxels_shift_the_result(device: Device, data, step) -> None:
    vertices, faces = data.draw(meshes.closed_meshes((12, 12, 12), beyond=0))
    vertices = vertices + 256  # voxels that are touched from outside count, too
    for mode in MODES:
        still = run(device, (vertices, faces), (24, 24, 24), mode)
        moved = run(device, (vertices + 256 * np.array(step), faces), (24, 24, 24), mode)
        assert np.array_equal(still.occupied() + step, moved.occupied()), mode


@given(data=st.data())
@settings(max_examples=60)
def test_the_outside_never_reaches_the_inside_through_faces(device: Device, data) -> None:
    """surface6 is 6-separating: flooding from a corner stays outside the closed mesh."""
    mesh = data.draw(meshes.closed_meshes((20, 20, 20), beyond=0))
    shape = (24, 24, 24)
    mesh = (mesh[0] + 2 * 256, mesh[1])
    surface = run(device, mesh, shape, "surface6").to_dense()
    thick = run(device, mesh, shape, "surface26").to_dense()
    solid = run(device, mesh, shape, "solid").to_dense()
    assert not (surface & ~thick).any()
    outside = np.zeros(shape, bool)
    outside[0, 0, 0] = not surface[0, 0, 0]
    while True:
        grown = outside.copy()  # the margins are free, so it does not matter that `roll` wraps
        for axis in range(3):
            grown |= np.roll(outside, 1, axis) | np.roll(outside, -1, axis)
        grown &= ~surface
        if np.array_equal(grown, outside):
            break
        outside = grown
    assert outside.any()
    assert not (outside & solid).any()


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=20)
def test_windows_make_up_the_whole(device: Device, data) -> None:
    """A window holds the voxels of the whole, the parity before its low-x side included."""
    shape = (20, 16, 12)
    mesh = data.draw(st.one_of(meshes.fixed_triangles(shape), meshes.closed_meshes(shape)))
    cut = [data.draw(st.integers(1, n - 1)) for n in shape]
    for mode in MODES:
        whole = run(device, mesh, shape, mode).to_dense()
        for corner in np.ndindex(2, 2, 2):
            low = [c * a for c, a in zip(corner, cut, strict=True)]
            high = [n if c else a for c, a, n in zip(corner, cut, shape, strict=True)]
            size = [b - a for a, b in zip(low, high, strict=True)]
            if max(size) < 8:
                continue
            part = run(device, mesh, shape, mode, window=(low, size))
            assert part.grid.shape == tuple(size)
            expected = whole[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
            assert np.array_equal(part.to_dense(), expected), mode


# ---- extremes


@pytest.mark.parametrize("dim", [4096, 65_536])
def test_beyond_a_dense_volume(device: Device, dim: int) -> None:
    """Blocks of level-1 nodes, and regions of blocks, at dims where the plan chooses them; rows are
    walked only near the mesh."""
    vertices, faces = meshes.tetrahedron((9, 8, 7), (60, 11, 12), (14, 55, 9), (13, 17, 61))
    corners = [(0, 0, 0), (dim - 64, dim - 64, dim - 64), (512, dim - 128, 64)]
    parts = [meshes.fixed(vertices) + 256 * np.array(corner) for corner in corners]
    for mode in ("solid", "surface26"):
        near = run(device, (meshes.fixed(vertices), faces), (64,) * 3, mode).occupied()
        mesh = meshes.join(*((part, faces) for part in parts))
        job = planned(device, mesh, (dim,) * 3, mode)
        assert job.plan.blocked
        assert job.plan.regions == (dim > 16_384)
        wanted = np.concatenate([near + corner for corner in corners])
        assert np.array_equal(np.unique(job.run().occupied(), axis=0), np.unique(wanted, axis=0))
        assert job.cost.device < 2e6


@pytest.mark.parametrize("mode", MODES)
def test_nothing_in_the_grid_is_an_empty_octree(device: Device, mode: str) -> None:
    mesh = meshes.box((9000, 9000, 9000), (9999, 9999, 9999))
    octree = run(device, mesh, (16, 16, 16), mode)
    assert octree.count == 0
    assert len(octree.nodes) == 1
    assert len(octree.occupied()) == 0


def test_a_vertex_that_no_face_uses_does_not_matter(device: Device) -> None:
    vertices, faces = meshes.box((256, 256, 256), (2000, 2000, 2000))
    far = np.concatenate([vertices, [[1 << 40, 0, 0]]])
    assert run(device, (far, faces), (16,) * 3, "solid").count == 7**3


# ---- refusals


def test_refusals(device: Device) -> None:
    vertices, faces = meshes.box((256, 256, 256), (2000, 2000, 2000))
    mesh, grid = lattice_mesh(vertices, faces), lattice_grid((16, 16, 16))
    with pytest.raises(VoxtoolError, match="choose one of surface26, surface6, solid"):
        voxelize(mesh, grid, "thick", device=device)
    with pytest.raises(VoxtoolError, match="choose one of auto, parity, nonzero, winding, flood"):
        voxelize(mesh, grid, fill="luck", device=device)
    with pytest.raises(VoxtoolError, match="is a surface already"):
        voxelize(mesh, grid, "surface6", with_surface=True, device=device)
    with pytest.raises(GridError, match="beyond the grid"):
        voxelize(mesh, grid, window=((0, 0, 0), (17, 8, 8)), device=device)
    with pytest.raises(MemoryLimitError, match=r"dim \d+ is the largest that fits"):
        voxelize(mesh, grid, device=device, max_memory=1000)
    far = lattice_mesh(vertices + (1 << 31), faces)
    with pytest.raises(GridError, match="choose a larger pitch or a nearer box"):
        voxelize(far, grid, device=device)


def test_rows_that_leak_may_not_outgrow_memory_or_links(device: Device) -> None:
    mesh = meshes.open_box((300, 7000, 7000), (60000, 60000, 60000), missing=1)
    leaking = run(device, mesh, (64,) * 3, "solid")
    assert leaking.to_dense()[-1].any()  # it leaks to the end
    with pytest.raises(MemoryLimitError):
        run(device, mesh, (1024,) * 3, "solid", max_memory=4 * leaking.nbytes)
    tree = DeviceOctree(np.array([0, 1, 9]), device.zeros(9, NODE), [])
    refuse_beyond(tree, 1 << 26, 0, 1 << 40)
    with pytest.raises(MemoryLimitError, match="the fill leaks from this open mesh"):
        refuse_beyond(tree, 1 << 27, 0, 1 << 40)


@pytest.mark.parametrize("blocked", [False, True])
def test_triangles_beyond_the_grid_but_within_its_nodes(device: Device, blocked: bool) -> None:
    """Nodes reach beyond a grid whose sides are no multiples of theirs; large triangles there call
    for shares and wide predicates like any other."""
    z = 256 * 13 + 128
    shape, far = (150, 150, 13), 1 << 28
    plane = np.array([[-far, -far, z], [far, -far, z], [0, far, z + 300]])
    mesh = (plane, np.array([[0, 1, 2]]))
    for mode in MODES:
        job = planned(device, mesh, shape, mode)
        assert job.plan.tiled
        assert job.plan.wide
        octree = job.with_(blocked=blocked).run()
        octree.validate()
        assert octree.count == 0
        level = octree.levels()[-2]
        cells = {tuple(c) for c in morton_decode(level.codes[level.refined]).tolist()}
        assert cells == oracles.active_nodes([plane], shape, mode == "solid")


def test_thin_grids_are_dense_in_their_own_shape(device: Device) -> None:
    shape = (60000, 8, 5)
    mesh = meshes.box((256 * 10, 256, 256), (256 * 50000, 256 * 6, 256 * 4))
    octree = run(device, mesh, shape, "solid")
    dense = octree.to_dense()
    assert dense.shape == shape
    assert np.array_equal(np.argwhere(dense), octree.occupied())
    assert octree.count == 49990 * 5 * 3


@pytest.mark.parametrize(
    ("mode", "options"),
    [
        ("surface6", {"fill": "auto"}),
        ("solid", {"fill": "parity", "with_surface": True}),
        ("solid", {"fill": "nonzero"}),
        ("solid", {"fill": "flood"}),
        ("solid", {"fill": "flood", "gap": 3}),
        ("solid", {"fill": "winding"}),
    ],
)
def test_the_programs_that_a_job_uses_are_prepared(device, mode, options, monkeypatch) -> None:
    fresh = open_device(str(device.info.index))
    mesh = meshes.mesh_of(*meshes.open_box(3, 27))
    job = plan_voxelize(mesh, lattice_grid((32, 32, 32)), mode, device=fresh, **options)
    assert not job.watertight  # warnings ask for it, and for the counts
    assert not once(check_topology)(mesh, fresh).closed
    planned = fresh.builder.requests
    prepared = []
    monkeypatch.setattr(fresh.builder, "prepare", prepared.extend)
    job.run()
    keys = {(source, *sorted(defines.items())) for source, defines in prepared}
    assert fresh.builder.requests == keys | planned
