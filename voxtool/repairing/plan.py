"""The plan of a repair, from the plan of its voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from voxtool.errors import MemoryLimitError, human
from voxtool.job import Cost, Plan
from voxtool.spatial.bvh import tree_bytes
from voxtool.spatial.distance import POINTS_AT_ONCE, rounded_bytes
from voxtool.svo.octree.layout import BRICK_BYTES
from voxtool.svo.surface.plan import EDGE_BYTES, TILE_BYTES, untangling_bytes

if TYPE_CHECKING:
    from voxtool.svo.voxelization.plan import VoxelizePlan

STYLE = "surface-nets"
NET_STAGES = (
    "tiles",
    "samples",
    "classify",
    "vertices",
    "relax",
    "quads",
    "triangles",
    "read back",
)
POINT_BYTES = 104  # bytes of a point whose nearest one is found, on the device
VERTEX_HOST_BYTES = 1200  # bytes of a vertex of the surface and its two faces, at peak


@dataclass(frozen=True)
class RepairPlan(Plan):
    """The decisions of a repair."""

    facts = (
        "pitch", "offset", "shell", "thicken", "simplify", "drains", "keep_components: keep",
    )  # fmt: skip
    predicted = ("vertices", "triangles: triangles_made")
    costs = ("device", "host")

    voxels: VoxelizePlan
    triangles: int  # of the mesh
    pitch: float
    keep: int | None  # components of the voxels that stay; None: all
    # world units, 0 for none: outward, the wall of a hollow solid, that of a thick surface
    offset: float
    shell: float
    thicken: float
    drains: tuple[tuple[float, ...], ...]  # x, y, z and radius
    simplify: float = 0.0  # largest distance in world units, 0 for none

    @property
    def stages(self) -> list[str]:
        components = ["components", "build"] if self.keep is not None else []
        plate = ["plate"] if self.thicken else []
        fit = ["tree", "fit", "self-intersections", "distances"]
        shape = {"offset": self.offset, "cavities": self.shell, "drains": self.drains}
        shape["simplify"] = self.simplify
        shaped = [name for name, wanted in shape.items() if wanted]
        return [*self.voxels.stages, *plate, *components, *NET_STAGES, *fit, *shaped, "check"]

    @property
    def reasons(self) -> dict[str, str]:
        moved = self.offset or self.shell or self.thicken
        return {
            **self.voxels.left_out,
            "components": "all of them are kept" if self.keep is None else "",
            "sets of voxels by distance": "" if moved else "the surface is that of the mesh",
            "simplification": "" if self.simplify else "every triangle is kept",
        }

    @property
    def vertices(self) -> int:
        """Predicted vertices of the result; it has twice as many faces. A surface crosses as many
        links between the centres of voxels as its projections along the axes have pixels, and a
        quad belongs to each."""
        sides = 2 if self.shell or self.thicken else 1
        return max(sides * round(sum(self.voxels.survey.areas)), 1)

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the stage that needs most."""
        n, voxels = self.vertices, self.voxels.cost
        net = BRICK_BYTES * self.voxels.bricks + 2 * TILE_BYTES * self.voxels.bricks
        net += EDGE_BYTES[STYLE] * n
        fit = tree_bytes(self.triangles) + rounded_bytes(self.triangles)
        fit += POINT_BYTES * min(n, POINTS_AT_ONCE)
        return Cost(
            device=max(voxels.device, net, fit, untangling_bytes(n)),
            host=voxels.host + VERTEX_HOST_BYTES * n,
            largest=max(voxels.largest, 240 * n),
        )

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError, which names a dim that fits, if the repair needs more bytes than
        these."""
        self.voxels.refuse_beyond(max_memory, max_allocation)
        if shortage := self.cost.shortage(max_memory, max_allocation):
            share = min(max_memory / self.cost.device, max_allocation / self.cost.largest)
            fits = int(max(self.voxels.shape) * math.sqrt(share))
            raise MemoryLimitError(f"the repair {shortage}: choose --dim {fits} (see --max-memory)")

    @property
    def triangles_made(self) -> int:
        """Predicted triangles of the result."""
        return 2 * self.vertices

    def as_dict(self) -> dict[str, Any]:
        return {**self.voxels.as_dict(), **super().as_dict()}

    def rows(self) -> list[tuple[str, str]]:
        return [
            *self.voxels.rows(),
            ("surface", f"about {self.vertices:,} vertices, {self.triangles_made:,} triangles"),
            ("host", f"about {human(self.cost.host)}"),
        ]
