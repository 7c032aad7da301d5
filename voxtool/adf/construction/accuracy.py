"""The measured error of a field, against exact distances at the same quasi-random points always."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.errors import MeshError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial.pseudonormals import Pseudonormals
from voxtool.spatial.sampling import SurfaceSampler, sample_cube
from voxtool.spatial.signed_distance import SignedDistance

PER_LEAF = 8  # points in the cube, and as many near the surface; a coarse field needs few
LEAST, MOST = 1 << 10, 1 << 15  # of them
NEAR = 1 / 64  # sides, along each axis: the largest offset of points near the surface


def measure_errors(
    field: DistanceField,
    mesh: Mesh,
    device: Device | None = None,
    samples: int | None = None,
    normals: Pseudonormals | None = None,
) -> dict[str, Any]:
    """Return the errors of a field at points throughout its cube, and near the surface; `normals`
    are the pseudo-normals of the mesh, if they are known. There are `samples` points in the cube,
    by default PER_LEAF for each leaf of the field, from LEAST to MOST, and as many near the
    surface.

    Points near the surface are uniform by area, and moved along each axis by up to NEAR sides
    (spatial/sampling.py); there are none if no face has an area. Points in leaves with a sign
    discontinuity, and points beyond the band, are excluded. The result has JSON types: "in the
    cube" and "near the surface", each with "points", their number; "max", "rms" and "p99", the 99th
    percentile, in sides of the cube; "within", the share of errors within the tolerance.
    """
    samples = samples or min(max(LEAST, PER_LEAF * field.reached["leaves"]), MOST)
    exact = SignedDistance(mesh, field.sign, device, normals)
    unit = sample_cube(samples)
    errors = {"in the cube": _errors(field, np.array(field.origin) + field.side * unit, exact)}
    with contextlib.suppress(MeshError):  # segments and points have no surface
        on_surface = np.concatenate(list(SurfaceSampler(mesh, "mesh").samples(samples)))
        near = on_surface + NEAR * field.side * (2 * unit - 1)
        errors["near the surface"] = _errors(field, near, exact)
    return errors


def _errors(field: DistanceField, points: np.ndarray, exact: SignedDistance) -> dict[str, Any]:
    distances = exact(points)
    answer = field.query(points, bounds=field.bounds is not None)
    counts = np.abs(distances) <= field.band * field.side
    if answer.bound is not None:
        counts &= np.isfinite(answer.bound)
    errors = np.abs(answer.distance - distances)[counts] / field.side
    if not len(errors):
        return {"points": 0}
    # math.fsum rounds once, whatever the order
    return {
        "points": len(errors),
        "max": float(errors.max()),
        "rms": math.sqrt(math.fsum(errors * errors) / len(errors)),
        "p99": float(np.quantile(errors, 0.99, method="inverted_cdf")),
        "within": float(np.count_nonzero(errors <= field.tolerance) / len(errors)),
    }


def helped_by_depth(
    voxels: np.ndarray, leaves: np.ndarray, errors: np.ndarray, level: int
) -> np.ndarray:
    """Return which leaves over the tolerance smaller ones would help, (n,) bool: those that the
    mesh may pass, and those whose error is no larger than where one point of the mesh is nearest.
    The others lie along the medial axis, where the distance has an edge.

    Parameters
    ----------
    voxels : (27 b,) float32
        The distances of blocks.
    leaves, errors : (n,) int, (n,) float32
        Children of the blocks, 8 block + octant, and their errors, in sides.
    level : int
        Level of the children.
    """
    blocks, (block, octant) = abs(voxels.reshape(-1, 3, 3, 3)), np.divmod(leaves, 8)
    x, y, z = octant & 1, octant >> 1 & 1, octant >> 2
    corners = [blocks[block, z + (i >> 2), y + (i >> 1 & 1), x + (i & 1)] for i in range(8)]
    half = math.sqrt(3) / 2 * 0.5**level  # of the diagonal: a corner is as near to every point
    least = np.maximum(np.min(corners, axis=0).astype(float) - half, 0)
    return (least == 0) | (errors <= np.sqrt(least * least + half * half) - least)
