"""Work larger than one memory: windows of an octree, in Morton order, and what joins them."""

from voxtool.tiles.make import combine, morph, voxelize

__all__ = ["combine", "morph", "voxelize"]
