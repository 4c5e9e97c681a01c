"""What every command shares: kept options, and the two ways of answering, for people and for programs.

With `--json` stdout holds exactly one JSON object (one a line for streams), also when the command fails;
everything else goes to stderr.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import click

import armctl.client
from armctl.cli.keys import attended
from armctl.cli.parameters import parameter, parameters, tables
from armctl.cli.screen import Screen, filled
from armctl.errors import ArmctlError, ConfigError, LogError, NoDaemon, RequestRefused
from armctl.files import driven_arm, load_arm, load_config, served_socket

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config

Point = tuple[float, float, float]
# What a Ctrl-C leaves behind during a motion: its client is gone, and the daemon stops the arm.
HOLDS = "the arm slows down on its path and holds there; `armctl status` shows it"
RECORDED = ", and what was recorded is kept"


class Output:
    """Where a command's answer goes, and what the options that many commands share were given."""

    def __init__(self) -> None:
        self.json = False
        # What a Ctrl-C leaves behind, said when it comes.
        self.after_interrupt = ""
        # What was done and is kept, and how to go on: said when the command ends before its time, whatever ends it.
        self.kept = ""
        # The command as it was typed.
        self.typed = "armctl"
        # Where answers for people go, and everything else.
        self.console, self.messages = Screen(), Screen(error=True)
        # The daemon that was named; None: the usual one.
        self.socket: str | None = None
        self.config_file: str | None = None
        self.arm_name: str | None = None
        self.port: str | None = None
        self.baud: int | None = None
        self.link: Path | None = None

    def client(self, socket: str | None = None, **options: Any) -> armctl.client.Client:
        """A connection to the daemon that was named."""
        return armctl.client.Client(socket or self.socket, **options)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """What the daemon answers to one request."""
        with self.client() as client:
            return client.call(method, **params)

    def carry_out(
        self, doing: str, method: str, request: Any, *, kept: str = "", told: Callable[[Any], None] | None = None
    ) -> dict[str, Any]:
        """What became of a motion; Ctrl-C stops it, and a terminal shows how far it is.

        Args:
            request: The checked parameters.
            kept: What else a Ctrl-C leaves behind.
            told: Takes what the daemon tells meanwhile; None: it is a warning, or a step of a program.
        """
        params = request if isinstance(request, dict) else request.model_dump(exclude_none=True)
        self.after_interrupt = HOLDS + kept
        with self.client() as client, self._following(f"{doing}; Ctrl-C stops the arm"):
            return client.call(method, on_progress=told or self.warned, **params)

    @contextmanager
    def _following(self, label: str) -> Iterator[None]:
        """Show how far the motion under way is, and how long it will still take."""
        over = Event()

        def follow() -> None:
            with suppress(ArmctlError), self.client() as watcher:
                for snapshot in watcher.subscribe():
                    if over.is_set():
                        break
                    show(snapshot["progress"] or 0.0, snapshot["state"])

        with self.progress(label, 1.0) as show:
            following = Thread(target=follow, daemon=True)
            if self.messages.is_terminal:
                following.start()
            try:
                yield
            finally:
                over.set()

    @cached_property
    def config(self) -> Config:
        """The configuration that was named, or the usual one; of the arm that was named, if one was."""
        config = load_config(self.config_file)
        return config if self.arm_name is None else config.model_copy(update={"arm": self.arm_name})

    @property
    def arm(self) -> ArmConfig:
        """The arm that was named, or the configured one."""

        return load_arm(self.arm_name or self.config.arm)

    def follow_daemon(self) -> None:
        """Take the arm that the daemon drives for the one that is meant; one that was named has to be it.

        Raises:
            ConfigError: no file of an arm says the same of it.
        """
        self.arm_name, _ = driven_arm(self.config.arm, self.ask("status"), self.arm_name is None)
        self.__dict__.pop("config", None)  # it names the arm

    def result(self, data: dict[str, Any]) -> bool:
        """Print `data` if JSON was asked for; whether it was."""
        if self.json:
            print(json.dumps(data, allow_nan=False), flush=True)
        return self.json

    def answer(self, data: dict[str, Any], shown: str | Callable[[], object] | None = None, **told: Any) -> None:
        """Print `data` if JSON was asked for, else say a text, or call what shows it; and what may come next.

        Args:
            shown: None: what `said.toml` has for the command, filled in from the data and what is `told`.
        """
        if self.result(data):
            return
        context = click.get_current_context(silent=True)
        asked = context.command_path.removeprefix("armctl ") if context else ""
        if callable(shown):
            shown()
        elif text := tables("said")["said"][asked].format_map(data | told) if shown is None else shown:
            self.say(text)
        if following := tables("next")["next"].get(asked):
            self.say(f"next: {following.format_map(data)}")

    def ready(self, key: str, value: object) -> None:
        """Tell programs that wait for it that a server has begun."""
        if not self.result({key: value}):
            click.echo(f"ready {value}")

    def live(self, text: str) -> None:
        """A line that stands at the end of the terminal until anything else is said, where a person looks at it."""
        if attended(sys.stdin):
            self.messages.stand(text)

    def say(self, text: str) -> None:
        """A message for a person; never on stdout when JSON was asked for."""
        self.messages.print()  # what stands there goes
        (self.messages if self.json else self.console).print(text)

    def warn(self, text: str) -> None:
        """A message for a person, on stderr whatever was asked for."""
        self.messages.print(text)

    def warned(self, told: dict[str, Any]) -> None:
        """What the daemon tells while it carries a request out: a warning, or a step of a program."""
        self.warn(f"{told.get('warning') or 'step ' + told['step']}: {told['text']}")

    def failure(self, error: ArmctlError) -> None:
        """Tell an expected failure."""
        code = getattr(error, "code", type(error).__name__)
        text = f"armctl: {error}".removeprefix("armctl: " if str(error).startswith("armctl ") else "")
        if code == "STOPPED":  # somebody wanted that
            text = "stopped, as somebody asked: the arm holds where it came to"
        elif isinstance(error, RequestRefused) and len(error.reasons) > 1:
            text = f"armctl: {code}:\n" + "\n".join(f"  - {reason}" for reason in error.reasons)
        following = self.kept or next_command(error, self.socket)
        if self.kept or ("`armctl " not in text and following not in text):
            text += f"\n  next: {following}"
        self.warn(text)
        self.refused(code, str(error), list(getattr(error, "reasons", [str(error)])), following)

    def interrupted(self) -> None:
        """Tell that Ctrl-C ended the command, and what is now."""
        text = ": ".join(filter(None, ("interrupted", self.after_interrupt or self.kept)))
        self.warn(text)
        self.refused("INTERRUPTED", text, [text], "armctl status")

    def refused(self, code: str, message: str, reasons: list[str], following: str, **told: Any) -> None:
        """Print what a program is told of a failure, if it can be: the failure may be that of stdout."""
        with suppress(OSError):
            self.result({**told, "error": {"code": code, "message": message, "reasons": reasons, "next": following}})

    @contextmanager
    def progress(self, label: str, total: float) -> Iterator[Callable[..., None]]:
        """A progress bar with the time left, on stderr, or a line where stderr is no terminal.

        Yields a function of (done, text); the text may be left out.
        """
        began_s = time.monotonic()

        last = ""

        def bar(done: float, note: str = "") -> str:  # within 80 columns
            nonlocal last
            share, last = min(1.0, done / total), note
            took_s = time.monotonic() - began_s
            left = timedelta(seconds=round(min(359_999.0, took_s * (1.0 / share - 1.0)))) if share else "-:--:--"
            return f"{label:<24} {filled(share, 20)} {left} {note}"

        if not self.messages.is_terminal:
            self.warn(f"{label} ...")
        self.messages.stand(bar(0.0))
        yield lambda done, note="": self.messages.stand(bar(done, note))
        if self.messages.is_terminal:
            self.warn(bar(total, last).rstrip())


def millimetres(point_m: Iterable[float]) -> str:
    """A place as people read it."""
    return ", ".join(f"{value * 1000.0:.1f}" for value in point_m) + " mm"


def off(errors: Mapping[str, Any], what: str, digits: int = 1) -> str:
    """How far the tool was off a line or a path; every command says it so, and off which one."""
    mean, most = (f"{errors[f'{kind}_error_mm']:.{digits}f}" for kind in ("mean", "max"))
    return f"{mean} mm mean and {most} mm at most off {what}"


# How an error says which extra is missing.
INSTALL = re.compile(r"pip install '[^']+'")


def next_command(error: ArmctlError, socket: str | None = None) -> str:
    """What to type after an error that does not say so itself: `next.toml` has it, by the error's code or its kind.

    Args:
        socket: The daemon that was asked; None: the usual one.
    """
    code = getattr(error, "code", "")
    if isinstance(error, ConfigError) and error.file.startswith("armctl "):
        return f"{error.file} --help"
    if code == "UNREACHABLE":
        return _workspace_command(socket)
    if found := INSTALL.search(str(error)):
        return found[0]
    known = tables("next")["failed"]
    kinds = [code] + ["recording"] * (isinstance(error, LogError) and "recording" in str(error))
    return next(str(known[kind]) for kind in kinds + [kind.__name__ for kind in type(error).__mro__] if kind in known)


def _workspace_command(socket: str | None) -> str:
    """What shows where the arm in question can reach: the daemon's arm, without a daemon the configured one."""
    with suppress(ArmctlError):
        arm = load_arm(configured := load_config().arm)
        with suppress(NoDaemon), armctl.client.Client(socket, timeout_s=1.0) as client:
            _, arm = driven_arm(configured, client.call("status"))
        return f"armctl workspace --robot {arm.robot_name}"
    return "armctl robots"


# ------------------------------------------------------------------------------------- commands and their options


def command(
    name: str, *shared: click.Parameter, group: click.Group | None = None, **about: Any
) -> Callable[[Callable[..., Any]], click.Command]:
    """Makes a function a command with `--json`; it receives the `Output` as its first argument.

    What else it takes stands in the table beside its module, see `parameters.py`.

    Args:
        shared: Options whose values are kept in the `Output`; the help lists them after the command's own.
        group: What it is a command of; None: of `armctl`.
        about: More for click.
    """

    def made(function: Callable[..., Any]) -> click.Command:
        new: click.Command = (group or click).command(name, **about)(click.pass_obj(function))
        path = f"{group.name} {name}" if group else name
        new.params += [*parameters(function.__module__.rpartition(".")[2], path), *shared, JSON]
        if SOCKET in shared and not any("--arm" in option.opts for option in new.params):
            new.params.append(SERVED)
        return new

    return made


def kept_option(words: str, made: Callable[[str], Any] | None = None, name: str = "", **about: Any) -> click.Parameter:
    """An option of the table `kept`; its value, or what is made of it, stands in the `Output`.

    Args:
        name: Under which name; left out: the option's. Two options of a command may not have the same.
    """

    def keep(ctx: click.Context, option: click.Parameter, value: Any) -> None:
        if value is not None and value is not False:  # what a group was given stays for its commands
            setattr(ctx.ensure_object(Output), name or str(option.name), made(value) if made else value)

    return parameter(words, tables("shared")["kept"][words] | about, expose_value=False, callback=keep)


JSON, SOCKET, CONFIG = map(kept_option, ("--json", "--socket", "--config config_file"))
LINK, BAUD, PORT = map(kept_option, ("--link", "--baud", "--port"))
ARM, SERVED = kept_option("--arm arm_name"), kept_option("--arm service", served_socket, "socket")
