"""Thin surfaces, against flood fills of the complement before and after, voxel by voxel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.cli import fail, run, told
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import voxtool
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.svo.octree.octree import Octree

pytestmark = pytest.mark.filterwarnings("ignore:of .* separated nothing")
MODES = {"surface26": 3, "surface6": 1}  # and the rank of scipy's structure of their paths


def unset_parts(dense: np.ndarray, mode: str) -> np.ndarray:
    """Label the components of what is not set; all beyond the array is unset."""
    structure = ndimage.generate_binary_structure(3, MODES[mode])
    return ndimage.label(np.pad(~dense, 1, constant_values=True), structure)[0]


def separated(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether voxels that were unset before lie in one part after if and only if they did
    before."""
    pairs = np.unique(np.stack([before[before > 0], after[before > 0]]), axis=1)
    return all(len(np.unique(row)) == pairs.shape[1] for row in pairs)


def check_minimal(dense: np.ndarray, thin: np.ndarray, mode: str) -> None:
    """Check that the thin set separates the same, and that every voxel of it is needed."""
    before = unset_parts(dense, mode)
    assert not (thin & ~dense).any()
    assert separated(before, unset_parts(thin, mode))
    for voxel in map(tuple, np.argwhere(thin)):
        thin[voxel] = False
        assert not separated(before, unset_parts(thin, mode)), voxel
        thin[voxel] = True


def thinned(dense: np.ndarray, mode: str) -> np.ndarray:
    grid = Grid(dense.shape, (0, 0, 0), (1, 1, 1))  # pyright: ignore[reportArgumentType]
    octree = Octree.from_voxels(np.argwhere(dense), grid, mode=mode)
    result = voxtool.thin(octree)
    result.validate()
    assert (result.grid, result.mode, result.fill) == (octree.grid, mode, "none")
    return result.to_dense()


@pytest.mark.parametrize("mode", MODES)
@given(
    shape=st.tuples(*[st.integers(1, 9)] * 3).filter(lambda s: max(s) >= 8),
    share=st.sampled_from([0.3, 0.6, 0.8, 0.95, 1.0]),
    seed=st.integers(0, 1 << 32),
)
@settings(max_examples=12, deadline=None)
def test_any_set_becomes_minimal(mode: str, shape, share: float, seed: int) -> None:
    """Among them sets with voxels that no unset one touches, and a full grid."""
    dense = np.random.default_rng(seed).random(shape) < share
    check_minimal(dense, thinned(dense, mode), mode)


@pytest.mark.parametrize("mode", MODES)
def test_walls_between_rooms(mode: str) -> None:
    """Walls of 1 to 4 voxels, with a sheet that ends in the air and a membrane in a tunnel, beside
    which another one leads to the same room."""
    dense = np.ones((18, 11, 9), bool)
    dense[1:5, 2:9, 1:8] = dense[6:10, 3:8, 3:6] = dense[13:16, 2:9, 2:7] = False
    dense[3, 2:6, 1:8] = True  # the sheet
    dense[9:14, 3, 4] = dense[9:14, 7, 4] = False  # two tunnels
    dense[11, 7, 4] = True  # the membrane
    thin = thinned(dense, mode)
    check_minimal(dense, thin.copy(), mode)
    assert not thin[3, 2:6, 2:7].any()
    assert not thin[11, 7, 4]


@pytest.mark.parametrize(("mode", "wall", "left"), [("surface26", 3, 296), ("surface6", 1, 384)])
def test_walls_of_a_box(mode: str, wall: int, left: int) -> None:
    """Of walls of 3 voxels the middle layer stays, 8^3 - 6^3; across faces, walls of 1 voxel need
    no edges, and 6 * 8^2 stay."""
    dense = np.ones((10, 10, 10), bool)
    dense[wall:-wall, wall:-wall, wall:-wall] = False
    thin = thinned(dense, mode)
    assert thin.sum() == left
    check_minimal(dense, thin, mode)


@pytest.mark.parametrize("mode", MODES)
def test_voxelized_meshes(mode: str) -> None:
    """The inside of a closed mesh stays separated from its outside."""
    mesh = voxtool.mesh_from_arrays(*meshes.icosphere(1))
    surface = voxtool.voxelize(mesh, dim=12, mode=mode)
    thin = voxtool.thin(surface)
    check_minimal(surface.to_dense(), thin.to_dense(), mode)
    assert thin.source_sha256 == surface.source_sha256
    assert thin.plan == surface.plan
    again = voxtool.thin(thin)
    assert again.digest() == thin.digest()


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "gone"), [("surface26", 11.2), ("surface6", 25.0)])
def test_the_share_that_the_page_states(mode: str, gone: float) -> None:
    surface = voxtool.voxelize(model("armadillo.obj"), dim=64, mode=mode)
    thin = voxtool.thin(surface)
    assert round(100 * (1 - thin.count / surface.count), 1) == gone
    before, after = (unset_parts(octree.to_dense(), mode) for octree in (surface, thin))
    assert separated(before, after)


def test_refusals() -> None:
    with pytest.raises(VoxtoolError, match="mode solid is no surface: voxelize with mode surf"):
        voxtool.thin(Octree.from_dense(np.ones((8, 8, 8))))
    surface = Octree.from_dense(np.ones((8, 8, 8)), mode="surface6")
    with pytest.raises(MemoryLimitError, match=r"thinning would need .* of 10 bytes allowed"):
        voxtool.thin(surface, max_memory=10)
    with pytest.warns(match=r"of 512 voxels 512 separated nothing"):
        assert voxtool.thin(surface).count == 0
    assert voxtool.thin(voxtool.thin(Octree.from_dense(np.zeros((8, 8, 8)), mode="surface6"))) == (
        Octree.from_dense(np.zeros((8, 8, 8)), mode="surface6")
    )


def test_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """voxelize and morph make the same set; its plan is told before."""
    monkeypatch.chdir(tmp_path)
    voxtool.write_mesh(voxtool.mesh_from_arrays(*meshes.icosphere(1)), "ball.obj")
    flags = "voxelize ball.obj --dim 24 --mode surface6"
    run(f"{flags} -o a.svo.h5")
    done = run(f"{flags} --thin -o b.svo.h5 -v")
    assert "separated nothing" in done.stderr
    found = told("morph a.svo.h5 --thin -o c.svo.h5 --json")
    assert found["digest"] == voxtool.read_svo("b.svo.h5").digest()
    assert (found["operation"], found["neighbours"]) == ("thin", 6)
    plan = told("morph a.svo.h5 --thin --plan --json")
    assert (plan["voxels"], plan["stages"][1]) == (found["voxels_before"], "thin")
    assert told(f"{flags} --thin --plan --json")["stages"][-1] == "thin"
    assert "read back, thin, merge subtrees\n" in run(f"{flags} --thin --dag --plan").stdout
    assert "--thin goes with --mode surface26" in fail("voxelize ball.obj --thin", 2)
    assert "drop --dask and --resume" in fail(f"{flags} --thin --resume", 2)
    run(f"{flags} --thin --dag -o d.svo.h5")
    assert told("svo-info d.svo.h5 --digest --json")["digest"] == found["digest"]
