"""The meshes of the labels of an octree in one file: objects of OBJ, or nodes of GLB.

OBJ has one list of vertices, to which the faces of all objects refer. In GLB each node has vertices
of its own; those on common borders are bit-equal. Numbers are written as those of single meshes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import printable
from voxtool.files.glb import BYTES, Node, write_nodes
from voxtool.files.mesh_writers import HEADER, check_float32, decimals_of
from voxtool.mesh.mesh import Mesh

if TYPE_CHECKING:
    from voxtool.svo.surface.labelled import LabelledSurface

LINES = 1 << 16  # that become text at once


def write_obj(surface: LabelledSurface, file: BinaryIO) -> None:
    """Write OBJ text: the vertices, then an object for each label."""
    file.write(f"# {HEADER}\n".encode())
    places = decimals_of(Mesh(surface.vertices, surface.faces))
    _write_lines(file, f"v %.{places}f %.{places}f %.{places}f\n", surface.vertices)
    for label in surface.labels:
        file.write(f"o {_name_of(surface, label)}\n".encode())
        _write_lines(file, "f %d %d %d\n", surface.faces_of(label) + 1)


def write_glb(surface: LabelledSurface, file: BinaryIO, limit: int = BYTES) -> None:
    """Write binary glTF 2.0: a node for each label, of at most `limit` bytes together."""
    check_float32(Mesh(surface.vertices, surface.faces), "GLB")
    nodes = (Node(_name_of(surface, n), surface.mesh(n)) for n in surface.labels)
    write_nodes(nodes, file, limit)


def _name_of(surface: LabelledSurface, label: int) -> str:
    """Return the name of a label on one line; that of a label without one is its number."""
    return printable(surface.names[label]).strip() or f"label {label}"


def _write_lines(file: BinaryIO, line: str, rows: np.ndarray) -> None:
    """Write a line for each row of numbers."""
    for first in range(0, len(rows), LINES):
        part = rows[first : first + LINES]
        file.write((line * len(part) % tuple(part.ravel().tolist())).encode())
