"""3MF (3D Manufacturing Format, core specification 1.3): a zip archive of XML models.

A model is read as a stream. Each object that the model builds is placed by the transforms of its
build item and its components, of other parts of the archive too (production extension).
"""

from __future__ import annotations

import io
import zipfile
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np

from voxtool.errors import MeshError, one_line, printable
from voxtool.files.placement import DEEPEST, Part, check_placed, merged, product

ZIP = b"PK\x03\x04"
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
CHUNK = 1 << 16  # bytes fed to the parser at once
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


def parse(
    name: str, data: bytes, limit: int, max_memory: int | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the (V, 3) float64 vertices, (F, 3) int64 faces and the units of all that a 3MF
    builds.

    name : of the file, for messages; limit : bytes that its parts may unpack to; max_memory :
    bytes that the placed meshes may take.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _Package(name, archive, limit).meshes(max_memory)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise MeshError(
            f"{name}: not readable as 3MF: {one_line(error)}: it may be truncated or damaged, "
            "export it again"
        ) from None


def _name(text: str) -> str:
    """Return the beginning of a name in the file, for messages."""
    return printable(text)[:80]


class _Package:
    """The parts of an archive that have been read."""

    def __init__(self, name: str, archive: zipfile.ZipFile, limit: int) -> None:
        self.name, self.archive, self.left, self.limit = name, archive, limit, limit
        self.models: dict[str, _Model] = {}
        self.sizes: dict[Key, int] = {}

    def meshes(self, max_memory: int | None) -> tuple[np.ndarray, np.ndarray, str]:
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
        check_placed(self.name, items, max_memory)
        parts = (part for use in root.build for part in self.placed(use))
        return *merged(self.name, parts), root.units

    def feed(self, part: str, parser: expat.XMLParserType) -> None:
        """Parse a part of the archive, and count the bytes that it unpacks to."""
        try:
            info = self.archive.getinfo(part)
        except KeyError:
            raise MeshError(f"{self.name}: no 3MF: {_name(part)} is missing in it") from None
        with self.archive.open(info) as file:
            while chunk := file.read(CHUNK):
                self.left -= len(chunk)
                if self.left < 0:
                    raise MeshError(
                        f"{self.name}: unpacks to more than {self.limit >> 20} MiB: split it"
                    )
                self.fed(part, parser, chunk, False)
            self.fed(part, parser, b"", True)

    def fed(self, part: str, parser: expat.XMLParserType, chunk: bytes, last: bool) -> None:
        try:
            parser.Parse(chunk, last)
        except (MeshError, ValueError, OverflowError) as error:
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
            yield np.frombuffer(found.points).reshape(-1, 3), corners, use.matrix
        for inner in found.components:
            yield from self.placed(Use(inner.key, product(use.matrix, inner.matrix)))


class _Parser:
    """An expat parser that refuses a DOCTYPE, and so all entities, as the format does."""

    def __init__(self) -> None:
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.StartDoctypeDeclHandler = self.doctype
        self.parser.StartElementHandler = self.start

    def doctype(self, *_: object) -> NoReturn:
        raise MeshError("a DOCTYPE, which 3MF forbids: export it again")

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

    def namespace(self, prefix: str | None, uri: str) -> None:
        self.names[prefix or ""] = uri

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        space, _, what = tag.rpartition(" ")
        if space != CORE:
            return
        if what == "vertex":
            self.open.points.extend(float(attributes[axis]) for axis in "xyz")
        elif what == "triangle":
            self.open.corners.extend(int(attributes[corner]) for corner in ("v1", "v2", "v3"))
        elif what == "object":
            self.open = self.objects[attributes["id"]] = Object()
        elif what == "component":
            self.open.components.append(self.use(attributes))
        elif what == "item":
            self.build.append(self.use(attributes))
        elif what == "model":
            self.begin(attributes)

    def begin(self, attributes: dict[str, str]) -> None:
        unit = attributes.get("unit", "millimeter")
        if unit not in UNITS:
            raise MeshError(f"unit {_name(unit)} is unknown: 3MF has {', '.join(UNITS)}")
        self.units = UNITS[unit]
        for prefix in attributes.get("requiredextensions", "").split():
            if (name := self.names.get(prefix, prefix)) not in UNDERSTOOD:
                raise MeshError(f"it requires the extension {_name(name)}: export it without")

    def use(self, attributes: dict[str, str]) -> Use:
        part = attributes.get(f"{PRODUCTION} path", self.part).lstrip("/")
        matrix = np.eye(4)
        if transform := attributes.get("transform"):
            numbers = [float(word) for word in transform.split()]
            if len(numbers) != 12 or not np.isfinite(numbers).all():
                raise MeshError("a transform is no 12 finite numbers")
            matrix[:3] = np.array(numbers).reshape(4, 3).T  # 3MF multiplies rows
        return Use((part, attributes["objectid"]), matrix)
