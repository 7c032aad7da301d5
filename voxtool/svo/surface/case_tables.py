"""The cases of a cube whose corners are inside or outside, derived rather than copied.

Corner j of a cube lies at (j & 1, j >> 1 & 1, j >> 2 & 1), as in a brick; bit j of a case is 1
where corner j is inside. Edge 4 a + k runs along axis a from the corner whose coordinates on the
two other axes, in rising order, are the bits of k; face 2 a + s lies at coordinate s of axis a.

On each face the surface leaves segments between cut edges, which join to loops around the cube, a
polygon each. A face whose inside corners are diagonal is ambiguous, and separates its inside
corners. This rule depends on the face alone, so the two cubes of a face always agree, and the
surface is closed for any corners; with tables that complement cases it is not [Duerst 1988].

Primal, marching cubes [Lorensen 1987]: each loop is cut into triangles. No diagonal lies in a face,
because the cube beyond the face might use the same one; so each edge has two triangles.

Dual [Nielson 2004]: each loop is a vertex, each cut edge a quad. Where both cubes of an ambiguous
face pass through it twice with one loop, edges of quads would coincide. There, and only there, both
cubes join the inside corners instead [Wenger 2013, section 3.5]: `ALTERNATIVE`. All such cubes have
one ambiguous face, so the choice concerns no other.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np

from voxtool.morton import morton_encode
from voxtool.opencl import program
from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS

CASES = 256
MAX_LOOPS = 4  # of a case
ALTERNATIVE = 256  # added to a case whose ambiguous face joins its inside corners
MAX_TRIANGLES = 5
CORNERS_ALONG = BRICK_SIDE + 1  # of the cubes of a tile
TILE_EDGES = 3 * CORNERS_ALONG**3  # from these corners
CELLS_ALONG = BRICK_SIDE + 2  # of a tile, and beside it
NEAR_CELLS = CELLS_ALONG**3
NO_FACE = 6
NO_EDGE = 255
# A step of a loop in 16 bits: the mask of its edge, the places of the face and of the edge beyond
# it, and the bit of a loop's last.
STEP_EDGE, STEP_FACE, STEP_ACROSS, STEP_LAST = 15, 4, 7, 1 << 11

Loop = list[int]  # the cut edges that it passes, counter-clockwise seen from outside the surface


NEXT = [(1 << (axis + 1) % 3, 1 << (axis + 2) % 3) for axis in range(3)]  # bits of the other axes
# The four corners of each face, counter-clockwise seen from outside the cube.
FACES = [
    face
    for axis, (b, c) in enumerate(NEXT)
    for face in ([0, c, b | c, b], [corner | 1 << axis for corner in (0, b, b | c, c)])
]
# The two corners of each edge, the low one first.
EDGES = [(j, j | 1 << axis) for axis in range(3) for j in range(8) if not j >> axis & 1]
EDGE_OF = {pair: e for e, (u, v) in enumerate(EDGES) for pair in ((u, v), (v, u))}
FACES_OF = [{f for f in range(6) if {*EDGES[e]} <= {*FACES[f]}} for e in range(12)]


def is_ambiguous(case: int, face: int) -> bool:
    """Return True if the inside corners of a face are diagonal."""
    a, b, c, d = (case >> corner & 1 for corner in FACES[face])
    return a == c != b == d


def segments(case: int, face: int, join: bool = False) -> list[tuple[int, int]]:
    """Return the segments of a face, from cut edge to cut edge: one around each run of inside
    corners or, with `join`, of outside ones."""
    ring = FACES[face]
    inside = [case >> corner & 1 for corner in ring]
    found = []
    for i in range(4):
        if inside[i] == join and inside[(i + 1) % 4] != join:  # a run begins
            k = (i + 1) % 4
            while inside[(k + 1) % 4] != join:
                k = (k + 1) % 4
            first = EDGE_OF[ring[i], ring[(i + 1) % 4]]
            last = EDGE_OF[ring[k], ring[(k + 1) % 4]]
            found.append((last, first) if join else (first, last))
    return found


@cache
def loops(case: int, joined: int = NO_FACE) -> list[Loop]:
    """Return the loops of a case, whose face `joined` joins its inside corners."""
    following = dict(s for f in range(6) for s in segments(case, f, f == joined))
    found: list[Loop] = []
    while following:
        edge = min(following)
        loop = []
        while edge in following:
            loop.append(edge)
            edge = following.pop(edge)
        found.append(loop)
    return found


@cache
def _triangulations(first: int, last: int) -> list[list[tuple[int, int, int]]]:
    """Return all ways to cut the polygon of places first .. last into triangles."""
    if last - first < 2:
        return [[]]
    return [
        [*left, *right, (first, k, last)]
        for k in range(first + 1, last)
        for left in _triangulations(first, k)
        for right in _triangulations(k, last)
    ]


@cache
def _diagonal_cost(first: int, second: int) -> float:
    """Return the squared distance of the middles of two edges, infinite if they share a face."""
    if FACES_OF[first] & FACES_OF[second]:
        return np.inf
    u, v = ([sum(j >> a & 1 for j in EDGES[e]) for a in range(3)] for e in (first, second))
    return sum((p - q) ** 2 for p, q in zip(u, v, strict=True))


def triangulate(loop: Loop) -> list[tuple[int, int, int]]:
    """Return the triangles of a loop, without diagonals in a face, whose squared diagonals have the
    least sum where all edges are cut in the middle."""
    n = len(loop)

    def cost(triangles: list[tuple[int, int, int]]) -> float:
        sides = (pair for triangle in triangles for pair in combinations(triangle, 2))
        return sum(_diagonal_cost(loop[u], loop[v]) for u, v in sides if v - u not in (1, n - 1))

    best = min(_triangulations(0, n - 1), key=cost)
    assert cost(best) < np.inf
    return [(loop[i], loop[j], loop[k]) for i, j, k in best]


def pinched_face(case: int) -> int:
    """Return the ambiguous face that one loop passes twice, or NO_FACE: no case has two."""
    for face in range(6):
        edges = {edge for segment in segments(case, face) for edge in segment}
        if is_ambiguous(case, face) and any(edges <= {*loop} for loop in loops(case)):
            return face
    return NO_FACE


def triangle_table() -> np.ndarray:
    """Return the edges of the triangles of each case, (256, 15) uint8; NO_EDGE beyond the last."""
    table = np.full((CASES, 3 * MAX_TRIANGLES), NO_EDGE, np.uint8)
    for case in range(CASES):
        edges = [e for loop in loops(case) for triangle in triangulate(loop) for e in triangle]
        table[case, : len(edges)] = edges
    return table


def loop_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the loop that passes each edge, and the face on which it goes on from there, (512, 12)
    uint8 each; NO_EDGE where it is not cut. Cases from ALTERNATIVE on join their pinched face."""
    loop_of = np.full((2 * CASES, 12), NO_EDGE, np.uint8)
    face_of = np.full((2 * CASES, 12), NO_EDGE, np.uint8)
    for case in range(CASES):
        for row, joined in ((case, NO_FACE), (case + ALTERNATIVE, pinched_face(case))):
            face_from = {s: f for f in range(6) for s in segments(case, f, f == joined)}
            for number, loop in enumerate(loops(case, joined)):
                for segment in zip(loop, loop[1:] + loop[:1], strict=True):
                    loop_of[row, segment[0]] = number
                    face_of[row, segment[0]] = face_from[segment]
    return loop_of, face_of


def loop_steps() -> np.ndarray:
    """Return the edges of each case, by loop, (512, 12) uint16: the edge, the face on which the
    loop goes on from there, the number of the edge in the cube beyond the face, and whether the
    loop ends; 0 after the last."""
    loop_of, face_of = loop_tables()
    steps = np.zeros(loop_of.shape, np.uint16)
    for case, (loop, face) in enumerate(zip(loop_of.tolist(), face_of.tolist(), strict=True)):
        order = sorted((n, edge) for edge, n in enumerate(loop) if n != NO_EDGE)
        for place, (n, edge) in enumerate(order):
            last = place + 1 == len(order) or order[place + 1][0] != n
            across = edge_across(face[edge], edge)
            steps[case, place] = (
                edge | face[edge] << STEP_FACE | across << STEP_ACROSS | last * STEP_LAST
            )
    return steps


def surroundings() -> np.ndarray:
    """Return the neighbours of the vertex of each loop, (512, MAX_LOOPS) uint16: their number and,
    from bits 4, 8 and 12 on, by how many more of them lie in a cube above than below along x, y and
    z, plus 8; 0 beyond the last loop."""
    loop_of, face_of = loop_tables()
    found = np.zeros((2 * CASES, MAX_LOOPS), np.uint16)
    for loop in range(MAX_LOOPS):
        count = (loop_of == loop).sum(axis=1)
        about = count.copy()
        for axis in range(3):
            below, above = (
                ((loop_of == loop) & (face_of == 2 * axis + side)).sum(axis=1) for side in (0, 1)
            )
            about |= above - below + 8 << 4 + 4 * axis
        found[:, loop] = np.where(count, about, 0)
    return found


def edge_across(face: int, edge: int) -> int:
    """Return the number that an edge of a face has in the cube beyond the face."""
    low, high = EDGES[edge]
    return EDGE_OF[low ^ 1 << face // 2, high ^ 1 << face // 2]


def edge_around() -> np.ndarray:
    """Return the number that an edge along each axis has in the four cubes around it, (3, 4) uint8,
    from that before it along the two next axes (modulo 3) on, counter-clockwise."""
    table = np.zeros((3, 4), np.uint8)
    for axis, (b, c) in enumerate(NEXT):
        for place, low in enumerate((b | c, c, 0, b)):
            table[axis, place] = EDGE_OF[low, low | 1 << axis]
    return table


def _header(constants: dict[str, int], tables: dict[str, np.ndarray]) -> str:
    lines = [program.c_constants(**constants)]
    for name, table in tables.items():
        values = ", ".join(map(str, table.ravel().tolist()))
        kind = "uchar" if table.max() < 256 else "ushort"
        lines.append(f"__constant {kind} {name}[{table.size}] = {{{values}}};")
    return "\n".join(lines)


def _primal_header() -> str:
    """Return the tables of marching cubes as OpenCL constants.

    The edges along x, y and z from the corners of a tile's cubes are numbered by the corner, in
    rows, then by the axis. PLACE is the number of the first edge from the low corner of each cube,
    TILE_BEYOND that from each corner of the tile, and TILE_TOP the cube below this corner;
    TRIANGLES has the edges of a case, from PLACE of its cube on.
    """
    steps = 3 * CORNERS_ALONG ** np.arange(3)
    low_corner, axis = np.array(EDGES)[:, 0], np.arange(12) // 4
    number = _bits(low_corner) @ steps + axis
    triangles = triangle_table()
    tables = {
        "TRIANGLE_COUNT": np.count_nonzero(triangles != NO_EDGE, axis=1) // 3,
        "TRIANGLES": np.where(triangles == NO_EDGE, 0, number[np.minimum(triangles, 11)]),
        "PLACE": BRICK_VOXELS.astype(int) @ steps,
        "TILE_BEYOND": BRICK_SIDE * _bits(np.arange(8)) @ steps,
        "TILE_TOP": morton_encode((BRICK_SIDE - 1) * _bits(np.arange(8))),
    }
    constants = {"MAX_TRIANGLES": MAX_TRIANGLES, "TILE_EDGES": TILE_EDGES,
                 "CORNERS_ALONG": CORNERS_ALONG}  # fmt: skip
    return _header(constants, tables)


def _bits(corners: np.ndarray) -> np.ndarray:
    """Return the coordinates of corners of a cube, (N, 3)."""
    return corners[:, None] >> np.arange(3) & 1


def _dual_header() -> str:
    """Return the tables of the dual styles as OpenCL constants.

    The cells of a tile and those around it are numbered in rows; PLACE is the number of each cell
    of the tile.
    """
    loop_of, _ = loop_tables()
    tables = {
        "PINCHED_FACE": np.array([pinched_face(case) for case in range(CASES)]),
        "LOOP_COUNT": (loop_of + np.uint8(1)).max(axis=1),  # NO_EDGE + 1 is 0
        "LOOP_OF": loop_of,
        "EDGE_COUNT": np.count_nonzero(loop_of != NO_EDGE, axis=1),
        "BEYOND_COUNT": sum(
            np.maximum((loop_of == n).sum(axis=1), 4) - 4 for n in range(MAX_LOOPS)
        ),
        "LOOP_STEPS": loop_steps(),
        "AROUND": surroundings(),
        "EDGE_AROUND": edge_around(),
        "EDGE_CORNER": np.array(EDGES)[:, 0],
        "PLACE": (BRICK_VOXELS.astype(int) + 1) @ CELLS_ALONG ** np.arange(3),
    }
    constants = {
        "CELLS_ALONG": CELLS_ALONG, "NEAR_CELLS": NEAR_CELLS,
        "ALTERNATIVE": ALTERNATIVE, "NO_EDGE": int(NO_EDGE), "NO_FACE": NO_FACE,
        "STEP_EDGE": STEP_EDGE, "STEP_FACE": STEP_FACE, "STEP_ACROSS": STEP_ACROSS,
        "STEP_LAST": STEP_LAST, "MAX_LOOPS": MAX_LOOPS,
    }  # fmt: skip
    return _header(constants, tables)


HEADERS = {
    "svo/surface/case_tables.h": _primal_header(),
    "svo/surface/dual_case_tables.h": _dual_header(),
}
