"""Layouts and constants are given once: what the device sees equals what the host says."""

from __future__ import annotations

import re
from importlib import import_module

import numpy as np
import pytest

from voxtool.adf.query import SEARCHES
from voxtool.errors import DeviceError
from voxtool.opencl import Device, headers, program
from voxtool.svo.layout import NODE
from voxtool.tets.integrate import INTEGRATORS

ENUMERATIONS = {  # constants that a header counts from 0, by names of the host
    "adf/query.h": SEARCHES,
    "tets/integrators.h": INTEGRATORS,
}


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """A folder of kernels of the test's own; returns a function that writes a file into it."""
    monkeypatch.setattr(program, "kernel_folder", lambda: tmp_path)
    monkeypatch.setattr(program, "flatten", program.flatten.__wrapped__)  # without its cache

    def write(name: str, text: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return name

    return write


def report(device: Device, source: str, size: int, *args) -> list[int]:
    """What the kernel `report` of a source writes."""
    out = device.zeros(size, np.uint64)
    device.kernel(source, "report")(1, *args, out)
    values = out.get().tolist()
    return values


def unique(request, text: str) -> str:
    """Text that no other test has built: devices outlive tests and keep their programs by name."""
    return f"{re.sub('[^a-z0-9]+', '_', request.node.name.lower())}_{text}"


def test_the_node_of_the_device_is_that_of_the_host(device: Device, kernels, request) -> None:
    assert NODE.fields
    lines = [
        '#include "svo/octree.h"',
        "__kernel void report(__global const svo_node *nodes, __global ulong *out) {",
        "    svo_node node;",
        "    out[0] = sizeof(svo_node);",
    ]
    for i, name in enumerate(NODE.names or ()):
        lines += [
            f"    out[{3 * i + 1}] = (ulong)((char *)&node.{name} - (char *)&node);",
            f"    out[{3 * i + 2}] = sizeof(node.{name});",
            f"    out[{3 * i + 3}] = nodes[1].{name};",
        ]
    source = kernels(unique(request, "node.cl"), "\n".join([*lines, "}"]))
    nodes = np.zeros(2, NODE)
    nodes[1] = (0x12345678, 0x9ABCDEF0)
    array = device.put(nodes)
    expected = [NODE.itemsize]
    for name in NODE.names or ():
        kind, offset = NODE.fields[name][:2]
        expected += [offset, kind.itemsize, int(nodes[1][name])]
    assert report(device, source, len(expected), array) == expected


@pytest.mark.parametrize("header", headers.HOMES)
def test_the_constants_of_the_device_are_those_of_the_host(
    device: Device, header: str, kernels, request
) -> None:
    """Every header compiles alone, and each whole number in it has the value, and the sign, of the
    host module's constant of the same name."""
    home = import_module(headers.HOMES[header])
    numbers = {name.upper(): i for i, name in enumerate(ENUMERATIONS.get(header, ()))}
    names = re.findall(r"(?m)^#define (\w+) -?\w+$", headers.generated(header))
    expected = [int(numbers[n] if n in numbers else getattr(home, n)) for n in names]
    assert numbers.keys() <= set(names)
    lines = [f'#include "{header}"', "__kernel void report(__global ulong *out) {"]
    for i, name in enumerate(names):
        lines += [f"    out[{2 * i}] = {name};", f"    out[{2 * i + 1}] = {name} > 0;"]
    source = kernels(unique(request, "constants.cl"), "\n".join([*lines, "}"]))
    found = report(device, source, max(2 * len(names), 1))
    assert found[: 2 * len(names) : 2] == expected
    assert found[1 : 2 * len(names) : 2] == [int(value > 0) for value in expected]


def test_any_record_of_32_and_64_bit_fields(device: Device, kernels, request) -> None:
    record = np.dtype([("a", "<u8"), ("b", "<i4"), ("c", "<u4"), ("d", "<i8")])
    assert record.fields
    lines = [program.c_struct("record", record), "__kernel void report(__global ulong *out) {"]
    lines.append("    record r;")
    for i, name in enumerate(record.names or ()):
        lines.append(f"    out[{i}] = (ulong)((char *)&r.{name} - (char *)&r);")
    source = kernels(unique(request, "record.cl"), "\n".join([*lines, "out[4] = sizeof(r); }"]))
    offsets = [record.fields[name][1] for name in record.names or ()]
    assert report(device, source, 5) == [*offsets, record.itemsize]


# ---- includes


def test_includes_are_in_place_each_once_with_markers(kernels) -> None:
    kernels("a/shared.h", "int shared;")
    kernels("a/one.h", '#include "a/shared.h"\nint one;')
    kernels("a/two.h", '#include "a/shared.h"\n#include "a/one.h"\nint two;')
    kernels("a/main.cl", '// first\n#include "a/one.h"\n#include "a/two.h"\nint last;')
    text = program.flatten("a/main.cl")
    for name in ("shared", "one", "two", "last"):
        assert text.count(f"int {name};") == 1
    assert "#include" not in text
    assert where(text, "int shared;") == ("a/shared.h", 1)
    assert where(text, "int one;") == ("a/one.h", 2)
    assert where(text, "int two;") == ("a/two.h", 3)
    assert where(text, "int last;") == ("a/main.cl", 4)


def where(text: str, wanted: str) -> tuple[str, int]:
    """File and line of a line of code, as a compiler counts them."""
    name, number = "", 0
    for line in text.splitlines():
        marker = re.fullmatch(r'#line (\d+) "(.*)"', line)
        if marker:
            name, number = marker[2], int(marker[1])
            continue
        if line == wanted:
            return name, number
        number += 1
    raise AssertionError(f"{wanted} is not there")


def test_every_kernel_includes_only_what_there_is() -> None:
    folder = program.kernel_folder()
    sources = [p.relative_to(folder).as_posix() for p in folder.rglob("*.cl")]
    assert {"opencl/primitives.cl", "svo/scan.cl", "svo/build.cl"} <= set(sources)
    for source in sources:
        text = program.flatten(source)
        assert "#include" not in text
        for path in folder.rglob("*.h"):
            for line in path.read_text(encoding="utf-8").splitlines():
                if line.startswith(("typedef ", "bool ", "uint ", "ulong ")) and line.endswith(")"):
                    assert text.splitlines().count(line) <= 1, f"{line} twice in {source}"


@pytest.mark.parametrize("in_header", [False, True])
def test_a_syntax_error_names_file_and_line(
    device: Device, in_header: bool, kernels, request
) -> None:
    wrong = "\n\nint broken(void) { return no_such_thing; }\n"
    header = kernels(unique(request, "part.h"), wrong if in_header else "// nothing\n")
    text = f'// a comment\n#include "{header}"\n' + ("" if in_header else wrong)
    source = kernels(
        unique(request, "main.cl"), text + "__kernel void report(__global uint *out) {}\n"
    )
    place = f"{header}:3" if in_header else f"{source}:5"
    with pytest.raises(DeviceError) as caught:
        device.kernel(source, "report")
    message = str(caught.value)
    assert message.startswith(f"kernels/{source} does not build on {device.info.platform}: ")
    assert place in message
    assert "no_such_thing" in message
    assert "\n" not in message


def test_options_make_programs_of_their_own(device: Device, kernels, request) -> None:
    source = kernels(
        unique(request, "options.cl"),
        "__kernel void report(__global ulong *out) { out[0] = NUMBER; }",
    )
    out = device.zeros(1, np.uint64)
    for number in (3, 7, 3):
        device.kernel(source, "report", NUMBER=number)(1, out)
        assert out.get().tolist() == [number]
    assert device.kernel(source, "report", NUMBER=3) is device.kernel(source, "report", NUMBER=3)
