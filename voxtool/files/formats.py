"""The tables of all formats: names, and the modules that write and read them.

A new format is a module with a `write`, a `read` or both, and a line here. Those of other programs'
voxels are in EXCHANGE; exchange.py says what their modules hold.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from voxtool.errors import FileError
from voxtool.files.storage.atomic import check_target
from voxtool.files.storage.streams import STREAM, PathLike

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Reader = Callable[[BinaryIO, int], Any]


class Writer(NamedTuple):
    """The function of a module of voxtool.files that writes a format."""

    module: str
    function: str = "write"
    text: bool = False  # whether a terminal can show it


class Exchange(NamedTuple):
    """A format of other programs' voxels, which a module of voxtool.files reads and writes."""

    module: str
    keeps: str  # what a file keeps of an image
    suffix: str = ""  # of the names of the module's functions, where it has several formats
    reads: bool = True
    writes: bool = True
    dtypes: tuple[str, ...] = ()  # of voxels, those that may be requested; (): all
    volumes: str = ""  # the module that writes tetrahedral volumes
    levels: str = ""  # the module that writes level sets of fields
    dense: bool = False  # whether it is a dense array, which can hold the samples of a field
    needs: str = ""  # the package that the module needs
    extra: str = "formats"  # of voxtool, which installs the package
    folder: bool = False  # whether it is a folder of files
    parts: bool = True  # whether it takes --level, --bbox, --invert and --dtype
    text: bool = False  # whether a terminal can show it
    grids: bool = False  # whether a file can hold several, by name
    normals: bool = False  # whether its points can have normals
    points: bool = False  # whether only the set cells are written, one by one
    whole: bool = False  # whether its writer needs all nodes of an octree at once
    hexahedra: bool = False  # whether set cells are written as hexahedra, for solvers
    # of voxels: "all" beside the occupancy, "one" in its place, a "palette" beside it, or "" none
    attributes: str = ""
    kinds: tuple[str, ...] = ()  # of attributes, those that it can hold; (): all
    opacity: bool = True  # whether its colours have one


# Writers, by the extension that names them.
SVO_FORMATS = {
    "svo.h5": Writer("octrees.svo_hdf5"),
    "svo.xml": Writer("octrees.svo_xml", text=True),
    "svo.xml.gz": Writer("octrees.svo_xml", "write_gz"),
    "voccel.xml": Writer("octrees.svo_xml", "write_voccel", text=True),
    "h5": Writer("octrees.svo_hdf5"),
    "xml": Writer("octrees.svo_xml", text=True),
    "xml.gz": Writer("octrees.svo_xml", "write_gz"),
}
OCTREE_FORMATS = tuple(name for name in SVO_FORMATS if "." in name and name != "xml.gz")
MERGED_FORMATS = ("svo.h5", "h5")  # those that hold merged subtrees
ADF_FORMATS = {"adf.h5": Writer("fields.adf_hdf5"), "h5": Writer("fields.adf_hdf5")}
TET_FORMATS = {"tet.h5": Writer("cells.tet_hdf5"), "h5": Writer("cells.tet_hdf5")}
EXCHANGE = {
    "npy": Exchange("grids.npy", "dtype", dense=True, attributes="one"),
    "npz": Exchange(
        "grids.npz",
        "grid, dtype; of the set cells alone",
        dense=True,
        points=True,
        attributes="all",
    ),
    "vti": Exchange("grids.vti", "grid, dtype", dense=True, attributes="all"),
    "nii": Exchange(
        "grids.nifti", "grid, dtype, unit", needs="nibabel", dense=True, attributes="one"
    ),
    "nii.gz": Exchange(
        "grids.nifti", "grid, dtype, unit", "_packed", needs="nibabel", dense=True, attributes="one"
    ),
    "nrrd": Exchange("grids.nrrd", "grid, dtype, unit", dense=True, attributes="one"),
    "binvox": Exchange(
        "grids.binvox", "the grid as a cube, with cubic voxels; bool", dtypes=("bool",)
    ),
    "ply": Exchange(
        "grids.centers",
        "centres of the set cells, and their values",
        "_ply",
        reads=False,
        normals=True,
        points=True,
        attributes="all",
    ),
    "xyz": Exchange(
        "grids.centers",
        "centres of the set cells",
        "_xyz",
        reads=False,
        text=True,
        normals=True,
        points=True,
        attributes="all",
    ),
    "vdb": Exchange(
        "grids.vdb",
        "grid, coverage; bool or float32; cubes as tiles",
        levels="grids.vdb_levels",
        grids=True,
        whole=True,
        attributes="all",
        kinds=("label", "area", "fraction", "colour", "normal"),
        opacity=False,
    ),
    "vox": Exchange(
        "grids.vox", "grid; which cells are set", dtypes=("bool",), whole=True, attributes="palette"
    ),
    "nvdb": Exchange(
        "grids.nvdb",
        "place, coverage as float32; cubes as tiles",
        levels="grids.nvdb_levels",
        reads=False,
        whole=True,
        attributes="all",
        kinds=("label", "area", "fraction"),
    ),
    "vtkhdf": Exchange(
        "grids.vtkhdf",
        "grid, levels, coverage",
        volumes="cells.vtkhdf_volume",
        whole=True,
        attributes="all",
    ),
    **{
        name: Exchange(
            f"cells.{name}",
            "set cells as hexahedra, materials, surfaces",
            reads=False,
            dtypes=("bool",),
            text=name == "inp",
            hexahedra=True,
        )
        for name in ("vtu", "msh", "inp")
    },
    "tif": Exchange(
        "grids.tiff", "grid, dtype, unit", needs="tifffile", dense=True, attributes="one"
    ),
    "tiff": Exchange(
        "grids.tiff", "grid, dtype, unit", needs="tifffile", dense=True, attributes="one"
    ),
    "ome.zarr": Exchange(
        "grids.ome_zarr",
        "grid, coverage, a pyramid of it, unit",
        needs="zarr",
        folder=True,
        dtypes=("float32", "float64"),
        attributes="all",
    ),
    "%04d.png": Exchange(
        "pictures.picture_layers", "which cells are set", reads=False, folder=True, dtypes=("bool",)
    ),
    "png": Exchange(
        "pictures.slice_png", "one slice, as a picture", reads=False, parts=False, whole=True
    ),
}
EXPORTS = tuple(name for name, format in EXCHANGE.items() if format.writes)
IMPORTS = tuple(name for name, format in EXCHANGE.items() if format.reads)
IMAGES = tuple(name for name in IMPORTS if EXCHANGE[name].dense)  # what can become a field
LINK_FORMATS = {
    "npz": Writer("grids.wall_links", "write_npz"),
    "h5": Writer("grids.wall_links", "write_h5"),
}
MESH_FORMATS = {
    name: Writer("meshes.mesh_writers", f"write_{name}", text=name in ("obj", "off"))
    for name in ("obj", "ply", "stl", "glb", "off")
}
PART_FORMATS = {  # of several meshes in one file
    name: Writer("meshes.mesh_parts", f"write_{name}", text=name == "obj")
    for name in ("obj", "glb", "3mf")
}
TEXT_FORMATS = (  # fit for a terminal
    *(name for name, f in {**SVO_FORMATS, **MESH_FORMATS, **EXCHANGE}.items() if f.text),
    "csv",
)
NORMAL_FORMATS = ("obj", "ply", "glb")  # those of meshes that hold a normal a vertex
COLOUR_FORMATS = NORMAL_FORMATS  # and those that hold a colour
STREAM_FORMATS = ("svo.h5", "adf.h5", "tet.h5", "obj")  # of stdout where no format is named

# Meshes of triangles, by extension or opening. Not all can be read; all are recognised.
MESH_EXTENSIONS = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".3mf", ".dae", ".xyz")
MESH_OPENINGS = (b"ply\n", b"ply\r", b"solid ", b"OFF\n", b"OFF\r", b"glTF", b"#", b"v ")
# Meshes of volume cells: extensions, and meshio's names of the formats.
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

HDF5, GZIP, ZIP, BOM = b"\x89HDF\r\n\x1a\n", b"\x1f\x8b", b"PK\x03\x04", b"\xef\xbb\xbf"


@dataclass(frozen=True)
class Kind:
    """A kind of content, and the messages for files of another kind, written after their names."""

    hdf5: tuple[str, ...]  # modules of the HDF5 formats that hold it
    mesh: str  # the message for a mesh
    other: str  # for any other file
    xml: bool = False  # whether the XML format holds it, too
    sliced: bool = False  # whether the arrays of octrees in HDF5 stay in the file
    endings: dict[tuple[str, ...], str] = field(default_factory=dict)  # by the endings of names


AN_EXPORT = {
    tuple(f".{name}" for name in IMPORTS): "holds another program's voxels: import it first: "
    "voxtool import {name}",
    tuple(f".{name}" for name in EXPORTS): "is an export: read the .svo.h5 or .svo.xml that it was "
    "made from",
}
OCTREE = Kind(
    hdf5=("octrees.svo_hdf5",),
    xml=True,
    mesh="is a mesh: voxelize it first (voxtool voxelize {name})",
    other="is no octree: expected HDF5 (.svo.h5) or XML (.svo.xml, .svo.xml.gz)",
    endings=AN_EXPORT,
)
STORED_OCTREE = replace(OCTREE, sliced=True)
FIELD = Kind(
    hdf5=("fields.adf_hdf5",),
    mesh="is a mesh: build a field first: voxtool adf-build {name}",
    other="is no distance field: expected HDF5 (.adf.h5)",
    endings={
        tuple(f".{name}" for name in IMAGES): "holds another program's image: if its values are "
        "signed distances, import it first: voxtool import --as-field {name}",
        (".svo.xml", ".svo.xml.gz"): "is an octree: build a field first: voxtool adf-build MESH",
    },
)
STORED_FIELD = replace(FIELD, hdf5=("fields.adf_slices",), sliced=True)
VOLUME = Kind(
    hdf5=("cells.tet_hdf5",),
    mesh="is a mesh of triangles: a volume is built of tetrahedra or hexahedra: voxtool tet-build "
    "MESH.vtu",
    other="is no tetrahedral volume: expected HDF5 (.tet.h5)",
)
SHAPE = Kind(
    hdf5=("octrees.svo_hdf5", "fields.adf_hdf5"),
    xml=True,
    mesh="is a mesh: voxelize it first (voxtool voxelize {name}), or voxtool adf-build {name}",
    other=OCTREE.other,
    endings=AN_EXPORT,
)
STORED_SHAPE = replace(SHAPE, sliced=True)
SCENE = Kind(
    hdf5=("octrees.svo_hdf5", "fields.adf_hdf5", "cells.tet_hdf5"),
    xml=True,
    mesh="is a mesh: make an octree or a field of it first: voxtool voxelize {name}, or voxtool "
    "adf-build {name}",
    other=OCTREE.other,
    endings=AN_EXPORT,
)
STORED_SCENE = replace(SCENE, sliced=True)


def ending(name: str) -> str:
    """Return the ending of names of a format: .vti, or %04d.png of pictures with numbers."""
    return name if name.startswith("%") else f".{name}"


def folder_of(path: PathLike, name: str) -> Path:
    """Return the file or the folder that a format makes: of layers/%04d.png, layers."""
    is_pattern = is_folder(name) and "%" in os.path.basename(path)
    return Path(path).parent if is_pattern else Path(path)


def is_folder(name: str) -> bool:
    """Return True if a format is a folder of files."""
    return name in EXCHANGE and EXCHANGE[name].folder


def check_output(path: PathLike, name: str, clobber: bool) -> None:
    """Raise FileError, before any work, if an output of a format cannot be written."""
    check_package(name)
    if path != STREAM:
        check_target(folder_of(path, name), clobber, folder=is_folder(name))


def function_of(name: str, verb: str) -> Callable[..., Any]:
    """Return the function of an export that is `size`, `write` or `read`; FileError if the package
    that it needs is not installed."""
    check_package(name)
    format = EXCHANGE[name]
    return getattr(import_module(f"voxtool.files.{format.module}"), verb + format.suffix)


def check_package(name: str) -> None:
    """Raise FileError if the package that a format needs is not installed."""
    needed = EXCHANGE[name].needs if name in EXCHANGE else ""
    if needed and find_spec(needed) is None:
        raise FileError(
            f".{name} needs {needed}, which is not installed: pip install "
            f"'voxtool[{EXCHANGE[name].extra}]'"
        )


def is_mesh(path: PathLike) -> bool:
    """Return True if the name is that of a file of a triangle mesh."""
    return os.fspath(path).lower().removesuffix(".gz").endswith(MESH_EXTENSIONS)


def reader_for(kind: Kind, name: str, opening: bytes) -> Reader:
    """Return the function that reads a file of this kind, chosen by its first bytes; for a file of
    another kind, FileError names the missing step."""
    if _is_volume_mesh(name, opening):
        raise FileError(
            f"{name} is a mesh of volume cells: build its textures first: voxtool tet-build {name}"
        )
    if opening.startswith(HDF5):
        from voxtool.files.storage import hdf5

        schemas = (import_module(f"voxtool.files.{module}").SCHEMA for module in kind.hdf5)
        return partial(hdf5.read_slices if kind.sliced else hdf5.read, schemas)
    lower = name.lower()
    if lower.endswith(MESH_EXTENSIONS) or opening.startswith(MESH_OPENINGS):
        raise FileError(f"{name} {kind.mesh.format(name=name)}")
    for endings, message in kind.endings.items():  # before XML and gzip, which exports can be
        if lower.endswith(endings):
            raise FileError(f"{name} {message.format(name=name)}")
    if kind.xml and opening.startswith(GZIP):
        return import_module("voxtool.files.octrees.svo_xml").read_gz
    if kind.xml and opening.removeprefix(BOM).lstrip().startswith(b"<"):
        return import_module("voxtool.files.octrees.svo_xml").read
    raise FileError(f"{name} {kind.other}")


def _is_volume_mesh(name: str, opening: bytes) -> bool:
    """Return whether a name is that of a volume mesh. HDF5 counts as Exodus only: other HDF5 files
    are read by content."""
    known = VOLUME_FORMATS.get(os.path.splitext(name.lower())[1])
    return known is not None and (known == "exodus" or not opening.startswith(HDF5))


def format_of(path: PathLike, formats: Iterable[str]) -> str:
    """Return the format that the extension of a name says; for stdout HDF5 or OBJ. FileError if
    there is none."""
    formats = tuple(formats)
    if path == STREAM:
        for default in STREAM_FORMATS:
            if default in formats:
                return default
    name = re.sub(r"%0?\d*d(?=[^/]*$)", ".%04d", os.fspath(path).lower())  # layers/%d.png
    endings = {*formats, *SVO_FORMATS, *ADF_FORMATS, *TET_FORMATS}
    for extension in sorted(endings, key=len, reverse=True):
        if name.endswith(f".{extension}"):  # the longest: .svo.h5 is no .h5 of another kind
            if extension in formats:
                return extension
            break
    known = ", ".join(
        ending(e) for e in formats if not any(other.endswith(f".{e}") for other in formats)
    )
    surfaces = "obj" in formats  # are what is written
    if not surfaces and name.endswith(tuple(f".{mesh}" for mesh in MESH_FORMATS)):
        raise FileError(f"{path} would be a surface: voxtool extract FILE -o {path} writes it")
    if path == STREAM:
        raise FileError(f"standard output has no extension: give --format, one of {known}")
    raise FileError(f"{path}: the name says no format: end it in one of {known}")
