"""Ray casting of tetrahedral volumes [TetVol, section 4], [Weiler 2003].

A ray goes from cell to cell. It leaves a cell by the nearest of the planes that face away from it.
In the cell the scalar is linear; the control points of the transfer function cut the segment into
pieces, each integrated in closed form [Moreland 2004]. The planes and the gradient of each cell are
transformed to the viewpoint once a picture, so a step has no division.

Kernels: kernels/tets/pictures/view.cl, raycast.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import program
from voxtool.tets.pictures.view import eye_cells, ray_entries, set_up_cells

if TYPE_CHECKING:
    from voxtool.tets.pictures.integrate import Integral
    from voxtool.tets.pictures.view import DeviceVolume, ShownCells, Viewpoint
    from voxtool.tets.volume.volume import TetVolume

SOURCE = "tets/pictures/raycast.cl"
MAX_STILL = 1 << 12  # steps without progress after which a ray ends
SLOTS, MANY_SLOTS = 3, 7  # exit faces of a record: eye outside the volume, or inside

HEADERS = {"tets/pictures/raycast.h": program.c_constants(MAX_STILL=MAX_STILL)}


def cast(
    volume: TetVolume,
    on_device: DeviceVolume,
    shown: ShownCells,
    view: Viewpoint,
    integral: Integral,
    max_entries: int,
) -> np.ndarray:
    """Return the picture, (H, W, 4) float32: premultiplied red, green, blue, and opacity.

    Raises
    ------
    MemoryLimitError : the device has no memory for a frame, or rays enter the volume more than
        `max_entries` times.
    """
    device = on_device.device
    slots = MANY_SLOTS if view.inside or volume.layout == "hexahedra" else SLOTS
    records = set_up_cells(on_device, shown, view, slots)
    projected = on_device.project_vertices(view)
    ends, entries = ray_entries(on_device, shown, view, projected, max_entries)
    width, height = view.rays.size
    tiles, lanes = -(-width // 4) * -(-height // 4), integral.lanes
    with device.stage("ray casting"):
        picture = device.empty(4 * width * height, np.float32)
        kernel = device.kernel(SOURCE, "cast", SLOTS=slots, **integral.options, **view.options)
        kernel(
            16 * tiles // lanes,
            **integral.arguments,
            **view.arguments,
            records=records,
            ends=ends,
            entries=entries,
            **eye_cells(volume, shown, view),
            picture=picture,
            local=1 if lanes > 1 else 64,
        )
        return picture.take().reshape(height, width, 4)
