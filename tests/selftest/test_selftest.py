"""The selftest: its cases hold on every device, and a device that is wrong does not pass them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from conftest import usable_devices
from helpers.distance import brute

from voxtool.errors import DeviceError
from voxtool.opencl import Device, open_device, program
from voxtool.selftest import CASES, arithmetic, digests, fields, oracles, selftest, shapes
from voxtool.selftest.case import Case

BY_NAME = {case.name: case for case in CASES}


@pytest.mark.every_driver
@pytest.mark.parametrize("name", BY_NAME)
@pytest.mark.slow
def test_cases_hold(device: Device, name: str) -> None:
    outcome = BY_NAME[name].run(device)
    assert outcome.passed, outcome.as_dict()
    assert outcome.message == ""
    assert outcome.seconds > 0


def test_cases_are_told_apart() -> None:
    assert len(BY_NAME) == len(CASES)
    for case in CASES:
        assert case.name.isascii()
        assert len(case.name) < 38
        assert len(case.unit) < 14
        assert case.what
        assert math.isfinite(case.bound)


# ---- what a wrong device does

FAULTS = [  # the case that finds it, and what goes wrong in a kernel
    ("float32 + - * / sqrt", "= a / b;", "= a * (1 / b);"),
    ("float64 + - * / sqrt", "= a / b;", "= a * (1 / b);"),
    ("float64 + - * / sqrt", "= sqrt(a);", "= sqrt(a) * (1 + (REAL)2.3e-16 * (i == 77777));"),
    ("contraction", "= a * b + c;", "= fma(a, b, c);"),
    ("denormals", "= a * b;", "= a * b * (REAL)1.0625;"),
    ("integers of 64 bits", "mul_hi(a, b)", "mul_hi(a, b) + (a >> 63 & b >> 63)"),
    ("integers of 64 bits", "convert_long(xs[i])", "convert_long_rte(xs[i])"),
    ("scan, sort, unique", "sorted[to] = key;", "sorted[to] = key + (i == 77777);"),
    ("faces turned and doubled", "found[1] += side < 0;", "found[1] += side > 0;"),
    ("faces that nearly meet", "most == 0 ? side : exact_side(of, d);", "true ? side : 0;"),
    ("distances to needles", "px - u * t->ex", "px - u * t->ex * (1 + 1e-14)"),
    ("nearest points of slivers", "at = p - way;", "at = p - way * (1 + 1e-13);"),
    ("winding numbers", "7.5 * s * three", "7.0 * s * three"),
    ("segments of optical depth 1e-7 to 1e4", "+ 0.626684487f;", "+ 0.62669f;"),
    ("segments of alike and of zero ends", "0.16666542f", "0.16665f"),
    ("step functions", "s >= (floats)t->points[k]", "s >= (floats)t->points[k] + 1e-4f"),
    ("rays along edges of cells", "turn == 0 &&", "turn > 0 &&"),
    ("isosurfaces through vertices", "last = rank_of(s, to)", "last = rank_of(s, to + 1e-3f)"),
    (
        "isosurfaces in slivers and needles",
        "away = dot3(g, way) > 0 ?",
        "away = dot3(g, way) < 0 ?",
    ),
    ("hardware sampler", "3u * place + (uint3)(octant & 1,", "3u * place + (uint3)(0,"),
]


@pytest.mark.parametrize(("name", "right", "wrong"), FAULTS)
def test_faults_are_found(name: str, right: str, wrong: str) -> None:
    """On one device: it is the case that is tested."""
    changed = []

    def faulty(text: str) -> str:
        changed.append(right in text)
        return text.replace(right, wrong)

    with program.changed_sources(faulty):
        outcome = BY_NAME[name].run(open_device(str(usable_devices()[0][0])))
    assert any(changed)
    assert outcome.message == ""
    assert outcome.error > outcome.case.bound


def test_other_content_is_found(device: Device) -> None:
    stored = digests.stored()
    assert stored.keys() == digests.KINDS.keys()
    stored["surfaces"]["surface-nets"] = stored["surfaces"]["voxel-faces"]
    del stored["surfaces"]["marching-cubes"]
    assert digests.differing(device, "surfaces", stored["surfaces"]) == 2


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (DeviceError("it does not\nbuild"), "it does not?build"),
        (IndexError("beyond"), "IndexError: beyond"),
        (MemoryError(), "MemoryError: "),
        (math.nan, ""),
        (math.inf, ""),
        (1.1, ""),
    ],
)
def test_a_case_that_fails_is_a_verdict(device: Device, result, message: str) -> None:
    def measure(device: Device, full: bool) -> float:
        if isinstance(result, Exception):
            raise result
        return result

    outcome = Case("one", "nothing", "values", 1, measure).run(device)
    assert not outcome.passed
    assert outcome.message == message
    found = json.loads(json.dumps(outcome.as_dict(), allow_nan=False))
    assert found["error"] == (1.1 if result == 1.1 else None)


def test_full_reaches_the_cases(device: Device) -> None:
    asked = []

    def measure(device: Device, full: bool) -> float:
        asked.append(full)
        return 0

    cases = (Case("one", "nothing", "values", 0, measure),)
    runs = [*selftest(device, cases=cases), *selftest(device, True, cases)]
    assert [outcome.passed for outcome in runs] == [True, True]
    assert asked == [False, True]


# ---- the oracles and operands themselves


def test_operands_tell_contraction_apart() -> None:
    """A third of the products lose something, which a contraction would not."""
    a, b, c = arithmetic.operands("float", 3000)
    assert np.isfinite(arithmetic.computed(a, b, c)).all()
    exact = a.astype(np.float64) * b + c
    twice = a * b + c
    assert np.count_nonzero(exact.astype(np.float32) != twice) > 500


def test_the_distance_to_a_box_is_that_to_its_triangles() -> None:
    low, high = np.array([0.1, -0.2, 0.3]), np.array([0.7, 0.9, 0.4])
    vertices, faces = shapes.box(low, high)
    points = np.random.default_rng(1).uniform(-1, 2, (300, 3))
    points[::2] = low + (high - low) * np.random.default_rng(2).random((150, 3))
    found = fields.to_box(points, low, high)
    assert (np.abs(np.abs(found) - brute(points, vertices[faces])) < 1e-15).all()
    assert np.array_equal(found < 0, ((points > low) & (points < high)).all(axis=1))


def test_rational_distances_are_those_of_long_doubles() -> None:
    random = np.random.default_rng(3)
    triangles, points = random.uniform(-1, 1, (5, 3, 3)), random.uniform(-2, 2, (40, 3))
    apart = oracles.distances(points, triangles) - brute(points, triangles)
    assert np.abs(apart).max() < 1e-15


def test_tetrahedra_fill_their_box() -> None:
    points, cells = shapes.tetrahedra(np.array([0.0, 1, 3]), np.array([0.0, 2]), np.arange(4.0))
    p = points[cells]
    volumes = np.abs(np.linalg.det(p[:, 1:] - p[:, :1])) / 6
    assert len(cells) == 6 * 2 * 1 * 3
    assert volumes.sum() == pytest.approx(3 * 2 * 3)
    assert volumes.min() > 0.3
