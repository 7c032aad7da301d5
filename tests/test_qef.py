"""The minimiser of kernels/qef.h against numpy's pseudo-inverse, SciPy's bounded least squares and
exact cases, and the same bits on every device."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import opened, usable_devices
from scipy.optimize import lsq_linear

from voxtool.opencl import Device

SHARE = 0.05  # QEF_SHARE
SOURCE = """
#include "qef.h"

__kernel void minimise(__global const double *planes, const uint n, const uint each,
                       __global double *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    qef q = empty_qef();
    for (uint i = 0; i < each; ++i) {
        const double3 at = vload3(2 * (gid * each + i), planes);
        add_point(&q, at);
        add_plane(&q, at, vload3(2 * (gid * each + i) + 1, planes));
    }
    bool inside;
    const double3 at = minimum_of_qef(&q, (double3)(0), (double3)(1), &inside);
    vstore3(at, gid, found);
    found[3 * n + gid] = inside;
    found[4 * n + gid] = error_of_qef(&q, at);
}
"""


def minimise(
    device: Device, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minima in the unit cube (n, 3) of (n, m, 3) points and unit normals, whether they are those
    of all space, and their errors."""
    n, each, _ = points.shape
    found = device.empty(5 * n, np.float64)
    planes = device.put(np.stack([points, normals], axis=2).astype(np.float64))
    device.kernel(SOURCE, "minimise")(n, planes, each, found)
    values = found.get()
    return values[: 3 * n].reshape(n, 3), values[3 * n : 4 * n] == 1, values[4 * n :]


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scenes(each: int) -> tuple[np.ndarray, np.ndarray]:
    """Random planes at points of the unit cube: of any direction, of two directions and of one."""
    rng = np.random.default_rng(each)
    points = rng.uniform(0, 1, (90, each, 3))
    points[::2] **= 6  # near the sides, beyond which the minimum then often lies
    normals = unit(rng.normal(size=(90, each, 3)))
    normals[30:60] = normals[30:60, np.arange(each) % min(each, 2)]
    normals[60:] = normals[60:, :1]
    return points, normals


@pytest.mark.parametrize("each", [1, 2, 3, 5, 12])
def test_minimum_is_that_of_bounded_least_squares(device: Device, each: int) -> None:
    points, normals = scenes(each)
    found, inside, errors = minimise(device, points, normals)
    mean = points.mean(axis=1)
    beyond = 0
    for i in range(len(points)):
        offsets = ((points[i] - mean[i]) * normals[i]).sum(axis=1)
        singular = np.linalg.svd(normals[i], compute_uv=False)
        near = np.abs(singular / singular[0] - SHARE).min() < 1e-3
        truncated = ((singular < SHARE * singular[0]) & (singular > 1e-12)).any()
        if near or truncated:
            continue  # a direction that is flat for the one and not for the other
        free = mean[i] + np.linalg.pinv(normals[i], rcond=SHARE) @ offsets
        if ((free >= 1e-9) & (free <= 1 - 1e-9)).all():
            assert inside[i]
            np.testing.assert_allclose(found[i], free, rtol=0, atol=1e-9)
            continue
        beyond += 1
        # a small weight on what is free makes the nearest point of the box unique
        right = (points[i] * normals[i]).sum(axis=1)
        best = lsq_linear(normals[i], right, (0, 1), tol=1e-14, method="bvls")
        error = float(((normals[i] @ best.x - right) ** 2).sum())
        assert errors[i] == pytest.approx(error, abs=2e-5)
        assert found[i].min() >= 0
        assert found[i].max() <= 1
    assert each == 1 or beyond > 5


def test_exact_corner_edge_and_plane(device: Device) -> None:
    """Axis-aligned planes meet in a point; two leave a line and one a plane, nearest the mean."""
    axes = np.eye(3)
    points = np.array([[0.25, 0.9, 0.5], [0.75, 0.5, 0.125], [0.5, 0.25, 0.375]])
    corner, _, errors = minimise(device, points[None], axes[None])
    np.testing.assert_allclose(corner, [[0.25, 0.5, 0.375]], rtol=0, atol=1e-15)
    assert errors[0] < 1e-15
    edge, _, _ = minimise(device, points[None, :2], axes[None, :2])
    np.testing.assert_allclose(edge, [[0.25, 0.5, 0.3125]], rtol=0, atol=1e-15)
    plane, _, _ = minimise(device, points[None], axes[None, [2, 2, 2]])
    np.testing.assert_allclose(plane[0], [0.5, 0.55, 1 / 3], rtol=0, atol=1e-15)


def test_corner_beyond_the_box_goes_where_its_planes_are_nearest(device: Device) -> None:
    """Two planes meet beyond a face: the best point is not the corner's projection to the face."""
    normals = unit(np.array([[[1, 4, 0], [1, -1, 0]]], float))
    points = np.array([[[1.3, 0.5, 0.5], [1.3, 0.5, 0.5]]])
    found, inside, errors = minimise(device, points, normals)
    y = np.linspace(0, 1, 100_001)
    sides = normals[0, :, :2] @ np.array([np.full_like(y, 1 - 1.3), y - 0.5])
    errors_of_face = (sides**2).sum(axis=0)
    assert not inside[0]
    assert found[0, 0] == 1
    assert found[0, 1] == pytest.approx(y[errors_of_face.argmin()], abs=1e-4)
    assert abs(found[0, 1] - 0.5) > 0.02
    assert errors[0] == pytest.approx(errors_of_face.min(), abs=1e-6)


def test_devices_agree_in_every_bit() -> None:
    found = [
        minimise(opened(index), *scenes(7))[k].tobytes()
        for index, _ in usable_devices()
        for k in (0, 2)
    ]
    assert len(set(found)) == 2
