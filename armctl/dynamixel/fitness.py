"""What makes servos unfit for an arm, in words that say what to do about it."""

from typing import NamedTuple, Protocol

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit, Register
from armctl.dynamixel.servos import MODELS, by_number
from armctl.messages import Problem

# How far outside a joint's limits those of its servo may lie and still be a wall: not quite 5 deg.
WALL_TICKS = 16
NEEDED_SHUTDOWN = ErrorBit.OVERHEAT | ErrorBit.OVERLOAD
# The factory's highest: 70 degC for an AX-12A, 85 for an AX-12+, which has the same model number.
HOTTEST_DEGC = 85


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
    what = (
        f"only garbled bytes came; check that every servo runs at {baud} baud, that the adapter does not echo, the "
        "data wire and the common ground"
        if garbled
        else f"not a byte came; check that the servos' 12 V supply is on, that they run at {baud} baud, and the cable "
        "between adapter and first servo"
    )
    return Problem("BUS_DEAD", f"{port_name}: {servos} servos asked, {what}")


def slow_adapter(port_name: str, latency_ms: float, bound_ms: float) -> Problem:
    """An adapter that keeps every reply back for so long."""
    return Problem(
        "SLOW_ADAPTER",
        f"{port_name}: the adapter adds {latency_ms:.1f} ms to every reply, at most {bound_ms:.0f} ms are fit for "
        "motion; install the udev rule, or set its latency timer: "
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB*/latency_timer",
    )


# Why a servo does not answer, or more than one does.
SILENT = "no reply; check its cable, its supply, its id, and that its status return level is 2"
DOUBLED = (
    "garbled replies while others answer well; two servos with this id, or a bad cable: connect them one at a time and "
    "give each its own id"
)


def problem(code: str, joint: ServoJoint, text: str) -> Problem:
    """What is wrong with the servo of a joint."""
    return Problem(code, f"servo {joint.servo_id} ({joint.name}): {text}", joint.servo_id)


class Unfit(NamedTuple):
    """A register that forbids motion."""

    register: Register
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


def wrong_model(joint: ServoJoint, model_number: int) -> str:
    """Which model a joint wants instead, and what to do; empty: it is the one."""
    wanted, found = MODELS[joint.model], by_number(model_number)
    if found is wanted:
        return ""
    told = f"{wanted.model_number} ({wanted.title}); use an {wanted.title}, or the right id"
    return told if found is None else f"{told}, or write `model: {found.name}` for it into the arm's file"
