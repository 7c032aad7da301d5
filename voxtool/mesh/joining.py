"""Several meshes as one, whose faces know the file that they are from."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence

import numpy as np

from voxtool.errors import MeshError
from voxtool.mesh.appearance import FILE, Parts
from voxtool.mesh.lengths import in_units
from voxtool.mesh.mesh import Mesh, check_counts


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return meshes as one, in their order.

    Its parts by "file" are named as the files without folder and ending, or "mesh N"; further parts
    are those that all meshes have, their names after that of the file. Its source is the SHA-256 of
    the sources, and its unit that of the first mesh: others are scaled to it.

    Raises
    ------
    MeshError
        If there is no mesh, or the units of some are not known.
    """
    if not meshes:
        raise MeshError("there is no mesh to join: give one or more")
    units = dict.fromkeys(mesh.units for mesh in meshes)
    if len(units) > 1 and "" in units:
        names = " and ".join(unit or "no unit" for unit in units)
        raise MeshError(f"meshes in {names}: give all the same with --units and --scale")
    meshes = [in_units(mesh, meshes[0].units) for mesh in meshes]
    name = f"{meshes[0].name or 'mesh'} and {len(meshes) - 1} more"
    check_counts(name, *(sum(map(len, of)) for of in _arrays(meshes)))
    counts = [len(mesh.vertices) for mesh in meshes]
    firsts = np.cumsum([0, *counts[:-1]]).astype(np.int32)
    files = _distinct([_name(mesh, i) for i, mesh in enumerate(meshes, 1)])
    sizes = [len(mesh.faces) for mesh in meshes]
    of_files = np.repeat(np.arange(len(meshes), dtype=np.int32), sizes)
    parts = {FILE: Parts(of_files, tuple(files))}
    for kind in set.intersection(*(set(mesh.parts) for mesh in meshes)) - {FILE}:
        parts[kind] = _joined_parts([mesh.parts[kind] for mesh in meshes], files)
    sources = "".join(mesh.source_sha256 for mesh in meshes)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + first for mesh, first in zip(meshes, firsts, strict=True)]),
        hashlib.sha256(sources.encode()).hexdigest() if sources else "",
        name, meshes[0].units, parts=parts,
    )  # fmt: skip


def _arrays(meshes: Sequence[Mesh]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes]


def _name(mesh: Mesh, number: int) -> str:
    return os.path.basename(mesh.name).split(".")[0] or f"mesh {number}"


def _distinct(names: Sequence[str]) -> list[str]:
    """Return names with (2), (3) after those that were there before."""
    counts: dict[str, int] = {}
    found = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        found.append(name if counts[name] == 1 else f"{name} ({counts[name]})")
    return found


def _joined_parts(parts: Sequence[Parts], files: Sequence[str]) -> Parts:
    firsts = np.cumsum([0, *(len(one.names) for one in parts[:-1])]).astype(np.int32)
    labels = [one.labels + first for one, first in zip(parts, firsts, strict=True)]
    names = [f"{file}/{name}" for one, file in zip(parts, files, strict=True) for name in one.names]
    return Parts(np.concatenate(labels), tuple(names))
