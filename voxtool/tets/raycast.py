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
from voxtool.tets.view import ON_PLANE, cells_at
from voxtool.tets.volume import BLOCK

if TYPE_CHECKING:
    from voxtool.tets.integrate import Integral
    from voxtool.tets.view import Viewpoint, VisibleCells

SOURCE = "tets/raycast.cl"
MOST_STILL = 1 << 12  # steps that a ray takes at one place before it is given up
SLOTS, MANY_SLOTS = 3, 7  # ways out that a record holds: the eye is outside a tetrahedron, or not

HEADERS = {"tets/raycast.h": program.c_constants(MOST_STILL=MOST_STILL)}


def cast(visible: VisibleCells, view: Viewpoint, integral: Integral) -> np.ndarray:
    """(H, W, 4) float32: red, green and blue, premultiplied, and alpha.

    Raises
    ------
    MemoryLimitError : the device has no memory for a frame.
    """
    device, volume = visible.textures.device, visible.textures.volume
    eye = view.rays.origin
    inside = view.rays.perspective and bool((np.abs(eye) <= 1 + ON_PLANE).all())
    eye_cells = cells_at(volume, eye) if inside else np.zeros(0, np.int64)
    eye_cells = eye_cells[visible.kept[eye_cells // BLOCK]].astype(np.uint32)
    slots = MANY_SLOTS if inside or volume.layout == "hexahedra" else SLOTS
    records = visible.look(view, slots)
    entries = visible.enter(view)
    width, height = view.rays.size
    tiles, lanes = -(-width // 4) * -(-height // 4), integral.lanes
    with device.stage("ray casting"):
        picture = device.empty(4 * width * height, np.float32)
        kernel = device.kernel(SOURCE, "cast", SLOTS=slots, **integral.options, **view.options)
        kernel(
            16 * tiles // lanes,
            records,
            entries.ends,
            entries.entries,
            *integral.arguments,
            device.put(eye_cells),
            np.uint32(len(eye_cells)),
            *view.arguments(),
            np.int32(width),
            np.int32(height),
            picture,
            local=1 if lanes > 1 else 64,
        )
        return picture.take().reshape(height, width, 4)
