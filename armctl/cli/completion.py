"""`armctl completion`: the script that lets a shell finish command lines."""

import click

from armctl.cli.output import Output, command

FILES = {"bash": "~/.bashrc", "zsh": "~/.zshrc", "fish": "~/.config/fish/completions/armctl.fish"}


@command("completion")
@click.argument("shell", type=click.Choice(tuple(FILES)))
def completion_command(output: Output, shell: str) -> None:
    """Print what lets the Tab key finish commands and options in SHELL.

    Append its output to the file that the shell reads when it starts: ~/.bashrc, ~/.zshrc, or
    ~/.config/fish/completions/armctl.fish.

    Example: armctl completion bash >> ~/.bashrc
    """
    from click.shell_completion import get_completion_class

    from armctl.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(cli, {}, "armctl", "_ARMCTL_COMPLETE").source()
    output.answer({"shell": shell, "file": FILES[shell], "script": script}, lambda: click.echo(script))
