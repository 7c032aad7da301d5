"""voxtool adf-info: what a distance field holds."""

from __future__ import annotations

import json
import math
import os
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options
from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field import DistanceField


@click.command("adf-info")
@click.argument("file")
@click.option("--check", is_flag=True, help="Check every invariant.")
@click.option("--digest", is_flag=True, help="Print the SHA-256 of the content, and that alone.")
@options.json_option
def command(file: str, check: bool, digest: bool, as_json: bool) -> None:
    """Describe a distance field FILE (.adf.h5, or - for stdin).

    Lengths are in the mesh's own units; those in sides are parts of the cube's side. The digest
    covers the content, not the container: it is the same on every device.

    \b
    Examples:
      voxtool adf-info bunny.adf.h5 --check
      voxtool adf-info bunny.adf.h5 --json
    """
    from voxtool.files import read_adf

    field = read_adf(file)
    if check:
        field.validate()
    if digest and not as_json:
        click.echo(field.digest())
        return
    info = summary(field)
    if os.path.isfile(file):  # neither stdin nor a pipe
        info["file_bytes"] = os.path.getsize(file)
    if check:
        info["check"] = "ok"
    if digest:
        info["digest"] = field.digest()
    if as_json:
        options.print_json(info)
    else:
        print_text(info)


def summary(field: DistanceField) -> dict[str, Any]:
    """The content of a field, in JSON types; origin and side in world units, lengths in sides.

    `saved` has the two savings of [ADF]: of section 3.1, the blocks against eight float32 a
    leaf or, as it counts there, a cell; of section 3.2, the slots of cells that have blocks against
    slots for the leaves, too, whose identifiers are longer.
    """
    import numpy as np

    from voxtool.adf.bounds import JUMP
    from voxtool.adf.cells import cell_of, identifier_type

    n, depth = len(field.voxels), field.depth
    leaves = field.leaves_by_level()
    cells = np.bincount(cell_of(field.blocks)[0], minlength=depth + 1).tolist()
    sizes, eight = field.sizes(), 8 * field.voxels.itemsize
    identifier = field.identifiers.itemsize
    with_leaves = identifier_type(depth).itemsize + field.cells.itemsize
    jumps = field.reached.get("jumps")
    if field.bounds is not None:
        jumps = int(np.count_nonzero(field.bounds == JUMP))
    return {
        "origin": list(field.origin),
        "side": field.side,
        "units": field.units,
        "sign": field.sign,
        "tolerance": field.tolerance,
        "max_level": field.max_level,
        "band": field.band if math.isfinite(field.band) else None,
        "continuous": field.continuous,
        "lipschitz": field.lipschitz,
        "source_sha256": field.source_sha256,
        "depth": depth,
        "blocks": n,
        "leaves": sum(leaves),
        "levels": [
            {"level": level, "cells": own, "leaves": left}
            for level, (own, left) in enumerate(zip(cells, [0, *leaves], strict=True))
        ],
        "bytes": sum(sizes.values()),
        "bytes_a_leaf": sum(sizes.values()) / sum(leaves),
        "textures": sizes,
        "saved": {
            "voxels_of_leaves": 1 - sizes["voxels"] / (eight * sum(leaves)),
            "voxels_of_cells": 1 - sizes["voxels"] / (eight * 8 * n),
            "cells": 1 - (identifier + field.cells.itemsize) * n / (with_leaves * (8 * n + 1)),
        },
        "hash": {
            "m": field.hash.m,
            "r": field.hash.r,
            "w": field.hash.has_w,
            "load": field.hash.load(n),
            "bits_a_key": field.hash.bits_a_key(n),
            "identifier_bits": 8 * identifier,
        },
        "jumps": jumps,
        "reached": field.reached,
        "plan": field.plan,
    }


def print_text(info: dict[str, Any]) -> None:
    unit = f" {info['units']}" if info["units"] else ""
    side, saved, table = info["side"], info["saved"], info["hash"]
    on_disk = f", {info['file_bytes']:,} on disk" if "file_bytes" in info else ""
    rows = [
        ("origin", f"{' '.join(f'{v:.9g}' for v in info['origin'])}{unit}"),
        ("side", f"{side:.9g}{unit}"),
        ("sign", info["sign"]),
        ("tolerance", _length(info["tolerance"], side, unit)),
        ("band", "everywhere" if info["band"] is None else _length(info["band"], side, unit)),
        ("levels", f"to {info['depth']}, at most {info['max_level']} asked for"),
        ("faces", "neighbours agree" if info["continuous"] else "neighbours of other level may "
         "disagree"),
        ("steepest", f"{info['lipschitz']:.6g}"),
        ("jumps", "unknown: without bounds" if info["jumps"] is None else
         f"in {info['jumps']:,} of {info['leaves']:,} leaves"),
        ("bytes", f"{info['bytes']:,} on the device, {info['bytes_a_leaf']:.3g} a leaf{on_disk}"),
        ("hash", f"m {table['m']}, r {table['r']}, {'with' if table['w'] else 'without'} w; load "
         f"{_share(table['load'])}, {table['bits_a_key']:.3g} bits a key; identifiers of "
         f"{table['identifier_bits']} bits"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<12} {text}")
    notes = {
        "voxels": f"{_share(saved['voxels_of_leaves'])} less than eight float32 a leaf, "
        f"{_share(saved['voxels_of_cells'])} less than eight a cell",
        "cells": f"{_share(saved['cells'])} less than with leaves",
    }
    click.echo("\ntexture            bytes")
    for name, size in info["textures"].items():
        click.echo(f"{name:<8} {size:>15,}   {notes.get(name, '')}".rstrip())
    click.echo("\nlevel        cells       leaves")
    for row in info["levels"]:
        click.echo(f"{row['level']:>5} {row['cells']:>12,} {row['leaves']:>12,}")
    _print_pairs("reached", info["reached"])
    _print_pairs("left out", info["plan"].get("left_out"))
    for name in ("check", "digest"):
        if name in info:
            click.echo(f"\n{name}: {info[name]}")


def _print_pairs(title: str, pairs: Any) -> None:
    """A section of names and values, if there are any; the values of a dict on one line."""
    if not pairs or not isinstance(pairs, dict):
        return
    click.echo(f"\n{title}")
    for name, value in _flattened(pairs):
        click.echo(f"  {printable(name)}: {printable(value)}")


def _flattened(pairs: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and values; of a dict of dicts, one of each inner one."""
    for name, value in pairs.items():
        if not isinstance(value, dict):
            yield name, _shown(value)
        elif any(isinstance(inner, dict) for inner in value.values()):
            yield from ((f"{name} {inner}", text) for inner, text in _flattened(value))
        else:
            yield name, ", ".join(f"{inner} {_shown(v)}" for inner, v in value.items())


def _shown(value: Any) -> str:
    """A value as people read it."""
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.6g}"
    if type(value) is int:
        return f"{value:,}"
    if isinstance(value, list):
        return f"({', '.join(map(_shown, value))})"
    return json.dumps(value, ensure_ascii=False)


def _length(sides: float, side: float, unit: str) -> str:
    return f"{sides:.6g} sides, {sides * side:.6g}{unit}"


def _share(part: float) -> str:
    return f"{100 * part:.3g} %"
