"""One module a format, behind one read/write pair; the only place besides mesh.py that touches
the disk. Outputs appear whole or not at all; inputs are recognised by content."""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.atomic import atomic_path, check_target
from voxtool.files.streams import (
    OPENING,
    STREAM,
    PathLike,
    input_name,
    open_whole,
    read_error,
    standard_output,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy as np

    from voxtool.adf.field import DistanceField
    from voxtool.mesh.mesh import Mesh
    from voxtool.svo.octree import Octree
    from voxtool.tets.mesh import UnstructuredMesh
    from voxtool.tets.volume import TetVolume

    Content = TypeVar("Content")
    Reader = Callable[[BinaryIO, int], Content]

__all__ = [
    "atomic_path",
    "check_target",
    "export",
    "format_of",
    "read_adf",
    "read_scene",
    "read_svo",
    "read_tet",
    "read_unstructured",
    "write_adf",
    "write_mesh",
    "write_svo",
    "write_tet",
]

# Format names and extensions: the module, and its function where it is not `write`.
SVO_FORMATS = {
    "svo.h5": ("voxtool.files.svo_hdf5", "write"),
    "svo.xml": ("voxtool.files.svo_xml", "write"),
    "svo.xml.gz": ("voxtool.files.svo_xml", "write_gz"),
    "h5": ("voxtool.files.svo_hdf5", "write"),
    "xml": ("voxtool.files.svo_xml", "write"),
    "xml.gz": ("voxtool.files.svo_xml", "write_gz"),
}
ADF_FORMATS = {
    "adf.h5": ("voxtool.files.adf_hdf5", "write"),
    "h5": ("voxtool.files.adf_hdf5", "write"),
}
TET_FORMATS = {
    "tet.h5": ("voxtool.files.tet_hdf5", "write"),
    "h5": ("voxtool.files.tet_hdf5", "write"),
}
EXPORTS = {
    **{name: (f"voxtool.files.{name}", "write") for name in ("npy", "npz", "vti")},
    "png": ("voxtool.files.png", "write"),
}
MESH_FORMATS = {
    name: ("voxtool.files.mesh_writers", f"write_{name}")
    for name in ("obj", "ply", "stl", "glb", "off")
}
NORMAL_FORMATS = ("obj", "ply", "glb")  # of these, those that hold a normal a vertex
STREAM_FORMATS = ("svo.h5", "adf.h5", "tet.h5", "obj")  # what stdout gets where no format is named
TEXT_FORMATS = ("svo.xml", "xml", "obj", "off")  # fit for a terminal

MESH_EXTENSIONS = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".3mf", ".dae", ".xyz")
# Meshes of volume cells: extensions, and what meshio calls the formats.
VOLUME_FORMATS = {
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".msh": "gmsh",
    ".mesh": "medit",
    ".inp": "abaqus",
    ".ex2": "exodus",
    ".exo": "exodus",
    ".e": "exodus",
}
MESH_OPENINGS = (b"ply\n", b"ply\r", b"solid ", b"OFF\n", b"OFF\r", b"glTF", b"#", b"v ")
EXPORT_EXTENSIONS = tuple(f".{name}" for name in EXPORTS)


def read_svo(path: PathLike) -> Octree:
    """Read an octree; `-` reads stdin. The format is recognised by content, not by name.

    Raises
    ------
    FileError : no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, _svo_reader)


def write_svo(
    octree: Octree, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write an octree as HDF5 (.svo.h5) or XML (.svo.xml, .svo.xml.gz); `-` writes stdout.

    Parameters
    ----------
    clobber : False refuses an existing file.
    format : "svo.h5", "svo.xml" or "svo.xml.gz" instead of what the name says.

    Raises
    ------
    FileError : the file cannot be written, or its name says no format.
    """
    _write(octree, path, clobber, format or format_of(path, SVO_FORMATS), SVO_FORMATS)


def read_adf(path: PathLike) -> DistanceField:
    """Read a distance field; `-` reads stdin. The format is recognised by content, not by name.

    Raises
    ------
    FileError : no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, _adf_reader)


def write_adf(
    field: DistanceField, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write a distance field as HDF5 (.adf.h5); `-` writes stdout.

    Parameters
    ----------
    clobber : False refuses an existing file.
    format : "adf.h5", whatever the name says.

    Raises
    ------
    FileError : the file cannot be written, its name says no format, or an attribute of the field
        is out of range or does not fit.
    """
    _write(field, path, clobber, format or format_of(path, ADF_FORMATS), ADF_FORMATS)


def read_tet(path: PathLike) -> TetVolume:
    """Read a tetrahedral volume; `-` reads stdin. The format is recognised by content, not by name.

    Raises
    ------
    FileError : no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, _tet_reader)


def write_tet(
    volume: TetVolume, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write a tetrahedral volume as HDF5 (.tet.h5); `-` writes stdout.

    Parameters
    ----------
    clobber : False refuses an existing file.
    format : "tet.h5", whatever the name says.

    Raises
    ------
    FileError : the file cannot be written, its name says no format, or an attribute of the volume
        is out of range or does not fit.
    """
    _write(volume, path, clobber, format or format_of(path, TET_FORMATS), TET_FORMATS)


def read_unstructured(
    path: PathLike, scalar: str | None = None, component: str | int | None = None
) -> UnstructuredMesh:
    """Read a mesh of volume cells and one of its arrays, through meshio (the extra `tets`).

    Parameters
    ----------
    path : a .vtu, .vtk, .msh (Gmsh), .mesh (Medit), .inp (Abaqus, AVS UCD) or .ex2, .exo, .e
        (Exodus II) file.
    scalar : the name of an array at points, or else at cells; None takes the only one there is.
    component : of an array of vectors: "x", "y", "z", a number from 0, or "magnitude".

    Raises
    ------
    FileError : the file cannot be read, meshio is not installed, or there is no such array or
        component.
    """
    from voxtool.files.unstructured import read

    return read(path, scalar, component)


def read_scene(path: PathLike) -> Octree | DistanceField | TetVolume:
    """Read an octree, a distance field or a tetrahedral volume, whichever it is; `-` reads stdin.

    Raises
    ------
    FileError : no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, _scene_reader)


def export(
    octree: Octree,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    **options: Any,
) -> None:
    """Export the set voxels as .npy (dense), .npz (coordinates), .vti (ParaView) or .png (slice).

    Parameters
    ----------
    clobber : False refuses an existing file.
    format : "npy", "npz", "vti" or "png" instead of what the name says.
    options : for a png, `axis` ("x", "y" or "z") and `value` (a voxel index).

    Raises
    ------
    FileError : the file cannot be written, is larger than its disk, or its name says no format.
    GridError : a slice outside the grid. MemoryLimitError : it does not fit in memory.
    """
    _write(octree, path, clobber, format or format_of(path, EXPORTS), EXPORTS, **options)


def write_mesh(
    mesh: Mesh,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    normals: np.ndarray | None = None,
) -> None:
    """Write a triangle mesh as .obj, .ply, .stl, .glb or .off; `-` writes stdout, as OBJ.

    Faces keep their order, and vertices too but for STL, which has none: it repeats the corners
    of every face. OBJ and OFF are text: coordinates of a tenth of the largest and more come back
    bit for bit, the others within 1e-17 of the largest and 1e-9 of the mesh's longest side. PLY,
    STL and GLB hold float32, 1 part in 1.6e7 of a coordinate; a mesh is refused if that moves
    vertices by more than a thousandth of its longest side. The unit of GLB is the metre; the
    others have none. Without faces the file is valid, but there is no mesh in it to load.

    Parameters
    ----------
    clobber : False refuses an existing file.
    format : "obj", "ply", "stl", "glb" or "off" instead of what the name says.
    normals : (V, 3) float64 unit vectors, one a vertex, written as they are; OBJ holds them within
        1e-9, PLY and GLB as float32.

    Raises
    ------
    FileError : the file cannot be written, its name says no format, or the format cannot hold the
        mesh or its normals.
    MeshError : a vertex is not finite, or the normals are not one a vertex and finite.
    MemoryLimitError : the text does not fit in memory.
    """
    format = format or format_of(path, MESH_FORMATS)
    if normals is not None and format in MESH_FORMATS and format not in NORMAL_FORMATS:
        held = ", ".join(f".{name}" for name in NORMAL_FORMATS)
        raise FileError(
            f".{format} holds no vertex normals: write one of {held}, or leave them out"
        )
    _write(mesh, path, clobber, format, MESH_FORMATS, normals=normals)


def format_of(path: PathLike, formats: Iterable[str]) -> str:
    """The format that a name's extension says; for stdout HDF5 or OBJ, if it is one of them.

    Raises
    ------
    FileError : no format of these has this extension.
    """
    formats = tuple(formats)
    if path == STREAM:
        for default in STREAM_FORMATS:
            if default in formats:
                return default
    name = os.fspath(path).lower()
    endings = {*formats, *SVO_FORMATS, *ADF_FORMATS, *TET_FORMATS}
    for extension in sorted(endings, key=len, reverse=True):
        if name.endswith(f".{extension}"):  # the longest: .svo.h5 is no .h5 of another kind
            if extension in formats:
                return extension
            break
    known = ", ".join(
        f".{e}" for e in formats if not any(other.endswith(f".{e}") for other in formats)
    )
    if path == STREAM:
        raise FileError(f"standard output has no extension: name the format, one of {known}")
    raise FileError(f"{path}: the name says no format: end it in one of {known}")


# Reading


def _read(path: PathLike, reader: Callable[[str, bytes], Reader[Content]]) -> Content:
    """What the reader for a file's content makes of it."""
    name = input_name(path)
    try:
        with open_whole(path) as (file, size):
            if size == 0:
                raise FileError(f"{name} is empty")
            read = reader(name, file.read(OPENING))
            file.seek(0)
            try:
                return read(file, size)
            except VoxtoolError as error:
                raise type(error)(f"{name}: {error}") from error
    except OSError as error:
        raise read_error(name, error) from error
    except MemoryError as error:
        raise FileError(f"{name}: more than fits in memory") from error


def _svo_reader(name: str, opening: bytes) -> Reader[Octree]:
    from voxtool.files import hdf5, svo_hdf5, svo_xml

    if opening.startswith(hdf5.SIGNATURE):
        return svo_hdf5.read
    if opening.startswith(svo_xml.GZIP_MAGIC):
        return svo_xml.read_gz
    if _is_volume_mesh(name):
        raise _no_textures(name)
    if _is_mesh(name, opening):
        raise FileError(f"{name} is a mesh: voxelize it first (voxtool voxelize {name})")
    if opening.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
        return svo_xml.read
    if name.lower().endswith(EXPORT_EXTENSIONS):
        raise FileError(f"{name} is an export: read the .svo.h5 or .svo.xml that it was made from")
    raise FileError(f"{name} is no octree: expected HDF5 (.svo.h5) or XML (.svo.xml, .svo.xml.gz)")


def _adf_reader(name: str, opening: bytes) -> Reader[DistanceField]:
    from voxtool.files import adf_hdf5, hdf5

    if opening.startswith(hdf5.SIGNATURE):
        return adf_hdf5.read
    if _is_volume_mesh(name):
        raise _no_textures(name)
    if _is_mesh(name, opening):
        raise FileError(f"{name} is a mesh: build a field first: voxtool adf-build {name}")
    if name.lower().endswith((".svo.xml", ".svo.xml.gz")):
        raise FileError(f"{name} is an octree: build a field first: voxtool adf-build MESH")
    raise FileError(f"{name} is no distance field: expected HDF5 (.adf.h5)")


def _tet_reader(name: str, opening: bytes) -> Reader[TetVolume]:
    from voxtool.files import hdf5, tet_hdf5

    if opening.startswith(hdf5.SIGNATURE) and not _is_volume_mesh(name):
        return tet_hdf5.read
    if _is_volume_mesh(name):
        raise _no_textures(name)
    if _is_mesh(name, opening):
        raise FileError(
            f"{name} is a mesh of triangles: a volume is built of tetrahedra or hexahedra: voxtool "
            "tet-build MESH.vtu"
        )
    raise FileError(f"{name} is no tetrahedral volume: expected HDF5 (.tet.h5)")


def _no_textures(name: str) -> FileError:
    return FileError(
        f"{name} is a mesh of volume cells: build its textures first: voxtool tet-build {name}"
    )


def _scene_reader(name: str, opening: bytes) -> Reader[Octree | DistanceField | TetVolume]:
    from voxtool.files import adf_hdf5, hdf5, svo_hdf5, tet_hdf5

    if _is_volume_mesh(name):
        raise _no_textures(name)
    if opening.startswith(hdf5.SIGNATURE):
        readers = {
            svo_hdf5.SCHEMA.format: svo_hdf5.read,
            adf_hdf5.SCHEMA.format: adf_hdf5.read,
            tet_hdf5.SCHEMA.format: tet_hdf5.read,
        }
        return lambda file, size: hdf5.read_by_format(file, size, readers)
    if _is_mesh(name, opening):
        raise FileError(
            f"{name} is a mesh: make an octree or a field of it first: voxtool voxelize {name}, or "
            f"voxtool adf-build {name}"
        )
    return _svo_reader(name, opening)


def _is_volume_mesh(name: str) -> bool:
    return name.lower().endswith(tuple(VOLUME_FORMATS))


def _is_mesh(name: str, opening: bytes) -> bool:
    return name.lower().endswith(MESH_EXTENSIONS) or opening.startswith(MESH_OPENINGS)


# Writing


def _write(
    content: Octree | DistanceField | TetVolume | Mesh,
    path: PathLike,
    clobber: bool,
    format: str,
    formats: dict[str, tuple[str, str]],
    **options: Any,
) -> None:
    if format not in formats:
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(formats)}")
    module_name, function = formats[format]
    module = import_module(module_name)
    write = getattr(module, function)
    if path == STREAM:
        with standard_output(format in TEXT_FORMATS) as file:
            write(content, file, **options)
        return
    check_target(path, clobber)
    if hasattr(module, "size"):
        from voxtool.memory import check_disk

        check_disk(path, module.size(content), "choose a smaller dim, or the sparse .npz")
    with atomic_path(path, clobber) as temporary, open(temporary, "w+b") as file:
        write(content, file, **options)
