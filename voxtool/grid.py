"""The grid: world coordinates <-> grid units <-> fixed point.

Voxel (i, j, k) is the closed cube [i, i+1] x [j, j+1] x [k, k+1] in grid units, its centre at
+0.5; world = origin + pitch * grid. Vertices are rounded once to 1/256 voxel, or for fractions to a
finer lattice, and everything after that is integer arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import aligned
from voxtool.choices import DEFAULT_DIM, FITS, MAX_DIM, MIN_DIM
from voxtool.errors import GridError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.mesh.mesh import Mesh

FIXED_POINT_BITS = 8  # a voxel is 2**8 units of the fixed-point lattice
FINEST_BITS = 20  # on the finest lattice: a variant of the kernels for all dims up to 512
COORDINATE_BITS = 29  # bits of coordinates there, so that products of their differences fit 64 bits
FIXED_POINT_LIMIT = (1 << 30) - 1  # units; differences of coordinates fit 32 bits
DEFAULT_MARGIN = 4
IGNORED = 1 / 512  # of a voxel that a mesh reaches beyond a grid: it is rounded off
MOST = 1e90  # extent; volumes are in the range of float64
MOVE = "move the mesh to the origin"
LEAST_PITCH = 1e-95  # of an extent of 1 / MOST
SINGLE = 2.0**-126, 2.0**127  # lengths that float32 holds to 24 bits


@dataclass(frozen=True)
class Grid:
    """An axis-aligned lattice of voxels.

    Parameters
    ----------
    shape : (3,) tuple of int
        Voxels along x, y and z, each at least 1, the largest from 8 to 65,536.
    origin : (3,) tuple of float
        World coordinates of the low corner of voxel (0, 0, 0).
    pitch : (3,) tuple of float
        World size of a voxel along x, y and z, from 1e-95 to 1e90.

    Raises
    ------
    GridError
        If a number is out of range or not finite.
    """

    shape: tuple[int, int, int]
    origin: tuple[float, float, float]
    pitch: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name, kind in (("shape", int), ("origin", float), ("pitch", float)):
            values = tuple(kind(v) for v in np.broadcast_to(getattr(self, name), 3))
            object.__setattr__(self, name, values)
        if min(self.shape) < 1 or not MIN_DIM <= max(self.shape) <= MAX_DIM:
            raise GridError(
                f"grid of {' x '.join(map(_short, self.shape))} voxels: the longest side must have "
                f"{MIN_DIM} to {MAX_DIM} voxels, and every side at least 1"
            )
        if not all(map(math.isfinite, self.origin)):
            raise GridError(f"grid origin {self.origin} is not finite")
        if not all(LEAST_PITCH <= p <= MOST for p in self.pitch):
            raise GridError(
                f"voxel size {self.pitch} is not positive, from {LEAST_PITCH:g} to {MOST:g}"
            )

    @classmethod
    def fit(
        cls,
        mesh: Mesh | None,
        dim: int | None = None,
        *,
        pitch: float | None = None,
        bbox: Sequence[float] | None = None,
        margin: int | None = None,
        fit: str = "uniform",
        lattice: Grid | None = None,
    ) -> Grid:
        """Return a grid around a mesh, or over a box.

        Parameters
        ----------
        mesh : Mesh, optional
            The mesh that the grid covers, unless a box is given.
        dim : int, optional
            Voxels along the longest side, margins included; 256 without dim and pitch.
        pitch : float, optional
            Voxel size in world units, instead of dim.
        bbox : (6,) sequence of float, optional
            Box X0 Y0 Z0 X1 Y1 Z1 in world units, which the grid covers instead of the mesh.
        margin : int, optional
            Empty voxels on each side; by default min(4, dim // 8), or 0 with bbox.
        fit : {"uniform", "stretch"}
            "uniform" makes cubic voxels. "stretch" scales each axis separately to [4, dim]
            ([voCCeL], eq. 5.1); it allows no option other than dim.
        lattice : Grid, optional
            Take the voxels of this grid's lattice: its pitch, and an origin that is whole numbers
            of voxels from its own; instead of dim, pitch and fit. Octrees of one lattice combine
            without loss.

        Returns
        -------
        Grid

        Raises
        ------
        GridError
            If options contradict each other, or the grid is out of range.
        """
        if dim is not None and pitch is not None:
            raise GridError("dim and pitch both set the voxel size: give one of them")
        if fit not in FITS:
            raise GridError(f"fit {fit!r} is neither 'uniform' nor 'stretch'")
        if lattice is not None and not (dim is pitch is None and fit == FITS[0]):
            raise GridError("a lattice has voxels of its own: drop dim, pitch and fit")
        if dim is None and pitch is None:
            dim = DEFAULT_DIM
        if dim is not None and not MIN_DIM <= dim <= MAX_DIM:
            raise GridError(f"dim {dim} is out of range: choose from {MIN_DIM} to {MAX_DIM}")
        if pitch is not None and not (math.isfinite(pitch) and pitch > 0):
            raise GridError(f"pitch {pitch} is not a positive size")
        if margin is not None and margin < 0:
            raise GridError(f"margin {margin} is negative: choose 0 or more voxels")
        low, high = _bounds(mesh, bbox)
        with np.errstate(over="ignore"):
            extent = high - low
        longest = float(extent.max())
        if not 1 / MOST <= longest <= MOST:
            where = "bbox" if bbox is not None or mesh is None else mesh.name or "mesh"
            raise GridError(
                f"{where}: an extent of {longest:g} is not within 1e±90, where volumes can be "
                "computed: scale it"
            )
        if bbox is not None and margin is None and fit != "stretch":
            margin = 0
        if lattice is not None:
            _check_resolution(low, high, np.array(lattice.pitch))
            return _on_lattice(lattice, low, high, margin)
        if fit == "stretch":
            if dim is None or bbox is not None or margin is not None:
                raise GridError("fit 'stretch' goes with dim alone: drop pitch, bbox and margin")
            extent[extent == 0] = longest  # a flat axis takes the scale of the longest
            shape, margin, pitches = np.full(3, dim), 4, extent / (dim - 4)
        else:
            if dim is not None:
                pitch, margin = _pitch_for(dim, margin, longest)
                shape = np.full(3, dim)
                if bbox is not None:  # the box need not be a cube
                    count = np.minimum(_voxel_count(extent, pitch), dim - 2 * margin)
                    shape = count + 2 * margin
            else:
                assert pitch is not None
                shape, margin = _shape_for(pitch, margin, extent)
            pitches = np.full(3, pitch)
        _check_resolution(low, high, pitches)
        return cls(tuple(shape), tuple(low - margin * pitches), tuple(pitches))

    @property
    def dim(self) -> int:
        """Voxels along the longest side."""
        return max(self.shape)

    @property
    def side(self) -> int:
        """Voxels along a side of the octree's cube: the smallest power of two >= dim."""
        return 1 << (self.dim - 1).bit_length()

    @property
    def voxel_volume(self) -> float:
        """World volume of a voxel."""
        return self.pitch[0] * self.pitch[1] * self.pitch[2]

    @property
    def exact(self) -> dict[str, list[int] | list[str]]:
        """Shape, origin and pitch without rounding, in JSON types: the grid's part of digests."""
        return {
            "shape": list(self.shape),
            "origin": [v.hex() for v in self.origin],
            "pitch": [v.hex() for v in self.pitch],
        }

    def check_resolution(self) -> None:
        """Raise GridError if rounding of its coordinates exceeds a quarter of a voxel."""
        low, pitch = np.array(self.origin), np.array(self.pitch)
        _check_resolution(low, low + pitch * self.shape, pitch, "place it nearer to the origin")

    def window(self, low: Sequence[int], shape: Sequence[int]) -> Grid:
        """Return the grid of the voxels [low, low + shape) of this grid."""
        origin = (o + p * int(n) for o, p, n in zip(self.origin, self.pitch, low, strict=True))
        return Grid(tuple(shape), tuple(origin), self.pitch)  # pyright: ignore[reportArgumentType]

    def finest_bits(self, points: np.ndarray) -> int:
        """Return the bits b of the finest lattice, of 2**-b voxel, for the grid and some (N, 3)
        world points: 20 as far as they reach 512 voxels from its corner, one less each time that
        this doubles, and not less than the 8 of voxels."""
        with np.errstate(over="ignore", invalid="ignore"):
            farthest = np.abs((np.asarray(points, np.float64) - self.origin) / self.pitch).max()
        reach = math.ceil(min(max(farthest, self.dim), 1 << COORDINATE_BITS))
        bits = COORDINATE_BITS - (reach - 1).bit_length()
        return max(min(bits, FINEST_BITS), FIXED_POINT_BITS)

    def to_fixed(self, points: np.ndarray, bits: int = FIXED_POINT_BITS) -> np.ndarray:
        """Return world points rounded to the fixed-point lattice, ties to even.

        Parameters
        ----------
        points : (N, 3) float64
            Points in world units.
        bits : int
            A voxel is 2**bits units of the lattice.

        Returns
        -------
        (N, 3) int32
            Coordinates from the grid's low corner, in 2**-bits voxel.

        Raises
        ------
        GridError
            If a coordinate is not finite, or 2**30 units or more from the corner.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = np.asarray(points, np.float64) - self.origin
            scaled /= self.pitch
            scaled *= 1 << bits
            np.rint(scaled, out=scaled)
        if scaled.size and not (
            scaled.min() >= -FIXED_POINT_LIMIT and scaled.max() <= FIXED_POINT_LIMIT
        ):
            inside = (np.abs(scaled) <= FIXED_POINT_LIMIT).all(axis=-1)
            raise GridError(
                f"vertex {int(np.argmin(inside))} lies more than "
                f"{FIXED_POINT_LIMIT >> bits} voxels from the grid's corner: "
                "choose a larger pitch or a nearer box"
            )
        return aligned(scaled, np.int32)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Return (N, 3) points in grid units as (N, 3) float64 world coordinates."""
        return np.asarray(points, np.float64) * self.pitch + self.origin


def _bounds(mesh: Mesh | None, bbox: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray]:
    if bbox is None:
        if mesh is None:
            raise GridError("there is nothing that the grid is to cover: give a mesh or a box")
        return mesh.bounds[0], mesh.bounds[1]
    box = np.asarray(bbox, np.float64).reshape(2, 3)
    if not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise GridError(f"box {' '.join(f'{v:g}' for v in box.ravel())} is empty or not finite")
    return box[0], box[1]


def _pitch_for(dim: int, margin: int | None, longest: float) -> tuple[float, int]:
    """Return the voxel size at which a length and its margins span dim voxels, and the margin."""
    if margin is None:
        margin = min(DEFAULT_MARGIN, dim // 8)
    inner = dim - 2 * margin
    if inner < 1:
        raise GridError(
            f"margin {margin} on both sides leaves no voxel of dim {dim}: choose at most "
            f"{(dim - 1) // 2}"
        )
    return longest / inner, margin


def _shape_for(pitch: float, margin: int | None, extent: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the numbers of voxels that cover an extent and its margins, and the margin."""
    count = _voxel_count(extent, pitch)
    longest, size = int(count.max()), float(extent.max())
    if longest > MAX_DIM:
        least = 1.001 * size / (MAX_DIM - 2 * DEFAULT_MARGIN)
        raise GridError(
            f"pitch {pitch:g} makes {size / pitch:.7g} voxels along the longest "
            f"side, of {MAX_DIM} allowed: choose at least {least:.4g}"
        )
    return _with_margin(count, margin)


def _with_margin(count: np.ndarray, margin: int | None) -> tuple[np.ndarray, int]:
    """Return numbers of voxels with the margin on both sides, and the margin."""
    longest = int(count.max())
    if margin is None:  # the largest m <= 4 that the dim it makes allows
        margin = next(m for m in range(DEFAULT_MARGIN, -1, -1) if m <= (longest + 2 * m) // 8)
    shape = count + 2 * margin
    shape[np.argmax(shape)] = max(int(shape.max()), MIN_DIM)
    return shape, margin


def _on_lattice(lattice: Grid, low: np.ndarray, high: np.ndarray, margin: int | None) -> Grid:
    """Return the grid of the voxels of a lattice from one corner to another, and the margin."""
    pitch = np.array(lattice.pitch)
    with np.errstate(over="ignore"):
        first, last = ((corner - lattice.origin) / pitch for corner in (low, high))
    first, last = np.floor(first + IGNORED), np.ceil(last - IGNORED)
    with np.errstate(invalid="ignore"):
        count = np.maximum(last - first, 1)
    if not count.max() <= MAX_DIM:
        raise GridError(
            f"{(high - low).max():.6g} along the longest side is {count.max():.7g} voxels of the "
            f"lattice, of {MAX_DIM} allowed: choose a lattice of larger voxels"
        )
    shape, margin = _with_margin(count.astype(np.int64), margin)
    return lattice.window((first - margin).astype(np.int64).tolist(), shape.tolist())


def _check_resolution(
    low: np.ndarray, high: np.ndarray, pitch: np.ndarray, instead: str = MOVE
) -> None:
    """Raise GridError if rounding at these coordinates exceeds a quarter of a voxel."""
    farthest = np.maximum(np.abs(low), np.abs(high))
    if (pitch < 4 * np.spacing(farthest)).any():
        raise GridError(
            f"voxels of {min(pitch):g} are too small for floating point at coordinate "
            f"{farthest.max():g}: {instead}, or choose larger voxels"
        )


def check_single(kind: str, pitch: Any, places: Any, instead: str) -> None:
    """Raise GridError if float32 does not hold the sizes of voxels, or coordinates or distances."""
    sizes, places = np.abs(pitch), np.abs(places)
    if sizes.min() < SINGLE[0] or max(sizes.max(), places.max()) > SINGLE[1]:
        raise GridError(
            f"{kind} holds float32, and lengths here are {sizes.min():.3g} to "
            f"{max(sizes.max(), places.max()):.3g}, of {SINGLE[0]:.2g} to {SINGLE[1]:.2g} that "
            f"float32 holds: {instead}"
        )


def _voxel_count(extent: np.ndarray, pitch: float) -> np.ndarray:
    """Return the voxels that cover each side, at least 1."""
    with np.errstate(over="ignore"):
        count = np.ceil(extent / pitch - IGNORED)
    return np.clip(count, 1, 1 << 40).astype(np.int64)


def _short(number: int) -> str:
    """Return a whole number as messages say it; of many digits its power of ten."""
    if abs(number) < 10**12:
        return str(number)
    return f"{'-' * (number < 0)}1e{math.floor(math.log10(abs(number)))}"


def grid_of(mesh: Mesh, grid: Grid | None, dim: int | None, pitch: float | None) -> Grid:
    """Return the grid, or one around the mesh of this dim or pitch; GridError if a grid is given
    with either."""
    if grid is None:
        return Grid.fit(mesh, dim, pitch=pitch)
    if dim is not None or pitch is not None:
        raise GridError("a grid has its own dim and pitch: drop dim= and pitch=, or the grid")
    return grid
