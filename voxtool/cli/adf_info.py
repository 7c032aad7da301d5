"""voxtool adf-info: what a distance field holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.cli.info import describe, info_options, normalized, place, section, sizes, table

if TYPE_CHECKING:
    from collections.abc import Iterator

SHOWN = ("missed", "errors")  # of what the build reached


@click.command("adf-info")
@click.argument("file")
@info_options
def command(file: str, **asked: bool) -> None:
    """Describe a distance field FILE (.adf.h5, or - for stdin).

    Lengths are in the mesh's own units; those in sides are parts of the cube's side. The digest
    covers the content, not the container: it is the same on every device.

    \b
    Examples:
      voxtool adf-info bunny.adf.h5 --check
      voxtool adf-info bunny.adf.h5 --json
    """
    from voxtool.files import read_adf

    describe(file, read_adf(file), text_of, **asked)


def text_of(info: dict[str, Any], verbose: bool) -> Iterator[str]:
    """Yield the lines of a summary, if verbose with how it is stored."""
    unit = f" {info['units']}" if info["units"] else ""
    side = info["side"]

    def length(sides: float | None) -> str:
        return "everywhere" if sides is None else f"{sides:.6g} sides, {sides * side:.6g}{unit}"

    yield from table((
        ("origin", f"{place(info['origin'])}{unit}"),
        ("side", f"{side:.9g}{unit}"),
        *normalized(*info["transform"]),
        ("sign", info["sign"]),
        ("tolerance", length(info["tolerance"])),
        ("band", length(info["band"])),
        ("levels", f"to {info['depth']}, at most {info['max_level']} asked for"),
        ("leaves", f"{info['leaves']:,}"),
        ("faces", "neighbours agree" if info["continuous"] else "neighbours of other level may "
         "disagree"),
        *([] if info["jumps"] == 0 else [("jumps", jumps(info))]),
        *sizes(info, verbose, f", {info['bytes_a_leaf']:.3g} a leaf"),
    ))  # fmt: skip
    if verbose:
        yield from stored(info)
    reached = info["reached"]
    shown = reached if verbose else {name: reached[name] for name in SHOWN if name in reached}
    yield from section("reached", shown)


def jumps(info: dict[str, Any]) -> str:
    """Return in how many leaves the sign jumps."""
    if info["jumps"] is None:
        return "unknown: without bounds"
    return f"in {info['jumps']:,} of {info['leaves']:,} leaves, as across a hole"


def stored(info: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of how a field is stored."""
    saved, hashed = info["saved"], info["hash"]
    yield from table((
        ("steepest", f"{info['lipschitz']:.6g}"),
        ("hash", f"m {hashed['m']}, r {hashed['r']}, {'with' if hashed['w'] else 'without'} w; "
         f"load {percent(hashed['load'])}, {hashed['bits_a_key']:.3g} bits a key; identifiers of "
         f"{hashed['identifier_bits']} bits"),
    ))  # fmt: skip
    notes = {
        "voxels": f"{percent(saved['voxels_of_leaves'])} less than eight float32 a leaf, "
        f"{percent(saved['voxels_of_cells'])} a cell",
        "cells": f"{percent(saved['cells'])} less than with leaves",
    }
    yield "\ntexture            bytes   x, y, z, channels"
    for name, size in info["textures"].items():
        texels = " x ".join(map(str, info["shapes"][name]))
        yield f"{name:<8} {size:>15,} {texels:>19}   {notes.get(name, '')}".rstrip()
    yield "\nlevel        cells       leaves"
    for row in info["levels"]:
        yield f"{row['level']:>5} {row['cells']:>12,} {row['leaves']:>12,}"


def percent(part: float) -> str:
    return f"{100 * part:.3g} %"
