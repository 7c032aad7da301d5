"""Pictures of tetrahedra where extinction is steep, in float64.

Ray casting and cell projection subtract depths of float32, which an extinction of E per local
length shows as E times their rounding; and their scalars of float32 do not tell apart control
points that are nearer than that. Here a ray goes from cell to cell by the signs of edge functions,
as through projected triangles, and the length of its way through a cell is a quotient of products,
exact however thin the cell is.

Kernels: kernels/tets/pictures/view.cl, walk.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.tets.pictures.view import eye_cells, ray_entries, volume_of
from voxtool.vector import dot

if TYPE_CHECKING:
    from voxtool.tets.pictures.surfaces import Surfaces
    from voxtool.tets.pictures.transfer import LocalTransfer
    from voxtool.tets.pictures.view import DeviceVolume, ShownCells, Viewpoint
    from voxtool.tets.volume.volume import TetVolume

SOURCE = "tets/pictures/walk.cl"


def walk(
    volume: TetVolume,
    on_device: DeviceVolume,
    shown: ShownCells,
    view: Viewpoint,
    transfer: LocalTransfer,
    surfaces: Surfaces | None,
    max_entries: int,
) -> np.ndarray:
    """Return the picture, (H, W, 4) float32: premultiplied red, green, blue, and opacity.

    view : exact.

    Raises
    ------
    MemoryLimitError : the device has no memory for a frame, or rays enter the volume more than
        `max_entries` times.
    """
    device, rays = on_device.device, view.rays
    (width, height), right, down, way = rays.size, rays.right, rays.down, rays.direction
    corners = on_device.project_vertices(view)
    ends, entries = ray_entries(on_device, shown, view, corners, max_entries)
    pairs = (right, right), (down, down), (right, down), (right, way), (down, way), (way, way)
    options, more = {"LANES": 1, **view.options}, {}
    if volume.constant:
        options["CONSTANT"] = 1
    if surfaces is not None:
        options |= surfaces.options(volume)
        more = surfaces.arguments(device)
    with device.stage("ray walking"):
        picture = device.empty(4 * width * height, np.float32)
        device.kernel(SOURCE, "walk", **options)(
            64 * -(-width // 8) * -(-height // 8),
            **on_device.arguments,
            **view.arguments,
            **eye_cells(volume, shown, view),
            **more,
            rows=device.put(transfer.exact),
            count=len(transfer.points),
            corners=corners,
            kept=shown.flags,
            volumes=on_device.volumes(volume),
            per_volume=1 / volume_of(rays),
            squares=device.put(np.array([dot(a, b) for a, b in pairs])),
            ends=ends,
            entries=entries,
            picture=picture,
            local=64,
        )
        return picture.take().reshape(height, width, 4)
