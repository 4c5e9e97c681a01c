"""Goals that arrive: invariants 1, 2, 6 and 8 at the packets, as `invariants.py` states them."""

import math
from collections import deque
from collections.abc import Sequence

from proving.duties import STOP_S
from proving.evidence import Servo
from proving.reading import JOGGING, PARKING, TICK_DEG, Arm
from proving.shafts import BLOCKED_TICKS, NOISE_TICKS
from proving.torque import HERE_TICKS, TorqueJudge

LEAD_TICKS = 12.0 / TICK_DEG
REST_SPEED_DEG_S = 20.0
AGE_S = 0.25
BURST_S, BURST = 0.25, 4
# A heartbeat counts for 80 ms; then the arm stops.
JOG_S = 0.08 + 0.1 + STOP_S


class GoalJudge(TorqueJudge):
    """Watches where goals lead, how fast, and whether they may."""

    def __init__(self, arm: Arm, period_s: float, eeprom_limits: Sequence[tuple[int, int]]) -> None:
        super().__init__(arm, period_s)
        self._limits = [
            (max(low, joint.low), min(high, joint.high))
            for joint, (low, high) in zip(arm.servos, eeprom_limits, strict=True)
        ]
        # A second servo may come a tick nearer to its place beside the first one, and is rounded by itself.
        self._aligns = [2.0 if joint.beside >= 0 else 0.0 for joint in arm.servos]
        self._steps = [
            joint.speed_deg_s * period_s / TICK_DEG + self._bend_ticks + more
            for joint, more in zip(arm.servos, self._aligns, strict=True)
        ]
        self._rest_step = REST_SPEED_DEG_S * period_s / TICK_DEG + self._bend_ticks
        self._sent_lately: list[deque[tuple[float, int]]] = [deque(maxlen=40) for _ in arm.servos]
        # When each servo was last heard.
        self._heard_s = self._duties.heard_s
        # How many goals in a row each servo may have missed, for they were damaged.
        self._missed = [0] * len(arm.servos)
        # What is right if this tick's report tells of a fault that sends the arm to rest at once.
        self._unless_settling: list[tuple[str, float, int, str]] = []
        # Whether another program is taking over, and nobody has asked it for anything yet.
        self._adopting = False

    def _goal(self, now_s: float, i: int, goal: int, before: Sequence[Servo]) -> None:
        was = before[i]
        low, high = self._limits[i]
        if not low <= goal <= high:
            self._violate("1", now_s, i, f"goal {goal} outside {low} to {high}")
        last = self._sent[i]
        self._sent[i], self._sent_before[i] = goal, last
        woken = self._duties.other_writer(now_s, i)
        if self._adopting and not woken and not any(_given_up(servo) for servo in before):
            self._violate("6", now_s, i, "a goal from a program that has only just adopted the arm")
        known = self._known(now_s, i, goal, was) if last is None else last
        if last is None:  # what was adopted is its own goal from now on
            self._sent_lately[i].append((now_s - BURST_S, known))
        if "clear" in self._asked_now and abs(goal - was.goal) < abs(goal - known):
            known = was.goal  # it was granted: from there on it goes on from the goals that the servos hold
        if goal in (known, was.goal) or not was.torque:  # what a servo holds already moves nothing
            self._brings_back(now_s, i, goal, was)
            return
        age_s = now_s - self._heard_s[i]
        if age_s > AGE_S:
            self._violate("8", now_s, i, f"a goal {age_s:.3f} s after its last reply (bound {AGE_S})")
        # Since the reading it was computed from a moving shaft has gone on: 25 ms, a quarter of a tick's way.
        moved = abs(was.shaft_tick - self._before[i].shaft_tick) if self._before else 0.0
        here, told = (min(max(tick, low), high) for tick in (was.sensed_tick, self._told[i]))
        thrown = self._duties.excused(now_s, i)
        near = HERE_TICKS + moved / (1.0 if thrown else 4.0)
        if abs(goal - here) > near and not (thrown and goal == told):
            self._advance(now_s, i, known, goal, was.goal)
        ahead = abs(goal - told)
        if ahead > max(LEAD_TICKS + NOISE_TICKS, abs(known - told)):
            text = f"goal {goal}, {ahead * TICK_DEG:.1f} deg ahead of its servo, which is at {told} (bound 12)"
            self._violate("2", now_s, i, text)

    def _advance(self, now_s: float, i: int, known: int, goal: int, held: int) -> None:
        """A goal that moves a servo, from the one sent before, or held by the servo."""
        step, way = self._steps[i], abs(goal - known)
        if way > step or (abs(goal - held) > (2.0 + self._missed[i]) * step and not self._duties.excused(now_s, i)):
            self._violate("2", now_s, i, f"goal {goal} after {known} sent, {held} held (bound {step:.1f} ticks)")
        self._advanced.append((i, f"goal {known} -> {goal}"))
        for duty in self._duties.in_force(self._time_s, now_s):
            text = f"goal {known} -> {goal}, {now_s - duty.from_s:.2f} s too late: {duty.why}"
            if "clear" in self._asked_now and (duty.by_clear or self._clears_and_moves):
                self._unless_cleared.append((duty.invariant, now_s, i, text))
            elif not duty.by_clear and not self._code:
                self._unless_settling.append((duty.invariant, now_s, i, text))
            else:
                self._violate(duty.invariant, now_s, i, text)
        if self._mode == JOGGING and (since_s := now_s - self._asked_s["jog"]) > JOG_S:
            self._violate("6", now_s, i, f"jogs on {since_s:.2f} s after the last heartbeat (bound {JOG_S:.2f})")
        rest_step = self._rest_step + self._aligns[i]
        if self._mode == JOGGING and way > rest_step:
            self._violate("2", now_s, i, f"goal {known} -> {goal} in a jog (bound {rest_step:.1f})")
        for j, heard_s in enumerate(self._heard_s):
            if now_s - heard_s > AGE_S:
                self._violate("8", now_s, j, f"the arm moves on, {now_s - heard_s:.3f} s after its last reply")
        settling = self._settling()
        since_s = now_s - max(self._fault_s, self._asked_s.get("park", -math.inf))
        if (settling or self._mode == PARKING) and since_s > STOP_S:
            if way > rest_step:
                self._violate("5", now_s, i, f"goal {known} -> {goal} on the way to rest (bound {rest_step:.1f})")
            if settling:
                self._led_to_rest(now_s, i, known, goal)


def _given_up(servo: Servo) -> bool:
    """Whether a servo is so far from its goal that the goal may be given up for its position."""
    return servo.torque and abs(servo.goal - servo.sensed_tick) > BLOCKED_TICKS - 4.0
