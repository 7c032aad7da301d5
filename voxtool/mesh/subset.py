"""The mesh of some faces of another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.mesh.mesh import Mesh


def mesh_of(mesh: Mesh, faces: np.ndarray) -> Mesh:
    """Return the mesh of some faces, with their appearance."""
    if len(faces) == len(mesh.faces):
        return mesh
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces[faces]] = True
    index = np.cumsum(used, dtype=np.int32) - 1
    look = mesh.appearance
    if look is not None:
        uv, colours = look.uv, look.colours
        look = replace(
            look,
            material=look.material[faces],
            uv=None if uv is None else uv[faces],
            colours=None if colours is None else colours[used],
        )
    arrays = {"vertices": mesh.vertices[used], "faces": index[mesh.faces[faces]]}
    return replace(mesh, **arrays, parts={}, appearance=look)
