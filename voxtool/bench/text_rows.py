"""The rows of `voxtool bench texts`: a figure or a statement of [voCCeL], [ADF] or [TetVol], and
that of voxtool."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from voxtool.bench.voccel_tables import HARDWARE as VOCCEL

UNKNOWN = "hardware not given in the chapter"
HARDWARE = {"[voCCeL]": VOCCEL, "[ADF]": UNKNOWN, "[TetVol]": UNKNOWN}
SOURCES = {  # docs/references.md has more
    "[voCCeL]": "Ján Brída: voCCeL, master's thesis in Slovak, supervised by Michal Španěl, 2017",
    "[ADF]": "A chapter of a thesis in Portuguese: Representação e Reconstrução de ADFs em GPU",
    "[TetVol]": "A chapter of a thesis in Portuguese on volume rendering: Modificações realizadas",
}
TITLES = {  # the tables and sections, in the order in which they are shown
    "[voCCeL] table 7.1": "stages of voxelization, and the size of the octree",
    "[voCCeL] table 7.2": "total times of voxelization",
    "[voCCeL] table 7.3": "marching cubes on coverages, and how many cubes they visit",
    "[voCCeL] figure 7.1": "every box of a bounding box is tested, or depth intervals",
    "[voCCeL] figure 7.2": "every cube of the grid is visited, or those at nodes",
    "[voCCeL] section 7.1": "Morton codes by table, tiles, and propagation by levels",
    "[voCCeL] section 5.1": "the tables of Morton codes",
    "[voCCeL] algorithm 2": "how the brick of a voxel is found",
    "[voCCeL] section 4.1": "histogram pyramids, or a scan",
    "[ADF] section 3.1": "samples that siblings share, or each cell has, or each vertex once",
    "[ADF] section 3.2": "leaves that are implicit",
    "[ADF] section 3.4": "the perfect hash, with w and without, and a hash with probes",
    "[ADF] section 3.5": "searches for a leaf",
    "[TetVol] table 4": "textures for cell projection",
    "[TetVol] table 5": "textures for ray casting",
    "[TetVol] section 4.1": "hexahedra that stay whole, or are split",
    "[TetVol] section 4.2": "exact segments, or pre-integration",
    "[TetVol] figure 28": "a table of the isosurfaces that a segment crosses",
}
MISPRINT = "misprint, not compared"


@dataclass(frozen=True)
class Row:
    """A figure of [voCCeL], [ADF] or [TetVol], and that of voxtool.

    Attributes
    ----------
    table : key of the source, and its table or section: of TITLES.
    model : what voxtool's figure is measured on.
    what : what is measured.
    setting : dim, level or size of picture; "" if there is none.
    unit : "" for a statement without a number.
    voxtool : voxtool's figure; None if there is none.
    ours : what voxtool's figure is.
    way : how voxtool does it, where ways are compared; "" elsewhere.
    text : the figure as printed; None if there is none.
    text_model : the source's model, if it names one.
    statement : the source's words, translated and shortened, instead of or beside a figure.
    note : why the figures are not to be compared; or "".
    spread : the slowest run minus the fastest, over the median, of voxtool's figure; or None.
    """

    table: str
    model: str
    what: str
    setting: str
    unit: str
    voxtool: float | None
    ours: str
    way: str = ""
    text: float | None = None
    text_model: str = ""
    statement: str = ""
    note: str = ""
    spread: float | None = None

    @property
    def key(self) -> str:
        """The key of the source in docs/references.md."""
        return self.table.split()[0]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, and the reference and hardware of the source, in JSON types."""
        return {**asdict(self), "reference": self.key, "hardware": HARDWARE[self.key]}
