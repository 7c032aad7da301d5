"""A device: its memory, its programs, and the time of each stage of work."""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections import OrderedDict
from ctypes import c_uint8
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from voxtool.arrays import ALIGNMENT
from voxtool.errors import LESS, DeviceError, MemoryLimitError
from voxtool.memory import available_memory
from voxtool.opencl import driver, launch
from voxtool.opencl.builder import Builder, Request

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.opencl.discovery import DeviceInfo

T = TypeVar("T")

KEPT_SHARE = 0.25  # of the memory that work may take, for data that is used again
OUT_OF_MEMORY = (-4, -5, -6)  # CL_MEM_OBJECT_ALLOCATION_FAILURE, _OUT_OF_RESOURCES, _HOST_MEMORY
PAGE = 4096  # alignment at which a CPU's driver uses the host's memory as it is
SHARED_FROM = 1 << 16  # bytes; smaller arrays are the driver's own
VECTOR = 16  # items that a work-item of a CPU processes side by side: a vector of float32
WITHOUT_FLOAT64 = "octrees (--fill parity, nonzero or flood) and their surfaces"
WORK_GROUP = 64  # work-items; a few wavefronts, and enough for a CPU's core


@dataclass(eq=False)
class Array:
    """A one-dimensional array on a device, which is freed when it is no longer referenced.

    size : number of elements; buffer : the driver's handle; host : the memory, if host and device
    share it.
    """

    device: Device
    dtype: np.dtype
    size: int
    buffer: Any
    host: np.ndarray | None

    def get(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return a copy of elements [start, stop) on the host; waits for the device."""
        stop = self.size if stop is None else stop
        values = np.empty(stop - start, self.dtype)
        if values.size:
            self.device.read(values, self.buffer, start * self.dtype.itemsize)
        return values

    def take(self) -> np.ndarray:
        """Return all elements on the host, without a copy where memory is shared; waits for the
        device. The array must not be used again."""
        if self.host is None:
            values = self.get()
        else:
            self.device.finish_into(self.buffer, self.host.nbytes)
            values = self.host[: self.size * self.dtype.itemsize].view(self.dtype)
            self.host = None
        self.buffer.release()
        return values

    def __del__(self) -> None:
        if self.host is not None:  # shared memory outlives the work that is enqueued on it
            self.device.retire(self.host)


class _Thread(threading.local):
    """The current stage of each thread, and the function that is called with the next name."""

    stage = "other"
    progress: Callable[[str], None] | None = None


class Device:
    """A device with its context, its queue, its programs, and the time of each stage.

    Threads may share it. It does not work in a forked child: open another there.
    """

    def __init__(self, cl_device: Any, info: DeviceInfo, profile: bool) -> None:
        cl = self._cl = driver.opencl()
        self.info = info
        self.cl_device = cl_device
        self.context = cl.Context([cl_device])
        flags = cl.command_queue_properties.PROFILING_ENABLE if profile else 0
        self.queue = cl.CommandQueue(self.context, cl_device, flags)
        self.profile = profile
        self.shares_memory = info.kind == "CPU"
        self._driver, self._forks = driver, driver.forks  # the module, as it ends before devices do
        self._retired: list[np.ndarray] = []  # shared memory, kept until the queue has run dry
        self._kept: OrderedDict[tuple[int, str], tuple[Any, int]] = OrderedDict()
        self._thread = _Thread()
        self._lock = threading.RLock()  # a kernel's arguments and its launch belong together
        self._events: list[tuple[str, Any]] = []
        self._kernels: dict[Any, Callable[..., None]] = {}
        self.builder = Builder(cl, self.context, info.platform)

    @property
    def lanes(self) -> int:
        """The number of points or rays that a work-item should process side by side."""
        return VECTOR if self.info.kind == "CPU" else 1

    def require_float64(self, what: str) -> None:
        """Raise DeviceError if the device has no double precision, which `what` need."""
        if not self.info.fp64:
            raise DeviceError(
                f"{self.info.name} has no double precision (cl_khr_fp64), which {what} need: "
                f"choose another device (see voxtool devices); this one does {WITHOUT_FLOAT64}"
            )

    # ---- memory

    @property
    def max_memory(self) -> int:
        """Bytes that work may take: the device's, of a CPU no more than the machine has left."""
        if self.info.kind != "CPU":
            return self.info.memory
        return min(self.info.memory, available_memory())

    def _buffer(self, flags: int, nbytes: int, host: np.ndarray | None = None) -> Any:
        """Return a buffer of `nbytes`, or one that copies or uses the host's memory, as flags
        say."""
        self._check_process()
        try:
            if host is None:
                return self._cl.Buffer(self.context, flags, nbytes)
            return self._cl.Buffer(self.context, flags, hostbuf=host)
        except (self._cl.Error, MemoryError) as error:
            raise MemoryLimitError(
                f"{self.info.name} could not allocate {nbytes} bytes: {LESS}"
            ) from error

    def _array(self, size: int, dtype: np.dtype | type, make: Callable[..., np.ndarray]) -> Array:
        """Return an array of new memory; if it is shared, whole pages that `make` (np.empty,
        np.zeros) allocates."""
        dtype = np.dtype(dtype)
        nbytes = max(-(-size * dtype.itemsize // 4) * 4, 4)  # whole words, for zeros
        flags = self._cl.mem_flags.READ_WRITE
        if not (self.shares_memory and nbytes >= SHARED_FROM):
            return Array(self, dtype, size, self._buffer(flags, nbytes), None)
        try:
            pages = make(-(-nbytes // PAGE) * PAGE + PAGE, np.uint8)
        except MemoryError as error:
            raise MemoryLimitError(
                f"this machine could not allocate {nbytes} bytes: {LESS}"
            ) from error
        start = -pages.ctypes.data % PAGE
        host = pages[start : start - PAGE or None]
        buffer = self._buffer(flags | self._cl.mem_flags.USE_HOST_PTR, nbytes, host)
        return Array(self, dtype, size, buffer, host)

    def empty(self, size: int, dtype: np.dtype | type) -> Array:
        """Return an array of undefined content."""
        return self._array(size, dtype, np.empty)

    def zeros(self, size: int, dtype: np.dtype | type) -> Array:
        """Return an array of zeros."""
        array = self._array(size, dtype, np.zeros)
        if array.host is None:
            size = array.buffer.size
            self._enqueue(self._cl.enqueue_fill_buffer, array.buffer, np.uint32(0), 0, size)
        return array

    def put(self, values: np.ndarray) -> Array:
        """Return a copy of a host array, flattened, on the device."""
        if not values.size:
            return self.empty(0, values.dtype)
        flags = self._cl.mem_flags.READ_WRITE | self._cl.mem_flags.COPY_HOST_PTR
        buffer = self._buffer(flags, values.nbytes, np.ascontiguousarray(values))
        return Array(self, values.dtype, values.size, buffer, None)

    def view(self, values: np.ndarray) -> Array:
        """Return a host array for kernels to read: shared where it can be, or else a copy. It must
        not change until the device has read it."""
        return self.put(values) if values.ctypes.data % ALIGNMENT else self.view_from(values)[0]

    def view_from(self, values: np.ndarray) -> tuple[Array, int]:
        """Return an array as view does, wherever the host array begins in memory, and the index
        of its first element there."""
        alike = values.flags.c_contiguous and values.flags.aligned
        if not (self.shares_memory and alike and values.nbytes >= SHARED_FROM):
            return self.put(values), 0
        before = values.ctypes.data % ALIGNMENT  # bytes in the same page, which nobody reads
        pages = (c_uint8 * (before + values.nbytes)).from_address(values.ctypes.data - before)
        memory = np.ctypeslib.as_array(pages)
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.USE_HOST_PTR
        buffer, start = self._buffer(flags, memory.size, memory), before // values.itemsize
        return Array(self, values.dtype, start + values.size, buffer, values), start

    def write(self, array: Array, values: np.ndarray, start: int = 0) -> None:
        """Overwrite the elements of an array from `start` on."""
        if values.size:
            offset, values = start * array.dtype.itemsize, np.ascontiguousarray(values)
            self._enqueue(self._cl.enqueue_copy, array.buffer, values, dst_offset=offset)

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
        if self._forks == driver.forks:
            self._retired.append(memory)

    def keep(self, owner: Any, kind: str, nbytes: int, make: Callable[[], T]) -> T:
        """Return the result of `make` for this owner and kind, kept on the device for the next
        call.

        It is released with its owner, or when the total exceeds KEPT_SHARE of the memory; then the
        least recently used goes first.

        owner : can be weakly referenced, and the result does not refer to it; nbytes : size of the
        result on the device.
        """
        key = id(owner), kind
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
            made = make()
            room = KEPT_SHARE * self.max_memory - nbytes
            while self._kept and sum(size for _, size in list(self._kept.values())) > room:
                self._kept.popitem(last=False)
            if room >= 0:
                self._kept[key] = made, nbytes
                weakref.finalize(owner, self._kept.pop, key, None).atexit = False
            return made

    @contextlib.contextmanager
    def _finishing(self) -> Iterator[None]:
        """Release the memory retired before the block, once it has waited for all earlier work."""
        with self._lock:
            retired, self._retired = self._retired, []
        yield
        del retired

    def __del__(self) -> None:
        if hasattr(self, "queue") and self._forks == self._driver.forks:
            self.queue.finish()

    # ---- work

    def prepare(self, *requests: Request) -> None:
        """Begin to build the programs of these sources and -D options, in the order of their use,
        beside the work that follows."""
        self.builder.prepare(requests)

    def kernel(self, source: str, name: str, **defines: int | str) -> Callable[..., None]:
        """Return a kernel of kernels/`source`, built once with the given -D options.

        Called as `kernel(size, *args, local=64, **named)`: at least `size` work-items (none for 0;
        it is rounded up to whole work-groups of `local`, and PoCL compiles a kernel anew for each
        size of group); the arguments as launch.Signature.bind takes them.
        """
        key = (source, name, *sorted(defines.items()))
        with self._lock:
            if key not in self._kernels:
                built = self.builder.program(source, defines)
                kernel = self._cl.Kernel(built.program, name)
                self._kernels[key] = self._launcher(kernel, built.signatures[name])
            return self._kernels[key]

    def _launcher(self, kernel: Any, signature: launch.Signature) -> Callable[..., None]:
        enqueue, bind = self._cl.enqueue_nd_range_kernel, signature.bind
        # typed arguments are set 40 times as fast, and without kernels' argument information
        kernel.set_scalar_arg_dtypes(signature.dtypes)
        set_args = kernel.set_args

        def run(size: int, *args: Any, local: int = WORK_GROUP, **named: Any) -> None:
            if size == 0:
                return
            values = bind(size, args, named)
            with self._lock:
                try:
                    set_args(*values)
                except Exception:  # not a plain number, or a wrong one
                    set_args(*signature.convert(values))
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

    @contextlib.contextmanager
    def reporting(self, progress: Callable[[str], None] | None) -> Iterator[None]:
        """Call `progress` with the name of each stage that this thread begins in this block."""
        outer = self._thread.progress
        self._thread.progress = progress or outer
        try:
            yield
        finally:
            self._thread.progress = outer

    def _check_process(self) -> None:
        """Raise DeviceError in a child that was forked after this device had been opened."""
        if self._forks != driver.forks:
            raise DeviceError(
                f"{self.info.name} was opened before this process was forked: open it again here, "
                f"or {driver.FORK_HINT}"
            )

    def _enqueue(self, work: Callable[..., Any], *args: Any, **options: Any) -> None:
        """Enqueue work, whose event counts towards the stage's time."""
        self._check_process()
        try:
            event = work(self.queue, *args, **options)
        except self._cl.Error as error:
            if error.code in OUT_OF_MEMORY:
                raise MemoryLimitError(
                    f"{self.info.name} ran out of memory ({error}): {LESS}"
                ) from error
            raise DeviceError(f"{self.info.name} failed: {error}") from error
        if self.profile:
            self._events.append((self._thread.stage, event))

    def stage_times(self) -> dict[str, float]:
        """Return the seconds on the device by stage since the last call, in order of first use."""
        self.queue.finish()
        events, self._events = self._events, []
        times: dict[str, float] = {}
        for name, event in events:
            seconds = 1e-9 * (event.profile.end - event.profile.start)
            times[name] = times.get(name, 0.0) + seconds
        return times

    def __repr__(self) -> str:
        return f"Device({self.info.name!r}, {self.info.platform!r})"
