"""Compare a device with the golden digests of a wing: `make golden KIND=report svo`.

Prints a line for each mesh or volume, and those digests that differ. Exit code 1 if any does.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import voxtool
from golden import adf as golden_adf
from golden import attributes as golden_attributes
from golden import auto as golden_auto
from golden import combine as golden_combine
from golden import distance as golden_distance
from golden import exchange as golden_exchange
from golden import field_surface as golden_field_surface
from golden import mesh as golden_mesh
from golden import page as golden_page
from golden import picture as golden_picture
from golden import repair as golden_repair
from golden import svo as golden_svo

Digests = Iterator[tuple[str, str]]
own = golden_svo.own_mesh
WINGS: dict[str, dict[str, Callable[[Any], Digests]]] = {
    "svo": {n: lambda d, n=n: golden_svo.digests(own(n), golden_svo.DIMS, d)
            for n in golden_svo.OWN},
    "mesh": {n: lambda d, n=n: golden_mesh.digests(own(n), golden_mesh.DIMS, d)
             for n in golden_svo.OWN},
    "distance": {n: lambda d, n=n: golden_distance.digests(own(n), d)
                 for n in golden_distance.OWN},
    "adf": {n: lambda d, n=n: golden_adf.digests(own(n), golden_adf.REQUESTS, d)
            for n in golden_adf.OWN},
    "field_surface": {n: lambda d, n=n: golden_field_surface.digests(n, d)
                      for n in golden_field_surface.OWN},
    "picture": {n: lambda d, n=n: golden_picture.surfaces(own(n), d) for n in golden_picture.OWN}
    | {n: lambda d, n=n: golden_picture.volume_pictures(golden_picture.own_volume(n), d)
       for n in golden_picture.VOLUMES},
    "page": {n: lambda d, n=n: golden_page.digests(own(n), d) for n in golden_page.OWN}
    | {n: lambda d, n=n: golden_page.volume_digests(golden_picture.own_volume(n))
       for n in golden_page.VOLUMES},
    "combine": {n: lambda d, n=n: golden_combine.digests(n, d) for n in golden_combine.OWN},
    "auto": {n: lambda d, n=n: golden_auto.digests(n, d) for n in golden_auto.OWN},
    "repair": {n: lambda d, n=n: golden_repair.digests(n, d) for n in golden_repair.OWN},
    "attributes": {n: lambda d, n=n: golden_attributes.digests(n, d)
                   for n in golden_attributes.OWN},
    "exchange": {n: lambda d, n=n: golden_exchange.digests(n, d)
                 for n in golden_exchange.OWN},
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wing", choices=WINGS)
    parser.add_argument("--device")
    parser.add_argument("--golden", type=Path, default=golden_svo.GOLDEN.parent)
    given = parser.parse_args()
    device = voxtool.open_device(given.device)
    golden = json.loads((given.golden / f"{given.wing}.json").read_text("utf-8"))
    warnings.simplefilter("ignore", voxtool.MeshWarning)  # the meshes are bad on purpose
    differ = 0
    for name, digests in WINGS[given.wing].items():
        found = dict(digests(device))
        wrong = sorted(
            key for key in golden[name].keys() | found if golden[name].get(key) != found.get(key)
        )
        print(
            f"{name}: {len(found) - len(wrong)} of {len(golden[name])} digests are equal",
            flush=True,
        )
        for key in wrong:
            print(f"    differs: {key}", flush=True)
        differ += len(wrong)
    return bool(differ)


if __name__ == "__main__":
    sys.exit(main())
