"""The public functions of voxtool: each does in one call what a command does.

The wings take meshes, octrees, fields and grids. Here, a mesh may also be a path, a
`trimesh.Trimesh` or a pair of arrays, an octree or a field may be a path, and a grid may be given
by its resolution. This package also gives the data classes their pictures in notebooks.
"""
