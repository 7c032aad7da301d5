"""Colours of surfaces, against dense arrays in exact fractions, and against other readers."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed, label_array, scattered, sizes
from helpers.octree import ball

import voxtool
from voxtool.choices import LABEL_STYLES, VOXEL_FACES
from voxtool.errors import FileError
from voxtool.files.formats import COLOUR_FORMATS
from voxtool.mesh import srgb
from voxtool.mesh.appearance import Material
from voxtool.mesh.topology import check_surface, closed_chain
from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.surface.isosurface import LATTICE
from voxtool.svo.surface.labelled import plan_labelled

REQUESTS = {
    "faces": {"style": "voxel-faces"},
    "faces of bricks": {"style": "voxel-faces", "level": 0},
    "nets": {"style": "surface-nets"},
    "cubes": {},
    "cubes of voxels": {"level": "voxel"},
}
BLANK = (1, 2, 3, 4)


def coloured(octree: Octree, share: float, whole: bool, seed: int = 5) -> Octree:
    """The octree with random colours, of a share of the voxels in bricks; some are transparent."""
    rng = np.random.default_rng(seed)
    voxels, leaves = sizes(octree)
    bits = rng.random((len(octree.bricks), 64)) < share
    masks = octree.bricks & np.packbits(bits, axis=1, bitorder="little").view("<u8")[:, 0]
    n = voxels if whole else int(np.bitwise_count(masks).sum())
    values = rng.integers(0, 256, (n + leaves, 4)).astype(np.uint8)
    values[::9, 3] = 0
    of_leaves = values[n:] if whole else values[:0]
    return replace(
        octree,
        attributes=(
            Attribute("colour", values[:n], of_leaves, None if whole else masks, default=BLANK),
        ),
    )


OCTREES = {
    "all voxels": lambda: coloured(scattered(), 1, True),
    "some voxels": lambda: coloured(scattered(), 0.4, False),
    "few voxels": lambda: coloured(scattered(), 0.004, False),
    "no voxel": lambda: coloured(scattered(), 0, False),
    "a ball": lambda: coloured(Octree.from_dense(ball((24, 21, 20))), 0.5, False),
}


def dense_of(octree: Octree) -> tuple[np.ndarray, np.ndarray]:
    """The colours of voxels in a cube, 0 where there is none, and which have their own."""
    colour, side = octree.attribute("colour"), octree.grid.side
    values, own = np.zeros((side,) * 3 + (4,), np.uint8), np.zeros((side,) * 3, bool)
    leaves = iter(colour.leaves)
    for level in octree.levels():
        if level.number:
            for x, y, z in level.cells[level.inside] if len(colour.leaves) else ():
                place = tuple(slice(n, n + level.side) for n in (x, y, z))
                values[place], own[place] = next(leaves), True
        else:
            at = 4 * morton_decode(level.codes)[:, None] + morton_decode(np.arange(64))
            held = colour.held(octree.bricks)
            bits = held[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1) == 1
            place = tuple(at[bits].T)
            values[place], own[place] = colour.values, True
    return values, own


class Oracle:
    """The colours of points, by the rule, one at a time."""

    def __init__(self, octree: Octree, side: int) -> None:
        self.values, self.own = dense_of(octree)
        self.voxels, self.side = np.argwhere(self.own), side
        table = [int(light) for light in srgb.linear_table()]
        self.light = lambda rgba: [*(table[n] for n in rgba[:3]), int(rgba[3])]

    def cell(self, at: tuple[int, ...]) -> np.ndarray | None:
        """The mean of a cell's coloured voxels, or None if it has no colour."""
        if min(at) < 0 or max(at) * self.side >= len(self.own):
            return None
        place = tuple(slice(n * self.side, (n + 1) * self.side) for n in at)
        values = self.values[place][self.own[place]]
        if not len(values):
            return None
        sums = [sum(column) for column in zip(*map(self.light, values), strict=True)]
        found = rounded([Fraction(n, len(values)) for n in sums])
        return found if found[3] else None

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """The colour of the nearest coloured voxel; `point` in 1 / LATTICE of a cell."""
        if not len(self.voxels):
            return np.array(BLANK)
        twice = 2 * point * (self.side / LATTICE)
        away = 2 * self.voxels + 1 - twice
        return self.values[tuple(self.voxels[np.argmin((away * away).sum(axis=1))])]

    def vertex(self, point: np.ndarray) -> np.ndarray:
        low, rest = np.divmod(point - LATTICE // 2, LATTICE)
        sums, total = [0, 0, 0, 0], 0
        for corner in product((0, 1), repeat=3):
            found = self.cell(tuple((low + corner).tolist()))
            weight = 1
            for one, part in zip(corner, rest.tolist(), strict=True):
                weight *= part if one else LATTICE - part
            if found is not None:
                total += weight
                sums = [n + weight * m for n, m in zip(sums, self.light(found), strict=True)]
        return rounded([Fraction(n, total) for n in sums]) if total else self.nearest(point)

    def face(self, corners: np.ndarray) -> np.ndarray:
        p, q = corners[1] - corners[0], corners[2] - corners[0]
        normal = np.sign(np.cross(p, q))
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        behind = np.floor(middle / LATTICE - normal / 2).astype(int)
        found = self.cell(tuple(behind.tolist()))
        return self.nearest(middle) if found is None else found


def rounded(means: list[Fraction]) -> np.ndarray:
    """Light and opacity as the nearest levels."""
    light = srgb.to_levels(np.array([n.__floor__() for n in means[:3]]))
    return np.array([*light, (means[3] + Fraction(1, 2)).__floor__()], np.uint8)


def extracted(octree: Octree, request: str, device) -> Any:
    found = plan_extract(octree, device=device, **REQUESTS[request]).run()
    assert found.colours is not None
    return found


@pytest.mark.parametrize("request_", REQUESTS)
@pytest.mark.parametrize("name", OCTREES)
def test_against_exact_fractions(device, name: str, request_: str) -> None:
    octree = OCTREES[name]()
    surface = extracted(octree, request_, device)
    oracle = Oracle(octree, surface.side)
    of_faces = surface.style == "voxel-faces"
    rows = surface.faces if of_faces else surface.points
    assert surface.colours.shape == (len(rows), 4)
    for n in np.random.default_rng(6).permutation(len(rows))[:150]:
        wanted = oracle.face(surface.points[rows[n]]) if of_faces else oracle.vertex(rows[n])
        assert surface.colours[n].tolist() == wanted.tolist(), (n, rows[n])
    bare = plan_extract(octree, device=device, **REQUESTS[request_]).with_(colours=False).run()
    assert bare.colours is None
    assert bare.digest() == replace(surface, colours=None).digest() != surface.digest()


@pytest.mark.parametrize("style", LABEL_STYLES)
def test_meshes_of_labels(device, style: str) -> None:
    """Each mesh has colours of its own label's voxels, where vertices have such around them."""
    octree = replace(attributed(), attributes=attributed().attributes[:2])
    surface = plan_labelled(octree, style=style, device=device).run()
    oracle, labels = Oracle(octree, 1), label_array(octree)
    for label, colours in zip(surface.labels, surface.colours, strict=True):
        faces = surface.faces_of(label)
        own = Oracle(octree, 1)
        within = tuple(slice(n) for n in labels.shape)
        own.own[within] &= labels == label
        rows = faces if style == VOXEL_FACES else np.unique(faces)
        assert len(colours) == len(rows)
        for n in np.random.default_rng(7).permutation(len(rows))[:80]:
            if style == VOXEL_FACES:
                wanted = oracle.face(surface.points[rows[n]])
            else:
                wanted = own.vertex(surface.points[rows[n]])
            assert colours[n].tolist() == wanted.tolist()
        mesh = surface.mesh(label)
        assert closed_chain(mesh)
        assert mesh.colours is not None
    bare = plan_labelled(octree, style=style).with_(colours=False).run()
    assert bare.colours == ()
    assert bare.digest() == replace(surface, colours=()).digest() != surface.digest()


def test_plan(device) -> None:
    octree = OCTREES["all voxels"]()
    job = plan_extract(octree, style="voxel-faces", device=device)
    assert job.plan.stages[-1] == "colours"
    assert "colours" not in job.plan.left_out
    merged = plan_extract(octree, style="voxel-faces", merge=True, device=device)
    assert merged.plan.left_out["colours"] == "squares of several colours are merged"
    assert "colours are left out: squares" in list(merged.notes(merged.run()))[-1]
    plain = plan_extract(scattered(), style="voxel-faces", device=device)
    assert "colours" not in plain.plan.left_out
    assert plain.run().colours is None


def test_vertices_of_voxel_faces_are_repeated_for_each_colour(device) -> None:
    """The mesh is closed where equal positions are one, and each triangle has its own colour."""
    surface = extracted(OCTREES["some voxels"](), "faces", device)
    mesh, origin = surface.coloured()
    assert len(mesh.vertices) > len(surface.points)
    assert np.array_equal(origin[mesh.faces], surface.faces)
    assert np.array_equal(mesh.vertices, surface.vertices[origin])
    assert check_surface(mesh).closed
    bytes_ = srgb.to_levels(np.rint(mesh.colours[:, :3] * srgb.ONE).astype(np.int64))
    assert np.array_equal(bytes_[mesh.faces], np.repeat(surface.colours[:, None, :3], 3, axis=1))
    keys = np.concatenate([origin[:, None], bytes_, np.rint(mesh.colours[:, 3:] * 255)], axis=1)
    assert len(np.unique(keys, axis=0)) == len(mesh.vertices)


@pytest.mark.parametrize("request_", ["faces", "nets"])
@pytest.mark.parametrize("with_normals", [False, True])
def test_files(device, request_: str, with_normals: bool, tmp_path: Path) -> None:
    """Trimesh reads the bytes of .ply and .obj, and the linear light of .glb beside its material;
    voxtool reads them all as they were."""
    trimesh = pytest.importorskip("trimesh")
    surface = extracted(OCTREES["some voxels"](), request_, device)
    mesh, origin = surface.coloured()
    normals = surface.normals if with_normals else None
    wanted = np.empty((len(mesh.vertices), 4), np.uint8)
    if request_ == "faces":
        wanted[mesh.faces] = surface.colours[:, None]
    else:
        wanted[:] = surface.colours
    linear = np.column_stack([srgb.linear_table()[wanted[:, :3]] / srgb.ONE, wanted[:, 3] / 255])
    for kind in COLOUR_FORMATS:
        path = tmp_path / f"a.{kind}"
        voxtool.write_mesh(surface, path, normals=normals)
        read = trimesh.load(path, process=False, maintain_order=True)
        if kind == "glb":
            (read,) = read.geometry.values()
            assert np.array_equal(read.visual.vertex_attributes["color"], linear.astype("f4"))
            assert read.visual.material.alphaMode == "BLEND"
        else:
            channels = 3 if kind == "obj" else 4
            assert np.array_equal(read.visual.vertex_colors[:, :channels], wanted[:, :channels])
        assert np.allclose(read.vertices, mesh.vertices, rtol=0, atol=1e-5)
        assert np.array_equal(read.faces, mesh.faces)
        if with_normals and kind == "glb":
            assert np.allclose(read.vertex_normals, surface.normals[origin], atol=1e-6)
        own = voxtool.load_mesh(path, keep=("appearance",)).colours
        assert own is not None
        back = srgb.to_levels(np.rint(own[:, :3] * srgb.ONE).astype(np.int64))
        assert np.array_equal(back, wanted[:, :3]), kind
        if kind != "obj":
            assert np.array_equal(np.rint(own[:, 3] * 255), wanted[:, 3])


def test_meshio_reads_the_colours_of_ply(device, tmp_path: Path) -> None:
    """It takes bytes for signed ones."""
    meshio = pytest.importorskip("meshio")
    surface = extracted(OCTREES["all voxels"](), "nets", device)
    voxtool.write_mesh(surface, tmp_path / "a.ply")
    found = meshio.read(tmp_path / "a.ply").point_data
    names = ("red", "green", "blue", "alpha")
    assert np.array_equal(
        np.stack([found[name] for name in names], axis=1).view(np.uint8), surface.colours
    )


def test_other_formats_have_the_surface_without(device, tmp_path: Path) -> None:
    surface = extracted(OCTREES["all voxels"](), "faces", device)
    for kind in ("stl", "off"):
        voxtool.write_mesh(surface, tmp_path / f"a.{kind}")
        voxtool.write_mesh(replace(surface, colours=None), tmp_path / f"b.{kind}")
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    with pytest.raises(FileError, match="holds no vertex normals"):
        voxtool.write_mesh(surface, tmp_path / "a.stl", normals=surface.normals)


def test_colours_of_a_mesh_are_written_unless_materials_multiply_them(tmp_path: Path) -> None:
    surface = voxtool.extract(OCTREES["all voxels"](), style="surface-nets")
    voxtool.write_mesh(surface, tmp_path / "a.ply")
    mesh: Any = voxtool.load_mesh(tmp_path / "a.ply", keep=("appearance",))
    voxtool.write_mesh(mesh, tmp_path / "b.glb")
    again: Any = voxtool.load_mesh(tmp_path / "b.glb", keep=("appearance",))
    assert np.allclose(again.colours, mesh.colours, atol=1e-7)
    red = Material("red", (1.0, 0.0, 0.0, 1.0))
    look = replace(again.appearance, materials=(red,))
    voxtool.write_mesh(replace(again, appearance=look), tmp_path / "c.ply")
    assert b"red" not in (tmp_path / "c.ply").read_bytes()
