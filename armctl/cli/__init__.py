"""The command line: a client of the daemon, and the offline entry points.

Commands only parse, call and print. Heavy modules are imported inside the commands, so that `armctl stop` does
not wait for a plotting library.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import click

from armctl import __version__
from armctl.cli.output import Output
from armctl.errors import ArmctlError

_COMMANDS = {
    "calibrate": "setup",
    "clear": "arm",
    "daemon": "processes",
    "demo": "demo",
    "doctor": "setup",
    "fault": "processes",
    "hand": "processes",
    "hold": "arm",
    "log": "logs",
    "optimize": "jobs",
    "park": "arm",
    "recordings": "jobs",
    "release": "arm",
    "replay": "logs",
    "robots": "logs",
    "run": "jobs",
    "scan": "setup",
    "servo": "setup",
    "sim": "processes",
    "status": "arm",
    "stop": "arm",
    "teach": "jobs",
    "torque": "arm",
    "watch": "arm",
}
"""Command -> the module of this package that defines it (as `NAME_command`)."""


class _Commands(click.Group):
    """Imports a command's module when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module = importlib.import_module(f"armctl.cli.{_COMMANDS[cmd_name]}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="armctl")
def cli() -> None:
    """A daemon that can be trusted with a Dynamixel AX-12A arm.

    Start with `armctl demo`. On an arm: `armctl daemon --port /dev/ttyUSB0` in one terminal, then `armctl status`,
    `armctl teach`, `armctl optimize` and `armctl run` in another. `armctl stop` always works.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (0 done, 1 refused or failed, 2 wrong usage, 3 no daemon)."""
    output = Output()
    try:
        result = cli.main(list(argv) if argv is not None else None, obj=output, standalone_mode=False)
    except click.UsageError as error:
        error.show()
        return 2
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return 130
    except ArmctlError as error:
        output.failure(error)
        return error.exit_status
    except BrokenPipeError:
        return 1
    return result if isinstance(result, int) else 0
