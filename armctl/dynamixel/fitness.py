"""What makes servos unfit for an arm, in words that say what to do about it: `unfit.toml` has them."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from typing import NamedTuple, Protocol

from armctl.dynamixel import ax12a
from armctl.dynamixel.servos import MODELS, by_number
from armctl.messages import Problem

# How far outside a joint's limits those of its servo may lie and still be a wall: not quite 5 deg.
WALL_TICKS = 16
NEEDED_SHUTDOWN = ax12a.ErrorBit.OVERHEAT | ax12a.ErrorBit.OVERLOAD
# The factory's highest: 70 degC for an AX-12A, 85 for an AX-12+, which has the same model number.
HOTTEST_DEGC = 85
_SAID: dict[str, str] = tomllib.loads(resources.files(__package__).joinpath("unfit.toml").read_text("utf-8"))
# Why a servo does not answer, or more than one does; what several ask that are not as they should be.
SILENT, DOUBLED, WHOSE = _SAID["silent"], _SAID["doubled"], _SAID["whose"]


class ServoJoint(Protocol):
    """What must be known of a joint to judge its servo."""

    @property
    def servo_id(self) -> int: ...

    @property
    def name(self) -> str: ...

    @property
    def model(self) -> str:
        """Name of its servo's model."""

    @property
    def limits_tick(self) -> tuple[int, int]:
        """Lowest and highest goal that the joint needs."""


def bus_dead(servos: int, garbled: bool, port_name: str, baud: int) -> Problem:
    """Why none of so many servos can be understood."""
    heard = _SAID["garbled" if garbled else "mute"].format(baud=baud)
    return Problem("BUS_DEAD", _SAID["dead"].format(port=port_name, servos=servos, heard=heard))


def slow_adapter(port_name: str, latency_ms: float, bound_ms: float) -> Problem:
    """An adapter that keeps every reply back for so long."""
    said = _SAID["slow"].format(port=port_name, latency_ms=latency_ms, bound_ms=bound_ms)
    return Problem("SLOW_ADAPTER", said)


def problem(code: str, joint: ServoJoint, text: str) -> Problem:
    """What is wrong with the servo of a joint."""
    return Problem(code, f"servo {joint.servo_id} ({joint.name}): {text}", joint.servo_id)


class Unfit(NamedTuple):
    """A register that forbids motion."""

    register: ax12a.Register
    found: int
    # What it is to hold, in words.
    wanted: str
    # What mends it.
    value: int


def unfit_registers(joint: ServoJoint, table: bytes) -> list[Unfit]:
    """What in the EEPROM (bytes 0..23) of a joint's servo is to be written before the joint may move.

    The servo is the second wall behind the daemon: its own angle limits, and its own shutdown at heat and overload.
    """
    low, high = joint.limits_tick
    lowest, highest = max(0, low - WALL_TICKS), min(ax12a.TICK_MAX, high + WALL_TICKS)
    protects = ax12a.register_value(ax12a.SHUTDOWN, table, 0) | NEEDED_SHUTDOWN
    level, hottest = ax12a.RETURN_LEVEL.default, ax12a.TEMPERATURE_LIMIT.default
    bounds = (
        (ax12a.CW_LIMIT, lowest, low, f"{lowest} to {low}", low),
        (ax12a.CCW_LIMIT, high, highest, f"{high} to {highest}", high),
        (ax12a.RETURN_LEVEL, level, level, f"{level}", level),
        (ax12a.SHUTDOWN, protects, protects, f"{NEEDED_SHUTDOWN:d} in it (overheat, overload)", protects),
        (ax12a.TEMPERATURE_LIMIT, 0, HOTTEST_DEGC, f"at most {HOTTEST_DEGC}", hottest),
    )
    return [
        Unfit(register, held, wanted, value)
        for register, least, most, wanted, value in bounds
        if not least <= (held := ax12a.register_value(register, table, 0)) <= most
    ]


def table_problems(joint: ServoJoint, table: bytes, port_name: str) -> list[Problem]:
    """Why the EEPROM (bytes 0..23) of a joint's servo forbids its motion, and the command that mends it."""
    model = ax12a.register_value(ax12a.MODEL, table, 0)
    if wrong := wrong_model(joint, model):
        return [problem("WRONG_MODEL", joint, f"model number {model}, wanted {wrong}")]
    unfit = unfit_registers(joint, table)
    if not unfit:
        return []
    faults = "; ".join(f"{it.register.name} is {it.found}, wanted {it.wanted}" for it in unfit)
    if not any(ax12a.register_value(limit, table, 0) for limit in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT)):
        faults += " (wheel mode)"
    remedy = f"`armctl servo mend {joint.servo_id} --port {port_name}` (with its --arm if it has one)"
    return [problem("EEPROM_MISMATCH", joint, f"{faults}; end the daemon, type {remedy}")]


def whose(found: Sequence[Problem], arm: str) -> list[Problem]:
    """The same; where several servos are not those of the file, each asks first whether this is that arm.

    Servos that are silent alone say nothing of it: a cable is enough for that.
    """
    unlike = [it for it in found if it.code in ("EEPROM_MISMATCH", "WRONG_MODEL", "SERVO_SILENT")]
    if len(unlike) < 2 or all(it.code == "SERVO_SILENT" for it in unlike):
        return list(found)
    return [replace(it, text=WHOSE.format(*it.text.rpartition("; "), arm=arm)) if it in unlike else it for it in found]


def wrong_model(joint: ServoJoint, model_number: int) -> str:
    """Which model a joint wants instead, and what to do; empty: it is the one."""
    wanted, found = MODELS[joint.model], by_number(model_number)
    if found is wanted:
        return ""
    title = wanted.name.upper()
    told = f"{wanted.model_number} ({title}); use an {title}, or the right id"
    return told if found is None else f"{told}, or write `model: {found.name}` for it into the arm's file"
