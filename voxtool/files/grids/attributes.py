"""The attributes of voxels that an export holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from voxtool.errors import VoxtoolError
from voxtool.files.formats import EXCHANGE, ending
from voxtool.svo.octree.attributes import KINDS

PAINTED = ("colour", "label")  # of palettes, the first that is there
NONE = "none"  # instead of names: the occupancy alone


def chosen_attributes(
    content: Any, name: str, asked: str | Sequence[str] | None, other: Sequence[str]
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the attributes of an octree that its export holds, and what is left out, with the
    reason.

    Parameters
    ----------
    content : what is exported.
    name : the format.
    asked : names, or "none"; None: all that the format can hold, the label if it holds one.
    other : the given options that ask for other values than set voxels have.

    Raises
    ------
    VoxtoolError
        If the octree has no such attribute, or the format holds none, or only one.
    """
    found, left_out = _chosen(content, name, asked, other)
    if "colour" in found and not EXCHANGE[name].opacity:
        left_out = {**left_out, "opacity of colours": f"{ending(name)} holds red, green and blue"}
    return found, left_out


def _chosen(
    content: Any, name: str, asked: str | Sequence[str] | None, other: Sequence[str]
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the attributes that an export holds, and which are left out, with the reason."""
    names = asked.split(",") if isinstance(asked, str) else asked
    there = [one.name for one in getattr(content, "attributes", ())]
    holds = EXCHANGE[name].attributes
    if names is not None and list(names) != [NONE]:
        return _asked(content, name, tuple(names), other), {}
    if not there or names is not None:
        return (), {}
    left = f"attributes {', '.join(there)}"
    if EXCHANGE[name].hexahedra:
        lost = [one for one in there if one != "label"]
        why = f"{ending(name)} holds labels, as materials"
        return (), {f"attributes {', '.join(lost)}": why} if lost else {}
    if not holds:
        return (), {left: f"{ending(name)} holds none"}
    if other:
        return (), {left: f"they are of set voxels, and {other[0]} asks for other values"}
    if holds == "all":
        lost = _not_held(name, there)
        why = f"{ending(name)} holds {', '.join(EXCHANGE[name].kinds)}"
        kept = tuple(one for one in there if one not in lost)
        return kept, {f"attributes {', '.join(lost)}": why} if lost else {}
    first = ("label",) if "label" in there else ()
    if holds == "palette":
        first = tuple(name for name in PAINTED if name in there)[:1]
    rest = [other for other in there if other not in first]
    what = "a palette of colours or labels" if holds == "palette" else "one array"
    why = f"{ending(name)} holds {what}: choose it by --attribute"
    return first, {f"attributes {', '.join(rest)}": why} if rest else {}


def _not_held(name: str, names: Sequence[str]) -> list[str]:
    """Return those of some attributes that a format cannot hold."""
    kinds = EXCHANGE[name].kinds
    return [one for one in names if kinds and one not in kinds]


def _asked(
    content: Any, name: str, names: tuple[str, ...], other: Sequence[str]
) -> tuple[str, ...]:
    """Return the names that were asked for, checked."""
    holds = EXCHANGE[name].attributes
    if not hasattr(content, "attribute"):  # a field, a volume, or an octree without nodes in memory
        raise VoxtoolError(
            f"this has no attribute {names[0]!r}: voxelize with it, and export the .svo.h5"
        )
    for one in names:
        if one not in KINDS:
            raise VoxtoolError(
                f"attribute {one!r} is unknown: choose one of {', '.join(KINDS)}, or none"
            )
        content.attribute(one)
    if len(set(names)) < len(names):
        raise VoxtoolError(f"attributes {', '.join(names)}: name each once")
    if not holds:
        known = ", ".join(ending(key) for key, each in EXCHANGE.items() if each.attributes)
        raise VoxtoolError(f"{ending(name)} holds no attributes of voxels: choose {known}")
    if holds == "palette" and (wrong := [one for one in names if one not in PAINTED]):
        raise VoxtoolError(f"{ending(name)} holds colours or labels, not {wrong[0]}: choose one")
    if lost := _not_held(name, names):
        held = ", ".join(EXCHANGE[name].kinds)
        raise VoxtoolError(
            f"{ending(name)} holds {held}, and not {lost[0]}: choose .vtkhdf or .npz"
        )
    if holds in ("one", "palette") and len(names) > 1:
        known = ", ".join(ending(key) for key, each in EXCHANGE.items() if each.attributes == "all")
        raise VoxtoolError(f"{ending(name)} holds one attribute: name one, or choose {known}")
    if other:
        raise VoxtoolError(
            f"attributes are of set voxels, and {other[0]} asks for other values: drop one"
        )
    return names
