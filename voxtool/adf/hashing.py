"""A perfect spatial hash over the cells of an octree: one read of a small table, then one of a
dense one, whatever the key.

Sections 3.3 and 3.4 of the text, after Lefebvre and Hoppe ("Perfect Spatial Hashing", SIGGRAPH
2006). A key p, three whole numbers, goes to slot

    h(p) = ((p mod w) + (x, y, z)) mod m,  (x, y, z, w) = offsets[p mod r],

axis by axis, in a table of m x m x m; m is the least whose cube holds the keys. Keys that are equal
mod r are a bucket, and move together: buckets by falling size, each takes the first offset that
puts all its keys into free slots (algorithm of section 3.4.2). w is m, and not stored, unless keys
of some bucket are equal mod m: no offset parts them, another w can (algorithm 3.1).

What differs from the text:

- r is coprime to m, or keys equal mod both would be many.
- Slots are searched in the order of s / r mod m. The keys of a bucket differ by multiples of r, so
  there they lie as near to each other as in a grid r times as coarse: those of a plane or a cube
  are a plate or a block. Large buckets are packed, each into the first slots that it fits, from m
  places on; which alone solves keys in planes, as a box has them, with a small r. Others begin to
  search at a pseudo-random place, which depends on their keys alone.
- The search walks the free slots and puts the first key of a bucket there. Buckets of one size
  search together: of those that want one slot, the first has it and the others search on. A bucket
  of one key takes the next free slot.

So the table depends on the set of keys alone.

The hash maps every key to some slot. Who looks for a cell that may be absent stores identifiers
in the slots and compares (section 3.4.3): Morton codes with a leading one tell cells of all levels
apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError, count_of
from voxtool.morton import morton_decode, morton_encode

MAX_LEVEL = 20  # of a cell: the three coordinates of its key fit 63 bits
MAX_LEVEL_32 = 10  # of cells whose identifiers fit 32 bits
KEYS_AN_OFFSET = 6  # n / 2d offsets to begin with: 4 bits a key where an offset has 24
MAX_R = 256  # r grows to this, or to 2 m
PACKED = 4  # keys of a bucket from which it is packed,
PACKED_LATE = 12  # if a search among random slots may do
TRIALS = 1 << 17  # offsets that are tried at once, at most
MIN_TRIALS = 8  # of a bucket, at least
AT_ONCE = 64  # keys of a bucket that are tested at once, at most


@dataclass(frozen=True, eq=False)
class SpatialHash:
    """A function from keys to slots without collisions among the keys that it was built for.

    m : side of the table of slots.
    r : side of the table of offsets.
    offsets : (r, r, r, 3 or 4) uint8 where m < 256, else uint16; indexed [z, y, x], each x, y, z
        and, where some bucket needs it, w: 1 to m.
    """

    m: int
    r: int
    offsets: np.ndarray

    @property
    def has_w(self) -> bool:
        """Whether w is stored; elsewhere it is m."""
        return self.offsets.shape[-1] == 4

    @property
    def nbytes(self) -> int:
        """Bytes of the offsets."""
        return self.offsets.nbytes

    def bits_a_key(self, n: int) -> float:
        """Bits of the offsets for each of n keys."""
        return 8 * self.nbytes / max(n, 1)

    def load(self, n: int) -> float:
        """Share of the slots that n keys take."""
        return n / self.m**3

    def slots(self, keys: np.ndarray) -> np.ndarray:
        """(n, 3) keys, none negative, to (n,) int64 slots x + m (y + m z)."""
        keys = np.asarray(keys, np.int64)
        x, y, z = (keys % self.r).T
        offset = self.offsets[z, y, x].astype(np.int64)
        w = offset[:, 3:] if self.has_w else self.m
        return _flat((keys % w + offset[:, :3]) % self.m, self.m)

    def validate(self, keys: np.ndarray) -> None:
        """Check that the table is sound and that each of these keys has a slot of its own.

        Raises
        ------
        VoxtoolError : names what is wrong, or two keys of one slot.
        """
        self._check_table()
        slots = self.slots(keys)
        order = np.argsort(slots, kind="stable")
        same = np.flatnonzero(np.diff(slots[order]) == 0)
        if len(same):
            first, second = (_shown(keys[i]) for i in order[same[0] : same[0] + 2])
            raise VoxtoolError(f"spatial hash: keys {first} and {second} have the same slot")

    def _check_table(self) -> None:
        m, r, offsets = self.m, self.r, self.offsets
        if m < 1 or r < 1 or offsets.shape not in ((r, r, r, 3), (r, r, r, 4)):
            raise VoxtoolError(f"spatial hash: r = {r}, but offsets of shape {offsets.shape}")
        if offsets.dtype != _offset_type(m):
            raise VoxtoolError(f"spatial hash: m = {m}, but offsets of type {offsets.dtype}")
        w = offsets[..., 3:]
        if (offsets[..., :3] >= m).any() or (w < 1).any() or (w > m).any():
            raise VoxtoolError(f"spatial hash: m = {m}, but an offset is out of range")


def build_hash(keys: np.ndarray) -> SpatialHash:
    """The perfect hash of a set of keys; their order does not matter.

    r grows from KEYS_AN_OFFSET keys an offset until a table is found, at most to 2 m or MAX_R.
    Takes some 16 bytes a slot and 150 bytes a key meanwhile.

    Parameters
    ----------
    keys : (n, 3) integers in [1, 2**21 - 1], distinct.

    Raises
    ------
    VoxtoolError : a key is repeated, or out of range.
    MemoryLimitError : there is no table of offsets within bounds.
    """
    keys = _sorted_keys(keys)
    m = _table_side(len(keys))
    r = _first_r(len(keys))
    while r <= _max_r(m):
        if math.gcd(r, m) == 1:
            buckets = _fill_buckets(keys, r)
            w = _choose_w(buckets, m)
            offsets = None if w is None else _search(buckets, w, m)
            if w is not None and offsets is not None:
                table = SpatialHash(m, r, _pack_offsets(buckets, offsets, w, m))
                table.validate(keys)
                return table
            # by much, where failure was no surprise and took time
            r += r // (32 if w is None or _expects(1, buckets.sizes, m) else 4)
        r += 1
    raise MemoryLimitError(
        f"no perfect hash of {count_of(len(keys), 'key')} with offsets up to {_max_r(m)}^3: they "
        "lie along a line, or their differences have many divisors"
    )


def _sorted_keys(keys: np.ndarray) -> np.ndarray:
    """(n, 3) int64: the keys in the order of z, y, x."""
    keys = np.asarray(keys)
    if keys.ndim != 2 or keys.shape[1] != 3 or keys.dtype.kind not in "iu":
        raise VoxtoolError(f"keys are (n, 3) integers, not {keys.shape} {keys.dtype}")
    wrong = np.flatnonzero(((keys < 1) | (keys >= 2 << MAX_LEVEL)).any(axis=1))
    if len(wrong):
        raise VoxtoolError(
            f"key {_shown(keys[wrong[0]])} is out of range: keys are 1 to {(2 << MAX_LEVEL) - 1}"
        )
    keys = keys.astype(np.int64)
    codes = _codes(keys)
    order = np.argsort(codes)
    twice = np.flatnonzero(np.diff(codes[order]) == 0)
    if len(twice):
        raise VoxtoolError(f"key {_shown(keys[order[twice[0]]])} is repeated: keys are distinct")
    return keys[order]


def _table_side(n: int) -> int:
    """The least m whose cube holds n keys."""
    m = 1
    while m**3 < n:
        m += 1
    return m


def _first_r(n: int) -> int:
    return _table_side(-(-n // KEYS_AN_OFFSET))


def _max_r(m: int) -> int:
    return max(2 * m, MAX_R)


# --- buckets -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Buckets:
    """The keys by bucket, the largest first.

    r : side of the table of offsets; keys : (n, 3) int64; cells : (b,) int64, where each bucket is
    in the table of offsets; sizes : (b,) int64; first : (b,) int64, the first key of each.
    """

    r: int
    keys: np.ndarray
    cells: np.ndarray
    sizes: np.ndarray
    first: np.ndarray

    def numbers(self) -> np.ndarray:
        """(n,) int64: the bucket of each key."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)


def _expects(choice: int, sizes: np.ndarray, m: int) -> bool:
    """Whether the last bucket of each size may expect a choice of so many offsets among the m**3,
    were the slots that are taken by then random ones."""
    histogram = np.bincount(sizes).tolist()
    slots = free = m**3
    for size in range(len(histogram) - 1, 1, -1):
        if histogram[size]:
            free -= size * histogram[size]
            if (free + size) ** size < choice * slots ** (size - 1):
                return False
    return True


def _fill_buckets(keys: np.ndarray, r: int) -> _Buckets:
    """Steps 1 to 3 of the algorithm; buckets of one size are in the order of their cells."""
    cell = _flat(keys % r, r)
    count = np.bincount(cell, minlength=r**3)
    cells = np.argsort(-count, kind="stable")[: np.count_nonzero(count)]
    sizes = count[cells]
    order = np.lexsort((cell, -count[cell]))
    return _Buckets(r, keys[order], cells, sizes, np.cumsum(sizes) - sizes)


def _choose_w(buckets: _Buckets, m: int) -> np.ndarray | None:
    """(b,) int64: w of each bucket, by algorithm 3.1; None where a bucket has none."""
    w = np.full(len(buckets.sizes), m)
    number = buckets.numbers()
    left = _colliding(buckets.keys, number, m)
    for candidate in range(2, m):
        if not len(left):
            return w
        if math.gcd(candidate, m * buckets.r) == 1:
            keys = np.isin(number, left)
            still = _colliding(buckets.keys[keys], number[keys], candidate)
            w[np.setdiff1d(left, still)] = candidate
            left = still
    return None if len(left) else w


def _colliding(keys: np.ndarray, number: np.ndarray, w: int) -> np.ndarray:
    """The numbers of the buckets in which keys are equal mod w."""
    slots = np.sort(number * w**3 + _flat(keys % w, w))
    return np.unique(slots[1:][np.diff(slots) == 0] // w**3)


# --- search --------------------------------------------------------------------------------------


def _search(buckets: _Buckets, w: np.ndarray, m: int) -> np.ndarray | None:
    """(b, 3) int64: the offset of each bucket; None where there is none for some bucket."""
    r, table = buckets.r, _Table(m)
    packed = PACKED_LATE if _expects(8, buckets.sizes, m) else PACKED
    offsets = np.empty((len(w), 3), np.int64)
    begin = 0
    for end in (np.flatnonzero(np.diff(buckets.sizes, append=0)) + 1).tolist():
        size = int(buckets.sizes[begin])
        first = int(buckets.first[begin])
        keys = buckets.keys[first : first + (end - begin) * size].reshape(end - begin, size, 3)
        places = keys % w[begin:end, None, None] * pow(r, -1, m) % m
        if size == 1:
            targets = table.points(table.free[: end - begin])
        elif size >= packed:
            layers = np.arange(end - begin) % m
            targets = _place(table, places, layers * table.stride[2], m)
        else:
            starts = _mixed(keys[:, 0]) * len(table.free) >> 32
            targets = _place(table, places, table.free[starts], m**3)
        if targets is None:
            return None
        offsets[begin:end] = (targets - places[:, 0]) * r % m
        begin = end
    return offsets


class _Table:
    """Which slots of the table are free; a slot is here at its coordinates divided by r mod m.

    It is kept twice along each axis, so that a slot plus a difference needs no mod: slot (x, y, z)
    is at x + 2m (y + 2m z), and again m further on.

    is_free : (8 m**3,) bool; free : (f,) int64, the free slots in rising order.
    """

    def __init__(self, m: int) -> None:
        self.m = m
        self.stride = np.array([1, 2 * m, 4 * m * m])
        self.copies = np.indices((2, 2, 2)).reshape(3, 8).T @ (m * self.stride)
        self.is_free = np.ones(8 * m**3, bool)
        z, y, x = np.ogrid[:m, :m, :m]
        self.free = (x + 2 * m * (y + 2 * m * z)).ravel()

    def points(self, slots: np.ndarray) -> np.ndarray:
        """The coordinates of slots."""
        m2 = 2 * self.m
        return np.stack([slots % m2, slots // m2 % m2, slots // (m2 * m2)], axis=-1)

    def take(self, slots: np.ndarray) -> None:
        """Mark slots as taken."""
        self.is_free[np.add.outer(self.copies, slots)] = False
        self.free = self.free[self.is_free[self.free]]


def _place(
    table: _Table, places: np.ndarray, cursor: np.ndarray, at_once: int
) -> np.ndarray | None:
    """Find free slots for buckets of one size, (b, s, 3), in their order.

    cursor : (b,) int64, the slot at which each begins to search; changed.
    at_once : buckets that search together, at most.

    Returns
    -------
    (b, 3) int64: where the first key of each goes; None if the keys of one fit nowhere.
    """
    m, (b, size) = table.m, places.shape[:2]
    apart = (places - places[:, :1]) % m
    reach = (apart @ table.stride)[:, :0:-1]  # the farthest first: nearer ones often fit together
    left = np.full(b, len(table.free))  # slots to try until all have been
    targets = np.empty((b, 3), np.int64)
    claims = np.full(m**3, b)
    pending = np.arange(b)
    width = MIN_TRIALS  # slots that a bucket tries at once
    while len(pending):
        free = table.free
        # at once so few that most of them have different slots in mind
        few = min(at_once, TRIALS // width, max(len(free) // (4 * size * size), 1))
        now = pending[:few]
        tries = min(width, len(free))
        at = np.searchsorted(free, cursor[now])[:, None] + np.arange(tries + 1)
        slots = free[at % len(free)]
        hit = _first_fit(table, slots[:, :tries], reach[now])
        missed = now[hit < 0]
        cursor[now] = slots[np.arange(len(now)), np.where(hit < 0, tries, hit)]
        left[missed] -= tries
        if (left[missed] <= 0).any():
            return None
        if 2 * len(missed) > len(now):
            width = min(2 * width, TRIALS)
        elif 8 * len(missed) < len(now):
            width = max(width // 2, MIN_TRIALS)

        fits = now[hit >= 0]
        target = table.points(cursor[fits])
        wanted = (target[:, None] + apart[fits]) % m
        slot = _flat(wanted, m)
        np.minimum.at(claims, slot, fits[:, None])
        won = (claims[slot] == fits[:, None]).all(axis=1)
        claims[slot] = b
        targets[fits[won]] = target[won]
        table.take((wanted[won] @ table.stride).ravel())
        still = np.setdiff1d(now, fits[won], assume_unique=True)
        pending = np.concatenate([still, pending[len(now) :]])
    return targets


def _first_fit(table: _Table, slots: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """(c,) int64: the first of the (c, k) free slots for the first key of each bucket at which its
    other keys, (c, s - 1) further on, find free slots too; -1 where there is none."""
    (c, k), others = slots.shape, reach.shape[1]
    left = np.flatnonzero(table.is_free[slots + reach[:, :1]])
    key = 1
    while key < others and len(left):
        end = key + min(key, AT_ONCE)
        tested = slots.ravel()[left, None] + reach[left // k, key:end]
        left = left[table.is_free[tested].all(axis=1)]
        key = end
    rows, first = np.unique(left // k, return_index=True)
    hit = np.full(c, -1)
    hit[rows] = left[first] % k
    return hit


def _mixed(keys: np.ndarray) -> np.ndarray:
    """(b, 3) keys to (b,) pseudo-random int64 below 2**32 (splitmix64)."""
    v = _codes(keys).astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    v = (v ^ (v >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    v = (v ^ (v >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (v >> np.uint64(32)).astype(np.int64)


def _pack_offsets(buckets: _Buckets, found: np.ndarray, w: np.ndarray, m: int) -> np.ndarray:
    """The table of offsets; without w where it is m everywhere."""
    r, channels = buckets.r, 4 if (w != m).any() else 3
    offsets = np.zeros((r**3, channels), _offset_type(m))
    offsets[:, 3:] = m
    offsets[buckets.cells, :3] = found
    offsets[buckets.cells, 3:] = w[:, None]
    return offsets.reshape(r, r, r, channels)


def _offset_type(m: int) -> np.dtype:
    return np.dtype(np.uint8 if m < 256 else np.uint16)


def _flat(points: np.ndarray, side: int) -> np.ndarray:
    """(..., 3) points of a cube to their places in its array, x fastest."""
    return points[..., 0] + side * (points[..., 1] + side * points[..., 2])


def _codes(keys: np.ndarray) -> np.ndarray:
    """(n, 3) int64 keys to (n,) int64, one to one; in the order of z, y, x."""
    bits = MAX_LEVEL + 1
    return keys[:, 0] | keys[:, 1] << bits | keys[:, 2] << 2 * bits


def _shown(key: np.ndarray) -> str:
    return f"({', '.join(map(str, key.tolist()))})"


# --- cells ---------------------------------------------------------------------------------------


def key_of(level: int | np.ndarray, ijk: np.ndarray) -> np.ndarray:
    """(n, 3) cells of a level, or of (n,) levels, to (n, 3) int64 keys 2**level + ijk (eq. 3-1)."""
    ijk = np.asarray(ijk, np.int64)
    return ijk + (1 << np.broadcast_to(np.asarray(level, np.int64), len(ijk)))[:, None]


def identifier_type(level: int) -> np.dtype:
    """The type of the identifiers of octrees whose deepest stored cells are of this level."""
    return np.dtype(np.uint32 if level <= MAX_LEVEL_32 else np.uint64)


def cell_identifier(level: int, ijk: np.ndarray) -> np.ndarray:
    """(n, 3) cells of a level to (n,) identifiers (section 3.4.3): Morton codes after a leading
    one, of 3 level + 1 bits; uint32 up to level 10, else uint64. None is 0.

    Raises
    ------
    VoxtoolError : the level is beyond MAX_LEVEL, or has no such cell.
    """
    ijk = np.asarray(ijk)
    if not 0 <= level <= MAX_LEVEL:
        raise VoxtoolError(f"no cell has level {level}: levels are 0 to {MAX_LEVEL}")
    wrong = np.flatnonzero(((ijk < 0) | (ijk >> level > 0)).any(axis=1))
    if len(wrong):
        raise VoxtoolError(f"level {level} has no cell {_shown(ijk[wrong[0]])}")
    codes = morton_encode(ijk) | np.uint64(1 << 3 * level)
    return codes.astype(identifier_type(level))


def cell_of(identifiers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) identifiers, none 0, to the (n,) int64 levels and (n, 3) int64 cells."""
    codes = np.asarray(identifiers, np.uint64)
    levels = np.zeros(len(codes), np.int64)
    for level in range(1, MAX_LEVEL + 1):
        levels[codes >> np.uint64(3 * level) != 0] = level
    leading = np.uint64(1) << (3 * levels).astype(np.uint64)
    return levels, morton_decode(codes ^ leading)
