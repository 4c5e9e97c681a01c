"""What every command shares: options, and the two ways of answering, for people and for programs.

With `--json` stdout holds exactly one JSON object (one a line for streams), also when the command fails;
everything else goes to stderr.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from armctl.errors import (
    ArmctlError,
    BusError,
    ConfigError,
    LogError,
    NoDaemon,
    RequestRefused,
    UnreachableTarget,
)

HOLDS = "the arm slows down on its path and holds there; `armctl status` shows it"
"""What a Ctrl-C leaves behind during a motion: its client is gone, and the daemon stops the arm."""

F = TypeVar("F", bound=Callable[..., Any])


class Output:
    """Where a command's answer goes."""

    def __init__(self) -> None:
        self.json = False
        self.console = Console()
        self.messages = Console(stderr=True)
        self.after_interrupt = ""
        """What a Ctrl-C leaves behind, said when it comes."""
        self.socket: str | None = None
        """The daemon that was named; None: the usual one."""

    def result(self, data: dict[str, Any]) -> bool:
        """Print `data` if JSON was asked for; whether it was."""
        if self.json:
            print(json.dumps(data, allow_nan=False), flush=True)
        return self.json

    def say(self, text: str) -> None:
        """A message for a person; never on stdout when JSON was asked for."""
        (self.messages if self.json else self.console).print(text, markup=False, highlight=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """A message for a person, on stderr whatever was asked for."""
        self.messages.print(text, markup=False, highlight=False, soft_wrap=True)

    def failure(self, error: ArmctlError) -> None:
        """Tell an expected failure."""
        code = getattr(error, "code", type(error).__name__)
        if isinstance(error, RequestRefused) and len(error.reasons) > 1:
            text = f"{code}:\n" + "\n".join(f"  - {reason}" for reason in error.reasons)
        else:
            text = str(error)
        following = next_command(error, self.socket)
        if "`armctl " not in text and following not in text:
            text += f"\n  next: {following}"
        self.warn(text if text.startswith("armctl ") else f"armctl: {text}")  # some begin with the command
        reasons = list(getattr(error, "reasons", [str(error)]))
        self.result({"error": {"code": code, "message": str(error), "reasons": reasons, "next": following}})

    def interrupted(self) -> None:
        """Tell that Ctrl-C ended the command, and what is now."""
        text = "interrupted" + (f": {self.after_interrupt}" if self.after_interrupt else "")
        self.warn(text)
        self.result({"error": {"code": "INTERRUPTED", "message": text, "reasons": [text], "next": "armctl status"}})

    @contextmanager
    def progress(self, label: str, total: float) -> Iterator[Callable[[float, str], None]]:
        """A progress bar with the time left, on stderr, or a line where stderr is no terminal.

        Yields a function of (done, text).
        """
        if not self.messages.is_terminal:
            self.warn(f"{label} ...")
        columns = (
            TextColumn("{task.description:<24}"),
            BarColumn(30),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        with Progress(*columns, console=self.messages, disable=not self.messages.is_terminal) as bars:
            bar = bars.add_task(label, total=total, note="")

            def show(done: float, note: str) -> None:
                bars.update(bar, completed=done, note=note)

            yield show


NEXT = {
    "LIMIT": "armctl status, which shows every joint within its limits",
    "NO_PLAN": "armctl optimize --help",
    "BAD_RECORDINGS": "armctl recordings",
    "RECORDS_LOST": "armctl recordings",
    "EXISTS": "another name, or armctl recordings",
}
"""Code of a refusal -> what to type next; where none stands here, `armctl status`."""


def next_command(error: ArmctlError, socket: str | None = None) -> str:
    """What to type after an error that does not say so itself.

    Args:
        socket: The daemon that was asked; None: the usual one.
    """
    if isinstance(error, ConfigError):
        command = error.file if error.file.startswith("armctl ") else "armctl help configuration"
        return f"{command} --help" if command == error.file else command
    if isinstance(error, NoDaemon):
        return "armctl daemon --port PORT"
    if isinstance(error, UnreachableTarget) or getattr(error, "code", "") == "UNREACHABLE":
        return _workspace_command(socket)
    if isinstance(error, BusError):
        return "armctl doctor"
    if isinstance(error, LogError):
        return "armctl recordings" if "recording" in str(error) else "armctl help logs"
    if isinstance(error, RequestRefused):
        return NEXT.get(error.code, "armctl status")
    remedy = INSTALL.search(str(error))
    return remedy[0] if remedy else "armctl help"


INSTALL = re.compile(r"pip install '[^']+'")
"""How an error says which extra is missing."""


def _workspace_command(socket: str | None) -> str:
    """What shows where the arm in question can reach: the daemon's arm, without a daemon the configured one."""
    from armctl.client import Client
    from armctl.files import calibration_dirs, load_arm, load_config

    with suppress(ArmctlError):
        arms = [load_arm(load_config().arm)]
        with suppress(NoDaemon), Client(socket, timeout_s=1.0) as client:
            arm_id = client.call("status")["arm_id"]
            arms += [load_arm(str(path)) for folder in calibration_dirs() for path in sorted(folder.glob("*.yaml"))]
            arms = [arm for arm in arms if arm.arm_id == arm_id]
        if arms:
            return f"armctl workspace --robot {arms[0].robot}"
    return "armctl robots"


def output_option(function: F) -> F:
    """Adds `--json`; the command receives the `Output` as its first argument."""

    def remember(ctx: click.Context, _parameter: click.Parameter, value: bool) -> None:
        ctx.ensure_object(Output).json |= value

    option = click.option(
        "--json", is_flag=True, expose_value=False, is_eager=True, callback=remember, help="One JSON object on stdout."
    )
    return click.pass_obj(option(function))  # type: ignore[return-value]


def socket_option(function: F) -> F:
    """Adds `--socket`."""

    def remember(ctx: click.Context, _parameter: click.Parameter, value: str | None) -> str | None:
        ctx.ensure_object(Output).socket = value
        return value

    text = "The daemon's socket (ARMCTL_SOCKET)."
    return click.option("--socket", "socket", metavar="PATH", callback=remember, help=text)(function)


def config_option(function: F) -> F:
    """Adds `--config`."""
    return click.option("--config", "config_file", metavar="FILE", help="Configuration file (ARMCTL_CONFIG).")(function)


class PointType(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """`x,y,z` in metres."""

    name = "x,y,z"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y, z = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not three numbers x,y,z in metres, such as 0.18,-0.125,0.10", param, ctx)
        if not all(math.isfinite(part) and abs(part) <= 10.0 for part in (x, y, z)):
            self.fail(f"{value!r}: each coordinate must be finite and within 10 m (the unit is metres)", param, ctx)
        return x, y, z


POINT = PointType()


def exit_failed() -> int:
    """Exit status of a command whose check did not hold."""
    sys.stdout.flush()
    return 1
