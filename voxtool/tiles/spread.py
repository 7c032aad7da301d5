"""What makes the windows of a job: this process, or the workers of a Dask cluster.

Both call the same functions (workers.py), which take a device, the bytes that it may take, and
plain arrays and options. A worker that sees the folder of windows writes its own there, and returns
what the journal says of it; others return the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar, cast

from voxtool.files.octrees.windows import Key, Store, Window, write_beside
from voxtool.opencl import Device, shared_device
from voxtool.tiles.cluster import results, threads_of

if TYPE_CHECKING:
    from distributed import Client, Future

Call = TypeVar("Call")
Given = Callable[[Call], tuple[Any, ...]]  # returns what a function takes for a call
Report = Callable[[], None]  # says that a call begins here, or that a worker has done it
Made = Window | dict[str, Any]  # a window, or what the journal says of it if it is on disk
Place = tuple[str, str]  # where windows wait, and the first line of the journal there


class Sent:
    """A value that stands in many calls, and is sent to workers once; again after it was lost with
    a scheduler or a worker."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self._future: Future | None = None

    def future(self, client: Client) -> Future:
        """Return what stands for the value in calls."""
        if self._future is None or self._future.cancelled():
            (self._future,) = cast("list[Future]", client.scatter([self.value], hash=False))
        return self._future


class Here:
    """Calls in this process, one after the other."""

    workers = 0  # of a cluster

    def __init__(self, device: Device, max_memory: int | None) -> None:
        self.device, self.max_memory = device, max_memory

    def call(self, function: Callable[..., Any], given: Iterable[Any]) -> Any:
        """Return what a function returns."""
        values = (one.value if isinstance(one, Sent) else one for one in given)
        return function(self.device, self.max_memory, *values)

    def results(
        self, function: Callable[..., Any], given: Given, calls: Iterable[Call], report: Report
    ) -> Iterator[tuple[Call, Any]]:
        """Yield calls with what a function returns for them."""
        for call in calls:
            report()
            with self.device.reporting(lambda _: None):  # not the stages within
                found = self.call(function, given(call))
            yield call, found

    def make(
        self,
        function: Callable[..., Any],
        given: Given,
        calls: Iterable[Call],
        store: Store,
        report: Report,
    ) -> Iterator[Call]:
        """Store the windows that a function returns for each call, with their keys; yield the calls
        for which it returns None, as they do not fit in memory."""

        def stored(*values: Any) -> bool:
            made = function(*values)
            for key, window in made or ():
                store.put(key, window)
            return made is not None

        for call, fits in self.results(stored, given, calls, report):
            if not fits:
                yield call


class Workers:
    """Calls to the workers of a Dask cluster.

    Parameters
    ----------
    device_name : the device of a worker, as --device takes it.
    max_memory : what each worker may take; by default half of what it has.
    """

    def __init__(
        self, client: Client, device_name: str | None = None, max_memory: int | None = None
    ) -> None:
        self.client, self.device_name, self.max_memory = client, device_name, max_memory
        self.workers = threads_of(client)

    def _submit(self, wrapped: Callable[..., Any], *given: Any) -> Future:
        """Submit a function that a wrapper calls on a worker, and what it takes."""
        values = (one.future(self.client) if isinstance(one, Sent) else one for one in given)
        place = self.device_name, self.max_memory
        return self.client.submit(wrapped, *place, *values, pure=False)

    def results(
        self, function: Callable[..., Any], given: Given, calls: Iterable[Call], report: Report
    ) -> Iterator[tuple[Call, Any]]:
        """Yield calls with what a function returns for them, as they are ready."""

        def submit(call: Call) -> Future:
            return self._submit(called, function, *given(call))

        for found in results(self.client, submit, calls):
            report()
            yield found

    def make(
        self,
        function: Callable[..., Any],
        given: Given,
        calls: Iterable[Call],
        store: Store,
        report: Report,
    ) -> Iterator[Call]:
        """Store windows as `Here.make` does."""
        place: Place | None = store.place

        def submit(call: Call) -> Future:
            return self._submit(made_beside, function, place, *given(call))

        while calls:
            again = []
            for call, made in results(self.client, submit, calls):
                if made is None:
                    yield call
                elif all(_is_stored(store, *each) for each in made):
                    report()
                else:  # the worker wrote into another folder of the same name: it has to send
                    place = None
                    again.append(call)
            calls = again


Executor = Here | Workers


def _is_stored(store: Store, key: Key, made: Made) -> bool:
    """Store what a worker made of a window; return whether it is there."""
    if isinstance(made, Window):
        store.put(key, made)
        return True
    return store.take_note(made)


# ---- on a worker


def called(
    device_name: str | None, max_memory: int | None, function: Callable[..., Any], *given: Any
) -> Any:
    """Return what a function returns on this worker."""
    return function(shared_device(device_name), allowed(max_memory), *given)


def made_beside(
    device_name: str | None,
    max_memory: int | None,
    function: Callable[..., Any],
    place: Place | None,
    *given: Any,
) -> list[tuple[Key, Made]] | None:
    """Return the windows that a function returns on this worker, with their keys, or what a journal
    says of them if this worker sees the place; None if the function does."""
    made = called(device_name, max_memory, function, *given)
    if made is None:
        return None
    return [(key, (place and write_beside(place, key, one)) or one) for key, one in made]


def allowed(max_memory: int | None) -> int | None:
    """Return the bytes that a window may take: what is given, or half of what the worker has; None
    if it has no limit."""
    from distributed import get_worker

    if max_memory is not None:
        return max_memory
    limit = get_worker().memory_manager.memory_limit
    return limit and limit // 2  # half is for results
