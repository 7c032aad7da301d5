"""The command `voxtool`: a group whose subcommands are imported when they are called."""

from __future__ import annotations

import signal
import sys
import warnings
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

import click

from voxtool.cli.failures import FAILURES, STREAM_ERRORS, failure_of
from voxtool.cli.options import PRINTED, TO_STDOUT, UNSAID, print_json, say, tell, warn
from voxtool.errors import FileError, MemoryLimitError, VoxtoolWarning
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Iterator

COMMANDS = (
    "voxelize", "diagnose", "repair", "hollow", "svo-info", "svo-query", "svo-dag", "combine",
    "compare", "morph", "extract", "distance", "adf-build", "adf-query", "adf-info", "tet-build",
    "render", "view", "export", "import", "devices", "selftest", "bench", "completion",
)  # fmt: skip


class Voxtool(click.Group):
    """A group that imports a subcommand's module when it is called, and reports every error in one
    line on stderr, with --json also as JSON on stdout. Exit codes: 0; 1 a check does not hold;
    2 usage; 3 input or output; 4 device or memory; 128 and the signal's number."""

    context: click.Context | None = None  # of the call that runs
    words: tuple[str, ...] = ()  # of its command line

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return super().get_command(ctx, cmd_name)
        return import_module(f"voxtool.cli.{cmd_name.replace('-', '_')}").command

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        with naming_causes():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        self.context = ctx
        with naming_causes():
            return super().invoke(ctx)

    def main(self, args: list[str] | None = None, *more: Any, **extra: Any) -> NoReturn:
        extra.update(standalone_mode=False)
        words = list(sys.argv[1:] if args is None else args)
        self.context, self.words = None, tuple(words)
        UNSAID.clear()
        try:
            with library_warnings():
                # a subcommand returns None; --help and the like return an exit code
                code = super().main(words, *more, **extra) or 0
            sys.stdout.flush()
        except (click.Abort, KeyboardInterrupt):
            code = 128 + signal.SIGINT
        except FAILURES as error:
            gone = reader_has_gone(error)
            code = 0 if gone else self.report(error, "--json" in words)
            if gone or (isinstance(error, OSError) and error.errno in STREAM_ERRORS):
                from voxtool.files.storage.streams import discard

                discard(sys.stdout)
        if code == 0 and UNSAID:
            code = 3
        sys.exit(code)

    def report(self, error: Exception, as_json: bool) -> int:
        """Print an error, and return its exit code."""
        failure = failure_of(error)
        message, code = failure["message"], failure["exit_code"]
        if message.startswith("Usage:"):  # the help, where a command stands alone
            say(message)
            return code
        tell(f"error: {message}")
        done = self.context.meta if self.context else {}
        if as_json and PRINTED not in done:  # stdout holds one JSON document
            with suppress(OSError):
                print_json({"error": failure}, err=done.get(TO_STDOUT, False))
        return code


@contextmanager
def library_warnings() -> Iterator[None]:
    """Print the library's own warnings as lines on stderr; hide those of other libraries."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", VoxtoolWarning)
        warnings.showwarning = lambda message, *_, **__: warn(str(message))
        yield


@contextmanager
def naming_causes() -> Iterator[None]:
    """Turn BrokenPipeError, which click makes an exit code of 1, into a FileError, and the error
    of a thread that cannot start into a MemoryLimitError."""
    try:
        yield
    except BrokenPipeError as error:
        raise FileError("standard output was closed") from error
    except RuntimeError as error:
        if "start new thread" not in str(error):
            raise
        raise MemoryLimitError(
            "a thread cannot be started: free memory, or raise the limits of ulimit -v and -u"
        ) from error


def reader_has_gone(error: BaseException) -> bool:
    """Return True if nobody reads stdout any more, as in `voxtool ... | head -1`."""
    cause: BaseException | None = error
    while cause and not isinstance(cause, BrokenPipeError):
        cause = cause.__cause__
    return cause is not None


@click.group(cls=Voxtool, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, message="voxtool %(version)s")
def cli() -> None:
    """Turn meshes into exact voxel octrees, distance fields and images, on any OpenCL device.

    Commands are chained through files; - is stdin or stdout. Results go to stdout or -o, everything
    else to stderr. Lengths are in the mesh's own units, dims in voxels. docs/pipelines.md describes
    exit codes, JSON and pipes.

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 --mode solid
      voxtool voxelize bunny.obj -o - | voxtool svo-info -
      voxtool render bunny.svo.h5 -o bunny.png
    """
