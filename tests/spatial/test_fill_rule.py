"""Closed parts that overlap, nest or repeat: what is inside, against another algorithm."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import meshes
from helpers.parts import check_scene, random_scene

import voxtool
from voxtool.distances import plan_distance, plan_field
from voxtool.grid import Grid
from voxtool.repairing.job import plan_repair
from voxtool.spatial.fill_rule import inside_of_closed
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device


def boxes(*parts: tuple[float, float, bool]) -> Mesh:
    """Cubes about the origin moved along x: half of the side, the move, and whether inside out."""
    found = []
    for half, move, inverted in parts:
        vertices, faces = meshes.box(-half, half)
        found.append((vertices + np.multiply(move, (1, 0.1, 0.2)), faces[:, :: 1 - 2 * inverted]))
    return meshes.mesh_of(*meshes.join(*found))


@pytest.mark.parametrize("block", range(5))
def test_random_scenes_are_the_union_of_their_parts(block: int, device: Device) -> None:
    for seed in range(40 * block, 40 * (block + 1)):
        check_scene(random_scene(np.random.default_rng(seed)), seed, device, field=seed % 20 == 0)


CUBE, LARGE = (1.0, 0.0, False), (2.0, 0.0, False)


@pytest.mark.parametrize(
    ("parts", "fill", "simple", "why"),
    [
        ([CUBE], "parity", True, ""),
        ([(1.0, 0.0, True)], "parity", True, "it is inside out, and turned outward"),
        ([CUBE, (1.0, 0.7, False)], "winding", False, "2 parts overlap"),
        ([CUBE, LARGE], "winding", False, "2 parts overlap"),
        ([(1.0, 0.0, True), LARGE], "parity", True, ""),
        ([CUBE, (2.0, 0.0, True)], "parity", True, "it is inside out, and turned outward"),
        ([CUBE, (1.0, 5.0, True)], "parity", True, "1 part is inside out, and turned outward"),
        ([CUBE, CUBE], "winding", False, "2 parts overlap or repeat one another"),
        # one touches the other's wall from within: no row sees another number
        ([LARGE, (1.0, 1.0, True)], "winding", False, "it touches or intersects itself"),
    ],
)  # fmt: skip
def test_decisions(parts: list, fill: str, simple: bool, why: str, device: Device) -> None:
    mesh = boxes(*parts)
    found = inside_of_closed(mesh, device)
    assert found is not None
    assert (found.fill, found.simple, found.why) == (fill, simple, why)
    assert bool(found.oriented) == ("inside out" in why)


def test_a_gap_is_no_overlap(device: Device) -> None:
    for gap in (1e-6, 1e-12):
        assert inside_of_closed(boxes(CUBE, (1.0, 2 + gap, False)), device).simple


def test_closed_by_index(device: Device) -> None:
    """Two boxes that share an edge by position, one of them inside out."""
    one, other = meshes.box(0.0, 1.0), meshes.box([1.0, 1, 0], [2.0, 2, 1])
    mesh = meshes.mesh_of(*meshes.join(one, (other[0], other[1][:, ::-1])))
    found = inside_of_closed(mesh, device)
    assert found is not None
    assert found.oriented is not None
    assert (plan_distance(mesh, device=device).run()([[0.5] * 3, [1.5, 1.5, 0.5]]) < 0).all()
    assert inside_of_closed(meshes.mesh_of(*meshes.open_box(0.0, 1.0)), device) is None


def test_commands_agree_on_points(device: Device) -> None:
    """The post in a ball: distances at points and on a grid, a field, an octree, and a repair."""
    post = meshes.box([-0.3, -0.3, -1.5], [0.3, 0.3, 1.5])
    mesh = meshes.mesh_of(*meshes.join(meshes.icosphere(2), post))
    point = [[0.01, 0.02, 0.03]]
    assert plan_distance(mesh, device=device).run()(point)[0] < 0
    assert plan_field(mesh, max_level=4, device=device).run().query(point).distance[0] < 0
    grid = Grid.fit(mesh, 32)
    job = plan_voxelize(mesh, grid, device=device)
    octree = job.run()
    assert octree.contains(point)[0]
    assert "their union is filled (parity would differ in" in job.notes(octree)[0]
    assert job.doubts(octree) == job.notes(octree)
    assert octree.plan["inside"]["parts"] == 2
    parity = voxelize(mesh, grid, fill="parity", device=device)
    assert octree.count - parity.count == octree.plan["inside"]["voxels_parity_differs"]
    distances = voxtool.distance_grid(mesh, grid, device=device)
    assert np.count_nonzero(distances < 0) == octree.count
    assert plan_repair(mesh, grid, device=device).run().voxels == octree.count


@pytest.mark.parametrize("fill", ["parity", "nonzero", "winding"])
def test_rules_mean_the_same_for_points_and_voxels(fill: str, device: Device) -> None:
    """Closed parts, inside out or not, and an open mesh along rows."""
    scenes = [random_scene(np.random.default_rng(seed)).mesh for seed in range(4)]
    scenes += [meshes.mesh_of(*meshes.open_box(0.0, 4.0, missing=side)) for side in (1, 4)]
    for mesh in scenes:
        grid = Grid.fit(mesh, 16)
        octree = voxelize(mesh, grid, fill=fill, device=device)
        measure = plan_distance(mesh, fill=fill, device=device).run()
        centres = grid.to_world(np.indices(grid.shape).reshape(3, -1).T + 0.5)
        distances = measure(centres)
        clear = np.abs(distances) > grid.pitch[0] / 50
        assert np.array_equal((distances < 0)[clear], octree.contains(centres)[clear])


def test_only_overlaps_that_a_row_sees_change_the_rule(device: Device) -> None:
    """Boxes that overlap by a hundredth of a voxel: parity, the same digest as of parity."""
    mesh = boxes(CUBE, (1.0, 1.9995, False))
    grid = Grid.fit(mesh, 16)
    octree = voxelize(mesh, grid, device=device)
    assert octree == voxelize(mesh, grid, fill="parity", device=device)


def test_a_plan_settles_before_it_is_printed(device: Device) -> None:
    job = plan_voxelize(boxes(CUBE, LARGE), Grid((32, 32, 32), (-3.0,) * 3, (0.2,) * 3))
    assert (job.plan.fill, job.plan.checked) == ("parity", True)
    job.settle()
    assert (job.plan.fill, job.plan.checked) == ("winding", False)
    assert job.differing == 1000


def test_a_mesh_is_freed_with_what_was_decided(device: Device) -> None:
    import gc
    import weakref

    mesh = replace(boxes(CUBE, LARGE))
    assert inside_of_closed(mesh, device)
    kept = weakref.ref(mesh)
    del mesh
    gc.collect()
    assert kept() is None
