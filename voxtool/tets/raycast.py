"""Ray casting of tetrahedral volumes: section 4 of the text.

Rays go from cell to cell. A ray leaves a cell by the nearest plane among those that it goes out by,
and the scalar is linear on the way; the transfer function's control points cut the way into pieces,
and each is integrated in closed form (Moreland and Angel 2004). What a viewpoint makes of a cell's
planes and gradient is worked out once a frame: then a step has no division.

Kernels: kernels/tets/view.cl, raycast.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import program
from voxtool.tets.view import cells_at, ray_entries, set_up_cells
from voxtool.tets.volume import BLOCK, ON_PLANE

if TYPE_CHECKING:
    from voxtool.tets.integrate import Integral
    from voxtool.tets.view import DeviceVolume, ShownCells, Viewpoint
    from voxtool.tets.volume import TetVolume

SOURCE = "tets/raycast.cl"
MAX_STILL = 1 << 12  # steps that a ray takes at one place before it is given up
SLOTS, MANY_SLOTS = 3, 7  # exit faces of a record: the eye is outside a tetrahedron, or not

HEADERS = {"tets/raycast.h": program.c_constants(MAX_STILL=MAX_STILL)}


def cast(
    volume: TetVolume,
    on_device: DeviceVolume,
    shown: ShownCells,
    view: Viewpoint,
    integral: Integral,
    max_entries: int,
) -> np.ndarray:
    """(H, W, 4) float32: red, green and blue, premultiplied, and alpha.

    Raises
    ------
    MemoryLimitError : the device has no memory for a frame, or rays enter the volume more than
        `max_entries` times.
    """
    device, eye = on_device.device, view.rays.origin
    inside = view.rays.perspective and bool((np.abs(eye) <= 1 + ON_PLANE).all())
    eye_cells = cells_at(volume, eye) if inside else np.zeros(0, np.int64)
    eye_cells = eye_cells[shown.kept[eye_cells // BLOCK]].astype(np.uint32)
    slots = MANY_SLOTS if inside or volume.layout == "hexahedra" else SLOTS
    records = set_up_cells(on_device, shown, view, slots)
    entries = ray_entries(on_device, shown, view, max_entries)
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
            ends=entries.ends,
            entries=entries.entries,
            eye_cells=device.put(eye_cells),
            eye_count=len(eye_cells),
            picture=picture,
            local=1 if lanes > 1 else 64,
        )
        return picture.take().reshape(height, width, 4)
