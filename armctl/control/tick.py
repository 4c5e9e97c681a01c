"""What one control step works on, and the few acts that every part of it shares."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

from armctl.config import ArmConfig, Servo
from armctl.control.faults import KINDS, with_fault
from armctl.control.machine import ENERGISING, LATCHED, TO_REST, TRANSITIONS, LettingGo, Look, Phase, State, Trigger
from armctl.control.stillness import Shaft, shaft
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Register, Status
from armctl.kinematics.robots.robot import Robot
from armctl.messages import NS_PER_S, Event, Fault, Goal, Inputs, JointState, LagModel, Reply, Write
from armctl.pair import Linkage
from armctl.trajectory.lag import nominal

# The goals of so long are remembered, and some at the slowest period.
SENT_S, SENT_LEAST = 1.0, 8
LED_OFF_TICKS = math.radians(12.0) / ax12a.TICK_RAD
# Share of a period: a tick that comes no sooner after the last one is in time.
IN_TIME = 0.9
# Of a period, what a ramp takes that begins at the shaft.
RAMP_SHARE = 0.1
# A second servo nears its place beside the first one by this in a tick, but in a fault: they may be relieved apart.
ALIGN_TICKS = 1
Made = TypeVar("Made")
# Slowest moving speed written (10.7 deg/s): a servo that holds must keep the authority to return to its goal.
MINIMUM_SPEED_UNITS = 16


class WireJoint(NamedTuple):
    """One servo's configuration in the units of the wire; every tick needs all of it."""

    servo_id: int
    direction: int
    zero_tick: float
    low_tick: int
    high_tick: int
    speed_limit_rad_s: float
    speed_limit_units: int
    # Torque limit with which the servo holds.
    full_torque: int
    name: str
    # Index of the joint that it turns.
    of: int
    # How it reads against that joint's first servo, which has `zero_tick`; None: it is that.
    linkage: Linkage | None

    def position_rad(self, tick: float) -> float:
        """Joint position of a servo position [tick]."""
        if self.linkage is not None:
            return self.linkage.sense * self.direction * (self.linkage.first(tick) - self.zero_tick) * ax12a.TICK_RAD
        return self.direction * (tick - self.zero_tick) * ax12a.TICK_RAD

    def beside(self, tick: int) -> int:
        """Goal [tick] of a second servo beside that of the first one."""
        return self.within_limits(tick if self.linkage is None else round(self.linkage.second(tick)))

    def within_limits(self, tick: int) -> int:
        """A position [tick], or the limit that it is beyond."""
        return min(max(tick, self.low_tick), self.high_tick)


def _wire_joint(servo: Servo) -> WireJoint:
    joint, link = servo.joint, servo.linkage
    turned, speed_rad_s = joint.direction * (1 if link is None else link.sense), joint.speed_limit_rad_s
    units = ax12a.moving_speed_units(speed_rad_s), round(ax12a.TORQUE_LIMIT.maximum * joint.torque_limit_ratio)
    more = *servo.limits_tick, speed_rad_s, *units, joint.name, servo.of, link
    return WireJoint(servo.servo_id, turned, joint.zero_tick, *more)


def of_latest_arm(make: Callable[..., Made]) -> Callable[..., Made]:
    """What is made of an arm, for the one asked for last: a process has one. It only saves time."""
    latest: list[tuple[ArmConfig, Made]] = []

    def kept(arm: ArmConfig, *more: Any) -> Made:
        if not latest or latest[0][0] is not arm:
            latest[:] = [(arm, make(arm, *more))]
        return latest[0][1]

    return kept


@of_latest_arm
def wire_joints(arm: ArmConfig) -> tuple[WireJoint, ...]:
    """Every servo of an arm in the units of the wire: the first ones of all joints, then the second ones of pairs."""
    return tuple(map(_wire_joint, arm.servos))


_nominal = of_latest_arm(nominal)


@dataclass(slots=True)
class Tick:
    """One step's own copy of the state, what the step sees, and what it says, being collected.

    Whoever refuses something does so before the first change: nothing is ever taken back.
    """

    state: State
    inputs: Inputs
    arm: ArmConfig
    wire: tuple[WireJoint, ...]
    robot: Robot
    period_s: float
    joints: tuple[JointState, ...]
    # The same of each servo alone, in the order of `wire`.
    each: tuple[JointState, ...]
    # What each servo says; None: it was never heard.
    servos: tuple[Status | None, ...]
    # Whether every servo was heard in this very sample.
    fresh: bool
    writes: list[Write] = field(default_factory=list)
    goal: Goal | None = None
    # Where the servos' own speed ramps are when that goal is sent.
    ramp: tuple[float, ...] = ()
    replies: list[Reply] = field(default_factory=list)
    # Codes of the faults that this very sample shows, latched before or not.
    found: set[str] = field(default_factory=set)
    events: list[Event] = field(default_factory=list)

    def go(self, trigger: Trigger) -> None:
        """Change the phase, and tell the log where the outside sees it.

        Raises:
            IllegalTransition: the trigger has no entry in the row of the present phase; nothing has changed.
        """
        before = self.state.mode
        self.state.go(trigger)
        if self.state.mode != before:
            self.events.append(Event("info", "STATE", f"{before} -> {self.state.mode}"))

    def ticks_in(self, seconds: float, least: int = 2) -> int:
        """So many ticks are a time, whatever the period; a lost reply is to be outlived by the slowest one too."""
        return max(least, round(seconds / self.period_s))

    def reply(self, request_id: int | None, ok: bool, code: str = "", message: str = "") -> None:
        if request_id is not None:
            self.replies.append(Reply(request_id, ok, code, message))

    def write(self, servo_id: int, register: Register, value: int) -> None:
        self.writes.append(Write(servo_id, register.address, register.size, value))

    def write_all(self, register: Register, value: int) -> None:
        for servo_id in self.arm.servo_ids:
            self.write(servo_id, register, value)

    def all_powered(self) -> bool:
        """Whether every servo shows torque; a goal would switch it on where it is off, after a restart even fully."""
        return all(servo and servo.torque_enabled and servo.torque_limit for servo in self.servos)

    def status(self, index: int) -> Status:
        """What a servo says that has been heard: every one has, once the arm is taken over."""
        status = self.servos[index]
        assert status is not None
        return status

    def limp_shaft(self, index: int, anchor: int | None = None) -> Shaft:
        """What is known of a shaft that no torque moves; its `anchor` as in `shaft`."""
        before = (*self.state.earlier_ticks, self.state.last_ticks)
        return shaft([*(ticks[index] for ticks in before), self.status(index).position], anchor)

    def heard(self, index: int) -> Status | None:
        """What a servo says that was heard in this very sample; None of any other."""
        return self.servos[index] if self.inputs.sample.servos[index].fresh else None

    def here(self, index: int) -> int:
        """Where a shaft is [tick], or the limit that it is just beyond."""
        return self.wire[index].within_limits(self.status(index).position)

    def lag_model(self) -> LagModel:
        """How the arm lags: its own model, or that of an arm of new servos."""
        return self.state.model or _nominal(self.arm, self.robot.chain)

    def goals_rad(self) -> tuple[float, ...]:
        """Where the joints' goals are that were decided; empty: there are none."""
        return tuple([self.wire[i].position_rad(tick) for i, tick in enumerate(self.state.goal[: len(self.joints)])])

    def wanted_rad(self) -> tuple[float, ...]:
        """Where the joints are wanted; empty: nowhere."""
        following = self.state.following
        return self.goals_rad() if following is None else following.wanted_rad

    def weak_servos(self) -> list[int]:
        """Which servos have torque but too little to hold: whatever switched it on did not come to its end."""
        both = enumerate(zip(self.servos, self.wire, strict=True))
        return [i for i, (it, joint) in both if it and it.torque_enabled and it.torque_limit < joint.full_torque]

    # ------------------------------------------------------------------------------------------------- faults

    def latch_servo(self, code: str, index: int, problem: str) -> bool:
        """See `latch`."""
        servo = self.wire[index]
        return self.latch(code, f"servo {servo.servo_id} ({servo.name}): {problem}", servo.servo_id)

    def latch(self, code: str, text: str, servo_id: int | None = None) -> bool:
        """Latch a fault, and do what its row in `faults.FAULTS` says; False: it is latched already."""
        state, kind = self.state, KINDS[code]
        state.connected = state.connected and self.inputs.sample.port_open
        self.found.add(code)
        if kind.motion == "ends" and state.phase in TO_REST & LATCHED:
            self.give_up_rest(code, text)
        if kind.motion == "ends" and state.motion is not None:
            self.finish_motion(code, text)
        if any(fault.code == code and (kind.of == "supply" or fault.servo_id == servo_id) for fault in state.faults):
            return False
        self.events.append(Event("error", code, text, servo_id))
        if state.motion is not None:
            state.motion.stop_code = code
        if state.jog is not None:
            self.finish_jog(code)
        self.end_sequence(code, text)
        if state.phase in ENERGISING and kind.to_rest:
            self.let_go()
        if state.phase not in LATCHED:
            self.go(Trigger.FAULT)
        state.faults = with_fault(state.faults, Fault(code, text, self.inputs.now_ns, servo_id))
        self.look_for_push()
        return True

    # -------------------------------------------------------------------------------- ends of what was under way

    def stop_motion(self, code: str) -> None:
        """Bring whatever motion is under way to rest; a joint that pushes then is relieved (see relief.py)."""
        self.look_for_push()
        for moving in (self.state.motion, self.state.jog):
            if moving is not None and not moving.stop_code:
                moving.stop_code = code

    def look_for_push(self) -> None:
        """Have every joint looked at once it stands (see relief.py), but those relieved just now."""
        waiting = tuple([look for look in self.state.looks if look.relieved])
        others = set(range(len(self.joints))).difference([look.joint for look in waiting])
        self.state.looks = (*waiting, *map(Look, sorted(others)))

    def finish_motion(self, code: str, text: str) -> None:
        motion, self.state.motion = self.state.motion, None
        assert motion is not None
        self.reply(motion.request_id, not code, code, text or (f"the motion was stopped ({code})" if code else ""))
        if code and self.state.phase is Phase.FAULT_GOING:  # nobody is against it: the arm sets off again
            self.go(Trigger.GIVE_UP)
        self._still()

    def finish_jog(self, code: str) -> None:
        self.events.append(Event("info", "JOG_END", f"the jog ended ({code})"))
        self.state.jog = None
        self._still()

    def _still(self) -> None:
        """The arm stands: whoever waits for that hears of it, and what was only a motion is over."""
        for request_id in self.state.hold_request_ids:
            self.reply(request_id, True)
        self.state.hold_request_ids = ()
        if Trigger.STOPPED in TRANSITIONS[self.state.phase]:
            self.go(Trigger.STOPPED)

    def end_sequence(self, code: str, text: str = "") -> None:
        """Tell whoever waits for the present sequence that it will not end well; not a `release`, which goes on."""
        state, going = self.state, self.state.letting_go
        request_ids: tuple[int | None, ...] = (state.request_id,)
        if going is not None and state.phase is Phase.LETTING_GO:
            request_ids += going.request_ids
            state.letting_go = replace(going, request_ids=())
        for request_id in request_ids:
            self.reply(request_id, False, code, text or "another request came first")
        state.request_id, state.anchor = None, ()

    def give_up_rest(self, code: str, why: str) -> None:
        """Hold instead of going to rest: torque is never cut but there.

        For a fault it is tried again once the servos can be relied on, but not where a person, an obstacle or the way
        itself is against it.
        """
        state = self.state
        self.stop_motion(code)
        text = f"the arm does not go to rest: {why}; it holds"
        self.events.append(Event("warning", code, text))
        self.end_sequence(code, text)
        against = code == "BLOCKED" or (code == "CONTACT" and state.motion is not None)
        state.stays = state.phase in LATCHED and (against or code not in (*KINDS, "HOST_SILENT"))
        self.go(Trigger.GIVE_UP)
        if state.motion is None and state.phase is Phase.PARK_ENDING:
            self.go(Trigger.STOPPED)

    def let_go(self, request_id: int | None = None) -> None:
        """Switch torque off, for as long as it takes until every servo is seen limp (see enforce.py)."""
        state = self.state
        more, going = () if request_id is None else (request_id,), state.letting_go
        if not (going and going.request_ids):  # who waits hears as soon, however often it is asked for anew
            going = LettingGo(self.inputs.now_ns, tuple(range(len(self.wire))), ())
        state.letting_go = replace(going, request_ids=going.request_ids + more)
        self.forget_goals()
        state.powered, state.looks, state.borne_ratio = False, (), ()
        self.write_all(ax12a.TORQUE_ENABLE, 0)

    # -------------------------------------------------------------------------------------------------- goals

    def take_over(self) -> None:
        """Take goals and settings of powered servos as they are."""
        state = self.state
        self.find_goals()
        state.settings = tuple([servo.settings for servo in self.servos if servo is not None])
        state.error_since_ns, state.push_since_ns, state.foreign_since_ns, state.foreign_ns = (), (), 0, 0
        state.yielded, state.powered = False, True

    def find_goals(self) -> None:
        """Take the goals of servos that have all been heard as they are."""
        self.state.goal = tuple(servo.goal for servo in self.servos if servo is not None)
        self.state.ramp, self.state.following = (), None

    def forget_goals(self) -> None:
        """No goal is sent any more: armctl has no say in where the servos are."""
        self.goal = None  # after a torque-off it would switch the torque on again
        self.state.goal = self.state.sent = self.state.heard_since = self.state.ramp = ()
        self.state.following = None

    def remember(self, goal: tuple[int, ...]) -> None:
        """A goal is sent, or decided: what the servos are to show from now on."""
        state, now_ns = self.state, self.inputs.now_ns
        if state.goal and goal != state.goal:
            state.sent, state.heard_since = (state.goal, *state.sent), (0, *state.heard_since)
            since_ns = zip(state.push_since_ns or (0,) * len(self.joints), goal, state.goal, strict=False)
            state.push_since_ns = tuple([since if new == old else 0 for since, new, old in since_ns])
        state.goal, state.goal_ns = goal, now_ns

    def confirm_goals(self) -> None:
        """A servo that shows its goal shows no earlier one again, nor one for long after it was replaced, unless
        somebody else writes it, or the latest is withheld because the servo was led off.
        """
        state = self.state
        shown = [(it := self.heard(i)) is not None and it.goal == goal for i, goal in enumerate(state.goal)]
        left = [
            (tuple([now if done else was for now, was, done in zip(state.goal, goal, shown, strict=True)]), heard)
            for goal, heard in zip(state.sent, state.heard_since, strict=True)
            if heard < self.ticks_in(SENT_S, SENT_LEAST)
        ]
        told = self.fresh and not any(self.is_led_off(i) for i, done in enumerate(shown) if not done)
        left = [(goal, heard + told) for goal, heard in left if goal != state.goal]
        state.sent, state.heard_since = tuple([goal for goal, _ in left]), tuple([heard for _, heard in left])

    def is_led_off(self, index: int) -> bool:
        """Whether a servo is so far from the goal decided for it that it is not brought back."""
        return abs(self.status(index).position - self.state.goal[index]) > LED_OFF_TICKS

    def is_from_here(self, index: int) -> bool:
        """Whether a servo that has been heard shows one of the goals sent to it since it last showed the latest."""
        shown = self.status(index).goal
        return shown == self.state.goal[index] or any(goal[index] == shown for goal in self.state.sent)

    def beside(self, goal: Sequence[int]) -> list[int]:
        """Goals [tick] of the second servos that `goal` leaves out: each goes along with the first one."""
        last, found, most = self.state.goal, [], 0 if self.state.phase in LATCHED else ALIGN_TICKS
        for i, servo in enumerate(self.wire[len(goal) :], start=len(goal)):
            place = servo.beside(goal[servo.of])
            if last:
                off = (before := servo.beside(last[servo.of])) - last[i]
                place = servo.within_limits(last[i] + place - before + min(max(off, -most), most))
            found.append(place)
        return found

    def send_goal(self, ticks: Sequence[int], within: float = 1.0) -> None:
        """Goal and speed for every servo, inside the limits; each arrives `within` so many ticks from its ramp.

        Those of second servos may be left out. None is sent to an arm that is let go: it would energise what is limp.
        """
        if self.state.letting_go is not None:
            return
        first = [joint.within_limits(tick) for joint, tick in zip(self.wire, ticks, strict=False)]
        goal = [*first, *self.beside(first)]
        self.ramp = self.ramps()
        begin, tick_rad_s = self.ramp or goal, ax12a.TICK_RAD / (within * self.period_s)
        limits = [joint.speed_limit_units for joint in self.wire]
        if self.state.ramp_restarts or self.arm.ramp_from_reference is False:
            # Each ramp is to be over soon: what a joint lags behind is asked of it anew with every goal.
            begin, tick_rad_s = [self.status(i).position for i in range(len(goal))], tick_rad_s / RAMP_SHARE
            limits = [ax12a.TICK_MAX] * len(goal)
        speeds = [ax12a.moving_speed_units(abs(a - b) * tick_rad_s) for a, b in zip(goal, begin, strict=True)]
        speeds = [min(max(MINIMUM_SPEED_UNITS, speed), most) for speed, most in zip(speeds, limits, strict=True)]
        self.goal = Goal(tuple(goal), tuple(speeds))

    def ramps(self) -> tuple[float, ...]:
        """Where the servos' own speed ramps are by now [tick]: at the last goal, or short of it.

        After a late tick the next one comes soon. A goal that then got no more speed than its own way needs would leave
        the ramp behind for the rest of the motion, and an arm whose program dies would go on for so long. So would a
        servo that missed goals; it shows an earlier one.
        """
        goal, wire = self.state.goal, self.wire if self.state.goal else ()
        elapsed_s = (self.inputs.now_ns - self.state.goal_ns) / NS_PER_S
        share = elapsed_s / self.period_s if elapsed_s < IN_TIME * self.period_s else 1.0
        time_s = max(elapsed_s, share * self.period_s)
        now = []
        for i, (joint, at, tick) in enumerate(zip(wire, self.state.ramp or goal, goal, strict=True)):
            left = abs(tick - at)
            way = min(left * share, joint.speed_limit_rad_s * time_s / ax12a.TICK_RAD)
            shown = heard.goal if (heard := self.heard(i)) else tick
            now.append(shown if shown != tick else tick if way >= left else at + math.copysign(way, tick - at))
        return tuple(now)
