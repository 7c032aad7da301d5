""".vox: midvoxio reads what is written, and what it writes is read; scenes by their definition."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers_octree import WORLD, ball, octree_from_dense

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.files import vox


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
        (file_of(SMALL, transform(0, 1, r="x"), SHAPE), "is damaged"),
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
