"""The golden digests of surfaces: which there are, and (run as a script) writing them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=mesh
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import voxtool
from golden import svo as golden_svo

GOLDEN = Path(__file__).parent / "mesh.json"
REQUESTS = {
    "smooth": {"style": "marching-cubes", "level": 0},
    "smooth 0.2": {"style": "marching-cubes", "level": 0, "isovalue": 0.2},
    "smooth level 1": {"style": "marching-cubes", "level": 1},
    "smooth voxel": {"style": "marching-cubes"},
    "blocks": {"style": "voxel-faces"},
    "blocks merged": {"style": "voxel-faces", "merge": True},
    "nets": {},
    "nets level 0": {"style": "surface-nets", "level": 0},
    "sharp": {"style": "sharp"},
}
ADAPTIVE = {"adaptive nets": {}, "adaptive blocks": {"style": "voxel-faces"}}
DIMS = (50, 128)
REAL_DIMS = (200,)


def digests(mesh: voxtool.Mesh, dims: tuple[int, ...], device: object) -> Iterator[tuple[str, str]]:
    """Name and digest of every surface at every dim."""
    for dim in dims:
        grid = voxtool.Grid.fit(mesh, dim)
        octree = voxtool.voxelize(mesh, grid, fill="parity", device=device)
        for name, request in REQUESTS.items():
            source = mesh if name == "sharp" else None
            surface = voxtool.extract(octree, source=source, device=device, **request)
            yield f"{name} {dim}", surface.digest()
        for name, request in ADAPTIVE.items() if dim == DIMS[0] else ():
            half = 0.5 * max(grid.pitch)
            surface = voxtool.extract(octree, adaptive=half, device=device, **request)
            yield f"{name} {dim}", surface.digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {
        name: dict(digests(golden_svo.own_mesh(name), DIMS, device)) for name in golden_svo.OWN
    }
    for name in golden_svo.REAL:
        mesh = voxtool.load_mesh(golden_svo.MODELS / f"{name}.obj")
        golden[f"{name}.obj"] = dict(digests(mesh, REAL_DIMS, device))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
