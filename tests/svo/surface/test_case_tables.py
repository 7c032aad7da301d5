"""The cases of a cube: loops, triangles and pinched faces, all 256 of them."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np

from voxtool.svo.surface import case_tables as cases

ALL_CASES = range(cases.CASES)


def corner(j: int) -> np.ndarray:
    return np.array([j & 1, j >> 1 & 1, j >> 2 & 1])


def middle(edge: int) -> np.ndarray:
    low, high = cases.EDGES[edge]
    return (corner(low) + corner(high)) / 2


def test_neighbours_of_a_vertex_are_those_of_its_steps() -> None:
    found = cases.surroundings()
    for row, steps in enumerate(cases.loop_steps().tolist()):
        about = np.array([0, 8, 8, 8])
        loop = 0
        for step in steps:
            if not step:
                break
            face = step >> cases.STEP_FACE & 7
            about[0] += 1
            about[1 + face // 2] += 1 if face % 2 else -1
            if step & cases.STEP_LAST:
                assert found[row, loop] == about @ (1, 16, 256, 4096), (row, loop)
                about, loop = np.array([0, 8, 8, 8]), loop + 1
        assert not found[row, loop:].any()


def cut_edges(case: int) -> set[int]:
    return {e for e, (u, v) in enumerate(cases.EDGES) if (case >> u ^ case >> v) & 1}


def variants(case: int) -> list[int]:
    """Return the faces at which a case may be joined: none, and its pinched one."""
    return sorted({cases.NO_FACE, cases.pinched_face(case)}, reverse=True)


def test_edges_and_faces_of_a_cube() -> None:
    assert len(set(cases.EDGES)) == 12
    for edge, (low, high) in enumerate(cases.EDGES):
        assert high - low == 1 << edge // 4
        assert len(cases.FACES_OF[edge]) == 2
    for face, ring in enumerate(cases.FACES):
        points = [corner(j) for j in ring]
        assert all(p[face // 2] == face % 2 for p in points)
        outward = np.cross(points[1] - points[0], points[2] - points[1])
        assert outward[face // 2] == (1 if face % 2 else -1)


def test_loops_pass_every_cut_edge_once() -> None:
    for case, joined in [(c, joined) for c in ALL_CASES for joined in variants(c)]:
        loops = cases.loops(case, joined)
        passed = [edge for loop in loops for edge in loop]
        assert len(passed) == len(set(passed))
        assert set(passed) == cut_edges(case)
        for loop in loops:
            assert len(loop) >= 3
            for first, second in pairwise([*loop, loop[0]]):
                assert cases.FACES_OF[first] & cases.FACES_OF[second]


def test_both_cubes_of_a_face_have_its_segments_in_opposite_directions() -> None:
    for case in ALL_CASES:
        for axis in range(3):
            bit = 1 << axis
            beyond = sum((case >> (j ^ bit) & 1) << j for j in range(8) if not j & bit)
            for rest in (0, 0xFF):
                other = beyond | sum(rest & 1 << j for j in range(8) if j & bit)
                for join in (False, True):
                    here = cases.segments(case, 2 * axis + 1, join)
                    there = cases.segments(other, 2 * axis, join)
                    face = 2 * axis + 1
                    moved = {tuple(cases.edge_across(face, e) for e in s[::-1]) for s in here}
                    assert moved == set(there)


def test_an_ambiguous_face_separates_its_inside_corners() -> None:
    face = next(f for f in range(6) if {0, 3} <= {*cases.FACES[f]})
    case = 1 << 0 | 1 << 3
    assert cases.is_ambiguous(case, face)
    assert len(cases.loops(case)) == 2
    assert len(cases.loops(case, face)) == 1
    assert not any(cases.is_ambiguous(0b1111, f) for f in range(6))


def test_triangles_fill_the_loops_and_face_outside() -> None:
    for case, row in enumerate(cases.triangle_table()):
        edges = row[row != cases.NO_EDGE].reshape(-1, 3)
        loops = cases.loops(case)
        assert len(edges) == sum(len(loop) - 2 for loop in loops) <= cases.MAX_TRIANGLES
        sides = Counter((a, b) for t in edges.tolist() for a, b in pairwise([*t, t[0]]))
        border = {s for s in sides if s[::-1] not in sides}
        assert set(sides.values()) <= {1}
        assert border == {s for loop in loops for s in pairwise([*loop, loop[0]])}, case
        for a, b in set(sides) - border:  # a diagonal in a face might be the neighbour's, too
            assert not cases.FACES_OF[a] & cases.FACES_OF[b]
        for a, b, c in edges:
            normal = np.cross(middle(b) - middle(a), middle(c) - middle(a))
            assert normal.any()
            if case.bit_count() == 1:  # away from the corner
                assert normal @ (middle(a) - corner(case.bit_length() - 1)) > 0


def test_pinched_cases_have_one_ambiguous_face() -> None:
    pinched = [case for case in ALL_CASES if cases.pinched_face(case) != cases.NO_FACE]
    assert len(pinched) == 36
    for case in pinched:
        assert [f for f in range(6) if cases.is_ambiguous(case, f)] == [cases.pinched_face(case)]


def test_no_loop_passes_a_face_twice_once_pinched_faces_are_joined() -> None:
    for case in ALL_CASES:
        face = cases.pinched_face(case)
        joined = cases.loops(case, face)
        if face != cases.NO_FACE:
            assert len(joined) == len(cases.loops(case)) + 1
        for f in range(6):
            if cases.is_ambiguous(case, f) and f == face:
                ends = [set(s) for s in cases.segments(case, f, join=True)]
                assert not any(ends[0] | ends[1] <= {*loop} for loop in joined)


def test_loop_tables_follow_the_loops() -> None:
    loop_of, face_of = cases.loop_tables()
    for case in ALL_CASES:
        alternative = case + cases.ALTERNATIVE, cases.pinched_face(case)
        for row, joined in ((case, cases.NO_FACE), alternative):
            loops = cases.loops(case, joined)
            assert {e for e in range(12) if loop_of[row, e] != cases.NO_EDGE} == cut_edges(case)
            for number, loop in enumerate(loops):
                assert {e for e in range(12) if loop_of[row, e] == number} == {*loop}
                for first, second in pairwise([*loop, loop[0]]):
                    face = int(face_of[row, first])
                    assert face in cases.FACES_OF[first] & cases.FACES_OF[second]
                    assert (first, second) in cases.segments(case, face, face == joined)
