"""A report on a mesh, in words: one screen of text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from voxtool.errors import count_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.diagnosis.report import Report

SHOWN = {"loops": 8, "patches": 4, "shells": 6}  # rows of each table


def lines(report: Report) -> Iterator[str]:
    """Yield the lines of a report."""
    counts, units = report.diagnosis, f" {report.units}" if report.units else ""
    size = [b - a for a, b in zip(report.low, report.high, strict=True)]
    state = "closed" if counts.closed else "not closed"
    yield _row(
        "mesh",
        f"{counted(counts.faces, 'face')}, {counted(counts.vertices, 'vertex')}, "
        f"{counted(counts.shells, 'shell')}; {'watertight' if counts.watertight else state}",
    )
    yield _row("box", f"{_by(size)}{units}, from {_point(report.low)} to {_point(report.high)}")
    yield _row("voxel", f"{report.pitch:.6g}{units} at dim {report.dim}")
    yield from _loop_lines(report)
    first = report.crowded_edges[:1]
    yield _row(
        "edges",
        f"{counts.nonmanifold_edges:,} of more than two faces"
        + "".join(f", the first from {_point(edge['ends'][0])}" for edge in first)
        + f"; {counts.inconsistent_edges:,} whose two faces disagree",
    )
    yield _row("vertices", f"{counts.nonmanifold_vertices:,} of more than one fan of faces")
    yield from _patch_lines(report)
    for name, faces in (
        ("duplicate", report.duplicate_faces),
        ("degenerate", report.degenerate_faces),
        ("intersecting", report.self_intersecting_faces),
    ):
        text = counted(faces["count"], "face")
        if faces["count"]:
            text += f", the first is {faces['faces'][0]:,} at {_point(faces['centre'])}"
        if faces is report.self_intersecting_faces and report.undecided_faces:
            text += f"; {report.undecided_faces:,} more are near too many others to be tested"
        yield _row(name, text)
    yield from _shell_lines(report)
    yield from _fill_lines(report)
    for fault in report.faults:
        yield _row("wrong", f"{fault.what}: {fault.hint}")
    if not report.faults:
        yield _row("wrong", "nothing")
    best = report.recommended
    chosen = ", as auto does" if best["fill"] == report.auto else ""
    if best["fill"] == "auto":
        chosen = f", which takes {report.auto}"
    yield _row("advice", f"voxelize --fill {best['fill']}{chosen}: {best['why']}")


def _loop_lines(report: Report) -> Iterator[str]:
    loops, pitch = report.loops, report.pitch
    edges = sum(loop["edges"] for loop in loops)
    yield _row("loops", f"{len(loops):,}, of {counted(edges, 'edge')} of one face")
    if loops:
        yield "              length    voxels   edges   centre; size in voxels"
    for loop in loops[: SHOWN["loops"]]:
        ends = "" if loop["closed"] else ", not closed"
        yield (
            f"  {loop['length']:>18.6g} {loop['length'] / pitch:>9.1f} {loop['edges']:>7,}   "
            f"{_point(loop['centre'])}; {_by([x / pitch for x in loop['size']], 3)}{ends}"
        )
    yield from _more(loops, "loops")


def _patch_lines(report: Report) -> Iterator[str]:
    patches, pitch = report.patches, report.pitch
    flipped, one_sided = patches["flipped"], patches["one_sided"]
    more = f", {one_sided:,} with one side only" if one_sided else ""
    yield _row("patches", f"{patches['count']:,}, {len(flipped):,} flipped{more}")
    for patch in flipped[: SHOWN["patches"]]:
        yield (
            f"  {patch['faces']:>18,} faces, the first is {patch['first']:,}   "
            f"{_point(patch['centre'])}; {_by([x / pitch for x in patch['size']], 3)}"
        )
    yield from _more(flipped, "patches")


def _shell_lines(report: Report) -> Iterator[str]:
    shells = report.shells
    is_open = sum(shell["is"] == "open" for shell in shells)
    yield _row("shells", f"{len(shells):,}, {is_open:,} open")
    for number, shell in enumerate(shells[: SHOWN["shells"]]):
        what = shell["is"] + ("" if shell["parent"] is None else f", within {shell['parent']}")
        volume = "no volume" if shell["volume"] is None else f"volume {shell['volume']:.6g}"
        capped = f", {counted(shell['loops'], 'loop')} capped" if shell["loops"] else ""
        yield f"  {number:>4} {what:<22} {shell['faces']:>12,} faces, {volume}{capped}"
    yield from _more(shells, "shells")


def _fill_lines(report: Report) -> Iterator[str]:
    leaking, place = report.leaking_rows, ""
    if leaking["count"]:
        (y0, z0), (y1, z1) = leaking["low"], leaking["high"]
        place = f", in y {y0:,} to {y1:,} and z {z0:,} to {z1:,}"
    yield _row("rows", f"{leaking['count']:,} of {leaking['of']:,} along x leak by parity{place}")
    best = report.recommended["fill"]
    kept = f"surface kept, of {report.outer_surface:,}"
    yield f"fill               voxels       missing         extra   beside {best}; {kept}"
    for rule, row in report.fills.items():
        share = f"{100 * row['share']:.1f} %"
        columns = f"{row['voxels']:>14,} {row['missing']:>13,} {row['extra']:>13,}"
        yield f"  {rule:<8} {columns} {share:>9}"


def _row(name: str, text: str) -> str:
    return f"{name:<12} {text}"


def _more(rows: list[Any], kind: str) -> Iterator[str]:
    if len(rows) > SHOWN[kind]:
        yield f"  and {len(rows) - SHOWN[kind]:,} more: --json lists all"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: "1 vertex", "2,000 vertices"."""
    return count_of(count, noun).replace(str(count), f"{count:,}", 1)


def _point(point: list[float]) -> str:
    return f"({', '.join(f'{x:.5g}' for x in point)})"


def _by(sizes: list[float], digits: int = 5) -> str:
    return " x ".join(f"{x:.{digits}g}" for x in sizes)
