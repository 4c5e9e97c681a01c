"""What clients ask for, and the loop itself: carried out, or refused with the reason and nothing changed.

Every request is checked before its first change, so that a refusal has nothing to take back.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from armctl import messages
from armctl.config import ArmConfig
from armctl.control import jog
from armctl.control.detect import PAUSE_AGE_S
from armctl.control.faults import SETTLING, Cause
from armctl.control.machine import TO_REST, Motion, Phase, Trigger
from armctl.control.motion import set_off
from armctl.control.pairs import mismatches
from armctl.control.sequences import soften
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a
from armctl.errors import IllegalTransition, RequestRefused
from armctl.messages import Command, Event, JointTrajectory, LagModel, Mode, most_points
from armctl.trajectory.preflight import EDGE_TICKS

START_TOLERANCE_RAD = math.radians(2.0)
MINIMUM_RATE = 0.1
# A servo that grips harder for good gets hotter than it may.
MAX_GRIP_RATIO = 0.5
# What is over only once the servos, or the arm's rest, show it.
ANSWERED_LATER = messages.TorqueOn | messages.Release | messages.Teach | messages.Run | messages.Park


def carry_out(s: Tick, command: Command) -> None:
    """Carry out one command, or refuse it and change nothing."""
    try:
        answer = _carry_out(s, command)
    except RequestRefused as refusal:
        s.reply(getattr(command, "request_id", None), False, refusal.code, str(refusal))
    else:
        if answer is not None:
            s.reply(getattr(command, "request_id", None), True, message=answer)


def _carry_out(s: Tick, command: Command) -> str | None:
    """What there is to say about a command that is done, if somebody waits for it; None: its reply comes later.

    Raises:
        RequestRefused: it is not to be carried out; nothing has changed.
    """
    state = s.state
    match command:
        case messages.Connected():
            _connected(s, command)
        case messages.HostLost():
            # As if this process had died with it: no goal after the last, which is one tick ahead at most.
            if state.motion is not None:
                s.finish_motion("HOST_LOST", "")
            if state.jog is not None:
                s.finish_jog("HOST_LOST")
        case messages.HostSilent():
            s.events.append(Event("warning", "HOST_SILENT", "no word of the daemon for 0.3 s; a motion slows down"))
            _slow_down(s, "HOST_SILENT", "the daemon is silent")
        case messages.TorqueOn(request_id):
            _torque_on(s, request_id)
        case messages.Release(request_id):
            state.target(Trigger.RELEASE)
            s.end_sequence("RELEASED")
            s.go(Trigger.RELEASE)
            if state.motion is not None:
                s.finish_motion("RELEASED", "")
            s.let_go(request_id)
        case messages.Teach(request_id):
            s.go(Trigger.TEACH)
            s.let_go(request_id)
        case messages.Run(request_id, trajectory):
            _run(s, request_id, trajectory)
        case messages.Park(request_id):
            s.go(Trigger.PARK)
            state.request_id = request_id
        case messages.Hold(request_id):
            return _hold(s, request_id)
        case messages.TeachEnd():
            s.state.target(Trigger.TEACH_END)
            s.end_sequence("TEACH_ENDED")
            s.go(Trigger.TEACH_END)
        case messages.Pause():
            _under_way(s, "pause").paused = True
        case messages.Resume():
            _under_way(s, "resume").paused = False
        case messages.SetRate(_, rate):
            if not MINIMUM_RATE <= rate <= 1.0:
                raise RequestRefused("LIMIT", f"rate {rate:g} lies outside {MINIMUM_RATE:g} to 1")
            _under_way(s, "rate").wanted_rate = rate
        case messages.Jog():
            (jog.begin if command.begin else jog.heartbeat)(s, command)
        case messages.Clear():
            return _clear(s)
        case messages.UseModel(_, model):
            _use_model(s, model)
    return None if isinstance(command, ANSWERED_LATER) else ""


def _connected(s: Tick, command: messages.Connected) -> None:
    state = s.state
    if not state.connected and any(fault.code == "PORT_GONE" for fault in state.faults):
        s.events.append(Event("warning", "PORT_BACK", "the port is back; the fault stays until `armctl clear`"))
    if command.restarted:
        s.events.append(Event("warning", "RESTARTED", "the control process was restarted; the arm is taken as found"))
    state.connected, state.problems = True, command.problems
    if not command.problems:
        s.events.append(Event("info", "CONNECTED", "every servo answers as the calibration says"))
    for problem in command.problems:
        s.latch(problem.code, problem.text, problem.servo_id)


def _slow_down(s: Tick, code: str, why: str) -> None:
    """Bring to rest whatever moves, on its path."""
    if s.state.phase in TO_REST:
        s.give_up_rest(code, why)
    s.stop_motion(code)


def _hold(s: Tick, request_id: int) -> str | None:
    state = s.state
    _slow_down(s, "STOPPED", "it was stopped")
    # Also where the way to rest is not under way just now, because it waits for a servo that does not answer.
    state.stays |= any(fault.code in SETTLING for fault in state.faults)
    if state.motion is not None or state.jog is not None:
        state.hold_request_ids = (*state.hold_request_ids, request_id)
        return None
    limp = state.mode in (Mode.OFF, Mode.TEACHING, Mode.RELEASING)
    return "the arm is limp; there is nothing to hold" if limp else ""


def _torque_on(s: Tick, request_id: int) -> None:
    state = s.state
    found = state.phase is Phase.FOUND  # its servos are not taken over yet, because not all of them were heard
    if not found:
        state.target(Trigger.TORQUE_ON)
    if found or not s.fresh or not state.last_ticks:
        raise RequestRefused("NO_REPLY", "not every servo answered just now; see `armctl status`")
    for cause, text in persisting_causes(s):
        if code := {Cause.HEAT: "HOT", Cause.SUPPLY: "VOLTAGE"}.get(cause):
            raise RequestRefused(code, f"the arm would go to rest: {text}")
    ticks = []
    for index, servo in enumerate(s.wire):
        position, still, _ = s.limp_shaft(index)
        if still is False:
            raise RequestRefused("JUMP_REFUSED", f"joint {servo.name} is moving; hold the arm still")
        if not servo.low_tick - EDGE_TICKS <= position <= servo.high_tick + EDGE_TICKS:
            position_deg, (low, high) = math.degrees(servo.position_rad(position)), s.arm.joints[servo.of].limits_deg
            problem = f"is at {position_deg:.1f} deg, outside {low:g} to {high:g}; move it inside by hand"
            raise RequestRefused("LIMIT", f"joint {servo.name} {problem}")
        ticks.append(position)
    s.go(Trigger.TORQUE_ON)
    soften(s)
    state.powered = None
    state.request_id, state.anchor = request_id, tuple(ticks)


def _run(s: Tick, request_id: int, trajectory: JointTrajectory) -> None:
    s.state.target(Trigger.RUN)
    if problem := _against(trajectory, s.arm):
        raise RequestRefused("LIMIT", problem)
    for joint, q, start in zip(s.arm.joints, s.wanted_rad(), trajectory.positions_rad[0], strict=True):
        away = abs(q - start)
        if away > START_TOLERANCE_RAD:
            problem = f"the motion starts {math.degrees(away):.1f} deg from where the arm is (bound 2)"
            raise RequestRefused("START_MISMATCH", f"joint {joint.name}: {problem}")
    s.go(Trigger.RUN)
    s.state.motion = Motion(trajectory, request_id)
    set_off(s, corrected=trajectory.corrected)
    s.events.append(Event("info", "RUN_ACCEPTED", f"{trajectory.label} ({trajectory.duration_s:.1f} s)"))


def _use_model(s: Tick, model: LagModel) -> None:
    """Foresee the lag by this model from now on.

    Raises:
        IllegalTransition: the arm moves.
        RequestRefused: it is another arm's, or of another calibration.
    """
    if s.state.motion is not None or s.state.jog is not None:
        raise IllegalTransition("the arm moves; its model is changed at rest alone")
    arm, n = s.arm, s.robot.chain.n
    if (model.arm_id, model.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        whose = f"{model.arm_id}, calibration {model.calibration_hash}"
        raise RequestRefused("MODEL", f"a lag model of {whose}; this is {arm.arm_id}, {arm.calibration_hash}")
    if len(model.rows) != n or any(len(row) != n + 3 or not all(map(math.isfinite, row)) for row in model.rows):
        raise RequestRefused("MODEL", f"a lag model of this arm has {n} rows of {n + 3} finite numbers")
    s.state.model = model


def _under_way(s: Tick, what: str) -> Motion:
    """The run that a request is to change.

    Raises:
        IllegalTransition: there is none, or it is being stopped.
    """
    motion = s.state.motion
    if s.state.phase is not Phase.MOVING or motion is None or motion.stop_code:
        raise IllegalTransition(f"{what}: no run is under way")
    return motion


def _against(trajectory: JointTrajectory, arm: ArmConfig) -> str:
    """The last wall before the wire: what shape, numbers, limits or joint speed forbid, with joint, value and bound."""
    points, times, most = trajectory.positions_rad, trajectory.times_s, most_points(len(arm.joints))
    if not 2 <= len(points) <= most:
        return f"a trajectory has 2 to {most} points, not {len(points)}"
    if times and len(times) != len(points):
        return f"every point needs a time of its own, or none has one: {len(times)} for {len(points)} points"
    if times and not (times[0] == 0.0 and all(a < b for a, b in pairwise(times)) and math.isfinite(times[-1])):
        return "the times of a trajectory must rise from 0"
    if not (math.isfinite(trajectory.period_s) and 0.001 <= trajectory.period_s <= 1.0):
        return f"trajectory period {trajectory.period_s} s lies outside 0.001 to 1 s"
    for point in points:
        if len(point) != len(arm.joints) or not all(map(math.isfinite, point)):
            return f"every point needs {len(arm.joints)} finite joint positions"
    grip = trajectory.grip
    if grip is not None and not (0 <= grip.joint < len(arm.joints) and 0.0 < grip.load_ratio <= MAX_GRIP_RATIO):
        needed = f"one of the {len(arm.joints)} joints and a load within 0 to {MAX_GRIP_RATIO:g}"
        return f"a grip needs {needed}, not joint {grip.joint} and {grip.load_ratio:g}"
    steps_s = [b - a for a, b in pairwise(times)] or [trajectory.period_s] * (len(points) - 1)
    for i, joint in enumerate(arm.joints):
        low, high = joint.limits_rad
        column = [point[i] for point in points]
        worst = min(column) if low - min(column) > max(column) - high else max(column)
        if not low - ax12a.TICK_RAD <= worst <= high + ax12a.TICK_RAD:
            bounds = f"{joint.limits_deg[0]:g} to {joint.limits_deg[1]:g}"
            return f"joint {joint.name} would go to {math.degrees(worst):.1f} deg, outside {bounds}"
        speed = max(abs(b - a) / step_s for (a, b), step_s in zip(pairwise(column), steps_s, strict=True))
        if speed > joint.speed_limit_rad_s * 1.001:
            bound = f"its limit is {joint.speed_limit_deg_s:g}"
            return f"joint {joint.name} would turn at {math.degrees(speed):.0f} deg/s; {bound}"
    return ""


# ------------------------------------------------------------------------------------------- clearing a fault


def _clear(s: Tick) -> str:
    state = s.state
    if state.fault is None:
        return "no fault is latched"
    if state.motion is not None or (state.phase in TO_REST and state.phase is not Phase.FAULT_STOPPING):
        raise RequestRefused("NOT_CLEARED", "the arm is still coming to rest; try again")
    causes = "; ".join(text for _, text in persisting_causes(s))
    if causes:
        raise RequestRefused("NOT_CLEARED", f"the cause of {state.fault.code} persists: {causes}")
    powered = all(servo and servo.torque_enabled for servo in s.servos)
    s.go(Trigger.CLEAR_POWERED if powered else Trigger.CLEAR_LIMP)
    state.faults, state.stays, state.noise = (), False, ()
    state.powered = powered
    if powered:
        s.take_over()
    return ""


def persisting_causes(s: Tick) -> Iterator[tuple[Cause, str]]:
    """Why no fault can be cleared now, each with what to do about it; in the order of `Cause`."""
    if not s.inputs.sample.port_open or not s.state.connected:
        yield Cause.PORT, "the serial port is not open; plug the adapter in"
        return
    for problem in s.state.problems:
        yield Cause.PROBLEM, problem.text
    # By age: one reply that was lost just now says nothing about a servo that answers.
    if silent := _names(s, [not now.known or now.age_s > PAUSE_AGE_S for now in s.each]):
        yield Cause.SILENCE, f"no reply from {silent}; check the cable and the supply"
        return  # what the servos said long ago tells nothing about now
    limit_degC = s.arm.temperature_limit_degC
    if hot := _names(s, [now.temperature_degC >= limit_degC for now in s.each]):
        yield Cause.HEAT, f"{hot} above {limit_degC:g} degC; let it cool"
    low_V, high_V = s.arm.voltage_V
    if wrong := [f"{now.voltage_V:.1f} V" for now in s.each if not low_V <= now.voltage_V <= high_V]:
        text = f"the supply gives {wrong[0]}, outside {low_V:g} to {high_V:g} V; check the power supply"
        yield Cause.SUPPLY, text
    if apart := "; ".join(mismatches(s)):
        yield Cause.PAIR, f"{apart}; see the horns, or type `armctl calibrate --pairs`"
    if s.state.letting_go is not None:
        names = _names(s, [i in s.state.letting_go.stiff for i in range(len(s.wire))])
        yield Cause.TORQUE, f"torque is still going off ({names}); support the arm and type `armctl release`"
        return
    if goal := () if s.state.yielded else s.state.goal:
        away = [bool(now and now.torque_enabled and now.goal != at) for now, at in zip(s.servos, goal, strict=True)]
        if any(away):
            yield Cause.GOAL, f"{_names(s, away)} is still being taken back to its last goal from here; try again"
    on = [bool(servo and servo.torque_enabled) for servo in s.servos]
    limp = _names(s, [not (servo and servo.torque_limit) for servo in s.servos])
    limp = limp or _names(s, [not torque for torque in on])
    if any(on) and limp:
        yield Cause.TORQUE, f"{limp} limp while others hold; support the arm and type `armctl release`"
    elif weak := _names(s, [i in s.weak_servos() for i in range(len(s.wire))]):
        yield Cause.TORQUE, f"{weak} without full torque; support the arm and type `armctl release`"


def _names(s: Tick, which: Sequence[bool]) -> str:
    """The joints of these servos."""
    return ", ".join(dict.fromkeys(servo.name for servo, named in zip(s.wire, which, strict=True) if named))
