"""Attributes: labels, colours, normals, fractions and the like of the set voxels of an octree.

An attribute has a value for each set voxel of the bricks, brick by brick, in the order of the bits,
and one for each inside leaf above them, in the order of the nodes. With masks, only the voxels of
these have values; the other set voxels have the attribute's default.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from voxtool.arrays import Data, Slices, blocks_of
from voxtool.errors import FileError, VoxtoolError
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE

if TYPE_CHECKING:
    from voxtool.svo.octree.content import OctreeContent

COLOUR = "colour"
BLOCK = 1 << 18  # values, or masks, that are read at once
BRICKS = 1 << 14  # bricks that are unpacked at once
BITS = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)


class Kind(NamedTuple):
    """The values that an attribute can have."""

    channels: int  # 0 for single numbers
    dtypes: tuple[str, ...]
    meaning: str  # for docs/formats.md


KINDS = {
    "label": Kind(0, ("u1", "u2", "u4"), "index of the part's name"),
    "colour": Kind(4, ("u1",), "red, green, blue in sRGB, and opacity, from 0 to 255"),
    "normal": Kind(
        3,
        ("f4",),
        "mean unit normal of the surface in the voxel, or that of its nearest point, or 0 0 0",
    ),
    "area": Kind(0, ("f4",), "area of the surface in the voxel, in the mesh's unit squared"),
    "fraction": Kind(
        0, ("u1", "u2", "f4"), "share of the voxel inside; of whole numbers, times the largest one"
    ),
    "faces": Kind(
        6, ("u1", "u2", "f4"), "shares of its faces inside: at low x, high x, low y, ..., high z"
    ),
}
RANGES = {
    "normal": (-1, 1),
    "area": (0, float(np.finfo(np.float32).max)),
    "fraction": (0, 1),
    "faces": (0, 1),
}


@dataclass(frozen=True, eq=False, repr=False)
class Attribute(Data):
    """An attribute of the set voxels of an octree.

    Attributes
    ----------
    name : str
        One of KINDS.
    values : (V,) or (V, channels)
        Values of the voxels that have one, brick by brick, in the order of the bits; these and the
        masks may be Slices of a file, which are read in blocks.
    leaves : (L,) or (L, channels), of the same dtype
        Values of the inside leaves above level 0, in the order of the nodes; L is 0 if all of them
        have the default.
    masks : (M,) uint64, optional
        Which voxels of each brick have a value; None if all set ones have.
    default : number or tuple of numbers
        Value of the other set voxels.
    names : tuple of str
        The name of each label.

    Raises
    ------
    VoxtoolError
        If the name is unknown, or an array has another type or shape.
    """

    name: str
    values: Any
    leaves: np.ndarray
    masks: Any = None
    default: Any = 0
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = KINDS.get(self.name)
        if kind is None:
            raise VoxtoolError(
                f"attribute {self.name!r} is unknown: choose one of {', '.join(KINDS)}"
            )
        row = (kind.channels,) if kind.channels else ()
        for array in (self.values, self.leaves):
            if array.dtype != self.values.dtype or array.dtype not in map(np.dtype, kind.dtypes):
                raise VoxtoolError(
                    f"attribute {self.name} of type {array.dtype}: give {' or '.join(kind.dtypes)}"
                )
            if array.ndim != 1 + len(row) or array.shape[1:] != row:
                raise VoxtoolError(
                    f"attribute {self.name} of shape {array.shape}: give "
                    f"({', '.join(map(str, ('N', *row)))})"
                )

    def __repr__(self) -> str:
        of = f" of {len(self.names)} names" if self.names else ""
        return f"<Attribute {self.name}{of}, {self.values.dtype}, {len(self.values):,} values>"

    @property
    def nbytes(self) -> int:
        """Bytes of values and masks."""
        masks = 0 if self.masks is None else self.masks.nbytes
        return self.values.nbytes + self.leaves.nbytes + masks

    @property
    def masked(self) -> bool:
        """True if masks say which voxels have values."""
        return self.masks is not None

    @property
    def head(self) -> dict[str, Any]:
        """The description that a file holds beside the arrays and the names, in JSON types."""
        return {
            "dtype": self.leaves.dtype.str.lstrip("<|"),
            "masked": self.masked,
            "default": np.asarray(self.default).tolist(),
        }

    @property
    def described(self) -> dict[str, Any]:
        """The description that a digest covers beside the arrays, in JSON types."""
        return {**self.head, "names": list(self.names)}

    @property
    def arrays(self) -> list[Any]:
        """The arrays, in the order of digests and files."""
        return [*([] if self.masks is None else [self.masks]), self.values, self.leaves]

    @property
    def total(self) -> Fraction:
        """The exact sum of the values of voxels, which are single numbers."""
        from voxtool.svo.octree.exact_sums import exact_sum

        return sum(map(exact_sum, blocks_of(self.values, BLOCK)), Fraction(0))

    @cached_property
    def largest(self) -> float:
        """The largest of the values, which are single numbers, or 0."""
        parts = (*blocks_of(self.values, BLOCK), self.leaves)
        return max(float(np.max(part, initial=0)) for part in parts)

    def loaded(self) -> Attribute:
        """Return the attribute with its values in memory."""
        masks = None if self.masks is None else self.masks[:]
        return replace(self, values=self.values[:], masks=masks)

    def summary(self) -> dict[str, Any]:
        """Return the type, sizes and names in JSON types, and the sum of areas."""
        sizes = {"values": len(self.values), "leaves": len(self.leaves)}
        sizes["memory_bytes"] = self.nbytes
        more = {"sum": float(self.total)} if self.name == "area" else {}
        return {**self.described, **sizes, **more}

    @property
    def blank(self) -> np.ndarray:
        """The default as a value, () or (channels,) of the dtype."""
        return np.broadcast_to(np.asarray(self.default, self.values.dtype), self.values.shape[1:])

    def held(self, bricks: Any) -> Any:
        """Return the masks of the voxels that have values, (M,) uint64, given the bricks."""
        return bricks if self.masks is None else self.masks

    def starts(self, bricks: Any) -> np.ndarray:
        """Return the index of the first value of each brick, and the number of values, (M + 1,)
        int64, given the bricks."""
        counts = [np.bitwise_count(block) for block in blocks_of(self.held(bricks), BLOCK)]
        return np.cumsum(np.concatenate([np.zeros(1, np.uint8), *counts]), dtype=np.int64)


class Values:
    """The values of an attribute of an octree, brick by brick.

    Parameters
    ----------
    attribute : Attribute
        The values.
    bricks : (M,) uint64
        The octree's bricks.
    """

    def __init__(self, attribute: Attribute, bricks: Any) -> None:
        self.attribute, self.bricks = attribute, bricks

    @cached_property
    def _starts(self) -> np.ndarray:
        return self.attribute.starts(self.bricks)

    def of_bricks(self, places: Any) -> np.ndarray:
        """Return the values of the voxels of some bricks, (n, 64) or (n, 64, channels) in the order
        of the bits; the set ones without a value have the default, the others 0.

        Parameters
        ----------
        places : slice or (n,) int
            The bricks' indices; a slice if the values stay in a file.
        """
        attribute = self.attribute
        set_, held = self.bricks[places], attribute.held(self.bricks)[places]
        bits = (held[:, None] & BITS) != 0
        starts, stored = self._starts[:-1][places], attribute.values
        if isinstance(stored, Slices):
            first, last, _ = places.indices(len(self.bricks))
            stored, starts = stored[self._starts[first] : self._starts[last]], starts - starts[:1]
        places_of = starts[:, None] + np.cumsum(bits, axis=1) - 1
        found = np.zeros((*bits.shape, *attribute.values.shape[1:]), attribute.values.dtype)
        if attribute.masks is not None:
            found[(set_[:, None] & BITS) != 0] = attribute.blank
        found[bits] = stored[places_of[bits]]
        return found

    def of_leaves(self, n: int) -> np.ndarray:
        """Return the values of the octree's n inside leaves."""
        if len(self.attribute.leaves):
            return self.attribute.leaves
        return np.broadcast_to(self.attribute.blank, (n, *self.attribute.values.shape[1:]))


def check_attributes(attributes: Sequence[Attribute], bricks: Any, inside_leaves: int) -> None:
    """Raise FileError if attributes do not fit the bricks and the number of inside leaves."""
    names = [attribute.name for attribute in attributes]
    if len(set(names)) < len(names):
        raise FileError(f"octree attributes: {', '.join(names)}: each name once")
    for one in attributes:
        where = f"octree attribute {one.name}"
        if one.masks is not None and (
            one.masks.dtype != BRICK
            or len(one.masks) != len(bricks)
            or any((mask & ~brick).any() for mask, brick in _both(one.masks, bricks))
        ):
            raise FileError(f"{where}: its masks hold voxels that are not set")
        held = blocks_of(one.held(bricks), BLOCK)
        wanted = sum(int(np.bitwise_count(block).sum(dtype=np.int64)) for block in held)
        if len(one.values) != wanted:
            raise FileError(f"{where}: {len(one.values)} values for {wanted} voxels")
        if len(one.leaves) not in (0, inside_leaves):
            raise FileError(f"{where}: {len(one.leaves)} values for {inside_leaves} leaves")
        for array in (*blocks_of(one.values, BLOCK), one.leaves, one.blank):
            _check_range(where, one, array)


def _both(masks: Any, bricks: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield masks and bricks in blocks."""
    return zip(blocks_of(masks, BLOCK), blocks_of(bricks, BLOCK), strict=True)


def _check_range(where: str, attribute: Attribute, array: np.ndarray) -> None:
    if not array.size:
        return
    if attribute.name == "label" and int(array.max()) >= len(attribute.names):
        raise FileError(f"{where}: {int(array.max())} where there are {len(attribute.names)} names")
    if array.dtype.kind == "f":
        least, most = RANGES[attribute.name]
        if not ((array >= least) & (array <= most)).all():
            raise FileError(f"{where}: a number that is not from {least} to {most:.9g}")


def has_colours(octree: OctreeContent) -> bool:
    """Return whether the voxels of an octree have colours."""
    return any(attribute.name == COLOUR for attribute in octree.attributes)
