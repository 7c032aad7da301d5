"""Attributes of surfaces in windows: each window's from the faces that reach it.

The octree is made by the windows of its own job, which may be labelled (labelled.py); what a face
gives a voxel depends on no other voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from voxtool.arrays import digest_of
from voxtool.choices import COLOURS
from voxtool.files.windows import Key, Window
from voxtool.mesh.appearance import Appearance
from voxtool.svo.attributes import Attribute
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.look import textures_of
from voxtool.svo.attribution.surface_pass import without_values
from voxtool.svo.voxelize import VoxelizeJob
from voxtool.tiles.flooding import FloodWindowsJob, filled
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.subtree import codes_of
from voxtool.tiles.windows import MARGIN, Content, WindowsJob, attributed, mesh_of


class AttributeWindowsJob(WindowsJob):
    """A voxelization with attributes of the surface that runs window by window."""

    def __init__(self, job: SurfaceAttributesJob) -> None:
        self._whole_job = job
        if not job.plan.shared:
            del job.surface.lattice  # frees the memory of the whole mesh on the device
        super().__init__(job.inner)  # pyright: ignore[reportArgumentType]

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

    def _complete(self, job: VoxelizeJob, key: Key, faces: np.ndarray) -> SurfaceAttributesJob:
        whole = self._whole_job
        mesh = mesh_of(whole.mesh, self._faces_near(key, faces, MARGIN, rows=False))
        colour = COLOURS[whole.plan.nearest]
        return SurfaceAttributesJob(
            job, mesh, whole.plan.names, colour, self.device, self.max_memory
        )

    def _finished(self, key: Key, faces: np.ndarray) -> Window:
        made = self._complete(self._job(key, faces), key, faces)
        return attributed(made._run(), key[3])

    def _scene(self) -> dict[str, Any]:
        return self._whole_job.scene(super()._scene())

    def _kinds(self) -> Sequence[Attribute]:
        return (*super()._kinds(), *map(without_values, self._whole_job.plan.names))


class FloodAttributeWindowsJob(AttributeWindowsJob, FloodWindowsJob):
    """A flood with attributes of the surface that runs window by window."""

    def _finished(self, key: Key, faces: np.ndarray) -> Window:
        job = self._job(key, faces)
        content = filled(job, self._outside[key])
        return flooded(self._complete(job, key, faces), content)


def flooded(job: SurfaceAttributesJob, content: Content) -> Window:
    """Return the window of a flood with attributes of the surface, given its octree."""
    levels, bricks, voxels = content
    found = job.surface_values().attributes(codes_of(levels), bricks)
    return Window(levels, bricks, voxels, found)


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
