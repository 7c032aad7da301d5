"""Isosurfaces of a volume: where the scalar is a given number in a cell.

The surface in a cell is a plane, since the scalar is linear there. It is lit from both sides, by
its normal, the gradient. Rays meet it within the integration of their segments, so surfaces are in
the order of depth with each other and with what the transfer function shows.

Kernels: kernels/tets/pictures/surfaces.h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.tets.pictures.transfer import TransferFunction
    from voxtool.tets.volume.volume import TetVolume

MOST = 64  # surfaces
SLACK = 1e-5  # normalised: blocks with scalars this near are drawn, so that rounding shows no gap


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Isosurfaces in a volume's frame.

    isovalues : (S,) float32, normalised, ascending; tints : (S, 4) float32, red, green, blue and
    opacity of each.
    """

    isovalues: np.ndarray
    tints: np.ndarray

    def blocks(self, volume: TetVolume) -> np.ndarray:
        """Return which blocks of cells the surfaces may pass through, (blocks,) bool."""
        low, high = volume.ranges[:, :1] - SLACK, volume.ranges[:, 1:] + SLACK
        return np.any((low <= self.isovalues) & (self.isovalues <= high), axis=1)

    def arguments(self, device: Device) -> dict[str, Any]:
        """Return arguments of kernels, by name."""
        return {"isovalues": device.put(self.isovalues), "tints": device.put(self.tints)}

    def options(self, volume: TetVolume) -> dict[str, int]:
        """Return -D options of kernels."""
        return {"SURFACES": len(self.isovalues), "FLOATS": volume.gradients.shape[1]}


def surfaces_of(
    volume: TetVolume,
    isovalues: Sequence[float],
    colours: TransferFunction,
    colour: Sequence[float] | None,
    opacity: float,
) -> Surfaces:
    """Return the surfaces where the scalar is one of `isovalues`, in one colour or, if that is
    None, in those of a transfer function.

    Raises
    ------
    VoxtoolError
        If an isovalue or the opacity is out of range, or the volume has one scalar a cell.
    """
    values = np.unique(np.array(isovalues, np.float64))
    if volume.constant:
        raise VoxtoolError(
            f"isosurfaces of {volume.scalar}: it is one number a cell, so none has a surface "
            "inside: choose a scalar of vertices"
        )
    if not all(map(math.isfinite, values)) or len(values) > MOST:
        raise VoxtoolError(f"isovalues {isovalues}: give up to {MOST} finite numbers")
    if not 0 < opacity <= 1:
        raise VoxtoolError(f"isosurfaces of opacity {opacity:g}: give more than 0, at most 1")
    low, high = volume.scalar_range
    values = values[(low <= values) & (values <= high)]
    tints = np.ones((len(values), 4), np.float32)
    tints[:, :3] = colours.evaluate(values)[0] if colour is None else colour
    tints[:, 3] = opacity
    normalised = (values - low) / ((high - low) or 1.0)
    return Surfaces(normalised.astype(np.float32), tints)
