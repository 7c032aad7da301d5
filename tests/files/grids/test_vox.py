""".vox: midvoxio reads what is written, and what it writes is read; scenes by their definition."""

from __future__ import annotations

import dataclasses
import struct
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import WORLD, ball, octree_from_dense

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.files.grids import quantize, vox
from voxtool.morton import morton_decode


def chunk(name: bytes, *numbers: int, rest: bytes = b"") -> bytes:
    content = struct.pack(f"<{len(numbers)}i", *numbers) + rest
    return struct.pack("<4sii", name, len(content), 0) + content


def file_of(*chunks: bytes) -> bytes:
    body = b"".join(chunks)
    return struct.pack("<4si4sii", b"VOX ", 150, b"MAIN", 0, len(body)) + body


def model(values: np.ndarray) -> bytes:
    places = np.argwhere(values)
    rows = np.column_stack([places, values[tuple(places.T)]]).astype(np.uint8)
    return chunk(b"SIZE", *values.shape) + chunk(b"XYZI", len(rows), rest=rows.tobytes())


def transform(node: int, child: int, **frame: str) -> bytes:
    attributes = vox._dict({f"_{name}": text for name, text in frame.items()})
    return chunk(b"nTRN", node, 0, child, -1, -1, 1, rest=attributes)


def test_midvoxio_reads_one_model(tmp_path: Path) -> None:
    from midvoxio.voxio import vox_to_arr

    dense = ball((40, 33, 21))
    voxtool.export(octree_from_dense(dense), tmp_path / "a.vox")
    assert np.array_equal(vox_to_arr(str(tmp_path / "a.vox"))[..., 3] > 0, dense)


@pytest.mark.parametrize("bbox", [None, (3.02, 1.02, 0.01, 7.98, 7.48, 1.98)])
def test_midvoxio_reads_several_models(
    bbox: tuple | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their voxels, placed by the definition of the format, are those of the octree."""
    from midvoxio.voxio import get_vox

    monkeypatch.setattr(vox, "MODEL_SIDE", 64)
    dense = ball((90, 80, 20))
    dense[:64, :32, :] = True
    octree = voxtool.Octree.from_dense(dense, (0, 0, 0), (0.1, 0.1, 0.1))
    voxtool.export(octree, tmp_path / "a.vox", bbox=bbox)
    if bbox:
        dense = dense[30:80, 10:75, :20]
    found = np.zeros(dense.shape, bool)
    scene = get_vox(str(tmp_path / "a.vox"))
    sizes = [tuple(size) for size in scene.sizes[: len(scene.voxels)]]
    low = np.array([-(dense.shape[0] // 2), -(dense.shape[1] // 2), 0])
    for place, number in scene._get_transform():
        voxels = np.array(scene.voxels[number])[:, :3]
        assert (voxels < sizes[number]).all()
        cells = voxels - np.array(sizes[number]) // 2 + place - low
        found[tuple(cells.T)] = True
    assert np.array_equal(found, dense)
    read = voxtool.read_voxels(tmp_path / "a.vox")
    assert np.array_equal(read.to_dense(), dense)


def test_full_blocks_are_one_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vox, "MODEL_SIDE", 64)
    octree = voxtool.Octree.from_dense(np.ones((256, 128, 70), bool), **WORLD)
    voxtool.export(octree, tmp_path / "a.vox")
    assert (tmp_path / "a.vox").stat().st_size < 4 * (64**3 + 256 * 128 * 6) + 4000
    assert voxtool.read_voxels(tmp_path / "a.vox").digest() == octree.digest()


def test_what_midvoxio_writes_is_read(tmp_path: Path) -> None:
    from midvoxio.voxio import write_list_to_vox

    dense = ball((12, 9, 10))
    colours = np.zeros((*dense.shape, 4))
    colours[dense] = 1, 0, 0, 1
    write_list_to_vox(colours, str(tmp_path / "a.vox"), palette_arr=[(255, 0, 0, 255)] * 256)
    octree = voxtool.read_voxels(tmp_path / "a.vox")
    places = np.argwhere(dense)
    extent = places.max(axis=0) + 1
    found = np.argwhere(octree.to_dense())
    assert np.array_equal(found - found.min(axis=0), places - places.min(axis=0))
    assert octree.grid.pitch == (1, 1, 1)
    assert (np.array(octree.grid.shape) >= extent - places.min(axis=0)).all()


@pytest.mark.parametrize("seed", range(6))
def test_scenes_of_turned_and_mirrored_models(seed: int, tmp_path: Path) -> None:
    """Against each voxel's centre turned and moved by matrices, one node after the other."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 3, rng.integers(1, 8, 3)).astype(np.uint8)
    values[0, 0, 0] = 2
    placings = []
    for _ in range(2):
        axes, signs = rng.permutation(3), rng.choice([-1, 1], 3)
        matrix = np.zeros((3, 3), int)
        matrix[range(3), axes] = signs
        bits = int(axes[0] | axes[1] << 2)
        bits |= sum(1 << (4 + n) for n in range(3) if signs[n] < 0)
        placings.append((matrix, rng.integers(-9, 9, 3), bits))
    frames = [{"r": str(r), "t": " ".join(map(str, t.tolist()))} for _, t, r in placings]
    scene = file_of(
        model(np.ones((2, 3, 9), np.uint8)), model(values),
        transform(0, 1), chunk(b"nGRP", 1, 0, 2, 2, 4),
        transform(2, 3, t="20 0 4"), chunk(b"nSHP", 3, 0, 1, 0, 0),
        transform(4, 5, **frames[0]), chunk(b"nGRP", 5, 0, 1, 6),
        transform(6, 7, **frames[1]), chunk(b"nSHP", 7, 0, 1, 1, 0), chunk(b"LAYR", 0, 0, -1),
    )  # fmt: skip
    (tmp_path / "a.vox").write_bytes(scene)
    octree = voxtool.read_voxels(tmp_path / "a.vox", label=2)
    centres = np.argwhere(values == 2) + 0.5 - np.array(values.shape) // 2
    for matrix, move, _ in placings[::-1]:
        centres = centres @ matrix.T + move
    cells = np.floor(centres).astype(int)
    found = np.argwhere(octree.to_dense()) + np.array(octree.grid.origin).astype(int)
    assert sorted(found.tolist()) == sorted(cells.tolist())
    both = voxtool.read_voxels(tmp_path / "a.vox")
    assert both.count == 54 + np.count_nonzero(values)


def test_files_without_a_scene(tmp_path: Path) -> None:
    values = np.zeros((9, 4, 5), np.uint8)
    values[1, 2, 3] = 7
    (tmp_path / "a.vox").write_bytes(file_of(model(values)))
    octree = voxtool.read_voxels(tmp_path / "a.vox")
    assert np.argwhere(octree.to_dense()).tolist() == [[1, 2, 3]]
    assert octree.grid == voxtool.Grid((9, 4, 5), (0, 0, 0), (1, 1, 1))
    (tmp_path / "a.vox").write_bytes(file_of(model(np.ones((1, 1, 1), np.uint8))))
    assert voxtool.read_voxels(tmp_path / "a.vox").count == 1


def test_grid_and_units_are_kept(tmp_path: Path) -> None:
    octree = octree_from_dense(ball((40, 33, 21)), units="mm")
    voxtool.export(octree, tmp_path / "a.vox")
    again = voxtool.read_voxels(tmp_path / "a.vox")
    assert (again.grid, again.units) == (octree.grid, "mm")


def test_coarser_cells_are_set_from_half_on(tmp_path: Path) -> None:
    dense = ball((40, 33, 21))
    voxtool.export(octree_from_dense(dense), tmp_path / "a.vox", level=1)
    cells = np.pad(dense, [(0, n % 2) for n in dense.shape]).reshape(20, 2, 17, 2, 11, 2)
    again = voxtool.read_voxels(tmp_path / "a.vox")
    assert np.array_equal(again.to_dense(), cells.mean(axis=(1, 3, 5)) >= 0.5)
    assert again.grid.pitch == (0.2, 0.2, 0.2)


def test_worlds_that_are_too_large_are_refused(tmp_path: Path) -> None:
    grid = voxtool.Grid((4001, 8, 8), (0.0, 0, 0), (1.0, 1, 1))
    octree = voxtool.Octree.from_voxels(np.array([[4000, 0, 0]]), grid)
    with pytest.raises(
        FileError, match=r"2000 voxels a side and this image 4001: choose --level 2"
    ):
        voxtool.export(octree, tmp_path / "a.vox")
    voxtool.export(octree, tmp_path / "a.vox", level=2, bbox=(3000, 0, 0, 4001, 8, 8))


SMALL = model(np.ones((8, 2, 2), np.uint8))
SHAPE = chunk(b"nSHP", 1, 0, 1, 0, 0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty|is no .vox"),
        (b"VOX?" + bytes(99), "is no .vox file: save it with MagicaVoxel"),
        (file_of(), "no model is in it"),
        (file_of(SMALL)[:-1], "ends within a chunk"),
        (file_of(SMALL[:-1]), "ends within a chunk"),
        (file_of(chunk(b"SIZE", 257, 1, 1)), "each side has 1 to 256"),
        (file_of(chunk(b"SIZE", 8, 0, 1)), "each side has 1 to 256"),
        (file_of(chunk(b"XYZI", 0)), "has more voxels than bytes, or no size"),
        (file_of(chunk(b"SIZE", 8, 8, 8), chunk(b"XYZI", 1 << 29)), "more voxels than bytes"),
        (file_of(chunk(b"SIZE", 8, 1, 1), chunk(b"XYZI", 1, 0x0108)), "outside of its model"),
        (file_of(SMALL, transform(0, 1)), "its scene lacks node 1"),
        (file_of(SMALL, transform(0, 0)), "its scene is no tree: node 0"),
        (file_of(SMALL, transform(0, 1), chunk(b"nGRP", 1, 0, 2, 2, 2), transform(2, 3),
                 chunk(b"nSHP", 3, 0, 1, 0, 0)), "node 2 is in it twice"),
        (file_of(SMALL, transform(0, 1), chunk(b"nSHP", 1, 0, 1, 5, 0)), "shows model 5 of 1"),
        (file_of(SMALL, transform(0, 1, r="5"), SHAPE), "rotation 5 is no rotation"),
        (file_of(SMALL, transform(0, 1, r="x"), SHAPE), "'x' is no whole number"),
        (file_of(SMALL, transform(0, 1, t="1 2"), SHAPE), "a translation is no three numbers"),
        (file_of(SMALL, transform(0, 1, t="1 2 9999999999"), SHAPE), "no three numbers"),
        (file_of(SMALL, chunk(b"nTRN", 0, 1, 99)), "a text is longer than its chunk"),
        (file_of(SMALL, chunk(b"nGRP", 0)), "is damaged"),
        (file_of(SMALL, SMALL, transform(0, 1), chunk(b"nGRP", 1, 0, 2, 2, 4), transform(2, 3),
                 chunk(b"nSHP", 3, 0, 1, 0, 0), transform(4, 5, t="99999999 0 0"),
                 chunk(b"nSHP", 5, 0, 1, 1, 0)), "8 to 65536"),
    ],
)  # fmt: skip
def test_refusals(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.vox").write_bytes(data)
    with pytest.raises(VoxtoolError, match=message):
        voxtool.read_voxels(tmp_path / "a.vox")


# ---- palettes


@pytest.mark.parametrize("axes", list(permutations(range(3))))
def test_models_of_few_voxels(
    axes: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One by one or as a box: the same voxels, whichever way the model is turned."""
    values = np.zeros((9, 20, 13), np.uint8)
    rng = np.random.default_rng(axes[0])
    values[tuple(rng.integers(0, values.shape, (12, 3)).T)] = rng.integers(1, 255, 12)
    for signs in product((0, 1), repeat=3):
        turn = axes[0] | axes[1] << 2 | sum(bit << 4 + n for n, bit in enumerate(signs))
        scene = file_of(model(values), transform(0, 1, r=str(turn), t="4 -3 2"), SHAPE)
        (tmp_path / "a.vox").write_bytes(scene)
        found = []
        for sparse in (1, 10**9):
            monkeypatch.setattr(vox, "SPARSE", sparse)
            found.append(voxtool.read_voxels(tmp_path / "a.vox", threshold=100))
        assert found[0] == found[1]
        assert found[0].count == np.count_nonzero(values >= 100)


def coloured(count: int, side: int = 40) -> voxtool.Octree:
    """Voxels of so many colours, in the order of bricks and bits."""
    dense = np.random.default_rng(1).random((side, side, side)) < 0.9  # so no leaf is coarse
    octree = voxtool.Octree.from_dense(dense)
    n = octree.count
    number = np.arange(n) % count
    values = np.stack([number % 256, number // 256, 255 - number % 256, np.full(n, 255)], axis=1)
    leaves = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
    held = int(np.bitwise_count(octree.bricks).sum())
    values = values.astype(np.uint8)
    attribute = voxtool.Attribute("colour", values[:held], values[:leaves])
    return dataclasses.replace(octree, attributes=(attribute,))


def read_rgba(path: Path) -> np.ndarray:
    from midvoxio.voxio import vox_to_arr

    return np.rint(255 * vox_to_arr(str(path))).astype(np.uint8)


def expected(octree: voxtool.Octree) -> np.ndarray:
    """The colours of all voxels, (nx, ny, nz, 4)."""
    found = np.zeros((*octree.grid.shape, 4), np.uint8)
    cells = octree.levels()[-1].cells
    local = morton_decode(np.arange(64, dtype=np.uint64))
    for cell, values in zip(cells, octree.values("colour").of_bricks(slice(None)), strict=True):
        inside = ((cell + local) < octree.grid.shape).all(axis=1)
        found[tuple((cell + local)[inside].T)] = values[inside]
    return found


@pytest.mark.parametrize("count", [1, 7, 255])
def test_colours_of_a_model_are_its_palette(count: int, tmp_path: Path) -> None:
    octree = coloured(count, 20)
    voxtool.export(octree, tmp_path / "a.vox")
    assert np.array_equal(read_rgba(tmp_path / "a.vox"), expected(octree))


def test_many_colours_become_255(tmp_path: Path) -> None:
    octree = coloured(5000, 24)
    for name in ("a.vox", "b.vox"):
        voxtool.export(octree, tmp_path / name)
    assert (tmp_path / "a.vox").read_bytes() == (tmp_path / "b.vox").read_bytes()
    found, wanted = read_rgba(tmp_path / "a.vox"), expected(octree)
    assert len(np.unique(found[found[..., 3] > 0], axis=0)) == 255
    error = np.abs(found.astype(int) - wanted)
    assert error.max() <= 16
    assert error.mean() < 3


def test_median_cut() -> None:
    colours = np.array([(x, 0, 0, 255) for x in range(256)], np.uint8)
    palette, place = quantize.palette_of(colours, np.ones(256, np.int64))
    assert len(palette) == 255
    assert (np.abs(palette[place].astype(int) - colours) <= 1).all()
    counts = np.where(np.arange(256) < 3, 1, 10**6)
    heavy, at = quantize.palette_of(colours, counts)
    assert (heavy[at][3:] == colours[3:]).all()  # the rare ones are joined
    assert np.array_equal(quantize.unpacked(quantize.packed(colours)), colours)


def test_labels_and_refusals(tmp_path: Path) -> None:
    octree = coloured(9, 12)
    names = tuple(map(str, range(300)))
    numbers = (np.arange(octree.count) % 300).astype(np.uint16)
    held = len(octree.attribute("colour").values)
    label = voxtool.Attribute("label", numbers[:held], numbers[:0], names=names)
    both = dataclasses.replace(octree, attributes=(*octree.attributes, label))
    voxtool.export(both, tmp_path / "a.vox")
    assert np.array_equal(read_rgba(tmp_path / "a.vox"), expected(octree))  # colours come first
    voxtool.export(both, tmp_path / "b.vox", attributes="label")
    found = read_rgba(tmp_path / "b.vox")
    assert len(np.unique(found[found[..., 3] > 0], axis=0)) == 255
    voxtool.export(both, tmp_path / "c.vox", attributes="none")
    found = read_rgba(tmp_path / "c.vox")
    assert len(np.unique(found[found[..., 3] > 0], axis=0)) == 1
    with pytest.raises(VoxtoolError, match=r"\.vox holds one attribute: name one"):
        voxtool.export(both, tmp_path / "d.vox", attributes="label,colour")
    normal = voxtool.Attribute("normal", np.zeros((held, 3), np.float32), np.zeros((0, 3), "f4"))
    other = dataclasses.replace(octree, attributes=(normal,))
    with pytest.raises(VoxtoolError, match=r"\.vox holds colours or labels, not normal"):
        voxtool.export(other, tmp_path / "d.vox", attributes="normal")


def test_levels_and_boxes_have_colours(tmp_path: Path) -> None:
    octree = coloured(100, 40)
    voxtool.export(octree, tmp_path / "a.vox", bbox=(3, 5, 7, 33, 36, 39))
    assert np.array_equal(read_rgba(tmp_path / "a.vox"), expected(octree)[3:33, 5:36, 7:39])
    voxtool.export(octree, tmp_path / "b.vox", level=1)
    counts = octree.to_dense().reshape(20, 2, 20, 2, 20, 2).sum(axis=(1, 3, 5))
    assert np.array_equal(read_rgba(tmp_path / "b.vox")[..., 3] == 255, counts >= 4)
