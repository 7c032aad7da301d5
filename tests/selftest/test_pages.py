"""Wrong values in pages are counted one by one."""

from __future__ import annotations

import base64
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import meshes

import voxtool
from voxtool.selftest.pages import unpacked, wrong_values
from voxtool.viewer.job import plan_view
from voxtool.viewer.page import Page, packed


def changed(page: Page, name: str, change: Any) -> Page:
    """A page with another array of this name."""
    array = unpacked(page)[1][name].copy()
    change(array)
    old = base64.b64encode(page.blocks[name]).decode()
    assert zlib.decompress(page.blocks[name])
    return replace(page, html=page.html.replace(old, base64.b64encode(packed(array)).decode()))


def test_voxels_that_are_wrong_are_counted() -> None:
    dense = np.zeros((16, 16, 16), bool)
    dense[:9, :8, :8] = True  # a leaf of 512 voxels, and bricks
    octree = voxtool.Octree.from_dense(dense)
    assert octree.count_by_level()[1] == 512
    page = plan_view(octree, "a").run()
    assert wrong_values(octree, page) == (0, dense.sum())

    def other_bits(bricks: np.ndarray) -> None:
        bricks[0] ^= 0b101

    def no_leaf(children: np.ndarray) -> None:
        children[2] &= ~np.uint8(1)  # of the root: its first child

    assert wrong_values(octree, changed(page, "bricks", other_bits)) == (2, dense.sum())
    assert wrong_values(octree, changed(page, "children", no_leaf)) == (512, dense.sum())


@pytest.mark.parametrize("name", ["voxels", "cells", "hash", "bounds"])
def test_texels_of_fields_that_are_wrong_are_counted(name: str) -> None:
    ball = voxtool.mesh_from_arrays(*meshes.icosphere(1))
    field = voxtool.build_adf(ball, tolerance=1e-2, max_level=3)
    page = plan_view(field, "a").run()
    none, values = wrong_values(field, page)
    assert none == 0

    def one(array: np.ndarray) -> None:
        array.view(np.uint8)[0] ^= 1

    wrong = wrong_values(field, changed(page, name, one))[0]
    assert wrong == 1 if name != "cells" else 0 < wrong < values  # it may change where blocks are
