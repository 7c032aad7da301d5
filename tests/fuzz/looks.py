"""Small valid files of what readers of appearance read: textures, materials, colours, labels."""

from __future__ import annotations

import importlib.util
import io
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import voxtool
from voxtool.files.meshes import threemf
from voxtool.mesh.appearance import Appearance

MAKE_PARTS = Path(__file__).parents[2] / "examples" / "make_parts.py"
FOLDER = "look.obj"  # an OBJ with its library and pictures, as an archive
MESHES = ("look.glb", "look.gltf", FOLDER, "look.3mf", "look.ply", "look.text.ply")
OCTREES = ("look.svo.h5", "shares.svo.h5")
FORMATS = (*MESHES, *OCTREES)


def write_looks(folder: Path, ball: Any, device: Any, archive_of: Any) -> None:
    """Write the files into the folder; `archive_of` packs what is in one."""
    parts = lighthouse()
    (folder / "a.look.glb").write_bytes(parts.glb())
    (folder / "a.look.gltf").write_text(gltf_of(parts.glb()))
    with tempfile.TemporaryDirectory() as inside:
        parts.write_obj(Path(inside) / "a.obj")
        (folder / f"a.{FOLDER}").write_bytes(archive_of(Path(inside)))
    write_3mf(folder / "a.look.3mf", ball)
    shares = np.abs(ball.vertices) / np.abs(ball.vertices).max()
    colours = np.column_stack([shares, np.ones(len(shares))])
    look = Appearance((), np.full(len(ball.faces), -1, np.int32), None, colours)
    voxtool.write_mesh(replace(ball, appearance=look), folder / "a.look.ply")
    write_text_ply(folder / "a.look.text.ply", ball, shares)
    mesh = voxtool.load_mesh(folder / "a.look.glb", keep=("parts", "appearance"))
    more: dict[str, Any] = {"attributes": ("colour", "normal", "area"), "labels": "part"}
    octree = voxtool.voxelize(mesh, None, "solid", dim=16, device=device, **more)
    voxtool.write_svo(octree, folder / "a.look.svo.h5")
    shares = voxtool.voxelize(mesh, None, "fraction", dim=16, device=device, face_fractions=True)
    voxtool.write_svo(shares, folder / "a.shares.svo.h5")


def lighthouse() -> Any:
    """The example of five parts, of few triangles and pixels."""
    spec = importlib.util.spec_from_file_location("make_parts", MAKE_PARTS)
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.TURN, module.SIDE = 6, 8
    return module


def gltf_of(glb: bytes) -> str:
    """The same as text, with its buffer inside."""
    import base64
    import json

    length = int.from_bytes(glb[12:16], "little")
    tree = json.loads(glb[20 : 20 + length])
    data = base64.b64encode(glb[28 + length :]).decode()
    tree["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    return json.dumps(tree)


def write_text_ply(path: Path, ball: Any, shares: np.ndarray) -> None:
    head = ["ply", "format ascii 1.0", f"element vertex {len(ball.vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"property float {name}" for name in ("red", "green", "blue")]
    head += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices"]
    rows = np.column_stack([ball.vertices, shares]).tolist()
    lines = [*head, "end_header", *(" ".join(map(repr, row)) for row in rows)]
    lines += [f"3 {a} {b} {c}" for a, b, c in ball.faces.tolist()]
    path.write_text("\n".join(lines) + "\n")


def write_3mf(path: Path, ball: Any) -> None:
    """A 3MF with a base material and colours of triangles, which an item and a component use."""
    vertices = "".join(
        f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in ball.vertices.tolist()
    )
    marks = ("", ' pid="1" p1="1"', ' pid="2" p1="0" p2="1" p3="0"', ' pid="2" p1="1"')
    triangles = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}"{marks[i % 4]}/>'
        for i, (a, b, c) in enumerate(ball.faces.tolist())
    )
    model = (
        f'<model unit="inch" xmlns="{threemf.CORE}" xmlns:m="{threemf.MATERIALS}" '
        'requiredextensions="m"><resources><basematerials id="1"><base name="red" '
        'displaycolor="#FF0000"/><base name="green" displaycolor="#00FF0080"/></basematerials>'
        '<m:colorgroup id="2"><m:color color="#0000FF"/><m:color color="#FFFF00FF"/>'
        f'</m:colorgroup><object id="3" name="ball" pid="1" pindex="0"><mesh><vertices>{vertices}'
        f'</vertices><triangles>{triangles}</triangles></mesh></object><object id="4"><components>'
        '<component objectid="3" transform="0 1 0 -1 0 0 0 0 1 2 0 0"/></components></object>'
        '</resources><build><item objectid="3"/><item objectid="4"/></build></model>'
    )
    relation = (
        f'<Relationships xmlns="{threemf.RELATION.split()[0]}"><Relationship Target="/3D/a.model" '
        f'Id="a" Type="{threemf.ROOT_MODEL}"/></Relationships>'
    )
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, text in ((threemf.RELATIONS, relation), ("3D/a.model", model)):
            archive.writestr(zipfile.ZipInfo(part), text, zipfile.ZIP_DEFLATED)
    path.write_bytes(packed.getvalue())
