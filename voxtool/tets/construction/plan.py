"""The plan of the textures of a mesh of volume cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from voxtool.choices import MAX_TEXTURE_2D, MIN_TEXTURE_2D
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.job import Cost, Plan
from voxtool.tets.construction.merge import MAX_PAIRS
from voxtool.tets.volume.cells import PIECES
from voxtool.tets.volume.packing import rows_for, width_for

CELL_BYTES = {"raycast": 116, "projection": 104, "hexahedra": 186}  # of its textures, with vertices
WORK_BYTES = {"raycast": 300, "projection": 280, "hexahedra": 620}  # at most about: measured
POINT_BYTES = 150  # bytes of a point, while coincident ones are merged
PLANE_BYTES = {"raycast": 64, "projection": 48, "hexahedra": 96}  # bytes of a cell's planes


@dataclass(frozen=True)
class VolumePlan(Plan):
    """The plan of a volume.

    layout, merge_distance : as asked.
    cells : the mesh's, by kind; ignored : cells that are no volumes, by kind.
    points : the mesh's; constant : whether each cell has one scalar.
    max_pairs : pairs of points, compared for merging, beyond which the work is refused.
    max_texture : texels along an axis of a 2-D texture, beyond which it is refused.
    """

    facts = ("cells", "ignored", "points")
    predicted = ("cells: predicted_cells", "volume_bytes")

    layout: str
    merge_distance: float
    cells: dict[str, int]
    ignored: dict[str, int]
    points: int
    constant: bool
    max_pairs: int = MAX_PAIRS
    max_texture: int = MAX_TEXTURE_2D

    def __post_init__(self) -> None:
        if not MIN_TEXTURE_2D <= self.max_texture <= MAX_TEXTURE_2D:
            raise VoxtoolError(
                f"max texture {self.max_texture}: choose {MIN_TEXTURE_2D} to {MAX_TEXTURE_2D}"
            )

    @property
    def stages(self) -> list[str]:
        cells = "hexahedra" if self.layout == "hexahedra" else "tetrahedra"
        return [cells, "order", "neighbours", "planes", "gradients"]

    @property
    def floats(self) -> int:
        """Floats of a plane, and of a gradient."""
        return 3 if self.layout == "projection" else 4

    @property
    def reasons(self) -> dict[str, str]:
        out = {}
        if self.cells.keys() == {"tetra"}:
            out["splitting"] = "every cell is a tetrahedron"
        elif self.layout == "hexahedra":
            out["splitting"] = "hexahedra stay whole"
        if not self.merge_distance:
            out["merging by distance"] = "only points at the same position are merged"
        if self.constant:
            out["non-zero gradients"] = "each cell has one scalar"
        if self.layout == "projection":
            out["offsets of planes and scalar terms"] = "anchors serve, as in table 4 of [TetVol]"
        else:
            out["anchors"] = "planes have offsets, as in table 5 of [TetVol]"
        return out

    @property
    def predicted_cells(self) -> int:
        """The largest possible number of cells."""
        pieces = dict.fromkeys(PIECES, 1) if self.layout == "hexahedra" else PIECES
        return sum(pieces[kind] * count for kind, count in self.cells.items())

    @property
    def volume_bytes(self) -> int:
        """The approximate largest size of the textures in bytes."""
        return CELL_BYTES[self.layout] * self.predicted_cells

    @property
    def cost(self) -> Cost:
        """The approximate peak of memory, the textures included."""
        cells = self.predicted_cells
        return Cost(
            device=WORK_BYTES[self.layout] * cells + POINT_BYTES * self.points,
            largest=PLANE_BYTES[self.layout] * cells,
        )

    def as_dict(self) -> dict[str, Any]:
        asked = {"layout": self.layout, "merge_distance": self.merge_distance}
        return {**asked, **super().as_dict()}

    def rows(self) -> list[tuple[str, str]]:
        read = ", ".join(f"{count:,} {kind}" for kind, count in self.cells.items())
        return [
            ("volume", f"layout {self.layout}, merge distance {self.merge_distance:g}"),
            ("mesh", f"{read}, {self.points:,} points"),
            ("cells", f"at most {self.predicted_cells:,}, {human(self.volume_bytes)}"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the work needs more bytes than these, in total or in one
        buffer, or wider textures than allowed; the message says how many cells fit."""
        most = max(self.predicted_cells, self.points)
        if max(width_for(most), rows_for(most)) > self.max_texture:
            raise MemoryLimitError(
                f"{self.predicted_cells:,} cells with {self.points:,} points do not fit textures "
                f"of {self.max_texture} x {self.max_texture} texels: cut the mesh into parts, or "
                "see --max-texture"
            )
        cost = self.cost
        if shortage := cost.shortage(max_memory, max_allocation):
            share = min(max_memory / cost.device, max_allocation / cost.largest)
            raise MemoryLimitError(
                f"{self.predicted_cells:,} cells {shortage}: about "
                f"{int(share * self.predicted_cells):,} fit; cut the mesh into parts, or see "
                "--max-memory"
            )
