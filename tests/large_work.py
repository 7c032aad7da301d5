"""Measure commands whose work is larger than the memory that they may take: a table, in Markdown.

    python -m tests.large_work armadillo.obj bunny.obj nefertiti.obj

Each command runs by itself, with --max-memory and without; its files are compared. Peak is the most
resident memory of the process, with Python, its libraries and the driver; of what it writes, the
system keeps pages beside it.
"""

from __future__ import annotations

import argparse
import filecmp
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import voxtool
from tests.performance_page import digits, markdown
from voxtool.selftest.shapes import subdivide

# Words of commands, with the dims or the limit that they take; OUT is the file that they write.
WORKS = (
    ("voxelize {armadillo} --mode surface26 --dim 8192 -o OUT", "512M"),
    ("voxelize {armadillo} --mode surface26 --dim 16384 -o OUT", "1G"),
    ("voxelize {armadillo} --mode surface26 --dim 32768 -o OUT", "2G"),
    ("voxelize {subdivided} --mode surface26 --dim 16384 -o OUT", "3G"),
    ("voxelize {bunny} --mode surface26 --dim 16384 --dag -o OUT", "1G"),
    ("voxelize {bunny} --mode surface26 --dim 2048 --attributes normal,area -o OUT", "100M"),
    ("voxelize {armadillo} --mode fraction --dim 1536 -o OUT", "40M"),
    ("adf-build {bunny} --tolerance 1e-4 --max-level 9 -o OUT", "512M"),
    ("voxelize {armadillo} --dim 8192 -o solid.svo.h5", ""),
    ("voxelize {armadillo} --mode surface26 --dim 8192 -o surface.svo.h5", ""),
    ("combine solid.svo.h5 surface.svo.h5 --op difference -o OUT", "512M"),
    ("morph solid.svo.h5 --close 4 -o OUT", "512M"),
    ("extract solid.svo.h5 --level 1 -o OUT", "512M"),
    ("export surface.svo.h5 -o OUT", "512M"),
    ("render surface.svo.h5 --level 3 -o OUT", "128M"),
)
# of the files of commands; of others .svo.h5
ENDINGS = {"extract": ".ply", "export": ".ply", "render": ".png", "adf-build": ".adf.h5"}
TIMES = 4  # that each triangle is cut in four


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.large_work", description=__doc__)
    for name in ("armadillo", "bunny", "nefertiti"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    models = {name: str(path.resolve()) for name, path in vars(given).items()}
    with tempfile.TemporaryDirectory(dir=".") as folder:
        os.chdir(folder)
        models["subdivided"] = "subdivided.ply"
        # in a process of its own: a process begins with the peak of the one that starts it
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            count = pool.submit(
                write_subdivided, models["nefertiti"], models["subdivided"]
            ).result()
        print(markdown(rows(models, count)))
        os.chdir("..")


def write_subdivided(source: str, target: str) -> int:
    """Write a mesh with each triangle cut in four, again and again; return its triangles."""
    mesh = voxtool.load_mesh(source)
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(TIMES):
        vertices, faces = subdivide((vertices, faces))
    voxtool.write_mesh(voxtool.mesh_from_arrays(vertices, faces), target)
    return len(faces)


def rows(models: dict[str, str], count: int) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    yield ["command", "--max-memory", "s", "peak, MB", "file, MB", "alone, s", "alone, peak, MB"]
    for words, limit in WORKS:
        ending = ENDINGS.get(words.split()[0], ".svo.h5")
        whole = measured(words.format(**models).replace("OUT", f"whole{ending}"))
        if not limit:
            continue
        part = measured(
            f"{words.format(**models).replace('OUT', f'part{ending}')} --max-memory {limit}"
        )
        if not filecmp.cmp(f"whole{ending}", f"part{ending}", shallow=False):
            raise SystemExit(f"{words}: the files differ")
        shown = words.format(
            armadillo="armadillo.obj", bunny="bunny.obj", subdivided=f"{count:,} triangles"
        ).removesuffix(" -o OUT")
        size = os.path.getsize(f"part{ending}")
        yield [f"`{shown}`", limit, *part, digits(size / 1e6), *whole]


def measured(words: str) -> tuple[str, str]:
    """Return the seconds and the peak in MB of a command."""
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "voxtool", *words.split(), "-q"])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{words}: exit status {status}")
    return f"{time.perf_counter() - begin:.1f}", digits(usage.ru_maxrss * 1024 / 1e6)


if __name__ == "__main__":
    main()
