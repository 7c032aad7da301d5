"""voxtool diagnose: what is wrong with a mesh, where, and what to do about it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options
from voxtool.errors import VoxtoolError, count_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from voxtool.grid import Grid
    from voxtool.mesh.loops import Loops
    from voxtool.mesh.mesh import Mesh
    from voxtool.mesh.topology import Topology
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree

FLAT = 1e-12  # of the cube of its longest side, up to which a shell encloses nothing
TUBE = 2e-3  # radius of a tube about a loop, of the mesh's longest side
LITTLE = 10  # times fewer voxels than by flood, from which on winding has found little
LISTED = 1000  # faces, edges or rows in a list
SHOWN = {"loops": 8, "patches": 4, "shells": 6}  # lines in the text


@click.command("diagnose")
@click.argument("mesh")
@click.option(
    "--dim",
    type=click.IntRange(8, 65536),
    default=256,
    show_default=True,
    help="Voxels along the longest side, for the rows that leak and the fill rules.",
)
@click.option(
    "--obj",
    metavar="FILE.obj",
    help="Write the boundary loops as thin tubes, a mesh that any viewer shows.",
)
@click.option("--no-clobber", is_flag=True, help="Refuse to replace an existing file.")
@click.option("--strict", is_flag=True, help="Exit 1 if something is wrong.")
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    mesh: str,
    dim: int,
    obj: str | None,
    no_clobber: bool,
    strict: bool,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Say what is wrong with a triangle MESH, where, and what to do about it.

    MESH is an OBJ, STL, PLY, OFF or GLB file, .gz too, or - for stdin. Lengths and places are in
    the mesh's own units; sizes also in voxels of a grid of --dim, on which the fill rules of
    voxelize are compared. Vertices at one position are one; faces are counted from 0.

    \b
    Examples:
      voxtool diagnose open.obj
      voxtool diagnose open.obj --obj leaks.obj
      voxtool diagnose bunny.obj --json --strict
    """
    from voxtool.choices import FILLS
    from voxtool.files import check_target, format_of, write_mesh
    from voxtool.files.mesh import load_mesh
    from voxtool.grid import Grid
    from voxtool.mesh.loops import tubes
    from voxtool.opencl import open_device

    rules = [fill for fill in FILLS if fill != "auto"]
    if obj is not None:
        if obj == "-":
            raise click.UsageError("stdout has the report: name a file for --obj")
        format_of(obj, ("obj",))
        check_target(obj, not no_clobber)
        if os.path.exists(obj) and os.path.exists(mesh) and os.path.samefile(mesh, obj):
            raise click.UsageError(f"{obj} is MESH itself: name another file")
    with options.Progress(["read mesh", "topology", "crossed faces", "nesting", *rules]) as bar:
        bar.enter("read mesh")
        loaded = load_mesh(mesh)
        chosen = open_device(device, profile=verbose)
        report, loops = examine(loaded, Grid.fit(loaded, dim), rules, chosen, bar)
        if obj is not None:
            low, high = loaded.bounds
            drawn = tubes(loaded.vertices[loops.edges], TUBE * float((high - low).max()))
            write_mesh(drawn, obj, not no_clobber, "obj")
    if as_json:
        options.print_json(report)
    else:
        print_text(report)
    if obj is not None:
        what = count_of(len(loops.closed), "boundary loop")
        options.tell(f"{mesh if mesh != '-' else 'stdin'} -> {obj}: {what} as tubes")
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")
    if strict and report["faults"]:
        faults = "; ".join(fault["what"] for fault in report["faults"])
        raise VoxtoolError(f"{loaded.name or 'mesh'}: {faults} (--strict)")


# ---- what is found, in JSON types


def examine(
    mesh: Mesh, grid: Grid, rules: list[str], device: Device, progress: options.Progress
) -> tuple[dict[str, Any], Loops]:
    """What there is to say of a mesh, with the fill rules on this grid; and its boundary loops."""
    import numpy as np

    from voxtool.mesh.loops import find_loops
    from voxtool.mesh.mesh import Mesh
    from voxtool.mesh.topology import (
        check_surface,
        closed_chain,
        collinear,
        repeated_faces,
        topology_of,
    )
    from voxtool.spatial.bvh import build_tree
    from voxtool.spatial.self_intersections import find_crossings
    from voxtool.svo.voxelize import fill_for, voxelize

    progress.enter("topology")
    topology = topology_of(mesh)
    counts = check_surface(mesh)
    loops = find_loops(mesh, topology)
    flat = collinear(mesh.vertices[mesh.faces])
    progress.enter("crossed faces")
    repeated = repeated_faces(topology)
    crossed = np.zeros(len(mesh.faces), bool)
    distinct = Mesh(mesh.vertices, mesh.faces[~repeated])
    tree = build_tree(device, distinct, flat[~repeated].astype(np.uint8))
    crossed[~repeated] = find_crossings(device, distinct, tree)
    low, high = mesh.bounds
    report: dict[str, Any] = {
        "mesh": mesh.name,
        "units": mesh.units,
        "source_sha256": mesh.source_sha256,
        "diagnosis": counts.as_dict(),
        "low": low.tolist(),
        "high": high.tolist(),
        "dim": grid.dim,
        "pitch": grid.pitch[0],
        "loops": loops_of(loops),
        "t_junctions": len(loops.closed) > 0 and closed_chain(mesh),
        "crowded_edges": crowded_of(mesh, topology),
        "duplicate_faces": faces_of(mesh, repeated),
        "degenerate_faces": faces_of(mesh, flat),
        "crossed_faces": faces_of(mesh, crossed),
    }
    progress.enter("nesting")
    report |= parts_of(mesh, topology, loops, device)
    octrees = {}
    for rule in rules:
        progress.enter(rule)
        octrees[rule] = voxelize(mesh, grid, fill=rule, device=device)
    report |= fills_of(octrees, report, fill_for(counts.watertight))
    report["faults"] = list(faults_of(report))
    return report, loops


def loops_of(loops: Loops) -> list[dict[str, Any]]:
    """Every boundary loop, the longest first."""
    middles, extents = loops.low + (loops.high - loops.low) / 2, loops.high - loops.low
    columns = loops.sizes, loops.lengths, middles, extents, loops.closed
    names = "edges", "length", "centre", "size", "closed"
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [dict(zip(names, row, strict=True)) for row in rows]


def crowded_of(mesh: Mesh, topology: Topology) -> list[dict[str, Any]]:
    """The first of the edges of more than two faces."""
    from voxtool.mesh.topology import crowded_edges

    edges, faces = crowded_edges(mesh, topology)
    ends = mesh.vertices[edges[:LISTED]].tolist()
    return [
        {"faces": n, "ends": pair} for n, pair in zip(faces[:LISTED].tolist(), ends, strict=True)
    ]


def faces_of(mesh: Mesh, chosen: np.ndarray) -> dict[str, Any]:
    """How many faces are chosen, the first of them, and where the very first is."""
    import numpy as np

    faces = np.flatnonzero(chosen)
    first = mesh.vertices[mesh.faces[faces[:1]]].mean(axis=1).tolist()
    return {"count": len(faces), "centre": (first or [None])[0], "faces": faces[:LISTED].tolist()}


def parts_of(mesh: Mesh, topology: Topology, loops: Loops, device: Device) -> dict[str, Any]:
    """The shells and how they are nested, and the patches that are flipped or have one side."""
    import numpy as np

    from voxtool.mesh.shells import find_patches, find_shells
    from voxtool.spatial.nesting import nest

    shells, patches = find_shells(mesh, topology, loops), find_patches(mesh, topology)
    nesting = nest(mesh, shells, device)
    columns = {
        "faces": shells.faces,
        "closed": shells.closed,
        "consistent": shells.consistent,
        "volume": shells.volumes,
        "loops": shells.loops,
        "low": shells.low,
        "high": shells.high,
        "parent": nesting.parents,
        "depth": nesting.depths,
    }
    values = zip(*(column.tolist() for column in columns.values()), strict=True)
    rows = [dict(zip(columns, row, strict=True)) for row in values]
    for row in rows:
        row["volume"] = row["volume"] if row["volume"] == row["volume"] else None  # NaN
        row["parent"] = row["parent"] if row["parent"] >= 0 else None
    for row in rows:
        row["is"] = role_of(row, rows)
    of_patch = np.argsort(patches.of, kind="stable")
    starts = np.searchsorted(patches.of[of_patch], np.arange(len(patches.areas) + 1))
    flipped = []
    for patch in np.flatnonzero(patches.flipped).tolist():
        faces = of_patch[starts[patch] : starts[patch + 1]]
        points = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        flipped.append(
            {
                "faces": len(faces),
                "first": int(faces[0]),
                "area": float(patches.areas[patch]),
                "centre": (low + (high - low) / 2).tolist(),
                "size": (high - low).tolist(),
            }
        )
    one_sided = int(np.count_nonzero(patches.one_sided))
    return {
        "shells": rows,
        "patches": {"count": len(patches.areas), "one_sided": one_sided, "flipped": flipped},
    }


def role_of(shell: dict[str, Any], shells: list[dict[str, Any]]) -> str:
    """What a shell is among the others."""
    volume = shell["volume"]
    if not shell["closed"]:
        return "open"
    if volume is None:
        return "mixed"
    side = max(b - a for a, b in zip(shell["low"], shell["high"], strict=True))
    if abs(volume) <= FLAT * side**3:
        return "flat"
    around = shells[shell["parent"]]["volume"] if shell["depth"] else None
    if around is None:
        return "solid" if volume > 0 else "inside out"
    if (volume > 0) == (around > 0):
        return "nested alike"
    return "solid" if volume > 0 else "cavity"


def fills_of(octrees: dict[str, Octree], found: dict[str, Any], auto: str) -> dict[str, Any]:
    """What each fill rule sets, which is recommended, and the rows that leak by parity."""
    from voxtool.svo.compare import count_differences, leaking_rows

    counts = {rule: octree.count for rule, octree in octrees.items()}
    fill, why = recommended_fill(found, auto, counts)
    rules = {}
    for rule, octree in octrees.items():
        extra, missing = count_differences(octree, octrees[fill])
        rules[rule] = {"voxels": counts[rule], "missing": missing, "extra": extra}
    sure = (
        found["diagnosis"]["watertight"]
        and not found["degenerate_faces"]["count"]
        and not meets_itself(found)
    )
    rows = leaking_rows(octrees["parity"])
    _, ny, nz = octrees["parity"].grid.shape
    return {
        "leaking_rows": {
            "count": len(rows),
            "of": ny * nz,
            "low": rows.min(axis=0).tolist() if len(rows) else None,
            "high": rows.max(axis=0).tolist() if len(rows) else None,
            "rows": rows[:LISTED].tolist(),
        },
        "auto": auto,
        "fills": rules,
        "recommended": {
            "fill": fill,
            "sign": "pseudonormal" if sure else "winding",
            "why": why,
        },
    }


def meets_itself(found: dict[str, Any]) -> bool:
    """Whether parts of a mesh overlap, or are nested and wound alike."""
    return found["crossed_faces"]["count"] > 0 or "nested alike" in roles(found)


def roles(found: dict[str, Any]) -> list[str]:
    return [shell["is"] for shell in found["shells"]]


def recommended_fill(found: dict[str, Any], auto: str, counts: dict[str, int]) -> tuple[str, str]:
    """The fill rule that suits a mesh, and why."""
    if not found["diagnosis"]["watertight"] and LITTLE * counts["winding"] < counts["flood"]:
        if sum(shell["volume"] or 0 for shell in found["shells"]) < 0:
            return "flood", (
                "its faces point inwards: turn them over and fill by winding, or find a --gap that "
                "closes its holes"
            )
        return "flood", (
            "its faces hardly tell what is inside: flood sets its surface and what that closes off"
        )
    if auto != "parity":
        return auto, "it holds where a mesh is open, doubled or wound both ways"
    if meets_itself(found):
        return "nonzero", "parts that overlap or nest are united, where parity cuts them out"
    return auto, "the mesh is closed, and the rules agree on it"


def faults_of(found: dict[str, Any]) -> Iterator[dict[str, str]]:
    """What is wrong, in words, and what mends it."""
    patches, role = found["patches"], roles(found)
    flipped = sum(patch["faces"] for patch in patches["flipped"])
    crowded = found["diagnosis"]["nonmanifold_edges"]
    repeated, flat, crossed = (
        found[f"{kind}_faces"]["count"] for kind in ("duplicate", "degenerate", "crossed")
    )
    alike = role.count("nested alike")
    by_winding = "or fill by winding"
    holes = f"close the holes, {by_winding}"
    if found["t_junctions"]:
        holes = "no holes: edges end within others (T-junctions)"
    for count, noun, more, mend in (
        (len(found["loops"]), "boundary loop", "", holes),
        (crowded, "edge", " of more than two faces", f"remove what is inside, {by_winding}"),
        (flipped, "face", " flipped", "turn them over, or fill by flood"),
        (patches["one_sided"], "patch", " with one side only", "voxelize it as a surface"),
        (repeated, "duplicate face", "", "remove them"),
        (flat, "degenerate face", "", "remove them, or leave them: voxels do not mind"),
        (crossed, "face", " crossed by others", f"unite the parts, {by_winding} or nonzero"),
        (role.count("inside out"), "shell", " inside out", "turn the faces over"),
        (alike, "shell", " wound like the one around it", f"turn cavities over, {by_winding}"),
    ):
        if count:
            yield {"what": f"{_counted(count, noun)}{more}", "mend": mend}


# ---- and in words


def print_text(found: dict[str, Any]) -> None:
    """One screen of text."""
    counts, units = found["diagnosis"], f" {found['units']}" if found["units"] else ""
    size = [b - a for a, b in zip(found["low"], found["high"], strict=True)]
    state = "closed" if counts["closed"] else "not closed"
    _row(
        "mesh",
        f"{_counted(counts['faces'], 'face')}, {_counted(counts['vertices'], 'vertex')}, "
        f"{_counted(counts['shells'], 'shell')}; {'watertight' if counts['watertight'] else state}",
    )
    _row("box", f"{_by(size)}{units}, from {_point(found['low'])} to {_point(found['high'])}")
    _row("voxel", f"{found['pitch']:.6g}{units} at dim {found['dim']}")
    print_loops(found["loops"], found["pitch"])
    first = found["crowded_edges"][:1]
    _row(
        "edges",
        f"{counts['nonmanifold_edges']:,} of more than two faces"
        + "".join(f", the first from {_point(edge['ends'][0])}" for edge in first)
        + f"; {counts['inconsistent_edges']:,} whose two faces disagree",
    )
    _row("vertices", f"{counts['nonmanifold_vertices']:,} of more than one fan of faces")
    print_patches(found["patches"], found["pitch"])
    for kind in ("duplicate", "degenerate", "crossed"):
        faces = found[f"{kind}_faces"]
        text = _counted(faces["count"], "face")
        if faces["count"]:
            text += f", the first is {faces['faces'][0]:,} at {_point(faces['centre'])}"
        _row(kind, text)
    print_shells(found["shells"])
    print_fills(found)
    for fault in found["faults"]:
        _row("wrong", f"{fault['what']}: {fault['mend']}")
    if not found["faults"]:
        _row("wrong", "nothing")
    best = found["recommended"]
    chosen = ", as auto does" if best["fill"] == found["auto"] else ""
    _row("advice", f"voxelize --fill {best['fill']}{chosen}: {best['why']}")
    _row("", f"adf-build --sign {best['sign']}")


def print_loops(loops: list[dict[str, Any]], pitch: float) -> None:
    edges = sum(loop["edges"] for loop in loops)
    _row("loops", f"{len(loops):,}, of {_counted(edges, 'edge')} of one face")
    if loops:
        click.echo("              length    voxels   edges   centre; size in voxels")
    for loop in loops[: SHOWN["loops"]]:
        ends = "" if loop["closed"] else ", not closed"
        click.echo(
            f"  {loop['length']:>18.6g} {loop['length'] / pitch:>9.1f} {loop['edges']:>7,}   "
            f"{_point(loop['centre'])}; {_by([x / pitch for x in loop['size']], 3)}{ends}"
        )
    _more(loops, "loops")


def print_patches(patches: dict[str, Any], pitch: float) -> None:
    flipped, one_sided = patches["flipped"], patches["one_sided"]
    more = f", {one_sided:,} with one side only" if one_sided else ""
    _row("patches", f"{patches['count']:,}, {len(flipped):,} flipped{more}")
    for patch in flipped[: SHOWN["patches"]]:
        click.echo(
            f"  {patch['faces']:>18,} faces, the first is {patch['first']:,}   "
            f"{_point(patch['centre'])}; {_by([x / pitch for x in patch['size']], 3)}"
        )
    _more(flipped, "patches")


def print_shells(shells: list[dict[str, Any]]) -> None:
    _row("shells", f"{len(shells):,}, {sum(shell['is'] == 'open' for shell in shells):,} open")
    for number, shell in enumerate(shells[: SHOWN["shells"]]):
        what = shell["is"] + ("" if shell["parent"] is None else f", within {shell['parent']}")
        volume = "no volume" if shell["volume"] is None else f"volume {shell['volume']:.6g}"
        capped = f", {_counted(shell['loops'], 'loop')} capped" if shell["loops"] else ""
        click.echo(f"  {number:>4} {what:<22} {shell['faces']:>12,} faces, {volume}{capped}")
    _more(shells, "shells")


def print_fills(found: dict[str, Any]) -> None:
    leaking, place = found["leaking_rows"], ""
    if leaking["count"]:
        (y0, z0), (y1, z1) = leaking["low"], leaking["high"]
        place = f", in y {y0:,} to {y1:,} and z {z0:,} to {z1:,}"
    _row("rows", f"{leaking['count']:,} of {leaking['of']:,} along x leak by parity{place}")
    best = found["recommended"]["fill"]
    click.echo(f"fill               voxels       missing         extra   beside {best}")
    for rule, row in found["fills"].items():
        click.echo(f"  {rule:<8} {row['voxels']:>14,} {row['missing']:>13,} {row['extra']:>13,}")


def _row(name: str, text: str) -> None:
    click.echo(f"{name:<12} {text}")


def _more(rows: list[Any], kind: str) -> None:
    if len(rows) > SHOWN[kind]:
        click.echo(f"  and {len(rows) - SHOWN[kind]:,} more: --json lists all")


def _counted(count: int, noun: str) -> str:
    return count_of(count, noun).replace(str(count), f"{count:,}", 1)


def _point(point: list[float]) -> str:
    return f"({', '.join(f'{x:.5g}' for x in point)})"


def _by(sizes: list[float], digits: int = 5) -> str:
    return " x ".join(f"{x:.{digits}g}" for x in sizes)
