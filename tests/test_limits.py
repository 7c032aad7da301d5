"""Limits of control groups, read from copies of their files; and those of this process."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest
from helpers.files import run_python

from voxtool import limits, memory

GIB = 1 << 30


def groups(root: Path, table: str, files: dict[str, str]) -> str:
    """A folder with proc/self/cgroup and files below sys/fs/cgroup."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(table)
    for name, content in files.items():
        path = root / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return str(root)


V1 = "3:cpu,cpuacct:/docker/abc\n2:memory:/docker/abc\n0::/\n"
CASES = {  # control groups, files, bytes that are left, processors
    "none": ("", {}, limits.UNLIMITED, None),
    "v2 without limits": (
        "0::/user.slice\n",
        {"user.slice/memory.max": "max\n", "user.slice/cpu.max": "max 100000\n"},
        limits.UNLIMITED,
        None,
    ),
    "v2 in a container": (
        "0::/\n",
        {
            "memory.max": f"{2 * GIB}\n",
            "memory.current": f"{GIB}\n",
            "memory.stat": f"anon 5\ninactive_file {GIB // 2}\n",
            "cpu.max": "150000 100000\n",
        },
        3 * GIB // 2,
        2,
    ),
    "v2, the outer group is smaller": (
        "0::/a/b\n",
        {
            "a/b/memory.max": f"{4 * GIB}",
            "a/b/memory.current": "0",
            "a/memory.max": f"{GIB}",
            "a/memory.current": f"{2 * GIB}",
            "a/b/cpu.max": "400000 100000",
            "a/cpu.max": "10000 100000",
        },
        0,
        1,
    ),
    "v1, its own group as the root": (
        V1,
        {
            "memory/memory.limit_in_bytes": f"{GIB}",
            "memory/memory.usage_in_bytes": f"{GIB // 4}",
            "memory/memory.stat": "total_inactive_file 0",
            "cpu/cpu.cfs_quota_us": "300000",
            "cpu/cpu.cfs_period_us": "100000",
        },
        3 * GIB // 4,
        3,
    ),
    "v1 without limits": (
        V1,
        {
            "memory/docker/abc/memory.limit_in_bytes": "9223372036854771712",
            "cpu/docker/abc/cpu.cfs_quota_us": "-1",
            "cpu/docker/abc/cpu.cfs_period_us": "100000",
        },
        limits.UNLIMITED,
        None,
    ),
    "strange files": (
        "0::/../..\n",
        {"memory.max": "many", "cpu.max": "x"},
        limits.UNLIMITED,
        None,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_limits_of_control_groups(name: str, tmp_path: Path) -> None:
    table, files, left, processors = CASES[name]
    root = groups(tmp_path, table, files)
    assert limits.group_memory(root) == left
    assert limits.processors(root) == processors


def test_the_address_space_counts_as_memory() -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    assert memory.available_memory() > GIB // 4
    try:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), before[1]))
        assert 0 <= memory.available_memory() <= 64 << 20
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


OPENING = """
import threading
from voxtool.limits import bounded_memory
from voxtool.opencl import shared_device
found = []
thread = threading.Thread(target=lambda: found.append(shared_device().info.units > 0))
with bounded_memory(1 << 26):
    thread.start()
    thread.join(0.5)
    print(thread.is_alive())
thread.join()
print(found)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux bounds memory")
def test_a_device_is_opened_after_a_bound_of_another_thread() -> None:
    done = run_python(OPENING)
    assert done.stdout.split() == [b"True", b"[True]"], done.stderr


def test_a_bound_waits_for_work_without_one() -> None:
    """Two blocks without a bound run side by side; one with a bound waits for both."""
    order = []

    def bound() -> None:
        with limits.bounded_memory(GIB):
            order.append("bound")

    with limits.unbounded_memory():
        with limits.unbounded_memory():
            thread = threading.Thread(target=bound)
            thread.start()
        thread.join(0.05)
        order.append("free")
    thread.join()
    assert order == ["free", "bound"]
