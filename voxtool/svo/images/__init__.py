"""An octree as an image: blocks, slabs and layers, for exports."""
