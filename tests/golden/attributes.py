"""The golden digests of attributes of voxels: levels, exports and pictures; run as a script, this
writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=attributes
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from helpers.attributes import attributed

import voxtool
from golden import picture as golden_picture
from golden.exchange import OWN_BYTES, digest
from voxtool.camera import Camera
from voxtool.choices import COLOUR_BY, LABEL_STYLES
from voxtool.files.formats import EXCHANGE
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.octree.attributes import KINDS
from voxtool.viewer.job import plan_view

GOLDEN = Path(__file__).parent / "attributes.json"
OWN = ("scattered",)
VIEWS = ("iso 30", "front orthographic")
COLOURED: list[tuple[str, dict[str, Any]]] = [
    ("voxel-faces", {}), ("voxel-faces", {"level": 0}), ("surface-nets", {}),
    ("marching-cubes", {"level": "voxel"}),
]  # fmt: skip


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digests of the nodes' values, of exports and of pictures."""
    octree = attributed()
    for name in KINDS:
        for number, values in enumerate(CellValues(octree, name, 0).of_all_nodes()):
            yield f"{name} of level {number}", digest(values)
    for format in OWN_BYTES:
        for name in KINDS if EXCHANGE[format].attributes == "one" else ("all",):
            asked = None if name == "all" else name
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, f"a.{format}")
                voxtool.export(octree, path, attributes=asked, level=1)
                yield f"{format} {name}", digest(path.read_bytes())
    for level in ("voxel", 1):
        yield f"page, level {level}", plan_view(octree, "a", level=level).plan.content.digest()
    for style in LABEL_STYLES:
        surface = voxtool.extract(octree, by="label", style=style, device=device)
        yield f"{style} by label", surface.digest()
    of_colour = replace(octree, attributes=(octree.attribute("colour"),))
    for style, more in COLOURED:
        surface = voxtool.extract(of_colour, style=style, device=device, **more)
        yield f"coloured {style} {more}", surface.digest()
    low, high = np.zeros(3), np.array(octree.grid.shape, float)
    for view in VIEWS:
        side, fov = golden_picture.VIEWS[view]
        rays = Camera.fit(low, high, side, fov=fov).rays(*golden_picture.SIZE)
        for level in ("voxel", 1):
            for name in COLOUR_BY:
                picture = voxtool.render(octree, rays, level=level, colour_by=name, device=device)
                yield f"by {name}, level {level}, {view}", golden_picture.digest(picture)
        picture = voxtool.render(octree, rays, only=["head"], device=device)
        yield f"only head, {view}", golden_picture.digest(picture)


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
