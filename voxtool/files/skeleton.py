"""The elements of an XML document without their text, for validation against octree.dtd."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from voxtool.errors import FileError

DTD = Path(__file__).with_name("octree.dtd")
MAX_ELEMENTS = 64  # that are no repetition: 15 levels and a few more


class Skeleton:
    """A document without its text, in which a run of equal leaves is one element."""

    def __init__(self) -> None:
        self.root: Any = None
        self.open: list[Any] = []
        self.count = 0

    def start(self, name: str, attributes: list[str]) -> None:
        """Open an element with attributes of these names."""
        from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

        self.count += 1
        if self.count > MAX_ELEMENTS:
            raise FileError("more elements than an octree has")
        empty = dict.fromkeys(attributes, "")
        if self.root is None:
            element = self.root = etree.Element(name, empty)
        else:
            element = etree.SubElement(self.open[-1], name, empty)
        self.open.append(element)

    def end(self) -> None:
        """Close the element that was opened last."""
        self.open.pop()

    def validate(self) -> None:
        """Validate the document against the packaged DTD.

        Raises
        ------
        FileError : the first violation.
        """
        from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

        with DTD.open("rb") as file:
            dtd = etree.DTD(file)
        if self.root is None or not dtd.validate(self.root):
            raise FileError(f"not by octree.dtd: {dtd.error_log[0].message[:160]}")
