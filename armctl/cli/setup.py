"""Commands that set an arm up: find its servos, judge them, write their EEPROM, calibrate the arm.

They open the serial port themselves, so the daemon must not run, and none of them moves a servo; but `calibrate --sag`
asks a running daemon to.
"""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.output import F, Output, config_option, exit_failed, output_option, socket_option

if TYPE_CHECKING:
    from armctl.commissioning.calibration import Fit, Readings
    from armctl.commissioning.doctor import Check
    from armctl.commissioning.eeprom import Difference
    from armctl.config import ArmConfig, Config
    from armctl.dynamixel.bus import ServoBus
    from armctl.dynamixel.port import ServoPort

FILE = click.Path(path_type=Path, dir_okay=False)
SERVO = click.IntRange(0, 253)


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
    from armctl.dynamixel.port import SerialPort

    return SerialPort(path, baud, MonotonicClock())


def make_bus(config: Config, port: str | None, baud: int | None, servo_ids: Sequence[int] = ()) -> ServoBus:
    """The bus named by options and configuration, not yet open."""
    from armctl.dynamixel.bus import ServoBus
    from armctl.errors import ConfigError

    path = port or config.port
    if not path:
        raise ConfigError("armctl", "--port", "no serial port named", "give --port PATH, or start `armctl sim`")
    if baud is not None and not 9_000 <= baud <= 1_000_000:
        raise ConfigError("armctl", "--baud", f"{baud} is outside 9000..1000000")
    transport = make_port(path, baud or config.baud)
    return ServoBus(transport, servo_ids, transport.clock)


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
    from armctl.config import load_config

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
        for servo in found:
            model = "answers no READ" if servo.model is None else f"model {servo.model} firmware {servo.firmware}"
            clash = "; two servos have this id" if servo.clash else ""
            output.say(f"{servo.servo_id:>4} at {servo.baud}: {model}, {servo.round_trip_us} us{clash}")
        if not found:
            remedy = "check supply and cable" if every else "try --baud all, and check supply and cable"
            output.say(f"no servo answers; {remedy}")
    return 0 if found else exit_failed()


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
    from armctl.config import data_dir, load_arm, load_config
    from armctl.errors import NoDaemon

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
        for line in _report(checks):
            output.say(line)
    return 0 if all(check.ok for check in checks) else exit_failed()


def _report(checks: Sequence[Check]) -> list[str]:
    """A line a finding, with the servos it is true of; troubles come last, each with its remedy."""
    order = list(dict.fromkeys(check.name for check in checks))
    servo_ids: dict[tuple[bool, int, str, str], list[str]] = {}
    for check in checks:
        ids = servo_ids.setdefault((not check.ok, order.index(check.name), check.value, check.fix), [])
        ids += [] if check.servo_id is None else [str(check.servo_id)]
    lines = []
    for (bad, name, value, fix), ids in sorted(servo_ids.items(), key=lambda item: item[0][:2]):
        where = f"  (servo {', '.join(ids)})" if ids else ""
        lines.append(f"{'FAIL' if bad else 'ok':<5} {order[name]:<16} {value}{where}")
        if bad:
            lines.append(f"{'':<5} {'':<16} -> {fix}")
    return lines


# ---------------------------------------------------------------------------------------------------------- servo


@click.group("servo")
def servo_command() -> None:
    """Write the EEPROM of servos: torque off, one answer an id, every write read back.

    Example: armctl servo set-id 1 4
    """


@servo_command.command("set-id")
@click.argument("old", type=SERVO)
@click.argument("new", type=SERVO)
@port_options
@output_option
def set_id_command(
    output: Output, old: int, new: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Give the servo OLD the id NEW; refused when NEW is taken or two servos answer to OLD.

    Example: armctl servo set-id 1 4
    """
    from armctl.commissioning.eeprom import set_id
    from armctl.config import load_config

    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        set_id(bus, old, new)
    if not output.result({"id": new, "before": old}):
        output.say(f"servo {old} is now servo {new}")


@servo_command.command("set-baud")
@click.argument("servo", type=SERVO)
@click.argument("rate", type=int)
@port_options
@output_option
def set_baud_command(
    output: Output, servo: int, rate: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Set the servo to RATE bit/s and find it again there; --baud is what it has now.

    Example: armctl servo set-baud 1 1000000 --baud 57600
    """
    from armctl.commissioning.eeprom import set_baud
    from armctl.config import load_config

    config = load_config(config_file)
    with opened(make_bus(config, port, baud)) as bus:
        before = bus.port.baudrate
        real = set_baud(bus, servo, rate)
    if not output.result({"id": servo, "baud": rate, "real_baud": real, "before": before}):
        output.say(f"servo {servo} answers at {rate} baud")
        if rate != config.baud:
            output.say(
                f"The daemon talks at {config.baud}; set `baud` in its configuration once all servos have {rate}."
            )


@servo_command.command("set-return-delay")
@click.argument("servo", metavar="ID|all")
@click.argument("delay_us", metavar="US", type=click.IntRange(0, 508))
@arm_option
@port_options
@output_option
def set_return_delay_command(
    output: Output,
    servo: str,
    delay_us: int,
    arm: str | None,
    port: str | None,
    baud: int | None,
    config_file: str | None,
) -> None:
    """How long the servo waits before it replies, in steps of 2 us; `all`: every servo of the arm.

    Example: armctl servo set-return-delay all 0
    """
    from armctl.commissioning.eeprom import require_writable, write_register
    from armctl.config import load_arm, load_config
    from armctl.dynamixel import ax12a

    config = load_config(config_file)
    if servo != "all" and not servo.isdecimal():
        raise click.BadParameter(f"{servo!r} is neither an id nor `all`", param_hint="ID")
    servo_ids = load_arm(arm or config.arm).servo_ids if servo == "all" else (int(servo),)
    with opened(make_bus(config, port, baud)) as bus:
        for servo_id in servo_ids:
            require_writable(bus, servo_id)
        for servo_id in servo_ids:
            write_register(bus, servo_id, ax12a.RETURN_DELAY, delay_us // 2)
    if not output.result({"ids": list(servo_ids), "return_delay_us": delay_us // 2 * 2}):
        output.say(f"servo {', '.join(map(str, servo_ids))}: return delay {delay_us // 2 * 2} us")


@servo_command.command("set")
@click.argument("servo", type=SERVO)
@click.argument("register")
@click.argument("value", type=int)
@port_options
@output_option
def set_command(
    output: Output, servo: int, register: str, value: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write one EEPROM register, by its name in the control table, in its own unit.

    Example: armctl servo set 3 ccw_angle_limit 1006
    """
    from armctl.commissioning.eeprom import SETTABLE, write_register
    from armctl.config import load_config

    known = {known.name: known for known in SETTABLE}
    if register not in known:
        raise click.BadParameter(f"{register!r}; one of: {', '.join(known)}", param_hint="REGISTER")
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        write_register(bus, servo, known[register], value)
    if not output.result({"id": servo, "register": register, "value": value}):
        output.say(f"servo {servo}: {register} is {value}")


@servo_command.group("eeprom")
def eeprom_command() -> None:
    """Save, compare and restore the EEPROM of all servos.

    Example: armctl servo eeprom save before.yaml
    """


@eeprom_command.command("save")
@click.argument("file", type=FILE)
@arm_option
@port_options
@output_option
def eeprom_save(
    output: Output, file: Path, arm: str | None, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write the EEPROM of every servo of the arm into FILE (YAML, or JSON by its name); never overwrites.

    Example: armctl servo eeprom save before.yaml
    """
    from armctl.commissioning.eeprom import save
    from armctl.config import load_arm, load_config

    config = load_config(config_file)
    with opened(make_bus(config, port, baud)) as bus:
        snapshot = save(bus, load_arm(arm or config.arm).servo_ids, file)
    if not output.result({"path": str(file), "servos": [servo.model_dump() for servo in snapshot.servos]}):
        output.say(f"EEPROM of {len(snapshot.servos)} servos in {file}")


@eeprom_command.command("diff")
@click.argument("file", type=FILE)
@port_options
@output_option
def eeprom_diff(output: Output, file: Path, port: str | None, baud: int | None, config_file: str | None) -> int:
    """What the servos hold otherwise than FILE; exit status 1 when something differs.

    Example: armctl servo eeprom diff before.yaml
    """
    from armctl.commissioning.eeprom import differences, load
    from armctl.config import load_config

    snapshot = load(file)
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        found = differences(bus, snapshot)
    if not output.result({"differences": [asdict(difference) for difference in found]}):
        _say_differences(output, found, "file", "servo")
        if not found:
            output.say("no difference")
    return exit_failed() if found else 0


@eeprom_command.command("restore")
@click.argument("file", type=FILE)
@click.option("--servo", "servos", type=SERVO, multiple=True, help="Only this servo; may be given again.")
@port_options
@output_option
def eeprom_restore(
    output: Output, file: Path, servos: tuple[int, ...], port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write back what differs from FILE, but id and baud; nothing is written unless every servo may be.

    Example: armctl servo eeprom restore before.yaml --servo 3
    """
    from armctl.commissioning.eeprom import load, restore
    from armctl.config import load_config

    snapshot = load(file)
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        changed = restore(bus, snapshot, servos)
    if not output.result({"restored": [asdict(difference) for difference in changed]}):
        _say_differences(output, changed, "now", "was")
        output.say(f"{len(changed)} registers restored")


def _say_differences(output: Output, found: Sequence[Difference], wanted: str, other: str) -> None:
    for difference in found:
        value = "not readable" if difference.found is None else difference.found
        output.say(
            f"servo {difference.servo_id}: {difference.register:<20} {wanted} {difference.wanted}, {other} {value}"
        )


# ------------------------------------------------------------------------------------------------------ calibrate


@click.command("calibrate")
@click.option("--points", type=FILE, help="Points to touch: lines x,y,z in metres, in the base frame.")
@click.option("--touches", default=2, show_default=True, type=click.IntRange(1, 20), help="Postures for each point.")
@click.option("--readings", type=FILE, help="Use these recorded readings; no arm is needed.")
@click.option("--save-readings", type=FILE, help="Keep the readings in a new file.")
@click.option("--sag", is_flag=True, help="Lines that show how the arm sags; the daemon moves it, torque is on.")
@click.option("--zero-at", type=click.Choice(["rest", "zero"]), help="Only zeros: the arm is held in this pose.")
@click.option("--out", type=FILE, help="The new calibration file.  [default: beside the old one, with the date]")
@arm_option
@port_options
@socket_option
@output_option
def calibrate_command(
    output: Output,
    points: Path | None,
    touches: int,
    readings: Path | None,
    save_readings: Path | None,
    sag: bool,
    zero_at: str | None,
    out: Path | None,
    arm: str | None,
    port: str | None,
    baud: int | None,
    socket: str | None,
    config_file: str | None,
) -> None:
    """Zero ticks and link lengths from points touched with the limp arm's tool tip.

    Fix a sheet with known points to the table, its x axis ahead of the base, and touch every point in different
    postures: elbow high and low, tool steep and flat. What the points do not show is named and left alone. Torque
    stays off and nothing is written to the servos; the result is a new file beside the old one.

    --sag is another matter: a running daemon moves the arm along eight lines, and what gravity and friction do to each
    joint is kept beside the calibration, as NAME.sag.json, for `armctl experiment`.

    Example: armctl calibrate --points sheet.csv
    """
    from armctl.commissioning import calibration
    from armctl.commissioning.eeprom import write_new
    from armctl.config import find_arm_file, load_arm, load_config
    from armctl.errors import RequestRefused

    if sum(choice is not None for choice in (points, readings, zero_at, sag or None)) != 1:
        raise click.UsageError("give one of --points FILE, --readings FILE, --zero-at rest|zero and --sag")
    config = load_config(config_file)
    if sag:
        _calibrate_sag(output, config, socket)
        return
    name = arm or config.arm
    before = load_arm(name)
    path = out or _dated(find_arm_file(name), date.today())
    if path.exists():
        raise RequestRefused("FILE_EXISTS", f"{path}: exists and is not overwritten; choose another --out")
    fit: Fit | None = None
    if zero_at is not None:
        with opened(make_bus(config, port, baud, before.servo_ids)) as bus:
            _wait_for_enter(output, f"hold the limp arm still in its {zero_at} pose, then press Enter")
            ticks = calibration.read_ticks(bus, before, bus.port.clock)
        pose = [joint.rest_rad if zero_at == "rest" else 0.0 for joint in before.joints]
        after = calibration.zeroed(before, ticks, pose)
        remark = f"zero ticks read in the {zero_at} pose"
    else:
        if readings is not None:
            session = calibration.load_readings(readings, before)
        else:
            assert points is not None
            with opened(make_bus(config, port, baud, before.servo_ids)) as bus:
                session = _touch_all(output, bus, before, calibration.read_points(points), touches)
        if save_readings is not None:
            write_new(save_readings, calibration.readings_text(session))
        fit = calibration.fit(before, session.touches)
        after = fit.arm
        remark = f"{len(session.touches)} touches, {fit.rms_before_mm:.2f} mm off before, {fit.rms_mm:.2f} mm after"
    remarks = [f"Calibrated {date.today().isoformat()} from {find_arm_file(name).name}: {remark}."]
    write_new(path, calibration.calibration_text(after, remarks))
    result: dict[str, Any] = {"path": str(path), "changes": _changes(before, after)}
    if fit is not None:
        result |= {
            "parameters": [asdict(parameter) for parameter in fit.parameters],
            "residuals_mm": fit.residuals_mm.tolist(),
            "rms_before_mm": fit.rms_before_mm,
            "rms_mm": fit.rms_mm,
            "complete": fit.complete,
        }
    if output.result(result):
        return
    if fit is not None:
        _say_fit(output, fit)
    for change in result["changes"]:
        output.say(f"  {change['key']}: {change['before']} -> {change['after']}")
    output.say(f"written: {path}\nuse it: armctl daemon --arm {path}")


def _dated(path: Path, today: date) -> Path:
    """A free name beside a calibration file that tells the day."""
    stem = path.stem
    if len(stem) > 11 and stem[-11] == "-" and stem[-10:].replace("-", "").isdecimal():
        stem = stem[:-11]
    names = (f"{stem}-{today.isoformat()}{suffix}.yaml" for suffix in ("", *(f"-{n}" for n in range(2, 100))))
    return next((path.with_name(name) for name in names if not path.with_name(name).exists()), path)


def _touch_all(
    output: Output, bus: ServoBus, arm: ArmConfig, points: Sequence[tuple[float, float, float]], touches: int
) -> Readings:
    """Lead the person through every point; a reading that fails is taken again."""
    from armctl.commissioning.calibration import Readings, Touch, read_ticks
    from armctl.errors import RequestRefused

    taken: list[Touch] = []
    for number, point in enumerate(points, start=1):
        for posture in range(1, touches + 1):
            where = ", ".join(f"{value * 1000.0:.1f}" for value in point)
            while True:
                _wait_for_enter(
                    output,
                    f"point {number} of {len(points)} ({where} mm), posture {posture} of {touches}: "
                    "hold the tip on it, then press Enter",
                )
                try:
                    taken.append(Touch(point_m=point, ticks=read_ticks(bus, arm, bus.port.clock)))
                    break
                except RequestRefused as refusal:
                    output.say(f"not taken: {refusal}")
    return Readings(arm_id=arm.arm_id, touches=tuple(taken))


def _wait_for_enter(output: Output, text: str) -> None:
    from armctl.errors import ConfigError

    if output.json or not sys.stdin.isatty():
        raise ConfigError("armctl calibrate", "", "needs a terminal and no --json", "or give --readings FILE")
    output.say(text)
    if not sys.stdin.readline():
        raise click.Abort


def _calibrate_sag(output: Output, config: Config, socket: str | None) -> None:
    """Run the calibration lines on the daemon's arm and keep the sag model."""
    import numpy as np

    from armctl.client import Client
    from armctl.config import load_arm
    from armctl.experiment import calibrate_sag, stored
    from armctl.experiment.run import DaemonRig

    with Client(socket) as client, output.progress("calibration lines", calibrate_sag.LINES) as show:
        rig = DaemonRig(client, load_arm(config.arm))
        model = calibrate_sag.identify(rig, np.random.default_rng(0), show=lambda done: show(done, ""))
    path = stored.save(config, model)
    residual = dict(zip(rig.arm.joint_names, model.residual_tick, strict=False))
    if not output.result({"path": str(path), "lines": model.lines, "residual_tick": residual}):
        output.say(f"{path}: sag and friction of {len(residual)} joints from {model.lines} lines")
        for name, ticks in residual.items():
            output.say(f"  {name:<20} leaves {ticks:.2f} tick unexplained (an encoder's own noise is about 0.6)")


def _changes(before: ArmConfig, after: ArmConfig) -> list[dict[str, Any]]:
    """Every value that differs between two calibrations of one arm."""
    from armctl.kinematics import robots

    old, new = (robots.get(arm.robot, arm.lengths_m).lengths_m for arm in (before, after))
    rows = [(f"lengths_m.{key}", old[key], new[key]) for key in old]
    for was, now in zip(before.joints, after.joints, strict=True):
        rows += [
            (f"{was.name}.{key}", getattr(was, key), getattr(now, key))
            for key in ("zero_tick", "limits_deg", "rest_deg")
        ]
    return [{"key": key, "before": was, "after": now} for key, was, now in rows if was != now]


def _say_fit(output: Output, fit: Fit) -> None:
    output.say(f"distance of tool and point: {fit.rms_before_mm:.2f} mm before, {fit.rms_mm:.2f} mm after (rms)")
    worst = int(fit.residuals_mm.argmax())
    output.say(f"worst point: touch {worst + 1}, {fit.residuals_mm[worst]:.2f} mm")
    for parameter in fit.parameters:
        factor, unit = (1000.0, "mm") if parameter.unit == "m" else (1.0, "tick")
        value = f"{parameter.before * factor:8.2f} -> {parameter.after * factor:8.2f} {unit}"
        note = f"left alone: {parameter.held}"
        if parameter.standard_error is not None:
            note = f"+- {parameter.standard_error * factor:.2f}"
        output.say(f"  {parameter.name:<20} {value:<28} {note}")
    if not fit.complete:
        output.say("What these points do not show was left alone, and the rest is only good near these postures:")
        output.say(
            "touch every point in more postures (elbow high and low, tool steep and flat) before you rely on it."
        )
