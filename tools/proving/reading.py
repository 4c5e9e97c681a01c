"""What the judge knows of an arm and its servos by itself: the arm's file, the control table, the fault table.

Nothing here comes from the package. Addresses and units are of ROBOTIS' e-manual (AX-12A), faults and their bounds of
the fault matrix, and a joint's limits of the YAML text that the package reads as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

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

# By how many ticks the second servo of a joint may be off what its file says, and the output with which two may push
# against each other at rest.
PAIR_ROOM, PAIR_PUSH = 12, 0.2
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
    # Of a second servo: which joint it turns as well, and what both read at the same places; else -1 and nothing.
    beside: int = -1
    alike: tuple[tuple[float, float], ...] = ()
    # Of its first servo.
    first_direction: int = 1
    first_zero_tick: float = 0.0

    @property
    def speed_units(self) -> int:
        """The moving speed that reaches the joint's own limit."""
        return max(1, min(1023, math.ceil(self.speed_deg_s / SPEED_UNIT_DEG_S - 1e-9)))

    def position_deg(self, tick: float) -> float:
        """Where its joint is when this servo reads `tick`."""
        if self.beside < 0:
            return self.direction * (tick - self.zero_tick) * TICK_DEG
        rising = self.alike if self.alike[0][1] < self.alike[-1][1] else self.alike[::-1]
        (b, a), (d, c) = _around([(second, first) for first, second in rising], tick)
        return self.first_direction * (a + (tick - b) * ((c - a) / (d - b)) - self.first_zero_tick) * TICK_DEG

    def beside_tick(self, first: float) -> float:
        """What this second servo reads where the first one of its joint reads `first`."""
        (a, b), (c, d) = _around(self.alike, first)
        return b + (first - a) * ((d - b) / (c - a))


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
    # Those of the joints, and behind them the second ones of joints that two servos turn.
    servos: tuple[Joint, ...]

    @property
    def servo_ids(self) -> tuple[int, ...]:
        return tuple(servo.servo_id for servo in self.servos)

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Places of the two servos on one shaft; those of a gripper have a finger each."""
        return tuple((one.beside, k) for k, one in enumerate(self.servos) if one.beside not in (-1, self.gripper))

    def one_joint(self, i: int, servo_id: int | None) -> bool:
        """Whether a servo (by its id; None: every one) turns the same joint as that at a place, or is it."""
        if servo_id is None:
            return True
        turned = [servo.beside if servo.beside >= 0 else k for k, servo in enumerate(self.servos)]
        return servo_id in self.servo_ids and turned[self.servo_ids.index(servo_id)] == turned[i]


def read(text: str) -> Arm:
    """An arm's file; what it leaves out is what `armctl help new-arm` says of a missing key."""
    told = yaml.safe_load(text)
    low_V, high_V = told.get("voltage_V", (9.0, 13.0))
    rows, grips = list(told["joints"]), told.get("gripper")
    if grips and "servo_id" in grips:  # a servo that is none of the joints comes last
        closed_deg = (grips["closed_tick"] - grips["open_tick"]) * TICK_DEG
        own = {"name": "gripper", "zero_tick": grips["open_tick"], "limits_deg": sorted((0.0, closed_deg))}
        rows.append(own | {key: grips[key] for key in ("name", "servo_id", "pair") if key in grips})
        grips = {"joint": rows[-1]["name"]}
    names, joints = [joint["name"] for joint in rows], tuple(map(_joint, rows))
    return Arm(
        joints,
        told.get("temperature_limit_degC", 65.0),
        (low_V, high_V),
        told.get("floor_m", 0.0),
        told.get("tool_speed_limit_m_s", 0.25),
        told.get("link_radius_m", 0.025),
        told.get("rest_on_strain", True),
        names.index(grips["joint"]) if grips else -1,
        (*joints, *(_second(i, joints[i], row["pair"]) for i, row in enumerate(rows) if "pair" in row)),
    )


def _second(i: int, first: Joint, told: dict[str, Any]) -> Joint:
    """The second servo of a joint: mirrored, unless its file says otherwise, or was measured."""
    turned = int(told.get("direction", -first.direction)) * first.direction
    at = told.get("zero_tick", TICK_MAX - first.zero_tick if turned < 0 else first.zero_tick)
    alike = told.get("table") or [(first.zero_tick, at)]
    turned = turned if len(alike) == 1 else 1 if alike[-1][1] > alike[0][1] else -1
    # Beyond what was measured both turn alike.
    (a, b), (c, d) = alike[0], alike[-1]
    alike = ((a - 4096.0, b - turned * 4096.0), *map(tuple, alike), (c + 4096.0, d + turned * 4096.0))
    one = replace(
        first, servo_id=int(told["servo_id"]), direction=turned * first.direction, beside=i, alike=tuple(alike),
        first_direction=first.direction, first_zero_tick=first.zero_tick,
    )  # fmt: skip
    ends = sorted(round(one.beside_tick(tick)) for tick in (first.low, first.high))
    # It may be off what its file says.
    low, high = max(0, ends[0] - PAIR_ROOM), min(TICK_MAX, ends[1] + PAIR_ROOM)
    zero, rest = one.beside_tick(first.zero_tick), one.beside_tick(first.rest_tick)
    return replace(one, zero_tick=zero, low=low, high=high, rest_tick=rest)


def _around(alike: Sequence[tuple[float, float]], first: float) -> Sequence[tuple[float, float]]:
    """The two rows between which a place lies."""
    at = next((k for k in range(1, len(alike)) if first < alike[k][0]), len(alike) - 1)
    return alike[at - 1 : at + 1]


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
