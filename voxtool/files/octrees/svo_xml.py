"""Octrees as XML after [voCCeL, listing 5.1], and as voCCeL itself exports them; octree.dtd and
docs/formats.md specify both.

Documents are written and read as streams. A document is not trusted: an internal subset and
entities are refused, no other file is read, its text is bounded by the sizes that it declares, and
these by the size of the file, before memory is taken. Each element is checked as it arrives; their
order is validated against the packaged DTD.
"""

from __future__ import annotations

import gzip
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from voxtool.errors import FileError
from voxtool.files.octrees import svo_hdf5, voccel
from voxtool.files.octrees.svo_hdf5 import grid_of
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.unpacked import Unpacked
from voxtool.memory import check_memory
from voxtool.svo.octree.layout import BRICK, NODE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.validate import check_offsets

if TYPE_CHECKING:
    from voxtool.files.storage.schema import Attribute
    from voxtool.grid import Grid

etree: Any = import_module("lxml.etree")  # it has no types

DTD = Path(__file__).with_name("octree.dtd")
MAX_ELEMENTS = 64  # without repetitions: 15 levels and a few more
GZIP_LEVEL = 4

SCHEMA = replace(svo_hdf5.SCHEMA, newer=())  # XML holds no merged subtrees
OPENING = '<?xml version="1.0" encoding="UTF-8"?>\n'
DOCTYPE = '<!DOCTYPE octree SYSTEM "octree.dtd">\n'  # on request: some readers would fetch it
NODE_ROW = '<node parent="%d" child="%d"/>\n'
MASK_ROW = "<bitmask>%d</bitmask>\n"
LEAST_NODE = len('<node parent="0" child="0"/>')
LEAST_MASK = len("<bitmask>0</bitmask>")
CONTAINERS = ("octree", "offset", "levels", "level", "subgrid")
NAMES = {"offsets": "offset"}  # what listing 5.1 calls it, too
ROWS = 1 << 14  # rows formatted, or parsed, at once

CHUNK = 1 << 16  # bytes fed to the parser at once
LONGEST_TOKEN = 1 << 18  # bytes of one tag or comment
HEAD_BYTES = 1 << 20  # text that needs no declared size
ROW_BYTES = 256  # text that each declared node or bitmask may take

ENTITY = re.compile(rb"&(?!(?:amp|lt|gt|quot|apos|#[0-9]{1,7}|#x[0-9a-fA-F]{1,6});)")
LONGEST_REFERENCE = len("&#x10ffff;")
WORDS = re.compile(r"[0-9]{1,10}(?: [0-9]{1,10})*")
WHOLE = re.compile(r"[0-9]{1,10}")
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


# Writing


def write(octree: Octree, file: BinaryIO, doctype: bool = False) -> None:
    """Write an octree as XML; with a DOCTYPE on request."""
    _check_kind(octree)
    head = SCHEMA.encode(octree)
    attributes = {"dim": head.pop("dim"), "size": len(octree.nodes), "depth": head.pop("depth")}
    opening = OPENING + DOCTYPE * doctype
    _write_document(file, opening, octree, attributes | head, octree.offsets, octree.nodes)


def write_voccel(octree: Octree, file: BinaryIO, doctype: bool = False) -> None:
    """Write an octree as voCCeL exports it: without its place, mode and fill."""
    _check_kind(octree)
    attributes = {"dim": octree.grid.dim, "size": len(octree.nodes), "depth": octree.depth}
    first = int(octree.offsets[-2])
    nodes = np.concatenate([octree.nodes[:first], voccel.words_of(octree.nodes[first:])])
    opening = OPENING + DOCTYPE * doctype
    _write_document(file, opening, octree, attributes, octree.offsets[:-1], nodes)


def _check_kind(octree: Octree) -> None:
    if not isinstance(octree, Octree):
        raise FileError("XML holds no merged subtrees: write them to .svo.h5")
    if octree.attributes:
        raise FileError("XML holds no attributes of voxels: write them to .svo.h5")


def _write_document(
    file: BinaryIO,
    opening: str,
    octree: Octree,
    attributes: dict[str, Any],
    offsets: np.ndarray,
    nodes: np.ndarray,
) -> None:
    """Write a document with these attributes, offsets and nodes; the octree's levels and bricks."""
    file.write(f"{opening}<octree".encode())
    for name, value in attributes.items():
        file.write(f"\n  {name}={quoteattr(_as_text(value))}".encode())
    file.write(f">\n<offset>{_as_text(offsets.tolist())}</offset>\n<levels>\n".encode())
    words = np.ascontiguousarray(nodes, NODE).view("<u4")
    for first, last in zip(octree.offsets[:-1].tolist(), octree.offsets[1:].tolist(), strict=True):
        file.write(b"<level>\n")
        _write_rows(file, NODE_ROW, words[2 * first : 2 * last], 2)
        file.write(b"</level>\n")
    halves = np.ascontiguousarray(octree.bricks, BRICK).view("<u4")
    file.write(f'</levels>\n<subgrid size="{len(halves)}">\n'.encode())
    _write_rows(file, MASK_ROW, halves, 1)
    file.write(b"</subgrid>\n</octree>\n")


def write_gz(octree: Octree, file: BinaryIO, doctype: bool = False) -> None:
    """Write an octree as gzip-compressed XML, without a name and a time."""
    with gzip.GzipFile("", "wb", GZIP_LEVEL, file, mtime=0) as packed:
        write(octree, packed, doctype)  # pyright: ignore[reportArgumentType]


def _as_text(value: Any) -> str:
    """Return the text of an attribute; a number has the fewest digits that read back as the
    same."""
    return " ".join(map(repr, value)) if isinstance(value, list | tuple) else str(value)


def _write_rows(file: BinaryIO, row: str, words: np.ndarray, columns: int) -> None:
    step = ROWS * columns
    for start in range(0, len(words), step):
        part = tuple(words[start : start + step].tolist())
        file.write((row * (len(part) // columns) % part).encode())


# Reading


def read(file: BinaryIO, size: int) -> Octree:
    """Return the octree of an XML file of `size` bytes; FileError if it is damaged or hostile."""
    return _Reader(size).read(file)


def read_gz(file: BinaryIO, size: int) -> Octree:
    """Return the octree of a gzip-compressed XML file of `size` bytes."""
    with Unpacked(gzip.GzipFile(fileobj=file, mode="rb"), "gzip file") as packed:
        return _Reader(size * PACKED).read(packed)  # pyright: ignore[reportArgumentType]


def parse_words(text: str) -> np.ndarray:
    """Return the (N,) uint32 of decimal numbers separated by single spaces."""
    if WORDS.fullmatch(text):
        values = np.fromstring(text, np.uint64, sep=" ")
        if values.max() < 1 << 32:
            return values.astype("<u4")
    bad = next(w for w in text.split(" ") if not re.fullmatch("[0-9]{1,10}", w) or int(w) >> 32)
    raise FileError(f"{bad[:20]!r} is no unsigned 32-bit number")


def parse_head(texts: dict[str, str]) -> dict[str, Any]:
    """Return the stored attributes of `octree`; where the document leaves one out, its default."""
    if "dim" not in texts:
        raise FileError("attribute dim is missing")
    head: dict[str, Any] = {"format_version": SCHEMA.version}
    SCHEMA.of_version(texts.get("format_version", SCHEMA.version))
    for attribute in SCHEMA.attributes:
        if attribute.name in texts:
            text = texts[attribute.name]
            head[attribute.name] = text if attribute.stored is str else _numbers(attribute, text)
    dim = head["dim"]
    plain = {"creator": "", "mode": "solid", "fill": "parity", "units": "", "source_sha256": ""}
    plain |= {"depth": max(dim - 1, 0).bit_length() - 1, "shape": (dim,) * 3, "plan": "{}"}
    return plain | {"origin": (0.0,) * 3, "pitch": (1.0,) * 3} | head


def _numbers(attribute: Attribute, text: str) -> Any:
    kind, count = attribute.stored, attribute.size
    pattern = NUMBER if kind is float else WHOLE
    words = text.split(" ")
    if len(words) != count or not all(len(w) < 40 and pattern.fullmatch(w) for w in words):
        raise FileError(
            f"attribute {attribute.name} is {text[:40]!r} where {count} of {kind.__name__} go"
        )
    numbers = tuple(map(kind, words))
    return numbers if count > 1 else numbers[0]


class _Words:
    """An array of a declared length that is filled with numbers as their text arrives."""

    def __init__(self, count: int, what: str) -> None:
        self.array = np.empty(count, "<u4")
        self.filled = 0
        self.pending: list[str] = []
        self.what = what

    def flush(self) -> None:
        """Parse the text that has arrived."""
        if not self.pending:
            return
        values = parse_words(" ".join(self.pending))
        if len(values) != len(self.pending):
            raise FileError("two numbers where one goes")
        end = self.filled + len(values)
        if end > len(self.array):
            raise FileError(f"more than the {len(self.array):,} {self.what} declared")
        self.array[self.filled : end] = values
        self.filled = end
        self.pending.clear()


class _Skeleton:
    """A document without its text, in which a run of equal leaves is one element; the DTD validates
    it."""

    def __init__(self) -> None:
        self.root: Any = None
        self.open: list[Any] = []
        self.count = 0

    @property
    def within(self) -> str:
        """The name of the innermost open element, or ""."""
        return self.open[-1].tag if self.open else ""

    def start(self, name: str, attributes: list[str]) -> None:
        """Open an element that has attributes of these names."""
        self.count += 1
        if self.count > MAX_ELEMENTS:
            raise FileError("more elements than an octree has")
        element = etree.Element(name, dict.fromkeys(attributes, ""))
        if self.open:
            self.open[-1].append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self) -> None:
        """Close the element that was opened last."""
        self.open.pop()

    def validate(self) -> None:
        """Raise FileError if the document is not valid by the packaged DTD."""
        with DTD.open("rb") as file:
            dtd = etree.DTD(file)
        if self.root is None or not dtd.validate(self.root):
            raise FileError(f"not by octree.dtd: {dtd.error_log[0].message[:160]}")


class _Reader:
    """Receives the events of the XML parser and fills the arrays of an octree."""

    def __init__(self, text_limit: int) -> None:
        self.text_limit = text_limit  # bytes of text that the file can hold at most
        self.allowed = HEAD_BYTES  # bytes of text that the declared sizes justify
        self.skeleton = _Skeleton()
        self.within = ""  # innermost open element
        self.leaf = False  # it is a node or a bitmask
        self.runs: set[str] = set()  # leaves that the open element already has
        self.text: list[str] = []
        self.sizes: list[int] = []  # nodes of each level so far
        self.head: dict[str, Any] = {}
        self.doctype_seen = False
        self.grid: Grid | None = None
        self.plain = False  # whether the root has no attributes but those of voCCeL
        self.voccel = False  # whether the offsets are voCCeL's
        self.offsets = np.empty(0, "<u4")  # until its element ends
        self.nodes = _Words(0, "node words")
        self.masks = _Words(0, "bitmasks")
        self.parser = expat.ParserCreate("UTF-8")
        self.parser.ordered_attributes = True
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self.doctype
        self.parser.EntityDeclHandler = _refuse_entity
        self.parser.SkippedEntityHandler = _refuse_entity
        self.parser.ProcessingInstructionHandler = _refuse_instruction
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.data

    def read(self, file: BinaryIO) -> Octree:
        try:
            self.parse(file)
            self.skeleton.validate()
        except expat.ExpatError as error:
            raise FileError(f"line {error.lineno}: {_syntax_message(error)}") from None
        except FileError as error:
            raise FileError(f"line {self.parser.CurrentLineNumber}: {error}") from None
        self.check_filled()
        nodes = self.nodes.array.view(NODE)
        if self.voccel:
            nodes = voccel.nodes_of(nodes, int(self.offsets[-2]))
        arrays = {"nodes": nodes.view("<u4"), "bricks": self.masks.array.view(BRICK)}
        return SCHEMA.decode(self.head, {"offsets": self.offsets, **arrays})

    def parse(self, file: BinaryIO) -> None:
        fed, tail = 0, b""
        while chunk := file.read(CHUNK):
            fed += len(chunk)
            self.parser.Parse(chunk, False)
            if self.doctype_seen:
                tail = refuse_entities(tail + chunk)
            self.nodes.flush()
            self.masks.flush()
            if fed > self.allowed:
                raise FileError("more text than its declared sizes need")
            if fed - max(self.parser.CurrentByteIndex, 0) > LONGEST_TOKEN:
                raise FileError(f"a tag or comment of more than {LONGEST_TOKEN} bytes")
        self.parser.Parse(b"", True)

    def check_filled(self) -> None:
        declared = np.diff(self.offsets).tolist()
        for d, (found, expected) in enumerate(zip(self.sizes, declared, strict=False)):
            if found != expected:
                raise FileError(f"level element {d + 1} has {found} nodes, not {expected}")
        masks = self.masks
        for found, expected, what in (
            (len(self.sizes), len(declared), "levels"),
            (masks.filled, len(masks.array), "bitmasks"),
        ):
            if found != expected:
                raise FileError(f"{found} {what} where {expected} are declared")

    # Events

    def doctype(self, name: str, system: str | None, public: str | None, internal: int) -> None:
        if internal:
            raise FileError("a DOCTYPE with an internal subset is refused: remove it")
        self.doctype_seen = True

    def start(self, name: str, attributes: list[str]) -> None:
        if name == "node" and self.within == "level":
            self.nodes.pending += _node_words(attributes)
            self.sizes[-1] += 1
            self.start_leaf(name, attributes)
        elif name == "bitmask" and self.within == "subgrid" and not attributes:
            self.start_leaf(name, [])
        elif not self.within and name != "octree":
            raise FileError(f"not an octree: its root is {name[:40]}")
        elif self.leaf or NAMES.get(name, name) not in CONTAINERS:
            raise FileError(f"element {name[:40]} inside {self.within}")
        else:
            self.start_container(NAMES.get(name, name), attributes)

    def start_leaf(self, name: str, attributes: list[str]) -> None:
        self.leaf = True
        self.within = name
        if name not in self.runs:
            self.runs.add(name)
            self.skeleton.start(name, attributes[::2])
            self.skeleton.end()

    def start_container(self, name: str, attributes: list[str]) -> None:
        values = dict(zip(attributes[::2], attributes[1::2], strict=True))
        if name == "octree":
            values = self.start_octree(values)
        elif name in ("levels", "level", "subgrid") and not len(self.offsets):
            raise FileError(f"element {name} before the offsets")
        elif name == "level":
            self.sizes.append(0)
        elif name == "subgrid":
            self.end_levels()
            self.expect_size(values.get("size"), len(self.masks.array))
        if any(":" in a for a in values):
            raise FileError("namespaces are refused: remove them")
        self.skeleton.start(name, list(values))
        self.within = name
        self.runs.clear()

    def start_octree(self, values: dict[str, str]) -> dict[str, str]:
        """Check the attributes; return those that the DTD validates."""
        if self.grid is not None:
            raise FileError("an octree inside an octree")
        self.head = parse_head(values)
        SCHEMA.check(self.head)
        self.grid = grid_of(self.head)
        self.size = values.get("size")
        self.plain = set(values) <= set(voccel.ATTRIBUTES)
        if SCHEMA.is_newer(self.head["format_version"]):
            known = {"size", *(attribute.name for attribute in SCHEMA.attributes)}
            values = {k: v for k, v in values.items() if k in known}
        return values

    def end_offset(self) -> None:
        """Check the declared sizes, then take memory for them."""
        if self.grid is None or len(self.offsets):
            raise FileError("the offsets are not the first thing in the octree")
        words = "".join(self.text).split()[:MAX_ELEMENTS]
        offsets = parse_words(" ".join(words))
        if self.plain and len(offsets) == self.head["depth"]:
            self.voccel = True
            offsets = np.append(offsets, self.voccel_total(offsets)).astype("<u4")
        check_offsets(self.grid, offsets)
        nodes, masks = int(offsets[-1]), 2 * int(offsets[-1] - offsets[-2])
        self.expect_size(self.size, nodes)
        if nodes * LEAST_NODE + masks * LEAST_MASK > self.text_limit:
            raise FileError(f"{nodes:,} nodes are declared, which the file cannot hold: cut short?")
        check_memory(8 * nodes + 4 * masks, "the nodes", "choose a smaller octree")
        self.allowed += ROW_BYTES * (nodes + masks)
        self.offsets = offsets
        self.nodes = _Words(2 * nodes, "node words")
        self.masks = _Words(masks, "bitmasks")

    def voccel_total(self, offsets: np.ndarray) -> int:
        """Return the number of nodes that the document declares; if it leaves the size out, the
        largest number that the levels and the file allow."""
        if self.size is not None:
            return int(parse_words(self.size)[0])
        above, first = offsets[-2:].tolist()
        room = (self.text_limit - LEAST_NODE * first) // (LEAST_NODE + 2 * LEAST_MASK)
        return min(first + 8 * max(min(first - above, room // 8), 0), (1 << 32) - 1)

    def end_levels(self) -> None:
        """Learn the number of nodes of a document of voCCeL's that leaves the size out."""
        self.nodes.flush()
        if self.voccel and self.size is None and self.sizes:
            found = self.nodes.filled // 2
            self.offsets[-1] = found
            self.nodes.array = self.nodes.array[: 2 * found]
            self.masks = _Words(2 * self.sizes[-1], "bitmasks")

    def expect_size(self, text: str | None, expected: int) -> None:
        if text is not None and text != str(expected):
            raise FileError(f"size {text[:20]!r} where the offsets say {expected}")

    def end(self, name: str) -> None:
        if name == "node" and self.text:
            raise FileError("text inside a node")
        if name == "bitmask":
            self.masks.pending.append("".join(self.text).strip())
        elif self.within == "offset":
            self.end_offset()
        self.text.clear()
        if not self.leaf:
            self.skeleton.end()
        self.leaf = False
        self.within = self.skeleton.within

    def data(self, text: str) -> None:
        if self.leaf or self.within == "offset":
            self.text.append(text)
        elif text.strip(" \t\r\n"):
            raise FileError(f"text {text.strip()[:20]!r} inside {self.within}")


def refuse_entities(text: bytes) -> bytes:
    """Refuse references to undeclared entities; return the bytes to search again with the next.

    After a DOCTYPE whose subset is not read, the parser ignores such references in attributes.
    """
    for match in ENTITY.finditer(text):
        if match.start() < len(text) - LONGEST_REFERENCE:
            _refuse_entity()
    return text[-LONGEST_REFERENCE:]


def _refuse_entity(*_: Any) -> None:
    raise FileError("entities are refused: remove them")


def _refuse_instruction(*_: Any) -> None:
    raise FileError("processing instructions are refused: remove them")


def _node_words(attributes: list[str]) -> list[str]:
    names, words = attributes[::2], attributes[1::2]
    if names not in (["parent", "child"], ["child", "parent"]):
        raise FileError("a node has the two attributes parent and child")
    return words if names[0] == "parent" else words[::-1]


def _syntax_message(error: expat.ExpatError) -> str:
    reason = expat.ErrorString(error.code)
    if reason in (expat.errors.XML_ERROR_NO_ELEMENTS, expat.errors.XML_ERROR_UNCLOSED_TOKEN):
        return "the document is cut short"
    return f"no well-formed XML ({reason})"
