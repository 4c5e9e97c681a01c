"""What one control step collects, and the few acts that every part of it shares."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from armctl.config import ArmConfig, JointConfig
from armctl.control.faults import SETTLING
from armctl.control.machine import Settle, State, Trigger, replace, transition
from armctl.dynamixel import ax12a
from armctl.kinematics.robots.robot import Robot
from armctl.messages import (
    NS_PER_S,
    Event,
    Fault,
    Goal,
    Inputs,
    JointState,
    Mode,
    Reply,
    Write,
)

LEAD_TICKS = math.radians(9.0) / ax12a.TICK_RAD
"""No goal is sent farther ahead of a servo, which may not be at the last one: fast, loaded, or after a late tick.

So far an arm goes on at most when its program dies, noise and overshoot making it 10 deg.
"""
ROUNDING_TICKS = 1.0
"""What rounding may add, of the goal sent last and of a part of the way to the next one."""
IN_TIME = 0.9
"""Of a period: a tick that comes no sooner is one in time."""
MINIMUM_SPEED_UNITS = 16
"""Slowest moving speed written (10.7 deg/s): a servo that holds must keep the authority to return to its goal."""


class Registers(NamedTuple):
    """A servo's control table from 24 to 49, in its units and order; `spare` are addresses without a register."""

    torque_enabled: int
    led: int
    cw_margin: int
    ccw_margin: int
    cw_slope: int
    ccw_slope: int
    goal: int
    moving_speed: int
    torque_limit: int
    position: int
    speed: int
    load: int
    voltage: int
    temperature: int
    registered: int
    spare: int
    moving: int
    lock: int
    punch: int

    @property
    def settings(self) -> int:
        """What only torque-on writes, margins, slopes, punch and torque limit, as one number to compare."""
        margins = self.cw_margin << 10 | self.ccw_margin
        slopes = self.cw_slope << 10 | self.ccw_slope
        return (margins << 20 | slopes) << 20 | self.punch << 10 | self.torque_limit


_BLOCK = struct.Struct("<6B6H6BH")

POWER_ON = Registers(0, 0, 1, 1, 32, 32, 0, 0, ax12a.TORQUE_LIMIT.maximum, 0, 0, 0, 0, 0, 0, 0, 0, 0, 32).settings
"""Settings of a servo that has just restarted."""


def decode(block: bytes) -> Registers | None:
    """The registers in the status bytes of a servo; None of one that never answered."""
    return Registers._make(_BLOCK.unpack(block)) if block else None


@dataclass(slots=True)
class Tick:
    """The outputs of one step, being collected."""

    state: State
    inputs: Inputs
    arm: ArmConfig
    robot: Robot
    period_s: float
    joints: tuple[JointState, ...]
    registers: tuple[Registers | None, ...]
    fresh: bool
    """Whether every servo was heard in this very sample."""
    writes: list[Write] = field(default_factory=list)
    goal: Goal | None = None
    ramp: tuple[float, ...] | None = None
    """Where the servos' own speed ramps are when that goal is sent."""
    replies: list[Reply] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def go(self, trigger: Trigger) -> None:
        before = self.state.mode
        self.state = transition(self.state, trigger)
        if self.state.mode != before:
            self.events.append(Event("info", "STATE", f"{before} -> {self.state.mode}"))

    def reply(self, request_id: int | None, ok: bool, code: str = "", message: str = "") -> None:
        if request_id is not None:
            self.replies.append(Reply(request_id, ok, code, message))


def all_powered(s: Tick) -> bool:
    """Whether every servo shows torque; a goal would switch it on where it is off, at full strength after a restart."""
    return all(registers and registers.torque_enabled and registers.torque_limit for registers in s.registers)


def full_torque(joint: JointConfig) -> int:
    """Torque limit with which a joint holds."""
    return round(ax12a.TORQUE_LIMIT.maximum * joint.torque_limit_ratio)


def weak_joints(s: Tick) -> list[int]:
    """Which joints have torque but too little to hold: whatever switched it on did not come to its end."""
    return [
        i
        for i, (joint, registers) in enumerate(zip(s.arm.joints, s.registers, strict=True))
        if registers and registers.torque_enabled and registers.torque_limit < full_torque(joint)
    ]


def latch_servo(s: Tick, code: str, index: int, problem: str) -> None:
    joint = s.arm.joints[index]
    latch(s, code, f"servo {joint.servo_id} ({joint.name}): {problem}", joint.servo_id)


def latch(s: Tick, code: str, text: str, servo_id: int | None = None) -> None:
    s.events.append(Event("error", code, text, servo_id))
    if s.state.motion is not None:
        if code in ("PORT_GONE", "BLOCKED", "OTHER_WRITER", "LOST_TORQUE", "TRIPPED"):
            finish_motion(s, code, text)
        else:
            s.state = replace(s.state, motion=replace(s.state.motion, stop_code=code))
    if s.state.jog is not None:
        finish_jog(s, code)
    settle = Settle.STOP if code in SETTLING else Settle.NO
    end_sequence(s, code, text)
    s.go(Trigger.FAULT)
    s.state = replace(
        s.state,
        fault=Fault(code, text, s.inputs.now_ns, servo_id),
        settle=settle,
        error_since_ns=(),
        load_since_ns=(),
        noise=(),
        connected=s.state.connected and s.inputs.sample.port_open,
    )


def end_sequence(s: Tick, code: str, text: str = "") -> None:
    """Tell whoever waits for the present sequence that it will not end well."""
    s.reply(s.state.request_id, False, code, text or "another request came first")
    s.state = replace(s.state, request_id=None, anchor=None)


def torque_off(s: Tick) -> None:
    s.goal = None  # a goal after it would switch the torque on again
    s.writes.extend(
        Write(servo_id, ax12a.TORQUE_ENABLE.address, ax12a.TORQUE_ENABLE.size, 0) for servo_id in s.arm.servo_ids
    )


def whole_ticks(s: Tick, position_rad: Sequence[float]) -> list[int]:
    """The nearest servo position of every joint position [rad]."""
    return [round(joint.tick(q)) for joint, q in zip(s.arm.joints, position_rad, strict=True)]


def send_goal(s: Tick, ticks: Sequence[int]) -> None:
    """Goal and speed for every servo, inside the limits, each arriving in one tick from where its ramp is by now."""
    goal, speeds = [], []
    before = s.ramp = ramps(s)
    tick_rad_s = ax12a.TICK_RAD / s.period_s
    for i, (joint, tick) in enumerate(zip(s.arm.joints, ticks, strict=True)):
        low, high = joint.limits_tick
        clamped = min(max(tick, low), high)
        goal.append(clamped)
        units = 0 if before is None or before[i] == clamped else abs(clamped - before[i]) * tick_rad_s
        slowest = max(MINIMUM_SPEED_UNITS, ax12a.moving_speed_units(units))
        speeds.append(min(slowest, ax12a.moving_speed_units(joint.speed_limit_rad_s)))
    s.goal = Goal(tuple(goal), tuple(speeds))


def ramps(s: Tick) -> tuple[float, ...] | None:
    """Where the servos' own speed ramps are by now [tick]: at the last goal, or short of it.

    After a late tick the next one comes soon. A goal that then got no more speed than its own way needs would leave the
    ramp behind for the rest of the motion, and an arm whose program dies would go on for so long.
    """
    goal, begin = s.state.goal, s.state.ramp
    if goal is None or begin is None:
        return goal
    elapsed_s = (s.inputs.now_ns - s.state.goal_ns) / NS_PER_S
    share = elapsed_s / s.period_s if elapsed_s < IN_TIME * s.period_s else 1.0
    now = []
    for joint, at, tick in zip(s.arm.joints, begin, goal, strict=True):
        way = min(abs(tick - at) * share, joint.speed_limit_rad_s * max(elapsed_s, share * s.period_s) / ax12a.TICK_RAD)
        now.append(tick if way >= abs(tick - at) else at + math.copysign(way, tick - at))
    return tuple(now)


def stop_motion(s: Tick, code: str) -> None:
    """Bring whatever motion is under way to rest."""
    motion, jog = s.state.motion, s.state.jog
    if motion is not None and not motion.stop_code:
        s.state = replace(s.state, motion=replace(motion, stop_code=code))
    if jog is not None and not jog.stop_code:
        s.state = replace(s.state, jog=replace(jog, stop_code=code))


def finish_motion(s: Tick, code: str, text: str) -> None:
    motion = s.state.motion
    assert motion is not None
    s.reply(motion.request_id, not code, code, text or (f"the motion was stopped ({code})" if code else ""))
    _tell_still(s)
    if s.state.mode is Mode.MOVING or (s.state.mode is Mode.PARKING and s.state.settle is Settle.NO):
        s.go(Trigger.STOPPED)
    s.state = replace(s.state, motion=None)


def finish_jog(s: Tick, code: str) -> None:
    s.events.append(Event("info", "JOG_END", f"the jog ended ({code})"))
    _tell_still(s)
    if s.state.mode is Mode.JOGGING:
        s.go(Trigger.STOPPED)
    s.state = replace(s.state, jog=None)


def _tell_still(s: Tick) -> None:
    for request_id in s.state.hold_request_ids:
        s.reply(request_id, True)
    if s.state.hold_request_ids:
        s.state = replace(s.state, hold_request_ids=())


def take_over(s: Tick) -> None:
    """Take goals and settings of powered servos as they are."""
    known = [registers for registers in s.registers if registers is not None]
    s.state = replace(
        s.state,
        goal=tuple(registers.goal for registers in known),
        previous_goal=None,
        ramp=None,
        settings=tuple(registers.settings for registers in known),
        error_since_ns=(),
    )


def share_of_step(s: Tick, goal: list[int]) -> float:
    """How much of the way from the last goal to `goal` may be sent now: a servo that lags behind is waited for."""
    assert s.state.goal is not None
    share = 1.0
    for registers, last, tick in zip(s.registers, s.state.goal, goal, strict=True):
        assert registers is not None
        ahead = abs(tick - registers.position)
        if ahead > LEAD_TICKS:
            behind = abs(last - registers.position)
            room = max(0.0, LEAD_TICKS - ROUNDING_TICKS - behind)
            share = min(share, room / (ahead - behind) if ahead > behind else 1.0)
    return share
