"""Whether a mesh is watertight, on a device: in linear time, where sorting its edges on the host
takes several times as long.

A hash table merges vertices at bit-equal positions. Sides that run to the higher one of their ends
are listed at the lower one; every other side marks the one to which it runs back. If all find one,
all are marked, and there are as many of both kinds, they form pairs. Where chains in the table or
lists are so long that this is slow, as at the apex of a large fan, the host decides. Kernels:
kernels/mesh/watertight.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.mesh import topology
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device, program
from voxtool.opencl.primitives import exclusive_scan

SOURCE = "mesh/watertight.cl"
NOTHING = 0xFFFFFFFF  # an empty slot of the table
MOST_PROBES = 64  # of a chain in the table
MOST_SIDES = 256  # at a vertex
MARK = 1 << 31  # vertices have 31 bits
MOST_FACES = 1 << 29  # whose sides 32-bit numbers count
HEADERS = {
    "mesh/watertight.h": program.c_constants(
        NOTHING=NOTHING, MOST_PROBES=MOST_PROBES, MOST_SIDES=MOST_SIDES, MARK=MARK
    )
}


def watertight(mesh: Mesh, device: Device, most_faces: int = MOST_FACES) -> bool:
    """Return TopologyCheck.watertight of a mesh; the host decides for more than `most_faces`."""
    count, n = len(mesh.faces), len(mesh.vertices)
    if not 0 < count <= most_faces:
        return topology.watertight(mesh)
    faces, points = device.view(mesh.faces.ravel()), device.view(mesh.vertices.ravel())
    mask = (1 << (2 * n - 1).bit_length()) - 1
    table, first = device.put(np.full(mask + 1, NOTHING, np.uint32)), device.empty(n, np.uint32)
    unsure, is_open, degenerate = (device.zeros(1, np.uint32) for _ in range(3))
    device.kernel(SOURCE, "merge_vertices")(n, points, table, mask, first, unsure)
    places = device.zeros(n + 1, np.uint32)
    list_sides = device.kernel(SOURCE, "list_sides")
    list_sides(count, faces, first, places, None, degenerate)
    total = exclusive_scan(places, n)
    paired = total > 0 and 2 * total == 3 * (count - int(degenerate.take()[0]))
    if paired:
        sides = device.empty(total, np.uint32)
        list_sides(count, faces, first, places, sides, device.zeros(1, np.uint32))
        device.kernel(SOURCE, "mark_sides")(count, faces, first, places, sides, is_open, unsure)
        device.kernel(SOURCE, "check_sides")(total, sides, is_open)
    if unsure.take()[0]:
        return topology.watertight(mesh)
    return paired and not is_open.take()[0]
