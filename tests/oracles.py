"""The oracles of voxelization, which the selftest has, too."""

from voxtool.bench.selftest.oracles import (
    OctreeNodes,
    active_nodes,
    expected_octree_nodes,
    solid,
    surface6,
    surface26,
    to_dense,
)

__all__ = [
    "OctreeNodes",
    "active_nodes",
    "expected_octree_nodes",
    "solid",
    "surface6",
    "surface26",
    "to_dense",
]
