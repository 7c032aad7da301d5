"""The golden digests of repaired meshes; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=repair
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from typing import Any

import voxtool
from golden import svo as golden_svo

GOLDEN = golden_svo.GOLDEN.with_name("repair.json")
OWN = ("bunny", "open-box", "torus")
LENGTHS = ("offset", "shell", "thicken")  # in a request, in shares of the longest side
REQUESTS: dict[str, dict[str, Any]] = {
    "auto 24": {"dim": 24},
    "auto 60": {"dim": 60},
    "offset 40": {"dim": 40, "offset": 0.03, "fill": "winding"},
    "inset 40": {"dim": 40, "offset": -0.02, "fill": "winding"},
    "thick 40": {"dim": 40, "thicken": 0.1},
    "hollow 40": {"dim": 40, "shell": 0.07},
    "flood 40": {"dim": 40, "fill": "flood", "gap": 1, "keep_components": 1},
}


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digest of every repair of a mesh."""
    warnings.simplefilter("ignore", voxtool.MeshWarning)  # the meshes are bad on purpose
    mesh = golden_svo.own_mesh(own)
    low, high = mesh.bounds
    side = float((high - low).max())
    for name, given in REQUESTS.items():
        request = {key: x * side if key in LENGTHS else x for key, x in given.items()}
        if "shell" in given:
            place = mesh.vertices[mesh.faces[0]].sum(axis=0) / 3
            request["drains"] = [(*place.tolist(), 0.06 * side)]
        yield name, voxtool.repair(mesh, device=device, **request).digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
