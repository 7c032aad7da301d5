"""Launching kernels: arguments by position and by name, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from voxtool.opencl import Device, launch

SOURCE = """
#define POINT const float x, \\
    const float y // two in one
#ifdef WIDE
#define TYPE ulong
#else
#define TYPE uint
#endif
__kernel void store(__global uint *out, const uint n, const TYPE value, POINT, const int3 place,
#if defined(WIDE) && WIDE > 1
                    const uchar small,
#elif !defined(WIDE)
                    const uint narrow,
#endif
                    __global const uint *maybe)
{
    if (get_global_id(0) >= n)
        return;
    out[0] = n;
    out[1] = (uint)value;
    out[2] = (uint)(x + 10 * y);
    out[3] = (uint)(place.x + 10 * place.y + 100 * place.z);
    out[4] = maybe == 0;
#if defined(WIDE) && WIDE > 1
    out[5] = small;
#elif !defined(WIDE)
    out[5] = narrow;
#endif
}
"""
GIVEN = {"value": 7, "x": 1.5, "y": 2, "place": (1, 2, -3), "maybe": None}


def names(**defines: int) -> list[str]:
    (signature,) = launch.signatures(SOURCE, defines)
    return [parameter.name for parameter in signature.parameters]


def test_parameters_are_those_of_the_variant() -> None:
    common = ["out", "n", "value", "x", "y", "place"]
    assert names() == [*common, "narrow", "maybe"]
    assert names(WIDE=1) == [*common, "maybe"]
    assert names(WIDE=2) == [*common, "small", "maybe"]
    (signature,) = launch.signatures(SOURCE, {"WIDE": 1})
    assert [p.dtype and p.dtype.name for p in signature.parameters] == [
        None, "uint32", "uint64", "float32", "float32", "int32", None,
    ]  # fmt: skip


def test_arguments_are_converted_by_position_and_by_name(device: Device) -> None:
    out = device.zeros(6, np.uint32)
    kernel = device.kernel(SOURCE, "store")
    expected = [3, 7, 21, (1 + 20 - 300) % 2**32, 1, 5]
    kernel(3, out, 7, 1.5, 2, (1, 2, -3), 5, None)
    assert out.get().tolist() == expected
    other = device.zeros(6, np.uint32)
    kernel(3, out=other, narrow=5, small=9, **GIVEN)  # no variant of it declares `small`
    assert other.get().tolist() == expected
    of_numpy = {"value": np.float64(8), "narrow": np.True_, "place": np.array([0.0, 1, 0])}
    kernel(3, other, **{**GIVEN, **of_numpy})
    assert other.get().tolist() == [3, 8, 21, 10, 1, 1]
    kernel(0, out=None, narrow=5, **GIVEN)  # nothing to do


@pytest.mark.parametrize(
    "wrong",
    [
        {"value": -1}, {"value": 1 << 32}, {"value": 2.5}, {"value": "7"}, {"value": None},
        {"x": "1"}, {"x": None}, {"place": (1, 2)}, {"place": 3}, {"place": (1, 2, 1 << 31)},
        {"maybe": 5}, {"maybe": np.zeros(3, np.uint32)},
    ],
)  # fmt: skip
def test_what_does_not_suit_is_named(device: Device, wrong: dict) -> None:
    kernel = device.kernel(SOURCE, "store")
    (name,) = wrong
    with pytest.raises(TypeError, match=f"kernel store does not take {name} = "):
        kernel(1, device.zeros(6, np.uint32), narrow=5, **{**GIVEN, **wrong})


def test_small_integers_do_not_wrap_around(device: Device) -> None:
    out = device.zeros(6, np.uint32)
    kernel = device.kernel(SOURCE, "store", WIDE=2)
    kernel(1, out, small=255, **{**GIVEN, "value": 1 << 40})
    assert out.get(5).tolist() == [255]
    with pytest.raises(TypeError, match="small = 256"):
        kernel(1, out, small=256, **GIVEN)


def test_missing_and_superfluous_arguments(device: Device) -> None:
    kernel = device.kernel(SOURCE, "store")
    with pytest.raises(TypeError, match="takes out, narrow: 1 arguments are given"):
        kernel(1, None, **GIVEN)
    with pytest.raises(TypeError, match="takes : 2 arguments are given"):
        kernel(1, 1, 2, out=None, narrow=5, **GIVEN)


def test_conditions_beyond_the_preprocessor_are_refused() -> None:
    with pytest.raises(ValueError, match="write numbers, names"):
        launch.preprocess("#if A / 2\n#endif", {"A": 4})
