"""Pages of extreme scenes: what their compressed data unpack to, without a browser."""

from __future__ import annotations

import base64
import json
import re
import zlib
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.build import build_adf
from voxtool.adf.packing import unpack
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.morton import morton_encode
from voxtool.opencl import Device
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.octree import Octree
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.textures import build_tet
from voxtool.viewer.job import plan_view

if TYPE_CHECKING:
    from voxtool.rendering import Content

BLOCK = re.compile(r'<script type="([^"]*)" id="([^"]*)">(.*?)</script>', re.DOTALL)
DIM = 1 << 16  # the most voxels along a side


def unpacked(content: Content) -> tuple[dict, dict[str, np.ndarray]]:
    """The facts in the page of content, and its arrays by name, flat, as a browser unpacks them."""
    blocks = {name: text for _, name, text in BLOCK.findall(plan_view(content, "page").run().html)}
    facts, arrays = json.loads(blocks["facts"]), {}
    for name, told in facts["arrays"].items():
        planes = zlib.decompress(base64.b64decode(blocks[f"data-{name}"]))
        kind = np.dtype(f"<{told['type']}")
        elements = np.frombuffer(planes, np.uint8).reshape(kind.itemsize, -1).T
        arrays[name] = np.ascontiguousarray(elements).view(kind).ravel()
    return facts, arrays


def voxels_of(facts: dict, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The (N, 3) voxels that the page of an octree without leaves wholly inside holds, in any
    order: the nodes of one level after the other, and the bits of their bricks."""
    octants = np.indices((2, 2, 2))[::-1].reshape(3, 8).T
    bits = np.unpackbits(arrays["children"].reshape(-1, 2), axis=1, bitorder="little")
    cells, begin = np.zeros((1, 3), np.int64), 0
    for number in facts["levels"]:
        held = bits[begin : begin + number, :8]
        node, octant = np.nonzero(held)
        cells, begin = 2 * cells[node] + octants[octant], begin + number
    places = np.unpackbits(arrays["bricks"].view(np.uint8).reshape(-1, 8), 1, bitorder="little")
    brick, bit = np.nonzero(places)
    within = np.stack([bit >> axis & 1 | bit >> axis + 2 & 2 for axis in range(3)], axis=1)
    return 4 * cells[brick] + within


@case("pages of octrees", "none, one voxel, the corners at dim 65,536: unpacked", "voxels wrong", 0)
def octrees(device: Device, full: bool) -> int:
    wrong, last = 0, DIM - 1
    corners = last * np.indices((2, 2, 2)).reshape(3, 8).T
    for voxels in (np.empty((0, 3), int), corners[:1], corners[-1:], corners):
        for side in (8, DIM):
            grid = Grid((side, side, side), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
            expected = np.minimum(voxels, side - 1)
            octree = Octree.from_voxels(expected, grid, mode="surface26")
            found = voxels_of(*unpacked(octree))
            either = np.setxor1d(morton_encode(found), morton_encode(expected))
            wrong += len(either) + abs(len(found) - len(expected))
    return wrong


@case("pages of fields and volumes", "needles, slivers: arrays unpacked", "arrays wrong", 0)
def fields_and_volumes(device: Device, full: bool) -> int:
    needle = mesh_from_arrays(*shapes.box(np.zeros(3), np.array([1.0, 1e-6, 1e-6])))
    field = build_adf(needle, device, tolerance=1e-6, max_level=12 if full else 8, band=1e-3)
    _, arrays = unpacked(field)
    content = plan_view(field, "page").plan.content.arrays
    shaped = {name: array.reshape(content[name].shape) for name, array in arrays.items()}
    bounds = None if field.bounds is None else shaped["bounds"]
    voxels, cells, bounds = unpack(shaped["voxels"], shaped["cells"], bounds)
    pairs = [(voxels, field.voxels), (cells, field.cells), (shaped["hash"], field.hash.offsets)]
    if field.bounds is not None and bounds is not None:
        pairs.append((bounds, field.bounds))
    points, four = shapes.tetrahedra(np.arange(3.0), np.arange(3.0), np.array([0, 1e-9, 1.0]))
    volume = build_tet(
        UnstructuredMesh(points, [("tetra", four)], points[:, 0], "s"), device=device
    )
    _, arrays = unpacked(volume)
    own = volume.normals, volume.gradients, volume.neighbours, volume.cells, volume.vertices
    names = "normals", "gradients", "neighbours", "cells", "vertices"
    pairs += [(arrays[name], array) for name, array in zip(names, own, strict=True)]
    return sum(found.tobytes() != array.tobytes() for found, array in pairs)


CASES = (octrees, fields_and_volumes)
