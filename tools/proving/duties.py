"""What a fault, or a word of the user, obliges the program in charge to.

Rules:

1. A duty is an instant from which no goal may advance, until the fault is over (a short silence), a `clear` (what
   latches) or the next motion asked for (a stop, an adoption). Bounds are the fault matrix's, with 200 ms of goals.
2. A program that was not run for a while has so much longer: its duties begin later by the gap.
3. Only what is certain obliges: a fault that strikes now and then may never have struck. What the matrix says of those
   shows in the other invariants.
4. A state that servos tell of (a trip, heat) has to be reported from when one of them was heard, and under its own name
   though another fault is reported already.

What excuses an arm instead stands in `excuses.py`.
"""

import math
from collections.abc import Iterator, Sequence, Set

from armctl.sim.faults import Fault
from proving.evidence import Duty, Expected, Known, Servo
from proving.excuses import GARBLES, MOVES_ARM, MOVES_JOINT, OVER_S, RECOVERING_S, SILENCES, STRAYS, Excuses
from proving.reading import OFF, POWERED, RESTING, STARTING, TICK_DEG, Arm

# From a hold, or a fault's bound, to the last goal that advances: 200 ms of them, and the tick under way.
STOP_S = 0.3
SILENCE_S = 0.2
LATCH_S = 0.5
# Beyond the matrix's bound: a fault may begin just behind a reading, and a silent servo is asked now and then.
REPORT_SLACK_S = 0.3
# An adapter that is in again is found, and its servos are identified, within this time.
BACK_S = 3.0
# A reply that comes so long after a fault's begin tells of it.
HEARD_S = 0.006
# The simulated world goes on in such steps: a fault begins, and ends, with the next one. It may be a step ahead of the
# clock, by which the judge goes.
WORLD_STEP_S = 0.001
BACK_TICKS = 3.5 / TICK_DEG
# A limp joint has found its rest by then.
FALL_S = 6.0
# Surely above an arm's limit, whatever has cooled by the next reading.
HOT_ABOVE_DEGC = 2.0
# Surely below an arm's lowest supply, as the register rounds.
LOW_BELOW_V = 0.5

SILENT = frozenset({"SERVO_SILENT", "BUS_DEAD"})
# Under which codes a fault may be reported.
CODES = {
    "mute": SILENT,
    "dead_bus": SILENT,
    "lost": SILENT,
    "unplug": frozenset({"PORT_GONE"}),
    "trip": frozenset({"TRIPPED"}),
    "brown_out": SILENT | {"LOST_TORQUE", "VOLTAGE"},
    "second_writer": frozenset({"OTHER_WRITER"}),
    "hot": frozenset({"HOT", "TRIPPED"}),
}


class Duties(Excuses):
    """All duties of one arm, beside its excuses."""

    def __init__(self, arm: Arm, period_s: float) -> None:
        super().__init__(arm)
        self._period_s = period_s
        # When each servo was last heard, and when by the tick before: what is heard in a tick, nobody has told yet.
        self.heard_s = [-math.inf] * len(arm.servos)
        self._heard_before_s = list(self.heard_s)
        self._duties: list[Duty] = []
        self._expected: list[Expected] = []
        self._codes: Set[str] = frozenset()
        # By when a port that was reported gone has to be reported back.
        self._back_by_s = math.inf

    def must_stop(
        self,
        from_s: float,
        why: str,
        *,
        until_s: float = math.inf,
        by_clear: bool,
        by_release: bool = False,
        invariant: str,
    ) -> None:
        """Add a duty."""
        self._duties.append(Duty(from_s, until_s, by_clear, invariant, why, by_release))

    def must_report(self, by_s: float, what: str, codes: frozenset[str] = frozenset()) -> None:
        """A fault has to be reported by then, under one of the codes (none: any will do)."""
        self._expected.append(Expected(by_s, what, codes))

    def motion_asked(self) -> None:
        """What only a stop or an adoption forbade is allowed again."""
        self._duties = [duty for duty in self._duties if duty.by_clear]

    def rest_announced(self) -> None:
        """The arm will set off for its rest pose: what stopped it by itself is over, what the user stopped is not."""
        self._duties = [duty for duty in self._duties if not duty.by_clear and duty.why == "after `hold`"]

    def cleared(self) -> None:
        """The user has cleared the fault."""
        self._duties = [duty for duty in self._duties if not duty.by_clear]

    def let_go(self) -> None:
        """The arm is limp on request, and no fault is reported."""
        self._duties = [duty for duty in self._duties if not duty.by_release]

    def reported(self, now_s: float, code: str) -> list[str]:
        """A fault is latched: whichever it is, it was noticed; what was to be reported under another code, if alone."""
        kinds = [fault.kind for _, _, fault in self._faults]
        alone = kinds[0] if len(kinds) == 1 and not self._garbled else "no fault"
        latched = [one for one in self._expected if not one.by_name]
        self._expected = [one for one in self._expected if one.by_name]
        if code == "HOT" and self.lately(now_s, {"hot"}):
            return []
        return [one.what for one in latched if one.what.startswith(alone) and one.codes and code not in one.codes]

    def told(self, codes: Set[str]) -> None:
        """All faults that are reported now."""
        # Nothing can be said of servos that nobody hears, and little where two answer at once: none is taken over then.
        unheard, self._codes = codes & (SILENT | {"PORT_GONE", "BUS_NOISE", "DUPLICATE_ID"}), codes
        if "PORT_GONE" in codes and self._back_by_s < math.inf:
            # A port that is not back hears nobody.
            self._expected = [one for one in self._expected if not one.by_name]
        if codes:
            self._expected = [
                one for one in self._expected if not (one.by_name and (one.codes & codes or (unheard and one.servos)))
            ]

    def port_gone(self, now_s: float) -> None:
        """The port is reported gone: once the adapter is in again it has to be reported back."""
        self._back_by_s = BACK_S + max(
            (end_s for _, end_s, fault in self._faults if fault.kind == "unplug" and end_s > now_s), default=now_s
        )

    def port_back(self) -> None:
        """The port is reported back, or nobody is there to do so."""
        self._back_by_s = math.inf

    def nobody_reports(self) -> None:
        """Nobody is there who could report a fault, or there is no torque any more."""
        self._expected.clear()

    def in_force(self, last_s: float, now_s: float, later_s: float = 0.0) -> Iterator[Duty]:
        """Duties that began at least `later_s` ago; `last_s` is when the program last did something."""
        gap_s = max(0.0, now_s - last_s - self._period_s)
        return (
            duty
            for duty in self._duties
            if duty.from_s + later_s + (gap_s if duty.from_s > last_s else 0.0) <= now_s <= duty.until_s
        )

    def overdue(self, now_s: float) -> list[tuple[str, bool]]:
        """What should have been reported by now, and whether it is its name that lacks; each told once."""
        if self._back_by_s < math.inf and (self.lately(now_s, GARBLES, 0.0) or self.may_be_forged(now_s)):
            self._back_by_s = max(self._back_by_s, now_s + BACK_S)
        if now_s > self._back_by_s:
            self.port_back()
            return [(f"the adapter has been in again for {BACK_S:g} s", False)]
        self._expected = [one for one in self._expected if not self._is_woken(now_s, one)]
        for one in self._expected:
            if one.by_s == math.inf and any(self.heard_s[i] > one.begin_s + HEARD_S for i in one.servos):
                one.by_s = now_s + one.within_s
        # A sag that is over too soon after it could be seen has not lasted.
        self._expected = [
            one for one in self._expected if one.by_s == math.inf or one.by_s < one.until_s + self._period_s
        ]
        due = [one for one in self._expected if one.by_s < now_s and self._could_tell(now_s, one)]
        self._expected = [one for one in self._expected if one not in due]
        self._heard_before_s = list(self.heard_s)
        return [(one.what, one.by_name) for one in due]

    def _is_woken(self, now_s: float, one: Expected) -> bool:
        """Whether a servo that restarted has its torque back from another program, and looks as before."""
        return one.what[:9] == "brown_out" and any(self._written_until_s(now_s, i) > one.begin_s for i in one.servos)

    def _could_tell(self, now_s: float, one: Expected) -> bool:
        """Whether a servo has been heard since what has to be told had lasted long enough, on a line that is well."""
        since_s = one.by_s - REPORT_SLACK_S - self._period_s - HEARD_S
        # What comes beside other bytes, or behind late ones, is rightly not believed.
        strays = self.lately(now_s, STRAYS, 0.0)
        return not one.servos or (not strays and any(self._heard_before_s[i] > since_s for i in one.servos))

    def tick(self, last_s: float, now_s: float, servos: Sequence[Servo], known: Known) -> None:
        """Time has passed, from `last_s`; faults begin and end."""
        gap_s = now_s - last_s - self._period_s
        if gap_s > 0.05:
            for duty in self._duties:
                if duty.from_s > last_s:
                    duty.from_s += gap_s
            for expected in self._expected:
                expected.by_s += gap_s
            self._back_by_s += gap_s
            self._forget_silences(last_s, now_s)
        begun = [planned for planned in self._planned if planned[0] <= now_s]
        if begun:
            self._planned = [planned for planned in self._planned if planned[0] > now_s]
            self._faults += begun
        for begin_s, end_s, fault in begun:
            # What began in a gap nobody was there to see begin.
            begin_s = begin_s if gap_s <= 0.05 else now_s
            if begin_s < end_s:
                self._begin(begin_s, end_s, fault, servos, known)
        for k, (begin_s, end_s, fault) in enumerate(self._faults):
            moves = fault.kind in MOVES_JOINT or fault.kind in MOVES_ARM
            falls = now_s - begin_s < FALL_S and not all(servo.torque for _, servo in self._struck(servos, fault))
            # What is written before a silence is seen after it.
            written_s = fault.begin_s + (fault.duration_s or 0.0) if fault.kind == "second_writer" else -math.inf
            unseen = any(self.heard_s[i] < written_s + self._period_s for i, _ in self._struck(servos, fault))
            unseen |= gap_s > 0.05 and end_s > last_s
            unseen |= written_s > -math.inf and self.lately(now_s, STRAYS, 0.0)
            lately = now_s - max(0.0, gap_s) < end_s + RECOVERING_S
            recovering = unseen or (lately and (falls or self._away(servos, fault)))
            if moves and end_s <= now_s and recovering:
                self._faults[k] = (begin_s, now_s, fault)
        self._duties = [duty for duty in self._duties if duty.until_s + 1.0 > now_s]
        self._over = [fault for fault in (*self._over, *self._faults) if now_s - OVER_S < fault[1] <= now_s]
        self._faults = [fault for fault in self._faults if fault[1] + RECOVERING_S > now_s]
        self._garbled = [garbled for garbled in self._garbled if garbled[1] + RECOVERING_S > now_s]

    def _forget_silences(self, last_s: float, now_s: float) -> None:
        """A silence, or a sag, that ends while the program is late was a short one for it, and is over."""
        for begin_s, end_s, fault in self._faults:
            if (fault.kind in SILENCES or fault.probability == 0.0) and end_s <= now_s and last_s - begin_s < LATCH_S:
                what = _named(fault, end_s - begin_s)
                self._duties = [duty for duty in self._duties if duty.why != what]
                self._expected = [expected for expected in self._expected if expected.what != what]

    def _begin(self, begin_s: float, end_s: float, fault: Fault, servos: Sequence[Servo], known: Known) -> None:
        """What a fault obliges the program to, by the rows of the matrix."""
        if not known.alive:  # the next program begins by looking
            return
        if fault.kind == "hot":  # it sets the temperature anew
            mine = {i for i, _ in self._struck(servos, fault)}
            self._expected = [one for one in self._expected if not (one.what[:3] == "hot" and mine & {*one.servos})]
        # A second servo may answer in the name of one that does not.
        both = any(other.kind == "same_id" and begin < end_s for begin, _, other in (*self._faults, *self._planned))
        certain = fault.probability == 1.0 and fault.count is None and not (both and fault.kind in SILENCES)
        lasts_s, value = end_s - begin_s, fault.value or 0.0
        powered = known.mode in POWERED and not known.latched
        stop_within_s = report_within_s = None
        until_s = math.inf
        if fault.kind in SILENCES and certain and lasts_s > SILENCE_S:
            stop_within_s = SILENCE_S
            # A program that starts waits until every servo has answered.
            if lasts_s > LATCH_S + REPORT_SLACK_S and known.mode != STARTING:
                report_within_s = None if known.mode == OFF else LATCH_S
            else:
                until_s = end_s
        elif fault.kind == "unplug":
            stop_within_s = report_within_s = self._period_s
            if known.latched and lasts_s <= 2.0 * self._period_s:
                # Nothing latches over a fault; an arm that it sends to rest goes on, as after a short silence.
                until_s = end_s
            if self._back_by_s < math.inf:
                self._back_by_s = max(self._back_by_s, end_s + BACK_S)
        elif not (powered or (known.latched and any(servo.torque for servo in servos))):
            return
        elif fault.kind == "trip" and certain and self._takes_torque(servos, fault) and "NOT_LIMP" not in self._codes:
            stop_within_s = report_within_s = self._period_s
        elif fault.kind == "brown_out" and certain and "NOT_LIMP" not in self._codes:
            stop_within_s, report_within_s = SILENCE_S, LATCH_S
        elif fault.kind == "brown_out" and fault.probability == 0.0:
            if lasts_s > RESTING["VOLTAGE"] + REPORT_SLACK_S and value < self._arm.voltage_V[0] - LOW_BELOW_V:
                report_within_s = RESTING["VOLTAGE"] + self._period_s
        elif fault.kind == "hot" and certain and value >= self._arm.temperature_limit_degC + HOT_ABOVE_DEGC:
            report_within_s = RESTING["HOT"] + self._period_s
        what = _named(fault, lasts_s)
        if stop_within_s is not None and (powered or fault.kind not in MOVES_ARM):
            from_s = begin_s + stop_within_s + STOP_S
            by_clear, by_release = until_s == math.inf, fault.kind in MOVES_ARM
            self.must_stop(from_s, what, until_s=until_s, by_clear=by_clear, by_release=by_release, invariant="6")
        if report_within_s is None:
            return
        within_s, servos_struck = report_within_s + REPORT_SLACK_S, tuple(i for i, _ in self._struck(servos, fault))
        for by_name in (False, True):
            if by_name or not known.latched:
                expected = Expected(begin_s + within_s, what, CODES[fault.kind], by_name, begin_s, within_s)
                if fault.kind not in SILENCES and fault.kind != "unplug":
                    expected.by_s, expected.servos = math.inf, servos_struck
                    expected.until_s = end_s if fault.probability == 0.0 else math.inf
                self._expected.append(expected)

    def overruled(self, now_s: float, i: int) -> None:
        """A servo under torque has a goal that the program in charge did not send."""
        until_s = self._written_until_s(now_s, i)
        if until_s > now_s + 0.15 and not any("second_writer" in one.what for one in self._expected):
            what = f"second_writer, until {until_s:.2f} s"
            self.must_stop(now_s + self._period_s + STOP_S, what, by_clear=True, invariant="6")
            within_s, codes = self._period_s + REPORT_SLACK_S, CODES["second_writer"]
            self._expected.append(Expected(now_s + within_s, what, codes, False, now_s, within_s, (i,)))

    def _struck(self, servos: Sequence[Servo], fault: Fault) -> Iterator[tuple[int, Servo]]:
        return (
            (i, servo)
            for i, (servo, servo_id) in enumerate(zip(servos, self._servo_ids, strict=True))
            if fault.servo_id in (None, servo_id)
        )

    def _away(self, servos: Sequence[Servo], fault: Fault) -> bool:
        """Whether a joint that was struck is not back at its goal."""
        return any(
            servo.torque and abs(servo.goal - servo.shaft_tick) > BACK_TICKS for _, servo in self._struck(servos, fault)
        )

    def _takes_torque(self, servos: Sequence[Servo], fault: Fault) -> bool:
        return any(servo.torque or servo.limit == 0 for _, servo in self._struck(servos, fault))


def _named(fault: Fault, lasts_s: float) -> str:
    return f"{fault.kind} for {lasts_s:.2f} s"
