"""voxtool bench adf: how long, how large, how wrong, how fast to ask, and beside whom."""

from __future__ import annotations

import math
from itertools import groupby
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import SEARCHES, SIGNS
from voxtool.cli import options, reports
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.adf import Exact, Hash, Row

STAGES = ("tree", "self-intersections", "moments", "sample", "signs", "winding number",
          "constrain", "examine", "refine", "hash")  # fmt: skip
SHORT = {"self-intersections": "intersect", "winding number": "winding"}
KINDS = ("random", "rays")
SIZES = "  blocks    leaves       MB  load % bits/key  hash ms"
PLACES = {"in the cube": "cube", "near the surface": "near"}


@click.command("adf")
@options.measure_options("Open3D and libigl (exact signed distances)")
@click.option(
    "--tolerances",
    type=options.List(click.FloatRange(min=0)),
    metavar="LENGTH,...",
    default="1e-3,1e-4",
    show_default=True,
    help="Errors that leaves may have, in sides of the cube.",
)
@click.option(
    "--max-level",
    type=click.IntRange(1, 21),
    default=9,
    show_default=True,
    help="As of `voxtool adf-build`.",
)
@click.option(
    "--band", type=float, metavar="WIDTH", help="As of `voxtool adf-build`.  [default: everywhere]"
)
@click.option(
    "--sign",
    type=click.Choice(SIGNS),
    help="As of `voxtool adf-build`.  [default: what suits the mesh]",
)
@click.option(
    "--points",
    type=click.IntRange(1, 100_000_000),
    default=1_000_000,
    show_default=True,
    help="Points of each measurement of queries.",
)
@reports.report_options
def command(
    models: tuple[str, ...],
    tolerances: list[float],
    max_level: int,
    band: float | None,
    sign: str | None,
    points: int,
    repeat: int,
    peers: bool,
    device: str | None,
    as_json: bool,
    **more: Any,
) -> None:
    """Time building the distance fields of MODELS, asking them, and exact distances beside them.

    Build: stages, device (their sum), host (what Python adds), build (mesh in memory to field in
    memory, and the runs' spread in %) and the perfect hash alone are in ms. Error: in sides of the
    cube, in the cube and near the surface, the share of points within the tolerance, and the leaves
    that miss it. Queries: ns a point, in each search, at random points of the cube and along rays;
    of the fastest search the ns on the device, and the points from which on building the field and
    asking it takes less time than the exact distance. Errors of peers are against voxtool's exact
    distance, in sides. With --json times are in s, unless their names say ns.

    \b
    Examples:
      voxtool bench adf bunny.obj --tolerances 1e-2,1e-3 --max-level 7
      voxtool bench adf bunny.obj --tolerances 1e-3 --band 0.01 --peers
    """
    if reports.wanted(more):
        from voxtool.bench.sweep import Sweep

        asked = Sweep(
            tolerances=tuple(tolerances), levels=(max_level,), sign=sign, queries=points,
            band=math.inf if band is None else band, repeat=repeat, peers=peers, device=device,
        )  # fmt: skip
        reports.measure_and_report(models, asked, ("adf",), as_json=as_json, **more)
        return

    from voxtool.bench.adf import measure_hash, sphere_keys, sweep
    from voxtool.bench.peers import missing
    from voxtool.opencl import open_device

    chosen = open_device(device)
    info = chosen.info
    if peers:
        for package in missing("open3d", "igl"):
            options.tell(f"peer {package} is not installed: pip install {package}")
    rows = sweep(
        list(models), tolerances, max_level=max_level, band=math.inf if band is None else band,
        sign=sign, points=points, repeat=repeat, device=str(info.index), with_peers=peers,
    )  # fmt: skip
    if as_json:
        options.print_bench(
            info, rows, max_level=max_level, band=band, sign=sign, points=points, repeat=repeat,
            sphere=vars(measure_hash(sphere_keys(), chosen, repeat)),
        )  # fmt: skip
        return
    for number, (model, group) in enumerate(groupby(rows, key=lambda row: row.model)):
        if number == 0:
            click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
            sphere = measure_hash(sphere_keys(), chosen, repeat)
            click.echo(f"perfect hash of a sphere: {hash_line(sphere)}")
        print_model(model, list(group), max_level, band)


def hash_line(found: Hash) -> str:
    return (
        f"{found.keys:,} keys in {1e3 * found.seconds:.0f} ms (±{100 * found.spread:.0f} %), "
        f"{100 * found.load:.1f} % full, {found.bits_a_key:.2f} bits a key, m {found.m}, "
        f"r {found.r}, {'with' if found.w else 'without'} w"
    )


def print_model(model: str, rows: Sequence[Row], max_level: int, band: float | None) -> None:
    """What is said of a model: four tables, a line for each tolerance or peer."""
    first = rows[0]
    where = "" if band is None else f", band {band:g}"
    click.echo(
        f"\n{model}: {first.triangles:,} triangles, sign {first.sign}, levels to {max_level}{where}"
    )
    tables = {
        "build": (build_header(), map(build_line, rows)),
        "error": (error_header(), map(error_line, rows)),
        "query": (query_header(), map(query_line, rows)),
        "exact": (exact_header(), map(exact_line, (first.exact, *first.peers))),
    }
    for name, (header, lines) in tables.items():
        click.echo(f"{name:<10}{header}")
        for line in lines:
            click.echo(line)


def build_header() -> str:
    stages = "".join(f"{SHORT.get(s, s):>10}" for s in STAGES)
    return f"{stages}    device      host     build +-%{SIZES}"


def build_line(row: Row) -> str:
    stages = "".join(
        f"{1e3 * row.stages[s]:10.1f}" if s in row.stages else f"{'-':>10}" for s in STAGES
    )
    return (
        f"{row.tolerance:<10g}{stages}{1e3 * row.device:10.1f}{1e3 * row.host:10.1f}"
        f"{1e3 * row.build:10.1f}{100 * row.spread:4.0f}{row.blocks:8,}{row.leaves:10,}"
        f"{row.bytes / 1e6:9.2f}{100 * row.hash.load:8.1f}{row.hash.bits_a_key:9.2f}"
        f"{1e3 * row.hash.seconds:9.1f}"
    )


def error_header() -> str:
    places = "".join(
        f"{f'{short} p99':>11}{'rms':>11}{'max':>11}{'within %':>10}" for short in PLACES.values()
    )
    return f"{places}   missed leaves"


def error_line(row: Row) -> str:
    places = ""
    for place in PLACES:
        found = row.error[place]
        if found["points"]:
            places += "".join(f"{found[name]:11.2e}" for name in ("p99", "rms", "max"))
            places += f"{100 * found['within']:10.2f}"
        else:
            places += f"{'-':>11}" * 3 + f"{'-':>10}"
    return f"{row.tolerance:<10g}{places}{row.missed:16,}"


def query_header() -> str:
    kinds = "".join(
        f"{kind:>8}" + "".join(f"{search:>9}" for search in SEARCHES) + "   device  break-even"
        for kind in KINDS
    )
    return f"{kinds}   upload ms"


def query_line(row: Row) -> str:
    kinds = ""
    for kind in KINDS:
        asked = {query.search: query for query in row.queries if query.points == kind}
        fastest = min(asked.values(), key=lambda query: query.ns)
        even = "never" if fastest.break_even is None else f"{fastest.break_even:,}"
        kinds += " " * 8 + "".join(f"{asked[search].ns:9.1f}" for search in SEARCHES)
        kinds += f"{fastest.device_ns:9.1f}{even:>12}"
    return f"{row.tolerance:<10g}{kinds}{1e3 * row.upload:12.2f}"


def exact_header() -> str:
    kinds = "".join(
        f"{f'{kind} ns':>12}{'rms':>11}{'max':>11}{'unsigned':>11}{'other sign':>12}"
        for kind in KINDS
    )
    return f"{'':<14}  build ms{kinds}"


def exact_line(found: Exact) -> str:
    kinds = ""
    for kind in KINDS:
        kinds += f"{found.ns[kind]:12.1f}"
        if error := found.error.get(kind):
            kinds += "".join(f"{error[name]:11.2e}" for name in ("rms", "max", "max_unsigned"))
            kinds += f"{error['other_sign']:12,}"
        else:
            kinds += f"{'-':>11}" * 3 + f"{'-':>12}"
    return f"{found.name:<24}{1e3 * found.build:10.1f}{kinds}"
