"""What stands between this computer and a moving arm, one fact and one remedy a line.

Rules:

1. Nothing is changed: only PING and READ go to the servos, and a port in use is left to its user.
2. A check that cannot be made, because one before it failed, is left out.
3. Every check that is not ok carries one remedy: a command to type where there is one.
"""

import os
import platform
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from armctl import __version__
from armctl.commissioning.scan import ALL_IDS, USUAL_BAUDS, FoundServo, Progress, scan
from armctl.config import ArmConfig, Servo
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import STATUS_BLOCK, ServoBus
from armctl.dynamixel.fitness import unfit_registers, wrong_model
from armctl.dynamixel.identify import EEPROM, IDENTIFY_LATENCY_MS, SLOW_ADAPTER_MS, added_ms
from armctl.dynamixel.port import ADAPTER_LATENCY_MS
from armctl.dynamixel.serial_port import usb_identity
from armctl.errors import BusError, PortBusy, PortGone
from armctl.recording.quota import remedy

MIN_PYTHON = (3, 11)
MAX_LATENCY_TIMER_MS = 1
# Recommended is 0; some adapters need a few microseconds to turn the line around.
MAX_RETURN_DELAY_US = 20
# ROBOTIS names 9 to 12 V; a full battery of three cells has 12.6 V.
VOLTAGE_V = (9.0, 12.6)
HOT_DEGC = 65
CYCLES = 10
# Of the period; the rest is for what the bus does not do, and for repetitions.
CYCLE_SHARE = 0.5

# What helps where a check is not ok, by its name; for `error_bits` by the bit's.
REMEDIES = tomllib.loads(Path(__file__).with_name("doctor.toml").read_text("utf-8"))


class Check(NamedTuple):
    """One line of the doctor's report."""

    name: str
    ok: bool
    value: str
    # What to do; empty when ok.
    fix: str = ""
    servo_id: int | None = None


class Surroundings(NamedTuple):
    """What the doctor is told instead of asking for it."""

    # Where a daemon answers; empty: none.
    daemon: str
    log_dir: Path
    # Needed in the folder of the logs.
    free_bytes: int
    # What to add to each command of armctl, such as " --port /dev/ttyUSB1".
    options: str = ""
    sysfs: Path = Path("/sys")


def check_host(surroundings: Surroundings) -> list[Check]:
    """Versions, disk and daemon: what needs no port."""
    version = platform.python_version()
    folder = surroundings.log_dir
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    writable = os.access(folder, os.W_OK)
    disk = f"{free / 2**20:.0f} MiB free in {folder}" + ("" if writable else ", not writable")
    disk_fix = remedy(folder) if writable else f"sudo chown $USER {folder}"
    return [
        _check("armctl", True, f"{__version__} on Python {version}"),
        _check("python", sys.version_info >= MIN_PYTHON, version),
        _check("disk", writable and free >= surroundings.free_bytes, disk, disk_fix),
        _check("daemon", True, f"runs: {surroundings.daemon}" if surroundings.daemon else "does not run"),
    ]


def check_port(bus: ServoBus, surroundings: Surroundings) -> list[Check]:
    """The port: there, ours to open, free; the bus is open afterwards if all of that is so."""
    path = Path(bus.port.port_name)
    try:
        bus.open()
    except BusError as error:
        value, _, fix = str(error).rpartition("; ")
        busy = isinstance(error, PortBusy)
        if busy and surroundings.daemon:
            fix = "if it is the daemon: `armctl status` shows its servos; stop it (Ctrl-C), then run doctor again"
        if busy or (path.exists() and not os.access(path, os.R_OK | os.W_OK)):
            return [Check("port", True, str(path)), Check("owner" if busy else "permission", False, value, fix)]
        return [Check("port", False, value, fix)]
    # The path, and the name that stays the same when the adapter is plugged in again.
    name = f"{path} = {link}" if (link := usb_identity(str(path))) else str(path)
    facts = (("port", name), ("permission", "readable and writable"), ("owner", "nobody else"))
    checks = [Check(name, True, value) for name, value in facts]
    timer = surroundings.sysfs / "class" / "tty" / path.resolve().name / "device" / "latency_timer"
    set_timer = f"echo {MAX_LATENCY_TIMER_MS} | sudo tee {timer}"
    if bus.port.low_latency is not None:
        checks.append(_check("low_latency", bus.port.low_latency, "on" if bus.port.low_latency else "off", set_timer))
    if timer.is_file():
        timer_ms = int(timer.read_text())
        checks.append(_check("latency_timer", timer_ms <= MAX_LATENCY_TIMER_MS, f"{timer_ms} ms", set_timer))
    return checks


def check_servos(
    bus: ServoBus, arm: ArmConfig, period_s: float, surroundings: Surroundings, progress: Progress | None = None
) -> list[Check]:
    """Every servo of the calibration, and every other one on the bus; leaves the bus open.

    Raises:
        PortGone: the port vanished.
    """
    baud = bus.port.baudrate
    found = {servo.servo_id: servo for servo in scan(bus, (baud,), ALL_IDS, progress)}
    missing = [servo_id for servo_id in arm.servo_ids if servo_id not in found]
    elsewhere: dict[int, FoundServo] = {}
    if missing:
        others = [other for other in USUAL_BAUDS if other != baud]
        elsewhere = {servo.servo_id: servo for servo in scan(bus, others, missing)}
        bus.port.setBaudRate(baud)
    checks = [_baud_check(baud, len(found), len(arm.servos), elsewhere, surroundings.options)]
    checks += _presence(arm, baud, list(found), elsewhere, surroundings.options)
    if not found:
        return checks
    bus.port.allow_latency(IDENTIFY_LATENCY_MS)
    latencies_ms: list[float] = []
    for joint in arm.servos:
        if joint.servo_id in found:
            slow = f"armctl servo set-return-delay {joint.servo_id if missing else 'all'} 0{surroundings.options}"
            checks += _servo_checks(bus, joint, found[joint.servo_id], surroundings.options, slow, latencies_ms)
    if latencies_ms:
        latency_ms = median(latencies_ms)
        bus.port.allow_latency(max(ADAPTER_LATENCY_MS, latency_ms))
        value = f"adds {latency_ms:.1f} ms to every reply, at most {SLOW_ADAPTER_MS:.0f} ms are fit for motion"
        checks.append(_check("adapter_latency", latency_ms <= SLOW_ADAPTER_MS, value))
        if not missing:
            checks.append(_cycle_check(bus, period_s))
    if not bus.is_open:
        raise PortGone(f"{bus.port.port_name}: the port vanished meanwhile; plug the adapter in again")
    return checks


def _check(name: str, ok: bool, value: str, fix: str = "", servo_id: int | None = None) -> Check:
    return Check(name, ok, value, "" if ok else fix or REMEDIES[name], servo_id)


def _baud_check(baud: int, found: int, wanted: int, elsewhere: dict[int, FoundServo], options: str) -> Check:
    if found:
        return Check("baud", True, f"{baud}, {found} servos answer")
    if not elsewhere:
        return _check("baud", False, f"none of {wanted} servos answers at {baud} or any other usual baud")
    first = next(iter(elsewhere.values()))
    servos = "servo" if len(elsewhere) == 1 else "servos"
    value = f"nobody answers at {baud}, but {servos} {', '.join(map(str, elsewhere))} at {first.baud}"
    return Check("baud", False, value, _set_baud(first, baud, options))


def _set_baud(servo: FoundServo, baud: int, options: str) -> str:
    return f"armctl servo set-baud {servo.servo_id} {baud}{options} --baud {servo.baud}"  # the last --baud counts


def _presence(
    arm: ArmConfig, baud: int, found: Sequence[int], elsewhere: dict[int, FoundServo], options: str
) -> list[Check]:
    """One line for each servo of the calibration and each stranger; strangers are taken for the missing, in order."""
    strays = [servo_id for servo_id in found if servo_id not in arm.servo_ids]
    mute = [servo_id for servo_id in arm.servo_ids if servo_id not in found and servo_id not in elsewhere]
    stand_ins = dict(zip(mute, strays, strict=False))
    renamings = {stray: f"armctl servo set-id {stray} {new}{options}" for new, stray in stand_ins.items()}
    checks = []
    for joint in arm.servos:
        servo_id, value, fix = joint.servo_id, "answers", ""
        if servo_id in elsewhere:
            value = f"{joint.name} answers at {elsewhere[servo_id].baud} baud"
            fix = _set_baud(elsewhere[servo_id], baud, options)
        elif servo_id in stand_ins:
            value = f"{joint.name} does not answer; servo {stand_ins[servo_id]}, which nobody expects, does"
            fix = renamings[stand_ins[servo_id]]
        elif servo_id in mute:
            value = f"{joint.name} does not answer"
            fix = f"check the cable and the supply of {joint.name}, then `armctl scan --baud all{options}`"
        checks.append(Check("present", not fix, value, fix, servo_id))
    for stray in strays:
        fix = renamings.get(stray, "take it off the bus, or give the calibration a joint for it")
        checks.append(Check("wrong_id", False, f"servo {stray} is not in the calibration {arm.arm_id}", fix, stray))
    return checks


def _servo_checks(
    bus: ServoBus, joint: Servo, servo: FoundServo, options: str, delay_fix: str, latencies_ms: list[float]
) -> list[Check]:
    """Registers of one servo that answers; adds what the adapter costs its replies to `latencies_ms`."""
    servo_id = joint.servo_id

    def set_to(register: ax12a.Register, value: int) -> str:
        return f"armctl servo set {servo_id} {register.name} {value}{options}"

    if servo.clash:
        fix = f"take all but one off the bus, then `armctl servo set-id {servo_id} NEW{options}`"
        return [Check("id_clash", False, f"two servos answer to id {servo_id}", fix, servo_id)]
    table = bus.read_block(servo_id, *EEPROM)
    status = bus.read_block(servo_id, *STATUS_BLOCK)
    if table.problem or status.problem:
        value = f"answers a PING but no READ ({table.problem or status.problem})"
        fix = set_to(ax12a.RETURN_LEVEL, ax12a.RETURN_LEVEL.default)
        return [Check("return_level", False, value, fix, servo_id)]

    def stored(register: ax12a.Register) -> int:
        return ax12a.register_value(register, table.data, 0)

    def now(register: ax12a.Register) -> int:
        return ax12a.register_value(register, status.data)

    delay_us = 2 * stored(ax12a.RETURN_DELAY)
    latencies_ms.append(added_ms(bus, table))
    model, level, mask = (stored(register) for register in (ax12a.MODEL, ax12a.RETURN_LEVEL, ax12a.SHUTDOWN))
    wrong = wrong_model(joint, model)
    unfit = {it.register: it for it in unfit_registers(joint, table.data)}
    asked = "..".join(map(str, joint.limits_tick))
    limits = f"{stored(ax12a.CW_LIMIT)}..{stored(ax12a.CCW_LIMIT)}, the calibration asks for {asked}"
    hottest, mend = stored(ax12a.TEMPERATURE_LIMIT), f"armctl servo mend {servo_id}{options}"
    volts, heat = now(ax12a.PRESENT_VOLTAGE) / 10.0, now(ax12a.PRESENT_TEMPERATURE)
    error, tripped = status.error | table.error, now(ax12a.TORQUE_LIMIT) == 0
    error_fix = next((REMEDIES["error_bits"][bit] for bit in ax12a.ErrorBit.names(error)), "")
    torque = "torque limit 0: it has shut itself down" if tripped else "on" if now(ax12a.TORQUE_ENABLE) else "off"
    rows = [
        ("model", not wrong, str(model), f"wanted {wrong}"),
        ("firmware", True, str(stored(ax12a.FIRMWARE)), ""),
        ("round_trip", True, f"{table.elapsed_ns // 1000} us for {ax12a.EEPROM_END} bytes", ""),
        ("return_delay", delay_us <= MAX_RETURN_DELAY_US, f"{delay_us} us (register {delay_us // 2})", delay_fix),
        ("return_level", level == ax12a.RETURN_LEVEL.default, str(level), set_to(ax12a.RETURN_LEVEL, 2)),
        ("angle_limits", not {ax12a.CW_LIMIT, ax12a.CCW_LIMIT} & unfit.keys(), limits, mend),
        ("shutdown", ax12a.SHUTDOWN not in unfit, _bits(mask), mend),
        ("temperature_limit", ax12a.TEMPERATURE_LIMIT not in unfit, f"{hottest} degC", mend),
        ("voltage", VOLTAGE_V[0] <= volts <= VOLTAGE_V[1], f"{volts:.1f} V", ""),
        ("temperature", heat < HOT_DEGC, f"{heat} degC", ""),
        ("error_bits", not error, _bits(error), error_fix),
        ("torque", not tripped, torque, ""),
    ]
    return [_check(*row, servo_id) for row in rows]


def _cycle_check(bus: ServoBus, period_s: float) -> Check:
    """The slowest of some cycles against the period."""
    cycle_s = max(bus.read_sample().bus_us for _ in range(CYCLES)) / 1e6
    best_Hz = 1.0 / max(cycle_s, 1e-6)
    value = f"{cycle_s * 1000.0:.1f} ms a cycle of {period_s * 1000.0:.0f} ms, {best_Hz:.0f} Hz at best"
    return _check("cycle_rate", cycle_s <= CYCLE_SHARE * period_s, value)


def _bits(value: int) -> str:
    return ", ".join(name.lower() for name in ax12a.ErrorBit.names(value)) or "none"
