"""Attributes of surfaces in windows: each window's from the faces that reach it.

The octree is made by the windows of its own job, which may be labelled (labelled.py); what a face
gives a voxel depends on no other voxel. Which voxels are exposed depends on those around the
window. So once all windows are made, each is completed: the octree waits on disk beside them, and
what lies around a window is read from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from voxtool.arrays import digest_of
from voxtool.choices import COLOURS
from voxtool.files.windows import Key, Window
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import Mesh
from voxtool.svo.attributes import Attribute
from voxtool.svo.attribution.colours import EXPOSED as STAGE
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.exposed import exposed_voxels, with_exposed
from voxtool.svo.attribution.look import textures_of
from voxtool.svo.attribution.nearest_surface import NearestSurface
from voxtool.svo.attribution.surface_pass import without_values
from voxtool.svo.cells import cube
from voxtool.svo.content import StoredOctree
from voxtool.svo.layout import BRICK, NODE
from voxtool.svo.links import FULL, REFINED, nodes_of, offsets_of
from voxtool.svo.octree import Octree
from voxtool.tiles.flooding import FloodWindowsJob
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.operations import Operand
from voxtool.tiles.spread import Executor, Sent
from voxtool.tiles.subtree import Subtree, leaf_subtree, subtree_of
from voxtool.tiles.windows import MARGIN, Part, WindowsJob, mesh_of
from voxtool.tiles.workers import Described

EXPOSED = "exposed voxels of window"  # as progress says it


class AttributeWindowsJob(WindowsJob):
    """A voxelization with attributes of the surface that runs window by window."""

    def __init__(
        self, job: SurfaceAttributesJob, executor: Executor | None = None, *, merged: bool = False
    ) -> None:
        self._whole_job = job
        if not job.plan.shared:
            del job.surface.lattice  # frees the memory of the whole mesh on the device
        super().__init__(job.inner, executor, merged=merged)

    @property
    def _whole_plan(self) -> Any:
        return self._whole_job.plan

    @property
    def request(self) -> dict[str, Any]:
        """The content and the rules of the octree that is made, in JSON types."""
        job = self._whole_job
        found = {**super().request, "attributes": list(job.plan.names)}
        if job.mesh.appearance and "colour" in job.plan.names:
            found["colour"] = COLOURS[job.plan.nearest]
            found["appearance"] = _digest_of(job.mesh.appearance)
        return found

    @cached_property
    def _look(self) -> tuple[Mesh, Sent | None]:
        """The mesh that windows take their faces from, and the materials of all windows."""
        mesh = replace(self._whole_job.mesh, parts={})
        if "colour" not in self._whole_job.plan.names or mesh.appearance is None:
            return replace(mesh, appearance=None), None
        return mesh, Sent(mesh.appearance.materials)

    def _described(self, key: Key, faces: np.ndarray) -> tuple[Described, Sent | None]:
        (whole, materials), plan = self._look, self._whole_job.plan
        mesh = mesh_of(whole, self._faces_near(key, faces, MARGIN, rows=False))
        look = mesh.appearance and replace(mesh.appearance, materials=())
        bare = replace(mesh, appearance=None)
        return (bare, look, plan.names, COLOURS[plan.nearest]), materials

    def _tree(self) -> Subtree:
        tree = super()._tree()
        if not self._whole_job.plan.exposed:
            return tree
        self._done = 0
        octree = Operand(self._on_disk(tree), np.zeros(3, np.int64))
        surface = self._whole_job.whole_surface
        for key in self._leaves(self.plan.root):
            self._report(EXPOSED)
            with self.device.reporting(lambda _: None), self.device.stage(STAGE):
                self._complete_window(key, octree, surface)
        return super()._tree()

    def _on_disk(self, tree: Subtree) -> StoredOctree:
        """Return the octree of all windows, which waits on disk."""
        bricks = chain.from_iterable(map(self.store.bricks, self._used))
        arrays = (
            offsets_of(tree.levels, tree.bricks).astype(np.uint32),
            self.store.mapped("nodes", NODE, nodes_of(tree.levels)),
            self.store.mapped("bricks", BRICK, bricks),
        )
        return StoredOctree(self.grid, *self._rule, *arrays, {}, "", "")  # pyright: ignore[reportArgumentType]

    def _leaves(self, part: Part) -> Iterator[Key]:
        """Yield the windows and the full cubes between them."""
        part = self._divided_part(part)
        for half in part.parts:
            yield from self._leaves(half)
        if part.key in self.store or (not part.parts and self._leaf(part.key) == FULL):
            yield part.key

    def _complete_window(self, key: Key, whole: Operand, surface: NearestSurface) -> None:
        """Give the exposed voxels of a cube their values."""
        if whole.state(key, 1) != REFINED:
            return
        around, corner = whole.part(key, 1, math.inf)
        box = -corner, np.full(3, key[3])
        exposed = exposed_voxels(around, *box, self.device, self.max_memory)
        own = self._octree(key)
        made = with_exposed(own, exposed, surface, np.array(key[:3]), self._whole_job.names)
        if made is not own:
            count = self.store.voxels(key) if key in self.store else key[3] ** 3
            levels = subtree_of(made, key[3]).levels
            self.store.put(key, Window(levels, made.bricks, count, made.attributes))

    def _octree(self, key: Key) -> Octree:
        """Return a window, or a full cube."""
        levels, bricks = leaf_subtree(key[3], FULL).levels, np.empty(0, BRICK)
        attributes = self._kinds()
        if key in self.store:
            levels, _ = self.store.get(key)
            bricks = np.concatenate([bricks, *self.store.bricks(key)])
            attributes = [self.store.load(key, one) for one in attributes]
        octree = Octree.of_states(cube(key[3]), *self._rule, levels, bricks)
        return replace(octree, attributes=tuple(attributes))

    def _scene(self) -> dict[str, Any]:
        return self._whole_job.scene(super()._scene())

    def _kinds(self) -> Sequence[Attribute]:
        return (*super()._kinds(), *map(without_values, self._whole_job.plan.names))


class FloodAttributeWindowsJob(AttributeWindowsJob, FloodWindowsJob):
    """A flood with attributes of the surface that runs window by window."""


class LabelAttributeWindowsJob(AttributeWindowsJob, LabelWindowsJob):
    """A voxelization with labels and attributes of the surface that runs window by window."""


def _digest_of(look: Appearance) -> str:
    """Return the digest of an appearance."""
    textures = textures_of(look)
    number_of = {id(texture): number for number, texture in enumerate(textures)}
    materials = [
        [*map(float.hex, map(float, one.colour)), number_of.get(id(one.texture), -1)]
        for one in look.materials
    ]
    wraps = [[*one.wrap, one.filter, *one.pixels.shape] for one in textures]
    arrays = [array for array in (look.uv, look.colours) if array is not None]
    pixels = [one.pixels for one in textures]
    head = {"materials": materials, "textures": wraps, "arrays": [len(one) for one in arrays]}
    return digest_of(head, look.material, *arrays, *pixels)
