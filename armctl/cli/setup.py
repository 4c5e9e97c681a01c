"""`armctl scan` and `armctl doctor`, and the bus of every command that opens the serial port itself.

The daemon must not run meanwhile, and none of these commands moves a servo.
"""

from __future__ import annotations

import contextlib
import shlex
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING

import click

from armctl.cli.output import ARM, BAUD, CONFIG, PORT, SOCKET, Output, command
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.commissioning.doctor import Check
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
    from armctl.errors import ConfigError

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


# ----------------------------------------------------------------------------------------------------------- scan


@command("scan", PORT, CONFIG)
@click.option("--baud", metavar="N|all", help="One rate, or all usual ones.  [default: the configuration's]")
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
    rows = [{"id" if key == "servo_id" else key: value for key, value in asdict(servo).items()} for servo in found]
    remedy = "check supply and cable" if every else "try --baud all, and check supply and cable"
    shown = partial(show_servos, output, found)
    output.answer({"servos": rows}, shown if found else f"no servo answers; {remedy}")
    return 0 if found else 1


def show_servos(output: Output, found: Sequence[FoundServo]) -> None:
    rows = [
        (
            str(servo.servo_id),
            str(servo.baud),
            *("-" if value is None else str(value) for value in (servo.model, servo.firmware)),
            str(servo.round_trip_us),
            "; ".join(["answers no READ"] * (servo.model is None) + ["two servos have this id"] * servo.clash),
        )
        for servo in found
    ]
    columns = ("id", "baud", "model", "firmware", "round trip, us", "trouble")
    show_table(output.console, "", columns, rows, words=("trouble",))


# --------------------------------------------------------------------------------------------------------- doctor


@command("doctor", ARM, PORT, BAUD, CONFIG, SOCKET)
def doctor_command(output: Output) -> int:
    """Check what this computer needs to move the arm; each problem is named with its remedy.

    Nothing is changed. Exit status 1 when some check is not ok.

    Example: armctl doctor --port /dev/ttyUSB0
    """
    from armctl.commissioning import doctor
    from armctl.errors import NoDaemon
    from armctl.files import data_dir

    config, arm = output.config, output.arm
    bus = make_bus(output, arm.servo_ids)
    daemon = ""
    with contextlib.suppress(NoDaemon), output.client(timeout_s=2.0) as client:
        daemon = f"{client.path}"
    options = {"--port": output.port, "--baud": output.baud, "--config": output.config_file}
    surroundings = doctor.Surroundings(
        daemon=daemon,
        log_dir=data_dir(config) / "logs",
        free_bytes=config.log.free_bytes,
        options="".join(f" {option} {shlex.quote(str(value))}" for option, value in options.items() if value),
    )
    checks = doctor.check_host(surroundings) + doctor.check_port(bus, surroundings)
    if bus.is_open:
        with contextlib.closing(bus), output.progress("asking every id", 254.0) as show:
            checks += doctor.check_servos(
                bus, arm, config.period_s, surroundings, lambda _baud, done, _all: show(float(done))
            )
    output.answer({"checks": [asdict(check) for check in checks]}, partial(show_checks, output, checks))
    return 0 if all(check.ok for check in checks) else 1


def show_checks(output: Output, checks: Sequence[Check]) -> None:
    """One line for each finding, with its servos; problems come last, each with its remedy."""
    order = list(dict.fromkeys(check.name for check in checks))
    servo_ids: dict[tuple[bool, int, str, str], list[str]] = {}
    for check in checks:
        ids = servo_ids.setdefault((not check.ok, order.index(check.name), check.value, check.fix), [])
        ids += [] if check.servo_id is None else [str(check.servo_id)]

    def say(text: str, indent: int) -> None:
        lines = textwrap.fill(text, output.console.width, subsequent_indent=" " * indent, break_on_hyphens=False)
        output.console.print(lines, markup=False, highlight=False)

    for (bad, name, value, fix), ids in sorted(servo_ids.items(), key=lambda item: item[0][:2]):
        where = f"  (servo {', '.join(ids)})" if ids else ""
        say(f"{'FAIL' if bad else 'ok':<5} {order[name]:<16} {value}{where}", 23)
        if bad:  # from the left: a command to type is then rarely broken
            say(f"      -> {fix}", 9)
