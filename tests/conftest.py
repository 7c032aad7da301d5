"""The devices under test: every one that is found and passes the probe; models for commands; the
browser that all tests of pages share."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import random
import re
import shlex
import shutil
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from helpers import meshes
from helpers import tets as helpers_tets
from helpers.browser import LARGE, SMALL, Viewer, open_browser
from helpers.cli import ENVIRONMENT, MODULE, ROOT, run, write_obj
from hypothesis import HealthCheck, Phase, settings

from voxtool.opencl import Device, open_device

MODELS = Path(__file__).parents[2] / "shared" / "models"
ABSENT = "no model"  # of a reason to skip, before the name
NO_DEVICE = "no usable OpenCL device: install the extra 'cpu' or a driver"
LONG = 600  # seconds of a soak run that has the tests marked long
SOAKED = 9  # tests that share the time of a soak run

settings.register_profile(
    "voxtool",
    deadline=None,  # a first launch compiles
    derandomize=True,  # the same run everywhere
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.register_profile("first failure", settings.get_profile("voxtool"), phases=[Phase.generate])
settings.load_profile("voxtool")


@functools.cache
def usable_devices() -> list[tuple[int, str]]:
    """Index and platform of each.

    A process of its own lists them, so that this one loads no driver before it has imported all
    tests. Intel's driver reads the list of mappings, up to its own, for each program that it
    builds; libraries that are loaded later come before it.
    """
    listed = subprocess.run([*MODULE, "devices", "--json"], env=ENVIRONMENT, capture_output=True)
    devices = json.loads(listed.stdout or "[]")
    return [(one["index"], one["platform"]) for one in devices if one["probe"] == "ok"]


@functools.cache
def opened(index: int) -> Device:
    return open_device(str(index))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="one driver, and no test marked slow")
    parser.addoption(
        "--every-driver", action="store_true", help="each case of each test on every driver"
    )
    parser.addoption("--soak", type=float, help="seconds that tests/soak may take")
    parser.addoption("--seed", type=int, help="of tests/soak; a new one every time by default")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what the tier does not run: slow tests in --quick, soak tests without --soak, and
    half of the pairs of case and driver. The longest file comes first, so that no worker is left
    alone with it."""
    items.sort(key=lambda item: item.path.name != "test_oclgrind.py")
    if not config.getoption("every_driver"):
        share_cases(items)
    soak = config.getoption("soak") or 0
    left_out = {name for name, least in (("soak", 1), ("long", LONG)) if soak < least}
    if config.getoption("quick"):
        left_out.add("slow")
        for item in items:
            if isinstance(item, pytest.Function) and uses_processes_or_models(item):
                item.add_marker("slow")
    dropped = [item for item in items if left_out & {mark.name for mark in item.iter_markers()}]
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        gone = set(dropped)
        items[:] = [item for item in items if item not in gone]


def share_cases(items: list[pytest.Item]) -> None:
    """Share the cases of each test among the drivers; what is left is for a long soak run.

    A test of one case, and one that is marked every_driver, keep all drivers. The share of case i
    follows the number of ones in i, so that each value of each of several parameters comes to
    every driver.
    """
    tests: dict[str, dict[str, list[pytest.Function]]] = defaultdict(lambda: defaultdict(list))
    for item in items:
        if not isinstance(item, pytest.Function) or "device_index" not in item.fixturenames:
            continue
        if item.get_closest_marker("every_driver") is None:
            case = item.callspec.id.partition("-")[2]  # the driver comes first
            tests[item.nodeid.partition("[")[0]][case].append(item)
    for cases in tests.values():
        for number, found in enumerate(cases.values()):
            chosen = found[number.bit_count() % len(found)]
            for item in found:
                if item is not chosen and len(cases) > 1:
                    item.add_marker("soak")
                    item.add_marker("long")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail in CI if a test was skipped and the real models are there: all else that tests need is
    installed."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None:  # a worker
        return
    skipped = reporter.stats.get("skipped", [])
    if skipped and os.environ.get("CI") == "true" and MODELS.exists():
        reporter.write_line(f"{len(skipped)} skipped, the first: {skipped[0].longrepr}", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the models without which tests were skipped, and why, in one line."""
    skipped = terminalreporter.stats.get("skipped", [])
    absent = [re.findall(rf"{ABSENT} ([\w.-]+)", str(each.longrepr)) for each in skipped]
    if names := sorted({name for found in absent for name in found}):
        count = sum(map(bool, absent))
        terminalreporter.write_line(
            f"{count} skipped without {', '.join(names)}: not in {MODELS}, and no part of the "
            "repository (docs/models.md)"
        )


SLOW_FOLDERS = {"bench", "selftest"}  # reports, and every case of the self-test


def uses_processes_or_models(item: pytest.Function) -> bool:
    if item.path.parent.name in SLOW_FOLDERS:
        return True
    names = {*item.function.__code__.co_names, *item.fixturenames}
    return not names.isdisjoint(
        {"model", "on_terminal", "process", "run_python", "shell", "subprocess"}
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device_index" in metafunc.fixturenames:
        found = usable_devices()
        assert found, NO_DEVICE
        if metafunc.config.getoption("quick"):
            found = found[:1]
        metafunc.parametrize(
            "device_index",
            [index for index, _ in found],
            ids=[name.split("(")[0].split()[0] for _, name in found],
            scope="session",
        )


@pytest.fixture(scope="session")
def device(device_index: int) -> Device:
    """Each usable device in turn."""
    return opened(device_index)


@pytest.fixture(scope="session")
def devices(request: pytest.FixtureRequest) -> list[Device]:
    """All usable devices, for tests whose oracle takes longer than what it is compared with: it
    runs once for all of them."""
    found = usable_devices()
    assert found, NO_DEVICE
    return [opened(index) for index, _ in found[: 1 if request.config.getoption("quick") else None]]


def model(name: str) -> Path:
    """A real model; tests that need it skip where the models are absent."""
    path = MODELS / name
    if not path.exists():
        pytest.skip(f"{ABSENT} {name}")
    return path


def example(name: str) -> ModuleType:
    """A module of the examples."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"examples/{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def models(tmp_path_factory) -> Path:
    """bunny.obj, parts.glb, bunny.svo.h5 (128, solid), bunny.adf.h5 (level 5), points.csv,
    open.obj, a box without a lid, box.svo.h5, its voxels in the grid of the bunny, volume.vtu and
    volume.tet.h5 (density), mask.npy and scan.npz (voxels and coverages of bunny.svo.h5),
    distances.nii.gz (samples of bunny.adf.h5)."""
    folder = tmp_path_factory.mktemp("models")
    write_obj(folder / "bunny.obj", *example("make_bunny").make_bunny(3000))
    (folder / "parts.glb").write_bytes(example("make_parts").glb())
    write_obj(folder / "open.obj", *meshes.open_box(0, (4, 3, 2)))
    (folder / "points.csv").write_text("x,y,z\n0,1,0\n0.5,2,0.25\n")
    helpers_tets.write_vtu(folder / "volume.vtu")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in (
            "voxelize bunny.obj --dim 128 -q",
            "voxelize open.obj --like bunny.svo.h5 -o box.svo.h5 -q",
            "adf-build bunny.obj --max-level 5 -q",
            "tet-build volume.vtu --scalar density -q",
            "export bunny.svo.h5 -o mask.npy -q",
            "export bunny.svo.h5 -o scan.npz --level 1 -q",
            "export bunny.adf.h5 -o distances.nii.gz --shape 20 -q",
        ):
            run(words)
    return folder


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that one of the processes of a run makes, and all of them read."""
    import fcntl

    base = factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = base / name
    with open(base / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            begun = factory.mktemp(name)
            make(begun)
            begun.rename(folder)
    return folder


@pytest.fixture
def here(models: Path, tmp_path: Path, monkeypatch) -> Path:
    """The current folder, with copies of the models."""
    for file in models.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def shell(tmp_path_factory) -> dict[str, str]:
    """An environment in which a shell finds `voxtool`."""
    folder = tmp_path_factory.mktemp("bin")
    script = folder / "voxtool"
    script.write_text(f'#!/bin/sh\nexec {shlex.join(MODULE)} "$@"\n')
    script.chmod(0o755)
    return {**ENVIRONMENT, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}


@pytest.fixture(scope="session")
def seed(request: pytest.FixtureRequest) -> int:
    """The seed of a soak run."""
    given = request.config.getoption("seed")
    chosen = random.SystemRandom().randrange(1 << 32) if given is None else given
    print(f"soak: --seed {chosen}")
    return chosen


@pytest.fixture
def rounds(request: pytest.FixtureRequest, seed: int) -> Iterator[Iterator[random.Random]]:
    """One random generator a round, for as long as the test's share of the time lasts."""
    end = time.monotonic() + float(request.config.getoption("soak") or 0) / SOAKED
    count = 0

    def until_then() -> Iterator[random.Random]:
        nonlocal count
        while count == 0 or time.monotonic() < end:
            yield random.Random(f"{request.node.name} {seed} {count}")
            count += 1

    yield until_then()
    print(f"soak: {request.node.name}: {count:,} rounds")


@pytest.fixture(scope="session")
def browser() -> Iterator:
    with open_browser() as browser:
        yield browser


@pytest.fixture
def large(viewer: Viewer) -> Iterator[None]:
    """The tab of `viewer` has room for the pointer and the panel."""
    viewer.resize(*LARGE)
    yield
    viewer.resize(*SMALL)
