"""A reader in another language can be written from docs/formats.md: its recipes in plain
Python, and its tables, which agree with the schemas."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.files import DATA, FIELDS, ROOT, deep_field, golden_field, golden_volume
from helpers.tets import assembly, built, linear

from voxtool import files
from voxtool.choices import LAYOUTS
from voxtool.files.cells import tet_hdf5
from voxtool.files.fields import adf_hdf5
from voxtool.files.octrees import svo_hdf5
from voxtool.files.storage.schema import CREATOR, FORMAT, FORMAT_VERSION, Attribute

DOCUMENT = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
SECTIONS = {
    "## The octree": svo_hdf5.SCHEMA,
    "## The distance field": adf_hdf5.SCHEMA,
    "## The tetrahedral volume": tet_hdf5.SCHEMA,
}


# Tables


def section(heading: str) -> str:
    start = DOCUMENT.index(heading)
    return DOCUMENT[start : DOCUMENT.find("\n## ", start + 1)]


def row(attribute: Attribute) -> str:
    """The attribute's row in the table of its format."""
    kinds = {int: "integer", float: "float64", bool: "integer", str: "text", dict: "JSON"}
    size = f" ≤ {attribute.size:,}" if attribute.stored is str else ""
    count = f"{attribute.size} " if not size and attribute.size > 1 else ""
    plural = "s" if count and attribute.stored is int else ""
    kind = f"{count}{kinds[attribute.kind]}{plural}{size}"
    return f"| `{attribute.name}` | {kind} | {attribute.meaning} |"


@pytest.mark.parametrize("heading", SECTIONS)
def test_tables_of_the_documents(heading: str) -> None:
    text, schema = section(heading), SECTIONS[heading]
    rows = [row(FORMAT).format(schema.format), row(FORMAT_VERSION).format(schema.version)]
    rows += map(row, (CREATOR, *schema.own))
    expected = "\n".join(["| attribute | type | meaning |", "| --- | --- | --- |", *rows])
    assert expected in text, f"put this table into docs/formats.md:\n{expected}"
    assert f"version {schema.version}" in text.partition("\n")[0]
    table = text.partition("| dataset |")[2].partition("\n\n")[0]
    documented = dict(re.findall(r"^\| `(\w+)` \| (\w+)", table, re.MULTILINE))
    sizes = {"m": 1, "layout": "raycast"}
    assert documented == {d.name: d.type_for(sizes).name for d in schema.datasets}


def test_table_of_merged_octrees() -> None:
    """Their attributes are those of the octree and one more."""
    text, schema = section("## The merged octree"), svo_hdf5.MERGED
    more = [a for a in schema.own if a.name not in {b.name for b in svo_hdf5.SCHEMA.own}]
    assert [row(a) in text for a in more] == [True]
    assert f"version {schema.version}" in text.partition("\n")[0]
    documented = dict(re.findall(r"^\| `(\w+)` \| (uint\w+)", text, re.MULTILINE))
    assert documented == {d.name: d.type_for({}).name for d in schema.datasets}


def test_merged_octrees() -> None:
    """The voxels that the section's recipe gives are those of the octree."""
    path = DATA / "v2.0.svo.h5"
    with h5py.File(path) as h5:
        starts, masks, stored, leaves = (
            h5[name][()].tolist()  # pyright: ignore
            for name in ("starts", "masks", "links", "leaves")
        )
        depth = int(h5.attrs["depth"])  # pyright: ignore
    tables, place = [], 0  # of each level, root first: eight numbers a subtree
    sizes = [*(b - a for a, b in itertools.pairwise(starts)), len(leaves)]
    for d in range(depth - 1):
        width = max(1, math.ceil(math.log(sizes[d + 1], 256)))
        tables.append([])
        for mask in masks[starts[d] : starts[d + 1]]:
            words = []
            for c in range(8):
                words.append(mask >> (8 + c) & 1)
                if mask >> c & 1:
                    link = int.from_bytes(bytes(stored[place : place + width]), "little")
                    words[-1], place = 2 + link, place + width
            tables[-1].append(words)
    assert place == len(stored)

    def voxels(d: int, word: int, low: tuple[int, ...]) -> set[tuple[int, ...]]:
        side = 4 << (depth - 1 - d)
        if word < 2:
            cube = itertools.product(range(side), repeat=3) if word else ()
            return {tuple(a + b for a, b in zip(low, xyz, strict=True)) for xyz in cube}
        half, found = side // 2, set()
        if d == depth - 1:
            for b in range(64):
                x, y, z = ((b >> a & 1) + 2 * (b >> (3 + a) & 1) for a in range(3))
                if leaves[word - 2] >> b & 1:
                    found.add((low[0] + x, low[1] + y, low[2] + z))
            return found
        for c, child in enumerate(tables[d][word - 2]):
            corner = tuple(low[a] + half * (c >> a & 1) for a in range(3))
            found |= voxels(d + 1, child, corner)
        return found

    expected = files.read_svo(DATA / "v1.0.svo.h5").occupied()
    assert voxels(0, 2, (0, 0, 0)) == set(map(tuple, expected.tolist()))


def test_offsets_of_a_large_hash_have_16_bits() -> None:
    hashes = next(d for d in adf_hdf5.SCHEMA.datasets if d.name == "hash")
    assert [hashes.type_for({"m": m}) for m in (255, 256)] == [np.uint8, np.uint16]


def head_of(line: str) -> bytes:
    """The JSON of a digest in the documents, by its first key."""
    (head,) = re.findall(rf"^\{{\"{line}\".*\}}$", DOCUMENT, re.MULTILINE)
    return head.encode()


def test_digest_of_volumes() -> None:
    path = DATA / "v1.0.tet.h5"
    sha = hashlib.sha256(head_of("constant"))
    with h5py.File(path) as h5:
        for dataset in ("vertices", "cells", "neighbours", "normals", "gradients", "ranges"):
            sha.update(h5[dataset][()].tobytes())  # pyright: ignore
    assert sha.hexdigest() == files.read_tet(path).digest()


def test_digest_of_fields() -> None:
    path = DATA / "v2.0.adf.h5"
    recipe = Recipe(path)
    blocks = sorted(recipe.pointers().items())
    sha = hashlib.sha256(head_of("band"))
    sha.update(struct.pack(f"<{len(blocks)}Q", *(identifier for identifier, _ in blocks)))
    for texture, side, kind in ((recipe.voxels, 3, "f"), (recipe.bounds, 2, "B")):
        for _, (x, y, z) in blocks:
            for dz, dy, dx in itertools.product(range(side), repeat=3):
                texel = texture[side * z + dz][side * y + dy][side * x + dx]
                sha.update(struct.pack(f"<{kind}", texel))
    assert sha.hexdigest() == files.read_adf(path).digest()


# Distance fields


class Recipe:
    """A field as a program in another language reads it."""

    def __init__(self, path: Path) -> None:
        with h5py.File(path) as h5:
            for name in ("depth", "m", "r", "side"):
                setattr(self, name, h5.attrs[name].item())
            self.origin = h5.attrs["origin"].tolist()
            self.voxels, self.cells, self.hash, self.bounds = (
                h5[name][()].tolist() if name in h5 else None
                for name in ("voxels", "cells", "hash", "bounds")
            )

    def point(self, world: list[float]) -> list[int]:
        u = [(x - o) / self.side for x, o in zip(world, self.origin, strict=True)]
        return [min(int(x * 2.0**32), 2**32 - 1) for x in u]

    def identifier(self, level: int, c: list[int]) -> int:
        code = 0
        for q in range(level):
            for axis in range(3):
                code |= (c[axis] >> q & 1) << (3 * q + axis)
        return 1 << (3 * level) | code

    def pointers(self) -> dict[int, tuple[int, ...]]:
        """The place of the block of each identifier."""
        found = {}
        for *words, pointer in itertools.chain(*itertools.chain(*self.cells)):
            if any(words):
                found[sum(word << 32 * i for i, word in enumerate(words))] = place(pointer)
        return found

    def block(self, level: int, c: list[int]) -> tuple[int, ...] | None:
        key = [2**level + a for a in c]
        x, y, z = (a % self.r for a in key)
        offset = self.hash[z][y][x]
        w = offset[3] if len(offset) == 4 else self.m
        hx, hy, hz = ((k % w + o) % self.m for k, o in zip(key, offset, strict=False))
        *words, pointer = self.cells[hz][hy][hx]
        stored = words[0] if len(words) == 1 else words[1] << 32 | words[0]
        return place(pointer) if stored == self.identifier(level, c) else None

    def leaf(self, p: list[int]) -> tuple[int, list[int], tuple[int, ...]]:
        """The level and the cell of the leaf, and the block that it is in."""
        found = (0, 0, 0)
        for level in range(self.depth):
            block = self.block(level, [a >> (32 - level) for a in p])
            if block is None:
                break
            found, last = block, level
        return last + 1, [a >> (31 - last) for a in p], found

    def distance(self, p: list[int]) -> float:
        level, leaf, block = self.leaf(p)
        x, y, z = (3 * b + (a & 1) for a, b in zip(leaf, block, strict=True))
        t = [((a << level) % 2**32 >> 8) * 2.0**-24 for a in p]
        v = [
            self.voxels[z + dz][y + dy][x + dx]
            for dz, dy, dx in itertools.product((0, 1), repeat=3)
        ]
        for axis in range(3):
            v = [
                rounded(a + rounded(t[axis] * rounded(b - a)))
                for a, b in zip(v[::2], v[1::2], strict=True)
            ]
        return v[0] * self.side

    def bound(self, p: list[int]) -> float:
        _, leaf, block = self.leaf(p)
        x, y, z = (2 * b + (a & 1) for a, b in zip(leaf, block, strict=True))
        code = self.bounds[z][y][x]
        assert code != 0
        return math.inf if code == 255 else 2 ** ((code - 254) / 8) * self.side


def place(pointer: int) -> tuple[int, ...]:
    return tuple(pointer >> shift & 1023 for shift in (0, 10, 20))


def rounded(value: float) -> float:
    """To float32; of a sum or product of two float32 in float64 that is rounded once."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


@pytest.mark.parametrize("name", FIELDS)
def test_recipe_of_fields(name: str, tmp_path: Path) -> None:
    field, path = FIELDS[name](), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    recipe = Recipe(path)
    rng = np.random.default_rng(1)
    u = np.concatenate(
        [
            rng.uniform(0, 1, (150, 3)),
            (0.3, 0.6, 0.7) + rng.normal(0, 1, (150, 3)) * np.exp2(-rng.uniform(2, 16, (150, 1))),
            np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=3))),
        ]
    )
    points = np.clip(u, 0, 1) * field.side + field.origin
    points = points[~field.query(points).outside]
    answer = field.query(points, bounds=field.bounds is not None, cell=True)
    assert answer.level is not None
    assert answer.cell is not None
    assert len(np.unique(answer.level)) > 2 or name in ("golden", "root")
    for i, world in enumerate(points.tolist()):
        p = recipe.point(world)
        level, cell, _ = recipe.leaf(p)
        assert (level, cell) == (answer.level[i], answer.cell[i].tolist())
        assert recipe.distance(p) == answer.distance[i]
        if answer.bound is not None:
            assert recipe.bound(p) == pytest.approx(answer.bound[i], rel=1e-12)


def test_recipe_of_the_places_of_blocks(tmp_path: Path) -> None:
    field, path = deep_field(), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    recipe = Recipe(path)
    found = recipe.pointers()
    ordered = sorted(found)
    assert len(ordered) == len({*found.values()}) == len(field.voxels)
    assert ordered[0] == 1
    assert {code >> 3 for code in ordered[1:]} <= {*ordered}
    reversed_places = [found[code][::-1] for code in ordered]  # z, y, x
    assert reversed_places == sorted(reversed_places)


def test_the_places_of_blocks_do_not_show_in_what_is_read(tmp_path: Path) -> None:
    field, path = golden_field(), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    with h5py.File(path, "r+") as file:
        h5: Any = file
        for name, side in (("voxels", 3), ("bounds", 2)):
            h5[name][...] = np.roll(h5[name][()], -side, axis=2)
        cells = h5["cells"][()]
        taken = cells[..., 0] != 0
        x = cells[taken, 1] & 1023
        cells[taken, 1] += (x + 2) % 3 - x
        h5["cells"][...] = cells
    assert files.read_adf(path) == field
    assert files.read_adf(path).digest() == field.digest()


# Tetrahedral volumes


def items(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The attributes of a volume, and its textures as lists of items: rows end to end, and those of
    cells and neighbours joined."""
    with h5py.File(path) as file:
        head: Any = {name: value.tolist() for name, value in file.attrs.items()}
        textures: dict[str, Any] = {name: data[()].tolist() for name, data in file.items()}
    counts = {"vertices": head["vertex_count"], "ranges": -(-head["cell_count"] // 64)}
    arrays = {}
    for name, texture in textures.items():
        count = counts.get(name, head["cell_count"])
        layers = texture if name in ("cells", "neighbours", "normals") else [texture]
        width = len(layers[0][0])
        assert width**2 >= count > (width // 2) ** 2 or width == count == 1
        found = [[layer[i // width][i % width] for i in range(count)] for layer in layers]
        assert not np.any(layers[0][-1][(count - 1) % width + 1 :])
        if name in ("cells", "neighbours"):
            found = [[list(itertools.chain(*parts)) for parts in zip(*found, strict=True)]]
        arrays[name] = found if name == "normals" else found[0]
    return head, arrays


def test_recipe_of_volumes(tmp_path: Path) -> None:
    """The scalar at a point of the mesh, found cell by cell."""
    path = tmp_path / "a.tet.h5"
    mesh = assembly((2, 2, 2), 3)
    for layout in ("raycast", "projection"):
        volume = built(mesh, layout)
        files.write_tet(volume, path)
        head, arrays = items(path)
        assert all(np.array_equal(arrays[name], a) for name, a in volume.arrays().items())
        low, high = head["scalar_range"]
        random = np.random.default_rng(0)
        for world in random.uniform(0, 2, (30, 3)).tolist():
            x = [(w - o) / head["scale"] for w, o in zip(world, head["origin"], strict=True)]
            cell = next(t for t in range(len(arrays["cells"])) if inside(arrays, layout, t, x))
            g = arrays["gradients"][cell]
            if layout == "raycast":
                s = sum(a * b for a, b in zip(g, x, strict=False)) + g[3]
            else:
                *anchor, s = arrays["vertices"][arrays["anchors"][cell][0]]
                s += sum(a * (b - c) for a, b, c in zip(g, x, anchor, strict=True))
            exact = linear(np.array([world]))[0]
            assert low + (high - low) * s == pytest.approx(exact, abs=1e-5)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_recipe_of_rows(layout: str) -> None:
    name = "v2.0" + f"-{layout}" * (layout != "raycast")
    _, arrays = items(DATA / f"{name}.tet.h5")
    expected = golden_volume(layout).arrays()
    assert arrays.keys() == expected.keys()
    for key, array in expected.items():
        assert np.array_equal(np.array(arrays[key], array.dtype), array), key


def inside(arrays: dict[str, Any], layout: str, cell: int, x: list[float]) -> bool:
    for face in range(4):
        n = arrays["normals"][face][cell]
        height = sum(a * b for a, b in zip(n, x, strict=False))
        if layout == "raycast":
            height += n[3]
        else:
            anchor = arrays["vertices"][arrays["anchors"][cell][face == 0]]
            height -= sum(a * b for a, b in zip(n, anchor, strict=False))
        if height > 1e-6:
            return False
    return True
