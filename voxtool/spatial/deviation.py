"""The deviation between two surfaces: mean and RMS of the distances from samples of each to the
other [Cignoni 1998], and bounds of the largest distance.

Samples are quasi-random, uniform by area, and the same every time (sampling.py). Distances are
exact up to rounding (distance.py). The bounds hold for all points (hausdorff.py).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.mesh.lengths import in_units
from voxtool.opencl import default_device
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import bound, tolerance_of
from voxtool.spatial.sampling import SurfaceSampler

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.hausdorff import DirectedHausdorff


MEASURES = ("mean", "rms", "max", "max_upper")  # of a direction, all lengths
WAYS = ("surface_to_reference", "reference_to_surface")


def deviation(
    surface: Mesh,
    reference: Mesh,
    samples: int = 100_000,
    pitch: float | None = None,
    device: Device | None = None,
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Return the deviation between two surfaces, in both directions; see voxtool.deviation."""
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer) or samples < 1:
        raise VoxtoolError(f"samples {samples}: give a whole number from 1 on")
    if pitch is not None and not 0 < pitch < math.inf:
        raise VoxtoolError(f"pitch {pitch:g}: give a length greater than 0")
    reference = in_units(reference, surface.units)
    samplers = [
        SurfaceSampler(mesh, name)
        for mesh, name in ((surface, "surface"), (reference, "reference"))
    ]
    device, tolerance = device or default_device(), tolerance_of(surface, reference, tolerance)
    there = one_way(samplers[0], TriangleDistance(reference, device), int(samples), tolerance)
    back = one_way(samplers[1], TriangleDistance(surface, device), int(samples), tolerance)
    ways = dict(zip(WAYS, (there, back), strict=True))
    result: dict[str, Any] = {
        "samples": int(samples),
        "tolerance": tolerance,
        **ways,
        "hausdorff": max(there["max"], back["max"]),
        "hausdorff_upper": max(there["max_upper"], back["max_upper"]),
    }
    if pitch is not None:
        result["pitch"] = float(pitch)
        result["voxels"] = {
            way: {name: found[name] / float(pitch) for name in MEASURES}
            for way, found in ways.items()
        }
        for name in ("hausdorff", "hausdorff_upper"):
            result["voxels"][name] = result[name] / float(pitch)
    return result


def one_way(
    sampler: SurfaceSampler, to: TriangleDistance, samples: int, tolerance: float
) -> dict[str, Any]:
    """Return mean and RMS of the distances from samples to a mesh, and bounds of the largest."""
    with to.device.stage("bounds"):
        bounds = bound(sampler.mesh, sampler.mesh.faces, to, tolerance)
    return {**averages(sampler, to, samples), **largest(bounds)}


def averages(sampler: SurfaceSampler, to: TriangleDistance, samples: int) -> dict[str, float]:
    """Return mean and RMS of the distances from samples to a mesh."""
    distances = np.concatenate([to(points) for points in sampler.samples(samples)])
    furthest = float(distances.max())
    # math.fsum rounds once, whatever the order; the squares are of numbers up to 1
    relative = distances / furthest if furthest > 0 else distances
    return {
        "mean": math.fsum(distances) / samples,
        "rms": furthest * math.sqrt(math.fsum(relative * relative) / samples),
    }


def largest(bounds: DirectedHausdorff) -> dict[str, Any]:
    """Return the bounds of the largest distance, and where it is, in JSON types."""
    return {
        "max": bounds.lower,
        "max_upper": bounds.upper,
        "point": bounds.point.tolist(),
        "nearest": bounds.nearest.tolist(),
    }
