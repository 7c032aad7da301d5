"""Fields in textures, as a device reads them: the program of docs/formats.md against query_adf, and
the hardware's filter against exact interpolation."""

from __future__ import annotations

import pickle
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers.field import plain_field
from helpers.files import FIELDS, ROOT

from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import to_fixed
from voxtool.adf.field.packing import pack_blocks, pack_cells
from voxtool.adf.queries.query import FieldQuery, query_adf
from voxtool.errors import DeviceError, VoxtoolError
from voxtool.opencl import images

if TYPE_CHECKING:
    from voxtool.opencl import Device


def points_in(field: DistanceField, n: int = 2000) -> np.ndarray:
    """Return points of the cube, half of them near a point where cells are small."""
    rng = np.random.default_rng(1)
    near = (0.3, 0.6, 0.7) + rng.normal(0, 1, (n, 3)) * np.exp2(-rng.uniform(2, 16, (n, 1)))
    unit = np.concatenate([rng.random((n, 3)), near, np.indices((3, 3, 3)).reshape(3, 27).T / 2])
    return np.array(field.origin) + field.side * np.clip(unit, 0, 1)


def filter_error(field: DistanceField, points: np.ndarray) -> np.ndarray:
    """Return the largest error of a filter at points, world units: 2**-9 of the range of the leaf's
    corners an axis, and the rounding of the place in the texture to float32."""
    found = query_adf(field, points, cell=True)
    assert found.level is not None
    assert found.cell is not None
    edge = field.side * 0.5 ** found.level.astype(float)[:, None]
    low = np.array(field.origin) + edge * found.cell
    inside = low[:, None] + edge[:, None] * (
        np.indices((2, 2, 2)).reshape(3, 8).T * (1 - 1e-9) + 5e-10
    )
    corners = field.query(inside.reshape(-1, 3)).distance.reshape(-1, 2, 2, 2)
    ranges = sum(np.abs(np.diff(corners, axis=axis)).max(axis=(1, 2, 3)) for axis in (1, 2, 3))
    return (2.0**-9 + 2.0**-13) * ranges + 1e-6 * np.abs(corners).max(axis=(1, 2, 3))


@pytest.mark.parametrize("name", FIELDS)
def test_the_program_of_the_documents(name: str, device: Device) -> None:
    document = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```opencl\n(.*?)^```$", document, re.MULTILINE | re.DOTALL)
    field = FIELDS[name]()
    cells, offsets = pack_cells(field.cells), field.hash.offsets
    points = points_in(field)
    fixed, outside = np.empty(points.shape, np.uint32), np.zeros(len(points), bool)
    to_fixed(field, points, fixed, outside)
    distances, filtered = (device.empty(len(points), np.float32) for _ in range(2))
    kernel = device.kernel(
        text, "look_up", OFFSET={1: "uchar", 2: "ushort"}[offsets.itemsize],
        CHANNELS=offsets.shape[-1], WORDS=cells.shape[-1],
    )  # fmt: skip
    kernel(
        len(points), points=device.put(fixed), cells=device.put(cells),
        hash=device.put(offsets), m=field.hash.m, r=field.hash.r, depth=field.depth,
        voxels=images.image_of(pack_blocks(field.voxels), device), distances=distances,
        filtered=filtered,
    )  # fmt: skip
    exact = query_adf(field, points, device=device).distance
    inside = ~outside
    assert np.array_equal(field.side * distances.get().astype(float)[inside], exact[inside])
    off = np.abs(field.side * filtered.get().astype(float) - exact)
    assert (off[inside] <= filter_error(field, points)[inside]).all()


@pytest.mark.parametrize("name", ["golden", "deep", "without bounds"])
def test_the_filter_is_within_its_weights(name: str, device: Device) -> None:
    field = FIELDS[name]()
    points = points_in(field)
    asked: dict[str, Any] = {"gradient": True, "cell": True, "bounds": field.bounds is not None}
    exact = query_adf(field, points, device=device, **asked)
    found = query_adf(field, points, sampler="hardware", device=device, **asked)
    inside = ~exact.outside
    off = np.abs(found.distance - exact.distance)
    assert (off <= filter_error(field, points))[inside].all()
    assert off[inside].max() > 0  # it is another arithmetic
    for values in ("gradient", "bound", "level", "cell"):
        if getattr(exact, values) is not None:
            one, other = (getattr(answer, values)[inside] for answer in (found, exact))
            assert np.array_equal(one, other), values
    # not by the host
    few = query_adf(field, points[:3], sampler="hardware", device=device, **asked)
    assert np.array_equal(few.distance, found.distance[:3])


def test_what_a_device_cannot_filter_is_refused(device: Device, monkeypatch) -> None:
    field = plain_field(max_level=2)
    with pytest.raises(VoxtoolError, match="sampler 'soft' is unknown: choose exact, hardware"):
        FieldQuery(field, device, sampler="soft")
    query = FieldQuery(field, device, sampler="hardware")
    assert pickle.loads(pickle.dumps(query)).sampler == "hardware"
    monkeypatch.setattr(images, "FILTER_STEP", -1.0)
    with pytest.raises(DeviceError, match="does not interpolate in images of one float32 channel"):
        images.check_filter(device)
    large = np.broadcast_to(np.float32(0), (1, 1, 1 << 20))
    with pytest.raises(
        DeviceError, match=r"has images of up to .* texels, and these are 1048576 x"
    ):
        images.image_of(large, device)
