"""Attributes of surfaces in windows: each window's from the faces that reach it.

The octree is made by the windows of its own job, which may be labelled (labelled.py); what a face
gives a voxel depends on no other voxel. Which voxels are exposed depends on those around the
window. So once all windows are made, each is completed: the octree waits on disk beside them, and
what lies around a window is read from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import digest_of
from voxtool.choices import COLOURS
from voxtool.files.octrees.windows import Key, Window
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.subset import mesh_of
from voxtool.svo.attribution.colours import EXPOSED as STAGE
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.exposed import exposed_voxels, with_exposed
from voxtool.svo.attribution.materials import textures_of
from voxtool.svo.attribution.nearest_surface import NearestSurface
from voxtool.svo.attribution.surface_pass import without_values
from voxtool.svo.cells.subtrees import cube
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.content import StoredOctree
from voxtool.svo.octree.layout import BRICK, NODE
from voxtool.svo.octree.links import FULL, REFINED, nodes_of, offsets_of
from voxtool.svo.octree.octree import Octree
from voxtool.tiles.operations import Operand
from voxtool.tiles.spread import Sent
from voxtool.tiles.subtree import Subtree, leaf_subtree, subtree_of
from voxtool.tiles.workers import Described

if TYPE_CHECKING:
    from voxtool.tiles.windows import Part, WindowsJob

EXPOSED = "exposed voxels of window"  # as progress says it


class SurfaceOfWindows:
    """The attributes of the surface of a voxelization that runs window by window.

    Parameters
    ----------
    whole : the voxelization in one piece.
    """

    def __init__(self, whole: SurfaceAttributesJob) -> None:
        self.whole, self.plan = whole, whole.plan
        if not whole.plan.shared:
            del whole.surface.lattice  # frees the memory of the whole mesh on the device

    @property
    def request(self) -> dict[str, Any]:
        """The attributes, and what they depend on beside the mesh, in JSON types."""
        look, found = self.whole.mesh.appearance, {"attributes": list(self.plan.names)}
        if look and "colour" in self.plan.names:
            return {**found, "colour": COLOURS[self.plan.nearest], "appearance": _digest_of(look)}
        return found

    @property
    def kinds(self) -> list[Attribute]:
        """The attributes, without values."""
        return list(map(without_values, self.plan.names))

    @cached_property
    def _look(self) -> tuple[Mesh, Sent | None]:
        """The mesh that windows take their faces from, and the materials of all windows."""
        mesh = replace(self.whole.mesh, parts={})
        if "colour" not in self.plan.names or mesh.appearance is None:
            return replace(mesh, appearance=None), None
        return mesh, Sent(mesh.appearance.materials)

    def described(self, near: np.ndarray) -> tuple[Described, Sent | None]:
        """Return what the attributes of a window are found from, given the faces near it, and the
        materials of all windows."""
        whole, materials = self._look
        mesh = mesh_of(whole, near)
        look = mesh.appearance and replace(mesh.appearance, materials=())
        bare = replace(mesh, appearance=None)
        return (bare, look, self.plan.names, COLOURS[self.plan.nearest]), materials

    # ---- exposed voxels

    def complete(self, job: WindowsJob, tree: Subtree) -> None:
        """Give the exposed voxels of all windows of a job their values, given their tree."""
        job._done = 0
        octree = Operand(_on_disk(job, tree), np.zeros(3, np.int64))
        surface = self.whole.whole_surface
        for key in _leaves(job, job.plan.root):
            job._report(EXPOSED)
            with job.device.reporting(lambda _: None), job.device.stage(STAGE):
                self._complete_window(job, key, octree, surface)

    def _complete_window(
        self, job: WindowsJob, key: Key, whole: Operand, surface: NearestSurface
    ) -> None:
        """Give the exposed voxels of a cube their values."""
        if whole.state(key, 1) != REFINED:
            return
        around, corner = whole.part(key, 1, math.inf)
        box = -corner, np.full(3, key[3])
        exposed = exposed_voxels(around, *box, job.device, job.max_memory)
        own = _octree(job, key)
        made = with_exposed(own, exposed, surface, np.array(key[:3]), self.plan.names)
        if made is not own:
            count = job.store.voxels(key) if key in job.store else key[3] ** 3
            levels = subtree_of(made, key[3]).levels
            job.store.put(key, Window(levels, made.bricks, count, made.attributes))


def _on_disk(job: WindowsJob, tree: Subtree) -> StoredOctree:
    """Return the octree of all windows, which waits on disk."""
    bricks = chain.from_iterable(map(job.store.bricks, job._used))
    arrays = (
        offsets_of(tree.levels, tree.bricks).astype(np.uint32),
        job.store.mapped("nodes", NODE, nodes_of(tree.levels)),
        job.store.mapped("bricks", BRICK, bricks),
    )
    return StoredOctree(job.grid, *job._rule, *arrays, {}, "", "")  # pyright: ignore[reportArgumentType]


def _leaves(job: WindowsJob, part: Part) -> Iterator[Key]:
    """Yield the windows and the full cubes between them."""
    part = job._divided_part(part)
    for half in part.parts:
        yield from _leaves(job, half)
    if part.key in job.store or (not part.parts and job._leaf(part.key) == FULL):
        yield part.key


def _octree(job: WindowsJob, key: Key) -> Octree:
    """Return a window, or a full cube."""
    levels, bricks = leaf_subtree(key[3], FULL).levels, np.empty(0, BRICK)
    attributes = job._all_kinds()
    if key in job.store:
        levels, _ = job.store.get(key)
        bricks = np.concatenate([bricks, *job.store.bricks(key)])
        attributes = [job.store.load(key, one) for one in attributes]
    octree = Octree.of_states(cube(key[3]), *job._rule, levels, bricks)
    return replace(octree, attributes=tuple(attributes))


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
