"""Hexahedra of the largest cubes of cells, instead of one a cell, with the nodes that hang.

A cube has 2**n cells a side, is aligned to the grid's low corner, wholly set and of one material.
It is as large as possible, but so that all cells that a face touches are alike: all unset, or all
of one material. So surfaces are made of whole faces. A node of small cubes that lies on an edge or
a face of a larger one, not at a corner of it, hangs: its value is interpolated from the masters,
the corners of that edge or face, with weights that are exact. If there are several larger cubes,
the largest one counts. A master may hang itself, on a larger cube.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.slabs import THICK, Filled
from voxtool.svo.solvers.hexahedra import CORNERS, Hexahedra, Key, Part, Sizes, between, sizes_of

PIECE = 1 << 18  # cubes that are passed on at once
LOOKED_UP = 1 << 20  # cells that are looked up at once
CUBE_BYTES = 600  # bytes of memory for a cube and its nodes
OCTANTS = np.indices((2, 2, 2)).reshape(3, 8).T
STEPS = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])  # of SIDES


class Cubes(NamedTuple):
    """Cubes of cells, in ascending order of the Morton codes of their low cells."""

    codes: np.ndarray  # (n,) uint64 of the low cells, counted from the grid's corner
    powers: np.ndarray  # (n,) uint8: a cube has 2**power cells a side
    values: np.ndarray  # (n,) uint32 numbers of materials

    def find(self, codes: np.ndarray) -> np.ndarray:
        """Return which cube has each cell, given by its Morton code, -1 where none has."""
        at = np.searchsorted(self.codes, codes, side="right") - 1
        size = np.uint64(1) << (np.uint64(3) * self.powers[at].astype(np.uint64))
        held = (at >= 0) & (codes - self.codes[at] < size)
        return np.where(held, at, -1)


class Hanging(NamedTuple):
    """The nodes that hang, in ascending order, counted from 0."""

    nodes: np.ndarray  # (n,) int64
    masters: np.ndarray  # (n, 4) int64, -1 beyond the two of an edge
    weights: np.ndarray  # (n, 4) float64, 0 beyond these


@dataclass(frozen=True, eq=False)
class Piece(Part):
    """Some cubes of a mesh."""

    mesh: LeafHexahedra
    start: int
    end: int

    @property
    def count(self) -> int:
        """Number of cubes."""
        return self.end - self.start

    @property
    def values(self) -> np.ndarray | None:
        """The materials of the cubes, if they have labels."""
        return self.mesh.cubes.values[self._chosen] if self.mesh.labels else None

    @property
    def _chosen(self) -> np.ndarray:
        return self.mesh.order[self.start : self.end]

    def at_corners(self, numbered: Callable[[int, int], np.ndarray]) -> list[np.ndarray]:
        """See Part."""
        values = numbered(0, len(self.mesh.node_keys))
        return list(values[self.mesh.numbers[self.start : self.end]].T)

    def nodes(self) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """See Part: the first piece has all nodes."""
        if self.start:
            return
        places = self.mesh.node_places
        starts = np.flatnonzero(np.diff(places[:, 0], prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(places)], strict=True):
            yield int(places[start, 0]), int(start), places[start:end, 1], places[start:end, 2]

    @cached_property
    def faces(self) -> list[tuple[Key, np.ndarray]]:
        """See Part."""
        mesh, chosen = self.mesh, self._chosen
        own, parts = mesh.cubes.values[chosen], list[tuple[Key, np.ndarray]]()
        for side, step in enumerate(STEPS):
            beyond = mesh.values_beside(mesh.cubes, chosen, step)
            parts.append((Key(0, 0, side), np.flatnonzero(beyond == 0)))
            parts += between(side, own, beyond)
        return [(key, cells) for key, cells in parts if len(cells)]


@dataclass(frozen=True, eq=False)
class LeafHexahedra(Hexahedra):
    """The hexahedra of the largest cubes of an image's cells.

    Attributes
    ----------
    limit : int
        Bytes that the cubes may take.
    """

    limit: int = 0

    @property
    def text(self) -> str:
        """The counts, for people."""
        return f"{super().text}, {len(self.hanging.nodes):,} nodes that hang"

    @property
    def facts(self) -> dict[str, Any]:
        """The counts, in JSON types."""
        return {**super().facts, "hanging": len(self.hanging.nodes)}

    @property
    def own_bytes(self) -> int:
        """A bound of the memory of all cubes."""
        labels = self.labels.own_bytes if self.labels else 0
        return labels + CUBE_BYTES * len(self.cubes.codes)

    @cached_property
    def sizes(self) -> Sizes:
        """The counts."""
        return sizes_of(self.layers())

    def layers(self) -> Iterator[Part]:
        """Yield the cubes in lexicographic order of their low cells."""
        for start in range(0, len(self.order), PIECE):
            yield Piece(self, start, min(start + PIECE, len(self.order)))

    # ---- cubes

    @cached_property
    def cubes(self) -> Cubes:
        """The cubes."""
        by_power = united(found_in(self.image, self.labels, self.limit // CUBE_BYTES))
        largest = sorted_cubes(by_power)
        for power in range(len(by_power) - 1, 0, -1):
            codes, values = by_power[power]
            if not len(codes):
                continue
            now = Cubes(codes << np.uint64(3 * power), np.full(len(codes), power, "u1"), values)
            alike = self._alike(largest, now)
            finer, more = by_power[power - 1]
            children = (codes[~alike, None] << np.uint64(3)) | np.arange(8, dtype=np.uint64)
            by_power[power] = (codes[alike], values[alike])
            by_power[power - 1] = (
                np.concatenate([finer, children.ravel()]),
                np.concatenate([more, np.repeat(values[~alike], 8)]),
            )
        return sorted_cubes(by_power)

    def _alike(self, held: Cubes, cubes: Cubes) -> np.ndarray:
        """Return whether all cells that a face of a cube touches are alike, for each cube of one
        power, in all faces."""
        side = 1 << int(cubes.powers[0])
        found = np.ones(len(cubes.codes), bool)
        low, step = morton_decode(cubes.codes).astype(np.int64), max(LOOKED_UP // side**2, 1)
        across = np.indices((side, side)).reshape(2, -1).T
        for axis in range(3):
            places = np.insert(across, axis, 0, axis=1)
            for beyond in (-1, side):
                places[:, axis] = beyond
                for start in range(0, len(low), step):
                    chosen = slice(start, start + step)
                    cells = low[chosen, None] + places
                    values = self._values_of(held, cells.reshape(-1, 3)).reshape(len(cells), -1)
                    found[chosen] &= values.min(axis=1) == values.max(axis=1)
        return found

    def _values_of(self, held: Cubes, cells: np.ndarray) -> np.ndarray:
        """Return the materials of cells, counted from the grid's corner; 0 where there is none."""
        at = cubes_of(held, cells, self.image)
        return np.where(at >= 0, held.values[at], 0)

    def values_beside(self, held: Cubes, chosen: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the materials that chosen cubes touch at the side of a step, 0 for none."""
        low = morton_decode(held.codes[chosen]).astype(np.int64)
        sides = np.int64(1) << held.powers[chosen].astype(np.int64)
        return self._values_of(held, low + np.where(step > 0, sides[:, None], step))

    @cached_property
    def lows(self) -> np.ndarray:
        """The low cells of the cubes, counted from the part's low cell, (n, 3) int64."""
        return morton_decode(self.cubes.codes).astype(np.int64) - np.array(self.image.low)

    @cached_property
    def order(self) -> np.ndarray:
        """The cubes in lexicographic order of their low cells."""
        return np.lexsort(self.lows.T[::-1])

    # ---- nodes

    @property
    def _spans(self) -> np.ndarray:
        """The differences of keys of nodes that are one step apart along each axis."""
        _, ny, nz = self.image.shape
        return np.array([(ny + 1) * (nz + 1), nz + 1, 1], np.int64)

    @cached_property
    def _numbered(self) -> tuple[np.ndarray, np.ndarray]:
        sides = np.int64(1) << self.cubes.powers[self.order].astype(np.int64)
        corners = self.lows[self.order][:, None] + sides[:, None, None] * np.array(CORNERS)
        keys, numbers = np.unique((corners * self._spans).sum(axis=2), return_inverse=True)
        return keys, numbers.reshape(-1, len(CORNERS))

    @property
    def node_keys(self) -> np.ndarray:
        """The keys of the nodes, ascending."""
        return self._numbered[0]

    @property
    def numbers(self) -> np.ndarray:
        """The nodes of the cubes in their order, (n, 8)."""
        return self._numbered[1]

    @cached_property
    def node_places(self) -> np.ndarray:
        """The places of the nodes, in cells from the low corner, (m, 3) int64."""
        x, rest = np.divmod(self.node_keys, self._spans[0])
        return np.stack([x, *np.divmod(rest, self._spans[1])], axis=1)

    @cached_property
    def hanging(self) -> Hanging:
        """The nodes that hang."""
        places, cubes = self.node_places, self.cubes
        on, size = np.full(len(places), -1), np.zeros(len(places), np.int64)
        for octant in OCTANTS:
            at = cubes_of(cubes, places + self.image.low - octant, self.image)
            side = np.int64(1) << cubes.powers[at].astype(np.int64)
            local = places - self.lows[at]
            inner = ((local > 0) & (local < side[:, None])).any(axis=1)
            larger = (at >= 0) & inner & (side > size)
            on[larger], size[larger] = at[larger], side[larger]
        nodes = np.flatnonzero(on >= 0)
        low, side = self.lows[on[nodes]], size[nodes]
        local = places[nodes] - low
        inner = (local > 0) & (local < side[:, None])
        first = np.argmax(inner, axis=1)  # the axis of an edge, or the first one of a face
        second = 2 - np.argmax(inner[:, ::-1], axis=1)
        masters = np.full((len(nodes), 4), -1)
        weights = np.zeros((len(nodes), 4))
        row = np.arange(len(nodes))
        for k, (a, b) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            at, share = local.copy(), np.ones(len(nodes))
            for axis, end in ((first, a), (second, b)):
                along = local[row, axis] / side
                used = np.ones(len(nodes), bool) if axis is first else first != second
                share *= np.where(used, along if end else 1 - along, 1)
                at[row[used], axis[used]] = end * side[used]
            keys = ((low + at) * self._spans).sum(axis=1)
            held = (first != second) | (b == 0)
            masters[held, k] = np.searchsorted(self.node_keys, keys[held])
            weights[held, k] = share[held]
        return Hanging(nodes, masters, weights)


def cubes_of(cubes: Cubes, cells: np.ndarray, image: VoxelImage) -> np.ndarray:
    """Return the cube of each cell, counted from the grid's corner, -1 where none has it."""
    within = ((cells >= image.low) & (cells < np.add(image.low, image.shape))).all(axis=1)
    found = np.full(len(cells), -1)
    found[within] = cubes.find(morton_encode(cells[within]))
    return found


def found_in(
    image: VoxelImage, labels: AttributeImage | None, most: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the cubes of each power that blocks of four cells a side and larger cubes hold: Morton
    codes in units of their side, and materials. MemoryLimitError if there are more than `most`."""
    powers = max(max(image.all_cells) - 1, 1).bit_length() + 1
    codes: list[list[np.ndarray]] = [[np.empty(0, np.uint64)] for _ in range(powers + 1)]
    values: list[list[np.ndarray]] = [[np.empty(0, np.uint32)] for _ in range(powers + 1)]

    total = 0

    def add(power: int, corners: np.ndarray, each: np.ndarray) -> None:
        nonlocal total
        total += len(corners)
        if total > most:
            raise MemoryLimitError(
                f"more than {most:,} cubes do not fit in memory: leave out --leaves, or choose "
                f"{image.smaller} (see --max-memory)"
            )
        codes[power].append(morton_encode(corners >> power))
        values[power].append(each.astype(np.uint32))

    for part in labels.parts() if labels else image.parts():
        for filled in part.cubes(THICK):
            each = filled.values if isinstance(filled, Filled) else np.ones(len(filled.corners))
            add(filled.side.bit_length() - 1, filled.corners, each)
        for corners, cells in part.blocks(THICK):
            small = cells.reshape(-1, 2, 2, 2, 2, 2, 2).transpose(0, 1, 3, 5, 2, 4, 6)
            eighths = small.reshape(-1, 8, 8)
            low = corners[:, None] + 2 * OCTANTS
            alike = eighths.min(axis=2) == eighths.max(axis=2)
            held = alike & (eighths[:, :, 0] != 0)
            add(1, low[held], eighths[held][:, 0])
            rest, lows = eighths[~alike], low[~alike][:, None] + OCTANTS
            add(0, lows[rest != 0], rest[rest != 0])
    return [
        (np.concatenate(own), np.concatenate(each)) for own, each in zip(codes, values, strict=True)
    ]


def united(
    by_power: list[tuple[np.ndarray, np.ndarray]],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the cubes with eight of one material made one, from the smallest on."""
    found = list(by_power)
    for power in range(len(found) - 1):
        codes, values = found[power]
        order = np.argsort(codes)
        codes, values = codes[order], values[order]
        parents = codes >> np.uint64(3)
        starts = np.flatnonzero(np.diff(parents, prepend=np.uint64(2**64 - 1)) != 0)
        if not len(starts):
            continue
        counts = np.diff(starts, append=len(codes))
        whole = (counts == 8) & (
            np.minimum.reduceat(values, starts) == np.maximum.reduceat(values, starts)
        )
        kept = ~np.repeat(whole, counts)
        above, more = found[power + 1]
        found[power] = (codes[kept], values[kept])
        found[power + 1] = (
            np.concatenate([above, parents[starts[whole]]]),
            np.concatenate([more, values[starts[whole]]]),
        )
    return found


def sorted_cubes(by_power: list[tuple[np.ndarray, np.ndarray]]) -> Cubes:
    """Return the cubes of all powers."""
    codes = np.concatenate([own << np.uint64(3 * p) for p, (own, _) in enumerate(by_power)])
    powers = np.repeat(np.arange(len(by_power), dtype=np.uint8), [len(o) for o, _ in by_power])
    values = np.concatenate([each for _, each in by_power])
    order = np.argsort(codes)
    return Cubes(codes[order], powers[order], values[order])
