"""Parts, materials, textures and colours of meshes: as files state them, and what is refused."""

from __future__ import annotations

import base64
import io
import json
import os
import random
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import lib3mf
import numpy as np
import pytest
import trimesh
from helpers import meshes
from PIL import Image

from voxtool import load_mesh
from voxtool.errors import MemoryLimitError, MeshError, MeshWarning
from voxtool.files.meshes import obj, pixels
from voxtool.files.meshes.mesh import KEPT
from voxtool.mesh import srgb
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import Mesh

EXAMPLES = Path(__file__).parents[3] / "examples"
sys.path.insert(0, str(EXAMPLES))
import make_parts  # noqa: E402

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def picture(colour: tuple[int, ...] = (255, 0, 0), kind: str = "PNG", mode: str = "RGB") -> bytes:
    file = io.BytesIO()
    Image.new(mode, (4, 2), colour).save(file, kind)
    return file.getvalue()


def read_obj(folder: Path, text: str, **files: str | bytes) -> Mesh:
    """The mesh of an OBJ beside other files, whose names end after __."""
    for name, content in files.items():
        data = content.encode() if isinstance(content, str) else content
        (folder / name.replace("__", ".")).write_bytes(data)
    (folder / "a.obj").write_text(text)
    return load_mesh(folder / "a.obj", keep=KEPT)


def look_of(mesh: Mesh) -> Appearance:
    assert mesh.appearance is not None
    return mesh.appearance


def refusal(folder: Path, *args: Any, **files: Any) -> str:
    with pytest.raises(MeshError) as caught:
        read_obj(folder, *args, **files)
    assert str(caught.value).isprintable()
    return str(caught.value)


# ---- sRGB


def test_tables_of_srgb() -> None:
    """Against the formula in float64, and each level comes back."""
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    table = srgb.linear_table()
    assert np.abs(table / srgb.ONE - linear).max() < 1.0001 / srgb.ONE
    assert (np.diff(table) > 0).all()
    assert table[[0, 255]].tolist() == [0, srgb.ONE]
    assert srgb.to_levels(table).tolist() == list(range(256))
    assert np.array_equal(srgb.to_linear(np.arange(256, dtype=np.uint8)), table / srgb.ONE)
    near = srgb.level_bounds()
    assert srgb.to_levels(near - 1).tolist() == list(range(255))


# ---- OBJ


def test_parts_of_an_obj(tmp_path: Path) -> None:
    text = (
        f"{SQUARE}f 1 2 3\no one\ng left  half\nusemtl red\nf 1 2 3 4\no two\nf 1 2 3\n"
        "g right\nusemtl blue\nf 3 4 1\ng left half\nf 2 3 4\ng unused\n"
    )
    parts = read_obj(tmp_path, text).parts
    assert parts["object"].names == ("", "one", "two")
    assert parts["object"].labels.tolist() == [0, 1, 1, 2, 2, 2]  # a square has two triangles
    assert parts["part"].names == ("", "left half", "right")
    assert parts["part"].labels.tolist() == [0, 1, 1, 1, 2, 1]
    assert parts["material"].names == ("", "red", "blue")
    assert parts["material"].labels.tolist() == [0, 1, 1, 1, 2, 2]
    plain = load_mesh(tmp_path / "a.obj")
    assert plain.parts == {}
    assert plain.appearance is None
    objects = read_obj(tmp_path, f"{SQUARE}o one\nf 1 2 3\n")
    assert objects.parts["part"].names == ("one",)
    assert read_obj(tmp_path, f"{SQUARE}f 1 2 3\n").parts == {}


def test_a_textured_obj(tmp_path: Path) -> None:
    library = (
        "newmtl pale # a comment\nKd 1 0.5 0\nd 0.25\nnewmtl dark wood\nKd 0 0 0\n"
        "map_Kd -clamp on -s 2 4 -o 0.5 0 my wood.png\nnewmtl both\nTr 0.25\nmap_Kd sub\\b.jpg\n"
    )
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "b.jpg").write_bytes(picture(kind="JPEG"))
    text = (
        f"mtllib my library.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1 9\nvt 0.5\n"
        "usemtl pale\nf 1/1 2/2 3/3\n"
        "usemtl dark wood\nf 1/1 2/2 3/3 4/-1\nusemtl both\nf 1/1/1 2//2 3/3/3\n"
        "f 1/1/1 2/2/2 3/3/3\n"
    )
    (tmp_path / "my wood.png").write_bytes(picture((255, 0, 0)))
    (tmp_path / "my library.mtl").write_text(library)
    look = look_of(read_obj(tmp_path, text))
    named = [look.materials[number].name for number in look.material]
    assert named == ["pale", "dark wood", "dark wood", "both", "both"]
    pale, wood, _, plain, both = (look.materials[number] for number in look.material)
    half = float(srgb.to_linear(np.array(0.5)))
    assert half == pytest.approx(((0.5 + 0.055) / 1.055) ** 2.4, abs=1e-5)  # between two levels
    assert pale.colour == (1.0, half, 0.0, 0.25)
    assert pale.texture is None
    assert wood.colour == (1.0, 1.0, 1.0, 1.0)  # the texture takes the place of Kd
    assert wood.texture is not None
    assert wood.texture.wrap == ("clamp", "clamp")
    assert wood.texture.pixels.shape == (2, 4, 4)
    assert wood.texture.pixels[0, 0].tolist() == [255, 0, 0, 255]
    assert plain.texture is None  # a corner without coordinates
    assert both.texture is not None
    assert both.texture.wrap == ("repeat", "repeat")
    assert both.colour[3] == 0.75
    assert look.uv is not None
    assert look.uv[0].tolist() == [[0, 1], [1, 1], [1, 0]]  # v down
    assert look.uv[2].tolist() == [[0.5, 1], [2.5, -3], [1.5, 1]]  # scaled; the last is vt 0.5


def test_colours_of_vertices_in_an_obj(tmp_path: Path) -> None:
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0.2 0 7\nf 1 2 3\n"
    look = look_of(read_obj(tmp_path, text))
    assert look.colours is not None
    assert look.colours[0].tolist() == [1, 0, 0, 1]
    assert look.colours[2].tolist() == [srgb.linear_table()[51] / srgb.ONE, 0, 1, 1]
    assert read_obj(tmp_path, text.replace(" 0 1 0\n", "\n", 1)).appearance is None


def random_obj(seed: int) -> bytes:
    """Statements of all kinds in any order, with references forwards and back."""
    rng = random.Random(seed)
    rows, points, coordinates = [], 0, 0
    for _ in range(60):
        kind = rng.choice(["v", "vt", "f", "f", "f", "g", "o", "usemtl", "vn", "s"])
        if kind == "v" or points < 3:
            rows.append(f"v {rng.random():.3f} {rng.randrange(9)} {rng.random():.2e}")
            points += 1
        elif kind == "vt" or coordinates < 3:
            rows.append(f"vt {rng.random():.4f} {rng.random():.1f}"[: rng.choice([9, 99])])
            coordinates += 1
        elif kind == "f":
            corners = []
            for _ in range(rng.choice([1, 2, 3, 3, 4, 6])):
                v = rng.choice([rng.randrange(1, points + 1), -rng.randrange(1, points + 1)])
                t = rng.choice(
                    [rng.randrange(1, coordinates + 1), -rng.randrange(1, coordinates + 1)]
                )
                corners.append(rng.choice([f"{v}", f"{v}/{t}", f"{v}//1", f"{v}/{t}/-1"]))
            rows.append(rng.choice(["f ", "f\t"]) + rng.choice([" ", "  "]).join(corners))
        else:
            rows.append(f"{kind} {rng.choice(['a', 'b c', '1', ''])}")
    return ("\n".join(rows) + "\n").encode()


@pytest.mark.parametrize("seed", range(40))
def test_both_readers_of_obj_agree(seed: int) -> None:
    data = random_obj(seed)
    vertices, faces, said = obj._by_line("m", data, True)
    for size in (1, 150, 1 << 20):
        for end in (b"\n", b" \r\n"):
            again = obj._quick(data.replace(b"\n", end), True, size)
            assert np.array_equal(again[0], vertices)
            assert np.array_equal(again[1], faces)
            assert said is not None
            assert again[2] is not None
            assert again[2].begun == said.begun
            assert np.array_equal(again[2].uv, said.uv)
            assert np.array_equal(again[2].corners, said.corners)


def test_ten_thousand_materials(tmp_path: Path) -> None:
    n = 10_000
    library = "".join(f"newmtl m{i}\nKd {i / n} 0 0\nmap_Kd t.png\n" for i in range(n))
    faces = "".join(f"usemtl m{i}\nf 1/1 2/2 3/3\n" for i in range(n))
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 0 1\n{faces}"
    mesh = read_obj(tmp_path, text, a__mtl=library, t__png=picture())
    look = look_of(mesh)
    assert len(mesh.parts["material"].names) == n
    assert [look.materials[i].name for i in look.material] == [f"m{i}" for i in range(n)]
    assert len({id(one.texture) for one in look.materials if one.texture}) == 1


TEXTURED = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"


@pytest.mark.parametrize(
    ("library", "message"),
    [
        (
            "map_Kd none.png",
            "texture 'none.png' is missing: put it into the folder of the mesh, or",
        ),
        ("map_Kd /etc/passwd", "texture '/etc/passwd' is not in the folder of the mesh"),
        ("map_Kd ..\\\\other.png", "is not in the folder of the mesh"),
        ("map_Kd x/../../other.png", "is not in the folder of the mesh"),
        ("map_Kd http://example.org/a.png", "is not in the folder of the mesh"),
        ("map_Kd C:\\a.png", "is not in the folder of the mesh"),
        ("map_Kd folder", "texture 'folder' "),
        ("map_Kd pipe", "texture 'pipe' is no file"),
        ("map_Kd link", "texture 'link' is a link that leaves the folder of the mesh"),
        ("map_Kd a.gif", "texture 'a.gif': not readable as PNG or JPEG"),
        ("map_Kd a.obj", "texture 'a.obj': not readable as PNG or JPEG"),
        ("map_Kd -clamp on", "a.mtl, line 2: map_Kd names no picture"),
        ("Kd 1 nan 0", "a.mtl, line 2: 'nan' is not a number"),
        ("Kd 1 0", "a.mtl, line 2: Kd has not 3 numbers"),
        ("Kd spectral a.rfl", "a.mtl, line 2: Kd is not red, green and blue"),
        ("d x", "a.mtl, line 2: 'x' is not a number"),
    ],
)
def test_libraries_that_are_refused(library: str, message: str, tmp_path: Path) -> None:
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "folder").mkdir()
    (tmp_path / "other.png").write_bytes(picture())
    (folder / "link").symlink_to(tmp_path / "other.png")
    os.mkfifo(folder / "pipe")
    (folder / "a.gif").write_bytes(picture(kind="GIF"))
    assert message in refusal(folder, TEXTURED, a__mtl=f"newmtl m\n{library}\n")


def test_other_faults_of_an_obj(tmp_path: Path) -> None:
    message = refusal(tmp_path, TEXTURED)
    assert "material library 'a.mtl' is missing: put it into the folder of the mesh" in message
    library = "newmtl m\nmap_Kd t.png\n"
    files = {"a__mtl": library, "t__png": picture()}
    assert read_obj(tmp_path, TEXTURED, **files).appearance is not None
    nan = TEXTURED.replace("vt 1 0", "vt nan 0")
    assert "line 7: coordinate 'nan' is not finite" in refusal(tmp_path, nan, **files)
    far = TEXTURED.replace("vt 1 0", "vt 1e9 0")
    assert "a texture coordinate of face 0 is not finite, or beyond" in refusal(
        tmp_path, far, **files
    )
    beyond = TEXTURED.replace("3/3", "3/4")
    assert "names texture coordinate 4 where there are 3" in refusal(tmp_path, beyond, **files)
    with pytest.warns(
        MeshWarning, match=r"material 'x' is in none .* \(1 in all\): such faces are"
    ):
        look = look_of(read_obj(tmp_path, TEXTURED.replace("usemtl m", "usemtl x"), **files))
    assert look.materials[look.material[0]].colour == (1, 1, 1, 1)
    with pytest.raises(
        MeshError, match="is another file, and a stream has no folder: give the path"
    ):
        load_mesh(io.BytesIO(TEXTURED.encode()), "obj", keep=KEPT)
    assert load_mesh(io.BytesIO(TEXTURED.encode()), "obj", keep=("parts",)).parts
    with pytest.raises(MeshError, match="keep 'colours' is unknown: choose of parts, appearance"):
        load_mesh(tmp_path / "a.obj", keep=("colours",))


# ---- pictures


@pytest.mark.parametrize(
    ("mode", "kind", "colour", "expected"),
    [
        ("RGB", "PNG", (10, 20, 30), [10, 20, 30, 255]),
        ("RGBA", "PNG", (10, 20, 30, 40), [10, 20, 30, 40]),
        ("L", "PNG", 77, [77, 77, 77, 255]),
        ("LA", "PNG", (77, 9), [77, 77, 77, 9]),
        ("1", "PNG", 1, [255, 255, 255, 255]),
        ("P", "PNG", 0, [0, 0, 0, 255]),
        ("I;16", "PNG", 77 * 257, [77, 77, 77, 255]),
        ("L", "JPEG", 128, [128, 128, 128, 255]),
    ],
)
def test_pixels_of_every_kind(mode: str, kind: str, colour: Any, expected: list[int]) -> None:
    found = pixels.Pictures(None).read("a", picture(colour, kind, mode))
    assert found.shape == (2, 4, 4)
    assert found.dtype == np.uint8
    assert (found == expected).all()


def png_of(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_pictures_that_are_refused() -> None:
    pictures = pixels.Pictures(10_000_000)
    for size, message in (
        ((20000, 20000), "exceeds limit"),
        ((12000, 12000), "bytes can hold: make it smaller"),
        ((20000, 1), "more than 16384 a side"),
    ):
        width, height = size
        with pytest.raises(MeshError, match=message):
            pictures.read("a", png_of(width, height, zlib.compress(b"")))
    large = png_of(1000, 1000, zlib.compress(bytes(3001 * 1000)))
    with pytest.raises(
        MemoryLimitError, match="a: the pixels of all textures need 16 MB and 10 MB"
    ):
        pictures.read("a", large)
    with pytest.raises(MeshError, match="not readable as PNG or JPEG"):
        pixels.Pictures(None).read("a", picture()[:-30])
    several = pixels.Pictures(400)
    several.read("a", picture((1, 2, 3)))
    several.read("a", picture((1, 2, 3)))  # the same, so once
    several.read("a", picture((1, 2, 4)))
    several.read("a", picture((1, 2, 5)))
    with pytest.raises(MemoryLimitError):
        several.read("a", picture((1, 2, 6)))


# ---- glTF

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (2, 2, 2)], "<f4")


def data_uri(data: bytes, kind: str = "application/octet-stream") -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def gltf(primitive: dict[str, Any], arrays: list[np.ndarray], **more: Any) -> dict[str, Any]:
    """A glTF of one primitive, whose accessors are the arrays."""
    codes = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
    data, views, accessors = b"", [], []
    for array in arrays:
        rows = array if array.ndim == 2 else array[:, None]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[rows.shape[1]]
        accessors.append({
            "bufferView": len(views) - 1, "componentType": codes[array.dtype.str[1:]],
            "count": len(rows), "type": kind, "normalized": array.dtype == np.uint8,
        })  # fmt: skip
        data += array.tobytes() + bytes(-array.nbytes % 4)
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": data_uri(data), "byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        **more,
    }


def read_gltf(tree: dict[str, Any], keep: tuple[str, ...] = KEPT) -> Mesh:
    return load_mesh(io.BytesIO(json.dumps(tree).encode()), "gltf", keep=keep)


FOUR = CORNERS[:4]
UV = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], "<f4")


def textured(**more: Any) -> dict[str, Any]:
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1, "TEXCOORD_1": 2, "COLOR_0": 3},
                 "mode": 5, "material": 0}  # fmt: skip
    colours = np.array([(255, 0, 51, 128)] * 4, "u1")
    texture = {"index": 0, "texCoord": 1}
    return gltf(
        primitive,
        [FOUR, UV, 2 * UV, colours],
        **{
            "materials": [{"name": "m", "pbrMetallicRoughness": {
                "baseColorTexture": texture, "baseColorFactor": [0.5, 0.25, 1, 0.5]}}],
            "textures": [{"source": 0, "sampler": 0}],
            "samplers": [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}],
            "images": [{"uri": data_uri(picture((1, 2, 3, 4), mode="RGBA"), "image/png")}],
            **more,
        },
    )  # fmt: skip


def test_a_textured_gltf() -> None:
    mesh = read_gltf(textured())
    look = look_of(mesh)
    (material,) = look.materials
    assert material.name == "m"
    assert material.colour == (0.5, 0.25, 1.0, 1.0)  # opaque
    assert material.texture is not None
    assert material.texture.wrap == ("clamp", "mirror")
    assert material.texture.filter == "nearest"
    assert (material.texture.pixels == [1, 2, 3, 255]).all()
    assert look.uv is not None
    assert look.colours is not None
    assert np.array_equal(look.uv, (2 * UV).astype(float)[mesh.faces])  # of TEXCOORD_1
    assert look.colours[0].tolist() == [1, 0, 0.2, 1]
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    blended = textured()
    blended["materials"][0]["alphaMode"] = "BLEND"
    del blended["samplers"][0]["magFilter"]
    moved = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [1, 2], "texCoord": 0}}
    blended["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = moved
    look = look_of(read_gltf(blended))
    assert look.materials[0].colour[3] == 0.5
    assert look.materials[0].texture is not None
    assert look.colours is not None
    assert look.materials[0].texture.filter == "linear"
    assert (look.materials[0].texture.pixels == [1, 2, 3, 4]).all()
    assert look.colours[0, 3] == 128 / 255
    assert look.uv is not None
    assert look.uv[1].tolist() == [[1.5, 0], [1.5, 2], [0.5, 2]]


def test_a_gltf_whose_mesh_has_no_coordinates() -> None:
    tree = textured()
    del tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"]
    look = look_of(read_gltf(tree))
    assert look.materials[0].texture is None
    assert look.uv is None


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("images", 0, "uri"), "http://example.org/a.png", "is not in the folder of the mesh"),
        (("images", 0, "uri"), "file:///etc/passwd", "is not in the folder of the mesh"),
        (("images", 0, "uri"), "%2e%2e/a.png", "is not in the folder of the mesh"),
        (("images", 0, "uri"), "a%00.png", "is not in the folder of the mesh"),
        (("images", 0, "uri"), "a.png", "a stream has no folder"),
        (("images", 0, "uri"), data_uri(b"hello"), "texture '0': not readable as PNG or JPEG"),
        (("images", 0, "uri"), "data:image/png;base64,x", "base64 is damaged"),
        (("images", 0), {"bufferView": 99}, "not readable as GLTF"),
        (("textures", 0), {}, "texture 0 is no PNG or JPEG"),
        (("samplers", 0, "wrapS"), 7, "not readable as GLTF"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorFactor"), [1], "not readable as GLTF"),
        (("meshes", 0, "primitives", 0, "material"), -1, "there is no material -1"),
        (("meshes", 0, "primitives", 0, "material"), 1, "there is no material 1|list index"),
        (("accessors", 2, "count"), 3, "does not fit 4 vertices"),
        (("accessors", 0, "byteOffset"), -4, "has a size below 0"),
        (("bufferViews", 0, "byteLength"), 400, "buffer 0 ends before"),
        (("bufferViews", 0, "byteStride"), 1, "has a size below 0"),
        (("nodes",), [{"mesh": 0, "children": [0]}], "node 0 is in the scene twice"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "packed by KHR_draco"),
    ],
)
def test_gltf_that_is_refused(path: tuple[Any, ...], value: Any, message: str) -> None:
    tree = textured()
    place: Any = tree
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    with pytest.raises(MeshError, match=message) as caught:
        read_gltf(tree)
    assert str(caught.value).isprintable()


def test_coordinates_that_are_nan() -> None:
    tree = textured()
    uv = UV.copy()
    uv[3, 1] = np.nan
    named = gltf(
        tree["meshes"][0]["primitives"][0], [FOUR, UV, uv, np.array([(0, 0, 0, 0)] * 4, "u1")]
    )
    with pytest.raises(MeshError, match="texture coordinate of face 1 is not finite"):
        read_gltf(tree | {name: named[name] for name in ("buffers", "bufferViews", "accessors")})
    assert read_gltf(tree, ()).appearance is None


def test_files_beside_a_gltf(tmp_path: Path) -> None:
    tree = textured(images=[{"uri": "my%20tex/a.png"}])
    buffer = tree["buffers"][0].pop("uri")
    tree["buffers"][0]["uri"] = "a.bin"
    (tmp_path / "a.bin").write_bytes(base64.b64decode(buffer.partition(",")[2]))
    (tmp_path / "my tex").mkdir()
    (tmp_path / "my tex" / "a.png").write_bytes(picture((9, 8, 7)))
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    look = look_of(load_mesh(tmp_path / "a.gltf", keep=KEPT))
    assert look.materials[0].texture is not None
    assert (look.materials[0].texture.pixels == [9, 8, 7, 255]).all()
    with pytest.raises(MeshError, match=r"buffer 0 is another file, 'a.bin': save it as .glb"):
        load_mesh(tmp_path / "a.gltf")


def test_geometry_is_as_trimesh_reads_it() -> None:
    """Modes, index types, strides and sparse arrays, and transforms of nodes."""
    q = np.array([0.5, 0.1, -0.7, 0.5])
    for mode, indices in ((4, [0, 1, 2, 2, 1, 3]), (5, [0, 1, 2, 3, 4]), (5, None)):
        primitive: dict[str, Any] = {"attributes": {"POSITION": 0}, "mode": mode}
        if indices:
            primitive["indices"] = 1
        tree = gltf(primitive, [CORNERS, np.array(indices or [0], "<u2")])
        tree["nodes"] = [
            {"children": [1, 2], "translation": [1, 2, 3], "scale": [1, 2, 1.5]},
            {"mesh": 0, "rotation": (q / np.sqrt((q * q).sum())).tolist(), "scale": [1, -1, 1]},
            {"mesh": 0, "matrix": [*(np.arange(16.0) * np.eye(4).ravel()).tolist()[:15], 1.0]},
        ]
        mine = read_gltf(tree, ())
        scene: Any = trimesh.load_scene(
            io.BytesIO(json.dumps(tree).encode()), file_type="gltf", process=False
        )
        theirs = scene.to_geometry()

        def ordered(v: np.ndarray, f: np.ndarray) -> np.ndarray:
            corners = v[f]
            return np.array(sorted(np.sort(corners.round(9), axis=1).reshape(-1, 9).tolist()))

        assert np.allclose(
            ordered(mine.vertices, mine.faces), ordered(theirs.vertices, theirs.faces)
        )
    fan = gltf({"attributes": {"POSITION": 0}, "mode": 6}, [CORNERS])
    assert read_gltf(fan, ()).faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    arrays = [CORNERS[:3], np.array([2], "<u2"), CORNERS[4:]]
    sparse = gltf({"attributes": {"POSITION": 0}}, arrays)
    sparse["accessors"][0]["sparse"] = {
        "count": 1, "indices": {"bufferView": 1, "componentType": 5123},
        "values": {"bufferView": 2},
    }  # fmt: skip
    assert read_gltf(sparse, ()).vertices.tolist() == [[0, 0, 0], [1, 0, 0], [2, 2, 2]]


def test_parts_of_a_gltf() -> None:
    tree = textured()
    one = tree["meshes"][0]["primitives"][0]
    tree["meshes"] = [{"name": "mesh", "primitives": [one, {**one, "material": 1}]},
                      {"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]  # fmt: skip
    tree["materials"].append({"pbrMetallicRoughness": {}})
    tree["nodes"] = [{"mesh": 0, "name": "a"}, {"mesh": 0, "scale": [-1, 1, 1]}, {"mesh": 1}]
    tree["scenes"] = [{"nodes": [0, 1, 2]}]
    mesh = read_gltf(tree)
    assert mesh.parts["part"].names == ("a/0", "a/1", "mesh/0", "mesh/1", "node 2")
    assert mesh.parts["part"].labels.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert mesh.parts["object"].names == ("a", "mesh", "node 2")
    assert mesh.parts["material"].names == ("m", "material 1", "default")
    assert mesh.parts["material"].labels.tolist() == [0, 0, 1, 1, 0, 0, 1, 1, 2, 2]
    look = look_of(mesh)
    assert look.material.tolist() == [0, 0, 1, 1, 0, 0, 1, 1, -1, -1]
    assert look.uv is not None
    assert look.uv[0].tolist() == [[0, 0], [2, 0], [0, 2]]
    assert look.uv[4].tolist() == [[0, 2], [2, 0], [0, 0]]  # mirrored, so turned
    assert mesh.faces[4].tolist() == [10, 9, 8]


# ---- 3MF and PLY


def test_parts_and_colours_of_a_3mf() -> None:
    model = lib3mf.get_wrapper().CreateModel()
    box = model.AddMeshObject()
    points, corners = meshes.box((0, 0, 0), (1, 2, 3))
    vertices = [lib3mf.Position((lib3mf.ctypes.c_float * 3)(*p)) for p in points.tolist()]
    faces = corners.tolist()
    box.SetGeometry(
        vertices, [lib3mf.Triangle((lib3mf.ctypes.c_uint32 * 3)(*face)) for face in faces]
    )
    box.SetName("a box")
    base = model.AddBaseMaterialGroup()
    red = base.AddMaterial("red", lib3mf.Color(255, 0, 0, 255))
    colours = model.AddColorGroup()
    pale = colours.AddColor(lib3mf.Color(0, 51, 255, 102))
    box.SetObjectLevelProperty(base.GetResourceID(), red)
    ids = (lib3mf.ctypes.c_uint32 * 3)(pale, pale, pale)
    box.SetTriangleProperties(1, lib3mf.TriangleProperties(colours.GetResourceID(), ids))
    for _ in range(2):
        model.AddBuildItem(box, lib3mf.get_wrapper().GetIdentityTransform())
    data = bytes(model.QueryWriter("3mf").WriteToBuffer())
    mesh = load_mesh(io.BytesIO(data), keep=KEPT)
    assert mesh.parts["object"].names == mesh.parts["part"].names == ("a box", "a box")
    n = len(faces)
    assert mesh.parts["object"].labels.tolist() == [0] * n + [1] * n
    look = look_of(mesh)
    names = [look.materials[i].name for i in look.material]
    assert names[1].upper().startswith("#0033FF")
    assert names[0] == names[2] == names[n - 1] == "red"
    assert look.materials[look.material[0]].colour == (1, 0, 0, 1)
    linear = srgb.linear_table() / srgb.ONE
    assert look.materials[look.material[1]].colour == (0, linear[51], 1, 102 / 255)
    assert mesh.parts["material"].names == tuple(one.name for one in look.materials)


@pytest.mark.parametrize("text", [False, True])
def test_colours_of_a_ply(text: bool) -> None:
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)
    colours = np.array([(255, 0, 0, 255), (51, 51, 51, 51), (0, 0, 255, 0)], np.uint8)
    solid = trimesh.Trimesh(points, [[0, 1, 2]], vertex_colors=colours, process=False)
    data = solid.export(file_type="ply", encoding="ascii" if text else "binary")
    mesh = load_mesh(io.BytesIO(data.encode() if isinstance(data, str) else data), keep=KEPT)
    look = look_of(mesh)
    grey = srgb.linear_table()[51] / srgb.ONE
    assert look.colours is not None
    assert look.colours.tolist() == [[1, 0, 0, 1], [grey] * 3 + [0.2], [0, 0, 1, 0]]
    assert look.material.tolist() == [-1]
    if text:
        floats = data.replace(b"property uchar red", b"property float red")
        with pytest.raises(MeshError, match="a colour of its vertices is not from 0 to 1"):
            load_mesh(io.BytesIO(floats), keep=KEPT)


# ---- the example


def test_the_example(tmp_path: Path) -> None:
    """The GLB and the OBJ are one mesh, whose bytes do not change, and trimesh finds it closed."""
    (tmp_path / "a.glb").write_bytes(make_parts.glb())
    make_parts.write_obj(tmp_path / "a.obj")
    one, two = (load_mesh(tmp_path / name, keep=KEPT) for name in ("a.glb", "a.obj"))
    names = ("island", "tower", "balcony", "lamp", "roof")
    for mesh in (one, two):
        assert mesh.parts["part"].names == names
        assert (
            mesh.parts["part"].labels.tolist() == np.repeat(range(5), len(mesh.faces) // 5).tolist()
        )
        assert sum(m.texture is not None for m in look_of(mesh).materials) == 2
    assert np.abs(one.vertices - two.vertices).max() < 1e-5
    uv = look_of(one).uv, look_of(two).uv
    assert uv[0] is not None
    assert uv[1] is not None
    tower = slice(0, 2 * len(one.faces) // 5)
    assert np.abs(uv[0][tower] - uv[1][tower]).max() < 1e-5
    for part in trimesh.Trimesh(one.vertices, one.faces).split():
        assert part.is_volume
        assert part.volume > 0
    assert one.source_sha256 == DIGEST


DIGEST = "47fd74e9c61513d119ef81bcee6fb380570413643708cfbcbf61eb30b5066c19"
