"""Building programs: sources flattened, layouts generated, options kept few.

Includes are flattened by the host, with #line markers, because drivers differ in how they search
paths and their caches miss edited headers. Compiled programs are kept by `cache`, or by the driver.
"""

from __future__ import annotations

import functools
import re
import time
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, SupportsInt

import numpy as np

from voxtool.errors import DeviceError, count_of
from voxtool.limits import unbounded_memory
from voxtool.opencl import cache, headers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)
_C_TYPES = {"<u4": "uint", "<i4": "int", "<u8": "ulong", "<i8": "long", "|u1": "uchar"}
OPTIONS = ["-cl-std=CL1.2"]
# a * b + c is rounded twice on every device. NOINLINE is for large functions, which would take long
# to compile at each place where they are called.
PREAMBLE = "#pragma OPENCL FP_CONTRACT OFF\n#define NOINLINE __attribute__((noinline))"
ROUNDED = "-cl-fp32-correctly-rounded-divide-sqrt"  # float32, where a device offers it
LONG = 1.0  # seconds of compiling that a command mentions


@functools.cache
def kernel_folder() -> Path:
    """Return the folder of the kernels: inside an installed package, or beside it in a checkout."""
    package = Path(__file__).parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if folder.is_dir():
            return folder
    raise DeviceError(f"no kernels beside {package}: reinstall voxtool")


@functools.cache
def flatten(source: str, folder: Path | None = None) -> str:
    """Return the text of kernels/`source`, or of `source` itself if it has lines, with its includes
    in place, each once; folder : other than that of the kernels, for tests."""
    seen: set[str] = set()

    def label(name: str) -> str:
        return "source" if "\n" in name else name

    def read(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        if name in headers.HOMES:
            return headers.generated(name)
        path = (folder or kernel_folder()) / name
        text = name if "\n" in name else path.read_text(encoding="utf-8")
        lines = []
        for number, line in enumerate(text.splitlines(), 1):
            lines.append(line)
            if include := _INCLUDE.match(line):
                lines[-1:] = [f'#line 1 "{include[1]}"', read(include[1])]
                lines.append(f'#line {number + 1} "{label(name)}"')
        return "\n".join(lines)

    return f'{PREAMBLE}\n#line 1 "{label(source)}"\n{read(source)}\n'


_change: ContextVar[Callable[[str], str] | None] = ContextVar("change", default=None)


@contextmanager
def changed_sources(change: Callable[[str], str]) -> Iterator[None]:
    """Build programs in this block from changed sources, on a device that has not built them yet.

    Tests use it to show that a faulty kernel is found.
    """
    token = _change.set(change)
    try:
        yield
    finally:
        _change.reset(token)


def c_struct(name: str, dtype: np.dtype) -> str:
    """Return the C declaration of a packed numpy record of 32- and 64-bit fields."""
    assert dtype.fields is not None
    members = " ".join(f"{_C_TYPES[t.str]} {n};" for n, (t, *_) in dtype.fields.items())
    return f"typedef struct {{ {members} }} {name};"


def c_constants(**values: SupportsInt) -> str:
    """Return #define lines for whole numbers: hexadecimal, of the type that C gives them."""
    return "\n".join(f"#define {name} {int(value):#x}" for name, value in values.items())


def build(
    cl: Any, context: Any, platform: str, source: str, defines: Mapping[str, int | str]
) -> Any:
    """Return the program of kernels/`source`; raises DeviceError with the compiler's first
    error."""
    options = [*OPTIONS, *(f"-D{name}={value}" for name, value in sorted(defines.items()))]
    if context.devices[0].single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT:
        options.append(ROUNDED)
    try:
        change = _change.get() or str
        with unbounded_memory():
            return compiled(cl, context, change(flatten(source)), options)
    except cl.RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        log = [line for line in lines[1:] if "error" in line.lower()]
        raise DeviceError(
            f"kernels/{source} does not build on {platform}: {(log or lines or [type(error)])[0]}"
        ) from error


def compiled(cl: Any, context: Any, text: str, options: Sequence[str] = ()) -> Any:
    """Return the program of a text, from the cache if it was compiled before; raises pyopencl's
    errors."""
    from pyopencl.characterize import has_src_build_cache

    device = context.devices[0]
    parts = device.platform.version, device.name, device.driver_version, *options, text
    file = cache.place(*parts)
    if has_src_build_cache(device):  # the driver keeps compiled programs itself
        file = None
    if file and (binary := cache.load(file)):
        with suppress(cl.Error):  # the driver may have changed without a new version
            return cl.Program(context, [device], [binary]).build([*options])
    began = time.perf_counter()
    # Program(context, text) would leave the text in the temporary folder when it does not compile.
    program = cl.Program(cl._cl._Program(context, text)).build([*options])
    kernels = program.get_info(cl.program_info.NUM_KERNELS)
    _compilations.append(Compilation(began, time.perf_counter(), kernels, file))
    if file:
        cache.keep(file, program.get_info(cl.program_info.BINARIES)[0])
    return program


class Compilation(NamedTuple):
    """A program that was compiled from its source: when, its number of kernels, and the file that
    keeps it, or None."""

    began: float
    ended: float
    kernels: int
    file: Path | None


_compilations: list[Compilation] = []


def compile_report() -> str:
    """Return a line on the kernels compiled since the last call: how many, how long, and where they
    are kept; "" if it took less than LONG, or they are not kept, of which `cache` warns. Time in
    which two programs compiled counts once."""
    done = sorted(_compilations)
    _compilations.clear()
    seconds = end = 0.0
    for one in done:
        seconds += max(one.ended - max(one.began, end), 0.0)
        end = max(end, one.ended)
    if seconds < LONG or cache.folder() is None:
        return ""
    files = [one.file for one in done if one.file]
    where = f"they are kept in {files[0].parent}" if files else "the driver keeps them"
    count = sum(one.kernels for one in done)
    return f"compiled {count_of(count, 'kernel')} in {seconds:.1f} s; {where} for the next run"
