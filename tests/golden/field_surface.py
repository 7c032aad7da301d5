"""The golden digests of surfaces of distance fields; run as a script, this writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=field_surface
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from typing import Any

import voxtool
from golden import svo as golden_svo

GOLDEN = golden_svo.GOLDEN.with_name("field_surface.json")
OWN = ("bunny", "torus", "open-box", "needles")
FIELD = {"tolerance": 4e-3, "max_level": 5, "measure": False}
REQUESTS = {  # lengths in sides of the field's cube
    "at 0": {"offset": 0.0},
    "outward": {"offset": 0.03125},
    "wall": {"offset": 0.015625, "shell": 0.03125},
}


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digest of every surface of the fields of a mesh, continuous and with cracks."""
    warnings.simplefilter("ignore", voxtool.MeshWarning)  # the meshes are bad on purpose
    mesh = golden_svo.own_mesh(own)
    for joint in ("continuous", "cracks"):
        field = voxtool.build_adf(mesh, device=device, continuous=joint == "continuous", **FIELD)
        for name, request in REQUESTS.items():
            lengths: dict[str, Any] = {key: field.side * x for key, x in request.items()}
            yield f"{joint}, {name}", voxtool.extract(field, **lengths).digest()
        sharp = voxtool.extract(field, style="sharp", source=mesh, device=device)
        yield f"{joint}, sharp", sharp.digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
