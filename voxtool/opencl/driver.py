"""pyopencl, imported with every driver in sight; and which drivers survive a fork."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

from voxtool import limits, watch
from voxtool.errors import DeviceError
from voxtool.opencl import cache

INSTALL_HINT = (
    "install the extra 'cpu' (pip install 'voxtool[cpu]', x86-64) or a driver: see docs/devices.md"
)
FORK_HINT = "start processes with the method 'spawn' of multiprocessing instead of 'fork'"
SYSTEM_DRIVERS = Path("/etc/OpenCL/vendors")
# Platforms that hang in a child process if the parent loaded them: PoCL, whose threads are gone.
LOST_IN_FORK = ("Portable Computing Language",)
# Variables that set the number of threads of Intel's driver and of PoCL.
THREADS = ("DPCPP_CPU_NUM_CUS", "POCL_MAX_PTHREAD_COUNT")

forks = 0  # since the drivers were loaded, on the way to this process


@functools.cache
def opencl() -> Any:
    """Return pyopencl, imported with the environment's own CPU driver in sight.

    The loader reads OCL_ICD_VENDORS, a folder of .icd files, when the platforms are first asked
    for. If the extra `cpu` is installed and nobody has set the variable, it names a folder with
    the system's drivers and that one for as long as this takes.
    Raises DeviceError if pyopencl cannot be imported.
    """
    embedded = Path(sys.prefix, "lib", "libintelocl.so")
    # Intel's CPU driver: our kernels branch too much for work-items to share vector registers
    os.environ.setdefault("CL_CONFIG_CPU_VECTORIZER_MODE", "1")
    if quota := limits.processors():
        for name in THREADS:
            os.environ.setdefault(name, str(quota))
    if cache.folder() is None:
        os.environ.setdefault("PYOPENCL_NO_CACHE", "1")  # pyopencl keeps code that sets arguments
        if "POCL_CACHE_DIR" not in os.environ:  # PoCL does not start without a folder
            os.environ["POCL_CACHE_DIR"] = cache.temporary_folder()
    with contextlib.ExitStack() as stack:
        if embedded.exists() and "OCL_ICD_VENDORS" not in os.environ:
            stack.enter_context(watch.making)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="voxtool-icd-")))
            watch.writing(folder)
            stack.callback(watch.written, folder)
            for icd in SYSTEM_DRIVERS.glob("*.icd"):
                shutil.copy(icd, folder)
            (folder / "voxtool-cpu.icd").write_text(f"{embedded}\n")
            os.environ["OCL_ICD_VENDORS"] = str(folder)
            stack.callback(os.environ.pop, "OCL_ICD_VENDORS")
        try:
            import pyopencl as cl
        except ImportError as error:
            raise DeviceError(f"pyopencl cannot be imported ({error}): {INSTALL_HINT}") from error
        with contextlib.suppress(cl.Error):  # no platform at all is an error, too
            cl.get_platforms()
    # Drivers log successful builds. A filter of warnings would not do: users replace filters.
    cl.compiler_output = lambda text: None
    warnings.filterwarnings("ignore", module="pyopencl")  # a cache that cannot be written
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_count_fork)
    return cl


def _count_fork() -> None:
    global forks
    forks += 1


def survives(platform: str) -> bool:
    """Return True if a platform can be used in this process."""
    return not forks or platform not in LOST_IN_FORK
