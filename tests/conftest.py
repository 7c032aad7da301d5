"""The devices under test: every one that is found and passes the probe."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from voxtool.opencl import Device, list_devices, open_device

MODELS = Path(__file__).parents[2] / "shared" / "models"

settings.register_profile(
    "voxtool",
    deadline=None,  # a first launch compiles
    derandomize=True,  # the same run everywhere
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("voxtool")


@functools.cache
def usable_devices() -> list[tuple[int, str]]:
    return [(d.index, d.platform) for d in list_devices() if d.probe == "ok"]


@functools.cache
def opened(index: int) -> Device:
    return open_device(str(index))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device_index" in metafunc.fixturenames:
        found = usable_devices()
        assert found, "no usable OpenCL device: install the extra 'cpu' or a driver"
        metafunc.parametrize(
            "device_index",
            [index for index, _ in found],
            ids=[name.split("(")[0].split()[0] for _, name in found],
            scope="session",
        )


@pytest.fixture(scope="session")
def device(device_index: int) -> Device:
    """Each usable device in turn."""
    return opened(device_index)


def model(name: str) -> Path:
    """A real model; tests that need it skip where the models are absent."""
    path = MODELS / name
    if not path.exists():
        pytest.skip(f"no model {name}: the folder of real models is absent")
    return path
