"""The meshes of the labels of an octree in one file: objects of OBJ or 3MF, or nodes of GLB.

OBJ has one list of vertices, to which the faces of all objects refer. In GLB and 3MF each has
vertices of its own; those on common borders are bit-equal. Numbers are written as those of single
meshes. A 3MF has one build item, whose components are the objects, each with a base material of its
name in the colour of the palette; how it is packed depends on the version of zlib.
"""

from __future__ import annotations

import zipfile
from dataclasses import replace
from typing import IO, TYPE_CHECKING, BinaryIO
from xml.sax.saxutils import quoteattr

from voxtool.errors import FileError, printable
from voxtool.files.meshes.glb import BYTES, Node, write_nodes
from voxtool.files.meshes.mesh_writers import HEADER, check_float32, write_lines
from voxtool.files.meshes.threemf import CORE, RELATION, RELATIONS, ROOT_MODEL, UNITS
from voxtool.mesh.mesh import Mesh
from voxtool.palette import palette

if TYPE_CHECKING:
    from voxtool.svo.surface.labelled import LabelledSurface

MODEL, TYPES = "3D/3dmodel.model", "[Content_Types].xml"
PACKAGE = "http://schemas.openxmlformats.org/package/2006/content-types"
TYPES_XML = (
    f'<?xml version="1.0" encoding="UTF-8"?>\n<Types xmlns="{PACKAGE}"><Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Default Extension='
    '"model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
RELATIONS_XML = (
    f'<?xml version="1.0" encoding="UTF-8"?>\n<Relationships xmlns="{RELATION.split()[0]}">'
    f'<Relationship Target="/{MODEL}" Id="model" Type="{ROOT_MODEL}"/></Relationships>'
)
LINE_BYTES, MOST_TEXT = 80, 1 << 31  # of a triangle and its share of vertices; that zip holds


def write_obj(surface: LabelledSurface, file: BinaryIO) -> None:
    """Write OBJ text: the vertices, then an object for each label."""
    file.write(f"# {HEADER}\n".encode())
    write_lines(file, "v %r %r %r\n", surface.vertices)
    for label in surface.labels:
        file.write(f"o {_name_of(surface, label)}\n".encode())
        write_lines(file, "f %d %d %d\n", surface.faces_of(label) + 1)


def write_glb(surface: LabelledSurface, file: BinaryIO, limit: int = BYTES) -> None:
    """Write binary glTF 2.0: a node for each label, of at most `limit` bytes together."""
    check_float32(Mesh(surface.vertices, surface.faces), "GLB")
    nodes = (Node(_name_of(surface, n), surface.mesh(n)) for n in surface.labels)
    write_nodes(nodes, file, limit)


def write_3mf(surface: LabelledSurface, file: BinaryIO) -> None:
    """Write a 3MF in the surface's unit, or millimetres if it is unknown."""
    surface = replace(surface, colours=())
    if LINE_BYTES * 2 * len(surface.faces) > MOST_TEXT:
        raise FileError("3MF holds 2 GiB of text at most and these meshes have more: write .glb")
    units = {short: long for long, short in UNITS.items()}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, text in ((TYPES, TYPES_XML), (RELATIONS, RELATIONS_XML)):
            archive.writestr(zipfile.ZipInfo(part), text, zipfile.ZIP_DEFLATED)
        info = zipfile.ZipInfo(MODEL)
        info.compress_type = zipfile.ZIP_DEFLATED
        with archive.open(info, "w") as model:
            _write_model(surface, model, units.get(surface.units, "millimeter"))


def _write_model(surface: LabelledSurface, file: IO[bytes], unit: str) -> None:
    """Write the XML of the model."""
    labels = surface.labels
    colours, names = palette(max(len(surface.names), 1)), [_quoted(surface, n) for n in labels]
    vertex = "<vertex " + " ".join(f'{axis}="%r"' for axis in "xyz") + "/>\n"
    base = "".join(
        f'<base name={name} displaycolor="#{bytes(colours[label]).hex().upper()}"/>'
        for label, name in zip(labels, names, strict=True)
    )
    head = f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="{unit}" xmlns="{CORE}">'
    file.write(f'{head}<resources><basematerials id="1">{base}</basematerials>'.encode())
    for number, (label, name) in enumerate(zip(labels, names, strict=True)):
        mesh = surface.mesh(label)
        own = f'<object id="{number + 2}" type="model" name={name} pid="1" pindex="{number}">'
        file.write(f"{own}<mesh><vertices>\n".encode())
        write_lines(file, vertex, mesh.vertices)
        file.write(b"</vertices><triangles>\n")
        write_lines(file, '<triangle v1="%d" v2="%d" v3="%d"/>\n', mesh.faces)
        file.write(b"</triangles></mesh></object>")
    whole = len(labels) + 2
    parts = "".join(f'<component objectid="{n}"/>' for n in range(2, whole))
    tail = f'<object id="{whole}" type="model"><components>{parts}</components></object>'
    file.write(f'{tail}</resources><build><item objectid="{whole}"/></build></model>'.encode())


def _quoted(surface: LabelledSurface, label: int) -> str:
    """Return the name of a label as an attribute of XML."""
    return quoteattr(_name_of(surface, label))


def _name_of(surface: LabelledSurface, label: int) -> str:
    """Return the name of a label on one line; that of a label without one is its number."""
    return printable(surface.names[label]).strip() or f"label {label}"
