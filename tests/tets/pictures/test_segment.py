"""The integral of a linear segment, against mpmath, in every regime."""

from __future__ import annotations

import functools
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from conftest import opened, usable_devices

from voxtool.opencl import Device
from voxtool.selftest import volumes

REGIMES = (0.25, 4.0, 80.0)  # between which segment.h changes its method
GROUP = 64
LANES = (1, 16)

KERNELS = """
__kernel void homogeneous(__global const float *m, __global float *alpha, __global float *zeta)
{
    const size_t i = get_global_id(0) * LANES;
    floats taken, through;
    attenuate(load(m + i), 0.0f, &taken, &through);
    store(taken, alpha + i);
    store(through, zeta + i);
}

__kernel void rounded(__global const float *a, __global const float *b, __global float *quotient,
                      __global float *root)
{
    const size_t i = get_global_id(0) * LANES;
    store(load(a + i) / load(b + i), quotient + i);
    store(sqrt(load(a + i)), root + i);
}
"""
SOURCE = '#include "tets/pictures/segment.h"\n' + KERNELS


def run(device: Device, kernel: str, results: int, *values: np.ndarray, lanes: int) -> np.ndarray:
    """(results, N) float32: what a kernel makes of N values, each of which stands alone."""
    count = len(values[0])
    padded = -(-count // (GROUP * lanes)) * GROUP * lanes
    arrays = [device.put(np.resize(v.astype(np.float32), padded)) for v in values]
    out = [device.empty(padded, np.float32) for _ in range(results)]
    launch = device.kernel(SOURCE, kernel, LANES=lanes)
    launch(padded // lanes, *arrays, *out, local=GROUP)
    return np.stack([o.get(stop=count) for o in out])


def weights(device: Device, a, b, lanes: int = 16) -> np.ndarray:
    """(3, N) float64 of float32: w_f, w_b and zeta."""
    a, b = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, np.float32)) for v in (a, b)))
    return volumes.weights(device, a, b, lanes)


def exact(front: float, back: float) -> tuple[Any, Any, Any]:
    """w_f, w_b and zeta by the closed forms, with 60 digits."""
    a, b = mp.mpf(float(front)), mp.mpf(float(back))
    m, delta = (a + b) / 2, (b - a) / 2
    if m == 0:
        return mp.mpf(0), mp.mpf(0), mp.mpf(1)
    zeta, root = mp.exp(-m), mp.sqrt(abs(delta))
    if delta == 0:
        psi = -mp.expm1(-m) / m
    else:
        x, y = a / (2 * root), b / (2 * root)
        # scaled: erfcx, or Dawson's function times 2 / sqrt(pi)
        kind, sign = (mp.erfc, 1) if delta > 0 else (mp.erfi, -1)
        ends = [mp.exp(sign * end * end) * kind(end) for end in (x, y)]
        psi = mp.sqrt(mp.pi) / (2 * root) * (ends[0] - zeta * ends[1])
    return 1 - psi, psi - zeta, zeta


def pairs(count: int, least: float, most: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Float32 ends: of any two sizes between those, like and alike, zero, and where the method
    changes."""
    random = np.random.default_rng(seed)
    sizes = np.exp(random.uniform(np.log(least), np.log(most), (4, count)))
    way = random.uniform(-1, 1, count)
    zero = 0 * way
    a = [sizes[0], sizes[1] * (1 - way), sizes[2] * (1 - way**15), sizes[3], zero, sizes[3]]
    b = [sizes[3], sizes[1] * (1 + way), sizes[2] * (1 + way**15), zero, sizes[3], sizes[3]]
    for m in REGIMES:
        around = m * (1 + random.uniform(-3e-7, 3e-7, count))
        a.append(around * (1 - way))
        b.append(around * (1 + way))
    a, b = (np.concatenate(ends).astype(np.float32) for ends in (a, b))
    beside = np.nextafter(a[:count], np.float32(np.inf))  # ends that only just differ
    return np.concatenate([a, a[:count]]), np.concatenate([b, beside])


@functools.cache
def cases() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends from 1e-7 to 1e4, and (3, N) what they give."""
    with mp.workdps(60):
        some: list[tuple[np.ndarray, ...]] = [pairs(150, 1e-7, 1e4), pairs(150, 1e-2, 30, 1)]
        edges = np.array([1e-7, 1e-5, 0.1, 0.25, 1, 4, 8, 80, 1e3, 1e4], np.float32)
        some.append(tuple(v.ravel() for v in np.meshgrid(edges, edges)))
        a, b = (np.concatenate(ends) for ends in zip(*some, strict=True))
        found = np.array([[float(v) for v in exact(*ends)] for ends in zip(a, b, strict=True)])
    return a, b, found.T


@pytest.mark.parametrize("lanes", LANES)
def test_weights_are_those_of_mpmath(device: Device, lanes: int) -> None:
    a, b, wanted = cases()
    found = weights(device, a, b, lanes)
    error = np.abs(found - wanted)
    assert (error[:2] <= 1e-6 * wanted[:2]).all()
    assert (error[2] <= 1e-7).all()
    seen = wanted[2] > 1e-30
    assert (error[2] <= 1e-6 * wanted[2])[seen].all()


def test_homogeneous_weights_are_those_of_mpmath(device: Device) -> None:
    m = np.concatenate([np.geomspace(1e-30, 1e6, 1500), np.arange(1, 90) * np.log(2)])
    m = m.astype(np.float32)
    alpha, zeta = run(device, "homogeneous", 2, m, lanes=16).astype(np.float64)
    with mp.workdps(60):
        wanted = np.array([(-mp.expm1(-float(v)), mp.exp(-float(v))) for v in m], np.float64).T
    assert (np.abs(alpha - wanted[0]) <= 1e-6 * wanted[0]).all()
    seen = wanted[1] > 1e-30
    assert (np.abs(zeta - wanted[1]) <= 1e-6 * wanted[1])[seen].all()
    assert run(device, "homogeneous", 2, np.zeros(1), lanes=1).tolist() == [[0], [1]]


def test_thin_segments_have_the_weights_of_the_limit(device: Device) -> None:
    a, b = pairs(200, 2e-30, 1e-8, 2)
    a, b = (np.where(v > 1e-7, np.float32(1e-12), v).astype(np.float64) for v in (a, b))
    front, back, zeta = weights(device, a, b)
    for found, wanted in ((front, a / 3 + b / 6), (back, a / 6 + b / 3)):
        assert (np.abs(found - wanted) <= 1e-6 * wanted + 1e-30).all()
    assert (zeta == np.float32(1)).sum() > 100
    assert np.abs(zeta - 1).max() < 1.2e-7


def test_nothing_weighs_nothing(device: Device) -> None:
    for a, b in ((0, 0), (1e-31, 0), (1e-40, 1e-45)):
        assert weights(device, a, b, 1)[:, 0].tolist() == [0, 0, 1]


def test_thick_segments_neither_overflow_nor_lose_anything(device: Device) -> None:
    a, b = pairs(400, 1e-7, 1e6, 3)
    far = np.array([1e6, 1e12, 1e20, 1e30, 0, 1])
    a = np.concatenate([a, *([v] * len(far) for v in far)]).astype(np.float32)
    b = np.concatenate([b, *([far] * len(far))]).astype(np.float32)
    found = weights(device, a, b)
    assert ((found >= 0) & (found <= 1)).all()
    assert np.abs(found.sum(axis=0) - 1).max() < 3e-7


def test_weights_go_on_where_the_method_changes(device: Device) -> None:
    """Along ever thicker segments of one shape none jumps, and less and less is let through."""
    for share in (0.0, 0.3, 1.0, 1.7, 2.0):
        m = np.linspace(1e-3, 100, 20001)
        front, back, zeta = weights(device, m * share, m * (2 - share))
        assert (np.diff(zeta) <= 1e-7 * zeta[1:]).all()
        assert np.diff(front).min() > -2e-7
        steps = np.abs(np.diff(np.stack([front, back]))) / np.diff(m)
        assert steps.max() < 1


def test_every_device_and_width_gives_the_same_bits() -> None:
    a, b = (
        np.concatenate(v) for v in zip(*(pairs(3000, 1e-30, 1e6, s) for s in (4, 5)), strict=True)
    )
    found = {
        (index, lanes): np.concatenate(
            [
                weights(opened(index), a, b, lanes),
                run(opened(index), "homogeneous", 2, a, lanes=lanes),
            ]
        )
        .astype(np.float32)
        .view(np.uint32)
        for index, _ in usable_devices()
        for lanes in LANES
    }
    first, *others = found.values()
    assert all(np.array_equal(first, other) for other in others)


@pytest.mark.parametrize("lanes", LANES)
def test_quotients_and_roots_are_rounded_correctly(device: Device, lanes: int) -> None:
    random = np.random.default_rng(6)
    shape = (2, 200_000)
    values = np.ldexp(random.uniform(1, 2, shape), random.integers(-50, 50, shape))
    a, b = values.astype(np.float32)
    quotient, root = run(device, "rounded", 2, a, b, lanes=lanes)
    assert np.array_equal(quotient, a / b)
    assert np.array_equal(root, np.sqrt(a))
