"""voxtool svo-info: what an octree holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.cli.info import describe, info_options, normalized, place, sizes, table
from voxtool.cli.options import flag, print_json
from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Iterator


@click.command("svo-info")
@click.argument("file", required=False)
@info_options
@flag("--set-digest", "Print the SHA-256 of the set of voxels, however it was made.")
@flag("--dtd", "Print the DTD of the XML, octree.dtd, and that alone; no FILE is needed.")
def command(file: str | None, *, dtd: bool, **asked: bool) -> None:
    """Describe an octree FILE (.svo.h5, .svo.xml, .voccel.xml, or - for stdin).

    Lengths and volumes are in the mesh's own units. The digest covers the content, not the
    container: it is the same for HDF5 and XML, on every device. The set digest is the same for
    equal sets of voxels of one grid, whatever their mode, fill and refinement. For merged
    subtrees (voxtool svo-dag) every line except "merged" describes the octree that they stand for.

    \b
    Examples:
      voxtool svo-info bunny.svo.h5 --check
      voxtool voxelize bunny.obj -o - | voxtool svo-info - --digest
      voxtool svo-info --dtd
    """
    if dtd:
        print_dtd(asked["as_json"])
        return
    if file is None:
        raise click.UsageError("Missing argument 'FILE'")
    from voxtool.files import open_svo

    with open_svo(file) as octree:
        describe(file, octree, text_of, **asked)


def print_dtd(as_json: bool) -> None:
    """Print the DTD, with --json as a text in an object."""
    from voxtool.files.octrees.svo_xml import DTD

    text = DTD.read_text(encoding="ascii")
    if as_json:
        print_json({"dtd": text})
    else:
        click.echo(text, nl=False)


def merged(info: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the line of a merged octree's subtrees, if it is one."""
    if "subtrees" in info:
        times = info["memory_bytes"] / info["merged_bytes"]
        yield (
            "merged",
            f"{info['subtrees']:,} distinct subtrees in place of {info['nodes']:,} nodes, in "
            f"{times:.1f} times less memory",
        )


def attributes(info: dict[str, Any], unit: str) -> Iterator[tuple[str, str]]:
    """Yield a line for each attribute of the voxels."""
    for name, one in info["attributes"].items():
        named = f" of {len(one['names']):,} names" if one["names"] else ""
        values = f"{one['values'] + one['leaves']:,} values"
        total = f", {one['sum']:.9g}{unit and unit + '^2'} in total" if "sum" in one else ""
        yield name, f"{one['dtype']}{named}, {values}{total}"


MOST_LABELS = 40  # in the text


def labels(info: dict[str, Any], unit: str) -> Iterator[str]:
    """Yield the lines of the labels: number, name, voxels and volume."""
    rows = info["attributes"].get("label", {}).get("labels", ())
    if not rows:
        return
    yield f"\n{'label':>7}          set voxels   {f'volume{unit}':<16} name"
    for row in rows[:MOST_LABELS]:
        volume = f"{row['volume']:.9g}"
        yield f"{row['label']:>7} {row['voxels']:>19,}   {volume:<16} {printable(row['name'])}"
    if len(rows) > MOST_LABELS:
        yield f"{len(rows) - MOST_LABELS:,} more: --json has them all"


def text_of(info: dict[str, Any], verbose: bool) -> Iterator[str]:
    """Yield the lines of a summary, if verbose with how it is stored."""
    from voxtool.svo.voxelization.connected.about import about_connected

    unit = f" {info['units']}" if info["units"] else ""
    size = " x ".join(map(str, info["shape"]))
    yield from table((
        ("grid", f"{size} voxels (dim {info['dim']}, depth {info['depth']})"),
        ("mode", info["mode"] + ("" if info["fill"] == "none" else f", filled by {info['fill']}")),
        ("origin", f"{place(info['origin'])}{unit}"),
        ("pitch", f"{place(info['pitch'])}{unit}"),
        *normalized(*info["transform"]),
        ("set voxels", f"{info['voxels']:,} ({100 * info['occupancy']:.3g} % of the grid)"),
        ("volume", f"{info['volume']:.9g}{unit and unit + '^3'}"),
        *([("bricks", f"{info['bricks']:,}")] if verbose else []),
        *sizes(info, verbose, f", {info['memory_bytes_with_x_pointers']:,} with x-pointers; "
               f"{info['compression']:.1f} times smaller than a dense bit grid"),
        *merged(info),
        *(("connected", line) for line in about_connected(info["plan"])),
        *attributes(info, unit),
    ))  # fmt: skip
    if verbose:
        yield from levels(info)
    yield from labels(info, unit and f" in{unit}^3")


def levels(info: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the levels."""
    distinct = "     subtrees" if "subtrees" in info else ""
    yield (
        "\nlevel   side        nodes      refined       inside          set voxels   coverage"
        + distinct
    )
    for row in info["levels"]:
        yield (
            f"{row['level']:>5} {row['side']:>6} {row['nodes']:>12,} {row['refined']:>12,} "
            f"{row['inside']:>12,} {row['voxels']:>19,} {100 * row['coverage']:>8.2f} %"
            + (f" {row['subtrees']:>12,}" if distinct else "")
        )
