"""Arithmetic of a device, compared bit for bit with numpy, and the primitives over arrays.

Kernels: kernels/selftest/arithmetic.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.opencl import Device
from voxtool.opencl.primitives import exclusive_scan, radix_sort, unique
from voxtool.selftest.case import Case, case

SOURCE = "selftest/arithmetic.cl"
COUNT = 100_000  # values, ten times as many in full
REALS = {"float": np.float32, "double": np.float64}
RANGES = {"float": 30, "double": 250}  # exponents of two, so that no result leaves the range
ROUNDED = slice(0, 5)  # + - * / and the root
JOINT = slice(5, 7)  # what a contraction would round less often


def compute(device: Device, name: str, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return (7, N): the results of the kernel `compute` for each three numbers."""
    n, real = len(a), REALS[name]
    results = device.empty(7 * n, real)
    inputs = [device.put(v.astype(real)) for v in (a, b, c)]
    device.kernel(SOURCE, "compute", REAL=name)(n, *inputs, results)
    return results.get().reshape(7, n)


def computed(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return (7, N): the results of numpy, which contracts nothing."""
    with np.errstate(all="ignore"):
        return np.stack([a + b, a - b, a * b, a / b, np.sqrt(a), a * b + c, a * b + b * c + c * a])


def operands(name: str, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return numbers of all sizes, nearly equal ones, and whole ones; a is positive, none is 0. A
    third of c is the negated product, so that a contracted a b + c is the rounding error of the
    product."""
    random, real = np.random.default_rng(1), REALS[name]
    size = np.exp2(random.integers(-RANGES[name], RANGES[name], (3, count)))
    a, b, c = random.uniform(1, 2, (3, count)) * size * random.choice([-1, 1], (3, count))
    third = count // 3
    b[:third] = -a[:third] * (1 + random.uniform(-1e-5, 1e-5, third))
    a[third : 2 * third], b[third : 2 * third] = random.integers(1, 1000, (2, third))
    a, b, c = np.abs(a).astype(real), b.astype(real), c.astype(real)
    c[::3] = -(a * b)[::3]
    return a, b, c


def differing(found: np.ndarray, expected: np.ndarray) -> int:
    """Return the number of values with different bits."""
    kind = f"u{found.itemsize}"
    return int(np.count_nonzero(found.view(kind) != expected.view(kind)))


def rounding(name: str, what: str, rows: slice, *reals: str) -> Case:
    """Return the case of rows of `compute` for these types."""

    def measure(device: Device, full: bool) -> int:
        wrong = 0
        for real in reals:
            values = operands(real, COUNT * (10 if full else 1))
            wrong += differing(compute(device, real, *values)[rows], computed(*values)[rows])
        return wrong

    return Case(name, f"{what}: the bits of numpy", "values wrong", 0, measure)


@case("denormals", "IEEE 754's in numpy, or flushed to 0", "values wrong", 0)
def denormals(device: Device, full: bool) -> int:
    wrong = 0
    for name, real in REALS.items():
        random, least = np.random.default_rng(2), np.finfo(real).smallest_normal

        def flushed(values: np.ndarray, least: np.floating = least) -> np.ndarray:
            return np.where(np.abs(values) < least, 0, values)

        factor = random.uniform(0, 4, COUNT).astype(real)
        a, b = (v.astype(real) * least for v in random.uniform(0, 4, (2, COUNT)))
        sums, products = (compute(device, name, a, v, b) for v in (-b, factor))
        for found, expected, without in (
            (sums[0], a - b, flushed(a) - flushed(b)),
            (products[2], a * factor, flushed(a) * factor),
        ):
            right = (found == expected) | (found == flushed(expected)) | (found == flushed(without))
            wrong += int(np.count_nonzero(~right))
    return wrong


@case("integers of 64 bits", "products, quotients, shifts, bits, conversions: numpy, Python",
      "values wrong", 0)  # fmt: skip
def integers(device: Device, full: bool) -> int:
    random, n = np.random.default_rng(3), COUNT * (10 if full else 1)
    a, b = random.integers(1, 1 << 64, (2, n), dtype=np.uint64) >> random.integers(
        0, 63, (2, n), dtype=np.uint64
    )
    b[::2] |= np.uint64(1)
    b = np.maximum(b, np.uint64(2))  # so no quotient overflows
    b[b == np.uint64((1 << 64) - 1)] = 3
    wrong = 0
    for name, real in REALS.items():
        x = random.uniform(-1, 1, n) * np.exp2(random.integers(0, 62, n))
        results, converted = device.empty(11 * n, np.uint64), device.empty(n, real)
        device.kernel(SOURCE, "count", REAL=name)(
            n, device.put(a), device.put(b), device.put(x.astype(real)), results, converted
        )
        c, whole = a.view(np.int64), x.astype(real)
        wrong += differing(results.get().reshape(11, n), counted(a, b, whole))
        wrong += differing(converted.get(), ((c >> 32) if name == "float" else c).astype(real))
    return wrong


def counted(a: np.ndarray, b: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return (11, N) uint64: the expected results of the kernel `count`, by Python integers."""
    c, d = a.view(np.int64), b.view(np.int64)
    shift = b & np.uint64(63)
    i, j, k, m = (values.astype(object) for values in (a, b, c, d))
    quotient = np.abs(k) // np.abs(m)  # Python rounds down, C to 0
    quotient = np.where((c < 0) != (d < 0), -quotient, quotient)
    rows = [
        i * j, (i * j) >> 64, i // j, i % j, (k * m) >> 64, quotient, k - quotient * m,
        k >> shift.astype(object), np.bitwise_count(a).astype(object),
        [64 - v.bit_length() for v in (a >> shift).tolist()],
        np.trunc(x).astype(np.int64).astype(object),
    ]  # fmt: skip
    return (np.array(rows, object) & ((1 << 64) - 1)).astype(np.uint64)


@case("scan, sort, unique", "over arrays of many blocks: numpy", "values wrong", 0)
def primitives(device: Device, full: bool) -> int:
    random, n = np.random.default_rng(4), 1_000_003 if full else 300_007
    counts = random.integers(0, 8, n + 1).astype(np.uint32)
    sums = np.concatenate([[0], np.cumsum(counts[:n], dtype=np.uint32)])
    array = device.put(counts)
    exclusive_scan(array, n)
    keys = random.integers(0, 1 << 40, n, dtype=np.uint64) % np.uint64(n)
    order = np.argsort(keys, kind="stable")
    numbers = device.put(np.arange(n, dtype=np.uint32))
    found, found_order = radix_sort(device.put(keys), n, n.bit_length(), numbers)
    distinct, expected = unique(found, n)[0].get(), np.unique(keys)
    wrong = abs(len(distinct) - len(expected))
    for one, other in (
        (array.get(), sums),
        (found.get(0, n), keys[order]),
        (found_order.get(0, n), order),
        (distinct[: len(expected)], expected[: len(distinct)]),
    ):
        wrong += int(np.count_nonzero(one != other))
    return wrong


CASES = (
    rounding("float32 + - * / sqrt", "rounded correctly", ROUNDED, "float"),
    rounding("float64 + - * / sqrt", "rounded correctly", ROUNDED, "double"),
    rounding("contraction", "a b + c is rounded twice", JOINT, "float", "double"),
    denormals,
    integers,
    primitives,
)
