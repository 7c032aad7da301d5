"""Files that name other files, or hold little and declare or unpack to much. docs/security.md lists
these tests beside the formats."""

from __future__ import annotations

import base64
import ctypes
import gzip
import io
import json
import os
import pickle
import resource
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from fuzz.bombs import endless_list, vtu_bomb, write_exodus_bomb
from helpers import meshes
from helpers.files import DATA, refusal, run_python
from helpers.tets import cube

import voxtool
from voxtool.errors import FileError, MemoryLimitError, MeshError, VoxtoolError
from voxtool.files.tables.points import read_points

SECRET = "a-secret-word"
OPENED = 0x20  # IN_OPEN of inotify


@pytest.fixture
def other(tmp_path: Path) -> Path:
    path = tmp_path / "other.txt"
    path.write_text(f"{SECRET}\n")
    return path


@contextmanager
def not_opened(path: Path) -> Iterator[None]:
    """Check that nothing opens a file, C libraries included."""
    if sys.platform != "linux":
        pytest.skip("only Linux says which files are opened")
    libc = ctypes.CDLL(None)
    notes = libc.inotify_init1(os.O_NONBLOCK)
    assert libc.inotify_add_watch(notes, os.fsencode(path), OPENED) > 0
    try:
        yield
        with pytest.raises(BlockingIOError):
            os.read(notes, 4096)
    finally:
        os.close(notes)


def test_a_file_that_is_opened_shows(other: Path) -> None:
    with pytest.raises(pytest.fail.Exception), not_opened(other):
        other.read_text()


def read_all_points(path: Path) -> np.ndarray:
    return np.concatenate(list(read_points(path)))


READERS: dict[str, Callable[[Path], Any]] = {
    "mesh": voxtool.load_mesh,
    "octree": voxtool.read_svo,
    "cells": voxtool.read_unstructured,
    "points": read_all_points,
    "transfer": voxtool.read_transfer,
}


# ---- other files

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PLY = (
    "ply\nformat ascii 1.0\ncomment TextureFile {}\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
NODES = "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n"
SOLID = f"{NODES}*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n"
XML = '<octree dim="8">{}</octree>'
INCLUDE = '<i:include xmlns:i="http://www.w3.org/2001/XInclude" href="{}"/>'
VTU = (
    '<VTKFile type="UnstructuredGrid">{}<UnstructuredGrid><Piece NumberOfPoints="0" '
    'NumberOfCells="0"/></UnstructuredGrid></VTKFile>'
)


def gltf(buffer: str, image: str = "", binary: bool = False) -> bytes:
    """A triangle whose buffer and image are elsewhere."""
    data = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], "<f4").tobytes()
    inside = f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}"
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0}}
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": buffer or inside, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    if image:
        tree |= {
            "images": [{"uri": image}],
            "textures": [{"source": 0}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        }
        primitive["material"] = 0
    text = json.dumps(tree).encode()
    if not binary:
        return text
    text += b" " * (-len(text) % 4)
    return struct.pack("<4s4I4s", b"glTF", 2, 20 + len(text), len(text), 0, b"")[:16] + (
        b"JSON" + text
    )


NAMED_IN_TEXT = [  # format, what names the file, reader, text, refusal or "" where it is ignored
    ("obj", "mtllib", "mesh", f"mtllib {{}}\n{TRIANGLE}", ""),
    ("ply", "TextureFile", "mesh", PLY, ""),
    ("gltf", "buffer", "mesh", lambda path: gltf(path), "not readable as GLTF"),
    ("gltf", "image", "mesh", lambda path: gltf("", path), ""),
    ("glb", "buffer", "mesh", lambda path: gltf(path, binary=True), "not readable as GLB"),
    ("svo.xml", "DTD", "octree", '<!DOCTYPE octree SYSTEM "{}">' + XML, "line 1: "),
    (
        "svo.xml",
        "entity",
        "octree",
        '<!DOCTYPE octree [<!ENTITY e SYSTEM "{}">]>' + XML.format("&e;"),
        "internal subset is refused",
    ),
    ("svo.xml", "XInclude", "octree", XML.format(INCLUDE), "element i:include"),
    ("svo.xml", "stylesheet", "octree", '<?xml-stylesheet href="{}"?>' + XML, "instructions are"),
    ("vtu", "XInclude", "cells", VTU.format(INCLUDE), "Unknown main tag"),
    ("vtu", "entity", "cells", '<!DOCTYPE v [<!ENTITY e SYSTEM "{}">]>' + VTU, "document type"),
    ("vtu", "DTD", "cells", '<!DOCTYPE v SYSTEM "{}">' + VTU, "document type"),
    *(
        ("inp", f"Abaqus {text.partition(chr(10))[0]}", "cells", SOLID + text, "names another file")
        for text in (
            "*INCLUDE, INPUT={}\n",
            "*include,input={}\n",
            "* Include , Input = {}\n",
            "*INCLUDE,\nINPUT={}\n",
            "*\u0131NCLUDE, ={}\n",
            "*NODE, INPUT={}\n",
            "*ELEMENT, TYPE=C3D4,\n INPUT={}\n",
        )
    ),
]


@pytest.mark.parametrize(
    ("extension", "what", "reader", "text", "message"),
    NAMED_IN_TEXT,
    ids=[f"{extension} {what!a}" for extension, what, *_ in NAMED_IN_TEXT],
)
def test_text_that_names_another_file(
    extension: str, what: str, reader: str, text: Any, message: str, other: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"a.{extension}"
    content = text.replace("{}", str(other)).encode() if isinstance(text, str) else text(str(other))
    path.write_bytes(content)
    with not_opened(other):
        if message:
            with pytest.raises(VoxtoolError, match=message) as caught:
                READERS[reader](path)
            assert SECRET not in str(caught.value)
            assert "\n" not in str(caught.value)
        else:
            assert len(READERS[reader](path).faces) in (0, 1)


def link(kind: str, other: Path) -> Callable[[h5py.File, str], None]:
    """Return a function that moves a dataset into another place or file."""

    def change(h5: h5py.File, name: str) -> None:
        shape, dtype = h5[name].shape, h5[name].dtype
        del h5[name]
        if kind == "soft link":
            h5[name] = h5py.SoftLink("/elsewhere")
        elif kind == "external link":
            h5[name] = h5py.ExternalLink(str(other), name)
        elif kind == "external storage":
            size = int(np.prod(shape)) * dtype.itemsize
            h5.create_dataset(name, shape, dtype, external=[(str(other), 0, size)])
        else:
            layout = h5py.VirtualLayout(shape, dtype)
            layout[...] = h5py.VirtualSource(str(other), name, shape)
            h5.create_virtual_dataset(name, layout)

    return change


@pytest.mark.parametrize(
    "kind", ["soft link", "external link", "external storage", "virtual dataset"]
)
@pytest.mark.parametrize(("file", "dataset"), [("a.svo.h5", "nodes"), ("a.exo", "coordx")])
def test_hdf5_that_names_another_file(
    kind: str, file: str, dataset: str, other: Path, tmp_path: Path
) -> None:
    path = tmp_path / file
    if file == "a.exo":
        box = cube(6)
        scalars = {"s": np.arange(8.0)}
        meshio.write(path, meshio.Mesh(box.points, [("tetra", box.cells[0][1])], scalars))
        with h5py.File(path, "r+") as h5:
            name = "coordx" if "coordx" in h5 else "coord"
            h5[dataset] = h5[name] if name != dataset else h5[dataset]
    else:
        path.write_bytes((DATA / "v1.0.svo.h5").read_bytes())
    with h5py.File(path, "r+") as h5:
        link(kind, other)(h5, dataset if dataset in h5 else "coord")
    with not_opened(other):
        reader = READERS["octree" if file == "a.svo.h5" else "cells"]
        refusal(reader, path, "link|other files|not contiguous|another file")


class Dangerous:
    """An object whose pickle makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_pickle_is_not_loaded(name: str, tmp_path: Path) -> None:
    made = tmp_path / "made"
    array = np.empty((1, 3), object)
    array[:] = [[Dangerous(made)] * 3]
    (np.save if name == "a.npy" else np.savez)(tmp_path / name, array)
    refusal(read_all_points, tmp_path / name, r"type \|O")
    (tmp_path / "b.npy").write_bytes(pickle.dumps(Dangerous(made)))
    refusal(read_all_points, tmp_path / "b.npy", "number|points|letters|header|column")
    assert not made.exists()


# ---- counts

MSH = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
MANY = 4 * 10**9


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.msh", f"{MSH}$NodeData\n{MANY}\n", r"\$NodeData 4000000000 is no number of items"),
        ("a.msh", f'{MSH}$NodeData\n1\n"s"\n{MANY}\n', "ends before the counts that it declares"),
        ("a.msh", f"{MSH}$Nodes\n{MANY}\n", r"\$Nodes 4000000000"),
        ("a.mesh", f"MeshVersionFormatted 2\nDimension 3\nVertices\n{MANY}\n", "Vertices 4000"),
        ("a.inp", f"# a\n{MANY} 1 0 0 0\n", "avsucd|4000000000 is no number"),
        (
            "a.vtk",
            f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {MANY} int\n",
            "POINTS 4000000000",
        ),
        (
            "a.vtk",
            "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\n"
            "DIMENSIONS 900 900 900\nORIGIN 0 0 0\nSPACING 1 1 1\n",
            "DIMENSIONS 729000000",
        ),
    ],
)
def test_counts_are_compared_with_the_file(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text)
    refusal(voxtool.read_unstructured, path, message)


def test_the_limit_of_memory_is_put_back(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)
    (tmp_path / "a.vtu").write_bytes(vtu_bomb())
    with pytest.raises(FileError, match=r"meshio takes more than .* to read it as vtu"):
        voxtool.read_unstructured(tmp_path / "a.vtu")
    assert resource.getrlimit(resource.RLIMIT_AS) == before


# ---- bombs


def gz(line: bytes) -> bytes:
    """A quarter of a MB that unpacks to 250 MB."""
    return 16 * gzip.compress(line * ((1 << 24) // len(line)), mtime=0)


def npz_bomb(columns: bool) -> bytes:
    """Points, all zero: 96 MB in 0.1 MB."""
    file = io.BytesIO()
    head = {"descr": "<f8", "fortran_order": columns, "shape": (4_000_000, 3)}
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, head)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("points.npy", header.getvalue() + bytes(24 * 4_000_000))
    return file.getvalue()


def scene(instances: int) -> bytes:
    tree = json.loads(gltf(""))
    tree["accessors"][0]["count"] = 3
    tree["nodes"] = [{"children": list(range(1, instances + 1))}, *[{"mesh": 0}] * instances]
    return json.dumps(tree).encode()


READ = "voxtool.read_unstructured(path)"
OCTREE = "voxtool.read_svo(path)"
LOAD = "voxtool.load_mesh(path)"
POINTS = "for _ in read_points(path): pass"
BOMBS: dict[str, tuple[Callable[[Path], Any], str]] = {  # what writes it, what reads it
    "blocks.vtu": (lambda path: path.write_bytes(vtu_bomb()), READ),
    "unwritten.exo": (write_exodus_bomb, READ),
    "chunk.exo": (
        lambda path: write_exodus_bomb(path, 8, zlib.compress(bytes(200 << 20), 9)),
        READ,
    ),
    "endless.svo.h5": (lambda path: path.write_bytes(endless_list("v1.0.svo.h5")), OCTREE),
    "endless.exo": (lambda path: path.write_bytes(endless_list("v1.0.svo.h5")), READ),
    "lines.obj.gz": (lambda path: path.write_bytes(gz(b"v 0 0 0\n")), LOAD),
    "zeros.ply.gz": (lambda path: path.write_bytes(gz(bytes(8))), LOAD),
    "blanks.svo.xml.gz": (lambda path: path.write_bytes(gz(b" " * 8)), OCTREE),
    "rows.npz": (lambda path: path.write_bytes(npz_bomb(False)), POINTS),
    "columns.npz": (lambda path: path.write_bytes(npz_bomb(True)), POINTS),
}
# Reads each file in a child of a process that has imported everything. The peak of a child begins
# with what its parent holds.
READ_BOMBS = """
import json, os, sys, traceback, warnings
import h5py, meshio, trimesh, lxml.etree, voxtool
import voxtool.files.cells.unstructured, voxtool.files.meshes.mesh
import voxtool.files.octrees.svo_xml
from voxtool.files.tables.points import read_points
warnings.simplefilter("ignore")
def peak():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))
for path, code in json.loads(sys.argv[1]).items():
    if not os.fork():
        before, said = peak(), ""
        try:
            exec(code)
        except voxtool.VoxtoolError as error:
            said = f"{type(error).__name__}: {error}"
        except BaseException:
            said = traceback.format_exc()
        print(json.dumps([path, peak() - before, said]), flush=True)
        os._exit(0)
    os.wait()
"""


@pytest.fixture(scope="module")
def bombs_read(tmp_path_factory) -> dict[str, tuple[int, int, str]]:
    """The size of each bomb, the memory that reading it takes, and what is said."""
    folder = tmp_path_factory.mktemp("bombs")
    codes = {}
    for name, (write, code) in BOMBS.items():
        write(folder / name)
        codes[str(folder / name)] = code
    done = run_python(READ_BOMBS, json.dumps(codes))
    assert done.returncode == 0, done.stderr
    told = map(json.loads, done.stdout.splitlines())
    return {Path(path).name: (Path(path).stat().st_size, taken, said) for path, taken, said in told}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux bounds the memory of a process")
@pytest.mark.parametrize("name", BOMBS)
def test_memory_of_a_bomb(name: str, bombs_read) -> None:
    """At most 64 MiB, and three times what the file takes: their declared content takes none."""
    size, taken, said = bombs_read[name]
    print(f"{name}: {size >> 10} kB, takes {taken / 2**20:.1f} MB: {said}")
    assert taken <= (64 << 20) + 3 * size
    assert ("Error: " in said) == ("npz" not in name), said
    assert said.count("\n") == 0


def test_what_a_gz_may_unpack_to(tmp_path: Path) -> None:
    """A mesh of equal triangles is read; --max-memory and a ratio of 100 are limits."""
    vertices, faces = meshes.icosphere(1)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [
        "f {} {} {}".format(*f + 1) for f in faces
    ]
    path = tmp_path / "a.obj.gz"
    path.write_bytes(gzip.compress(("\n".join(lines) + "\n# " + " " * (8 << 20)).encode()))
    assert len(voxtool.load_mesh(path).faces) == len(faces)
    with pytest.raises(MeshError, match="more than 1 MiB unpacked"):
        voxtool.load_mesh(path, max_memory=1 << 20)


def test_a_scene_that_repeats_its_meshes(tmp_path: Path) -> None:
    """Its memory is known before it is taken; nodes cannot be inside each other without end."""
    path = tmp_path / "a.gltf"
    path.write_bytes(scene(1000))
    assert len(voxtool.load_mesh(path).vertices) == 3000
    with pytest.raises(MemoryLimitError, match="its meshes need 361 kB and 360 kB are allowed"):
        voxtool.load_mesh(path, max_memory=360_000)
    tree = json.loads(gltf(""))
    tree["nodes"] = [{"children": [i + 1], "mesh": 0} for i in range(99)] + [{"mesh": 0}]
    path.write_text(json.dumps(tree))
    refusal(voxtool.load_mesh, path, "nodes inside more than 64 others")


@pytest.mark.parametrize("name", ["new\nline.{}", os.fsdecode(b"\xff\x1b[1m.{}")])
def test_names_in_messages_are_printable(name: str, tmp_path: Path) -> None:
    """Errors of what is not there, of a folder, of content and of writing are one line."""
    (tmp_path / name.format("vtu")).write_bytes(b"hello")
    (tmp_path / name.format("obj")).mkdir()
    for act in (
        lambda: voxtool.read_svo(tmp_path / name.format("svo.h5")),
        lambda: voxtool.read_unstructured(tmp_path / name.format("vtu")),
        lambda: voxtool.load_mesh(tmp_path / name.format("obj")),
        lambda: voxtool.write_mesh((np.eye(3), [[0, 1, 2]]), tmp_path / name.format("x")),
        lambda: voxtool.write_mesh((np.eye(3), [[0, 1, 2]]), tmp_path / name.format("obj")),
    ):
        with pytest.raises(VoxtoolError) as caught:
            act()
        assert str(caught.value).isprintable()
