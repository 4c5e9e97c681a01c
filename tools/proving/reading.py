"""What the judge knows of an arm and its servos by itself: the arm's file, the control table, the fault table.

Nothing here comes from the package. Addresses and units are of ROBOTIS' e-manual (AX-12A), faults and their bounds of
the fault matrix, and a joint's limits of the YAML text that the package reads as well.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import yaml

TICK_DEG = 300.0 / 1023.0
TICK_MAX = 1023
# One unit of moving speed [deg/s]: 0.111 rpm.
SPEED_UNIT_DEG_S = 0.111 * 6.0


class Register(NamedTuple):
    """Where a value stands in the control table."""

    address: int
    size: int

    @property
    def eeprom(self) -> bool:
        return self.address < EEPROM_END


class At(Protocol):
    """Whatever says where a value stands."""

    @property
    def address(self) -> int: ...

    @property
    def size(self) -> int: ...


EEPROM_END = 24
CW_LIMIT, CCW_LIMIT = Register(6, 2), Register(8, 2)
TORQUE_ENABLE, GOAL, MOVING_SPEED, TORQUE_LIMIT = Register(24, 1), Register(30, 2), Register(32, 2), Register(34, 2)
PRESENT_POSITION, PRESENT_SPEED, PRESENT_LOAD = Register(36, 2), Register(38, 2), Register(40, 2)
PRESENT_VOLTAGE, PRESENT_TEMPERATURE = Register(42, 1), Register(43, 1)
LOAD_FULL = 1023
FULL_LIMIT = 1023
# The block that a program reads of each servo in each tick: address and size.
STATUS_BEGIN, STATUS_SIZE = 24, 26
PING, READ, WRITE, REG_WRITE, SYNC_WRITE = 1, 2, 3, 4, 0x83
BROADCAST_ID = 0xFE

# What the program says of itself, in its own words.
STARTING, OFF, ENERGISING, HOLDING, MOVING, JOGGING, PARKING, TEACHING, FAULTED = (
    "starting", "off", "energising", "holding", "moving", "jogging", "parking", "teaching", "faulted",
)  # fmt: skip
ADVANCING = frozenset({MOVING, JOGGING, PARKING})
POWERED = ADVANCING | {HOLDING}
LIMP = frozenset({OFF, TEACHING})

# Faults that may send the arm to rest, and for how long their cause has to last before [s].
RESTING = {"HOT": 2.0, "VOLTAGE": 0.5, "OVERLOAD": 2.0}
# The way to rest is announced so long before it begins [s].
ANNOUNCED_S = 3.0


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint in the units of the wire."""

    name: str
    servo_id: int
    direction: int
    zero_tick: float
    # Lowest and highest whole goal.
    low: int
    high: int
    rest_tick: float
    speed_deg_s: float
    # The torque limit with which the servo holds.
    full_limit: int
    limits_deg: tuple[float, float]

    @property
    def speed_units(self) -> int:
        """The moving speed that reaches the joint's own limit."""
        return max(1, min(1023, math.ceil(self.speed_deg_s / SPEED_UNIT_DEG_S - 1e-9)))


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm."""

    joints: tuple[Joint, ...]
    temperature_limit_degC: float
    voltage_V: tuple[float, float]
    floor_m: float
    tool_speed_limit_m_s: float
    link_radius_m: float
    # Whether heat, voltage and load may send it to rest at all.
    rests: bool
    # Which joint grips; -1: none.
    gripper: int

    @property
    def servo_ids(self) -> tuple[int, ...]:
        return tuple(joint.servo_id for joint in self.joints)


def read(text: str) -> Arm:
    """An arm's file; what it leaves out is what `armctl help new-arm` says of a missing key."""
    told = yaml.safe_load(text)
    low_V, high_V = told.get("voltage_V", (9.0, 13.0))
    names = [joint["name"] for joint in told["joints"]]
    return Arm(
        tuple(map(_joint, told["joints"])),
        told.get("temperature_limit_degC", 65.0),
        (low_V, high_V),
        told.get("floor_m", 0.0),
        told.get("tool_speed_limit_m_s", 0.25),
        told.get("link_radius_m", 0.025),
        told.get("rest_on_strain", True),
        names.index(told["gripper"]["joint"]) if "gripper" in told else -1,
    )


def _joint(told: dict[str, object]) -> Joint:
    number = {key: float(value) for key, value in told.items() if isinstance(value, int | float)}
    direction, zero = int(number.get("direction", 1)), number.get("zero_tick", 512.0)
    low_deg, high_deg = map(float, told["limits_deg"])  # type: ignore[call-overload]  # a pair, or nothing is right
    first, last = sorted(zero + direction * limit / TICK_DEG for limit in (low_deg, high_deg))
    return Joint(
        str(told["name"]),
        int(number["servo_id"]),
        direction,
        zero,
        max(0, math.ceil(first - 1e-9)),
        min(TICK_MAX, math.floor(last + 1e-9)),
        zero + direction * number.get("rest_deg", 0.0) / TICK_DEG,
        number.get("speed_limit_deg_s", 60.0),
        round(FULL_LIMIT * number.get("torque_limit_ratio", 1.0)),
        (low_deg, high_deg),
    )
