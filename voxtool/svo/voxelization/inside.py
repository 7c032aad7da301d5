"""One decision about what is inside of a mesh, which every command takes.

Closed meshes are decided by their shells (spatial/fill_rule.py). A mesh that is open but consistent
(consistency.py) is filled by winding numbers. For any other mesh, rules are compared
(fill_choice.py).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.mesh.topology import net_faces
from voxtool.mesh.watertight import watertight
from voxtool.opencl import Device
from voxtool.spatial.fill_rule import Inside, inside_of_closed

if TYPE_CHECKING:
    from voxtool.svo.voxelization.fill.caps import Boundary


@once
def net_boundary(mesh: Mesh) -> Boundary:
    """Return the boundary of the faces that winding numbers count."""
    from voxtool.svo.voxelization.fill.caps import find_boundary

    return find_boundary(mesh, net_faces(mesh))


@once
def inside_of(mesh: Mesh, device: Device) -> Inside:
    """Return what is inside of a mesh."""
    if not once(watertight)(mesh, device):
        from voxtool.svo.voxelization.consistency import consistent

        if consistent(mesh, net_boundary(mesh), device):
            return Inside(None, "winding")
    return inside_of_closed(mesh, device) or _compared(mesh, device)


def _compared(mesh: Mesh, device: Device) -> Inside:
    from voxtool.svo.voxelization.fill_choice import choose
    from voxtool.svo.voxelization.plan import COMPARISON
    from voxtool.svo.voxelization.voxelize import voxelize

    with device.stage(COMPARISON), device.reporting(lambda _: None):  # not the stages within
        return choose(mesh, net_boundary(mesh), device, voxelize)
