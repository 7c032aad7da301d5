"""Building programs beside other work, and how long they compile."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from voxtool.errors import DeviceError
from voxtool.opencl import Device, builder, program
from voxtool.opencl.program import Compilation

SOURCE = "__kernel void store(__global uint *out) {\n    out[0] = NUMBER;\n}"


def test_a_prepared_program_is_built_once(device: Device, monkeypatch) -> None:
    built, release, build = [], threading.Event(), program.build

    def slowly(*args):
        built.append((args[-1]["NUMBER"], threading.current_thread()))
        release.wait(10)
        return build(*args)

    monkeypatch.setattr(program, "build", slowly)
    threads = builder.THREADS
    device.prepare(*((SOURCE, {"NUMBER": 100 + i}) for i in range(threads)))
    out = device.zeros(1, np.uint32)
    release.set()
    for number in range(100, 100 + threads):
        device.kernel(SOURCE, "store", NUMBER=number)(1, out)
        assert out.get().tolist() == [number]
    assert sorted(number for number, _ in built) == list(range(100, 100 + threads))
    assert threading.current_thread() not in {thread for _, thread in built[:threads]}


def test_a_program_that_fails_in_the_background_fails_where_it_is_used(device: Device) -> None:
    wrong = "__kernel void wrong(__global uint *out) {\n    out[0] = no_such_thing;\n}"
    device.prepare((wrong, {}), (SOURCE, {"NUMBER": 7}))
    with pytest.raises(DeviceError, match="no_such_thing"):
        device.kernel(wrong, "wrong")
    out = device.zeros(1, np.uint32)
    device.kernel(SOURCE, "store", NUMBER=7)(1, out)
    assert out.get().tolist() == [7]


def test_oclgrind_compiles_alone() -> None:
    """Its compiler crashes if several threads use it."""
    one = builder.Builder(None, None, builder.ALONE)
    before = threading.active_count()
    one.prepare([(SOURCE, {"NUMBER": n}) for n in range(3)])
    assert threading.active_count() == before
    assert not one.requests


def test_time_in_which_two_programs_compile_counts_once(monkeypatch) -> None:
    kept = Path("/cache/a.bin")
    done = [Compilation(3.0, 3.5, 1, kept), Compilation(0.0, 1.0, 2, kept)]
    done.append(Compilation(0.5, 2.0, 4, kept))
    monkeypatch.setattr(program, "_compilations", list(done))
    line = "compiled 7 kernels in 2.5 s; they are kept in /cache for the next run"
    assert program.compile_report() == line
    assert program.compile_report() == ""
    monkeypatch.setattr(program, "_compilations", done[:1])
    assert program.compile_report() == ""  # it took half a second
