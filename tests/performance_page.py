"""Measure the tables of docs/performance.md and write them there.

    python -m tests.performance_page MODELS

MODELS is the folder with the models that the dictionary MODELS names. Each table is a stage, kept
in build/performance: run the command again to go on. A table stands in the page between
<!-- table NAME --> and <!-- end -->, after the command that measures it. Where a stage did not
finish, its table stays as it is.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import voxtool
from tests.gpu_report import Result, run_stages
from voxtool.bench.points import exponent
from voxtool.version import __version__

ROOT = Path(__file__).parents[1]
LIMIT = 2400  # seconds that a stage may take
HERE, PAGE = ROOT / "build/performance", ROOT / "docs/performance.md"
MODELS = {
    "bunny.obj": "stanford-bunny.obj",
    **{
        name: name
        for name in ("armadillo.obj", "teapot.obj", "suzanne.obj", "nefertiti.obj", "bluntfin.vtu")
    },
}
Point = dict[str, Any]
Rows = Iterable[Iterable[str]]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.performance_page", description=__doc__)
    parser.add_argument("models", type=Path)
    parser.add_argument("--seconds", type=float, default=3600, help="start no stage later")
    parser.add_argument("--only", default="", help="a pattern: commands to run")
    given = parser.parse_args()
    models = given.models.resolve()
    HERE.mkdir(parents=True, exist_ok=True)
    os.chdir(HERE)
    for name, source in MODELS.items():
        if not Path(name).exists():
            shutil.copy(models / source, name)
    commands = {f"python -m {words} -o {name}": name for name, (words, _) in TABLES.items()}
    commands |= {command: name for name, command in SCRIPTS.items()}
    results = run_stages(list(commands), Path("kept"), given.seconds, given.only, limit=LIMIT)
    info = voxtool.open_device().info
    device = f"{info.name}, {info.platform} {info.driver}"
    where = f"{device}, {datetime.date.today()}, voxtool {__version__}"
    page = PAGE.read_text(encoding="utf-8")
    missing = 0
    for command, found in results.items():
        name = commands[command]
        if found is None or found.code != 0:
            print(f"{name}: {found.verdict if found else 'not run'}")
            missing += 1
            continue
        page = with_table(page, name, command, where, found)
    PAGE.write_text(page, encoding="utf-8")
    return bool(missing)


def with_table(page: str, name: str, command: str, where: str, found: Result) -> str:
    """The page with another table of this name."""
    if name in SCRIPTS:
        body = found.output[found.output.index("|") :].rstrip()
    else:
        points = json.loads(Path(name, "report.json").read_text("utf-8"))["points"]
        body = markdown(TABLES[name][1](points))
    shown = command.replace("python -m voxtool", "voxtool").replace(f"{ROOT}/", "")
    shown = shown.removesuffix(f" -o {name}")
    text = f"```sh\n{shown}\n```\n\n{where}.\n\n{body}"
    begin, end = f"<!-- table {name} -->", "<!-- end -->"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if not pattern.search(page):
        raise SystemExit(f"{PAGE.name} has no place for the table {name}: add {begin} and {end}")
    return pattern.sub(lambda _: f"{begin}\n{text}\n\n{end}", page)


def markdown(rows: Rows) -> str:
    """A table: the first row is its head, and columns of numbers are aligned right."""
    head, *body = [list(row) for row in rows]
    numbers = (
        all(re.fullmatch(r"[-\d.,e ]*", cell) for cell in column)
        for column in zip(*body, strict=True)
    )
    rule = ["---:" if right else "---" for right in numbers]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, rule, *body))


# ---- values


def ms(point: Point) -> str:
    """The median time in ms, with three digits."""
    return digits(1e3 * point["seconds"]["median"])


def digits(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def share(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}".replace("e-0", "e-")


def ratio(point: Point | None, ours: Point) -> str:
    return "" if point is None else digits(point["seconds"]["median"] / ours["seconds"]["median"])


def own(points: list[Point], **named: str) -> list[Point]:
    """The points of voxtool, with these values."""
    return [p for p in points if not p["peer"] and all(p[k] == v for k, v in named.items())]


def peers_of(points: list[Point], ours: Point) -> dict[str, Point]:
    """The points of other tools on the same work, by the tool's name."""
    same = ("bench", "model", "work", "label")
    return {
        p["method"].split(",")[0]: p
        for p in points
        if p["peer"] and all(p[k] == ours[k] for k in same)
    }


# ---- tables


def voxels(points: list[Point]) -> Rows:
    yield ["dim", "mode", "ms", "command, s", "peak, MB", "octree, kB", "other tool", "ms", "ratio"]
    for p in own(points):
        others = [(name, q) for name, q in peers_of(points, p).items()
                  if q["method"].endswith(p["setting"]["modes"])]  # fmt: skip
        name, best = min(others, key=lambda o: o[1]["seconds"]["median"], default=("", None))
        yield [
            p["label"].removeprefix("dim "), p["setting"]["modes"], ms(p),
            f"{p['figures']['command']:.2f}", f"{p['peak'] / 1e6:,.0f}", f"{p['bytes'] / 1e3:,.0f}",
            name, ms(best) if best else "", ratio(best, p),
        ]  # fmt: skip


def winding(points: list[Point]) -> Rows:
    yield ["model", "dim", "parity, ms", "winding, ms", "ratio", "flood, ms"]
    for first in own(points, method="solid, parity"):
        same = {name: first[name] for name in ("model", "label")}
        (other,) = own(points, **same, method="solid, winding")
        (flooded,) = own(points, **same, method="solid, flood")
        yield [first["model"], first["label"].removeprefix("dim "), ms(first), ms(other),
               ratio(other, first), ms(flooded)]  # fmt: skip


def surfaces(points: list[Point]) -> Rows:
    yield ["model", "dim", "style", "ms", "command, s", "triangles", "VTK, ms", "ratio"]
    for p in own(points):
        beside = None
        if p["method"] == "marching-cubes":
            beside = next((q for name, q in peers_of(points, p).items() if "VTK" in name), None)
        figures = p["figures"]
        command = figures.get("command")  # none of fractions
        yield [p["model"], p["label"].removeprefix("dim "), p["method"], ms(p),
               "" if command is None else f"{command:.2f}", f"{figures['triangles']:,.0f}",
               ms(beside) if beside else "",
               ratio(beside, p)]  # fmt: skip


def fields(points: list[Point]) -> Rows:
    yield ["model", "field", "build, ms", "leaves", "size, MB", "99 % of errors, in the cube",
           "near the surface"]  # fmt: skip
    for p in own(points, work="mesh to field"):
        errors = p["errors"]
        yield [p["model"], f"{p['method']}, {p['label']}", ms(p), f"{p['size']:,.0f}",
               f"{p['bytes'] / 1e6:.1f}", share(errors.get("p99")),
               share(errors.get("p99 near the surface"))]  # fmt: skip


def queries(points: list[Point]) -> Rows:
    yield ["points", "method", "ns a point", "99 % of errors, sides", "largest error, sides"]
    for p in points:
        if p["work"].startswith("distances at"):
            yield [p["work"].removeprefix("distances at "), f"{p['method']} {p['label']}".strip(),
                   digits(p["figures"]["ns a point"]), share(p["errors"].get("p99")),
                   share(p["errors"].get("max"))]  # fmt: skip


def distances(points: list[Point]) -> Rows:
    yield ["model", "work", "method", "ms", "ns a point", "largest error, sides"]
    for p in points:
        each = p["figures"].get("ns a point")  # of distances between meshes there is none
        yield [p["model"], f"{p['work']} {p['label']}".strip(), p["method"], ms(p),
               "" if each is None else digits(each), share(p["errors"].get("max"))]  # fmt: skip


def pictures(points: list[Point]) -> Rows:
    yield ["picture", "ms", "times Embree", "pixels with another outline"]
    for p in points:
        beside = p["figures"].get("times a peer")
        yield [f"{p['method']} {p['label']}".strip(), ms(p), digits(beside) if beside else "",
               share(p["errors"].get("outline"))]  # fmt: skip


def volumes(points: list[Point]) -> Rows:
    yield ["transfer function", "method", "pixels", "first, ms", "frame, ms", "beside", "RMS",
           "largest"]  # fmt: skip
    for p in points:
        if p["first"] is None:
            continue  # isosurfaces have no transfer function
        ours = own(points, work=p["work"], label=p["label"])[0]
        yield [p["work"].removeprefix("frames through "), p["method"], p["label"],
               digits(1e3 * p["first"]), ms(p), ratio(p, ours) if p["peer"] else "",
               share(p["errors"].get("rms")), share(p["errors"].get("max"))]  # fmt: skip


def growth(points: list[Point]) -> Rows:
    yield ["model", "work", "grows", "from", "to", "ms", "exponent"]
    for model, work, method in dict.fromkeys((p["model"], p["work"], p["method"]) for p in points):
        found = own(points, model=model, work=work, method=method)
        p = exponent([(one["size"], one["seconds"]["median"]) for one in found])
        first, last = (f"{found[i]['size']:,.0f}" for i in (0, -1))
        yield [model, method, found[0]["size_of"], first, last, " ".join(map(ms, found)),
               "" if p is None else f"{p:.2f}"]  # fmt: skip


def scale(points: list[Point]) -> Rows:
    yield ["work", "method", "dim", "ms", "size, kB"]
    for p in points:
        size = "" if p["bytes"] is None else f"{p['bytes'] / 1e3:,.0f}"
        yield [p["work"], p["method"], p["label"].removeprefix("dim "), ms(p), size]


SCRIPTS = {  # which print a table
    "large": "python -m tests.large_work armadillo.obj bunny.obj nefertiti.obj",
    "workers": "python -m tests.cluster_gain armadillo.obj",
    "small": f"python {ROOT / 'examples/call_costs.py'} bunny.obj",
    "frames": "python -m tests.frame_rates bunny.obj bluntfin.vtu",
}
BENCH = "voxtool bench"
TABLES: dict[str, tuple[str, Callable[[list[Point]], Rows]]] = {
    "voxels": (f"{BENCH} voxelize bunny.obj --dims 64,256,512,1024 --fills parity --peers "
               "--samples 0 --no-ablate", voxels),
    "winding": (f"{BENCH} voxelize bunny.obj teapot.obj armadillo.obj --dims 512,1024,2048 "
                "--modes solid --fills parity,winding,flood --samples 0 --no-ablate", winding),
    "surfaces": (f"{BENCH} extract bunny.obj --dims 64,256,1024,2048 --fills parity --styles "
                 "marching-cubes,surface-nets --peers --samples 0 --no-ablate", surfaces),
    "fields": (f"{BENCH} adf bunny.obj armadillo.obj --tolerances 1e-3,1e-4 --levels 9 "
               "--band 0.01 --points 1000000 --no-ablate --repeat 1", fields),
    "queries": (f"{BENCH} adf bunny.obj --tolerances 1e-4 --levels 9 --band 0.01 "
                "--points 1000000 --peers --no-ablate --repeat 1", queries),
    "distances": (f"{BENCH} distance bunny.obj armadillo.obj --points 1000000 --grids 64",
                  distances),
    "pictures": (f"{BENCH} pictures bunny.obj --dims 1024 --levels 9 --tolerances 1e-3 --sizes 512 "
                 "--peers", pictures),
    "volumes": (f"{BENCH} tets bluntfin.vtu --scalar density --peers --methods raycast "
                "--integrators linear --repeat 5", volumes),
    "scale": (f"{BENCH} scale bunny.obj --dims 512,2048 --peers", scale),
    "growth": (f"{BENCH} growth suzanne.obj bluntfin.vtu --scalar density --triangles 4000000 "
               "--dims 64,256,1024,2048,8192 --levels 4,6,8,9 --tolerances 1e-3 "
               "--sizes 64,256,1024,2048 --repeat 1", growth),
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
