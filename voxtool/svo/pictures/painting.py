"""Colours of voxels by their attributes, for pictures and pages.

Colours are those of sRGB, as pictures write what is computed without a gamma; labels have the
palette; a normal is (n + 1) / 2 as red, green and blue; a fraction is a ramp from EMPTY to WHOLE. A
cube without colour (opacity 0) or normal (0 0 0) has the colour of octrees without attributes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from voxtool.choices import COLOUR_BY, NONE
from voxtool.errors import VoxtoolError
from voxtool.morton import morton_encode
from voxtool.palette import palette
from voxtool.svo.attributes.of_cells import BRICKS, CellValues
from voxtool.svo.attributes.of_points import values_of_voxels
from voxtool.svo.cells.counts import BRICK_POWER
from voxtool.svo.octree.attributes import BITS, Attribute
from voxtool.svo.octree.layout import BRICK, INSIDE
from voxtool.svo.octree.octree import Octree

BY_DEFAULT = ("colour", "label")
EMPTY, WHOLE = (0.15, 0.2, 0.45), (1.0, 0.9, 0.5)  # of fractions: dark blue, pale yellow


def painted(content: Any, colour_by: str | None) -> str:
    """Return the attribute that gives voxels their colours, or ""."""
    if colour_by is not None:
        return "" if colour_by == NONE else colour_by
    there = [one.name for one in getattr(content, "attributes", ())]
    return next((name for name in BY_DEFAULT if name in there), "")


def check_painting(content: Any, colour_by: str | None) -> None:
    """Raise VoxtoolError if an octree has no such attribute."""
    if colour_by in (None, NONE):
        return
    if colour_by not in COLOUR_BY:
        raise VoxtoolError(f"colour by {colour_by!r}: choose one of {', '.join(COLOUR_BY)}")
    if not isinstance(content, Octree):
        raise VoxtoolError(f"merged subtrees have no attribute {colour_by!r}: voxelize with it")
    content.attribute(colour_by)


def colours_of_values(
    attribute: Attribute, values: np.ndarray, plain: Sequence[float]
) -> np.ndarray:
    """Return the colours of values of an attribute, (n, 3) float32 from 0 to 1."""
    name, without = attribute.name, np.zeros(len(values), bool)
    if name == "label":
        found = palette(max(len(attribute.names), 1))[values] / np.float32(255)
    elif name == "colour":
        found, without = values[:, :3] / np.float32(255), values[:, 3] == 0
    elif name == "normal":
        found = np.float32(0.5) + np.float32(0.5) * values
        without = (values == 0).all(axis=1)
    else:
        whole = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
        share = (values / np.float32(whole)).astype(np.float32)[:, None]
        low, high = np.array([EMPTY, WHOLE], np.float32)
        found = low + share * (high - low)
    found = found.astype(np.float32)
    found[without] = np.array(plain, np.float32)
    return found


def colours_of_cells(
    octree: Octree, name: str, cells: np.ndarray, size: int, plain: Sequence[float]
) -> np.ndarray:
    """Return the colours of cubes that are drawn, (n, 3) float32.

    Parameters
    ----------
    name : the attribute.
    cells : (n, 4) int32, the low corner of each in voxels, and k: its side is 2**k.
    size : k of the finest that is drawn; larger ones are inside leaves.
    """
    values = CellValues(octree, name, size)
    found = np.zeros((len(cells), *values.row), values.dtype)
    exponents = cells[:, 3].astype(np.int64)
    for k in np.unique(exponents).tolist():
        here = np.flatnonzero(exponents == k)
        codes = morton_encode(cells[here, :3].astype(np.int64) >> k)
        distinct, places = np.unique(codes, return_inverse=True)
        found[here] = values_of_cubes(values, distinct, k)[places.ravel()]
    return colours_of_values(values.attribute, found, plain)


def values_of_cubes(values: CellValues, codes: np.ndarray, k: int) -> np.ndarray:
    """Return the values of cubes of 2**k voxels a side by their Morton codes, (n, ...). Voxels,
    inside leaves and nodes of the values' own size have values; others have 0."""
    if k == 0:
        return values_of_voxels(values, codes)
    number = k - BRICK_POWER
    own = values.around(codes, number)
    return _of_nodes(values, number, codes, own) if k == values.size else own


def _of_nodes(values: CellValues, number: int, codes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the values of nodes of a level by their codes, and `others` where there is no such
    node."""
    own = values.levels[number].codes
    at = np.minimum(np.searchsorted(own, codes), len(own) - 1)
    there = own[at] == codes
    others[there] = values.of_cells(number, at[there])[:, 0]
    return others


def with_labels(content: Any, names: Sequence[str]) -> Octree:
    """Return the octree of the voxels of some labels, with its attributes; VoxtoolError if it has
    no such label."""
    if not isinstance(content, Octree):
        raise VoxtoolError("merged subtrees have no labels: voxelize with them")
    label = content.attribute("label")
    for name in names:
        if name not in label.names:
            known = ", ".join(label.names[:9]) + (", ..." if len(label.names) > 9 else "")
            raise VoxtoolError(f"no label is called {name!r}: choose of {known}")
    chosen = np.isin(np.array(label.names, object), np.array(names, object))
    values, kept = content.values("label"), np.zeros(len(content.bricks), BRICK)
    for first in range(0, len(kept), BRICKS):
        part = slice(first, first + BRICKS)
        flags = chosen[values.of_bricks(part)]
        kept[part] = np.packbits(flags, axis=1, bitorder="little").view(BRICK)[:, 0]
    leaves = chosen[values.of_leaves(len(_inside(content)))]
    return part_of(content, kept & content.bricks, leaves)


def part_of(octree: Octree, kept: np.ndarray, leaves: np.ndarray) -> Octree:
    """Return the octree of some of the voxels of the bricks, as masks (M,) uint64, and of some of
    the inside leaves, (L,) bool, with its attributes."""
    nodes = octree.nodes.copy()
    nodes["child"][_inside(octree)[~leaves]] = 0
    attributes = [_part_of(one, octree.bricks, kept, leaves) for one in octree.attributes]
    return replace(octree, nodes=nodes, bricks=kept, attributes=tuple(attributes))


def _inside(octree: Octree) -> np.ndarray:
    """Return the places of the inside leaves among the nodes."""
    return np.flatnonzero(octree.nodes["child"] & INSIDE)


def _part_of(
    attribute: Attribute, bricks: np.ndarray, kept: np.ndarray, leaves: np.ndarray
) -> Attribute:
    """Return what an attribute says of some of the voxels, and of some of the leaves."""
    held = attribute.held(bricks)
    parts = [np.empty(0, bool)]
    for first in range(0, len(held), BRICKS):
        part = slice(first, first + BRICKS)
        bits = (held[part, None] & BITS) != 0
        parts.append(((kept[part, None] & BITS) != 0)[bits])
    masks = None if attribute.masks is None else attribute.masks & kept
    of_leaves = attribute.leaves[leaves] if len(attribute.leaves) else attribute.leaves
    values = attribute.values[np.concatenate(parts)]
    return replace(attribute, values=values, leaves=of_leaves, masks=masks)
