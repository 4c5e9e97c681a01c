"""What one control step collects, and the few acts that every part of it shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from armctl.config import ArmConfig
from armctl.control.faults import SETTLING
from armctl.control.machine import Settle, State, Trigger, transition
from armctl.dynamixel import ax12a
from armctl.kinematics.robots.robot import Robot
from armctl.messages import (
    Event,
    Fault,
    Goal,
    Inputs,
    JointState,
    Mode,
    Reply,
    Write,
)

MINIMUM_SPEED_UNITS = 16
"""Slowest moving speed written (10.7 deg/s): a servo that holds must keep the authority to return to its goal."""


@dataclass(frozen=True, slots=True)
class Registers:
    """What of a servo's status bytes decides: torque, goal [tick], torque limit, position [tick]."""

    torque_enabled: bool
    goal: int
    torque_limit: int
    position: int


@dataclass
class Tick:
    """The outputs of one step, being collected."""

    state: State
    inputs: Inputs
    arm: ArmConfig
    robot: Robot
    period_s: float
    joints: tuple[JointState, ...]
    registers: tuple[Registers | None, ...]
    writes: list[Write] = field(default_factory=list)
    goal: Goal | None = None
    replies: list[Reply] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    @property
    def fresh(self) -> bool:
        return all(reading.fresh for reading in self.inputs.sample.servos)

    def go(self, trigger: Trigger) -> None:
        before = self.state.mode
        self.state = transition(self.state, trigger)
        if self.state.mode != before:
            self.events.append(Event("info", "STATE", f"{before} -> {self.state.mode}"))

    def reply(self, request_id: int | None, ok: bool, code: str = "", message: str = "") -> None:
        if request_id is not None:
            self.replies.append(Reply(request_id, ok, code, message))


def decode(registers: bytes) -> Registers | None:
    if not registers:
        return None
    return Registers(
        torque_enabled=bool(ax12a.register_value(ax12a.TORQUE_ENABLE, registers)),
        goal=ax12a.register_value(ax12a.GOAL, registers),
        torque_limit=ax12a.register_value(ax12a.TORQUE_LIMIT, registers),
        position=ax12a.register_value(ax12a.PRESENT_POSITION, registers),
    )


def latch_servo(s: Tick, code: str, index: int, problem: str) -> None:
    joint = s.arm.joints[index]
    latch(s, code, f"servo {joint.servo_id} ({joint.name}): {problem}", joint.servo_id)


def latch(s: Tick, code: str, text: str, servo_id: int | None = None) -> None:
    s.events.append(Event("error", code, text, servo_id))
    if code in ("PORT_GONE", "BLOCKED", "OTHER_WRITER") and s.state.motion is not None:
        finish_motion(s, code, text)
    elif s.state.motion is not None:
        s.state = replace(s.state, motion=replace(s.state.motion, stop_code=code))
    if s.state.settle is not Settle.NO:
        s.state = replace(s.state, settle=Settle.NO)
    if code in SETTLING:
        s.state = replace(s.state, settle=Settle.STOP)
    end_sequence(s, code, text)
    s.go(Trigger.FAULT)
    s.state = replace(
        s.state,
        fault=Fault(code, text, s.inputs.now_ns, servo_id),
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


def send_goal(s: Tick, ticks: Sequence[int]) -> None:
    """Goal and speed for every servo, inside the limits, each arriving in one tick."""
    goal, speeds = [], []
    for i, (joint, tick) in enumerate(zip(s.arm.joints, ticks, strict=True)):
        low, high = joint.limits_tick
        clamped = min(max(tick, low), high)
        before = clamped if s.state.goal is None else s.state.goal[i]
        units = ax12a.moving_speed_units(abs(clamped - before) * ax12a.TICK_RAD / s.period_s)
        limit = ax12a.moving_speed_units(joint.speed_limit_rad_s)
        goal.append(clamped)
        speeds.append(min(max(units, MINIMUM_SPEED_UNITS), limit))
    s.goal = Goal(tuple(goal), tuple(speeds))


def stop_motion(s: Tick, code: str) -> None:
    motion = s.state.motion
    if motion is not None and not motion.stop_code:
        s.state = replace(s.state, motion=replace(motion, stop_code=code))


def finish_motion(s: Tick, code: str, text: str) -> None:
    motion = s.state.motion
    assert motion is not None
    s.reply(motion.request_id, not code, code, text or (f"the motion was stopped ({code})" if code else ""))
    for request_id in s.state.hold_request_ids:
        s.reply(request_id, True)
    if s.state.mode is Mode.MOVING or (s.state.mode is Mode.PARKING and s.state.settle is Settle.NO):
        s.go(Trigger.STOPPED)
    s.state = replace(s.state, motion=None, hold_request_ids=())


def take_goals_over(s: Tick) -> None:
    goals = tuple(registers.goal for registers in s.registers if registers is not None)
    s.state = replace(s.state, goal=goals, previous_goal=None, error_since_ns=())
