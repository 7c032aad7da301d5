"""voxtool render: a picture of an octree, a distance field or a volume."""

from __future__ import annotations

import hashlib
import math
import sys
import time
from contextlib import contextmanager
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import METHODS, VIEWS
from voxtool.cli import options
from voxtool.cli.extract import Level
from voxtool.errors import FileError, MemoryLimitError, VoxtoolError, human, printable
from voxtool.tets.maps import MAPS

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from voxtool.rendering import RenderJob
    from voxtool.tets.transfer import TransferFunction
    from voxtool.tets.volume import TetVolume

SIZE = (512, 512)  # pixels
MOST_SAMPLES = 16  # along a pixel's side
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
# The options that make a transfer function, by their parameters.
MAKERS = {
    "map_name": "--map",
    "opacity_range": "--opacity-range",
    "unit_distance": "--unit-distance",
}
# The options that go with some kinds of scenes only, by their parameters.
BELONGS = {
    "level": ("octree",),
    "offset": ("field",),
    "colour": ("octree", "field"),
    "transfer_file": ("volume",),
    "map_name": ("volume",),
    "opacity_range": ("volume",),
    "unit_distance": ("volume",),
    "method": ("volume",),
    "integrator": ("volume",),
    "legend": ("volume",),
}


class Number(click.ParamType):
    """A finite number, or a positive one."""

    name = "number"

    def __init__(self, positive: bool = False) -> None:
        self.positive = positive

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        numbers = numbers_of(value, 1)
        if numbers is None or (self.positive and numbers[0] <= 0):
            kind = "positive" if self.positive else "finite"
            self.fail(f"{value!r} is no {kind} number", param, ctx)
        return numbers[0]


class Vector(click.ParamType):
    """X,Y,Z; a direction may be an axis: z or -y."""

    name = "vector"

    def __init__(self, axes: bool = False) -> None:
        self.axes = axes

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value  # pyright: ignore[reportReturnType]
        numbers = numbers_of(value, 3)
        if numbers is not None:
            return numbers[0], numbers[1], numbers[2]
        axis = AXES.get(value[-1:].lower())
        if self.axes and axis and value[:-1] in ("", "+", "-"):
            sign = -1.0 if value[:-1] == "-" else 1.0
            return sign * axis[0], sign * axis[1], sign * axis[2]
        mend = "write 0,0,1, z or -z" if self.axes else "write three numbers, as 1,2.5,-3"
        self.fail(f"{value!r}: {mend}", param, ctx)


class Pair(click.ParamType):
    """A,B."""

    name = "pair"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        numbers = numbers_of(value, 2)
        if numbers is None:
            self.fail(f"{value!r}: write two numbers, as 0.5,2", param, ctx)
        return numbers[0], numbers[1]


class Size(click.ParamType):
    """WIDTHxHEIGHT, or one number for both."""

    name = "size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        width, times, height = str(value).lower().partition("x")
        sides = (width, height if times else width)
        if not all(side.isdecimal() and 0 < len(side) < 7 and int(side) for side in sides):
            self.fail(f"{value!r} is no size: write 800x600, or 512 for both sides", param, ctx)
        return int(sides[0]), int(sides[1])


class Colour(click.ParamType):
    """Red, green and blue: #ff8000, or 1,0.5,0; white and black have names."""

    name = "colour"

    def __init__(self, none: bool = False) -> None:
        self.none = none

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...] | str:
        if isinstance(value, tuple) or (self.none and value == "none"):
            return value
        if value in COLOURS:
            return COLOURS[value]
        hexadecimal = value.removeprefix("#")
        if value.startswith("#") and len(hexadecimal) == 6 and hexadecimal.isalnum():
            try:
                return tuple(byte / 255 for byte in bytes.fromhex(hexadecimal))
            except ValueError:
                pass
        numbers = numbers_of(value, 3)
        if numbers is None or not all(0 <= v <= 1 for v in numbers):
            known = "white, black, none" if self.none else "white, black"
            self.fail(
                f"{value!r} is no colour: write #ff8000, 1,0.5,0 (from 0 to 1), {known}", param, ctx
            )
        return numbers


def numbers_of(text: Any, count: int) -> tuple[float, ...] | None:
    """So many finite numbers with commas between them, or None."""
    try:
        numbers = tuple(float(word) for word in str(text).split(","))
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


@click.command("render")
@click.argument("file")
@options.output_options(
    "PICTURE", "Default FILE's name with .png, or with --float .npy, in this folder."
)
@click.option(
    "--view",
    type=click.Choice(VIEWS),
    help="Where to look from, with all in the picture.  [default: iso]",
)
@click.option("--eye", type=Vector(), metavar="X,Y,Z", help="Where to look from, in world units.")
@click.option(
    "--target",
    type=Vector(),
    metavar="X,Y,Z",
    help="With --eye: what to look at.  [default: the middle]",
)
@click.option(
    "--up",
    type=Vector(axes=True),
    metavar="X,Y,Z|AXIS",
    help="What is up: a direction, or x, y, z, -x, ...  [default: y]",
)
@click.option(
    "--fov",
    type=click.FloatRange(0.01, 170),
    metavar="DEG",
    help="Degrees that the picture's shorter side takes.  [default: 30]",
)
@click.option("--orthographic", is_flag=True, help="Parallel rays, without perspective.")
@click.option(
    "--height",
    type=Number(positive=True),
    metavar="WORLD",
    help="With --orthographic: what the shorter side shows, in world units.  [default: all]",
)
@click.option(
    "--turn",
    type=Number(),
    metavar="DEG",
    help="Go around the target by so many degrees, about --up: for turntables.",
)
@click.option(
    "--size", type=Size(), default=SIZE, metavar="WxH|N", help="Pixels.  [default: 512x512]"
)
@click.option(
    "--samples",
    type=click.IntRange(1, MOST_SAMPLES),
    metavar="N",
    help="N x N rays a pixel, whose mean it shows.  [default: 2 for octrees and fields, which have "
    "sharp edges; 1 for volumes]",
)
@click.option(
    "--level",
    type=Level(),
    metavar="N|voxel",
    help="Octrees: draw nodes of this level as cubes; 0 are bricks of 4 x 4 x 4 voxels.  "
    "[default: voxel]",
)
@click.option(
    "--offset",
    type=Number(),
    metavar="D",
    help="Fields: the surface at this distance from the mesh's, in world units; negative inside.",
)
@click.option(
    "--colour",
    type=Colour(),
    metavar="COLOUR",
    help="Octrees and fields: the surface's, #ff8000 or 1,0.5,0.  [default: light grey]",
)
@click.option(
    "--transfer",
    "transfer_file",
    metavar="FILE.json",
    help="Volumes: the transfer function, control points of colour and extinction.",
)
@click.option(
    "--map",
    "map_name",
    type=click.Choice(MAPS),
    help="Volumes: a map of colours over the data's range, instead.  [default: viridis]",
)
@click.option(
    "--opacity-range",
    type=Pair(),
    metavar="A,B",
    help="Volumes: scalars at which a map's extinction is 0 and full; A may be the higher one.  "
    "[default: the data's range]",
)
@click.option(
    "--unit-distance",
    type=Number(positive=True),
    metavar="D",
    help="Volumes: the way through full extinction that leaves 1/e of the light, in world units.  "
    "[default: a 24th of the longest side]",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    help="Volumes: follow rays from cell to cell, or project cells in order.  [default: raycast]",
)
@click.option(
    "--integrator",
    metavar="NAME",
    help="Volumes: linear (exact), preintegrated (by a table), average or sampled:N (N points a "
    "cell).  [default: linear]",
)
@click.option("--legend", is_flag=True, help="Volumes: draw the transfer function beside it.")
@click.option(
    "--background",
    type=Colour(none=True),
    metavar="COLOUR",
    help="Colour behind it, or none: a transparent picture.  [default: white]",
)
@click.option(
    "--bits", type=click.Choice(["8", "16"]), help="Of each value in a .png.  [default: 8]"
)
@click.option(
    "--float",
    "as_float",
    is_flag=True,
    help="Write .npy: (height, width, 4) float32, premultiplied red, green, blue and opacity.",
)
@options.plan_options
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    file: str,
    output: str | None,
    no_clobber: bool,
    size: tuple[int, int],
    samples: int | None,
    background: Any,
    bits: str | None,
    as_float: bool,
    only_plan: bool,
    max_memory: int | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **request: Any,
) -> None:
    """Draw a picture of an octree, a distance field or a volume FILE.

    FILE is what voxelize, adf-build or tet-build wrote, or - for stdin. Lengths are in world units,
    angles in degrees, sizes in pixels. What is computed is written as it is, without a gamma.

    \b
    Examples:
      voxtool render bunny.svo.h5 -o bunny.png
      voxtool render bunny.adf.h5 --view front --samples 2 --background none
      voxtool render volume.tet.h5 --legend --size 800x600
    """
    check_request(request)
    started = time.perf_counter()
    source = file if file != "-" else "stdin"
    from voxtool.camera import MAX_SIDE
    from voxtool.files import check_target, read_scene
    from voxtool.files.picture import WHITE, check_writer, write_picture
    from voxtool.opencl import open_device
    from voxtool.rendering import camera_for, plan_render

    across = (samples or 1) * max(size)
    if across > MAX_SIDE:
        raise click.UsageError(
            f"--size {size[0]}x{size[1]} with --samples {samples or 1} is {across} rays along a "
            f"side, of {MAX_SIDE} that are cast: choose less"
        )
    output, file_format = output_of(file, output, as_float)
    if file_format == "npy":
        for name in ("bits", "background", "legend"):
            if click.get_current_context().params[name]:
                raise click.UsageError(f"--{name} goes with .png: .npy holds the values themselves")
    if not only_plan:
        if output != "-":
            check_target(output, not no_clobber)
        elif sys.stdout.isatty():
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")
        if file_format == "png":
            check_writer(int(bits or 8))
    paper = None if background == "none" else background or WHITE
    with options.Progress(["read file"]) as progress:
        progress.enter("read file")
        content = read_scene(file)
        with naming(source):
            shown = options_of(content, source, request)
            camera = camera_for(content, size=size, **camera_options(request), **shown)
            chosen = open_device(device, profile=verbose)
            job = plan_render(
                content, camera, size=size, samples=samples, device=chosen, max_memory=max_memory,
                **shown,
            )  # fmt: skip
        progress.stages = ["read file", *job.stages, "write file"]
        if only_plan:
            progress.erase()
            print_plan(job, as_json)
            return
        job.refuse()
        legend = request["legend"] and legend_of(job, size[1], paper)
        with naming(source):
            drawn = job.run(progress.enter)
        progress.enter("write file")
        write_picture(
            beside(drawn, legend),
            output,
            bits=int(bits or 8),
            background=paper,
            clobber=not no_clobber,
            format=file_format,
        )
    seconds = time.perf_counter() - started
    if as_json:
        options.print_json(summary(job, output, drawn, seconds), err=output == "-")
    else:
        options.tell(
            f"{source} -> {output if output != '-' else 'stdout'}: {size[0]} x {size[1]}, "
            f"{viewpoint(request)}, {100 * share_hit(drawn):.3g} % of pixels hit, {seconds:.2f} s"
        )
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Errors in this block name the file; those of other files and of memory are as they are."""
    try:
        yield
    except (FileError, MemoryLimitError):
        raise
    except VoxtoolError as error:
        raise type(error)(f"{source}: {error}") from error


def check_request(request: dict[str, Any]) -> None:
    """Refuse options that contradict each other."""
    if request["eye"] and request["view"]:
        raise click.UsageError("--eye and --view both place the camera: drop one")
    if request["target"] and not request["eye"]:
        raise click.UsageError("--target goes with --eye: views look at the middle")
    if request["orthographic"] and request["fov"] is not None:
        raise click.UsageError("--fov is of a perspective: --orthographic has --height")
    if request["transfer_file"] is not None:
        for name, option in MAKERS.items():
            if request[name] is not None:
                raise click.UsageError(f"{option} makes a transfer function: drop it or --transfer")
    if request["height"] is not None and not request["orthographic"]:
        raise click.UsageError("--height goes with --orthographic: a perspective has --fov")


def output_of(file: str, output: str | None, as_float: bool) -> tuple[str, str]:
    """Where to write, and as what: bunny.svo.h5 -> bunny.png, in the current folder; stdin ->
    stdout."""
    from voxtool.files import format_of
    from voxtool.files.picture import FORMATS

    default = "npy" if as_float else "png"
    if output is None and file != "-":
        name = PurePath(file).name
        for extension in (".gz", ".h5", ".xml", ".svo", ".adf", ".tet"):
            name = name.removesuffix(extension)
        output = f"{name}.{default}"
    if output is None or output == "-":
        return "-", default
    found = format_of(output, FORMATS)
    if as_float and found != "npy":
        raise click.UsageError(f"--float writes .npy, and {output} ends in .{found}")
    return output, found


def options_of(content: Any, source: str, request: dict[str, Any]) -> dict[str, Any]:
    """The options of the picture that go with what the file holds.

    Raises
    ------
    click.UsageError : an option was given that goes with another kind of file.
    """
    from voxtool.rendering import SCENES

    kind = SCENES[type(content)].kind
    for parameter in click.get_current_context().command.params:
        name = parameter.name or ""
        kinds = BELONGS.get(name, (kind,))
        if kind not in kinds and request[name] is not None and request[name] is not False:
            article = "an" if kind[0] in "aeiou" else "a"
            raise click.UsageError(
                f"{parameter.opts[0]} goes with {' and '.join(f'{k}s' for k in kinds)}: "
                f"{source} holds {article} {kind}"
            )
    names = ("method", "integrator") if kind == "volume" else ("level", "offset", "colour")
    given = {name: request[name] for name in names if request[name] is not None}
    if kind == "volume":
        given["transfer"] = transfer_of(content, request)
    return given


def transfer_of(volume: TetVolume, request: dict[str, Any]) -> TransferFunction:
    """The transfer function that was asked for."""
    from voxtool.files.transfer import read_transfer
    from voxtool.tets.transfer import DEFAULT_MAP, default_transfer

    if request["transfer_file"] is not None:
        return read_transfer(request["transfer_file"])
    return default_transfer(
        volume,
        request["map_name"] or DEFAULT_MAP,
        opacity_range=request["opacity_range"],
        unit_distance=request["unit_distance"],
    )


def camera_options(request: dict[str, Any]) -> dict[str, Any]:
    """The options of the camera as camera_for takes them."""
    given = {
        name: request[name]
        for name in ("view", "eye", "target", "up", "fov", "height", "turn")
        if request[name] is not None
    }
    return {**given, "fov": None} if request["orthographic"] else given


def viewpoint(request: dict[str, Any]) -> str:
    """Where the camera is, in words."""
    where = f"{request['view'] or 'iso'} view"
    if request["eye"]:
        where = f"from ({', '.join(f'{v:g}' for v in request['eye'])})"
    turn = request["turn"]
    return where if turn is None else f"{where}, turned {turn:g} degrees"


def legend_of(job: RenderJob, height: int, background: Any) -> np.ndarray:
    """The legend of a volume's transfer function."""
    from voxtool.plots.legend import draw_legend

    scene: Any = job.plan.scene
    return draw_legend(
        scene.shown_through,
        scene.content.scalar_range,
        printable(scene.content.scalar),
        height,
        unit=printable(scene.content.units),
        background=background,
    )


def beside(picture: np.ndarray, legend: np.ndarray | bool) -> np.ndarray:
    """The picture, with the legend at its right if there is one."""
    import numpy as np

    return picture if legend is False else np.concatenate([picture, legend], axis=1)


def share_hit(picture: np.ndarray) -> float:
    """The share of pixels that are not wholly transparent."""
    import numpy as np

    return float(np.count_nonzero(picture[..., 3])) / picture[..., 3].size


def summary(job: RenderJob, output: str, picture: np.ndarray, seconds: float) -> dict[str, Any]:
    """What was drawn, in JSON types. The digest is that of the picture before it is rounded."""
    described = job.describe()
    return {
        "output": output,
        **{name: described[name] for name in ("kind", "size", "samples")},
        **job.plan.scene.counts,
        "pixels_hit": share_hit(picture),
        "digest": hashlib.sha256(picture.astype("<f4").tobytes()).hexdigest(),
        "seconds": round(seconds, 3),
    }


def print_plan(job: RenderJob, as_json: bool) -> None:
    """Print what will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(job.describe())
    else:
        rows = [
            *job.plan.rows(),
            ("stages", ", ".join(job.stages)),
            *(("left out", f"{what}: {why}") for what, why in job.left_out.items()),
            ("predicted", f"{human(job.cost.device)} on the device"),
        ]
        for name, text in rows:
            click.echo(f"{name:<10} {text}")
    try:
        job.refuse()
    except MemoryLimitError as error:
        options.tell(f"warning: this will be refused: {error}")
