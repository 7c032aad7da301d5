"""Parts, materials and textures, from the statements of an OBJ and its material libraries."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from voxtool.errors import MeshError, MeshWarning, printable, shown
from voxtool.files.meshes.placement import Read, named
from voxtool.mesh.appearance import Appearance, Material, Parts, Texture
from voxtool.mesh.srgb import to_linear

if TYPE_CHECKING:
    from voxtool.files.meshes.companions import Companions

GROUPINGS = {"g": "part", "o": "object", "usemtl": "material"}
NUMBERS_OF = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}  # at most, of options of map_Kd
WORD_OPTIONS = ("-blendu", "-blendv", "-cc", "-clamp", "-texres", "-bm", "-imfchan", "-boost",
                "-type")  # fmt: skip


class Statements(NamedTuple):
    """The statements of an OBJ beside vertices and faces."""

    begun: list[tuple[int, str, str]]  # the face from which on it holds, the statement, its words
    uv: np.ndarray  # (T, 2) float64: the file's texture coordinates
    corners: np.ndarray  # (F, 3) int64: rows of `uv` for the corners of the faces, or -1
    colours: np.ndarray | None  # (V, 3) float64 of the vertices, in sRGB


class Look(NamedTuple):
    """A material of a library."""

    colour: list[float]  # sRGB and opacity
    picture: str = ""
    clamp: bool = False
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


BLANK = Look([1.0, 1.0, 1.0, 1.0])


def described(
    vertices: np.ndarray,
    faces: np.ndarray,
    statements: Statements,
    keep: Sequence[str],
    companions: Companions,
    max_memory: int | None,
) -> Read:
    """Return the mesh with its parts and its appearance, as `keep` asks."""
    labels = {
        what: _labels(statements.begun, statement, len(faces))
        for statement, what in GROUPINGS.items()
        if any(one == statement for _, one, _ in statements.begun)
    }
    if "part" not in labels and "object" in labels:
        labels["part"] = labels["object"]
    parts = {what: named(*one) for what, one in labels.items()} if "parts" in keep else {}
    look = None
    if "appearance" in keep:
        used = named(*labels["material"]) if "material" in labels else None
        look = _appearance(faces, statements, used, companions, max_memory)
    return Read(vertices, faces, "", parts, look)


def _labels(
    begun: list[tuple[int, str, str]], statement: str, faces: int
) -> tuple[np.ndarray, list[str]]:
    """Return which name each face has by a kind of statement, and all names, of which the first is
    that of faces before any."""
    names, starts, numbers = {"": 0}, [0], [0]
    for face, one, words in begun:
        if one == statement:
            starts.append(face)
            numbers.append(names.setdefault(words, len(names)))
    counts = np.diff([*starts, faces])
    return np.repeat(np.array(numbers, np.int32), counts), list(names)


def _appearance(
    faces: np.ndarray,
    statements: Statements,
    used: Parts | None,
    companions: Companions,
    max_memory: int | None,
) -> Appearance | None:
    """Return the materials of the faces by the libraries that an OBJ names."""
    colours = None
    if statements.colours is not None:
        colours = np.ones((len(statements.colours), 4))
        colours[:, :3] = to_linear(np.clip(statements.colours, 0.0, 1.0))
    files = [words for _, one, words in statements.begun if one == "mtllib"]
    looks: dict[str, Look] = {}
    for file in dict.fromkeys(files):
        for name, look in _library(file, companions).items():
            looks.setdefault(name, look)
    if used is None or not looks:
        if colours is None:
            return None
        return Appearance((), np.full(len(faces), -1, np.int32), None, colours)
    unknown = [name for name in used.names if name and name not in looks]
    if unknown:
        warnings.warn(
            f"{companions.name}: material {printable(unknown[0])[:40]!r} is in none of its "
            f"libraries ({len(unknown)} in all): such faces are white",
            MeshWarning,
            stacklevel=2,
        )
    return _of_looks(statements, used, looks, colours, companions, max_memory)


def _of_looks(
    statements: Statements,
    used: Parts,
    looks: dict[str, Look],
    colours: np.ndarray | None,
    companions: Companions,
    max_memory: int | None,
) -> Appearance:
    """Return the appearance of faces whose materials have these looks."""
    from voxtool.files.meshes.pixels import Pictures

    pictures = Pictures(max_memory)
    textures: dict[tuple[str, bool], Texture] = {}
    known = [looks.get(name, BLANK) for name in used.names]
    materials = [_material(*one, None) for one in zip(used.names, known, strict=True)]
    has_uv = (statements.corners >= 0).all(axis=1)  # other faces have the colour
    counts = np.bincount(used.labels[has_uv], minlength=len(known))
    textured = np.arange(len(known), dtype=np.int32)  # the number of each with its texture
    shown = list(known)  # the looks of all materials
    for number, (name, look) in enumerate(zip(used.names, known, strict=True)):
        if not look.picture or not counts[number]:
            continue
        key = look.picture, look.clamp
        if key not in textures:
            data = companions.read(look.picture, "texture")
            where = f"{companions.name}: texture {printable(look.picture)[:80]!r}"
            wrap = "clamp" if look.clamp else "repeat"
            textures[key] = Texture(pictures.read(where, data), (wrap, wrap))
        textured[number] = len(materials)
        materials.append(_material(name, look, textures[key]))
        shown.append(look)
    labels = np.where(has_uv, textured[used.labels], used.labels)
    uv = _uv(statements, labels, shown) if textures else None
    return Appearance(tuple(materials), labels, uv, colours)


def _material(name: str, look: Look, texture: Texture | None) -> Material:
    """Return a material; a texture takes the place of its colour."""
    *colour, alpha = look.colour
    red, green, blue = (1.0, 1.0, 1.0) if texture else to_linear(np.array(colour)).tolist()
    return Material(name, (red, green, blue, alpha), texture)


def _uv(statements: Statements, labels: np.ndarray, looks: list[Look]) -> np.ndarray:
    """Return the coordinates of the corners, (F, 3, 2), with v down, by the looks of materials."""
    rows = np.concatenate([statements.uv, [(0.0, 0.0)]])  # -1 is the last
    uv = rows[statements.corners]
    if any(look[3:] != BLANK[3:] for look in looks):
        scale, offset = (np.array([look[i] for look in looks])[labels, None] for i in (3, 4))
        uv = uv * scale + offset
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv


# ---- material libraries


def _library(file: str, companions: Companions) -> dict[str, Look]:
    """Return the materials of a library by name; MeshError names its line."""
    data = companions.read(file, "material library")
    found: dict[str, Look] = {}
    name = None
    for line, row in enumerate(data.splitlines(), 1):
        row = row.partition(b"#")[0]
        words = row.split()
        if not words:
            continue
        try:
            if words[0] == b"newmtl":
                name = name_of(row.split(None, 1)[1]) if len(words) > 1 else ""
                found.setdefault(name, BLANK)
            elif name is not None:
                found[name] = _changed(found[name], words, row)
        except MeshError as error:
            where = f"{companions.name}: {printable(file)[:80]}, line {line}"
            raise MeshError(f"{where}: {error}") from None
    return found


def _changed(look: Look, words: list[bytes], row: bytes) -> Look:
    """Return a material with what a statement of its library says."""
    what = words[0]
    if what == b"Kd":
        if words[1:2] in ([b"spectral"], [b"xyz"]):
            raise MeshError("Kd is not red, green and blue: export it so")
        numbers = [_share(word) for word in words[1:4]]
        numbers = numbers * 3 if len(numbers) == 1 else numbers
        if len(numbers) != 3:
            raise MeshError("Kd has not 3 numbers: correct it")
        return look._replace(colour=[*numbers, look.colour[3]])
    if what in (b"d", b"Tr") and len(words) > 1:
        number = _share(words[-1])
        return look._replace(colour=[*look.colour[:3], number if what == b"d" else 1 - number])
    if what == b"map_Kd":
        return _mapped(look, [text_of(word) for word in words[1:]], text_of(row))
    return look


def _mapped(look: Look, words: list[str], row: str) -> Look:
    """Return a material with the texture that map_Kd names after its options."""
    options: dict[str, Any] = {}
    at = 0
    while at < len(words) and words[at] in (*NUMBERS_OF, *WORD_OPTIONS):
        option, at = words[at], at + 1
        if option in WORD_OPTIONS:
            options[option], at = words[at : at + 1], at + 1
            continue
        numbers = []
        while (
            at + 1 < len(words)
            and len(numbers) < NUMBERS_OF[option]
            and (n := _number(words[at])) is not None
        ):
            numbers.append(n)
            at += 1
        options[option] = numbers
    words = words[at:]
    if not words:
        raise MeshError("map_Kd names no picture: correct it")
    picture = row[row.rindex(words[0]) :] if len(words) == 1 else row[row.index(words[0]) :]
    scale, offset = [*options.get("-s", []), 1.0, 1.0], [*options.get("-o", []), 0.0, 0.0]
    clamp = options.get("-clamp") == ["on"]
    return look._replace(
        picture=picture.strip(), clamp=clamp, scale=(scale[0], scale[1]),
        offset=(offset[0], offset[1]),
    )  # fmt: skip


def _number(word: str) -> float | None:
    try:
        number = float(word)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _share(word: bytes) -> float:
    """Return a number from 0 to 1, which a word is or is next to."""
    number = _number(text_of(word))
    if number is None:
        raise MeshError(f"{shown(word)} is not a number: correct it")
    return min(max(number, 0.0), 1.0)


def name_of(text: bytes) -> str:
    """Return the name of a group or a material."""
    return printable(text.strip().decode("utf-8", "replace"))


def text_of(text: bytes) -> str:
    """Return the name of a file; bytes that are no UTF-8 stay as they are."""
    return os.fsdecode(text.strip())
