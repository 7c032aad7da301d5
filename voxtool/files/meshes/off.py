"""OFF text to arrays: counts, a line for each vertex, and a line for each polygon.

Colours, normals and texture coordinates, which may follow on a line, are ignored.
"""

from __future__ import annotations

import re

import numpy as np

from voxtool.errors import MeshError
from voxtool.files.storage.numbers import blocks_of, check_lines, rows_in, triangles_in, vertices_in
from voxtool.mesh.mesh import check_complete, check_promised

HEAD = re.compile(rb"\s*(?:ST)?C?N?OFF\s+(\d{1,20})[ \t]+(\d{1,20})(?:[ \t]+\d+)?[ \t\r]*(?:\n|$)")


def parse(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of an OFF.

    MeshError names the line. Polygons become fans of triangles.
    """
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    check_lines(name, data)
    head = HEAD.match(data)
    if head is None:
        raise MeshError(
            f"{name}: not readable as OFF: it does not begin with OFF and the numbers of vertices "
            "and faces: export it again"
        )
    wanted = int(head[1]), int(head[2])
    check_promised(name, *wanted, len(data))
    points, corners, vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0, 0
    line = data.count(b"\n", 0, head.end()) + 1
    for block in blocks_of(data, head.end()):
        rows = rows_in(name, block, line)
        split = min(wanted[0] - vertices, len(rows.first))
        end = min(split + wanted[1] - faces, len(rows.first))
        points.append(vertices_in(name, rows.part(0, split)))
        corners.append(triangles_in(name, wanted[0], rows.part(split, end)))
        vertices, faces = vertices + split, faces + end - split
        line += block.count(b"\n")
    check_complete(name, (vertices, faces), wanted)
    return np.concatenate(points), np.concatenate(corners)
