"""What clients ask for, and the loop itself: carried out, or refused with the reason and nothing changed."""

from __future__ import annotations

import math
from itertools import pairwise

from armctl.config import ArmConfig
from armctl.control import jog
from armctl.control.detect import PAUSE_AGE_S
from armctl.control.machine import Motion, Settle, Trigger, replace
from armctl.control.sequences import SOFT_TORQUE, STILL_TICKS, abandon_settling
from armctl.control.tick import (
    Tick,
    end_sequence,
    finish_jog,
    finish_motion,
    latch,
    send_goal,
    stop_motion,
    take_over,
    torque_off,
    weak_joints,
)
from armctl.dynamixel import ax12a
from armctl.errors import IllegalTransition, RequestRefused
from armctl.messages import (
    Clear,
    Command,
    Connected,
    Event,
    Hold,
    HostLost,
    Jog,
    JointTrajectory,
    Mode,
    Park,
    Pause,
    Release,
    Resume,
    Run,
    SetRate,
    Teach,
    TeachEnd,
    TorqueOn,
    Write,
)

START_TOLERANCE_RAD = math.radians(2.0)
EDGE_TICKS = 2
"""How far outside its limits a joint may be found and still be energised, at the limit."""
MAX_POINTS = 4000
MINIMUM_RATE = 0.1
MAX_GRIP_RATIO = 0.5
"""A servo that grips harder for good gets hotter than it may."""


def carry_out(s: Tick, command: Command) -> None:
    """Carry out one command, or refuse it and change nothing."""
    before = s.state
    kept = len(s.writes), len(s.events), len(s.replies), s.goal
    try:
        match command:
            case Connected():
                _connected(s, command)
            case HostLost():
                # As if this process had died with it: no goal after the last, which is one tick ahead at most.
                if s.state.motion is not None:
                    finish_motion(s, "HOST_LOST", "")
                if s.state.jog is not None:
                    finish_jog(s, "HOST_LOST")
            case Hold(request_id):
                _hold(s, request_id)
            case TorqueOn(request_id):
                _torque_on(s, request_id)
            case Release(request_id):
                s.go(Trigger.RELEASE)
                if s.state.motion is not None:
                    finish_motion(s, "RELEASED", "")
                end_sequence(s, "RELEASED")
                s.state = replace(s.state, settle=Settle.NO, adopted=True)
                torque_off(s)
                s.reply(request_id, True)
            case Teach(request_id):
                s.go(Trigger.TEACH)
                torque_off(s)
                # Whatever torque there was is not to be taken over any more.
                s.state = replace(s.state, request_id=request_id, adopted=True)
            case TeachEnd(request_id):
                s.go(Trigger.TEACH_END)
                end_sequence(s, "TEACH_ENDED")
                s.reply(request_id, True)
            case Run(request_id, trajectory):
                _run(s, request_id, trajectory)
            case Pause(request_id):
                _change_run(s, "pause", paused=True)
                s.reply(request_id, True)
            case Resume(request_id):
                _change_run(s, "resume", paused=False)
                s.reply(request_id, True)
            case SetRate(request_id, rate):
                if not MINIMUM_RATE <= rate <= 1.0:
                    raise RequestRefused("LIMIT", f"rate {rate:g} lies outside {MINIMUM_RATE:g} to 1")
                _change_run(s, "rate", wanted_rate=rate)
                s.reply(request_id, True)
            case Jog(request_id):
                (jog.begin if command.begin else jog.heartbeat)(s, command)
                s.reply(request_id, True)
            case Park(request_id):
                s.go(Trigger.PARK)
                s.state = replace(s.state, request_id=request_id, settle=Settle.STOP)
            case Clear(request_id):
                _clear(s, request_id)
    except RequestRefused as refusal:
        s.state = before
        del s.writes[kept[0] :], s.events[kept[1] :], s.replies[kept[2] :]
        s.goal = kept[3]
        s.reply(getattr(command, "request_id", None), False, refusal.code, str(refusal))


def _connected(s: Tick, command: Connected) -> None:
    text = "every servo answers as the calibration says"
    if s.state.fault is not None and s.state.fault.code == "PORT_GONE" and not s.state.connected:
        s.events.append(Event("warning", "PORT_BACK", "the port is back; the fault stays until `armctl clear`"))
    if command.restarted:
        s.events.append(Event("warning", "RESTARTED", "the control process was restarted; the arm is taken as found"))
    s.state = replace(s.state, connected=True, adopted=s.state.fault is not None, problems=command.problems)
    if command.problems and s.state.mode is not Mode.FAULTED:
        first = command.problems[0]
        text = "; ".join(problem.text for problem in command.problems)
        latch(s, first.code, text, first.servo_id)
    elif not command.problems:
        s.events.append(Event("info", "CONNECTED", text))


def _hold(s: Tick, request_id: int) -> None:
    if s.state.settle is not Settle.NO:
        abandon_settling(s, "STOPPED", "it was stopped")
    if s.state.motion is not None or s.state.jog is not None:
        stop_motion(s, "STOPPED")
        s.state = replace(s.state, hold_request_ids=(*s.state.hold_request_ids, request_id))
        return
    limp = s.state.mode in (Mode.OFF, Mode.TEACHING)
    s.reply(request_id, True, message="the arm is limp; there is nothing to hold" if limp else "")


def _torque_on(s: Tick, request_id: int) -> None:
    s.go(Trigger.TORQUE_ON)
    if not s.state.adopted or not s.fresh or len(s.state.last_ticks) != len(s.joints):
        raise RequestRefused("NO_REPLY", "not every servo answered just now; see `armctl status`")
    ticks = []
    for joint, registers, last in zip(s.arm.joints, s.registers, s.state.last_ticks, strict=True):
        assert registers is not None
        if abs(registers.position - last) > STILL_TICKS:
            raise RequestRefused("JUMP_REFUSED", f"joint {joint.name} is moving; hold the arm still")
        low, high = joint.limits_tick
        if not low - EDGE_TICKS <= registers.position <= high + EDGE_TICKS:
            found = math.degrees(joint.position_rad(registers.position))
            raise RequestRefused(
                "LIMIT",
                f"joint {joint.name} is at {found:.1f} deg, outside {joint.limits_deg[0]:g} to "
                f"{joint.limits_deg[1]:g}; move it inside by hand",
            )
        ticks.append(min(max(registers.position, low), high))
    for joint, reading in zip(s.arm.joints, s.inputs.sample.servos, strict=True):
        compliance = joint.compliance
        for register, value in (
            (ax12a.CW_MARGIN, compliance.margin),
            (ax12a.CCW_MARGIN, compliance.margin),
            (ax12a.CW_SLOPE, compliance.slope),
            (ax12a.CCW_SLOPE, compliance.slope),
            (ax12a.PUNCH, compliance.punch),
            (ax12a.TORQUE_LIMIT, SOFT_TORQUE),
        ):
            if ax12a.register_value(register, reading.registers) != value:
                s.writes.append(Write(joint.servo_id, register.address, register.size, value))
    send_goal(s, ticks)
    s.state = replace(s.state, request_id=request_id, anchor=tuple(ticks))


def _run(s: Tick, request_id: int, trajectory: JointTrajectory) -> None:
    s.go(Trigger.RUN)
    _check_trajectory(trajectory, s.arm)
    assert s.state.goal is not None
    for joint, tick, start in zip(s.arm.joints, s.state.goal, trajectory.positions_rad[0], strict=True):
        away = abs(joint.position_rad(tick) - start)
        if away > START_TOLERANCE_RAD:
            raise RequestRefused(
                "START_MISMATCH",
                f"joint {joint.name}: the motion starts {math.degrees(away):.1f} deg from where the arm is (bound 2)",
            )
    s.state = replace(s.state, motion=Motion(trajectory, request_id))
    s.events.append(Event("info", "RUN_ACCEPTED", f"{trajectory.label} ({trajectory.duration_s:.1f} s)"))


def _change_run(s: Tick, what: str, **changes: float | bool) -> None:
    motion = s.state.motion
    if s.state.mode is not Mode.MOVING or motion is None or motion.stop_code:
        raise IllegalTransition(f"{what}: no run is under way")
    s.state = replace(s.state, motion=replace(motion, **changes))  # type: ignore[arg-type]  # by name, from above


def _check_trajectory(trajectory: JointTrajectory, arm: ArmConfig) -> None:
    """The last wall before the wire: shape, numbers, limits and joint speed.

    Raises:
        RequestRefused: code LIMIT, with joint, value and bound.
    """
    points = trajectory.positions_rad
    if not 2 <= len(points) <= MAX_POINTS:
        raise RequestRefused("LIMIT", f"a trajectory has 2 to {MAX_POINTS} points, not {len(points)}")
    if not (math.isfinite(trajectory.period_s) and 0.001 <= trajectory.period_s <= 1.0):
        raise RequestRefused("LIMIT", f"trajectory period {trajectory.period_s} s lies outside 0.001 to 1 s")
    for point in points:
        if len(point) != len(arm.joints) or not all(map(math.isfinite, point)):
            raise RequestRefused("LIMIT", f"every point needs {len(arm.joints)} finite joint positions")
    grip = trajectory.grip
    if grip is not None and not (0 <= grip.joint < len(arm.joints) and 0.0 < grip.load_ratio <= MAX_GRIP_RATIO):
        raise RequestRefused(
            "LIMIT",
            f"a grip needs one of the {len(arm.joints)} joints and a load within 0 to {MAX_GRIP_RATIO:g}, not joint "
            f"{grip.joint} and {grip.load_ratio:g}",
        )
    for i, joint in enumerate(arm.joints):
        low, high = joint.limits_rad
        column = [point[i] for point in points]
        worst = min(column) if low - min(column) > max(column) - high else max(column)
        if not low - ax12a.TICK_RAD <= worst <= high + ax12a.TICK_RAD:
            raise RequestRefused(
                "LIMIT",
                f"joint {joint.name} would go to {math.degrees(worst):.1f} deg, outside {joint.limits_deg[0]:g} to "
                f"{joint.limits_deg[1]:g}",
            )
        speed = max(abs(b - a) for a, b in pairwise(column)) / trajectory.period_s
        if speed > joint.speed_limit_rad_s * 1.001:
            raise RequestRefused(
                "LIMIT",
                f"joint {joint.name} would turn at {math.degrees(speed):.0f} deg/s; its limit is "
                f"{joint.speed_limit_deg_s:g}",
            )


def _clear(s: Tick, request_id: int) -> None:
    if s.state.fault is None:
        s.reply(request_id, True, message="no fault is latched")
        return
    if s.state.motion is not None or s.state.settle is not Settle.NO:
        raise RequestRefused("NOT_CLEARED", "the arm is still coming to rest; try again")
    causes = persisting_causes(s)
    if causes:
        raise RequestRefused("NOT_CLEARED", f"the cause of {s.state.fault.code} persists: {'; '.join(causes)}")
    powered = [registers is not None and registers.torque_enabled for registers in s.registers]
    s.go(Trigger.CLEAR_POWERED if all(powered) else Trigger.CLEAR_LIMP)
    s.state = replace(s.state, fault=None, adopted=True)
    if all(powered):
        take_over(s)
    s.reply(request_id, True)


def persisting_causes(s: Tick) -> list[str]:
    """Why the latched fault cannot be cleared now, each with what to do about it; empty if it can."""
    if not s.inputs.sample.port_open or not s.state.connected:
        return ["the serial port is not open; plug the adapter in"]
    causes = [problem.text for problem in s.state.problems]
    named = list(zip(s.arm.joints, s.joints, s.registers, strict=True))
    # By age: one reply that was lost just now says nothing about a servo that answers.
    silent = [joint.name for joint, now, _ in named if not now.known or now.age_s > PAUSE_AGE_S]
    if silent:
        return [*causes, f"no reply from {', '.join(silent)}; check the cable and the supply"]
    limit_degC = s.arm.temperature_limit_degC
    if hot := [joint.name for joint, now, _ in named if now.temperature_degC >= limit_degC]:
        causes.append(f"{', '.join(hot)} above {limit_degC:g} degC; let it cool")
    low_V, high_V = s.arm.voltage_V
    if wrong := [f"{now.voltage_V:.1f} V" for _, now, _ in named if not low_V <= now.voltage_V <= high_V]:
        causes.append(f"the supply gives {wrong[0]}, outside {low_V:g} to {high_V:g} V; check the power supply")
    on = [bool(registers and registers.torque_enabled) for _, _, registers in named]
    limp = [joint.name for joint, _, registers in named if not (registers and registers.torque_limit)]
    limp = limp or [joint.name for (joint, _, _), torque in zip(named, on, strict=True) if not torque]
    if any(on) and limp:
        causes.append(f"{', '.join(limp)} limp while others hold; support the arm and type `armctl release`")
    elif weak := ", ".join(s.arm.joint_names[i] for i in weak_joints(s)):
        causes.append(f"{weak} without full torque; support the arm and type `armctl release`")
    return causes
