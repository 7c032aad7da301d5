"""Components and cavities against scipy's labels."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import model
from helpers.morphology import scenes, sizes_of
from scipy import ndimage

import voxtool
from voxtool.choices import NEIGHBOURS
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.components import split

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_components_are_those_of_scipy(neighbours: int) -> None:
    for name, dense in scenes().items():
        job = voxtool.plan_keep_components(Octree.from_dense(dense), 2, neighbours=neighbours)
        result = job.run()
        result.validate()
        sizes = sizes_of(dense, neighbours)
        assert np.array_equal(job.sizes, sizes), name
        kept = result.to_dense()
        assert not (kept & ~dense).any(), name
        assert np.array_equal(sizes_of(kept, neighbours), sizes[:2]), name


def test_cavities_are_those_of_scipy() -> None:
    for name, dense in scenes().items():
        filled = voxtool.fill_cavities(Octree.from_dense(dense))
        filled.validate()
        assert np.array_equal(filled.to_dense(), np.asarray(ndimage.binary_fill_holes(dense))), name


def test_small_components_go() -> None:
    dense = scenes()["sparse"]
    sizes = sizes_of(dense, 6)
    kept = voxtool.keep_components(Octree.from_dense(dense), min_size=3)
    assert kept.count == sizes[sizes >= 3].sum()


def test_of_two_of_one_size_the_first_in_morton_order_stays() -> None:
    dense = np.zeros((40, 40, 40), bool)
    dense[3, 0, 0] = dense[0, 0, 2] = True  # codes 9 and 32
    kept = voxtool.keep_components(Octree.from_dense(dense), 1)
    assert kept.occupied().tolist() == [[3, 0, 0]]


def test_unpruned_octrees_have_the_same_components(device) -> None:
    octree = voxtool.voxelize(model("spot.obj"), dim=64, device=device)
    shell = voxtool.morph(octree, "shell", 2, device=device)
    assert voxtool.fill_cavities(shell) == octree
    job = voxtool.plan_keep_components(octree, neighbours=26)
    assert job.run() == octree
    assert np.array_equal(job.sizes, sizes_of(octree.to_dense(), 26))


def test_a_checkerboard_brick_has_32_parts() -> None:
    brick = Octree.from_dense(np.indices((4, 4, 8)).sum(axis=0) % 2 == 0).bricks[:1]
    assert len(split(brick, 6)[0]) == 32
    assert len(split(brick, 18)[0]) == len(split(brick, 26)[0]) == 1


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"largest": 0}, "0 components: keep 1 or more"),
        ({"min_size": 0}, "least size 0"),
        ({"neighbours": 8}, "neighbours 8: choose one of 6, 18, 26"),
    ],
)
def test_refused(request_, message: str) -> None:
    with pytest.raises(voxtool.VoxtoolError, match=message):
        voxtool.plan_keep_components(Octree.from_dense(np.ones((8, 8, 8), bool)), **request_)


def test_memory_is_planned() -> None:
    octree = Octree.from_dense(RNG.random((40, 40, 40)) < 0.5)
    with pytest.raises(voxtool.MemoryLimitError, match="components would need"):
        voxtool.keep_components(octree, max_memory=1000)
