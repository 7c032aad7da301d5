"""Exodus files are read as meshio reads them, in every kind of netCDF, and without its library."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import meshio
import netCDF4
import numpy as np
import pytest
from helpers.files import changed_h5, edited, refusal, run_python, stored
from helpers.tets import assembly, copy_netcdf, linear, split

from voxtool import read_unstructured
from voxtool.errors import FileError, MemoryLimitError, MeshWarning, VoxtoolError
from voxtool.files.cells import exodus

FORMATS = {
    "hdf5": "NETCDF4",
    "CDF-1": "NETCDF3_CLASSIC",
    "CDF-2": "NETCDF3_64BIT_OFFSET",
    "CDF-5": "NETCDF3_64BIT_DATA",
}


def write(
    path: Path, format: str = "hdf5", change: Callable[[Any], Any] = lambda file: None
) -> Path:
    """Write a tetrahedron, hexahedra, wedges, pyramids and triangles in blocks, with arrays at
    points, by meshio; then one at the cells of all blocks, as meshio cannot."""
    mesh = assembly((3, 2, 2), 2)
    p = np.concatenate([mesh.points, 9 + np.eye(4, 3)])
    corners = len(mesh.points) + np.array([[3, 0, 1, 2]])
    blocks = [("tetra", corners), *mesh.cells, ("triangle", np.array([[0, 1, 2], [1, 2, 3]]))]
    data = {"s": linear(p), "wX": p[:, 0], "wY": p[:, 1] ** 2, "wZ": -p[:, 2]}
    data |= {"u_R": p[:, 1], "u_Z": p[:, 2], "lone_X": p[:, 0], "v": p * 3}
    with warnings.catch_warnings(action="ignore"):
        meshio.write(path, meshio.Mesh(p, blocks, data), "exodus")
    with netCDF4.Dataset(path, "a") as file:
        file.createDimension("num_elem_var", 2)
        names = file.createVariable("name_elem_var", "S1", ("num_elem_var", "len_string"))
        names[:] = netCDF4.stringtochar(np.array(["c", "second"], "S33"))
        for variable in (1, 2):
            for block, (_, cells) in enumerate(blocks):
                name = f"vals_elem_var{variable}eb{block + 1}"
                sides = ("time_step", f"num_el_in_blk{block + 1}")
                file.createVariable(name, "f8", sides)[0] = variable * cells[:, 0]
        change(file)
    if format != "hdf5":
        copy = path.with_name("copy.nc")
        copy_netcdf(path, copy, FORMATS[format])
        copy.replace(path)
    return path


def found(path: Path) -> exodus.ExodusMesh:
    with path.open("rb") as file:
        return exodus.read(path.name, file, None)


@pytest.mark.parametrize("format", FORMATS)
def test_the_same_as_meshio(format: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.exo", format)
    assert h5py.is_hdf5(path) == (format == "hdf5")
    with warnings.catch_warnings(action="error"):
        ours = found(path)
    theirs: Any = meshio.read(path)
    assert np.array_equal(ours.points, theirs.points)
    assert len(ours.cells) == 5
    for one, two in zip(ours.cells, theirs.cells, strict=True):
        assert one.type == two.type
        assert one.data.dtype == np.int64
        assert np.array_equal(one.data, two.data)
    assert set(ours.point_data) == {"s", "w", "u", "lone_X", "v"}
    assert set(ours.point_data) == set(theirs.point_data)
    for name, values in theirs.point_data.items():
        assert np.array_equal(ours.point_data[name], values)
    assert set(ours.cell_data) == set(theirs.cell_data) == {"c", "second"}
    for name, parts in theirs.cell_data.items():
        for part, expected in zip(ours.cell_data[name], parts, strict=True):
            assert np.array_equal(part, expected)
    assert split(read_unstructured(path, "c")).report["ignored"] == {"triangle": 2}


def test_no_library_of_netcdf_and_no_meshio(tmp_path: Path) -> None:
    for format in ("hdf5", "CDF-1"):
        path = write(tmp_path / f"{format}.e", format)
        read = "voxtool.read_unstructured(sys.argv[1], 's')\n"
        done = run_python(read + "print({'netCDF4', 'meshio'} & {*sys.modules})", path)
        assert done.stdout == b"set()\n", done.stderr


def minimal(
    path: Path, kinds: dict[str, int], change: Callable[[Any], Any] = lambda f: None
) -> Path:
    """Write a block of one cell for each kind, with the number of nodes that `kinds` gives, and an
    array at points."""
    count = max(kinds.values())
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        for name, size in {"nodes": count, "one": 1, "letters": 9, "time": None}.items():
            file.createDimension(name, size)
        for number, axis in enumerate("xyz"):
            values = np.random.default_rng(number).random(count)
            file.createVariable(f"coord{axis}", "f8", ("nodes",))[:] = values
        for number, (kind, nodes) in enumerate(kinds.items()):
            file.createDimension(f"of{number + 1}", nodes)
            block = file.createVariable(f"connect{number + 1}", "i4", ("one", f"of{number + 1}"))
            block.elem_type = kind
            block[:] = np.arange(nodes)[None] + 1
        names = file.createVariable("name_nod_var", "S1", ("one", "letters"))
        names[:] = netCDF4.stringtochar(np.array(["s"], "S9"))
        file.createVariable("vals_nod_var1", "f8", ("time", "nodes"))[0] = np.arange(count)
        change(file)
    return path


def test_names_of_kinds(tmp_path: Path) -> None:
    """All that writers use: any case, with and without the number of nodes, aliases."""
    kinds = {
        "TETRA": 4, "tet4": 4, "TETRA4": 4, "Tet": 4, "TETRA10": 10, "tetra ": 8,
        "HEX": 8, "HEX8": 8, "hexahedron": 8, "HEX20": 20, "hex27": 27,
        "WEDGE": 6, "WEDGE6": 6, "wedge15": 15, "PYRAMID": 5, "PYRAMID5": 5, "pyramid13": 13,
        "SHELL4": 4, "QUAD9": 9, "TRI3": 3, "TRISHELL6": 6, "BEAM": 2, "TRUSS3": 3, "SPHERE": 1,
    }  # fmt: skip
    mesh = found(minimal(tmp_path / "a.exo", kinds))
    assert [block.type for block in mesh.cells] == [
        *["tetra"] * 4, "tetra10", "tetra8", *["hexahedron"] * 3, "hexahedron20", "hexahedron27",
        "wedge", "wedge", "wedge15", "pyramid", "pyramid", "pyramid13",
        "quad", "quad9", "triangle", "triangle6", "line", "line3", "vertex",
    ]  # fmt: skip
    theirs = dict(meshio.exodus._exodus.exodus_to_meshio_type)
    del theirs["TETRA4"]  # tetra4 is no type of meshio
    for name, block in zip(kinds, mesh.cells, strict=True):
        assert block.type == theirs.get(name, block.type)


def test_a_kind_that_is_unknown(tmp_path: Path) -> None:
    path = minimal(tmp_path / "a.exo", {"TETRA": 4, "Nfaced": 7})
    refusal(lambda p: split(read_unstructured(p)), path, "1 cell of kind nfaced, which cannot be")


def test_old_files_have_one_table_of_points_and_one_of_values(tmp_path: Path) -> None:
    def change(file: Any) -> None:
        file.renameVariable("coordx", "x")
        file.renameVariable("coordy", "y")
        file.renameVariable("coordz", "z")
        file.renameVariable("vals_nod_var1", "values")
        file.renameVariable("name_nod_var", "names")
        file.createDimension("two", 2)
        file.createVariable("coord", "f4", ("two", "nodes"))[:] = [[0, 1, 0, 0], [0, 0, 1, 0]]
        table = file.createVariable("vals_nod_var", "f8", ("time", "two", "nodes"))
        table[0] = np.arange(8).reshape(2, 4)
        names = file.createVariable("name_nod_var", "S1", ("two", "letters"))
        names[:] = netCDF4.stringtochar(np.array(["s", "t   "], "S9"))

    path = minimal(tmp_path / "a.exo", {"TETRA": 4}, change)
    assert found(path).point_data["s"].tolist() == [0, 1, 2, 3]
    mesh = read_unstructured(path, "t")
    assert np.array_equal(mesh.scalars, [4, 5, 6, 7])
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]]


@pytest.mark.parametrize("format", ["hdf5", "CDF-1"])
def test_of_several_time_steps_the_first_is_read(format: str, tmp_path: Path) -> None:
    def change(file: Any) -> None:
        file.variables["time_whole"][1] = 1.0
        for name in file.variables:
            if name.startswith("vals"):
                file.variables[name][1] = -700.0

    path = write(tmp_path / "a.exo", format, change)
    for name in ("s", "c"):
        with pytest.warns(MeshWarning, match=r"a\.exo: has 2 time steps, of which the first is"):
            mesh = read_unstructured(path, name)
        assert np.min(np.concatenate([np.ravel(part) for part in mesh.scalars])) >= -70


def test_arrays_that_a_block_lacks(tmp_path: Path) -> None:
    """The truth table of element variables: needed for volume cells only."""
    path = write(tmp_path / "a.exo")
    triangles = next(i for i, block in enumerate(found(path).cells) if block.type == "triangle")
    with h5py.File(path, "r+") as file:
        del file[f"vals_elem_var1eb{triangles + 1}"], file["vals_elem_var2eb1"]
    assert len(read_unstructured(path, "c").scalars[triangles]) == 2
    message = r"second has no values for block 1 of the cells \(1 tetra cell\): leave the block out"
    refusal(lambda path: read_unstructured(path, "second"), path, message)


def test_files_without_a_step_hold_no_arrays(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exo")
    with h5py.File(path, "r+") as file:
        for name in file:
            if name.startswith("vals"):
                shape = file[name].shape
                del file[name]
                file[name] = np.zeros((0, *shape[1:]))
    refusal(read_unstructured, path, "holds no arrays, only cells")


# ---- damaged and hostile files


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (stored("coord", lambda d: d.astype("S4")), r"coord has the type \|S4"),
        (stored("coord", lambda d: d[0]), r"coord has the shape \(43,\)"),
        (stored("connect1", lambda d: d.astype("f8")), "connect1 has the type float64"),
        (stored("connect1", lambda d: d), "attribute elem_type is missing"),
        (edited("connect1", (0, 0), 0), r"tetra 0 names point -1 where there are"),
        (edited("connect1", (0, 0), 2**63 - 1), r"tetra 0 names point 9223372036854775806"),
        (edited("connect1", (0, 0), -(2**63)), r"tetra 0 names point 9223372036854775807"),
        (lambda h5: h5.__delitem__("coord"), "has no coordinates"),
        (stored("vals_nod_var1", lambda d: d[:, :5]), r"s of shape \(5,\) for \d+ points"),
        (stored("name_nod_var", lambda d: np.array([b"s"])), "name_nod_var has the"),
    ],
)
def test_damaged_variables(change: Any, message: str, tmp_path: Path) -> None:
    path = changed_h5(write(tmp_path / "a.exo"), change)
    refusal(lambda path: split(read_unstructured(path, "s")), path, message)


def header(*parts: int | bytes) -> bytes:
    """A CDF-1 file of numbers and padded names."""
    pieces = [b"CDF\x01"]
    for part in parts:
        if isinstance(part, bytes):
            pieces += [struct.pack(">I", len(part)), part, bytes(-len(part) % 4)]
        else:
            pieces.append(struct.pack(">I", part))
    return b"".join(pieces)


MANY = 4 * 10**9
ONE_SIDE = (0, 10, 1, b"n", 1000, 0, 0)  # a dimension of 1,000, and no attributes


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"hello", "not readable as Exodus"),
        (b"CDF", "ends in its header"),
        (b"CDF\x03", "version 3 of netCDF is unknown"),
        (header(0, 10, 99999), "ends in its header"),
        (header(0, 10, MANY), "a list of 4000000000 items"),
        (header(0, 11, 1), "a list of 1 items with tag 11"),
        (header(0, 10, 1, b"n" * 300), "a name of 300 letters"),
        (header(0, 0, 0, 12, 1, b"a", 2, MANY), "ends in its header"),
        (header(0, 0, 0, 12, 1, b"a", 12, 1), "numbers of the unknown type 12"),
        (header(*ONE_SIDE, 11, 1, b"coordx", 99), "coordx has 99 dimensions"),
        (header(*ONE_SIDE, 11, 1, b"coordx", 1, 1), "coordx has a dimension that the file lacks"),
        (
            header(*ONE_SIDE, 11, 1, b"coordx", 1, 0, 0, 0, 6, 8000, 0),
            "declares 8 kB that the file cannot hold",
        ),
        (
            header(*ONE_SIDE, 11, 1, b"coordx", 1, 0, 0, 0, 6, 8000, 100) + bytes(8000),
            "coordx needs 8000 bytes that the file does not have",
        ),
        (
            header(0, 10, 2, b"t", 0, b"n", MANY, 0, 0, 11, 1, b"coord", 2, 0, 1, 0, 0, 6, 0, 0),
            "has no coordinates|declares|not readable",
        ),
    ],
)
def test_damaged_headers(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.exo").write_bytes(data)
    refusal(read_unstructured, tmp_path / "a.exo", message)


@pytest.mark.parametrize("format", FORMATS)
def test_damaged_files_are_one_line(format: str, tmp_path: Path) -> None:
    """Truncated anywhere, or bytes changed: read, or refused."""
    path = write(tmp_path / "a.exo", format)
    data, rng, messages = path.read_bytes(), np.random.default_rng(0), []
    for step in range(200):
        mutant = bytearray(data)
        if step % 2:
            del mutant[int(rng.integers(len(data))) :]
        else:
            for place in rng.integers(min(len(data), 3000), size=3):
                mutant[place] = int(rng.integers(256))
        path.write_bytes(mutant)
        try:
            with warnings.catch_warnings(action="error"):
                split(read_unstructured(path, "s"))
        except (VoxtoolError, MeshWarning) as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all("a.exo" in message and "\n" not in message for message in messages)


def test_variables_that_share_their_data(tmp_path: Path) -> None:
    """A thousand arrays at one place of a file: together they need more than it has."""
    sides = (0, 10, 2, b"t", 1, b"n", 1000, 0, 0)
    variables = [(b"vals_nod_var%d" % (i + 1), 2, 0, 1, 0, 0, 6, 8000, 8) for i in range(1000)]
    data = header(*sides, 11, len(variables), *[part for row in variables for part in row])
    (tmp_path / "a.exo").write_bytes(data)
    refusal(read_unstructured, tmp_path / "a.exo", "declares 8 MB that the file cannot hold")


def test_memory_is_limited(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exo")
    with pytest.raises(MemoryLimitError, match=r"a\.exo: its arrays need .* and 1 kB are allowed"):
        read_unstructured(path, "s", max_memory=1000)
    with pytest.raises(FileError, match="which array"):
        read_unstructured(path)
