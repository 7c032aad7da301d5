"""The octree on the device, from the Morton codes of its refined nodes.

The octree is built bottom-up ([voCCeL], section 3.2, listing A.2): shortening the codes of the
refined nodes of a level gives the codes of their parents; a scan and a compaction keep each once.
Kernels: kernels/svo/octree/build.cl.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import compact
from voxtool.svo.octree.layout import MAX_LINK, NODE

SOURCE = "svo/octree/build.cl"


@dataclass(frozen=True)
class RefinedNodes:
    """The refined nodes of a level."""

    codes: Array  # (n,) ascending Morton codes
    parent_index: Array  # (n,) index of the parent among the refined nodes of the level above
    n: int


@dataclass(frozen=True)
class DeviceOctree:
    """The links of an octree on the device."""

    offsets: np.ndarray  # (depth + 1,) uint32, as in Octree
    nodes: Array  # NODE
    refined: list[RefinedNodes]  # by level, from level 1 up

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.refined)

    def kernel(self, source: str, name: str) -> Callable[..., None]:
        """Return a kernel compiled for the type of the octree's Morton codes."""
        code = code_name(self.refined[0].codes.dtype)
        return self.nodes.device.kernel(source, name, CODE=code)


def code_name(dtype: np.dtype) -> str:
    """Return the OpenCL type of Morton codes, the value of the option CODE."""
    return "uint" if dtype.itemsize == 4 else "ulong"


def build_octree(device: Device, side: int, codes: Array, n: int) -> DeviceOctree:
    """Return the octree of `side` voxels whose refined nodes are the n level-1 nodes with these
    ascending Morton codes (uint32 or uint64), and their ancestors."""
    strip_mortons = device.kernel(SOURCE, "strip_mortons", CODE=code_name(codes.dtype))
    refined = []
    for _ in range((side // 8).bit_length()):
        stripped, parent_index = device.empty(n, codes.dtype), device.empty(n + 1, np.uint32)
        strip_mortons(n, codes, stripped, parent_index)
        refined.append(RefinedNodes(codes, parent_index, n))
        codes, n = compact(stripped, parent_index, n)
    return _link(device, refined)


def build_from_lists(device: Device, lists: list[np.ndarray]) -> DeviceOctree:
    """Return the octree of refined nodes that are given by ascending codes, from level 1 up."""
    refined = []
    for codes, parents in zip(lists, [*lists[1:], lists[-1][:0]], strict=True):
        index = np.searchsorted(parents, codes >> codes.dtype.type(3)).astype(np.uint32)
        refined.append(RefinedNodes(device.put(codes), device.put(index), len(codes)))
    return _link(device, refined)


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
        first, below = offsets[top - number : top - number + 2].tolist()
        codes, parents = level.codes, level.parent_index
        link_level(level.n, codes, parents, number == top, number, first, below, nodes)
    return DeviceOctree(offsets, nodes, refined)
