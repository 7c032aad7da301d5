"""Uses of a case: a file is read, and its content used if accepted; or a command runs."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import voxtool
from voxtool.files.tables.points import read_points

from . import looks, samples
from .cases import Case
from .judge import Finding, Tools, memory, place_of, reset_peak, run_command, watched

LEAST_LIMIT = 400 << 20  # bytes that a case may take, whatever its size
SHARE_OF_COMMANDS = 0.15  # of the files; the others are used by the library
STYLES = ("marching-cubes", "voxel-faces", "surface-nets")
POINTS = np.array(
    [(0, 0, 0), (0.1, 0.2, 0.3), (-9, 1e-308, 5), (1e308, 0, 0), (np.inf, 0, 1), (np.nan, 0, 0)]
)
# Commands that read a file of each kind, in a folder beside the samples.
COMMANDS: dict[tuple[str, ...], tuple[str, ...]] = {
    samples.OCTREES: (
        "svo-info FILE --json", "svo-info FILE --check", "svo-info FILE --digest",
        "svo-info FILE --set-digest", "svo-dag FILE -o out.svo.h5",
        "svo-query FILE ../../a.csv --level 0 -o out.csv --device DEVICE",
        "combine FILE FILE --op xor -o out.svo.h5 --device DEVICE",
        "render FILE --size 16 -o out.png --device DEVICE", "export FILE -o out.png",
        "extract FILE --check -o out.obj --device DEVICE",
    ),
    samples.FIELDS: (
        "adf-info FILE --json", "adf-query FILE ../../a.csv -o out.csv --device DEVICE",
        "adf-query FILE --slice z=0 --size 200 -o out.png --device DEVICE",
    ),
    samples.VOLUMES: ("render FILE --size 16 --legend -o out.png --device DEVICE",),
    samples.MESHES: (
        "voxelize FILE --dim 16 --json -o out.svo.h5 --device DEVICE",
        "diagnose FILE --dim 16 --json --device DEVICE",
        "adf-build FILE --max-level 3 -o out.adf.h5 --device DEVICE",
        "distance FILE --dim 8 -o out.npy --device DEVICE",
    ),
    looks.MESHES: (
        "voxelize FILE --dim 16 --mode surface26 --attributes colour,normal -o out.svo.h5",
        "voxelize FILE --dim 16 --with-surface --attributes colour --colour nearest -o out.ply",
        "voxelize FILE --dim 16 --labels material -o out.svo.h5",
        "voxelize FILE --dim 16 --labels part --priority last -o out.vdb",
        "voxelize FILE --dim 16 --labels object --json -o out.svo.h5",
    ),
    looks.OCTREES: (
        "svo-info FILE --json", "extract FILE --style voxel-faces --check -o out.ply",
        "extract FILE --style surface-nets --normals -o out.glb", "extract FILE -o out.obj",
        "extract FILE --by label --check -o out.glb", "export FILE -o out.vdb",
        "export FILE -o out.nvdb", "export FILE -o out.vtkhdf", "export FILE -o out.vox",
        "svo-query FILE ../../a.csv --attributes label,colour,normal -o out.csv",
        "morph FILE --dilate 1 -o out.svo.h5", "render FILE --size 16 -o out.png",
    ),
    samples.CELLS: ("tet-build FILE --json -o out.tet.h5",),
    samples.POINTS: ("adf-query ../../a.adf.h5 FILE --gradient -o out.csv --device DEVICE",),
    (*samples.IMAGES, *samples.FOLDERS): (
        "import FILE --json -o out.svo.h5", "import FILE --threshold 0.5 -o out.svo.xml",
        "voxelize ../../a.obj --like FILE --mode surface6 -o out.npz --device DEVICE",
    ),
    samples.REPORTS: (
        "bench compare FILE ../../a.report.json --json", "bench compare ../../a.report.json FILE",
        "bench compare FILE FILE --all --fail-over 10",
    ),
    samples.TRANSFERS: (
        "render ../../a.raycast.tet.h5 --transfer FILE --size 16 -o out.png --device DEVICE",
    ),
}  # fmt: skip


def run(case: Case, tools: Tools) -> list[Finding]:
    """The findings of a case; its file lies in the current folder."""
    tools.findings = []
    what = case.words[0] if case.words else case.format
    before = set(os.listdir())
    reset_peak()
    start = memory("VmRSS")
    if case.words:
        code = run_command(case, tools, arithmetic=True)
        fresh = set(os.listdir()) - before
        if code not in (0, 1) and fresh:
            tools.found("a failed command leaves a file", what, sorted(fresh))
    else:
        use_file(case, tools)
    peak = memory("VmHWM") - start
    if peak > max(LEAST_LIMIT, 3 * len(case.content)):
        place = place_of(tools.deepest, f".{case.format}" if case.format else what)
        tools.found("memory", place, f"{peak >> 20} MiB for a file of {len(case.content)} bytes")
    left = [name for name in os.listdir() if name.endswith(".tmp")]
    if left:
        tools.found("temporary file left", what, left)
    return tools.findings


def use_file(case: Case, tools: Tools) -> None:
    rng = case.rng
    if rng.random() < SHARE_OF_COMMANDS or case.format in samples.REPORTS:
        line = rng.choice(next(lines for kinds, lines in COMMANDS.items() if case.format in kinds))
        inner = "/a.obj" if case.format == looks.FOLDER else ""
        given = {"FILE": f"./{case.name}{inner}", "DEVICE": tools.device_name}
        words = tuple(given.get(word, word) for word in line.split())
        run_command(Case(case.number, words=words), tools)
        return
    read, uses = next(way for kinds, way in WAYS.items() if case.format in kinds)
    with watched(tools, f"reading .{case.format}", names=Path(case.name)) as done:
        done.append(read(case.name))
    if done:
        for use in rng.sample(uses, min(2, len(uses))):
            with watched(tools, f"use of .{case.format}"):
                use(done[0], tools, rng)


# ---- what is done with each kind of content


def use_octree(octree: Any, tools: Tools, rng: random.Random) -> None:
    octree.validate()
    octree.digest(), octree.summary()
    style = rng.choice((*STYLES, None, None))
    if style:
        voxtool.extract(octree, style=style, device=tools.device)
    else:
        voxtool.render(octree, size=(16, 16), device=tools.device)


def combine(octree: Any, tools: Tools, rng: random.Random) -> None:
    operation = rng.choice(("union", "intersection", "difference", "xor"))
    other = rng.choice((octree, voxtool.read_svo(tools.folder / "a.svo.h5")))
    voxtool.combine((octree, other), operation, device=tools.device).validate()


def change(octree: Any, tools: Tools, rng: random.Random) -> None:
    match rng.randrange(4):
        case 0:
            operation = rng.choice(("dilate", "erode", "open", "close"))
            voxtool.morph(octree, operation, rng.choice((1, 2.5)), device=tools.device).validate()
        case 1:
            voxtool.resample(octree, dim=rng.choice((8, 23)), device=tools.device).validate()
        case 2:
            voxtool.thin(octree).validate()
        case _:
            voxtool.components(octree, rng.choice((6, 26)))


def ask(octree: Any, tools: Tools, rng: random.Random) -> None:
    names = tuple(one.name for one in getattr(octree, "attributes", ()))
    voxtool.query_svo(octree, POINTS, attributes=names, device=tools.device)
    more = {"nearest": True} if rng.random() < 0.5 else {"level": rng.choice((0, 1, 2))}
    voxtool.query_svo(octree, POINTS[:4], device=tools.device, **more)


def keep(octree: Any, tools: Tools, rng: random.Random) -> None:
    """Write it in every form, and read it back: the same."""
    kind = rng.choice(("svo.h5", "merged", "vti", "nii.gz", "vox", "vdb", "vtkhdf", "npz"))
    if kind == "svo.h5" or isinstance(octree, voxtool.MergedOctree):
        voxtool.write_svo(octree, "out.svo.h5")
        assert voxtool.read_svo("out.svo.h5").digest() == octree.digest()
    elif kind == "merged":
        merged = voxtool.MergedOctree.of(octree)
        merged.validate()
    else:
        voxtool.export(octree, f"out.{kind}")


def use_distances(field: Any, tools: Tools, rng: random.Random) -> None:
    match rng.randrange(3):
        case 0:
            voxtool.extract(field, device=tools.device)
        case 1:
            voxtool.export(field, f"out.{rng.choice(('vdb', 'nrrd', 'npy', 'vti'))}", shape=9)
        case _:
            voxtool.write_adf(field, "out.adf.h5")
            assert voxtool.read_adf("out.adf.h5").digest() == field.digest()


def keep_volume(volume: Any, tools: Tools, rng: random.Random) -> None:
    if rng.random() < 0.5:
        voxtool.export(volume, f"out.{rng.choice(('vtu', 'vtkhdf'))}")
    voxtool.write_tet(volume, "out.tet.h5")
    assert voxtool.read_tet("out.tet.h5").digest() == volume.digest()


def use_field(field: Any, tools: Tools, rng: random.Random) -> None:
    field.validate()
    field.digest(), field.summary()
    if rng.random() < 0.5:
        voxtool.render(field, size=(16, 16), device=tools.device)
    else:
        options = {name: rng.random() < 0.5 for name in ("gradient", "bounds", "cell")}
        voxtool.query_adf(field, POINTS, device=tools.device, **options)


def use_volume(volume: Any, tools: Tools, rng: random.Random) -> None:
    volume.validate()
    volume.digest()
    method = rng.choice(("raycast", "projection", None))
    more = {"method": method} if method else {"integrator": "preintegrated"}
    voxtool.render(volume, size=(16, 16), device=tools.device, **more)


def voxelize(mesh: Any, tools: Tools, rng: random.Random) -> None:
    mode = rng.choice(("solid", "solid", "surface26", "surface6"))
    fill = rng.choice(("auto", "parity", "nonzero", "winding", "flood"))
    voxtool.voxelize(mesh, None, mode, dim=16, fill=fill, device=tools.device).validate()


def measure(mesh: Any, tools: Tools, rng: random.Random) -> None:
    if rng.random() < 0.5:
        voxtool.diagnose(mesh, dim=16, device=tools.device)
    else:
        voxtool.distance(mesh, POINTS[:3], gradient=True, device=tools.device)


def build_field(mesh: Any, tools: Tools, rng: random.Random) -> None:
    voxtool.build_adf(mesh, max_level=3, device=tools.device).validate()


def write_mesh(mesh: Any, tools: Tools, rng: random.Random) -> None:
    voxtool.write_mesh(mesh, f"out.{rng.choice(('obj', 'ply', 'stl', 'glb', 'off'))}")


def paint(mesh: Any, tools: Tools, rng: random.Random) -> None:
    names = rng.choice((("colour",), ("normal",), ("colour", "normal")))
    mode = rng.choice(("surface26", "surface6", "solid"))
    more = {"attributes": names, "colour": rng.choice(("mean", "nearest"))}
    octree = voxtool.voxelize(mesh, None, mode, dim=16, device=tools.device, **more)
    octree.validate()
    if "colour" in names:
        surfaces_of(octree, tools, rng)


def label(mesh: Any, tools: Tools, rng: random.Random) -> None:
    by = rng.choice(("shell", *mesh.parts))
    octree = voxtool.voxelize(mesh, dim=16, labels=by, device=tools.device)
    octree.validate()
    voxtool.extract(octree, by="label").digest()


def surfaces_of(octree: Any, tools: Tools, rng: random.Random) -> None:
    styles = ("voxel-faces",) if octree.mode.startswith("surface") else STYLES
    surface = voxtool.extract(octree, style=rng.choice(styles), device=tools.device)
    voxtool.write_mesh(surface, f"out.{rng.choice(('obj', 'ply', 'glb'))}")
    if any(one.name == "label" for one in octree.attributes):
        voxtool.write_mesh(voxtool.extract(octree, by="label"), "out.obj")


def export(octree: Any, tools: Tools, rng: random.Random) -> None:
    voxtool.export(octree, f"out.{rng.choice(('vdb', 'nvdb', 'ply', 'vti', 'npz', 'vox'))}")


def read_look(name: str) -> Any:
    path = Path(name, "a.obj") if Path(name).is_dir() else Path(name)
    return voxtool.load_mesh(path, keep=("parts", "appearance"))


def build_volume(mesh: Any, tools: Tools, rng: random.Random) -> None:
    layout = rng.choice(("raycast", "projection", "hexahedra"))
    use_volume(voxtool.build_tet(mesh, layout), tools, rng)


def query(points: np.ndarray, tools: Tools, rng: random.Random) -> None:
    if rng.random() < 0.5:
        voxtool.query_adf(tools.distances, points, gradient=True, bounds=True, device=tools.device)
    else:
        voxtool.distance(tools.mesh, points, gradient=True, device=tools.device)


def render_through(transfer: Any, tools: Tools, rng: random.Random) -> None:
    more = {"transfer": transfer, "method": rng.choice(("raycast", "projection"))}
    voxtool.render(tools.volume, size=(16, 16), device=tools.device, **more)


def read_cells(name: str) -> Any:
    scalar = {"mesh": "medit:ref", "inp": None}.get(name.partition(".")[2], "s")
    return voxtool.read_unstructured(name, scalar)


def read_all_points(name: str) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *read_points(name)])


Use = Callable[[Any, Tools, random.Random], None]
WAYS: dict[tuple[str, ...], tuple[Callable[[str], Any], list[Use]]] = {
    samples.OCTREES: (voxtool.read_svo, [use_octree, combine, change, ask, keep]),
    samples.FIELDS: (voxtool.read_adf, [use_field, use_distances]),
    samples.VOLUMES: (voxtool.read_tet, [use_volume, keep_volume]),
    samples.MESHES: (voxtool.load_mesh, [voxelize, measure, build_field, write_mesh]),
    looks.MESHES: (read_look, [paint, label, write_mesh]),
    looks.OCTREES: (
        voxtool.read_svo,
        [use_octree, surfaces_of, export, combine, change, ask, keep],
    ),
    samples.CELLS: (read_cells, [build_volume]),
    samples.POINTS: (read_all_points, [query]),
    (*samples.IMAGES, *samples.FOLDERS): (voxtool.read_voxels, [use_octree]),
    samples.TRANSFERS: (voxtool.read_transfer, [render_through]),
}
