"""Extraction of a surface from a distance field: dual contouring over its leaves.

The surface is that of [Ju 2002], with the loops of dual.py in place of one vertex a leaf, so that
it is a closed manifold whatever the values. The stages: leaves and their vertices near the surface
(leaves.py), crossings, segments, loops and triangles (dual.py), places (placing.py). They run on
the host, with exact comparisons of float32 and + - * / of float64 in a fixed order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.raycast import checked_offset, local_offset
from voxtool.adf.surface import dual
from voxtool.adf.surface.field_surface import FieldSurface
from voxtool.adf.surface.leaves import COORDINATE_BITS, Leaves, vertices_near
from voxtool.adf.surface.placing import CLEAR, MARGIN, place_crossings, place_loops
from voxtool.adf.surface.sharp import Features, apart, nearest_planes, place_features
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of
from voxtool.job import Cost, Job, Plan, one_call
from voxtool.mesh.lengths import in_units
from voxtool.mesh.mesh import Mesh, check_source
from voxtool.morton import distinct
from voxtool.opencl import Device, default_device
from voxtool.spatial.bvh import tree_bytes
from voxtool.spatial.distance import TriangleDistance
from voxtool.vector import length

STAGES = ("leaves", "crossings", "segments", "loops", "vertices", "triangles")
SHARP_STAGES = ("tree", "distance", "self-intersections")
LEAF_BYTES, NEAR_BYTES = 120, 900  # of a leaf at peak, and of one near the surface besides
SHARP_BYTES, SHARP_DEVICE_BYTES = 1200, 500  # of a leaf that is crossed, besides


@dataclass(frozen=True)
class FieldSurfacePlan(Plan):
    """The decisions of an extraction.

    offsets : distances of its surfaces, in sides: one, or the two of a shell, the outer one first.
    leaves, crossed : the leaves of the field, and at most how many its surfaces cross.
    source_faces : those of the source whose edges and corners are kept; 0 without one.
    """

    facts = ("offset", "shell", "sharp", "leaves", "leaves_crossed: crossed")
    costs = ("device", "host")

    offset: float
    shell: float | None
    offsets: tuple[float, ...]
    leaves: int
    crossed: int
    source_faces: int = 0

    @property
    def stages(self) -> tuple[str, ...]:
        return (*STAGES, *SHARP_STAGES) if self.source_faces else STAGES

    @property
    def sharp(self) -> bool:
        """True if edges and corners are kept."""
        return self.source_faces > 0

    @property
    def reasons(self) -> dict[str, str]:
        rounded = "they are rounded off within a leaf: no source is given"
        return {
            "leaves away from the surface": "their corners are all inside, or all outside",
            "edges and corners": "" if self.sharp else rounded,
        }

    @property
    def cost(self) -> Cost:
        """The memory that the job is predicted to take."""
        host, device = LEAF_BYTES * self.leaves + NEAR_BYTES * 3 * self.crossed, 0
        if self.source_faces:
            host += SHARP_BYTES * self.crossed
            device = tree_bytes(self.source_faces) + SHARP_DEVICE_BYTES * self.crossed
        return Cost(device, host=host)

    def rows(self) -> list[tuple[str, str]]:
        wall = "" if self.shell is None else f", a wall of {self.shell:g} inward"
        return [
            ("surface", f"at distance {self.offset:g}{wall}"),
            ("leaves", f"{self.leaves:,}, of which {self.crossed:,} are crossed"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        if shortage := Cost(0, self.cost.host).shortage(max_memory, max_allocation):
            raise MemoryLimitError(
                f"the surface {shortage}: build the field with a lower --max-level, or allow more "
                "(see --max-memory)"
            )


def plan_field_surface(
    field: DistanceField,
    *,
    offset: float = 0.0,
    shell: float | None = None,
    source: Mesh | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> FieldSurfaceJob:
    """Return the planned job of a field's surface; see `voxtool.extract`. With a source, its edges
    and corners are kept."""
    if source is not None:
        check_source(source, field.source_sha256, "field")
        source = in_units(source, field.units)
    offset = checked_offset(field, float(offset))
    distances = [offset]
    if shell is not None:
        if not (math.isfinite(shell) and shell > 0):
            raise VoxtoolError(f"a wall of {shell}: its thickness is a positive distance")
        distances.append(offset - shell)
    if field.depth >= COORDINATE_BITS:
        raise VoxtoolError(
            f"the field has leaves of level {field.depth}: build it with --max-level 20"
        )
    for distance in distances:
        if field.sign == "none" and distance <= 0:
            raise VoxtoolError(
                f"the field has no signs, so no surface at distance {distance:g}: give a larger "
                "--offset, or build it with --sign winding"
            )
        if abs(distance) > field.band * field.side:
            raise VoxtoolError(
                f"a surface at distance {distance:g}: the field is sampled within a band of "
                f"{field.band * field.side:g} only; build it with a wider --band"
            )
    offsets = tuple(local_offset(field, distance) for distance in distances)
    crossed = 0
    for each in offsets:
        inside = field.voxels < np.float32(each)
        crossed += int(np.count_nonzero(inside.any(axis=(1, 2, 3)) & ~inside.all(axis=(1, 2, 3))))
    leaves = sum(field.leaves_by_level())
    plan = FieldSurfacePlan(
        offset, shell, offsets, leaves, 8 * crossed, len(source.faces) if source else 0
    )
    if source is not None:
        device = device or default_device()
        device.require_float64("sharp surfaces")
    return FieldSurfaceJob(field, plan, source, device, max_memory)


extract_field_surface = one_call(plan_field_surface, "extract_field_surface", FieldSurface)


class Part(NamedTuple):
    """One surface: points, (V, 3) float64, world units; triangles, (F, 3); the number of vertices
    on the cube's boundary; and of triangles that others may pass through, if that was tested."""

    points: np.ndarray
    triangles: np.ndarray
    cut: int
    tangled: int = 0


class FieldSurfaceJob(Job[FieldSurface]):
    """The planned extraction of a field's surface.

    Attributes
    ----------
    field : DistanceField
        The field whose surface is extracted.
    plan : FieldSurfacePlan
        The decisions.
    """

    plan: FieldSurfacePlan

    def __init__(
        self, field: DistanceField, plan: FieldSurfacePlan, source: Mesh | None,
        device: Device | None, max_memory: int | None,
    ) -> None:  # fmt: skip
        self.field, self.plan, self.source = field, plan, source
        self.device, self.max_memory = device, max_memory
        self._distance: TriangleDistance | None = None

    def _run(self) -> FieldSurface:
        field, plan = self.field, self.plan
        with self.stage("leaves"):
            leaves = Leaves.of(field)
        if self.source is not None:
            self._distance = TriangleDistance(self.source, self.device)
        parts = [self._surface(leaves, np.float32(offset)) for offset in plan.offsets]
        faces, first = [], 0
        for number, part in enumerate(parts):  # the second one is the inside of a wall
            faces.append((part.triangles[:, ::-1] if number else part.triangles) + first)
            first += len(part.points)
        return FieldSurface(
            offset=plan.offset,
            shell=plan.shell,
            units=field.units,
            pitch=math.ldexp(field.side, -field.depth),
            vertices=np.concatenate([part.points for part in parts]),
            faces=np.concatenate(faces).astype(np.int32),
            cut=sum(part.cut for part in parts),
            tangled=None if self.source is None else sum(part.tangled for part in parts),
        )

    def _surface(self, leaves: Leaves, offset: np.float32) -> Part:
        """Return the surface at an offset."""
        field = self.field
        with self.stage("crossings"):
            vertices = vertices_near(field, leaves, offset)
            crossings = dual.find_crossings(leaves, vertices)
        with self.stage("segments"):
            segments = dual.find_segments(leaves, vertices, crossings)
        with self.stage("loops"):
            loops, count = dual.find_loops(crossings, segments)
            doubled = dual.doubled(segments, loops)
        with self.stage("vertices"):
            margin = CLEAR if self._distance else MARGIN
            places = place_crossings(leaves, vertices, crossings, margin)
            smooth, of = place_loops(
                field, leaves, vertices, crossings, loops, count, places, offset
            )
            extra = np.full(loops.shape, -1)
            for ends in (segments.first[doubled], segments.second[doubled]):
                extra[tuple(ends.T)] = count + np.arange(len(doubled))
            middles = [places[ends[doubled, 0]] for ends in (segments.first, segments.second)]
            between = (middles[0] + middles[1]) / 2
        edge = 0.5**field.depth
        cut = int(np.count_nonzero(((smooth < edge) | (smooth > 1 - edge)).any(axis=1)))
        features = None
        if self._distance:
            features = self._features(leaves, of, crossings, loops, places, offset)
        points = np.concatenate([features.points if features else smooth, between])
        with self.stage("triangles"):
            inside = vertices.inside[crossings.ends[:, 0]]
            triangles, centred = dual.triangles_of(
                leaves, crossings, loops, extra, inside, points, features
            )
        others = np.concatenate([between, places[centred]])  # these stay where they are
        points = self._world(np.concatenate([points[:count], others]))
        if not features or not len(triangles):
            return Part(points, triangles, cut)
        homes = [smooth, features.centres]
        homes = [self._world(np.concatenate([home, others])) for home in homes]
        assert self.device
        with self.stage("self-intersections"):
            points, tangled = apart(points, homes, triangles, self.device)
        return Part(points, triangles, cut, tangled)

    def _world(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) points in sides of the cube as world points."""
        return np.array(self.field.origin) + self.field.side * points

    def _features(
        self, leaves: Leaves, of: np.ndarray, crossings: dual.Crossings, loops: np.ndarray,
        places: np.ndarray, offset: np.float32,
    ) -> Features:  # fmt: skip
        """Return the vertices of loops on the features of the source.

        of : (n,) int64, their leaves; places : (c, 3) float64, of the crossings, sides.
        """
        field, distance, source = self.field, self._distance, self.source
        assert distance
        assert source
        near, normals = nearest_planes(distance, source, self._world(places))
        moved = near + abs(float(offset)) * field.side * normals
        on = (moved - np.array(field.origin)) / field.side
        # across a hole, and at the sides of the cube, the source is elsewhere
        astray = length(on - places) > np.ldexp(1.0, -crossings.levels)
        on[astray], normals[astray] = places[astray], 0
        # a crossing counts once for a loop, also if its leaf is twice around it
        crossing = np.repeat(np.arange(len(loops)), 4)
        each = distinct(loops.ravel() * np.int64(len(loops)) + crossing)
        loop, crossing = np.divmod(each, max(len(loops), 1))
        low = np.ldexp(leaves.cells(of).astype(np.float64), -leaves.levels[of, None])
        size = np.ldexp(1.0, -leaves.levels[of])
        with distance.device.stage("features"):
            return place_features(distance.device, low, size, loop, on[crossing], normals[crossing])

    def notes(self, result: FieldSurface) -> Iterator[str]:
        """Yield the shells and the volume beside those of a mesh thinner than leaves, if it has
        other shells."""
        thin = self._thin(result)
        if thin and thin["shells"] != result.check()["shells"]:
            yield self._beside(result, thin)

    def details(self, result: FieldSurface) -> Iterator[str]:
        """Yield the shells and the volume beside those of a mesh thinner than leaves, if it has as
        many shells."""
        thin = self._thin(result)
        if thin and thin["shells"] == result.check()["shells"]:
            yield self._beside(result, thin)

    def _thin(self, result: FieldSurface) -> dict[str, Any]:
        """Return what the field says of a mesh thinner than its leaves; {} for another surface."""
        thin = self.field.reached.get("thin")
        if not isinstance(thin, dict) or not {"leaves", "shells", "volume"} <= set(thin):
            return {}
        return {} if result.offset or result.shell else thin

    @staticmethod
    def _beside(result: FieldSurface, thin: dict[str, Any]) -> str:
        found = result.check()
        return (
            f"the mesh is thinner than {count_of(thin['leaves'], 'leaf')}: the surface has "
            f"{count_of(found['shells'], 'shell')} and volume {found['volume']:.6g}, the mesh "
            f"{count_of(thin['shells'], 'shell')} and volume {thin['volume']:.6g}"
        )

    def findings(self, result: FieldSurface) -> Iterator[str]:
        """Yield why the surface is empty, or that it leaves the cube."""
        if not len(result.faces):
            low, high = (self.field.side * float(f(self.field.voxels)) for f in (np.min, np.max))
            yield (
                f"there is no surface at distance {result.offset:g}: the field has distances from "
                f"{low:.6g} to {high:.6g}"
            )
        elif result.cut:
            yield (
                "the surface leaves the field's cube, and is closed at its sides: choose a smaller "
                "--offset"
            )
        if result.tangled:
            yield (
                f"{count_of(result.tangled, 'face')} of {len(result.faces):,} may pass through "
                "others: build the field with another --max-level"
            )
