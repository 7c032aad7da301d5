"""The request of a benchmark, and the command line that measures one of its points again."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from typing import Any

from voxtool.choices import (
    MARCHING_CUBES,
    METHODS,
    MODES,
    POINT_FILLS,
    SEARCHES,
    SHARP,
    SURFACE_NETS,
)

KINDS = ("random", "rays")  # of points: quasi-random ones, and those along rays, in order
INTEGRATORS = ("linear", "average", "preintegrated", "sampled:1", "sampled:4", "sampled:16")
TRANSFERS = ("x1", "x10", "x100", "steps")
SETTINGS = {  # the fields of a Request that each bench reads
    "voxelize": ("dims", "modes", "fills", "fit", "samples"),
    "extract": ("dims", "fills", "styles", "isovalue", "samples"),
    "surfaces": ("tolerances", "levels", "samples"),
    "adf": ("tolerances", "levels", "band", "fill", "points", "kinds", "searches"),
    "distance": ("points", "fill", "grids", "fills"),
    "pictures": ("sizes", "view", "dims", "levels", "tolerances", "fill"),
    "tets": ("sizes", "pixels", "view", "methods", "integrators", "transfers", "scalar",
             "component"),
    "view": ("dims", "levels", "tolerances", "fill", "scalar", "component"),
    "fractions": ("dims",),
    "attributes": ("dims",),
    "exchange": ("dims",),
    "combine": ("dims",),
    "morph": ("dims",),
    "scale": ("dims",),
    "repair": ("dims", "samples"),
    "degenerate": ("triangles",),
    "plans": (),
    "growth": ("triangles", "dims", "levels", "tolerances", "sizes", "cells", "scalar",
               "component"),
}  # fmt: skip

MESH_BENCHES = ("voxelize", "extract", "adf", "surfaces", "distance", "pictures", "view",
                "exchange", "combine", "morph", "fractions", "attributes", "scale",
                "repair", "growth")  # fmt: skip
VOLUME_BENCHES = ("tets", "view", "growth")


@dataclass(frozen=True)
class Request:
    """The settings to measure, as `voxtool bench` describes its options, and how often. The
    defaults are those of `voxtool bench all`.

    Attributes
    ----------
    sphere_level : the depth of the sphere whose cells are hashed.
    repeat, seconds : runs after a warm-up; short work has more, until it took these seconds.
    commands : True to run whole commands in their own process, for their time and memory.
    ablations : True to force decisions of plans.
    """

    dims: tuple[int, ...] = (64, 128, 256, 512)
    modes: tuple[str, ...] = MODES
    fills: tuple[str, ...] = ("auto", "parity")
    fit: str = "uniform"
    styles: tuple[str, ...] = (MARCHING_CUBES, SURFACE_NETS, SHARP)
    isovalue: float = 0.5
    samples: int = 20_000
    tolerances: tuple[float, ...] = (1e-2, 3e-3, 1e-3)
    levels: tuple[int, ...] = (5, 7)
    band: float = math.inf
    fill: str = POINT_FILLS[0]
    sphere_level: int = 10
    points: int = 1 << 17
    kinds: tuple[str, ...] = KINDS
    searches: tuple[str, ...] = SEARCHES
    grids: tuple[int, ...] = (32, 64)
    sizes: tuple[int, ...] = (128, 256, 512)
    pixels: int = 64
    view: str = "iso"
    methods: tuple[str, ...] = METHODS
    integrators: tuple[str, ...] = INTEGRATORS
    transfers: tuple[str, ...] = TRANSFERS
    triangles: int = 1_200_000
    cells: int = 1_600_000
    scalar: str | None = None
    component: str | None = None
    repeat: int = 3
    seconds: float = 0.2
    commands: bool = True
    peers: bool = False
    ablations: bool = True
    device: str | None = None

    def command(self, bench: str, model: str, **setting: Any) -> str:
        """Return the shell command that measures one point again: `setting` replaces fields."""
        words = ["voxtool", "bench", bench, model]
        for name in (*SETTINGS[bench], "repeat", "device"):
            value = setting.get(name, getattr(self, name))
            if value is None or value == math.inf:
                continue
            each = value if isinstance(value, tuple) else (value,)
            words += [f"--{name}", ",".join(map(str, each))]
        return shlex.join([*words, *["--peers"] * self.peers, "-o", "report"])


QUICK = Request(
    dims=(16, 32), fills=("auto",), styles=(MARCHING_CUBES,), samples=1000, tolerances=(1e-1, 1e-2),
    levels=(3,), sphere_level=4, points=1 << 10, searches=("binary",), kinds=KINDS[:1],
    grids=(16,), sizes=(16, 32), pixels=8, transfers=("x10",), integrators=("linear", "average"),
    triangles=20_000, cells=5_000, repeat=2, seconds=0.0, commands=False,
)  # fmt: skip


def benches_for(model: str) -> tuple[str, ...]:
    """Return the benches for a file, by its name."""
    return VOLUME_BENCHES if is_volume(model) else MESH_BENCHES


def is_volume(model: str) -> bool:
    """Return True if a file has volume cells, by its name."""
    from voxtool.files import VOLUME_FORMATS  # heavy: the help does without

    return model.lower().removesuffix(".gz").endswith(tuple(VOLUME_FORMATS))
