"""Checks of the documents: commands, transcripts, Python snippets, links, docstrings."""

from __future__ import annotations

import inspect
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from helpers.cli import SHELL
from PIL import Image

import voxtool
from voxtool.cli.main import cli

ROOT = Path(__file__).parents[2]
PICTURES = {  # in docs/: what these commands draw, from left to right, and how wide
    "slice.png": [("slice.png", 746)],
    "render.png": [("octree.png", 320), ("nodes.png", 320), ("surface.png", 320)],
    "volume.png": [("volume.png", 512)],  # and a legend, which varies with matplotlib
}
DRAWN_BY = (
    "voxtool voxelize bunny.obj --dim 512 -q",
    "voxtool voxelize bunny.obj --pitch 0.0125 -o small.svo.h5 -q",
    "voxtool export small.svo.h5 -o slice.png --slice z=60",
    "voxtool adf-build bunny.obj --max-level 8 -q",
    "voxtool render bunny.svo.h5 --size 320 -o octree.png -q",
    "voxtool render bunny.svo.h5 --size 320 --level 1 -o nodes.png -q",
    "voxtool render bunny.adf.h5 --size 320 --colour '#d0a070' -o surface.png -q",
    "voxtool tet-build volume.vtu --scalar density -q",
    "voxtool render volume.tet.h5 --opacity-range 0.1,0.5 --legend -q",
)
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(group: click.Group, name: str = "voxtool") -> dict[str, click.Command]:
    """Every command by its full name."""
    found = {}
    context = click.Context(group)
    for word in group.list_commands(context):
        command = group.get_command(context, word)
        assert command is not None
        if isinstance(command, click.Group):
            found |= commands(command, f"{name} {word}")
        else:
            found[f"{name} {word}"] = command
    return found


COMMANDS = commands(cli)


def lines_of_commands() -> list[str]:
    """The lines that call voxtool, in blocks of documents and in the help of commands."""
    lines = []
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for block in [*blocks(text, "sh"), *blocks(text, "console")]:
            lines += block.splitlines()
    for command in COMMANDS.values():
        lines += (command.help or "").splitlines()
    lines = [line.strip().removeprefix("$ ") for line in lines]
    return list(dict.fromkeys(line for line in lines if line.startswith("voxtool ")))


# ---- commands


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_documented(name: str) -> None:
    assert any(name in document.read_text(encoding="utf-8") for document in DOCUMENTS)


@pytest.mark.parametrize("line", lines_of_commands())
def test_commands_and_options_exist(line: str) -> None:
    words = shlex.split(line.partition("  #")[0], comments=True)
    while words:
        end = words.index("|") if "|" in words else len(words)
        part, words = words[:end], words[end + 1 :]
        if part[0] == "voxtool":
            parse(cli, part[1:])


def parse(command: click.Command, words: list[str]) -> None:
    """Parse the words as click does, without running anything."""
    if isinstance(command, click.Group):
        assert words, "a subcommand is missing"
        found = command.get_command(click.Context(command), words[0])
        assert found is not None, f"no subcommand {words[0]}"
        parse(found, words[1:])
    else:
        command.make_context(
            "voxtool", list(words), parent=click.Context(cli, **cli.context_settings)
        )


@pytest.mark.parametrize(
    "target", re.findall(r"^make (\w+)", "\n".join(blocks(README, "sh")), re.M)
)
def test_targets_of_make_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


# ---- what the README shows, run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the example mesh and volume, in which all blocks run in order."""
    path = tmp_path_factory.mktemp("readme")
    for example in ("make_bunny.py", "make_volume.py"):
        run(shlex.join([sys.executable, str(ROOT / "examples" / example)]), path)
    return path


def run(command: str, cwd: Path) -> str:
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"exec 2>&1\n{command}"],
        cwd=cwd, env=SHELL, capture_output=True, encoding="utf-8",
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


@pytest.mark.slow
def test_transcripts_are_what_is_printed(folder: Path) -> None:
    for block in blocks(README, "console"):
        for command, expected in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block, re.MULTILINE):
            assert lasting(run(command, folder)) == lasting(expected), command


@pytest.mark.soak
def test_pictures_are_what_is_drawn(folder: Path) -> None:
    for command in DRAWN_BY:
        run(command, folder)
    for picture, parts in PICTURES.items():
        shown, left = Image.open(ROOT / "docs" / picture).convert("RGB"), 0
        for name, width in parts:
            drawn = Image.open(folder / name).convert("RGB")
            drawn = drawn.crop((0, 0, width, drawn.height))
            part = shown.crop((left, 0, left + width, shown.height))
            assert drawn.size == part.size, name
            assert drawn.tobytes() == part.tobytes(), name
            left += width


def lasting(text: str) -> str:
    """Without what differs from run to run and from one version of HDF5 to the next."""
    pattern = r"[\d.]+ s$|[\d,]+ on disk|(?<=  seconds   ).*"
    return re.sub(pattern, "#", text.strip(), flags=re.MULTILINE)


@pytest.mark.slow
def test_shell_lines_run(folder: Path) -> None:
    for block in blocks(README, "sh"):
        for line in block.splitlines():
            if line.startswith("voxtool "):
                run(line, folder)


@pytest.mark.slow
def test_python_snippet_runs(folder: Path) -> None:
    (snippet,) = blocks(README, "python")
    (folder / "snippet.py").write_text(snippet, encoding="utf-8")
    assert " of volume" in run(f"{shlex.quote(sys.executable)} snippet.py", folder)


GUIDES = [
    path for path in DOCUMENTS if path.parent.name == "docs" and "```python" in path.read_text()
]


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.name)
def test_python_in_guides_runs(guide: Path, here: Path) -> None:
    for snippet in blocks(guide.read_text(encoding="utf-8"), "python"):
        # in this process, which has imported all; large dims take seconds
        (here / "snippet.py").write_text(snippet.replace("dim=512", "dim=64"), encoding="utf-8")
        runpy.run_path("snippet.py", run_name="__main__")


# ---- sources


def sources() -> list[Path]:
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout
    ends = (".py", ".cl", ".h", ".md")
    found = [ROOT / name for name in names.splitlines() if name.endswith(ends)]
    return [path for path in found if path.exists() and path.name != "test_docs.py"]


def test_texts_are_cited_by_key() -> None:
    for path in sources():
        found = re.findall(r"\b[Tt]he (?:thesis|text's)\b", path.read_text(encoding="utf-8"))
        assert not found, f"{path.relative_to(ROOT)}: cite it by its key"


# ---- links and docstrings


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_resolve(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if not re.match(r"\w+:", link):
            file = link.partition("#")[0]
            assert (document.parent / file).exists(), f"{document.name} links to {link}"
    for named in re.findall(r"`((?:docs|examples|tests|voxtool|kernels)/[\w/.]+\.\w+)`", text):
        assert (ROOT / named).exists(), f"{document.name} names {named}"


def test_formats_are_in_the_changelog() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "### File formats" in text
    for name in ("SVO 1.0", "ADF 1.0", "TET 1.0"):
        assert name in text
    assert re.search(rf"{re.escape(voxtool.__version__.split('.dev')[0])}", text)


@pytest.mark.parametrize("name", [n for n in voxtool.__all__ if n != "__version__"])
def test_public_names_have_docstrings(name: str) -> None:
    value = getattr(voxtool, name)
    assert value.__doc__
    assert not value.__doc__.startswith(f"{name}(")  # what dataclass writes
    if inspect.isclass(value) and not issubclass(value, Exception):
        for member, method in vars(value).items():
            if not member.startswith("_") and (inspect.isfunction(method) or method_like(method)):
                assert inspect.getdoc(method), f"{name}.{member}"


def method_like(value: object) -> bool:
    return isinstance(value, (property, classmethod, staticmethod))
