"""Labels of voxels against each part alone, and against areas in float64."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from helpers import meshes, oracles
from helpers.attributes import label_array
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.errors import MeshWarning, VoxtoolError
from voxtool.mesh.appearance import Parts
from voxtool.morton import morton_decode
from voxtool.svo.attribution.labels import PartLabelsJob, plan_labels
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.mesh_parts import parts_of
from voxtool.svo.voxelization.part_pieces import UNITS_OF_AREA

ROUNDING = 1e-4  # of a face of a voxel, by voxtool/svo/voxelization/part_pieces.py
UNIT = voxtool.Grid((16, 16, 16), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
KINDS = (("solid", False), ("solid", True), ("surface26", False), ("surface6", False))


def lattice_mesh(solids: list) -> tuple[voxtool.Mesh, Parts]:
    """Meshes of vertices in 1/256 voxel as one, and a part for each."""
    points, faces, labels, count = [], [], [], 0
    for number, (vertices, corners) in enumerate(solids):
        points.append(np.asarray(vertices).reshape(-1, 3) / 256)
        faces.append(np.asarray(corners) + count)
        labels += [number] * len(corners)
        count += len(points[-1])
    mesh = voxtool.mesh_from_arrays(np.concatenate(points), np.concatenate(faces))
    return mesh, Parts(np.array(labels, np.int32), tuple(f"p{i}" for i in range(len(solids))))


def each_alone(job: PartLabelsJob, device: object, **request: object) -> list[np.ndarray]:
    """The voxels of each part, voxelized by itself."""
    mode = str(request.pop("mode"))
    return [
        voxtool.voxelize(job.own.alone(part, job.mesh), job.grid, mode, device=device, **request)
        .to_dense()
        for part in job.own.parts.tolist()
    ]  # fmt: skip


def clipped_area(corners: list, voxel: tuple[int, ...]) -> float:
    """The area of a triangle, given in 1/256 voxel, in the closed cube of a voxel, in faces."""
    polygon = [tuple(c / 256 - v for c, v in zip(p, voxel, strict=True))
               for p in corners]  # fmt: skip
    for axis, side in product(range(3), (0, 1)):
        inside = [(p[axis] - side) * (1 - 2 * side) for p in polygon]
        kept = []
        for i, p in enumerate(polygon):
            a, b, q = inside[i], inside[(i + 1) % len(polygon)], polygon[(i + 1) % len(polygon)]
            if a >= 0:
                kept.append(p)
            if (a < 0) != (b < 0):
                t = a / (a - b)
                kept.append(tuple(u + t * (v - u) for u, v in zip(p, q, strict=True)))
        polygon = kept
    if len(polygon) < 3:
        return 0.0
    total = [0.0] * 3
    for i in range(1, len(polygon) - 1):
        a, b = ([u - v for u, v in zip(polygon[j], polygon[0], strict=True)] for j in (i, i + 1))
        for k in range(3):
            total[k] += a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]
    return sum(t * t for t in total) ** 0.5 / 2


def check_areas(job: PartLabelsJob, mode: str, labels: np.ndarray) -> int:
    """Check, by triangles that set a voxel by the oracle of the mode, that no other part has a
    greater area in a voxel of several parts; return how many voxels these are."""
    corners = np.rint(job.own.points * 256).astype(int)[job.own.faces]
    setting: dict[tuple[int, ...], list[int]] = {}
    for number, triangle in enumerate(corners.tolist()):
        for voxel in getattr(oracles, mode)([triangle], job.grid.shape):
            setting.setdefault(voxel, []).append(number)
    shared = {v: of for v, of in setting.items() if len(set(job.own.of[of].tolist())) > 1}
    for voxel, numbers in shared.items():
        areas = {part: [0.0, 0] for part in job.own.of[numbers].tolist()}
        for number in numbers:
            own = clipped_area(corners[number].tolist(), voxel)
            areas[int(job.own.of[number])][0] += own
            areas[int(job.own.of[number])][1] += own > 0
        best = int(labels[voxel])
        assert best in areas
        for part, (area, pieces) in areas.items():
            slack = ROUNDING * (pieces + areas[best][1])
            assert areas[best][0] >= area - slack, (voxel, best, areas)
            if area == areas[best][0] == 0:
                assert best <= part
    return len(shared)


@pytest.mark.parametrize(("mode", "with_surface"), KINDS)
def test_each_voxel_belongs_to_a_part_that_sets_it(device, mode, with_surface) -> None:
    rng = np.random.default_rng(5)
    solids = [meshes.box(rng.integers(2, 24, 3), rng.integers(28, 60, 3)) for _ in range(4)]
    solids = [(np.asarray(v) * 64, f) for v, f in solids]
    solids[2] = solids[2][0], np.asarray(solids[2][1])[2:]  # open
    mesh, parts = lattice_mesh(solids)
    job = plan_labels(mesh, UNIT, mode, labels=parts, with_surface=with_surface, device=device)
    octree = job.run()
    octree.validate()
    labels = label_array(octree)
    alone = each_alone(job, device, mode=mode, with_surface=with_surface)
    assert ((labels >= 0) == np.any(alone, axis=0)).all()
    one = np.sum(alone, axis=0) == 1
    assert (labels[one] == np.argmax(alone, axis=0)[one]).all()
    if "solid" in octree.mode:
        assert (labels[labels >= 0] == np.argmax(alone, axis=0)[labels >= 0]).all()
    else:
        assert check_areas(job, mode, labels) > 20


def test_the_parts_of_one_grid_are_those_of_the_whole_mesh(device) -> None:
    """Without overlap the set of voxels and the nodes are those of the mesh without labels."""
    balls = [meshes.icosphere(2, c, 3.1) for c in (4.3, 11.6)]
    solids = [(np.rint(np.asarray(v) * 256), f) for v, f in balls]
    mesh, parts = lattice_mesh(solids)
    for mode, with_surface in KINDS:
        request = {"with_surface": with_surface, "device": device}
        octree = voxtool.voxelize(mesh, UNIT, mode, labels=parts, **request)
        whole = voxtool.voxelize(mesh, UNIT, mode, **request)
        plain = Octree(octree.grid, octree.mode, octree.fill, octree.offsets, octree.nodes,
                       octree.bricks)  # fmt: skip
        assert plain.digest() == whole.digest()


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.integers(2, 5), st.sampled_from(["surface26", "surface6"]))
def test_random_soups(device, seed: int, count: int, mode: str) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = meshes.random_triangles(rng, 2 * count, (16, 16, 16), margin=0)
    mesh = voxtool.mesh_from_arrays(np.asarray(vertices) / 256, faces)
    parts = Parts(rng.integers(0, count, len(faces)).astype(np.int32),
                  tuple(f"p{i}" for i in range(count)))  # fmt: skip
    job = plan_labels(mesh, UNIT, mode, labels=parts, device=device)
    octree = job.run()
    octree.validate()
    check_areas(job, mode, label_array(octree))


@pytest.mark.parametrize("offset", [0, 37, 128])
def test_boxes_that_share_a_face_lose_and_double_no_voxel(device, offset: int) -> None:
    low, middle, high = (256 * x + offset for x in (3, 7, 11))
    solids = [meshes.box((low, 512, 512), (middle, 3000, 3000)),
              meshes.box((middle, 512, 512), (high, 3000, 3000))]  # fmt: skip
    mesh, parts = lattice_mesh(solids)
    whole, _ = lattice_mesh([meshes.box((low, 512, 512), (high, 3000, 3000))])
    labels = label_array(voxtool.voxelize(mesh, UNIT, labels=parts, device=device))
    assert ((labels >= 0) == voxtool.voxelize(whole, UNIT, device=device).to_dense()).all()
    first, second = (np.count_nonzero(labels == i) for i in (0, 1))
    assert first == second > 0  # both are four voxels long
    surface = voxtool.voxelize(mesh, UNIT, "surface26", labels=parts, device=device)
    labels = label_array(surface)
    x = middle // 256
    inner = labels[x, 4:10, 4:10]
    assert (inner == 0).all()  # the face belongs to both: the lower label


def test_priorities(device) -> None:
    solids = [meshes.box((256, 256, 256), (2048, 2048, 2048)),
              meshes.box((1024, 1024, 1024), (3072, 3072, 3072)),
              meshes.box((1280, 1280, 1280), (1792, 1792, 1792))]  # fmt: skip
    mesh, parts = lattice_mesh(solids)

    def middle(priority: object) -> int:
        octree = voxtool.voxelize(mesh, UNIT, labels=parts, priority=priority, device=device)
        return int(label_array(octree)[6, 6, 6])

    with pytest.warns(MeshWarning, match="1 part without a voxel, p2: choose smaller voxels"):
        assert middle("first") == 0
    assert middle("last") == 2
    assert middle("p1,p2") == 1
    assert middle(["p2"]) == 2
    with pytest.raises(VoxtoolError, match="priority: there is no part 'p7': choose of p0, p1, p2"):
        middle("p7")


def test_a_thousand_parts_are_voxelized_at_once(device) -> None:
    rng = np.random.default_rng(3)
    low = rng.integers(300, 3000, (1000, 3))
    solids = [meshes.box(a, a + rng.integers(1, 700, 3)) for a in low]
    mesh, parts = lattice_mesh(solids)
    job = plan_labels(mesh, UNIT, labels=parts, priority="last", device=device)
    assert (len(job.jobs), job.plan.together, job.plan.alone) == (1, 1000, ())
    assert job.plan.dtype == "u2"
    with pytest.warns(MeshWarning, match="parts without a voxel"):
        octree = job.run()
    labels = label_array(octree)
    centres = np.arange(16) * 256 + 128
    expected = np.full((16, 16, 16), -1)
    for number, (vertices, _) in enumerate(solids):
        points = np.asarray(vertices).reshape(-1, 3)
        held = [(centres >= a) & (centres < b)
                for a, b in zip(points.min(axis=0), points.max(axis=0), strict=True)]  # fmt: skip
        expected[np.ix_(*held)] = number
    differ = labels != expected
    on_face = np.isin(centres, np.concatenate([np.ravel(v) for v, _ in solids]))
    rows = on_face[:, None, None] | on_face[None, :, None] | on_face[None, None, :]
    assert not (differ & ~rows).any()  # centres on faces go by the rule for ties


def test_parts_at_the_side_of_the_grid_and_beyond_are_cut(device) -> None:
    solids = [meshes.box((-900, 500, 500), (1000, 1500, 1500)),
              meshes.box((2000, 2000, 2000), (5000, 5000, 5000)),
              meshes.box((0, 3000, 0), (256, 4096, 256)),
              meshes.box((1500, 300, 300), (1900, 700, 700))]  # fmt: skip
    mesh, parts = lattice_mesh(solids)
    for mode in ("solid", "surface26", "surface6"):
        job = plan_labels(mesh, UNIT, mode, labels=parts, device=device)
        assert [part for part, _ in job.plan.alone] == [0, 1, 2]
        labels = label_array(job.run())
        alone = each_alone(job, device, mode=mode)
        assert ((labels >= 0) == np.any(alone, axis=0)).all()


@pytest.mark.parametrize("fill", ["parity", "nonzero", "winding", "flood"])
def test_each_part_has_its_own_fill(device, fill: str) -> None:
    solids = [meshes.box((400, 400, 400), (2400, 2400, 2400)),
              meshes.box((1400, 1400, 1400), (3700, 3700, 3700))]  # fmt: skip
    solids[1] = solids[1][0], np.asarray(solids[1][1])[2:]
    mesh, parts = lattice_mesh(solids)
    request = {"fill": fill, "gap": 10 if fill == "flood" else 0}
    job = plan_labels(mesh, UNIT, labels=parts, device=device, **request)
    labels = label_array(job.run())
    alone = each_alone(job, device, mode="solid", **request)
    assert ((labels >= 0) == np.any(alone, axis=0)).all()
    assert alone[0].any()


@pytest.mark.parametrize("fill", ["parity", "nonzero"])
def test_rows_that_leak_stay_with_their_part(device, fill: str) -> None:
    """Boxes are open at high x, so the fill leaks along their rows to the side of the grid."""
    solids = [meshes.box((400 + 600 * i, 400, 400), (800 + 600 * i, 1200, 1200)) for i in range(5)]
    right = [np.flatnonzero((np.asarray(v)[np.asarray(f), 0] == np.asarray(v)[:, 0].max()).all(1))
             for v, f in solids]  # fmt: skip
    solids = [(v, np.delete(f, side, axis=0)) for (v, f), side in zip(solids, right, strict=True)]
    mesh, parts = lattice_mesh(solids)
    job = plan_labels(mesh, UNIT, labels=parts, fill=fill, device=device)
    labels = label_array(job.run())
    alone = each_alone(job, device, mode="solid", fill=fill)
    assert (labels == np.where(np.any(alone, axis=0), np.argmax(alone, axis=0), -1)).all()
    assert alone[0][15].any()


def test_kinds_of_labels() -> None:
    mesh, parts = lattice_mesh(
        [meshes.box((0, 0, 0), (9, 9, 9)), meshes.box((20, 0, 0), (30, 9, 9))]
    )
    assert parts_of(mesh, "shell").names == ("shell 1", "shell 2")
    assert (parts_of(mesh, "shell").labels == parts.labels).all()
    named = Parts(parts.labels, ("bolt", "bolt"))
    assert parts_of(mesh, named).names == ("bolt",)
    with pytest.raises(VoxtoolError, match="mesh names no materials: choose labels 'shell'"):
        parts_of(mesh, "material")
    with pytest.raises(VoxtoolError, match="labels 'taste': choose one of part, material"):
        parts_of(mesh, "taste")
    with pytest.raises(VoxtoolError, match="3 labels for 24 faces: one each"):
        parts_of(mesh, Parts(np.zeros(3, np.int32), ("a",)))


def test_joined_meshes_know_their_file() -> None:
    one, two = (voxtool.mesh_from_arrays(*meshes.box((0, 0, 0), (n, n, n)), name=f"dir/b{n}.obj")
                for n in (1, 2))  # fmt: skip
    both = voxtool.join([one, two, one])
    assert both.parts["file"].names == ("b1", "b2", "b1 (2)")
    assert np.bincount(both.parts["file"].labels).tolist() == [12, 12, 12]
    assert np.array_equal(both.vertices[both.faces[12:24]], two.vertices[two.faces])
    with pytest.raises(voxtool.MeshError, match="meshes in no unit and mm: give all the same"):
        voxtool.join([one, voxtool.mesh_from_arrays(one.vertices, one.faces, units="mm")])


def test_areas_are_those_of_float64(device) -> None:
    """The area of each piece of random triangles, some of them thousands of voxels long."""
    from voxtool.svo.voxelization import part_pieces
    from voxtool.svo.voxelization.scan_conversion import TOUCHED, Scan, find_active_nodes
    from voxtool.svo.voxelization.voxelize import plan_voxelize

    rng = np.random.default_rng(8)
    for reach, count in ((4096, 40), (1 << 20, 12), (1 << 29, 12)):
        corners = rng.integers(-reach, reach, (count, 3, 3)) + 2048
        corners[:, 0] = rng.integers(0, 4096, (count, 3))
        mesh = voxtool.mesh_from_arrays(
            corners.reshape(-1, 3) / 256, np.arange(3 * count).reshape(-1, 3)
        )
        job = plan_voxelize(mesh, UNIT, "surface26", device=device)
        octree, scan = job.run(), Scan(job.lattice, job.plan)
        active = find_active_nodes(scan)
        counts = np.bitwise_count(octree.bricks)
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.uint32)
        masks = (device.put(octree.bricks), device.put(starts))
        found = part_pieces.list_pieces(scan, active, *masks, TOUCHED)
        level = octree.levels()[-1]
        at = 4 * morton_decode(level.codes)[:, None] + morton_decode(np.arange(64))
        bits = octree.bricks[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1) == 1
        low = at[bits]
        areas = part_pieces.areas_of(scan, found, low) / UNITS_OF_AREA
        of = zip(found.voxels.get(0, found.n), found.faces.get(0, found.n), areas, strict=True)
        pairs = set()
        for voxel, face, area in of:
            pairs.add((int(voxel), int(face)))
            exact = clipped_area(corners[face].tolist(), tuple(low[voxel].tolist()))
            assert abs(exact - area) < ROUNDING, (reach, exact, area)
        assert len(pairs) == found.n > 50


def test_a_path_is_read_with_its_parts(tmp_path) -> None:
    path = tmp_path / "two.obj"
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in ((1, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)))
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\ng tip\n{faces}")
    octree = voxtool.voxelize(path, dim=16, labels="part")
    assert octree.attribute("label").names == ("tip",)


def test_large_faces_that_repeat_others(device) -> None:
    """Boxes that share whole faces, which are so large that repeated ones would be left out."""
    corners = [(1, 1, 1), (15, 1, 1), (15, 15, 1)]
    solids = [meshes.box(np.array(low) * 256, (np.array(low) + 14) * 256) for low in corners]
    mesh, parts = lattice_mesh(solids)
    grid = voxtool.Grid((32, 32, 32), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    job = plan_labels(mesh, grid, "surface26", labels=parts, device=device)
    assert check_areas(job, "surface26", label_array(job.run())) > 300
