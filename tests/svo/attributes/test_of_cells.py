"""Attributes of cells above voxels, against plain sums of all voxels in Python's numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed, scattered, sizes

from voxtool.mesh.srgb import linear_table
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.octree.attributes import KINDS, Attribute
from voxtool.svo.octree.octree import Octree


def voxels_of(octree: Octree, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The values of all voxels of the octree's cube, which are set, and which have their own."""
    side, attribute = octree.grid.side, octree.attribute(name)
    values = np.zeros((side,) * 3 + attribute.values.shape[1:], attribute.values.dtype)
    is_set, own = np.zeros((2, side, side, side), bool)
    rest, leaves = list(attribute.values), list(attribute.leaves)
    for level in octree.levels():
        for node, corner in enumerate(level.cells):
            if level.number and level.inside[node]:
                box = tuple(slice(c, c + level.side) for c in corner)
                is_set[box], own[box] = True, bool(len(attribute.leaves)) or attribute.masks is None
                values[box] = leaves.pop(0) if leaves else attribute.blank
            for bit in range(0 if level.number else 64):
                at = tuple(
                    c + (bit >> axis & 1) + 2 * (bit >> axis + 3 & 1)
                    for axis, c in enumerate(corner)
                )
                if not int(octree.bricks[node]) >> bit & 1:
                    continue
                is_set[at], values[at] = True, attribute.blank
                if int(attribute.held(octree.bricks)[node]) >> bit & 1:
                    own[at], values[at] = True, rest.pop(0)
    assert not rest
    assert not leaves
    return values, is_set, own


def nearest_level(light: int) -> int:
    """The level of sRGB nearest to linear light in 2**-24, by floating-point numbers."""
    x = light / 2**24
    return round(255 * (12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055))


def half_up(mean: Fraction) -> int:
    return int(mean + Fraction(1, 2))


def expected(attribute: Attribute, values: np.ndarray, is_set: Any, own: Any) -> Any:
    """The value of a cell by the rules, of its voxels."""
    name, kind = attribute.name, attribute.values.dtype
    if not is_set.any():
        return np.zeros_like(attribute.blank)
    if name == "label":
        votes = Counter(values[is_set].tolist())
        return min(votes, key=lambda label: (-votes[label], label))
    if name == "fraction":
        if kind.kind != "f":
            return half_up(Fraction(sum(values[is_set].tolist()), is_set.size))
        return sum(Fraction(round(float(v) * 2**24), 2**24) for v in values[is_set]) / is_set.size
    if name == "faces":
        return [face_of(values[..., f], is_set, f // 2, -(f % 2)) for f in range(6)]
    if not own.any():
        return attribute.blank
    rows = values[own]
    if name == "area":
        unit = 2**24 / float(attribute.values.max())
        return sum(round(float(v) * unit) for v in rows) / unit
    if name == "normal":
        x, y, z = (sum(round(float(v) * 2**24) for v in column) for column in rows.T)
        length = float(x * x + y * y + z * z) ** 0.5
        return np.array([x, y, z]) / (length or 1)
    light = [[int(linear_table()[v]) for v in row[:3]] for row in rows]
    colour = [nearest_level(sum(column) // len(rows)) for column in zip(*light)]  # noqa: B905
    return [*colour, half_up(Fraction(sum(rows[:, 3].tolist()), len(rows)))]


def face_of(values: np.ndarray, is_set: np.ndarray, axis: int, at: int) -> Fraction | int:
    """The share of a face of a cell, of those of its voxels."""
    shares, held = values.take(at, axis), is_set.take(at, axis)
    if values.dtype.kind != "f":
        return half_up(Fraction(sum(shares[held].tolist()), held.size))
    return sum(Fraction(round(float(v) * 2**24), 2**24) for v in shares[held]) / Fraction(held.size)


def whole_faces() -> Octree:
    octree, rng = scattered(), np.random.default_rng(5)
    voxels, leaves = sizes(octree)
    values = [rng.integers(0, 256, (n, 6)).astype(np.uint8) for n in (voxels, leaves)]
    return replace(octree, attributes=(Attribute("faces", *values),))


def whole_numbers() -> Octree:
    octree, rng = scattered(), np.random.default_rng(3)
    voxels, leaves = sizes(octree)
    values = [rng.integers(0, 256, n).astype(np.uint8) for n in (voxels, leaves)]
    return replace(octree, attributes=(Attribute("fraction", *values),))


def few_colours() -> Octree:
    """Colours of some voxels alone, with a default that the others have."""
    octree = attributed()
    masks = octree.attribute("normal").masks
    assert masks is not None
    count = int(np.bitwise_count(masks).sum())
    values = np.random.default_rng(4).integers(0, 256, (count, 4)).astype(np.uint8)
    none = np.empty((0, 4), np.uint8)
    colour = Attribute("colour", values, none, masks, (9, 8, 7, 255))
    return replace(octree, attributes=(colour,))


@pytest.mark.parametrize(
    ("octree", "name"),
    [(attributed, name) for name in KINDS]
    + [(whole_numbers, "fraction"), (whole_faces, "faces"), (few_colours, "colour")],
)
def test_cells_have_the_values_of_the_rules(octree: Any, name: str) -> None:
    tree = octree()
    attribute = tree.attribute(name)
    values, is_set, own = voxels_of(tree, name)
    assert np.array_equal(is_set[tuple(map(slice, tree.grid.shape))], tree.to_dense())
    for size in (0, 1, 2, 3, 4, 6):
        cells = CellValues(tree, name, size)
        side = 1 << size
        found = cells.of_cells(tree.depth - 1, np.zeros(1, np.int64))[0]
        some = np.random.default_rng(5).permutation(len(found))[:400]
        for code, value in zip(some.tolist(), found[some], strict=True):
            corner = [
                side * sum((code >> 3 * b + axis & 1) << b for b in range(6)) for axis in range(3)
            ]
            box = tuple(slice(c, c + side) for c in corner)
            wanted = expected(attribute, values[box], is_set[box], own[box])
            if attribute.values.dtype.kind == "f" and size:
                assert np.allclose(value, np.array(wanted, float), rtol=1e-6, atol=1e-7)
            elif attribute.values.dtype.kind != "f":
                assert np.array_equal(value, wanted)
            else:
                assert np.array_equal(value, values[box].reshape(value.shape))


def test_nodes_of_all_levels_are_those_of_one() -> None:
    octree = attributed()
    for name in KINDS:
        cells = CellValues(octree, name, 0)
        for number, values in enumerate(cells.of_all_nodes()):
            assert np.array_equal(values, cells.of_nodes(number))


def test_leaves_are_found_around_nodes() -> None:
    octree = attributed()
    cells = CellValues(octree, "label", 0)
    for level in octree.levels():
        if level.number and level.inside.any():
            codes = level.codes[level.inside]
            below = (codes << np.uint64(3 * level.number)) + np.uint64(5)
            values = cells.around(codes, level.number)
            assert np.array_equal(cells.around(below, 0), values)
            assert len(values) == level.inside.sum()
