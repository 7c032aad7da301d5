"""3MF (3D Manufacturing Format, core specification 1.3): a zip archive of XML models.

A model is read as a stream. Each object that the model builds is placed by the transforms of its
build item and its components, of other parts of the archive too (production extension). Base
materials and groups of colours are read; a triangle whose corners differ has the first one's.
"""

from __future__ import annotations

import io
import re
import zipfile
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np

from voxtool.errors import FileError, MeshError, one_line, printable
from voxtool.files.meshes.placement import (
    DEEPEST,
    Part,
    Read,
    check_placed,
    look_of,
    merged,
    named,
    product,
)
from voxtool.files.storage.text_numbers import real, whole
from voxtool.files.storage.unpacked import open_entry, open_zip
from voxtool.mesh.appearance import Material
from voxtool.mesh.srgb import to_linear

RELATIONS = "_rels/.rels"
RELATION = "http://schemas.openxmlformats.org/package/2006/relationships Relationship"
ROOT_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
MATERIALS = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
UNDERSTOOD = (CORE, PRODUCTION, MATERIALS)  # extensions that a model may require
UNITS = {
    "micron": "um",
    "millimeter": "mm",
    "centimeter": "cm",
    "inch": "in",
    "foot": "ft",
    "meter": "m",
}
COLOUR = re.compile(r"#[0-9A-Fa-f]{6}(?:[0-9A-Fa-f]{2})?")
CHUNK = 1 << 16  # bytes fed to the parser at once
MOST_TOKEN = 1 << 20  # bytes of one tag
MOST_OBJECTS = 1 << 16  # of a model; its items and components together
EYE = np.eye(4)
Key = tuple[str, str]  # the part of the archive, and the object's id in it


class Use(NamedTuple):
    """An object where a build item or a component puts it."""

    key: Key
    matrix: np.ndarray  # (4, 4)


@dataclass
class Object:
    """A mesh, or the components that an object consists of."""

    points: array[float] = field(default_factory=lambda: array("d"))  # x, y, z of each vertex
    corners: array[int] = field(default_factory=lambda: array("q"))  # three a triangle
    components: list[Use] = field(default_factory=list)
    name: str = ""
    property: tuple[str, int] | None = None  # the group and the index that its triangles have
    # Triangles with properties: the triangle, and the place of its group and index.
    marks: dict[tuple[str, int], int] = field(default_factory=dict)
    marked: array[int] = field(default_factory=lambda: array("q"))  # a place, or -1, a triangle


def parse(name: str, data: bytes, limit: int, max_memory: int | None, keep: Sequence[str]) -> Read:
    """Return all that a 3MF builds.

    name : the file's, for messages; limit : bytes that its parts may unpack to; max_memory :
    bytes that the placed meshes may take.
    """
    try:
        with open_zip(io.BytesIO(data)) as archive:
            return _Package(name, archive, limit, keep).meshes(max_memory)
    except (FileError, OSError, RuntimeError, ValueError) as error:
        raise MeshError(
            f"{name}: not readable as 3MF: {one_line(error)}: it may be truncated or damaged, "
            "export it again"
        ) from None


def _name(text: str) -> str:
    """Return the beginning of a name in the file, for messages."""
    return printable(text)[:80]


class _Package:
    """The parts of an archive that have been read."""

    def __init__(
        self, name: str, archive: zipfile.ZipFile, limit: int, keep: Sequence[str]
    ) -> None:
        self.name, self.archive, self.left, self.limit = name, archive, limit, limit
        self.keep, self.look = keep, "appearance" in keep
        self.materials: list[Material] = []
        self.numbers: dict[tuple[str, str, int], int] = {}  # of materials: part, group, index
        self.parts: list[str] = []
        self.items: list[str] = []
        self.models: dict[str, _Model] = {}
        self.sizes: dict[Key, int] = {}

    def meshes(self, max_memory: int | None) -> Read:
        relations = _Relations()
        self.feed(RELATIONS, relations.parser)
        if not relations.target:
            raise MeshError(f"{self.name}: no 3MF: its {RELATIONS} names no 3D model")
        root = self.model(relations.target)
        if not root.build:
            raise MeshError(
                f"{self.name}: its build names no object, so nothing is placed: export it again"
            )
        items = sum(self.size(use.key) for use in root.build)
        check_placed(self.name, items, self.limit - self.left, max_memory, self.look)
        placed = merged(self.name, self.built(root))
        parts = {}
        if "parts" in self.keep and len(placed.faces):
            parts = {
                "part": named(placed.labels["part"], self.parts),
                "object": named(placed.labels["object"], self.items),
            }
            names = [material.name for material in self.materials]
            if names and (placed.labels["look"] >= 0).all():
                parts["material"] = named(placed.labels["look"], names)
        look = look_of(placed, self.materials) if self.look else None
        return Read(placed.vertices, placed.faces, root.units, parts, look)

    def built(self, root: _Model) -> Iterator[Part]:
        """Yield the meshes of each build item, with their labels."""
        for use in root.build:
            self.items.append(self.named(use.key))
            for part in self.placed(use):
                part.labels["object"] = len(self.items) - 1
                yield part

    def named(self, key: Key) -> str:
        """Return the name of an object, or its number."""
        return printable(self.object(key).name) or f"object {_name(key[1])}"

    def look_of(self, key: Key) -> np.ndarray:
        """Return the materials of the triangles of an object, (F,) int32; -1 for none."""
        found, model = self.object(key), self.model(key[0])
        own = self.number(model, found.property)
        of = np.array([*(self.number(model, mark) for mark in found.marks), own], np.int32)
        marked = np.full(len(found.corners) // 3, -1)
        marked[: len(found.marked)] = found.marked
        return of[marked]  # -1 is the object's own

    def number(self, model: _Model, mark: tuple[str, int] | None) -> int:
        """Return the number of a material of a model; -1 for none, and for what is no colour."""
        if mark is None or mark[0] not in model.groups:
            return -1
        group, index = mark
        if not 0 <= index < len(model.groups[group]):
            raise MeshError(
                f"{self.name}: {_name(model.part)} has no colour {index} in group {_name(group)}"
            )
        key = model.part, group, index
        if key not in self.numbers:
            self.numbers[key] = len(self.materials)
            self.materials.append(_material(self.name, *model.groups[group][index]))
        return self.numbers[key]

    def feed(self, part: str, parser: expat.XMLParserType) -> None:
        """Parse a part of the archive, and count the bytes that it unpacks to."""
        try:
            info = self.archive.getinfo(part)
        except KeyError:
            raise MeshError(f"{self.name}: no 3MF: {_name(part)} is missing in it") from None
        with open_entry(self.archive, info) as file:
            fed = 0
            while chunk := file.read(CHUNK):
                self.left -= len(chunk)
                if self.left < 0:
                    raise MeshError(
                        f"{self.name}: unpacks to more than {self.limit >> 20} MiB: split it"
                    )
                fed += len(chunk)
                self.fed(part, parser, chunk, False)
                if fed - max(parser.CurrentByteIndex, 0) > MOST_TOKEN:
                    raise MeshError(
                        f"{self.name}: {_name(part)} has a tag of more than {MOST_TOKEN >> 20} MiB"
                    )
            self.fed(part, parser, b"", True)

    def fed(self, part: str, parser: expat.XMLParserType, chunk: bytes, last: bool) -> None:
        try:
            parser.Parse(chunk, last)
        except (MeshError, FileError, ValueError, OverflowError) as error:
            where = f"{_name(part)} line {parser.CurrentLineNumber}"
            raise MeshError(f"{self.name}: {where}: {one_line(error)}") from None
        except KeyError as error:
            where = f"{_name(part)} line {parser.CurrentLineNumber}"
            raise MeshError(f"{self.name}: {where}: attribute {error} is missing") from None
        except expat.ExpatError as error:
            raise MeshError(f"{self.name}: {_name(part)}: not readable as XML: {error}") from None

    def model(self, part: str) -> _Model:
        """Return a model of the archive, which is read when it is first needed."""
        if part not in self.models:
            self.models[part] = model = _Model(part)
            self.feed(part, model.parser)
        return self.models[part]

    def object(self, key: Key) -> Object:
        part, number = key
        found = self.model(part).objects.get(number)
        if found is None:
            raise MeshError(f"{self.name}: {_name(part)} has no object {_name(number)} to build")
        return found

    def size(self, key: Key, depth: int = 0) -> int:
        """Return the number of vertices, indices and objects that placing an object makes."""
        if depth > DEEPEST:
            raise MeshError(f"{self.name}: objects inside more than {DEEPEST} others: flatten it")
        if key not in self.sizes:
            found = self.object(key)
            inside = sum(self.size(use.key, depth + 1) for use in found.components)
            self.sizes[key] = 1 + len(found.points) // 3 + len(found.corners) + inside
        return self.sizes[key]

    def placed(self, use: Use) -> Iterator[Part]:
        """Yield the meshes of an object and of its components, each with its transform."""
        found = self.object(use.key)
        if found.points:
            corners = np.frombuffer(found.corners, np.int64).reshape(-1, 3)
            labels: dict[str, Any] = {"part": len(self.parts)}
            if self.keep:
                self.parts.append(self.named(use.key))
                labels["look"] = self.look_of(use.key)
            yield Part(np.frombuffer(found.points).reshape(-1, 3), corners, use.matrix, labels)
        for inner in found.components:
            yield from self.placed(Use(inner.key, product(use.matrix, inner.matrix)))


class _Parser:
    """An expat parser that refuses a DOCTYPE, and so all entities, as the format does."""

    def __init__(self) -> None:
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.StartDoctypeDeclHandler = self.doctype
        self.parser.StartElementHandler = self.begin_tag
        self.parser.EndElementHandler = self.end_tag
        self.depth = 0

    def doctype(self, *_: object) -> NoReturn:
        raise MeshError("a DOCTYPE, which 3MF forbids: export it again")

    def begin_tag(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise MeshError(f"elements inside more than {DEEPEST} others: export it again")
        self.start(tag, attributes)

    def end_tag(self, tag: str) -> None:
        self.depth -= 1

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        raise NotImplementedError


class _Relations(_Parser):
    """Receives the relations of the archive."""

    target = ""  # the root model's part

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag == RELATION and attributes.get("Type") == ROOT_MODEL:
            self.target = attributes["Target"].lstrip("/")


class _Model(_Parser):
    """Receives the objects and the build items of a model."""

    def __init__(self, part: str) -> None:
        super().__init__()
        self.parser.StartNamespaceDeclHandler = self.namespace
        self.part, self.units = part, "mm"
        self.names: dict[str, str] = {}  # prefix to namespace
        self.objects: dict[str, Object] = {}
        self.build: list[Use] = []
        self.open = Object()
        self.uses = 0  # items and components so far
        # Names and colours of base materials and of colours, by the id of their group.
        self.groups: dict[str, list[tuple[str, str]]] = {}
        self.group: list[tuple[str, str]] = []

    def namespace(self, prefix: str | None, uri: str) -> None:
        self.names[prefix or ""] = uri

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        space, _, what = tag.rpartition(" ")
        if space == MATERIALS:
            self.coloured(what, attributes)
        if space != CORE:
            return
        if what == "vertex":
            self.open.points.extend(real(attributes[axis]) for axis in "xyz")
        elif what == "triangle":
            self.open.corners.extend(whole(attributes[corner]) for corner in ("v1", "v2", "v3"))
            if "p1" in attributes:
                self.mark(attributes)
        elif what == "object":
            if len(self.objects) == MOST_OBJECTS:
                raise MeshError(f"more than {MOST_OBJECTS} objects: split it")
            self.open = self.objects[attributes["id"]] = Object(name=attributes.get("name", ""))
            if "pid" in attributes:
                self.open.property = attributes["pid"], whole(attributes.get("pindex", "0"))
        elif what == "basematerials":
            self.group = self.groups[attributes["id"]] = []
        elif what == "base":
            self.group.append((attributes.get("name", ""), attributes["displaycolor"]))
        elif what == "component":
            self.open.components.append(self.use(attributes))
        elif what == "item":
            self.build.append(self.use(attributes))
        elif what == "model":
            self.begin(attributes)

    def coloured(self, what: str, attributes: dict[str, str]) -> None:
        if what == "colorgroup":
            self.group = self.groups[attributes["id"]] = []
        elif what == "color":
            self.group.append((attributes["color"], attributes["color"]))

    def mark(self, attributes: dict[str, str]) -> None:
        """Keep the group and the index of the triangle that has just been read."""
        own, one = self.open.property, self.open
        group = attributes.get("pid", own[0] if own else "")
        triangle = len(one.corners) // 3 - 1
        one.marked.extend([-1] * (triangle - len(one.marked)))
        one.marked.append(one.marks.setdefault((group, whole(attributes["p1"])), len(one.marks)))

    def begin(self, attributes: dict[str, str]) -> None:
        unit = attributes.get("unit", "millimeter")
        if unit not in UNITS:
            raise MeshError(f"unit {_name(unit)} is unknown: 3MF has {', '.join(UNITS)}")
        self.units = UNITS[unit]
        for prefix in attributes.get("requiredextensions", "").split():
            if (name := self.names.get(prefix, prefix)) not in UNDERSTOOD:
                raise MeshError(f"it requires the extension {_name(name)}: export it without")

    def use(self, attributes: dict[str, str]) -> Use:
        self.uses += 1
        if self.uses > MOST_OBJECTS:
            raise MeshError(f"more than {MOST_OBJECTS} items and components: split it")
        part = attributes.get(f"{PRODUCTION} path", self.part).lstrip("/")
        matrix = EYE
        if transform := attributes.get("transform"):
            numbers = [real(word) for word in transform.split()]
            if len(numbers) != 12 or not np.isfinite(numbers).all():
                raise MeshError("a transform is no 12 finite numbers")
            matrix = EYE.copy()
            matrix[:3] = np.array(numbers).reshape(4, 3).T  # 3MF multiplies rows
        return Use((part, attributes["objectid"]), matrix)


def _material(file: str, name: str, colour: str) -> Material:
    """Return a material of a colour of 3MF, #RRGGBB or #RRGGBBAA in sRGB."""
    if not COLOUR.fullmatch(colour):
        raise MeshError(f"{file}: colour {_name(colour)} is not as #RRGGBB: correct it")
    *levels, opacity = bytes.fromhex(colour[1:].ljust(8, "F"))
    red, green, blue = (_linear()[level] for level in levels)
    return Material(printable(name), (red, green, blue, opacity / 255))


@cache
def _linear() -> list[float]:
    """Return the linear light of each level of sRGB."""
    return to_linear(np.arange(256, dtype=np.uint8)).tolist()
