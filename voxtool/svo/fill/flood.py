"""The flood rule: a voxel is inside if the outside cannot reach it.

The surface is "surface26": no path through voxels that share a face, an edge or a corner passes it.
The outside consists of the voxels that such paths reach from beyond the grid. The flood works on
the octree: a leaf without surface voxels is one node of a graph, and so is every connected
component of the free voxels of a brick. Nodes that touch are united [Jaiganesh 2018]; the component
of a far corner is outside.

With a gap of N voxels, the outside first stays ceil(N / 2) voxels away from the surface, so that it
does not pass openings of up to N voxels. Then it grows by the same number of steps, so that closing
gaps does not thicken the solid. Kernels: kernels/svo/fill/flood.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.morton import morton_decode
from voxtool.opencl import Array, Device, program
from voxtool.svo.build import DeviceOctree, build_octree
from voxtool.svo.fill.dilation import dilate, grow_outside, reached_nodes
from voxtool.svo.fill.rows import unite_nodes
from voxtool.svo.layout import BRICK, descend, voxels_within
from voxtool.svo.prune import EMPTY, FULL, REFINED

SOURCE = "svo/fill/flood.cl"
PARTS = 8  # components that the voxels of a brick can have
NOTHING = 0xFFFFFFFF  # beyond the octree
HEADERS = {
    "svo/fill/flood.h": program.c_constants(
        PARTS=PARTS, NOTHING=NOTHING, EMPTY=EMPTY, FULL=FULL, REFINED=REFINED
    )
}


def flood(
    device: Device,
    nodes: np.ndarray,
    surface: np.ndarray,
    side: int,
    shape: tuple[int, int, int],
    gap: int,
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Return the octree of the voxels that the outside cannot reach, including the surface: the
    codes of the refined nodes by level, from level 1 up, the states of all nodes by level, and the
    masks of the bricks.

    `nodes` holds the ascending Morton codes of the level-1 nodes with surface voxels, and `surface`
    the (8 n,) masks of their bricks. The outside does not pass openings of up to `gap` voxels.
    """
    steps = -(-gap // 2)
    top = (side // 8).bit_length()  # the root's level
    if not len(nodes):
        root = np.full(1, EMPTY, np.uint8)
        return [nodes] * top, [root[:0]] * (top - 1) + [root], surface
    around = np.uint64(7 << 3 * (top - 1))  # the grid becomes cube (1, 1, 1) of 4 x 4 x 4
    nodes = own = nodes.astype(np.uint64) | around
    codes, n, barrier = device.put(own), len(own), device.view(surface)
    if steps:
        codes, n = reached_nodes(codes, n, barrier, steps, bits=3 * (top + 1))
    tree = build_octree(device, 4 * side, codes, n)
    beside = _beside(tree)
    if steps:
        nodes, walls = _level_codes(tree, 1), barrier
        barrier = device.zeros(8 * n, BRICK)
        unite_nodes(walls, np.searchsorted(nodes, own).astype(np.uint32), barrier)
        barrier = dilate(tree, beside, barrier, steps)
    all_states, outside = _reach(tree, beside, barrier)
    outside = grow_outside(tree, beside, all_states, barrier, outside, steps)

    every, lists, states = all_states.take(), [], []
    for level in range(1, top + 1):
        shift = np.uint64(3 * (top - level))
        codes, refined = (_level_codes(tree, n) for n in (level + 1, level))
        first = int(tree.offsets[tree.top - level])
        within = descend(codes) >> shift == 7
        states.append(every[first : first + len(within)][within])
        lists.append(refined[refined >> shift == 7] ^ (np.uint64(7) << shift))
    inside = ~outside.take()[np.repeat(nodes >> np.uint64(3 * (top - 1)) == 7, 8)]
    return lists, states, inside & voxels_within(morton_decode(descend(lists[0])), shape)


def _level_codes(tree: DeviceOctree, level: int) -> np.ndarray:
    """Return the ascending Morton codes of the refined nodes of a level."""
    refined = tree.refined[level - 1]
    return refined.codes.get(0, refined.n)


def _beside(tree: DeviceOctree) -> Array:
    """Return what lies around each refined level-1 node, (27 n,) uint32."""
    device, level1 = tree.nodes.device, tree.refined[0]
    beside = device.empty(27 * level1.n, np.uint32)
    find_beside = tree.kernel(SOURCE, "find_beside")
    offsets = device.put(tree.offsets)
    find_beside(level1.n, tree.nodes, offsets, tree.top, level1.codes, beside)
    return beside


def _reach(tree: DeviceOctree, beside: Array, barrier: Array) -> tuple[Array, Array]:
    """Return what the outside reaches: (coarse nodes,) uint8 states, and the (bricks,) masks of
    free voxels."""
    device, n, coarse = tree.nodes.device, barrier.size, int(tree.offsets[-2])
    offsets, roots = device.put(tree.offsets), device.empty(coarse + PARTS * n, np.uint32)
    parts, outside = device.empty(PARTS * n, BRICK), device.empty(n, BRICK)
    tree.kernel(SOURCE, "number_nodes")(roots.size, roots)
    tree.kernel(SOURCE, "split_bricks")(n, barrier, parts)
    for level in range(1, tree.top):
        above = tree.refined[level]
        link_leaves = tree.kernel(SOURCE, "link_leaves")
        link_leaves(8 * above.n, tree.nodes, offsets, tree.top, level, above.codes, roots)
    tree.kernel(SOURCE, "link_parts")(n, beside, parts, coarse, roots)
    refined = _level_codes(tree, tree.top - 1)[-1] == 7  # the root's last child, in a far corner
    out = int(tree.offsets[3 if refined else 2]) - 1  # a leaf beyond the grid
    tree.kernel(SOURCE, "collect_outside")(n, parts, coarse, out, roots, outside)
    states = device.empty(coarse, np.uint8)
    tree.kernel(SOURCE, "state_nodes")(coarse, tree.nodes, out, roots, states)
    return states, outside
