"""Finding OpenCL devices, probing them, and choosing one."""

from __future__ import annotations

import os
import re
import threading
import warnings
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from voxtool import watch
from voxtool.errors import DeviceError, DeviceWarning
from voxtool.limits import unbounded_memory
from voxtool.opencl import driver, program
from voxtool.opencl.device import Device

PROBE = """
__kernel __attribute__((reqd_work_group_size(256, 1, 1))) void probe(__global uint *values) {
    values[get_global_id(0)] = 3u * (uint)get_global_id(0) + 1u;
}
"""


@dataclass(frozen=True)
class DeviceInfo:
    """The properties of a device, and the outcome of the probe kernel: "ok", or its failure."""

    index: int
    name: str
    platform: str
    kind: str
    driver: str
    opencl: str
    units: int
    memory: int
    max_allocation: int
    fp64: bool
    probe: str

    @property
    def title(self) -> str:
        """The names of the device and its platform."""
        return f"{self.name} ({self.platform})"

    def as_dict(self) -> dict[str, Any]:
        """Return all properties in JSON types."""
        return asdict(self)

    def matches(self, choice: str) -> bool:
        """Return True if `choice` is the index, the kind, or a part of the names of this device."""
        if choice.isdecimal():
            return self.index == int(choice)
        if choice.lower() in ("cpu", "gpu"):
            return self.kind.lower() == choice.lower()
        names = f"{self.platform} {self.name} {self.opencl}"
        return re.search(re.escape(choice), names, re.IGNORECASE) is not None


def list_devices() -> list[DeviceInfo]:
    """Return every device with the probe's outcome, in the order in which they are preferred."""
    devices = _cl_devices()
    infos = [_info(i, d, "") for i, d in enumerate(devices)]
    found = []
    for info, each in zip(infos, devices, strict=True):
        _watch(info, infos)
        found.append(replace(info, probe=_probe(each)))
    return found


def open_device(choice: str | None = None, *, profile: bool = False) -> Device:
    """Return the device to use.

    Parameters
    ----------
    choice
        an index of `voxtool devices`, "cpu", "gpu", or a part of the platform's or the
        device's name; by default $VOXTOOL_DEVICE, or the first device that works, GPUs first.
    profile
        time each stage by events of the device.

    Raises
    ------
    DeviceError
        no device, none that matches, or none that passes the probe.

    Warns
    -----
    DeviceWarning
        a device that would be preferred fails the probe.
    """
    choice = choice or os.environ.get("VOXTOOL_DEVICE") or None
    devices = _cl_devices()
    if not devices:
        raise no_usable_device([])
    infos = [_info(i, d, "") for i, d in enumerate(devices)]
    matching = [i for i in infos if choice is None or i.matches(choice)]
    if not matching:
        names = "; ".join(f"{i.index}: {i.title}" for i in infos)
        raise DeviceError(f"no OpenCL device matches {choice!r}: choose one of {names}")
    failures = []
    for info in matching:
        _watch(info, infos)
        outcome = _probe(devices[info.index])
        if outcome == "ok":
            for failure in failures:
                warnings.warn(f"passed over {failure}", DeviceWarning, stacklevel=2)
            return Device(devices[info.index], info, profile)
        failures.append(f"{info.title}, probe {outcome}")
    raise no_usable_device(failures)


def _watch(used: DeviceInfo, infos: list[DeviceInfo]) -> None:
    """Say which device is used, and which others there are, in case its driver ends the process."""
    watch.using(used.title, [f"{i.index}: {i.title}" for i in infos if i.index != used.index])


def default_device() -> Device:
    """Return the device of calls that name none: `shared_device()`."""
    return shared_device()


def shared_device(choice: str | None = None, *, profile: bool = False) -> Device:
    """Return the device of `open_device(choice, profile=profile)`, opened once a process.

    It is opened again in a child process after a fork, and when $VOXTOOL_DEVICE changes. Threads
    may share it. Raises DeviceError as `open_device`.
    """
    choice = choice or os.environ.get("VOXTOOL_DEVICE") or None
    key = os.getpid(), choice, profile
    with _opening:
        if key not in _shared:
            with unbounded_memory():  # another thread may read a file meanwhile
                _shared[key] = open_device(choice, profile=profile)
        return _shared[key]


_shared: dict[tuple[int, str | None, bool], Device] = {}
_opening = threading.Lock()


def _renew_lock() -> None:
    """Replace the lock, which another thread of the parent may have held."""
    global _opening
    _opening = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


def no_usable_device(failures: list[str]) -> DeviceError:
    """Return the error that says what to install, or what to do instead."""
    hint = driver.FORK_HINT if driver.forks else driver.INSTALL_HINT
    if folder := os.environ.get("OCL_ICD_VENDORS"):
        hint += f"; only drivers in OCL_ICD_VENDORS={folder} were sought"
    return DeviceError("; ".join(["no usable OpenCL device", *failures]) + f": {hint}")


def _cl_devices() -> list[Any]:
    """Return every device of every platform; GPUs first, otherwise in the loader's order."""
    cl = driver.opencl()
    try:
        found = [d for p in cl.get_platforms() for d in p.get_devices()]
    except cl.Error:
        found = []
    return sorted(found, key=lambda d: not d.type & cl.device_type.GPU)


def _info(index: int, cl_device: Any, probe: str) -> DeviceInfo:
    kinds = driver.opencl().device_type
    return DeviceInfo(
        index=index,
        name=cl_device.name.strip(),
        platform=cl_device.platform.name.strip(),
        kind=next((k for k in ("GPU", "CPU") if cl_device.type & getattr(kinds, k)), "accelerator"),
        driver=cl_device.driver_version,
        opencl=cl_device.version.strip(),
        units=cl_device.max_compute_units,
        memory=cl_device.global_mem_size,
        max_allocation=cl_device.max_mem_alloc_size,
        fp64="cl_khr_fp64" in cl_device.extensions,
        probe=probe,
    )


def _probe(cl_device: Any, source: str = PROBE) -> str:
    """Return the outcome of a three-line kernel in a work-group as large as any of ours: "ok", or
    the first line of the failure."""
    cl = driver.opencl()
    if not driver.survives(cl_device.platform.name.strip()):
        return "failed: this driver does not work in a forked process"
    try:
        context = cl.Context([cl_device])
        queue = cl.CommandQueue(context)
        kernel = cl.Kernel(program.compiled(cl, context, source), "probe")
        values = np.zeros(256, np.uint32)
        buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, values.nbytes)
        kernel.set_args(buffer)
        cl.enqueue_nd_range_kernel(queue, kernel, values.shape, values.shape)
        cl.enqueue_copy(queue, values, buffer)
    except (cl.Error, RuntimeError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return f"failed: {lines[0] if lines else type(error).__name__}"
    if not np.array_equal(values, 3 * np.arange(256, dtype=np.uint32) + 1):
        return "failed: the probe kernel gave wrong values"
    return "ok"
