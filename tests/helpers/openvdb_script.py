"""Reads and writes files with OpenVDB's own library; run by the system's Python, which has it.

read FILE OUT.npz NX NY NZ [NAME]  values of active cells of [0, shape), and facts of the grid
"""

import json
import sys

import numpy as np

try:
    import pyopenvdb
except ImportError:  # its name since OpenVDB 12
    import openvdb as pyopenvdb


def read(path, out, nx, ny, nz, *name):
    grid = pyopenvdb.read(path, *name) if name else pyopenvdb.readAll(path)[0][0]
    shape = (int(nx), int(ny), int(nz))
    of_vectors = isinstance(grid.background, tuple)
    values = np.zeros((*shape, 3) if of_vectors else shape, np.array(grid.background).dtype)
    grid.copyToArray(values)
    facts = {
        "type": type(grid).__name__,
        "name": grid.name,
        "class": str(grid.gridClass),
        "active": grid.activeVoxelCount(),
        "leaves": grid.leafCount(),
        "box": grid.evalActiveVoxelBoundingBox(),
        "background": grid.background,
        "corners": [
            grid.transform.indexToWorld(c)
            for c in ((0, 0, 0), (shape[0], 0, 0), (shape[0], shape[1], shape[2]))
        ],
        "metadata": {k: v for k, v in grid.metadata.items() if isinstance(v, (str, int))},
    }
    grid.prune((0.0, 0.0, 0.0) if of_vectors else 0)
    facts["pruned"] = grid.leafCount()
    np.savez(out, values=values, facts=json.dumps(facts))


def write(path, source, kind, half, matrix):
    values = np.load(source)
    grid = getattr(pyopenvdb, kind)(values.dtype.type(0).item())
    grid.copyFromArray(values, ijk=(-3, 5, 130))
    grid.fill((128, 0, 0), (135, 7, 7), values.dtype.type(1).item())
    grid.prune()
    grid.saveFloatAsHalf = half == "half"
    grid.name, grid.gridClass = "a", pyopenvdb.GridClass.FOG_VOLUME
    grid.transform = pyopenvdb.createLinearTransform(json.loads(matrix))
    pyopenvdb.write(path, grid)


def several(path):
    sphere = pyopenvdb.createLevelSetSphere(9.0, (1.0, 2.0, 3.0), 0.25)
    sphere.name = "sphere"
    grids = [sphere, pyopenvdb.BoolGrid(), pyopenvdb.Vec3SGrid()]
    for grid, name in zip(grids[1:], ("nothing", "velocity"), strict=True):
        grid.name = name
    pyopenvdb.write(path, grids)


for line in sys.stdin.read().splitlines():
    verb, *words = line.split("\t")
    globals()[verb](*words)
