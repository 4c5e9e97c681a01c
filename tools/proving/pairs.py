"""What the judge asks of two servos that turn one joint: they agree, or it is told; and at rest none fights the other.

| rule | from when | bound |
|-|-|-|
| told | both read farther apart than an honest pair may, and are heard | PAIR_MISMATCH within 3 s |
| fight | both have torque, the joint stands, no goal changes | 0.2 of the output that they do not share, for 3 s |

An arm that is told to be left to another program is not relieved; that its servos do not agree is told all the same.
"""

import math
from collections.abc import Iterator, Sequence

from proving.evidence import Servo, Strain
from proving.reading import PAIR_PUSH, PAIR_ROOM, Arm

# Noise and rounding of two readings; the load's own rounding, and what friction makes of it.
NOISE_TICKS, NOISE_RATIO = 3.0, 0.03
LASTS_S = 3.0
STILL_TICKS = 0.5


class PairWatch:
    """The pairs of one arm."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        # Since when each pair reads apart, and fights.
        self._apart_s, self._fight_s = [math.inf] * len(arm.pairs), [math.inf] * len(arm.pairs)
        # When some pair last did not agree, well or hardly.
        self.off_s = -math.inf

    def look(
        self,
        now_s: float,
        servos: Sequence[Servo],
        before: Sequence[Servo],
        strains: Sequence[Strain],
        well: Sequence[bool],
        *,
        told: bool,
        left: bool,
    ) -> Iterator[tuple[int, str]]:
        """Which joint's servos do what must not be, and what.

        Args:
            well: Of every servo, whether it is heard, and nothing else moves or blinds it.
            told: Whether the mismatch is told.
            left: Whether the arm is told to be left to another program, which has the say.
        """
        for k, (first, second) in enumerate(self._arm.pairs):
            a, b = servos[first], servos[second]
            turned = self._arm.servos[first].direction * self._arm.servos[second].direction
            apart = abs(b.sensed_tick - self._arm.servos[second].beside_tick(a.sensed_tick))
            works = strains[first].output, turned * strains[second].output
            against = abs(works[0] - works[1]) / 2.0 if a.torque and b.torque else 0.0
            if apart > PAIR_ROOM - NOISE_TICKS or against > PAIR_PUSH - NOISE_RATIO:
                self.off_s = now_s
            judged = well[first] and well[second]
            is_apart = judged and not told and apart > PAIR_ROOM + NOISE_TICKS
            self._apart_s[k] = min(self._apart_s[k], now_s) if is_apart else math.inf
            stands = bool(before) and all(
                abs(servos[i].shaft_tick - before[i].shaft_tick) < STILL_TICKS and servos[i].goal == before[i].goal
                for i in (first, second)
            )
            fights = judged and stands and against > PAIR_PUSH + NOISE_RATIO and not (told and left)
            self._fight_s[k] = min(self._fight_s[k], now_s) if fights else math.inf
            if now_s - self._apart_s[k] > LASTS_S:
                yield first, f"its servos read {apart:.0f} ticks apart for {LASTS_S:g} s, and nobody tells it"
            if now_s - self._fight_s[k] > LASTS_S:
                yield first, f"its servos push against each other with {against:.2f} for {LASTS_S:g} s, at rest"
