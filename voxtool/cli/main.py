"""The command `voxtool`: a group whose subcommands are imported when they are called."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from typing import Any, NoReturn

import click

from voxtool.cli.options import tell
from voxtool.errors import VoxtoolError
from voxtool.version import __version__

COMMANDS = {
    "voxelize": "voxtool.cli.voxelize",
    "diagnose": "voxtool.cli.diagnose",
    "svo-info": "voxtool.cli.svo_info",
    "extract": "voxtool.cli.extract",
    "adf-build": "voxtool.cli.adf_build",
    "adf-query": "voxtool.cli.adf_query",
    "adf-info": "voxtool.cli.adf_info",
    "tet-build": "voxtool.cli.tet_build",
    "render": "voxtool.cli.render",
    "export": "voxtool.cli.export",
    "devices": "voxtool.cli.devices",
    "selftest": "voxtool.cli.selftest",
    "bench": "voxtool.cli.bench",
}


class Voxtool(click.Group):
    """A group that imports a subcommand's module when it is asked for, and says every failure in
    one line on stderr: exit code 1 failure, 2 usage, 130 interrupted."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        return import_module(COMMANDS[cmd_name]).command

    def main(self, *args: Any, **extra: Any) -> NoReturn:
        extra.update(standalone_mode=False)
        shown, warnings.showwarning = warnings.showwarning, show_warning
        try:
            # a subcommand returns None; --help and the like return an exit code
            sys.exit(super().main(*args, **extra) or 0)
        except click.Abort:
            sys.exit(130)
        except click.ClickException as error:
            print_usage_error(error)
            sys.exit(error.exit_code)
        except VoxtoolError as error:
            tell(f"error: {error}")
        except MemoryError:
            tell("error: this machine has not enough memory: choose a smaller dim")
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            tell(f"error: {where}{error.strerror or error}")
        finally:
            warnings.showwarning = shown
        sys.exit(1)


def print_usage_error(error: click.ClickException) -> None:
    """One line that says where to look; the help as it is, where a command stands alone."""
    message = error.format_message()
    if message.startswith("Usage:"):
        click.echo(message, err=True)
        return
    context = error.ctx if isinstance(error, click.UsageError) else None
    seek = f" (see {context.command_path} -h)" if context else ""
    tell(f"error: {' '.join(message.split()).removesuffix('.')}{seek}")


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning of the library as a line on stderr."""
    tell(f"warning: {message}")


@click.group(cls=Voxtool, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, message="voxtool %(version)s")
def cli() -> None:
    """Turn meshes into exact voxel octrees, distance fields and pictures, on any OpenCL device.

    Commands are chained through files; - is stdin or stdout. Results go to stdout or -o, everything
    else to stderr. Lengths are in the mesh's own units, dims in voxels.

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 --mode solid
      voxtool voxelize bunny.obj -o - | voxtool svo-info -
      voxtool render bunny.svo.h5 -o bunny.png
    """


def main() -> NoReturn:
    """Run the command line."""
    try:
        cli.main(prog_name="voxtool")
    except KeyboardInterrupt:  # outside of click's hands
        sys.exit(130)


if __name__ == "__main__":
    main()
