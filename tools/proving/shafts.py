"""What the shafts of an arm show: strain, jumps at torque-on, motion where there should be rest.

The part of the judge that looks at true positions once a tick; `invariants.py` has the rules and looks at the packets.
"""

import math
from collections import deque
from collections.abc import Sequence

from proving.duties import REPORT_SLACK_S, Duties
from proving.evidence import Servo, Violation
from proving.reading import POWERED, STARTING, TICK_DEG, Arm
from proving.rules import RED

# Two standard deviations of one reading: a program that has one reading knows a shaft no better.
NOISE_TICKS = 1.0
JUMP_TICKS = 2.0 / TICK_DEG
JUMP_S = 0.5
# Between two ticks: twice the play of a joint, which gravity may cross when a neighbour comes to rest.
STILL_TICKS = 0.9 / TICK_DEG
DEAD_TICKS = 10.0 / TICK_DEG
BLOCKED_TICKS = 8.0 / TICK_DEG + 2.0
BLOCKED_S = 0.3
# By so much faster than the joint a goal may go that is being corrected.
CORRECTION_DEG_S = 4.0
# And so much it may be bent in all.
CORRECTION_DEG = 7.0
# How long a joint swings whose goal was given up.
SETTLE_S = 0.6
# One whose motor lies within its play swings about the same place for good: it is back within a second.
BACK_TICKS, BACK_S = 1.0, 1.0


class ShaftJudge:
    """Watches the shafts of one arm, and notes what must not be."""

    def __init__(self, arm: Arm, period_s: float) -> None:
        self.violations: list[Violation] = []
        # Of rules that are not kept yet.
        self.red: list[Violation] = []
        self._arm = arm
        self._names = [joint.name for joint in arm.servos]
        self._period_s = period_s
        # What a correction and rounding may add to a goal in a tick.
        self._bend_ticks = CORRECTION_DEG_S * period_s / TICK_DEG + 1.0
        self._seen: set[tuple[str, int]] = set()
        self._duties = Duties(arm, period_s)
        # What is reported: the mode, and the code of a fault.
        self._mode, self._code = STARTING, ""
        # The servos a tick ago.
        self._before: list[Servo] = []
        # Where each shaft was lately [tick].
        self._lately: deque[list[float]] = deque(maxlen=round(BACK_S / period_s))
        # When and where [tick] each servo took torque, for the half second of watching.
        self._enabled: dict[int, tuple[float, float]] = {}
        # When the goal of each servo last changed.
        self._goal_s = [-math.inf] * len(arm.servos)
        # Since when each servo is far from its goal.
        self._far_s = [math.inf] * len(arm.servos)
        # When the program in charge died, and where the shafts were.
        self._dead: tuple[float, list[float]] | None = None

    def found(self, now_s: float, invariant: str, text: str) -> None:
        """Something that whoever plays the user, or the episode itself, has seen."""
        self._violate(invariant, now_s, -1, text)

    def _violate(self, invariant: str, now_s: float, index: int, text: str) -> None:
        if (invariant, index) not in self._seen:
            self._seen.add((invariant, index))
            who = f"{self._names[index]}: " if index >= 0 else ""
            (self.red if invariant in RED else self.violations).append(Violation(invariant, now_s, who + text))

    def _watch_tripped(self, now_s: float) -> None:
        """Servos that shut themselves down say so by their torque limit: the card is another than for lost torque."""
        limits = [servo.limit for servo in self._before if not servo.torque]
        if limits and not any(limits) and self._mode in POWERED and not self._duties.may_restart():
            self._violate("rows", now_s, -1, "a servo that shut itself down is reported as LOST_TORQUE")

    def _watch_strain(self, now_s: float, i: int, away_ticks: int) -> None:
        """A joint that cannot follow: over 8 deg (and the noise of two readings) for 300 ms has to be reported.

        It counts from when a program watches for it and was told: one that has just adopted the arm knows of nothing
        before. Of a joint that is not heard nothing is to be reported but that.
        """
        if away_ticks <= BLOCKED_TICKS or self._mode not in POWERED or self._code:
            self._far_s[i] = math.inf
        elif self._far_s[i] == math.inf:
            self._far_s[i] = now_s
        elif now_s - self._far_s[i] > BLOCKED_S + 1.5 * self._period_s > now_s - self._duties.heard_s[i] + BLOCKED_S:
            self._far_s[i] = now_s
            what = f"{self._names[i]} over 8 deg from its goal for 0.3 s"
            self._duties.must_report(now_s + REPORT_SLACK_S, what)

    def _unknown(self, now_s: float, i: int) -> bool:
        """Whether nobody can tell where a joint is to be: a fault or a hand moves it, or another servo answers."""
        return self._duties.excused(now_s, i) or self._duties.replaced(now_s, i)

    def _watch_jump(self, now_s: float, i: int, servo: Servo) -> None:
        since_s, from_tick = self._enabled[i]
        if now_s - since_s > JUMP_S:
            del self._enabled[i]
            return
        moved = servo.shaft_tick - from_tick
        if abs(moved) > JUMP_TICKS and not _sags(servo, moved) and not self._unknown(now_s, i):
            text = f"moved {abs(moved) * TICK_DEG:.1f} deg within {now_s - since_s:.2f} s of torque-on (bound 2)"
            self._violate("3", now_s, i, text)

    def _watch_rest(
        self, now_s: float, servos: Sequence[Servo], before: Sequence[Servo], invariant: str, why: str
    ) -> None:
        all_moved = [servo.shaft_tick - was.shaft_tick for servo, was in zip(servos, before, strict=True)]
        if self._duties.excused(now_s) or any(
            abs(moved) > STILL_TICKS and (not servo.torque or (self._code and self._is_weak(i, servo)))
            for i, (servo, moved) in enumerate(zip(servos, all_moved, strict=True))
        ):
            return  # a limp or weak joint that falls swings, and shakes those that hold
        # What was decided before is sent until it arrives.
        lossy = self._duties.may_be_lost(now_s)
        for i, (servo, moved) in enumerate(zip(servos, all_moved, strict=True)):
            if now_s - self._goal_s[i] < SETTLE_S and invariant != "lead":
                continue  # a goal that goes on is another rule's; one given up for the shaft lets it swing
            arrives = lossy and moved * (servo.goal - servo.shaft_tick + moved) > 0.0
            lately = [shafts[i] for shafts in self._lately]
            swings = any(abs(place - servo.shaft_tick) < BACK_TICKS for place in lately)
            swings &= max(lately, default=0.0) - min(lately, default=0.0) < 2.0 * STILL_TICKS
            if servo.torque and abs(moved) > STILL_TICKS and not (_sags(servo, moved) or arrives or swings):
                self._violate(invariant, now_s, i, f"still moving, {abs(moved) * TICK_DEG:.1f} deg in a tick: {why}")

    def _is_weak(self, i: int, servo: Servo) -> bool:
        """Whether it was left with a part of its strength by a program that died."""
        return servo.limit < self._arm.servos[i].full_limit

    def _watch_dead(
        self, now_s: float, servos: Sequence[Servo], before: Sequence[Servo], shafts_then: Sequence[float]
    ) -> None:
        self._watch_rest(now_s, servos, before, "lead", "the program is dead")
        for i, (servo, shaft) in enumerate(zip(servos, shafts_then, strict=True)):
            moved = abs(servo.shaft_tick - shaft)
            if servo.torque and moved > DEAD_TICKS:
                self._violate("lead", now_s, i, f"moved {moved * TICK_DEG:.1f} deg after the program died (bound 10)")


def copied(servo: Servo) -> Servo:
    """A servo as it is now."""
    return Servo(servo.torque, servo.goal, servo.speed, servo.limit, servo.shaft_tick, servo.sensed_tick)


def _sags(servo: Servo, moved: float) -> bool:
    """Whether a shaft moves away from its goal: a load does that, a motor does not."""
    left = servo.goal - servo.shaft_tick
    return moved * left < 0.0 and abs(left) > NOISE_TICKS
