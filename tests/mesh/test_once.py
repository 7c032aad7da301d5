"""What is computed once for a mesh is kept as long as it, and not longer."""

import gc

from tests.meshes import box, mesh_of
from voxtool.mesh import once


def test_results_live_as_long_as_their_mesh() -> None:
    calls = []

    @once.once
    def faces(mesh, scale=1):
        calls.append(scale)
        return [scale * len(mesh.faces)]

    before = len(once._found)
    cube, other = mesh_of(*box(0, 1)), mesh_of(*box(0, 1))
    found = faces(cube)
    assert faces(cube, 2) is found == [12]
    assert faces(other, 2) == [24]
    assert calls == [1, 2]
    del cube, other
    gc.collect()
    assert len(once._found) == before
