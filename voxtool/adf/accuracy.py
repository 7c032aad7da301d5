"""The measured error of a field, against exact distances at the same quasi-random points always."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from voxtool.adf.field import DistanceField
from voxtool.errors import MeshError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial.pseudonormals import Pseudonormals
from voxtool.spatial.sampling import SurfaceSampler, sample_cube
from voxtool.spatial.signed_distance import SignedDistance

SAMPLES = 1 << 15  # points in the cube, and as many near the surface
NEAR = 1 / 64  # sides, along each axis: the largest offset of points near the surface


def measure_errors(
    field: DistanceField,
    mesh: Mesh,
    device: Device | None = None,
    samples: int = SAMPLES,
    normals: Pseudonormals | None = None,
) -> dict[str, Any]:
    """Return the errors of a field at points throughout its cube, and near the surface; `normals`
    are the pseudo-normals of the mesh, if they are known.

    Points near the surface are uniform by area, and moved along each axis by up to NEAR sides
    (spatial/sampling.py); there are none if no face has an area. Points in leaves with a sign
    discontinuity, and points beyond the band, are excluded. The result has JSON types: "in the
    cube" and "near the surface", each with "points", their number; "max", "rms" and "p99", the 99th
    percentile, in sides of the cube; "within", the share of errors within the tolerance.
    """
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
