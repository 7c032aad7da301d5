"""The deviation between two surfaces: distances from samples of each to the other [Cignoni 1998].

Samples are quasi-random, uniform by area, and the same every time (sampling.py). Distances are
exact up to rounding (distance.py).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import default_device
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.sampling import SurfaceSampler

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device


def deviation(
    surface: Mesh,
    reference: Mesh,
    samples: int = 100_000,
    pitch: float | None = None,
    device: Device | None = None,
) -> dict[str, Any]:
    """Return the deviation between two surfaces, in both directions; see voxtool.deviation."""
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer) or samples < 1:
        raise VoxtoolError(f"samples {samples}: give a whole number from 1 on")
    if pitch is not None and not 0 < pitch < math.inf:
        raise VoxtoolError(f"pitch {pitch:g}: give a length greater than 0")
    samplers = [
        SurfaceSampler(mesh, name)
        for mesh, name in ((surface, "surface"), (reference, "reference"))
    ]
    device = device or default_device()
    there = _one_way(samplers[0], TriangleDistance(reference, device), int(samples))
    back = _one_way(samplers[1], TriangleDistance(surface, device), int(samples))
    result: dict[str, Any] = {
        "samples": int(samples),
        "surface_to_reference": there,
        "reference_to_surface": back,
        "hausdorff": max(there["max"], back["max"]),
        "maximum_is": "lower bound",
    }
    if pitch is not None:
        result["pitch"] = float(pitch)
        result["voxels"] = {
            **{
                way: {name: result[way][name] / float(pitch) for name in ("mean", "rms", "max")}
                for way in ("surface_to_reference", "reference_to_surface")
            },
            "hausdorff": result["hausdorff"] / float(pitch),
        }
    return result


def _one_way(sampler: SurfaceSampler, to: TriangleDistance, samples: int) -> dict[str, Any]:
    """Return mean, RMS and maximum of the distances from samples and vertices to a mesh."""
    distances = np.concatenate([to(points) for points in sampler.samples(samples)])
    vertices = sampler.vertices()
    farthest = float(distances.max())
    # math.fsum rounds once, whatever the order; the squares are of numbers up to 1
    relative = distances / farthest if farthest > 0 else distances
    return {
        "mean": math.fsum(distances) / samples,
        "rms": farthest * math.sqrt(math.fsum(relative * relative) / samples),
        "max": max(farthest, float(to(vertices).max())),
        "vertices": len(vertices),
    }
