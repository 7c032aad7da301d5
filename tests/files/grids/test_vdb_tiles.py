"""Trees of OpenVDB with tiles at all levels: in, of every type and packing; out, beyond 4096."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
from helpers.openvdb import openvdb

import voxtool
from voxtool.svo.octree.from_pieces import Collector

FILES = Path(__file__).parents[2] / "data" / "openvdb.zip"  # openvdb_types.cc wrote them


def octree_of(grid: voxtool.Grid, cells: list, cubes: dict[int, list]) -> voxtool.Octree:
    """The octree of some voxels, and of cubes by their side."""
    collector = Collector(grid)
    collector.add_cubes(np.array(cells), 1)
    for side, corners in cubes.items():
        collector.add_cubes(np.array(corners), side)
    return collector.octree()


def test_every_type_and_packing(tmp_path: Path) -> None:
    """Active cells and tiles of 8, 128 and 4096 cells a side; not inactive ones of any value."""
    grid = voxtool.Grid((4096 + 256, 4096, 4096), (-2048.25, -0.25, -0.25), (0.5, 0.5, 0.5))
    held = {(i % 7, i * i % 13, i * 7 % 11) for i in range(300)} - {(3, 3, 3)}
    cells = [(4096 + x, y, z) for x, y, z in held | {(101, 3, 3), (102, 3, 3)}]
    cubes = {8: [(4096 + 16, 0, 0)], 128: [(4096 + 128, 0, 0)], 4096: [(0, 0, 0)]}
    wanted = octree_of(grid, cells, cubes)
    with zipfile.ZipFile(FILES) as files:
        assert len(files.namelist()) == 21
        for name in files.namelist():
            assert voxtool.read_voxels(files.extract(name, tmp_path)) == wanted, name


def test_root_tiles(tmp_path: Path) -> None:
    """They are written, and come back."""
    place = (1.0, 2.0, 3.0), (0.5, 0.5, 0.5)
    flat = octree_of(voxtool.Grid((8192, 16, 8192), *place), [(0, 1, 5)], {8: [(4096, 8, 0)]})
    cube = octree_of(voxtool.Grid((8192,) * 3, *place), [(0, 1, 5)], {4096: [(4096, 0, 4096)]})
    lines = []
    for number, (octree, dtype) in enumerate([(flat, "bool"), (cube, "bool"), (cube, "float32")]):
        path = tmp_path / f"{number}.vdb"
        voxtool.export(octree, path, dtype=dtype)
        assert voxtool.read_voxels(path) == octree
        lines.append(("read", path, tmp_path / f"{number}.npz", 1, 2, 6))
    openvdb(lines)
    for number, (count, leaves) in enumerate([(1 + 8**3, 1), (1 + 4096**3, 1), (1 + 4096**3, 1)]):
        read = np.load(tmp_path / f"{number}.npz")
        facts = json.loads(str(read["facts"]))
        assert (facts["active"], facts["leaves"]) == (count, leaves)
        assert np.argwhere(read["values"]).tolist() == [[0, 1, 5]]
