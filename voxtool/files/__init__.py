"""Reading and writing: one module a format (formats.py lists them), behind a few functions.

Only this package touches the disk. Outputs appear whole or not at all; inputs are recognised by
content. Modules of formats, and what they import, are loaded when they are first needed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

from voxtool.errors import FileError, VoxtoolError
from voxtool.files import formats
from voxtool.files.formats import (
    ADF_FORMATS,
    COLOUR_FORMATS,
    EXPORTS,
    IMPORTS,
    MESH_EXTENSIONS,
    MESH_FORMATS,
    NORMAL_FORMATS,
    PART_FORMATS,
    SVO_FORMATS,
    TET_FORMATS,
    TEXT_FORMATS,
    VOLUME_FORMATS,
    Kind,
    Writer,
    format_of,
    is_mesh,
)
from voxtool.files.storage import streams
from voxtool.files.storage.atomic import alone, atomic_path, check_target
from voxtool.files.storage.streams import PathLike

if TYPE_CHECKING:
    import numpy as np

    from voxtool.adf.field.field import DistanceField
    from voxtool.adf.field.stored_field import StoredField
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.dag.merged import MergedOctree
    from voxtool.svo.octree.content import OctreeContent, StoredOctree
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.sets.labels import Labels
    from voxtool.svo.solvers.wall_links import WallLinks
    from voxtool.svo.surface.blocks import BlockSurface
    from voxtool.svo.surface.labelled import LabelledSurface
    from voxtool.tets.volume.mesh import UnstructuredMesh
    from voxtool.tets.volume.volume import TetVolume

__all__ = [
    "ADF_FORMATS",
    "EXPORTS",
    "IMPORTS",
    "MESH_EXTENSIONS",
    "MESH_FORMATS",
    "NORMAL_FORMATS",
    "PART_FORMATS",
    "SVO_FORMATS",
    "TET_FORMATS",
    "TEXT_FORMATS",
    "VOLUME_FORMATS",
    "alone",
    "atomic_path",
    "check_holds_parts",
    "check_target",
    "export",
    "format_of",
    "is_mesh",
    "open_adf",
    "open_scene",
    "open_shape",
    "open_svo",
    "read_adf",
    "read_drawn",
    "read_scene",
    "read_shape",
    "read_svo",
    "read_tet",
    "read_unstructured",
    "write_adf",
    "write_blocks",
    "write_mesh",
    "write_svo",
    "write_tet",
    "write_wall_links",
]


def read_svo(path: PathLike) -> Octree:
    """Read an octree; `-` reads stdin. The format is recognised by content, not by name. A merged
    octree (SVO 2.0) is expanded to the octree that it stands for.

    Raises
    ------
    FileError
        no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, formats.OCTREE)


@contextmanager
def open_shape(path: PathLike) -> Iterator[Octree | StoredOctree | MergedOctree | DistanceField]:
    """Yield an octree as `open_svo` does, or a distance field in memory."""
    with ExitStack() as stack:
        yield _read_open(path, formats.STORED_SHAPE, stack)


@contextmanager
def open_scene(path: PathLike) -> Iterator[Any]:
    """Yield an octree as `open_svo` does, or a field or a volume in memory."""
    with ExitStack() as stack:
        yield _read_open(path, formats.STORED_SCENE, stack)


@contextmanager
def open_svo(path: PathLike) -> Iterator[Octree | StoredOctree | MergedOctree]:
    """Yield an octree as `read_svo` returns it, but its nodes, its bricks and the values of its
    attributes stay in an HDF5 file, and a merged one is not expanded."""
    with ExitStack() as stack:
        yield _read_open(path, formats.STORED_OCTREE, stack)


def write_svo(
    octree: Octree | MergedOctree,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    doctype: bool = False,
) -> None:
    """Write an octree as HDF5 (.svo.h5) or XML (.svo.xml, .svo.xml.gz, .voccel.xml), a merged one
    as HDF5; `-` writes stdout.

    Parameters
    ----------
    clobber
        False refuses an existing file.
    format
        "svo.h5", "svo.xml", "svo.xml.gz" or "voccel.xml" instead of what the name says.
    doctype
        True names the DTD of XML, octree.dtd, in a DOCTYPE.

    Raises
    ------
    FileError
        the file cannot be written, its name says no format, or one that has no DOCTYPE.
    """
    format = format or format_of(path, SVO_FORMATS)
    if doctype and "xml" not in format:
        raise FileError(f".{format} has no DOCTYPE: write .svo.xml or .voccel.xml")
    more = {"doctype": True} if doctype else {}
    _write(octree, path, clobber, format, SVO_FORMATS, **more)


def read_adf(path: PathLike) -> DistanceField:
    """Read a distance field; `-` reads stdin. The format is recognised by content, not by name.

    Raises
    ------
    FileError
        no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, formats.FIELD)


@contextmanager
def open_adf(path: PathLike) -> Iterator[StoredField | DistanceField]:
    """Yield a distance field as `read_adf` returns it, but its blocks stay in the file; one of
    version 1 is in memory."""
    with ExitStack() as stack:
        yield _read_open(path, formats.STORED_FIELD, stack)


def write_adf(
    field: DistanceField, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write a distance field as HDF5 (.adf.h5); `-` writes stdout.

    Parameters
    ----------
    clobber
        False refuses an existing file.
    format
        "adf.h5" instead of what the name says.

    Raises
    ------
    FileError
        the file cannot be written, its name says no format, or an attribute of the field
        is out of range or does not fit.
    """
    _write(field, path, clobber, format, ADF_FORMATS)


def read_tet(path: PathLike) -> TetVolume:
    """Read a tetrahedral volume; `-` reads stdin. The format is recognised by content, not by name.

    Raises
    ------
    FileError
        no such file, or one that is damaged, hostile or of another kind.
    """
    return _read(path, formats.VOLUME)


def write_tet(
    volume: TetVolume, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write a tetrahedral volume as HDF5 (.tet.h5); `-` writes stdout.

    Parameters
    ----------
    clobber
        False refuses an existing file.
    format
        "tet.h5" instead of what the name says.

    Raises
    ------
    FileError
        the file cannot be written, its name says no format, or an attribute of the volume
        is out of range or does not fit.
    """
    _write(volume, path, clobber, format, TET_FORMATS)


def read_unstructured(
    path: PathLike,
    scalar: str | None = None,
    component: str | int | None = None,
    max_memory: int | None = None,
) -> UnstructuredMesh:
    """Read a mesh of volume cells and one of its arrays, mostly through meshio (the extra `tets`).

    Parameters
    ----------
    path
        a .vtu, .vtk, .msh (Gmsh), .mesh (Medit), .inp (Abaqus, AVS UCD) or .ex2, .exo, .e
        (Exodus II, which needs no meshio) file.
    scalar
        the name of an array at points, or else at cells; None takes the only one there is.
    component
        of an array of vectors: "x", "y", "z", a number from 0, or "magnitude".
    max_memory
        bytes that reading may take; at most what its declared content needs, and what is free.

    Raises
    ------
    FileError
        the file cannot be read, meshio is needed and not installed, or there is no such array
        or component.
    MemoryLimitError
        reading needs more memory than is allowed or free.
    """
    from voxtool.files.cells.unstructured import read

    return read(path, scalar, component, max_memory)


def read_shape(path: PathLike) -> Octree | DistanceField:
    """Read an octree or a distance field, as read_svo does."""
    return _read(path, formats.SHAPE)


def read_scene(path: PathLike) -> Octree | DistanceField | TetVolume:
    """Read an octree, a distance field or a tetrahedral volume, as read_svo does."""
    return _read(path, formats.SCENE)


def read_drawn(path: PathLike, kind: Kind = formats.SCENE) -> Any:
    """Read what a picture shows, as read_scene does, but a merged octree is not expanded."""
    with ExitStack() as stack:
        return _read_open(path, kind, stack)


def export(
    content: OctreeContent | DistanceField | TetVolume | Labels | PathLike,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    *,
    level: int = 0,
    bbox: Sequence[float] | None = None,
    invert: bool = False,
    dtype: Any = None,
    normals: bool = False,
    band: float | None = None,
    shape: int | Sequence[int] | None = None,
    spacing: float | Sequence[float] | None = None,
    grid: Grid | PathLike | None = None,
    lattice: Grid | PathLike | None = None,
    leaves: bool = False,
    attributes: str | Sequence[str] | None = None,
    max_bytes: int | None = None,
    device: Device | None = None,
    **options: Any,
) -> None:
    """Export voxels, a field or a volume for other programs, as the name of the file says.

    Parameters
    ----------
    content : OctreeContent, DistanceField, TetVolume, Labels or path
        The voxels, whose nodes may be in a file or merged (`open_svo`); or a field, whose signed
        distances are sampled at the centres of the cells of a grid, in float32; in a .vdb or .nvdb
        as a level set, for which it needs signs; or a volume, whose cells a .vtkhdf holds with
        their scalar; or the labels of components, as whole numbers.
    path : path
        The file or the folder; `-` writes stdout.
    clobber : bool
        False refuses an existing file.
    format : str, optional
        A format that `voxtool export -h` lists; by default what the name says.
    level : int
        0 for voxels, or N for cells of 2**N voxels a side.
    bbox : (6,) sequence of float, optional
        Box X0 Y0 Z0 X1 Y1 Z1 in world units: only the cells that it touches.
    invert : bool
        Export the unset voxels of the grid instead of the set ones.
    dtype : dtype, optional
        "bool" (at least half of a cell is set), "uint8", "uint16" or "uint32" (the number of its
        voxels that are set), "float32" or "float64" (the share of them); by default bool for
        voxels, and float32 above them.
    normals : bool
        Write the unit normals of the cells, too, to a ply or xyz. They point to where less is set,
        and are 0 where there is no such direction.
    band : float, optional
        Half-width of the level set of a field, in voxels; by default 3.
    shape : int or (3,) sequence of int, optional
        Cells along each axis of a grid over a field's cube.
    spacing : float or (3,) sequence of float, optional
        Size of a cell of that grid in world units; by default that of the finest leaves, and at
        most 256 cells along a side. A level set takes one number, without that limit.
    grid : Grid or path, optional
        The grid of a field's samples: itself, or that of an octree or a file that read_voxels
        reads.
    lattice : Grid or path, optional
        A grid over a field's cube, with the voxels of this grid or file.
    leaves : bool
        Write a hexahedron for each of the largest cubes of cells to a .vtu, .msh or .inp, not for
        each cell, with the nodes that hang.
    attributes : str or sequence of str, optional
        Names of the attributes of an octree that are written, or "none"; by default all that the
        format can hold, and the label if it holds one.
    max_bytes : int, optional
        Refuse a larger output.
    device : Device, optional
        Where a field is sampled; the default device if None.
    **options
        For a png, `axis` ("x", "y" or "z") and `value` (the index of the slice, in voxels).

    Raises
    ------
    FileError
        If the output cannot be written, is larger than its disk or max_bytes, or its name says no
        format; or if the package that the format needs is not installed.
    GridError
        If the slice is outside the grid, the box touches no voxel, or a grid is out of range.
    MemoryLimitError
        If the export does not fit in memory.
    VoxtoolError
        If there is no such level, dtype, attribute, band, shape or spacing, or a level set is to be
        made of a field without signs.
    """
    from voxtool.files.exchange import plan_export

    with ExitStack() as stack:
        held: Any = content
        if isinstance(content, str | os.PathLike):
            held = stack.enter_context(open_scene(content))
        plan_export(
            held, path, clobber, format, level=level, bbox=bbox, invert=invert, dtype=dtype,
            normals=normals, band=band, shape=shape, spacing=spacing, grid=grid,
            lattice=lattice, leaves=leaves, attributes=attributes, max_bytes=max_bytes,
            device=device, **options,
        ).run()  # fmt: skip


def write_blocks(
    surface: BlockSurface,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    origin: Sequence[float] | None = None,
) -> None:
    """Write a surface that comes in blocks, as .ply, relative to an origin.

    Raises
    ------
    FileError
        If the file cannot be written, or is of another format.
    """
    from voxtool.files.meshes.mesh import relative_to

    _write(relative_to(surface, origin), path, clobber, format, {"ply": MESH_FORMATS["ply"]})


def write_mesh(
    mesh: Any,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    normals: np.ndarray | None = None,
    origin: Sequence[float] | None = None,
) -> None:
    """Write a triangle mesh, or the result of `extract`, as .obj, .ply, .stl, .glb or .off; the
    meshes of labels as .obj, .glb or .3mf. Colours of vertices are written to .obj, .ply and .glb.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, pair of arrays, Isosurface or LabelledSurface
        The triangle mesh; of labels, each becomes an object or a node of its name.
    path : path
        The file; `-` writes stdout, as OBJ.
    clobber : bool
        False refuses an existing file.
    format : str, optional
        "obj", "ply", "stl", "glb" or "off"; by default what the name says.
    normals : (V, 3) float64, optional
        Unit vectors, one for each vertex, for .obj, .ply and .glb.
    origin : (3,) float, optional
        A point that is subtracted from the vertices, so that meshes far from 0 fit float32.

    Raises
    ------
    FileError
        If the file cannot be written, its name says no format, or the format cannot hold the mesh
        or its normals.
    MeshError
        If a vertex is not finite, or the normals are not finite and one for each vertex.
    MemoryLimitError
        If the text does not fit in memory.
    """
    if origin is not None:
        from voxtool.files.meshes.mesh import relative_to

        mesh = relative_to(mesh, origin)
    of_parts = hasattr(mesh, "sides")  # a LabelledSurface
    format = format or format_of(path, MESH_FORMATS | (PART_FORMATS if of_parts else {}))
    if of_parts:
        if normals is not None:
            raise FileError("meshes with common borders have no normals of vertices: omit them")
        if format in MESH_FORMATS:
            check_holds_parts(format)
        _write(mesh, path, clobber, format, PART_FORMATS)
        return
    if normals is not None and format in MESH_FORMATS and format not in NORMAL_FORMATS:
        held = ", ".join(f".{name}" for name in NORMAL_FORMATS)
        raise FileError(
            f".{format} holds no vertex normals: write one of {held}, or leave them out"
        )
    if hasattr(mesh, "coloured"):  # an Isosurface
        mesh, of = mesh.coloured() if format in COLOUR_FORMATS else (mesh.mesh(), ...)
        normals = None if normals is None else normals[of]
    if not hasattr(mesh, "source_sha256"):  # no Mesh yet
        from voxtool.files.meshes.mesh import as_mesh

        mesh = as_mesh(mesh)
    _write(mesh, path, clobber, format, MESH_FORMATS, normals=normals)


def write_wall_links(
    links: WallLinks, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write the links of a lattice, as .npz or HDF5 (.h5).

    Parameters
    ----------
    links : WallLinks
        The links.
    path : path
        The file; `-` writes stdout.
    clobber : bool
        False refuses an existing file.
    format : str, optional
        "npz" or "h5"; by default what the name says.

    Raises
    ------
    FileError
        If the file cannot be written, or its name says no format.
    """
    _write(links, path, clobber, format, formats.LINK_FORMATS)


def check_holds_parts(format: str) -> None:
    """Raise FileError if a format of meshes holds a single one."""
    if format not in PART_FORMATS:
        held = ", ".join(f".{name}" for name in PART_FORMATS)
        raise FileError(f".{format} holds one mesh without a name: write {held}")


def _read(path: PathLike, kind: Kind) -> Any:
    """Return the content of a file, as the reader for its format returns it; merged octrees
    expanded."""
    with ExitStack() as stack:
        content = _read_open(path, kind, stack)
    if not hasattr(content, "expanded"):  # a MergedOctree
        return content
    with _naming(streams.input_name(path)):
        return content.expanded()


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Put the name of a file before the errors of this block."""
    try:
        yield
    except VoxtoolError as error:
        raise type(error)(f"{name}: {error}") from error


def _read_open(path: PathLike, kind: Kind, stack: ExitStack) -> Any:
    """Return the content of a file, which stays open until the stack ends."""
    name = streams.input_name(path)
    try:
        file, size = stack.enter_context(streams.open_whole(path))
        if size == 0:
            raise FileError(f"{name} is empty")
        read = formats.reader_for(kind, name, file.read(streams.OPENING))
        file.seek(0)
        with _naming(name):
            return read(file, size)
    except OSError as error:
        raise streams.read_error(name, error) from error
    except MemoryError as error:
        raise FileError(f"{name}: more than fits in memory") from error


def _write(
    content: Octree
    | MergedOctree
    | DistanceField
    | TetVolume
    | Mesh
    | BlockSurface
    | LabelledSurface
    | WallLinks,
    path: PathLike,
    clobber: bool,
    format: str | None,
    writers: dict[str, Writer],
    **options: Any,
) -> None:
    format = format or format_of(path, writers)
    if format not in writers:
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(writers)}")
    writer = writers[format]
    module = import_module(f"voxtool.files.{writer.module}")
    if path != streams.STREAM:
        check_target(path, clobber)
    with streams.open_output(path, writer.text, clobber) as file:
        getattr(module, writer.function)(content, file, **options)
