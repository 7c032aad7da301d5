"""3MF: the meshes that lib3mf writes and reads, their units and places, and what is refused."""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import lib3mf
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import meshes

import voxtool
from voxtool.choices import LENGTH_UNITS
from voxtool.cli.main import cli
from voxtool.errors import MemoryLimitError, MeshError
from voxtool.files.meshes import threemf

POINTS, FACES = meshes.box((0, 0, 0), (1, 2, 3))
TURN = [[0.0, 2.0, 0.0, 5.0], [-1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0]]
MIRROR = [[-1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]


def transform(rows: list[list[float]]) -> lib3mf.Transform:
    """lib3mf's transform of the same points: its fields are [axis of the result's column]."""
    result = lib3mf.Transform()
    for column in range(4):
        for row in range(3):
            result.Fields[column][row] = rows[row][column]
    return result


def scene(unit: lib3mf.ModelUnit = lib3mf.ModelUnit.MilliMeter) -> bytes:
    """A box as it is, and a component of it turned and moved, in an item that mirrors it."""
    model = lib3mf.get_wrapper().CreateModel()
    model.SetUnit(unit)
    box = model.AddMeshObject()
    vertices = [lib3mf.Position((lib3mf.ctypes.c_float * 3)(*p)) for p in POINTS.tolist()]
    triangles = [lib3mf.Triangle((lib3mf.ctypes.c_uint32 * 3)(*f)) for f in FACES.tolist()]
    box.SetGeometry(vertices, triangles)
    parts = model.AddComponentsObject()
    parts.AddComponent(box, transform(TURN))
    identity = np.eye(4)[:3].tolist()
    model.AddBuildItem(box, transform(identity))
    model.AddBuildItem(parts, transform(MIRROR))
    return bytes(model.QueryWriter("3mf").WriteToBuffer())


def changed(data: bytes, *pairs: tuple[bytes, bytes]) -> bytes:
    """The archive with text of its model replaced."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for info in old.infolist():
            text = old.read(info)
            if info.filename.endswith(".model"):
                for find, put in pairs:
                    assert re.search(find, text), text[:2000]
                    text = re.sub(find, put, text)
            new.writestr(info.filename, text, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def refusal(data: bytes) -> str:
    with pytest.raises(MeshError) as caught:
        voxtool.load_mesh(io.BytesIO(data), "3mf")
    assert str(caught.value).isprintable()
    return str(caught.value)


@pytest.mark.parametrize(
    ("unit", "name"),
    [("MicroMeter", "um"), ("MilliMeter", "mm"), ("CentiMeter", "cm"), ("Meter", "m"),
     ("Inch", "in"), ("Foot", "ft")],
)  # fmt: skip
def test_units_and_places_are_those_of_lib3mf(unit: str, name: str) -> None:
    data = scene(getattr(lib3mf.ModelUnit, unit))
    mesh = voxtool.load_mesh(io.BytesIO(data))  # known by its content
    assert mesh.units == name
    assert name in LENGTH_UNITS
    moved = np.array([[2 * y + 5, -x + 6, z + 7] for x, y, z in POINTS.tolist()])
    moved[:, 0] = 1 - moved[:, 0]
    assert mesh.vertices.tolist() == [*POINTS.tolist(), *moved.tolist()]
    assert mesh.to_trimesh().volume == pytest.approx(6 + 12)  # a mirrored part keeps its outside


def test_scale_and_units_of_a_command(tmp_path: Path) -> None:
    (tmp_path / "a.3mf").write_bytes(scene(lib3mf.ModelUnit.Inch))
    plain = voxtool.load_mesh(tmp_path / "a.3mf")
    scaled = voxtool.load_mesh(tmp_path / "a.3mf", scale=25.4, units="mm")
    assert (scaled.units, plain.units) == ("mm", "in")
    assert scaled.vertices.tolist() == (plain.vertices * 25.4).tolist()
    command = (
        f"voxelize {tmp_path}/a.3mf --dim 16 --scale 25.4 --units mm -q -o {tmp_path}/a.svo.h5"
    )
    assert CliRunner().invoke(cli, command.split()).exit_code == 0
    octree = voxtool.read_svo(tmp_path / "a.svo.h5")
    assert octree.units == "mm"
    assert octree.grid == voxtool.Grid.fit(scaled, 16)
    command = f"adf-build {tmp_path}/a.3mf --max-level 2 --scale 0.5 -q -o {tmp_path}/a.adf.h5"
    assert CliRunner().invoke(cli, command.split()).exit_code == 0
    field = voxtool.read_adf(tmp_path / "a.adf.h5")
    assert field.units == "in"
    half = voxtool.load_mesh(tmp_path / "a.3mf", scale=0.5)
    assert field.digest() == voxtool.build_adf(half, max_level=2).digest()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0}, "scale 0: give a positive number"),
        ({"scale": float("nan")}, "scale nan: give a positive number"),
        ({"scale": 1e308}, "vertex 1 is not finite"),
        ({"units": "mile"}, "units 'mile' are unknown: choose one of um, mm, cm, m, in, ft"),
    ],
)
def test_scales_and_units_that_are_refused(options: dict, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        voxtool.load_mesh(io.BytesIO(changed(scene(), (rb'x="1(\.0*)?"', b'x="9"'))), **options)


def test_components_of_another_part_of_the_archive() -> None:
    data = scene()
    out = io.BytesIO()
    production = b'xmlns:q="' + threemf.PRODUCTION.encode() + b'" requiredextensions="q" '
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for info in old.infolist():
            text = old.read(info)
            if info.filename.endswith(".model"):
                new.writestr("3D/other.model", text)
                text = re.sub(
                    rb"<object(?:(?!<object).)*?<mesh>.*?</object>", b"", text, flags=re.S
                )
                text = text.replace(b"<model ", b"<model " + production)
                text = re.sub(rb'objectid="1"', b'objectid="1" q:path="/3D/other.model"', text)
            new.writestr(info.filename, text)
    both = [voxtool.load_mesh(io.BytesIO(one), "3mf") for one in (data, out.getvalue())]
    assert both[0].vertices.tolist() == both[1].vertices.tolist()
    assert both[0].faces.tolist() == both[1].faces.tolist()


@pytest.mark.parametrize(
    ("find", "put", "message"),
    [
        (rb"</model>", b"", r"3dmodel.model: not readable as XML: no element found"),
        (rb"<model", b"<!DOCTYPE a [<!ENTITY b 'c'>]><model", "line 2: a DOCTYPE, which 3MF"),
        (rb'unit="millimeter"', b'unit="mile"', "unit mile is unknown: 3MF has micron, "),
        (rb'<vertex x="1', b'<vertex x="z', "'z.000000' is no number"),
        (rb'<vertex x="0[^"]*"', b"<vertex", "attribute 'x' is missing"),
        (rb'v1="0"', b'v1="99"', "face 0 names vertex 99 where there are 8"),
        (rb'v1="0"', b'v1="-1"', "names vertex -1"),
        (rb'v1="0"', b'v1="9999999999999999999999"', r"line \d+: "),
        (rb'objectid="1"', b'objectid="7"', "has no object 7 to build"),
        (rb'objectid="1"', b'objectid="2"', "objects inside more than 64 others"),
        (rb'transform="[^"]*"', b'transform="1 0"', "a transform is no 12 finite numbers"),
        (rb'transform="\S+ ', b'transform="nan ', "a transform is no 12 finite numbers"),
        (rb"<build.*</build>", b"<build/>", "its build names no object, so nothing is placed"),
        (rb' unit="', b' xmlns:beams="urn:beams" requiredextensions="beams" unit="',
         "it requires the extension urn:beams"),
    ],
)  # fmt: skip
def test_refusals(find: bytes, put: bytes, message: str) -> None:
    text = refusal(changed(scene(), (rb"\n", b" "), (rb"<model", b"\n<model"), (find, put)))
    assert re.search(message, text), text


def test_archives_that_are_refused() -> None:
    data = scene()
    assert "no zip file" in refusal(b"PK").lower() or "not a zip file" in refusal(b"PK")
    assert "not readable as 3MF" in refusal(data[: len(data) // 2])
    empty = io.BytesIO()
    zipfile.ZipFile(empty, "w").close()
    assert "_rels/.rels is missing" in refusal(empty.getvalue())
    broken = bytearray(data)
    middle = data.index(b"3D/3dmodel.model") + 200
    broken[middle : middle + 40] = bytes(40)
    assert "not readable" in refusal(bytes(broken))


def test_bombs_are_refused_before_memory_is_taken() -> None:
    spaces = changed(scene(), (rb"</build>", b"</build>" + b" " * (100 << 20)))
    assert re.search(r"unpacks to more than \d+ MiB", refusal(spaces))
    doubled = b"".join(
        b'<object id="%d"><components>%s</components></object>'
        % (n, b'<component objectid="%d"/>' % (n - 1) * 2)
        for n in range(100, 160)
    ).replace(b'objectid="99"', b'objectid="1"')
    many = changed(
        scene(), (rb"</resources>", doubled + b"</resources>"),
        (rb"</build>", b'<item objectid="159"/></build>'),
    )  # fmt: skip
    with pytest.raises(MemoryLimitError, match="its meshes"):
        voxtool.load_mesh(io.BytesIO(many), "3mf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (rb"</build>", b'<item objectid="1"/>' * 101 + b"</build>", "more than 100 items"),
        (
            rb"</resources>",
            b"".join(b'<object id="%d"/>' % n for n in range(9, 120)) + b"</resources>",
            "more than 100 objects",
        ),
        (rb"<resources>", b"<resources>" + b"<x>" * 70, "inside more than 64 others"),
        (rb"<resources>", b'<resources a="' + b"1" * 2_000_000 + b'">', "a tag of more than 1 MiB"),
        (rb'<vertex x="1', b'<vertex x="1_1', "is no number"),
        (rb'v1="0"', b'v1="0.5"', "'0.5' is no whole number"),
    ],
)
def test_many_elements_and_odd_numbers(
    old: bytes, new: bytes, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threemf, "MOST_OBJECTS", 100)
    with pytest.raises(MeshError, match=message):
        voxtool.load_mesh(io.BytesIO(changed(scene(), (old, new))), "3mf")
