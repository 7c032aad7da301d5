"""A Dask cluster of subprocesses that are killed while a mesh is voxelized."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.cli import ENVIRONMENT, MODULE, told

import voxtool

pytestmark = pytest.mark.soak
ONE_THREAD = {"CL_CONFIG_CPU_FORCE_NUM_THREADS": "1", "POCL_MAX_PTHREAD_COUNT": "1"}


class Cluster:
    """A scheduler and two workers, each a process, which can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self._folder = folder
        place = ("--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        self._scheduler_call = ("distributed.cli.dask_scheduler", *place)
        worker = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(folder))
        self._worker_call = ("distributed.cli.dask_worker", self.address, *worker)
        self.start()

    def _process(self, call: tuple[str, ...]) -> subprocess.Popen[bytes]:
        with (self._folder / "log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", *call], env={**ENVIRONMENT, **ONE_THREAD}, stderr=log
            )

    def start(self) -> None:
        """Start the scheduler and the workers."""
        self.scheduler = self._process(self._scheduler_call)
        self.workers = [self._process(self._worker_call) for _ in range(2)]

    def stop(self, number: int = signal.SIGTERM) -> None:
        """End all processes by a signal."""
        for process in (self.scheduler, *self.workers):
            process.send_signal(number)
        for process in (self.scheduler, *self.workers):
            process.wait(30)


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.stop()


@pytest.mark.parametrize(
    "of",
    [
        "bunny.obj --dim 2000 --fill parity",
        "open.obj --dim 500 --fill winding",
        "parts.glb --dim 900 --labels part --attributes colour --with-surface",
        "bunny.obj --dim 700 --mode fraction --face-fractions",
    ],
)
def test_a_scheduler_that_comes_back_costs_nothing(
    of: str, cluster: Cluster, models: Path, tmp_path: Path
) -> None:
    target = tmp_path / "out.svo.h5"
    whole = told(f"voxelize {models}/{of} -o {target} --json")["digest"]
    target.unlink()
    command = f"voxelize {models}/{of} -q -o {target} --dask {cluster.address}"
    for seed in range(2):
        child = subprocess.Popen(
            [*MODULE, *command.split()], env=ENVIRONMENT, stderr=subprocess.PIPE
        )
        windows = Path(f"{target}.windows")
        wanted = random.Random(seed).randrange(8)  # of 16, or more
        while child.poll() is None and len(list(windows.rglob("*.0"))) < wanted:
            time.sleep(0.01)
        assert child.poll() is None, "the command was done before a kill"
        cluster.stop(signal.SIGKILL)
        time.sleep(1)
        cluster.start()
        assert child.communicate(timeout=120) == (None, b"")
        assert child.returncode == 0
        assert voxtool.read_svo(target).digest() == whole
        assert [path.name for path in tmp_path.iterdir()] == [target.name]
        target.unlink()
