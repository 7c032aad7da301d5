"""The golden digests of what pages hold: which there are, and (run as a script) writing them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=page
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import voxtool
from golden import picture as golden_picture
from golden import svo as golden_svo
from voxtool.viewer.job import plan_view

GOLDEN = Path(__file__).parent / "page.json"
OWN = ("sphere", "needles")
VOLUMES = ("jittered", "hexahedra")


def digests(mesh: voxtool.Mesh, device: Any) -> Iterator[tuple[str, str]]:
    """Name and digest of the pages of a mesh's octrees and field."""
    for mode in ("solid", "surface26"):
        grid = voxtool.Grid.fit(mesh, 48)
        octree = voxtool.voxelize(mesh, grid, mode, fill="parity", device=device)
        yield f"octree {mode}", plan_view(octree, "a").plan.content.digest()
    field = voxtool.build_adf(mesh, device=device, tolerance=4e-3, max_level=4)
    yield "field", plan_view(field, "a").plan.content.digest()


def volume_digests(volume: voxtool.TetVolume) -> Iterator[tuple[str, str]]:
    """Name and digest of the page of a volume."""
    yield "volume", plan_view(volume, "a").plan.content.digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(golden_svo.own_mesh(name), device)) for name in OWN}
    golden |= {name: dict(volume_digests(golden_picture.own_volume(name))) for name in VOLUMES}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
