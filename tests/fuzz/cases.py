"""Cases by number: a mutated file, or a command with extreme arguments.

The same seed, number and samples always give the same case.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from dataclasses import dataclass

import click

from .lies import lying
from .looks import FORMATS as LOOKS
from .looks import OCTREES as LOOKING
from .mutate import mutant, split
from .samples import FIELDS, FORMATS, OCTREES, VOLUMES

# looks: files with an appearance alone; lies: own files whose parts fit each other
KINDS = ("files", "looks", "lies", "arguments")
OWN = (*OCTREES, *FIELDS, *VOLUMES, *LOOKING)
LYING = tuple(name for name in OWN if name.endswith(".h5"))
ODD_NAMES = ("new\nline", os.fsdecode(b"\xff"), "a b'c\"", "\u202e\u0661", "-x", "x" * 200)


@dataclass(frozen=True)
class Case:
    """A file, a command, or a command with a file.

    Attributes
    ----------
    number : from which the random choices of its use follow, too.
    name, format, content : of the mutated file, the format one of samples.FORMATS; empty without.
    words : of the command line; empty where the library uses the file.
    has, lacks : patterns that stderr must hold; that stdout and stderr must not hold.
    """

    number: int
    name: str = ""
    format: str = ""
    content: bytes = b""
    words: tuple[str, ...] = ()
    has: str = ""
    lacks: str = ""

    @property
    def rng(self) -> random.Random:
        return random.Random(f"use {self.number}")


def case_of(kind: str, seed: int, number: int, samples: dict[str, bytes]) -> Case:
    rng = random.Random(f"{kind} {seed} {number}")
    if kind == "arguments":
        return Case(number, words=tuple(random_words(rng)))
    if kind == "lies":
        format = rng.choice(LYING)
        return Case(number, f"lie.{format}", format, lying(samples[format], rng))
    format = rng.choice(LOOKS if kind == "looks" else FORMATS)
    known = 0.97 if kind == "looks" else 0.8  # whose readers other damage hardly reaches
    content = mutant(format, samples[format], rng, list(samples.values()), known)
    stem = rng.choice(ODD_NAMES) if rng.random() < 0.02 else "mutant"
    return Case(number, f"{stem}.{format}", format, content)


# ---- command lines

# Words that make each command work in a fraction of a second, on samples by their formats.
BASES = {
    "voxelize": ("a.obj", "--dim", "16"),
    "diagnose": ("a.obj", "--dim", "16"),
    "repair": ("a.obj", "--dim", "16"),
    "hollow": ("a.obj", "--dim", "16", "--wall", "0.3"),
    "svo-info": ("a.svo.h5",),
    "svo-query": ("a.svo.h5", "a.csv"),
    "svo-dag": ("a.svo.h5", "-o", "out.svo.h5"),
    "morph": ("a.svo.h5", "--dilate", "1"),
    "extract": ("a.svo.h5",),
    "distance": ("a.obj", "a.csv"),
    "adf-build": ("a.obj", "--max-level", "3"),
    "adf-query": ("a.adf.h5", "a.csv"),
    "adf-info": ("a.adf.h5",),
    "tet-build": ("a.vtu",),
    "export": ("a.svo.h5", "-o", "out.npz"),
    "import": ("a.image.npy",),
    "completion": ("bash",),
}
SCENES = ("a.svo.h5", "a.adf.h5", "a.raycast.tet.h5", "a.projection.tet.h5", "a.hexahedra.tet.h5")
BENCH = ("--repeat", "1", "--dims", "8", "--samples", "100", "--points", "100",
         "--grids", "8", "--levels", "2", "--sizes", "8", "--pixels", "8")  # fmt: skip
AFTER = {"selftest": ("--device", "none"), "bench": ("--device", "none")}  # too long to be run
INTEGERS = (
    *split("0 -0 1 -1 2 3 7 8 16 255 65536 65537 2147483647 2147483648 0x10 1.5"),
    "", "9223372036854775808", "-9223372036854775809", "9" * 400,
)  # fmt: skip
REALS = (
    *split("0.0 -0.0 1 0.5 1e-3 1e3 1e9 1e39 1e300 1e308 -1e308 1e309 1e-40 1e-200 1e-308 5e-324"),
    *split("nan inf -inf a 1_0 \u0661"),
)
ODD = ("", "-", ".", "folder", "/dev/null", "x" * 300, os.fsdecode(b"\xff.obj"), "new\nline.obj")
INPUTS = (*(f"a.{format}" for format in FORMATS), *ODD, "empty", "missing", "missing/a", "a.obj/b")
OUTPUTS = (
    *split("out.svo.h5 out.svo.xml out.xml.gz out.adf.h5 out.tet.h5 out.obj out.ply out.stl"),
    *split("out.glb out.off out.npy out.npz out.vti out.png out.csv out a.obj missing/out.obj"),
    *split("out.nii out.nii.gz out.nrrd out.binvox out.xyz out.voccel.xml"),
    *ODD, "/dev/full", "new\nline.svo.h5", os.fsdecode(b"\xff.svo.h5"), "x" * 300 + ".obj",
)  # fmt: skip
TEXTS = (
    *split("a cpu gpu -1 99 s density magnitude"), "", "\n", "\x1b[1m", os.fsdecode(b"\xff"),
    "x" * 5000,
)  # fmt: skip


def commands() -> dict[str, click.Command]:
    """Every command by its name, subcommands as `bench adf`."""
    from voxtool.cli.main import cli

    def walk(group: click.Group, before: str) -> Iterator[tuple[str, click.Command]]:
        context = click.Context(group)
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            if isinstance(command, click.Group):
                yield from walk(command, f"{before}{name} ")
            elif command:
                yield before + name, command

    return dict(walk(cli, ""))


def random_words(rng: random.Random) -> list[str]:
    """A command with one to four options at extreme values."""
    name, command = rng.choice(sorted(commands().items()))
    options = [p for p in command.params if isinstance(p, click.Option) and not p.hidden]
    names = {option for p in options for option in p.opts}
    words = [*name.split(), *base(name, names, rng)]
    for _ in range(rng.choice((1, 1, 2, 2, 3, 4))):
        option = rng.choice([*options, None])
        if option is None or not options:  # an argument, or one too many
            place = rng.randrange(len(name.split()), len(words) + 1)
            words[place : place + rng.randrange(2)] = [rng.choice(INPUTS)]
            continue
        written = [rng.choice((*option.opts, *option.secondary_opts))]
        if not option.is_flag:
            written += [value_of(option, rng) for _ in range(option.nargs)]
        words += written * rng.choice((1,) * 9 + (2,))
    if rng.random() < 0.02:
        words.append(rng.choice(("--no-such-option", "--", "-", "-h", "--version", "")))
    words += AFTER.get(name if name == "selftest" or rng.random() < 0.1 else name.split()[0], ())
    if "--serve" in words:
        words.append("--plan")  # it serves until it is interrupted
    if name.startswith("bench ") and words[-1] != "none":
        words += sizes(names)  # the last ones count: a bench does the work that it is asked for
    return words


def base(name: str, names: set[str], rng: random.Random) -> list[str]:
    words = list(BASES.get(name, ()))
    if name == "render":
        words = [rng.choice(SCENES), "--size", "16"]
    elif name == "bench compare":
        words = ["a.report.json", "a.report.json"]
    elif name.startswith("bench"):
        words = ["a.vtu" if name == "bench tets" else "a.obj", *sizes(names), "--quick"]
    if "--max-memory" in names:
        words += ["--max-memory", "300M"]
    return words


def sizes(names: set[str]) -> list[str]:
    """The options of a bench that keep its work small, of the names that it has."""
    pairs = zip(BENCH[::2], BENCH[1::2], strict=True)
    return [word for pair in pairs if pair[0] in names for word in pair]


def value_of(option: click.Option, rng: random.Random) -> str:
    """An extreme value of an option, mostly of its own type."""
    kind, named = option.type, f"{option.opts} {option.metavar}"
    if rng.random() < 0.1:
        return rng.choice((*INTEGERS, *REALS, *INPUTS, *TEXTS))
    number = rng.choice
    each = getattr(kind, "each", None)
    choices = getattr(kind, "choices", None) or getattr(each, "choices", None)
    if choices:
        count = rng.choice((1, 2, 3)) if each else 1
        return ",".join(rng.choice((*choices, *choices, "", "none")) for _ in range(count))
    if "--output" in named or "--obj" in named:
        return rng.choice(OUTPUTS)
    if "FILE" in named or "MESH" in named or "--like" in named:
        return rng.choice(INPUTS)
    if "=" in (option.metavar or ""):
        return f"{number('xyzw')}={number((*REALS, *INTEGERS))}"
    match kind.name:
        case "vector" | "colour":
            return number(
                (",".join(number(REALS) for _ in range(3)), "z", "-y", "#ff8000", "none", "white")
            )
        case "range":
            return number((",".join(number(REALS) for _ in range(2)), "full"))
        case "size":
            return number(("x".join(number(INTEGERS) for _ in range(2)), number(INTEGERS)))
        case "list":
            return ",".join(number((*INTEGERS, *REALS)) for _ in range(number((1, 2))))
        case "text":
            return number((*TEXTS, f"sampled:{number(INTEGERS)}"))
        case _ if "integer" in kind.name:
            return number((*INTEGERS, *INTEGERS, *REALS))
    return number((*INTEGERS, *REALS, *REALS))
