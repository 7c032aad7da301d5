"""Pictures of attributes: each cube has the colour of its value, on every device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed, scattered

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.palette import palette
from voxtool.pictures.rendering import camera_for
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.pictures.painting import EMPTY, WHOLE, with_labels
from voxtool.svo.pictures.raycast import COLOUR, depths

SIZE = (64, 48)


def met_by(octree: Any, rays: Any, level: int | str) -> tuple[np.ndarray, np.ndarray]:
    """The cubes of a level that rays meet, by their depth: (h, w, 3) low corners in cubes."""
    depth = depths(octree, rays, level=level)
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    way = rays.direction + x[..., None] * rays.right + y[..., None] * rays.down
    hit = np.isfinite(depth)
    at = rays.origin + (np.where(hit, depth, 0)[..., None] + 1e-6) * way
    side = 1 if level == "voxel" else 4 << int(level)
    return np.floor((at - octree.grid.origin) / octree.grid.pitch / side).astype(int), hit


def wanted(octree: Any, name: str, level: int | str, cubes: np.ndarray) -> np.ndarray:
    """The colours of cubes, by the values of all cells of the grid."""
    size = 0 if level == "voxel" else int(level) + 2
    values = CellValues(octree, name, size)
    whole = values.of_cells(octree.depth - 1, np.zeros(1, np.int64))[0]
    from voxtool.morton import morton_encode

    found = whole[morton_encode(cubes.reshape(-1, 3))].reshape(*cubes.shape[:2], *values.row)
    if name == "label":
        return palette(3)[found] / 255
    if name == "colour":
        plain = found[..., 3:] == 0
        return np.where(plain, COLOUR, found[..., :3] / 255)
    if name == "normal":
        plain = (found == 0).all(axis=-1, keepdims=True)
        return np.where(plain, COLOUR, 0.5 + 0.5 * found)
    return np.array(EMPTY) + found[..., None] * np.subtract(WHOLE, EMPTY)


@pytest.mark.parametrize("level", ["voxel", 0, 1, 2])
@pytest.mark.parametrize("name", ["label", "colour", "normal", "fraction"])
def test_cubes_have_the_colours_of_their_values(name: str, level: int | str) -> None:
    octree = attributed()
    camera = camera_for(octree, "iso")
    rays = camera.rays(*SIZE)
    light = voxtool.render(octree, rays, level=level, colour=(1.0, 1.0, 1.0), colour_by="none")
    picture = voxtool.render(octree, rays, level=level, colour_by=name)
    cubes, hit = met_by(octree, rays, level)
    assert hit.mean() > 0.2
    colours = wanted(octree, name, level, np.where(hit[..., None], cubes, 0))
    near = np.abs(picture[..., :3] - light[..., :3] * colours).max(axis=-1) < 1e-5
    assert (near | ~hit).mean() > 0.99  # at edges, depths rounded here meet another cube
    assert np.array_equal(picture[..., 3], light[..., 3])


def test_leaves_have_the_colour_of_their_value() -> None:
    full = voxtool.Octree.from_dense(np.ones((16, 16, 16), bool))
    assert len(full.nodes) == 1
    label = replace(
        attributed().attribute("label"), values=np.empty(0, "u2"), leaves=np.array([2], "u2")
    )
    picture = voxtool.render(replace(full, attributes=(label,)), "front", size=(16, 16))
    colours = picture[picture[..., 3] == 1][:, 1:3]
    ratios = colours / (palette(3)[2, 1:] / np.float32(255))  # its red is 0
    assert np.allclose(ratios, ratios[:, :1])


def test_what_is_drawn_by_default() -> None:
    octree = attributed()
    without = scattered()

    def picture(content: Any, **options: Any) -> np.ndarray:
        return voxtool.render(content, "top", size=(32, 32), **options)

    assert np.array_equal(picture(octree), picture(octree, colour_by="colour"))
    label = replace(octree, attributes=octree.attributes[:1])
    assert np.array_equal(picture(label), picture(label, colour_by="label"))
    fraction = replace(octree, attributes=octree.attributes[3:])
    assert np.array_equal(picture(fraction), picture(without))
    assert np.array_equal(picture(octree, colour_by="none"), picture(without))


def test_some_labels_alone() -> None:
    octree = attributed()
    size = int(np.bitwise_count(octree.bricks).sum())
    rest = 0
    for names in (["head"], ["größe"], ["a b"], ["a b", "head"]):
        part = with_labels(octree, names)
        part.validate()
        chosen = [octree.attribute("label").names.index(name) for name in names]
        values = CellValues(octree, "label", 0)
        whole = values.of_cells(octree.depth - 1, np.zeros(1, np.int64))[0]
        from voxtool.morton import morton_encode

        dense = octree.to_dense()
        codes = morton_encode(np.indices(dense.shape).reshape(3, -1).T).reshape(dense.shape)
        assert np.array_equal(part.to_dense(), dense & np.isin(whole[codes], chosen))
        for one in octree.attributes:
            cells = CellValues(part, one.name, 0)
            found = cells.of_cells(octree.depth - 1, np.zeros(1, np.int64))[0][codes]
            all_of = CellValues(octree, one.name, 0)
            those = all_of.of_cells(octree.depth - 1, np.zeros(1, np.int64))[0][codes]
            assert np.array_equal(found[part.to_dense()], those[part.to_dense()])
        rest += len(part.attribute("label").values) if len(names) == 1 else 0
        scene = voxtool.render(octree, "front", size=(32, 24), only=names)
        assert np.array_equal(scene, voxtool.render(part, "front", size=(32, 24)))
    assert rest == size


def test_what_does_not_go_together_is_refused() -> None:
    octree = attributed()
    merged = voxtool.MergedOctree.of(scattered())
    for options, message in (
        ({"colour_by": "taste"}, "colour by 'taste': choose one of label, colour, normal"),
        ({"only": ["hand"]}, "no label is called 'hand': choose of head, größe, a b"),
        ({"other": scattered(), "only": ["head"]}, "a difference has its own colours"),
    ):
        with pytest.raises(VoxtoolError, match=message):
            voxtool.render(octree, "front", size=(8, 8), **options)
    with pytest.raises(VoxtoolError, match="merged subtrees have no attribute 'label'"):
        voxtool.render(merged, "front", size=(8, 8), colour_by="label")
    with pytest.raises(VoxtoolError, match="has no attribute 'label', it has none"):
        voxtool.render(scattered(), "front", size=(8, 8), only=["head"])
