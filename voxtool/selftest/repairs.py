"""Repair of a soup of triangles, small and far from the origin, and a drained hollow of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.repairing.job import grid_for, plan_repair
from voxtool.selftest.case import case
from voxtool.selftest.shapes import ball
from voxtool.vector import length

if TYPE_CHECKING:
    from voxtool.opencl import Device

CENTRE = np.array([1e3, -2e3, 3e3])
RADIUS = 1e-4
EVERY = 4  # one face in EVERY is reversed, the next one is missing


@case("repair", "a ball of 1e-4 at (1e3, -2e3, 3e3), faces missing and reversed: a closed ball",
      "faults", 0)  # fmt: skip
def soup(device: Device, full: bool) -> int:
    """Repair a ball, solid and then hollow with two drains. The result is one closed shell, free of
    self-intersections, within a voxel of the ball: without handles, and then with one."""
    vertices, faces = ball(4 if full else 3)
    corners = (CENTRE + RADIUS * vertices)[np.delete(faces, np.s_[1 :: EVERY * 8], axis=0)]
    corners[::EVERY] = corners[::EVERY, ::-1]
    mesh = mesh_from_arrays(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    grid, wrong = grid_for(mesh, 96 if full else 40), 0
    drains = [(*(CENTRE + side * np.array([0, 0, RADIUS])), 0.3 * RADIUS) for side in (1, -1)]
    for genus, request in ((0, {}), (1, {"shell": 0.3 * RADIUS, "drains": drains})):
        found = plan_repair(mesh, grid, device=device, **request).run()
        wrong += found.faults != ""
        wrong += (found.checked["shells"], found.checked["genus"]) != (1, genus)
        far = length(found.vertices - CENTRE) - RADIUS
        wrong += int(np.count_nonzero(far > 0.5 * grid.pitch[0]))
        wrong += not genus and int(np.count_nonzero(far < -2 * grid.pitch[0]))
    return int(wrong)
