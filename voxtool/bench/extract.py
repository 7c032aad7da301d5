"""Extraction against run time: cubes, times of stages, memory, error, and peers on the same work.

As the thesis's table 7.3 and, beside it, what the user waits for: octree in memory to surface in
memory, and the whole command in a process of its own.
"""

from __future__ import annotations

import statistics
import tempfile
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import peers, timing
from voxtool.choices import MARCHING_CUBES
from voxtool.files import write_svo
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.morton import morton_encode
from voxtool.opencl import open_device
from voxtool.spatial.deviation import deviation
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree
from voxtool.svo.surface.extract import extract
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass
class Row:
    """One model at one dim in one style; times are medians, in seconds.

    samples : along a side of the grid; cubes : those of the thesis, nodes and NullCubes, at level
    0 (None at others); tiles : cubes of the tiles that were looked at, 64 at once; cut : cubes that
    are cut, which alone are looked at one by one. stages : on the device, by its events; device :
    their sum; host : what Python adds, in the same runs; memory : octree in memory to surface in
    memory, Python included; spread : (max - min) / median of `memory`; command : the whole command,
    in a process of its own, kernels cached; peak : its peak of resident memory, in bytes; error :
    deviation from the model; peers : seconds by name, the dense grid included, and `ratios` : peer
    / memory.
    """

    model: str
    dim: int
    style: str
    level: int | str
    samples: int
    cubes: int | None
    tiles: int
    cut: int
    vertices: int
    triangles: int
    stages: dict[str, float]
    device: float
    memory: float
    host: float
    spread: float
    command: float
    peak: int
    error: dict[str, Any]
    peers: dict[str, float] = field(default_factory=dict)
    ratios: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def sweep(
    models: list[str],
    dims: list[int],
    styles: list[str],
    *,
    isovalue: float = 0.5,
    repeat: int = 5,
    samples: int = 100_000,
    device: str | None = None,
    with_peers: bool = False,
) -> Iterator[Row]:
    """Measure every model at every dim in every style, `repeat` times after a warm-up.

    Raises
    ------
    VoxtoolError : a model cannot be read, a dim does not fit, or a command fails.
    """
    timed = open_device(device)
    profiled = open_device(device, profile=True)
    for model in models:
        mesh, others = load_mesh(model), timing.Peers(repeat)
        for dim in dims:
            grid = Grid.fit(mesh, dim)
            octree = voxelize(mesh, grid, "solid", device=timed)
            for style in styles:
                work = partial(extract, octree, style=style, isovalue=isovalue)
                surface = work(device=timed)
                times = timing.times(partial(work, device=timed), repeat)
                profiled.stage_times()
                stages, whole = timing.stage_times(partial(work, device=profiled), profiled, repeat)
                memory = statistics.median(times)
                on_device = sum(stages.values())
                command, peak = whole_command(octree, style, isovalue, timed.info.index)
                pitch = max(grid.pitch)
                row = Row(
                    model=Path(model).name,
                    dim=dim,
                    style=style,
                    level=surface.level,
                    samples=-(-dim // surface.side),
                    cubes=visited_cubes(octree) if surface.level == 0 else None,
                    tiles=BRICK_SIDE**3 * surface.tiles,
                    cut=surface.cubes,
                    vertices=len(surface.points),
                    triangles=len(surface.faces),
                    stages=stages,
                    device=on_device,
                    memory=memory,
                    host=whole - on_device,
                    spread=(max(times) - min(times)) / memory,
                    command=command,
                    peak=peak,
                    error=deviation(surface.mesh(), mesh, samples, pitch=pitch, device=timed),
                )
                if with_peers and style == MARCHING_CUBES:
                    row.peers = others.medians(peers.of_octree(octree, isovalue))
                    row.ratios = {name: t / memory for name, t in row.peers.items()}
                yield row


def visited_cubes(octree: Octree) -> int:
    """How many cubes have a corner in a level 0 node: the nodes and the thesis's NullCubes (section
    4.1), every one of which its algorithm looks at."""
    cells = octree.levels()[-1].cells // BRICK_SIDE
    for axis in range(3):
        below = cells[cells[:, axis] > 0]
        below[:, axis] -= 1
        cells = np.concatenate([cells, below])
        cells = cells[np.unique(morton_encode(cells), return_index=True)[1]]
    return len(cells)


def whole_command(octree: Octree, style: str, isovalue: float, device: int) -> tuple[float, int]:
    """Seconds and peak resident bytes of `voxtool extract` in a process of its own, to a PLY."""
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        source = str(Path(folder, "in.svo.h5"))
        write_svo(octree, source)
        return timing.command(
            *("extract", source, "-q", "--style", style, "--isovalue", str(isovalue)),
            *("--device", str(device), "-o", str(Path(folder, "out.ply"))),
        )
