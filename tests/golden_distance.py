"""The golden digests of exact distances: which there are, and (run as a script) writing them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    python tests/golden_distance.py
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import golden_svo
import numpy as np

import voxtool
from voxtool.choices import SIGNS

GOLDEN = Path(__file__).parent / "golden" / "distance.json"
OWN = ("sphere", "torus", "open-box", "needles")
DIM = 20
POINTS = 4000


def points_of(mesh: voxtool.Mesh) -> np.ndarray:
    """(POINTS, 3): quasi-random points in the mesh's box and around it."""
    low, high = mesh.bounds
    numbers = np.arange(1, POINTS + 1)[:, None] * np.array([577, 1153, 1999]) % 4093 / 4093
    return low + (high - low) * (1.5 * numbers - 0.25)


def digest(*arrays: np.ndarray) -> str:
    """SHA-256 of arrays."""
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
    return sha.hexdigest()


def digests(mesh: voxtool.Mesh, device: Any) -> Iterator[tuple[str, str]]:
    """The digests of all that is found of points by every sign, and of a grid."""
    asked = {"gradient": True, "nearest": True, "face": True, "device": device}
    for sign in SIGNS:
        yield sign, digest(*voxtool.distance(mesh, points_of(mesh), sign=sign, **asked))
    grid = voxtool.Grid.fit(mesh, DIM)
    yield "grid", digest(voxtool.distance_grid(mesh, grid, device=device))


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(golden_svo.own_mesh(name), device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
