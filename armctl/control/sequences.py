"""What goes on over several ticks: taking an arm over, torque coming on, a motion, the slow way to rest.

Every stage is decided by what the servos report, not by what was written to them.
"""

from __future__ import annotations

import math
from dataclasses import replace

from armctl.control.detect import SILENT_AGE_S
from armctl.control.machine import Motion, Settle, Trigger
from armctl.control.tick import (
    Tick,
    end_sequence,
    finish_motion,
    latch_servo,
    send_goal,
    stop_motion,
    take_goals_over,
    torque_off,
)
from armctl.dynamixel import ax12a
from armctl.messages import (
    Event,
    JointTrajectory,
    Mode,
    Write,
)
from armctl.trajectory.approach import approach_trajectory, lowest_link_m

STOP_S = 0.2
"""Time in which a stop brings the trajectory's rate from 1 to 0."""
LATE_NS = 250_000_000
STILL_TICKS = 3
"""Largest change between two samples of an arm that counts as still (noise is one tick)."""
SOFT_TORQUE = 128
"""Torque limit while torque comes on (12.5 %)."""
RAMP_TICKS = 5
JUMP_RAD = math.radians(6.0)
SEQUENCE_TICKS = 5
"""How long a sequence waits for the servos to confirm a step."""
REST_TOLERANCE_RAD = math.radians(3.0)
VERIFY_TICKS = 20


def adopt(s: Tick) -> None:
    """Take over what the servos are doing: torque on stays on at its goal, off stays off."""
    if not s.state.connected or s.state.adopted or s.state.fault is not None or not s.fresh:
        return
    powered = [registers is not None and registers.torque_enabled for registers in s.registers]
    s.state = replace(s.state, adopted=True)
    if all(powered):
        s.go(Trigger.ADOPT_POWERED)
        take_goals_over(s)
    elif any(powered):
        index = powered.index(False)
        latch_servo(s, "LOST_TORQUE", index, "found limp while other servos hold")


def advance(s: Tick) -> None:
    if s.state.mode is Mode.ENERGISING and s.state.phase > 0:
        _energise(s)
    elif s.state.mode is Mode.TEACHING and s.state.request_id is not None and s.state.phase > 0:
        _verify_limp(s)
    if s.state.settle is not Settle.NO:
        _settle(s)
    if s.state.motion is not None:
        _move(s, s.state.motion)


def _energise(s: Tick) -> None:
    """The careful torque-on: soft limit and goal read back, enable, watch, ramp the limit up."""
    anchor = s.state.anchor
    assert anchor is not None
    if not s.fresh:
        # The sequence waits until every servo has been heard; one that stays silent latches a fault.
        s.state = replace(s.state, phase=s.state.phase - 1)
        return
    surprise = next(filter(None, (_surprise(s, i, anchor[i]) for i in range(len(anchor)))), "")
    ramp = s.state.phase - 2
    if surprise:
        torque_off(s)
        s.events.append(Event("warning", "JUMP_REFUSED", surprise))
        s.go(Trigger.ENERGISE_FAILED)
        end_sequence(s, "JUMP_REFUSED", surprise)
    elif s.state.phase == 1:
        s.writes.extend(Write(i, ax12a.TORQUE_ENABLE.address, ax12a.TORQUE_ENABLE.size, 1) for i in s.arm.servo_ids)
        send_goal(s, anchor)  # again: a limp servo may have let its goal follow the shaft
    elif 1 <= ramp <= RAMP_TICKS:
        for joint in s.arm.joints:
            full = ax12a.TORQUE_LIMIT.maximum * joint.torque_limit_ratio
            limit = round(SOFT_TORQUE + (full - SOFT_TORQUE) * ramp / RAMP_TICKS)
            s.writes.append(Write(joint.servo_id, ax12a.TORQUE_LIMIT.address, ax12a.TORQUE_LIMIT.size, limit))
    elif ramp > RAMP_TICKS:
        s.reply(s.state.request_id, True)
        s.go(Trigger.ENERGISED)
        s.state = replace(s.state, request_id=None, anchor=None, error_since_ns=())


def _surprise(s: Tick, index: int, anchor: int) -> str:
    """What is not as it should be with one servo while torque comes on; empty if nothing."""
    joint, registers = s.arm.joints[index], s.registers[index]
    assert registers is not None
    who = f"servo {joint.servo_id} ({joint.name})"
    if abs(registers.position - anchor) * ax12a.TICK_RAD > JUMP_RAD:
        return f"{who} moved while torque came on; support the arm and try again"
    if abs(registers.goal - anchor) > (STILL_TICKS if s.state.phase == 1 else 0):
        return f"{who} shows goal {registers.goal} where {anchor} was written"
    if s.state.phase == 1 and registers.torque_limit != SOFT_TORQUE:
        return f"{who} shows torque limit {registers.torque_limit} where {SOFT_TORQUE} was written"
    if s.state.phase > 1 and not registers.torque_enabled:
        return f"{who} did not take torque"
    return ""


def _verify_limp(s: Tick) -> None:
    """Answer the teach request once every servo is seen without torque."""
    if s.fresh and not any(registers is None or registers.torque_enabled for registers in s.registers):
        s.reply(s.state.request_id, True)
        s.state = replace(s.state, request_id=None)
    elif s.state.phase > SEQUENCE_TICKS:
        index = next((i for i, r in enumerate(s.registers) if r is not None and r.torque_enabled), 0)
        latch_servo(s, "NOT_LIMP", index, "torque stayed on although it was switched off")


def _move(s: Tick, motion: Motion) -> None:
    """Send the trajectory's position one tick ahead."""
    trajectory = motion.trajectory
    if not motion.begun and motion.progress_s >= trajectory.begin_s:
        motion = replace(motion, begun=True)
        s.events.append(Event("info", "PLAN_BEGIN", trajectory.label))
    if not motion.ended and motion.progress_s >= trajectory.end_s > trajectory.begin_s:
        motion = replace(motion, ended=True)
        s.events.append(Event("info", "PLAN_END", trajectory.label))
    if motion.progress_s >= trajectory.duration_s:
        return finish_motion(s, motion.stop_code, "")
    if s.inputs.late_ns > LATE_NS and not motion.stop_code:
        motion = replace(motion, stop_code="LATE")
        s.events.append(Event("warning", "LATE", f"a tick came {s.inputs.late_ns / 1e6:.0f} ms late (bound 250)"))
    # A goal would energise a servo that has just restarted: none goes out while one is unheard.
    waiting = bool(motion.stop_code) or not s.fresh
    change = s.period_s / STOP_S
    rate = max(0.0, motion.rate - change) if waiting else min(1.0, motion.rate + change)
    if rate == 0.0 and motion.stop_code:
        return finish_motion(s, motion.stop_code, "")
    if not s.fresh:
        s.state = replace(s.state, motion=replace(motion, rate=rate))
        return None
    progress_s = min(motion.progress_s + rate * s.period_s, trajectory.duration_s)
    s.state = replace(s.state, motion=replace(motion, progress_s=progress_s, rate=rate))
    q = sample_trajectory(trajectory, progress_s)
    send_goal(s, [round(joint.tick(position)) for joint, position in zip(s.arm.joints, q, strict=True)])
    return None


def sample_trajectory(trajectory: JointTrajectory, time_s: float) -> tuple[float, ...]:
    """Joint positions [rad] at `time_s`, linear between grid points."""
    points = trajectory.positions_rad
    place = min(max(time_s / trajectory.period_s, 0.0), len(points) - 1.0)
    index = min(int(place), len(points) - 2)
    part = place - index
    return tuple(a + part * (b - a) for a, b in zip(points[index], points[index + 1], strict=True))


def _settle(s: Tick) -> None:
    """The slow way to rest: come to a stop, go there, see that it is there, switch torque off."""
    goal = s.state.goal
    assert goal is not None
    if any(r is None or not r.torque_enabled or not r.torque_limit for r in s.registers):
        return abandon_settling(s, "LOST_TORQUE", "a servo has no torque")
    if any(joint.age_s > SILENT_AGE_S for joint in s.joints):
        return abandon_settling(s, "SERVO_SILENT", "a servo does not answer")
    if s.state.motion is not None:
        return None
    if s.state.settle is Settle.STOP:
        q = [joint.position_rad(tick) for joint, tick in zip(s.arm.joints, goal, strict=True)]
        rest = [joint.rest_rad for joint in s.arm.joints]
        way = approach_trajectory(q, rest, s.arm, s.robot, s.period_s, "to rest")
        if lowest_link_m(way, s.robot) < s.arm.floor_m:
            return abandon_settling(s, "LIMIT", "the straight way to rest leads below the floor")
        s.state = replace(s.state, motion=Motion(way, None), settle=Settle.MOVE, phase=0)
    elif s.state.settle is Settle.MOVE:
        s.state = replace(s.state, settle=Settle.VERIFY, phase=0)
    elif s.fresh and all(
        abs(now.position_rad - joint.rest_rad) <= REST_TOLERANCE_RAD
        for now, joint in zip(s.joints, s.arm.joints, strict=True)
    ):
        torque_off(s)
        s.events.append(Event("info", "PARKED", "the arm is at its rest pose; torque is off"))
        s.reply(s.state.request_id, True)
        if s.state.mode is Mode.PARKING:
            s.go(Trigger.PARKED)
        s.state = replace(s.state, settle=Settle.NO, request_id=None)
    elif s.state.phase > VERIFY_TICKS:
        abandon_settling(s, "NOT_AT_REST", "the arm is over 3 deg from its rest pose")
    return None


def abandon_settling(s: Tick, code: str, why: str) -> None:
    """Hold instead: torque is never cut but at rest."""
    stop_motion(s, code)
    text = f"the arm does not go to rest: {why}; it holds"
    s.events.append(Event("warning", code, text))
    s.state = replace(s.state, settle=Settle.NO)
    end_sequence(s, code, text)
    if s.state.mode is Mode.PARKING and s.state.motion is None:
        s.go(Trigger.STOPPED)
