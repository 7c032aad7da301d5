"""The golden digests of set operations; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=combine
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from typing import Any

import voxtool
from golden import svo as golden_svo
from voxtool.choices import OPERATIONS

GOLDEN = golden_svo.GOLDEN.with_name("combine.json")
OWN = {"bunny": "torus", "needles": "open-box"}  # the second operand
DIMS = (24, 130)


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digests of every operation on the octree of a mesh, that of another mesh in its
    place, and a part of the first, whose origin is no corner of its nodes."""
    warnings.simplefilter("ignore", voxtool.MeshWarning)  # the meshes are bad on purpose
    mesh, other = golden_svo.own_mesh(own), golden_svo.own_mesh(OWN[own])
    low, other_low = mesh.bounds[0], other.bounds[0]
    scale = (mesh.bounds[1] - low).max() / (other.bounds[1] - other_low).max()
    placed = voxtool.mesh_from_arrays((other.vertices - other_low) * scale + low, other.faces)
    for dim in DIMS:
        grid = voxtool.Grid.fit(mesh, dim)
        octrees = [
            voxtool.voxelize(mesh, grid, "surface26", device=device),
            voxtool.voxelize(placed, grid, fill="parity", device=device),
            voxtool.voxelize(
                mesh, grid, fill="parity", window=((3, 5, 1), (20, 18, 16)), device=device
            ),
        ]
        for operation in OPERATIONS:
            yield f"{operation} {dim}", voxtool.combine(octrees, operation, device=device).digest()
        for mode in ("surface26", "surface6"):
            surface = voxtool.voxelize(mesh, grid, mode, device=device)
            yield f"thin {mode} {dim}", voxtool.thin(surface).digest()
        found = voxtool.compare(*octrees[:2], device=device)
        yield f"both {dim}", found.both.digest()
        yield f"only second {dim}", found.second.set_digest()
        hollow = voxtool.morph(octrees[1], "shell", 1.5, device=device)
        wall = hollow - octrees[0]
        yield f"components {dim}", voxtool.components(wall, 26).digest()
        yield f"largest {dim}", voxtool.keep_components(wall, 1).digest()
        yield f"filled {dim}", voxtool.fill_cavities(hollow).digest()
        for pitch in (1.5, 3**0.5):  # exact, and with rounded planes
            size = pitch * grid.pitch[0]
            coarse = voxtool.resample(wall, pitch=size, threshold=0.3, device=device)
            yield f"resampled {pitch:.3g} {dim}", coarse.digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
