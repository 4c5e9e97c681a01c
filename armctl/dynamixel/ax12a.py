"""AX-12A: control table and units.

Source: ROBOTIS e-manual, AX-12A control table. Everything outside this module and the YAML files is SI;
ticks, percent and degrees stop here.
"""

import math
import struct
from enum import IntFlag
from typing import NamedTuple

MODEL_NUMBER = 12
TABLE_SIZE = 50
# First RAM address; everything below is EEPROM and writable only with torque off.
EEPROM_END = 24

# Angle of one position tick; 0..1023 spans 300 deg.
TICK_RAD = math.radians(300.0) / 1023.0
TICK_MAX = 1023
# One unit of moving or present speed (0.111 rpm).
SPEED_UNIT_RAD_S = 0.111 * 2.0 * math.pi / 60.0
LOAD_MAX = 1023
STALL_TORQUE_NM = 1.5
NO_LOAD_SPEED_RAD_S = 59.0 * 2.0 * math.pi / 60.0
STATUS_BEGIN = 24
# Bytes 24..49: everything that tells position, load, heat and every kind of lost torque, in one read.
STATUS_SIZE = 26


class ErrorBit(IntFlag):
    """Bits of the error byte of a status packet."""

    VOLTAGE = 1
    ANGLE_LIMIT = 2
    OVERHEAT = 4
    RANGE = 8
    CHECKSUM = 16
    OVERLOAD = 32
    INSTRUCTION = 64

    @classmethod
    def names(cls, error: int) -> tuple[str, ...]:
        """Names of every bit that is set, lowest first."""
        return tuple(bit.name or "" for bit in cls if error & bit)


class Register(NamedTuple):
    """One entry of the control table."""

    name: str
    address: int
    size: int
    writable: bool
    default: int
    minimum: int = 0
    maximum: int = 1023

    @property
    def eeprom(self) -> bool:
        return self.address < EEPROM_END


MODEL = Register("model_number", 0, 2, False, MODEL_NUMBER, 0, 0xFFFF)
FIRMWARE = Register("firmware_version", 2, 1, False, 24, 0, 255)
ID = Register("id", 3, 1, True, 1, 0, 253)
BAUD = Register("baud_rate", 4, 1, True, 1, 0, 254)
RETURN_DELAY = Register("return_delay_time", 5, 1, True, 250, 0, 254)
CW_LIMIT = Register("cw_angle_limit", 6, 2, True, 0)
CCW_LIMIT = Register("ccw_angle_limit", 8, 2, True, 1023)
TEMPERATURE_LIMIT = Register("temperature_limit", 11, 1, True, 70, 0, 150)
MIN_VOLTAGE = Register("min_voltage_limit", 12, 1, True, 60, 50, 250)
MAX_VOLTAGE = Register("max_voltage_limit", 13, 1, True, 140, 50, 250)
MAX_TORQUE = Register("max_torque", 14, 2, True, 1023)
RETURN_LEVEL = Register("status_return_level", 16, 1, True, 2, 0, 2)
ALARM_LED = Register("alarm_led", 17, 1, True, 36, 0, 127)
SHUTDOWN = Register("shutdown", 18, 1, True, 36, 0, 127)
TORQUE_ENABLE = Register("torque_enable", 24, 1, True, 0, 0, 1)
LED = Register("led", 25, 1, True, 0, 0, 1)
CW_MARGIN = Register("cw_compliance_margin", 26, 1, True, 1, 0, 254)
CCW_MARGIN = Register("ccw_compliance_margin", 27, 1, True, 1, 0, 254)
CW_SLOPE = Register("cw_compliance_slope", 28, 1, True, 32, 1, 254)
CCW_SLOPE = Register("ccw_compliance_slope", 29, 1, True, 32, 1, 254)
GOAL = Register("goal_position", 30, 2, True, 0)
MOVING_SPEED = Register("moving_speed", 32, 2, True, 0, 0, 2047)
TORQUE_LIMIT = Register("torque_limit", 34, 2, True, 1023)
PRESENT_POSITION = Register("present_position", 36, 2, False, 0)
PRESENT_SPEED = Register("present_speed", 38, 2, False, 0, 0, 2047)
PRESENT_LOAD = Register("present_load", 40, 2, False, 0, 0, 2047)
PRESENT_VOLTAGE = Register("present_voltage", 42, 1, False, 120, 0, 255)
PRESENT_TEMPERATURE = Register("present_temperature", 43, 1, False, 30, 0, 255)
REGISTERED = Register("registered", 44, 1, False, 0, 0, 1)
MOVING = Register("moving", 46, 1, False, 0, 0, 1)
LOCK = Register("lock", 47, 1, True, 0, 0, 1)
PUNCH = Register("punch", 48, 2, True, 32)

# The control table in address order, which is the order above.
REGISTERS: tuple[Register, ...] = tuple(found for found in list(vars().values()) if isinstance(found, Register))


def register_value(register: Register, block: bytes, begin: int = STATUS_BEGIN) -> int:
    """Value of `register` in `block`, a copy of the table that starts at address `begin`.

    Raises:
        ValueError: the block does not hold the register.
    """
    offset = register.address - begin
    if offset < 0 or offset + register.size > len(block):
        where = f"is not in a block of {len(block)} bytes from {begin}"
        raise ValueError(f"{register.name} (address {register.address}) {where}")
    return int.from_bytes(block[offset : offset + register.size], "little")


def signed_magnitude(value: int) -> int:
    """Present speed or load as a signed number, CCW positive (bit 10 set means CW)."""
    magnitude = value & 0x3FF
    return -magnitude if value & 0x400 else magnitude


def compliance_slope(register: int) -> int:
    """Slope [tick] of a compliance-slope register: the steps are 2, 4, 8, ..., 128."""
    return max(2, 1 << (register.bit_length() - 1))


def speed_rad_s(raw: int) -> float:
    """Present speed [rad/s], CCW positive."""
    return signed_magnitude(raw) * SPEED_UNIT_RAD_S if raw else 0.0


def load_ratio(raw: int) -> float:
    """Present load as a fraction of full output, CCW positive."""
    return signed_magnitude(raw) / LOAD_MAX if raw else 0.0


def moving_speed_units(speed: float) -> int:
    """Moving-speed register for |speed| [rad/s], at least 1 (0 would mean no limit), at most 1023."""
    return max(1, min(1023, math.ceil(abs(speed) / SPEED_UNIT_RAD_S - 1e-9)))


class Status(NamedTuple):
    """What the block 24..49 of a servo says, as far as the control step reads it."""

    torque_enabled: int
    # Goal position [tick].
    goal: int
    torque_limit: int
    # Present position [tick].
    position: int
    # CCW positive, as is the load.
    speed_rad_s: float
    load_ratio: float
    voltage_V: float
    temperature_degC: float
    # What only torque-on writes, margins, slopes, punch and torque limit, as one number to compare.
    settings: int


# Bytes 24..49 in the order of the control table; 45 has no register.
_BLOCK = struct.Struct("<6B6H6BH")


def _settings(cw_margin: int, ccw_margin: int, cw_slope: int, ccw_slope: int, punch: int, torque_limit: int) -> int:
    return cw_margin << 50 | ccw_margin << 40 | cw_slope << 30 | ccw_slope << 20 | punch << 10 | torque_limit


def compliance(settings: int) -> tuple[int, int, int]:
    """Margin [tick], slope [tick] and punch in a status's settings, of the softer side."""
    cw_margin, ccw_margin, cw_slope, ccw_slope, punch = [settings >> shift & 0x3FF for shift in (50, 40, 30, 20, 10)]
    return max(cw_margin, ccw_margin), compliance_slope(max(cw_slope, ccw_slope)), punch


_SET_WITH_TORQUE = CW_MARGIN, CCW_MARGIN, CW_SLOPE, CCW_SLOPE, PUNCH, TORQUE_LIMIT
# Settings of a servo that has just restarted.
POWER_ON_SETTINGS = _settings(*(register.default for register in _SET_WITH_TORQUE))


def decode(block: bytes) -> Status | None:
    """What a servo's status bytes say; None of one that never answered.

    Raises:
        struct.error: the block is not `STATUS_SIZE` long.
    """
    if not block:
        return None
    (enabled, _led, cw_margin, ccw_margin, cw_slope, ccw_slope, goal, _moving_speed, limit, position, speed, load,
     voltage, temperature, _registered, _spare, _moving, _lock, punch) = _BLOCK.unpack(block)  # fmt: skip
    return Status(
        enabled, goal, limit, position,
        speed_rad_s(speed), load_ratio(load), voltage / 10.0, float(temperature),
        _settings(cw_margin, ccw_margin, cw_slope, ccw_slope, punch, limit),
    )  # fmt: skip


def distance_rad(servo: Status, ratio: float) -> float:
    """How far from its goal a servo stands that gives an output >= 0, by its compliance."""
    margin, slope, punch = compliance(servo.settings)
    rise = max(0.0, min(ratio, 1.0) - punch / LOAD_MAX) / (1.0 - punch / LOAD_MAX)
    return (margin + rise * slope) * TICK_RAD


# ---------------------------------------------------------------- what can be true of a servo, whichever it is

MOTION_MARGIN = 1.5
MOTION_MARGIN_TICKS = 3.0
SPEED_BOUND_TICK_S = MOTION_MARGIN * (NO_LOAD_SPEED_RAD_S / TICK_RAD)
POSITION_AT = PRESENT_POSITION.address - STATUS_BEGIN


# Bits of the block 24..49, as a little-endian number, that the control table never sets.
IMPOSSIBLE_BITS = sum(
    (1 << 8 * register.size) - 1 - register.maximum << 8 * (register.address - STATUS_BEGIN)
    for register in REGISTERS
    if not register.eeprom and register.maximum & (register.maximum + 1) == 0
)


# Where a servo was [tick], and when [ns].
Seen = tuple[int, int]


def position_tick(block: bytes) -> int:
    """Present position [tick] in a block of status bytes."""
    return block[POSITION_AT] | block[POSITION_AT + 1] << 8


def believable(seen: Seen, last: Seen | None, doubted: Seen | None) -> bool:
    """Whether a servo can have moved to where it is seen.

    Args:
        last: Where it was by the last reading that was believed.
        doubted: Where it was by one that was not, if there was one since; two that agree are believed.
    """
    if last is not None and abs(seen[0] - last[0]) <= MOTION_MARGIN_TICKS:
        return True  # nearly always
    return last is doubted is None or any(_reachable(seen, one) for one in (last, doubted) if one is not None)


def _reachable(seen: Seen, before: Seen) -> bool:
    time_s = max(0, seen[1] - before[1]) / 1e9
    return abs(seen[0] - before[0]) <= SPEED_BOUND_TICK_S * time_s + MOTION_MARGIN_TICKS
