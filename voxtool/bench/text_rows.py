"""The rows of `voxtool bench texts`: a figure or a statement of a text, and ours."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from voxtool.bench.voccel_tables import HARDWARE as VOCCEL

UNKNOWN = "hardware not given in the chapter"
HARDWARE = {"[voCCeL]": VOCCEL, "[ADF]": UNKNOWN, "[TetVol]": UNKNOWN}
NO_COUNTERPART = "no counterpart in the text"
MISPRINT = "misprint, not compared"


@dataclass(frozen=True)
class Row:
    """A figure of a text, and ours.

    Attributes
    ----------
    table : key of the text, and its table or section.
    model : what ours is measured on.
    what, setting, unit : what is measured; unit "" for a statement that ours is not a number of.
    text : the figure as printed; None if there is none.
    statement : what the text says instead of, or of, a figure; with the name of its model.
    voxtool : ours; None if it is not compared.
    ours : what ours is.
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
        """The key of the text in docs/references.md."""
        return self.table.split()[0]

    def as_dict(self) -> dict[str, Any]:
        """JSON types: the fields, and the reference and hardware of the text."""
        return {**asdict(self), "reference": self.key, "hardware": HARDWARE[self.key]}

    def cells(self) -> tuple[str, ...]:
        """The words of the columns HEAD."""
        unit = f" {self.unit}" if self.unit else ""
        figures = [
            "-" if x is None else f"{x:.4g}{unit}" if abs(x) < 1000 else f"{x:,.0f}{unit}"
            for x in (self.text, self.voxtool)
        ]
        return (self.what, self.setting, *figures, self.statement, self.ours, self.note)


HEAD = ("what", "setting", "text", "voxtool", "the text says", "ours is", "note")


def by_table(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """The rows by table and model, in their order."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.table, row.model), []).append(row)
    return found
