"""Rays from a viewpoint.

Everything here is + − × ÷ and √ of float64, so that the same request gives the same rays on every
machine; the angle functions are our own.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.arrays import Data
from voxtool.choices import VIEWS
from voxtool.errors import VoxtoolError
from voxtool.vector import cross, dot, length, triple, unit

if TYPE_CHECKING:
    from collections.abc import Sequence

FOV = 30.0  # degrees
MARGIN = 1.02  # of a named view, around the sphere about the box
FRAME = 1.04  # around what fills a picture
MAX_SIDE = 32768  # pixels along a side of a picture
MOST = 2.0**900  # coordinates whose sums and quotients of picture sizes stay in float64
REACH = 2.0**40  # units of the content that the eye may be away
PIXELS = 2.0**-50, 2.0**50  # units of the content that a pixel of parallel rays may have


@dataclass(frozen=True, eq=False)
class Rays(Data):
    """One ray for each pixel.

    Pixel (column, row), from the upper left, has x = column + 1/2 − width/2 and y = row + 1/2 −
    height/2. Its ray is origin + t (direction + x right + y down) in perspective, where t is the
    depth along `direction`, and (origin + x right + y down) + t direction orthographic.

    Attributes
    ----------
    origin : (3,) float64
        World units.
    direction : (3,) float64
        Unit vector.
    right, down : (3,) float64
        Steps from pixel to pixel: at depth 1 in perspective, in world units otherwise.
    perspective : bool
        Whether all rays begin at the origin; otherwise they are parallel.
    size : (int, int)
        Width and height in pixels.
    """

    origin: np.ndarray
    direction: np.ndarray
    right: np.ndarray
    down: np.ndarray
    perspective: bool
    size: tuple[int, int]

    def __post_init__(self) -> None:
        for name in ("origin", "direction", "right", "down"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        super().__post_init__()

    def light(self) -> np.ndarray:
        """Return the unit vector towards the light, at the viewer's upper left: (3,) float64."""
        left, above = -_direction(self.right, "right"), -_direction(self.down, "down")
        return _direction(0.4 * left + 0.6 * above - self.direction, "light")

    def local(self, origin: Sequence[float] | np.ndarray, scale: float) -> Rays:
        """Return the same rays in coordinates (world − origin) / scale; depths scale with them.

        Orthographic rays begin nearest to that origin, so that depths are small numbers.

        Raises
        ------
        VoxtoolError
            If the eye is so far away, or parallel rays are so near or far from each other, that
            rounding in these coordinates would show.
        """
        if not 2 * _size(self.origin / 2 - np.asarray(origin) / 2) <= REACH * scale:
            raise VoxtoolError(
                f"eye {triple(self.origin)} is more than {REACH * scale:.2g} units away from the "
                "content: choose a nearer --eye"
            )
        steps = _size(self.right), _size(self.down)
        low, high = (scale * bound for bound in PIXELS)
        if not (self.perspective or low <= min(steps) <= max(steps) <= high):
            side = min(self.size)
            raise VoxtoolError(
                f"a picture {side * min(steps):g} units high: for this content choose a --height "
                f"from {side * low:.2g} to {side * high:.2g}"
            )
        start = (self.origin - np.asarray(origin, np.float64)) / scale
        if self.perspective:
            return replace(self, origin=start)
        start = start - dot(start, self.direction) * self.direction
        return replace(self, origin=start, right=self.right / scale, down=self.down / scale)

    def finer(self, samples: int) -> Rays:
        """Return samples x samples rays for each pixel; at most MAX_SIDE along a side."""
        if samples == 1:
            return self
        width, height = (samples * side for side in self.size)
        check_size(width, height)
        right, down = self.right / samples, self.down / samples
        return replace(self, right=right, down=down, size=(width, height))

    def meet_box(self, points: np.ndarray) -> bool:
        """Return whether the bounding rectangle of (N, 3) projected points meets the picture."""
        arms = points - self.origin
        depth = dot(arms, self.direction) if self.perspective else np.ones(len(arms))
        arms, depth = arms[depth > 0], depth[depth > 0]
        for side, step in zip(self.size, (self.right, self.down), strict=True):
            across = _steps(arms, step) / depth
            if not ((across <= side / 2).any() and (across >= -side / 2).any()):
                return False
        return True


@dataclass(frozen=True)
class Camera:
    """A viewpoint.

    Attributes
    ----------
    eye, target : (float, float, float)
        Position of the camera and the point that it looks at, world units.
    up : (float, float, float)
        Any direction that is not parallel to the view.
    fov : float or None
        Angle of the picture's shorter side in degrees; None for an orthographic camera.
    height : float
        Length of an orthographic picture's shorter side, world units.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fov: float | None = FOV
    height: float = 0.0

    @staticmethod
    def fit(
        low: Sequence[float] | np.ndarray,
        high: Sequence[float] | np.ndarray,
        view: str = "iso",
        *,
        up: Sequence[float] = (0.0, 1.0, 0.0),
        fov: float | None = FOV,
    ) -> Camera:
        """Return the named view of a box, with its bounding sphere in the picture.

        The front view looks along −z, or along +y if `up` is near the z axis. The right view shows
        the side that is at the right of the front view.

        Raises
        ------
        VoxtoolError
            no such view, or numbers that are no box or no direction.
        """
        if view not in VIEWS:
            raise VoxtoolError(f"view {view!r} is unknown: choose {', '.join(VIEWS)}")
        low, high = _place(low, "content"), _place(high, "content")
        centre = low / 2 + high / 2
        radius = MARGIN * _size(high / 2 - low / 2) or 1.0
        if radius < 1 / MOST:
            raise VoxtoolError(f"content of {radius:g} units is too small to draw: scale it up")
        upward = _direction(up, "up")
        front = np.array([0.0, 0.0, 1.0] if abs(upward[2]) < 0.9 else [0.0, -1.0, 0.0])
        front = _direction(front - dot(front, upward) * upward, "up")
        right = cross(upward, front)
        axes = {"front": front, "right": right, "top": upward}
        opposite = {"back": -front, "left": -right, "bottom": -upward}
        way = (axes | opposite | {"iso": _direction(front + right + upward, "view")})[view]
        if view in ("top", "bottom"):
            upward = -front if view == "top" else front
        distance = 2 * radius if fov is None else radius / sine(_half(fov))
        return Camera(
            triple(centre + distance * way), triple(centre), triple(upward), fov, 2 * radius
        )

    def turned(self, degrees: float) -> Camera:
        """Return this camera turned about `up` around the target; 360 degrees change nothing."""
        if not math.isfinite(degrees):
            raise VoxtoolError(f"a turn of {degrees} degrees: give a finite angle")
        axis = _direction(self.up, "up")
        arm = _place(self.eye, "eye") - _place(self.target, "target")
        along = dot(arm, axis) * axis
        across = arm - along
        s, c = sine(degrees), sine(90 - degrees % 360)
        eye = np.array(self.target) + along + c * across + s * cross(axis, across)
        return self if degrees % 360 == 0 else replace(self, eye=triple(eye))

    def framed(self, points: np.ndarray, width: int, height: int) -> Camera:
        """Return this camera moved so that (N, 3) points fill a picture of width x height pixels.

        Point i is in the picture where |u_i - shift| <= half (distance + depth_i), u_i pixels
        across at depth 1 and depth_i measured from the target. For parallel rays depth_i is 0, and
        the height is found instead of the distance.
        """
        rays, target = self.rays(width, height), np.array(self.target)
        arms = points - target
        depth = dot(arms, rays.direction) if rays.perspective else 0.0
        distance, shift = 0.0, np.zeros(3)
        for side, step in zip(rays.size, (rays.right, rays.down), strict=True):
            half = side / 2 / FRAME
            across = _steps(arms, step)
            ends = float((across - half * depth).max()), float((-across - half * depth).max())
            distance = max(distance, (ends[0] + ends[1]) / 2 / half)
            shift = shift + (ends[0] - ends[1]) / 2 * step
        if not distance > 0:  # a single point
            return self
        moved = triple(target + shift)
        if not rays.perspective:
            eye = triple(np.array(self.eye) + shift)
            return replace(self, eye=eye, target=moved, height=distance * self.height)
        return replace(self, eye=triple(target + shift - distance * rays.direction), target=moved)

    def rays(self, width: int, height: int) -> Rays:
        """Return the rays of a picture of width x height pixels.

        Raises
        ------
        VoxtoolError
            If a size, an angle or a direction makes no picture.
        """
        check_size(width, height)
        eye, target = _place(self.eye, "eye"), _place(self.target, "target")
        direction = _direction(target - eye, "the way from eye to target")
        right = cross(direction, _direction(self.up, "up"))
        if _size(right) < 1e-9:
            raise VoxtoolError(f"up {self.up} is along the view: choose another --up")
        right = _direction(right, "up")
        down = cross(direction, right)
        if self.fov is None:
            if not 0 < self.height < math.inf:
                raise VoxtoolError(f"a picture {self.height} units high: give a positive height")
            step = self.height / min(width, height)
        else:
            half = _half(self.fov)
            step = 2 * sine(half) / sine(90 - half) / min(width, height)
        return Rays(
            eye, direction, step * right, step * down, self.fov is not None, (width, height)
        )


def box_corners(low: np.ndarray, sides: np.ndarray | int) -> np.ndarray:
    """Return the corners (8 N, 3) of N boxes with these low corners (N, 3) and sides."""
    steps = np.array(list(itertools.product((0, 1), repeat=3)))
    return (low + steps[:, None] * sides).reshape(-1, 3)


def checked_colour(colour: Sequence[float]) -> tuple[float, float, float]:
    """Return red, green and blue as floats, or raise VoxtoolError if they are not from 0 to 1."""
    with contextlib.suppress(TypeError, ValueError):
        red, green, blue = (float(c) for c in colour)
        if all(0 <= c <= 1 for c in (red, green, blue)):
            return red, green, blue
    raise VoxtoolError(f"colour {colour!r}: give red, green and blue between 0 and 1")


def check_size(width: int, height: int) -> None:
    """Raise VoxtoolError if a side of a picture is not from 1 to MAX_SIDE pixels."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise VoxtoolError(f"a picture of {width} x {height} pixels: sides are 1 to {MAX_SIDE}")


def _half(fov: float) -> float:
    """Return half of a field of view, or raise VoxtoolError if that is not 0.01 to 170 degrees."""
    if not 0.01 <= fov <= 170:
        raise VoxtoolError(f"a field of view of {fov} degrees: choose 0.01 to 170")
    return fov / 2


def _place(point: Sequence[float] | np.ndarray, what: str) -> np.ndarray:
    """Return a point as float64, or raise VoxtoolError if it is not finite or beyond MOST."""
    point = np.array(point, np.float64)
    if not (np.abs(point) <= MOST).all():
        raise VoxtoolError(
            f"{what} at {triple(point)}: coordinates must be finite numbers up to {MOST:.0e}"
        )
    return point


def _steps(arms: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return (N, 3) arms along a step, in steps, (N,); a power of two keeps its square in range."""
    scale = 2.0 ** -math.frexp(_size(step))[1]
    step = scale * step
    return dot(arms, step) / dot(step, step) * scale


def _size(v: np.ndarray) -> float:
    """Return the length of a vector, also if its square overflows."""
    largest = float(np.abs(v).max())
    return largest * float(length(v / largest)) if 0 < largest < math.inf else largest


def _direction(v: Sequence[float] | np.ndarray, what: str) -> np.ndarray:
    """Return the unit vector of `what`, or raise VoxtoolError if its length is 0 or not finite."""
    v = np.asarray(v, np.float64)
    if not 0 < _size(v) < math.inf:
        raise VoxtoolError(f"{what} {tuple(v.tolist())} has no direction")
    return unit(v)


def sine(degrees: float) -> float:
    """Return the sine of an angle, exact at multiples of 90 degrees."""
    degrees %= 360
    if degrees >= 180:
        return -sine(degrees - 180)
    if degrees > 90:
        degrees = 180 - degrees
    cosine = degrees > 45  # of the complement
    x = math.radians(90 - degrees if cosine else degrees)
    terms = [1.0 if cosine else x]
    for k in range(1 if cosine else 2, 21, 2):
        terms.append(-terms[-1] * x * x / (k * (k + 1)))
    total = 0.0  # from the smallest term; the built-in sum of newer Pythons rounds differently
    for term in reversed(terms):
        total += term
    return total
