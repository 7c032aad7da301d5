"""voxtool render: a picture of an octree, a distance field or a volume."""

from __future__ import annotations

import hashlib
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import METHODS, VIEWS
from voxtool.cli import runner
from voxtool.cli.options import Colour, Level, Number, Range, Size, Vector
from voxtool.errors import printable
from voxtool.tets.maps import MAPS

if TYPE_CHECKING:
    import numpy as np

    from voxtool.cli.runner import Run
    from voxtool.rendering import RenderJob
    from voxtool.tets.transfer import TransferFunction
    from voxtool.tets.volume import TetVolume

SIZE = (512, 512)  # pixels
MOST_SAMPLES = 16  # along a pixel's side
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


@click.command("render")
@click.argument("file")
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
    type=Range(),
    metavar="A,B|full",
    help="Volumes: scalars at which a map's extinction is 0 and full; A may be the higher one; "
    "full: the data's range.  [default: the data's 75th and 99th percentiles]",
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
@runner.job_options(
    "PICTURE", "Default FILE's name with .png, or with --float .npy, in this folder."
)
def command(
    run: Run,
    file: str,
    size: tuple[int, int],
    samples: int | None,
    background: Any,
    bits: str | None,
    as_float: bool,
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
    check_rays(size, samples)
    from voxtool.files import read_scene
    from voxtool.files.picture import FORMATS, WHITE, check_writer, write_picture
    from voxtool.rendering import camera_for, plan_render

    if run.output in (None, "-"):
        run.file_format = "npy" if as_float else "png"
    run.to(file, output_of(file, as_float), FORMATS)
    check_format(run, as_float)
    depth = int(bits or 8)
    if run.file_format == "png" and not run.only_plan:
        check_writer(depth)
    paper = None if background == "none" else background or WHITE
    with run:
        content = run.stage("read file", read_scene, file)
        with run.naming(file):
            shown = options_of(content, file, request)
            camera = camera_for(content, size=size, **camera_options(request), **shown)
            job = run.plan(plan_render, content, camera, size=size, samples=samples, **shown)
        drawn = run.job(job)
        picture = with_legend(drawn, job, paper) if request["legend"] else drawn
        run.write(write_picture, picture, bits=depth, background=paper)
    hit = share_hit(drawn)
    text = f"{size[0]} x {size[1]}, {viewpoint(request)}, {100 * hit:.3g} % of pixels hit"
    run.report(text, lambda: summary(job, drawn, hit))


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


def output_of(file: str, as_float: bool) -> str:
    """The default output: bunny.svo.h5 -> bunny.png, in the current folder; stdin -> stdout."""
    if file == "-":
        return "-"
    name = PurePath(file).name
    for extension in (".gz", ".h5", ".xml", ".svo", ".adf", ".tet"):
        name = name.removesuffix(extension)
    return f"{name}.{'npy' if as_float else 'png'}"


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


def with_legend(picture: np.ndarray, job: RenderJob, background: Any) -> np.ndarray:
    """The picture with the legend of its transfer function at the right."""
    import numpy as np

    from voxtool.plots.legend import draw_legend

    scene: Any = job.plan.scene
    volume = scene.content
    legend = draw_legend(
        scene.shown_through,
        volume.scalar_range,
        printable(volume.scalar),
        len(picture),
        unit=printable(volume.units),
        background=background,
    )
    return np.concatenate([picture, legend], axis=1)


def share_hit(picture: np.ndarray) -> float:
    """The share of pixels that are not wholly transparent."""
    import numpy as np

    return float(np.count_nonzero(picture[..., 3])) / picture[..., 3].size


def summary(job: RenderJob, picture: np.ndarray, hit: float) -> dict[str, Any]:
    """What was drawn, in JSON types. The digest is that of the picture before it is rounded."""
    described = job.describe()
    return {
        **{name: described[name] for name in ("kind", "size", "samples")},
        **job.plan.scene.counts,
        "pixels_hit": hit,
        "digest": hashlib.sha256(picture.astype("<f4").tobytes()).hexdigest(),
    }
