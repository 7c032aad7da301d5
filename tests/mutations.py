"""Show which test fails for a fault: each mutation changes one place of the product.

    python tests/mutations.py [NAME ...]

Each mutation is applied to a copy of the checkout, in which the tests of its part run on one
driver until one fails. The script prints the first failing test, and exits 1 if a fault survives.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Mutation(NamedTuple):
    """A text that occurs once in a file, what replaces it, and where tests should notice."""

    file: str
    old: str
    new: str
    tests: str


MUTATIONS: dict[str, Mutation] = {}


def run(name: str, mutation: Mutation) -> bool:
    """Print which test fails; return whether one does."""
    with tempfile.TemporaryDirectory(prefix="voxtool-mutant-") as folder:
        copy = Path(folder, "checkout")
        ignored = shutil.ignore_patterns(
            ".git", ".venv", "build", "dist", "__pycache__", ".*_cache"
        )
        shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)
        file = copy / mutation.file
        text = file.read_text(encoding="utf-8")
        if text.count(mutation.old) != 1:
            sys.exit(f"{name}: {mutation.old!r} occurs {text.count(mutation.old)} times")
        file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "--quick", "-x", "-q", "-p", "no:cacheprovider",
             *mutation.tests.split()],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
        )  # fmt: skip
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    print(f"{name:<36} {failed[1] if failed else 'SURVIVES'}", flush=True)
    return failed is not None


def main() -> None:
    names = sys.argv[1:] or list(MUTATIONS)
    survivors = [name for name in names if not run(name, MUTATIONS[name])]
    sys.exit(f"survive: {', '.join(survivors)}" if survivors else 0)


if __name__ == "__main__":
    main()
