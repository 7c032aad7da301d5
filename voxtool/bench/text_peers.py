"""Peers that the texts name beside their own structures: the classic octree of pointers with eight
samples a cell, the hash of vertices that [ADF] ascribes to Bærentzen, hashing with probes, samples
that cousins share, and Morton codes decoded by table.

Rows say whether a peer's answers are voxtool's own. Times are of kernels, in turns with voxtool's.

Kernels: kernels/bench.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.field.cells import cell_of
from voxtool.adf.queries.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.text_rows import Row
from voxtool.morton import among, morton_decode
from voxtool.opencl import Device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from voxtool.adf.field.field import DistanceField
    from voxtool.bench.timing import Bench

FIELD, DECODE = "bench/field_peers.cl", "bench/morton_decode.cl"
GROUP = 16  # points of a block that wait for each other, as [ADF] has it
FULLEST = 0.7  # of slots that are probed
GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # the multiplier of field_peers.cl
AXIS_BITS = 21  # bits of a vertex in its key
CODES = 1 << 20  # that are decoded
CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T[:, ::-1]  # x first
EIGHT, VERTICES = "pointers, eight samples a cell", "pointers, vertices in a hash"
PERFECT, PROBED = "perfect hash", "hash with probes"
OURS = "voxtool's query"
PRINTED = {
    EIGHT: "the classic structure: redundant samples, and pointers that a GPU follows badly",
    VERTICES: "no redundancy, but eight look-ups a cell would probably be too slow",
    PROBED: "all of a block wait for the most probes: of 16, 15 with 3 wait for one with 10",
}
WORDS = "one point a work-item, levels from the root on"


@dataclass(frozen=True)
class Probing:
    """A table of keys that is searched by linear probing: (2**bits,) uint64, 0 where it is free;
    and the slot of each key that it was made of, (n,)."""

    bits: int
    keys: np.ndarray
    slots: np.ndarray

    @classmethod
    def of(cls, keys: np.ndarray) -> Probing:
        """Return the table of (n,) different keys other than 0."""
        bits = max(int(np.ceil(len(keys) / FULLEST)) - 1, 1).bit_length()
        table = np.zeros(1 << bits, np.uint64)
        slots = (keys * GOLDEN >> np.uint64(64 - bits)).astype(np.int64)
        left = np.arange(len(keys))
        while len(left):  # of those at a free slot the first takes it, the others go on
            at = slots[left]
            free = np.flatnonzero(table[at] == 0)
            taken, first = np.unique(at[free], return_index=True)
            table[taken] = keys[left[free[first]]]
            left = left[table[at] != keys[left]]
            slots[left] = (slots[left] + 1) & (len(table) - 1)
        return cls(bits, table, slots)


def nodes_of(field: DistanceField) -> tuple[np.ndarray, np.ndarray]:
    """Return the first child of each node of a field's octree, (8 n + 1,) uint32, 0 for leaves; the
    root is the first, and the children of block i begin at 8 i + 1. And the corners of the nodes,
    (8 n + 1, 8) float32; those of the root are 0."""
    blocks = field.blocks.astype(np.uint64)
    n = len(blocks)
    children = (blocks[:, None] << np.uint64(3) | np.arange(8, dtype=np.uint64)).ravel()
    order = np.argsort(blocks)
    refined = among(blocks[order], children)
    first = np.zeros(8 * n + 1, np.uint32)
    first[0] = 8 * order[0] + 1
    first[1:][refined] = 8 * order[np.searchsorted(blocks[order], children[refined])] + 1
    octant = np.arange(8)
    places = np.stack([octant & 1, octant >> 1 & 1, octant >> 2], axis=1)
    corners = np.zeros((8 * n + 1, 8), np.float32)
    block = np.repeat(np.arange(n), 8)
    corners[1:] = field.corners(block, np.tile(places, (n, 1))).reshape(-1, 8)
    return first, corners


def vertices_of(
    field: DistanceField, nodes: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the keys of the vertices of a field's leaves, ascending, (n,) uint64, and their
    samples, (n,) float32; nodes, corners : as of nodes_of."""
    levels, cells = cell_of(field.blocks)
    octants = morton_decode(np.arange(8, dtype=np.uint64))
    cells = (2 * cells[:, None] + octants).reshape(-1, 3)
    leaf = nodes[1:] == 0
    scale = np.repeat(field.depth - 1 - levels, 8)[leaf]
    places = (cells[leaf][:, None] + CORNERS) << scale[:, None, None]
    shifts = 1 + AXIS_BITS * np.arange(3)
    keys = (places << shifts).sum(axis=2).astype(np.uint64) | np.uint64(1)
    keys, first = np.unique(keys.ravel(), return_index=True)
    return keys, corners[1:][leaf].ravel()[first]


def shared_by_cousins(field: DistanceField) -> int:
    """Return the samples that are stored where the blocks of eight siblings, or of eight cousins,
    and so on, share the samples of their common sides: as far as all eight exist and agree."""
    blocks = np.sort(field.blocks.astype(np.uint64))
    samples = field.voxels[np.argsort(field.blocks)]
    total = 0
    while len(blocks):
        side = samples.shape[1]
        parents, first, count = np.unique(blocks >> np.uint64(3), return_index=True,
                                          return_counts=True)  # fmt: skip
        whole = (count == 8) & (parents > 0)
        eight = samples[first[whole][:, None] + np.arange(8)]
        wide = np.zeros((len(eight), *[2 * side - 1] * 3), np.float32)
        for octant in range(8):
            wide[tuple(_part(octant, side))] = eight[:, octant]
        agree = np.ones(len(eight), bool)
        for octant in range(8):
            agree &= (wide[tuple(_part(octant, side))] == eight[:, octant]).all(axis=(1, 2, 3))
        joined = parents[whole][agree]
        total += side**3 * (len(blocks) - 8 * len(joined))
        blocks, samples = joined, wide[agree]
    return total


def _part(octant: int, side: int) -> Iterator[slice]:
    """Yield where the samples of an octant are among those of eight: of all, along z, y and x."""
    yield slice(None)
    for axis in (2, 1, 0):
        start = (side - 1) * (octant >> axis & 1)
        yield slice(start, start + side)


class Peers:
    """The peers of a field on a device: by name, functions of points that return distances and the
    slots read, and the bytes of each."""

    def __init__(self, field: DistanceField, device: Device) -> None:
        nodes, corners = nodes_of(field)
        keys, samples = vertices_of(field, nodes, corners)
        vertices, cells = Probing.of(keys), Probing.of(field.blocks.astype(np.uint64))
        scattered = np.zeros(len(vertices.keys), np.float32)
        scattered[vertices.slots] = samples
        numbers = np.zeros(len(cells.keys), np.uint32)
        numbers[cells.slots] = np.arange(len(field.blocks))
        eight = np.concatenate([nodes[:, None], corners.view(np.uint32)], axis=1)
        w = field.hash.m
        offsets = np.full((field.hash.r**3, 4), w, np.uint16)
        given = field.hash.offsets
        offsets[:, : given.shape[-1]] = given.reshape(len(offsets), -1)
        perfect = {
            "voxels": field.voxels, "keys": field.identifiers.ravel().astype(np.uint64),
            "blocks": np.ascontiguousarray(field.cells[..., -1]).ravel(), "offsets": offsets,
        }  # fmt: skip
        hashed = {"keys": vertices.keys, "samples": scattered, "nodes": nodes}
        probed = {"voxels": field.voxels, "keys": cells.keys, "blocks": numbers}
        self.field, self.device = field, device
        self.samples, self.vertices, self.loads = corners.size, len(keys), len(numbers)
        self._kernels: dict[str, tuple[str, dict[str, int], dict[str, Any]]] = {
            EIGHT: ("query_pointers", {"EIGHT": 1}, {"nodes": eight}),
            VERTICES: ("query_pointers", {}, {**hashed, "bits": vertices.bits}),
            PERFECT: ("query_hash", {}, {**perfect, "m": w, "r": field.hash.r}),
            PROBED: ("query_hash", {"PROBED": 1}, {**probed, "bits": cells.bits}),
        }
        self.bytes = {
            name: sum(array.nbytes for array in given.values() if isinstance(array, np.ndarray))
            for name, (_, _, given) in self._kernels.items()
        }
        self.bytes[PERFECT] = field.voxels.nbytes + field.cells.nbytes + field.hash.nbytes
        key = field.blocks.itemsize + 4
        self.bytes[PROBED] = field.voxels.nbytes + key * len(numbers)
        for _, _, given in self._kernels.values():
            for name, array in given.items():
                if isinstance(array, np.ndarray):
                    given[name] = device.put(np.ascontiguousarray(array))

    def ways(self, points: np.ndarray) -> dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]]:
        """Return by name what answers (n, 3) points in the cube."""
        own = self.device.put(points)
        return {name: partial(self._run, name, own, len(points)) for name in self._kernels}

    def _run(self, name: str, points: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
        kernel, options, given = self._kernels[name]
        field, device = self.field, self.device
        distances, probes = device.empty(n, np.float64), device.empty(n, np.uint32)
        with device.stage("query"):
            device.kernel(FIELD, kernel, **options)(
                n, points=points, origin=field.origin, side=field.side, depth=field.depth,
                distances=distances, probes=probes, **given,
            )  # fmt: skip
            return distances.take(), probes.take()


def field_rows(
    row: partial[Row], field: DistanceField, points: Mapping[str, np.ndarray], bench: Bench
) -> Iterator[Row]:
    """Yield rows of the peers of a field, at points of each kind, by its name."""
    peers, ask = Peers(field, bench.profiled), FieldQuery(field, bench.profiled)
    tables = {EIGHT: "3.1", VERTICES: "3.1", PERFECT: "3.4", PROBED: "3.4"}
    for what, places in points.items():
        ways = peers.ways(places)
        ours = partial(ask, places, search="linear")
        distances = ours().distance
        answers = {name: run() for name, run in ways.items()}
        runs = bench.stage_runs(ours, *ways.values())
        for name, stages in zip((OURS, *ways), runs, strict=True):
            seconds = [run["query"] for run in stages]
            words, wanted = "stage query, linear search", (tables[VERTICES], tables[PROBED])
            if name != OURS:
                same = np.array_equal(answers[name][0], distances)
                words = f"{WORDS}: {'the same' if same else 'other'} distances"
                wanted = (tables[name],)
            for table in wanted:
                yield row(
                    f"[ADF] section {table}", what=what, unit="ns a point", way=name, ours=words,
                    voxtool=1e9 * statistics.median(seconds) / len(places),
                    spread=timing.spread(seconds), statement=PRINTED.get(name, ""),
                )  # fmt: skip
        for name in (PERFECT, PROBED):
            read = answers[name][1]
            padded = np.append(read, np.zeros(-len(read) % GROUP, read.dtype)).reshape(-1, GROUP)
            for reads, most in (("slots read a point", read), ("of the most in 16", padded.max(1))):
                yield row("[ADF] section 3.4", what=f"{reads}, {what}", unit="", way=name,
                          voxtool=float(most.mean()), ours="", statement="")  # fmt: skip
    for name, table in tables.items():
        yield row(f"[ADF] section {table}", what="cells and samples", unit="bytes", way=name,
                  voxtool=peers.bytes[name], ours="")  # fmt: skip
    counts = {
        "eight a cell": peers.samples, "siblings share": field.voxels.size,
        "cousins share, too": shared_by_cousins(field),
        "each vertex of a leaf once": peers.vertices,
    }  # fmt: skip
    cousins = "blocks of eight siblings, of eight such blocks, and so on, as far as all exist"
    for way, count in counts.items():
        yield row("[ADF] section 3.1", what="samples", unit="", way=way, voxtool=count,
                  ours=cousins if way.startswith("cousins") else "",
                  statement="other redundancy remains: the best packing is NP-hard")  # fmt: skip


def decoding_table() -> np.ndarray:
    """Return the coordinates of codes of nine bits, (3, 512) uint8."""
    return morton_decode(np.arange(512, dtype=np.uint64)).T.astype(np.uint8)


def decode(codes: np.ndarray, device: Device, by_table: bool) -> np.ndarray:
    """Return the cells of (n,) Morton codes, (n, 3) uint32."""
    cells = device.empty(3 * len(codes), np.uint32)
    options = {"TABLE": 1} if by_table else {}
    with device.stage("decode"):
        device.kernel(DECODE, "decode", **options)(
            len(codes), device.put(codes), device.put(decoding_table()), cells
        )
        return cells.take().reshape(-1, 3)


def decoding_rows(row: partial[Row], bench: Bench) -> Iterator[Row]:
    """Yield rows of Morton codes that are decoded by bits and by table."""
    table = decoding_table()
    yield row("[voCCeL] section 5.1", what="table for decoding", unit="bytes", text=table.size,
              voxtool=table.nbytes, ours="numbers of a byte, by axis and nine bits; codes are "
              "decoded by bits elsewhere", statement="1.5 kB: 3 x 512")  # fmt: skip
    codes = np.random.default_rng(1).integers(0, 1 << 63, CODES, np.uint64)
    device = bench.profiled
    ways = {"by bits": False, "by table": True}
    works = {way: partial(decode, codes, device, by_table) for way, by_table in ways.items()}
    one, other = (work() for work in works.values())
    same = np.array_equal(one, other)
    for way, runs in zip(works, bench.stage_runs(*works.values()), strict=True):
        seconds = [run["decode"] for run in runs]
        yield row("[voCCeL] section 5.1", what="decoding", unit="ns a code", way=way,
                  voxtool=1e9 * statistics.median(seconds) / CODES, spread=timing.spread(seconds),
                  ours=f"{'the same' if same else 'other'} cells")  # fmt: skip
