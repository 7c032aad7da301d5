"""Every kernel under Oclgrind, a simulator that checks each access and looks for data races.

The child, which is this file run as a script, voxelizes tiny meshes in every variant that a plan
can choose; the limits beyond which a plan chooses a variant are lowered for that. It compares each
result with the oracle and prints what was launched.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import meshes, oracles
from helpers.attributes import attributed
from helpers.distance import brute
from helpers.field import HALVES, cells_of, plain_field, sphere
from helpers.octree import octree_from_dense
from helpers.signs import winding
from helpers.tets import (
    SIX,
    boxes,
    draw,
    grid_corners,
    grid_points,
    ramp,
    reference_picture,
    tet_mesh,
)
from scipy import ndimage

from voxtool.adf.construction import build
from voxtool.adf.pictures.scene import FieldScene
from voxtool.adf.queries import query, textures
from voxtool.adf.surface.extract import extract_field_surface
from voxtool.bench import text_peers
from voxtool.bench.fractions import dense_of
from voxtool.camera import Camera
from voxtool.choices import COLOURS, METHODS
from voxtool.files.storage.spool import Spool
from voxtool.grid import Grid
from voxtool.mesh.appearance import Appearance, Material, Texture
from voxtool.mesh.joining import join
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.mesh.parts import find_parts
from voxtool.mesh.topology import check_surface, closed_chain
from voxtool.opencl import Device, open_device, primitives, program
from voxtool.selftest import arithmetic, crowds, volumes
from voxtool.spatial import signed_distance
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.fans import fan_of
from voxtool.spatial.fill_rule import inside_of_closed
from voxtool.spatial.hausdorff import hausdorff
from voxtool.spatial.orientation import orient
from voxtool.spatial.pseudonormals import pseudonormals
from voxtool.spatial.self_intersections import find_self_intersections
from voxtool.spatial.signed_distance import SignedDistance
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.attribution.fraction import plan_fractions
from voxtool.svo.attribution.labels import plan_labels
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import stored_volume
from voxtool.svo.pictures.raycast import cast, cast_attribute, depths
from voxtool.svo.queries.query import OctreeQuery
from voxtool.svo.sets.booleans import combine
from voxtool.svo.sets.morphology import plan_morph
from voxtool.svo.sets.resample import plan_resample
from voxtool.svo.solvers.wall_links import CROSSED, plan_wall_links
from voxtool.svo.surface.extract import plan_extract, plan_unread
from voxtool.svo.surface.isosurface import LATTICE
from voxtool.svo.voxelization.fill.caps import find_boundary
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tets.construction.textures import build_tet
from voxtool.tiles.surface import SurfaceWindowsJob

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.slow
KERNELS = Path(__file__).parents[1] / "kernels"
OPTIONS = ("--data-races", "--uniform-writes", "--max-errors", "1000000000")
# Races that cannot show, by the two lines that they are between: reads beside atomic operations on
# the same word, which reads see before or after, never in part.
UNITE = {  # a root that was read earlier is still above the node: roots only fall towards the least
    frozenset(pair)
    for pair in itertools.product(
        ("uint above = roots[i];", "const uint next = roots[above];"),
        (
            "atomic_min(&roots[i], next);",
            "if (atomic_cmpxchg(&roots[high], high, low) == high)",
            "atomic_min(&roots[gid], root_of(roots, gid));",
        ),
    )
}
HARMLESS = UNITE | {
    frozenset(pair)
    for pair in (
        # glances that only save an atomic: bits that are set stay, and a maximum never falls
        (
            "else if ((s->words[s->word] & s->bits) != s->bits)",
            "atomic_or(&s->words[s->word], s->bits);",
        ),
        (
            "if (as_uint(slope_of_leaves) > *steepest)",
            "atomic_max(steepest, as_uint(slope_of_leaves));",
        ),
        # fetches into the cache, whose values are dropped
        (
            "(void)table[places[i - begin] & mask];",
            "other = atomic_cmpxchg(slot, 0, i + 1);",
        ),
        (
            "(void)lists[LIST * (size_t)at[i]];",
            "const uint place = atomic_inc(list) + 1, side = 3 * b.begin + k;",
        ),
        # all write the same
        ("used[corners[k]] = 1;",),
        # a slot of the table is taken once and for good
        ("other = *slot;", "other = atomic_cmpxchg(slot, 0, i + 1);"),
        # the mark is masked out of what is read
        (
            "if ((list[place] & ~MARK) == start)",
            "if (side == list || atomic_or(side, MARK) & MARK)",
        ),
        # a flag that only becomes 1
        ("if (left > 0 && !*some)", "*some = 1;"),
        ("*open = 1;",),
    )
}
VARIANTS = {  # forced decisions of VoxelizePlan
    "narrow": {},
    "levels": {"propagation": "levels", "morton": "table", "plane_tiles": True},
    "base": {"overlap": "base", "addressing": "jumps"},
    "blocked": {"blocked": True, "code_bits": 64},
    "all": dict.fromkeys(("wide", "blocked", "regions", "tiled", "tiled_nodes"), True)
    | {"code_bits": 64, "column_tile": 8},
}


@pytest.fixture(scope="module")
def run():
    """The JSON that the child printed, and Oclgrind's reports on stderr (with every context it
    clears a --log)."""
    oclgrind = shutil.which("oclgrind")
    if oclgrind is None:
        pytest.skip("oclgrind is not installed")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OCL_", "VOXTOOL_"))}
    child = subprocess.run(
        [oclgrind, *OPTIONS, sys.executable, "-W", "ignore", __file__],
        env={**environment, "PYOPENCL_NO_CACHE": "1"},
        capture_output=True,
        text=True,
    )
    assert child.returncode == 0, child.stdout + child.stderr
    return json.loads(child.stdout.splitlines()[-1]), child.stderr


def test_runs_on_the_simulator(run):
    assert run[0]["device"] == "Oclgrind Simulator"


def test_every_kernel_and_variant_was_launched(run):
    declared = {
        name
        for source in KERNELS.glob("**/*.cl")
        for name in re.findall(r"\bvoid\s+(\w+)\s*\(", _without_comments(source))
        if re.search(rf"__kernel[^;{{]*\bvoid\s+{name}\s*\(", _without_comments(source))
    }
    assert len(declared) > 10
    assert declared == set(run[0]["kernels"])
    wanted = {
        "",
        "WIDE",
        "CODE=ulong",
        "LISTED",
        "VOXELS",
        "FRACTIONS",
        "SAMPLE=uchar",
        "SAMPLE=uint",
    }
    wanted |= {"MORTON_TABLE", "PLANE_TILE=4", "BASE_OVERLAP", "DESCENT", "ANCESTORS"}
    wanted |= {"SIGNED", "RANKED", "GRAINED", "FLAT", "WINDING", "CLOSED", "JUMPS"}
    wanted |= {"SEARCH=LINEAR", "SEARCH=BINARY", "SEARCH=COHERENT", "LANES=1", "LANES=16", "W"}
    wanted |= {"GRADIENT", "BOUNDS", "CELL", "HARDWARE", "BOOK", "EIGHT", "PROBED", "TABLE"}
    wanted |= {"PERSPECTIVE", "ANCHORED", "CONSTANT", "FACES=4", "FACES=6", "SLOTS=3", "SLOTS=7"}
    wanted |= {"SURFACES=2", "CELLS"}
    wanted |= {f"INTEGRATOR={name}" for name in ("LINEAR", "AVERAGE", "SAMPLED", "PREINTEGRATED")}
    assert wanted <= set(run[0]["options"])


def test_no_invalid_access_and_no_race(run):
    found = Counter(
        f"{kind}, kernel {kernel}: {' | '.join(sorted(lines))}"
        for kind, kernel, lines in _reports(run[1])
        if "race" not in kind or lines not in HARMLESS
    )
    assert not found, "\n".join(f"{count} x {what}" for what, count in found.items())


def _reports(log: str) -> Iterator[tuple[str, str, frozenset[str]]]:
    """The kind of error, the kernel and the source lines of each report of Oclgrind."""
    for report in re.split(r"\n(?=\S)", "\n" + log):
        if report.strip():
            kind = report.strip().split(" at ")[0].splitlines()[0]
            kernel = re.search(r"Kernel: (\w+)", report)
            places = re.findall(r"At line (\d+) \(column \d+\) of (\S+):", report)
            lines = frozenset(_line(file, int(number)) for number, file in places)
            yield kind, kernel[1] if kernel else "?", lines


def _line(file: str, number: int) -> str:
    """A line of a kernel's source, without its comment."""
    source = KERNELS / file
    if not number or not source.exists():
        return f"{file}:{number}"
    return source.read_text(encoding="utf-8").splitlines()[number - 1].partition("//")[0].strip()


def _without_comments(source: Path) -> str:
    return re.sub(r"//[^\n]*", "", source.read_text(encoding="utf-8"))


# ---- the child


def main() -> None:

    kernels, options = set(), set()
    kernel = Device.kernel

    def recorded(self, source, name, **defines):
        launch = kernel(self, source, name, **defines)

        def record(size, *args, **keywords):
            if size:
                kernels.add(name)
                options.update(["", *defines, *(f"{k}={v}" for k, v in defines.items())])
            launch(size, *args, **keywords)

        return record

    Device.kernel = recorded
    use_primitives(open_device())
    scan_by_small_groups()
    device = open_device()
    voxelize_all(device)
    extract_surfaces(device)
    extract_sharp_field(device)
    colour_voxels(device)
    measure_wall_links(device)
    fill_voxels_in_part(device)
    dilate_voxels(device)
    label_parts(device)
    resample_voxels(device)
    measure_distances(device)
    bound_distances_of_meshes(device)
    find_faces_that_meet(device)
    orient_shells(device)
    unite_parts(device)
    wind_a_fan(device)
    build_fields(device)
    query_fields(device)
    combine_octrees(device)
    query_octrees(device)
    render_octrees(device)
    render_fields(device)
    render_volumes(device)
    check_device(device)
    print(json.dumps({"device": device.info.name, "kernels": [*kernels], "options": [*options]}))


def scan_by_small_groups() -> None:
    """Let devices opened from now on scan and sort by groups of 32 work-items. Of 256, which
    use_primitives has run, most would be idle here, and the simulator spends its time on them."""
    group, header = 32, "opencl/primitives.h"
    define = f"#define GROUP {primitives.GROUP:#x}\n"
    assert define in primitives.HEADERS[header]
    primitives.HEADERS[header] = primitives.HEADERS[header].replace(
        define, f"#define GROUP {group:#x}\n"
    )
    primitives.GROUP, primitives.BLOCK = group, group * primitives.ITEMS
    program.flatten.cache_clear()


def use_primitives(device) -> None:
    """Every primitive, over several work-groups, portions and passes."""
    values = np.arange(5000, dtype=np.uint32) % 7
    scanned = device.put(values)
    assert primitives.exclusive_scan(scanned, 4999) == values[:-1].sum()
    assert np.array_equal(scanned.get(), np.cumsum(values) - values)

    for dtype, bits, blocks in (
        (np.uint32, 15, False),
        (np.uint64, 42, False),
        (np.uint32, 7, True),
        (np.uint64, 3, True),
    ):
        keys = np.random.default_rng(1).integers(0, 1 << bits, 1001).astype(dtype)
        keys[::3] = keys[0]
        for numbers in (None, device.put(np.arange(1001, dtype=np.uint32))):
            array = device.put(keys)
            found, order = primitives.radix_sort(array, 1001, bits, numbers, blocks=blocks)
            assert np.array_equal(found.get(0, 1001), np.sort(keys))
            if order is not None:
                assert np.array_equal(order.get(0, 1001), np.argsort(keys, kind="stable"))
            distinct, _ = primitives.unique(found, 1001)
            assert np.array_equal(distinct.get(), np.unique(keys))

    buckets = np.arange(1001, dtype=np.uint32) % 3 // 2 * 5  # one of them small enough to insert
    buckets[::50] = 3
    _, _, order = primitives.bucket_sort(device.put(buckets), device.put(keys), 1001, 8)
    assert np.array_equal(order.get(), np.lexsort((keys, buckets)))


def voxelize_all(device) -> None:
    """Every mode and variant, on meshes that are closed and begin before the grid, that are open,
    and, for solids, so large that several rows' tiles pass through an inside leaf."""
    parts = (
        meshes.octahedron((12.5, 9, 10), 7),
        meshes.box((14, 11, 2), (27, 13, 6)),
        meshes.box((-9, 2, 3), (6, 11, 9.5)),
    )
    scenes = {
        "closed": (meshes.join(*parts), (30, 22, 17)),
        "open": (meshes.open_box((3.5, 4, 4), (20, 21, 13), missing=1), (30, 22, 17)),
        "coarse": (meshes.box((11, 12, 13), (46, 34, 35)), (47, 36, 36)),
    }
    for scene, ((vertices, faces), shape) in scenes.items():
        vertices = np.asarray(vertices, np.float64)
        mesh, grid = Mesh(vertices, faces.astype(np.int32)), Grid(shape, (0, 0, 0), (1, 1, 1))
        triangles = meshes.fixed(vertices)[faces]
        expected = {
            mode: oracles.to_dense(getattr(oracles, mode)(triangles, shape), shape)
            for mode in ("surface26", "surface6", "solid")
        }
        numbers = oracles.numbers(triangles, shape)
        for variant, decisions in VARIANTS.items():
            if variant == "blocked" and scene != "open":
                continue  # "all" has the blocks of the other scenes

            def voxelize(
                mode="solid", fill="parity", mesh=mesh, grid=grid, forced=decisions, **more
            ):
                job = plan_voxelize(mesh, grid, mode, fill=fill, device=device, **more)
                octree = job.with_(**forced).run()
                octree.validate()
                return octree.to_dense()

            for mode, voxels in expected.items():
                if mode == "solid" or scene != "coarse":
                    assert np.array_equal(voxelize(mode), voxels), (scene, variant, mode)
            with_surface = expected["solid"] | expected["surface26"]
            assert np.array_equal(voxelize(with_surface=True), with_surface), (scene, variant)
            assert np.array_equal(voxelize(fill="nonzero"), numbers != 0), (scene, variant)
            wound = voxelize(fill="winding")
            if scene == "open":  # the hole's cap bounds the solid
                assert wound[6:12, 7:18, 7:10].all()
                assert not wound[21:].any()
                crowded = voxelize(fill="winding", forced={"crowd": 0, **decisions})
                assert np.array_equal(crowded, wound)
            else:
                assert np.array_equal(wound, numbers > 0), (scene, variant)

    # a hole so wide that its middle is far from its edges
    vertices, faces = meshes.open_box((1.5, 1.5, 3), (30.5, 30.5, 10), missing=4)
    mesh, grid = Mesh(vertices, faces.astype(np.int32)), Grid((32, 32, 12), (0, 0, 0), (1, 1, 1))
    job = plan_voxelize(mesh, grid, fill="winding", device=device).with_(most_left=1.0)
    assert job.run().to_dense()[8:24, 8:24, 5:10].all()

    vertices, faces = meshes.open_box((2.5, 3.5, 2.5), (13.5, 12.5, 9.5), missing=4)
    mesh, grid = Mesh(vertices, faces.astype(np.int32)), Grid((16, 16, 12), (0, 0, 0), (1, 1, 1))
    surface = plan_voxelize(mesh, grid, "surface26", device=device).run().to_dense()
    flooded = plan_voxelize(mesh, grid, fill="flood", gap=2, device=device).run()
    assert np.array_equal(flooded.to_dense(), oracles.flood(surface, 2))
    vertices, faces = meshes.open_box((2.5, 2.5, 2.5), (6, 6, 68), missing=5)
    mesh, grid = Mesh(vertices, faces.astype(np.int32)), Grid((8, 8, 72), (0, 0, 0), (1, 1, 1))
    assert find_parts(mesh, mesh.vertices, find_boundary(mesh).edges, device).volumes > 0
    tall = plan_voxelize(mesh, grid, fill="flood", device=device)
    assert tall.with_(slabs=2).run().count == tall.run().count


def colour_voxels(device) -> None:
    """Colours and normals of two triangles, of which one has a texture and one has corners of
    three colours; parts that only touch, and parts of more texels than are integrated."""
    corners = [(1, 1, 2.5), (6.5, 1, 2.5), (1, 6, 2.5), (6.5, 1, 2.5), (6, 6, 4), (1, 6, 2.5)]
    uv = np.array([[(0, 0), (2, 0), (0, 2)], [(0, 0), (90, 0), (0, 90)]], float)
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 3, 4)
    for filter, wrap in (("linear", "mirror"), ("nearest", "clamp")):
        texture = Texture(pixels, (wrap, "repeat"), filter)
        look = Appearance(
            (Material("a", texture=texture),), np.array([0, 0], np.int32), uv, np.full((6, 4), 0.5)
        )
        mesh = Mesh(np.array(corners, float), np.arange(6, dtype=np.int32).reshape(2, 3),
                    appearance=look)  # fmt: skip
        grid = Grid((9, 8, 8), (0, 0, 0), (1, 1, 1))
        for colour, forced in itertools.product(COLOURS, (VARIANTS["narrow"], VARIANTS["all"])):
            inner = plan_voxelize(mesh, grid, "surface26", device=device)
            job = plan_attributes(inner, mesh, ("colour", "normal"), colour=colour)
            octree = job.with_(**forced).run()
            assert len(octree.attribute("colour").values) == octree.count > 0
            assert octree.attribute("normal").values.any()
    vertices, faces = meshes.box(1.7, 6.2)  # touches none of the 4 x 4 x 4 voxels in it
    look = Appearance(
        (Material("a", texture=texture),), np.zeros(12, np.int32), np.tile(uv[0], (12, 1, 1))
    )
    mesh = Mesh(np.asarray(vertices, float), faces.astype(np.int32), appearance=look)
    for colour in COLOURS:
        inner = plan_voxelize(mesh, grid, device=device)
        octree = plan_attributes(inner, mesh, ("colour", "normal"), colour=colour).run()
        assert len(octree.attribute("colour").values) == octree.count - 2**3 == 56


def fill_voxels_in_part(device) -> None:
    """Fractions of parts that begin before the grid, large ones in tiles, and of an open box; and
    surfaces of them."""
    parts = (meshes.octahedron((12.5, 9, 10), 7), meshes.box((-9, 2, 3), (3, 11, 9.5)))
    vertices, faces = meshes.join(*parts)
    vertices = np.asarray(vertices, np.float64)
    triangles = meshes.fixed(vertices)[faces]
    mesh, grid = Mesh(vertices, faces.astype(np.int32)), Grid((30, 22, 17), (0, 0, 0), (1, 1, 1))
    for variant in ("narrow", "all"):
        for fill in ("parity", "nonzero", "winding"):
            job = plan_fractions(mesh, grid, fill=fill, faces=fill != "parity", device=device)
            octree = job.with_(**VARIANTS[variant]).run()
            octree.validate()
        found = dense_of(octree)
        for cell in ((0, 5, 5), (2, 10, 9), (7, 8, 9), (12, 9, 16), (15, 12, 12)):
            assert abs(found[cell] - float(oracles.filled(triangles, cell))) < 1e-7, cell
    moved = replace(grid, shape=(13, 13, 9), origin=(0.0, 4.0, 4.0))  # begins within the mesh
    plan_fractions(mesh, moved, faces=True, device=device).run().validate()
    vertices, faces = meshes.open_box((3.5, 4, 4), (20, 21, 13), missing=1)
    mesh = Mesh(np.asarray(vertices, np.float64), faces.astype(np.int32))
    octree = plan_fractions(mesh, grid, device=device).run()
    assert stored_volume(octree) == 16.5 * 17 * 9
    for style in ("marching-cubes", "surface-nets"):
        surface = plan_extract(octree, style=style, device=device).run()
        found = check_surface(Mesh(surface.points / LATTICE, surface.faces), weld=False)
        assert found.watertight
        assert found.manifold


def dilate_voxels(device) -> None:
    """A dilation of voxels that are no cubes, over two tiles along x, a few tiles at a time."""
    dense = np.zeros((35, 5, 5), bool)
    dense[[2, 32], 4, 4] = dense[20, 2:4, 2] = True
    octree = Octree.from_dense(dense, pitch=(0.0625, 1, 1))
    job = plan_morph(octree, "dilate", 1.125, world=True, device=device).with_(batch=7)
    padded = np.pad(dense, 18)
    distance = np.asarray(ndimage.distance_transform_edt(~padded, sampling=octree.grid.pitch))
    assert job.run().count == np.count_nonzero(distance <= 1.125)


def label_parts(device) -> None:
    """Two solids that overlap, and their surfaces, of which areas decide."""
    grid = Grid((16, 12, 16), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    solids = [meshes.box(2.3, 7.6), meshes.octahedron(7.5, 3.2)]
    mesh = join([meshes.mesh_of(*solid) for solid in solids])
    for mode in ("solid", "surface26"):
        octree = plan_labels(mesh, grid, mode, labels="file", device=device).run()
        assert np.bincount(octree.attribute("label").values).all()


def resample_voxels(device) -> None:
    """Voxels of 3/2 over a full leaf, bricks, and what lies beyond the grid."""
    dense = np.random.default_rng(1).random((12, 9, 8)) < 0.5
    dense[:8, :8, :8] = True
    grid = Grid((8, 9, 5), (-1.5, 0, 1), (1.5, 1, 1.5))
    found = plan_resample(Octree.from_dense(dense), grid, threshold=1, device=device).run()
    inner = dense[:, :, 1:7].repeat(2, axis=0).repeat(2, axis=2)  # in halves of a voxel
    whole = inner.reshape(8, 3, 9, 4, 3).all(axis=(1, 4))
    assert np.array_equal(found.to_dense()[1:, :, :4], whole[:7])


def measure_distances(device) -> None:
    """Distances near to a mesh of several levels, and far away, and by every sign."""
    vertices, faces = meshes.torus(sides=(12, 6))
    faces = np.concatenate([faces, [(0, 0, 5), (7, 7, 7)]])
    mesh = Mesh(vertices, faces.astype(np.int32))
    measure = TriangleDistance(mesh, device)
    together = TriangleDistance(mesh, device, packets_from=1)
    signed = [SignedDistance(mesh, sign, device) for sign in ("pseudonormal", "winding")]
    for scale in (1, 100):
        points = scale * np.random.default_rng(1).uniform(-3, 3, (70, 3))
        distances = measure(points)
        assert np.array_equal(together(points), distances)
        assert np.allclose(distances, brute(points, vertices[faces]), rtol=1e-14, atol=1e-14)
        inside = winding(points, vertices[faces]) > 0.5
        for sign in signed:
            assert np.array_equal(sign(points), np.where(inside, -distances, distances))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signed_distance, "NUMBERED", 0)
        assert np.array_equal(signed[1](points), signed[0](points))
    many = np.repeat(points, 8, axis=0)  # 560 points are sorted
    located = signed[0](many, gradient=True, nearest=True, face=True)
    assert np.array_equal(located.distance[::8], signed[0](points))


def bound_distances_of_meshes(device) -> None:
    """A square, and another above it that is cut otherwise: pieces are within reach of a triangle,
    or are cut about one corner or two, or are halved."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.4, 0.3, 0)])
    fan = np.array([(i, (i + 1) % 4, 4) for i in range(4)], np.int32)
    two = Mesh(corners[:4], np.array([(0, 1, 2), (0, 2, 3)], np.int32))
    four = Mesh(corners + np.array([0, 0, 0.0625]), fan)
    found = hausdorff(two, four, 1e-6, device)
    assert found.a_to_b.pieces > 10
    assert found.upper - 1e-6 <= found.lower <= 0.0625 <= found.upper


def extract_surfaces(device) -> None:
    """Every style at every kind of level, of voxels that touch the border, with inside leaves."""
    dense = np.random.default_rng(3).random((17, 9, 9)) < 0.4
    dense[8:16, :8, :8] = True
    octree = octree_from_dense(dense)
    requests: tuple[dict[str, Any], ...] = (
        {"style": "marching-cubes", "level": 0},
        {"style": "marching-cubes", "level": 1},
        {"style": "marching-cubes"},
        {"style": "voxel-faces"},
        {"style": "voxel-faces", "level": 0, "merge": True},
        {},
        {"level": 0},
    )
    source = mesh_from_arrays(
        *meshes.box((1.25, 1.5, 1.75), (5.5, 6.25, 7.25))
    )  # not where all voxels are
    few = octree_from_dense(dense[5:10])  # each face is compared with all that are near
    jobs = [plan_extract(octree, device=device, **request) for request in requests]
    jobs.append(plan_extract(few, device=device, style="sharp", source=source))
    for request, job in zip((*requests, "sharp"), jobs, strict=True):
        surface = job.with_(relaxations=min(job.plan.relaxations, 2)).run()  # odd and even rounds
        mesh = Mesh(surface.points / LATTICE, surface.faces)
        found = check_surface(mesh, weld=False)
        assert len(surface.faces) > 0, request
        assert closed_chain(mesh) if surface.merged else found.watertight and found.manifold, found
    for forced in ({"naive": True}, {"compaction": "pyramid-4"}, {"compaction": "pyramid-5"}):
        assert jobs[0].with_(**forced).run().digest() == jobs[0].run().digest()
    dense = np.ones((24, 16, 16), bool)  # with full cells below the low sides of a window's cube
    dense[20, 3, 4] = False
    octree = octree_from_dense(dense)
    request: dict[str, Any] = {"style": "voxel-faces", "level": "voxel"}
    job = SurfaceWindowsJob(octree, plan_unread(octree, **request), device, None)
    job.plan = replace(job.plan, side=16)
    with Spool("-") as job.store:
        assert job.run().digest() == plan_extract(octree, device=device, **request).run().digest()


def extract_sharp_field(device) -> None:
    """The surface of a coarse field of a box that keeps its edges."""
    mesh = mesh_from_arrays(*meshes.box((0.1, 0.2, 0.3), (0.9, 0.7, 0.8)))
    field = build.build_adf(mesh, device, tolerance=2e-2, max_level=3, measure=False)
    surface = extract_field_surface(field, source=mesh, device=device)
    assert surface.check()["closed"]


def measure_wall_links(device) -> None:
    """Links to a box, whose places all are 3/4, in both widths of products."""
    mesh = meshes.mesh_of(*meshes.box(2.25, 4.75))
    grid = Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))
    few = Octree.from_voxels(np.indices((3, 3, 3)).reshape(3, -1).T + 2, grid)
    for wide in (False, True):
        links = plan_wall_links(few, mesh, device=device).with_(wide=wide).run()
        assert set(links.places[links.flags == CROSSED].tolist()) == {0.75}
        assert links.uncrossed == 0 < links.count


def find_faces_that_meet(device) -> None:
    """Faces that others pass, that share a corner or an edge with them, or that lie in a plane."""
    from spatial.test_self_intersections import meet

    flat = np.array([(20, 20, 17), (20, 22, 17), (20, 24, 17)]), np.array([(0, 1, 2)])
    fold = np.array([(5, 1, 1), (4, 0, 0), (4, 2, 0), (9, 9, 9)]), np.array([(0, 1, 2), (0, 3, 2)])
    other = meshes.tetrahedron((2, 2, 2), (9, 3, 2), (3, 9, 3), (2, 3, 9))
    vertices, faces = meshes.join(meshes.tetrahedron(), other, meshes.octahedron(20, 3), flat, fold)
    mesh = Mesh(vertices.astype(np.float64), faces.astype(np.int32))
    found = find_self_intersections(
        device, mesh, build_tree(device, mesh, pseudonormals(mesh).flat)
    )
    met = [
        any(meet(vertices[f], vertices[g]) for g in np.delete(faces, i, axis=0))
        for i, f in enumerate(faces)
    ]
    assert np.array_equal(found, met)
    assert 0 < np.count_nonzero(found) < len(faces)


def unite_parts(device) -> None:
    """Parts that cross, and one inside out; rows that are crossed before points."""
    boxes = [meshes.box(low, low + 4) for low in (0, 2, 9)]
    shells = [*boxes[:2], (boxes[2][0], boxes[2][1][:, ::-1])]
    mesh = meshes.mesh_of(*meshes.join(*shells))
    inside = inside_of_closed(mesh, device)
    assert inside is not None
    assert inside.why == "2 parts overlap; 1 part is inside out, and turned outward"
    points = np.array([(3.1, 3.2, 3.3), (1.1, 1.2, 1.3), (10.1, 10.2, 10.3), (20.0, 1.0, 1.0)])
    signs = [SignedDistance(mesh, rule, device)(points) < 0 for rule in ("parity", "nonzero")]
    assert [found.tolist() for found in signs] == [
        [False, True, True, False], [True, True, True, False],
    ]  # fmt: skip


def orient_shells(device) -> None:
    inner = meshes.box(8, 9)
    mesh = meshes.mesh_of(*meshes.join(meshes.octahedron(8, 8), (inner[0], inner[1][:, ::-1])))
    mesh = replace(mesh, faces=np.concatenate([mesh.faces[:5, ::-1], mesh.faces[5:]]))
    assert np.flatnonzero(orient(mesh, device).reversed).tolist() == [0, 1, 2, 3, 4]


def wind_a_fan(device) -> None:
    """A fan and a book, each with two levels of bundles and a leaf that is not full."""
    vertices, faces = crowds.fan(70)
    _, q, r = vertices[faces].transpose(1, 0, 2)
    points = np.array([(0, 0, -5), (0.3, 0.2, 0.3), (0, 0, 0.5), (1, 1, 1.0), (0.01, 0, 0)])
    order = device.put(np.arange(len(points), dtype=np.uint32))
    spine, signs = np.array([0.1, 0.2, -1]), np.ones((70, 1)) * (1, 0, 0)
    book = np.stack([0 * q, 0 * q + spine, q], axis=1)
    for fan, triangles in (
        (fan_of(vertices[0], 0 * spine, q, r - q, device), vertices[faces]),
        (fan_of(vertices[0], spine, q, signs, device), book),
    ):
        numbers = device.zeros(len(points), np.float64)
        fan.add_numbers(len(points), device.put(points), order, numbers)
        assert np.allclose(numbers.take(), winding(points, triangles), rtol=0, atol=4e-3)


def build_fields(device) -> None:
    """Distances without sign, by pseudo-normals and by winding numbers; of meshes that are closed,
    open, so that signs are in doubt near the hole, and with faces that have no side."""
    ball, lidless = meshes.octahedron(0, 2), meshes.open_box(0, (4, 3, 2))
    flat = ball[0], np.concatenate([ball[1], [(0, 0, 2), (1, 1, 1)]])
    scenes = {"ball": ball, "box without lid": lidless, "with flat faces": flat}
    for name, sign, continuous, more in (
        ("ball", "none", True, {"max_bytes": 3000, "max_level": 3}),
        ("ball", "pseudonormal", False, {}),
        ("with flat faces", "pseudonormal", False, {}),
        ("box without lid", "pseudonormal", True, {}),
        ("with flat faces", "winding", True, {}),
        ("box without lid", "winding", False, {}),
    ):
        vertices, faces = scenes[name]
        mesh = Mesh(vertices.astype(np.float64), faces.astype(np.int32))
        request = {"tolerance": 1e-3, "max_level": 2, "measure": False, **more}
        field = build.build_adf(mesh, device, sign=sign, continuous=continuous, **request)
        field.validate()
        levels, cells = cells_of(field)
        unit = (cells[:, None] + HALVES / 2) * np.exp2(-levels)[:, None, None]
        points = np.array(field.origin) + field.side * unit.reshape(-1, 3)
        triangles = vertices[faces]
        distances = brute(points, triangles)
        numbers = winding(points, triangles)
        certain = np.abs(numbers - 0.5) > 0.02
        certain &= distances > 1e-9
        stored = field.voxels.ravel() * field.side
        if not continuous:
            assert np.allclose(np.abs(stored), distances, rtol=1e-6, atol=1e-9), (name, sign)
            inside = (numbers > 0.5) & (sign != "none")
            # Oclgrind 21.10 makes 255 of what is true in a vector, where it should be 1: some edges
            # get the normal of another part of their face
            assert np.mean(((stored < 0) == inside)[certain]) > 0.95, (name, sign)


def query_fields(device) -> None:
    """Every search, for every answer, by fields with identifiers of either size and hashes with
    and without a fourth channel; one point or several at a time."""
    from adf.queries.test_query import EVERYTHING, equal, spike, with_w

    points = np.random.default_rng(1).uniform(-0.1, 1.1, (40, 3))
    points[3] = np.nan
    textures.TOP_LEVEL = 2  # a table of 64 cells, and most points are in cells below it
    shapes = textures.GPU, textures.Shape(16, 32, 2, 2), textures.Shape(1, 1, 3, 4)
    deep = plain_field(lambda p: spike(p) / 32, 0.2 / 32, 13)  # of less than 2 sides
    fields = [plain_field(sphere, 1e-2, 4), with_w(deep, 40)]
    for shape in shapes:
        for field in fields:
            ask = query.FieldQuery(field, device, shape=shape, host_points=0)
            for search in query.SEARCHES:
                for asked in ({}, EVERYTHING):
                    equal(ask(points, search=search, **asked), field.query(points, **asked))
    ask = query.FieldQuery(fields[0], device, sampler="hardware")
    exact = fields[0].query(points)
    assert np.allclose(ask(points).distance, exact.distance, atol=5e-3, equal_nan=True)
    inner = points[((points > 0) & (points < 1)).all(axis=1)]
    for run in text_peers.Peers(fields[0], device).ways(inner).values():
        assert np.array_equal(run()[0], fields[0].query(inner).distance)
    codes = np.arange(40, dtype=np.uint64) << np.uint64(31)
    found = (text_peers.decode(codes, device, by_table) for by_table in (False, True))
    assert np.array_equal(*found)


def two_views(size: tuple[int, int]) -> list[Any]:
    """Rays to the box from -1 to 1, orthographic ones and others."""
    return [Camera.fit((-1, -1, -1), (1, 1, 1), "iso", fov=fov).rays(*size) for fov in (None, 40)]


def check_device(device) -> None:
    """The kernels that only the selftest has."""
    arithmetic.COUNT = 200
    assert arithmetic.integers.run(device).passed
    for name in arithmetic.REALS:
        values, rows = arithmetic.operands(name, 200), arithmetic.ROUNDED
        found, expected = arithmetic.compute(device, name, *values), arithmetic.computed(*values)
        assert arithmetic.differing(found[rows], expected[rows]) == 0
    ends = np.geomspace(1e-3, 10, 8).astype(np.float32)
    volumes.weights(device, ends, ends, lanes=1)  # as above


def combine_octrees(device) -> None:
    """Octrees of three levels, by or and by exclusive or."""
    rng = np.random.default_rng(3)
    arrays = [np.kron(rng.random((4, 4, 4)) < 0.4, np.ones((4, 4, 4), bool)) for _ in range(3)]
    arrays[0] ^= rng.random(arrays[0].shape) < 0.01
    octrees = [octree_from_dense(array) for array in arrays]
    a, b, c = arrays
    assert np.array_equal(combine(octrees, "difference", device=device), a & ~(b | c))
    assert np.array_equal(combine(octrees, "xor", device=device), a ^ b ^ c)


def query_octrees(device) -> None:
    """Voxels and nodes of level 1 at all voxels of an octree, and beside its grid; nearest ones."""
    dense = np.random.default_rng(4).random((13, 10, 9)) < 0.3
    octree = octree_from_dense(dense)
    places = np.stack(np.indices((14, 11, 10)), axis=-1)
    points = octree.grid.to_world(places.reshape(-1, 3) + 0.5)
    found = OctreeQuery(octree, 1, device)(points)
    expected = np.pad(dense, [(0, 1)] * 3)
    assert np.array_equal(found.contains.reshape(expected.shape), expected)
    few = OctreeQuery(octree, device=device, nearest=True)(points[::31])
    assert few.distance is not None
    assert np.array_equal(few.distance < 0.05, expected.ravel()[::31])


def render_octrees(device) -> None:
    """Voxels and nodes, and where rays meet them; one ray at a time: of several Oclgrind 21.10
    spoils the masks, as below."""
    dense = np.random.default_rng(4).random((13, 10, 9)) < 0.3
    octree = octree_from_dense(dense)
    octree = replace(octree, grid=Grid(octree.grid.shape, (-1, -1, -1), (0.16, 0.16, 0.16)))
    for rays in two_views((11, 9)):
        for level in ("voxel", 0, 1):
            picture = cast(octree, rays, level=level, device=device, lanes=1)
            met = np.isfinite(depths(octree, rays, level=level, device=device, lanes=1))
            assert np.array_equal(picture[..., 3] > 0, met)
            assert 10 < np.count_nonzero(picture[..., 3]) < picture[..., 3].size
    octree = attributed()
    for rays in two_views((11, 9)):
        how: dict[str, Any] = {"device": device, "lanes": 1}
        plain = cast(octree, rays, **how)
        found = cast_attribute(octree, rays, "label", **how)
        assert np.array_equal(found[..., 3], plain[..., 3])


def render_fields(device) -> None:
    """A ball; one ray at a time: of several Oclgrind 21.10 spoils the masks, as below."""
    field = plain_field(sphere, 1e-2, 4, origin=(-1.0, -1.0, -1.0), side=2.0)
    textures.TOP_LEVEL = 1  # most leaves are in cells below it
    for rays in two_views((9, 7)):
        picture = FieldScene(field, lanes=1).draw(rays, device)
        assert set(np.unique(picture[..., 3])) == {0, 1}
        for search in query.SEARCHES:
            found = FieldScene(field, search=search).draw(rays, device)
            assert np.array_equal(found, picture)


def render_volumes(device) -> None:
    """Both methods from outside and inside, by every integrator, of every layout, with cells that
    are left out; one ray at a time: of several Oclgrind 21.10 spoils the masks, as above."""
    shape = (2, 2, 3)
    points, corners = grid_points(shape) / (np.array(shape) / 2) - 1, grid_corners(shape)
    cells, scalars = corners[:, SIX].reshape(-1, 4), points @ (0.1, 0.2, 1.0)
    mesh = tet_mesh(points, cells, scalars)
    hexahedra, _ = boxes(points, shape, np.linspace(-1, 1, len(corners)))
    shown = ramp(-1.5, 1.5, 2.0)
    part = replace(shown, extinctions=shown.extinctions * (0, 0, 1, 1))
    views = [*two_views((6, 5)), Camera((0.1, 0.2, 0.3), (0, 1, -0.4), fov=100.0).rays(6, 5)]
    constant = build_tet(hexahedra, device=device)  # split
    assert (constant.noun, constant.constant) == ("tetrahedra", True)
    for layout in ("raycast", "projection", "hexahedra"):
        volume = build_tet(hexahedra if layout == "hexahedra" else mesh, layout, device=device)
        for rays, method in itertools.product(views, METHODS):
            picture = draw(volume, rays, part, device, method, lanes=1)
            assert picture.any()
            if layout != "hexahedra":
                error = np.abs(picture - reference_picture(mesh, part, rays))
                assert error.max() < 2e-5, (layout, method)
                surfaces = {"isovalues": (-0.5, 0.3), "opacity": 0.5, "lanes": 1}
                shaded = draw(volume, rays, part, device, method, **surfaces)
                assert (shaded[..., 3] >= picture[..., 3] - 1e-6).all()
                assert (shaded != picture).any()
                steep = replace(part, extinctions=50 * part.extinctions)
                assert draw(volume, rays, steep, device, method, **surfaces).any()
        for integrator, method in itertools.product(
            ("average", "sampled:2", "preintegrated"), METHODS
        ):
            # a small table, which takes no minutes here
            how = {"lanes": 1, "table": (6, 4)}
            found = draw(volume, views[1], shown, device, method, integrator, **how)
            assert np.isfinite(found).all()


if __name__ == "__main__":
    main()
