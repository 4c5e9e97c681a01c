"""Torque that comes on and goes off, and goals that are not this program's: invariants 3, 4 and 5 at the packets."""

import math
from collections.abc import Sequence

from proving.evidence import Servo
from proving.excuses import GARBLES
from proving.reading import ENERGISING, FULL_LIMIT, PAIR_ROOM, PARKING, RESTING, TICK_DEG, TICK_MAX, Arm
from proving.shafts import CORRECTION_DEG, NOISE_TICKS
from proving.standing import StandingJudge

# A goal this near to the servo's own position asks for no motion.
HERE_TICKS = 0.6 / TICK_DEG + NOISE_TICKS
SOFT_LIMIT = 0.2 * FULL_LIMIT
# More than this no servo has so soon after torque came on.
FIRM_LIMIT, FIRM_S = 0.9 * FULL_LIMIT, 0.35
REST_TICKS = 3.0 / TICK_DEG + 2.0
# One that was led off farther stays where it is.
LED_TICKS = 12.0 / TICK_DEG + NOISE_TICKS
# After so long a write that nobody acknowledged is sent once more.
AGAIN_S, AGAIN_LATE_S = 0.006, 0.04
# A shaft is known by its readings of so long; by how much a horn slips at most.
SETTLES_S, SLIP_TICKS = 0.5, 25.0
# A torque-on takes so long at most, without the ticks in which a servo is not heard.
ASKED_S = 2.0
# How long a `clear` may wait until every servo is identified.
CLEARS_S = 3.0


class TorqueJudge(StandingJudge):
    """Watches who gets torque, when and how."""

    def __init__(self, arm: Arm, period_s: float) -> None:
        super().__init__(arm, period_s)
        n = len(arm.servos)
        self._rest = [joint.rest_tick for joint in arm.servos]
        # Goals of the program in charge, while their servos have torque; and those before them: what a servo holds
        # that missed one.
        self._sent: list[int | None] = [None] * n
        self._sent_before: list[int | None] = [None] * n
        # What each servo under torque held before another program wrote to it.
        self._held: list[int | None] = [None] * n
        self._limits = [(joint.low, joint.high) for joint in arm.servos]
        # Where each servo said it was.
        self._told = [0] * n
        # Where each was before anything sent the arm to rest.
        self._came = [0] * n
        # Whose EEPROM forbids torque.
        self._unfit: set[int] = set()
        # When the last tick was over.
        self._time_s = -math.inf
        # In this tick.
        self._asked_now: set[str] = set()
        self._torque_asked_s = -math.inf
        # Who was told to let go, and has not been heard limp since: that is said again.
        self._going: set[int] = set()
        # What this tick's `clear`, if it is granted, makes right.
        self._unless_cleared: list[tuple[str, float, int, str]] = []
        # Whether this tick's `clear` comes together with a request to move.
        self._clears_and_moves = False
        # When a `clear` was asked for that nothing has come of yet.
        self._clear_s = -math.inf
        # Whether there is a program at all.
        self._in_charge = False

    def _still_waits(self, now_s: float) -> set[str]:
        """A `clear` may wait until every servo is identified; what is asked for meanwhile comes in the same tick."""
        if "clear" in self._asked_now and self._clear_s == -math.inf:
            self._clear_s = now_s
        waits = bool(self._code) and now_s - self._clear_s < CLEARS_S
        self._clear_s = self._clear_s if waits else -math.inf
        return {"clear"} if waits else set()

    def garbled(self, begin_s: float, end_s: float) -> None:
        """Packets of the host will come damaged from then to then."""
        self._duties.garbled(begin_s, end_s)

    def led(self, now_s: float) -> None:
        """A hand is at the arm."""
        self._duties.led(now_s)

    def tampered(self, i: int) -> None:
        """Somebody has set a servo's EEPROM such that the arm must not be moved."""
        self._unfit.add(i)

    def mended(self, i: int) -> None:
        """The user has set it right."""
        self._unfit.discard(i)

    def _energised(self, now_s: float, i: int, now: Servo) -> None:
        for unfit in self._unfit:
            text = f"torque came on although {self._names[unfit]} is in wheel mode"
            self._violate("rows", now_s, i, text)
        self._enabled[i] = (now_s, now.shaft_tick)
        twin = self._duties.lately(now_s, {"same_id"}, 0.2)  # whose position it is, nobody can tell
        own = not twin and (now.goal == self._sent[i] or not self._duties.other_writer(now_s, i))
        self._sent[i] = now.goal
        # Its readings before a horn has just slipped are that far off.
        bound = HERE_TICKS + SLIP_TICKS * self._slipped(now_s, SETTLES_S, i)
        if own and abs(now.goal - now.sensed_tick) > bound:
            text = f"torque came on at {now.sensed_tick} with goal {now.goal} (bound {bound:.1f} ticks)"
            self._violate("3", now_s, i, text)
        if now.limit > SOFT_LIMIT or now.speed == 0:
            text = f"torque came on with limit {now.limit} (bound {SOFT_LIMIT:.0f}), speed {now.speed} (not 0)"
            self._violate("soft" if self._duties.may_be_forged(now_s) and now.speed else "3", now_s, i, text)
        for code in self._standing_causes(now_s):
            self._violate("cause", now_s, i, f"torque came on while the cause of {code} stands")
        text = "torque came on, which nobody asked for since the last fault"
        if not self._energising(now_s):
            self._violate("4", now_s, i, text)
        elif self._code:  # asked for behind a `clear` of the same tick
            self._unless_cleared.append(("4", now_s, i, text))

    def _watch_ramp(self, now_s: float, i: int, now: Servo) -> None:
        """Strength comes slowly, after torque."""
        since_s = now_s - self._enabled.get(i, (-math.inf, 0.0))[0]
        if now.limit > FIRM_LIMIT and since_s < FIRM_S:
            self._violate("3", now_s, i, f"limit {now.limit} {since_s:.2f} s after torque came on (bound {FIRM_S})")

    def _slipped(self, now_s: float, within_s: float, i: int) -> bool:
        """Whether a horn at a servo's joint has slipped, or come back, since so long ago."""
        return len({self._duties.lately(at_s, {"pair_mismatch"}, 0.0, i) for at_s in (now_s - within_s, now_s)}) > 1

    def _settling(self) -> bool:
        """Whether a fault is told that may send the arm to rest."""
        return bool(self._codes & RESTING.keys())

    def _energising(self, now_s: float) -> bool:
        """Whether a torque-on may be under way; a tick that is late does not count."""
        late_s = max(0.0, now_s - self._time_s - self._period_s)
        return now_s - late_s - self._torque_asked_s <= ASKED_S

    def _watch_held(self, now_s: float, servos: Sequence[Servo]) -> None:
        for i, servo in enumerate(servos):
            sent, before = known = self._sent[i], self._sent_before[i]
            if not servo.torque or sent is None or before is None or servo.goal in known:
                continue
            away, off = abs(servo.sensed_tick - sent), abs(servo.sensed_tick - servo.goal)
            if away <= LED_TICKS or off > HERE_TICKS:
                self._violate("yields", now_s, i, f"holds goal {servo.goal}, which another program sent; sent: {sent}")

    def _take_over(self, now_s: float) -> None:
        """From now on the goals count that the servos hold, if they are surely not another program's."""
        self._sent = [
            None if not servo.torque or self._duties.other_writer(now_s, i) else servo.goal
            for i, servo in enumerate(self._before or ())
        ] or [None] * len(self._sent)

    def _is_again(self, now_s: float, sent_s: float, sent: int, goal: int) -> bool:
        """Whether a goal is the last one, which nobody acknowledged, once more; later, where replies come late."""
        late = self._duties.lately(now_s, GARBLES, 0.0)
        return goal == sent and now_s - sent_s < (AGAIN_LATE_S if late else AGAIN_S)

    def _known(self, now_s: float, i: int, goal: int, servo: Servo) -> int:
        """From which goal a program goes on that has sent none: the servo's, or the one before another program's."""
        held = self._held[i] if self._duties.other_writer(now_s, i) else None
        return servo.goal if held is None or abs(goal - servo.goal) < abs(goal - held) else held

    def _brings_back(self, now_s: float, i: int, goal: int, was: Servo) -> None:
        """A goal is sent again. One that hardly differs from what the servo holds leads a joint nowhere new."""
        low, high = self._limits[i]
        away = min(abs(goal - min(max(self._told[i], low), high)), abs(goal - was.goal))
        if was.torque and was.goal != goal and away > LED_TICKS:
            self._violate("2", now_s, i, f"brought back {away * TICK_DEG:.1f} deg to goal {goal} (bound 12)")

    def _off_rest(self, i: int, goal: int) -> float:
        """How far a goal is off rest [ticks]; beyond it as its joint comes, what a correction may be does not count.

        Of one that came from as near as that nobody can tell from which side it was to come.
        """
        rest, bent = self._rest[i], CORRECTION_DEG / TICK_DEG
        beyond = any((goal - rest) * (rest - place) > 0.0 for place in (self._told[i], self._came[i]))
        return max(0.0, abs(goal - rest) - bent * (beyond or abs(self._came[i] - rest) <= bent))

    def _led_to_rest(self, now_s: float, i: int, known: int, goal: int) -> None:
        """A goal goes on while a fault is told that may send the arm to rest."""
        text = f"goal {known} -> {goal}"
        goes_back = self._off_rest(i, goal) > self._off_rest(i, known) + self._bend_ticks
        if self._clears_and_moves and (goes_back or not self._may_go_to_rest(now_s)):
            self._unless_cleared.append(("7", now_s, i, f"{text}, as was asked for, {self._code} being latched"))
            return
        self._advances_to_rest(now_s, i, text)
        if goes_back:
            self._violate("7", now_s, i, f"{text}, away from rest, {self._code} being latched")

    def _told_off(self, now_s: float, i: int, before: Sequence[Servo]) -> None:
        """A servo is told to let go."""
        # It is told again until it is seen limp: what it was told may be lost, or another program wake it.
        again = self._letting_go or i in self._going
        if again or self._asked_now & {"release", "teach"} or self._energising(now_s):
            self._going.add(i)
            return
        if self._fights_blindly(i, before):
            self._going.add(i)
            return
        settling = self._mode == PARKING or self._settling()
        slipped = [self._slipped(now_s, self._period_s, k) for k in range(len(before))]
        rows = zip(before, self._told, slipped, self._rest, strict=True)
        away = max(abs((told if hidden else servo.sensed_tick) - rest) for servo, told, hidden, rest in rows)
        if settling and away <= REST_TICKS:
            self._going.add(i)
        elif before[i].torque:
            self._violate("5", now_s, i, f"torque cut, {away * TICK_DEG:.1f} deg from rest, and nobody asked")

    def _fights_blindly(self, i: int, before: Sequence[Servo]) -> bool:
        """Whether a servo is past the end of its sensor, a fault is told, and another one that sees holds its joint."""
        partners = [before[k] for pair in self._arm.pairs if i in pair for k in pair if k != i]
        held = any(servo.torque and abs(servo.sensed_tick - servo.shaft_tick) <= PAIR_ROOM for servo in partners)
        return bool(self._codes) and held and not 0 <= before[i].shaft_tick <= TICK_MAX

    def polled(self, now_s: float, unheard: Sequence[tuple[int, int]], heard: int, asked: int) -> None:
        """Which servos were asked in vain in a tick, each how often, how many answered and how often all were asked.

        Where all answered a tick ago, the first that does not deserves a second try, unless two others had one. A
        torque-on waits for all of them.
        """
        n = len(self._names)
        if unheard and self._all_heard and unheard[0][1] < 2 and asked < n + 2 and self._in_charge:
            self._violate("rows", now_s, unheard[0][0], "a lost reply was not asked for again")
        self._all_heard = heard == n
        if not self._all_heard and self._mode == ENERGISING:
            self._torque_asked_s += self._period_s
