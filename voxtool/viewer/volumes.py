"""Volumes in pages: the textures of table 5, and what the boundary is made of."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import printable
from voxtool.tets.pictures.surfaces import MOST
from voxtool.tets.pictures.transfer import DEFAULT_MAP, default_transfer, scalar_shares
from voxtool.tets.volume.volume import ON_PLANE
from voxtool.vector import dot
from voxtool.viewer.content import PageContent

if TYPE_CHECKING:
    from voxtool.tets.volume.volume import TetVolume

BINS = 64  # of the histogram behind the transfer function
SEGMENT = "tets/pictures/segment.h"  # the kernels' integral of a segment


def volume_content(volume: TetVolume) -> PageContent:
    """Return the content of a page that shows a volume: planes, gradients and neighbours of the
    cells as in table 5, and their vertices."""
    normals, gradients = _table_5(volume)
    arrays = {
        "normals": normals,
        "gradients": gradients,
        "neighbours": volume.neighbours,
        "cells": volume.cells,
        "vertices": volume.vertices,
    }
    facts = {
        "origin": list(volume.origin),
        "scale": volume.scale,
        "range": list(volume.scalar_range),
        "faces": volume.faces.tolist(),
        "noun": f"{len(volume.cells):,} {volume.noun}",
        "scalar": printable(volume.scalar),
        "units": printable(volume.units),
        "colour": [1.0, 1.0, 1.0],
        "transfer": json.loads(default_transfer(volume).to_json()),
        "map": DEFAULT_MAP,
        "histogram": _histogram(volume),
        "surfaces": 0 if volume.constant else MOST,  # a page shows at most
    }
    defines = (f"FACES {len(facts['faces'])}", f"ON_PLANE {ON_PLANE}")
    return PageContent("volume", facts, arrays, _smaller_by, (), defines, SEGMENT)


def _histogram(volume: TetVolume) -> list[float]:
    """Return the volume at scalars of each bin, the largest 1."""
    scalars, sizes = scalar_shares(volume)
    found = np.histogram(scalars, BINS, (0.0, 1.0), weights=sizes)[0]
    return np.round(found / (found.max() or 1.0), 3).tolist()


def _table_5(volume: TetVolume) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes (F, T, 4) and the gradients (T, 4) of cells, float32; those of table 4 get
    the offsets of their anchors."""
    if volume.anchors is None:
        return volume.normals, volume.gradients
    first, second = (volume.vertices[volume.anchors[:, i]].astype(np.float64) for i in (0, 1))
    normals = np.empty((*volume.normals.shape[:2], 4), np.float32)
    normals[..., :3] = volume.normals
    for face, n in enumerate(volume.normals.astype(np.float64)):
        normals[face, :, 3] = -dot(n, (second if face == 0 else first)[:, :3])
    gradients = np.empty((len(volume.cells), 4), np.float32)
    gradients[:, :3] = volume.gradients
    gradients[:, 3] = first[:, 3] - dot(volume.gradients.astype(np.float64), first[:, :3])
    return normals, gradients


def _smaller_by(share: float) -> str:
    return f"a mesh with about {share:.0%} of the cells fits"
