"""Attributes of combinations and of morphology, against a dense array of values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import meshes
from helpers.attributes import attributed, scattered, sizes, value_array
from helpers.cli import run, told

import voxtool
from voxtool.files import write_svo
from voxtool.svo.attribution.labels import plan_labels
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import stored_volume
from voxtool.svo.sets.booleans import plan_combine
from voxtool.svo.sets.thin import plan_thin
from voxtool.tiles.combining import CombineWindowsJob


def labelled(device, low: int, names: tuple[str, str], origin=(0.0, 0.0, 0.0)) -> Octree:
    """Two boxes side by side, large enough for inside leaves, with labels and colours."""
    solids = [
        meshes.box((low, 3, 3), (low + 11, 27, 27)),
        meshes.box((low + 11, 3, 3), (29, 27, 27)),
    ]
    mesh = voxtool.join(
        [voxtool.mesh_from_arrays(np.asarray(v, float), f, name=f"{name}.obj")
         for (v, f), name in zip(solids, names, strict=True)]
    )  # fmt: skip
    grid = voxtool.Grid((32, 32, 32), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    octree = plan_labels(mesh, grid, labels="file", device=device).run()
    label = octree.attribute("label")
    table = np.array([(200, 10, low, 255), (5, 100, low, 128)], np.uint8)
    colour = Attribute("colour", table[label.values], table[label.leaves], default=(0, 0, 0, 0))
    grid = replace(grid, origin=origin)
    return replace(octree, grid=grid, attributes=(label, colour))


def dense(octree: Octree, name: str) -> np.ndarray:
    """The value of each voxel, as whole numbers; labels by the hash of their name."""
    found = value_array(octree, name)
    if name == "label":
        names = octree.attribute(name).names
        table = np.array([*(sum(map(ord, name)) for name in names), -1])
        return table[found]
    return found


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4.0, 8.0, 0.0), (3.0, -2.0, 5.0)])
@pytest.mark.parametrize("operation", ["union", "intersection", "difference", "xor"])
def test_combinations(device, operation: str, origin: tuple[float, float, float]) -> None:
    one = labelled(device, 3, ("left", "right"))
    two = labelled(device, 7, ("right", "other"), origin)
    both = voxtool.combine([one, two], operation, device=device)
    both.validate()
    low = [np.rint(np.subtract(o.grid.origin, both.grid.origin)).astype(int) for o in (one, two)]
    for name in ("label", "colour"):
        found = dense(both, name)
        expected = np.full_like(found, -1)
        for octree, corner in zip((two, one), (low[1], low[0]), strict=True):
            values, set_ = dense(octree, name), octree.to_dense()
            at = tuple((np.argwhere(set_) + corner).T)
            expected[at] = values[set_]
        set_ = both.to_dense()
        expected[~set_] = -1
        assert (found == expected).all()
    plain = voxtool.combine(
        [replace(o, attributes=()) for o in (one, two)], operation, device=device
    )
    assert both.set_digest() == plain.set_digest()
    wanted = ("left", "right", "other") if operation in ("union", "xor") else ("left", "right")
    assert both.attribute("label").names == wanted


def test_only_attributes_that_all_operands_have_are_kept(device) -> None:
    one = labelled(device, 3, ("left", "right"))
    two = replace(labelled(device, 7, ("a", "b")), attributes=())
    assert voxtool.combine([one, two], device=device).attributes == ()
    kept = voxtool.combine([one, two], "difference", device=device)
    assert [a.name for a in kept.attributes] == ["label", "colour"]


@pytest.mark.parametrize(
    ("operation", "radius"), [("erode", 2), ("open", 3), ("shell", 2), ("dilate", 3), ("close", 4)]
)
def test_morphology(device, operation: str, radius: float) -> None:
    octree = labelled(device, 4, ("left", "right"))
    made = voxtool.morph(octree, operation, radius, device=device)
    made.validate()
    assert (
        made.set_digest()
        == voxtool.morph(
            replace(octree, attributes=()), operation, radius, device=device
        ).set_digest()
    )
    low = np.rint(np.subtract(octree.grid.origin, made.grid.origin)).astype(int)
    values, old, new = dense(octree, "label"), octree.to_dense(), dense(made, "label")
    voxels = np.argwhere(made.to_dense())
    own = np.argwhere(old)
    for voxel in voxels:
        at = voxel - low
        inside = (at >= 0).all() and (at < old.shape).all() and old[tuple(at)]
        if inside:
            assert new[tuple(voxel)] == values[tuple(at)]
        elif voxel.sum() % 7 == 0:  # some of them
            away = ((own - at) ** 2).sum(axis=1)
            near = own[away == away.min()]
            assert new[tuple(voxel)] in values[tuple(near.T)]


def test_components_and_cavities_keep_labels(device) -> None:
    octree = labelled(device, 4, ("left", "right"))
    hollow = voxtool.morph(octree, "shell", 2, device=device)
    filled = voxtool.fill_cavities(hollow)
    assert (dense(filled, "label")[filled.to_dense()] > 0).all()
    kept = voxtool.keep_components(octree, largest=1)
    assert (dense(kept, "label") == dense(octree, "label")).all()


def test_a_note_names_what_is_not_kept(here, device) -> None:
    """A combination, a morphology, components, resampling, thinning and merging each name it; a
    command that keeps every attribute says nothing."""
    names, whole = ("label", "colour", "normal", "fraction"), attributed()
    one = replace(whole, attributes=tuple(map(whole.attribute, names)))
    write_svo(one, "a.svo.h5")
    write_svo(replace(one, attributes=one.attributes[:3]), "b.svo.h5")
    fraction = 'not kept: the attribute fraction (docs/attributes.md, "Changed octrees")'
    lines = ("combine a.svo.h5 a.svo.h5", "morph a.svo.h5 --dilate 1", "morph a.svo.h5 --keep 1")
    for line in lines:
        assert f"voxtool: {fraction}\n" in run(f"{line} -o c.svo.h5").stderr, line
        other = run(f"{line.replace('a.svo', 'b.svo')} -o c.svo.h5")
        assert "not kept" not in other.stderr, line
    every = fraction.replace("attribute ", "attributes label, colour, normal, ")
    for line in ("morph a.svo.h5 --resample --dim 20", "svo-dag a.svo.h5"):
        assert f"voxtool: {every}\n" in run(f"{line} -o c.svo.h5").stderr, line
        assert every in told(f"{line} -o c.svo.h5 --json")["notes"], line
    assert list(plan_thin(replace(one, mode="surface26")).notes(replace(one, attributes=()))) == [
        every
    ]
    whole = plan_combine([one], device=device)
    windows = CombineWindowsJob(whole, [one])
    kept = "windows keep no attributes: more --max-memory would keep label, colour, normal"
    assert list(windows.notes(None)) == [every, kept]


def test_the_volume_of_fractions_is_their_sum(here, device) -> None:
    """svo-info states it, as voxelize does; leaves and defaults of any value count."""
    mesh = meshes.mesh_of(*meshes.icosphere(3, 16.0, 11.3))
    octree = voxtool.voxelize(mesh, dim=40, mode="fraction", device=device)
    write_svo(octree, "a.svo.h5")
    found = told("svo-info a.svo.h5 --json")
    assert found["volume"] == stored_volume(octree) * octree.grid.voxel_volume
    assert f"\nvolume       {found['volume']:.9g}\n" in run("svo-info a.svo.h5").stdout
    assert found["volume"] == pytest.approx(4 / 3 * np.pi * 11.3**3, rel=0.02)
    made, rng = scattered(), np.random.default_rng(4)
    voxels, leaves = sizes(made)
    masks = made.bricks & rng.integers(0, 1 << 63, len(made.bricks), dtype=np.uint64)
    own = rng.integers(0, 256, int(np.bitwise_count(masks).sum())).astype(np.uint8)
    above = rng.integers(0, 256, leaves).astype(np.uint8)
    fraction = Attribute("fraction", own, above, masks, 7)
    sides = [level.side**3 for level in made.levels() for _ in range(int(level.inside.sum()))]
    assert sides[0] > 1
    total = int(own.sum()) + 7 * (voxels - len(own)) + int((above * np.array(sides)).sum())
    assert stored_volume(replace(made, attributes=(fraction,))) == total / 255
