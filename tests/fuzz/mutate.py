"""Mutants of files: what damage, other programs and attackers make of them.

`mutant` changes a valid file in one to four places. Some changes know the format: HDF5, XML, JSON,
gzip, lines of text, numbers in text, numbers in binary data. Others change bytes.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

from .mutate_looks import SECRET, change_bytes, change_png, change_words

Change = Callable[[bytes, random.Random], bytes]
split = str.split

INTEGERS = (0, 1, -1, 2, 7, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**40,
            2**63 - 1, 2**63, 2**64 - 1, -(2**31), -(2**63))  # fmt: skip
REALS = (*map(float, split("0 -0.0 1 -1 1e9 1e20 1e38 1e39 1e300 1e308 -1e308 inf -inf nan")),
         5e-324, 1e-308, 1e-40, 1e-38, 1e-20)  # fmt: skip
WORDS = (*map(str, INTEGERS), *map(repr, REALS), *split("1e400 -1e400 0x10 1_0 1,5 --1 1.2.3 a"),
         "", "\u0661", "\x00", "1" * 400, "'", '"')  # fmt: skip
NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
MOST_BYTES = 1 << 18  # of a mutant
FOREIGN = tuple(
    line.format(SECRET).encode()
    for line in ("*INCLUDE, INPUT={}", "mtllib {}", "Include {}", '$Merge "{}"', "FILE {}")
)


def mutant(
    format: str, data: bytes, rng: random.Random, others: list[bytes], known: float = 0.8
) -> bytes:
    """A changed file of a format; `others` are files that parts are taken from, `known` the share
    of the changes that know the format."""
    if format.endswith(".gz") and rng.random() < 0.8:
        inside = mutant(format[:-3], gzip.decompress(data), rng, others, known)
        return gzip.compress(inside, mtime=0)
    changes = changes_for(format, data)
    count = rng.choice((1, 1, 1, 2, 2, 4))
    chosen = [rng.choice(changes) if rng.random() < known else change_bytes for _ in range(count)]
    # the HDF5 library, which changes files in this process, gets them before they are damaged
    for change in sorted(chosen, key=lambda one: one is not change_hdf5):
        spliced = change is not change_hdf5 and rng.random() < 0.15 * (1 - known)
        data = (splice(data, rng, others) if spliced else change(data, rng))[:MOST_BYTES]
    return data


def changes_for(format: str, data: bytes) -> list[Change]:
    """The changes that know the format."""
    if data.startswith(b"\x89HDF"):
        return [change_hdf5, change_hdf5, change_hdf5, change_binary]
    if format.endswith(("xml", "vtu")):
        return [change_xml, change_numbers, change_lines]
    if format.endswith(("json", "gltf")):
        return [change_json, change_numbers]
    if format.endswith("glb"):
        return [change_glb, change_glb, change_glb_data, change_binary, change_png]
    if format.endswith(("3mf", "image.ome.zarr", "look.obj")):
        return [change_zip, change_zip, change_zip, change_zip, change_binary, change_zip_heads]
    if format.endswith("npz"):
        return [change_binary, change_zip_heads]
    if b"\0" in data or format.endswith((".gz", "npz", "npy")):
        return [change_binary, change_numbers, change_lines]
    return [change_numbers, change_numbers, change_lines]


# ---- any bytes


def splice(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """The beginning of one file and the end of another."""
    other = rng.choice(others)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def change_binary(data: bytes, rng: random.Random) -> bytes:
    """A binary number replaced by an extreme one, or moved by one; headers more often."""
    changed = bytearray(data)
    code = rng.choice("BHIQfd")
    size = struct.calcsize(code)
    if len(data) < size:
        return data
    end = min(len(data), 200) if rng.random() < 0.5 else len(data)
    place = (
        rng.randrange(max(end - size, 0) + 1) // size * size
        if rng.random() < 0.7
        else (rng.randrange(len(data) - size + 1))
    )
    if code in "fd":
        with contextlib.suppress(OverflowError):
            struct.pack_into("<" + code, changed, place, rng.choice(REALS))
        return bytes(changed)
    bits = 8 * size
    (old,) = struct.unpack_from("<" + code, data, place)
    value = rng.choice((*INTEGERS, old + 1, old - 1, 2 * old, old // 2)) % (1 << bits)
    order = rng.choice("<<<>")
    struct.pack_into(order + code, changed, place, value)
    return bytes(changed)


# ---- text


def change_numbers(data: bytes, rng: random.Random) -> bytes:
    """One number, or the numbers of one kind from a place on, replaced by an extreme one."""
    found = list(NUMBER.finditer(data))
    if not found:
        return change_bytes(data, rng)
    first = rng.randrange(min(len(found), rng.choice((8, 10**9))))
    count = rng.choice((1, 1, 1, 3, len(found)))
    word = rng.choice(WORDS).encode("utf-8", "surrogateescape")
    old = found[first][0]
    if rng.random() < 0.2 and old.isdigit():
        word = b"%d" % (int(old[:30]) + rng.choice((-1, 1)))
    pieces, last = [], 0
    for match in found[first : first + count]:
        pieces += [data[last : match.start()], word]
        last = match.end()
    return b"".join(pieces) + data[last:]


def change_lines(data: bytes, rng: random.Random) -> bytes:
    """Lines dropped, repeated, swapped, joined, indented or commented out."""
    lines = data.split(b"\n")
    place, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(8):
        case 0:
            del lines[place : place + rng.choice((1, 2, 10, 1000))]
        case 1:
            lines[place:place] = [lines[place]] * rng.choice((1, 2, 10, 1000))
        case 2:
            lines[place], lines[other] = lines[other], lines[place]
        case 3:
            lines[place : place + 2] = [b" ".join(lines[place : place + 2])]
        case 4:
            lines[place] = rng.choice((b" ", b"\t", b"#", b"\\", b"*", b"$", b"")) + lines[place]
        case 5:
            words = lines[place].split()
            rng.shuffle(words)
            lines[place] = b" ".join(words * rng.choice((1, 1, 2, 1000)))
        case 6:
            lines.insert(place, rng.choice(FOREIGN))
        case _:
            lines[place] += rng.choice((b"\\", b"\r", b" #", b",", b" 1", b"\x00"))
    return b"\n".join(lines)


# ---- XML and JSON


def change_xml(data: bytes, rng: random.Random) -> bytes:
    """Elements and attributes dropped, repeated or renamed; entities; depth; other constructs."""
    tags = list(re.finditer(rb"<[^<>]+>", data))
    values = list(re.finditer(rb'\b[\w:]+="([^"]*)"', data))
    if not tags or not values:
        return change_bytes(data, rng)
    tag, value = rng.choice(tags[: rng.choice((12, 10**9))]), rng.choice(values)
    start, end = tag.span()
    match rng.randrange(9):
        case 0:
            return data[:start] + data[end:]
        case 1:
            return data[:end] + tag[0] * rng.choice((1, 2, 1000)) + data[end:]
        case 2:
            return data[: value.start()] + data[value.end() :]
        case 3:
            return data[: value.end()] + b" " + value[0] + data[value.end() :]
        case 4 | 5:
            word = rng.choice(
                (*WORDS, "&lt;", "&e;", "&#0;", "&#1114112;", "raw", "Float64", "Int8")
            )
            word = word.encode("utf-8", "surrogateescape")
            return data[: value.start(1)] + word + data[value.end(1) :]
        case 6:
            depth = rng.choice((2, 100, 10_000))
            return data[:end] + b"<x>" * depth + b"</x>" * rng.choice((depth, 0)) + data[end:]
        case 7:
            head = b'<!DOCTYPE x [<!ENTITY e "%s"><!ENTITY f SYSTEM "../../secret.txt">]>'
            opening = data.find(b"?>") + 2 if data.startswith(b"<?") else 0
            return data[:opening] + head % (b"9" * 50) + data[opening:end] + b"&e;&f;" + data[end:]
        case _:
            odd = rng.choice((b"<!-- x -->", b"<![CDATA[1 2]]>", b"<?p q?>", b"\xff\xfe", b"&#x41;",
                              b'<xi:include href="../../secret.txt"/>'))  # fmt: skip
            return data[:end] + odd + data[end:]


def change_json(data: bytes, rng: random.Random) -> bytes:
    """A value of a JSON document replaced, dropped or repeated."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return change_bytes(data, rng)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        if isinstance(value, dict | list) and len(places) < 10_000:
            for key in value if isinstance(value, dict) else range(len(value)):
                places.append((value, key))
                walk(value[key])

    walk(tree)
    if places:
        parent, key = rng.choice(places)
        match rng.randrange(6):
            case 0:
                del parent[key]
            case 1:
                parent[key] = [parent[key]] * rng.choice((1, 2, 1000))
            case 2:
                parent[key] = rng.choice(places)[0]  # perhaps around itself: json refuses that
            case _:
                parent[key] = rng.choice((*INTEGERS, *REALS, *WORDS, None, True, [], {}))
    try:
        return json.dumps(tree).encode()
    except (ValueError, RecursionError):
        return change_bytes(data, rng)


def change_glb(data: bytes, rng: random.Random) -> bytes:
    """The JSON of a GLB changed, with its lengths right."""
    length = int.from_bytes(data[12:16], "little")
    text = change_json(data[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest


def change_glb_data(data: bytes, rng: random.Random) -> bytes:
    """A number in the buffer of a GLB changed: a vertex, an index, a texture coordinate."""
    start = 28 + int.from_bytes(data[12:16], "little")
    return data[:start] + change_binary(data[start:], rng)


def change_zip(data: bytes, rng: random.Random) -> bytes:
    """A file of XML, JSON or other bytes in a zip archive changed, packed again."""
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
            names = old.namelist()
            for name in names:
                text = old.read(name)
                if rng.random() < 1 / len(names):
                    text = rng.choice(_changes_inside(name, text))(text, rng)
                new.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)
    except Exception:  # another change damaged it before
        return change_bytes(data, rng)
    return out.getvalue()


def change_zip_heads(data: bytes, rng: random.Random) -> bytes:
    """The flags, the method, the sizes or the check of an entry changed, in one or both places."""
    starts = [found.start() for found in re.finditer(re.escape(b"PK\1\2"), data)]
    if not starts:
        return change_bytes(data, rng)
    central, changed = rng.choice(starts), bytearray(data)
    (local,) = struct.unpack_from("<I", data.ljust(central + 46, b"\0"), central + 42)
    kind, place = rng.choice((("<H", 8), ("<H", 8), ("<H", 10), ("<I", 16), ("<I", 20), ("<I", 24)))
    values = (1, 0x20, 0x40, 0x2000, 8, 9, 12, 14, 93, 98, 0, 0xFFFF) if kind == "<H" else INTEGERS
    value = rng.choice(values) % (1 << 8 * struct.calcsize(kind))
    for at in rng.choice(((central + place,), (central + place, local + place - 2))):
        if at + 4 <= len(changed):
            struct.pack_into(kind, changed, at, value)
    return bytes(changed)


def _changes_inside(name: str, text: bytes) -> list[Change]:
    """The changes that know a file of an archive."""
    if name.endswith(".png"):
        return [change_png, change_png, change_bytes]
    if name.endswith((".obj", ".mtl")):
        return [change_numbers, change_lines, change_words]
    known = change_json if text.startswith(b"{") else change_xml
    return [known, change_numbers, change_bytes]


# ---- HDF5


def change_hdf5(data: bytes, rng: random.Random) -> bytes:
    """An attribute, a dataset, a link or a filter changed by the HDF5 library."""
    file = io.BytesIO(data)
    try:
        with h5py.File(file, "r+") as h5, np.errstate(all="ignore"):
            if h5.attrs and rng.random() < 0.4:
                change_attribute(h5, rng)
            elif len(h5):
                change_dataset(h5, rng.choice(sorted(h5)), rng)
    except Exception:  # a value that HDF5 cannot hold
        return change_bytes(data, rng)
    return file.getvalue()


def change_attribute(h5: h5py.File, rng: random.Random) -> None:
    name = rng.choice(sorted(h5.attrs))
    old = h5.attrs[name]
    match rng.randrange(6):
        case 0:
            del h5.attrs[name]
        case 1:
            h5.attrs[name] = np.broadcast_to(rng.choice(INTEGERS[:12]), np.shape(old))
        case 2:
            h5.attrs[name] = np.full(np.shape(old), rng.choice(REALS))
        case 3:
            h5.attrs[name] = np.full(rng.choice(((0,), (2,), (3, 3), (1000,))), 1.0)
        case 4:
            h5.attrs[name] = rng.choice(
                (*WORDS[:-3], "\n", "\u202e", "{" * 100, '{"a":1}', "9.0", "1.9")
            )
        case _:
            changed = np.array(old)
            if changed.dtype.kind in "iuf" and changed.size:
                changed.flat[rng.randrange(changed.size)] = rng.choice(
                    (0, 1, -1, 3, 1000, 2**31 - 1)
                )
            h5.attrs[name] = changed


def change_dataset(h5: h5py.File, name: str, rng: random.Random) -> None:
    old = h5[name]
    values = old[()] if isinstance(old, h5py.Dataset) else np.zeros(3)
    kind = rng.randrange(8)
    if kind == 0 and values.size:
        set_values(values, rng)
        old[...] = values  # pyright: ignore[reportIndexIssue]
        return
    del h5[name]
    match kind:
        case 1:
            pass
        case 2:
            h5[name] = rng.choice((h5py.ExternalLink(SECRET, "/"), h5py.SoftLink("/" + name)))
        case 3:
            shape = rng.choice(((0,), (1,), (1 << 16,), (1 << 40,), (2, 2, 2, 2)))
            h5.create_dataset(name, shape, values.dtype, chunks=True, compression="gzip")
        case 4:
            h5.create_dataset(
                name, data=values, chunks=True, compression=rng.choice(("gzip", "lzf"))
            )
        case 5:
            h5[name] = values.astype(rng.choice(("f8", "f4", "i1", ">u4", "u8", "S4", "c16", "?")))
        case 6:
            rows = values[: rng.randrange(len(values) + 1)] if values.ndim else values
            h5[name] = np.concatenate([rows, rows]) if rng.random() < 0.3 and values.ndim else rows
        case _:
            h5.create_group(name)


def set_values(values: np.ndarray, rng: random.Random) -> None:
    """Some numbers of an array, or of a field of it, set to an extreme one or to each other."""
    array = values[rng.choice(values.dtype.names)] if values.dtype.names else values
    for _ in range(rng.choice((1, 1, 3, 100))):
        place = rng.randrange(array.size)
        if array.dtype.kind == "f":
            array.flat[place] = rng.choice(REALS)
        elif array.dtype.kind in "iu" and rng.random() < 0.5:
            least, most = np.iinfo(array.dtype).min, np.iinfo(array.dtype).max
            array.flat[place] = min(max(rng.choice(INTEGERS), least), most)
        else:
            array.flat[place] = array.flat[rng.randrange(array.size)]
