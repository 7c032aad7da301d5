"""A small valid file of every format that is read, written by voxtool and by meshio."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import json
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner
from helpers import meshes
from helpers import tets as helpers_tets

import voxtool
from voxtool.cli.main import cli
from voxtool.files import write_mesh
from voxtool.files.formats import EXCHANGE
from voxtool.files.meshes import threemf

from . import looks

OCTREES = ("svo.h5", "svo.xml", "svo.xml.gz", "voccel.xml", "merged.svo.h5")
FIELDS = ("adf.h5",)
VOLUMES = ("raycast.tet.h5", "projection.tet.h5", "hexahedra.tet.h5")
MESHES = ("obj", "ply", "stl", "off", "glb", "gltf", "text.ply", "text.stl", "obj.gz", "ply.gz",
          "3mf")  # fmt: skip
CELLS = ("vtu", "text.vtu", "vtk", "text.vtk", "msh", "text.msh", "old.msh", "mesh", "inp",
         "ucd.inp", "exo", "e")  # fmt: skip
POINTS = ("npy", "columns.npy", "npz", "packed.npz", "csv", "xyz", "points.ply", "text.points.ply")
PACKED = ("text.image.vti", "lzma.image.vti", "lz4.image.vti", "text.image.nrrd", "bz2.image.nrrd",
          "lzma.image.npz")  # fmt: skip
IMAGES = (
    *(f"image.{name}" for name, format in EXCHANGE.items() if format.reads and not format.folder),
    *PACKED,
)
FOLDERS = tuple(  # their samples are archives of what is in them
    f"image.{name}" for name, format in EXCHANGE.items() if format.reads and format.folder
)
TRANSFERS = ("json",)
REPORTS = ("report.json",)
FORMATS = (*OCTREES, *FIELDS, *VOLUMES, *MESHES, *CELLS, *POINTS, *IMAGES, *FOLDERS, *TRANSFERS,
           *REPORTS, *looks.FORMATS)  # fmt: skip
ARCHIVES = (*FOLDERS, looks.FOLDER)
# meshio's format and options of each file of volume cells.
MESHIO: dict[str, tuple[str, dict[str, Any]]] = {
    "vtu": ("vtu", {}),
    "text.vtu": ("vtu", {"binary": False}),
    "vtk": ("vtk", {}),
    "text.vtk": ("vtk", {"binary": False}),
    "msh": ("gmsh", {}),
    "text.msh": ("gmsh", {"binary": False}),
    "old.msh": ("gmsh22", {"binary": False}),
    "mesh": ("medit", {}),
    "inp": ("abaqus", {}),
    "ucd.inp": ("avsucd", {}),
    "exo": ("exodus", {}),
}


def write_all(folder: Path, device: Any) -> None:
    """Write a file of every format, `a.FORMAT`, into the folder."""
    vertices, faces = meshes.icosphere(1)
    ball = voxtool.mesh_from_arrays(vertices * (1, 0.8, 0.6), faces)
    octree = voxtool.voxelize(ball, dim=16, device=device)
    for kind in OCTREES:
        content = voxtool.MergedOctree.of(octree) if kind.startswith("merged") else octree
        voxtool.write_svo(content, folder / f"a.{kind}")
    for kind in (kind for kind in IMAGES if kind not in PACKED):
        voxtool.export(octree, folder / f"a.{kind}")
    write_packed(folder, octree.to_dense().astype(np.uint8))
    for kind in FOLDERS:
        with tempfile.TemporaryDirectory() as inside:
            voxtool.export(octree, Path(inside) / f"a.{kind}")
            (folder / f"a.{kind}").write_bytes(archive_of(Path(inside) / f"a.{kind}"))
    field = voxtool.build_adf(ball, max_level=3, device=device)
    voxtool.write_adf(field, folder / "a.adf.h5")
    helpers_tets.write_vtu(folder / "volume.vtu")
    mesh = voxtool.read_unstructured(folder / "volume.vtu", "density")
    (folder / "volume.vtu").unlink()
    points, cells = helpers_tets.lattice((2, 2, 1))
    box = helpers_tets.unstructured(points, [("hexahedron", cells)], [np.arange(4.0)])
    for kind in VOLUMES:
        layout = kind.split(".")[0]
        volume = voxtool.build_tet(box if layout == "hexahedra" else mesh, layout)
        voxtool.write_tet(volume, folder / f"a.{kind}")
    transfer = voxtool.default_transfer(volume)
    (folder / "a.json").write_text(transfer.to_json())
    write_meshes(folder, ball)
    looks.write_looks(folder, ball, device, archive_of)
    (folder / "a.report.json").write_text(report(folder / "a.obj", device))
    write_cells(folder)
    write_points(folder, vertices)


def write_packed(folder: Path, values: np.ndarray) -> None:
    """Images as other programs write them: as text, and packed by other means."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    flat = values.ravel(order="F")
    image = vtkImageData()
    image.SetExtent(*(end for n in values.shape for end in (0, n)))
    image.GetCellData().SetScalars(numpy_to_vtk(flat, deep=True))
    for kind in PACKED[:3]:
        writer = vtkXMLImageDataWriter()
        writer.SetInputData(image)
        writer.SetFileName(str(folder / f"a.{kind}"))
        if kind.startswith("text"):
            writer.SetDataModeToAscii()
        (writer.SetCompressorTypeToLZMA if "lzma" in kind else writer.SetCompressorTypeToLZ4)()
        writer.Write()
    head = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {} {} {}\nencoding: {}\n\n"
    text = " ".join(map(str, flat.tolist())).encode()
    for kind, data in (("ascii", text), ("bzip2", bz2.compress(flat.tobytes()))):
        name = "text.image.nrrd" if kind == "ascii" else "bz2.image.nrrd"
        (folder / f"a.{name}").write_bytes(head.format(*values.shape, kind).encode() + data)
    with zipfile.ZipFile(folder / "a.lzma.image.npz", "w") as packed:
        array = io.BytesIO()
        np.save(array, values)
        packed.writestr(zipfile.ZipInfo("a.npy"), array.getvalue(), zipfile.ZIP_LZMA)


def archive_of(folder: Path) -> bytes:
    """The files of a folder in one archive."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            archive.writestr(zipfile.ZipInfo(str(path.relative_to(folder))), path.read_bytes())
    return packed.getvalue()


def put(path: Path, format: str, content: bytes) -> None:
    """Write the file of a case, or its folder as far as the archive can be unpacked."""
    if format not in ARCHIVES:
        path.write_bytes(content)
        return
    path.mkdir()
    with contextlib.suppress(Exception), zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(path)


def report(mesh: Path, device: Any) -> str:
    """A report of `voxtool bench`, in which all measured numbers are the same."""
    command = f"bench voxelize {mesh} --dims 8 --quick --repeat 1 --samples 99 --json --device"
    text = CliRunner().invoke(cli, [*command.split(), str(device.info.index)]).stdout
    text = re.sub(r"-?\d+\.\d+(e[-+]\d+)?", "1.5", re.sub(r"\d{4,}", "4096", text))
    text = text.replace('"index": 1', '"index": 0')
    return re.sub(r'("(?:command|model|name|platform|driver|opencl)": )".*"', r'\1"a"', text)


def write_meshes(folder: Path, ball: Any) -> None:
    import trimesh

    for kind in ("obj", "ply", "stl", "off", "glb"):
        write_mesh(ball, folder / f"a.{kind}")
    same = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    for kind, content in {
        "text.ply": same.export(file_type="ply", encoding="ascii"),
        "text.stl": same.export(file_type="stl_ascii"),
        "gltf": embedded(trimesh.Scene(same).export(file_type="gltf")),
    }.items():
        (folder / f"a.{kind}").write_bytes(
            content if isinstance(content, bytes) else content.encode()
        )
    write_3mf(folder / "a.3mf", ball)
    for kind in ("obj", "ply"):
        packed = gzip.compress((folder / f"a.{kind}").read_bytes(), mtime=0)
        (folder / f"a.{kind}.gz").write_bytes(packed)


def write_3mf(path: Path, ball: Any) -> None:
    """A 3MF of a mesh, and of a component that turns it."""
    vertices = "".join(
        f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in ball.vertices.tolist()
    )
    triangles = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in ball.faces.tolist()
    )
    model = (
        f'<model unit="inch" xmlns="{threemf.CORE}"><resources><object id="1"><mesh><vertices>'
        f"{vertices}</vertices><triangles>{triangles}</triangles></mesh></object>"
        '<object id="2"><components><component objectid="1" transform="0 1 0 -1 0 0 0 0 1 2 0 0"/>'
        '</components></object></resources><build><item objectid="1"/><item objectid="2"/></build>'
        "</model>"
    )
    relation = (
        f'<Relationships xmlns="{threemf.RELATION.split()[0]}"><Relationship Target="/3D/a.model" '
        f'Id="a" Type="{threemf.ROOT_MODEL}"/></Relationships>'
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, text in ((threemf.RELATIONS, relation), ("3D/a.model", model)):
            archive.writestr(zipfile.ZipInfo(part), text, zipfile.ZIP_DEFLATED)


def embedded(files: dict[str, bytes]) -> str:
    """A glTF with its buffers inside."""
    import base64

    tree = json.loads(files["model.gltf"])
    for buffer in tree["buffers"]:
        text = base64.b64encode(files[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{text}"
    return json.dumps(tree)


def write_cells(folder: Path) -> None:
    """Six tetrahedra with one scalar at points and, where the format has it, one at cells."""
    import meshio
    import netCDF4

    cube = helpers_tets.cube(6)
    cells = [("tetra", np.asarray(cube.cells[0][1]))]
    for kind, (format, options) in MESHIO.items():
        more: dict[str, Any] = {"point_data": {"s": helpers_tets.linear(cube.points)}}
        if format in ("medit", "abaqus"):  # have none: a reference, or nothing
            more = {"cell_data": {"medit:ref": [np.arange(6)]}} if format == "medit" else {}
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            path = folder / f"a.{kind}"
            meshio.write(path, meshio.Mesh(cube.points, cells, **more), format, **options)
        if format == "exodus":  # meshio writes the time
            with netCDF4.Dataset(path, "a") as file:
                file.title = "a" * len(file.title)
            helpers_tets.copy_netcdf(path, folder / "a.e", "NETCDF3_CLASSIC")
        if kind.endswith("msh"):  # meshio writes np.float64(1.5), which it cannot read
            path.write_bytes(re.sub(rb"np\.float64\(([^)]*)\)", rb"\1", path.read_bytes()))


def write_points(folder: Path, points: np.ndarray) -> None:
    np.save(folder / "a.npy", points)
    np.save(folder / "a.columns.npy", np.asfortranarray(points, np.float32))
    np.savez(folder / "a.npz", points=points)
    np.savez_compressed(folder / "a.packed.npz", points=points)
    rows = [" ".join(map(repr, row)) for row in points.tolist()]
    (folder / "a.xyz").write_text("# points\n" + "\n".join(rows) + "\n")
    (folder / "a.csv").write_text("x,y,z\n" + "\n".join(rows).replace(" ", ",") + "\n")
    head = "ply\nformat {} 1.0\nelement vertex 42\n" + "".join(
        f"property {{}} {axis}\n" for axis in "xyz"
    )
    binary = head.format("binary_little_endian", *["double"] * 3) + "end_header\n"
    (folder / "a.points.ply").write_bytes(binary.encode() + points.astype("<f8").tobytes())
    text = head.format("ascii", *["double"] * 3) + "end_header\n" + "\n".join(rows) + "\n"
    (folder / "a.text.points.ply").write_text(text)


def read_all(folder: Path) -> dict[str, bytes]:
    """The content of each file, by its format."""
    return {kind: (folder / f"a.{kind}").read_bytes() for kind in FORMATS}
