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
from typing import Any

import numpy as np

from voxtool.adf.field import DistanceField
from voxtool.adf.raycast import checked_offset, local_offset
from voxtool.adf.surface import dual
from voxtool.adf.surface.field_surface import FieldSurface
from voxtool.adf.surface.leaves import COORDINATE_BITS, Leaves, vertices_near
from voxtool.adf.surface.placing import place_crossings, place_loops
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.job import Cost, Job, one_call
from voxtool.opencl import Device

STAGES = ("leaves", "crossings", "segments", "loops", "vertices", "triangles")
LEAF_BYTES, NEAR_BYTES = 120, 900  # of a leaf at peak, and of one near the surface besides


@dataclass(frozen=True)
class FieldSurfacePlan:
    """The decisions of an extraction.

    offsets : distances of its surfaces, in sides: one, or the two of a shell, the outer one first.
    leaves, crossed : the leaves of the field, and at most how many its surfaces cross.
    """

    offset: float
    shell: float | None
    offsets: tuple[float, ...]
    leaves: int
    crossed: int
    stages = STAGES

    @property
    def left_out(self) -> dict[str, str]:
        """The parts that are not run, each with the reason."""
        return {"leaves away from the surface": "their corners are all inside, or all outside"}

    @property
    def cost(self) -> Cost:
        """The memory that the job is predicted to take."""
        return Cost(0, host=LEAF_BYTES * self.leaves + NEAR_BYTES * 3 * self.crossed)

    def as_dict(self) -> dict[str, Any]:
        """The whole plan in JSON types."""
        return {
            "offset": self.offset,
            "shell": self.shell,
            "leaves": self.leaves,
            "leaves_crossed": self.crossed,
            "stages": list(self.stages),
            "left_out": self.left_out,
            "predicted_host_bytes": self.cost.host,
        }

    def rows(self) -> list[tuple[str, str]]:
        """Names and texts that `--plan` prints before the stages."""
        wall = "" if self.shell is None else f", a wall of {self.shell:g} inward"
        return [
            ("surface", f"at distance {self.offset:g}{wall}"),
            ("leaves", f"{self.leaves:,}, of which {self.crossed:,} are crossed"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the extraction needs more bytes."""
        if self.cost.host > max_memory:
            raise MemoryLimitError(
                f"the surface would need {human(self.cost.host)} of memory, of {human(max_memory)} "
                "allowed: build the field with a lower --max-level, or allow more (see "
                "--max-memory)"
            )


def plan_field_surface(
    field: DistanceField,
    *,
    offset: float = 0.0,
    shell: float | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> FieldSurfaceJob:
    """Return the planned job of a field's surface; see `voxtool.extract`."""
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
    plan = FieldSurfacePlan(offset, shell, offsets, sum(field.leaves_by_level()), 8 * crossed)
    return FieldSurfaceJob(field, plan, device, max_memory)


extract_field_surface = one_call(plan_field_surface, "extract_field_surface", FieldSurface)


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
        self, field: DistanceField, plan: FieldSurfacePlan, device: Device | None,
        max_memory: int | None,
    ) -> None:  # fmt: skip
        self.field, self.plan, self.device, self.max_memory = field, plan, device, max_memory

    def _run(self) -> FieldSurface:
        field, plan = self.field, self.plan
        with self.stage("leaves"):
            leaves = Leaves.of(field)
        vertices, faces, cut = [], [], 0
        for number, offset in enumerate(plan.offsets):
            points, triangles = self._surface(leaves, np.float32(offset))
            edge = 0.5**field.depth
            cut += int(np.count_nonzero(((points < edge) | (points > 1 - edge)).any(axis=1)))
            faces.append((triangles[:, ::-1] if number else triangles) + sum(map(len, vertices)))
            vertices.append(points)
        return FieldSurface(
            offset=plan.offset,
            shell=plan.shell,
            units=field.units,
            pitch=math.ldexp(field.side, -field.depth),
            vertices=np.array(field.origin) + field.side * np.concatenate(vertices),
            faces=np.concatenate(faces).astype(np.int32),
            cut=cut,
        )

    def _surface(self, leaves: Leaves, offset: np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices, (V, 3) float64 in sides, and the triangles at an offset."""
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
            places = place_crossings(leaves, vertices, crossings)
            points = place_loops(field, leaves, crossings, loops, count, places, offset)
            extra = np.full(loops.shape, -1)
            for ends in (segments.first[doubled], segments.second[doubled]):
                extra[tuple(ends.T)] = count + np.arange(len(doubled))
            middles = [places[ends[doubled, 0]] for ends in (segments.first, segments.second)]
            points = np.concatenate([points, (middles[0] + middles[1]) / 2])
        with self.stage("triangles"):
            inside = vertices.inside[crossings.ends[:, 0]]
            triangles, centred = dual.triangles_of(leaves, crossings, loops, extra, inside, points)
        return np.concatenate([points, places[centred]]), triangles

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
