"""docs/formats.md says what the schemas of the HDF5 formats say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from voxtool.files import adf_hdf5, svo_hdf5, tet_hdf5
from voxtool.files.schema import Schema

DOCUMENT = Path(__file__).parents[2] / "docs" / "formats.md"
SECTIONS = {
    "## The octree": svo_hdf5.SCHEMA,
    "## The distance field": adf_hdf5.SCHEMA,
    "## The tetrahedral volume": tet_hdf5.SCHEMA,
}


@pytest.mark.parametrize("heading", SECTIONS)
def test_document_has_the_attributes_of_the_schema(heading: str) -> None:
    text, schema = section(heading), SECTIONS[heading]
    assert schema.table() in text, f"put this table into docs/formats.md:\n{schema.table()}"
    assert f"version {schema.version}" in text.partition("\n")[0]


@pytest.mark.parametrize("heading", SECTIONS)
def test_document_has_the_datasets_of_the_schema(heading: str) -> None:
    table = section(heading).partition("| dataset |")[2].partition("\n\n")[0]
    documented = dict(re.findall(r"^\| `(\w+)` \| (\w+)", table, re.MULTILINE))
    schema = SECTIONS[heading]
    sizes = {"m": 1, "r": 1, "depth": 1, "layout": "raycast"}
    expected = {d.name: d.type_for(sizes).name for d in schema.datasets}
    assert documented == expected


def section(heading: str) -> str:
    text = DOCUMENT.read_text(encoding="utf-8")
    start = text.index(heading)
    end = text.find("\n## ", start + 1)
    return text[start:end]


def test_a_free_side_names_itself() -> None:
    (voxels, cells, hashes, bounds) = adf_hdf5.SCHEMA.datasets
    assert voxels.shape_for({}) == (None, 3, 3, 3)
    assert bounds.shape_for({"n": 5}) == (5, 2, 2, 2)
    assert cells.shape_for({"m": 7}) == (7, 7, 7, (2, 3))
    assert hashes.type_for({"m": 255}) == np.uint8
    assert hashes.type_for({"m": 256}) == np.uint16
    assert isinstance(adf_hdf5.SCHEMA, Schema)
