"""Readers and writers of voxels by other projects, for round trips through every format.

A reader returns the set cells as a dense array [x, y, z] of the grid's shape, and the map from
cells to the world as (translation, scale) of their centres, or None where the file keeps none.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from helpers import vtk as helpers_vtk
from helpers.openvdb import openvdb

from voxtool.grid import Grid

Place = tuple[np.ndarray, np.ndarray] | None
Read = tuple[np.ndarray, Place]
LPS = np.array([-1, -1, 1])  # the signs of SimpleITK's axes in NIfTI's world


def _of_cells(cells: np.ndarray, grid: Grid) -> np.ndarray:
    """The dense array of cells, without their repetition or loss."""
    found = np.zeros(grid.shape, bool)
    found[tuple(cells.T)] = True
    assert np.count_nonzero(found) == len(cells)
    return found


def read_npy(path: Path, grid: Grid) -> Read:
    return np.load(path), None


def read_npz(path: Path, grid: Grid) -> Read:
    with np.load(path) as file:
        place = file["origin"] + file["pitch"] / 2, file["pitch"]
        return _of_cells(file["voxels"], grid), place


def read_vti(path: Path, grid: Grid) -> Read:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    image: Any = reader.GetOutput()
    values = vtk_to_numpy(image.GetCellData().GetArray(0)).reshape(grid.shape, order="F")
    origin, spacing = np.array(image.GetOrigin()), np.array(image.GetSpacing())
    return values != 0, (origin + spacing / 2, spacing)


def read_itk(path: Path, grid: Grid) -> Read:
    import SimpleITK

    image = SimpleITK.ReadImage(str(path))
    ends = [
        np.array(image.TransformIndexToPhysicalPoint(cell)) * LPS for cell in ((0,) * 3, (1,) * 3)
    ]
    return SimpleITK.GetArrayFromImage(image).T != 0, (ends[0], ends[1] - ends[0])


def read_binvox(path: Path, grid: Grid) -> Read:
    import trimesh

    found: Any = trimesh.exchange.binvox.load_binvox(io.BytesIO(path.read_bytes()))
    return np.asarray(found.matrix), None  # its scale is of other ends


def read_vdb(path: Path, grid: Grid) -> Read:
    out = path.with_suffix(".npz")
    openvdb([("read", path, out, *grid.shape)])
    with np.load(out) as file:
        corners = np.array(json.loads(str(file["facts"]))["corners"])
        return file["values"] != 0, (corners[0], (corners[2] - corners[0]) / grid.shape)


def read_vox(path: Path, grid: Grid) -> Read:
    from midvoxio.voxio import vox_to_arr

    return vox_to_arr(str(path))[..., 3] > 0, None


def read_vtkhdf(path: Path, grid: Grid) -> Read:
    vtk: Any = helpers_vtk.vtk()
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    tree: Any = reader.GetOutputDataObject(0)
    lines = tree.GetXCoordinates(), tree.GetYCoordinates(), tree.GetZCoordinates()
    bounds = np.array([line.GetRange() for line in lines])
    change = vtk.vtkHyperTreeGridToUnstructuredGrid()
    change.SetInputConnection(reader.GetOutputPort())
    change.Update()
    cells: Any = change.GetOutput()
    found, pitch = np.zeros((grid.side,) * 3, bool), (bounds[:, 1] - bounds[:, 0]) / grid.side
    if cells.GetNumberOfCells():
        points = vtk.vtk_to_numpy(cells.GetPoints().GetData())
        corners = points[vtk.vtk_to_numpy(cells.GetCells().GetConnectivityArray()).reshape(-1, 8)]
        assert (vtk.vtk_to_numpy(cells.GetCellData().GetArray("coverage")) == 255).all()
        ends = [(end - bounds[:, 0]) / pitch for end in (corners.min(axis=1), corners.max(axis=1))]
        low, high = (np.rint(end).astype(int) for end in ends)
        for side in np.unique(high[:, 0] - low[:, 0]):  # points are of single precision
            held = low[high[:, 0] - low[:, 0] == side]
            for step in np.indices((side,) * 3).reshape(3, -1).T:
                found[tuple((held + step).T)] = True
    assert np.count_nonzero(found) == np.count_nonzero(found[tuple(map(slice, grid.shape))])
    return found[tuple(map(slice, grid.shape))], (bounds[:, 0] + pitch / 2, pitch)


def read_tif(path: Path, grid: Grid) -> Read:
    import tifffile

    return np.asarray(tifffile.imread(path)).reshape(grid.shape[::-1]).T != 0, None


def read_ome_zarr(path: Path, grid: Grid) -> Read:
    from ome_zarr.io import parse_url
    from ome_zarr.reader import Reader

    location: Any = parse_url(path)
    (node,) = list(Reader(location)())
    steps = node.metadata["coordinateTransformations"][0]
    scale, move = (np.array(step[step["type"]])[::-1] for step in steps)
    return np.asarray(node.data[0]).T != 0, (move, scale)


def read_points(path: Path, grid: Grid) -> Read:
    import trimesh

    if path.suffix == ".xyz":
        points = np.loadtxt(path)
    else:  # which has no vertices if it is empty
        points = np.asarray(getattr(trimesh.load(path), "vertices", ()))
    places = (points.reshape(-1, 3) - grid.origin) / grid.pitch - 0.5
    cells = np.rint(places).astype(int)
    assert np.abs(places - cells).max(initial=0) < 1e-9  # each is where it belongs
    return _of_cells(cells, grid), None


def read_layers(path: Path, grid: Grid) -> Read:
    from PIL import Image

    paths = sorted(path.parent.glob("*.png"))
    layers = [np.asarray(Image.open(each))[::-1] for each in paths]  # the top row is first
    return np.stack(layers).T, None


READERS: dict[str, Callable[[Path, Grid], Read]] = {
    "npy": read_npy, "npz": read_npz, "vti": read_vti, "nii": read_itk, "nii.gz": read_itk,
    "nrrd": read_itk, "binvox": read_binvox, "vdb": read_vdb, "vox": read_vox,
    "vtkhdf": read_vtkhdf, "tif": read_tif, "ome.zarr": read_ome_zarr, "ply": read_points,
    "xyz": read_points, "%04d.png": read_layers,
}  # fmt: skip


# ---- files that other projects write


def write_itk(path: Path, dense: np.ndarray, grid: Grid) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(dense.T.astype(np.uint8))
    image.SetSpacing(grid.pitch)
    image.SetOrigin(((np.array(grid.origin) + np.array(grid.pitch) / 2) * LPS).tolist())
    image.SetDirection(np.diag(LPS).astype(float).ravel().tolist())
    SimpleITK.WriteImage(image, str(path), useCompression=True)


def write_tif(path: Path, dense: np.ndarray, grid: Grid) -> None:
    import tifffile

    tifffile.imwrite(path, dense.T.astype(np.uint8), compression="zlib", photometric="minisblack")


# With whether the grid's place is kept.
WRITERS: dict[str, tuple[Callable[[Path, np.ndarray, Grid], None], bool]] = {
    "npy": (lambda path, dense, grid: np.save(path, dense), False),
    "npz": (lambda path, dense, grid: np.savez(path, dense), False),
    "nii": (write_itk, True), "nii.gz": (write_itk, True), "nrrd": (write_itk, True),
    "tif": (write_tif, False),
}  # fmt: skip
