"""What goes on over several ticks: taking an arm over, torque coming on, a motion, the slow way to rest.

Every stage is decided by what the servos report, not by what was written to them.
"""

from __future__ import annotations

import math

from armctl.control.detect import SILENT_AGE_S
from armctl.control.jog import advance_jog
from armctl.control.machine import Motion, Settle, Trigger, replace
from armctl.control.tick import (
    Tick,
    all_powered,
    end_sequence,
    finish_motion,
    full_torque,
    latch_servo,
    send_goal,
    share_of_step,
    stop_motion,
    take_over,
    torque_off,
    weak_joints,
    whole_ticks,
)
from armctl.dynamixel import ax12a
from armctl.messages import (
    Event,
    Grip,
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
ENERGISE_AWAY_TICKS = 2
"""0.6 deg: no servo takes torque with a goal farther from its shaft."""
RAMP_TICKS = 5
ENERGISE_TICKS = RAMP_TICKS + 10
"""A servo that does not show its full torque limit by then refuses it."""
JUMP_RAD = math.radians(6.0)
SEQUENCE_TICKS = 5
"""How long a sequence waits for the servos to confirm a step."""
REST_TOLERANCE_RAD = math.radians(3.0)
VERIFY_TICKS = 20
GRIP_TICKS = 2
"""A load felt once may be the servo setting off."""


def adopt(s: Tick) -> None:
    """Take over what the servos are doing: torque on stays on at its goal, off stays off."""
    if not s.state.connected or s.state.adopted or s.state.fault is not None or not s.fresh:
        return
    powered = [registers is not None and registers.torque_enabled for registers in s.registers]
    s.state = replace(s.state, adopted=True)
    tripped = [i for i, registers in enumerate(s.registers) if registers is not None and registers.torque_limit == 0]
    if any(powered) and tripped:
        latch_servo(s, "TRIPPED", tripped[0], "found shut down (torque limit 0) while other servos hold")
    elif all(powered) and (weak := weak_joints(s)):
        limit = s.registers[weak[0]].torque_limit  # type: ignore[union-attr]  # it shows torque
        latch_servo(s, "LOST_TORQUE", weak[0], f"found with torque limit {limit}: its torque-on was interrupted")
    elif all(powered):
        s.go(Trigger.ADOPT_POWERED)
        take_over(s)
    elif any(powered):
        index = powered.index(False)
        latch_servo(s, "LOST_TORQUE", index, "found limp while other servos hold")


def advance(s: Tick) -> None:
    if s.state.mode is Mode.ENERGISING and s.state.phase > 0:
        _energise(s)
    elif s.state.mode is Mode.TEACHING and s.state.request_id is not None and s.state.phase > 0:
        _verify_limp(s)
    if s.inputs.late_ns > LATE_NS:
        s.events.append(Event("warning", "LATE", f"a tick came {s.inputs.late_ns / 1e6:.0f} ms late (bound 250)"))
        stop_motion(s, "LATE")
    if s.state.settle is not Settle.NO:
        _settle(s)
    if s.state.motion is not None:
        _move(s, s.state.motion)
    if s.state.jog is not None:
        advance_jog(s, s.state.jog)


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
    elif s.state.phase == 1 and any(_drifted(s, i, anchor[i]) > ENERGISE_AWAY_TICKS for i in range(len(anchor))):
        # Torque would pull a shaft back to where it was: another goal, to be looked at again.
        here = tuple(_within_limits(s, i) if _drifted(s, i, was) else was for i, was in enumerate(anchor))
        s.state = replace(s.state, anchor=here, phase=0)
        send_goal(s, here)
    elif s.state.phase == 1:
        s.writes.extend(Write(i, ax12a.TORQUE_ENABLE.address, ax12a.TORQUE_ENABLE.size, 1) for i in s.arm.servo_ids)
        send_goal(s, anchor)  # again: a limp servo may have let its goal follow the shaft
    elif 1 <= ramp <= RAMP_TICKS:
        for joint in s.arm.joints:
            limit = round(SOFT_TORQUE + (full_torque(joint) - SOFT_TORQUE) * ramp / RAMP_TICKS)
            s.writes.append(Write(joint.servo_id, ax12a.TORQUE_LIMIT.address, ax12a.TORQUE_LIMIT.size, limit))
    elif ramp > RAMP_TICKS and _at_full_torque(s):
        s.reply(s.state.request_id, True)
        s.go(Trigger.ENERGISED)
        s.state = replace(s.state, request_id=None, anchor=None)
        take_over(s)


def _within_limits(s: Tick, index: int) -> int:
    """Where a shaft is [tick], or the limit that it is just beyond."""
    registers, (low, high) = s.registers[index], s.arm.joints[index].limits_tick
    assert registers is not None
    return min(max(registers.position, low), high)


def _drifted(s: Tick, index: int, anchor: int) -> int:
    """How far a limp shaft has come since energising began [tick]; one under torque, soft as it is, only sags."""
    registers = s.registers[index]
    assert registers is not None
    return 0 if registers.torque_enabled else abs(_within_limits(s, index) - anchor)


def _at_full_torque(s: Tick) -> bool:
    """Whether every servo shows the torque limit it is to hold with; one that missed the ramp's end is told again."""
    behind = [
        joint
        for joint, registers in zip(s.arm.joints, s.registers, strict=True)
        if registers is not None and registers.torque_limit != full_torque(joint)
    ]
    s.writes.extend(
        Write(joint.servo_id, ax12a.TORQUE_LIMIT.address, ax12a.TORQUE_LIMIT.size, full_torque(joint))
        for joint in behind
    )
    return not behind


def _surprise(s: Tick, index: int, anchor: int) -> str:
    """What is not as it should be with one servo while torque comes on; empty if nothing."""
    joint, registers = s.arm.joints[index], s.registers[index]
    assert registers is not None
    who = f"servo {joint.servo_id} ({joint.name})"
    if s.state.phase == 1 and _drifted(s, index, anchor) > STILL_TICKS:
        return f"{who} moved while torque came on; hold the arm still and try again"
    if abs(registers.position - anchor) * ax12a.TICK_RAD > JUMP_RAD:
        return f"{who} moved while torque came on; support the arm and try again"
    if abs(registers.goal - anchor) > (STILL_TICKS if s.state.phase == 1 else 0):
        return f"{who} shows goal {registers.goal} where {anchor} was written"
    if s.state.phase == 1 and registers.torque_limit != SOFT_TORQUE:
        return f"{who} shows torque limit {registers.torque_limit} where {SOFT_TORQUE} was written"
    if s.state.phase > 1 and not registers.torque_enabled:
        return f"{who} did not take torque"
    if s.state.phase > ENERGISE_TICKS and registers.torque_limit != full_torque(joint):
        return f"{who} shows torque limit {registers.torque_limit}; it does not take {full_torque(joint)}"
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
    if trajectory.grip is not None and s.fresh and not motion.stop_code:
        resisted = _resists(s, trajectory.grip)
        motion = replace(motion, resisted_ticks=motion.resisted_ticks + 1 if resisted else 0)
        s.state = replace(s.state, motion=motion)
        if motion.resisted_ticks >= GRIP_TICKS:
            return _hold_gripped(s, motion, trajectory.grip)
        if resisted:
            return None  # no closer: the goal stays where its distance made the load
    if motion.progress_s >= trajectory.duration_s:
        return finish_motion(s, motion.stop_code, "")
    # A goal would energise a servo that has just restarted: none goes out while one is unheard.
    wanted = 0.0 if motion.stop_code or motion.paused or not s.fresh else motion.wanted_rate
    change = s.period_s / STOP_S
    rate = max(wanted, motion.rate - change) if motion.rate > wanted else min(wanted, motion.rate + change)
    if rate == 0.0 and motion.stop_code:
        return finish_motion(s, motion.stop_code, "")
    if not s.fresh:
        s.state = replace(s.state, motion=replace(motion, rate=rate))
        return None
    if not all_powered(s):
        return finish_motion(s, motion.stop_code or "LOST_TORQUE", "")
    progress_s = min(motion.progress_s + rate * s.period_s, trajectory.duration_s)
    goal = _goal_at(s, trajectory, progress_s)
    share = share_of_step(s, goal)
    if share < 1.0:
        progress_s = motion.progress_s + share * (progress_s - motion.progress_s)
        goal = _goal_at(s, trajectory, progress_s)
    s.state = replace(s.state, motion=replace(motion, progress_s=progress_s, rate=rate))
    send_goal(s, goal)
    return None


def _resists(s: Tick, grip: Grip) -> bool:
    """Whether the gripper's load stands against its goal."""
    assert s.state.goal is not None
    registers, joint = s.registers[grip.joint], s.arm.joints[grip.joint]
    assert registers is not None
    behind = joint.direction * (s.state.goal[grip.joint] - registers.position)
    load_ratio = s.joints[grip.joint].load_ratio
    return abs(load_ratio) >= grip.load_ratio and load_ratio * behind > 0.0


def _hold_gripped(s: Tick, motion: Motion, grip: Grip) -> None:
    """End the motion with the goal so far inside what is gripped that the servo keeps the load asked for."""
    assert s.state.goal is not None
    registers, joint = s.registers[grip.joint], s.arm.joints[grip.joint]
    assert registers is not None
    load_ratio = abs(s.joints[grip.joint].load_ratio)
    inside = (s.state.goal[grip.joint] - registers.position) * grip.load_ratio / load_ratio
    goal = list(s.state.goal)
    goal[grip.joint] = registers.position + round(inside)
    send_goal(s, goal)
    found = (
        f"{joint.name} grips at {math.degrees(joint.position_rad(registers.position)):.1f} deg, load {load_ratio:.0%}"
    )
    s.events.append(Event("info", "GRIPPED", found))
    s.reply(motion.request_id, True, "GRIPPED", found)
    s.state = replace(s.state, motion=replace(motion, request_id=None))
    finish_motion(s, "", "")


def _goal_at(s: Tick, trajectory: JointTrajectory, time_s: float) -> list[int]:
    q = sample_trajectory(trajectory, time_s)
    return whole_ticks(s, q)


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
    if not all_powered(s):
        return abandon_settling(s, "LOST_TORQUE", "a servo has no torque")
    if any(_overruled(s, i) for i in range(len(goal))):
        return abandon_settling(s, "OTHER_WRITER", "a servo restarted, or another program writes to the bus")
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


def _overruled(s: Tick, index: int) -> bool:
    """Whether a servo shows a goal or settings that are not from here; a latched arm is not watched for that else."""
    registers, goal = s.registers[index], s.state.goal
    assert registers is not None
    assert goal is not None
    known = (goal[index], (s.state.previous_goal or goal)[index])
    return registers.goal not in known or registers.settings != s.state.settings[index]


def abandon_settling(s: Tick, code: str, why: str) -> None:
    """Hold instead: torque is never cut but at rest."""
    stop_motion(s, code)
    text = f"the arm does not go to rest: {why}; it holds"
    s.events.append(Event("warning", code, text))
    s.state = replace(s.state, settle=Settle.NO)
    end_sequence(s, code, text)
    if s.state.mode is Mode.PARKING and s.state.motion is None:
        s.go(Trigger.STOPPED)
