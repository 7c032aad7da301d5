"""What a sweep measures, and the words that measure one of its rows again."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from typing import Any

from voxtool.bench import tets
from voxtool.bench.timing import Runs
from voxtool.choices import MARCHING_CUBES, METHODS, MODES, SURFACE_NETS


@dataclass(frozen=True)
class Sweep:
    """What is measured, and how often.

    dims, modes, fills, fit, styles, isovalue : of voxels and surfaces, with errors at `samples`
    points; fills are the rules of solids.
    tolerances, levels, band, sign, queries : of fields, and the points that they are asked at.
    sizes, transfers, integrators : of pictures, whose errors are of `pixels` along each side; the
    smaller sizes have the first integrator alone.
    repeat : runs after a warm-up, and more of what is short until it took `seconds` in all;
    commands : whether the peak of memory is measured, by running the
    whole command in a process of its own.
    """

    dims: tuple[int, ...] = (64, 128, 256, 512)
    modes: tuple[str, ...] = MODES
    fills: tuple[str, ...] = ("auto",)
    fit: str = "uniform"
    styles: tuple[str, ...] = (MARCHING_CUBES, SURFACE_NETS)
    isovalue: float = 0.5
    samples: int = 20_000
    tolerances: tuple[float, ...] = (1e-2, 3e-3, 1e-3)
    levels: tuple[int, ...] = (5, 7)
    band: float = math.inf
    sign: str | None = None
    queries: int = 1 << 17
    sizes: tuple[int, ...] = (128, 256, 512)
    pixels: int = 64
    view: str = "iso"
    methods: tuple[str, ...] = METHODS
    transfers: tuple[str, ...] = tets.TRANSFERS
    integrators: tuple[str, ...] = tets.INTEGRATORS
    scalar: str | None = None
    component: str | None = None
    repeat: int = 3
    seconds: float = 0.0
    commands: bool = True
    peers: bool = False
    forced: bool = True
    device: str | None = None

    @property
    def runs(self) -> Runs:
        return Runs(self.repeat, self.seconds)


QUICK = Sweep(
    dims=(16, 32), styles=(MARCHING_CUBES,), samples=1000, tolerances=(1e-1, 1e-2), levels=(3,),
    queries=1 << 10, sizes=(16, 32), pixels=8, transfers=("x10",), repeat=2, commands=False,
    integrators=("linear", "average"),
)  # fmt: skip


def command(bench: str, model: str, asked: Sweep, **request: Any) -> str:
    """The words that measure a row again, for a shell."""
    words = ["voxtool", "bench", bench, model]
    for name, value in {**request, "repeat": asked.repeat, "device": asked.device}.items():
        if value is not None:
            words += [f"--{name}", str(value)]
    return shlex.join([*words, *["--peers"] * asked.peers, "-o", "report"])
