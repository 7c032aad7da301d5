"""The octree on the device, from the Morton codes of its refined nodes.

The build goes bottom-up ([voCCeL], section 3.2, listing A.2): the parents of a level's refined
nodes are found by shortening their codes; flags, a scan and a compaction keep each of them once.
Kernels: kernels/svo/build.cl.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.layout import MAX_LINK, NODE

SOURCE = "svo/build.cl"


@dataclass(frozen=True)
class RefinedNodes:
    """The refined nodes of a level.

    codes : (n,) Morton codes, rising; parent_index : (n,) places of the parents among the refined
    nodes of the level above.
    """

    codes: Array
    parent_index: Array
    n: int


@dataclass(frozen=True)
class DeviceOctree:
    """The links of an octree on the device.

    offsets : (depth + 1,) uint32, as in Octree; nodes : NODE; refined : by level, from 1 up.
    """

    offsets: np.ndarray
    nodes: Array
    refined: list[RefinedNodes]

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.refined)

    def kernel(self, source: str, name: str) -> Callable[..., None]:
        """A kernel for Morton codes of the octree's type."""
        code = code_name(self.refined[0].codes.dtype)
        return self.nodes.device.kernel(source, name, CODE=code)


def code_name(dtype: np.dtype) -> str:
    """The OpenCL name of the type of Morton codes, for the option CODE."""
    return "uint" if dtype.itemsize == 4 else "ulong"


def build_octree(device: Device, side: int, codes: Array, n: int) -> DeviceOctree:
    """The octree whose refined nodes are n level-1 nodes and their ancestors.

    Parameters
    ----------
    side : voxels along a side of the root, a power of two from 8 on.
    codes : (n,) rising Morton codes of level-1 nodes, uint32 or uint64.
    """
    code = code_name(codes.dtype)
    tag_parents = device.kernel(SOURCE, "tag_parents", CODE=code)
    strip_mortons = device.kernel(SOURCE, "strip_mortons", CODE=code)
    refined = []
    for _ in range((side // 8).bit_length()):
        parent_index = device.empty(n + 1, np.uint32)
        tag_parents(n, codes, parent_index)
        refined.append(RefinedNodes(codes, parent_index, n))
        count = exclusive_scan(parent_index, n) if n else 0
        parents = device.empty(count, codes.dtype)
        strip_mortons(n, codes, parent_index, parents)
        codes, n = parents, count
    return _link(device, refined)


def build_from_lists(device: Device, lists: list[np.ndarray]) -> DeviceOctree:
    """The octree of the given refined nodes: rising codes by level, from level 1 up; each node's
    parent is in the list above."""
    refined = []
    for codes, parents in zip(lists, [*lists[1:], lists[-1][:0]], strict=True):
        index = _places_of_parents(codes, parents)
        refined.append(RefinedNodes(device.put(codes), device.put(index), len(codes)))
    return _link(device, refined)


def _places_of_parents(codes: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """(n,) uint32: where the parent of each code is among `parents`; both rise."""
    shortened = codes >> codes.dtype.type(3)
    first = np.flatnonzero(np.diff(shortened, prepend=~shortened[:1]))
    places = np.searchsorted(parents, shortened[first]).astype(np.uint32)
    return np.repeat(places, np.diff(first, append=len(codes)))


def _link(device: Device, refined: list[RefinedNodes]) -> DeviceOctree:
    """Number the nodes, root first, and link parents and children."""
    top = len(refined)
    counts = [1, *(8 * level.n for level in reversed(refined))]
    offsets = np.concatenate([[0], np.cumsum(counts)])
    if offsets[-1] > MAX_LINK:
        raise MemoryLimitError(
            f"an octree of {offsets[-1]:,} nodes exceeds links of 30 bits: choose a smaller dim"
        )
    offsets = offsets.astype(np.uint32)
    nodes = device.zeros(int(offsets[-1]), NODE)
    link_level = device.kernel(SOURCE, "link_level", CODE=code_name(refined[0].codes.dtype))
    for number, level in enumerate(refined, 1):
        depth = top - number
        link_level(
            level.n, level.codes, level.parent_index, number == top, number, offsets[depth],
            offsets[depth + 1], nodes,
        )  # fmt: skip
    return DeviceOctree(offsets, nodes, refined)
