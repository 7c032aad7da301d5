"""Attributes of voxels in exports: readers of other projects find the same values everywhere."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import vtk as helpers_vtk
from helpers.attributes import attributed, sizes
from helpers.openvdb import openvdb

import voxtool
from voxtool.choices import FACE_NAMES
from voxtool.errors import VoxtoolError
from voxtool.files.formats import EXCHANGE
from voxtool.grid import Grid
from voxtool.mesh.srgb import to_linear
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.attributes import KINDS, Attribute
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree

NAMES = ["", "head", "größe", "a b"]
LEVELS = (0, 1, 2, 3)


def octree_at_a_place() -> Octree:
    octree = attributed()
    return replace(octree, grid=Grid(octree.grid.shape, (-1.5, 0.1, 1e-3), (0.1, 0.2, 0.1)))


def image_of(octree: Octree, name: str, **options: Any) -> AttributeImage:
    return AttributeImage(VoxelImage.of(octree, **options), name)


def dense_of(octree: Octree, name: str, **options: Any) -> np.ndarray:
    return np.concatenate(list(image_of(octree, name, **options).slabs()))


def exported(octree: Octree, path: Path, **options: Any) -> Path:
    """The path of an export, whose bytes depend on the content alone, within the predicted size."""
    job = voxtool.plan_export(octree, path, **options)
    assert job.run() <= job.plan.size
    if path.is_file():
        first = path.read_bytes()
        voxtool.export(octree, path, **options)
        assert path.read_bytes() == first
    return path


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", KINDS)
def test_npy(name: str, level: int, tmp_path: Path) -> None:
    octree = octree_at_a_place()
    path = exported(octree, tmp_path / "a.npy", attributes=name, level=level)
    assert np.array_equal(np.load(path), dense_of(octree, name, level=level))


@pytest.mark.parametrize("level", LEVELS)
def test_npz(level: int, tmp_path: Path) -> None:
    octree = octree_at_a_place()
    with np.load(exported(octree, tmp_path / "a.npz", level=level)) as found:
        places = tuple(found["voxels"].T)
        for name in KINDS:
            assert np.array_equal(found[name], dense_of(octree, name, level=level)[places])
        assert found["label_names"].tolist() == NAMES
    if level < 2:  # a grid has 8 cells or more
        assert voxtool.read_voxels(tmp_path / "a.npz").count == len(places[0])


def vtk_arrays(data: Any) -> dict[str, Any]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    arrays = (data.GetCellData().GetArray(i) for i in range(data.GetCellData().GetNumberOfArrays()))
    return {array.GetName(): vtk_to_numpy(array) for array in arrays}


def vtk_names(data: Any) -> list[str]:
    array = data.GetFieldData().GetAbstractArray("label_names")
    return [array.GetValue(i) for i in range(array.GetNumberOfValues())]


@pytest.mark.parametrize("options", [{}, {"level": 1}, {"bbox": (-1, 0.5, 0.2, 1, 4, 1)}], ids=str)
def test_vti(options: dict[str, Any], tmp_path: Path) -> None:
    vtk: Any = helpers_vtk.vtk()
    octree = octree_at_a_place()
    reader = vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(exported(octree, tmp_path / "a.vti", **options)))
    reader.Update()
    data = reader.GetOutput()
    found = vtk_arrays(data)
    assert set(found) == {*KINDS, "coverage" if options.get("level") else "occupancy"}
    for name in KINDS:
        wanted = dense_of(octree, name, **options)
        wanted = wanted.transpose(2, 1, 0, *range(3, wanted.ndim))
        assert np.array_equal(found[name], wanted.reshape(-1, *wanted.shape[3:]))
    assert vtk_names(data) == NAMES


def in_grids(name: str, values: np.ndarray) -> np.ndarray:
    """Values of an attribute as grids of floats hold them."""
    return (to_linear(values[..., :3]) if name == "colour" else values).astype(np.float32)


@pytest.mark.parametrize("options", [{}, {"level": 1}, {"bbox": (-1, 0.5, 0.2, 1, 4, 1)}], ids=str)
def test_vdb(options: dict[str, Any], tmp_path: Path) -> None:
    """OpenVDB reads a grid for each attribute, whose active cells are those of the voxels."""
    octree = octree_at_a_place()
    path = exported(octree, tmp_path / "a.vdb", **options)
    image = VoxelImage.of(octree, **options)
    shape = np.add(image.low, image.shape)
    part = tuple(slice(n, None) for n in image.low)
    kinds = EXCHANGE["vdb"].kinds
    openvdb([("read", path, tmp_path / f"{n}.npz", *shape, n) for n in ("voxels", *kinds)])
    whole = np.load(tmp_path / "voxels.npz")
    facts = json.loads(str(whole["facts"]))
    for name in kinds:
        read = np.load(tmp_path / f"{name}.npz")
        own = json.loads(str(read["facts"]))
        wanted = in_grids(name, dense_of(octree, name, **options))
        assert np.array_equal(read["values"][part], wanted), name
        assert own["type"] == ("Vec3SGrid" if wanted.ndim == 4 else "FloatGrid")
        assert {k: own[k] for k in ("active", "box", "corners")} == {
            k: facts[k] for k in ("active", "box", "corners")
        }
        assert own["leaves"] == own["pruned"]
    names = json.loads(str(np.load(tmp_path / "label.npz")["facts"]))["metadata"]
    assert json.loads(names["voxtool_label_names"]) == NAMES
    if not options:
        assert voxtool.read_voxels(path).set_digest() == octree.set_digest()
        found = voxtool.read_voxels(path, grid="label", label=2)
        cells = np.argwhere(dense_of(octree, "label") == 2)
        assert np.array_equal(
            (found.occupied() + 0.5) * found.grid.pitch + found.grid.origin,
            (cells + 0.5) * octree.grid.pitch + octree.grid.origin,
        )


@pytest.mark.parametrize("side", [8, 128, 4096])
def test_tiles_of_attributes(side: int, tmp_path: Path) -> None:
    """Cubes of one label are tiles of every level of the tree, each with its own value."""
    collector = Collector(Grid((side, side, 2 * side), (0.5, 1, 2), (0.5, 0.5, 0.5)))
    collector.add_cubes(np.array([[0, 0, 0], [0, 0, side]]), side)
    octree = collector.octree()
    leaves = [level.cells[level.inside] for level in octree.levels() if level.number]
    values = (np.concatenate(leaves)[:, 2] >= side).astype(np.uint8)
    none = np.full(64 * len(octree.bricks), 0, np.uint8)[: int(sizes(octree)[0])]
    octree = replace(octree, attributes=(Attribute("label", none, values, names=("a", "b")),))
    path = exported(octree, tmp_path / "a.vdb")
    assert path.stat().st_size < 60_000
    corner = (2, 2, side + 3)
    openvdb([("read", path, tmp_path / "a.npz", *corner, "label")])
    read = np.load(tmp_path / "a.npz")
    facts = json.loads(str(read["facts"]))
    assert (facts["active"], facts["leaves"]) == (2 * side**3, 0)
    assert (read["values"] == np.where(np.arange(corner[2]) < side, 1, 2)).all()
    pytest.importorskip("warp")
    from helpers.warp import grids_of, values_at

    grids = grids_of(exported(octree, tmp_path / "a.nvdb"))
    cells = np.array([[0, 0, 0], [side - 1, side - 1, side - 1], [0, 1, side], [0, 0, 2 * side]])
    assert values_at(grids["label"], cells).tolist() == [1, 1, 2, 0]
    assert values_at(grids["voxels"], cells).tolist() == [1, 1, 1, 0]


@pytest.mark.parametrize("level", [0, 1])
def test_nvdb(level: int, tmp_path: Path) -> None:
    """Warp reads the grids of labels, areas and fractions after that of the voxels."""
    pytest.importorskip("warp")
    from helpers.warp import grids_of, values_at

    octree = octree_at_a_place()
    job = voxtool.plan_export(octree, tmp_path / "a.nvdb", level=level)
    assert job.plan.left_out == {
        "attributes colour, normal, faces": ".nvdb holds label, area, fraction"
    }
    grids = grids_of(exported(octree, tmp_path / "a.nvdb", level=level))
    assert list(grids) == ["voxels", "label", "area", "fraction"]
    for name in ("label", "area", "fraction"):
        wanted = np.pad(in_grids(name, dense_of(octree, name, level=level)), 1)
        cells = np.argwhere(np.ones_like(wanted)) - 1
        assert np.array_equal(values_at(grids[name], cells).reshape(wanted.shape), wanted)


@pytest.mark.parametrize("level", LEVELS)
def test_vtkhdf(level: int, tmp_path: Path) -> None:
    vtk: Any = helpers_vtk.vtk()
    octree = octree_at_a_place()
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(exported(octree, tmp_path / "a.vtkhdf", level=level)))
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    arrays = vtk_arrays(grid)
    images = {name: image_of(octree, name, level=level) for name in KINDS}
    wanted = {name: np.concatenate(list(image.slabs())) for name, image in images.items()}
    found = {name: np.zeros_like(values) for name, values in wanted.items()}
    cursor = vtk.vtkHyperTreeGridNonOrientedGeometryCursor()
    image = images["label"]

    def walk() -> None:
        if cursor.IsMasked():
            return
        if cursor.IsLeaf():
            box, cell = [0.0] * 6, cursor.GetGlobalNodeIndex()
            cursor.GetBounds(box)
            ends = (np.reshape(box, (3, 2)).T - image.origin) / image.pitch
            low, high = np.rint(ends).astype(int)
            for name in KINDS:
                found[name][tuple(map(slice, low, high))] = arrays[name][cell]
            return
        for child in range(8):
            cursor.ToChild(child)
            walk()
            cursor.ToParent()

    grid.InitializeNonOrientedGeometryCursor(cursor, 0)
    walk()
    for name in KINDS:
        assert np.array_equal(found[name], wanted[name])
    assert vtk_names(grid) == NAMES
    if level < 3:  # a grid has 8 cells or more
        occupied = voxtool.read_voxels(tmp_path / "a.vtkhdf").to_dense()
        assert np.array_equal(occupied, wanted["label"] != 0)


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
@pytest.mark.parametrize("name", KINDS)
def test_nii(name: str, ending: str, tmp_path: Path) -> None:
    nibabel: Any = pytest.importorskip("nibabel")
    octree = octree_at_a_place()
    wanted = dense_of(octree, name)
    path = exported(octree, tmp_path / f"a.{ending}", attributes=name)
    image = nibabel.load(path)
    found = np.asanyarray(image.dataobj)
    if name == "colour":
        found = np.stack([found[channel] for channel in "RGBA"], axis=-1)
    if name in ("normal", "faces"):
        assert image.header.get_intent()[0] == "vector"
        found = found[:, :, :, 0]
    assert np.array_equal(found, wanted)
    assert np.allclose(image.affine[:3, 3], [-1.45, 0.2, 0.051])
    if name == "label":
        assert image.header.get_intent()[0] == "label"
        text = image.header.extensions[1].get_content()
        text = text if isinstance(text, str) else text.decode()
        said = json.loads(text.removeprefix("voxtool labels ").rstrip("\0"))
        assert said == {str(number): label for number, label in enumerate(NAMES) if number}
        assert np.array_equal(voxtool.read_voxels(path).to_dense(), octree.to_dense())


@pytest.mark.parametrize("name", KINDS)
def test_nrrd(name: str, tmp_path: Path) -> None:
    nrrd: Any = pytest.importorskip("nrrd")
    octree = octree_at_a_place()
    wanted = dense_of(octree, name)
    found, header = nrrd.read(str(exported(octree, tmp_path / "a.nrrd", attributes=name)))
    found = np.moveaxis(found, 0, -1) if wanted.ndim == 4 else found
    assert np.array_equal(found, wanted)
    if name == "label":
        assert json.loads(header["voxtool labels"])["2"] == "größe"
    else:
        assert "voxtool labels" not in header
    assert np.allclose(header["space directions"][-3:], np.diag([0.1, 0.2, 0.1]))


@pytest.mark.parametrize("axis", ["z", "x"])
@pytest.mark.parametrize("name", KINDS)
def test_tif(name: str, axis: str, tmp_path: Path) -> None:
    tifffile: Any = pytest.importorskip("tifffile")
    octree = octree_at_a_place()
    order = {"z": (2, 1, 0), "x": (0, 2, 1)}[axis]
    wanted = dense_of(octree, name)
    wanted = wanted.transpose(*order, *range(3, wanted.ndim))
    path = exported(octree, tmp_path / "a.tif", attributes=name, axis=axis)
    with tifffile.TiffFile(path) as tif:
        assert np.array_equal(tif.asarray(), wanted)
        assert tif.series[0].axes == ("ZYXS" if wanted.ndim == 4 else "ZYX")
        said = tifffile.xml2dict(tif.ome_metadata)["OME"]
        assert int(said["Image"]["Pixels"]["SizeC"]) == (wanted.shape[3:] or (1,))[0]
        if name == "label":
            rows = said["StructuredAnnotations"]["MapAnnotation"]["Value"]["M"]
            assert [(row["K"], row["value"]) for row in rows] == [
                (1, "head"), (2, "größe"), (3, "a b"),
            ]  # fmt: skip


def test_ome_zarr(tmp_path: Path) -> None:
    zarr: Any = pytest.importorskip("zarr")
    octree = voxtool.Octree.from_dense(np.ones((150, 70, 80), bool), pitch=0.5)
    voxels = int(np.bitwise_count(octree.bricks).sum())
    leaves = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
    rng = np.random.default_rng(1)
    more = [
        replace(
            attribute,
            values=rng.permutation(np.resize(attribute.values, (voxels, *attribute.blank.shape))),
            leaves=rng.permutation(np.resize(attribute.values, (leaves, *attribute.blank.shape))),
            masks=None,
        )
        for attribute in attributed().attributes
    ]
    octree = replace(octree, attributes=tuple(more))
    for options in ({}, {"bbox": (9, 3, 2, 70, 30, 33)}):
        path = exported(octree, tmp_path / "a.ome.zarr", **options)
        group = zarr.open_group(str(path), mode="r")
        scales = group["labels/label"].attrs["multiscales"][0]
        assert len(scales["datasets"]) == (2 if options else 3)
        for number, dataset in enumerate(scales["datasets"]):
            occupied = group[str(number)][:].T != 0
            for name in KINDS:
                where = "labels/label" if name == "label" else name
                found = group[where][dataset["path"]][:].T
                whole = dense_of(octree, name, level=number)
                low = [int(v / 0.5) >> number for v in options.get("bbox", (0, 0, 0))[:3]]
                box = tuple(slice(a, a + n) for a, n in zip(low, occupied.shape, strict=True))
                assert np.array_equal(found, whole[box])
        said = group["labels/label"].attrs["image-label"]
        assert [one["name"] for one in said["properties"]] == NAMES[1:]
        assert group["labels"].attrs["labels"] == ["label"]
        axes = [axis["name"] for axis in group["colour"].attrs["multiscales"][0]["axes"]]
        assert axes == ["c", "z", "y", "x"]


def test_napari_s_reader_finds_the_labels(tmp_path: Path) -> None:
    reader: Any = pytest.importorskip("ome_zarr.reader")
    from ome_zarr.io import parse_url

    path = exported(octree_at_a_place(), tmp_path / "a.ome.zarr")
    nodes = list(reader.Reader(parse_url(str(path)))())
    labels = nodes[-1]
    assert np.array_equal(np.asarray(labels.data[0]).T, dense_of(octree_at_a_place(), "label"))
    assert labels.metadata["properties"][2]["name"] == "größe"


def test_points(tmp_path: Path) -> None:
    octree = octree_at_a_place()
    trimesh: Any = pytest.importorskip("trimesh")
    exported(octree, tmp_path / "a.ply")
    data = trimesh.load(tmp_path / "a.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    places = tuple(np.argwhere(octree.to_dense()).T)
    columns = {"label": ["label"], "colour": ["red", "green", "blue", "alpha"],
               "normal": ["nx", "ny", "nz"], "area": ["area"], "fraction": ["fraction"],
               "faces": list(FACE_NAMES)}  # fmt: skip
    found = {
        name: np.stack([data[column] for column in own], axis=1) for name, own in columns.items()
    }
    for name in KINDS:
        wanted = dense_of(octree, name)[places].reshape(len(places[0]), -1)
        assert np.array_equal(found[name], wanted)
    assert b"comment label 2 gr\xc3\xb6\xc3\x9fe\n" in (tmp_path / "a.ply").read_bytes()
    exported(octree, tmp_path / "a.xyz")
    rows = np.loadtxt(tmp_path / "a.xyz")
    wanted = [found[one.name] for one in octree.attributes]
    assert np.array_equal(rows[:, 3:].astype(np.float32), np.concatenate(wanted, axis=1))


def test_one_array_is_the_label_unless_another_is_asked_for(tmp_path: Path) -> None:
    octree = octree_at_a_place()
    for name in [name for name, each in EXCHANGE.items() if each.attributes == "one"]:
        plan = voxtool.plan_export(octree, tmp_path / f"a.{name}").plan
        assert plan.about["attributes"] == ["label"]
        assert list(plan.left_out) == ["attributes colour, normal, area, fraction, faces"]
    plan = voxtool.plan_export(octree, tmp_path / "a.npy", attributes="none").plan
    assert "attributes" not in plan.about
    assert plan.image.dtype == bool
    less = replace(octree, attributes=octree.attributes[1:2])
    assert voxtool.plan_export(less, tmp_path / "a.npy").plan.image.dtype == bool


@pytest.mark.parametrize("name", ["a.ply", "a.xyz", "a.npz", "a.vdb", "a.nvdb"])
def test_layers_without_voxels(name: str, tmp_path: Path) -> None:
    """Four layers are listed at once, of which some hold nothing."""
    octree = octree_at_a_place()
    empty = replace(octree, grid=Grid((64, 33, 20), octree.grid.origin, octree.grid.pitch))
    exported(empty, tmp_path / name)


def test_a_format_that_holds_none_says_so(tmp_path: Path) -> None:
    octree = octree_at_a_place()
    plan = voxtool.plan_export(octree, tmp_path / "%04d.png").plan
    assert plan.left_out == {
        "attributes label, colour, normal, area, fraction, faces": "%04d.png holds none"
    }
    plan = voxtool.plan_export(octree, tmp_path / "a.vdb").plan
    assert plan.left_out == {
        "attributes faces": ".vdb holds label, area, fraction, colour, normal",
        "opacity of colours": ".vdb holds red, green and blue",
    }
    for name in ("vtu", "msh", "inp"):
        plan = voxtool.plan_export(octree, tmp_path / f"a.{name}").plan
        why = f".{name} holds labels, as materials"
        assert plan.left_out == {"attributes colour, normal, area, fraction, faces": why}
    plan = voxtool.plan_export(octree, tmp_path / "a.vti", invert=True).plan
    assert "--invert asks for other values" in next(iter(plan.left_out.values()))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.binvox", {"attributes": "label"}, r"\.binvox holds no attributes of voxels: choose"),
        ("a.nvdb", {"attributes": "normal"}, r"\.nvdb holds label, area, fraction, and not normal"),
        ("a.nii", {"attributes": "label,colour"}, r"holds one attribute: name one, or"),
        ("a.vti", {"attributes": "taste"}, "attribute 'taste' is unknown: choose one of label"),
        ("a.vti", {"attributes": "label,label"}, "name each once"),
        ("a.vti", {"attributes": "label", "invert": True}, "--invert asks for other values"),
        ("a.npy", {"attributes": "label", "dtype": "uint8"}, "--dtype asks for other values"),
        ("a.vtkhdf", {"attributes": "label", "bbox": (0, 0, 0, 1, 1, 1)}, "--bbox asks for other"),
        ("a.ply", {"normals": True}, "choose one of them"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_refused(
    name: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(VoxtoolError, match=message):
        voxtool.export(octree_at_a_place(), tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_an_octree_without_attributes_names_what_is_missing(tmp_path: Path) -> None:
    octree = replace(octree_at_a_place(), attributes=())
    with pytest.raises(VoxtoolError, match="has no attribute 'label', it has none"):
        voxtool.export(octree, tmp_path / "a.vti", attributes="label")
    voxtool.write_svo(octree, tmp_path / "a.svo.h5")
    with pytest.raises(VoxtoolError, match="this has no attribute 'label': voxelize with it"):
        voxtool.export(tmp_path / "a.svo.h5", tmp_path / "a.vti", attributes="label")
