"""The golden digests of distance fields; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=adf
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import voxtool
from golden import svo as golden_svo
from voxtool.adf.construction.build import build_adf
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import QueryResult
from voxtool.adf.queries.query import query_adf

GOLDEN = Path(__file__).parent / "adf.json"
OWN = ("sphere", "torus", "open-box", "needles")
REQUESTS = {
    f"{sign} {joint} {level}": {
        "tolerance": 4e-3, "max_level": level, "sign": sign, "continuous": joint == "continuous",
    }
    for sign in ("pseudonormal", "winding", "none")
    for joint in ("continuous", "cracks")
    for level in (4, 5)
}  # fmt: skip
LARGE = ("armadillo", "dragon", "nefertiti")  # their fields are built by `make soak` alone
REAL_REQUESTS = {"default": {"tolerance": 2e-3, "max_level": 5}}
POINTS = 4000
NUMBERS = np.arange(1, POINTS + 1)[:, None] * np.array([577, 1153, 1999]) % 4093 / 4093


def points_of(field: DistanceField) -> np.ndarray:
    """Return quasi-random points in the cube and around it, (POINTS, 3)."""
    return np.array(field.origin) + field.side * (1.25 * NUMBERS - 0.125)


def digest_of(answer: QueryResult) -> str:
    """Return the SHA-256 of a result."""
    sha = hashlib.sha256()
    for name, array in sorted(vars(answer).items()):
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
    return sha.hexdigest()


def digests(
    mesh: voxtool.Mesh, requests: dict[str, dict], device: Any
) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of every request, and the digests of the field and of its values."""
    for name, request in requests.items():
        field = build_adf(mesh, device, **request)
        answer = query_adf(
            field, points_of(field), gradient=True, bounds=True, cell=True, device=device
        )
        yield name, [field.digest(), digest_of(answer)]


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(golden_svo.own_mesh(name), REQUESTS, device)) for name in OWN}
    for name in golden_svo.REAL:
        mesh = voxtool.load_mesh(golden_svo.MODELS / f"{name}.obj")
        golden[f"{name}.obj"] = dict(digests(mesh, REAL_REQUESTS, device))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
