"""voxtool view: an interactive page of an octree, a distance field or a volume."""

from __future__ import annotations

import webbrowser
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options, runner
from voxtool.cli.options import flag, together
from voxtool.cli.render import DIRECTION, fitting

if TYPE_CHECKING:
    from voxtool.cli.runner import Run
    from voxtool.viewer.page import Page


@click.command("view")
@click.argument("file")
@together(
    flag("--no-open", "Write or serve the page, and do not open it in a browser."),
    flag("--serve",
        "Serve the page and its data to this machine until interrupted, and write nothing: for "
        "data that no page holds."),
    options.option("--up", DIRECTION, "What is up: a direction, or x, y, z, -x, ...  [default: y]",
        metavar="X,Y,Z|AXIS"),
    options.option("--level", options.LEVEL,
        "Octrees: show nodes of this level as cubes, and nothing finer: a smaller page.  "
        "[default: voxel]", metavar="N|voxel"),
    options.option("--isovalue", float,
        "Octrees: show at first, above voxels, the nodes of which at least this share is set, "
        "above 0 and at most 1.  [default: any share]", metavar="V"),
)  # fmt: skip
@runner.run_options(
    options.output_options("PAGE.html", "Default FILE's name with .html, in this folder."),
    options.plan_options,
    options.strict_option,
    options.report_options,
)
def command(
    run: Run, file: str, no_open: bool, serve: bool, up: tuple[float, ...] | None,
    level: int | str | None, isovalue: float | None,
) -> None:  # fmt: skip
    """Write a page that shows an octree, a field or a volume FILE in a browser, and open it.

    The page is one file with everything inside and reaches nothing else: it can be mailed. FILE is
    what voxelize, adf-build or tet-build wrote, or a mesh, which is voxelized first, or - for
    stdin. Positions and distances on the page are in world units.

    \b
    Examples:
      voxtool view bunny.svo.h5
      voxtool view bunny.svo.h5 --level 0 --isovalue 0.5
      voxtool view volume.tet.h5 --up z
      voxtool view bunny.obj -o bunny.html --no-open
    """
    from voxtool.api.views import shown_content
    from voxtool.files import is_mesh, open_scene
    from voxtool.files.pictures.page import FORMATS, write_page
    from voxtool.svo.pictures.painting import BY_DEFAULT
    from voxtool.viewer.job import plan_view

    if serve and run.output:
        raise click.UsageError("--serve writes no page: drop it or -o")
    if serve:
        run.source = file
    else:
        if run.output in (None, "-"):
            run.file_format = "html"
        run.to(file, options.output_of(file, "html"), FORMATS)
    with run, ExitStack() as stack:
        if is_mesh(file):
            content: Any = run.stage("read file", shown_content, file)
        else:
            content = run.stage("read file", stack.enter_context, open_scene(file))
        with run.naming(file):
            content, level = fitting(run, content, level, BY_DEFAULT)
            given = {"up": up, "level": level, "isovalue": isovalue}
            given = {name: value for name, value in given.items() if value is not None}
            job = run.plan(plan_view, content, file, served=serve, **given)
            page = run.job(job)
        if not serve:
            run.write(write_page, page.html)
    if serve:
        show_served(run, page, no_open)
        return
    run.report(
        f"{page.content.kind}, {run.size}",
        lambda: summary(page),
    )
    if not (no_open or run.to_stdout):
        webbrowser.open(Path(str(run.output)).absolute().as_uri())


def show_served(run: Run, page: Page, no_open: bool) -> None:
    """Serve a page until the command is interrupted."""
    from voxtool.viewer.serve import PageServer

    with PageServer(page) as server:
        if run.as_json:
            options.print_json({"url": server.url, **summary(page)})
        else:
            options.tell(f"{options.shown(run.source)} at {server.url}: Ctrl-C ends it")
        if not no_open:
            webbrowser.open(server.url)
        server.serve_forever()


def summary(page: Page) -> dict[str, Any]:
    """Return the facts of the report; the digest is of the data before they are compressed."""
    return {
        "kind": page.content.kind,
        "bytes": page.base_bytes + page.data_bytes,
        "data_bytes": page.data_bytes,
        "base_bytes": page.base_bytes,
        "digest": page.content.digest(),
    }
