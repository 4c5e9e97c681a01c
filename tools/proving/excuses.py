"""What strikes an arm, and what that excuses.

A fault that moves joints (a dead motor, a frozen sensor, a sagging supply) or a hand excuses their motion until they
are back at their goals. Damaged packets, and those of another program, excuse a goal that the program in charge did not
send.
"""

import math
from collections.abc import Set

from armctl.sim.faults import Fault
from proving.reading import Arm

# For so long a fault still excuses what its joints do, once they are back at their goals.
RECOVERING_S = 1.0
# And so long ago something may still be told of it.
OVER_S = 4.0
# For so long a goal that damage made is excused: one that repeats a good one is to be there long before.
FORGED_S = 1.0

# Faults by which a servo's shaft leaves its goal, or its goal the program's.
MOVES_JOINT = frozenset({"stuck_joint", "blocked_joint", "frozen_sensor", "second_writer", "pair_mismatch"})
# Faults that take torque from some and thereby load from others.
MOVES_ARM = frozenset({"brown_out", "trip"})
# What spoils so many replies that nobody can tell servos from each other.
GARBLES = frozenset(
    {"late", "latency", "duplicated", "garbage", "echo", "wrong_id", "corrupted", "truncated", "same_id"}
)
SILENCES = frozenset({"mute", "dead_bus", "lost"})
# By these a reply may come that a program rightly does not believe.
STRAYS = frozenset({"late", "latency", "duplicated", "garbage", "echo", "wrong_id", "corrupted", "truncated"})


class Excuses:
    """What goes wrong with one arm, as far as it is planned or was noticed."""

    def __init__(self, arm: Arm) -> None:
        self._arm, self._servo_ids = arm, arm.servo_ids
        # Begin and end of every fault not begun yet.
        self._planned: list[tuple[float, float, Fault]] = []
        self._faults: list[tuple[float, float, Fault]] = []
        # Until when damaged packets may have told a servo what nobody sent.
        self._forged_until_s = [-math.inf] * len(arm.servos)
        # Until when another servo's replies have misled whoever asked each one.
        self._misled_until_s = [-math.inf] * len(arm.servos)
        # Begin and end of damage to packets of the host.
        self._garbled: list[tuple[float, float]] = []
        # Those that are over since a short while.
        self._over: list[tuple[float, float, Fault]] = []
        # When a hand was last at the arm.
        self.hand_s = -math.inf

    def garbled(self, begin_s: float, end_s: float) -> None:
        """What the host says may come damaged from then to then."""
        self._garbled.append((begin_s, end_s))

    def forged(self, now_s: float, i: int) -> None:
        """A damaged packet has told a servo what nobody sent."""
        self._forged_until_s[i] = now_s + FORGED_S

    def may_be_forged(self, now_s: float) -> bool:
        """Whether packets of the host come damaged, or did just now."""
        return any(begin_s <= now_s < end_s + RECOVERING_S for begin_s, end_s in self._garbled)

    def plan(self, fault: Fault) -> None:
        """Take note of a fault that will begin, at `begin_s` of the arm's time."""
        end_s = math.inf if fault.duration_s is None else fault.begin_s + fault.duration_s
        self._planned.append((fault.begin_s, end_s, fault))

    def led(self, now_s: float) -> None:
        """A hand is at the arm."""
        self.hand_s = now_s

    def told_elsewhere(self, now_s: float, i: int) -> None:
        """A servo was told to be far from where it is."""
        if self.lately(now_s, {"same_id"}, 0.0, i):
            self._misled_until_s[i] = now_s + RECOVERING_S

    def lately(self, now_s: float, kinds: Set[str], within_s: float = OVER_S, i: int | None = None) -> bool:
        """Whether a fault of some kinds strikes a servo (None: any), or did so long ago at most."""
        return any(
            fault.kind in kinds
            and begin_s <= now_s < end_s + within_s
            and (i is None or self._arm.one_joint(i, fault.servo_id))
            for begin_s, end_s, fault in (*self._faults, *self._planned, *self._over)
        )

    def may_be_lost(self, now_s: float) -> bool:
        """Whether goals may not have reached a servo, or told what it holds."""
        return self.may_be_forged(now_s) or self.lately(now_s, {"mute", "dead_bus", "lost", "unplug"}, OVER_S)

    def any_forged(self, now_s: float) -> bool:
        """Whether a damaged packet told some servo what nobody sent."""
        return now_s < max(self._forged_until_s) + RECOVERING_S

    def may_restart(self) -> bool:
        """Whether a servo may restart, or have restarted just now."""
        return any(fault.kind == "brown_out" for _, _, fault in (*self._faults, *self._planned))

    def other_writer(self, now_s: float, i: int) -> bool:
        """Whether another program may just have written a joint's goal."""
        return self._written_until_s(now_s, i) > -math.inf or now_s < self._forged_until_s[i]

    def writer_in_force(self, now_s: float, within_s: float) -> bool:
        """Whether another program writes to the arm, or did so long ago at most."""
        return any(
            fault.kind == "second_writer" and begin_s <= now_s < fault.begin_s + (fault.duration_s or 0.0) + within_s
            for begin_s, _, fault in (*self._faults, *self._planned)
        )

    def _written_until_s(self, now_s: float, i: int) -> float:
        """When the last of the other programs ends that write to a joint, or did just now."""
        ends = (
            end_s
            for begin_s, end_s, fault in (*self._faults, *self._planned)
            if fault.kind == "second_writer" and begin_s <= now_s and fault.servo_id in (None, self._servo_ids[i])
        )
        return max(ends, default=-math.inf)

    def excused(self, now_s: float, i: int | None = None) -> bool:
        """Whether a fault, or a hand, may be what moves a joint; None: whichever, for it shakes the others."""
        forged_s = max(self._forged_until_s) if i is None else self._forged_until_s[i]
        return now_s < max(self.hand_s + RECOVERING_S, forged_s) or any(
            begin_s <= now_s < end_s + RECOVERING_S
            and (
                fault.kind in MOVES_ARM
                or (fault.kind in MOVES_JOINT and (i is None or self._arm.one_joint(i, fault.servo_id)))
            )
            for begin_s, end_s, fault in (*self._faults, *self._planned)
        )

    def replaced(self, now_s: float, i: int) -> bool:
        """Whether another servo answers in the name of one that does not: whose position it is, nobody can tell.

        It surely does where the one's replies are all lost, and where a reply told another place than its own.
        """
        if now_s < self._misled_until_s[i]:
            return True
        here = [one for one in (*self._faults, *self._planned) if self._arm.one_joint(i, one[2].servo_id)]
        others = [(begin_s, end_s) for begin_s, end_s, fault in here if fault.kind == "same_id"]
        silent = [
            (begin_s, end_s)
            for begin_s, end_s, fault in here
            if fault.kind in SILENCES and fault.probability == 1.0 and fault.count is None
        ]
        both = [(max(a, c), min(b, d)) for a, b in others for c, d in silent]
        return any(begin_s < end_s and begin_s <= now_s < end_s + RECOVERING_S for begin_s, end_s in both)
