"""Faults of a simulated arm and its bus: what goes wrong, with which servo, how often, from when and for how long.

Rules:

1. A fault is in force from `begin_s` for `duration_s` (None: until it is ended), in the simulator's own time: seconds
   since the arm began. It changes nothing before and leaves nothing behind, except what a servo itself keeps (a trip,
   a reboot, a goal).
2. Some kinds are a state, in force without pause. Others happen on occasions (a reply, a packet, a write of the second
   writer, a servo at the fault's begin): each with `probability`, and at most `count` times.
3. Every fault draws from a generator of its own, by the seed and its number, so faults do not disturb each other.
4. Nobody but the bus, the arm and the port asks about faults, and where none is planned each asks a plain number.

The kinds stand in `faults.yaml`: what each is, on what it happens, and what its value means.

The file of `armctl sim --faults` holds one list:

    faults:
      - {kind: lost, servo_id: 3, probability: 0.2, begin_s: 5, duration_s: 10}
      - {kind: late, count: 1, value: 12}
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, TypeAdapter

from armctl.config import Frozen, parse_yaml, validate
from armctl.errors import ConfigError

# From one write of the second writer to its next.
WRITER_PERIOD_S = 0.1


class _Value(Frozen):
    what: str
    # None: drawn each time.
    default: float | None = None
    low: float
    high: float
    whole: bool = False


class _Kind(Frozen):
    what: str
    # On what it happens; empty: a state.
    occasion: str = ""
    value: _Value | None = None
    bus_wide: bool = False
    one_servo: bool = False


_TABLE = Path(__file__).with_name("faults.yaml")
_KINDS = TypeAdapter(dict[str, _Kind]).validate_python(parse_yaml(_TABLE.read_text(encoding="utf-8"), str(_TABLE)))
KINDS: tuple[str, ...] = tuple(_KINDS)
DESCRIPTIONS: dict[str, str] = {
    name: kind.what + (f" (value: {kind.value.what})" if kind.value else "") for name, kind in _KINDS.items()
}


class Fault(Frozen):
    """One fault, as planned; what `value` means depends on the kind, see `DESCRIPTIONS`."""

    kind: str
    # By the calibration; None: every servo.
    servo_id: int | None = Field(None, ge=0, le=253)
    probability: float = Field(1.0, ge=0.0, le=1.0)
    count: int | None = Field(None, ge=1)
    # Seconds of simulator time; for a live fault, from now.
    begin_s: float = Field(0.0, ge=0.0)
    duration_s: float | None = Field(None, gt=0.0)
    value: float | None = None

    def _check(self) -> None:
        kind = _KINDS.get(self.kind)
        if kind is None:
            raise ValueError(f"kind {self.kind!r} is unknown; known: {', '.join(KINDS)}")
        if kind.bus_wide and self.servo_id is not None:
            raise ValueError(f"{self.kind} strikes the whole bus; leave servo_id out")
        if kind.one_servo and self.servo_id is None:
            raise ValueError(f"{self.kind} needs a servo_id")
        if not kind.occasion and (self.probability != 1.0 or self.count is not None):
            raise ValueError(f"{self.kind} is a state; probability and count do not apply, begin_s and duration_s do")
        if self.value is not None:
            wanted = kind.value
            if wanted is None:
                raise ValueError(f"{self.kind} takes no value")
            if not wanted.low <= self.value <= wanted.high or (wanted.whole and self.value % 1):
                bounds = f"{'a whole number ' if wanted.whole else ''}in {wanted.low:g}..{wanted.high:g}"
                raise ValueError(f"value {self.value:g} of {self.kind} ({wanted.what}) must be {bounds}")


class _Script(Frozen):
    faults: tuple[Fault, ...] = Field(strict=False)


def parse(text: str, file: str, servo_ids: Collection[int]) -> tuple[Fault, ...]:
    """The faults of a YAML text.

    Args:
        servo_ids: Servos of the arm.
    Raises:
        ConfigError: naming the file and every key that is wrong.
    """
    script = validate(_Script, parse_yaml(text, file), file).faults
    for index, fault in enumerate(script):
        check_servo(fault, servo_ids, file, f"faults.{index}.servo_id")
    return script


def check_servo(fault: Fault, servo_ids: Collection[int], file: str, key: str) -> None:
    """Refuse a fault of a servo that is not among `servo_ids`.

    Raises:
        ConfigError: there is no such servo.
    """
    if fault.servo_id is not None and fault.servo_id not in servo_ids:
        known = ", ".join(map(str, servo_ids))
        raise ConfigError(file, key, f"no servo {fault.servo_id} on this arm", f"its servos are {known}")


@dataclass
class Planned:
    """A fault from its announcement to its end."""

    id: int
    fault: Fault
    # Absolute.
    begin_s: float
    end_s: float
    rng: np.random.Generator
    begun: bool = False
    struck: int = 0
    next_write_s: float = math.inf

    @property
    def amount(self) -> float:
        """The fault's value, or its kind's default.

        Raises:
            AssertionError: the kind has none; then whoever asks must look at `fault.value` himself.
        """
        wanted = _KINDS[self.fault.kind].value
        value = wanted.default if self.fault.value is None and wanted else self.fault.value
        assert value is not None
        return value

    def concerns(self, kind: str, servo_id: int | None) -> bool:
        """Whether it is a fault of this kind, in force for a servo (None: whichever)."""
        fault = self.fault
        return self.begun and fault.kind == kind and (servo_id is None or fault.servo_id in (None, servo_id))

    def happens(self) -> bool:
        """Whether it happens on an occasion; counts if so."""
        fault, spent = self.fault, self.fault.count is not None and self.struck >= self.fault.count
        happens = not spent and (fault.probability >= 1.0 or self.rng.random() < fault.probability)
        self.struck += happens
        return happens


class Faults:
    """Every fault planned or in force; time comes from the arm, which calls `advance` whenever `due_s` has come."""

    def __init__(self, script: Sequence[Fault] = (), *, seed: int = 0) -> None:
        """Plan the faults of a script, whose `begin_s` count from the arm's begin."""
        self._seed, self._last_id = seed, 0
        # Those planned or in force; empty nearly always, and asked for with every byte.
        self.planned: list[Planned] = []
        # When something changes next.
        self.due_s = math.inf
        # How often the adapter was pulled out of the host so far.
        self.unplugs = 0
        for fault in script:
            self.begin(fault, 0.0)

    def begin(self, fault: Fault, now_s: float) -> int:
        """Plan a fault, its `begin_s` counting from `now_s`; the number to end it by."""
        self._last_id += 1
        begin_s = now_s + fault.begin_s
        end_s = math.inf if fault.duration_s is None else begin_s + fault.duration_s
        rng = np.random.default_rng((self._seed, self._last_id))
        self.planned.append(Planned(self._last_id, fault, begin_s, end_s, rng))
        self.due_s = min(self.due_s, begin_s)
        return self._last_id

    def end(self, id: int) -> None:
        """End a fault, or call it off; one that is over already is left so.

        Raises:
            ValueError: there never was a fault of this number.
        """
        if not 1 <= id <= self._last_id:
            raise ValueError(f"fault {id}: there never was one; the numbers so far are 1..{self._last_id}")
        for planned in self.planned:
            if planned.id == id:
                planned.end_s = self.due_s = -math.inf

    def advance(self, now_s: float) -> list[Planned]:
        """Begin and end what is due by `now_s`.

        Returns:
            What the arm has to do now: faults that begin, and second writers whose write is due.
        """
        self.planned = [planned for planned in self.planned if planned.end_s > now_s]
        due = []
        for planned in self.planned:
            if planned.begin_s <= now_s and not planned.begun:
                planned.begun = True
                self.unplugs += planned.fault.kind == "unplug"
                planned.next_write_s = planned.begin_s if planned.fault.kind == "second_writer" else math.inf
                due.append(planned)
            elif planned.next_write_s <= now_s:
                due.append(planned)
            while planned.next_write_s <= now_s:
                planned.next_write_s += WRITER_PERIOD_S
        coming_s = (min(p.end_s, p.next_write_s) if p.begun else p.begin_s for p in self.planned)
        self.due_s = min(coming_s, default=math.inf)
        return due

    def in_force(self, kind: str, servo_id: int | None = None) -> Planned | None:
        """The newest fault of a kind in force for a servo (None: whichever)."""
        return next((p for p in reversed(self.planned) if p.concerns(kind, servo_id)), None)

    def happening(self, kind: str, servo_id: int) -> Planned | None:
        """The oldest fault of a kind that happens on this occasion, a servo's."""
        return next((p for p in self.planned if p.concerns(kind, servo_id) and p.happens()), None)

    def listing(self) -> list[dict[str, Any]]:
        """Everything planned or in force, as plain values; times are absolute, `end_s` None: not before it is ended."""
        return [
            {
                "id": planned.id,
                **planned.fault.model_dump(exclude={"begin_s", "duration_s"}),
                "begin_s": planned.begin_s,
                "end_s": None if planned.end_s == math.inf else planned.end_s,
                "active": planned.begun,
                "struck": planned.struck,
            }
            for planned in self.planned
        ]
