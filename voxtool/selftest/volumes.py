"""Volumes of stiff cells, extreme transfer functions and isosurfaces: against quadrature and
clipping in float64.

Kernels: kernels/selftest/segments.cl.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from voxtool.camera import Camera
from voxtool.choices import METHODS
from voxtool.opencl import Device
from voxtool.pictures.rendering import render
from voxtool.selftest import reference, shapes
from voxtool.selftest.case import Case, case
from voxtool.selftest.isosurfaces import isosurfaces
from voxtool.selftest.stiff_volumes import BOUNDS, error_of
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh

SOURCE = "selftest/segments.cl"
GROUP = 64
WEIGHTS = 1e-6  # of each: what kernels/tets/pictures/segment.h promises
NEAR = 2e-5  # of a colour: float32 planes, depths and scalars
ROUNDED = 2.0**-23  # of the range of scalars: two roundings of a float32 from 1/2 to 1
SEEN = 1e-30  # light that is let through counts down to this
SLIVER = 1e-9  # of a cube: a cell's volume
PICTURES = "pictures: every cell clipped on every ray, float64"
ISOSURFACES = "pictures: segments cut at the isovalues, float64"
CLEAR = TransferFunction([0.0], [[0.0, 0.0, 0.0]], [0.0])  # pyright: ignore[reportArgumentType]
GREY = TransferFunction([0.0], [[0.5, 0.5, 0.5]], [0.7])  # pyright: ignore[reportArgumentType]


def weights(device: Device, a: np.ndarray, b: np.ndarray, lanes: int | None = None) -> np.ndarray:
    """Return (3, N) float64 of float32: w_f, w_b and zeta of segments, as rays of this device
    have."""
    lanes = lanes or device.lanes
    count = len(a)
    padded = -(-count // (GROUP * lanes)) * GROUP * lanes
    ends = [device.put(np.resize(v, padded)) for v in (a, b)]
    found = [device.empty(padded, np.float32) for _ in range(3)]
    weigh = device.kernel(SOURCE, "weigh", LANES=lanes)
    weigh(padded // lanes, *ends, *found, local=GROUP)
    return np.stack([f.get(stop=count) for f in found]).astype(np.float64)


def weight_error(device: Device, a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest relative error of weights and of transmittances."""
    found = weights(device, a, b)
    front, back = a.astype(np.float64), b.astype(np.float64)
    through = np.exp(-(front + back) / 2)
    expected = np.stack([*reference.weights(front, back), through])
    counts = expected > [[0], [0], [SEEN]]
    error = np.abs(found - expected)
    return float((error[counts] / expected[counts]).max())


@case("segments of optical depth 1e-7 to 1e4", "their weights: quadrature in float64", "relative",
      WEIGHTS)  # fmt: skip
def segments(device: Device, full: bool) -> float:
    random, count = np.random.default_rng(1), 100_000 if full else 3000
    sizes = np.exp(random.uniform(math.log(1e-7), math.log(1e4), (3, count)))
    share = random.uniform(-1, 1, count)
    a = np.concatenate([sizes[0], sizes[1] * (1 - share)]).astype(np.float32)
    b = np.concatenate([sizes[2], sizes[1] * (1 + share)]).astype(np.float32)
    edges = np.array([1e-7, 1e-5, 0.1, 0.25, 1, 4, 8, 80, 1e3, 1e4], np.float32)
    a, b = np.append(a, np.repeat(edges, len(edges))), np.append(b, np.tile(edges, len(edges)))
    return weight_error(device, a, b)


@case("segments of alike and of zero ends", "their weights: quadrature in float64", "relative",
      WEIGHTS)  # fmt: skip
def ends(device: Device, full: bool) -> float:
    random, count = np.random.default_rng(2), 30_000 if full else 1000
    a = np.exp(random.uniform(math.log(1e-7), math.log(1e4), count)).astype(np.float32)
    far = np.float32(np.inf)
    alike = a * (1 + random.uniform(-1e-4, 1e-4, count)).astype(np.float32)
    b = np.concatenate([a, np.nextafter(a, far), np.nextafter(a, -far), alike, 0 * a])
    a = np.tile(a, 5)
    return max(weight_error(device, *pair) for pair in ((a, b), (b, a)))


def wavy_block(seed: int, cubes: int = 4) -> UnstructuredMesh:
    """Return cubes cut in six each, with moved corners and a scalar that bends; in [-1, 1] or
    so."""
    points, cells = shapes.tetrahedra(*[np.linspace(-1, 1, cubes + 1)] * 3)
    points = points + np.random.default_rng(seed).uniform(-0.4, 0.4, points.shape) / cubes
    x, y, z = points.T
    return UnstructuredMesh(points, [("tetra", cells)], x * (1 - x * x / 3) + y * z, "s")


def picture_error(
    device: Device, mesh: UnstructuredMesh, transfer: TransferFunction, full: bool
) -> float:
    """Return the largest error of a colour in pictures by both methods, beyond the change when all
    scalars move by ROUNDED of their range, which shows if a ray runs along a step."""
    points, cells, scalars = mesh.points, mesh.cells[0][1], np.asarray(mesh.scalars)
    moved = ROUNDED * np.ptp(scalars)
    volume, error = build_tet(mesh, device=device), 0.0
    low, high = points.min(axis=0), points.max(axis=0)
    views = product(("iso", "left", "top"), (None, 30.0, 100.0)) if full else [("iso", None)]
    for view, fov in views:
        rays = Camera.fit(low, high, view, fov=fov).rays(*((80, 64) if full else (40, 32)))
        expected, less, more = (
            reference.reference(points, cells, scalars + shift, transfer, rays)
            for shift in (0, -moved, moved)
        )
        allowed = np.maximum(np.abs(less - expected), np.abs(more - expected))
        if not expected[:, 3].max() > 0.1:
            return math.inf  # nothing is seen
        for method in METHODS:
            picture = render(volume, rays, transfer=transfer, method=method, device=device)
            found = picture.reshape(-1, 4)
            error = max(error, float((np.abs(found - expected) - allowed).max()))
    return error


def wavy_error(device: Device, full: bool, seed: int, at: list, extinctions: list) -> float:
    """Return the largest error of pictures of wavy blocks, with random colours at the control
    points."""
    colours = np.random.default_rng(seed).random((len(at), 3))
    transfer = TransferFunction(np.array(at), colours, np.array(extinctions))
    blocks = map(wavy_block, range(5 if full else 1))
    return max(picture_error(device, block, transfer, full) for block in blocks)


@case("control points 1e-6 apart", PICTURES, "of a colour", NEAR)
def control_points(device: Device, full: bool) -> float:
    near = 1e-6
    at = [-1.5, -0.3, -0.3 + near, 0.2 - near, 0.2, 0.2 + near, 1.5]
    return wavy_error(device, full, 3, at, [0.3, 0.3, 3.0, 0.5, 3.0, 0.5, 2.0])


@case("step functions", PICTURES, "of a colour", NEAR)
def steps(device: Device, full: bool) -> float:
    at = [-0.7, -0.7, -0.2, -0.2, 0.1, 0.1, 0.6, 0.6]
    return wavy_error(device, full, 4, at, [0.0, 0.8, 0.8, 0.0, 0.0, 5.0, 5.0, 0.2])


def layers(thin: float) -> np.ndarray:
    """Return planes from -1 to 1, two pairs of which are so near each other."""
    return np.cumsum([-1, 0.7, thin, 0.6, thin, 0.7])


def sheared(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> UnstructuredMesh:
    """Return the boxes between planes across each axis, cut in six each and sheared."""
    points, cells = shapes.tetrahedra(x, y, z)
    x, y, z = points.T
    moved = np.stack([x + 0.15 * z, y + 0.1 * x, z + 0.2 * y], axis=1)
    return UnstructuredMesh(moved, [("tetra", cells)], x - y + x * z, "s")


@case("slivers of 1e-9 relative volume", PICTURES, "of a colour", NEAR)
def slivers(device: Device, full: bool) -> float:
    error, thick = 0.0, np.linspace(-1, 1, 4)
    for thin in (SLIVER, 1e-5, 1e-7) if full else (SLIVER,):
        mesh = sheared(thick, thick, layers(thin))
        colours = np.random.default_rng(5).random((4, 3))
        transfer = TransferFunction(np.linspace(-3, 3, 4), colours, np.array([0.5, 2, 0.1, 1]))
        error = max(error, picture_error(device, mesh, transfer, full))
    return error


@case("rays along edges of cells", "through vertices, edges and faces: 1 - exp(-depth)",
      "of a colour", WEIGHTS)  # fmt: skip
def edges(device: Device, full: bool) -> float:
    cubes, error = 8, 0.0
    points, cells = shapes.tetrahedra(*[np.linspace(-1, 1, cubes + 1)] * 3)
    mesh = UnstructuredMesh(points, [("tetra", cells)], points[:, 0], "s")
    volume, step = build_tet(mesh, device=device), 2 / cubes
    expected = -math.expm1(-2 * float(GREY.extinctions[0]))
    for parts in (1, 2, 3, 7) if full else (1, 2):
        size = (cubes + 1) * parts
        at = (np.arange(size) + 0.5 - size / 2) * step / parts
        inside = (np.abs(at) < 1)[:, None] & (np.abs(at) < 1)
        for axis, method in product(range(3), METHODS):
            rays = shapes.rays_along(axis, 5 * np.eye(3)[axis], step / parts, size)
            picture = render(volume, rays, transfer=GREY, method=method, device=device)
            opacity = picture[..., 3][inside]
            error = max(error, float(np.abs(opacity - expected).max()))
    return error


def isosurface_error(device: Device, mesh: UnstructuredMesh, values: list[float]) -> float:
    """Return the largest error of a colour in pictures of isosurfaces by both methods; where the
    hits of a ray change when all scalars move by ROUNDED of their range, any of these is right."""
    points, cells, scalars = mesh.points, mesh.cells[0][1], np.asarray(mesh.scalars)
    moved, error = ROUNDED * np.ptp(scalars), 0.0
    volume, tint = build_tet(mesh, device=device), (1.0, 0.5, 0.25, 0.5)
    for fov in (None, 30.0):
        camera = Camera.fit(points.min(axis=0), points.max(axis=0), fov=fov).turned(75.0)
        rays = camera.rays(40, 32)
        right = np.stack([
            isosurfaces(points, cells, scalars + shift, CLEAR, rays, values, tint)
            for shift in (0, -moved, moved)
        ])  # fmt: skip
        if not (right[0, :, 3] > 0).mean() > 0.1:
            return math.inf  # hardly anything is seen
        for method in METHODS:
            picture = render(
                volume, rays, isovalues=values, opacity=tint[3], colour=tint[:3], method=method,
                device=device,
            )  # fmt: skip
            off = np.abs(picture.reshape(-1, 4) - right).max(axis=2).min(axis=0)
            error = max(error, float(off.max()))
    return error


@case("isosurfaces through vertices", ISOSURFACES, "of a colour", NEAR)
def at_vertices(device: Device, full: bool) -> float:
    error = 0.0
    for seed in range(5 if full else 1):
        mesh = wavy_block(seed)
        values = np.quantile(np.asarray(mesh.scalars), (0.3, 0.5, 0.7), method="nearest").tolist()
        error = max(error, isosurface_error(device, mesh, values))
    return error


@case("isosurfaces in slivers and needles", ISOSURFACES, "of a colour", NEAR)
def isosurfaces_of_slivers(device: Device, full: bool) -> float:
    thick, error = np.linspace(-1, 1, 4), 0.0
    for thin in (SLIVER, 1e-5, 1e-7) if full else (SLIVER,):
        sliver = sheared(thick, thick, layers(thin))
        needle = sheared(thick, *[layers(math.sqrt(thin))] * 2)
        for mesh in (sliver, needle):
            error = max(error, isosurface_error(device, mesh, [-0.4321, 0.1234, 0.789]))
    return error


def stiff(kind: str, name: str) -> Case:
    """Return the case of random scenes of a kind."""
    what = "pictures: layers cut by fractions, quadrature in float64"
    return case(name, what, "of a colour", BOUNDS[kind])(
        lambda device, full: error_of(device, kind, range(60 if full else 2))
    )


CASES = (
    segments, ends, control_points, steps, slivers, edges, at_vertices, isosurfaces_of_slivers,
    stiff("layers", "layers of cells down to 1e-12 thick"),
    stiff("spikes", "spikes of colours down to 1e-15 wide"),
    stiff("extreme", "extinctions of 1e2 to 1e13"),
    stiff("eyes", "eyes in planes of faces"),
    stiff("needles", "needles of cells down to 1e-7 wide"),
)  # fmt: skip
