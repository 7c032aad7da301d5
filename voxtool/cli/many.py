"""Commands that read one mesh, and take many: an output each, in a folder.

`mesh_argument` stands for `click.argument("mesh")` at the top of such a command. One mesh is done
here; many are done by worker processes (workers.py), and a manifest in the folder says what became
of each.
"""

from __future__ import annotations

import functools
import math
import os
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options
from voxtool.cli.inputs import refuse_inputs
from voxtool.cli.options import Parsed, flag, option, together
from voxtool.cli.runner import SHARED
from voxtool.errors import CheckError, DeviceError, FileError, VoxtoolError, human, printable
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from voxtool.cli.workers import Answer, Task
    from voxtool.files.storage.manifest import Manifest

    Values = dict[str, Any]


def shard_of(text: str) -> tuple[int, int]:
    """Return the number of a shard, from 1, and the number of shards: 3/16."""
    part, _, whole = text.partition("/")
    number, count = int(part), int(whole)
    if not 1 <= number <= count:
        raise ValueError
    return number, count


TAR = ".tar"
SHARD = Parsed("shard", shard_of, " is no shard: write 1/16 to 16/16")
# Options that say how many meshes are done, not what they become.
WAYS = SHARED | {"mesh", "workers", "shard", "keep_folders", "fail_fast", "dask", "as_worker"}


def mesh_argument(
    kind: str = "",
    form: str = "",
    arrange: Callable[..., Any] = lambda *given: given,
    *,
    divides: bool = False,
) -> options.Decorator:
    """Add the argument MESH..., and what many meshes need, to a command of one mesh.

    Parameters
    ----------
    kind, form : the outputs are called NAME.KIND.FORM, where --format may say another form; both
        are empty if there is no output.
    arrange : takes the meshes and the values of the options, and returns them.
    divides : the command divides one mesh among the workers of Dask; it takes `dask` and `workers`.
    """

    def decorate(call: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(call)
        def command(mesh: tuple[str, ...], **values: Any) -> None:
            own = {name: values.pop(name) for name in (WAYS - SHARED) & values.keys()}
            meshes, values = arrange(mesh, values)
            more = {name: own[name] for name in ("dask", "workers")} if divides else {}
            if own["as_worker"]:
                from voxtool.cli.workers import serve

                serve(call, values)
            elif values.get("labels") and len(meshes) > 1:
                refused = ("shard",) if own["dask"] else ("shard", "workers")
                if given := [name for name in refused if own[name]]:
                    raise click.UsageError(f"--labels makes one octree: drop --{given[0]}")
                call(mesh=meshes[0], others=meshes[1:], **values, **more)
            elif is_one(meshes, values.get("output"), own, divides):
                call(mesh=meshes[0], **values, **more)
            else:
                Many(meshes, values, (kind, form), **own).run()

        added: list[click.Parameter] = []  # in the reverse order of the help
        vars(command)["__click_params__"] = added
        decorated = together(*OPTIONS)(command)
        added += vars(call)["__click_params__"]
        return click.argument("mesh", nargs=-1, required=True, metavar="MESH...")(decorated)

    return decorate


OPTIONS = (
    option("--workers", click.IntRange(1),
        "Processes that do many meshes.  [default: 1]", metavar="N"),
    option("--dask", str,
        "Do the work on a Dask cluster: the address of its scheduler; or local, for --workers "
        "processes of this machine.", metavar="ADDRESS|local"),
    option("--shard", SHARD,
        "Do only part I of N of the meshes: one command for each of N machines.", metavar="I/N"),
    flag("--keep-folders", "With many meshes: keep their folders, below the one that all have."),
    flag("--fail-fast", "With many meshes: stop at the first that fails."),
    click.option("--as-worker", is_flag=True, hidden=True, help="Read tasks from stdin."),
)  # fmt: skip


def is_one(
    meshes: Sequence[str], output: str | None, own: Mapping[str, Any], divides: bool
) -> bool:
    """Return whether a command line is of one mesh and its output."""
    into_folder = output is not None and output.endswith(("/", os.sep, TAR))
    if len(meshes) > 1 or own["shard"] or into_folder:
        return False
    shared = own["dask"] or own["workers"]
    return bool(divides and own["dask"]) or not shared or names_file(output)


def names_file(output: str | None) -> bool:
    """Return whether a name says the format of an output, so that it is none of a folder."""
    from voxtool.files.formats import ADF_FORMATS, EXPORTS, MESH_FORMATS, SVO_FORMATS, format_of

    with suppress(FileError):
        format_of(output or "", (*SVO_FORMATS, *ADF_FORMATS, *MESH_FORMATS, *EXPORTS))
        return True
    return False


class Many:
    """Many meshes, their outputs, and the options of the command."""

    def __init__(
        self, meshes: Sequence[str], values: Values, name: tuple[str, str], *,
        workers: int | None, shard: tuple[int, int] | None, keep_folders: bool, fail_fast: bool,
        dask: str | None, as_worker: bool,
    ) -> None:  # fmt: skip
        if "-" in meshes:
            raise click.UsageError("stdin is one mesh: name files, if there are many")
        if values.get("output") == "-":
            raise click.UsageError("many meshes have no place on stdout: name a folder with -o")
        self.values, self.shard, self.fail_fast = values, shard, fail_fast
        self.workers, self.dask = workers, dask
        self.folder = (values.get("output") or ".") if name[1] else None
        self.tar = tar_of(self.folder, shard)
        self.folder = f"{self.tar}.parts" if self.tar else self.folder
        self.ending = ".".join(filter(None, (name[0], values.get("file_format") or name[1])))
        self.outputs = outputs_of(meshes, self.folder, self.ending, keep_folders)
        part = slice(shard[0] - 1, None, shard[1]) if shard else slice(None)
        self.meshes = list(meshes)[part]
        self.counts = dict.fromkeys(("made", "up to date", "failed"), 0)

    def run(self) -> None:
        """Do the meshes, and report.

        Raises
        ------
        CheckError
            If a mesh failed.
        """
        from voxtool.cli.workers import Task

        began = time.perf_counter()
        tasks = [Task(mesh, self.outputs.get(mesh)) for mesh in self.meshes]
        if self.folder is None or self.values["only_plan"]:
            return self.make(tasks, None, began)
        from voxtool.files.storage.manifest import Manifest

        if not self.values["overwrite"]:
            refuse_inputs([*(str(task.output) for task in tasks), *filter(None, [self.tar])])
        if self.tar and self.is_packed(self.tar):
            if os.path.isdir(self.folder):  # a killed run had packed it
                with Manifest(self.folder, self.shard) as manifest:
                    manifest.remove(self.outputs[mesh] for mesh in self.meshes)
            self.counts["up to date"] = len(tasks)
            return self.summarize(None, time.perf_counter() - began)
        with Manifest(self.folder, self.shard) as manifest:
            self.make(tasks, manifest, began)

    def make(self, tasks: Sequence[Task], manifest: Manifest | None, began: float) -> None:
        """Do the tasks that are not up to date, and report."""
        if manifest:
            from voxtool.files.storage.atomic import sweep
            from voxtool.files.storage.manifest import make_folder

            for below in {str(manifest.path.parent), *map(os.path.dirname, self.outputs.values())}:
                make_folder(below)
                sweep(Path(below))  # of outputs that are up to date, too
        todo = [task for task in tasks if not (manifest and self.is_current(manifest, task))]
        self.counts["up to date"] = len(tasks) - len(todo)
        try:
            answers = self.do(todo, manifest)
        except VoxtoolError:
            if manifest and not self.counts["made"]:
                manifest.discard()
            raise
        if manifest:
            manifest.finish(str(task.output) for task in tasks)
            if self.tar:
                self.pack(self.tar, manifest)
            self.summarize(manifest, time.perf_counter() - began)
        elif self.values["as_json"]:
            options.print_json([{"mesh": mesh, **answers[mesh]} for mesh in self.meshes])
        if failed := self.counts["failed"]:
            where = f": see {manifest.path}" if manifest else ""
            raise CheckError(f"{failed:,} of {len(tasks):,} meshes failed{where}")

    def do(self, tasks: Sequence[Task], manifest: Manifest | None) -> dict[str, Answer]:
        """Do the tasks, print what workers say, and return the answers by their mesh; those that
        are in the manifest are not kept."""
        from voxtool.cli.workers import Spread, Workers

        context = click.get_current_context()
        words = list(context.find_root().command.words)  # pyright: ignore[reportAttributeAccessIssue]
        words.insert(words.index(str(context.info_name)) + 1, "--as-worker")
        found: dict[str, Answer] = {}
        shown = 0
        with options.Progress() as progress:
            if self.dask:
                workers = Spread(words, tasks, self.dask, self.workers)
            else:
                workers = Workers(words, tasks, self.workers or 1)
            for done, (task, answer) in enumerate(workers.answers()):
                progress.enter(f"{done + 1:,} of {len(tasks):,} meshes")
                self.take(task, answer, manifest)
                found[task.mesh] = answer
                while shown < len(self.meshes) and self.meshes[shown] in found:
                    mesh = self.meshes[shown]
                    self.show(mesh, found[mesh])
                    if manifest:
                        found[mesh] = {}
                    shown += 1
        return found

    def show(self, mesh: str, answer: Answer) -> None:
        """Print the plan of a mesh, or its report, on stdout."""
        text = answer.pop("text", "")
        if self.values["as_json"]:
            return
        if "cost" in answer:
            device, host = (human(answer["cost"][where]) for where in ("device", "host"))
            target = self.outputs[mesh]
            text = f"{printable(mesh)} -> {target}: {device} on the device, {host} on the host"
        if text:
            click.echo(text)

    def ends_all(self, failure: Mapping[str, Any]) -> bool:
        """Return whether no other mesh need be tried, as the options or the device are wrong."""
        wrong = failure["kind"] == "usage"
        wrong |= failure["kind"] == "device" and not self.counts["made"]
        return wrong or self.fail_fast

    def take(self, task: Task, answer: Answer, manifest: Manifest | None) -> None:
        """Count and print an answer, and put it into the manifest."""
        for line in answer.pop("lines"):
            options.tell(line)
        if failure := answer.get("error"):
            message = failure["message"]
            if task.mesh not in message:
                message = f"{printable(task.mesh)}: {message}"
            if self.ends_all(failure):
                raise error_of(failure["kind"], message)
            options.tell(f"failed: {message}")
        self.counts["failed" if failure else "made"] += 1
        if manifest:
            line = {"mesh": task.mesh, "output": task.output, "voxtool": __version__}
            manifest.add({**line, "options": self.request, **size_of(task.output), **answer})

    @functools.cached_property
    def request(self) -> Values:
        """The options that decide what a mesh becomes, in JSON types."""
        given = {name: value for name, value in self.values.items() if value is not None}
        chosen = {name: given[name] for name in sorted(given.keys() - WAYS)}
        chosen["format"] = self.values.get("file_format")
        return {name: in_json(value) for name, value in chosen.items()}

    def is_current(self, manifest: Manifest, task: Task) -> bool:
        """Return whether an output is newer than its mesh, and was made with these options."""
        line = manifest.line_of(str(task.output))
        same = "error" not in line and line.get("voxtool") == __version__
        if not same or line.get("options") != self.request:
            return False
        newer = self.is_newer(str(task.output), [task.mesh])
        return newer and size_of(task.output) == {"size": line.get("size")}

    def is_newer(self, output: str, meshes: Sequence[str]) -> bool:
        """Return whether an output is newer than meshes and the files that options name."""
        given = (x for name, x in self.values.items() if name != "output")
        others = [x for x in given if isinstance(x, str) and os.path.isfile(x)]
        try:
            made = os.stat(output).st_mtime_ns
            return made >= max(os.stat(name).st_mtime_ns for name in (*meshes, *others))
        except OSError:
            return False

    def is_packed(self, tar: str) -> bool:
        """Return whether a tar is newer than the meshes, and has these, made with these options;
        raise UsageError or FileError if it can have none."""
        from voxtool.files.formats import is_folder
        from voxtool.files.storage.atomic import check_target
        from voxtool.files.tables.samples import read_lines

        if is_folder(self.ending):
            raise click.UsageError(f"a tar holds files, and {self.ending} is a folder")
        check_target(tar, not self.values["no_clobber"])
        names = Counter(self.name_of(mesh) for mesh in self.meshes)
        if twice := [name for name, count in names.items() if count > 1]:
            raise click.UsageError(f"{tar} would have several samples {twice[0]}: rename a mesh")
        lines = read_lines(tar)
        of = [(mesh, __version__, self.request) for mesh in self.meshes]
        known = [(x.get("mesh"), x.get("voxtool"), x.get("options")) for x in lines.values()]
        same = known == of and list(lines) == list(names)
        return same and self.is_newer(tar, self.meshes)

    def name_of(self, mesh: str) -> str:
        """Return the name of a mesh in a tar, which has no dot below its last folder."""
        output = os.path.relpath(self.outputs[mesh], self.folder)
        above, name = os.path.split(output.removesuffix(f".{self.ending}"))
        return os.path.join(above, name.replace(".", "_"))

    def pack(self, tar: str, manifest: Manifest) -> None:
        """Put the outputs into a tar; remove them if no mesh has failed."""
        from voxtool.files.tables.samples import Sample, write_samples

        done = [(mesh, manifest.line_of(self.outputs[mesh])) for mesh in self.meshes]
        good = [(mesh, line) for mesh, line in done if line and "error" not in line]
        if good:
            samples = (
                Sample(self.name_of(mesh), self.ending, self.outputs[mesh], line)
                for mesh, line in good
            )
            write_samples(tar, samples, not self.values["no_clobber"])
        if len(good) == len(self.meshes):
            manifest.remove(self.outputs[mesh] for mesh in self.meshes)

    def summarize(self, manifest: Manifest | None, seconds: float) -> None:
        """Print how many meshes were made, were up to date, or failed."""
        kept = str(manifest.path) if manifest and manifest.path.exists() else ""
        if self.values["as_json"]:
            facts = {name.replace(" ", "_"): count for name, count in self.counts.items()}
            result = {"output": self.tar or self.folder, "manifest": kept or None, **facts}
            options.print_json({**result, "seconds": round(seconds, 3)})
            return
        counts = ", ".join(f"{count:,} {name}" for name, count in self.counts.items() if count)
        total = f"{len(self.meshes):,} meshes -> {self.tar or self.folder}"
        options.tell(f"{total}: {counts}, {seconds:.2f} s" + (f"; {kept}" if kept else ""))


def tar_of(output: str | None, shard: tuple[int, int] | None) -> str | None:
    """Return the tar that a command writes, one for each shard; None for a folder."""
    if output is None or not output.endswith(TAR):
        return None
    part = ".{}-of-{}".format(*shard) if shard else ""
    return output.removesuffix(TAR) + part + TAR


def outputs_of(
    meshes: Sequence[str], folder: str | None, ending: str, nested: bool
) -> dict[str, str]:
    """Return the outputs of meshes by the mesh; raise UsageError if two are one."""
    if folder is None:
        return {}
    places = [os.path.dirname(os.path.abspath(mesh)) for mesh in meshes]
    above = os.path.commonpath(places) if nested else ""
    outputs: dict[str, str] = {}
    taken: dict[str, str] = {}
    for mesh, place in zip(meshes, places, strict=True):
        below = os.path.relpath(place, above) if nested else "."
        output = str(Path(folder, below, options.output_of(mesh, ending)))
        if (other := taken.setdefault(output, mesh)) != mesh:
            hint = "rename one" if nested else "rename one, or give --keep-folders"
            raise click.UsageError(f"{other} and {mesh} would both become {output}: {hint}")
        outputs[mesh] = output
    return outputs


def error_of(kind: str, message: str) -> Exception:
    """Return the error of a failure."""
    if kind == "usage":
        return click.UsageError(message)
    return DeviceError(message) if kind == "device" else CheckError(message)


def size_of(output: str | None) -> Values:
    """Return the bytes of an output that is a file."""
    known = output is not None and os.path.isfile(output)
    return {"size": os.path.getsize(str(output)) if known else None}


def in_json(value: Any) -> Any:
    """Return a value of an option as JSON has it."""
    if isinstance(value, list | tuple):
        return [in_json(x) for x in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
