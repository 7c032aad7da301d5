"""The program as a process: signals, crashes, closed streams, caches, limits."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.cli import ENVIRONMENT, MODULE, run

from voxtool import open_device
from voxtool.files.storage.atomic import atomic_path

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name == "nt", reason="processes of POSIX"),
]
DRIVERS = ["Intel", "Portable"]

CUBE = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"""
# A command that stops in the middle of writing its output, with the program's own beginning.
CRASHING = """
import os, sys
from voxtool.opencl import program
name, platform = sys.argv.pop(1), sys.argv.pop(1)
found = getattr(program, name)
def crash(cl, context, *more):
    if platform in context.devices[0].platform.name:
        os.abort()
    return found(cl, context, *more)
setattr(program, name, crash)
from voxtool.__main__ import main
main()
"""
HALF = """
import os, sys, time
from voxtool import files, watch
from voxtool.files.octrees import svo_hdf5
def write(octree, file):
    file.write(b"half")
    print("written", flush=True)
    {then}
svo_hdf5.write = write
from voxtool.__main__ import main
sys.argv = ["voxtool", "voxelize", "cube.obj", "--dim", "16", "-o", "a.svo.h5"]
main()
"""


@pytest.fixture
def cube(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("cube.obj").write_text(CUBE)
    return tmp_path


def half_written(then: str, device: str) -> subprocess.Popen[bytes]:
    child = subprocess.Popen(
        [sys.executable, "-c", HALF.format(then=then)],
        env={**ENVIRONMENT, "VOXTOOL_DEVICE": device},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert child.stdout
    assert child.stdout.readline() == b"written\n"
    return child


def shell(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A shell command, in which $V is voxtool."""
    return subprocess.run(
        ["bash", "-c", command],
        env={**ENVIRONMENT, "V": " ".join(MODULE), **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize(
    ("name", "code", "device"),
    [("SIGINT", 130, "Intel"), ("SIGTERM", 143, "Portable"), ("SIGHUP", 129, "Intel")],
)
def test_a_signal_ends_the_command_with_one_line_and_no_file(name, code, device, cube) -> None:
    with half_written("time.sleep(60)", device) as child:
        child.send_signal(getattr(signal, name))
        out, error = child.communicate(timeout=20)
    assert (child.returncode, out, error) == (code, b"", f"voxtool: ended by {name}\n".encode())
    assert os.listdir() == ["cube.obj"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_imports_gives_no_traceback(number: signal.Signals, cube) -> None:
    script = "import sys; from voxtool.__main__ import main; print(1, flush=True); main()"
    for delay in (0.0, 0.05):
        child = subprocess.Popen(
            [sys.executable, "-c", script, "voxelize", "cube.obj", "-q"],
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert child.stdout
        assert child.stdout.readline() == b"1\n"
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.005 + delay)
        child.send_signal(number)
        assert b"Traceback" not in child.communicate(timeout=20)[1]
        assert child.returncode == 128 + number


ENDS_WHILE_A_THREAD_MAKES_A_FOLDER = """
import os, sys, threading, time
from voxtool import watch
begun = threading.Event()
def make():
    with watch.making:
        os.mkdir(sys.argv[1])
        begun.set()
        time.sleep(0.2)
        watch.writing(sys.argv[1])
threading.Thread(target=make).start()
begun.wait()
watch.remove_files()
os._exit(0)
"""


def test_a_folder_that_another_thread_makes_at_the_end_is_removed(tmp_path) -> None:
    words = [sys.executable, "-c", ENDS_WHILE_A_THREAD_MAKES_A_FOLDER, tmp_path / "folder"]
    subprocess.run(words, check=True, env=ENVIRONMENT, timeout=60)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("device", DRIVERS)
@pytest.mark.parametrize("then", ["os.abort()", "os.kill(os.getpid(), 9)"])
def test_a_crash_is_one_line_that_names_the_device_and_leaves_no_file(then, device, cube) -> None:
    with half_written(then, device) as child:
        error = child.communicate(timeout=20)[1].decode()
    assert child.returncode < 0
    line = error.splitlines()[-1]  # a driver may print its own before
    assert line.startswith("voxtool: error: the command ended without a result")
    assert f"the driver of {open_device(device).info.name} (" in line
    assert os.listdir() == ["cube.obj"]


@pytest.mark.parametrize(
    ("where", "device", "command"),
    [
        ("build", "Intel", "voxelize cube.obj --dim 16 --device Intel"),
        ("build", "Portable", "repair cube.obj --dim 16 -o b.obj --device Portable"),
        ("compiled", "Portable", "devices"),
    ],
)
def test_a_compiler_that_ends_the_process_is_one_line(where, device, command, cube) -> None:
    """It names the device, and the others."""
    words = [sys.executable, "-c", CRASHING, where, device, *command.split()]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert done.returncode == -signal.SIGABRT
    assert "Traceback" not in done.stderr
    used, other = done.stderr.splitlines()[-1].split(" crashed: ")  # a driver prints its own before
    assert used.startswith("voxtool: error: the command ended without a result")
    assert f"the driver of {open_device(device).info.title}" in used
    (name,) = (open_device(each).info.title for each in DRIVERS if each != device)
    assert re.search(rf"choose another device with --device: .*\d: {re.escape(name)}", other)
    assert os.listdir() == ["cube.obj"]


def test_leftovers_of_dead_processes_go_when_the_target_is_written_again(cube) -> None:
    script = (
        "import os; from voxtool.files.storage.atomic import atomic_path as a\n"
        "with a('a.obj') as t: {}"
    )
    for then in ("os._exit(1)", "print(t, flush=True), __import__('time').sleep(60)"):
        child = subprocess.Popen(
            [sys.executable, "-c", script.format(then)], env=ENVIRONMENT, stdout=subprocess.PIPE
        )
        assert child.stdout
        left = child.stdout.readline() if "print" in then else child.wait()
    names = {p for p in os.listdir() if p.endswith(".tmp")}
    assert {Path(left.decode().strip()).name} == names  # the second writer removed the first's file
    with atomic_path("a.obj") as temporary:
        temporary.write_text("v 0 0 0\n")
    assert names < set(os.listdir())  # its writer lives
    child.kill()
    child.communicate()
    with atomic_path("a.obj"):
        pass
    assert sorted(os.listdir()) == ["a.obj", "cube.obj"]


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        ("$V svo-info a.svo.h5 >&-", 3, "standard output: it is closed"),
        ("$V voxelize cube.obj -o - --dim 16 >&-", 3, "standard output: it is closed"),
        ("$V svo-info --help >&-", 3, "standard output: it is closed"),
        ("$V voxelize - --dim 16 <&-", 3, "standard input"),
        ("$V svo-info - <&-", 3, "stdin"),
        ("$V svo-info a.svo.h5 >/dev/full", 3, "standard output: the disk is full"),
        ("$V svo-info a.svo.h5 2>&-", 0, ""),
        ("$V svo-info a.svo.h5 2>/dev/full", 0, ""),
        ("$V voxelize cube.obj --dim 16 -o b.svo.h5 2>/dev/full && false", 3, ""),
        ("$V voxelize cube.obj --dim 16 -o - --json 2>/dev/full >b.svo.h5", 3, ""),
        ("$V svo-info none.svo.h5 2>/dev/full", 3, ""),
        ("$V svo-info 2>/dev/full", 2, ""),
        ("$V svo-info a.svo.h5 2>/dev/full >/dev/full", 3, ""),
        ("$V svo-info none.svo.h5 2>&-", 3, ""),
        ("$V voxelize cube.obj --dim 16 -o b.svo.h5 <&- >&- 2>&-", 0, ""),
        ("ulimit -f 2000; $V render a.svo.h5 --float -o b.npy", 3, "cannot write b.npy: the file"),
    ],
)
def test_closed_and_full_streams(command: str, code: int, said: str, cube) -> None:
    run("voxelize cube.obj --dim 16 -q -o a.svo.h5")
    done = shell(command)
    assert done.returncode == code
    assert done.stderr.count("\n") == bool(said)
    assert said in done.stderr


@pytest.mark.parametrize("device", DRIVERS)
@pytest.mark.parametrize(
    ("limit", "target", "said"),
    [
        (
            "ulimit -f 2",
            "a.svo.h5",
            "cannot write a.svo.h5: the file would be larger than its disk",
        ),
        ("true", "/proc/a.svo.h5", "cannot write /proc/a.svo.h5"),
        ("true", "/dev/full --format svo.h5", "cannot write /dev/full: the disk is full"),
    ],
)
def test_an_output_that_cannot_be_written(limit, target, said, device, cube) -> None:
    done = shell(f"{limit}; $V voxelize cube.obj --dim 16 -q -o {target} --device {device}")
    line = done.stderr.splitlines()[-1]  # a driver may print its own before
    if device == "Portable" and "ulimit" in limit:  # LLVM cannot write its files: it calls exit
        assert f"the driver of {open_device(device).info.name} (" in line
    else:
        assert (done.returncode, said in line) == (3, True), done.stderr
    assert os.listdir() == ["cube.obj"]


@pytest.mark.parametrize("device", DRIVERS)
def test_without_a_cache_folder_there_is_one_warning(device: str, cube) -> None:
    command = f"$V voxelize cube.obj --dim 16 --mode surface6 --device {device} -o a.svo.h5"
    done = shell(command, XDG_CACHE_HOME="/proc/none", HOME="/proc/none")
    assert (done.returncode, done.stderr.count("\n")) == (0, 2), done.stderr
    assert done.stderr.startswith("voxtool: warning: kernels are compiled anew")


def test_a_damaged_cache_is_compiled_anew_and_locks_do_not_matter(cube) -> None:
    command = "$V voxelize cube.obj --dim 16 --mode surface6 -q -o a.svo.h5 --device Intel"
    assert shell(command, XDG_CACHE_HOME=str(cube / "cache")).stderr == ""
    kept = list((cube / "cache" / "voxtool").iterdir())
    assert len(kept) > 3
    for number, file in enumerate(kept):
        content = file.read_bytes()
        file.write_bytes(content[: len(content) // 2] if number % 2 else content[:-1] + b"\1")
    old = (
        cube
        / "cache/pyopencl"
        / f"pyopencl-compiler-cache-v2-py{'.'.join(map(str, sys.version_info))}"
    )
    old.mkdir(parents=True)
    (old / "lock").touch()  # of a process that was killed
    done = shell(command, XDG_CACHE_HOME=str(cube / "cache"))
    assert (done.returncode, done.stderr) == (0, "")


def test_a_cache_that_others_can_write_to_is_not_used(cube) -> None:
    (cube / "cache/voxtool").mkdir(parents=True)
    (cube / "cache/voxtool").chmod(0o777)
    command = "$V voxelize cube.obj --dim 16 --mode surface6 -o a.svo.h5"
    done = shell(command, XDG_CACHE_HOME=str(cube / "cache"))
    assert "compiled anew" in done.stderr
    assert not os.listdir(cube / "cache/voxtool")


@pytest.mark.parametrize("device", DRIVERS)
@pytest.mark.parametrize("limit", [200_000, 700_000])
def test_too_little_address_space_is_one_line(limit: int, device: str, cube) -> None:
    """Or a result, or nothing but the line of an allocation in a driver that ends the process."""
    done = shell(
        f"ulimit -v {limit}; exec $V voxelize cube.obj --dim 256 -q -o a.svo.h5 --device {device}"
    )
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert "voxtool: error: " in done.stderr
    assert [p for p in os.listdir() if p.endswith(".tmp")] == []
