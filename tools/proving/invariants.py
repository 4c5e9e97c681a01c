"""The invariants of an arm under control, judged by its servos.

Rules:

1. Evidence is what arrives at the servos: packets that write, the registers before and after each, the true shafts,
   the replies that reach the host whole. What the program in charge says of itself counts only where an invariant is
   about its word (4, 7 and the rows: what is reported as latched) or lets a user's command through.
2. What the user asked for is evidence too, and so is what was planned to go wrong: an arm that a fault moves (a blocked
   or dead motor, a frozen sensor, a sagging supply) is not judged by how far it is from its goal.
3. Checks are made where something happens: at a write, at a reply, once a tick. A violation is told once for its kind
   and joint, with the instant, the value and the bound. `duties.py` says from when no goal may advance, and why.

| invariant | checked | bound here |
|-|-|-|
| 1 | every goal that arrives | the calibration's limits, and the servo's EEPROM limits |
| 2 | goal steps; goal - shaft each tick | vmax * period + 1 tick from the goal sent before, twice that from the one |
| | | held (a servo may have missed one); 12 deg from the shaft, and from what its sensor says, whatever holds or |
| | | moves it, when a goal goes on. Aside: a goal at the servo's own position, or |
| | | where a joint that something moves said it was |
| 3 | torque 0 -> 1 by a write | 0.6 deg and one tick of noise to a goal of its own; speed not 0; limit 20 %; |
| | | 2 deg to the goal in 500 ms |
| 4 | torque 0 -> 1 by a write | `torque on` within 2 s, and no fault reported since |
| 5 | torque 1 -> 0 by a write | `release` or `teach` in this tick, again until heard limp; within 3 deg (2 ticks |
| | | noise) of rest on the way there, at 20 deg/s; or undoing a torque-on of the last 2 s, |
| | | without ticks in which a servo is not heard; or, of a pair, the one that sees nothing |
| 6 | goals after what stops motion | 200 ms after the matrix's bound; shafts still 500 ms after it |
| 7 | goals while a fault is reported | none after 250 ms, but to rest for heat, voltage and load |
| | `clear` | refused while the cause lasts |
| 8 | goals that change | every servo heard within 250 ms |
| 9 | every write | nothing below address 24 |
| lead | shafts after the program died | still after 250 ms, within 10 deg |
| late | goals but for repeated ones | at most 4 in 250 ms: no burst |
| rows | what is reported after a fault | the matrix's bound, a tick and 0.2 s; a lost reply is asked for again; |
| | | a port that is there again, within 3 s; no torque while a servo's EEPROM is wrong |

11, 13 and 14 need more than one arm's bytes: the user of an episode and the soak tell them by `Judge.found`.
"""

import math
from collections.abc import Sequence, Set

from armctl.sim.faults import Fault
from proving.duties import STOP_S, WORLD_STEP_S
from proving.evidence import Known, Sent, Servo, Strain
from proving.excuses import GARBLES
from proving.goals import AGE_S, BURST, BURST_S, LEAD_TICKS, GoalJudge
from proving.reading import (
    ADVANCING,
    EEPROM_END,
    ENERGISING,
    GOAL,
    HOLDING,
    JOGGING,
    LIMP,
    MOVING,
    MOVING_SPEED,
    OFF,
    POWERED,
    RESTING,
    STARTING,
    TICK_DEG,
    TORQUE_ENABLE,
    Arm,
)
from proving.shafts import copied

# From the last goal that may advance to an arm that is still.
REST_S = 0.3
# Two times are the same if they differ by such a part of a step of the world, for they are rounded.
SAME_STEP = 1e-6
# A bus that is heard again: looked for, identified, and the silent ones of it told.
FOUND_S = 2.5
LATELY_S, AGAIN_TOLD_S = 1.15, 0.5
# And half a second after it the jog is over.
JOGS_S = 0.5 + 0.1 + STOP_S
# Late by the bound of 250 ms, whatever the two readings took.
LATE_S = 0.35
DEAD_S = 0.25
STOPS = frozenset({"hold", "host_lost", "host_silent"})
MOTION_REQUESTS = frozenset({"run", "park", "move", "jog", "resume", "torque_on"})


class Judge(GoalJudge):
    """Watches one arm from its servos' side, and notes what must not be."""

    def __init__(self, arm: Arm, period_s: float, eeprom_limits: Sequence[tuple[int, int]]) -> None:
        super().__init__(arm, period_s, eeprom_limits)
        self._speeds = [joint.speed_units for joint in arm.servos]
        # When last no servo had been heard for some time.
        self._deaf_s = -math.inf
        # In the tick that is reported of.
        self._asked_before: set[str] = set()
        # Whether the program in charge has said anything yet.
        self._spoke = False

    # ------------------------------------------------------------------------------------- what is known

    def plan(self, fault: Fault) -> None:
        """Take note of a fault that will begin, at `begin_s` of the arm's time."""
        self._duties.plan(fault)

    def asked(self, now_s: float, kind: str) -> None:
        """The user (or the host) asks for something."""
        self._asked_s[kind] = now_s
        self._asked_now.add(kind)
        self._adopting = False
        if kind in STOPS or kind in MOTION_REQUESTS:
            self._stopped_s = min(self._stopped_s, now_s) if kind in STOPS else math.inf
        calm = self._mode in (HOLDING, OFF) and not self._code
        if (kind in MOTION_REQUESTS and calm) or (kind == "resume" and self._mode == MOVING):
            self._duties.motion_asked()
        self._clears_and_moves |= kind in MOTION_REQUESTS and "clear" in self._asked_now
        if kind in ("release", "teach"):
            self._duties.nobody_reports()
        if kind in ("release", "teach", "teach_end"):
            self._letting_go = kind
        if kind == "torque_on":
            self._going.clear()
            self._torque_word_s = self._torque_word_s if self._mode == ENERGISING else now_s
        if kind == "torque_on" and (not self._code or "clear" in self._asked_now):
            self._torque_asked_s = now_s
            self._letting_go = ""
        if kind in STOPS or (kind == "pause" and self._mode == MOVING):
            self._duties.must_stop(now_s + self._period_s + STOP_S, f"after `{kind}`", by_clear=False, invariant="6")

    def told_elsewhere(self, now_s: float, index: int) -> None:
        """A good reply told a place where its servo is not."""
        self._duties.told_elsewhere(now_s, index)

    def heard(
        self, now_s: float, index: int, position: int, goal: int | None = None, *, asked_s: float | None = None
    ) -> None:
        """A good reply of a servo has reached the host.

        Args:
            position: Where it says it is [tick].
            asked_s: When its request left the host, and was echoed or not; None: just now.
            goal: The one it tells, of a servo under torque. One that is not from here obliges a program that looks;
                one that this program's next goal replaced before anybody asked the servo is seen by nobody.
        """
        struck_s = math.floor((now_s if asked_s is None else asked_s) / WORLD_STEP_S + SAME_STEP) * WORLD_STEP_S
        echoed = self._duties.lately(struck_s + SAME_STEP * WORLD_STEP_S, {"echo"}, 0.0)
        if echoed and not self._duties.may_be_forged(now_s):
            return  # the host hears itself, unless what it said was cut
        self._heard_s[index], self._told[index] = now_s, position
        if not self._settling():
            self._came[index] = position
        if goal is None:
            self._going.discard(index)
        looks = self._in_charge and self._mode in POWERED and not self._code
        # Nobody can tell a goal that this program sent within a second from one that was lost since.
        ours = {mine for sent_s, mine in self._sent_lately[index] if now_s - sent_s < LATELY_S}
        if (
            goal not in ours | {None, self._sent[index], self._sent_before[index]}
            and self._sent[index] is not None
            and looks
        ):
            self._duties.overruled(now_s, index)

    def reported(self, now_s: float, mode: str, code: str, cause: str = "", codes: Set[str] | None = None) -> None:
        """What the program in charge says after a tick.

        Args:
            code: Of the fault that is latched; empty: none is.
            cause: Why a fault cannot be cleared now, as far as the simulator knows; empty: nothing.
            codes: Of all faults that are told; None: that one.
        """
        codes = (frozenset({code}) if code else frozenset()) if codes is None else codes
        for unless_settling in self._unless_settling if not codes & RESTING.keys() else ():
            self._violate(*unless_settling)
        self._unless_settling.clear()
        if code:
            self._torque_asked_s = -math.inf
        if code and code != self._code:
            self._fault_s = now_s
            if code == "LOST_TORQUE" and "TRIPPED" not in codes:
                self._watch_tripped(now_s)
            if code == "PORT_GONE":
                self._duties.port_gone(now_s)
            wrongly = self._duties.reported(now_s, code)
            for what in () if code == self._again[0] and now_s - self._again[1] < AGAIN_TOLD_S else wrongly:
                self._violate("rows", now_s, -1, f"{what} is reported as {code}")
            if code not in RESTING:
                from_s = now_s + 1.5 * self._period_s + 0.1
                self._duties.must_stop(from_s, f"{code} is latched", by_clear=True, invariant="7")
        if codes & RESTING.keys() - self._codes:
            self._duties.motion_asked()
            self._duties.cleared()
        if self._code and not code:
            self._again = self._code, now_s
            self._duties.cleared()
            if self._clears_and_moves:
                self._duties.motion_asked()
            self._take_over(now_s)
            if cause:
                self._violate("7", now_s, -1, f"{self._code} was cleared although {cause}")
        elif not code and mode in LIMP:
            self._duties.let_go()
        for unless_cleared in self._unless_cleared if code else ():
            self._violate(*unless_cleared)
        self._unless_cleared.clear()
        self._clears_and_moves = False
        self._hear_codes(now_s, mode, codes, bool(MOTION_REQUESTS & self._asked_before))
        self._mode, self._code, self._spoke = mode, code, True
        self._adopting &= mode == OFF  # from now on a fault may send the arm to rest

    def port_back(self) -> None:
        """The program in charge says that a port it lost is there again, and with it what the servos hold by then."""
        self._take_over(self._time_s)
        self._duties.port_back()

    def died(self, now_s: float, servos: Sequence[Servo]) -> None:
        """The program in charge is gone at once; another one will take over."""
        self._letting_go = ""
        self._dead, self._in_charge = (now_s, [servo.shaft_tick for servo in servos]), False
        self._sent = [None] * len(self._sent)
        self._going.clear()
        self._duties.nobody_reports()
        self._duties.port_back()
        self._duties.cleared()
        self._duties.must_stop(now_s, "the program died, and the next one adopts", by_clear=False, invariant="6")
        self._forget_words()
        self._unless_cleared.clear()
        self._unless_settling.clear()
        self._clears_and_moves = False

    def back(self) -> None:
        """Another program is in charge."""
        self._dead, self._in_charge, self._adopting, self._spoke = None, True, True, False
        self._held = [None] * len(self._held)

    # ---------------------------------------------------------------------------------- what is observed

    def wrote(self, now_s: float, sent: Sequence[Sent], before: Sequence[Servo], after: Sequence[Servo]) -> None:
        """One packet of the host that writes has arrived.

        Args:
            sent: What it tells each servo addressed, heard or not.
            before, after: Every servo then, in joint order.
        """
        for one in sent:
            i, was, now = one.index, before[one.index], after[one.index]
            if one.address < EEPROM_END:
                self._violate("9", now_s, i, f"a write to address {one.address}: EEPROM")
            speed, goal = one.value(MOVING_SPEED), one.value(GOAL)
            if speed is not None and not 1 <= speed <= self._speeds[i]:
                self._violate("3" if speed == 0 else "2", now_s, i, f"speed {speed} (bound 1 to {self._speeds[i]})")
            if goal is not None:
                self._goal(now_s, i, goal, before)
                lately = self._sent_lately[i]
                if not (lately and self._is_again(now_s, *lately[-1], goal)):
                    lately.append((now_s, goal))
                if sum(now_s - sent_s < BURST_S for sent_s, _ in lately) > BURST:
                    self._violate("late", now_s, i, f"more than {BURST} goals in {BURST_S} s")
                self._missed[i] = 0 if now.goal == goal else self._missed[i] + 1
            if now.torque and not was.torque:
                self._energised(now_s, i, now)
            elif now.torque and now.limit > was.limit:
                self._watch_ramp(now_s, i, now)
            elif was.torque and not now.torque:
                self._sent[i] = None
            if one.value(TORQUE_ENABLE) == 0:
                self._told_off(now_s, i, before)

    def _alive(self) -> bool:
        return self._in_charge

    def ticked(self, now_s: float, servos: Sequence[Servo], strains: Sequence[Strain] = ()) -> None:
        """Another tick is over (or a period without any program)."""
        last_s, self._time_s = self._time_s, now_s
        gap_s = now_s - last_s - self._period_s
        if gap_s > 0.05:
            self._torque_asked_s += gap_s
        mode = OFF if self._asked_now & {"release", "teach"} else self._mode
        self._asked_now, self._asked_before = self._still_waits(now_s), self._asked_now
        known = Known(mode, bool(self._code), self._in_charge)
        self._duties.tick(last_s, now_s, servos, known)
        self._late_s = now_s if gap_s > LATE_S else self._late_s
        if gap_s > LATE_S and self._mode in ADVANCING:
            from_s = now_s + 1.5 * self._period_s
            self._duties.must_stop(from_s, f"a tick came {gap_s:.2f} s late", by_clear=False, invariant="6")
        if self._mode == JOGGING and now_s - self._asked_s.get("jog", now_s) > JOGS_S + max(0.0, gap_s):
            self._violate("status", now_s, -1, "the arm is told to be jogged, and nobody asks for it")
        if now_s - max(self._heard_s) > AGE_S:
            self._deaf_s = now_s
        for what, by_name in self._duties.overdue(now_s):
            if by_name and now_s - self._deaf_s < FOUND_S:
                continue  # of a bus that is not heard at all there is nothing more to tell
            text = f"{what}, and nobody reports it" + (f" beside {self._code}" if by_name else "")
            self._violate("faults" if by_name else "rows", now_s, -1, text)
        self._watch_standing(now_s, servos, strains)
        self._lately.append([servo.shaft_tick for servo in self._before or servos])
        before, self._before = self._before, [copied(servo) for servo in servos]
        for i, servo in enumerate(servos):
            ours = (self._sent[i], self._sent_before[i], before[i].goal if before else servo.goal)
            if servo.goal not in ours and self._duties.may_be_forged(now_s):
                self._duties.forged(now_s, i)
            if self._held[i] is None or not self._duties.other_writer(now_s, i):
                self._held[i] = servo.goal if servo.torque else None
            if not servo.torque:
                self._enabled.pop(i, None)
                self._far_s[i] = math.inf
                continue
            away = abs(servo.goal - servo.shaft_tick)
            # It is told of, or no program has taken it over and said so, which a bad line delays: it cannot hold.
            begins = self._adopting or self._mode == STARTING
            waits = not self._in_charge or not self._spoke or (begins and self._duties.lately(now_s, GARBLES))
            weak = self._is_weak(i, servo) and (bool(self._codes) or waits)
            if away > LEAD_TICKS and not weak and not self._unknown(now_s, i):
                # One that kept its torque while the others lost theirs cannot hold the arm.
                rule = "limp" if self._mode in LIMP or self._code == "NOT_LIMP" else "2"
                self._violate(rule, now_s, i, f"{away * TICK_DEG:.1f} deg from its goal (bound 12)")
            if before:
                self._watch_strain(now_s, i, min(abs(before[i].goal - at) for at in (servo.sensed_tick, self._told[i])))
            if i in self._enabled:
                self._watch_jump(now_s, i, servo)
        if before and gap_s <= 0.05:
            if not self._settling():
                for duty in self._duties.in_force(last_s, now_s, REST_S):
                    self._watch_rest(now_s, servos, before, duty.invariant, duty.why)
            if self._dead is not None and self._duties.excused(now_s):
                self._dead = (self._dead[0], [servo.shaft_tick for servo in servos])
            elif self._dead is not None and now_s - self._dead[0] > DEAD_S:
                self._watch_dead(now_s, servos, before, self._dead[1])
