"""Work on the workers of a Dask cluster: calls that are independent, and outlive a lost worker or
a scheduler that comes back.

Dask is the scheduler; here is only which calls wait, and which are done. Its processes run what
they are sent (cloudpickle), so an address is trusted as a program is (docs/security.md).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeVar, cast

from voxtool.errors import DeviceError, FileError, printable
from voxtool.limits import processors
from voxtool.opencl import THREADS

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

Call = TypeVar("Call")
LOCAL = "local"  # in place of an address: processes of this machine
PATIENCE = 10  # seconds for a scheduler to answer
WAITING = 2  # calls that each worker has beside the one that it runs


def threads_of(client: Client) -> int:
    """Return the threads of a cluster's workers, at least one: others may come."""
    with suppress(OSError):  # the scheduler is lost just now
        return max(1, sum(cast("dict[str, int]", client.nthreads()).values()))
    return 1


@contextmanager
def connected(address: str, workers: int | None = None) -> Iterator[Client]:
    """Yield the client of a scheduler, or of `workers` processes of this machine.

    Parameters
    ----------
    address : "local", or where a scheduler is, as tcp://host:8786.
    workers : processes of "local", each with a device of one thread; by default one a processor.

    Raises
    ------
    FileError
        If distributed is not installed.
    DeviceError
        If no scheduler answers, or none starts.
    """
    try:
        from distributed import Client
        from distributed.utils import silence_logging_cmgr
    except ImportError:
        raise FileError("Dask is not installed: pip install 'voxtool[dask]'") from None
    if address != LOCAL:
        try:
            client = Client(address, timeout=PATIENCE)
        except (OSError, ValueError, OverflowError, AssertionError) as error:
            raise DeviceError(
                f"no scheduler of Dask at {printable(address)}: start one, or use --dask {LOCAL}"
            ) from error
        with silence_logging_cmgr(logging.CRITICAL), client:  # what was lost is sent again
            yield client
        return
    with _started(workers) as cluster, Client(cluster) as client:
        yield client


def _started(workers: int | None) -> LocalCluster:
    """Return a cluster of this machine; raise DeviceError if it does not start."""
    from distributed import LocalCluster

    for _ in range(2):
        with suppress(AssertionError):  # its thread did not start within 10 s: a busy machine
            return LocalCluster(
                n_workers=workers or processors() or None,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                env=dict.fromkeys(THREADS, "1"),
                silence_logs=logging.CRITICAL,
            )
    raise DeviceError(f"--dask {LOCAL}: Dask does not start: the machine is busy, try again")


def results(
    client: Client, submit: Callable[[Call], Any], calls: Iterable[Call]
) -> Iterator[tuple[Call, Any]]:
    """Yield calls with their results, as they are ready.

    A worker has few calls at a time, so that results do not pile up in its memory. What was lost
    with a scheduler is submitted again once it is back.

    Parameters
    ----------
    submit : submits a call to the client and returns its future.

    Raises
    ------
    DeviceError
        If the scheduler does not come back, or a call has ended several workers.
    """
    from distributed import CancelledError, KilledWorker, as_completed
    from distributed.comm.core import CommClosedError

    waiting, again = iter(calls), []
    flying: dict[Any, Call] = {}
    ready = as_completed()
    while True:
        _wait_for(client)
        while len(flying) <= WAITING * threads_of(client):
            call = again.pop() if again else next(waiting, None)
            if call is None:
                break
            future = submit(call)
            flying[future] = call
            ready.add(future)
        if not flying:
            return
        future = next(ready)
        call = flying.pop(future)
        try:
            result = future.result()
        except (CancelledError, CommClosedError):  # the scheduler was lost
            again.append(call)
            continue
        except KilledWorker as error:
            raise DeviceError(
                "workers of Dask ended again and again: they were killed, or their driver "
                "crashed: give them more memory, or choose another device with --device"
            ) from error
        future.release()
        yield call, result


def _wait_for(client: Client) -> None:
    """Wait while a scheduler is lost; raise DeviceError if it does not come back."""
    while client.status == "connecting":
        time.sleep(0.1)
    if client.status != "running":
        raise DeviceError("the scheduler of Dask has gone: start it, and use --resume")
