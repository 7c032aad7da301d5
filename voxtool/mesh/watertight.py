"""A test on a device for watertight meshes, in linear time: sorting the edges on the host takes
several times as long.

A hash table tells which vertices are at bit-equal positions. Sides that run to the higher one of
their ends are listed at the lower one; every other side marks the one to which it runs back. If
each finds one of its own, and all are marked, they form pairs. Where chains in the table or lists
are so long that this is slow, as at the apex of a large fan, the host decides. Kernels:
kernels/mesh/watertight.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.mesh import topology
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Array, Device, program

SOURCE = "mesh/watertight.cl"
MOST_PROBES = 64  # of a chain in the table
MOST_SIDES = 256  # at a vertex
BATCH = 8  # vertices or faces of a work-item
LIST = 8  # numbers of a position's list: in half a line of the cache, a count and 7 sides
MARK = 1 << 31  # vertices have 31 bits
MOST_FACES = 1 << 30  # whose sides 32-bit numbers count
HEADERS = {
    "mesh/watertight.h": program.c_constants(
        MOST_PROBES=MOST_PROBES, MOST_SIDES=MOST_SIDES, LIST=LIST, MARK=MARK, BATCH=BATCH
    )
}


def watertight(mesh: Mesh, device: Device, most_faces: int = MOST_FACES) -> bool:
    """Return TopologyCheck.watertight of a mesh; the host decides for more than `most_faces`."""
    count, n = len(mesh.faces), len(mesh.vertices)
    if not 0 < count <= most_faces:
        return topology.watertight(mesh)
    faces, points = device.view(mesh.faces.ravel()), device.view(mesh.vertices.ravel())
    first, sure = merge_vertices(device, points, n)
    if not sure:
        return topology.watertight(mesh)
    unsure, is_open, some = (device.zeros(1, np.uint32) for _ in range(3))
    sides = {
        "lists": device.zeros(LIST * n, np.uint32),
        "heads": device.zeros(n, np.uint32),
        "more": device.empty(6 * count, np.uint32),
    }
    of = {"n": count, "faces": faces, "first": first, **sides}
    items = -(-count // BATCH)
    device.kernel(SOURCE, "list_sides")(items, **of)
    device.kernel(SOURCE, "mark_sides")(items, open=is_open, unsure=unsure, **of)
    device.kernel(SOURCE, "check_sides")(n, open=is_open, some=some, **sides)
    if unsure.take()[0]:
        return topology.watertight(mesh)
    return bool(some.take()[0]) and not is_open.take()[0]


def merge_vertices(device: Device, points: Array, n: int) -> tuple[Array | None, bool]:
    """Return the same number for all vertices at a position, (n,) uint32: one of them; None if no
    two of them have one position. Also return False if a chain in the table was too long to
    tell."""
    mask = (1 << (2 * n - 1).bit_length()) - 1
    table, first = device.zeros(mask + 1, np.uint32), device.empty(n, np.uint32)
    merged, unsure = (device.zeros(1, np.uint32) for _ in range(2))
    device.kernel(SOURCE, "merge_vertices")(
        -(-n // BATCH), points, table, mask, first, merged, unsure, n=n
    )
    return first if merged.take()[0] else None, not unsure.take()[0]
