"""What is told, or answered, has to be so in that very tick: torque by the bytes of its own readings.

| rule | checked | bound here |
|-|-|-|
| status | torque is told (`holding`, or on the way) and no fault, every servo being heard | each reading says so |
| limp | torque after a `release` or `teach` that is not refused | in 3 readings of a servo not seen limp since; |
| | | nothing comes damaged |
| limp | what it is answered, whichever way | within 9 ticks of a program that is there |
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from proving.reading import POWERED, STATUS_BEGIN, TORQUE_ENABLE, TORQUE_LIMIT

STIFF_READINGS = 3
SEEN_LIMP = -1
ANSWER_TICKS = 9
NOT_LIMP = "NOT_LIMP"


class Reading(Protocol):
    """What the program took a reply for; `readings.py` has compared it with what the servo said."""

    @property
    def fresh(self) -> bool: ...

    @property
    def registers(self) -> bytes: ...


class Reply(Protocol):
    """An answer to a request."""

    @property
    def request_id(self) -> int: ...

    @property
    def ok(self) -> bool: ...

    @property
    def code(self) -> str: ...


class Promises:
    """Compares word and bytes, tick by tick."""

    def __init__(self, names: Sequence[str], found: Callable[[float, str, str], None]) -> None:
        """Of an arm whose joints are called so; `found` takes the instant, the rule and what is wrong."""
        self._names, self._found = names, found
        # In how many readings each servo had torque since the arm was to be let go, or `SEEN_LIMP`; None: it is not.
        self._stiff: list[int] | None = None
        # Who waits for an answer, and for how many ticks.
        self._waiting: dict[int, int] = {}

    def lost(self) -> None:
        """The program is gone."""
        self._stiff = None
        self._waiting.clear()

    def asked(self, kind: str, request_id: int) -> None:
        """The user asks for something."""
        if kind in ("release", "teach"):
            self._stiff, self._waiting[request_id] = [0] * len(self._names), 0
        elif kind == "torque_on":
            self._stiff = None

    def tick(
        self, now_s: float, mode: str, faulty: bool, readings: Sequence[Reading], replies: Sequence[Reply], whole: bool
    ) -> None:
        """A tick is over.

        Args:
            faulty: Whether any fault is told.
            whole: Whether requests come to the servos as they are sent, and from here alone.
        """
        for reply in replies:
            if self._waiting.pop(reply.request_id, None) is not None and reply.code != NOT_LIMP:
                self._stiff = None
        for i, reading in enumerate(readings):
            if not reading.fresh or self._stiff is None or self._stiff[i] == SEEN_LIMP:
                continue
            if not _torque(reading):
                self._stiff[i] = SEEN_LIMP  # torque from now on is somebody else's
                continue
            self._stiff[i] = self._stiff[i] + 1 if whole else 0
            if self._stiff[i] > STIFF_READINGS:
                self._found(now_s, "limp", f"{self._names[i]}: let go, and {self._stiff[i]} readings of it have torque")
        for request_id in self._waiting:
            self._waiting[request_id] += 1
            if self._waiting[request_id] == ANSWER_TICKS:
                self._found(
                    now_s, "limp", f"the arm is to be let go, and nobody says for {ANSWER_TICKS} ticks whether it is"
                )
        if mode in POWERED and not faulty and all(reading.fresh for reading in readings):
            for name, reading in zip(self._names, readings, strict=True):
                if not _torque(reading):
                    self._found(now_s, "status", f"{name}: {mode} is told, and its reading has no torque")


def _torque(reading: Reading) -> bool:
    at, limit = TORQUE_ENABLE.address - STATUS_BEGIN, TORQUE_LIMIT.address - STATUS_BEGIN
    return bool(reading.registers[at] and any(reading.registers[limit : limit + TORQUE_LIMIT.size]))
