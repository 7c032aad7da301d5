"""Voxelization against run time: the time of each stage, memory, and peers on the same work.

As the thesis's table 7.1, and beside it what the user waits for: mesh in memory to octree in
memory, and the whole command in a process of its own.
"""

from __future__ import annotations

import statistics
import tempfile
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench import peers, timing
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.opencl import open_device
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


@dataclass
class Row:
    """One model at one dim in one mode; times are medians, in seconds.

    fill : the rule of a solid, "none" for surfaces.
    stages : on the device, by its events; device : their sum; host : what Python adds, in the same
    runs; memory : mesh in memory to octree in memory, Python included, without events; spread :
    (max - min) / median of `memory`; command : the whole command, in a process of its own, kernels
    cached; peak : its peak of resident memory, in bytes; peers : seconds by name, and `ratios` :
    peer / memory.
    """

    model: str
    dim: int
    mode: str
    fill: str
    triangles: int
    voxels: int
    octree_bytes: int
    stages: dict[str, float]
    device: float
    memory: float
    host: float
    spread: float
    command: float
    peak: int
    peers: dict[str, float] = field(default_factory=dict)
    ratios: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def sweep(
    models: list[str],
    dims: list[int],
    modes: list[str],
    *,
    fills: Sequence[str] = ("auto",),
    fit: str = "uniform",
    repeat: int = 5,
    device: str | None = None,
    with_peers: bool = False,
) -> Iterator[Row]:
    """Measure every model at every dim in every mode, solids by each of `fills`, `repeat` times
    after a warm-up.

    Raises
    ------
    VoxtoolError : a model cannot be read, a dim does not fit, or a command fails.
    """
    timed = open_device(device)
    profiled = open_device(device, profile=True)
    for model in models:
        mesh, others = load_mesh(model), timing.Peers(repeat)
        for dim in dims:
            grid = Grid.fit(mesh, dim, fit=fit)
            every = [
                (mode, fill) for mode in modes for fill in (fills if mode == "solid" else ["auto"])
            ]
            for mode, fill in every:
                work = partial(voxelize, mesh, grid, mode, fill=fill)
                octree = work(device=timed)
                times = timing.times(partial(work, device=timed), repeat)
                profiled_work = partial(work, device=profiled)
                stages, whole = timing.stage_times(profiled_work, profiled, repeat)
                memory = statistics.median(times)
                on_device = sum(stages.values())
                command, peak = whole_command(model, dim, mode, fill, fit, timed.info.index)
                row = Row(
                    model=Path(model).name,
                    dim=dim,
                    mode=mode,
                    fill=octree.fill,
                    triangles=len(mesh.faces),
                    voxels=octree.count,
                    octree_bytes=octree.nbytes,
                    stages=stages,
                    device=on_device,
                    memory=memory,
                    host=whole - on_device,
                    spread=(max(times) - min(times)) / memory,
                    command=command,
                    peak=peak,
                )
                if with_peers:
                    row.peers = others.medians(peers.of(mesh, grid, mode))
                    row.ratios = {name: t / memory for name, t in row.peers.items()}
                yield row


def whole_command(
    model: str, dim: int, mode: str, fill: str, fit: str, device: int
) -> tuple[float, int]:
    """Seconds and peak resident bytes of `voxtool voxelize` in a process of its own."""
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        return timing.command(
            *("voxelize", model, "-q", "--dim", str(dim), "--mode", mode, "--fit", fit),
            *("--fill", fill, "--device", str(device), "-o", str(Path(folder, "out.svo.h5"))),
        )
