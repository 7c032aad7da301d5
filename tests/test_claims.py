"""An output belongs to one run at a time: locks, and what decides where there are none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.cli import ENVIRONMENT

from voxtool import claims
from voxtool.claims import Claim, machine, release
from voxtool.errors import FileError

OWNS = """
import sys
from pathlib import Path
from voxtool.claims import Claim
claim = Claim(Path(sys.argv[1]), "a.svo.h5")
print("owns", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "a" / ".owner"


@pytest.fixture(autouse=True)
def folder(file: Path) -> Path:
    file.parent.mkdir()
    return file.parent


@pytest.fixture
def unlocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file system has no locks, and time goes fast."""
    monkeypatch.setattr(Claim, "_lock", lambda _: False)
    monkeypatch.setattr(claims, "BEAT", 0.1)


def refused(file: Path) -> str:
    with pytest.raises(FileError) as caught:
        Claim(file, "a.svo.h5")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_second_is_refused_in_one_line(file: Path) -> None:
    for keep in (False, True, False):
        claim = Claim(file, "a.svo.h5")
        text = refused(file)
        assert f"another run (process {os.getpid()} on " in text
        assert "is making a.svo.h5: wait until it ends, or name another output" in text
        assert claim.holds
        claim.release(keep=keep)
        assert file.exists() == keep


def test_the_claim_ends_with_its_process(file: Path) -> None:
    words = [sys.executable, "-c", OWNS, file]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(words, env=ENVIRONMENT, **pipes) as child:
        assert child.stdout
        assert child.stdout.readline() == b"owns\n"
        assert f"process {child.pid} on" in refused(file)
        child.kill()
        child.wait()
        assert json.loads(file.read_text())["process"] == child.pid
        release(str(file))
    assert not file.parent.exists()


def test_of_many_that_come_and_go_one_owns_it_at_a_time(folder: Path, file: Path) -> None:
    """The folder is made and removed each time, too."""
    inside, worst, owned = [0], [0], [0]

    def come_and_go() -> None:
        end = time.monotonic() + 1
        while time.monotonic() < end:
            with suppress(FileExistsError):
                folder.mkdir()
            with suppress(FileError, FileNotFoundError):
                claim = Claim(file, "a")
                inside[0] += 1
                worst[0] = max(worst[0], inside[0])
                owned[0] += 1
                time.sleep(0)
                inside[0] -= 1
                claim.release()
                with suppress(OSError):
                    folder.rmdir()

    threads = [threading.Thread(target=come_and_go) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert worst == [1]
    assert owned[0] > 0


def test_without_locks_a_process_of_this_machine_is_looked_for(file: Path, unlocked) -> None:
    claim = Claim(file, "a")
    assert f"process {os.getpid()} on" in refused(file)
    claim.release()
    for process, started in ((1, -1), (1 << 30, None), (1 << 70, None), ("x", None)):
        record = {"process": process, "started": started, "machine": machine(), "token": "x"}
        file.write_text(json.dumps(record))  # another one of the same number, or none
        Claim(file, "a").release()


def test_another_machine_gives_signs_of_life(file: Path, unlocked, monkeypatch) -> None:
    there = Claim(file, "a")
    monkeypatch.setattr(claims, "machine", lambda: "another")
    assert f"process {os.getpid()} on" in refused(file)
    assert there.holds
    there._ended.set()  # it is stopped, or has died
    here = Claim(file, "a")
    assert (there.holds, here.holds) == (False, True)
    there.release()  # once it goes on
    assert here.holds
    here.release()
    assert not file.exists()


def test_of_two_that_begin_at_once_without_locks_one_is_refused(file: Path, unlocked) -> None:
    made: list[Claim] = []
    errors: list[str] = []
    barrier = threading.Barrier(2)

    def begin() -> None:
        barrier.wait()
        try:
            made.append(Claim(file, "a"))
        except FileError as error:
            errors.append(str(error))

    threads = [threading.Thread(target=begin) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) <= 1
    assert len(made) + len(errors) == 2
    for claim in made:
        claim.release()


def test_a_file_that_says_nothing_useful(file: Path, monkeypatch) -> None:
    monkeypatch.setattr(claims, "BEAT", 0.1)
    for text in ("", "[]", "{", '{"machine": 1, "process": {}}'):
        file.write_text(text)
        with Claim(file, "a") as claim:
            assert claim.holds
