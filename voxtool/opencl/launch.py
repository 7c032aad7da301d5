"""Launching kernels: arguments are converted as the kernel's own declaration says.

Host code passes Arrays, None, plain numbers and tuples of them, by position or by name. The types
are read from the kernel's source after preprocessing, because drivers lose them: Intel's keeps no
argument types with a program that pyopencl has cached as a binary. With types, pyopencl sets the
arguments of a kernel 40 times as fast.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "long", "ulong", "float", "double")
_TYPES: dict[str, str] = dict(
    zip(_NAMES, ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), strict=True)
)
_QUALIFIERS = {"__global", "__constant", "__local", "const", "volatile", "restrict", "__read_only"}
_DIRECTIVE = re.compile(r"\s*#\s*(ifdef|ifndef|if|elif|else|endif|define|undef)\b\s*(.*)")
_KERNEL = re.compile(r"__kernel\b[^;{]*?\bvoid\s+(\w+)\s*\(")
SIZE = "n"  # the parameter that is the number of work-items


@dataclass(frozen=True)
class Parameter:
    """A parameter of a kernel; `dtype` is None for a pointer or an image, `width` the components of
    vectors."""

    name: str
    dtype: np.dtype | None = None
    width: int = 1

    @property
    def is_packed(self) -> bool:
        """True if numpy makes the bytes of an argument: of vectors, and of small integers, which
        pyopencl would let wrap around."""
        return self.dtype is not None and (self.width > 1 or self.dtype.itemsize < 4)

    @property
    def passed(self) -> np.dtype | None:
        """The dtype by which pyopencl sets the argument."""
        if not self.is_packed or self.dtype is None:
            return self.dtype
        return np.dtype((np.void, self._components * self.dtype.itemsize))

    @property
    def _components(self) -> int:
        return 4 if self.width == 3 else self.width

    def pack(self, value: Any) -> Any:
        """Return the argument for pyopencl: the buffer of an Array or Image, or the bytes of a
        vector."""
        if not self.is_packed:
            return getattr(value, "buffer", value)
        components = np.asarray(value)
        packed = np.zeros(self._components, self.dtype)
        if components.size == self.width:
            packed[: self.width] = components
            if packed.dtype.kind == "f" or (packed[: self.width] == components).all():
                return packed
        raise ValueError(f"{self.name} = {value!r}")

    def convert(self, value: Any) -> Any:
        """Return a packed value as a plain number, if it is one of numpy's that pyopencl refuses;
        raises TypeError if it does not suit the parameter."""
        if self.is_packed:
            return value
        is_number = isinstance(value, (int, float, np.generic))
        if self.dtype is None and not is_number and not isinstance(value, np.ndarray):
            return value
        if self.dtype is not None and is_number:
            with contextlib.suppress(ValueError, OverflowError):
                number = self.dtype.type(value).item()
                if self.dtype.kind == "f" or number == value:
                    return number
        raise TypeError(f"{self.name} = {value!r}")


class Signature:
    """The parameters of a kernel, and the arguments of its calls."""

    def __init__(self, name: str, parameters: list[Parameter]) -> None:
        self.name = name
        self.parameters = parameters
        self.dtypes = [p.passed for p in parameters]
        self._names = [p.name for p in parameters]
        # None for an argument that is passed as it is
        self._packs = [p.pack if p.dtype is None or p.is_packed else None for p in parameters]

    def bind(self, size: int, args: tuple[Any, ...], named: dict[str, Any]) -> list[Any]:
        """Return the arguments of a call, in order, as pyopencl takes them.

        The parameter `n` is the number of work-items. Positional arguments fill the parameters that
        are not given by name, in order. Names that this variant of the kernel does not declare are
        left out, so that a caller lists the arguments of all variants. Raises TypeError if an
        argument is missing or superfluous, or a vector has the wrong length.
        """
        given = {SIZE: size, **named}
        free = [name for name in self._names if name not in given]
        if len(args) != len(free):
            raise TypeError(
                f"kernel {self.name} takes {', '.join(free)}: {len(args)} arguments are given"
            )
        given.update(zip(free, args, strict=True))
        try:
            return [
                given[name] if pack is None else pack(given[name])
                for name, pack in zip(self._names, self._packs, strict=True)
            ]
        except (ValueError, OverflowError) as error:
            raise TypeError(f"kernel {self.name} does not take {error}") from error

    def convert(self, values: list[Any]) -> list[Any]:
        """Return the arguments of a call that pyopencl refused, as plain numbers; raises TypeError
        with the name of one that does not suit its parameter."""
        try:
            return [p.convert(v) for p, v in zip(self.parameters, values, strict=True)]
        except TypeError as error:
            raise TypeError(f"kernel {self.name} does not take {error}") from error


def signatures(text: str, defines: Mapping[str, int | str]) -> list[Signature]:
    """Return the signature of every kernel in a flattened source, for these -D options."""
    text, macros = preprocess(text, defines)
    found = []
    for match in _KERNEL.finditer(text):
        declared = _expand(text[match.end() : _closing(text, match.end())], macros)
        words = [word for word in declared.split(",") if word.strip()]
        found.append(Signature(match[1], [_parameter(word) for word in words]))
    return found


def preprocess(text: str, defines: Mapping[str, int | str]) -> tuple[str, dict[str, str]]:
    """Return the active lines of a source without comments, and its object-like macros."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text.replace("\\\n", " "), flags=re.DOTALL)
    macros = {name: str(value) for name, value in defines.items()}
    lines: list[str] = []
    active = [(True, True)]  # of each open #if: whether its lines count, whether a branch did
    for line in text.splitlines():
        match = _DIRECTIVE.match(line)
        if not match:
            if active[-1][0]:
                lines.append(line)
            continue
        word, rest = match[1], match[2].strip()
        if word in ("ifdef", "ifndef", "if"):
            outer = active[-1][0]
            holds = outer and _holds(word, rest, macros)
            active.append((holds, holds or not outer))
        elif word in ("elif", "else"):
            _, done = active.pop()
            holds = active[-1][0] and not done and (word == "else" or _holds("if", rest, macros))
            active.append((holds, holds or done))
        elif word == "endif":
            active.pop()
        elif active[-1][0]:
            key = re.match(r"\w+", rest)
            if key and word == "undef":
                macros.pop(key[0], None)
            elif key and not rest[key.end() :].startswith("("):
                macros[key[0]] = rest[key.end() :].strip()
    return "\n".join(lines), macros


def _holds(word: str, condition: str, macros: dict[str, str]) -> bool:
    """Return True if an #if, #ifdef or #ifndef holds; names that are no macros count as 0."""
    if word != "if":
        return (condition.split()[0] in macros) == (word == "ifdef")
    condition = re.sub(r"defined\s*\(\s*(\w+)\s*\)", lambda m: str(int(m[1] in macros)), condition)
    condition = re.sub(r"\b[A-Za-z_]\w*\b", "0", _expand(condition, macros))
    condition = condition.replace("&&", " and ").replace("||", " or ")
    condition = re.sub(r"!(?!=)", " not ", condition)
    if not re.fullmatch(r"(?:[\dxa-f()<>=!+*\s-]|and|or|not)+", condition):
        raise ValueError(f"#if {condition}: write numbers, names, defined(), ==, < and > only")
    return bool(eval(condition, {"__builtins__": {}}))


def _expand(text: str, macros: dict[str, str]) -> str:
    """Return the text with its object-like macros replaced."""
    for _ in range(16):
        expanded = re.sub(r"\b[A-Za-z_]\w*\b", lambda m: macros.get(m[0], m[0]), text)
        if expanded == text:
            return text
        text = expanded
    return text


def _closing(text: str, start: int) -> int:
    """Return the place of the parenthesis that closes the one opened before `start`."""
    depth = 1
    for place in range(start, len(text)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if depth == 0:
            return place
    raise ValueError("a kernel's parameters have no end")


def _parameter(declaration: str) -> Parameter:
    *words, name = re.findall(r"\w+|\*", declaration)
    kind = next(word for word in words if word not in _QUALIFIERS)
    if "*" in words or kind == "image3d_t":
        return Parameter(name)
    match = re.fullmatch(r"([a-z]+)(\d*)", kind)
    if not match or match[1] not in _TYPES:
        raise ValueError(f"parameter {declaration.strip()!r} is of a type that is not understood")
    return Parameter(name, np.dtype(_TYPES[match[1]]), int(match[2] or 1))
