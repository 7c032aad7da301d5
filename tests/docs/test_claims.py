"""Figures and equalities of the documents have a command beside them, and such commands exist.

Whether a command prints just the figure is not checked."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from voxtool.cli.main import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MEASURED = {"accuracy.md", "performance.md"}  # times are in these alone, below their commands
ABOVE = 12  # lines in which a command stands, before the figure
LIMITS = {  # times that are rules of a program, not measurements
    ("benchmarks.md", "over 5 s"),
    ("benchmarks.md", "within 0.1 s"),
    ("benchmarks.md", "less than 0.2 s"),
}

COMMAND = re.compile(r"(?:^|[`(]|\$ )(?:voxtool|pytest|python|make) [\w./-]")
SHOWN_BY = re.compile(r"digest|selftest|voxtool compare|bench \w|tests/|tests\.|pytest")
EQUAL = re.compile(r"bit for bit|bit-identical|byte for byte|same bits|same bytes")
UNIT = r"(?:%|ns|µs|ms|s|[kMG]?B|voxels?)"
NUMBER = rf"[<~+−-]?\d[\d,.]*(?:e[-+−]?\d+)?(?: {UNIT})?"
FIGURE = re.compile(rf"{NUMBER}(?:(?: to |, |; ){NUMBER})*")
TIME = re.compile(
    r"\b\d[\d,.]*(?: to \d[\d,.]*)? (?:ns|µs|ms|s|seconds?|minutes?|hours?)\b"
    r"|\b(?:micro|nano|milli)seconds?\b"
    r"|\b(?:[\d.]+|two|three|four|five|ten) times (?:as (?:fast|long|slow)|faster|slower|longer)"
    r"|\b(?:half|a third|a quarter|a fifth|a tenth) (?:of )?the time\b"
)


def test_the_patterns_find_what_they_should() -> None:
    for cell in ("5.2", "1,200 MB", "−0.03 %", "40 to 47", "3.6e-8, 3.6e-7", "1.4 s"):
        assert FIGURE.fullmatch(cell), cell
    for cell in ("", "surface26", "2³⁰ nodes", "at most 5", "1e-3 of it"):
        assert not FIGURE.fullmatch(cell), cell
    for text in ("took 0.23 s of", "two to three times as long", "tens of nanoseconds"):
        assert TIME.search(text), text
    for text in ("1 << 30", "5 sides", "at most 64 times", "all the time"):
        assert not TIME.search(text), text
    assert COMMAND.search("`voxtool bench adf`")
    assert not COMMAND.search("The voxtool library")
    assert figures(["| a | 1 | 2 |", "| b | 3 | c |"]) == 0.75


def figures(rows: list[str]) -> float:
    """The share of figures among the cells of a table that are not in the first column."""
    cells = [cell.strip() for row in rows for cell in row.strip("|").split("|")[1:]]
    return sum(FIGURE.fullmatch(cell) is not None for cell in cells) / max(1, len(cells))


def tables(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    """Each table: the line where it begins, and its rows."""
    for i, line in enumerate(lines):
        if re.fullmatch(r"\|[ :|-]+\|", line):
            end = next((j for j in range(i, len(lines)) if lines[j][:1] != "|"), len(lines))
            yield i - 1, lines[i + 1 : end]


def prose(text: str) -> list[str]:
    """The lines of a page; those of blocks of code are empty."""
    text = re.sub(r"^```.*?^```$", lambda b: "\n" * b[0].count("\n"), text, flags=re.M | re.S)
    return text.split("\n")


def beside(lines: list[str], i: int) -> str:
    """The lines above the i-th, it, and the rest of its paragraph."""
    end = next((j for j in range(i, len(lines)) if not lines[j].strip()), len(lines))
    return "\n".join(lines[max(0, i - ABOVE) : max(end, i + 1)])


def named(pattern: re.Pattern[str], text: str) -> bool:
    return any(pattern.search(line) for line in text.split("\n"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_of_figures_have_a_command(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").split("\n")
    for i, rows in tables(lines):
        if figures(rows) >= 1 / 3:
            above = "\n".join(lines[max(0, i - ABOVE) : i])
            assert named(COMMAND, above), f"{page.name}:{i + 1}: {lines[i]}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_times_have_a_command(page: Path) -> None:
    if page.name in MEASURED:
        return
    text = page.read_text(encoding="utf-8")
    lines = text.split("\n")
    for i, line in enumerate(prose(text)):
        for found in TIME.finditer(line):
            if not any(page.name == name and rule in line for name, rule in LIMITS):
                where = f"{page.name}:{i + 1}: {found[0]}"
                assert named(COMMAND, beside(lines, i)), where


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_equality_says_what_shows_it(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    lines = text.split("\n")
    for i, line in enumerate(prose(text)):
        if EQUAL.search(line):
            assert named(SHOWN_BY, beside(lines, i)), f"{page.name}:{i + 1}: {line}"


def test_the_limits_are_there() -> None:
    for name, rule in LIMITS:
        assert rule in (ROOT / "docs" / name).read_text(encoding="utf-8")


# ---- the commands


def code(first: str) -> list[str]:
    """The code in the pages, in lines and in blocks, that begins with this word."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = "\n".join(re.findall(r"^```\w*\n(.*?)^```$", text, re.M | re.S))
        text = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
        found += re.findall(rf"`({first} [^`]+)`", text)
        found += re.findall(rf"^(?:\$ )?({first} .+)$", blocks, re.M)
    return sorted({" ".join(line.partition("  #")[0].split()) for line in found})


@pytest.mark.parametrize("line", code("pytest"))
def test_tests_exist(line: str) -> None:
    words = shlex.split(line)
    path = ROOT / words[-1]
    assert path.exists()
    if "-k" in words:
        assert re.search(rf"def test_\w*{words[words.index('-k') + 1]}", path.read_text("utf-8"))


@pytest.mark.parametrize("line", code("python"))
def test_programs_exist(line: str) -> None:
    name = line.split()[1]
    path = name if name != "-m" else line.split()[2].replace(".", "/")
    assert (ROOT / path).exists() or (ROOT / f"{path}.py").exists()


@pytest.mark.parametrize("line", code("make"))
def test_targets_exist(line: str) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{line.split()[1]}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("line", code("voxtool"))
def test_commands_have_these_options(line: str) -> None:
    """Also of commands in sentences, which are not complete."""
    words, command = line.split("|")[0].split()[1:], cli
    while words and isinstance(command, click.Group) and words[0][0].islower():
        found = command.get_command(click.Context(command), words.pop(0))
        assert found is not None
        command = found
    known = {option for param in command.params for option in [*param.opts, *param.secondary_opts]}
    known |= {"-h", "--help", "--version"}
    for option in re.findall(r"(?<![\w-])--?[a-z][\w-]*", " ".join(words)):
        assert option in known, option
