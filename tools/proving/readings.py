"""What a program takes the servos' replies to say, against what stands in the bytes: the judge's own decoding."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

from proving.reading import (
    LOAD_FULL,
    PRESENT_LOAD,
    PRESENT_POSITION,
    PRESENT_SPEED,
    PRESENT_TEMPERATURE,
    PRESENT_VOLTAGE,
    SPEED_UNIT_DEG_S,
    STATUS_BEGIN,
    TORQUE_ENABLE,
    Arm,
    At,
)

# Present speed and load: their size, and a bit for clockwise.
SIZE, CLOCKWISE = 0x3FF, 0x400


class Heard(NamedTuple):
    """A good reply: its error byte, and the status bytes."""

    error: int
    data: bytes


class Reading(Protocol):
    """What the program took a reply for."""

    @property
    def fresh(self) -> bool: ...

    @property
    def error(self) -> int: ...

    @property
    def registers(self) -> bytes: ...


class Told(Protocol):
    """What the program tells of a joint."""

    @property
    def position_rad(self) -> float: ...

    @property
    def velocity_rad_s(self) -> float: ...

    @property
    def load_ratio(self) -> float: ...

    @property
    def voltage_V(self) -> float: ...

    @property
    def temperature_degC(self) -> float: ...

    @property
    def torque_enabled(self) -> bool: ...


def differences(
    arm: Arm, heard: Mapping[int, Heard], readings: Sequence[Reading], told: Sequence[Told]
) -> Iterator[tuple[int, str]]:
    """Which servo's reading is not what it said in this tick, or whose joint is not told as it was read, and how."""
    said: dict[int, tuple[float, ...]] = {}
    for i, (joint, reading) in enumerate(zip(arm.servos, readings, strict=True)):
        if not reading.fresh:
            continue
        if i not in heard:
            yield i, "a reading counts as fresh, and no good reply came"
            continue
        error, data = heard[i]
        if reading.registers != data or reading.error != error:
            yield (
                i,
                f"the servo said {data.hex()} (error {error}), read was {reading.registers.hex()} ({reading.error})",
            )
            continue
        said[i] = (
            math.radians(joint.position_deg(_value(data, PRESENT_POSITION))),
            joint.direction * math.radians(_signed(data, PRESENT_SPEED) * SPEED_UNIT_DEG_S),
            joint.direction * _signed(data, PRESENT_LOAD) / LOAD_FULL,
            _value(data, PRESENT_VOLTAGE) / 10.0,
            float(_value(data, PRESENT_TEMPERATURE)),
            float(_value(data, TORQUE_ENABLE)),
        )
    for i, state in enumerate(told):
        both = [k for k, servo in enumerate(arm.servos) if i in (k, servo.beside)]
        if not all(k in said for k in both):
            continue
        wanted = (
            said[i] if len(both) == 1 else _of_two(said[i], said[both[1]], measured=len(arm.servos[both[1]].alike) > 3)
        )
        found = (state.position_rad, state.velocity_rad_s, state.load_ratio, state.voltage_V, state.temperature_degC,
                 float(state.torque_enabled))  # fmt: skip
        if not all(math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6) for a, b in zip(wanted, found, strict=True)):
            yield i, f"told is {found}, the servo said {wanted}"


def _of_two(a: tuple[float, ...], b: tuple[float, ...], *, measured: bool) -> tuple[float, ...]:
    """What is to be told of a joint with two servos: of one without a measured table the first one has the place."""
    place, speed = [(x + y) / 2.0 if measured else x for x, y in zip(a[:2], b[:2], strict=True)]
    return place, speed, (a[2] + b[2]) / 2.0, min(a[3], b[3]), max(a[4], b[4]), min(a[5], b[5])


def _value(data: bytes, register: At) -> int:
    begin = register.address - STATUS_BEGIN
    return int.from_bytes(data[begin : begin + register.size], "little")


def _signed(data: bytes, register: At) -> int:
    value = _value(data, register)
    return -(value & SIZE) if value & CLOCKWISE else value & SIZE
