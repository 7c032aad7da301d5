"""The runner of all commands: read, plan, run, write, report.

A command module holds its options, its help, and what it reports. `job_options` at the end of its
decorators adds the shared options and passes their values as a `Run`, the first argument:

    @click.command("voxelize")
    @click.argument("mesh")
    @runner.job_options("FILE", "Default MESH's name with .svo.h5, in this folder.", "svo.h5")
    def command(run: Run, mesh: str) -> None:
        run.to(mesh, options.output_of(mesh, "svo.h5"), SVO_FORMATS)
        with run:
            loaded = run.stage("read mesh", load_mesh, mesh)
            octree = run.job(run.plan(plan_voxelize, loaded, Grid.fit(loaded)))
            run.write(write_svo, octree)
        run.report(f"{octree.count:,} voxels in {run.size}", lambda: {"voxels": octree.count})

`--plan` ends the command at `run.job`. A command without an output file names its options with
`run_options`, and calls `finish` instead of `report`.
"""

from __future__ import annotations

import functools
import sys
import threading
import time
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeVar

import click
from click.globals import push_context

from voxtool.cli import options
from voxtool.cli.inputs import refuse_inputs
from voxtool.errors import CheckError, FileError, MemoryLimitError, VoxtoolError, human

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from voxtool.files.tables.answers import Answers
    from voxtool.job import Job
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

    Result = TypeVar("Result")
    AnyJob = TypeVar("AnyJob", bound=Job[Any] | None)

PLAN, WRITE = "plan", "write file"  # the stages before and after a job's own
JOB = "job"  # stands for the stages of a job on the device


@dataclass
class Item:
    """One of many meshes: the lock of their device, and what the report says."""

    lock: AbstractContextManager[Any]
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass
class Run:
    """One call of a command: the values of the shared options, and the work done so far."""

    output: str | None = None
    no_clobber: bool = False
    overwrite: bool = False
    file_format: str | None = None
    only_plan: bool = False
    max_memory: int | None = None
    device_name: str | None = None
    on_device: bool = False  # whether the command has --device
    as_json: bool = False
    quiet: bool = False
    verbose: bool = False
    strict: bool = False
    item: Item | None = None  # if the mesh is one of many
    source: str = "-"
    progress: options.Progress = field(default_factory=options.Progress)
    started: float = field(default_factory=time.perf_counter)
    seconds: float = 0.0
    notes: list[str] = field(default_factory=list)  # remarks that are no warnings
    doubts: list[str] = field(default_factory=list)  # those of --strict
    details: list[str] = field(default_factory=list)  # remarks for -v
    _before: int = 0  # bytes that were written before the output
    _times: dict[str, float] = field(default_factory=dict)  # of stages on the host
    _after_reading: Callable[[], None] | None = None  # what follows the first stage
    _stage: tuple[str, float] | None = None  # the stage that runs, and when it began

    # ---- where the result goes

    def to(self, source: str, default: str, formats: Iterable[str]) -> None:
        """Choose the output, without -o the `default`, and its format, one of `formats`; refuse an
        output that cannot be written. The report names the `source`.

        Raises
        ------
        click.UsageError : stdout is a terminal, and the format is not text; or it is an input.
        FileError : the file cannot be written, or its name does not say the format.
        """
        from voxtool.files.formats import TEXT_FORMATS, check_output, format_of
        from voxtool.files.storage.atomic import written

        self.source = source
        by_default = self.output is None
        self.output = default if self.output is None else self.output
        self.file_format = self.file_format or format_of(self.output, formats)
        self._before = written()
        click.get_current_context().meta[options.TO_STDOUT] = self.to_stdout
        if self.only_plan:
            return
        if not self.to_stdout:
            if by_default:  # the input may be of the wrong kind, which is said first
                self._after_reading = self.refuse_inputs
            else:
                self.refuse_inputs()
            check_output(self.output, self.file_format, not self.no_clobber)
        elif self.file_format not in TEXT_FORMATS and sys.stdout.isatty():
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")

    def refuse_inputs(self, more: Iterable[str] = ()) -> None:
        """Raise UsageError if the output would replace an input, or one of `more`, unasked."""
        from voxtool.files.formats import folder_of

        if not self.overwrite:
            refuse_inputs([folder_of(str(self.output), str(self.file_format))], more)

    def to_table(self, points: str, what: str = "distance") -> None:
        """Choose the output of a table of values at points: CSV on stdout, otherwise .npy, unless
        --format or the name of the output says another. The name says what it holds."""
        from voxtool.files.tables.answers import ANSWER_FORMATS

        piped = (self.output or points) == "-"
        self.file_format = self.file_format or ("csv" if piped else None)
        default = options.output_of(points, f"{what}.{self.file_format or 'npy'}")
        self.to(points, default, ANSWER_FORMATS)

    def table(self, columns: Sequence[tuple[str, str]]) -> AbstractContextManager[Answers]:
        """Open the output as a table of these columns, which is written block by block."""
        from voxtool.files.tables.answers import open_answers

        return open_answers(str(self.output), columns, self.file_format, not self.no_clobber)

    @property
    def to_stdout(self) -> bool:
        """True if stdout takes the result; reports then go to stderr."""
        return self.output == "-"

    @property
    def bytes(self) -> int:
        """The bytes of the output, once it has been written."""
        from voxtool.files.storage.atomic import written

        return written() - self._before

    @property
    def size(self) -> str:
        """The bytes of the output for people."""
        return human(self.bytes)

    def write(self, write: Callable[..., Any], content: Any, **more: Any) -> None:
        """Write the result: `write(content, output, clobber=..., format=..., **more)`."""
        more |= {"clobber": not self.no_clobber, "format": self.file_format}
        self.stage(WRITE, write, content, self.output, **more)

    # ---- the device, the stages, the job

    @cached_property
    def device(self) -> Device:
        """The device of --device, opened at the first use."""
        device = self._shared_device()
        if not self.item:
            device.stage_times()  # of the command before, where one process runs several
        return device

    def _shared_device(self) -> Device:
        from voxtool.opencl import shared_device

        profile = (self.verbose or self.as_json) and not self.item
        return shared_device(self.device_name, profile=profile)

    def _open_device(self, context: click.Context) -> None:
        """Open the device, in a thread of its own."""
        push_context(context)  # for warnings
        with suppress(VoxtoolError):  # which the command meets at the first use
            self._shared_device()

    def __enter__(self) -> Self:
        if not self.item:
            self.progress.__enter__()
        if self.on_device:  # the device is opened while the input is read
            context = click.get_current_context()
            threading.Thread(target=self._open_device, args=(context,)).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.enter(None)
        if not self.item:
            self.progress.__exit__()
        self.seconds = time.perf_counter() - self.started
        if self.item:  # without the time that it waited for others
            self.seconds = sum(self._times.values())

    def enter(self, stage: str | None) -> None:
        """Begin a stage, which ends when the next one begins; None begins none."""
        now = time.perf_counter()
        if self._stage:
            name, began = self._stage
            self._times[name] = self._times.get(name, 0.0) + now - began
        self._stage = (stage, now) if stage else None
        if stage:
            self.progress.enter(stage)

    def stage(self, name: str, work: Callable[..., Result], *args: Any, **more: Any) -> Result:
        """Return `work(*args, **more)`, run as a stage of this name."""
        self.enter(name)
        result = work(*args, **more)
        self.enter(None)
        check, self._after_reading = self._after_reading, None
        if check:
            check()
        return result

    def mesh(self, name: str, units: str | None, scale: float, normalize: str | None) -> Mesh:
        """Read a mesh, and place it as --normalize asks."""
        return self.meshes((name,), units, scale, normalize)

    def meshes(
        self,
        names: Sequence[str],
        units: str | None,
        scale: float,
        normalize: str | None,
        keep: Sequence[str] = (),
    ) -> Mesh:
        """Read meshes as one, with what is to be kept of them, and place it."""
        if normalize and (units or scale != 1):
            message = "--normalize sets the scale and leaves no unit: drop --units and --scale"
            raise click.UsageError(message)
        from voxtool.files.meshes import companions
        from voxtool.files.meshes.mesh import load_mesh

        given = {"max_memory": self.max_memory, "units": units, "scale": scale, "keep": keep}
        with companions.noting() as beside:
            found = [self.stage("read mesh", load_mesh, name, **given) for name in names]
        if beside and not self.only_plan:
            self.refuse_inputs(beside)
        mesh = found[0]
        if len(found) > 1:
            from voxtool.mesh.joining import join
            from voxtool.mesh.lengths import conversion

            mesh = self.stage("join meshes", join, found)
            self.notes += filter(None, (conversion(one, mesh, found[0].name) for one in found))
        if not normalize:
            return mesh
        from voxtool.mesh.normalize import normalize as placed

        return self.stage("normalize", placed, mesh, normalize)

    @contextmanager
    def naming(self, name: str) -> Iterator[None]:
        """Put the name of a file before the errors of this block."""
        try:
            yield
        except MemoryLimitError:
            raise
        except VoxtoolError as error:
            raise type(error)(f"{options.shown(name)}: {error}") from error

    def plan(self, plan: Callable[..., AnyJob], *args: Any, **request: Any) -> AnyJob:
        """Return the job of a `plan_...` function, with the device and memory of the options."""
        request["max_memory"] = self.max_memory
        if not self.on_device:
            return self.stage(PLAN, plan, *args, **request)
        with self._turn, self.device.reporting(self.progress.enter):
            return self.stage(PLAN, plan, *args, device=self.device, **request)

    def job(
        self,
        job: Job[Result],
        after: Iterable[str] = (),
        empty: Callable[[Result], bool] = lambda _: False,
        **facts: Any,
    ) -> Result:
        """Run a job under the progress bar; with --plan, print its plan, and as JSON the `facts`,
        and end the command. `after` are stages between the job and the writing of its result. The
        first warning of a result that is `empty`, and cannot be written, is an error."""
        if self.only_plan:
            self.print_plan(job, facts, tuple(after))
        self.progress.stages = [*self._times, *job.stages, *after, WRITE]
        with self._turn, options.holding_warnings() as found:
            began = time.perf_counter()
            result = job.run(self.enter if job.device is None else self.progress.enter)
        self.enter(None)
        if empty(result):
            raise VoxtoolError(found[0])
        for message in found:
            options.warn(message)
        if job.device is not None:
            self._times[JOB] = time.perf_counter() - began
        self.notes += job.notes(result)
        self.doubts += job.doubts(result)
        self.details += job.details(result)
        return result

    @property
    def _turn(self) -> AbstractContextManager[Any]:
        """The lock of the device that many meshes share."""
        return self.item.lock if self.item else nullcontext()

    def print_plan(
        self, job: Job[Any], facts: Mapping[str, Any], after: tuple[str, ...]
    ) -> NoReturn:
        """Print the plan and the predicted memory of a job, and the stages after it; end the
        command."""
        from voxtool.cli.plans import planned, rows_of

        self.progress.erase()
        job.settle()
        found = planned(job, facts, after)
        if self.item:
            self.item.facts |= {"plan": found, "cost": vars(job.cost)}
        elif self.as_json:
            options.print_json(found)
        else:
            for name, text in rows_of(job, after):
                click.echo(f"{name:<10} {text}")
        try:
            job.refuse()
        except (FileError, MemoryLimitError) as error:
            options.tell(f"warning: this will be refused: {error}")
        raise click.exceptions.Exit(0)

    # ---- the report

    def report(
        self,
        text: str,
        facts: Callable[[], Mapping[str, Any]],
        details: Iterable[str] = (),
        *,
        json_too: bool = False,
    ) -> None:
        """Print the result: a line without names and time, notes, and with -v details, or the
        `facts` as JSON, which `json_too` prints beside the line; then finish."""
        if self.item or self.as_json or json_too:
            result = {
                "output": self.output,
                "bytes": self.bytes,
                **facts(),
                "notes": [*self.notes, *self.details],
                "warnings": options.issued_warnings(),
                "stages": self.times if self.item or self.as_json else {},
                "seconds": round(self.seconds, 3),
            }
            if self.item:
                self.item.facts |= result
            elif not (self.to_stdout and self.quiet):
                options.print_json(result, err=self.to_stdout)
        if not self.as_json:
            target = "stdout" if self.to_stdout else self.output
            options.tell(f"{options.shown(self.source)} -> {target}: {text}, {self.seconds:.2f} s")
            for line in self.notes:
                options.tell(line)
            if self.verbose:
                for line in (*details, *self.details):
                    options.tell(f"  {line}")
        self.finish()

    def answer(self, facts: Mapping[str, Any], text: str) -> None:
        """Print the report of a command without an output: as text, or its facts as JSON."""
        if self.item:
            self.item.facts |= {"report": facts, "text": text}
        elif self.as_json:
            options.print_json(facts)
        else:
            click.echo(text)

    def print_facts(self, facts: Mapping[str, Any]) -> None:
        """Print facts that are the result of a command, as JSON."""
        result = {"output": self.output, **facts, "seconds": round(self.seconds, 3)}
        options.print_json(result, err=self.to_stdout)

    def finish(self) -> None:
        """Print, on a terminal or with -v, how long kernels compiled, if it was long; with -v the
        device and the time of each stage. Pipelines compare what is printed, and the first run of a
        machine is not to differ there.

        Raises
        ------
        CheckError : with --strict, there is a warning, or a doubt about what is inside.
        """
        on_terminal = sys.stderr and sys.stderr.isatty()
        if "device" in self.__dict__ and not self.item and (on_terminal or self.verbose):
            from voxtool.opencl.program import compile_report

            if line := compile_report():
                options.tell(line)
        if self.verbose:
            if "device" in self.__dict__:
                options.tell(f"{self.device.info.name} ({self.device.info.platform})")
            for stage, seconds in self.times.items():
                options.tell(f"  {stage:<18} {1e3 * seconds:9.2f} ms")
        if self.strict and (issued := [*options.issued_warnings(), *self.doubts]):
            raise CheckError(f"{'; '.join(issued)} (--strict)")

    @cached_property
    def times(self) -> dict[str, float]:
        """Seconds by stage, in order: those of kernels and copies for what ran on the device, those
        of the clock for the rest; "other" is the time that no stage has. For one of many meshes,
        the job is one stage, and all times are those of the clock."""
        if self.item:
            return self._times
        on_device = self.device.stage_times() if "device" in self.__dict__ else {}
        times: dict[str, float] = {}
        for name, seconds in self._times.items():
            times |= on_device if name == JOB else {name: seconds}
        times |= on_device
        times.pop("other", None)
        return {**times, "other": max(self.seconds - sum(times.values()), 0.0)}


# ---- options

OWN = {"source", "progress", "notes", "doubts", "details"}
SHARED = {field.name for field in fields(Run) if field.init} - OWN


def run_options(*decorators: options.Decorator) -> options.Decorator:
    """Add options to a command; those in SHARED arrive as a Run, the first argument."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(**values: Any) -> Any:
            shared = {name: values.pop(name) for name in SHARED & values.keys()}
            return function(Run(**shared, on_device="device_name" in shared), **values)

        return options.together(*decorators)(call)

    return decorate


def job_options(metavar: str, default: str, *formats: str) -> options.Decorator:
    """Return the options of a command that runs one job: -o, --no-clobber, --format, --plan,
    --max-memory, --device, --strict, --json, -q, -v.

    Parameters
    ----------
    metavar, default : what -o takes, and what its help says of the default.
    formats : the choices of --format; without any there is no such option.
    """
    return run_options(
        options.output_options(metavar, default),
        *([options.format_option(*formats)] if formats else []),
        options.plan_options,
        options.device_option,
        options.strict_option,
        options.report_options,
    )
