"""Images of octrees that are not in memory: the same files as of the octree in memory."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, run, told
from helpers.merged import OCTREES

import voxtool
from voxtool.errors import MemoryLimitError
from voxtool.files import open_svo, write_svo
from voxtool.files.exchange import plan_export
from voxtool.svo.cells.counts import Counts, NodeCounts
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import SHARE, ImageInParts
from voxtool.svo.octree.octree import Octree

BOX = (13.2, 5, 7.7, 120, 61, 50)
REQUESTS: tuple[dict[str, Any], ...] = (
    {},
    {"invert": True},
    {"level": 1, "dtype": "float32"},
    {"level": 2, "invert": True, "bbox": BOX},
    {"bbox": BOX},
)
FORMATS = ("npy", "npz", "nrrd", "binvox", "ply", "tif")


def octree_of(seed: int = 1) -> Octree:
    """Return an octree of blocks that do not lie on its nodes, and single voxels."""
    random = np.random.default_rng(seed)
    dense = np.kron(random.random((12, 10, 7)) < 0.4, np.ones((11, 11, 11), bool))
    return Octree.from_dense(dense ^ (random.random(dense.shape) < 0.002))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Octree, list[Path]]:
    """An octree, and a file with all its nodes and one of merged subtrees."""
    octree, folder = octree_of(), tmp_path_factory.mktemp("octrees")
    write_svo(octree, folder / "a.svo.h5")
    write_svo(MergedOctree.of(octree), folder / "b.svo.h5")
    return octree, [folder / "a.svo.h5", folder / "b.svo.h5"]


def in_parts(image: VoxelImage, most: int) -> ImageInParts:
    """Return an image whose parts have up to `most` bytes of nodes."""
    shared = {item.name: getattr(image, item.name) for item in fields(VoxelImage)}
    return ImageInParts(**shared, limit=image.layer_bytes + SHARE * most)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("name", FORMATS)
def test_parts_make_the_same_file(name: str, files, tmp_path: Path, monkeypatch) -> None:
    octree, stored = files
    for request in REQUESTS:
        if name == "binvox" and "dtype" in request:
            continue
        path, counts = tmp_path / f"a.{name}", set()
        plan_export(octree, path, **request).run()
        expected = digest(path)
        for most in (40_000, 300_000):
            monkeypatch.setattr(
                "voxtool.files.exchange.fitting_image",
                lambda image, *_, most=most: in_parts(image, most),
            )
            for source in stored:
                with open_svo(source) as content:
                    job = plan_export(content, path, **request)
                    counts.add(len(list(job.plan.image.parts(2))))
                    job.run()
                assert digest(path) == expected, (request, most)
                assert path.stat().st_size <= job.plan.size
        assert max(counts) > 2
        assert len(counts) > 1


def held(path: Path) -> dict[str, bytes]:
    """Return the bytes of a file, or of those of a folder."""
    found = [p for p in path.rglob("*") if p.is_file()] or [path]
    return {str(p.relative_to(path)): p.read_bytes() for p in found}


def test_parts_of_a_pyramid(files, tmp_path: Path, monkeypatch) -> None:
    octree, stored = files

    plan_export(octree, tmp_path / "a.ome.zarr", dtype="float32").run()
    parts: list[int] = []

    def chosen(image: VoxelImage, *_: Any) -> ImageInParts:
        found = in_parts(image, 260_000)
        parts.append(len(list(found.parts(least=64))))
        return found

    monkeypatch.setattr("voxtool.files.exchange.fitting_image", chosen)
    with open_svo(stored[0]) as content:
        plan_export(content, tmp_path / "b.ome.zarr", dtype="float32").run()
    assert parts == [3]
    assert held(tmp_path / "a.ome.zarr") == held(tmp_path / "b.ome.zarr")


ATTRIBUTED: tuple[tuple[str, dict[str, Any]], ...] = (
    ("npz", {}),
    ("npz", {"level": 1}),  # areas are summed in units of the largest one
    ("npz", {"level": 3}),
    ("npy", {"attributes": "colour", "bbox": (3, 4, 5, 30, 20, 18)}),
    ("vti", {}),
    ("nrrd", {"attributes": "label"}),
    ("ply", {"level": 2}),
    ("ome.zarr", {}),
    ("msh", {}),
    ("inp", {"leaves": True}),
)


@pytest.mark.parametrize(("name", "request_"), ATTRIBUTED, ids=str)
def test_parts_have_their_attributes(name, request_, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("voxtool.svo.attributes.of_parts.BLOCK", 64)  # so that there are many
    monkeypatch.setattr("voxtool.files.grids.ome_zarr.CHUNK", 16)
    octree = attributed()
    write_svo(octree, tmp_path / "a.svo.h5")
    whole, parts = tmp_path / f"whole.{name}", tmp_path / f"parts.{name}"
    plan_export(octree, whole, **request_).run()
    seen, whole_part = set(), ImageInParts.part

    def part(image: ImageInParts, low: Any, shape: Any) -> VoxelImage:
        found = whole_part(image, low, shape)
        if found.attributes:
            seen.add(low)
        return found

    monkeypatch.setattr(ImageInParts, "part", part)
    with open_svo(tmp_path / "a.svo.h5") as stored:
        for power in range(12, 24):  # the least memory that suffices
            most = (1 << power) // SHARE
            monkeypatch.setattr(
                "voxtool.files.exchange.fitting_image",
                lambda image, *_, most=most: in_parts(image, most),
            )
            with suppress(MemoryLimitError):
                plan_export(stored, parts, **request_).run()
                break
        assert len(seen) > 1
    assert held(whole) == held(parts)


@pytest.mark.parametrize("make", OCTREES.values(), ids=OCTREES)
def test_counts_of_upper_nodes_alone(make, tmp_path: Path) -> None:
    octree = make()
    write_svo(octree, tmp_path / "a.svo.h5")
    with open_svo(tmp_path / "a.svo.h5") as stored:
        for level in range(3, octree.depth + 2):
            whole = Counts(octree, level)
            for content in (stored, MergedOctree.of(octree)):
                found = NodeCounts(content, level)
                for number in range(found.level, octree.depth):
                    a, b = whole.levels[number], found.levels[number]
                    assert np.array_equal(a.codes, b.codes)
                    assert np.array_equal(a.nodes["child"], b.nodes["child"])
                    assert np.array_equal(whole.of_nodes[number], found.of_nodes[number])
                    nodes = np.arange(len(a.nodes))
                    assert np.array_equal(
                        whole.of_cells(number, nodes), found.of_cells(number, nodes)
                    )


@pytest.fixture
def surface(here: Path) -> None:
    """A surface of 512 voxels in a file, and merged."""
    octree = voxtool.voxelize("bunny.obj", dim=512, mode="surface26")
    write_svo(octree, "a.svo.h5")
    write_svo(MergedOctree.of(octree), "b.svo.h5")


def test_exports_choose_what_fits(surface: None) -> None:
    for name, wanted in (("ply", "windows"), ("vdb --level 3", ""), ("vtkhdf --level 4", "")):
        ending, *options = name.split()
        rest = " ".join(options)
        whole = told(f"export a.svo.h5 {rest} --json -o whole.{ending}")
        for source in "ab":
            command = f"export {source}.svo.h5 {rest} --max-memory 1M -o parts.{ending}"
            assert wanted in run(f"{command} --plan").stdout
            assert told(f"{command} --json")["digest"] == whole["digest"]
            assert digest(Path(f"parts.{ending}")) == digest(Path(f"whole.{ending}"))


def test_boxes_and_slices_are_read_alone(surface: None) -> None:
    x, y, z = voxtool.read_svo("a.svo.h5").grid.origin
    box = f"--bbox {x} {y} {z} {x + 0.05} {y + 0.02} {z + 1}"
    for name in (f"vdb {box}", "png --slice y=200"):
        ending, *options = name.split()
        rest = " ".join(options)
        run(f"export a.svo.h5 {rest} -o whole.{ending}")
        for source in "ab":
            run(f"export {source}.svo.h5 {rest} --max-memory 4M -o parts.{ending}")
            assert digest(Path(f"parts.{ending}")) == digest(Path(f"whole.{ending}"))


def test_refusals(surface: None) -> None:
    for source in "ab":
        command = f"export {source}.svo.h5 --max-memory 1M"
        assert "a .vdb is written from memory" in fail(f"{command} -o x.vdb")
        assert "choose a higher --level" in fail(f"{command} --windows never -o x.ply")
        assert "choose a higher --level" in fail(f"{command} -o x.npy")
        assert "choose a plane by --slice" in fail(f"{command} -o x.png")
    coarse = "export a.svo.h5 --level 3 --max-memory 10k -o x.vdb"
    assert "would need" in fail(coarse)


def test_a_slice_has_an_axis_by_default(surface: None) -> None:
    run("export a.svo.h5 --slice z=100 -o command.png")
    voxtool.export("a.svo.h5", "call.png", value=100)
    assert digest(Path("call.png")) == digest(Path("command.png"))


def test_layers_that_do_not_fit(files) -> None:
    image = in_parts(VoxelImage.of(files[0]), 1000)
    with pytest.raises(MemoryLimitError, match=r"4 layers of cells do not fit in .*--level"):
        list(image.listed())
