"""The golden digests of pictures: which there are, and (run as a script) writing them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=picture
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from helpers.tets import boxes, grid_points, tet_grid, tet_mesh

import voxtool
from golden import svo as golden_svo
from voxtool.camera import Camera
from voxtool.choices import WHITE
from voxtool.cli.render import turned
from voxtool.pictures.rendering import camera_for, plan_render
from voxtool.tets.pictures.transfer import named

GOLDEN = Path(__file__).parent / "picture.json"
OWN = ("sphere", "torus", "needles")
SIZE = (96, 72)
VIEWS = {
    f"{view} {'orthographic' if fov is None else f'{fov:g}'}": (view, fov)
    for view in ("iso", "front", "bottom")
    for fov in (None, 30.0)
}
REAL_VIEWS = ("iso 30", "front orthographic")
INTEGRATORS = ("linear", "average", "sampled:3", "preintegrated")
CONSTANT = ("constant", "hexahedra")  # a scalar for a cell
VOLUMES = ("jittered", "holes", *CONSTANT)
# Each integrator with one projection: half the programs, and every pair of a choice of cells, of
# an integrator and of a projection is in this or in the pictures of the other volumes.
PAIRS = {"orthographic": ("average", "preintegrated"), "30": ("linear", "sampled:3")}


def digest(picture: np.ndarray) -> str:
    """SHA-256 of the values as they are."""
    return hashlib.sha256(np.ascontiguousarray(picture, "<f4").data).hexdigest()


def surfaces(mesh: voxtool.Mesh, device: Any) -> Iterator[tuple[str, str]]:
    """Name and digest of pictures of a mesh's octree and of its field."""
    octree = voxtool.voxelize(mesh, voxtool.Grid.fit(mesh, 48), fill="parity", device=device)
    field = voxtool.build_adf(mesh, device=device, tolerance=4e-3, max_level=5)
    moved = replace(mesh, vertices=mesh.vertices + 2.5 * np.array(octree.grid.pitch))
    other = voxtool.voxelize(moved, octree.grid, "surface6", device=device)
    yield "turntable", digest(turntable(octree, device))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    for name, (view, fov) in VIEWS.items():
        rays = Camera.fit(low, high, view, fov=fov).rays(*SIZE)
        yield f"difference {name}", digest(voxtool.render(octree, rays, other=other, device=device))
        for level in ("voxel", 1):
            yield (
                f"octree {level} {name}",
                digest(voxtool.render(octree, rays, level=level, device=device)),
            )
        for offset in (0.0, 0.02):
            yield (
                f"field {offset} {name}",
                digest(voxtool.render(field, rays, offset=offset * field.side, device=device)),
            )


def turntable(octree: voxtool.Octree, device: Any) -> np.ndarray:
    """Four frames of a whole turn, (4, H, W, 3) uint8."""
    camera = camera_for(octree, size=SIZE, turn=0.0)
    job = plan_render(octree, camera, size=SIZE, samples=1, device=device)
    return np.stack(list(turned(job.run(), job, camera, 4, legend=False, paper=WHITE)))


def own_volume(name: str) -> voxtool.TetVolume:
    """A volume that is made here, by name."""
    if name == "hexahedra":
        shape = (3, 3, 3)
        mesh, _ = boxes(grid_points(shape), shape, np.arange(27) * 5 % 27 / 27)
        return voxtool.build_tet(mesh, "hexahedra")
    points, cells = tet_grid((6, 5, 4), seed=3, holes=0.3 if name == "holes" else 0.0)
    squares = points * points
    if name == "constant":
        return voxtool.build_tet(tet_mesh(points, cells, [np.arange(len(cells)) * 7 % 64 / 64]))
    return voxtool.build_tet(tet_mesh(points, cells, squares[:, 0] + squares[:, 1] * points[:, 2]))


def volume_pictures(
    volume: voxtool.TetVolume,
    device: Any,
    views: Iterable[str] = tuple(VIEWS),
    integrators: Iterable[str] = INTEGRATORS,
) -> Iterator[tuple[str, str]]:
    """Name and digest of pictures of a volume."""
    low, high = volume.bounds()
    unit = float((high - low).max()) / 8
    transfer = named("viridis", *volume.scalar_range, unit)
    for name in views:
        view, fov = VIEWS[name]
        rays = Camera.fit(low, high, view, fov=fov).rays(*SIZE)
        for method in ("raycast", "projection"):
            for integrator in integrators:
                picture = voxtool.render(
                    volume, rays, transfer=transfer, method=method, integrator=integrator,
                    device=device,
                )  # fmt: skip
                yield f"{method} {integrator} {name}", digest(picture)
            if not volume.constant:
                low_third = volume.scalar_range[0] * 2 / 3 + volume.scalar_range[1] / 3
                picture = voxtool.render(
                    volume, rays, transfer=transfer, isovalues=(low_third,), opacity=0.5,
                    method=method, device=device,
                )  # fmt: skip
                yield f"{method} surface {name}", digest(picture)


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(surfaces(golden_svo.own_mesh(name), device)) for name in OWN}
    golden |= {name: dict(volume_pictures(own_volume(name), device)) for name in VOLUMES}
    bluntfin = voxtool.read_unstructured(golden_svo.MODELS / "bluntfin.vtu")
    golden["bluntfin.vtu"] = dict(volume_pictures(voxtool.build_tet(bluntfin), device, REAL_VIEWS))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
