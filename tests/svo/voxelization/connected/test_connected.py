"""Solids whose thin parts are connected: their components, topology and counts by other means.

Components are scipy's; the Euler number is counted over the cells of the voxels; the voxels that a
curve crosses are found segment by segment; distances are those of the selftest's oracle.
"""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.attributes import label_array
from helpers.cli import fail, run, write_obj
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import voxtool
from voxtool.errors import OnePieceError, VoxtoolError
from voxtool.selftest.oracles import distances
from voxtool.svo.voxelization.connected.thin_parts import REACH
from voxtool.tiles.plan import plan_windows

pytestmark = pytest.mark.filterwarnings("ignore:.*sets no voxel")
ALL = np.ones((3, 3, 3), bool)
NEAR = ndimage.generate_binary_structure(3, 2)  # voxels that share a face or an edge
SIDE = 48
GRID = voxtool.Grid((SIDE, SIDE, SIDE), (0, 0, 0), (1, 1, 1))
TURNS = np.linspace(0, 1, 240)


def pieces(dense: np.ndarray) -> int:
    return ndimage.label(dense, ALL)[1]


def euler(dense: np.ndarray) -> int:
    """Corners less edges plus faces less cubes of a set of closed voxels."""
    total, padded = 0, np.pad(dense, 1)
    for cell in product((0, 1), repeat=3):
        found = padded
        for axis in np.flatnonzero(np.array(cell) == 0):
            found = found | np.roll(found, 1, axis)
        total += (-1) ** sum(cell) * np.count_nonzero(found)
    return int(total)


def crossed(points: np.ndarray) -> set[tuple[int, ...]]:
    """The voxels that a polyline passes through, between its crossings of planes."""
    found = set()
    for a, b in pairwise(points):
        ends = np.sort(np.stack([a, b]), axis=0)
        shares = {0.0, 1.0}
        for axis in np.flatnonzero(a != b):
            planes = np.arange(np.ceil(ends[0, axis]), np.floor(ends[1, axis]) + 1)
            shares |= set(((planes - a[axis]) / (b[axis] - a[axis])).tolist())
        steps = np.sort(list(shares))
        for middle in (steps[1:] + steps[:-1]) / 2:
            found.add(tuple(np.floor(a + middle * (b - a)).astype(int).tolist()))
    return found


def mesh_of(*parts) -> voxtool.Mesh:
    return meshes.mesh_of(*meshes.join(*parts))


def helix(offset: float = 0.0) -> np.ndarray:
    angle = 4 * np.pi * TURNS
    return 24 + offset + np.stack([15 * np.cos(angle), 15 * np.sin(angle), 36 * TURNS - 18], 1)


def circle(radius: float, normal, centre) -> np.ndarray:
    axis = np.asarray(normal, float) / np.linalg.norm(normal)
    u = np.cross(axis, [0.1, 0.9, 0.4])
    u /= np.linalg.norm(u)
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)[:, None]
    return centre + radius * (np.cos(angle) * u + np.sin(angle) * np.cross(axis, u))


def line(start, end, n: int = 40) -> np.ndarray:
    return np.linspace(start, end, n)


def made(mesh: voxtool.Mesh, device=None, **options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh's solid, the solid connected, and all voxels that it may consist of. What holds of
    every connected solid is checked."""
    octree = voxtool.voxelize(mesh, GRID, connected=True, device=device, **options)
    plain = voxtool.voxelize(mesh, GRID, device=device, **options)
    octree.validate()
    solid, result = plain.to_dense(), octree.to_dense()
    most = voxtool.voxelize(mesh, GRID, with_surface=True, device=device, **options).to_dense()
    assert not (solid & ~result).any()
    assert not (result & ~most).any()
    facts = {"added": (result & ~solid).sum(), "pieces": pieces(solid), "became": pieces(result)}
    assert octree.plan["connected"] == facts
    assert (octree.mode, octree.fill) == (plain.mode, plain.fill)
    assert np.array_equal(octree.nodes, plain.nodes)
    assert not facts["added"] or octree.digest() != plain.digest()
    return solid, result, most


def check_one_part(result: np.ndarray, most: np.ndarray) -> None:
    """Check what holds of the solid of a mesh whose inside is one part: it has one component for
    each of what it may consist of, and leaves out no more than a tip of this."""
    labels, n = ndimage.label(most, ALL)
    assert pieces(result) == n
    assert len(np.unique(labels[result])) == n
    reached = ndimage.binary_dilation(result, ALL, REACH + 1, mask=most)
    assert (reached | ~most).all()


def check_thin(result: np.ndarray, most: np.ndarray) -> None:
    """Check what holds where no 2 x 2 x 2 voxels are set: nothing of it is farther away than across
    an edge, and the topology is its own."""
    check_one_part(result, most)
    assert (ndimage.binary_dilation(result, NEAR) | ~most).all()
    assert euler(result) == euler(most)


@pytest.mark.parametrize("radius", [0.01, 0.2, 0.45])
def test_a_helix_is_a_curve_of_voxels(device, radius: float) -> None:
    for offset in (0.0, 0.37):
        points = helix(offset)
        _, result, most = made(mesh_of(meshes.tube(points, radius)), device)
        check_thin(result, most)
        assert pieces(result) == 1
        assert euler(result) == 1
        assert result.sum() <= len(crossed(points))


def test_no_voxel_of_a_helix_could_be_left_out() -> None:
    """Without any added one there are two pieces or more, or a voxel that the tube touches has no
    set one across a face or an edge."""
    solid, result, most = made(mesh_of(meshes.tube(helix(0.2), 0.1)))
    for voxel in map(tuple, np.argwhere(result & ~solid)):
        result[voxel] = False
        covered = (ndimage.binary_dilation(result, NEAR) | ~most).all()
        assert not covered or pieces(result) > 1, voxel
        result[voxel] = True


def test_added_voxels_are_near_the_mesh() -> None:
    mesh = mesh_of(meshes.tube(helix(0.2), 0.2, 4))
    solid, result, _ = made(mesh)
    centres = np.argwhere(result & ~solid)[::25] + 0.5
    assert distances(centres, mesh.vertices[mesh.faces]).max() < np.sqrt(3) / 2 + 2 / 256


@pytest.mark.parametrize("radius", [0.05, 0.3, 0.5, 0.6, 0.8])
def test_a_ring_stays_a_ring(device, radius: float) -> None:
    for size, normal in ((6, (1, 0.3, 0.2)), (14, (0.1, 1, 0.7)), (18.3, (1, 1, 1))):
        points = circle(size, normal, (23.3, 24.1, 24.4))
        _, result, most = made(mesh_of(meshes.tube(points, radius, closed=True)), device)
        check_thin(result, most)
        assert (pieces(result), euler(result)) == (1, 0)


@pytest.mark.parametrize("thickness", [0.02, 0.3, 0.6])
def test_a_plate_is_a_sheet_without_holes(device, thickness: float) -> None:
    """Every row of voxels across it that meets it farther than two voxels from its rim has a set
    one; it has about as many as there are rows."""
    rng = np.random.default_rng(3)
    for normal in ((0, 0, 1), (1, 2, 3), (1, 1, 1), (1, 0.1, 0.2), (0.7, 1, -0.4), (1, 1, 0)):
        centre = 24 + rng.random(3)
        mesh = mesh_of(meshes.plate(normal, 13, thickness, centre))
        _, result, most = made(mesh, device)
        check_thin(result, most)
        assert (pieces(result), euler(result)) == (1, 1)
        inner = voxtool.voxelize(
            mesh_of(meshes.plate(normal, 11, 1e-3, centre)), GRID, "surface26", device=device
        ).to_dense()
        axis = int(np.argmax(np.abs(normal)))
        assert result.any(axis=axis)[ndimage.binary_erosion(inner.any(axis=axis))].all()
        rows = 26**2 * np.abs(normal).max() / np.linalg.norm(normal)
        assert result.sum() < 1.1 * rows + 30


def test_hollow_boxes_are_closed(device) -> None:
    """A wall of 0.6 voxel between two shells is one closed sheet."""
    outer, inner = meshes.box([6.2] * 3, [40.1] * 3), meshes.box([6.8] * 3, [39.5] * 3)
    result = made(mesh_of(outer, (inner[0], inner[1][:, ::-1])), device)[1]
    assert (pieces(result), euler(result)) == (1, 2)
    assert pieces(~result) == 2
    assert result.sum() < 1.1 * 6 * 34**2


def test_parts_that_are_apart_stay_apart(device) -> None:
    """Blocks with a clearance of 0.8 voxel; wires 2.5 voxels apart; a wire in a hollow box."""
    low, high = meshes.box([4, 4, 4], [30, 30, 15.3]), meshes.box([4, 4, 16.1], [30, 30, 40])
    solid, result, _ = made(mesh_of(low, high), device)
    assert (pieces(solid), pieces(result)) == (2, 2)
    assert np.array_equal(solid, result)
    one = meshes.tube(line((4, 4.3, 20.4), (44, 40, 20.4)), 0.2)
    other = meshes.tube(line((4, 41, 22.9), (44, 5, 22.9)), 0.2)
    result = made(mesh_of(one, other), device)[1]
    assert (pieces(result), euler(result)) == (2, 2)
    outer, inner = meshes.box([4.2] * 3, [42.1] * 3), meshes.box([4.6] * 3, [41.5] * 3)
    wire = meshes.tube(line((9, 9.2, 9.4), (35, 30, 31)), 0.2)
    result = made(mesh_of(outer, (inner[0], inner[1][:, ::-1]), wire), device)[1]
    assert (pieces(result), euler(result)) == (2, 3)


def test_shells_that_meet_are_one_part(device) -> None:
    """Wires that pass through each other, and two bubbles with a thin wall between them."""
    one = meshes.tube(line((4, 4.3, 10.4), (44, 40, 30.4)), 0.1)
    other = meshes.tube(line((4, 40, 10.5), (44, 4.5, 30.5)), 0.1)
    result = made(mesh_of(one, other), device)[1]
    assert (pieces(result), euler(result)) == (1, 1)
    bubbles = [
        meshes.box(a, b) for a, b in (([8.2] * 3, [20] * 3), ([20.3, 8.2, 8.2], [36, 20, 20]))
    ]
    turned = [(vertices, faces[:, ::-1]) for vertices, faces in bubbles]
    result = made(mesh_of(meshes.box([3] * 3, [44] * 3), *turned), device)[1]
    assert pieces(~result) == 3


def test_a_wire_beside_a_block_is_not_its_skin(device) -> None:
    wire = meshes.tube(line((30.6, 5.1, 10), (30.6, 43.2, 12)), 0.1)
    mesh = mesh_of(meshes.box([5, 5, 5], [30, 43, 30]), wire)
    solid, result, _ = made(mesh, device)
    thin = made(mesh_of(wire), device)[1]
    assert np.array_equal(result, solid | thin)
    assert thin.sum() > 36


def test_necks_are_bridged_and_gaps_are_not(device) -> None:
    """Two balls with a neck of a few voxels become one piece; a cut ring keeps its gap."""
    for neck in (4, 20):
        radius = np.interp(np.arange(100), [0, 50 - neck, 50, 50 + neck, 99], [5, 5, 0.1, 5, 5])
        points = line((8, 8.3, 8.1), (40, 38, 40), 100)
        solid, result, most = made(mesh_of(meshes.tube(points, radius, 12)), device)
        check_one_part(result, most)
        assert (result & ~solid).sum() <= neck
    points = circle(14, (0.3, 1, 0.2), (24, 24, 24))[:-8]
    result = made(mesh_of(meshes.tube(points, 0.3)), device)[1]
    assert (pieces(result), euler(result)) == (1, 1)


def test_a_neck_between_faces_is_a_row_of_voxels(device) -> None:
    """Blocks 1.2 voxels apart, with a wire from one to the other: two voxels join them, although
    all between them touch the mesh."""
    blocks = meshes.box([8, 8, 8], [20, 20, 20.4]), meshes.box([8, 8, 21.6], [20, 20, 36])
    wire = meshes.tube(line((13.4, 14.3, 18), (13.4, 14.3, 24)), 0.1)
    solid, result, _ = made(mesh_of(*blocks, wire), device, fill="nonzero")
    assert (pieces(solid), pieces(result), (result & ~solid).sum()) == (2, 1, 2)


def tree(rng: np.random.Generator, branches: int, smallest: float) -> list:
    """Tubes that branch off each other and taper, as vessels do."""
    start = rng.uniform(8, 14, 3)
    paths = [line(start, start + rng.uniform(18, 24, 3))]
    sizes = [np.linspace(rng.uniform(0.3, 3), smallest, 40)]
    for _ in range(branches):
        parent = int(rng.integers(len(paths)))
        place = int(rng.integers(5, 35))
        start = paths[parent][place]
        step = rng.normal(size=3)
        end = np.clip(start + 16 * step / np.linalg.norm(step), 4, SIDE - 4)
        bend = np.cross(end - start, rng.normal(size=3)) / 12
        t = np.linspace(0, 1, 40)[:, None]
        paths.append(start + t * (end - start) + t * (1 - t) * bend)
        sizes.append(np.linspace(min(sizes[parent][place], 1.5), smallest, 40))
    return [meshes.tube(path, size) for path, size in zip(paths, sizes, strict=True)]


@given(seed=st.integers(0, 1 << 32), branches=st.integers(0, 4))
@settings(max_examples=6)
def test_trees_of_vessels_are_one_piece(seed: int, branches: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = mesh_of(*tree(rng, branches, rng.choice([0.05, 0.2, 0.5])))
    _, result, most = made(mesh, fill="nonzero")
    assert pieces(result) == 1
    check_one_part(result, most)


@given(seed=st.integers(0, 1 << 32))
@settings(max_examples=6)
def test_thin_tubes_keep_their_topology(seed: int) -> None:
    """Curves of any turn, which may touch themselves."""
    rng = np.random.default_rng(seed)
    turns = np.linspace(0, 2 * np.pi, 200, endpoint=False)[:, None]
    waves = [rng.normal(size=(2, 3)) / (k + 1) for k in range(4)]
    path = sum(np.cos(k * turns) * a + np.sin(k * turns) * b for k, (a, b) in enumerate(waves, 1))
    low, high = path.min(axis=0), path.max(axis=0)
    points = 4 + (path - low) / (high - low).max() * rng.uniform(12, SIDE - 8)
    tube = meshes.tube(points, rng.uniform(0.02, 0.6), closed=True)
    _, result, most = made(mesh_of(tube), fill="nonzero")
    check_thin(result, most)


def test_moved_by_whole_voxels_it_is_the_same(device) -> None:
    mesh = mesh_of(meshes.tube(circle(9, (1, 0.3, 0.2), (12.3, 13.1, 12.4)), 0.3, closed=True))
    moved = meshes.mesh_of(mesh.vertices + np.array([5, 3, 19]), mesh.faces)
    one, other = (made(m, device)[1] for m in (mesh, moved))
    assert np.array_equal(np.roll(one, (5, 3, 19), axis=(0, 1, 2)), other)


def test_each_labelled_part_is_connected_by_itself(device) -> None:
    """Rods, one of which passes through a ball, one beyond the grid, and one open; the set is that
    of the parts alone, and where they share voxels the first one counts."""
    parts = {
        "ball": meshes.icosphere(3, [24.0, 24, 24], 7.0),
        "rod": meshes.tube(line((4, 4.2, 5), (43, 42, 41)), 0.2),
        "beyond": meshes.tube(line((-9, 40.2, 5), (60, 20, 30)), 0.2),
        "open": meshes.tube(line((40, 4.2, 5), (12, 10.3, 30)), 0.2),
    }
    parts["open"] = parts["open"][0], parts["open"][1][:-16]
    mesh = mesh_of(*parts.values())
    labels = np.repeat(np.arange(4, dtype=np.int32), [len(faces) for _, faces in parts.values()])
    request = {"connected": True, "device": device}
    octree = voxtool.voxelize(
        mesh, GRID, labels=voxtool.Parts(labels, tuple(parts)), priority="first", **request
    )
    octree.validate()
    alone = [made(mesh_of(part), device)[1] for part in parts.values()]
    assert [pieces(dense) for dense in alone] == [1] * 4
    assert np.array_equal(
        label_array(octree), np.where(np.any(alone, axis=0), np.argmax(alone, axis=0), -1)
    )


def test_attributes_reach_added_voxels(device) -> None:
    mesh = mesh_of(meshes.tube(helix(), 0.2))
    request = {"connected": True, "device": device}
    plain = voxtool.voxelize(mesh, GRID, **request)
    octree = voxtool.voxelize(mesh, GRID, attributes=("normal",), **request)
    assert np.array_equal(octree.bricks, plain.bricks)
    assert len(octree.attribute("normal").values) == octree.count


@pytest.mark.parametrize("name", ["spot", "armadillo", "suzanne", "rocker-arm"])
def test_what_needs_nothing_stays_as_it_is(device, name: str) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    for dim in (64, 128):
        octree = voxtool.voxelize(mesh, dim=dim, connected=True, device=device)
        assert octree.digest() == voxtool.voxelize(mesh, dim=dim, device=device).digest()
        assert octree.plan["connected"] == {"added": 0, "pieces": 1, "became": 1}


def test_simple_solids_stay_as_they_are() -> None:
    for part in (
        meshes.icosphere(3, [24.2, 24, 23.9], 14.0),
        meshes.tetrahedron((4, 4, 4), (43, 8, 9), (9, 40, 6), (22, 20, 40)),
        meshes.plate((1, 2, 3), 13, 2.5, (24, 24, 24)),
        meshes.tube(circle(14, (1, 0.3, 0.2), (24, 24, 24)), 2.0, closed=True),
        meshes.tube(line((12, 11, 12), (30, 31, 29)), np.linspace(12, 0.01, 40), 12),
    ):
        solid, result, _ = made(mesh_of(part))
        assert np.array_equal(solid, result)


def test_a_flood_has_all_that_could_be_added(device) -> None:
    request = {"fill": "flood", "connected": True, "device": device}
    job = voxtool.plan_voxelize(mesh_of(meshes.tube(helix(), 0.2)), GRID, **request)
    assert "connect" not in job.stages
    assert "connecting of thin parts" in job.left_out
    assert list(job.notes(job.run())) == []


def test_what_does_not_go_together() -> None:
    mesh = mesh_of(meshes.tube(helix(), 0.2))
    for options, message in (
        ({"mode": "surface26"}, "connected goes with mode 'solid', not 'surface26'"),
        ({"mode": "fraction"}, "connected goes with mode 'solid', not 'fraction'"),
        ({"with_surface": True}, "drop one"),
        ({"window": ((0, 0, 0), (8, 8, 8))}, "connected takes the whole grid"),
    ):
        with pytest.raises(VoxtoolError, match=message):
            voxtool.plan_voxelize(mesh, GRID, connected=True, **options)
    for options in ({}, {"labels": "shell"}, {"attributes": ("normal",)}):
        job = voxtool.plan_voxelize(mesh, GRID, connected=True, **options)
        with pytest.raises(OnePieceError, match="in one piece, not in windows"):
            plan_windows(job)


def test_the_command_says_what_it_added(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    vertices, faces = meshes.tube(helix(), 0.2)
    write_obj(tmp_path / "wire.obj", vertices, faces)
    planned = run("voxelize wire.obj --pitch 1 --connected --plan").stdout
    assert "connected  parts thinner than two voxels stay in one piece" in planned
    said = run("voxelize wire.obj --pitch 1 --connected -o wire.svo.h5").stderr
    octree = voxtool.read_svo("wire.svo.h5")
    added, before = (octree.plan["connected"][name] for name in ("added", "pieces"))
    assert f"{added} voxels added: {before} pieces became 1" in said
    assert f"{added} voxels added: {before} pieces became 1" in run("svo-info wire.svo.h5").stdout
    for options, message in (
        ("--mode surface6", "--connected goes with --mode solid"),
        ("--with-surface", "drop one"),
        ("--mode fraction", "--connected: not with --mode fraction"),
        ("--dask local", "--connected takes a solid in one piece"),
        ("--resume", "--connected takes a solid in one piece"),
    ):
        assert message in fail(f"voxelize wire.obj --connected {options}", code=2)
    assert "not in windows" in fail(
        "voxelize wire.obj --pitch 0.05 --connected --max-memory 100k -o x.svo.h5", code=4
    )
