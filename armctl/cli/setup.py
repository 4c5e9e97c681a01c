"""Finding and judging an arm's servos, and what every command shares that opens the serial port itself.

The daemon must not run meanwhile, and none of these commands moves a servo.
"""

from __future__ import annotations

import contextlib
import shlex
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armctl.cli.output import F, Output, config_option, exit_failed, output_option, socket_option
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.commissioning.doctor import Check
    from armctl.commissioning.scan import FoundServo
    from armctl.config import Config
    from armctl.dynamixel.bus import ServoBus
    from armctl.dynamixel.port import ServoPort

FILE = click.Path(path_type=Path, dir_okay=False)


def port_options(function: F) -> F:
    """Adds `--port`, `--baud` and `--config`."""
    function = config_option(function)
    function = click.option("--baud", type=int, help="Rate of the bus, bit/s.  [default: the configuration's]")(
        function
    )
    return click.option("--port", metavar="PATH", help="Serial port of the arm, or the link of `armctl sim`.")(function)


def arm_option(function: F) -> F:
    """Adds `--arm`."""
    return click.option("--arm", metavar="NAME|FILE", help="Which calibration file describes the arm.")(function)


def make_port(path: str, baud: int) -> ServoPort:
    """The port the commands of this module use, not yet open."""
    from armctl.clock import MonotonicClock
    from armctl.dynamixel.serial_port import SerialPort

    return SerialPort(path, baud, MonotonicClock())


def make_bus(config: Config, port: str | None, baud: int | None, servo_ids: Sequence[int] = ()) -> ServoBus:
    """The bus named by options and configuration, not yet open."""
    from armctl.dynamixel.bus import ServoBus
    from armctl.errors import ConfigError

    context = click.get_current_context(silent=True)
    command = context.command_path if context else "the bus"
    path = port or config.port
    if not path:
        raise ConfigError(command, "--port", "no serial port named", "give --port PATH, or start `armctl sim`")
    if baud is not None and not 9_000 <= baud <= 1_000_000:
        raise ConfigError(command, "--baud", f"{baud} is outside 9000..1000000")
    transport = make_port(path, baud or config.baud)
    return ServoBus(transport, servo_ids)


@contextlib.contextmanager
def opened(bus: ServoBus) -> Iterator[ServoBus]:
    """The bus, open; closed whatever happens."""
    bus.open()
    try:
        yield bus
    finally:
        bus.close()


# ----------------------------------------------------------------------------------------------------------- scan


@click.command("scan")
@click.option("--port", metavar="PATH", help="Serial port of the arm, or the link of `armctl sim`.")
@click.option("--baud", metavar="N|all", help="One rate, or all usual ones.  [default: the configuration's]")
@config_option
@output_option
def scan_command(output: Output, port: str | None, baud: str | None, config_file: str | None) -> int:
    """Which servos answer: all ids at one baud in about a second, or at all usual bauds.

    Example: armctl scan --port /dev/ttyUSB0 --baud all
    """
    from armctl.commissioning.scan import USUAL_BAUDS, scan
    from armctl.files import load_config

    if baud is not None and baud != "all" and not baud.isdecimal():
        raise click.BadParameter(f"{baud!r} is neither a number nor `all`", param_hint="--baud")
    every = baud == "all"
    bus = make_bus(load_config(config_file), port, int(baud) if baud and not every else None)
    bauds = USUAL_BAUDS if every else (bus.port.baudrate,)
    with opened(bus), output.progress("asking every id", float(len(bauds))) as show:
        found = scan(
            bus, bauds, progress=lambda at, done, total: show(bauds.index(at) + done / total, f"{at} baud, id {done}")
        )
    rows = [
        {
            "id": servo.servo_id,
            "baud": servo.baud,
            "model": servo.model,
            "firmware": servo.firmware,
            "round_trip_us": servo.round_trip_us,
            "clash": servo.clash,
        }
        for servo in found
    ]
    if not output.result({"servos": rows}):
        if found:
            show_servos(output, found)
        else:
            remedy = "check supply and cable" if every else "try --baud all, and check supply and cable"
            output.say(f"no servo answers; {remedy}")
    return 0 if found else exit_failed()


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


@click.command("doctor")
@arm_option
@port_options
@socket_option
@output_option
def doctor_command(
    output: Output,
    arm: str | None,
    port: str | None,
    baud: int | None,
    config_file: str | None,
    socket: str | None,
) -> int:
    """What stands between this computer and a moving arm, with one remedy for each trouble.

    Nothing is changed. Exit status 1 when some check is not ok.

    Example: armctl doctor --port /dev/ttyUSB0
    """
    from armctl.client import Client
    from armctl.commissioning import doctor
    from armctl.errors import NoDaemon
    from armctl.files import data_dir, load_arm, load_config

    config = load_config(config_file)
    described = load_arm(arm or config.arm)
    bus = make_bus(config, port, baud, described.servo_ids)
    daemon = ""
    with contextlib.suppress(NoDaemon), Client(socket, timeout_s=2.0) as client:
        daemon = f"{client.path}"
    options = {"--port": port, "--baud": baud, "--config": config_file}
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
                bus, described, config.period_s, surroundings, lambda _baud, done, _all: show(float(done), "")
            )
    if not output.result({"checks": [asdict(check) for check in checks]}):
        show_checks(output, checks)
    return 0 if all(check.ok for check in checks) else exit_failed()


def show_checks(output: Output, checks: Sequence[Check]) -> None:
    """A line a finding, with the servos it is true of; troubles come last, each with its remedy."""
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
