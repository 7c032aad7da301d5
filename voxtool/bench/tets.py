"""Pictures of tetrahedral volumes: error against time, over methods, integrators and transfer
functions; beside them a peer, from the same orthographic viewpoint.

Errors are against voxtool.selftest.reference, which takes the mesh as it is in float64.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import peers, timing
from voxtool.camera import Camera
from voxtool.choices import METHODS
from voxtool.files import read_unstructured
from voxtool.opencl import open_device
from voxtool.selftest.reference import reference
from voxtool.tets.mesh import tetrahedra
from voxtool.tets.render import VolumeRenderer
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.tets.mesh import ConformingMesh
    from voxtool.tets.volume import TetVolume

INTEGRATORS = ("linear", "average", "preintegrated", "sampled:1", "sampled:4", "sampled:16")
TRANSFERS = ("x1", "x10", "x100", "steps")
DEPTH = 4.0  # optical, of the box's diagonal at the largest extinction of x1
SLAB = 0.1  # thickness of each slab of steps, in ranges of the scalar


@dataclass
class Frame:
    """A volume drawn by someone.

    name : a method, or a peer; first : seconds of the first frame, from textures or cells in
    memory to picture in memory; seconds : of a later one, the median; spread : (max - min) /
    median; rms, max : errors of premultiplied red, green, blue and alpha, 0 to 1.
    """

    name: str
    integrator: str
    first: float
    seconds: float
    spread: float
    rms: float
    max: float


@dataclass
class Row:
    """One model with one transfer function.

    transfer : of TRANSFERS; pixels : that errors are of, those of the ones looked at in which the
    reference has something; alpha : the largest there; frames : by method and integrator; peers :
    each as it is shown and, from the same run, what its rays find.
    """

    model: str
    cells: int
    scalar: str
    transfer: str
    pixels: int
    alpha: float
    frames: list[Frame]
    peers: list[Frame] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class View:
    """Where errors are looked at.

    rays : of the picture; pixels : (N, 2) int, column and row of every k-th pixel; expected :
    (N, 4) float64, their colours.
    """

    rays: Rays
    pixels: np.ndarray
    expected: np.ndarray

    def errors(self, found: np.ndarray) -> tuple[float, float]:
        """RMS and maximum, of (N, 4) colours."""
        seen = (self.expected[:, 3] > 0) | (found[:, 3] > 0)
        off = np.abs(found[seen].astype(np.float64) - self.expected[seen]).ravel()
        # math.fsum rounds once, whatever the order
        return math.sqrt(math.fsum(off * off) / max(len(off), 1)), float(off.max(initial=0))

    def of(self, picture: np.ndarray) -> np.ndarray:
        """The colours that a picture has there."""
        return picture[self.pixels[:, 1], self.pixels[:, 0]]


def sweep(
    models: list[str],
    scalar: str | None = None,
    component: str | None = None,
    *,
    size: int = 512,
    view: str = "iso",
    every: int = 4,
    methods: Sequence[str] = METHODS,
    integrators: Sequence[str] = INTEGRATORS,
    transfers: Sequence[str] = TRANSFERS,
    repeat: int = 5,
    device: str | None = None,
    with_peers: bool = False,
) -> Iterator[Row]:
    """Draw every model with every transfer function, `repeat` times after the first frame, which
    comes after a warm-up.

    Parameters
    ----------
    scalar, component : as voxtool.files.read_unstructured.
    size : pixels along each side; view : as Camera.fit; every : the pixels that errors are looked
        at, in both directions.

    Raises
    ------
    VoxtoolError : a model cannot be read or built.
    """
    chosen = open_device(device)
    for model in models:
        mesh = read_unstructured(model, scalar, component)
        cells = tetrahedra(mesh)
        # either method draws either layout, and only "raycast" holds scalars of cells
        volumes = {
            method: build_tet(mesh, "raycast" if mesh.constant else method) for method in methods
        }
        low, high = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
        rays = Camera.fit(low, high, view, fov=None).rays(size, size)
        pixels = np.stack(np.meshgrid(*[np.arange(0, size, every)] * 2), axis=-1).reshape(-1, 2)
        for name in transfers:
            transfer = transfer_of(name, cells)
            expected = reference(
                cells.vertices, cells.cells, cells.scalars, transfer, rays, pixels,
                constant=cells.constant,
            )  # fmt: skip
            seen = View(rays, pixels, expected)
            yield Row(
                model=Path(model).name,
                cells=len(cells.cells),
                scalar=mesh.scalar,
                transfer=name,
                pixels=int(np.count_nonzero(expected[:, 3])),
                alpha=float(expected[:, 3].max()),
                frames=[
                    measure(volume, seen, transfer, method, integrator, chosen, repeat)
                    for method, volume in volumes.items()
                    for integrator in integrators
                ],
                peers=measure_peers(cells, seen, transfer, repeat) if with_peers else [],
            )


def transfer_of(name: str, mesh: ConformingMesh) -> TransferFunction:
    """A transfer function over the range of a mesh's scalars, by its name.

    x1 goes through five colours, from transparent at the least scalar; x10 and x100 are as many
    times as opaque. steps has two slabs with jumps at their sides, as opaque as x100.
    """
    low, high = float(mesh.scalars.min()), float(mesh.scalars.max())
    diagonal = float(np.sqrt((np.ptp(mesh.vertices, axis=0) ** 2).sum()))
    most = DEPTH / diagonal
    colours = np.array([(0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 0, 0.0)])
    if name == "steps":
        sides = np.array([0.25, 0.25 + SLAB, 0.6, 0.6 + SLAB]).repeat(2)
        inside = np.array([0, 1, 1, 0, 0, 1, 1, 0.0])
        return TransferFunction(
            low + sides * (high - low), colours[[1, 1, 1, 1, 4, 4, 4, 4]], 100 * most * inside
        )
    points = np.linspace(low, high, 5)
    return TransferFunction(points, colours, int(name[1:]) * most * np.arange(5) / 4)


def measure(
    volume: TetVolume,
    view: View,
    transfer: TransferFunction,
    method: str,
    integrator: str,
    device: Device,
    repeat: int,
) -> Frame:
    """Draw a volume, `repeat` times after the first, with kernels that are compiled."""

    draw = partial(VolumeRenderer.render, rays=view.rays, transfer=transfer, method=method,
                   integrator=integrator)  # fmt: skip
    draw(VolumeRenderer(volume, device))
    start = time.perf_counter()
    renderer = VolumeRenderer(volume, device)
    picture = draw(renderer)
    first = time.perf_counter() - start
    times = timing.times(partial(draw, renderer), repeat)
    return Frame(
        method, integrator, first, *median_and_spread(times), *view.errors(view.of(picture))
    )


def measure_peers(
    mesh: ConformingMesh, view: View, transfer: TransferFunction, repeat: int
) -> list[Frame]:
    """Likewise of each peer, at most 3 times: as it is shown, and what its rays find."""
    found = []
    for peer in peers.of_volume(
        mesh.vertices, mesh.cells, mesh.scalars, transfer, view.rays, constant=mesh.constant
    ):
        (first,) = timing.times(peer.draw, 1)
        figures = first, *median_and_spread(timing.times(peer.draw, min(repeat, 3)))
        shown, rays = view.of(peer.picture()), peer.at(view.pixels)
        found.append(Frame(f"{peer.name}, shown", "linear", *figures, *view.errors(shown)))
        found.append(Frame(f"{peer.name}, rays", "linear", *figures, *view.errors(rays)))
    return found


def median_and_spread(times: list[float]) -> tuple[float, float]:
    median = statistics.median(times)
    return median, (max(times) - min(times)) / median
