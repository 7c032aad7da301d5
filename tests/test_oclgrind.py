"""Every kernel under Oclgrind, a simulator that checks each access and looks for data races.

The child, which is this file run as a script, voxelizes tiny meshes in every variant that a plan
can choose; the limits beyond which a plan chooses a variant are lowered for that. It compares each
result with the oracle and prints what was launched.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = Path(__file__).parents[1] / "kernels"
CHECKS = ("--data-races", "--uniform-writes")
VARIANTS = {  # of the constants of voxtool.plan
    "narrow": {},
    "wide": {"NARROW_EXTENT": 0},
    "blocked": {"DENSE_SIDE": 0},
    "64-bit codes": {"CODE_32_SIDE": 0},
    "all": {"NARROW_EXTENT": 0, "DENSE_SIDE": 0, "CODE_32_SIDE": 0},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What the child printed, and Oclgrind's log."""
    oclgrind = shutil.which("oclgrind")
    if oclgrind is None:
        assert os.environ.get("CI") != "true", "oclgrind is not installed, and CI must not skip it"
        pytest.skip("oclgrind is not installed")
    log = tmp_path_factory.mktemp("oclgrind") / "log"
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OCL_", "VOXTOOL_"))}
    child = subprocess.run(
        [oclgrind, *CHECKS, "--log", log, sys.executable, __file__],
        env={**environment, "PYOPENCL_NO_CACHE": "1"},
        capture_output=True,
        text=True,
    )
    assert child.returncode == 0, child.stdout + child.stderr
    return json.loads(child.stdout.splitlines()[-1]), log.read_text() if log.exists() else ""


def test_runs_on_the_simulator(run):
    assert run[0]["device"] == "Oclgrind Simulator"


def test_every_kernel_and_variant_was_launched(run):
    declared = {
        name
        for source in KERNELS.glob("**/*.cl")
        for name in re.findall(r"\bvoid\s+(\w+)\s*\(", _without_comments(source))
        if re.search(rf"__kernel[^;{{]*\bvoid\s+{name}\s*\(", _without_comments(source))
    }
    assert len(declared) > 10
    assert declared == set(run[0]["kernels"])
    assert {"", "WIDE", "BLOCKED", "CODE=ulong"} <= set(run[0]["options"])


def test_no_invalid_access_and_no_race(run):
    assert run[1] == ""


def _without_comments(source: Path) -> str:
    return re.sub(r"//[^\n]*", "", source.read_text(encoding="utf-8"))


# ---- the child


def main() -> None:
    from voxtool import plan

    plan.TILE = 8  # before kernels/svo/voxelize.cl gets it: triangles are shared among work-items

    import numpy as np

    from voxtool.opencl import Device, open_device
    from voxtool.opencl.primitives import exclusive_scan

    kernels, options = set(), set()
    kernel = Device.kernel

    def recorded(self, source, name, **defines):
        launch = kernel(self, source, name, **defines)

        def record(size, *args, **keywords):
            if size:
                kernels.add(name)
                options.update(["", *defines, *(f"{k}={v}" for k, v in defines.items())])
            launch(size, *args, **keywords)

        return record

    Device.kernel = recorded
    device = open_device()

    values = np.arange(5000, dtype=np.uint32) % 7  # several blocks
    scanned = device.put(values)
    assert exclusive_scan(scanned, 4999) == values[:-1].sum()
    assert np.array_equal(scanned.get(), np.cumsum(values) - values)

    limits = {name: getattr(plan, name) for changed in VARIANTS.values() for name in changed}
    for name, changed in VARIANTS.items():
        for limit, value in {**limits, **changed}.items():
            setattr(plan, limit, value)
        voxelize_all(device, name)
    print(json.dumps({"device": device.info.name, "kernels": [*kernels], "options": [*options]}))


def voxelize_all(device, variant: str) -> None:
    """Every mode, on a mesh that is closed, one that is open and one that begins before the grid."""
    import meshes
    import numpy as np
    import oracles

    from voxtool.grid import Grid
    from voxtool.mesh import Mesh
    from voxtool.svo.voxelize import voxelize

    scenes = {
        "closed": meshes.join(
            meshes.octahedron((12.5, 9, 10), 7), meshes.box((14, 11, 2), (27, 13, 6))
        ),
        "open": meshes.open_box((3.5, 4, 4), (20, 21, 13), missing=1),
        "before": meshes.box((-9, 2, 3), (6, 11, 9.5)),
    }
    shape = (30, 22, 17)
    for scene, (vertices, faces) in scenes.items():
        vertices = np.asarray(vertices, np.float64)
        mesh = Mesh(vertices, faces.astype(np.int32))
        grid = Grid(shape, (0, 0, 0), (1, 1, 1))
        triangles = meshes.fixed(vertices)[faces]
        expected = {m: getattr(oracles, m)(triangles, shape) for m in ("surface26", "surface6")}
        expected["solid"] = oracles.solid(triangles, shape)
        for mode, voxels in expected.items():
            octree = voxelize(mesh, grid, mode, device=device)
            octree.validate()
            assert {tuple(v) for v in octree.occupied().tolist()} == voxels, (variant, scene, mode)
        octree = voxelize(mesh, grid, "solid", with_surface=True, device=device)
        found = {tuple(v) for v in octree.occupied().tolist()}
        assert found == expected["solid"] | expected["surface26"], (variant, scene)


if __name__ == "__main__":
    main()
