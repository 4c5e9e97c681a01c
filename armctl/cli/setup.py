"""`armctl setup`, `scan`, `doctor`, `report`, `install`, `uninstall`; the bus of every command that opens the port.

The daemon must not run while a command of this module has the port. `setup` moves servos, a little and when it may; the
others move none.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.keys import attended
from armctl.cli.output import ARM, BAUD, CONFIG, PORT, SOCKET, Output, command
from armctl.cli.tables import show_rows
from armctl.commissioning.texts import refusal, said
from armctl.errors import ArmctlError, ConfigError, NoDaemon, RequestRefused
from armctl.files import calibration_dirs, data_dir, find_arm_file, load_arm, served_socket

if TYPE_CHECKING:
    from armctl.commissioning.doctor import Check
    from armctl.commissioning.installation import Act
    from armctl.commissioning.scan import FoundServo
    from armctl.dynamixel.bus import ServoBus
    from armctl.dynamixel.port import ServoPort


def make_port(path: str, baud: int) -> ServoPort:
    """The port the commands of this module use, not yet open."""
    from armctl.clock import MonotonicClock
    from armctl.dynamixel.serial_port import SerialPort

    return SerialPort(path, baud, MonotonicClock())


def make_bus(output: Output, servo_ids: Sequence[int] = ()) -> ServoBus:
    """The bus named by options and configuration, not yet open."""
    from armctl.dynamixel.bus import ServoBus

    context = click.get_current_context(silent=True)
    asked = context.command_path if context else "the bus"
    path, baud = output.port or output.config.port, output.baud
    if not path:
        raise ConfigError(asked, "--port", "no serial port named", "give --port PATH, or start `armctl sim`")
    if baud is not None and not 9_000 <= baud <= 1_000_000:
        raise ConfigError(asked, "--baud", f"{baud} is outside 9000..1000000")
    return ServoBus(make_port(path, baud or output.config.baud), servo_ids)


@contextlib.contextmanager
def opened(output: Output, servo_ids: Sequence[int] = ()) -> Iterator[ServoBus]:
    """The bus named by options and configuration, open; closed whatever happens."""
    bus = make_bus(output, servo_ids)
    bus.open()
    with contextlib.closing(bus):
        yield bus


# ---------------------------------------------------------------------------------------------------------- setup


@command("setup", PORT, BAUD, CONFIG)
def setup_command(output: Output, arm_file: str | None, answers: Path | None) -> None:
    """Set your own arm up, step by step: servos, joints, directions, limits, poses, a first small motion.

    ARM_FILE is an arm of the same shape: a name of `armctl arms`, or your own file, which is renewed. It says how the
    links are. All else is found out, with you beside the arm: you turn the limp joints by hand, and say what you saw.
    What was found is kept after every step. Type q or Ctrl-C to break off, and the same command to go on there.
    With --json another program asks: steps and questions on stdout, answers on stdin, one a line. With --answers every
    question shows the answer from the file, and Enter takes it; at the end of the input nobody is waited for.

    Example: armctl setup ax12-line --port /dev/ttyUSB0
    """
    from armctl.commissioning.arm_file import active_path, arms_at_hand
    from armctl.commissioning.wizard import Wizard, progress, progress_path

    over_pipe = output.json and not answers
    person = OverPipe(output) if over_pipe else AtTerminal(output, "armctl setup", "or give --answers FILE", answers)
    kinds = [arm["name"] for arm in arms_at_hand() if not (arm["joints"] and load_arm(arm["path"]).pairs)]
    kind = arm_file or person.ask("kind", "which arm is yours like?", kinds)
    arm, path = load_arm(kind), active_path(kind)
    if arm.pairs:
        raise ConfigError(kind, "pair", said("pair apart"), said("pair apart, help"))
    name = arm.arm_id
    if path.resolve() != find_arm_file(kind).resolve():  # it comes with armctl; yours gets a name of its own
        name = person.ask("name", "what shall yours be called? A word, such as my-arm")
        path = path.parent / f"{name}.yaml"
    found = progress(kind, name, path)
    ports = sorted(str(port) for pattern in ("serial/by-id/*", "tty[UA]*[BM]*") for port in Path("/dev").glob(pattern))
    output.port = output.port or output.config.port or person.ask("port", "which port has the adapter?", ports)
    kept = f"what was found is kept in {progress_path(path)}"
    output.after_interrupt = f"{kept}; begin again with the same arm and name to go on there"
    steps = {}
    for step in Wizard(arm, path, found, partial(opened, output), person, output.config.period_s).run():
        steps[step["name"]] = step
        if over_pipe:
            output.result({"step": step})
        output.say("{name}: {text}".format(**step))
    given = f"--arm {name if path.parent == calibration_dirs()[0] else path} --port {output.port}"
    following = ["doctor " + given, "calibrate --points sheet.csv " + given, "daemon " + given, "calibrate --sag"]
    told = {"arm": str(path), "port": output.port, "steps": [*steps.values()]}
    output.answer(told, "\n  armctl ".join(["next:", *following]))


class AtTerminal:
    """The person at this terminal; q, and the end of the input where no answers are prepared, break off."""

    def __init__(self, output: Output, asks: str, instead: str, answers: Path | None = None) -> None:
        """
        Args:
            asks: The command that asks.
            instead: What to do where there is nobody.
            answers: Those that are prepared.
        """
        from armctl.commissioning.finding import Prepared

        if not answers and (output.json or not attended(sys.stdin)):
            raise ConfigError(asks, "", "needs a terminal and no --json", instead)
        self._output, self._prepared = output, Prepared(answers) if answers else None

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        while True:
            self._show(key, text, choices)
            line = sys.stdin.readline()
            word = line.strip() if line or self._prepared else "q"
            if word == "q":
                raise click.Abort
            if self._prepared and not word and (key in self._prepared.answers or not (line and choices)):
                return self._prepared.ask(key, text, choices)
            fitting = [choice for choice in choices if word in (choice, choice[0])] if choices else [word]
            if len(fitting) == 1:
                return fitting[0]

    def again(self, defect: RequestRefused) -> bool:
        text = f"{defect}\ntry again, or break off?"
        return not self._prepared and self.ask("again", text, ("again", "q")) == "again"

    def _show(self, key: str, text: str, choices: Sequence[str]) -> None:
        wanted = f" ({', '.join(choices)})" if choices else "" if key == "name" else ", then press Enter"
        prepared = f"\n{key} [{self._prepared.answers.get(key, '')}], Enter:" if self._prepared else ""
        self._output.say(f"\n{text}{wanted}{prepared}")


class OverPipe(AtTerminal):
    """Somebody asked by the program that started this one: questions on stdout, answers on stdin, a line each."""

    def __init__(self, output: Output) -> None:
        self._output, self._prepared = output, None

    def _show(self, key: str, text: str, choices: Sequence[str]) -> None:
        self._output.result({"question": {"key": key, "text": text, "choices": [*choices]}})


# ----------------------------------------------------------------------------------------------------------- scan


@command("scan", PORT, CONFIG)
def scan_command(output: Output, baud: str | None) -> int:
    """List the servos that answer: all ids at one baud in about a second, or at all usual bauds.

    Example: armctl scan --port /dev/ttyUSB0 --baud all
    """
    from armctl.commissioning.scan import USUAL_BAUDS, scan

    if baud is not None and baud != "all" and not baud.isdecimal():
        raise click.BadParameter(f"{baud!r} is neither a number nor `all`", param_hint="--baud")
    every = baud == "all"
    output.baud = int(baud) if baud and not every else None
    with opened(output) as bus:
        bauds = USUAL_BAUDS if every else (bus.port.baudrate,)
        with output.progress("asking every id", float(len(bauds))) as show:
            found = scan(
                bus, bauds, progress=lambda at, done, all_: show(bauds.index(at) + done / all_, f"{at} baud, id {done}")
            )
    rows = [{"id" if key == "servo_id" else key: value for key, value in servo._asdict().items()} for servo in found]
    remedy = "check supply and cable" if every else "try --baud all, and check supply and cable"
    output.answer({"servos": rows}, partial(show_servos, output, found) if found else f"no servo answers; {remedy}")
    return 0 if found else 1


def show_servos(output: Output, found: Sequence[FoundServo]) -> None:
    troubles = [["answers no READ"] * (one.model is None) + ["two servos have this id"] * one.clash for one in found]
    rows = [one._asdict() | {"trouble": "; ".join(of)} for one, of in zip(found, troubles, strict=True)]
    show_rows(output.console, "servos", "", rows)


# --------------------------------------------------------------------------------------------------------- doctor


@command("doctor", ARM, PORT, BAUD, CONFIG, SOCKET)
def doctor_command(output: Output) -> int:
    """Check what this computer needs to move the arm; each problem is named with its remedy.

    Nothing is changed. Exit status 1 when some check is not ok.

    Example: armctl doctor --port /dev/ttyUSB0
    """
    from armctl.commissioning import doctor

    config, arm = output.config, output.arm
    bus = make_bus(output, arm.servo_ids)
    daemon = ""
    with contextlib.suppress(NoDaemon), output.client(timeout_s=2.0) as client:
        daemon = f"{client.socket_file}"
    given = {"--port": output.port, "--baud": output.baud, "--config": output.config_file}
    options = "".join(f" {option} {shlex.quote(str(value))}" for option, value in given.items() if value)
    surroundings = doctor.Surroundings(daemon, data_dir(config) / "logs", config.log.free_bytes, options)
    checks = doctor.check_host(surroundings) + doctor.check_port(bus, surroundings)
    if bus.is_open:
        with contextlib.closing(bus), output.progress("asking every id", 254.0) as show:
            checks += doctor.check_servos(
                bus, arm, config.period_s, surroundings, lambda _baud, done, _all: show(float(done))
            )
    output.answer({"checks": [check._asdict() for check in checks]}, partial(show_checks, output, checks))
    return 0 if all(check.ok for check in checks) else 1


def show_checks(output: Output, checks: Sequence[Check]) -> None:
    """One line for each finding, with its servos; problems come last, each with its remedy."""
    order = list(dict.fromkeys(check.name for check in checks))
    servo_ids: dict[tuple[bool, int, str, str], list[str]] = {}
    for check in checks:
        ids = servo_ids.setdefault((not check.ok, order.index(check.name), check.value, check.fix), [])
        ids += [] if check.servo_id is None else [str(check.servo_id)]

    def say(text: str, indent: int) -> None:
        width = output.console.width
        output.console.print(*textwrap.wrap(text, width, subsequent_indent=" " * indent, break_on_hyphens=False))

    for (bad, name, value, fix), ids in sorted(servo_ids.items(), key=lambda item: item[0][:2]):
        where = f"  (servo {', '.join(ids)})" if ids else ""
        say(f"{'FAIL' if bad else 'ok':<5} {order[name]:<16} {value}{where}", 23)
        if bad:  # from the left: a command to type is then rarely broken
            say(f"      -> {fix}", 9)


@command("report", CONFIG)
def report_command(output: Output, out: Path | None) -> None:
    """Gather versions, doctor, status, configuration and the last logs into one zip file for a bug report.

    Secrets, your name and your home folder are left out of every text; look through the file before you send it.

    Example: armctl report --out armctl-report.zip
    """
    from armctl.commissioning import bundle

    path = out or Path(f"armctl-report-{datetime.now():%Y%m%d-%H%M%S}.zip")
    logs = None
    with contextlib.suppress(ArmctlError), output.client(timeout_s=2.0) as client:
        logs = (log := client.call("log")["path"]) and Path(log).parent
        output.follow_daemon()
    files = bundle.write(path, output.config, output.config_file or "", logs, lambda part: output.say(f"  {part}"))
    size_MB = path.stat().st_size / 1e6
    output.answer({"path": str(path), "files": files}, f"{path}: {len(files)} files, {size_MB:.1f} MB")


# States in which a restart of the daemon changes nothing that the arm does.
AT_REST = ("off", "holding", "faulted", "starting", "stalled")


@command("install")
def install_command(output: Output, dry_run: bool, root: Path, yes: bool, **wanted: Any) -> None:
    """Make the daemon a service that starts with the system, or bring that service up to date.

    Says what it does, shows how files change that are there and asks before it replaces them, and restarts only what
    changed, while the arm is at rest. Keeps configuration, calibrations and drop-ins. The adapter need not be there.
    The dashboard's service is installed too, but starts only when asked:
    `sudo systemctl enable --now armctl-web`.

    Example: sudo armctl install --port /dev/ttyUSB0
    """
    from armctl.commissioning.installation import SYSTEM, File, Run, hindrance, installation

    wanted["user"] = os.environ.get("SUDO_USER", "") if wanted["user"] is None else wanted["user"]
    acts = installation(**wanted, root=root)
    if root == SYSTEM and not dry_run and (why := hindrance(acts)):
        raise ConfigError("armctl install", "", why, "run `armctl daemon` by hand instead")
    if not dry_run and root == SYSTEM:
        _refuse_moving(act.command for act in acts if isinstance(act, Run) and act.due(root))
    differences = [text for act in acts if isinstance(act, File) and (text := act.difference(root))]
    for text in differences:
        output.say(text)
    if differences and not (yes or dry_run or output.json) and attended(sys.stdin):
        click.confirm("replace what is shown?", abort=True)
    done = "armctl runs as a service; see `armctl status`" if root == SYSTEM else f"written below {root}"
    _carry_out(output, acts, root, dry_run, done)


def _refuse_moving(commands: Iterable[Sequence[str]]) -> None:
    """Refuse to restart a daemon whose arm is not at rest.

    Raises:
        RequestRefused: code MOVING.
    """
    from armctl.client import Client

    for words in commands:
        if words[1] == "restart" and (found := re.fullmatch(r"armctl(?:@(.+))?[.]service", words[-1])):
            with contextlib.suppress(NoDaemon), Client(served_socket(found[1] or "armctl"), timeout_s=2.0) as client:
                if (state := client.call("status")["state"]) not in AT_REST:
                    raise refusal("MOVING", unit=words[-1], state=state)


# What no uninstallation removes.
LEFT = "left: /etc/armctl, /var/lib/armctl, /var/lib/armctl-web-lan, users and groups armctl and armctl-web"


@command("uninstall")
def uninstall_command(output: Output, dry_run: bool, root: Path) -> None:
    """Remove the service; configuration, calibrations, logs and recordings stay.

    The arm comes to rest and keeps its torque: type `armctl park` first to have it limp at its rest pose.

    Example: sudo armctl uninstall --dry-run
    """
    from armctl.commissioning.installation import removal

    _carry_out(output, removal(), root, dry_run, LEFT)


def _carry_out(output: Output, acts: Sequence[Act], root: Path, dry_run: bool, done: str) -> None:
    from armctl.commissioning.installation import carry_out

    told: list[dict[str, object]] = []

    def tell(act: Act, due: bool) -> None:
        told.append({"act": str(act), "due": due})
        output.say(("would " if dry_run and due else "") + str(act) + ("" if due else "  (nothing to do)"))

    carry_out(acts, root, tell, dry_run=dry_run)
    if not dry_run:
        output.say(done)
    output.result({"acts": told, "done": not dry_run})
