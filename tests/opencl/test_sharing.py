"""A device shared: by threads, by calls that keep data on it, and with forked processes."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from voxtool.opencl import Device, default_device, open_device
from voxtool.opencl.primitives import exclusive_scan, radix_sort

ROOT = Path(__file__).parents[2]
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")


def sort_and_scan(device: Device, seed: int) -> None:
    """Sort keys and scan them, on arrays that are shared with the host and that are not."""
    rng = np.random.default_rng(seed)
    for n in (100, 60_000):
        keys = rng.integers(0, 1 << 20, n, dtype=np.uint32)
        found, _ = radix_sort(device.put(keys), n, 20)
        assert np.array_equal(found.get(), np.sort(keys))
        counts = device.zeros(n + 1, np.uint32)
        device.write(counts, keys & 7)
        assert exclusive_scan(counts, n) == (keys & 7).sum()


def test_threads_share_a_device(device: Device) -> None:
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda seed: sort_and_scan(device, seed), range(24)))


def test_threads_get_one_default_device(device: Device, monkeypatch) -> None:
    monkeypatch.setenv("VOXTOOL_DEVICE", str(device.info.index))
    with ThreadPoolExecutor(4) as pool:
        (found,) = {default_device() for _ in pool.map(abs, range(8))}
    assert found.info.index == device.info.index


def test_stages_are_those_of_the_thread(device: Device) -> None:
    def stages(name: str) -> list[str]:
        began: list[str] = []
        with device.reporting(began.append):
            for _ in range(50):
                with device.stage(name):
                    device.zeros(1, np.uint32)
        return began

    with ThreadPoolExecutor(4) as pool:
        for name, began in zip("abcd", pool.map(stages, "abcd"), strict=True):
            assert began == [name] * 50


# ---- data that stays


class Owner:
    """An object that data is kept for."""


def test_data_is_kept_for_its_owner(device: Device) -> None:
    made: list[int] = []
    owner, other = Owner(), Owner()

    def keep(of: Owner, kind: str = "a") -> int:
        return device.keep(of, kind, 100, lambda: made.append(0) or len(made))

    assert [keep(owner), keep(owner), keep(owner, "b"), keep(other), keep(owner)] == [1, 1, 2, 3, 1]
    gc.collect()  # of owners that other tests left
    before = len(device._kept)
    del owner
    gc.collect()
    assert len(device._kept) == before - 2
    assert keep(other) == 3


def test_the_least_recently_used_goes_beyond_the_limit() -> None:
    opened = open_device()
    tenth = opened.max_memory // 10  # a quarter of the memory is for data that is kept
    a, b, c, d = owners = [Owner() for _ in range(4)]
    for owner in (a, b, a, c):
        opened.keep(owner, "", tenth, object)
    assert [(id(owner), "") in opened._kept for owner in owners] == [True, False, True, False]
    never_fits = 3 * tenth
    assert opened.keep(d, "", never_fits, object) is not opened.keep(d, "", never_fits, object)


# ---- processes

SCAN = """
import os, signal, sys
import numpy as np
from voxtool.errors import DeviceError
from voxtool.opencl import default_device, list_devices
from voxtool.opencl.primitives import exclusive_scan

def scan():
    ones = default_device().put(np.ones(70001, np.uint32))
    return exclusive_scan(ones, 70000)

device = default_device() if sys.argv[1] == "used" else None
if device:
    assert scan() == 70000
pid = os.fork()
if pid == 0:
    signal.alarm(60)
    for work in (scan, lambda: device.zeros(1, np.uint32)):
        try:
            work()
            print("worked")
        except (DeviceError, AttributeError) as error:
            print(error)
    sys.stdout.flush()
    sys.exit()
assert os.waitpid(pid, 0)[1] == 0
assert not device or scan() == 70000
"""


def forked(device: Device, how: str) -> list[str]:
    """The output of a forked child that works on its default device, and on its parent's."""
    done = subprocess.run(
        [sys.executable, "-c", SCAN, how],
        env={**os.environ, "PYTHONPATH": str(ROOT), "VOXTOOL_DEVICE": str(device.info.index)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@needs_fork
def test_a_forked_child_works_or_is_told_to_be_spawned(device: Device) -> None:
    own, inherited = forked(device, "used")
    if "Portable" in device.info.platform:
        assert "this driver does not work in a forked process: start processes with the" in own
        assert "'spawn'" in own
    else:
        assert own == "worked"
    assert "was opened before this process was forked: open it again here" in inherited


@needs_fork
def test_a_process_that_is_forked_first_works(device: Device) -> None:
    assert forked(device, "not used")[0] == "worked"


# ---- warnings


def test_compilers_warnings_are_not_the_users(device: Device) -> None:
    text = f"#warning {os.urandom(8).hex()}\n__kernel void odd(__global uint *a) {{ uint unused; }}"
    with warnings.catch_warnings(action="error"):
        open_device(str(device.info.index)).kernel(text, "odd")
