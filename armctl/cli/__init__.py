"""The command line: a client of the daemon, and the offline entry points.

Commands only parse, call and print. Heavy modules are imported inside the commands, so that `armctl stop` does
not wait for a plotting library.
"""

import importlib
import shlex
import sys
from collections.abc import Sequence

import click

from armctl import __version__
from armctl.cli.output import Output
from armctl.cli.parameters import tables
from armctl.errors import ArmctlError

# What the help lists under which heading, and the module of each command; it has the command as `NAME_command`.
PURPOSES: dict[str, dict[str, str]] = tables("commands")
_MODULES = {name: module for commands in PURPOSES.values() for name, module in commands.items()}
# Characters at most that say in the list what a command does.
SUMMARY = 100


class _Commands(click.Group):
    """Imports a command's module when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_MODULES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _MODULES:
            return None
        module = importlib.import_module(f"armctl.cli.{_MODULES[cmd_name]}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for purpose, names in PURPOSES.items():
            rows = [(name, one.get_short_help_str(SUMMARY)) for name in names if (one := self.get_command(ctx, name))]
            with formatter.section(purpose):
                formatter.write_dl(rows)


_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


@click.group(cls=_Commands, context_settings=_SETTINGS)
@click.version_option(__version__, prog_name="armctl")
def cli() -> None:
    """A daemon that can be trusted with a Dynamixel AX-12A arm.

    Start with `armctl try`, which needs no arm. On an arm: `armctl setup` once, then `armctl daemon --port
    /dev/ttyUSB0` in one terminal, and in another what is listed first. `armctl stop` always works, and Ctrl-C stops
    what it interrupts.

    `armctl COMMAND --help` explains a command with an example, `armctl help` lists pages to read, and
    `armctl completion bash` lets the Tab key finish names.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit status: 0 done, 1 refused or failed, 2 wrong usage, 3 no daemon, 130 interrupted by Ctrl-C.
    """
    output, arguments = Output(), sys.argv[1:] if argv is None else list(argv)
    output.typed = shlex.join(["armctl", *arguments])
    try:
        result = cli.main(arguments, prog_name="armctl", obj=output, standalone_mode=False)
    except click.ClickException as error:
        error.show()
        output.json |= "--json" in arguments  # what was read may end before it
        text, context = error.format_message(), getattr(error, "ctx", None)
        output.refused("USAGE", text, [text], f"{context.command_path if context else 'armctl'} --help")
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        output.interrupted()
        return 130
    except ArmctlError as error:
        output.failure(error)
        return error.exit_status
    except OSError as error:  # stdout is full, for one
        output.failure(ArmctlError(str(error)))
        return 1
    return result if isinstance(result, int) else 0
