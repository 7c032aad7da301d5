"""The counts of a mesh's edges, shells and others on a device: sorting the edges on the host takes
several times as long.

Every side of a face is listed at the lower of its two positions. The list of a position, sorted by
the other ends, has the faces of each of its edges side by side. Where lists are so long that this
is slow, as at the apex of a large fan, the host counts. Kernels: kernels/mesh/counts.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.mesh import topology
from voxtool.mesh.collinear import collinear
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import TopologyCheck
from voxtool.mesh.watertight import MOST_SIDES, merge_vertices
from voxtool.mesh.watertight import SOURCE as MERGING
from voxtool.opencl import Device, program
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import SCAN, exclusive_scan

SOURCE = "mesh/counts.cl"
PROGRAMS: list[Request] = [(MERGING, {}), (SCAN, {}), (SOURCE, {})]
MOST_FACES = 1 << 29  # whose sides 31 bits count
POSITIONS = 16  # of a work-item
# The sums over edges, and their number.
VERTICES, EDGES, ODD, BOUNDARY, NONMANIFOLD, INCONSISTENT, DUPLICATE, UNITED, SUMS = range(9)
HEADERS = {
    "mesh/counts.h": program.c_constants(
        MOST_SIDES=MOST_SIDES,
        POSITIONS=POSITIONS,
        SUMS=SUMS,
        VERTICES=VERTICES,
        EDGES=EDGES,
        ODD=ODD,
        BOUNDARY=BOUNDARY,
        NONMANIFOLD=NONMANIFOLD,
        INCONSISTENT=INCONSISTENT,
        DUPLICATE=DUPLICATE,
        UNITED=UNITED,
    )
}


def check_topology(mesh: Mesh, device: Device, most_faces: int = MOST_FACES) -> TopologyCheck:
    """Return topology.check_topology of a mesh; the host counts for more than `most_faces`, and
    on devices without double precision."""
    count, n = len(mesh.faces), len(mesh.vertices)
    if not (0 < count <= most_faces and device.info.fp64):
        return topology.check_topology(mesh)
    faces, points = device.view(mesh.faces.ravel()), device.view(mesh.vertices.ravel())
    first, sure = merge_vertices(device, points, n)
    if not sure:
        return topology.check_topology(mesh)
    of = {"n": count, "faces": faces, "first": first}
    ends, used = device.zeros(n + 1, np.uint32), device.zeros(n, np.uint32)
    roots, flat = device.empty(count, np.uint32), device.empty(count, np.uint8)
    device.kernel(SOURCE, "count_sides")(
        count, points=points, counts=ends, used=used, roots=roots, flat=flat, **of
    )
    total = exclusive_scan(ends, n)
    sides, items = device.empty(total, np.uint64), -(-n // POSITIONS)
    device.kernel(SOURCE, "list_sides")(count, ends=ends, sides=sides, **of)
    sums, unsure = device.empty(SUMS * items, np.uint32), device.zeros(1, np.uint32)
    device.kernel(SOURCE, "count_edges")(
        items, faces=faces, first=first, positions=n, ends=ends, used=used, sides=sides,
        roots=roots, sums=sums, unsure=unsure,
    )  # fmt: skip
    if unsure.take()[0]:
        return topology.check_topology(mesh)
    found = sums.take().reshape(-1, SUMS).sum(axis=0).tolist()
    proper, maybe = total // 3, mesh.faces[flat.take() != 0]
    return TopologyCheck(
        faces=count,
        vertices=n,
        closed=found[ODD] == 0 < proper,
        even=found[ODD] == 0,
        boundary_edges=found[BOUNDARY],
        nonmanifold_edges=found[NONMANIFOLD],
        inconsistent_edges=found[INCONSISTENT],
        duplicate_faces=found[DUPLICATE],
        degenerate_faces=count - proper + int(collinear(mesh.vertices[maybe]).sum()),
        shells=proper - found[UNITED],
        euler=found[VERTICES] - found[EDGES] + proper,
    )
