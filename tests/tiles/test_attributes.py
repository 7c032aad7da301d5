"""Octrees with attributes made in windows: the same content as in one piece, warnings and sums
included, and what a killed run leaves."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, told
from helpers.meshes import UNIT
from svo.voxelization.test_voxelize import lattice_grid, lattice_mesh
from tiles.test_flooding import scraps

import voxtool
from voxtool import tiles
from voxtool.errors import MemoryLimitError
from voxtool.files import read_svo, write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.mesh.appearance import Parts
from voxtool.mesh.joining import join
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.attribution.fraction import FractionJob, plan_fractions
from voxtool.svo.attribution.labels import plan_labels
from voxtool.svo.attribution.part_fractions import plan_part_fractions
from voxtool.svo.octree.stored_volume import stored_volume
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tiles.attributed import SurfaceOfWindows
from voxtool.tiles.fractions import BarsJob
from voxtool.tiles.plan import plan_windows
from voxtool.tiles.windows import WindowsJob


def warned(work: Callable[[], Any]) -> tuple[Any, list[str]]:
    """Return what a call returns, and of what it warns."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        return work(), [str(one.message) for one in found]


@pytest.fixture
def check(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Returns a function that holds windows of `side` voxels against one piece."""
    return partial(hold, device, tmp_path / "octree.svo.h5", monkeypatch)


def hold(
    device: Device, target: Path, monkeypatch: pytest.MonkeyPatch, plan: Any, side: int = 64
) -> Any:
    """Hold windows against one piece; return the job in windows."""

    def shortage(job: Any, made: Any) -> str:
        shape = sorted((getattr(made, "surface", None) or made).grid.shape)
        longest = shape[1] if isinstance(job, BarsJob) else shape[2]
        return "" if longest <= side else "would not fit"

    whole = plan(device=device)
    octree, told_whole = warned(whole.run)
    monkeypatch.setattr(WindowsJob, "_shortage", shortage)
    job = plan_windows(plan(device=device))
    with Windows(str(target), job.request, job.plan.disk) as job.store:
        made, told_windows = warned(job.run)
        notes = list(job.notes(made))
        write_svo(made, target)
    assert job.plan.count > 1
    assert not job.store.folder.exists()
    stored = read_svo(target)
    stored.validate()
    assert made.digest() == octree.digest() == stored.digest()
    assert (made.count, made.nbytes) == (octree.count, octree.nbytes)
    assert [one.summary() for one in made.attributes] == [
        one.summary() for one in octree.attributes
    ]
    if "fraction" in octree.mode:
        assert stored_volume(made) == stored_volume(octree)
    assert told_windows == told_whole
    assert notes == list(whole.notes(octree))
    assert stored.plan == octree.plan
    return job


def surface(
    mesh: Mesh, grid: Grid, names: str, colour: str = "mean", labels: Any = None, **request: Any
) -> Callable[..., Any]:
    """Return a function that plans attributes of the surface."""

    def plan(**more: Any) -> Any:
        if labels:
            inner: Any = plan_labels(mesh, grid, labels=labels, **request, **more)
        else:
            inner = plan_voxelize(mesh, grid, **request, **more)
        return plan_attributes(inner, mesh, names.split(","), colour=colour, **more)

    return plan


def cut(mesh: Mesh) -> Grid:
    """A grid that is no cube, and in which a part of the mesh lies before each side."""
    return Grid.fit(mesh, 300).window((40, 6, 0), (260, 202, 280))


# ---- surfaces


@pytest.mark.parametrize(
    "request_of",
    [
        {"names": "normal,area", "mode": "surface26"},
        {"names": "area", "mode": "surface6"},
        {"names": "normal"},
        {"names": "area,normal", "with_surface": True, "fill": "winding"},
        {"names": "normal", "fill": "flood", "gap": 2},
    ],
    ids=lambda request: "-".join(map(str, request.values())),
)
def test_normals_and_areas(request_of: dict, models: Path, check) -> None:
    mesh = load_mesh(models / "bunny.obj")
    side = 128 if request_of.get("fill") == "flood" else 64
    check(surface(mesh, cut(mesh), **request_of), side)


@pytest.mark.parametrize("fill", ["parity", "flood"])
def test_exposed_voxels_far_from_faces(fill: str, check) -> None:
    """Full cubes beside the end of the grid, which no face reaches; windows beside them."""
    vertices, faces = meshes.box((20, 20, 20), (340, 340, 500))
    mesh = meshes.mesh_of(np.asarray(vertices) + 0.3, faces)
    grid = Grid((350, 350, 256), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    check(surface(mesh, grid, "normal", mode="solid", fill=fill), 128)


@pytest.mark.parametrize("colour", ["mean", "nearest"])
def test_textures(colour: str, models: Path, check) -> None:
    mesh = load_mesh(models / "parts.glb", keep=("appearance",))
    plan = surface(mesh, cut(mesh), "normal,colour", colour, mode="surface26")
    check(plan)


def test_a_large_triangle_between_windows(check) -> None:
    """Faces in the sides of windows, which both sides share, and a slanted one across all."""
    box = lattice_mesh(*meshes.box(64 * UNIT, 192 * UNIT))
    slanted = lattice_mesh(
        np.array([[7, 3, 9], [255, 90, 201], [60, 250, 130]]) * UNIT, [[0, 1, 2]]
    )
    mesh = join([box, slanted])
    plan = surface(mesh, lattice_grid((256, 250, 256)), "area,normal", mode="surface26")
    check(plan)


# ---- labels


def boxes(seed: int, count: int) -> tuple[Mesh, Parts]:
    """Boxes, each a part: most of them small, some across many windows, some beyond the grid."""
    random = np.random.default_rng(seed)
    solids, labels = [], []
    for number in range(count):
        low = random.integers(-10, 200, 3)
        size = random.integers(2, 150 if number % 5 == 0 else 20, 3)
        solids.append(meshes.box(low * UNIT + 9, (low + size) * UNIT + 9))
        labels += [number] * 12
    if seed % 2:  # one part has no lid
        solids[0] = (solids[0][0], solids[0][1][2:])
        labels = labels[2:]
    mesh = lattice_mesh(*meshes.join(*solids))
    return mesh, Parts(np.array(labels, np.int32), tuple(f"part {n}" for n in range(count)))


@pytest.mark.parametrize(
    ("seed", "count", "mode"),
    [(0, 12, "solid"), (1, 12, "surface6"), (2, 12, "surface26"), (1, 260, "solid")],
)
def test_labels(seed: int, count: int, mode: str, check) -> None:
    mesh, parts = boxes(seed, count)
    grid = lattice_grid((200, 170, 190))
    plan = partial(plan_labels, mesh, grid, mode, labels=parts, priority="last")
    job = check(plan)
    assert job.whole.plan.dtype == ("u1" if count < 256 else "u2")


@pytest.mark.parametrize(
    "request_of",
    [{"with_surface": True}, {"fill": "nonzero"}, {"fill": "winding"}],
    ids=lambda request: "-".join(map(str, request.values())),
)
def test_labels_of_open_files(request_of: dict, models: Path, check) -> None:
    found = [load_mesh(models / name) for name in ("bunny.obj", "open.obj")]
    mesh = join(found)
    plan = partial(plan_labels, mesh, cut(mesh), labels="file", **request_of)
    check(plan)


def test_labels_with_colours(models: Path, check) -> None:
    mesh = load_mesh(models / "parts.glb", keep=("parts", "appearance"))
    plan = surface(mesh, cut(mesh), "colour,area", labels="part", with_surface=True)
    check(plan)


def test_a_flooded_part_is_refused(device: Device) -> None:
    mesh, parts = boxes(0, 4)
    grid = lattice_grid((200, 170, 190))
    whole = plan_labels(mesh, grid, labels=parts, fill="flood", device=device)
    with pytest.raises(MemoryLimitError, match="part part 0 is filled by flood, which is not made"):
        plan_windows(whole)


# ---- fractions


@pytest.mark.parametrize(
    "request_of",
    [
        {"kind": "f4", "faces": True},
        {"kind": "u2", "fill": "parity"},
        {"kind": "u1", "fill": "nonzero", "faces": True},
        {"kind": "f4", "fill": "winding"},
    ],
    ids=lambda request: "-".join(map(str, request.values())),
)
def test_fractions(request_of: dict, models: Path, check) -> None:
    mesh = load_mesh(models / "bunny.obj")
    check(partial(plan_fractions, mesh, cut(mesh), **request_of))


@pytest.mark.parametrize("faces", [False, True])
def test_fractions_of_an_open_mesh(faces: bool, models: Path, check) -> None:
    mesh = load_mesh(models / "open.obj")
    plan = partial(plan_fractions, mesh, Grid.fit(mesh, 200), faces=faces)
    check(plan)


@pytest.mark.parametrize("fill", ["parity", "nonzero"])
@pytest.mark.parametrize("seed", [1, 2])
def test_fractions_that_faces_do_not_bound(seed: int, fill: str, check) -> None:
    """Sums along rows that are no whole numbers between touched voxels, also between windows."""
    mesh, grid = lattice_mesh(*scraps(seed)), lattice_grid((200, 170, 190))
    plan = partial(plan_fractions, mesh, grid, fill=fill, faces=True)
    job = check(plan)
    assert job.whole.disagreements


@pytest.mark.parametrize("axis", [1, 2])
def test_fractions_of_plates_in_the_sides_of_bars(axis: int, check) -> None:
    """Thin plates that leave the side between two bars by some units of the lattice, which a box
    beyond the grid makes coarser for all bars."""
    rng, plates = np.random.default_rng(axis), [meshes.box(600, 601)]
    for at in (64, 128):
        vertices, faces = meshes.box([3, 3, at], [187, 190, at])
        vertices = vertices * 2**20 + rng.integers(-9, 10, vertices.shape)
        vertices[:, 2] += 300 * meshes.box(0, 1)[0][:, 2]
        plates.append((np.roll(vertices, axis - 2, axis=1) / 2**20, faces))
    mesh = meshes.mesh_of(*meshes.join(*plates))
    plan = partial(plan_fractions, mesh, lattice_grid((200, 200, 200)), fill="parity", faces=True)
    assert check(plan).whole.plan.solid.bits == 19


@pytest.mark.parametrize(("seed", "kind"), [(0, "f4"), (1, "u1")])
def test_fractions_of_parts(seed: int, kind: str, check) -> None:
    mesh, parts = boxes(seed, 9)
    grid = lattice_grid((200, 170, 190))
    check(partial(plan_part_fractions, mesh, grid, labels=parts, kind=kind))


# ---- windows without voxels


@pytest.mark.parametrize("what", ["surface", "labels", "fractions"])
def test_nothing_between_two_boxes(what: str, check, tmp_path, device: Device) -> None:
    low = meshes.box(3 * UNIT, 40 * UNIT + 9)
    solids = [low, meshes.box(215 * UNIT + 9, 250 * UNIT)]
    mesh, grid = lattice_mesh(*meshes.join(*solids)), lattice_grid((256,) * 3)
    plans = {
        "surface": surface(mesh, grid, "normal", mode="surface26"),
        "labels": partial(plan_labels, mesh, grid, labels="shell"),
        "fractions": partial(plan_fractions, mesh, grid, faces=True),
    }
    job = check(plans[what], 128)
    if what != "fractions":
        assert job.plan.count < 8
    nowhere = lattice_mesh(*meshes.box(300 * UNIT, 310 * UNIT))
    with warnings.catch_warnings(action="ignore"):
        octree = plan_fractions(nowhere, grid, device=device).run()
        job = plan_windows(plan_fractions(nowhere, grid, device=device))
        with Windows(str(tmp_path / "b.svo.h5"), job.request) as job.store:
            made = job.run()
            write_svo(made, tmp_path / "b.svo.h5")
    assert made.digest() == octree.digest()


# ---- in Python

CALLS = {
    "attributes": {"mode": "surface26", "attributes": ("normal",)},
    "labels": {"labels": "part", "priority": "last", "with_surface": True},
    "fractions": {"mode": "fraction", "fraction_type": "u1", "face_fractions": True},
}


@pytest.mark.parametrize("name", CALLS)
def test_windows_in_python(name: str, models: Path, tmp_path, device: Device) -> None:
    call = {"dim": 300, "device": device, **CALLS[name]}
    mesh = models / "parts.glb"
    whole = voxtool.voxelize(mesh, **call)
    limit = int(0.7 * voxtool.plan_voxelize(mesh, **call).cost.device)
    found = tiles.voxelize(mesh, max_memory=limit, **call)
    assert found == whole
    target = tmp_path / "a.svo.h5"
    written = tiles.voxelize(mesh, max_memory=limit, file=target, **call)
    assert written.digest() == whole.digest() == read_svo(target).digest()


# ---- the command line

COMMANDS = {
    "attributes": "parts.glb --dim 300 --mode surface26 --attributes normal,colour",
    "labels": "parts.glb --dim 300 --labels part --with-surface",
    "fractions": "bunny.obj --dim 300 --mode fraction --face-fractions",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_windows_of_the_command_line(name: str, here: Path) -> None:
    command = f"voxelize {COMMANDS[name]} --json"
    whole = told(f"{command} -o whole.svo.h5")
    limit = told(f"{command} --plan")["predicted_device_bytes"] * 6 // 10
    less = f"{command} -o parts.svo.h5 --max-memory {limit}"
    plan: dict = told(f"{less} --plan")
    assert plan["windows"] > 1
    assert plan["predicted_device_bytes"] <= limit
    parts = told(less)
    same = {*whole} - {"output", "stages", "seconds"}
    assert {key: parts[key] for key in same} == {key: whole[key] for key in same}
    assert Path("parts.svo.h5").read_bytes() == Path("whole.svo.h5").read_bytes()
    run("svo-info parts.svo.h5 --check")
    assert f"{plan['windows']} " in run(f"{less.replace('--json', '')} --plan").stdout
    fail(f"{less} --windows never", 4)


class Killed(Exception):
    """Stands for a kill."""


@pytest.mark.parametrize("left", [1, 4, 9])
def test_a_killed_run_goes_on(left: int, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = "voxelize bunny.obj --dim 300 --mode fraction --face-fractions --json"
    whole, shares, found = told(f"{command} -o whole.svo.h5"), FractionJob.shares, [left]

    def dies(job: FractionJob, axis_alone: int | None = None) -> Any:
        if not found[0]:
            raise Killed
        found[0] -= 1
        return shares(job, axis_alone)

    monkeypatch.setattr(FractionJob, "shares", dies)
    limit = told(f"{command} --plan")["predicted_device_bytes"] * 6 // 10
    less = f"{command} -o parts.svo.h5 --max-memory {limit}"
    bars = told(f"{less} --plan")["windows"]
    assert bars > 10
    with pytest.raises(Killed):
        run(less)
    found[0] = 1000
    assert told(f"{less} --resume")["digest"] == whole["digest"]
    assert 1000 - found[0] == bars - left
    assert not Path("parts.svo.h5.windows").exists()


def test_exposed_voxels_of_a_killed_run(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that were completed are not changed again; the others are."""
    command = "voxelize bunny.obj --dim 200 --attributes normal --json"
    whole, left = told(f"{command} -o whole.svo.h5"), [5]
    complete = SurfaceOfWindows._complete_window

    def dies(surface: SurfaceOfWindows, *given: Any) -> None:
        if not left[0]:
            raise Killed
        left[0] -= 1
        complete(surface, *given)

    monkeypatch.setattr(SurfaceOfWindows, "_complete_window", dies)
    limit = told(f"{command} --plan")["predicted_device_bytes"] * 5 // 10
    less = f"{command} -o parts.svo.h5 --max-memory {limit}"
    assert told(f"{less} --plan")["windows"] > 5
    with pytest.raises(Killed):
        run(less)
    left[0] = 1000
    assert told(f"{less} --resume")["digest"] == whole["digest"]
    assert not Path("parts.svo.h5.windows").exists()


def test_windows_of_labels_are_of_their_request(here: Path, monkeypatch) -> None:
    command = "voxelize parts.glb --dim 400 --labels part -o parts.svo.h5 --max-memory 6M"
    run("voxelize parts.glb --dim 400 --labels part -o whole.svo.h5")
    put, left = Windows.put, [3]

    def dies(*given: Any) -> None:
        put(*given)
        left[0] -= 1
        if not left[0]:
            raise Killed

    monkeypatch.setattr(Windows, "put", dies)
    with pytest.raises(Killed):
        run(command)
    assert "is of another mesh, grid or options" in fail(f"{command} --priority last --resume", 3)
    run(f"{command} --resume")
    assert Path("parts.svo.h5").read_bytes() == Path("whole.svo.h5").read_bytes()


def test_what_is_not_made_in_windows_is_named(here: Path) -> None:
    command = "voxelize bunny.obj open.obj --dim 300 --labels file --fill flood -o x.svo.h5"
    assert "part bunny is filled by flood" in fail(f"{command} --max-memory 1M", 4)
    assert "no dim fits" in fail("voxelize bunny.obj --mode fraction --max-memory 20k", 4)
    assert "windows wait beside the output" in fail(
        "voxelize bunny.obj --dim 300 --mode fraction --max-memory 1M -o -", 2
    )
