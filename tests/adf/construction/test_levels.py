"""Distances in single precision, by which fields are built, against those in double precision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import meshes

from voxtool.adf.construction.stages import narrow_triangles
from voxtool.mesh.mesh import Mesh
from voxtool.spatial.bvh import build_tree

if TYPE_CHECKING:
    from voxtool.opencl import Device

BOTH = """
#include "adf/construction/lists.h"
#include "adf/construction/narrow.h"

// For each slot: distances from the corners of a cube, by triangles that fill all lanes, by sixteen
// that have a lane each, and in double precision; and the doubt.
__kernel void both(const uint n, __global const double *leaves, __global const float *narrow,
                   __global const double *cubes, __global float *alone, __global float *together,
                   __global double *exact, __global float *doubts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    scene_of_lists scene;
    scene.leaves = leaves, scene.narrow = narrow;
    const float3 centre = convert_float3(vload3(0, cubes + 4 * gid));
    const double edge = cubes[4 * gid + 3];
    const double8 x = centre.x + edge * (vload8(0, CELL) - 0.5);
    const double8 y = centre.y + edge * (vload8(0, CELL + POINTS) - 0.5);
    const double8 z = centre.z + edge * (vload8(0, CELL + 2 * POINTS) - 0.5);
    const float8 nx = convert_float8(x - centre.x), ny = convert_float8(y - centre.y);
    const float8 nz = convert_float8(z - centre.z);
    ways way;
    MASKS feature;
    narrow_ways narrow_way;
    int16 narrow_feature;
    const triangle t = one_triangle(leaves + (size_t)(gid / LEAF) * (FIELDS * LEAF), gid % LEAF);
    vstore8(sqrt(triangle_ways(&t, x, y, z, &way, &feature)), gid, exact);
    const narrow_triangles one = one_narrow(&scene, gid, centre, (float)edge);
    const float16 square = narrow_squares(&one, (float16)(nx, nx), (float16)(ny, ny),
                                          (float16)(nz, nz), &narrow_way, &narrow_feature);
    vstore8(sqrt(square.lo), gid, alone);
    doubts[gid] = one.doubt.s0;
    uint slots[16];
    for (uint i = 0; i < 16; ++i)
        slots[i] = (gid + 7 * i) % n;
    const narrow_triangles sixteen = sixteen_narrow(&scene, slots, centre, (float)edge);
    float xs[8], ys[8], zs[8], own[16];
    vstore8(nx, 0, xs), vstore8(ny, 0, ys), vstore8(nz, 0, zs);
    for (uint i = 0; i < 8; ++i) {
        const float16 squares =
            narrow_squares(&sixteen, xs[i], ys[i], zs[i], &narrow_way, &narrow_feature);
        vstore16(sqrt(squares), 0, own);
        together[8 * gid + i] = own[0];
    }
}
"""


@pytest.mark.parametrize("depth", [0, 8, 18])
def test_single_precision_is_as_near_as_it_says(device: Device, depth: int) -> None:
    n = 4000
    triangles = meshes.hard_triangles(n)
    tree = build_tree(
        device, Mesh(triangles.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3))
    )
    rng = np.random.default_rng(depth)
    own = tree.frame.local(triangles)[tree.face_of.get()]
    weights = rng.dirichlet(np.ones(3), len(own))
    far = rng.uniform(-1, 1, (len(own), 3)) * np.exp2(-rng.integers(0, depth + 1, (len(own), 1)))
    cubes = np.empty((len(own), 4))
    cubes[:, :3] = ((weights[:, :, None] * own).sum(axis=1) + far).clip(-1.1, 1.1)
    cubes[:, 3] = 2.0**-depth
    alone, together = (device.empty(8 * n, np.float32) for _ in range(2))
    exact, doubts = device.empty(8 * n, np.float64), device.empty(n, np.float32)
    both = device.kernel(BOTH, "both")
    narrow = narrow_triangles(tree)
    both(n, tree.leaves, narrow, device.put(cubes), alone, together, exact, doubts)
    wrong = np.abs(alone.get().astype(np.float64) - exact.get()).reshape(-1, 8).max(axis=1)
    share = wrong / doubts.get()
    assert (share < 1).all()
    assert share.max() > 1 / 64  # and not much better
    assert (alone.get() == together.get()).all()
