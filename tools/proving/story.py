"""What happens in one episode of the soak, drawn from a seed; and how a failing one is told in few words.

A story is plain data: a list of things that happen at their times. It can be run, shortened and printed; leaving out
one of its lines leaves the others as they were.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from armctl.config import ArmConfig
from armctl.sim.faults import DESCRIPTIONS, Fault
from armctl.sim.faults import KINDS as ALL_KINDS

SHORTEST_S, LONGEST_S = 120.0, 240.0
# What a user wants of an arm; `mixed` is a run with pauses, other rates and stops in between, `lean` one against
# something that holds a joint.
WISHES = ("run", "run", "run", "mixed", "mixed", "jog", "jog", "park", "teach", "release", "lean")
# What may become of a packet on its way to the servos.
DAMAGES = ("flipped", "short", "cut", "dropped")
# What beside the simulator's faults may meet one of them.
OTHERS = ("requests", "late tick", "kill")
# What strikes a pair of servos on one joint has its turn on arms that have one.
KINDS = tuple(kind for kind in ALL_KINDS if kind != "pair_mismatch")
HAPPENINGS = (*KINDS, *OTHERS)
# The whole bus is struck once at a time.
ALONE = frozenset({"dead_bus", "echo", "unplug", "latency", *OTHERS})
PAIRS: tuple[tuple[str, str], ...] = tuple(
    pair for pair in combinations_with_replacement(HAPPENINGS, 2) if pair[0] != pair[1] or pair[0] not in ALONE
)
# So many an episode, at least: they begin with another one in the next.
PAIRS_EACH = 3
# Two that begin within a tick.
TOGETHER_S = 0.08
# What is asked without regard to the state; `nonsense` is a run outside the limits, `elsewhere` one that starts so.
WORDS = (
    "hold", "clear", "release", "torque_on", "park", "run", "teach", "teach_end", "pause", "resume", "set_rate", "jog",
    "nonsense", "elsewhere", "elsewhere",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Wish:
    """The user wants something and sees to what it needs: torque, a hand at a limp arm."""

    at_s: float
    what: str
    # Draws whatever it needs.
    number: int

    def __str__(self) -> str:
        return f"the user wants to {self.what}"


@dataclass(frozen=True, slots=True)
class Word:
    """A command out of the blue."""

    at_s: float
    what: str
    number: int

    def __str__(self) -> str:
        return f"`{self.what}` is asked for, whatever the state"


@dataclass(frozen=True, slots=True)
class Strike:
    """A fault of the simulator begins."""

    fault: Fault

    @property
    def at_s(self) -> float:
        return self.fault.begin_s

    def __str__(self) -> str:
        fault = self.fault
        who = "the whole bus" if fault.servo_id is None else f"servo {fault.servo_id}"
        lasts = "" if fault.duration_s is None else f" for {fault.duration_s:.2f} s"
        often = "" if fault.probability == 1.0 else f", with probability {fault.probability:.2f}"
        value = "" if fault.value is None else f", value {fault.value:g}"
        return f"fault {fault.kind} ({who}){lasts}{often}{value}: {DESCRIPTIONS[fault.kind].split(' (')[0]}"


@dataclass(frozen=True, slots=True)
class Late:
    """The control process is not run for a while."""

    at_s: float
    late_ms: float

    def __str__(self) -> str:
        return f"the next tick comes {self.late_ms:.0f} ms late"


@dataclass(frozen=True, slots=True)
class Kill:
    """The control process is killed, in the middle of a tick, and another one comes."""

    at_s: float
    # After so many packets of the tick.
    sends: int
    back_s: float

    def __str__(self) -> str:
        return f"the control process dies after {self.sends} packets of a tick, back after {self.back_s:.2f} s"


@dataclass(frozen=True, slots=True)
class HostGone:
    """The host dies: the control process brings the arm to rest and leaves; another pair comes."""

    at_s: float
    back_s: float

    def __str__(self) -> str:
        return f"the host dies, and is back {self.back_s:.2f} s after the control process left"


@dataclass(frozen=True, slots=True)
class Tamper:
    """Before the start somebody has set a servo's EEPROM wrong."""

    servo_id: int
    at_s: float = 0.0

    def __str__(self) -> str:
        return f"servo {self.servo_id} was left in wheel mode before the start"


@dataclass(frozen=True, slots=True)
class Garble:
    """For a while packets of the host come damaged to the servos."""

    at_s: float
    duration_s: float
    probability: float
    # One of `DAMAGES`.
    how: str

    def __str__(self) -> str:
        return f"requests come {self.how} for {self.duration_s:.2f} s, with probability {self.probability:.2f}"


Line = Wish | Word | Strike | Late | Kill | HostGone | Tamper | Garble


@dataclass(frozen=True, slots=True)
class Story:
    """One episode; `seed` draws the simulated arm and its noise."""

    seed: int
    duration_s: float
    lines: tuple[Line, ...]


def draw(seed: int, episode: int, arm: ArmConfig) -> Story:
    """The story of an episode, the same for the same numbers."""
    rng = np.random.default_rng((seed, episode))
    duration_s = float(rng.uniform(SHORTEST_S, LONGEST_S))
    lines: list[Line] = []

    def times(mean_s: float, begin_s: float = 1.0) -> list[float]:
        found, at_s = [], begin_s + float(rng.exponential(mean_s))
        while at_s < duration_s - 1.0:
            found.append(round(at_s, 4))
            at_s += float(rng.exponential(mean_s))
        return found

    def number() -> int:
        return int(rng.integers(2**31))

    wish_s = 0.5
    while wish_s < duration_s:
        lines.append(Wish(round(wish_s, 4), str(rng.choice(WISHES)), number()))
        wish_s += float(rng.uniform(1.0, 12.0))
    lines += [Word(at_s, str(rng.choice(WORDS)), number()) for at_s in times(20.0)]
    lines += [Late(at_s, round(float(rng.choice((60, 120, 240, 300, 600, 1500)) * rng.uniform(0.8, 1.2)), 1))
              for at_s in times(25.0)]  # fmt: skip
    lines += [Kill(at_s, int(rng.integers(8)), round(float(rng.uniform(0.3, 2.0)), 3)) for at_s in times(90.0)]
    lines += [HostGone(at_s, round(float(rng.uniform(0.5, 2.0)), 3)) for at_s in times(200.0)]
    lines += [Strike(_fault(rng, arm, at_s)) for at_s in times(18.0)]
    if rng.random() < 0.25:
        lines.append(Strike(_fault(rng, arm, 0.0)))
    if rng.random() < 0.1:  # a slow adapter is one from the start
        lines.append(Strike(Fault(kind="latency", value=16.0, duration_s=round(float(rng.uniform(1.0, 5.0)), 2))))
    if rng.random() < 0.15:
        lines.append(Tamper(int(rng.choice(arm.servo_ids))))
    return Story(int(rng.integers(2**31)), duration_s, tuple(sorted(lines, key=lambda line: line.at_s)))


def thickened(story: Story, seed: int, episode: int, arm: ArmConfig) -> Story:
    """A story with more in it: faults that come in pairs within a tick, damaged requests, motions that the host judges.

    Every pair has its turn, whatever the seed.
    """
    rng = np.random.default_rng((seed, episode, 5))
    lines: list[Line] = []
    begin_s, turn = 6.0 + float(rng.uniform(0.0, 20.0)), 0
    while begin_s < story.duration_s - 10.0:
        pair = PAIRS[(seed * 37 + episode * PAIRS_EACH + turn) % len(PAIRS)]
        lines += _together(rng, arm, pair, begin_s, story.duration_s)
        begin_s, turn = begin_s + float(rng.uniform(22.0, 50.0)), turn + 1
    for _ in range(int(rng.integers(2))):
        lines.append(_garble(rng, float(rng.uniform(2.0, story.duration_s - 2.0))))
    lines += [
        Wish(round(float(rng.uniform(2.0, story.duration_s)), 4), "plan", int(rng.integers(2**31))) for _ in range(4)
    ]
    lines += [
        Wish(round(float(rng.uniform(2.0, story.duration_s)), 4), "halt", int(rng.integers(2**31))) for _ in range(2)
    ]
    lines += [Word(round(float(rng.uniform(2.0, story.duration_s)), 4), "host_silent", 0) for _ in range(2)]
    # Half of what strikes alone makes room for what strikes together.
    kept = tuple(line for line in story.lines if not isinstance(line, Strike) or rng.random() < 0.5)
    return replace(story, lines=tuple(sorted((*kept, *lines), key=lambda line: line.at_s)))


def paired(story: Story, seed: int, episode: int, arm: ArmConfig) -> Story:
    """A story in which a horn of a pair slips, by about what real pairs are off, and a servo of one dies."""
    if not arm.pairs:
        return story
    rng = np.random.default_rng((seed, episode, 13))
    lines: list[Line] = []
    for at_s in np.sort(rng.uniform(8.0, story.duration_s - 15.0, 3)).tolist():
        pair = arm.pairs[int(rng.integers(len(arm.pairs)))]
        value = float(rng.choice((6, 15, 15, 25)) * rng.choice((-1, 1)))
        dies = str(rng.choice(("trip", "brown_out", "mute")))
        for kind, index, amount, later_s in (
            ("pair_mismatch", pair[1], value, 0.0),
            (dies, int(rng.choice(pair)), None, float(rng.uniform(0.0, 14.0))),
        ):
            begin_s, lasts_s = round(at_s + later_s, 4), round(float(rng.uniform(0.5, 9.0)), 3)
            struck = arm.servo_ids[index]
            lines.append(Strike(Fault(kind=kind, servo_id=struck, value=amount, begin_s=begin_s, duration_s=lasts_s)))
    return replace(story, lines=tuple(sorted((*story.lines, *lines), key=lambda line: line.at_s)))


def _together(
    rng: np.random.Generator, arm: ArmConfig, pair: tuple[str, str], begin_s: float, duration_s: float
) -> list[Line]:
    """Two happenings within a tick; of one kind they strike two servos."""
    begins_s = [round(begin_s, 4), round(begin_s + float(rng.uniform(0.0, TOGETHER_S)), 4)]
    lines: list[Line] = []
    taken: list[int] = []
    for what, at_s in zip(rng.permutation(pair).tolist(), begins_s, strict=True):
        if what == "requests":
            lines.append(_garble(rng, at_s))
        elif what == "late tick":
            lines.append(Late(at_s, round(float(rng.choice((120, 300, 600)) * rng.uniform(0.8, 1.2)), 1)))
        elif what == "kill":
            lines.append(Kill(at_s, int(rng.integers(8)), round(float(rng.uniform(0.3, 2.0)), 3)))
        else:
            fault = _fault(rng, arm, at_s, what)
            if fault.servo_id in taken and pair[0] == pair[1]:
                free = [servo_id for servo_id in arm.servo_ids if servo_id not in taken]
                fault = fault.model_copy(update={"servo_id": int(rng.choice(free))})
            taken += [] if fault.servo_id is None else [fault.servo_id]
            lines.append(Strike(fault))
    return lines


def _garble(rng: np.random.Generator, at_s: float) -> Garble:
    probability = 1.0 if rng.random() < 0.2 else round(float(rng.uniform(0.02, 0.6)), 3)
    lasts_s = float(rng.uniform(0.1, 0.9) if probability == 1.0 else rng.uniform(0.2, 10.0))
    return Garble(round(at_s, 4), round(lasts_s, 3), probability, str(rng.choice(DAMAGES)))


def _fault(rng: np.random.Generator, arm: ArmConfig, begin_s: float, kind: str = "") -> Fault:
    """Any fault (or one of a kind), as it may happen: short or long, on one servo or all, always or now and then."""
    kind = kind or str(rng.choice((*KINDS, "brown_out", "hot", "noise")))
    one: int | None = int(rng.choice(arm.servo_ids))
    everyone = rng.random() < 0.2
    duration_s = round(math.exp(rng.uniform(math.log(0.03), math.log(6.0))), 4)
    probability, value, count = 1.0, None, None
    if kind == "noise":  # enough of it for 10 % in 10 s, too little to silence a servo
        kind, everyone, duration_s = "corrupted", True, round(float(rng.uniform(11.0, 16.0)), 2)
        probability = round(float(rng.uniform(0.3, 0.5)), 3)
    elif kind in ("lost", "late", "duplicated", "corrupted", "truncated", "garbage", "wrong_id"):
        probability = 1.0 if rng.random() < 0.3 else round(float(rng.uniform(0.02, 0.9)), 3)
        duration_s = round(float(rng.uniform(0.1, 15.0)), 3)
        if kind == "late":
            value = round(float(rng.uniform(0.5, 60.0)), 2)
    elif kind == "hot":
        value, probability = round(float(rng.uniform(62.0, 70.4)), 1), 1.0
    elif kind == "brown_out":
        probability = float(rng.choice((0.0, 1.0)))
        value = round(float(rng.uniform(5.0, 9.5)), 2)
    elif kind == "latency":
        value = float(rng.choice((1.0, 4.0, 16.0)))
    elif kind == "second_writer":
        value = float(rng.integers(5, 60) * rng.choice((-1, 1)))
    elif kind in ("blocked_joint", "stuck_joint", "frozen_sensor"):
        duration_s = round(float(rng.uniform(0.5, 8.0)), 3)
    if kind in ("echo", "dead_bus", "unplug", "latency") or (everyone and kind != "same_id"):
        one = None
    return Fault(
        kind=kind, servo_id=one, probability=probability, count=count,
        begin_s=begin_s, duration_s=duration_s, value=value,
    )  # fmt: skip


class Drawing:
    """The lines of a scene being drawn."""

    def __init__(self, rng: np.random.Generator, arm: ArmConfig, turn: int) -> None:
        """The scene's `turn`-th time."""
        self.rng, self._arm, self._turn = rng, arm, turn
        self.lines: list[Line] = []
        # What strikes one servo, strikes that one; and the next one.
        self.one, self.other = map(int, rng.choice(arm.servo_ids, 2, replace=False))

    def either(self, *ways: str) -> str:
        """Each in its turn."""
        return ways[self._turn % len(ways)]

    def number(self) -> int:
        return int(self.rng.integers(2**31))

    def within(self, at_s: float, spread_s: float = 0.1) -> float:
        """A time from then on; by default anywhere in one tick."""
        return round(at_s + float(self.rng.uniform(0.0, spread_s)), 4)

    def wish(self, what: str, at_s: float) -> None:
        self.lines.append(Wish(at_s, what, self.number()))

    def say(self, *words: tuple[str, float]) -> None:
        self.lines += [Word(self.within(at_s), what, self.number()) for what, at_s in words]

    def strike(
        self, kind: str, at_s: float, lasts_s: tuple[float, float], value: tuple[float, float] | None = None,
        servo_id: int | None = 0, probability: float = 1.0,
    ) -> float:  # fmt: skip
        """A fault between the least and the most so long and strong, of servo `one` unless told; when it begins."""
        begin_s = self.within(at_s)
        amount = (
            None if value is None or kind in ("trip", "blocked_joint") else round(float(self.rng.uniform(*value)), 2)
        )
        if amount is not None and kind == "second_writer":
            amount = float(round(amount) * self.rng.choice((-1, 1)))
        self.lines.append(Strike(Fault(
            kind=kind, servo_id=self.one if servo_id == 0 else servo_id, begin_s=begin_s, value=amount,
            duration_s=round(float(self.rng.uniform(*lasts_s)), 4), probability=probability,
        )))  # fmt: skip
        return begin_s

    def garble(self, at_s: float, lasts_s: float, probability: float, how: str) -> None:
        self.lines.append(Garble(self.within(at_s), lasts_s, probability, how))

    def heat(self, at_s: float, above_degC: tuple[float, float] = (1.5, 4.5), servo_id: int | None = 0) -> None:
        low, high = (self._arm.temperature_limit_degC + degC for degC in above_degC)
        # Nobody cools it before.
        self.strike("hot", at_s, (8.0, 9.0), (low, high), servo_id)


# ------------------------------------------------------------------------------------------------ shrinking


def shrink(story: Story, fails_at_s: Callable[[Story], float | None], budget_s: float) -> Story:
    """A shorter story that still fails, none of whose lines can be left out (or the best one within the budget).

    Delta debugging: ever smaller pieces are left out as long as what remains still fails.

    Args:
        fails_at_s: Runs a story; when the same thing goes wrong in it, or None.
    """
    give_up_s = time.monotonic() + budget_s
    failed_s = fails_at_s(story)
    assert failed_s is not None, "a story that does not fail cannot be shortened"
    story = _cut(story, failed_s)
    pieces = 2
    while len(story.lines) > 1 and time.monotonic() < give_up_s:
        size = math.ceil(len(story.lines) / pieces)
        for begin in range(0, len(story.lines), size):
            shorter = replace(story, lines=story.lines[:begin] + story.lines[begin + size :])
            failed_s = fails_at_s(shorter)
            if failed_s is not None:
                story, pieces = _cut(shorter, failed_s), max(pieces - 1, 2)
                break
            if time.monotonic() >= give_up_s:
                break
        else:
            if size == 1:
                break
            pieces = min(2 * pieces, len(story.lines))
    return story


def _cut(story: Story, failed_s: float) -> Story:
    """End it where it has failed; nothing later can matter."""
    lines = tuple(line for line in story.lines if line.at_s <= failed_s)
    return replace(story, duration_s=min(story.duration_s, failed_s + 0.2), lines=lines)
