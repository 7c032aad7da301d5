"""Files whose reading would take far more time or memory than their bytes: read in proportion, or
refused. Limits are lowered where they are large; times are not measured."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import voxtool
from voxtool.errors import FileError, GridError, MemoryLimitError, MeshError
from voxtool.files.meshes import obj
from voxtool.files.meshes.gltf_materials import Looks
from voxtool.files.storage import numbers, unpacked
from voxtool.files.tables.points import read_points

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


# ---- lines


def test_a_face_over_many_lines(tmp_path: Path) -> None:
    path, count = tmp_path / "a.obj", 3000
    for end in (b"\n", b"\r\n", b"\r"):
        face = b"f 1 2" + (b" 3\\" + end) * count + b" 2"
        path.write_bytes(TRIANGLE.replace(b"\n", end) + face + end)
        assert len(voxtool.load_mesh(path).faces) == count + 1


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.obj", TRIANGLE + b"f "),
        ("a.obj", TRIANGLE + b" f "),
        ("a.obj", TRIANGLE + b"f 1 2\\\n"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n500 "),
        ("a.stl", b"solid a\nvertex 0 0 "),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
            b"property float z\nelement face 1\nproperty list int int vertex_indices\n"
            b"end_header\n0 0 0\n1 0 0\n0 1 0\n500 ",
        ),
    ],
)
def test_a_line_that_is_too_long(
    name: str, head: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = b"2 3 1\\\n" * 200 if head.endswith(b"\\\n") else b"1 2 " * 400
    (tmp_path / name).write_bytes(head + lines + b"\nendsolid\n")
    for module in (numbers, obj):
        monkeypatch.setattr(module, "MOST_LINE", 1000)
    with pytest.raises(MeshError, match="of more than 0 MiB: split its face"):
        voxtool.load_mesh(tmp_path / name)


def test_a_word_of_many_digits(tmp_path: Path) -> None:
    """No pattern tries each of its digits as the end of a number: this would take hours."""
    word = b"1" * 500_000 + b"x"
    for name, content in {
        "a.obj": b"v 0 0 " + word,
        "a.off": b"OFF\n3 1 0\n0 0 " + word,
        "a.stl": b"solid a\nvertex 0 0 " + word + b"\nendsolid",
    }.items():
        (tmp_path / name).write_bytes(content + b"\n")
        with pytest.raises(MeshError, match="is not"):
            voxtool.load_mesh(tmp_path / name)
    (tmp_path / "a.csv").write_bytes(b"1,2," + word[-65_000:])
    with pytest.raises(FileError, match="is no number"):
        list(read_points(tmp_path / "a.csv"))


# ---- scenes


def test_scenes_larger_than_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = base64.b64encode(np.eye(3, dtype="<f4").tobytes()).decode()
    tree = {
        "buffers": [{"uri": f"data:;base64,{data}", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}] * 1000,
        "scenes": [{"nodes": list(range(1000))}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert len(voxtool.load_mesh(tmp_path / "a.gltf").vertices) == 3000
    monkeypatch.setattr(unpacked, "ANY_SIZE", 1000)
    monkeypatch.setattr(unpacked, "MOST_RATIO", 10)
    with pytest.raises(MemoryLimitError, match=r"its meshes take 361 kB, .* times the file's"):
        voxtool.load_mesh(tmp_path / "a.gltf")
    assert len(voxtool.load_mesh(tmp_path / "a.gltf", max_memory=1 << 20).vertices) == 3000


def test_textures_share_the_pixels_of_an_image() -> None:
    class Decoded(Looks):
        def _read(self, index: int) -> np.ndarray:
            self.decoded = [*getattr(self, "decoded", []), index]
            return np.full((2, 2, 4), 7, np.uint8)

    tree: Any = type("Tree", (), {"json": {"textures": [{"source": 0}] * 50}})
    looks = Decoded(tree, None)
    for opaque in (True, False):
        found = {id(looks._texture(index, opaque)) for index in range(50)}
        assert len(found) == 1
    assert looks.decoded == [0, 0]  # of which the pictures keep the second
    assert (looks._texture(3, True).pixels[..., 3] == 255).all()
    assert (looks._texture(3, False).pixels[..., 3] == 7).all()


# ---- voxels


def test_grids_that_float64_does_not_resolve(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones((8, 8, 8), np.uint8))
    assert voxtool.read_voxels(tmp_path / "a.npy", origin=(1e15, 0, 0)).count == 512
    wrong: list[dict[str, Any]] = [{"origin": (1e17, 0, 0)}, {"origin": (0, -1, 0), "pitch": 1e-17}]
    for more in wrong:
        with pytest.raises(GridError, match="too small for floating point"):
            voxtool.read_voxels(tmp_path / "a.npy", **more)


@pytest.mark.parametrize("name", ["a.nrrd", "a.gltf"])
def test_json_that_is_nested_without_end(name: str, tmp_path: Path) -> None:
    deep = b"[" * 100_000
    head = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 8 8 8\nencoding: raw\nvoxtool grid:="
    contents = {"a.nrrd": head + deep + b"\n\n" + bytes(512), "a.gltf": b'{"a":' + deep}
    (tmp_path / name).write_bytes(contents[name])
    read: Callable[..., Any] = voxtool.read_voxels if name == "a.nrrd" else voxtool.load_mesh
    if name == "a.nrrd":  # which has a place of its own
        assert read(tmp_path / name).count == 0
    else:
        with pytest.raises(MeshError, match="recursion depth"):
            read(tmp_path / name)


def test_element_sets_of_abaqus_are_passed_over(tmp_path: Path) -> None:
    """meshio would go through all blocks for each of them."""
    nodes = "*NODE\n1,0,0,0\n2,1,0,0\n3,0,1,0\n4,0,0,1\n"
    blocks = "".join(
        f"*ELEMENT, TYPE=C3D4, ELSET=e{n}\n{n},1,2,3,4\n*ELSET, ELSET=s{n}\n{n}\n"
        for n in range(1, 2000)
    )
    (tmp_path / "a.inp").write_text(nodes + blocks)
    with pytest.raises(FileError, match="holds no arrays, only cells"):
        voxtool.read_unstructured(tmp_path / "a.inp")
