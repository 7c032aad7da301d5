"""OpenVDB's own library, which the system's Python has, for tests of .vdb."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parent / "openvdb_script.py"
PYTHON = "/usr/bin/python3"


def openvdb(lines: list[tuple[Any, ...]]) -> None:
    """Run the lines with OpenVDB's library."""
    has = (
        shutil.which(PYTHON)
        and not subprocess.run([PYTHON, "-c", "import pyopenvdb"], capture_output=True).returncode
    )
    if not has:
        pytest.skip("needs OpenVDB's library for the system's Python: apt install python3-openvdb")
    text = "\n".join("\t".join(map(str, line)) for line in lines)
    subprocess.run([PYTHON, SCRIPT], input=text.encode(), check=True)
