"""The textures are the same on every device, and those that version 0.1 computed with numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tets import assembly, lattice, linear, tet_grid, tet_mesh, unstructured

from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.opencl import Device
from voxtool.tets.construction.plan import VolumePlan
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.tets.volume.packing import (
    pack_layers,
    pack_rows,
    rows_for,
    unpack_layers,
    unpack_rows,
    width_for,
)

# Of each case: the digest of the volume, and the counts of its build that are not 0.
EXPECTED: dict[str, tuple[str, dict[str, int]]] = {
    "all kinds": (
        "89e90d3d3eedc4ba0237fcc56860937f5d58a1dc1259bdee1d69544e84fba523",
        {"points": 92, "boundary_faces": 132},
    ),
    "all kinds, projection": (
        "ac01f5eccc7ddca154c0dd188ec8985bbab71dc767985a95f154780c7982e8ee",
        {"points": 90, "boundary_faces": 132},
    ),
    "moved and merged": (
        "3546051cc32dcaae9941eee205dc3d5a4217a72aa8ddf458c34b4d7f49be5269",
        {"points": 95, "boundary_faces": 132},
    ),
    "constant cells": (
        "15c30b598d32a4897e9797ee9eb45e847ff11e7b2f3e6b4c9925cad7471ad6c1",
        {"points": 93, "boundary_faces": 132},
    ),
    "turned and doubled": (
        "07681f479323f307e7a2ce0c5892f721be72de6ae45bf9a4dd55526184e1a62e",
        {"points": 210, "duplicates": 15, "turned": 306, "boundary_faces": 596},
    ),
    "flat and coincident": (
        "b7c29e6b48b538d80fc52dbabb9161176141d4f01e0eb7d9b00b6ef151b4e043",
        {
            "points": 210,
            "merged_points": 6,
            "coincident": 24,
            "duplicates": 15,
            "zero_volume": 27,
            "turned": 294,
            "boundary_faces": 590,
        },
    ),
    "merged by distance": (
        "494e2dfd34013c988fcd20536d3a0072d7baef79f89d10fbb9e642089997318c",
        {
            "points": 210,
            "merged_points": 14,
            "merged_scalars": 14,
            "coincident": 46,
            "duplicates": 15,
            "zero_volume": 46,
            "turned": 281,
            "boundary_faces": 556,
        },
    ),
    "overlapping": (
        "f6cd910c9c56fb078b05f8443a1eb0667d13ef4b92f14d8ad5de3152bc0fd849",
        {
            "points": 12,
            "coincident": 15,
            "zero_volume": 15,
            "turned": 14,
            "non_manifold_faces": 1,
            "folded_faces": 5,
            "boundary_faces": 94,
        },
    ),
    "hexahedra": (
        "5a31ac62ac5220b15f2a98d04871db92f567476a145be408321f8897f30f7f7f",
        {"points": 60, "duplicates": 6, "turned": 4, "boundary_faces": 52},
    ),
    "split hexahedra": (
        "cfab3ec0e80962bece0df0de076eb045470d3c14450e28ae2713664bb7835632",
        {"points": 60, "duplicates": 36, "turned": 24, "boundary_faces": 104},
    ),
    "collapsed hexahedra": (
        "e79d93d71829f9d852e4a25f57eac08e288023c6a5f7c08e862988000a7150da",
        {
            "points": 60,
            "collapsed": 10,
            "duplicates": 33,
            "zero_volume": 1,
            "turned": 22,
            "boundary_faces": 148,
        },
    ),
}


def product(points: np.ndarray) -> np.ndarray:
    return points[:, 0] * points[:, 1] + points[:, 2]


def case(name: str) -> tuple[UnstructuredMesh, str, float]:
    """A mesh, a layout and a merge distance."""
    random = np.random.default_rng(len(name))
    mixed = assembly((3, 4, 3), len(name))
    points, cells = tet_grid((6, 5, 4), 1, 0.2)
    cells[::7] = cells[::7][:, [0, 2, 1, 3]]
    cells = np.concatenate([cells, cells[5:50:3][:, [3, 1, 0, 2]]])
    coarse = np.round(points * 4) / 4
    shift = np.array([10.3, -7.7, 0.1])
    corners, boxes = lattice((4, 3, 2))
    corners = np.sqrt(corners + 1) @ np.array([(1, 0, 0), (0.25, 1, 0), (0, 0.5, 2)])
    boxes[5:9] = boxes[5:9][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    boxes = [("hexahedron", np.concatenate([boxes, boxes[3:9]]))]
    values = [random.uniform(0, 9, len(block)) for _, block in mixed.cells]
    half = boxes[0][1].copy()
    half[::3, 6] = half[::3, 5]
    return {
        "all kinds": (mixed, "raycast", 0.0),
        "all kinds, projection": (mixed, "projection", 0.0),
        "moved and merged": (
            unstructured(mixed.points + shift, mixed.cells, linear(mixed.points)),
            "raycast",
            1e-3,
        ),
        "constant cells": (unstructured(mixed.points, mixed.cells, values), "raycast", 0.0),
        "turned and doubled": (tet_mesh(points, cells, product(points)), "raycast", 0.0),
        "flat and coincident": (tet_mesh(coarse, cells, product(coarse)), "raycast", 0.0),
        "merged by distance": (tet_mesh(points, cells, product(points)), "projection", 0.26),
        "overlapping": (
            tet_mesh(
                random.uniform(-1, 1, (12, 3)), random.integers(0, 12, (40, 4)), np.arange(12.0)
            ),
            "raycast",
            0.0,
        ),
        "hexahedra": (
            unstructured(corners, boxes, [np.arange(len(boxes[0][1])) % 7.0]), "hexahedra", 0.0,
        ),
        "split hexahedra": (unstructured(corners, boxes, product(corners)), "raycast", 0.0),
        "collapsed hexahedra": (
            unstructured(corners, [("hexahedron", half)], product(corners)), "raycast", 0.0,
        ),
    }[name]  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_textures_are_those_of_numpy(name: str, device: Device) -> None:
    volume = build_tet(*case(name), device=device)
    volume.validate()
    counts = {key: n for key, n in volume.report.items() if isinstance(n, int) and n}
    assert (volume.digest(), counts) == EXPECTED[name]


def test_a_volume_that_fits_no_texture_is_refused() -> None:
    fits = VolumePlan("raycast", 0.0, {"tetra": 2048**2}, {}, 5000, False, max_texture=2048)
    fits.refuse_beyond(1 << 40, 1 << 40)
    message = "4,194,305 cells with 5,000 points do not fit textures of 2048 x 2048 .*--max-texture"
    with pytest.raises(MemoryLimitError, match=message):
        replace(fits, cells={"tetra": 2048**2 + 1}).refuse_beyond(1 << 40, 1 << 40)
    with pytest.raises(VoxtoolError, match="max texture 16385: choose 2048 to 16384"):
        replace(fits, max_texture=16385)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 16, 17, 100])
def test_rows_are_a_power_of_two_wide(n: int) -> None:
    items = np.arange(2 * n, dtype=np.int32).reshape(n, 2) + 1
    packed = pack_rows(items)
    rows, width, channels = packed.shape
    assert (rows, width, channels) == (rows_for(n), width_for(n), 2)
    assert width & (width - 1) == 0
    assert width**2 >= n > (width // 2) ** 2
    assert n <= rows * width < n + width
    assert all(np.array_equal(packed[i // width, i % width], items[i]) for i in range(n))
    assert np.array_equal(unpack_rows(packed, n), items)
    eight = np.arange(8 * n, dtype=np.int32).reshape(n, 8)
    layers = pack_layers(eight)
    assert np.array_equal(layers[1, 0, 0], (4, 5, 6, 7))
    assert np.array_equal(unpack_layers(layers, n), eight)
