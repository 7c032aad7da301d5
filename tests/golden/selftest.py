"""The digests of the selftest: run as a script, it writes them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=selftest
"""

from __future__ import annotations

import json

import voxtool
from voxtool.selftest.digests import KINDS, STORED


def main() -> None:
    device = voxtool.open_device()
    digests = {kind: dict(make(device)) for kind, make in KINDS.items()}
    STORED.write_text(json.dumps(digests, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
