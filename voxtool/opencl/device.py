"""Finding and choosing a device, and what a host function needs of one."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import sys
import tempfile
import threading
import warnings
import weakref
from collections import OrderedDict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from voxtool.errors import DeviceError, DeviceWarning, MemoryLimitError
from voxtool.memory import available_memory
from voxtool.opencl import launch, program

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

T = TypeVar("T")

KEPT_SHARE = 0.25  # of the memory that work may take, for data that is used again
INSTALL_HINT = (
    "install the extra 'cpu' (pip install 'voxtool[cpu]', x86-64) or a driver: see docs/devices.md"
)
OUT_OF_MEMORY = (-4, -5, -6)  # CL_MEM_OBJECT_ALLOCATION_FAILURE, _OUT_OF_RESOURCES, _HOST_MEMORY
SYSTEM_DRIVERS = Path("/etc/OpenCL/vendors")
PAGE = 4096  # alignment at which a CPU's driver uses the host's memory as it is
ALIGNMENT = 128  # bytes, of buffers that CPU drivers do not copy (CL_DEVICE_MEM_BASE_ADDR_ALIGN)
SHARED_FROM = 1 << 16  # bytes; smaller arrays are the driver's own
WORK_GROUP = 64  # work-items; a few wavefronts, and enough for a CPU's core
PROBE = """
__kernel __attribute__((reqd_work_group_size(256, 1, 1))) void probe(__global uint *values) {
    values[get_global_id(0)] = 3u * (uint)get_global_id(0) + 1u;
}
"""


@functools.cache
def _opencl() -> Any:
    """pyopencl, imported with the environment's own CPU driver in sight.

    The loader reads OCL_ICD_VENDORS, a folder of .icd files, when the platforms are first asked
    for. If the extra `cpu` is installed and nobody has set the variable, it names a folder with
    the system's drivers and that one for as long as this takes.
    """
    embedded = Path(sys.prefix, "lib", "libintelocl.so")
    os.environ.setdefault("PYOPENCL_COMPILER_OUTPUT", "0")
    # Intel's CPU driver: our kernels branch too much for work-items to share vector registers
    os.environ.setdefault("CL_CONFIG_CPU_VECTORIZER_MODE", "1")
    with contextlib.ExitStack() as stack:
        if embedded.exists() and "OCL_ICD_VENDORS" not in os.environ:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="voxtool-icd-")))
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
    warnings.filterwarnings("ignore", category=cl.CompilerWarning)
    return cl


def _cl_devices() -> list[Any]:
    """Every device of every platform; GPUs first, otherwise in the loader's order."""
    cl = _opencl()
    try:
        found = [d for p in cl.get_platforms() for d in p.get_devices()]
    except cl.Error:
        found = []
    return sorted(found, key=lambda d: not d.type & cl.device_type.GPU)


@dataclass(frozen=True)
class DeviceInfo:
    """What is known of a device, and whether the probe kernel ran on it."""

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
    probe: str  # "ok", or what failed

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def _info(index: int, cl_device: Any, probe: str) -> DeviceInfo:
    cl = _opencl()
    return DeviceInfo(
        index=index,
        name=cl_device.name.strip(),
        platform=cl_device.platform.name.strip(),
        kind="GPU"
        if cl_device.type & cl.device_type.GPU
        else "CPU"
        if cl_device.type & cl.device_type.CPU
        else "accelerator",
        driver=cl_device.driver_version,
        opencl=cl_device.version.strip(),
        units=cl_device.max_compute_units,
        memory=cl_device.global_mem_size,
        max_allocation=cl_device.max_mem_alloc_size,
        fp64="cl_khr_fp64" in cl_device.extensions,
        probe=probe,
    )


def _probe(cl_device: Any) -> str:
    """Build and run a three-line kernel in a work-group as large as any of ours: "ok", or the
    first line of what failed."""
    cl = _opencl()
    try:
        context = cl.Context([cl_device])
        queue = cl.CommandQueue(context)
        kernel = cl.Kernel(cl.Program(context, PROBE).build(), "probe")
        values = np.zeros(256, np.uint32)
        buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, values.nbytes)
        kernel(queue, values.shape, values.shape, buffer)
        cl.enqueue_copy(queue, values, buffer)
    except (cl.Error, RuntimeError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return f"failed: {lines[0] if lines else type(error).__name__}"
    if not np.array_equal(values, 3 * np.arange(256, dtype=np.uint32) + 1):
        return "failed: the probe kernel gave wrong values"
    return "ok"


def list_devices() -> list[DeviceInfo]:
    """Every device with the probe's outcome, in the order in which they are preferred."""
    return [_info(i, d, _probe(d)) for i, d in enumerate(_cl_devices())]


def open_device(choice: str | None = None, *, profile: bool = False) -> Device:
    """The device to use.

    Parameters
    ----------
    choice : an index of `voxtool devices`, "cpu", "gpu", or a part of the platform's or the
        device's name; by default $VOXTOOL_DEVICE, or the first device that works, GPUs first.
    profile : time each stage by events of the device.

    Raises
    ------
    DeviceError : no device, none that matches, or none that passes the probe.
    """
    choice = choice or os.environ.get("VOXTOOL_DEVICE") or None
    devices = _cl_devices()
    if not devices:
        raise no_usable_device([])
    infos = [_info(i, d, "") for i, d in enumerate(devices)]
    matching = [i for i in infos if choice is None or _matches(i, choice)]
    if not matching:
        names = "; ".join(f"{i.index}: {i.name} ({i.platform})" for i in infos)
        raise DeviceError(f"no OpenCL device matches {choice!r}: choose one of {names}")
    failures = []
    for info in matching:
        outcome = _probe(devices[info.index])
        if outcome == "ok":
            for failure in failures:
                warnings.warn(f"passed over {failure}", DeviceWarning, stacklevel=2)
            return Device(devices[info.index], info, profile)
        failures.append(f"{info.name} ({info.platform}), probe {outcome}")
    raise no_usable_device(failures)


def default_device() -> Device:
    """The device of calls that name none: `open_device()`, once a process.

    It is opened again in a child process after a fork, and when $VOXTOOL_DEVICE changes. Threads
    may share it.

    Raises
    ------
    DeviceError : as open_device.
    """
    key = os.getpid(), os.environ.get("VOXTOOL_DEVICE")
    with _opening:
        if key not in _default_devices:
            _default_devices[key] = open_device()
        return _default_devices[key]


_default_devices: dict[tuple[int, str | None], Device] = {}
_opening = threading.Lock()


def no_usable_device(failures: list[str]) -> DeviceError:
    """The error that says what to install, or to unset."""
    mend = INSTALL_HINT
    if folder := os.environ.get("OCL_ICD_VENDORS"):
        mend += f"; only drivers in OCL_ICD_VENDORS={folder} were sought"
    return DeviceError("; ".join(["no usable OpenCL device", *failures]) + f": {mend}")


def _matches(info: DeviceInfo, choice: str) -> bool:
    if choice.isdecimal():
        return info.index == int(choice)
    if choice.lower() in ("cpu", "gpu"):
        return info.kind.lower() == choice.lower()
    return (
        re.search(re.escape(choice), f"{info.platform} {info.name} {info.opencl}", re.IGNORECASE)
        is not None
    )


class Array:
    """A one-dimensional array on a device; `host` is its memory where host and device share it."""

    def __init__(
        self, device: Device, dtype: np.dtype, size: int, buffer: Any, host: np.ndarray | None
    ) -> None:
        self.device = device
        self.dtype = dtype
        self.size = size
        self.buffer = buffer
        self.host = host

    def get(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """A copy of elements [start, stop) on the host; waits for the device."""
        stop = self.size if stop is None else stop
        values = np.empty(stop - start, self.dtype)
        if values.size:
            self.device.read(values, self.buffer, start * self.dtype.itemsize)
        return values

    def take(self) -> np.ndarray:
        """All elements on the host, without a copy where memory is shared; the array is gone."""
        if self.host is None:
            values = self.get()
        else:
            self.device.finish_into(self.buffer, self.host.nbytes)
            values = self.host[: self.size * self.dtype.itemsize].view(self.dtype)
            self.host = None
        self.release()
        return values

    def release(self) -> None:
        """Give the memory back; the array must not be used again."""
        self.buffer.release()
        self._retire()

    def _retire(self) -> None:
        """Shared memory must outlive the work that is still enqueued on it."""
        if self.host is not None:
            self.device.retire(self.host)
            self.host = None

    def __del__(self) -> None:
        self._retire()


class _Thread(threading.local):
    """What each thread is at: the stage, and who is told of the next."""

    stage = "other"
    progress: Callable[[str], None] | None = None


class Device:
    """A device with its context, its queue, its programs, and the time of each stage."""

    def __init__(self, cl_device: Any, info: DeviceInfo, profile: bool) -> None:
        cl = self._cl = _opencl()
        self.info = info
        self.cl_device = cl_device
        self.context = cl.Context([cl_device])
        flags = cl.command_queue_properties.PROFILING_ENABLE if profile else 0
        self.queue = cl.CommandQueue(self.context, cl_device, flags)
        self.profile = profile
        self.shares_memory = info.kind == "CPU"
        self._retired: list[np.ndarray] = []  # shared memory, kept until the queue has run dry
        self._kept: OrderedDict[tuple[int, str], tuple[Any, int]] = OrderedDict()
        self._thread = _Thread()
        self._lock = threading.RLock()  # a kernel's arguments and its launch belong together
        self._events: list[tuple[str, Any]] = []
        self._kernels: dict[Any, Callable[..., None]] = {}

    # ---- memory

    @property
    def max_memory(self) -> int:
        """Bytes that work may take: the device's, of a CPU no more than the machine has left."""
        if self.info.kind != "CPU":
            return self.info.memory
        return min(self.info.memory, available_memory())

    def _array(self, size: int, dtype: np.dtype | type, make: Callable[..., np.ndarray]) -> Array:
        """An array of new memory; if it is shared, host memory that `make` (np.empty, np.zeros)
        gives, in pages larger than drivers ask for."""
        dtype = np.dtype(dtype)
        nbytes = max(-(-size * dtype.itemsize // 4) * 4, 4)  # whole words, for zeros
        flags, host = self._cl.mem_flags.READ_WRITE, None
        try:
            if self.shares_memory and nbytes >= SHARED_FROM:
                pages = make(-(-nbytes // PAGE) * PAGE + PAGE, np.uint8)
                start = -pages.ctypes.data % PAGE
                host = pages[start : start - PAGE or None]
                flags |= self._cl.mem_flags.USE_HOST_PTR
                buffer = self._cl.Buffer(self.context, flags, hostbuf=host)
            else:
                buffer = self._cl.Buffer(self.context, flags, nbytes)
        except (self._cl.Error, MemoryError) as error:
            raise self._too_large(nbytes) from error
        return Array(self, dtype, size, buffer, host)

    def _too_large(self, nbytes: int) -> MemoryLimitError:
        return MemoryLimitError(
            f"{self.info.name} could not allocate {nbytes} bytes: choose a smaller dim"
        )

    def empty(self, size: int, dtype: np.dtype | type) -> Array:
        """An array of undefined content."""
        return self._array(size, dtype, np.empty)

    def zeros(self, size: int, dtype: np.dtype | type) -> Array:
        """An array of zeros."""
        array = self._array(size, dtype, np.zeros)
        if array.host is None:
            size = array.buffer.size
            self._enqueue(self._cl.enqueue_fill_buffer, array.buffer, np.uint32(0), 0, size)
        return array

    def put(self, values: np.ndarray) -> Array:
        """A copy of a host array, flattened, on the device."""
        if not values.size:
            return self.empty(0, values.dtype)
        flags = self._cl.mem_flags.READ_WRITE | self._cl.mem_flags.COPY_HOST_PTR
        try:
            buffer = self._cl.Buffer(self.context, flags, hostbuf=np.ascontiguousarray(values))
        except (self._cl.Error, MemoryError) as error:
            raise self._too_large(values.nbytes) from error
        return Array(self, values.dtype, values.size, buffer, None)

    def view(self, values: np.ndarray) -> Array:
        """A host array for kernels to read: shared where it can be, or else a copy. It must not
        change until the device has read it."""
        aligned = values.ctypes.data % ALIGNMENT == 0 and values.flags.c_contiguous
        if not (self.shares_memory and aligned and values.nbytes >= SHARED_FROM):
            return self.put(values)
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.USE_HOST_PTR
        try:
            buffer = self._cl.Buffer(self.context, flags, hostbuf=values)
        except (self._cl.Error, MemoryError) as error:
            raise self._too_large(values.nbytes) from error
        return Array(self, values.dtype, values.size, buffer, values)

    def write(self, array: Array, values: np.ndarray) -> None:
        """Overwrite the beginning of an array."""
        self._enqueue(self._cl.enqueue_copy, array.buffer, np.ascontiguousarray(values))

    def read(self, values: np.ndarray, buffer: Any, offset: int) -> None:
        """Copy from a buffer; waits for all that was enqueued."""
        with self._finishing():
            self._enqueue(self._cl.enqueue_copy, values, buffer, src_offset=offset)

    def finish_into(self, buffer: Any, nbytes: int) -> None:
        """Wait until the shared memory of a buffer holds what the device wrote."""

        def map_and_unmap(queue: Any) -> Any:
            read = self._cl.map_flags.READ
            mapped, event = self._cl.enqueue_map_buffer(queue, buffer, read, 0, nbytes, np.uint8)
            mapped.base.release()
            return event

        with self._finishing():
            self._enqueue(map_and_unmap)

    def retire(self, memory: np.ndarray) -> None:
        """Keep shared memory until the work that is enqueued now is done."""
        with self._lock:
            self._retired.append(memory)

    def keep(self, owner: Any, kind: str, nbytes: int, make: Callable[[], T]) -> T:
        """What `make` returned for this owner and kind, kept on the device for the next call.

        It is released when the owner goes, or when what is kept exceeds KEPT_SHARE of the memory;
        then the one that was not used for longest goes first.

        Parameters
        ----------
        owner : any object that can be weakly referenced; what is made must not refer to it.
        nbytes : that it takes on the device.
        """
        key = id(owner), kind
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
            made = make()
            room = KEPT_SHARE * self.max_memory - nbytes
            while self._kept and sum(size for _, size in self._kept.values()) > room:
                self._kept.popitem(last=False)
            if room >= 0:
                self._kept[key] = made, nbytes
                weakref.finalize(owner, self._kept.pop, key, None)
            return made

    @contextlib.contextmanager
    def _finishing(self) -> Iterator[None]:
        """The work in this block waits for all before it, after which shared memory that was
        retired by then may go."""
        with self._lock:
            retired, self._retired = self._retired, []
        yield
        del retired

    def __del__(self) -> None:
        if hasattr(self, "queue"):
            self.queue.finish()

    # ---- work

    def kernel(self, source: str, name: str, **defines: int | str) -> Callable[..., None]:
        """A kernel of kernels/`source`, built once with the given -D options.

        Called as `kernel(size, *args, local=64, **named)`: at least `size` work-items (none for 0;
        it is rounded up to whole work-groups of `local`, and PoCL compiles a kernel anew for each
        size of group); the arguments as launch.bind takes them.
        """
        key = (source, name, *sorted(defines.items()))
        with self._lock:
            if key not in self._kernels:
                built = program.build(self._cl, self.context, self.info.platform, source, defines)
                declared = launch.parameters(program.flatten(source), defines)
                for kernel in built.all_kernels():
                    name = kernel.function_name
                    launcher = self._launcher(kernel, name, declared[name])
                    self._kernels[(source, name, *key[2:])] = launcher
            return self._kernels[key]

    def _launcher(
        self, kernel: Any, name: str, declared: list[launch.Parameter]
    ) -> Callable[..., None]:
        enqueue = self._cl.enqueue_nd_range_kernel

        def run(size: int, *args: Any, local: int = WORK_GROUP, **named: Any) -> None:
            if size == 0:
                return
            values = launch.bind(name, declared, size, args, named)
            with self._lock:
                kernel.set_args(*values)
                self._enqueue(enqueue, kernel, (-(-size // local) * local,), (local,))

        return run

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Name the stage to which the work of this thread in this block belongs."""
        outer, self._thread.stage = self._thread.stage, name
        if self._thread.progress:
            self._thread.progress(name)
        try:
            yield
        finally:
            self._thread.stage = outer

    @property
    def on_stage(self) -> Callable[[str], None] | None:
        """Who is told of each stage of this thread."""
        return self._thread.progress

    @on_stage.setter
    def on_stage(self, progress: Callable[[str], None] | None) -> None:
        self._thread.progress = progress

    @contextlib.contextmanager
    def reporting(self, progress: Callable[[str], None] | None) -> Iterator[None]:
        """Call `progress` with the name of each stage that this thread begins in this block."""
        outer = self._thread.progress
        self._thread.progress = progress or outer
        try:
            yield
        finally:
            self._thread.progress = outer

    def _enqueue(self, work: Callable[..., Any], *args: Any, **options: Any) -> None:
        """Enqueue work, whose event tells the stage's time."""
        try:
            event = work(self.queue, *args, **options)
        except self._cl.Error as error:
            if error.code in OUT_OF_MEMORY:
                raise MemoryLimitError(
                    f"{self.info.name} ran out of memory ({error}): choose a smaller dim"
                ) from error
            raise DeviceError(f"{self.info.name} failed: {error}") from error
        if self.profile:
            self._events.append((self._thread.stage, event))

    def stage_times(self) -> dict[str, float]:
        """Seconds on the device by stage since the last call, in order of first use."""
        self.queue.finish()
        times: dict[str, float] = {}
        for name, event in self._events:
            seconds = 1e-9 * (event.profile.end - event.profile.start)
            times[name] = times.get(name, 0.0) + seconds
        self._events.clear()
        return times

    def __repr__(self) -> str:
        return f"Device({self.info.name!r}, {self.info.platform!r})"
