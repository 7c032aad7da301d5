"""Building a perfect spatial hash of the cells of an octree: a lookup reads a small table, then a
dense one [Lefebvre 2006; ADF, sections 3.3 and 3.4].

A key p, three whole numbers, has slot

    h(p) = ((p mod w) + (x, y, z)) mod m,  (x, y, z, w) = offsets[p mod r],

axis by axis, in a table of m x m x m; m is the smallest side whose cube holds the keys. Keys that
are equal mod r form a bucket and move together: buckets by falling size, each takes the first
offset that puts all its keys into free slots (section 3.4.2). w is m, and not stored, unless keys
of some bucket are equal mod m: no offset separates them, but another w can (algorithm 3.1).

Differences from [ADF]:

- r is coprime to m. Otherwise many keys would be equal modulo both.
- Slots are searched in the order of s / r mod m. The keys of a bucket differ by multiples of r, so
  in this order they are as close as in a grid r times coarser, and rows of bits are tested at once.
- Buckets search in rounds, the next of the remaining ones together. Each claims slots that were
  vacant when the round began; the first bucket gets a slot, and the others search on. Buckets of
  one key take the slots that are left, in order.
- Buckets are scattered if random vacant slots would offer each of them enough places: each begins
  its search at its own place. In an octree that is full down to some level all buckets have the
  same shape and compete for the same places; there w differs from bucket to bucket.
- Otherwise buckets are packed, each into the first slots that it fits, from m starting places. This
  suits planes, such as the faces of a box. A bucket without a place tries other w.

The table depends on the set of keys alone, not on their order or the device. It maps every key to
some slot. To look up a cell that may be absent, identifiers are stored in the slots and compared
(section 3.4.3): Morton codes after a leading one, which differ from level to level.

Kernels: kernels/adf/field/hashing.cl.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np

from voxtool.adf.field.cells import MAX_KEY, shown
from voxtool.adf.field.spatial_hash import SpatialHash, offset_type
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.primitives import radix_sort

SOURCE = "adf/field/hashing.cl"
SLOT_BITS = 10  # bits of a slot along an axis: m is at most 1024
KEYS_AN_OFFSET = 6  # n / 2d offsets to begin with: 4 bits a key where an offset has 24
SCATTERED_KEYS = 4  # keys an offset: the fewest for which buckets are scattered
CHOICE = 15  # expected places of the last bucket of each size, at least, to scatter buckets
MAX_R = 256  # r grows to this, or to 2 m
ALIKE = 16  # if keys extend over fewer tables of offsets, all buckets have one shape
LEAST_W = 3  # w of such buckets is at least m / 3
MOST_PARTED = 2048  # keys of a bucket, at most, that are compared in pairs to test a w
WORDS = 4  # words of 64 slots, tested at once (a span): the width of the kernels' vectors
REACH = 2048  # spans that a bucket searches with one w, if all buckets have one shape
BUDGET = 1 << 22  # spans searched in vain before r grows
LANES = 1 << 14  # buckets that search together, at most
CROWD = 4  # vacant slots for each pair of keys of buckets that search together, at least
MAX_ROUNDS = (1 << 32) // LANES  # a claim has 32 bits for the round and the bucket of its window
LOST, WON, NO_PLACE = 0, 1, 2  # the outcome of a bucket in a round
EVEN = 0xC13FA9A9, 0x91E10DA6  # 2**32 over the plastic number, and over its square

HEADERS = {
    "adf/field/hashing.h": program.c_constants(
        SLOT_BITS=SLOT_BITS,
        MOST_PARTED=MOST_PARTED,
        WORDS=WORDS,
        LANES=LANES,
        LOST=LOST,
        WON=WON,
        NO_PLACE=NO_PLACE,
    )
}


def build_hash(
    keys: np.ndarray,
    device: Device | None = None,
    *,
    side: int | None = None,
    max_r: int | None = None,
    with_w: bool = True,
) -> SpatialHash:
    """Return the perfect hash of a set of keys, (n, 3) distinct integers in [1, 2**21 - 1].

    r grows from KEYS_AN_OFFSET keys an offset until a table is found, up to max_r, by default 2 m
    or MAX_R, the larger. `side` is that of the table of slots, by default the smallest. With
    `with_w` False there are offsets alone, as in [Lefebvre 2006]. Raises VoxtoolError if a key is
    repeated or out of range, MemoryLimitError if there are more than 2**30 keys, or no table is
    found. The build takes about 16 bytes a slot and 70 bytes a key.
    """
    keys = _checked(keys)
    keys_on_device = _sort_keys(device or default_device(), keys)
    m = side or _table_side(len(keys))
    max_r = max(2 * m, MAX_R) if max_r is None else max_r
    for r, sizes, way in _attempts(keys_on_device, m, max_r):
        if way is _Way.DIFFERING and not with_w:
            continue
        buckets = _fill_buckets(keys_on_device, r, sizes)
        offsets = _Search(buckets, m, way, with_w).run()
        if offsets is not None:
            table = SpatialHash(m, r, offsets)
            table.validate(keys)
            return table
    raise MemoryLimitError(
        f"no perfect hash of {count_of(len(keys), 'key')} with offsets up to {max_r}^3: they "
        "lie along a line, or their differences have many divisors"
    )


def _checked(keys: np.ndarray) -> np.ndarray:
    """Return the keys as an array; raise if they are no keys, out of range, or too many."""
    keys = np.asarray(keys)
    if keys.ndim != 2 or keys.shape[1] != 3 or keys.dtype.kind not in "iu":
        raise VoxtoolError(f"keys are (n, 3) integers, not {keys.shape} {keys.dtype}")
    if len(keys) > 1 << 3 * SLOT_BITS:
        raise MemoryLimitError(
            f"{len(keys):,} keys are more than the {1 << SLOT_BITS}^3 slots of the largest table: "
            "choose a smaller level"
        )
    if keys.min(initial=1) < 1 or keys.max(initial=1) > MAX_KEY:
        wrong = keys[((keys < 1) | (keys > MAX_KEY)).any(axis=1)][0]
        raise VoxtoolError(f"key {shown(wrong)} is out of range: keys are 1 to {MAX_KEY}")
    return keys


def _table_side(n: int) -> int:
    """Return the least m with m**3 >= n."""
    m = 1
    while m**3 < n:
        m += 1
    return m


# --- buckets -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Keys:
    """Keys on the device: codes, (n,) uint64, ascending: z, y, x from the highest bits on, as many
    bits each as `top`, the largest coordinate of any key, has."""

    codes: Array
    top: int

    def run(self, kernel: str, **arguments: Any) -> None:
        """Run a kernel with a work-item for each key."""
        launch = self.codes.device.kernel(SOURCE, kernel)
        launch(self.codes.size, codes=self.codes, top=self.top, **arguments)


@dataclass(frozen=True)
class _Buckets:
    """The keys by bucket, by falling size, then in the order of their cells.

    r: side of the table of offsets; order: (n,) uint32, the keys, bucket by bucket; cells, sizes,
    firsts: (b,) int64, the place of each bucket in the table of offsets, its number of keys, and
    the place of its first key in `order`.
    """

    keys: _Keys
    r: int
    order: Array
    cells: np.ndarray
    sizes: np.ndarray
    firsts: np.ndarray


def _sort_keys(device: Device, keys: np.ndarray) -> _Keys:
    n, top = len(keys), int(keys.max(initial=1))
    bits = top.bit_length()
    unsorted = _Keys(device.empty(n, np.uint64), top)
    unsorted.run("encode_keys", keys=device.put(keys.astype(np.uint32)))
    codes, _ = radix_sort(unsorted.codes, n, 3 * bits)
    repeated = device.put(np.array([n], np.uint32))
    found = _Keys(codes, top)
    found.run("find_repeated", repeated=repeated)
    first = int(repeated.get()[0])
    if first < n:
        code = int(codes.get(first, first + 1)[0])
        key = np.array([code >> bits * axis & (1 << bits) - 1 for axis in range(3)])
        raise VoxtoolError(f"key {shown(key)} is repeated: keys are distinct")
    return found


class _Way(Enum):
    """The ways in which buckets search for places."""

    SCATTERED = auto()  # each bucket from its own place
    DIFFERING = auto()  # the same, with w that differs from bucket to bucket
    PACKED = auto()  # from one of m places


def _attempts(keys: _Keys, m: int, max_r: int) -> Iterator[tuple[int, np.ndarray, _Way]]:
    """Yield each r to try, the number of keys of each of its offsets, and the way to search."""
    n = keys.codes.size
    first = _table_side(-(-n // KEYS_AN_OFFSET))
    for r in range(first, min(max_r, _table_side(-(-n // SCATTERED_KEYS))) + 1):
        if math.gcd(r, 2 * m) == 1:  # an odd r: more w are coprime to it
            sizes = _count_keys(keys, r)
            if _has_choice(sizes, m):
                yield r, sizes, _Way.DIFFERING if keys.top < ALIKE * r else _Way.SCATTERED
    r = first
    while r <= max_r:
        if math.gcd(r, m) == 1:
            sizes = _count_keys(keys, r)
            yield r, sizes, _Way.PACKED
            if _has_choice(sizes, m):
                yield r, sizes, _Way.DIFFERING
            r += r // 32
        r += 1


def _count_keys(keys: _Keys, r: int) -> np.ndarray:
    """Return the number of keys of each offset, (r**3,) uint32."""
    sizes = keys.codes.device.zeros(r**3, np.uint32)
    keys.run("count_keys", r=r, sizes=sizes)
    return sizes.take()


def _has_choice(sizes: np.ndarray, m: int) -> bool:
    """Return True if the last bucket of each size expects CHOICE places or more among the m**3
    slots, if vacant slots are random."""
    histogram = np.bincount(sizes).tolist()
    vacant = m**3
    for size in range(len(histogram) - 1, 1, -1):
        if histogram[size]:
            vacant -= size * histogram[size]
            if (vacant + size) ** size < CHOICE * m ** (3 * size - 3):
                return False
    return True


def _fill_buckets(keys: _Keys, r: int, sizes: np.ndarray) -> _Buckets:
    """Return the buckets from the number of keys of each offset: steps 1 to 3 of the algorithm."""
    device, n = keys.codes.device, keys.codes.size
    cells, order = device.empty(n, np.uint32), device.empty(n, np.uint32)
    keys.run("find_cells", r=r, cells=cells, order=order)
    _, order = radix_sort(cells, n, (r**3 - 1).bit_length(), order)
    falling = np.argsort(sizes.max() - sizes, kind="stable")[: np.count_nonzero(sizes)]
    sizes = sizes.astype(np.int64)
    firsts = np.cumsum(sizes) - sizes
    return _Buckets(keys, r, order, falling, sizes[falling], firsts[falling])


# --- search --------------------------------------------------------------------------------------


class _Search:
    """The choice of w, and steps 4 to 6 of the algorithm."""

    def __init__(self, buckets: _Buckets, m: int, way: _Way, with_w: bool = True) -> None:
        device, b, spans = buckets.keys.codes.device, len(buckets.sizes), -(-m // (64 * WORDS))
        self.device, self.buckets, self.m, self.way = device, buckets, m, way
        every = m * m * spans
        self.reach = min(every, REACH) if way is _Way.DIFFERING else every
        self.choices = _choices(m, buckets.r)[: None if with_w else 1]
        self.most_tries = len(self.choices) * -(-every // self.reach)
        if way is _Way.PACKED:
            starts = np.arange(b) % m * (m * spans)  # a layer of slots each
        else:
            starts = _evenly(np.arange(b) * EVEN[0], every)
        self.w, self.places = device.empty(b, np.uint32), device.empty(b, np.uint32)
        self.targets = device.empty(b, np.uint32)
        self.outcome = device.empty(LANES, np.uint8)
        self.vacant = device.empty(2 * WORDS * every, np.uint64)
        self.arguments = {
            "codes": buckets.keys.codes,
            "top": buckets.keys.top,
            "order": buckets.order,
            "firsts": device.put(buckets.firsts.astype(np.uint32)),
            "sizes": device.put(buckets.sizes.astype(np.uint32)),
            "starts": device.put(starts.astype(np.uint32)),
            "choices": device.put(self.choices),
            "choice_count": len(self.choices),
            "m": m,
            "r": buckets.r,
            "inverse": pow(buckets.r, -1, m),
            "spans": spans,
            "reach": self.reach,
            "ws": self.w,
            "places": self.places,
            "apart": device.empty(buckets.order.size, np.uint32),
            "steps": device.empty(b, np.uint32),
            "claims": device.put(np.full(m**3, 0xFFFFFFFF, np.uint32)),
            "targets": self.targets,
            "vacant": self.vacant,
            "outcome": self.outcome,
        }
        self._launch("vacate", self.vacant.size)

    def _launch(self, kernel: str, size: int, **more: Any) -> None:
        self.device.kernel(SOURCE, kernel)(size, **self.arguments, **more)

    def run(self) -> np.ndarray | None:
        """Return the table of offsets, (r, r, r, 3 or 4) uint8 or uint16; None if a bucket has no
        place."""
        sizes, most = self.buckets.sizes, self.m if self.way is _Way.PACKED else LANES
        shared = np.count_nonzero(sizes > 1)
        pending = np.arange(shared, dtype=np.uint32)
        tries = np.zeros(len(sizes), np.int64)
        tries[:shared] = self.way is _Way.DIFFERING
        self._place(np.arange(len(sizes), dtype=np.uint32), tries)
        if not self.w.get().all():
            return None
        vacant, vain = self.m**3, 0
        for number in range(MAX_ROUNDS):
            if not len(pending):
                return self._offsets()
            few = vacant // (CROWD * int(sizes[pending[0]]) ** 2)
            window = pending[: max(min(few, most), 1)]
            outcome = self._round(window, number)
            stuck = window[outcome == NO_PLACE]
            if len(stuck):
                tries[stuck] += 1
                vain += len(stuck) * self.reach
                if vain > BUDGET or tries[stuck].max() > self.most_tries:
                    return None
                self._place(stuck, tries[stuck])
            vacant -= int(sizes[window[outcome == WON]].sum())
            pending = np.concatenate([window[outcome != WON], pending[len(window) :]])
        return None

    def _place(self, window: np.ndarray, tries: np.ndarray) -> None:
        """Choose w of buckets and place their keys: first m, if it separates the keys, then other
        w at later tries."""
        wide = int(np.count_nonzero(LEAST_W * self.choices >= self.m))
        others = _evenly(window.astype(np.int64) * EVEN[1] + tries * EVEN[0], wide)
        first = self.device.put(np.where(tries, others, 0).astype(np.uint32))
        self._launch("place_keys", len(window), window=self.device.put(window), first_choice=first)

    def _round(self, window: np.ndarray, number: int) -> np.ndarray:
        """Search for the k buckets of a window; return the outcome of each, (k,) uint8."""
        on_device = self.device.put(window)
        for kernel in ("search", "settle"):
            self._launch(kernel, len(window), window=on_device, round=number)
        return self.outcome.get(0, len(window))

    def _offsets(self) -> np.ndarray:
        """Return the table of offsets; buckets of one key take the slots that are left."""
        m, r, cells = self.m, self.buckets.r, self.buckets.cells
        bits = np.unpackbits(self.vacant.get().view(np.uint8), bitorder="little")
        vacant = np.flatnonzero(bits.reshape(m, m, -1)[..., :m])
        single = self.buckets.sizes == 1
        targets = _unpacked(self.targets.get())
        rest = vacant[: np.count_nonzero(single)]
        targets[:, single] = rest % m, rest // m % m, rest // (m * m)
        w = self.w.get()
        table = np.zeros((r**3, 4 if (w != m).any() else 3), offset_type(m))
        table[:, 3:] = m
        table[cells, :3] = ((targets - _unpacked(self.places.get())) * r % m).T
        table[cells, 3:] = w[:, None]
        return table.reshape(r, r, r, -1)


def _choices(m: int, r: int) -> np.ndarray:
    """Return the w that algorithm 3.1 tries, (c,) uint32: m, then the numbers that are coprime to m
    and r, the largest first."""
    coprime = [w for w in range(m - 1, 1, -1) if math.gcd(w, m * r) == 1]
    return np.array([m, *coprime], np.uint32)


def _evenly(multiples: np.ndarray, end: int) -> np.ndarray:
    """Return (k,) int64 below `end` for multiples of EVEN: any run fills the range evenly, and a
    pair fills a square (the sequence R2 [Roberts 2018])."""
    return (multiples & 0xFFFFFFFF) * end >> 32


def _unpacked(slots: np.ndarray) -> np.ndarray:
    """Return the coordinates x, y, z of the device's (b,) slots, (3, b) int64."""
    shifts = np.array([[0], [SLOT_BITS], [2 * SLOT_BITS]])
    return slots.astype(np.int64) >> shifts & (1 << SLOT_BITS) - 1
