"""Layouts and constants are given once: what the device sees equals what the host says."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from voxtool.adf.queries.query import SEARCHES
from voxtool.errors import DeviceError
from voxtool.opencl import Device, headers, open_device, program
from voxtool.svo.octree.layout import NODE
from voxtool.tets.pictures.integrate import INTEGRATORS

ENUMERATIONS = {  # constants that a header counts from 0, by names of the host
    "adf/queries/query.h": SEARCHES,
    "tets/pictures/integrators.h": INTEGRATORS,
}


def report(device: Device, lines: list[str], size: int, parameters: str = "", *args) -> list[int]:
    """The numbers that a kernel with these lines writes to `out`."""
    head, *body = lines
    kernel = f"__kernel void report({parameters}__global ulong *out) {{"
    out = device.zeros(size, np.uint64)
    device.kernel("\n".join([head, kernel, *body, "}"]), "report")(1, *args, out)
    return out.get().tolist()


RECORD = np.dtype([("a", "<u8"), ("b", "<i4"), ("c", "<u4"), ("d", "<i8")])


@pytest.mark.parametrize(
    ("record", "name", "head"),
    [
        (NODE, "svo_node", '#include "svo/octree/octree.h"'),
        (RECORD, "record", program.c_struct("record", RECORD)),
    ],
)
def test_records_of_the_device_are_those_of_the_host(
    device: Device, record: np.dtype, name: str, head: str
) -> None:
    assert record.fields
    values = np.frombuffer(np.random.default_rng(1).bytes(2 * record.itemsize), record)
    lines, expected = [f"out[0] = sizeof({name});"], [record.itemsize]
    for i, (field, (kind, offset, *_)) in enumerate(record.fields.items()):
        lines += [
            f"out[{3 * i + 1}] = (ulong)((__global char *)&records[1].{field}"
            " - (__global char *)&records[1]);",
            f"out[{3 * i + 2}] = sizeof(records[1].{field});",
            f"out[{3 * i + 3}] = (ulong)records[1].{field};",
        ]
        expected += [offset, kind.itemsize, int(values[1][field]) % 2**64]
    parameters = f"__global const {name} *records, "
    assert report(device, [head, *lines], len(expected), parameters, device.put(values)) == expected


def test_the_constants_of_the_device_are_those_of_the_host(device: Device) -> None:
    """Each whole number in each header has the value, and the sign, of the host module's constant
    of the same name. One program has those of all headers, and forgets one's before the next."""
    head, body, expected = [], [], {}
    for header, module in headers.HOMES.items():
        home = import_module(module)
        names = (name.upper().replace("-", "_") for name in ENUMERATIONS.get(header, ()))
        numbers = {name: i for i, name in enumerate(names)}
        defined = re.findall(r"(?m)^(#define (\w+) -?\w+)$", headers.generated(header))
        names = [name for _, name in defined]
        assert numbers.keys() <= set(names)
        function, start = f"report_{re.sub(r'[^a-z]', '_', header)}", 2 * len(expected)
        head += [*(line for line, _ in defined), f"void {function}(__global ulong *out) {{"]
        for i, name in enumerate(names):
            head += [f"out[{start + 2 * i}] = {name};", f"out[{start + 2 * i + 1}] = {name} > 0;"]
            value = int(numbers[name] if name in numbers else getattr(home, name))
            expected[header, name] = value, int(value > 0)
        head += ["}", *(f"#undef {name}" for name in names)]
        body.append(f"{function}(out);")
    found = report(device, ["\n".join(head), *body], 2 * len(expected))
    assert dict(zip(expected, zip(*[iter(found)] * 2, strict=True), strict=True)) == expected


# ---- includes


def test_includes_are_in_place_each_once_with_markers(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for name, text in {
        "a/shared.h": "int shared;",
        "a/one.h": '#include "a/shared.h"\nint one;',
        "a/two.h": '#include "a/shared.h"\n#include "a/one.h"\nint two;',
        "a/main.cl": '// first\n#include "a/one.h"\n#include "a/two.h"\nint last;',
    }.items():
        (tmp_path / name).write_text(text)
    text = program.flatten("a/main.cl", tmp_path)
    places = [("shared", "a/shared.h", 1), ("one", "a/one.h", 2), ("two", "a/two.h", 3),
              ("last", "a/main.cl", 4)]  # fmt: skip
    for name, file, line in places:
        assert text.count(f"int {name};") == 1
        assert where(text, f"int {name};") == (file, line)
    assert "#include" not in text


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
    assert {"opencl/scan.cl", "svo/voxelization/scan_conversion.cl", "svo/octree/build.cl"} <= set(
        sources
    )
    for source in sources:
        text = program.flatten(source)
        assert "#include" not in text
        assert text.startswith("#pragma OPENCL FP_CONTRACT OFF\n")
        for path in folder.rglob("*.h"):
            for line in path.read_text(encoding="utf-8").splitlines():
                if line.startswith(("typedef ", "bool ", "uint ", "ulong ")) and line.endswith(")"):
                    assert text.splitlines().count(line) <= 1, f"{line} twice in {source}"


@pytest.mark.parametrize("file", ["opencl/primitives.h", "opencl/scan.cl"])
def test_a_syntax_error_names_file_and_line(device: Device, file: str) -> None:
    mark, wrong = f'#line 1 "{file}"\n', "\n\nint broken(void) { return no_such_thing; }\n"
    fresh = open_device(str(device.info.index))
    with (
        program.changed_sources(lambda text: text.replace(mark, mark + wrong)),
        pytest.raises(DeviceError) as caught,
    ):
        fresh.kernel("opencl/scan.cl", "sum_blocks")
    message = str(caught.value)
    platform = device.info.platform
    assert message.startswith(f"kernels/opencl/scan.cl does not build on {platform}: ")
    assert f"{file}:3" in message
    assert "no_such_thing" in message
    assert "\n" not in message


def test_options_make_programs_of_their_own(device: Device) -> None:
    source = "__kernel void report(__global ulong *out) {\n    out[0] = NUMBER;\n}"
    out = device.zeros(1, np.uint64)
    for number in (3, 7, 3):
        device.kernel(source, "report", NUMBER=number)(1, out)
        assert out.get().tolist() == [number]
    assert device.kernel(source, "report", NUMBER=3) is device.kernel(source, "report", NUMBER=3)
