"""A case for each fault that the fuzzer or a review has found; code generates the files."""

from __future__ import annotations

import base64
import gzip
import io
import os
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import netCDF4
import numpy as np

from voxtool.selftest.crowds import CROWDS
from voxtool.selftest.shapes import Shape

from .bombs import endless_list, vtu_bomb, write_exodus_bomb
from .cases import Case
from .mutate import SECRET

Content = Callable[[], bytes]
MANY, MORE = 20_000, 4 * 10**9  # faces that are there, and elements that are not
SUMMED = ("fan", "closed-fans", "loose-fan", "book", "needles", "nested")  # for winding numbers
TRIANGLE_GLTF = (
    '{"asset":{"version":"2.0"},"buffers":[{"uri":"%s","byteLength":36}],"bufferViews":'
    '[{"buffer":0,"byteLength":36}],"accessors":[{"bufferView":0,"componentType":5126,"count":3,'
    '"type":"VEC3"}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],"nodes":'
    '[{"mesh":0}],"scenes":[{"nodes":[0]}]}'
)
SCENES = ("svo.h5", "adf.h5", "raycast.tet.h5")


@dataclass(frozen=True)
class Entry:
    """A case by name.

    Attributes
    ----------
    file, content : of the case; both are empty without a file.
    command : that is run, with FILE for the file; without one the library uses the file.
    has, lacks : patterns that stderr must hold; that stdout and stderr must not hold.
    """

    name: str
    file: str = ""
    content: Content = bytes
    command: str = ""
    has: str = ""
    lacks: str = ""

    def case(self, device: str = "") -> Case:
        words = [self.file if word == "FILE" else word for word in self.command.split(" ")]
        format = self.file.partition(".")[2]
        words = [] if not self.command else words
        if words and words[0] not in ("svo-info", "tet-build"):
            words += ["--device", device]
        return Case(0, self.file, format, self.content(), tuple(words), self.has, self.lacks)


def entries() -> Iterator[Entry]:
    yield from counts()
    yield from other_files()
    yield from bombs()
    yield from repeated_faces()
    yield from numbers_and_words()
    yield from casts()
    yield Entry("a dimension of Exodus that is gone", "a.exo", without_dimension)


# ---- item 3: counts that the file does not hold


def counts() -> Iterator[Entry]:
    gmsh = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
    new = "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
    medit = "MeshVersionFormatted 2\nDimension 3\n"
    vtk = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\n"
    for name, file, text in (
        ("NodeData", "a.msh", f"{gmsh}$NodeData\n{MORE}"),
        ("ElementData", "a.msh", f"{gmsh}$ElementData\n{MORE}\n"),
        ("real tags", "a.msh", f'{gmsh}$NodeData\n1\n"s"\n{MORE}\n'),
        ("Nodes", "a.msh", f"{gmsh}$Nodes\n{MORE}\n"),
        ("Elements", "a.msh", f"{gmsh}$Elements\n{MORE}\n"),
        ("PhysicalNames", "a.msh", f"{gmsh}$PhysicalNames\n{MORE}\n"),
        ("Entities", "a.msh", f"{new}$Entities\n{MORE} 0 0 0\n"),
        ("Nodes 4.1", "a.msh", f"{new}$Nodes\n1 {MORE} 1 {MORE}\n"),
        ("Vertices", "a.mesh", f"{medit}Vertices\n{MORE}\n0 0 0 0\n"),
        ("Tetrahedra", "a.mesh", f"{medit}Tetrahedra\n{MORE}\n1 2 3 4 0\n"),
        ("POINTS", "a.vtk", f"{vtk}POINTS {MORE} double\n0 0 0\n"),
        ("CELLS", "a.vtk", f"{vtk}POINTS 1 double\n0 0 0\nCELLS {MORE} {5 * MORE}\n"),
        ("nodes", "a.ucd.inp", f"{MORE} 1 0 0 0\n1 0 0 0\n"),
        ("cells", "a.ucd.inp", f"1 {MORE} 0 0 0\n1 0 0 0\n"),
    ):
        yield Entry(f"count of {name} in {file}", file, text.encode)


# ---- item 4: files that name another file


def other_files() -> Iterator[Entry]:
    nodes = "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n"
    tetrahedron = f"{nodes}*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n"
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    vtu = (
        '<VTKFile type="UnstructuredGrid" xmlns:xi="http://www.w3.org/2001/XInclude">'
        '<xi:include href="%s" parse="text"/></VTKFile>'
    )
    doctype = '<!DOCTYPE octree [<!ENTITY e SYSTEM "%s">]><octree dim="8">&e;</octree>'
    for name, file, text in (
        ("Abaqus INCLUDE at the end", "a.inp", f"{tetrahedron}*INCLUDE, INPUT={SECRET}\n"),
        ("Abaqus INCLUDE in small letters", "a.inp", f"{tetrahedron}*include,input={SECRET}\n"),
        ("Abaqus INCLUDE of nodes", "a.inp", f"*NODE\n*INCLUDE, INPUT={SECRET}\n"),
        ("Abaqus INCLUDE in odd letters", "a.inp", f"{tetrahedron}\u0131N*CLUDE, ={SECRET}\n"),
        ("mtllib", "a.obj", f"mtllib {SECRET}\n{triangle}"),
        ("glTF buffer", "a.gltf", TRIANGLE_GLTF % SECRET),
        ("XInclude", "a.vtu", vtu % SECRET),
        ("external entity", "a.svo.xml", doctype % SECRET),
    ):
        yield Entry(f"another file by {name}", file, text.encode)


# ---- item 5: little that unpacks to much


def bombs() -> Iterator[Entry]:
    yield Entry("bomb of blocks", "a.vtu", lambda: vtu_bomb(1 << 25, 20))
    yield Entry("bomb of unwritten chunks", "a.exo", exodus_bomb)
    for file, kind in (
        ("a.svo.h5", "svo"),
        ("a.adf.h5", "adf"),
        ("a.raycast.tet.h5", "tet"),
        ("a.exo", "svo"),
    ):
        content = partial(endless_list, f"v1.0.{kind}.h5")
        yield Entry(f"bomb of an endless list in {file}", file, content)
    for file, line in (
        ("a.obj.gz", b"v 0 0 0\n"),
        ("a.ply.gz", b"\0" * 8),
        ("a.svo.xml.gz", b" " * 8),
    ):
        yield Entry(f"bomb of gzip in {file}", file, partial(gzip_bomb, line))


def gzip_bomb(line: bytes) -> bytes:
    return 32 * gzip.compress(line * (1 << 21), mtime=0)


def exodus_bomb() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_exodus_bomb(path := Path(folder) / "a.exo")
        return path.read_bytes()


# ---- item 6: many faces of one kind


def obj(points: np.ndarray, faces: np.ndarray) -> bytes:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    lines += ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
    return "\n".join(lines).encode()


def repeated_faces() -> Iterator[Entry]:
    commands = {
        "voxelize": "voxelize FILE --dim 16 -o out.svo.h5 -q",
        "adf-build": "adf-build FILE --max-level 3 -o out.adf.h5 -q",
        "diagnose": "diagnose FILE --dim 16 -q",
    }
    for kind, shape in CROWDS.items():
        for name, command in commands.items():
            # each winding number sums all triangles of a fan: fewer of them
            many = MANY // 40 if name == "adf-build" and kind in SUMMED else MANY // 4
            yield Entry(f"{name} of {kind}", "faces.obj", partial(crowd, shape, many), command)


def crowd(shape: Callable[[int], Shape], many: int) -> bytes:
    return obj(*shape(many))


# ---- item 11: numbers and words


def numbers_and_words() -> Iterator[Entry]:
    ball, field, volume = (f"render a.{kind} --size 16 -o out.png" for kind in SCENES)
    for command in (
        f"{ball} --eye 1e308,0,0",
        f"{ball} --orthographic --height 1e-200",
        f"{field} --offset 1e300",
        f"{volume} --eye 1e308,0,0",
        f"{volume} --orthographic --height 1e-200",
        f"{volume} --orthographic --height 1e300",
        f"{volume} --opacity-range 0,1e-320",
        "adf-build a.obj --tolerance 1e300 -o out.adf.h5",
    ):
        yield Entry(f"numpy warning of {command}", command=command)
    deep = f"{volume} --orthographic --opacity-range 1,2 --height"
    yield Entry("volume at height 1e-10", command=f"{deep} 1e-10", has="100 % of pixels hit")
    yield Entry("volume at height 1e-40", command=f"{deep} 1e-40", has="choose a --height")
    yield Entry("hint of render", command=f"{ball} --max-memory 1k", has="error", lacks="dim")
    tiny = b"v 0 0 0\nv 1e-320 0 0\nv 0 1e-320 0\nf 1 2 3\n"
    huge = b"v -1e308 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3\n"
    for name, content in {"tiny.obj": tiny, "huge.obj": huge}.items():
        for command in ("diagnose FILE", "voxelize FILE -o out.svo.h5"):
            yield Entry(f"{command} {name}", name, lambda c=content: c, command, has=name)
    for name in ("new\nline.svo.h5", os.fsdecode(b"\xff.svo.h5")):
        yield Entry(f"name {name!r}", name, lambda: b"\x89HDF\r\n\x1a\n", "svo-info FILE")
        yield Entry(f"output {name!r}", command=f"voxelize a.obj --dim 16 -o {name}")
    for name in ("new\nline.obj", os.fsdecode(b"\xff.obj")):
        yield Entry(f"name {name!r}", name, lambda: b"v 0 0 0\nf 1 2 3\n", "diagnose FILE")
    bench = "bench voxelize a.obj --quick --dims 8 --repeat 1 --samples 99 -o \udcff"
    budget = f"{bench} --budget-time 1e300 --json".replace(" -o \udcff", "")
    yield Entry("an answer beside JSON", command=budget)
    yield Entry("runs without end", command=bench.replace("--repeat 1", f"--repeat {10**30}"))
    yield Entry("name of an array", command="tet-build a.vtu --scalar \udcff")
    yield Entry("report in an odd folder", command=bench)
    points = np.array([(np.inf, 0, 0), (-np.inf, np.inf, 0)])
    csv = "\n".join(",".join(map(str, point)) for point in points.tolist()).encode()
    query = "adf-query a.adf.h5 FILE --gradient -o - --format csv"
    yield Entry("gradient at infinity", "far.csv", lambda: csv, query, lacks="nan")


# ---- found by this fuzzer


def casts() -> Iterator[Entry]:
    """Numbers whose conversion makes numpy warn: infinite references, signalling NaN."""
    medit = "MeshVersionFormatted 2\nDimension 3\nVertices\n1\n0 0 0 inf\n"
    yield Entry("infinite reference", "a.mesh", medit.encode)
    long = f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n${'-' * 999}8"
    yield Entry("a long warning of meshio", "a.old.msh", long.encode)
    file = io.BytesIO()
    np.save(file, np.full((1, 3), 0x7F800001, "<u4").view("<f4"))
    yield Entry("signalling NaN", "a.npy", file.getvalue)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    ply = f"{head}end_header\n".encode() + struct.pack("<3I", *[0x7F800001] * 3)
    yield Entry("signalling NaN of a vertex", "a.points.ply", lambda: ply)
    nrrd = "NRRD0004\ntype: int\ndimension: 3\nsizes: 9 9 9\nspace directions: " + (
        "(1e308,1e308,0) (0,6,0) (0,0,6)\nencoding: raw\n\n"
    )
    yield Entry("axes beyond float64", "a.image.nrrd", nrrd.encode, has="oblique")
    far = nrrd.replace("(1e308,1e308,0)", "(-1e308,0,0)")
    yield Entry("a side beyond float64", "a.image.nrrd", far.encode, has="not finite")
    vti = '<?xml version="1.0"?><VTKFile type="ImageData" byte_order="LittleEndian">' + (
        '<ImageData WholeExtent="0 9 0 9 0 9" Origin="0 0 0" Spacing="1 -inf 1">'
        '<Piece Extent="0 9 0 9 0 9"><CellData Scalars="a">'
        '<DataArray type="UInt8" Name="a" format="ascii">'
        f"{'1 ' * 729}</DataArray></CellData></Piece></ImageData></VTKFile>"
    )
    yield Entry("an infinite spacing", "a.image.vti", vti.encode)
    buffer = "data:;base64," + base64.b64encode(np.eye(3, dtype="<f4").tobytes()).decode()
    far = '"nodes":[{"children":[1],"scale":[1e308,1,1]},{"mesh":0,"scale":[1e308,0,1]}]'
    gltf = (TRIANGLE_GLTF % buffer).replace('"nodes":[{"mesh":0}]', far)
    yield Entry("a transform beyond float64", "a.gltf", gltf.encode)
    yield Entry("a port beyond any", command=f"voxelize a.obj --dask a:{2**63}", has="no scheduler")


# ---- found by the fuzzer in CI: netCDF's library crashed


def without_dimension() -> bytes:
    """An Exodus file with a variable over a dimension that something else has replaced."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exo"
        with netCDF4.Dataset(path, "w") as file:
            for name, size in {"xyz": 3, "nodes": 4, "cells": 1, "gone": 4, "time": None}.items():
                file.createDimension(name, size)
            file.createVariable("coord", "f8", ("xyz", "nodes"))[:] = np.eye(3, 4)
            block = file.createVariable("connect1", "i4", ("cells", "nodes"))
            block.elem_type = "TETRA"
            block[:] = [[1, 2, 3, 4]]
            file.createVariable("vals_nod_var1", "f8", ("time", "gone"))[0] = np.arange(4)
        with h5py.File(path, "r+") as file:
            del file["gone"]
            file["gone"] = np.zeros(0, ">f4")
        return path.read_bytes()
