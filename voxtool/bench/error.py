"""How far two surfaces are apart, measured from points spread over each to the other.

After Cignoni, Rocchini and Scopigno, "Metro: measuring error on simplified surfaces", 1998. Points
are spread by area, and in the same places every time: the area, summed along the faces, is cut into
equal strata, the middle of each names a face, and there the point is the next of Roberts's
low-discrepancy sequence R2. So a face has its share of the points to within one; faces without area
have none. Distances are exact to rounding (voxtool.proximity).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MeshError, VoxtoolError, count_of
from voxtool.opencl import open_device
from voxtool.proximity.bvh import Frame
from voxtool.proximity.distance import TriangleDistance

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.mesh import Mesh
    from voxtool.opencl import Device

BLOCK = 1 << 18  # points that are made at once
PLASTIC = 1.324717957244746  # the real root of x^3 = x + 1, which R2 is made of


def deviation(
    surface: Mesh,
    reference: Mesh,
    samples: int = 100_000,
    pitch: float | None = None,
    device: Device | None = None,
) -> dict[str, Any]:
    """The deviation between two surfaces, both ways: mean, root mean square and maximum.

    Mean and RMS are over `samples` points, spread by area. The maximum is over these and the
    vertices of the mesh that they are on, as far as faces use them. It is a lower bound of the
    one-sided Hausdorff distance: between the points, the surface may be farther away. So is
    "hausdorff", the larger of the two, of the Hausdorff distance.

    Parameters
    ----------
    samples : points on each of the two; pitch : side of a voxel, world units.

    Returns
    -------
    JSON types: "samples"; "surface_to_reference" and "reference_to_surface", each with "mean",
    "rms", "max" and "vertices", the number of vertices that count for the maximum; "hausdorff";
    "maximum_is": "lower bound". World units. With a pitch also "pitch", and in "voxels" the
    distances in voxels.

    Raises
    ------
    MeshError : a mesh without faces or of zero area, or of an extent beyond 2^±500.
    VoxtoolError : samples or pitch is not positive, or the meshes are 2^500 extents apart.
    DeviceError : there is no device, or it has no double precision.
    """
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer) or samples < 1:
        raise VoxtoolError(f"samples {samples}: give a whole number from 1 on")
    if pitch is not None and not 0 < pitch < math.inf:
        raise VoxtoolError(f"pitch {pitch:g}: give a length greater than 0")
    spreads = [
        _Spread(mesh, name) for mesh, name in ((surface, "surface"), (reference, "reference"))
    ]
    device = device or open_device()
    there = _one_way(spreads[0], TriangleDistance(reference, device), int(samples))
    back = _one_way(spreads[1], TriangleDistance(surface, device), int(samples))
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


def _one_way(spread: _Spread, to: TriangleDistance, samples: int) -> dict[str, Any]:
    """Mean, RMS and maximum of the distances from a mesh's samples, and vertices, to another."""
    distances = np.concatenate([to(points) for points in spread.samples(samples)])
    vertices = spread.vertices()
    farthest = float(distances.max())
    # math.fsum rounds once, whatever the order; the squares are of numbers up to 1
    relative = distances / farthest if farthest > 0 else distances
    return {
        "mean": math.fsum(distances) / samples,
        "rms": farthest * math.sqrt(math.fsum(relative * relative) / samples),
        "max": max(farthest, float(to(vertices).max())),
        "vertices": len(vertices),
    }


class _Spread:
    """Points spread by area over a mesh."""

    def __init__(self, mesh: Mesh, name: str) -> None:
        """Sum the area; raises MeshError where there is none."""
        self.mesh = mesh
        a, b, c = (Frame.of(mesh).local(mesh.vertices[mesh.faces[:, i]]) for i in range(3))
        (ex, ey, ez), (fx, fy, fz) = (b - a).T, (c - a).T
        x, y, z = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
        self.area = np.cumsum(np.sqrt(x * x + y * y + z * z))  # adds one by one, in order
        if not self.area[-1] > 0:
            raise MeshError(
                f"{mesh.name or name}: no area: each of its {count_of(len(mesh.faces), 'face')} is "
                "a segment or a point: give a mesh whose faces have an area"
            )

    def samples(self, count: int) -> Iterator[np.ndarray]:
        """`count` points, in blocks of (n, 3)."""
        last = int(np.searchsorted(self.area, self.area[-1]))  # with an area
        for start in range(0, count, BLOCK):
            i = np.arange(start, min(start + BLOCK, count), dtype=np.float64)
            along = (i + 0.5) / count * self.area[-1]
            faces = np.minimum(np.searchsorted(self.area, along, side="right"), last)
            u, v = (0.5 + i / PLASTIC) % 1.0, (0.5 + i / (PLASTIC * PLASTIC)) % 1.0
            beyond = u + v > 1.0  # the other half of the parallelogram
            u, v = np.where(beyond, 1.0 - u, u)[:, None], np.where(beyond, 1.0 - v, v)[:, None]
            a, b, c = (self.mesh.vertices[self.mesh.faces[faces, corner]] for corner in range(3))
            yield a + u * (b - a) + v * (c - a)

    def vertices(self) -> np.ndarray:
        """(n, 3) the vertices that faces use."""
        used = np.zeros(len(self.mesh.vertices), bool)
        used[self.mesh.faces] = True
        return self.mesh.vertices[used]
