"""`armctl completion`: the script that lets a shell finish command lines."""

from __future__ import annotations

import click

from armctl.cli.output import Output, output_option

FILES = {"bash": "~/.bashrc", "zsh": "~/.zshrc", "fish": "~/.config/fish/completions/armctl.fish"}


@click.command("completion")
@click.argument("shell", type=click.Choice(tuple(FILES)))
@output_option
def completion_command(output: Output, shell: str) -> None:
    """Print what lets the Tab key finish commands and options in SHELL.

    Put its words where the shell reads them when it starts: ~/.bashrc, ~/.zshrc, or
    ~/.config/fish/completions/armctl.fish.

    Example: armctl completion bash >> ~/.bashrc
    """
    from click.shell_completion import get_completion_class

    from armctl.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(cli, {}, "armctl", "_ARMCTL_COMPLETE").source()
    if not output.result({"shell": shell, "file": FILES[shell], "script": script}):
        click.echo(script)
