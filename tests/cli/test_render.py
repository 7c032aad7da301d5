"""voxtool render: pictures as the library's, options and their refusals, plans, empty pictures."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import png
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, run, told
from PIL import Image, ImageSequence

from voxtool.camera import Camera
from voxtool.choices import METHODS, SEARCHES, VIEWS
from voxtool.cli.render import OPTIONS_OF
from voxtool.errors import human
from voxtool.files import read_adf, read_svo, read_tet, write_svo
from voxtool.files.pictures.picture import rounded
from voxtool.palette import palette
from voxtool.pictures.rendering import averaged, camera_for, render
from voxtool.svo.octree.octree import Octree
from voxtool.tets.pictures import transfer

OCTREE, FIELD, VOLUME = "bunny.svo.h5", "bunny.adf.h5", "volume.tet.h5"
SCENES = {"octree": OCTREE, "field": FIELD, "volume": VOLUME}
OPTIONS = {
    "level": "--level 0",
    "offset": "--offset 0.1",
    "search": "--search binary",
    "colour": "--colour #ff8000",
    "transfer_file": "--transfer a.json",
    "map_name": "--map gray",
    "opacity_range": "--opacity-range 0,1",
    "unit_distance": "--unit-distance 1",
    "method": "--method raycast",
    "integrator": "--integrator linear",
    "colour_by": "--colour-by label",
    "only": "--only head",
    "legend": "--legend",
    "isovalues": "--isovalue 0.5",
    "other": f"--difference {OCTREE}",
}


def floats(command: str) -> np.ndarray:
    """Return the picture that a command draws."""
    run(f"render {command} -q --float -o a.npy")
    return np.load("a.npy")


def hits(command: str) -> np.ndarray:
    """Return the pixels that are hit, none of them at the border of the picture."""
    hit = floats(command)[..., 3] > 0
    assert hit.any()
    assert not hit[[0, -1]].any(), command
    assert not hit[:, [0, -1]].any(), command
    return hit


# ---- pictures


@pytest.mark.parametrize("file", [OCTREE, FIELD, VOLUME])
def test_the_report(file: str, here: Path) -> None:
    result = run(f"render {file} --size 80x60")
    assert result.stdout == ""
    name = f"{file.partition('.')[0]}.png"
    said = re.fullmatch(
        rf"voxtool: {file} -> {name}: 80 x 60, iso view, ([\d.]+) % of pixels hit, "
        rf"{human(os.path.getsize(name))}, \d+\.\d\d s\n",
        result.stderr,
    )
    assert said, result.stderr
    assert Image.open(name).size == (80, 60)
    drawn = floats(f"{file} --size 80x60")
    assert 5 < float(said[1]) < 95
    assert float(said[1]) == pytest.approx(100 * np.mean(drawn[..., 3] > 0), rel=0.01)


def test_the_picture_is_the_librarys(here: Path) -> None:
    eye, target = (3.0, 2.5, 4.0), (0.1, 0.9, 0.0)
    rays = Camera(eye, target, (0.0, 0.0, 1.0), 40.0).rays(60, 40)
    camera = "--eye 3,2.5,4 --target 0.1,.9,0 --up z --fov 40 --size 60x40 --samples 1"
    octree, field = read_svo(OCTREE), read_adf(FIELD)
    assert np.array_equal(floats(f"{OCTREE} {camera}"), render(octree, rays))
    assert np.array_equal(
        floats(f"{OCTREE} {camera} --level 1 --colour 1,0,.5"),
        render(octree, rays, level=1, colour=(1, 0, 0.5)),
    )
    assert np.array_equal(floats(f"{FIELD} {camera}"), render(field, rays))
    assert np.array_equal(
        floats(f"{FIELD} {camera} --offset=0.1 --colour #ff0000"),
        render(field, rays, offset=0.1, colour=(1, 0, 0)),
    )


@pytest.mark.parametrize("file", [OCTREE, VOLUME])
@pytest.mark.parametrize("samples", [2, 4])
def test_samples_are_means_of_a_larger_picture(file: str, samples: int, here: Path) -> None:
    fine = floats(f"{file} --samples 1 --size {48 * samples}x{32 * samples}")
    drawn = floats(f"{file} --samples {samples} --size 48x32")
    assert np.array_equal(drawn, averaged(fine, samples))


def test_surfaces_have_two_samples_a_side_by_default(here: Path) -> None:
    assert np.array_equal(floats(f"{OCTREE} --size 40"), floats(f"{OCTREE} --size 40 --samples 2"))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("background", "colour"),
    [("", (1, 1, 1)), ("black", (0, 0, 0)), ("#ff8000", (1, 128 / 255, 0)), ("none", None)],
)
def test_bits_and_background(bits: int, background: str, colour, here: Path) -> None:
    drawn = floats(f"{OCTREE} --size 50")
    behind = f"--background {background}" if background else ""
    run(f"render {OCTREE} --size 50 --bits {bits} {behind} -o a.png")
    width, height, rows, info = png.Reader("a.png").read()
    found = np.array([list(row) for row in rows]).reshape(height, width, -1)
    assert info["bitdepth"] == bits
    assert np.array_equal(found, rounded(drawn, bits, colour))
    corner = [0] * 4 if colour is None else [round(c * (2**bits - 1)) for c in colour]
    assert found[0, 0].tolist() == corner


def test_streams(here: Path) -> None:
    run(f"render {OCTREE} --size 40 -o a.png")
    expected = Path("a.png").read_bytes()
    for command in ("render - --size 40", "render - --size 40 -o -"):
        result = run(command, (here / OCTREE).read_bytes())
        assert result.stdout_bytes == expected
        assert result.stderr.startswith("voxtool: stdin -> stdout: 40 x 40, iso view")
    result = run("render - --size 40 --float --json", (here / FIELD).read_bytes())
    assert np.load(io.BytesIO(result.stdout_bytes)).shape == (40, 40, 4)
    assert json.loads(result.stderr)["output"] == "-"


def test_json(here: Path) -> None:
    result = run(f"render {OCTREE} --size 60x40 --samples 3 --json")
    assert result.stderr == ""
    said = json.loads(result.stdout)
    drawn = floats(f"{OCTREE} --size 60x40 --samples 3")
    octree = read_svo(OCTREE)
    assert said.pop("seconds") > 0
    assert {"coverage", "ray casting"} < said.pop("stages").keys()
    assert said == {
        "notes": [],
        "warnings": [],
        "output": "bunny.png",
        "bytes": os.path.getsize("bunny.png"),
        "kind": "octree",
        "size": [60, 40],
        "samples": 3,
        "nodes": len(octree.nodes),
        "bricks": len(octree.bricks),
        "pixels_hit": np.mean(drawn[..., 3] > 0),
        "digest": hashlib.sha256(drawn.tobytes()).hexdigest(),
    }


# ---- cameras


def test_every_view_shows_all_and_fills_the_picture(here: Path) -> None:
    pictures = []
    for view in VIEWS:
        for lens in ("", "--orthographic"):
            hit = hits(f"{OCTREE} --view {view} --size 96x64 --samples 1 {lens}")
            filled = max(np.ptp(np.flatnonzero(hit.any(axis=axis))) / side
                         for axis, side in ((1, 64), (0, 96)))  # fmt: skip
            assert filled > 0.75, (view, lens)
            pictures.append(hit.tobytes())
    assert len(set(pictures)) == len(pictures)


@pytest.mark.parametrize("view", VIEWS)
def test_coarse_nodes_and_offset_surfaces_are_in_the_picture(view: str, here: Path) -> None:
    for level in range(6):
        hits(f"{OCTREE} --view {view} --size 64 --level {level} --samples 1")
    for offset in (0, 0.2, -0.1):
        hit = hits(f"{FIELD} --offset {offset} --view {view} --size 64 --samples 1")
        assert hit.any(axis=1).sum() > 40 or hit.any(axis=0).sum() > 40


def test_an_eye_may_be_where_a_view_is(here: Path) -> None:
    view = floats(f"{OCTREE} --view right --turn 0 --size 40")
    camera = camera_for(read_svo(OCTREE), "right", turn=0)
    eye = ",".join(map(repr, camera.eye))
    assert np.array_equal(floats(f"{OCTREE} --eye {eye} --size 40"), view)


def test_turns(here: Path) -> None:
    command = f"{OCTREE} --view front --size 40 --turn"
    start = floats(f"{command} 0")
    assert np.array_equal(floats(f"{command} 360"), start)
    assert not np.array_equal(floats(f"{command} 40"), start)
    for degrees in range(0, 360, 45):  # all of it at every turn
        hits(f"{command} {degrees}")
    quarter = (
        floats(f"{command} 90")[..., 3]
        - floats(f"{OCTREE} --view right --size 40 --turn 0")[..., 3]
    )
    assert np.abs(quarter).mean() < 0.01


def test_height_and_fov(here: Path) -> None:
    def area(options: str) -> float:
        return float(floats(f"{OCTREE} --view front --size 128 {options}")[..., 3].mean())

    assert area("--orthographic --height 10") == pytest.approx(
        4 * area("--orthographic --height 20"), rel=0.05
    )
    eye = "--eye 0,1,9 --target 0,1,0"
    near = float(floats(f"{OCTREE} {eye} --fov 40 --size 128")[..., 3].mean())
    far = float(floats(f"{OCTREE} {eye} --fov 80 --size 128")[..., 3].mean())
    assert near == pytest.approx(
        far * (np.tan(np.radians(40)) / np.tan(np.radians(20))) ** 2, rel=0.05
    )


def test_up(here: Path) -> None:
    upright = floats(f"{OCTREE} --view front --size 40 --orthographic --samples 1")[..., 3]
    under = floats(f"{OCTREE} --view front --size 40 --orthographic --samples 1 --up -y")[..., 3]
    assert np.mean(upright[::-1, ::-1] != under) < 0.02
    for axis, vector in (("y", "0,1,0"), ("-Y", "0,-2,0"), ("x", "1,0,0")):
        assert np.array_equal(
            floats(f"{OCTREE} --up {axis} --size 20"), floats(f"{OCTREE} --up {vector} --size 20")
        )


# ---- differences


def test_a_difference_colours_what_only_one_octree_has(here: Path) -> None:
    dense = read_svo(OCTREE).to_dense()
    low, high = dense.copy(), dense.copy()
    half, third = dense.shape[1] // 2, dense.shape[1] // 3
    low[:, half:], high[:, :third] = False, False
    grid = read_svo(OCTREE).grid
    for name, part in (("low", low), ("high", high)):
        part_of = Octree.from_dense(part, grid.origin, grid.pitch)
        write_svo(part_of, f"{name}.svo.h5")
    camera = "--size 48 --samples 1 --orthographic --view front"
    found = floats(f"low.svo.h5 --difference high.svo.h5 {camera}")
    whole = floats(f"{OCTREE} {camera} --colour white")
    assert np.array_equal(found[..., 3], whole[..., 3])  # together they have every voxel
    reddish, bluish = found[..., 0] > 1.5 * found[..., 2], found[..., 2] > 1.5 * found[..., 0]
    common = (found[..., 3] == 1) & ~reddish & ~bluish
    rows = [np.flatnonzero(met.any(axis=1)) for met in (bluish, common, reddish)]
    assert all(len(met) > 4 for met in rows)
    assert rows[0].max() <= rows[1].min() + 1  # the second from the top, the first at the bottom
    assert rows[1].max() <= rows[2].min() + 1
    same = floats(f"{OCTREE} --difference {OCTREE} {camera}")
    assert np.array_equal(same, floats(f"{OCTREE} {camera}"))
    run("voxelize bunny.obj --dim 16 -o other.svo.h5 -q")
    assert "octrees of different grids" in fail(f"render {OCTREE} --difference other.svo.h5")


# ---- turntables


def test_turntables(here: Path) -> None:
    """Frames are the pictures of --turn, one by one, in every format."""
    command = f"render {OCTREE} --size 40 --samples 1 --turntable 5"
    result = run(f"{command} -o spin%02d.png")
    assert "5 frames, the first 40 x 40, iso view" in result.stderr
    frames = sorted(Path().glob("spin*.png"))
    assert [path.name for path in frames] == [f"spin{i:02d}.png" for i in range(5)]
    for i, path in enumerate(frames):
        run(f"render {OCTREE} --size 40 --samples 1 --turn {72 * i} -o one.png -q")
        assert Path("one.png").read_bytes() == path.read_bytes()
    pixels = [np.asarray(Image.open(path)) for path in frames]
    run(f"{command} -q")  # bunny.gif
    run(f"{command} -o spin.webp --background none -q")
    for name in ("bunny.gif", "spin.webp"):
        film: Any = Image.open(name)
        assert film.n_frames == 5
        assert film.info["loop"] == 0
        for i, frame in enumerate(ImageSequence.Iterator(film)):
            drawn = np.asarray(frame.convert("RGBA"), float)
            straight = drawn[..., :3] * drawn[..., 3:] / 255 + (255 - drawn[..., 3:])
            assert np.abs(straight - pixels[i]).mean() < 6, (name, i)  # as it is encoded
    assert run(f"{command} -o - -q").stdout_bytes[:6] == b"GIF89a"
    assert "frames as .png need a place for their number" in fail(f"{command} -o spin.png")
    with_legend = f"render {VOLUME} --size 200 --turntable 2 --legend"
    run(f"{with_legend} -o a.gif -q")
    assert Image.open("a.gif").width > 200


def test_turntables_as_videos(here: Path) -> None:
    """A video has the frames of the numbered pictures, an odd side with one line more, and the same
    bytes each time."""
    command = f"render {OCTREE} --size 61x48 --samples 2 --turntable 4 -q"
    run(f"{command} -o spin%d.png")
    run(f"{command} -o spin.mp4")
    with av.open("spin.mp4") as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.frames, stream.average_rate) == (4, Fraction(4, 6))
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 4
    for i, frame in enumerate(frames):
        drawn = np.asarray(Image.open(f"spin{i}.png"))
        assert frame.shape == (48, 62, 3)
        error = ((frame[:, :61].astype(float) - drawn) ** 2).mean()
        assert 10 * np.log10(255**2 / error) > 38, i
        assert (np.abs(frame[:, 61].astype(int) - frame[:, 60]) < 16).all()
    run(f"{command} -o again.mp4 --fps 25")
    with av.open("again.mp4") as film:
        assert film.streams.video[0].average_rate == 25
    run(f"{command} -o again.mp4")
    assert Path("again.mp4").read_bytes() == Path("spin.mp4").read_bytes()
    run(f"{command} -o spin.gif --fps 5")
    assert Image.open("spin.gif").info["duration"] == 200


def test_videos_need_pyav(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    message = fail(f"render {OCTREE} --turntable 4 -o spin.mp4")
    assert "a video as .mp4 needs PyAV: pip install 'voxtool[video]'" in message
    assert not Path("spin.mp4").exists()


def test_frames_too_large_for_a_format(here: Path) -> None:
    message = fail(f"render {OCTREE} --size 16385x2 --samples 1 --turntable 2 -o spin.mp4")
    assert "spin.mp4: frames of 16385 x 2 pixels: .mp4 has 16384 along a side" in message
    assert not Path("spin.mp4").exists()


# ---- refusals


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("name", OPTIONS)
def test_options_of_other_kinds_are_refused_by_name(kind: str, name: str, here: Path) -> None:
    kinds = [k for k, names in OPTIONS_OF.items() if name in names]
    if kind in kinds:
        return
    message = fail(f"render {SCENES[kind]} {OPTIONS[name]}", code=2)
    goes = " and ".join(f"{k}s" for k in kinds)
    article = "an" if kind == "octree" else "a"
    option = OPTIONS[name].split()[0]
    assert message.startswith(f"{option} goes with {goes}: {SCENES[kind]} holds {article} {kind}")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--view up", "'front', 'back', 'left', 'right', 'top', 'bottom', 'iso'"),
        ("--eye 1,2,3 --view top", "--eye and --view both place the camera: drop one"),
        ("--eye 1,2", "'1,2': write three numbers, as 1,2.5,-3"),
        ("--eye 1,2,nan", "'1,2,nan': write three numbers"),
        ("--eye z", "'z': write three numbers"),
        ("--target 1,2,3", "--target goes with --eye"),
        ("--up w", "'w': write 0,0,1, z or -z"),
        ("--up --z", "'--z': write 0,0,1, z or -z"),
        ("--fov 0", "0.0 is not in the range 0.01<=x<=170"),
        ("--fov 30 --orthographic", "--fov is of a perspective: --orthographic has --height"),
        ("--height 3", "--height goes with --orthographic"),
        ("--orthographic --height 0", "'0' is no positive number"),
        ("--size 0", "'0' is no size: write 800x600, or 512 for both sides"),
        ("--size 10x", "'10x' is no size"),
        ("--size 10x20x30", "'10x20x30' is no size"),
        ("--size -5", "'-5' is no size"),
        ("--size 9999999", "'9999999' is no size"),
        ("--size 20000x8 --samples 2", "is 40000 rays along a side, of 32768 that are cast"),
        ("--size 40000x8", "is 40000 rays along a side"),
        ("--samples 17", "17 is not in the range 1<=x<=16"),
        ("--level x", "'x': choose voxel, or a level"),
        ("--colour red", "'red' is no colour: write #ff8000, 1,0.5,0 (from 0 to 1), white, black"),
        ("--colour none", "'none' is no colour"),
        ("--colour 1,2,0", "'1,2,0' is no colour"),
        ("--colour #ff80", "'#ff80' is no colour"),
        ("--colour '#ff 0 0'", "'#ff 0 0' is no colour"),
        ("--background #gggggg", "'#gggggg' is no colour"),
        ("--bits 12", "'8', '16'"),
        ("--float -o a.png", "--float writes .npy, and a.png ends in .png"),
        ("--float --bits 8", "--bits goes with .png: .npy holds the values themselves"),
        ("-o a.npy --background white", "--background goes with .png"),
        ("--turn inf", "'inf' is no finite number"),
        ("--turn east", "'east' is no finite number"),
        ("--method rays", "'raycast', 'projection'"),
        (
            "--opacity-range 2",
            "'2': write two numbers or percentiles, as 0.5,2 or 75%,99%, or full",
        ),
        ("--opacity-range 75%,101%", "'75%,101%': write two numbers or percentiles"),
        ("--turntable 4 -o a.mp4 --background none", "videos have no transparency: drop"),
        ("--turntable 4 -o a%d.png --fps 8", "--fps is of animations: a%d.png are single pictures"),
        ("--fps 8", "--fps is of the frames of --turntable"),
        ("--turntable 4 --fps 60", "0.1<=x<=50"),
        ("--turntable 4 --float", "--float goes with one picture: --turntable writes frames of 8"),
        ("--turntable 4 --bits 16", "--bits goes with one picture"),
        ("--iso-opacity 0.5", "--iso-opacity is of the surfaces of --isovalue: give one"),
        ("--isovalue x", "is no finite number"),
        ("--level 0 --isovalue 0.2,0.4", "--isovalue of an octree is one share: give one number"),
        ("--opacity-range 0,inf", "'0,inf': write two numbers"),
        ("--map fire", "'viridis', 'inferno', 'coolwarm', 'turbo', 'gray'"),
        ("--transfer a.json --map gray", "--map makes a transfer function: drop it or --transfer"),
        ("--transfer a.json --opacity-range 0,1", "--opacity-range makes a transfer function"),
        ("--transfer a.json --unit-distance 1", "--unit-distance makes a transfer function"),
        ("--unit-distance nan", "'nan' is no positive number"),
    ],
)
def test_usage_errors(options: str, message: str, here: Path) -> None:
    assert message in fail(f"render {OCTREE} {options}", code=2)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("bunny.obj", "bunny.obj is a mesh: make an octree or a field of it first: voxtool voxel"),
        ("points.csv", "points.csv is no "),
        ("mesh.vtu", "voxtool tet-build mesh.vtu"),
        ("other.h5", "an HDF5 file, but no octree or distance field or tetrahedral volume: attr"),
        (f"{OCTREE} -o a.jpg", "a.jpg: the name says no format: end it in one of .png, .npy"),
        (f"{OCTREE} --level 6", "level 6: choose 'voxel' or a level from 0 to 5"),
        (f"{OCTREE} --level -1", "level -1: choose 'voxel' or a level from 0 to 5"),
        (f"{OCTREE} --eye 1,1,1 --target 0,0,0 --up 1,1,1", "is along the view: choose another"),
        (f"{OCTREE} --eye 1,1,1 --target 1,1,1", "has no direction"),
        (f"{OCTREE} --up 0,0,0", "has no direction"),
        (f"{OCTREE} --fov nan", "a field of view of nan degrees: choose 0.01 to 170"),
        (f"{OCTREE} --size 2000 --max-memory 10M", "2000 x 2000 pixels, 4 rays each, would need"),
        (f"{OCTREE} --max-memory 500", "the octree alone is too large (see --max-memory)"),
    ],
)
def test_failures_are_one_line(command: str, message: str, here: Path) -> None:
    import h5py

    (here / "mesh.vtu").write_text('<?xml version="1.0"?><VTKFile/>')
    with h5py.File("other.h5", "w") as h5:
        h5["a"] = 1
    assert message in fail(f"render {command}")


# ---- volumes

EYE = "--eye 9,5,12 --target 2,1.5,1.5"
POINTS = [
    {"scalar": 2, "color": [0, 0, 1], "extinction": 0},
    {"scalar": 5.5, "color": [1, 0.5, 0], "extinction": 2.5},
    {"scalar": 5.5, "color": [0, 1, 0], "extinction": 0.5},
]


def test_defaults_are_those_of_the_help() -> None:
    assert transfer.DEFAULT_MAP == "viridis"
    assert transfer.DEPTH == 24


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("integrator", ["linear", "preintegrated", "average", "sampled:3"])
def test_volumes_are_the_librarys(method: str, integrator: str, here: Path) -> None:
    volume = read_tet(VOLUME)
    rays = Camera((9.0, 5.0, 12.0), (2.0, 1.5, 1.5)).rays(30, 20)
    expected = render(volume, rays, method=method, integrator=integrator)
    command = f"{VOLUME} {EYE} --size 30x20 --method {method} --integrator {integrator}"
    assert np.array_equal(floats(command), expected)
    assert 0 < expected[..., 3].max() < 1


def test_searches_of_fields(here: Path) -> None:
    """Each draws the same pixels; the plan says what is searched."""
    plain = floats(f"{FIELD} --size 40")
    for search in SEARCHES:
        assert np.array_equal(floats(f"{FIELD} --size 40 --search {search}"), plain)
    left_out = run(f"render {FIELD} --plan").stdout
    assert "a block knows its children's" in left_out
    assert "a block knows" not in run(f"render {FIELD} --search linear --plan").stdout


def test_levels_by_coverage(here: Path) -> None:
    """Each larger share leaves less; a share goes with a level, and the plan says it."""
    shown = [
        np.count_nonzero(floats(f"{OCTREE} --size 40 --level 1{share}")[..., 3])
        for share in ("", " --isovalue 0.2", " --isovalue 0.9")
    ]
    assert shown == sorted(set(shown), reverse=True)
    assert "an isovalue is a share of a node: choose a level, too" in fail(
        f"render {OCTREE} --isovalue 0.5", 3
    )
    assert "the isovalue is 0.5" in run(f"render {OCTREE} --level 1 --isovalue 0.5 --plan").stdout
    message = run(f"render {OCTREE} --size 9 --level 4 --isovalue 1").stderr
    assert "of its nodes of level 4 at most" in message


def test_isovalues_alone_and_within_a_transfer_function(here: Path) -> None:
    volume = read_tet(VOLUME)
    low, high = volume.scalar_range
    one, two = low + 0.2 * (high - low), low + 0.5 * (high - low)
    rays = Camera((9.0, 5.0, 12.0), (2.0, 1.5, 1.5)).rays(30, 20)
    command = f"{VOLUME} {EYE} --size 30x20 --isovalue {one!r},{two!r} --iso-opacity 0.6"
    both = {"isovalues": (one, two), "opacity": 0.6}
    alone = render(volume, rays, **both)
    assert alone[..., 3].any()
    assert np.array_equal(floats(command), alone)
    coloured = render(volume, rays, colour=(1.0, 0.0, 0.0), method="projection", **both)
    assert np.array_equal(floats(f"{command} --colour #ff0000 --method projection"), coloured)
    shown = transfer.default_transfer(volume, "gray", opacity_range=("50%", high))
    within = render(volume, rays, transfer=shown, **both)
    assert np.array_equal(floats(f"{command} --map gray --opacity-range 50%,{high!r}"), within)
    message = fail(f"render {VOLUME} --colour #ff0000", code=2)
    assert message.startswith("--colour of a volume is that of --isovalue: give one")


def test_transfer_functions(here: Path) -> None:
    volume = read_tet(VOLUME)
    low, high = volume.scalar_range
    rays = Camera((9.0, 5.0, 12.0), (2.0, 1.5, 1.5)).rays(30, 20)
    command = f"{VOLUME} {EYE} --size 30x20"

    def expected(function: transfer.TransferFunction) -> np.ndarray:
        return render(volume, rays, transfer=function)

    middle = (low + high) / 2
    found = floats(f"{command} --map gray --opacity-range {high!r},{middle!r} --unit-distance 0.3")
    assert np.array_equal(found, expected(transfer.named("gray", low, high, 0.3, (high, middle))))
    Path("a.json").write_text(json.dumps({"points": POINTS}))
    function = transfer.TransferFunction.from_json(json.dumps({"points": POINTS}))
    assert np.array_equal(floats(f"{command} --transfer a.json"), expected(function))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "a.json: transfer function: no JSON"),
        (b"{", "a.json: transfer function: no JSON"),
        (b"\xff\xfe", "a.json: no text, so no transfer function"),
        (b"[" * 500_000, "a.json: transfer function: no JSON"),
        (b'{"points": ' * 90_000, "a.json: transfer function: no JSON"),
        (b" " * (1 << 20) + b"{}", "a.json: a transfer function has at most 1.05 MB"),
        (b'{"points": []}', "a.json: transfer function of 0 points"),
        (b'{"points": [1]}', "a.json: transfer function, point 1: "),
        (
            b'{"points": [{"scalar": NaN, "color": [0,0,0], "extinction": 0}]}',
            "point 1: scalar nan is not",
        ),
        (b'{"points": [{"scalar": 0, "color": [0,0,0], "extinction": 1e400}]}', "is not 0 or more"),
        (b'{"points": [{"scalar": 1' + b"0" * 5000 + b"}]}", "a.json: transfer function"),
        (b'{"points": [{"scalar": 0, "color": [0,0,0], "extinction": 1e300}]}', "float32 holds"),
    ],
)
def test_hostile_transfer_functions_are_one_line(content: bytes, message: str, here: Path) -> None:
    Path("a.json").write_bytes(content)
    assert message in fail(f"render {VOLUME} --transfer a.json")


def test_a_missing_transfer_function(here: Path) -> None:
    assert "none.json: there is no such file" in fail(f"render {VOLUME} --transfer none.json")
    assert "is a folder" in fail(f"render {VOLUME} --transfer /")
    assert "integrator 'simpson' is unknown" in fail(f"render {VOLUME} --integrator simpson")


def test_a_legend_stands_beside_the_picture(here: Path) -> None:
    run(f"render {VOLUME} --size 240x220 -o a.png")
    run(f"render {VOLUME} --size 240x220 --legend -o b.png")
    plain, beside = (np.asarray(Image.open(name)) for name in ("a.png", "b.png"))
    assert np.array_equal(beside[:, :240], plain)
    assert beside.shape[1] > 300
    assert (beside[:, 240:] < 128).any()
    run(f"render {VOLUME} --size 240x220 --legend --background none --bits 16 -o c.png")
    assert Image.open("c.png").size == beside.shape[1::-1]
    assert "leave out --legend" in fail(f"render {VOLUME} --size 100 --legend")
    alone = "--legend shows a transfer function, and --isovalue alone has"
    assert alone in fail(f"render {VOLUME} --isovalue 0.3 --legend", 2)


def test_labels_are_named_and_drawn_alone(here: Path) -> None:
    write_svo(attributed(), "parts.svo.h5")
    run("render parts.svo.h5 --size 240x220 --colour-by label -o a.png")
    run("render parts.svo.h5 --size 240x220 --colour-by label --legend -o b.png")
    plain, beside = (np.asarray(Image.open(name)) for name in ("a.png", "b.png"))
    assert np.array_equal(beside[:, :240], plain)
    beside = beside[:, 240:, :3].reshape(-1, 3)
    for colour in palette(3):
        assert (beside == colour).all(axis=1).sum() > 10
    alone = "render parts.svo.h5 --size 240x220 --colour-by label --only"
    run(f"{alone} größe -o c.png")
    run(f"{alone} 'head,größe,a b' -o d.png")
    some, every = (np.asarray(Image.open(name)) for name in ("c.png", "d.png"))
    assert np.array_equal(every, plain)
    assert not np.array_equal(some, plain)
    assert "no label is called 'arm'" in fail("render parts.svo.h5 --only arm")
    assert "give --colour-by label" in fail("render parts.svo.h5 --legend", 2)
    assert "which are not drawn" in fail(f"render {OCTREE} --legend", 2)


def test_what_is_transparent_is_left_out(here: Path) -> None:
    low, high = read_tet(VOLUME).scalar_range
    points = [{"scalar": high + 1, "color": [1, 1, 1], "extinction": 0}]
    Path("a.json").write_text(json.dumps({"points": points}))
    text = run(f"render {VOLUME} --transfer a.json --plan").stdout
    assert "left out   transparent cells: the transfer function leaves " in text
    assert told(f"render {VOLUME} --transfer a.json --plan --json")["cells_shown"] == 0
    said = run(f"render {VOLUME} --transfer a.json --size 20").stderr
    assert f"is empty: the transfer function is transparent from {low:.6g} to {high:.6g}" in said


def test_too_thin_to_be_seen(here: Path) -> None:
    said = run(f"render {VOLUME} --unit-distance 1e6 --size 20").stderr
    assert re.search(
        r"is empty: its opacity is at most \de-0\d: choose a smaller unit distance", said
    )


# ---- plans


@pytest.mark.parametrize("kind", SCENES)
def test_the_plan_counts_rays(kind: str, here: Path) -> None:
    text = run(f"render {SCENES[kind]} --size 30x20 --samples 3 --plan").stdout
    assert "picture    30 x 20 pixels of 3 x 3 rays\n" in text
    assert "rays       5,400" in text
    plan = told(f"render {SCENES[kind]} --size 30x20 --samples 3 --plan --json")
    assert (plan["kind"], plan["size"], plan["samples"], plan["rays"]) == (kind, [30, 20], 3, 5400)
    assert plan["predicted_device_bytes"] > 16 * 5400


def test_plan_tells_what_a_level_leaves_out(here: Path) -> None:
    assert "voxels finer than level 2" in run(f"render {OCTREE} --level 2 --plan").stdout
    assert "finer" not in run(f"render {OCTREE} --plan").stdout


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize(
    "camera", ["--eye 1e30,0,0", "--orthographic --height 1e-200", "--orthographic --height 1e300"]
)
def test_the_plan_refuses_what_the_run_refuses(kind: str, camera: str, here: Path) -> None:
    command = f"render {SCENES[kind]} --size 8 {camera}"
    refused = fail(command)
    assert "choose a nearer --eye" in refused or "choose a --height from" in refused
    assert fail(f"{command} --plan") == refused


# ---- empty pictures


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("--eye 50,50,50 --target 100,100,100", "the camera looks past the content in ("),
        ("--eye 50,50,50 --target 50,0,50 --up x", "the camera looks past the content"),
        ("--orthographic --eye 0,0,50 --target 0,80,0 --height 1", "the camera looks past"),
        ("--eye 9e5,0,0 --fov 170 --size 9", "no ray hits the content"),
    ],
)
@pytest.mark.parametrize("file", [OCTREE, FIELD])
def test_empty_pictures_are_told(file: str, options: str, why: str, here: Path) -> None:
    result = run(f"render {file} {options} -o a.png")
    warning, first = result.stderr.splitlines()
    assert " 0 % of pixels hit" in first
    assert warning.startswith(f"voxtool: warning: the picture is empty: {why}")
    assert (np.asarray(Image.open("a.png")) == 255).all()
    assert run(f"render {file} {options} -o a.png -q").stderr == ""


def test_an_offset_that_the_field_does_not_have(here: Path) -> None:
    result = run(f"render {FIELD} --offset -500 --size 30")
    assert re.search(
        r"is empty: the field has distances from -[\d.]+ to [\d.]+, so no surface at -500: choose "
        r"another offset\n",
        result.stderr,
    )


def test_an_octree_without_voxels(here: Path) -> None:
    run("voxelize bunny.obj --bbox 50 50 50 51 51 51 --dim 16 -o none.svo.h5 -q")
    assert read_svo("none.svo.h5").count == 0
    assert "is empty: no voxel of the octree is set\n" in run("render none.svo.h5").stderr


def test_pictures_that_are_not_empty_are_not_warned_of(here: Path) -> None:
    for file in SCENES.values():
        assert "warning" not in run(f"render {file} --size 40").stderr
