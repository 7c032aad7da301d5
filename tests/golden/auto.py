"""The golden digests of fill "auto" for meshes whose faces define no inside, and of their oriented
faces; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=auto
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import wrecks
from helpers import meshes

import voxtool
from golden import svo as golden_svo
from golden.distance import digest
from voxtool.spatial.orientation import orient

GOLDEN = golden_svo.GOLDEN.with_name("auto.json")
OWN = ("sphere", "torus", "car")
DIMS = (40, 150)


def own_mesh(name: str) -> voxtool.Mesh:
    """A mesh with faces turned at random: a sphere, a torus with every face twice, open parts."""
    random = np.random.default_rng(3)
    if name == "car":
        vertices, faces = golden_svo.lattice_points(wrecks.car())
    else:
        closed = golden_svo.own_mesh(name)
        vertices, faces = closed.vertices, np.tile(closed.faces, (1 + (name == "torus"), 1))
    turned = random.random(len(faces)) < 0.3
    return meshes.mesh_of(vertices, np.where(turned[:, None], faces[:, ::-1], faces))


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield why a fill rule was chosen, and the digests of octrees and of the oriented faces."""
    mesh = own_mesh(own)
    jobs = [voxtool.plan_voxelize(mesh, voxtool.Grid.fit(mesh, dim), device=device) for dim in DIMS]
    yield "choice", jobs[0].plan.choice
    for job, dim in zip(jobs, DIMS, strict=True):
        yield f"{job.plan.rule} {dim}", job.run().digest()
    found = orient(mesh, device)
    yield "oriented", digest(found.mesh.faces)
    yield "sheets", f"{found.sheets} {found.seen} {found.counted} {found.kept}"


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
