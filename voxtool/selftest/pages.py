"""Pages of extreme scenes: what their compressed data unpack to, without a browser."""

from __future__ import annotations

import base64
import json
import re
import zlib
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.packing import unpack
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Device
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.octree.octree import Octree
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.viewer.job import plan_view

if TYPE_CHECKING:
    from voxtool.pictures.rendering import Content
    from voxtool.viewer.page import Page

BLOCK = re.compile(r'<script type="([^"]*)" id="([^"]*)">(.*?)</script>', re.DOTALL)
DIM = 1 << 16  # the most voxels along a side
LEVEL = 58  # the place of the level in the key of a node, above its Morton code
TABLE_5 = ("normals", "gradients", "neighbours", "cells", "vertices")


def wrong_values(content: Content, page: Page) -> tuple[int, int]:
    """Return how many values the page of content unpacks to wrongly, and how many there are: voxels
    of an octree, or elements of the textures of a field, or of a volume in table 5."""
    facts, arrays = unpacked(page)
    if isinstance(content, Octree):
        found, expected = nodes_of(facts, arrays), _nodes(content)
        _, i, j = np.intersect1d(found[0], expected[0], assume_unique=True, return_indices=True)
        both = _voxels(found[0][i], found[1][i] & expected[1][j])
        return _voxels(*found) + content.count - 2 * both, content.count
    if isinstance(content, DistanceField):
        pairs = _textures(content, page, arrays)
    else:
        pairs = [(arrays[name], getattr(content, name)) for name in TABLE_5]
    return sum(_differing(*pair) for pair in pairs), sum(found.size for found, _ in pairs)


def unpacked(page: Page) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the facts in a page, and its arrays by name, flat, as a browser unpacks them."""
    blocks = {name: text for _, name, text in BLOCK.findall(page.html)}
    facts, arrays = json.loads(blocks["facts"]), {}
    for name, told in facts["arrays"].items():
        planes = zlib.decompress(base64.b64decode(blocks[f"data-{name}"]))
        kind = np.dtype(f"<{told['type']}")
        elements = np.frombuffer(planes, np.uint8).reshape(kind.itemsize, -1).T
        arrays[name] = np.ascontiguousarray(elements).view(kind).ravel()
    return facts, arrays


def nodes_of(facts: dict, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the bricks and the leaves wholly inside that the page of an octree holds: keys of
    level and Morton code, and masks of voxels, (N,) uint64 each. Nodes come level by level."""
    octants = np.indices((2, 2, 2))[::-1].reshape(3, 8).T
    bits = np.unpackbits(arrays["children"].reshape(-1, 2), axis=1, bitorder="little")
    cells, begin, keys = np.zeros((1, 3), np.int64), 0, []
    for level, number in zip(reversed(range(len(facts["levels"]))), facts["levels"], strict=True):
        held, refined = bits[begin : begin + number].reshape(-1, 2, 8).swapaxes(0, 1)
        node, octant = np.nonzero(held)
        cells, begin = 2 * cells[node] + octants[octant], begin + number
        deeper = refined[node, octant] == 1
        keys.append(_keys(level, morton_encode(cells[~deeper])))
        cells = cells[deeper]
    bricks = arrays["bricks"].view("<u8")
    whole = np.full(sum(map(len, keys)) - len(bricks), 2**64 - 1, np.uint64)
    return np.concatenate(keys), np.concatenate([whole, bricks])


def _nodes(octree: Octree) -> tuple[np.ndarray, np.ndarray]:
    """Return the keys and the masks of an octree itself, as `nodes_of` does of its page."""
    *above, last = octree.levels()
    full = octree.bricks != 0
    keys = [_keys(level.number, level.codes[level.inside]) for level in above]
    whole = np.full(sum(map(len, keys)), 2**64 - 1, np.uint64)
    bricks = _keys(0, last.codes[full])
    return np.concatenate([*keys, bricks]), np.concatenate([whole, octree.bricks[full]])


def _keys(level: int, codes: np.ndarray) -> np.ndarray:
    return codes | np.uint64(level << LEVEL)


def _voxels(keys: np.ndarray, masks: np.ndarray) -> int:
    """Return the number of voxels of nodes."""
    counts = np.bitwise_count(masks).astype(np.int64)
    return int((counts << (3 * (keys >> np.uint64(LEVEL)).astype(np.int64))).sum())


def _textures(
    field: DistanceField, page: Page, arrays: dict[str, np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the arrays of a field that its page unpacks to, and those of the field."""
    content = page.content.arrays
    shaped = {name: array.reshape(content[name].shape) for name, array in arrays.items()}
    bounds = None if field.bounds is None else shaped["bounds"]
    voxels, cells, bounds = unpack(shaped["voxels"], shaped["cells"], bounds)
    pairs = [(voxels, field.voxels), (cells, field.cells), (shaped["hash"], field.hash.offsets)]
    if field.bounds is not None and bounds is not None:
        pairs.append((bounds, field.bounds))
    return pairs


def _differing(found: np.ndarray, expected: np.ndarray) -> int:
    """Return the number of elements that differ; all where there are more of one than of the
    other."""
    if found.size != expected.size:
        return max(found.size, expected.size)
    return int(np.count_nonzero(_words(found) != _words(expected)))


def _words(array: np.ndarray) -> np.ndarray:
    """Return the bits of the elements of an array, which tell -0 from 0."""
    return np.ascontiguousarray(array).ravel().view(f"<u{array.itemsize}")


def voxels_of(page: Page) -> np.ndarray:
    """Return the (N, 3) voxels in the bricks of a page, in any order."""
    keys, masks = nodes_of(*unpacked(page))
    brick, bit = np.nonzero(masks[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1))
    within = np.stack([bit >> axis & 1 | bit >> axis + 2 & 2 for axis in range(3)], axis=1)
    return 4 * morton_decode(keys)[brick] + within


@case("pages of octrees", "none, one voxel, the corners at dim 65,536: unpacked", "voxels wrong", 0)
def octrees(device: Device, full: bool) -> int:
    wrong, last = 0, DIM - 1
    corners = last * np.indices((2, 2, 2)).reshape(3, 8).T
    for voxels in (np.empty((0, 3), int), corners[:1], corners[-1:], corners):
        for side in (8, DIM):
            grid = Grid((side, side, side), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
            expected = np.minimum(voxels, side - 1)
            octree = Octree.from_voxels(expected, grid, mode="surface26")
            found = voxels_of(plan_view(octree, "page").run())
            either = np.setxor1d(morton_encode(found), morton_encode(expected))
            wrong += len(either) + abs(len(found) - len(expected))
    return wrong


@case("pages of fields and volumes", "needles, slivers: values unpacked", "values wrong", 0)
def fields_and_volumes(device: Device, full: bool) -> int:
    needle = mesh_from_arrays(*shapes.box(np.zeros(3), np.array([1.0, 1e-6, 1e-6])))
    field = build_adf(needle, device, tolerance=1e-6, max_level=12 if full else 8, band=1e-3)
    points, four = shapes.tetrahedra(np.arange(3.0), np.arange(3.0), np.array([0, 1e-9, 1.0]))
    volume = build_tet(
        UnstructuredMesh(points, [("tetra", four)], points[:, 0], "s"), device=device
    )
    contents = field, volume
    return sum(wrong_values(each, plan_view(each, "page").run())[0] for each in contents)


CASES = (octrees, fields_and_volumes)
