"""What the judge sees and what it expects: packets, servos and motors at an instant, duties, faults to be reported,
and what came of an episode."""

import math
from collections import Counter
from dataclasses import dataclass, field

from proving.reading import At


@dataclass(frozen=True, slots=True)
class Sent:
    """A register write on the wire, to the servo at `index`."""

    index: int
    address: int
    data: bytes

    def value(self, register: At) -> int | None:
        """What it writes into a register; None: nothing."""
        begin = register.address - self.address
        end = begin + register.size
        return int.from_bytes(self.data[begin:end], "little") if begin >= 0 and end <= len(self.data) else None


@dataclass(slots=True)
class Servo:
    """What one servo held at an instant."""

    # Enabled, with a torque limit above 0.
    torque: bool
    goal: int
    speed: int
    limit: int
    shaft_tick: float
    # What its own sensor reads, without noise.
    sensed_tick: int


@dataclass(frozen=True, slots=True)
class Strain:
    """What one motor works, and what its servo feels, at an instant."""

    # Of its full one, and as much of it as gravity asks for; counter-clockwise positive.
    output: float
    gravity: float
    voltage_V: float
    temperature_degC: float
    # What gravity would ask a weak motor for with what an arm may carry, were the joint free: as good as a push.
    carrying: float | None = None


@dataclass(slots=True)
class Duty:
    """From `from_s` no goal may advance, until it is over."""

    from_s: float
    # The end of a short fault; infinite: until the user ends it.
    until_s: float
    # Whether `clear` ends it, else the next motion asked for.
    by_clear: bool
    invariant: str
    why: str
    # Whether an arm that is let go on request, before anybody had to latch, is past it: what took its torque.
    by_release: bool = False


@dataclass(frozen=True, slots=True)
class Known:
    """What else is known when a fault begins."""

    # As reported.
    mode: str
    # Whether a fault was reported before.
    latched: bool
    # Whether a program is in charge.
    alive: bool


@dataclass(slots=True)
class Expected:
    """A fault that has to be reported."""

    # By when; infinite: it counts from the first reply of one of `servos`.
    by_s: float
    what: str
    # Under which codes; none: any will do.
    codes: frozenset[str]
    # Whether one of the codes has to be among all that are reported, else anything that is latched will do.
    by_name: bool = False
    begin_s: float = 0.0
    within_s: float = 0.0
    servos: tuple[int, ...] = ()
    # When its cause is over; infinite: it stays.
    until_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Violation:
    """Something that no invariant allows."""

    invariant: str
    time_s: float
    text: str


@dataclass
class Outcome:
    """What came of an episode."""

    violations: list[Violation]
    rows: Counter[str]
    virtual_s: float
    # Fingerprint of every byte the host sent.
    wire: str
    # The course of it in plain words, with its times.
    told: list[tuple[float, str]] = field(default_factory=list)
    # Of rules that are not kept yet.
    red: list[Violation] = field(default_factory=list)
    # Which two faults began within a tick, under torque.
    met: Counter[tuple[str, str]] = field(default_factory=Counter)
