"""Export and import on the command line: fields, what is no format here, and units of meshes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, told, write_obj

import voxtool
from voxtool.files.grids.vdb_read import read as read_vdb


def test_band_and_spacing_of_a_level_set(here: Path) -> None:
    """The values in the file end at the band, and are as far apart as --spacing says."""
    spacing = voxtool.read_adf("bunny.adf.h5").side / 24
    run(f"export bunny.adf.h5 -o a.vdb --band 2 --spacing {spacing!r}")
    voxtool.export("bunny.adf.h5", "b.vdb", band=2, spacing=spacing)
    assert Path("a.vdb").read_bytes() == Path("b.vdb").read_bytes()
    with open("a.vdb", "rb") as file:
        stored = read_vdb(file, Path("a.vdb").stat().st_size)
        assert stored.frame.grid.pitch == (spacing,) * 3
        values = np.concatenate([np.ravel(getattr(p, "values", 0)) for p in stored.pieces])
    assert 1.9 * spacing < np.abs(values).max() <= np.float32(2 * spacing)
    message = fail("export bunny.svo.h5 -o a.vdb --band 2")
    assert "go with a distance field: this is none" in message


@pytest.mark.parametrize("name", ["bunny.svo.h5", "bunny.adf.h5"])
def test_a_device_is_used_by_fields_alone(name: str, here: Path) -> None:
    command = f"export {name} -o a.npy --device nowhere"
    if "adf" in name:
        assert "no OpenCL device matches 'nowhere'" in fail(command)
    else:
        run(command)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("export bunny.svo.h5 -o a.stl", "voxtool extract FILE -o a.stl writes it"),
        ("export bunny.svo.h5 -o a.glb", "voxtool extract FILE -o a.glb writes it"),
        ("export bunny.svo.h5 -o a.vti --normals", ".vti holds no normals: choose .ply, .xyz"),
        ("svo-info a.vtkhdf", "holds data of VTK: voxtool import makes an octree of its voxels"),
        ("import a.png", "a.png: its name says no format that is read: give --from, one of npy,"),
        ("export bunny.svo.h5 -o a.vox --dtype uint8", ".vox holds bool, not uint8: leave out --d"),
        ("export bunny.svo.h5 -o a.ome.zarr --dtype uint8", "holds float32 or float64, not uint8"),
        ("import bunny.obj", "bunny.obj is a mesh: voxelize it: voxtool voxelize bunny.obj"),
        ("import bunny.svo.h5", "bunny.svo.h5 is a file of voxtool, which needs no import"),
        ("import -", "stdin has no name: give --from, one of npy, npz,"),
        (
            "extract bunny.svo.h5 --scale 2",
            "those of the meshes of --against and --source: name one",
        ),
    ],
)
def test_the_missing_step_is_named(command: str, message: str, here: Path) -> None:
    if "vtkhdf" in command:
        run("export bunny.svo.h5 -o a.vtkhdf")
    assert message in fail(command, code=2 if "--scale" in command else None)


def test_units_and_scale_of_meshes_that_are_read(here: Path) -> None:
    lengths = "--units mm --scale 1000"
    mesh = voxtool.load_mesh("bunny.obj", units="mm", scale=1000)
    report = told(f"diagnose bunny.obj --dim 16 {lengths} --json")
    assert report["units"] == "mm"
    assert report == voxtool.diagnose(mesh, dim=16).as_dict() | {"mesh": "bunny.obj"}
    facts = told(f"distance bunny.obj points.csv {lengths} -o d.npy --json")
    assert facts["units"] == "mm"
    points = [[0, 1, 0], [0.5, 2, 0.25]]
    assert np.load("d.npy").tolist() == voxtool.distance(mesh, points).tolist()
    run(f"voxelize bunny.obj --dim 32 {lengths} -o mm.svo.h5")
    result = run(f"extract mm.svo.h5 --style surface-nets --against bunny.obj {lengths}")
    found = json.loads(result.stdout)["against"]
    assert found["voxels"]["hausdorff"] < 2  # 15 without the scale


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ("--label 7", "no value is 7"),
        ("--threshold 2", "no value is 2 or more"),
        ("", "no value is neither 0 nor NaN"),
    ],
)
def test_an_import_without_a_voxel_warns(rule: str, said: str, here: Path) -> None:
    np.save("a.npy", np.full((8, 8, 8), 1 if rule else 0))
    result = run(f"import a.npy {rule} -o a.svo.h5")
    assert f"voxtool: warning: a.npy sets no voxel: {said}\n" in result.stderr


def test_an_import_of_every_voxel_says_so(here: Path) -> None:
    """An image of distances has no value of 0, so every voxel would be set."""
    np.save("a.npy", np.linspace(-2, 2, 512).reshape(8, 8, 8))
    text = run("import a.npy -o a.svo.h5").stderr
    assert "a.npy sets every voxel, since every value is neither 0 nor NaN: --threshold and" in text
    assert "every" not in run("import a.npy --threshold 0 -o a.svo.h5").stderr


@pytest.mark.parametrize("name", ["nrrd", "nii.gz"])
@pytest.mark.parametrize("direction", [(1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 0, -1, 1, 0, 0, 0, 1, 0)])
def test_a_mask_lies_on_its_image(name: str, direction: tuple[int, ...], here: Path) -> None:
    """On a grid of ITK's (LPS) that is no cube: a voxel of the image is set where its centre is in
    the box, by its physical point, and the centres of both images are the same points."""
    itk = pytest.importorskip("SimpleITK")
    scan = itk.Image(20, 13, 9, itk.sitkInt16)
    scan.SetSpacing((0.75, 0.5, 1.25))
    scan.SetOrigin((-3.0, 4.0, 10.0))
    scan.SetDirection(direction)
    itk.WriteImage(scan, f"scan.{name}")
    cells = np.indices(scan.GetSize()).reshape(3, -1).T
    points = np.array([scan.TransformIndexToPhysicalPoint(cell.tolist()) for cell in cells])
    world = points * (-1, -1, 1)  # in voxtool's RAS
    size = np.ptp(world, axis=0)
    low = world.min(axis=0) + 0.21 * size
    high = world.max(axis=0) - 0.33 * size
    write_obj(here / "box.obj", *meshes.box(low, high))
    run(f"voxelize box.obj --like scan.{name} -o mask.{name}")
    mask = itk.ReadImage(f"mask.{name}")
    found = [mask.TransformPhysicalPointToContinuousIndex(point.tolist()) for point in points]
    places = np.rint(found).astype(int)
    assert np.abs(found - places).max() < 1e-4  # the numbers of .nii are float32
    values = itk.GetArrayFromImage(mask).transpose(2, 1, 0)
    assert values.size == len(cells)
    expected = ((world > low) & (world < high)).all(axis=1)
    assert 0 < expected.sum() < len(cells)
    assert np.array_equal(values[tuple(places.T)] != 0, expected)
