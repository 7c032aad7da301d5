"""The picture of isosurfaces in a tetrahedral volume, in float64, by a plain algorithm.

The segments of rays in cells [reference.py] are cut where the scalar is an isovalue. Pieces and the
surfaces behind them are composited one after the other. A surface at the end of a segment belongs
to the segment whose lesser scalar is below it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.selftest.reference import Segments, composite, segments

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.camera import Rays
    from voxtool.tets.pictures.transfer import TransferFunction

AMBIENT = 0.08  # of the brightness: half Lambert's law [Mitchell 2006]


def isosurfaces(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    transfer: TransferFunction,
    rays: Rays,
    values: Sequence[float],
    tint: Sequence[float],
    pixels: np.ndarray | None = None,
) -> np.ndarray:
    """Return the premultiplied RGBA of pixels, (N, 4) float64.

    Parameters
    ----------
    vertices, cells, scalars, transfer, rays, pixels
        As of `reference`; (V,) scalars.
    values
        The isovalues.
    tint
        Red, green, blue and opacity of the surfaces.
    """
    width, height = rays.size
    if pixels is None:
        row, column = np.divmod(np.arange(width * height), width)
        pixels = np.stack([column, row], axis=1)
    x, y = (pixels + 0.5 - np.array(rays.size) / 2).T
    ways = rays.direction + rays.perspective * (x[:, None] * rays.right + y[:, None] * rays.down)
    picture = np.zeros((len(pixels), 4))
    for found in segments(vertices, cells, scalars, rays, pixels):
        segment, pieces, met = cut_at(found, np.unique(values))
        layers = np.zeros((len(segment), 2, 4))  # a piece, and the surface behind it
        composite(layers[:, 0], pieces, transfer)
        cell, pixel = found.cell[segment[met]], found.pixel[segment[met]]
        bright = brightness(rises(vertices[cells[cell]], scalars[cells[cell]]), ways[pixel], rays)
        layers[met, 1, :3] = tint[3] * bright[:, None] * np.array(tint[:3])
        layers[met, 1, 3] = tint[3]
        over(picture, np.repeat(found.pixel[segment], 2), layers.reshape(-1, 4))
    return picture


def cut_at(found: Segments, values: np.ndarray) -> tuple[np.ndarray, Segments, np.ndarray]:
    """Return the segment of each piece between ascending values, the pieces, each of a pixel of its
    own, and whether a surface is behind each."""
    low, high = found.scalars.min(axis=1), found.scalars.max(axis=1)
    begin, end = (np.searchsorted(values, ends, "right") for ends in (low, high))
    count = end - begin + 1
    segment = np.repeat(np.arange(len(count)), count)
    k = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    last = k == count[segment] - 1
    near, far = found.scalars[segment].T
    rising = near < far
    padded = np.append(values, np.inf)
    stop = np.where(rising, padded[begin[segment] + k], padded[end[segment] - 1 - k])
    to = np.where(last, far, stop)
    start = np.where(k == 0, near, np.roll(to, 1))
    share = np.divide(to - start, far - near, out=np.ones(len(k)), where=near != far)
    own, length = np.arange(len(segment)), found.length[segment] * share
    return segment, Segments(own, own, own, own, length, np.stack([start, to], axis=1)), ~last


def rises(corners: np.ndarray, scalars: np.ndarray) -> np.ndarray:
    """Return the gradients of cells, (n, 3), from (n, 4, 3) corners and (n, 4) scalars."""
    edges, steps = corners[:, 1:] - corners[:, :1], scalars[:, 1:] - scalars[:, :1]
    return np.linalg.solve(edges, steps[..., None])[..., 0]


def brightness(normals: np.ndarray, ways: np.ndarray, rays: Rays) -> np.ndarray:
    """Return the brightness of surfaces, (n,), lit from both sides, as seen along `ways`."""
    sizes = np.sqrt((normals * normals).sum(axis=1))
    signs = np.where((normals * ways).sum(axis=1) > 0, -1, 1)
    wrapped = 0.5 + 0.5 * (normals * rays.light()).sum(axis=1) * signs / sizes
    return AMBIENT + (1 - AMBIENT) * wrapped * wrapped


def over(picture: np.ndarray, pixel: np.ndarray, layers: np.ndarray) -> None:
    """Composite (n, 4) layers, sorted by pixel and then front to back, behind a picture."""
    pixels, start, count = np.unique(pixel, return_index=True, return_counts=True)
    for k in range(count.max(initial=0)):
        live = count > k
        at = pixels[live]
        picture[at] += (1 - picture[at, 3:]) * layers[start[live] + k]
