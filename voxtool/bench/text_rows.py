"""The rows of `voxtool bench texts`: a figure or a statement of [voCCeL], [ADF] or [TetVol], and
that of voxtool."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from voxtool.bench.voccel_tables import HARDWARE as VOCCEL

UNKNOWN = "hardware not given in the chapter"
HARDWARE = {"[voCCeL]": VOCCEL, "[ADF]": UNKNOWN, "[TetVol]": UNKNOWN}
NO_COUNTERPART = "no counterpart there"
MISPRINT = "misprint, not compared"


@dataclass(frozen=True)
class Row:
    """A figure of [voCCeL], [ADF] or [TetVol], and that of voxtool.

    Attributes
    ----------
    table : key of the source, and its table or section.
    model : what voxtool's figure is measured on.
    what, setting, unit : what is measured; unit "" for a statement without a number.
    text : the figure as printed; None if there is none.
    statement : the source's words, instead of or beside a figure; with the name of its model.
    voxtool : voxtool's figure; None if it is not compared.
    ours : what voxtool's figure is.
    note : why the figures are not to be compared; or "".
    """

    table: str
    model: str
    what: str
    setting: str
    unit: str
    text: float | None
    statement: str
    voxtool: float | None
    ours: str
    note: str = ""

    @property
    def key(self) -> str:
        """The key of the source in docs/references.md."""
        return self.table.split()[0]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, and the reference and hardware of the source, in JSON types."""
        return {**asdict(self), "reference": self.key, "hardware": HARDWARE[self.key]}

    def cells(self) -> tuple[str, ...]:
        """Return the words of the columns HEAD."""
        unit = f" {self.unit}" if self.unit else ""
        figures = [
            "-" if x is None else f"{x:.4g}{unit}" if abs(x) < 1000 else f"{x:,.0f}{unit}"
            for x in (self.text, self.voxtool)
        ]
        return (self.what, self.setting, *figures, self.statement, self.ours, self.note)


HEAD = ("what", "setting", "printed", "voxtool", "statement", "of voxtool", "note")


def by_table(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the rows by table and model, in their order."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.table, row.model), []).append(row)
    return found
