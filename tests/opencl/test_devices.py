"""Finding, probing and choosing devices."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import meshes
from helpers.cli import write_obj

from voxtool.cli.main import cli
from voxtool.errors import DeviceError, DeviceWarning, MemoryLimitError
from voxtool.opencl import Device, discovery, driver, list_devices, open_device

ROOT = Path(__file__).parents[2]
FIELDS = {
    "index", "name", "platform", "kind", "driver", "opencl", "units", "memory", "max_allocation",
    "fp64", "probe",
}  # fmt: skip


@pytest.fixture
def no_choice(monkeypatch) -> None:
    monkeypatch.delenv("VOXTOOL_DEVICE", raising=False)


def run_python(
    code: str, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter, with neither of the variables that choose devices but those given."""
    kept = {k: v for k, v in os.environ.items() if k not in ("OCL_ICD_VENDORS", "VOXTOOL_DEVICE")}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env={**kept, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


MESH = "triangle.obj"
COMMAND = "from voxtool.__main__ import main; import sys; sys.argv[1:] = {!r}; main()"


# ---- what there is


def test_devices_lists_all_with_the_outcome_of_the_probe(no_choice) -> None:
    found = list_devices()
    assert [d.index for d in found] == list(range(len(found)))
    result = CliRunner().invoke(cli, ["devices"])
    assert result.exit_code == 0
    assert result.stderr == ""
    for d in found:
        assert f"{d.index}  {d.name} ({d.platform}, {d.kind})\n" in result.stdout
        assert f"driver {d.driver}; {d.opencl}; {d.units} units" in result.stdout
        assert f"probe {d.probe}" in result.stdout
    told = json.loads(CliRunner().invoke(cli, ["devices", "--json"]).stdout)
    assert [d.keys() for d in told] == [FIELDS] * len(found)
    assert told == [d.as_dict() for d in found]


def test_gpus_come_first() -> None:
    kinds = [d.kind for d in list_devices()]
    assert kinds == sorted(kinds, key=lambda kind: kind != "GPU")


def test_numbers_of_a_device_are_plausible(device: Device) -> None:
    info = device.info
    assert info.units >= 1
    assert 0 < info.max_allocation <= info.memory
    assert 0 < device.max_memory <= info.memory
    assert info.opencl.startswith("OpenCL ")


# ---- nothing to use


def assert_says_what_to_install(code: int, stderr: str) -> None:
    assert code == 4
    assert stderr.startswith("voxtool: error: no usable OpenCL device")
    assert stderr.count("\n") == 1
    assert "pip install 'voxtool[cpu]'" in stderr
    assert "docs/devices.md" in stderr


@pytest.mark.parametrize("command", [["devices"], ["devices", "--json"], ["voxelize", MESH]])
def test_no_driver_says_what_to_install(tmp_path, command: list[str]) -> None:
    write_obj(tmp_path / MESH, *meshes.tetrahedron())
    (tmp_path / "drivers").mkdir()
    done = run_python(COMMAND.format(command), cwd=tmp_path, OCL_ICD_VENDORS="drivers")
    assert_says_what_to_install(done.returncode, done.stderr)
    assert "only drivers in OCL_ICD_VENDORS=drivers were sought" in done.stderr
    assert done.stdout == ("[]\n" if "--json" in command else "")
    assert sorted(os.listdir(tmp_path)) == ["drivers", MESH]


def test_no_pyopencl(tmp_path) -> None:
    (tmp_path / "pyopencl.py").write_text("raise ImportError('libOpenCL.so.1 is not there')")
    done = run_python(COMMAND.format(["devices"]), PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert done.returncode == 4
    assert "pyopencl cannot be imported (libOpenCL.so.1 is not there): install" in done.stderr
    assert done.stderr.count("\n") == 1


# ---- probes that fail


@pytest.fixture
def devices_twice(monkeypatch, no_choice):
    """Every device twice; returns a function that makes the probe of the given indices fail."""
    found = discovery._cl_devices()
    monkeypatch.setattr(discovery, "_cl_devices", lambda: [*found, *found])
    monkeypatch.setattr(discovery, "_shared", {})
    probe = discovery._probe

    def break_down(*indices: int) -> None:
        calls = iter(range(2 * len(found)))

        def broken(cl_device) -> str:
            if next(calls) in indices:
                return "failed: unknown target CPU 'generic'"
            return probe(cl_device)

        monkeypatch.setattr(discovery, "_probe", broken)

    return len(found), break_down


def test_a_device_whose_probe_fails_is_passed_over_with_a_warning(devices_twice) -> None:
    _, break_down = devices_twice
    break_down(0)
    with pytest.warns(DeviceWarning, match="passed over .* probe failed: unknown target CPU"):
        assert open_device().info.index == 1
    break_down(0)
    assert [d.probe for d in list_devices()][:2] == ["failed: unknown target CPU 'generic'", "ok"]


def test_the_warning_is_one_line_and_not_for_quiet_commands(devices_twice, tmp_path) -> None:
    _, break_down = devices_twice
    mesh = tmp_path / MESH
    write_obj(mesh, *meshes.tetrahedron())
    command = ["voxelize", str(mesh), "--mode", "surface26", "-o", str(tmp_path / "a.svo.h5")]
    break_down(0)
    result = CliRunner().invoke(cli, command)
    assert result.exit_code == 0
    first, second = result.stderr.splitlines()
    assert first.startswith("voxtool: warning: passed over ")
    assert second.startswith(f"voxtool: {mesh} -> ")
    break_down(0)
    discovery._shared.clear()
    result = CliRunner().invoke(cli, [*command, "-q"])
    assert (result.exit_code, result.output) == (0, "")


def test_every_probe_fails(devices_twice) -> None:
    count, break_down = devices_twice
    break_down(*range(2 * count))
    with pytest.raises(DeviceError, match=r"unknown target CPU 'generic'.*pip install"):
        open_device()
    break_down(*range(2 * count))
    result = CliRunner().invoke(cli, ["devices"])
    assert result.stdout.count("probe failed: unknown target CPU 'generic'") == 2 * count
    assert_says_what_to_install(result.exit_code, result.stderr)


@pytest.mark.parametrize(
    ("body", "outcome"),
    [("v[0] = oops;", "failed: "), ("v[0] = 7u;", "failed: the probe kernel gave wrong values")],
)
def test_a_probe_that_does_not_build_or_is_wrong(device: Device, body: str, outcome: str) -> None:
    found = discovery._probe(
        device.cl_device, f"__kernel void probe(__global uint *v) {{ {body} }}"
    )
    assert found.startswith(outcome)
    assert "\n" not in found


# ---- choosing


def test_choosing_by_number_kind_and_name(no_choice, monkeypatch) -> None:
    usable = [d for d in list_devices() if d.probe == "ok"]
    assert open_device().info.index == usable[0].index
    for d in usable:
        assert open_device(str(d.index)).info.index == d.index
        first = min(e.index for e in usable if e.kind == d.kind)
        assert open_device(d.kind.lower()).info.index == first
        assert open_device(d.kind.upper()).info.index == first
        for part in (d.platform, d.platform.upper()[:8], d.name):
            assert part.lower() in f"{d.platform} {d.name}".lower()
            chosen = open_device(part).info
            assert part.lower() in f"{chosen.platform} {chosen.name}".lower()
        monkeypatch.setenv("VOXTOOL_DEVICE", str(d.index))
        assert open_device().info.index == d.index
        assert open_device(str(usable[0].index)).info.index == usable[0].index  # beats the variable
        monkeypatch.delenv("VOXTOOL_DEVICE")
    monkeypatch.setenv("VOXTOOL_DEVICE", "")
    assert open_device().info.index == usable[0].index


@pytest.mark.parametrize("choice", ["no such thing", "99", "[", "-1", "accelerator"])
def test_an_unknown_device_lists_the_choices(choice: str, no_choice, monkeypatch) -> None:
    choices = "; ".join(f"{d.index}: {d.name} ({d.platform})" for d in list_devices())
    with pytest.raises(DeviceError) as caught:
        open_device(choice)
    message = f"no OpenCL device matches {choice!r}: choose one of {choices}"
    assert str(caught.value) == message
    monkeypatch.setenv("VOXTOOL_DEVICE", choice)
    with pytest.raises(DeviceError) as caught:
        open_device()
    assert str(caught.value) == message


# ---- the embedded driver

LOOK = """
import os, pathlib, tempfile
from voxtool.opencl import driver, list_devices
before = dict(os.environ)
seen = []
made = tempfile.TemporaryDirectory
class Watched(made):
    def cleanup(self):
        seen.append((self.name, sorted(p.name for p in pathlib.Path(self.name).iterdir()),
                     os.environ.get("OCL_ICD_VENDORS")))
        super().cleanup()
    def __exit__(self, *error):
        self.cleanup()
driver.tempfile.TemporaryDirectory = Watched
names = [d.platform for d in list_devices()]
left = [p for p in os.listdir(tempfile.gettempdir()) if p.startswith("voxtool-icd-")]
print(repr((names, seen, left, before.get("OCL_ICD_VENDORS"), os.environ.get("OCL_ICD_VENDORS"))))
"""
EMBEDDED = Path(sys.prefix, "lib", "libintelocl.so")
needs_embedded = pytest.mark.skipif(
    not EMBEDDED.exists(), reason="the extra 'cpu' is not installed: no embedded driver"
)


@needs_embedded
def test_the_embedded_drivers_folder_is_temporary(tmp_path) -> None:
    done = run_python(LOOK, TMPDIR=str(tmp_path))
    names, seen, left, _, after = eval(done.stdout)
    assert any("Intel" in name for name in names)
    ((folder, files, variable),) = seen
    assert Path(folder).parent == tmp_path
    assert variable is None  # it is unset before the folder goes
    system = {p.name for p in driver.SYSTEM_DRIVERS.glob("*.icd")}
    assert set(files) == {"voxtool-cpu.icd", *system}
    assert (left, after) == ([], None)
    assert os.listdir(tmp_path) == []


@needs_embedded
def test_the_users_own_drivers_are_respected(tmp_path) -> None:
    own = tmp_path / "vendors"
    own.mkdir()
    (own / "one.icd").write_text(f"{EMBEDDED}\n")
    done = run_python(LOOK, OCL_ICD_VENDORS=str(own), TMPDIR=str(own.parent))
    names, seen, left, before, after = eval(done.stdout)
    assert len(names) == 1
    assert "Intel" in names[0]
    assert seen == left == []
    assert before == after == str(own)
    assert os.listdir(own) == ["one.icd"]


def test_variables_of_drivers_are_defaults_and_listing_prints_nothing() -> None:
    code = "import os; from voxtool.opencl import list_devices; list_devices()"
    done = run_python(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    code += "; print(os.environ['CL_CONFIG_CPU_VECTORIZER_MODE'])"
    assert run_python(code).stdout == "1\n"
    assert run_python(code, CL_CONFIG_CPU_VECTORIZER_MODE="4").stdout == "4\n"


# ---- work and memory


def test_arrays_go_there_and_back(device: Device) -> None:
    values = np.arange(12, dtype=np.uint32).reshape(3, 4)
    array = device.put(values)
    assert np.array_equal(array.get(), values.ravel())
    assert np.array_equal(array.get(2, 5), [2, 3, 4])
    assert array.get(5, 5).size == 0
    device.write(array, np.array([9, 8], np.uint32))
    assert np.array_equal(array.get(0, 3), [9, 8, 2])
    for size in (0, 1, 3, 1000):
        for dtype in (np.uint8, np.uint32, np.uint64):
            array = device.zeros(size, dtype)
            assert array.dtype == dtype
            assert array.get().tolist() == [0] * size
    assert device.empty(0, np.uint32).get().size == 0


def test_too_large_an_array_is_a_memory_error(device: Device) -> None:
    with pytest.raises(MemoryLimitError, match="choose a smaller dim"):
        device.empty(1 << 46, np.uint64)


def test_failures_of_the_driver_are_ours(device: Device) -> None:
    array = device.empty(4, np.uint32)
    with pytest.raises(DeviceError, match="failed: "):
        device.write(array, np.zeros(8, np.uint32))  # more than it holds
    kernel = device.kernel("opencl/scan.cl", "sum_blocks")
    with pytest.raises(DeviceError, match="failed: "):
        kernel(256, array, np.uint32(0), array, local=128)  # not the size that it requires


def test_stage_times() -> None:
    opened = open_device(profile=True)
    told: list[str] = []
    with opened.reporting(told.append), opened.stage("outer"):
        opened.zeros(10, np.uint32)
        with opened.stage("inner"):
            opened.put(np.zeros(4, np.uint32)).get()
        opened.zeros(10, np.uint32)
    opened.zeros(10, np.uint32)
    times = opened.stage_times()
    assert told == ["outer", "inner"]
    assert list(times) == ["outer", "inner", "other"]
    assert all(seconds >= 0 for seconds in times.values())
    assert opened.stage_times() == {}
