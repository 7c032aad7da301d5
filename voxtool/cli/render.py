"""voxtool render: a picture of an octree, a distance field or a volume."""

from __future__ import annotations

import hashlib
import warnings
from contextlib import ExitStack
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import COLOUR_BY, LABEL, METHODS, SEARCHES, VIEWS, WHITE
from voxtool.cli import options, runner
from voxtool.cli.options import (
    LEVEL,
    POSITIVE,
    List,
    Parsed,
    flag,
    numbers_of,
    option,
    output_of,
    together,
)
from voxtool.errors import VoxtoolWarning, printable
from voxtool.tets.pictures.maps import MAPS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import numpy as np

    from voxtool.camera import Camera
    from voxtool.cli.runner import Run
    from voxtool.pictures.rendering import RenderJob
    from voxtool.tets.pictures.transfer import TransferFunction
    from voxtool.tets.volume.volume import TetVolume

NUMBER = Parsed("number", lambda text: numbers_of(text, 1)[0], " is no finite number")
VECTOR = Parsed("vector", lambda text: numbers_of(text, 3), ": write three numbers, as 1,2.5,-3")
DIRECTION = Parsed("vector", options.direction_of, ": write 0,0,1, z or -z")
RANGE = Parsed(
    "range",
    lambda text: text if text == "full" else options.places_of(text, 2),
    ": write two numbers or percentiles, as 0.5,2 or 75%,99%, or full",
)
SIZE = Parsed("size", options.size_of, " is no size: write 800x600, or 512 for both sides")
NO_COLOUR = " is no colour: write #ff8000, 1,0.5,0 (from 0 to 1), white, black"
COLOUR = Parsed("colour", options.colour_of, NO_COLOUR)
BACKGROUND = Parsed(
    "colour", lambda text: text if text == "none" else options.colour_of(text), f"{NO_COLOUR}, none"
)
# The parameters of a transfer function, and those that only some kinds of content have.
MAKERS = {
    "map_name": "--map",
    "opacity_range": "--opacity-range",
    "unit_distance": "--unit-distance",
}
OPTIONS_OF = {
    "octree": ("level", "isovalues", "colour", "other", "colour_by", "only", "legend"),
    "field": ("offset", "search", "colour"),
    "volume": (
        "transfer_file", *MAKERS, "method", "integrator", "legend", "isovalues", "opacity",
        "colour",
    ),
}  # fmt: skip


@click.command("render")
@click.argument("file")
@together(
    option("--view", VIEWS, "Where to look from, with all in the picture.  [default: iso]"),
    option("--eye", VECTOR, "Where to look from, in world units.", metavar="X,Y,Z"),
    option("--target", VECTOR, "With --eye: what to look at.  [default: the middle]",
        metavar="X,Y,Z"),
    option("--up", DIRECTION, "What is up: a direction, or x, y, z, -x, ...  [default: y]",
        metavar="X,Y,Z|AXIS"),
    option("--fov", click.FloatRange(0.01, 170),
        "Degrees that the picture's shorter side takes.  [default: 30]", metavar="DEG"),
    flag("--orthographic", "Parallel rays, without perspective."),
    option("--height", POSITIVE,
        "With --orthographic: what the shorter side shows, in world units.  [default: all]",
        metavar="WORLD"),
    option("--turn", NUMBER,
        "Turn the camera around the target by this angle, about --up.",
        metavar="DEG"),
    option("--turntable", click.IntRange(2, 3600),
        "Draw N frames of a whole turn, as .gif, .webp, .mp4 or spin%03d.png.", metavar="N"),
    option("--fps", click.FloatRange(0.1, 50),
        "With --turntable: frames a second.  [default: a turn in six seconds, at most 50]",
        metavar="F"),
    option("--size", SIZE, "Pixels.  [default: 512x512]", (512, 512), metavar="WxH|N"),
    option("--samples", click.IntRange(1, 16),
        "N x N rays a pixel, whose mean it shows.  [default: 2 for octrees and fields, which have "
        "sharp edges; 1 for volumes]", metavar="N"),
    option("--level", LEVEL,
        "Octrees: draw nodes of this level as cubes; 0 are bricks of 4 x 4 x 4 voxels.  "
        "[default: voxel]", metavar="N|voxel"),
    option("--difference other", str,
        "Octrees: colour what only FILE has vermilion, and what only OTHER has, on the same grid, "
        "blue.", metavar="OTHER"),
    option("--colour-by", COLOUR_BY,
        "Octrees with attributes: the one whose colours are drawn.  [default: colour, or else "
        "label, if it has one]"),
    option("--only", str, "Octrees with labels: draw the voxels of these labels alone.",
        metavar="NAME[,NAME...]"),
    option("--offset", NUMBER,
        "Fields: the surface at this distance from the mesh's, in world units; negative inside.",
        metavar="D"),
    option("--search", SEARCHES,
        "Fields: rays find each leaf by the hash, as in adf-query, for the same picture.  "
        "[default: blocks know their children's, and nothing is searched]"),
    option("--colour", COLOUR,
        "Colour of the surface, #ff8000 or 1,0.5,0.  [default: light grey; isosurfaces: the map's]",
        metavar="COLOUR"),
    option("--isovalue isovalues", List(NUMBER),
        "Octrees with --level: draw the nodes of which at least the share V is set, above 0 and "
        "at most 1.  [default: any share]  Volumes: draw the surfaces where the scalar is V; "
        "alone, or within --transfer, --map or --opacity-range if one is given.",
        metavar="V[,V...]"),
    option("--iso-opacity opacity", click.FloatRange(0, 1, min_open=True),
        "Opacity of the surfaces of --isovalue.  [default: 1]", metavar="A"),
    option("--transfer transfer_file", str,
        "Volumes: the transfer function, control points of colour and extinction.",
        metavar="FILE.json"),
    option("--map map_name", tuple(MAPS),
        "Volumes: a map of colours over the data's range, instead.  [default: viridis]"),
    option("--opacity-range", RANGE,
        "Volumes: scalars at which a map's extinction is 0 and full, or percentiles of the volume; "
        "A may be the higher one; full: the data's range.  [default: 75%,99%]",
        metavar="A,B|A%,B%|full"),
    option("--unit-distance", POSITIVE,
        "Volumes: the way through full extinction that leaves 1/e of the light, in world units.  "
        "[default: a 24th of the longest side]", metavar="D"),
    option("--method", METHODS,
        "Volumes: follow rays from cell to cell, or project cells in order.  [default: raycast]"),
    option("--integrator", str,
        "Volumes: linear (exact), preintegrated (by a table), average or sampled:N (N points a "
        "cell).  [default: linear]", metavar="NAME"),
    flag("--legend",
        "Volumes: draw the transfer function beside it.  Octrees: the names of their labels."),
    option("--background", BACKGROUND,
        "Colour behind it, or none: a transparent picture.  [default: white]", metavar="COLOUR"),
    option("--bits", ("8", "16"), "Bits of each value in a .png.  [default: 8]"),
    flag("--float as_float",
        "Write .npy: (height, width, 4) float32, premultiplied red, green, blue and opacity."),
)  # fmt: skip
@runner.job_options(
    "PICTURE", "Default FILE's name with .png, or with --float .npy, in this folder."
)
def command(
    run: Run, file: str, size: tuple[int, int], samples: int | None, background: Any,
    bits: str | None, as_float: bool, turntable: int | None, fps: float | None, **request: Any,
) -> None:  # fmt: skip
    """Draw a picture of an octree, a distance field or a volume FILE.

    FILE is what voxelize, adf-build or tet-build wrote, or - for stdin. Lengths are in world units,
    angles in degrees, sizes in pixels. What is computed is written as it is, without a gamma.

    \b
    Examples:
      voxtool render bunny.svo.h5 -o bunny.png
      voxtool render bunny.svo.h5 --level 0 --isovalue 0.5 -o coarse.png
      voxtool render bunny.adf.h5 --view front --samples 2 --background none
      voxtool render volume.tet.h5 --legend --size 800x600
      voxtool render bunny.svo.h5 --turntable 24 --size 128 -o spin.gif
      voxtool render volume.tet.h5 --isovalue 0.2,0.4 --iso-opacity 0.6 -o surfaces.png
    """
    check_request(request)
    check_rays(size, samples)
    from voxtool.files import open_scene
    from voxtool.files.pictures.animation import rate_of, write_animation
    from voxtool.files.pictures.picture import FORMATS, check_writer, write_picture
    from voxtool.pictures.rendering import camera_for, plan_render

    if turntable is not None:
        choose_animation(run, file, as_float, bits, fps, background)
    elif fps:
        raise click.UsageError("--fps is of the frames of --turntable: give N")
    else:
        if run.output in (None, "-"):
            run.file_format = "npy" if as_float else "png"
        run.to(file, output_of(file, "npy" if as_float else "png"), FORMATS)
        check_format(run, as_float)
    depth = int(bits or 8)
    if run.file_format != "npy" and not run.only_plan:
        check_writer(depth)
    paper = None if background == "none" else background or WHITE
    with run, ExitStack() as stack:
        content: Any = run.stage("read file", stack.enter_context, open_scene(file))
        with run.naming(file):
            content, request["level"] = fitting(
                run, content, request["level"], attributes_of(content, request),
                alone=request["other"] is None, asked=asks_for_attributes(request),
            )  # fmt: skip
            shown = options_of(content, file, request)
            if turntable is not None:
                request["turn"] = request["turn"] or 0.0
            camera = camera_for(content, size=size, **camera_options(request), **shown)
            job = run.plan(plan_render, content, camera, size=size, samples=samples, **shown)
            drawn = run.job(job)
        picture = with_legend(drawn, job, paper) if request["legend"] else drawn
        if turntable is None:
            run.write(write_picture, picture, bits=depth, background=paper)
        else:
            frames = turned(picture, job, camera, turntable, request["legend"], paper)
            rate = Fraction(fps).limit_denominator(1000) if fps else rate_of(turntable)
            run.write(write_animation, frames, rate=rate)
    hit = float((drawn[..., 3] != 0).mean())
    text = f"{size[0]} x {size[1]}, {viewpoint(request)}, {100 * hit:.3g} % of pixels hit"
    if turntable is not None:
        text = f"{turntable:,} frames, the first {text}"
    run.report(f"{text}, {run.size}", lambda: summary(job, drawn, hit))


def asks_for_attributes(request: dict[str, Any]) -> bool:
    """Return whether options ask for attributes of an octree by name."""
    return request["colour_by"] is not None or "only" in given_of(request) or request["legend"]


def attributes_of(content: Any, request: dict[str, Any]) -> set[str]:
    """Return the attributes that a picture of an octree needs."""
    from voxtool.svo.pictures.painting import painted

    return {painted(content, request["colour_by"]), *([LABEL] if request["only"] else [])}


def fitting(
    run: Run, content: Any, level: int | str | None, attributes: Collection[str],
    alone: bool = True, asked: bool = False,
) -> tuple[Any, int | str | None]:  # fmt: skip
    """Return what a picture shows of the content of a file, and the level. An octree that does not
    fit in memory and is drawn alone shows its upper nodes. Attributes that do not fit are left
    out, with a warning, unless they are asked for."""
    from voxtool.svo.octree.content import StoredAttributedOctree, StoredOctree
    from voxtool.svo.octree.octree import in_memory
    from voxtool.svo.pictures.coarsen import fitting_octree

    if not isinstance(content, StoredOctree):
        return content, level
    if asked and isinstance(content, StoredAttributedOctree):
        for name in filter(None, attributes):
            content.attribute(name)  # or an error that says which there are
    content = content.only(attributes)
    if not alone or (asked and content.attributes):
        return run.stage("read file", in_memory, content, run.max_memory), level
    wanted = "voxel" if level is None else level
    octree, finest = run.stage("read file", fitting_octree, content, wanted, run.max_memory)
    held = [one.name for one in octree.attributes]
    if lost := [one.name for one in content.attributes if one.name not in held]:
        warnings.warn(
            f"the attribute{'s' * (len(lost) > 1)} {', '.join(lost)} would not fit in memory, and "
            "the octree is drawn without (see --max-memory)",
            VoxtoolWarning,
            stacklevel=2,
        )
    if finest == wanted:
        return octree, level
    drawn = "voxels" if wanted == "voxel" else f"those of level {wanted}"
    warnings.warn(
        f"the octree does not fit in memory: nodes of level {finest} are drawn instead of {drawn} "
        "(see --max-memory)",
        VoxtoolWarning,
        stacklevel=2,
    )
    return octree, finest


def choose_animation(
    run: Run, file: str, as_float: bool, bits: str | None, fps: float | None, background: Any
) -> None:
    """Choose the output of a turntable; refuse options and formats that do not go with it."""
    from voxtool.files.pictures.animation import FORMATS, check_video, numbered

    if as_float or bits:
        raise click.UsageError(f"{'--float' if as_float else '--bits'} goes with one picture: "
                               "--turntable writes frames of 8 bits")  # fmt: skip
    if run.output == "-":
        run.file_format = run.file_format or "gif"
    run.to(file, output_of(file, "gif"), FORMATS)
    if run.file_format == "png":
        numbered(run.output or "", 0)
        if fps:
            raise click.UsageError(f"--fps is of animations: {run.output} are single pictures")
    if run.file_format == "mp4":
        if background == "none":
            raise click.UsageError("videos have no transparency: drop --background none, or write "
                                   ".webp")  # fmt: skip
        check_video()


def turned(
    first: np.ndarray, job: RenderJob, camera: Camera, count: int, legend: bool, paper: Any
) -> Iterator[np.ndarray]:
    """Yield the frames of a whole turn, (H, W, 3 or 4) uint8, drawn one by one as they are asked
    for. The content stays on the device."""
    from dataclasses import replace

    from voxtool.files.pictures.picture import rounded

    yield rounded(first, 8, paper)
    width, height = job.rays.size
    for number in range(1, count):
        rays = camera.turned(360 * number / count).rays(width, height)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a frame in which nothing is: the first has told
            drawn = replace(job, rays=rays).run()
        yield rounded(with_legend(drawn, job, paper) if legend else drawn, 8, paper)


def check_rays(size: tuple[int, int], samples: int | None) -> None:
    """Refuse more rays along a side than are cast."""
    from voxtool.camera import MAX_SIDE

    across = (samples or 1) * max(size)
    if across > MAX_SIDE:
        raise click.UsageError(
            f"--size {size[0]}x{size[1]} with --samples {samples or 1} is {across} rays along a "
            f"side, of {MAX_SIDE} that are cast: choose less"
        )


def check_format(run: Run, as_float: bool) -> None:
    """Refuse options that do not go with the format of the file."""
    if as_float and run.file_format != "npy":
        raise click.UsageError(f"--float writes .npy, and {run.output} ends in .{run.file_format}")
    if run.file_format == "npy":
        for name in ("bits", "background", "legend"):
            if click.get_current_context().params[name]:
                raise click.UsageError(f"--{name} goes with .png: .npy holds the values themselves")


def check_request(request: dict[str, Any]) -> None:
    """Refuse options that contradict each other."""
    given = set(given_of(request))
    parallel = "orthographic" in given
    for wrong, message in (
        ({"eye", "view"} <= given, "--eye and --view both place the camera: drop one"),
        ({"target"} == given & {"target", "eye"},
         "--target goes with --eye: views look at the middle"),
        (parallel and "fov" in given, "--fov is of a perspective: --orthographic has --height"),
        ("height" in given and not parallel,
         "--height goes with --orthographic: a perspective has --fov"),
        ("opacity" in given and "isovalues" not in given,
         "--iso-opacity is of the surfaces of --isovalue: give one"),
        *(({"transfer_file", name} <= given,
           f"{maker} makes a transfer function: drop it or --transfer")
          for name, maker in MAKERS.items()),
    ):  # fmt: skip
        if wrong:
            raise click.UsageError(message)


def with_transfer(request: dict[str, Any]) -> bool:
    """Return whether a volume is drawn through a transfer function: not isosurfaces alone."""
    given = given_of(request)
    return "isovalues" not in given or not given.keys().isdisjoint({"transfer_file", *MAKERS})


def given_of(request: dict[str, Any]) -> dict[str, Any]:
    """Return the options that were given: 0 is a value, too."""
    return {n: value for n, value in request.items() if value is not None and value is not False}


def options_of(content: Any, source: str, request: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the picture that go with the content of the file.

    Raises
    ------
    click.UsageError : an option was given that goes with another kind of file.
    """
    from voxtool.pictures.rendering import SCENES
    from voxtool.svo.pictures.painting import painted

    kind, given = SCENES[type(content)].kind, given_of(request)
    for parameter in click.get_current_context().command.params:
        kinds = [k for k, names in OPTIONS_OF.items() if parameter.name in names]
        if kinds and kind not in kinds and parameter.name in given:
            article = "an" if kind[0] in "aeiou" else "a"
            raise click.UsageError(
                f"{parameter.opts[0]} goes with {' and '.join(f'{k}s' for k in kinds)}: "
                f"{source} holds {article} {kind}"
            )
    drawn = {"level", "offset", "search", "colour", "method", "integrator", "isovalues", "opacity",
             "colour_by"}  # fmt: skip
    shown = {name: value for name, value in given.items() if name in drawn}
    if "other" in given:
        from voxtool.files import open_svo
        from voxtool.svo.octree.content import StoredOctree
        from voxtool.svo.octree.octree import in_memory

        if source == given["other"] == "-":
            raise options.input_twice("FILE", "OTHER")
        with open_svo(given["other"]) as other:  # whose attributes are not drawn
            stored = isinstance(other, StoredOctree)
            shown["other"] = in_memory(other.only(())) if stored else other
    if kind == "octree" and "isovalues" in shown:
        shown["isovalue"], *more = shown.pop("isovalues")
        if more:
            raise click.UsageError("--isovalue of an octree is one share: give one number")
    if kind == "volume" and "colour" in given and "isovalues" not in given:
        raise click.UsageError("--colour of a volume is that of --isovalue: give one")
    if "only" in given:
        shown["only"] = tuple(given["only"].split(","))
    if kind == "octree" and "legend" in given and painted(content, given.get("colour_by")) != LABEL:
        raise click.UsageError(
            "--legend of an octree names its labels, which are not drawn: give --colour-by label"
        )
    if kind == "volume" and "legend" in given and not with_transfer(request):
        raise click.UsageError(
            "--legend shows a transfer function, and --isovalue alone has none: give --map, too"
        )
    if kind == "volume" and with_transfer(request):
        shown["transfer"] = transfer_of(content, request)
    return shown


def transfer_of(volume: TetVolume, request: dict[str, Any]) -> TransferFunction:
    """Return the transfer function that the options name."""
    from voxtool.files.pictures.transfer import read_transfer
    from voxtool.tets.pictures.transfer import DEFAULT_MAP, default_transfer

    if request["transfer_file"] is not None:
        return read_transfer(request["transfer_file"])
    return default_transfer(
        volume,
        request["map_name"] or DEFAULT_MAP,
        opacity_range=request["opacity_range"],
        unit_distance=request["unit_distance"],
    )


def camera_options(request: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the camera as camera_for takes them."""
    names = {"view", "eye", "target", "up", "fov", "height", "turn"}
    given = {name: value for name, value in given_of(request).items() if name in names}
    return {**given, "fov": None} if request["orthographic"] else given


def viewpoint(request: dict[str, Any]) -> str:
    """Return the place of the camera in words."""
    where = f"{request['view'] or 'iso'} view"
    if request["eye"]:
        where = f"from ({', '.join(f'{v:g}' for v in request['eye'])})"
    turn = request["turn"]
    return where if turn is None else f"{where}, turned {turn:g} degrees"


def with_legend(picture: np.ndarray, job: RenderJob, background: Any) -> np.ndarray:
    """Return the picture with the legend of its labels or transfer function at the right."""
    import numpy as np

    from voxtool.pictures.legend import draw_legend
    from voxtool.tets.pictures.transfer import scalar_shares

    scene: Any = job.plan.scene
    if scene.kind == "octree":
        from voxtool.pictures.label_legend import draw_label_legend
        from voxtool.svo.octree.label_counts import label_counts

        (counts, _), names = label_counts(scene.content), scene.content.attribute(LABEL).names
        rows = [(n, printable(name)) for n, name in enumerate(names) if counts[n]]
        legend = draw_label_legend(rows, len(picture), background=background)
        return np.concatenate([picture, legend], axis=1)
    volume = scene.content
    legend = draw_legend(
        scene.shown_through,
        volume.scalar_range,
        printable(volume.scalar),
        len(picture),
        unit=printable(volume.units),
        background=background,
        shares=scalar_shares(volume),
    )
    return np.concatenate([picture, legend], axis=1)


def summary(job: RenderJob, picture: np.ndarray, hit: float) -> dict[str, Any]:
    """Return the facts of the report; the digest is of the picture before it is rounded."""
    described = job.describe()
    return {
        **{name: described[name] for name in ("kind", "size", "samples")},
        **job.plan.scene.counts,
        "pixels_hit": hit,
        "digest": hashlib.sha256(picture.astype("<f4").tobytes()).hexdigest(),
    }
