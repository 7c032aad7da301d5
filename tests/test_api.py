"""The public API: names, types at run time, what a mesh may be, and pictures in notebooks."""

from __future__ import annotations

import inspect
import subprocess
import sys
import typing

import numpy as np
import pytest
import trimesh
from helpers import meshes
from helpers.cli import ENVIRONMENT, write_obj

import voxtool

FUNCTIONS = [name for name in voxtool.__all__ if inspect.isfunction(getattr(voxtool, name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_have_types_and_documentation(name: str) -> None:
    function = getattr(voxtool, name)
    hints = typing.get_type_hints(function)
    assert "return" in hints
    assert set(inspect.signature(function).parameters) <= set(hints)
    assert (function.__doc__ or "")[:1].isupper()


def test_importing_is_cheap() -> None:
    code = (
        "import sys, voxtool\n"
        "assert 'numpy' not in sys.modules\n"
        "voxtool.voxelize\n"
        "assert not {'pyopencl', 'h5py', 'trimesh', 'lxml', 'PIL'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True, capture_output=True)


def test_no_such_name() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'nope'"):
        _ = voxtool.nope  # pyright: ignore[reportAttributeAccessIssue]
    assert dir(voxtool) == sorted(voxtool.__all__)


@pytest.fixture
def ball():
    return meshes.icosphere(1, 2.0, 2.0)


def test_what_a_mesh_may_be(ball, tmp_path) -> None:
    vertices, faces = ball
    path = tmp_path / "ball.obj"
    write_obj(path, vertices, faces)
    octree = voxtool.voxelize((vertices, faces), dim=16)
    same = trimesh.Trimesh(vertices, faces, process=False)
    for mesh in (path, str(path), same, voxtool.mesh_from_arrays(vertices, faces)):
        assert voxtool.voxelize(mesh, dim=16).digest() == octree.digest()
        assert voxtool.plan_voxelize(mesh, dim=16).run().digest() == octree.digest()
    point = [1.0, 1.0, 1.0]
    assert voxtool.distance(path, point) == voxtool.SignedDistance(same)(point)
    with pytest.raises(voxtool.MeshError, match="int is no mesh"):
        voxtool.voxelize(3, dim=16)


def test_paths_of_octrees_and_fields(ball, tmp_path) -> None:
    octree, field = voxtool.voxelize(ball, dim=16), voxtool.build_adf(ball, max_level=3)
    voxtool.write_svo(octree, tmp_path / "ball.svo.h5")
    voxtool.write_adf(field, tmp_path / "ball.adf.h5")
    assert voxtool.extract(tmp_path / "ball.svo.h5").digest() == voxtool.extract(octree).digest()
    far = voxtool.query_adf(tmp_path / "ball.adf.h5", [[1, 1, 1]]).distance
    assert far[0] == voxtool.query_adf(field, [1, 1, 1]).distance
    drawn = voxtool.render(tmp_path / "ball.svo.h5", size=(16, 16))
    assert np.array_equal(drawn, voxtool.render(octree, size=(16, 16)))


def test_a_grid_has_its_own_size(ball) -> None:
    grid = voxtool.Grid.fit(voxtool.mesh_from_arrays(*ball), 16)
    assert voxtool.voxelize(ball, grid) == voxtool.voxelize(ball, dim=16)
    with pytest.raises(voxtool.GridError, match="drop dim= and pitch=, or the grid"):
        voxtool.voxelize(ball, grid, dim=16)
    assert np.array_equal(
        voxtool.distance_grid(ball, dim=16) < 0, voxtool.voxelize(ball, dim=16).to_dense()
    )


def test_pictures_in_notebooks(ball) -> None:
    octree = voxtool.voxelize(ball, dim=16)
    shown = (octree, voxtool.extract(octree), voxtool.mesh_from_arrays(*ball))
    for content in (*shown, voxtool.build_adf(ball, max_level=3)):
        picture = content._repr_png_()  # pyright: ignore[reportAttributeAccessIssue]
        assert picture.startswith(b"\x89PNG")


def test_a_picture_that_cannot_be_made_is_none(ball, monkeypatch) -> None:
    octree = voxtool.voxelize(ball, dim=16)
    monkeypatch.setenv("VOXTOOL_DEVICE", "nothing-like-it")
    assert octree._repr_png_() is None  # pyright: ignore[reportAttributeAccessIssue]
