"""The surfaces of all labels of an octree: one closed mesh a label, with common borders.

One surface holds each face between two labels, or between a label and what is unset, once. The mesh
of a label is the triangles that have it on one side, so two labels beside each other have the same
vertices and triangles, in opposite order.

The stages: find the faces between labels (borders.py); number their corners; place the vertices,
and relax them (junctions.py); split the faces into triangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.arrays import Data, digest_of, read_only
from voxtool.choices import BY, LABEL, LABEL_STYLES, STYLE_ALIASES, SURFACE_NETS, VOXEL_FACES
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import closed_chain
from voxtool.opencl import Device
from voxtool.svo.octree.attributes import has_colours
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.borders import AT_ONCE, Blocks, find_borders
from voxtool.svo.surface.colours import surface_colours
from voxtool.svo.surface.isosurface import enclosed, in_world, painted, six_volumes
from voxtool.svo.surface.junctions import corner_points, net_of, relaxed_points, split
from voxtool.svo.surface.plan import RELAXATIONS

UNSET = -1  # on the side of a triangle where no label is
BRICK_FACES = 24  # predicted, of a brick with set voxels: a layer, and half of another one
BRICK_BYTES = 64  # bytes of memory for a brick beside its labels
FACE_BYTES = 320  # for a face, when its corners are numbered
PART_BYTES = 3000  # for each brick of those that are looked at together
MAX_FACES = 1 << 29  # so that 32 bits number their corners


@dataclass(frozen=True, eq=False, repr=False)
class LabelledSurface(Data):
    """The surfaces of all labels of an octree.

    Attributes
    ----------
    grid
        Grid of the octree.
    units
        name of the world unit if known, or "".
    style
        "voxel-faces" or "surface-nets".
    names
        names of the labels.
    points
        (V, 3) int32, vertices in 2**-14 of a voxel's side from the grid's corner.
    faces
        (F, 3) int32, triangles of all labels, each once.
    sides
        (F, 2) int32, the label behind each triangle and that before it, from where its corners are
        counter-clockwise; -1 where no voxel is set. Between two labels the lower one is behind.
    colours
        of the mesh of each of `labels`, uint8, sRGB and opacity: (n, 4) of its vertices, or with
        voxel faces of its triangles; () if the octree has none, or they were not requested.
    """

    grid: Grid
    units: str
    style: str
    names: tuple[str, ...]
    points: np.ndarray
    faces: np.ndarray
    sides: np.ndarray
    colours: tuple[np.ndarray, ...] = ()

    def __repr__(self) -> str:
        return (
            f"LabelledSurface({self.style}, {len(self.labels):,} labels, "
            f"{len(self.points):,} vertices, {len(self.faces):,} triangles)"
        )

    @property
    def text(self) -> str:
        """The kind of surface, in words."""
        return f"{self.style}, {len(self.labels):,} labels"

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) float64: the vertices, in world units."""
        return read_only(in_world(self.points, 1, self.grid))

    @cached_property
    def _sorted(self) -> tuple[np.ndarray, np.ndarray]:
        """The sides by their labels: of 2 F sides the order, first those behind, and the first of
        each label."""
        sides = self.sides.T.ravel()
        order = np.argsort(sides, kind="stable")
        return order, np.searchsorted(sides[order], np.arange(len(self.names) + 1))

    @property
    def triangles(self) -> np.ndarray:
        """(names,) int64: the number of triangles of each label."""
        return np.diff(self._sorted[1])

    @property
    def labels(self) -> list[int]:
        """The labels that have triangles."""
        return np.flatnonzero(self.triangles).tolist()

    def faces_of(self, label: int) -> np.ndarray:
        """Return the triangles of a label, (n, 3) int32, counter-clockwise seen from outside."""
        order, first = self._sorted
        own, before = np.divmod(order[first[label] : first[label + 1]], len(self.faces))[::-1]
        found = self.faces[own]
        return np.where(before[:, None] == 1, found[:, [0, 2, 1]], found)

    def mesh(self, label: int | str) -> Mesh:
        """Return the closed mesh of a label or of its name, in world units, with those vertices
        that it has, and its colours; VoxtoolError if no label has the name."""
        if isinstance(label, str):
            if label not in self.names:
                raise VoxtoolError(f"no label is named {label!r}: it has {', '.join(self.names)}")
            label = self.names.index(label)
        used, faces = np.unique(self.faces_of(label), return_inverse=True)
        faces = faces.reshape(-1, 3).astype(np.int32)
        mesh = Mesh(self.vertices[used], faces, name=self.names[label], units=self.units)
        if not self.colours:
            return mesh
        return painted(mesh, self.colours[self.labels.index(label)], self.style)[0]

    def meshes(self) -> list[Mesh]:
        """Return the meshes of the labels that have triangles, which are named after them."""
        return [self.mesh(label) for label in self.labels]

    def facts(self, check: bool = False) -> list[dict[str, Any]]:
        """Return the triangles of each label, how many of them are borders with other labels, and
        the volume within them, in JSON types; on request also whether its mesh is closed."""
        inner = np.bincount(self.sides[(self.sides != UNSET).all(axis=1)].ravel(), minlength=1)
        found = []
        for label in self.labels:
            shared = int(inner[label]) if label < len(inner) else 0
            own = {"label": label, "name": self.names[label]}
            own |= {"triangles": int(self.triangles[label]), "shared_triangles": shared}
            own["volume"] = enclosed(six_volumes(self.points, self.faces_of(label)), 1, self.grid)
            if check:
                own["closed"] = closed_chain(self.mesh(label))
            found.append(own)
        return found

    def digest(self) -> str:
        """Return the SHA-256 of grid, style, names, points, faces and sides, and of colours if
        there are any, in little-endian order. Equal content has an equal digest on every device and
        platform."""
        head = {**self.grid.exact, "style": self.style, "names": list(self.names)}
        return digest_of(head, self.points, self.faces, self.sides, *self.colours)


@dataclass(frozen=True)
class LabelledPlan(Plan):
    """The decisions of an extraction by label."""

    by = LABEL
    facts = ("style", "by", "labels", "bricks")
    predicted, costs = ("faces",), ("host",)
    refusal = (
        "{plan.style} of {plan.faces:,} faces between labels {shortage}: voxelize with a smaller "
        "dim, or allow more (see --max-memory)"
    )

    style: str
    labels: int  # names
    bricks: int  # that have set voxels
    faces: int  # predicted, then counted: between voxels of different labels
    relaxations: int
    coloured: bool = False  # the octree's voxels have colours
    colours: bool = False  # and so will the meshes

    @property
    def stages(self) -> list[str]:
        relax = ["relax"] if self.relaxations else []
        return ["labels", "borders", "vertices", *relax, "triangles", *["colours"] * self.colours]

    @property
    def reasons(self) -> dict[str, str]:
        device = "the device, but for nearest colours" if self.colours else "the device"
        without = self.coloured and not self.colours
        return {
            device: "faces between labels are few, and are found brick by brick",
            "relaxation": "" if self.relaxations else "voxel faces lie on the corners of voxels",
            "colours": "the meshes are written without" if without else "",
        }

    @property
    def cost(self) -> Cost:
        """The predicted bytes on the host, the surface included."""
        label = np.min_scalar_type(self.labels).itemsize
        values = (BRICK_SIDE**3 * label + BRICK_BYTES) * self.bricks
        parts = PART_BYTES * min(self.bricks, AT_ONCE)
        return Cost(device=0, host=values + FACE_BYTES * self.faces + parts)

    def rows(self) -> list[tuple[str, str]]:
        return [
            ("surfaces", f"{self.style}, of up to {self.labels:,} labels"),
            ("faces", f"about {self.faces:,} between labels, in {self.bricks:,} bricks"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        if self.faces > MAX_FACES:
            raise MemoryLimitError(
                f"{self.faces:,} faces between labels exceed the {MAX_FACES:,} that are numbered: "
                "voxelize with a smaller dim"
            )
        super().refuse_beyond(max_memory, max_allocation)


def plan_labelled(
    octree: Octree,
    *,
    by: str = LABEL,
    style: str = SURFACE_NETS,
    device: Device | None = None,
    max_memory: int | None = None,
) -> LabelledJob:
    """Return the planned extraction of one mesh for each label; see voxtool.extract. The device
    finds nearest voxels with a colour, where some have none."""
    style = STYLE_ALIASES.get(style, style)
    if by not in BY:
        raise VoxtoolError(f"by {by!r} is unknown: choose {' or '.join(BY)}")
    if style not in LABEL_STYLES:
        raise VoxtoolError(
            f"style {style!r} makes no meshes with common borders: choose one of "
            f"{', '.join(LABEL_STYLES)}"
        )
    if all(attribute.name != LABEL for attribute in octree.attributes):
        raise VoxtoolError("the octree has no labels: voxelize with --labels part, or another one")
    if "solid" not in octree.mode and style == SURFACE_NETS:
        raise VoxtoolError(
            f"an octree of mode {octree.mode} has no inside to extract a {style} surface from: "
            f"voxelize with --mode solid, or extract {VOXEL_FACES}"
        )
    bricks = int(np.count_nonzero(octree.bricks))
    plan = LabelledPlan(
        style=style,
        labels=len(octree.attribute(LABEL).names),
        bricks=bricks,
        faces=BRICK_FACES * bricks,
        relaxations=RELAXATIONS if style == SURFACE_NETS else 0,
        coloured=has_colours(octree),
        colours=has_colours(octree),
    )
    return LabelledJob(octree, plan, device, max_memory)


class LabelledJob(Job[LabelledSurface]):
    """The planned extraction of one mesh for each label, on the host except for nearest voxels.

    Attributes
    ----------
    octree : Octree
        An octree with labels.
    plan : LabelledPlan
        The decisions.
    """

    plan: LabelledPlan
    device = None

    def __init__(
        self, octree: Octree, plan: LabelledPlan, nearest: Device | None, max_memory: int | None
    ) -> None:
        self.octree, self.plan, self.max_memory = octree, plan, max_memory
        self.nearest = nearest

    def _run(self) -> LabelledSurface:
        octree, plan = self.octree, self.plan
        with self.stage("labels"):
            blocks = Blocks.of(octree)
        with self.stage("borders"):
            borders = find_borders(blocks)
            del blocks
            replace(plan, faces=len(borders.keys)).refuse_beyond(self.limit, 0)
        with self.stage("vertices"):
            net = net_of(borders)
            points = corner_points(net)
        if plan.relaxations:
            with self.stage("relax"):
                points = relaxed_points(net, borders.axes, plan.relaxations)
        with self.stage("triangles"):
            # Behind is the lower label; where one side is unset, that is before.
            low, high = (side.astype(np.int32) - 1 for side in (borders.low, borders.high))
            up = (high == UNSET) | ((low != UNSET) & (low < high))
            quads = np.where(up[:, None], net.quads, net.quads[:, [0, 3, 2, 1]])
            sides = np.where(up[:, None], np.stack([low, high], 1), np.stack([high, low], 1))
            faces = split(quads, points).reshape(-1, 3)
        surface = LabelledSurface(
            grid=octree.grid,
            units=octree.units,
            style=plan.style,
            names=octree.attribute(LABEL).names,
            points=points,
            faces=faces,
            sides=np.repeat(sides, 2, axis=0),
        )
        return self._with_colours(surface) if plan.colours and len(faces) else surface

    def _with_colours(self, surface: LabelledSurface) -> LabelledSurface:
        """Return the surface with the colours of its meshes."""
        with self.stage("colours"):
            labels, points = surface.labels, surface.points
            faces = [surface.faces_of(label) for label in labels]
            rows = faces
            if surface.style != VOXEL_FACES:
                rows = [np.unique(own) for own in faces]
                points = points[np.concatenate([points[:0, 0], *rows])]
            counts = [len(own) for own in rows]
            found = surface_colours(
                self.octree, surface.style, 1, points, np.concatenate([surface.faces[:0], *faces]),
                self.nearest, np.repeat(labels, counts),
            )  # fmt: skip
        return replace(surface, colours=tuple(np.split(found, np.cumsum(counts)[:-1])))

    def findings(self, result: LabelledSurface) -> Iterator[str]:
        """Yield why the surface is empty, and which labels have no voxel."""
        if not self.octree.count:
            yield "no voxel is set, so there is no surface: voxelize a mesh with --mode solid"
            return
        without = sorted(set(range(len(result.names))) - set(result.labels))
        if without:
            names = ", ".join(result.names[label] for label in without[:5])
            more = f" and {len(without) - 5:,} others" if len(without) > 5 else ""
            yield f"no voxel is labelled {names}{more}: no mesh has that name"
