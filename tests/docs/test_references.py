"""Sources are cited by keys that docs/references.md defines."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
REFERENCES = ROOT / "docs" / "references.md"
KEY = r"\[(voCCeL|ADF|TetVol|[A-Z][a-z]+ (?:19|20)\d\d)[,\]]"
FOLDERS = {"voxtool": (".py", ".dtd"), "kernels": (".cl", ".h"), "docs": (".md",)}


def texts() -> dict[Path, str]:
    paths = [
        path
        for folder, endings in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in endings and path != REFERENCES
    ]
    return {path: path.read_text(encoding="utf-8") for path in [*paths, ROOT / "README.md"]}


def defined() -> set[str]:
    rows = re.findall(rf"^\| {KEY}", REFERENCES.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) == len(set(rows))
    return set(rows)


def test_every_key_is_defined() -> None:
    known = defined()
    missing = {
        f"{path.relative_to(ROOT)}: {key}"
        for path, text in texts().items()
        for key in re.findall(KEY, text)
        if key not in known
    }
    assert not missing


def test_every_source_is_used() -> None:
    everything = "\n".join([*texts().values(), REFERENCES.read_text(encoding="utf-8")])
    unused = {key for key in defined() if everything.count(key.partition(" ")[0]) < 2}
    assert not unused, "cited nowhere: remove them from docs/references.md"
