"""A file appears whole or not at all, whatever happens meanwhile."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from helpers.files import ROOT

from voxtool.errors import FileError
from voxtool.files.storage import atomic
from voxtool.files.storage.atomic import atomic_folder, atomic_path, check_target

posix_only = pytest.mark.skipif(os.name != "posix", reason="POSIX only")

OLD, NEW = b"old\n", b"new\n"


def put(target: Path, data: bytes = NEW, clobber: bool = True) -> None:
    with atomic_path(target, clobber) as temporary:
        temporary.write_bytes(data)


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_writes_a_new_file_or_replaces_one(tmp_path: Path) -> None:
    for data in (OLD, NEW):
        put(tmp_path / "a.h5", data)
        assert (tmp_path / "a.h5").read_bytes() == data
        assert names(tmp_path) == ["a.h5"]


def test_bytes_are_on_the_disk_before_the_rename(tmp_path: Path, monkeypatch) -> None:
    target, fsync, synced = tmp_path / "a.h5", os.fsync, []
    target.write_bytes(OLD)

    def record(handle: int) -> None:
        synced.append((os.fstat(handle).st_ino, target.read_bytes()))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", record)
    put(target)
    assert synced[0] == (target.stat().st_ino, OLD)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("exists", [True, False])
def test_any_exception_leaves_the_old_file_and_nothing_else(tmp_path, error, exists) -> None:
    target = tmp_path / "a.h5"
    if exists:
        target.write_bytes(OLD)

    def fail(temporary: Path) -> None:
        temporary.write_bytes(NEW)
        raise error

    with pytest.raises(error), atomic_path(target) as temporary:
        fail(temporary)
    assert names(tmp_path) == (["a.h5"] if exists else [])
    assert not exists or target.read_bytes() == OLD


@posix_only
@pytest.mark.parametrize("umask", [0o077, 0o002])
def test_mode_is_that_of_a_plain_file(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        put(tmp_path / "a.h5")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.h5").stat().st_mode) == 0o666 & ~umask


def test_two_writers_have_temporary_files_beside_the_target(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as one, atomic_path(tmp_path / "a") as two:
        assert one != two
        assert one.exists()
        assert one.parent == tmp_path
        assert one.name.startswith(".a.")
        one.write_bytes(b"1")
        two.write_bytes(b"2")
    assert (tmp_path / "a").read_bytes() == b"1"  # the outer one ends last
    assert names(tmp_path) == ["a"]


def test_long_and_strange_names(tmp_path: Path) -> None:
    for name in ("x" * 255, "ř" * 127, "-", " a b\n"):
        put(tmp_path / name)
        assert (tmp_path / name).read_bytes() == NEW


# What is refused


def refusal(target: Path, clobber: bool = True) -> str:
    before = target.parent.is_dir() and names(target.parent)
    with pytest.raises(FileError) as early:
        check_target(target, clobber)
    with pytest.raises(FileError) as caught:
        put(target, clobber=clobber)
    assert str(early.value) == str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(target) in str(caught.value)
    assert before == (target.parent.is_dir() and names(target.parent))
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"), [("none/a", "create it"), (".", "is a folder"), ("file/a", "not a folder")]
)
def test_folders(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(OLD)
    assert message in refusal(tmp_path / name)


def test_no_clobber(tmp_path: Path) -> None:
    target = tmp_path / "a.h5"
    put(target, OLD, clobber=False)
    assert "--no-clobber" in refusal(target, clobber=False)
    assert target.read_bytes() == OLD


@contextmanager
def without_privileges() -> Iterator[Path]:
    """A folder that cannot be written; root becomes nobody, since root may write anywhere."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o555)
        user = os.getresuid()
        if user[1] == 0:
            os.setresuid(65534, 65534, 0)
        try:
            yield Path(folder)
        finally:
            os.setresuid(*user)


@posix_only
def test_no_permission() -> None:
    with without_privileges() as folder:
        assert "no permission" in refusal(folder / "a.h5")


def test_name_too_long(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="too long"):
        put(tmp_path / ("x" * 256))
    assert names(tmp_path) == []


def test_disk_full_is_one_line_and_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "a.h5"
    target.write_bytes(OLD)
    with pytest.raises(FileError, match=r"a\.h5: the disk is full"), atomic_path(target):
        raise OSError(28, "No space left on device")
    assert target.read_bytes() == OLD
    assert names(tmp_path) == ["a.h5"]


def test_error_about_another_file_is_not_ours(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a"):
        (tmp_path / "input").read_bytes()
    assert names(tmp_path) == []


# Links and devices


@posix_only
def test_symbolic_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "data" / "a")
    assert "exists" in refusal(tmp_path / "link", clobber=False)
    put(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "data" / "a").read_bytes() == NEW


@posix_only
def test_device_gets_the_bytes_and_stays_a_device() -> None:
    put(Path("/dev/null"))
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


@posix_only
def test_pipe_gets_the_bytes(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    put(pipe)
    reader.join(10)
    assert got == [NEW]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


# Races and kills


def test_no_clobber_race_has_one_winner(tmp_path: Path) -> None:
    target = tmp_path / "a"
    barrier = threading.Barrier(8)
    outcomes: list[str] = []

    def write(number: int) -> None:
        try:
            with atomic_path(target, clobber=False) as temporary:
                temporary.write_bytes(b"%d" % number)
                barrier.wait(10)  # all have passed the early check
            outcomes.append(f"won {number}")
        except FileError as error:
            outcomes.append(str(error))

    threads = [threading.Thread(target=write, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    won = [o for o in outcomes if o.startswith("won")]
    assert len(outcomes) == 8
    assert won == [f"won {target.read_text()}"]
    assert sum("exists" in o for o in outcomes) == 7
    assert names(tmp_path) == ["a"]


@posix_only
def test_no_clobber_without_hard_links(tmp_path: Path, monkeypatch) -> None:
    def no_link(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_link)
    put(tmp_path / "a", NEW, clobber=False)
    assert (tmp_path / "a").read_bytes() == NEW
    with pytest.raises(FileError, match="exists"), atomic_path(tmp_path / "b", clobber=False):
        (tmp_path / "b").write_bytes(OLD)  # another one was faster
    assert (tmp_path / "b").read_bytes() == OLD
    assert names(tmp_path) == ["a", "b"]


def started(program: str, target: Path, **streams: Any) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", program, str(target)], cwd=ROOT, **streams)


KILLED = """
import sys
from voxtool.files.storage.atomic import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    with open(temporary, "wb") as file:
        file.write(b"n" * 100_000)
        file.flush()
        print("written", flush=True)
        sys.stdin.read()
"""


@posix_only
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("exists", [True, False])
def test_a_process_killed_while_writing_leaves_old_or_none(tmp_path, kill, exists) -> None:
    target = tmp_path / "a.h5"
    if exists:
        target.write_bytes(OLD)
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with started(KILLED, target, **streams) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(kill)
        process.wait(20)
    assert target.exists() == exists
    assert not exists or target.read_bytes() == OLD
    if kill == signal.SIGINT:
        assert names(tmp_path) == (["a.h5"] if exists else [])


REWRITTEN = """
import sys
from voxtool.files.storage.atomic import atomic_path
for number in range(1_000_000):
    with atomic_path(sys.argv[1]) as temporary:
        temporary.write_bytes(bytes([number % 256]) * 50_000)
"""


@posix_only
def test_killed_at_any_moment_the_file_is_whole(tmp_path: Path) -> None:
    for delay in (0.0, 0.013, 0.029):
        target = tmp_path / f"a{delay}"
        with started(REWRITTEN, target) as process:
            until = time.monotonic() + 20
            while not target.exists() and time.monotonic() < until:
                time.sleep(0.002)
            time.sleep(delay)
            process.kill()
        data = target.read_bytes()
        assert data == data[:1] * 50_000


# Folders


def put_folder(target: Path, text: str) -> None:
    with atomic_folder(target) as temporary:
        for name in "ab":
            (temporary / name).write_text(text)


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_folder_is_replaced_as_a_whole(exchanges: bool, tmp_path: Path, monkeypatch) -> None:
    """Whatever several writers do at once; where a system cannot exchange two folders, too."""
    if not exchanges:
        monkeypatch.setattr(atomic, "_exchanged", lambda *_: False)
    target = tmp_path / "o"
    put_folder(target, "before")
    errors: list[BaseException] = []

    def write(number: int) -> None:
        try:
            for turn in range(20):
                put_folder(target, f"{number} {turn}")
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    while exchanges and any(thread.is_alive() for thread in threads):
        assert (target / "a").exists()  # at every moment there is one
    for thread in threads:
        thread.join()
    assert errors == []
    assert names(target) == [".voxtool", "a", "b"]
    assert (target / "a").read_text() == (target / "b").read_text() != "before"
    assert names(tmp_path) == ["o"]


def test_a_folder_that_is_replaced_while_it_is_read_is_an_export(
    tmp_path: Path, monkeypatch
) -> None:
    """Another run puts its own there and has removed half of the old one."""
    target, names_in = tmp_path / "o", os.listdir
    put_folder(target, "before")

    def slow(path):
        if path == target:
            monkeypatch.undo()
            target.rename(tmp_path / "old")
            put_folder(target, "other")
            (tmp_path / "old" / atomic.MARK).unlink()
            return names_in(tmp_path / "old")
        return names_in(path)

    monkeypatch.setattr(atomic.os, "listdir", slow)
    put_folder(target, "new")
    assert (target / "a").read_text() == "new"


def test_what_no_export_wrote_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "o").mkdir()
    put_folder(tmp_path / "o", "new")  # it was empty
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "x").write_text("mine")
    with pytest.raises(FileError, match="holds files that no export wrote"):
        put_folder(tmp_path / "mine", "new")
    assert names(tmp_path / "mine") == ["x"]


KILLED_FOLDER = KILLED.replace("atomic_path", "atomic_folder").replace(
    "open(temporary,", "open(temporary / 'a',"
)


@posix_only
def test_the_folder_of_a_killed_process_goes_when_the_target_is_written(tmp_path: Path) -> None:
    target = tmp_path / "o"
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with started(KILLED_FOLDER, target, **streams) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        put_folder(target, "old")
        assert len(names(tmp_path)) == 2  # its writer lives
        process.kill()
    put_folder(target, "new")
    assert names(tmp_path) == ["o"]
    assert (target / "a").read_text() == "new"
