"""What is computed once for a mesh is kept as long as it, and not longer."""

import gc
import weakref

import numpy as np
from helpers.meshes import box, mesh_of

from voxtool.mesh.once import once


def test_results_live_as_long_as_their_mesh() -> None:
    calls = []

    @once
    def scaled(mesh, scale=1):
        calls.append(scale)
        return scale * np.arange(len(mesh.faces))

    cube, other = mesh_of(*box(0, 1)), mesh_of(*box(0, 1))
    found = weakref.ref(scaled(cube))
    assert scaled(cube, 2) is found()
    assert scaled(other, 2)[-1] == 22
    assert calls == [1, 2]
    del cube
    gc.collect()
    assert found() is None
