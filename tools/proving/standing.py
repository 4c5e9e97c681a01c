"""What an arm does while it stands, and whether what is told of it is true: the part of the judge that compares words.

| rule | checked | bound here |
|-|-|-|
| status | the mode that is told, once every servo is heard | `off`, `teaching`: no torque; under torque: all of it, |
| | | within 5 such ticks; `holding`: no goal advances |
| rows, held | a fault that is newly told | its cause is there, or was just now; a lost goal is no other program |
| faults | every fault that is certain | under its own name among all that are told, another one being latched |
| stall | output at standstill beyond what gravity asks for, with 150 g at the tool or not | 0.42 for 3.5 s; 2 s |
| | | after a latch, 1.2 s after a stop |
| rest | the way to rest for heat, supply, load | after a cause that lasted (2, 0.5, 2 s), 3 s after it was told |
| yields | goals held while OTHER_WRITER is told, its writer gone for 0.6 s | this program's, or OVERRULED is told |
| limp | what `release` answers | every servo is without torque, or it is refused |
| cause | torque that comes on | not while the cause of a rest stands |
"""

import math
from collections.abc import Iterator, Mapping, Sequence, Set

from proving.duties import SILENT, WORLD_STEP_S
from proving.evidence import Servo, Strain
from proving.excuses import OVER_S, RECOVERING_S, STRAYS
from proving.pairs import PairWatch
from proving.reading import ANNOUNCED_S, FULL_LIMIT, HOLDING, LIMP, OFF, POWERED, RESTING, STARTING, TICK_DEG, Arm
from proving.shafts import STILL_TICKS, ShaftJudge

# More than gravity asks for: what is a fault, and what stiction may keep.
PUSH = 0.3 + 0.12
LEAST_PUSH = 0.2
# What a gripper may hold with.
GRIP = 0.5
PUSH_S, PUSH_STOPPED_S, PUSH_WELL_S, PUSH_BLOCKED_S = 3.5, 2.0, 1.2, 1.0
# Of a cause that has to last: the reading before it, and the one that ends it.
SLACK_S = 0.25
# Ticks in which all servos are heard and what is told of torque is wrong.
WRONG_TICKS = 5
# A request that is not served is refused within two ticks.
REFUSED_S = 0.25
HEARD_LATELY_S = 0.35
WRITER_GONE_S = 0.6
# From when a servo's silence is told, and by when.
SILENT_S, UNHEARD_TICKS = 0.5, 6
# While the servos are identified: that takes longer where replies come damaged or late, and tells at its end.
STARTING_S = 8.0
BLOCKED_DEG = 6.0
# Of a motor's output, as the load's own rounding has it; and by when it is told of, lasting 2 s.
OVERLOADED, OVERLOADED_S = 0.805, 2.6
# Of a voltage as servos tell it.
ROUNDED_V = 0.06
# For so long a cause that is over may still be told of.
JUST_NOW_S = 1.5
# To what a servo tells its supply.
SENSED_V = 0.1
# Above this a servo tells its overheating by itself.
OVERHEAT_DEGC = 70.0


class StandingJudge(ShaftJudge):
    """Watches an arm that stands, and what is told of it."""

    def __init__(self, arm: Arm, period_s: float) -> None:
        super().__init__(arm, period_s)
        n = len(arm.servos)
        # When a tick last came late.
        self._late_s = -math.inf
        # When each request was last asked; the one for a limp arm that was not refused, nor answered that it is.
        self._asked_s: dict[str, float] = {}
        self._letting_go = ""
        # All faults that are told; since when the worst of them is.
        self._codes: Set[str] = frozenset()
        self._fault_s = -math.inf
        # Which fault was cleared last, and when: told again at once it is that one still.
        self._again = "", -math.inf
        # Since when one is told that may send the arm to rest.
        self._announced_s = math.inf
        # Since when each servo pushes against something; when any last worked more than gravity asks for.
        self._push_s = [math.inf] * n
        self._pushed_s = -math.inf
        # Since when, and when last, some servo has been too hot, or its supply out of range.
        self._since_s = {"HOT": math.inf, "VOLTAGE": math.inf}
        self._last_s = {"HOT": -math.inf, "VOLTAGE": -math.inf}
        # For how long then, counting from when servos may have told so.
        self._may_since_s = {"HOT": math.inf, "VOLTAGE": math.inf}
        self._lasted_s = {"HOT": 0.0, "VOLTAGE": 0.0}
        self._hottest_degC = 0.0
        # When the torque was asked for that may be coming on.
        self._torque_word_s = -math.inf
        # Whether anybody has said what the servos feel.
        self._strained = False
        # When each servo was last too hot; what the motors worked a tick ago, since when too much.
        self._hot_s = [-math.inf] * n
        # When each servo was last far from its goal.
        self._away_s = [-math.inf] * n
        self._strains: Sequence[Strain] = ()
        self._load_s = [math.inf] * n
        # When each servo was last heard, as of a tick ago.
        self._heard_before_s = [-math.inf] * n
        # Which servo each fault names.
        self._named: Mapping[str, int | None] = {}
        # Since when a program is there that has heard every servo.
        self._all_known = False
        self._unheard_ticks = 0
        # Ticks in which what is told of torque was wrong.
        self._wrong_ticks = 0
        # Whether every servo answered in the last tick; when one last did not, or what is sent might be lost.
        self._all_heard = False
        self._unwell_s = -math.inf
        # Whether all servos were heard when a fault came to be told.
        self._clean = False
        # Since when the arm has been told to stop, and not to move since.
        self._stopped_s = math.inf
        # Goals of this tick that advance.
        self._advanced: list[tuple[int, str]] = []
        self._pairs = PairWatch(arm)

    def replied(self, now_s: float, kind: str, ok: bool, servos: Sequence[Servo]) -> None:
        """The program answers a request."""
        if kind == self._letting_go and (not any(servo.torque for servo in servos) if ok else self._just_asked(now_s)):
            self._letting_go = ""
        if kind in ("release", "teach") and ok:
            for i, servo in enumerate(servos):
                if servo.torque and not self._duties.writer_in_force(now_s, JUST_NOW_S):
                    rule = "limp" if kind == "release" else "status"
                    self._violate(rule, now_s, i, f"`{kind}` is answered well, and the servo has torque")

    def _just_asked(self, now_s: float) -> bool:
        return now_s - self._asked_s[self._letting_go] < REFUSED_S

    def misread(self, now_s: float, i: int, text: str) -> None:
        """A reading is not what its servo said."""
        self._violate("status", now_s, i, text)

    def rest_announced(self) -> None:
        """The program in charge says that it will send the arm to rest."""
        if self._codes & RESTING.keys():
            self._duties.rest_announced()

    def names(self, named: Mapping[str, int | None]) -> None:
        """Which servo each fault that is told names."""
        self._named = named

    def _hear_codes(self, now_s: float, mode: str, codes: Set[str], moves: bool) -> None:
        """What is told after a tick.

        Args:
            moves: Whether a motion was asked for in it.
        """
        for code in codes - self._codes:
            if why := self._without_cause(now_s, code):
                lost = code == "OTHER_WRITER" and self._duties.may_be_lost(now_s)
                self._violate("held" if lost else "rows", now_s, -1, f"{code} is told, and {why}")
            who = self._named.get(code)
            index = self._arm.servo_ids.index(who) if who in self._arm.servo_ids else -1
            if index >= 0 and self._before and (why := self._not_this_one(now_s, code, index)):
                self._violate("rows", now_s, index, f"{code} names this servo, and {why}")
            lasted_s = self._lasted_s.get(code, math.inf)
            # What holds a joint up is told with it.
            lasted_s += RESTING.get(code, 0.0) if code == "VOLTAGE" and "BLOCKED" in codes else 0.0
            own = self._hottest_degC > OVERHEAT_DEGC
            if self._strained and not own and lasted_s < RESTING.get(code, 0.0) - SLACK_S:
                text = f"{code} is told {lasted_s:.2f} s after its cause began (bound {RESTING[code]})"
                self._violate("rest", now_s, -1, text)
        if not codes & RESTING.keys():
            self._announced_s = math.inf
        elif not self._codes & RESTING.keys():
            self._announced_s = now_s
        if self._mode == mode == HOLDING and not (codes or self._codes or moves):
            for i, text in self._advanced:
                self._violate("status", now_s, i, f"{text}, and the arm is told to hold")
        self._advanced.clear()
        if codes and not self._codes:
            self._clean = self._all_heard and not self._duties.may_be_forged(now_s)
        self._codes = codes
        self._duties.told(codes)

    def _not_this_one(self, now_s: float, code: str, i: int) -> str:
        """Why a fault cannot be that of a servo; empty: it can, as far as this looks."""
        servo, duties = self._before[i], self._duties
        if duties.lately(now_s, {"same_id"}, JUST_NOW_S):
            return ""
        if code == "HOT" and self._strains and now_s - self._hot_s[i] > JUST_NOW_S:
            return f"it has {self._strains[i].temperature_degC:.1f} degC"
        strays = duties.may_be_forged(now_s) or duties.lately(now_s, STRAYS, JUST_NOW_S)
        strays |= duties.lately(now_s, {"lost"}, i=i)
        if code == "SERVO_SILENT" and not strays and now_s - duties.heard_s[i] < SILENT_S - SLACK_S and self._all_known:
            return "it was heard just now"
        if code == "BLOCKED" and now_s - max(self._away_s[i], self._late_s) > JUST_NOW_S:
            return "it is where it is told to be"
        struck = {"TRIPPED": {"trip", "brown_out", "hot"}, "LOST_TORQUE": {"trip", "brown_out"}}.get(code, set())
        if struck and servo.torque and servo.limit == FULL_LIMIT and not duties.lately(now_s, struck, i=i):
            return "it holds"
        return ""

    def _without_cause(self, now_s: float, code: str) -> str:
        """Why a fault cannot be; empty: it can, as far as this looks."""
        duties, before = self._duties, self._before
        if self._strained and code in self._last_s and now_s - self._last_s[code] > JUST_NOW_S:
            if code == "HOT":
                return "no servo is too hot"
            return "" if duties.lately(now_s, {"brown_out"}, JUST_NOW_S) else "the supply is in range"
        if code == "OTHER_WRITER" and not duties.lately(
            now_s, {"second_writer", "brown_out", "same_id", "trip", "wrong_id"}, RECOVERING_S + JUST_NOW_S
        ):
            return "" if duties.any_forged(now_s) else "no other program wrote"
        if code == "TRIPPED" and before and all(servo.limit for servo in before):
            return (
                ""
                if duties.lately(now_s, {"trip", "brown_out", "hot", "same_id"}, JUST_NOW_S)
                else "no servo shut down"
            )
        if code == "LOST_TORQUE" and before and all(servo.torque and servo.limit == FULL_LIMIT for servo in before):
            return "" if duties.lately(now_s, {"trip", "brown_out", "same_id"}, JUST_NOW_S) else "every servo holds"
        struck_by = {"second_writer", "mute", "dead_bus", "lost", "unplug", "same_id", "brown_out"} | STRAYS
        # What comes may be of no use there, which is told then.
        unheard = now_s - min(duties.heard_s) > HEARD_LATELY_S or self._codes & SILENT
        if code == "NOT_LIMP" and not unheard and not duties.lately(now_s, struck_by, JUST_NOW_S):
            return "" if duties.may_be_forged(now_s) else "torque is where it was asked for"
        if code == "CONTACT" and now_s - self._pushed_s > JUST_NOW_S:
            # A program that is shown a wrong pose cannot tell what the arm has to bear there.
            return "" if duties.lately(now_s, {"frozen_sensor"}, JUST_NOW_S) else "no joint pushes"
        blind = {"pair_mismatch", "stuck_joint", "frozen_sensor", "second_writer", "same_id"} | STRAYS
        if code == "PAIR_MISMATCH" and now_s - self._pairs.off_s > JUST_NOW_S and not duties.lately(now_s, blind):
            return "its servos agree"
        # A program that was late finds its port gone for good, however short that was.
        if code == "PORT_GONE" and not duties.lately(
            now_s + WORLD_STEP_S, {"unplug"}, OVER_S if now_s - self._late_s < self._period_s else JUST_NOW_S
        ):
            return "the adapter is in"
        return ""

    def _advances_to_rest(self, now_s: float, i: int, text: str) -> None:
        """A goal goes on towards rest, for a fault."""
        if not self._arm.rests:
            self._violate("rest", now_s, i, f"{text}: the arm's file forbids it")
        elif now_s - self._announced_s < ANNOUNCED_S - SLACK_S:
            told_s = max(0.0, now_s - self._announced_s)
            self._violate("rest", now_s, i, f"{text}, {told_s:.1f} s after it was told (bound {ANNOUNCED_S:g})")

    def _may_go_to_rest(self, now_s: float) -> bool:
        """Whether the way to rest was announced in time, and may be under way."""
        return self._arm.rests and now_s - self._announced_s >= ANNOUNCED_S - SLACK_S

    def _standing_causes(self, now_s: float) -> Iterator[str]:
        """Why torque must not come on: what would send the arm to rest."""
        low_V, high_V = self._arm.voltage_V
        out = any(not low_V - SENSED_V <= strain.voltage_V <= high_V + SENSED_V for strain in self._strains)
        return (
            code
            for code, since_s in self._since_s.items()
            if since_s < self._torque_word_s - SLACK_S and (out or code != "VOLTAGE")
        )

    def _watch_standing(self, now_s: float, servos: Sequence[Servo], strains: Sequence[Strain]) -> None:
        """Once a tick, with the servos of the tick before in `_before`."""
        if not self._all_heard or self._duties.may_be_lost(now_s) or self._duties.may_be_forged(now_s):
            self._unwell_s = now_s
        self._strained |= bool(strains)
        hot = [strain.temperature_degC + 0.5 >= self._arm.temperature_limit_degC for strain in strains]
        low_V, high_V = self._arm.voltage_V
        out = [not low_V <= round(strain.voltage_V, 1) <= high_V for strain in strains]
        # A servo rounds, and the supply wavers: near a bound it may read as beyond it.
        near = [not low_V + ROUNDED_V < strain.voltage_V < high_V - ROUNDED_V for strain in strains]
        self._hottest_degC = max((strain.temperature_degC for strain in strains), default=0.0)
        for code, found, may in (("HOT", hot, hot), ("VOLTAGE", out, near)):
            if any(found):
                self._since_s[code], self._last_s[code] = min(self._since_s[code], now_s), now_s
            else:
                self._since_s[code] = math.inf
            # It may have lasted until just now: looks may be far apart.
            if any(may) or self._may_since_s[code] < math.inf:
                self._may_since_s[code] = min(self._may_since_s[code], now_s)
                self._lasted_s[code] = now_s - self._may_since_s[code]
            if not any(may):
                self._may_since_s[code] = math.inf
        for i, (servo, strain) in enumerate(zip(servos, strains, strict=False)):
            self._watch_push(now_s, i, servo, strain)
            self._watch_load(now_s, i)
        self._watch_pairs(now_s, servos, strains)
        for i, is_hot in enumerate(hot):
            self._hot_s[i] = now_s if is_hot else self._hot_s[i]
        self._strains = strains
        for i, servo in enumerate(servos):
            if abs(servo.goal - servo.sensed_tick) * TICK_DEG > BLOCKED_DEG:
                self._away_s[i] = now_s
            if self._before and servo.goal != self._before[i].goal:
                self._goal_s[i] = now_s
        self._watch_torque(now_s, servos)
        self._watch_silence(now_s)
        gone = not self._duties.writer_in_force(now_s, WRITER_GONE_S) and not self._duties.may_be_forged(now_s)
        # Through an adapter that holds replies back a tick hears two servos; that another is led off, it cannot know.
        gone &= now_s - self._late_s > WRITER_GONE_S and not self._duties.lately(now_s, {"latency"}, WRITER_GONE_S)
        # To one that went on, which is told as OVERRULED, the arm is left; and what is to be limp has no goal.
        elsewhere = self._codes & {"PORT_GONE", "BUS_DEAD", "SERVO_SILENT", "OVERRULED", "NOT_LIMP"}
        if "OTHER_WRITER" in self._codes and gone and not elsewhere:
            self._watch_held(now_s, servos)

    def _watch_pairs(self, now_s: float, servos: Sequence[Servo], strains: Sequence[Strain]) -> None:
        """Two servos on one joint; nobody tells of what is not heard, or by a program that is not there yet."""
        duties, n = self._duties, len(self._arm.servos)
        there = self._alive() and self._all_known and self._mode != STARTING and now_s - self._late_s > JUST_NOW_S
        there &= now_s - self._unwell_s > JUST_NOW_S and not self._codes & (SILENT | {"PORT_GONE", "BUS_NOISE"})
        blind = {"stuck_joint", "frozen_sensor", "blocked_joint", "second_writer", "same_id"} | STRAYS
        well = [there and now_s - duties.hand_s > JUST_NOW_S and not duties.lately(now_s, blind, i=i) for i in range(n)]
        if strains:
            told, left = "PAIR_MISMATCH" in self._codes, "OVERRULED" in self._codes
            for i, text in self._pairs.look(now_s, servos, self._before, strains, well, told=told, left=left):
                self._violate("pair", now_s, i, text)

    def _watch_held(self, now_s: float, servos: Sequence[Servo]) -> None:
        """Another program has gone: whose goals are left."""

    def _watch_push(self, now_s: float, i: int, servo: Servo, strain: Strain) -> None:
        before = self._before[i] if self._before else servo
        duties = self._duties
        lately = now_s - duties.heard_s[i] < HEARD_LATELY_S and self._alive()
        # A program that has just begun asks who is there first.
        seen = self._mode != STARTING
        loaded = seen and servo.torque and abs(strain.output) > OVERLOADED and servo.limit == FULL_LIMIT
        self._load_s[i] = min(self._load_s[i], now_s) if loaded and lately else math.inf
        reachable = lately and not duties.may_be_forged(now_s) and not duties.writer_in_force(now_s, JUST_NOW_S)
        # An arm whose adapter was out may have been moved by anybody, until every servo of it is heard; and one that is
        # told to be left to another program is.
        reachable &= not ("PORT_GONE" in self._codes and self._codes & SILENT) and "OVERRULED" not in self._codes
        still = abs(servo.shaft_tick - before.shaft_tick) <= STILL_TICKS and servo.goal == before.goal
        # A motor that does less than gravity asks for holds back; it does not push.
        may = (0.0, strain.gravity, strain.gravity if strain.carrying is None else strain.carrying)
        grip = GRIP if self._arm.gripper in (i, self._arm.servos[i].beside) and self._arm.gripper >= 0 else 0.0
        needed = min(max(strain.output, min(may) - grip), max(may) + grip)
        # A motor that turns nothing pushes against nothing; one that sees nothing seems to bear a weight.
        idle = duties.lately(now_s, {"stuck_joint", "frozen_sensor"}, i=i)
        # The hand that leads it feels like a weight: it is not to give way to that for ever, but to tell it.
        led = bool(self._codes) and now_s - duties.hand_s < 1.5 * self._period_s
        pushes = servo.torque and abs(strain.output - needed) > PUSH and not idle and not led
        if servo.torque and abs(strain.output - strain.gravity) > LEAST_PUSH:
            self._pushed_s = now_s
        if not (pushes and still and reachable):
            self._push_s[i] = math.inf
            return
        self._push_s[i] = min(self._push_s[i], now_s)
        told_s = self._fault_s if self._codes else self._stopped_s if self._mode == HOLDING else math.inf
        # A program that was late could not see it while it was.
        stopped_s = now_s - max(self._push_s[i], told_s, self._late_s)
        # A joint that is told to be blocked is relieved at once, if every servo was heard.
        blocked = self._codes == {"BLOCKED"} and self._named.get("BLOCKED") == self._arm.servo_ids[i] and self._clean
        # What is stopped is relieved as soon as it stands, if every servo is heard and hears.
        well = not self._codes and now_s - self._unwell_s > stopped_s
        soon_s = PUSH_BLOCKED_S if blocked else PUSH_WELL_S if well else PUSH_STOPPED_S
        bound_s = soon_s if stopped_s > soon_s else PUSH_S
        if now_s - self._push_s[i] > bound_s:
            text = f"pushes with {strain.output:.2f} where gravity asks for {strain.gravity:.2f}"
            text += f", for {now_s - self._push_s[i]:.1f} s (bound {bound_s:g}), {self._mode} {'+'.join(self._codes)}"
            self._violate("relief" if blocked else "stall", now_s, i, text)

    def _watch_load(self, now_s: float, i: int) -> None:
        # A program that was late has seen it once; what is heard in this very tick, nobody has told yet.
        heard_s, self._heard_before_s[i] = self._heard_before_s[i], self._duties.heard_s[i]
        lasts_s = heard_s - max(self._load_s[i], self._late_s)
        # What is cleared while it lasts is told again when its servo is heard again.
        untold = "OVERLOAD" not in self._codes and heard_s > self._again[1]
        if lasts_s > OVERLOADED_S and untold and (self._codes or self._mode in POWERED):
            beside = f" beside {'+'.join(self._codes)}" if self._codes else ""
            text = f"works above 80 % for {now_s - self._load_s[i]:.1f} s, and nobody tells it{beside}"
            self._violate("faults" if beside else "rows", now_s, i, text)

    def _watch_silence(self, now_s: float) -> None:
        """A servo that nobody hears, for whatever reason, has to be told of."""
        if not self._alive():
            self._all_known = False
        elif not self._all_known:
            self._all_known = self._all_heard
        bound_s = STARTING_S if self._mode == STARTING else SILENT_S
        quiet = self._all_known and now_s - min(self._duties.heard_s) > bound_s
        self._unheard_ticks = self._unheard_ticks + 1 if quiet and not self._codes else 0
        if self._unheard_ticks > UNHEARD_TICKS:
            i = self._duties.heard_s.index(min(self._duties.heard_s))
            text = f"not heard for {now_s - self._duties.heard_s[i]:.1f} s, and nobody tells it"
            self._violate("rows", now_s, i, text)

    def _alive(self) -> bool:
        """Whether a program is in charge."""
        return False

    def _watch_torque(self, now_s: float, servos: Sequence[Servo]) -> None:
        """What is told of torque, and what is."""
        on = [servo.torque for servo in servos]
        limp = self._mode in LIMP and any(on)
        powered = self._mode in POWERED and not all(on)
        if self._codes or not (limp or powered) or not self._alive():
            self._wrong_ticks = 0
            return
        self._wrong_ticks += self._all_heard
        if self._wrong_ticks > WRONG_TICKS:
            who = on.index(limp)
            told = f"the arm is told to be {self._mode}, and the servo has {'torque' if limp else 'none'}"
            self._violate("status", now_s, who, told)

    def _forget_words(self) -> None:
        """The program is gone, and what it said."""
        self._codes, self._announced_s, self._stopped_s = frozenset(), math.inf, math.inf
        self._advanced.clear()
        self._mode, self._code = OFF, ""
        self._push_s = [math.inf] * len(self._push_s)
