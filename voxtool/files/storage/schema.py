"""File formats as data.

A `Schema` lists the attributes and the datasets of a format. Writing, reading, checking and the
tables of docs/formats.md follow from it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple, NoReturn

import numpy as np

from voxtool.arrays import Blocks, Slices
from voxtool.errors import FileError
from voxtool.version import __version__

JSON_LIMIT = 60_000  # bytes; HDF5 ends attributes at 64 KiB
MAX_DEPTH = 16  # of nested JSON


class Rule(NamedTuple):
    """A condition on a value, and the end of the message for a value that breaks it."""

    holds: Callable[[Any], object]  # true or false
    otherwise: str  # "{value}" stands for the value


FINITE = Rule(lambda numbers: all(map(math.isfinite, numbers)), "{value} is not finite")
POSITIVE = Rule(lambda x: 0 < x < math.inf, "is {value}: a positive number is expected")
FROM_ZERO = Rule(lambda x: 0 <= x < math.inf, "is {value}: a finite number from 0 is expected")
SHA256 = Rule(lambda text: re.fullmatch(r"([0-9a-f]{64})?", text), "is not 64 hexadecimal digits")


@dataclass(frozen=True)
class Attribute:
    """One attribute of a format."""

    name: str
    kind: type  # in Python: int, float, str, bool (stored as 0 or 1), dict (stored as JSON)
    meaning: str  # one phrase for docs/formats.md
    size: int = 1  # the count of numbers; of text and JSON, the most bytes of UTF-8
    at: str = ""  # path of the value in the content, such as "hash.m"; by default the name
    choices: tuple[Any, ...] = ()  # the allowed values; empty: any
    rule: Rule | None = None  # what else the value must satisfy
    since: str = ""  # the minor version that a file needs for it; the others leave it out

    @property
    def stored(self) -> type:
        """The type in the file: int, float or str."""
        return {bool: int, dict: str}.get(self.kind, self.kind)

    def encode(self, content: Any) -> Any:
        """Return the value of some content, as it is stored."""
        value = attrgetter(self.at or self.name)(content)
        return _json_text(self.name, value) if self.kind is dict else _cast(self.stored, value)

    def decode(self, stored: Any) -> Any:
        """Return the value in Python of a stored value that has been checked."""
        return _parse_json(self.name, stored) if self.kind is dict else _cast(self.kind, stored)

    def check(self, stored: Any) -> None:
        """Raise FileError if a stored value of the right type and count is out of range, too long,
        or cannot be printed."""
        if self.stored is str:
            self._check_text(stored)
        choices = (0, 1) if self.kind is bool else self.choices
        if choices:
            expect(self.name, stored, choices)
        if self.rule and not self.rule.holds(stored):
            raise FileError(f"attribute {self.name} {self.rule.otherwise.format(value=stored)}")

    def _check_text(self, text: str) -> None:
        try:
            size = len(text.encode())
        except UnicodeEncodeError:
            raise FileError(f"attribute {self.name} is not Unicode text") from None
        if size > self.size:
            raise FileError(f"attribute {self.name} has {size} bytes: at most {self.size} fit")
        if self.kind is not dict and not text.isprintable():
            raise FileError(f"attribute {self.name} has characters that cannot be printed")


FORMAT = Attribute("format", str, "`{}`", 64)
FORMAT_VERSION = Attribute("format_version", str, "`{}`", 16)
CREATOR = Attribute("creator", str, "program and version; no part of the content", 128)
UNITS = Attribute("units", str, "name of the world unit, or empty", 64)
SCALED = Rule(
    lambda numbers: len(numbers) == 4 and all(map(math.isfinite, numbers)) and numbers[0] > 0,
    "is {value}: a scale above 0 and three offsets are expected, all finite",
)
SOURCE = Attribute(
    "source_sha256", str, "SHA-256 of the source file in lower-case hex, or empty", 64, rule=SHA256
)
PLAN = Attribute("plan", dict, "what the plan said of the scene", JSON_LIMIT)


def transform_since(version: str) -> Attribute:
    """Return the attribute of the transform of a normalized mesh, which only files of this version
    have."""
    about = (
        "of a normalized mesh, scale and offset x, y, z: world = original · scale + offset; files "
        f"with it are `{version}`, others `{version[0]}.0`"
    )
    return Attribute("transform", float, about, 4, rule=SCALED, since=version)


Sizes = Mapping[str, Any]  # the stored attributes, and the sides that earlier datasets have named
Side = int | str | tuple[int, ...] | Callable[[Sizes], int]


@dataclass(frozen=True)
class Dataset:
    """One dataset of a format.

    Attributes
    ----------
    name : in the file.
    dtype : type of the numbers, such as "<f4", or a function of the sizes.
    shape : for each side a number, the numbers that are allowed, the name of a size, or a function
        of the sizes. A name that no attribute and no dataset before this one has is free, and
        names the side from here on.
    at : path of the array in the content; by default the name.
    rows : structured dtype of a row in Python, where it has one.
    pack : the stored array of the content's, or its Blocks, where they differ; the schema's
        `build` undoes it.
    needed : whether a file has it, from the sizes and from whether it is there.
    """

    name: str
    dtype: str | Callable[[Sizes], str]
    shape: tuple[Side, ...]
    at: str = ""
    rows: np.dtype | None = None
    pack: Callable[[np.ndarray], np.ndarray | Blocks] | None = None
    needed: Callable[[Sizes, bool], bool] = lambda sizes, there: True

    def type_for(self, sizes: Sizes) -> np.dtype:
        """Return the type of the numbers, given the sizes."""
        return np.dtype(self.dtype(sizes) if callable(self.dtype) else self.dtype)

    def shape_for(self, sizes: Sizes) -> tuple[Any, ...]:
        """Return the allowed number or numbers of each side; None where a side is free."""
        return tuple(
            sizes.get(side) if isinstance(side, str) else side(sizes) if callable(side) else side
            for side in self.shape
        )

    def encode(self, content: Any, sizes: Sizes) -> np.ndarray | Blocks | None:
        """Return the array of some content, as it is stored; None where there is none."""
        array = attrgetter(self.at or self.name)(content)
        if array is None:
            return None
        if self.pack is not None:
            array = self.pack(array)
        if isinstance(array, Blocks):
            blocks = (self._stored(block, sizes) for block in array.blocks)
            row = array.row if self.rows is None else (len(self.rows.names or ()),)
            return Blocks(array.size, self.type_for(sizes), blocks, row)
        return self._stored(array, sizes)

    def _stored(self, array: np.ndarray, sizes: Sizes) -> np.ndarray:
        """Return an array as it is stored."""
        if self.rows is not None:
            array = np.ascontiguousarray(array, self.rows).view(self.type_for(sizes))
            return array.reshape(-1, len(self.rows.names or ()))
        return np.ascontiguousarray(array, self.type_for(sizes))

    def decode(self, array: Any) -> Any:
        """Return the array, or Slices, in Python of a stored one."""
        if isinstance(array, Slices):
            kept = (array.dtype, array.row) if self.rows is None else (self.rows, ())
            return Slices(
                array.size, lambda start, stop: self.decode(array.read(start, stop)), *kept
            )
        return array if self.rows is None else array.view(self.rows).reshape(-1)


@dataclass(frozen=True)
class Schema:
    """A major version of a file format."""

    format: str
    version: str  # major.minor, as it is written
    what: str  # the content in words
    hint: str  # how to make a file of it
    own: tuple[Attribute, ...]  # beside the format's name and version and the creator
    datasets: tuple[Dataset, ...]  # in the order in which they are stored
    build: Callable[[dict[str, Any], dict[str, Any]], Any]  # content of attributes, arrays
    agree: Callable[[Mapping[str, Any]], object] | None = None  # checks attributes together
    sliced: bool = False  # whether `build` takes Slices for arrays
    older: tuple[Schema, ...] = ()  # major versions that are read, but not written
    newer: tuple[Schema, ...] = ()  # those of other content of the format

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        """All attributes but the format's name, in the order in which they are stored."""
        return (FORMAT_VERSION, CREATOR, *self.own)

    def held(self, names: Container[str]) -> list[Attribute]:
        """Return the attributes of a file with these names, optional ones only if it has them."""
        return [a for a in self.attributes if a.name in names or not a.since]

    def encode(self, content: Any) -> dict[str, Any]:
        """Return the stored attributes of some content; FileError names one that is out of
        range."""
        own = {attribute: attribute.encode(content) for attribute in self.own}
        own = {attribute: value for attribute, value in own.items() if value or not attribute.since}
        version = max((attribute.since for attribute in own), default="") or self.version
        stored = {"format_version": version, "creator": f"voxtool {__version__}"}
        stored |= {attribute.name: value for attribute, value in own.items()}
        self.check(stored)
        return stored

    def check(self, stored: Mapping[str, Any]) -> None:
        """Check stored attributes of the right types and counts, of this major version; FileError
        names the attribute."""
        for attribute in self.held(stored):
            attribute.check(stored[attribute.name])
        if self.agree:
            self.agree(stored)

    def decode(self, stored: Mapping[str, Any], arrays: Mapping[str, Any]) -> Any:
        """Return the validated content of checked attributes and arrays; FileError if it is not
        sound."""
        values = {
            attribute.name: attribute.decode(stored[attribute.name])
            for attribute in self.held(stored)
            if attribute in self.own
        }
        found = {d.name: d.decode(arrays[d.name]) for d in self.datasets if d.name in arrays}
        content = self.build(values, found)
        content.validate()
        return content

    @property
    def major(self) -> int:
        """The major number of the version."""
        return int(self.version.split(".")[0])

    def of_version(self, version: str) -> Schema:
        """Return the schema with the major number of a version; FileError if there is none."""
        found = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", version)
        if found is None:
            raise FileError(f"format_version {version[:16]!r} is no version such as {self.version}")
        theirs = int(found[1])
        for schema in (self, *self.older, *self.newer):
            if schema.major == theirs:
                return schema
        known = max((self, *self.newer), key=lambda schema: schema.major)
        newer = theirs > known.major
        age, hint = ("newer", "update voxtool") if newer else ("older", "write it anew")
        raise FileError(
            f"written in format {version}, {age} than the {known.version} that voxtool "
            f"{__version__} reads: {hint}"
        )

    def is_newer(self, version: str) -> bool:
        """Return True if an accepted version has a newer minor number, so that it may hold more."""
        known = (self.version, *(a.since for a in self.own if a.since))
        return int(version.split(".")[1]) > max(int(v.split(".")[1]) for v in known)


def without(values: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Return the values of all names but these."""
    return {name: value for name, value in values.items() if name not in names}


def expect(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Raise FileError unless an attribute is one of the values that it may have."""
    if value not in allowed:
        known = " or ".join(map(str, allowed))
        raise FileError(f"attribute {name} is {str(value)[:40]!r} where {known} is expected")


def _cast(kind: type, value: Any) -> Any:
    several = isinstance(value, tuple | list | np.ndarray)
    return tuple(map(kind, value)) if several else kind(value)


# --- JSON ----------------------------------------------------------------------------------------


def _json_text(name: str, value: dict[str, Any]) -> str:
    """Return a dict of JSON types as text."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise FileError(f"attribute {name} cannot be JSON: {str(error)[:80]}") from None


def _parse_json(name: str, text: str) -> dict[str, Any]:
    """Return a JSON object as a dict; finite numbers, real characters and bounded nesting only."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    try:
        value = json.loads(text, parse_constant=refuse)
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, RecursionError) as error:
        raise FileError(f"attribute {name} is not JSON: {str(error)[:80]}") from None
    if not isinstance(value, dict):
        raise FileError(f"attribute {name} is not a JSON object")
    level: list[Any] = [value]  # no recursion: the input may be hostile
    for _ in range(MAX_DEPTH):
        inner = [v.values() if isinstance(v, dict) else v for v in level]
        level = [v for values in inner for v in values if isinstance(v, dict | list)]
    if level:
        raise FileError(f"attribute {name} is nested deeper than {MAX_DEPTH}")
    return value
