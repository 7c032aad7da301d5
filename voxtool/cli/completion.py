"""voxtool completion: words completed by the shell."""

from __future__ import annotations

import click

SHELLS = ("bash", "zsh", "fish")


@click.command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
def command(shell: str) -> None:
    """Print a script that lets a SHELL complete commands, options and their values.

    For bash, add the line eval "$(voxtool completion bash)" to ~/.bashrc; for zsh, the same with
    zsh to ~/.zshrc. For fish, write the script to ~/.config/fish/completions/voxtool.fish.

    \b
    Examples:
      voxtool completion bash
      voxtool completion fish
    """
    from click.shell_completion import get_completion_class

    from voxtool.cli.main import cli

    kind = get_completion_class(shell)
    assert kind
    click.echo(kind(cli, {}, "voxtool", "_VOXTOOL_COMPLETE").source())
