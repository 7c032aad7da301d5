"""Jobs of fields: planned once, forced, refused, and their warnings."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import meshes

from voxtool.adf.construction.build import plan_adf
from voxtool.adf.construction.plan import PILOT_LEVEL, FieldPlan
from voxtool.adf.field.packing import arrangement, most_blocks, pack_blocks, pointers_to
from voxtool.errors import MemoryLimitError, MeshWarning, VoxtoolError
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import open_device

if TYPE_CHECKING:
    from voxtool.opencl import Device

plan = partial(plan_adf, tolerance=1e-3, max_level=6, measure=False)


def ball() -> Mesh:
    return mesh_from_arrays(*meshes.icosphere(2))


def box_without_lid() -> Mesh:
    return mesh_from_arrays(*meshes.open_box(0, (4, 3, 2)))


def test_levels_are_built_once(device: Device) -> None:
    """A run continues from the levels that the plan built; the next begins at the root."""
    job, begun = plan(ball(), device=device), []
    with device.reporting(begun.append):
        counted = job.plan.refined
        job.describe()
        assert begun.count("sample") == PILOT_LEVEL == len(counted) - 1
        field = job.run()
        levels = len(field.cells_by_level()) - 1
        assert begun.count("sample") == levels > PILOT_LEVEL
        assert job.run().digest() == field.digest()
        assert begun.count("sample") == 2 * levels
    assert begun.count("tree") == 0
    assert job.plan.refined == tuple(field.cells_by_level()[:-1])
    assert field.digest() == plan(ball(), device=device).run().digest()
    assert set(begun) <= {*job.stages, "upload"}
    assert "errors" not in job.stages
    assert "errors" in job.with_(measure=True).stages


@pytest.mark.parametrize(
    ("mesh", "request_"),
    [
        (ball, {"measure": True}),
        (ball, {"sign": "none", "continuous": False}),
        (box_without_lid, {"measure": True}),
        (box_without_lid, {"max_level": 1}),
    ],
)
def test_the_programs_that_a_build_uses_are_prepared(device, mesh, request_, monkeypatch) -> None:
    fresh, prepared = open_device(str(device.info.index)), []
    monkeypatch.setattr(fresh.builder, "prepare", prepared.extend)
    with warnings.catch_warnings(action="ignore"):
        plan(mesh(), device=fresh, **request_).run()
    keys = {(source, *sorted(defines.items())) for source, defines in prepared}
    assert fresh.builder.requests == keys


@pytest.mark.parametrize(
    ("forced", "says"),
    [
        ({"flat": 1}, True),
        ({"closed": False, "sign": "pseudonormal"}, True),
        ({"sign": "winding"}, True),
        ({"sign": "none"}, False),
        ({"max_level": 3}, False),
    ],
)
def test_decisions_are_forced(device: Device, forced: dict, says: bool) -> None:
    job = plan(ball(), device=device, tolerance=4e-3)
    field = job.run()
    other = job.with_(**forced).run()
    assert np.array_equal(other.voxels, field.voxels) == says
    assert job.run().digest() == field.digest()
    request = {name: value for name, value in forced.items() if name not in ("flat", "closed")}
    again = plan(ball(), device=device, **{"tolerance": 4e-3, **request}).run()
    assert np.array_equal(again.voxels, other.voxels)


def test_memory_is_refused_level_by_level(device: Device) -> None:
    job = plan(ball(), device=device, max_memory=1 << 20)
    with pytest.raises(MemoryLimitError, match=r"--max-level \d fits"):
        job.run()


def nested_balls() -> Mesh:
    inner, outer = meshes.icosphere(1), meshes.icosphere(1, radius=2)
    return mesh_from_arrays(*meshes.join(inner, outer))


@pytest.mark.parametrize(
    ("mesh", "forced", "message"),
    [
        (box_without_lid, {}, "mesh is not closed: .*; inside is where its winding number"),
        (
            ball,
            {"closed": False},
            "mesh is treated as open; signs by pseudo-normals may be wrong: choose fill winding",
        ),
        (lambda: mesh_from_arrays(np.eye(3), [(0, 1, 2)]), {}, "the field has no inside"),
    ],
)
def test_warnings(device: Device, mesh, forced: dict, message: str) -> None:
    with pytest.warns(MeshWarning, match=message):
        plan(mesh(), max_level=3, device=device).with_(**forced).run()


def test_parts_are_united(device: Device) -> None:
    job = plan(nested_balls(), max_level=3, device=device)
    field = job.run()
    assert field.sign == "winding"
    assert field.query([[0.0, 0.0, 0.0]]).distance[0] < 0
    assert list(job.notes(field)) == ["mesh: 2 parts overlap: their union is inside"]


def test_a_field_that_fits_no_texture_is_refused() -> None:
    room = most_blocks(256)
    fits = FieldPlan(1, "none", max_texture=256, refined=(1, 8, room - 9))
    fits.refuse_beyond(1 << 40, 1 << 40)
    message = (
        r"614,126 blocks down to level 2 do not fit a texture of 256\^3 texels, which has room for "
        r"614,125: --max-level 2 fits, or ask for .* --max-bytes 76765625 \(see --max-texture\)"
    )
    with pytest.raises(MemoryLimitError, match=message):
        replace(fits, refined=(1, 8, room - 8)).refuse_beyond(1 << 40, 1 << 40)
    with pytest.raises(VoxtoolError, match="max texture 255: choose 256 to 3072"):
        replace(fits, max_texture=255)


@pytest.mark.parametrize("n", [1, 2, 9, 27, 28, 585, 37449])
def test_blocks_are_packed_nearly_as_a_cube(n: int) -> None:
    sides = arrangement(n)
    assert math.prod(sides) >= n
    assert math.prod(sides) <= n + sides[0] * (sides[1] + sides[2])
    assert max(sides) ** 3 < n + 3 * max(sides) ** 2  # no smaller cube has room
    assert most_blocks(3 * max(sides)) >= n > most_blocks(3 * (max(sides) - 1))
    blocks = np.arange(8 * n, dtype=np.uint32).reshape(n, 2, 2, 2)
    texture, pointers = pack_blocks(blocks), pointers_to(n)
    x, y, z = (pointers >> shift & 1023 for shift in (0, 10, 20))
    for dz, dy, dx in np.ndindex(2, 2, 2):
        texels = texture[2 * z + dz, 2 * y + dy, 2 * x + dx]
        assert np.array_equal(texels, blocks[:, dz, dy, dx])
    assert texture.sum(dtype=np.int64) == blocks.sum(dtype=np.int64)
