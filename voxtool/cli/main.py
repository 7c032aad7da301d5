"""The command `voxtool`: a group whose subcommands are imported when they are called."""

from __future__ import annotations

import os
import sys
from importlib import import_module

import click

from voxtool.errors import VoxtoolError
from voxtool.version import __version__

COMMANDS = {
    "voxelize": "voxtool.cli.voxelize",
    "svo-info": "voxtool.cli.svo_info",
    "export": "voxtool.cli.export",
    "devices": "voxtool.cli.devices",
    "bench": "voxtool.cli.bench",
}


class LazyGroup(click.Group):
    """A group that imports a subcommand's module when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        return import_module(COMMANDS[cmd_name]).command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, message="voxtool %(version)s")
def cli() -> None:
    """Turn triangle meshes into exact sparse voxel octrees, on any OpenCL device.

    Commands are chained through files; `-` is stdin or stdout. Results go to stdout or -o,
    everything else to stderr.

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 --mode solid
      voxtool voxelize bunny.obj -o - | voxtool svo-info -
    """


def main() -> None:
    """Run the command line: exit code 0, 1 failure, 2 usage, 130 interrupted."""
    try:
        cli.main(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.Abort:
        sys.exit(130)
    except KeyboardInterrupt:
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except VoxtoolError as error:
        print(f"voxtool: error: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # the reader of our output has gone; Python must not flush into it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    sys.exit(0)


if __name__ == "__main__":
    main()
