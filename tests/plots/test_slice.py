"""A slice of a field is a picture, and the values that it shows."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_field import plain_field, sphere

from voxtool.adf.query import FieldQuery
from voxtool.errors import VoxtoolError
from voxtool.files.picture import rounded
from voxtool.opencl import Device
from voxtool.plots.slice import draw_slice


def test_a_slice_is_a_picture_and_its_values(device: Device) -> None:
    field = plain_field(sphere, 5e-3, 4, origin=(-1.0, 2.0, 0.5), side=4.0, units="mm")
    picture, answer = draw_slice(FieldQuery(field, device), "y", 3.3, size=300)
    assert picture.dtype == np.float32
    assert picture.shape[1:] == (300, 4)
    assert (picture[..., 3] == 1).all()
    count = int(len(answer.distance) ** 0.5)
    plot = rounded(picture)[:, :, :3].reshape(-1, 3).astype(int)
    red = np.count_nonzero(plot[:, 0] > plot[:, 2] + 30)
    inside = np.count_nonzero(answer.distance < 0)
    assert count**2 == len(answer.distance)
    assert 0.8 * inside < red < 1.3 * inside  # the scale is red, too


@pytest.mark.parametrize(
    ("axis", "value", "message"),
    [("w", 1.0, "choose x, y or z"), ("y", 9.0, "lies outside of the cube: choose 2 to 6")],
)
def test_no_such_plane(device: Device, axis: str, value: float, message: str) -> None:
    field = plain_field(sphere, 5e-3, 2, origin=(-1.0, 2.0, 0.5), side=4.0)
    with pytest.raises(VoxtoolError, match=message):
        draw_slice(FieldQuery(field, device), axis, value)
