"""The command line: a client of the daemon, and the offline entry points.

Commands only parse, call and print. Heavy modules are imported inside the commands, so that `armctl stop` does
not wait for a plotting library.
"""

import importlib
from collections.abc import Sequence

import click

from armctl import __version__
from armctl.cli.output import Output
from armctl.errors import ArmctlError

# What the help lists under which heading, in the order in which a newcomer meets it.
PURPOSES: dict[str, tuple[str, ...]] = {
    "First steps": ("demo", "try", "setup", "sim", "daemon", "help", "completion"),
    "Running the arm": (
        *("status", "watch", "stop", "hold", "pause", "resume", "rate", "torque", "move", "jog", "reach", "transfer"),
        *("run", "play", "path", "program", "park", "release", "clear"),
    ),
    "Teaching and straightening": ("teach", "recordings", "optimize", "experiment"),
    "Setting an arm up": ("arms", "arm", "scan", "doctor", "servo", "calibrate", "install", "uninstall", "web", "live"),
    "Logs": ("log", "replay", "report"),
    "Kinematics, without an arm": ("robots", "fk", "ik", "jacobian", "workspace", "trajectory", "reproduce"),
    "For maintainers": ("study", "hand", "fault"),
}
# Module of this package -> the commands in it, each as `NAME_command`; every other command has a module of its name.
_SHARED = {
    "arm": ("arms", "clear", "hold", "park", "pause", "rate", "release", "resume", "status", "stop", "torque", "watch"),
    "demo": ("try",),
    "help": ("completion",),
    "jobs": ("optimize", "play", "recordings", "run"),
    "kinematics": ("fk", "ik", "jacobian", "robots", "trajectory", "workspace"),
    "logs": ("replay",),
    "motion": ("jog", "move", "path", "reach", "transfer"),
    "processes": ("daemon", "fault", "hand", "live", "sim", "web"),
    "setup": ("doctor", "install", "report", "scan", "uninstall"),
}
_COMMANDS = {name: name for names in PURPOSES.values() for name in names}
_COMMANDS |= {name: module for module, names in _SHARED.items() for name in names}
# Characters at most that say in the list what a command does.
SUMMARY = 100


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

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for purpose, names in PURPOSES.items():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            rows = [(name, command.get_short_help_str(SUMMARY)) for name, command in commands if command is not None]
            with formatter.section(purpose):
                formatter.write_dl(rows)


_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


@click.group(cls=_Commands, context_settings=_SETTINGS)
@click.version_option(__version__, prog_name="armctl")
def cli() -> None:
    """A daemon that can be trusted with a Dynamixel AX-12A arm.

    Start with `armctl demo`. On an arm: `armctl daemon --port /dev/ttyUSB0` in one terminal, then `armctl status`,
    `armctl teach`, `armctl optimize` and `armctl run` in another. `armctl stop` always works, and Ctrl-C stops what it
    interrupts.

    `armctl COMMAND --help` explains a command with an example, `armctl help` lists pages to read, and
    `armctl completion bash` lets the Tab key finish names.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit status: 0 done, 1 refused or failed, 2 wrong usage, 3 no daemon, 130 interrupted by Ctrl-C.
    """
    output = Output()
    try:
        arguments = list(argv) if argv is not None else None
        result = cli.main(arguments, prog_name="armctl", obj=output, standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        output.interrupted()
        return 130
    except ArmctlError as error:
        output.failure(error)
        return error.exit_status
    except BrokenPipeError:
        return 1
    return result if isinstance(result, int) else 0
