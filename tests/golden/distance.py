"""The golden digests of exact distances; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=distance
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import voxtool
from golden import svo as golden_svo
from golden.adf import NUMBERS, OWN
from voxtool.choices import FIELD_SIGNS
from voxtool.spatial.signed_distance import SignedDistance

GOLDEN = Path(__file__).parent / "distance.json"
DIM = 20


def points_of(mesh: voxtool.Mesh) -> np.ndarray:
    """Return quasi-random points in the mesh's box and around it, (POINTS, 3)."""
    low, high = mesh.bounds
    return low + (high - low) * (1.5 * NUMBERS - 0.25)


def digest(*arrays: np.ndarray) -> str:
    """Return the SHA-256 of arrays."""
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
    return sha.hexdigest()


def digests(mesh: voxtool.Mesh, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digests of the distances at points with every sign, on a grid, and to another
    mesh."""
    options = {"gradient": True, "nearest": True, "face": True}
    for sign in FIELD_SIGNS:
        measure = SignedDistance(mesh, sign, device)
        yield sign, digest(*measure(points_of(mesh), **options))
    grid = voxtool.Grid.fit(mesh, DIM)
    yield "grid", digest(voxtool.distance_grid(mesh, grid, device=device))
    other = replace(mesh, vertices=1.125 * mesh.vertices[:, [1, 2, 0]])
    apart = voxtool.hausdorff(mesh, other, tolerance=1e-4, device=device)
    ways = ((w.lower, w.upper, *w.point, *w.nearest) for w in (apart.a_to_b, apart.b_to_a))
    yield "hausdorff", digest(np.array([*ways]))


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(golden_svo.own_mesh(name), device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
