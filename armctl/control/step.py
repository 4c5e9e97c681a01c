"""One control step, pure: (state, inputs) -> (state, outputs).

Rules.
1. All time comes from the inputs, all memory is in the state: the same inputs give the same outputs, bit for
   bit, which is what makes every log a test.
2. Goals are positions of the trajectory one tick ahead; what stops feeding goals stops the arm within two.
3. A stop runs the trajectory's own time down to zero within `STOP_S`, so the arm stays on its path.
4. Torque is enabled only by the energising sequence, on request, at the position the arm has; it is disabled
   only on request (`release`, `teach`), at a rest pose that is seen, or to undo an energising that went wrong.
5. A fault latches. While it is latched nothing advances, save the deceleration of rule 3 and, for a fault that
   would soon end in a dropped arm, the slow way to rest.
6. What the servos report, not what was written, decides whether a sequence goes on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from armctl.config import ArmConfig
from armctl.control.faults import SETTLING
from armctl.control.machine import Motion, Settle, State, Trigger, transition
from armctl.dynamixel import ax12a
from armctl.errors import RequestRefused
from armctl.kinematics.chain import forward_kinematics
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import quaternion_from_matrix
from armctl.messages import (
    Clear,
    Command,
    Connected,
    Event,
    Fault,
    Goal,
    Hold,
    HostLost,
    Inputs,
    JointState,
    JointTrajectory,
    Mode,
    Outputs,
    Park,
    Release,
    Reply,
    Run,
    Teach,
    TeachEnd,
    ToolPose,
    TorqueOn,
    Write,
)
from armctl.trajectory.approach import approach_trajectory, lowest_link_m

STOP_S = 0.2
"""Time in which a stop brings the trajectory's rate from 1 to 0."""
PAUSE_AGE_S = 0.2
"""A motion pauses while any reading is older than this."""
SILENT_AGE_S = 0.5
"""A servo unheard for this long latches a fault."""
BLOCKED_RAD = math.radians(8.0)
BLOCKED_NS = 300_000_000
START_TOLERANCE_RAD = math.radians(2.0)
LATE_NS = 250_000_000
STILL_TICKS = 3
"""Largest change between two samples of an arm that counts as still (noise is one tick)."""
EDGE_TICKS = 2
"""How far outside its limits a joint may be found and still be energised, at the limit."""
SOFT_TORQUE = 128
"""Torque limit while torque comes on (12.5 %)."""
RAMP_TICKS = 5
JUMP_RAD = math.radians(6.0)
SEQUENCE_TICKS = 5
"""How long a sequence waits for the servos to confirm a step."""
MINIMUM_SPEED_UNITS = 16
"""Slowest moving speed written (10.7 deg/s): a servo that holds must keep the authority to return to its goal."""
MAX_POINTS = 4000
LOAD_RATIO = 0.8
LOAD_NS = 2_000_000_000
"""Load above 80 % for this long: a servo's own trip is near."""
NOISE_TICKS = 100
NOISE_SHARE = 0.1
REST_TOLERANCE_RAD = math.radians(3.0)
VERIFY_TICKS = 20


@dataclass
class _Step:
    """The outputs of one step, being collected."""

    state: State
    inputs: Inputs
    arm: ArmConfig
    robot: Robot
    period_s: float
    joints: tuple[JointState, ...]
    registers: tuple[_Registers | None, ...]
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


@dataclass(frozen=True, slots=True)
class _Registers:
    torque_enabled: bool
    goal: int
    torque_limit: int
    position: int


def step(state: State, inputs: Inputs, arm: ArmConfig, robot: Robot, period_s: float) -> tuple[State, Outputs]:
    """The next state and everything the arm is to be told.

    Args:
        state: What the last step remembered; `State()` at first.
        inputs: This tick's sample and commands; `sample.servos` in the order of `arm.joints`.
        period_s: Time between ticks.
    """
    s = _Step(
        state=replace(state, phase=state.phase + 1),
        inputs=inputs,
        arm=arm,
        robot=robot,
        period_s=period_s,
        joints=_joint_states(inputs, arm),
        registers=tuple(_decode(reading.registers) for reading in inputs.sample.servos),
    )
    _detect_faults(s)
    for command in inputs.commands:
        _command(s, command)
    _adopt(s)
    _advance(s)
    positions = tuple(r.position for r in s.registers if r is not None)
    s.state = replace(s.state, last_ticks=positions if len(positions) == len(arm.joints) else ())
    if s.goal is not None:
        s.state = replace(s.state, previous_goal=s.state.goal, goal=s.goal.ticks)
    motion = s.state.motion
    return s.state, Outputs(
        mode=s.state.mode,
        fault=s.state.fault,
        joints=s.joints,
        tool=_tool_pose(s.joints, robot),
        writes=tuple(s.writes),
        goal=s.goal,
        replies=tuple(s.replies),
        events=tuple(s.events),
        progress=None if motion is None else motion.progress_s / max(motion.trajectory.duration_s, 1e-9),
    )


# ------------------------------------------------------------------------------------------------ reading


def _decode(registers: bytes) -> _Registers | None:
    if not registers:
        return None
    return _Registers(
        torque_enabled=bool(ax12a.register_value(ax12a.TORQUE_ENABLE, registers)),
        goal=ax12a.register_value(ax12a.GOAL, registers),
        torque_limit=ax12a.register_value(ax12a.TORQUE_LIMIT, registers),
        position=ax12a.register_value(ax12a.PRESENT_POSITION, registers),
    )


def _joint_states(inputs: Inputs, arm: ArmConfig) -> tuple[JointState, ...]:
    states = []
    for reading, joint in zip(inputs.sample.servos, arm.joints, strict=True):
        block = reading.registers
        if not block:
            states.append(JointState(False, 0.0, 0.0, 0.0, 0.0, 0.0, False, inputs.now_ns / 1e9))
            continue
        states.append(
            JointState(
                known=True,
                position_rad=joint.position_rad(ax12a.register_value(ax12a.PRESENT_POSITION, block)),
                velocity_rad_s=joint.direction * ax12a.speed_rad_s(ax12a.register_value(ax12a.PRESENT_SPEED, block)),
                load_ratio=joint.direction * ax12a.load_ratio(ax12a.register_value(ax12a.PRESENT_LOAD, block)),
                voltage_V=ax12a.register_value(ax12a.PRESENT_VOLTAGE, block) / 10.0,
                temperature_degC=float(ax12a.register_value(ax12a.PRESENT_TEMPERATURE, block)),
                torque_enabled=bool(ax12a.register_value(ax12a.TORQUE_ENABLE, block)),
                age_s=(inputs.now_ns - reading.stamp_ns) / 1e9,
            )
        )
    return tuple(states)


def _tool_pose(joints: tuple[JointState, ...], robot: Robot) -> ToolPose | None:
    if not all(joint.known for joint in joints):
        return None
    q = np.array([joint.position_rad for joint in joints[: robot.chain.n]])
    T = forward_kinematics(robot.chain, q)
    x, y, z = T[:3, 3].tolist()
    return ToolPose((x, y, z), quaternion_from_matrix(T[:3, :3]))


# ------------------------------------------------------------------------------------------------- faults


def _detect_faults(s: _Step) -> None:
    """Latch the first fault of the sample; each test names the row of the fault matrix it implements."""
    if s.state.mode is Mode.FAULTED:
        return
    if not s.inputs.sample.port_open:
        _latch(s, "PORT_GONE", "the serial port is gone (adapter unplugged?)")
        return
    if not s.state.connected:
        return
    silent = [i for i, joint in enumerate(s.joints) if joint.age_s > SILENT_AGE_S]
    if len(silent) == len(s.joints) > 1:
        _latch(s, "BUS_DEAD", "no servo has answered for 0.5 s")
    elif silent:
        _latch_servo(s, "SERVO_SILENT", silent[0], "no reply for 0.5 s")
    elif s.state.mode in (Mode.HOLDING, Mode.MOVING, Mode.PARKING):
        _detect_power_faults(s)
        if s.state.fault is None:
            _detect_strain(s)
        if s.state.fault is None:
            _detect_noise(s)
    elif s.state.mode is Mode.TEACHING and s.state.request_id is None:
        powered = [i for i, r in enumerate(s.registers) if r is not None and r.torque_enabled]
        if powered:
            _latch_servo(s, "NOT_LIMP", powered[0], "torque came on while teaching, and not from here")


def _detect_power_faults(s: _Step) -> None:
    """Lost torque, a trip, a second writer, a blocked joint: faults of an arm under torque."""
    goal = s.state.goal
    assert goal is not None
    since = list(s.state.error_since_ns) or [0] * len(s.joints)
    lost = False
    for i, (registers, reading) in enumerate(zip(s.registers, s.inputs.sample.servos, strict=True)):
        if registers is None or not reading.fresh:
            continue
        if registers.torque_limit == 0:
            return _latch_servo(s, "TRIPPED", i, "the servo shut itself down (torque limit 0)")
        if not registers.torque_enabled:
            return _latch_servo(s, "LOST_TORQUE", i, "torque is off, and not by a command from here")
        if registers.goal not in (goal[i], (s.state.previous_goal or goal)[i]):
            found = f"goal {registers.goal} read back, {goal[i]} sent"
            return _latch_servo(s, "OTHER_WRITER", i, f"{found}: another program writes to the bus")
        lost |= registers.goal != goal[i]
        error_rad = abs(registers.position - goal[i]) * ax12a.TICK_RAD
        since[i] = (since[i] or s.inputs.now_ns) if error_rad > BLOCKED_RAD else 0
        if since[i] and s.inputs.now_ns - since[i] >= BLOCKED_NS:
            _latch_servo(s, "BLOCKED", i, f"{math.degrees(error_rad):.1f} deg away from its goal for 0.3 s (bound 8)")
            # Once, so that the servo stops pushing; never again and again, or gravity walks the arm down.
            _send_goal(s, [r.position if r else g for r, g in zip(s.registers, goal, strict=True)])
            return None
    s.state = replace(s.state, error_since_ns=tuple(since))
    if lost:
        _send_goal(s, goal)
    return None


def _detect_strain(s: _Step) -> None:
    """Heat, voltage and lasting load: what comes before a servo's own trip."""
    since = list(s.state.load_since_ns) or [0] * len(s.joints)
    low_V, high_V = s.arm.voltage_V
    for i, (joint, reading) in enumerate(zip(s.joints, s.inputs.sample.servos, strict=True)):
        if not reading.fresh:
            continue
        if joint.temperature_degC >= s.arm.temperature_limit_degC or reading.error & ax12a.ErrorBit.OVERHEAT:
            bound = f"bound {s.arm.temperature_limit_degC:g}"
            return _latch_servo(s, "HOT", i, f"{joint.temperature_degC:g} degC ({bound})")
        if not low_V <= joint.voltage_V <= high_V or reading.error & ax12a.ErrorBit.VOLTAGE:
            return _latch_servo(s, "VOLTAGE", i, f"{joint.voltage_V:.1f} V (bounds {low_V:g} to {high_V:g})")
        since[i] = (since[i] or s.inputs.now_ns) if abs(joint.load_ratio) > LOAD_RATIO else 0
        if since[i] and s.inputs.now_ns - since[i] >= LOAD_NS:
            return _latch_servo(s, "OVERLOAD", i, f"load {abs(joint.load_ratio):.0%} for 2 s (bound 80%)")
    s.state = replace(s.state, load_since_ns=tuple(since))
    return None


def _detect_noise(s: _Step) -> None:
    noisy = sum(reading.problem == "BUS_NOISE" for reading in s.inputs.sample.servos)
    noise = (*s.state.noise[1 - NOISE_TICKS :], noisy)
    s.state = replace(s.state, noise=noise)
    if sum(noise) > NOISE_SHARE * NOISE_TICKS * len(s.joints):
        share = sum(noise) / (len(noise) * len(s.joints))
        _latch(
            s, "BUS_NOISE", f"{share:.0%} of the replies came damaged in {len(noise) * s.period_s:.0f} s (bound 10%)"
        )


def _latch_servo(s: _Step, code: str, index: int, problem: str) -> None:
    joint = s.arm.joints[index]
    _latch(s, code, f"servo {joint.servo_id} ({joint.name}): {problem}", joint.servo_id)


def _latch(s: _Step, code: str, text: str, servo_id: int | None = None) -> None:
    s.events.append(Event("error", code, text, servo_id))
    if code in ("PORT_GONE", "BLOCKED", "OTHER_WRITER") and s.state.motion is not None:
        _finish_motion(s, code, text)
    elif s.state.motion is not None:
        s.state = replace(s.state, motion=replace(s.state.motion, stop_code=code))
    if s.state.settle is not Settle.NO:
        s.state = replace(s.state, settle=Settle.NO)
    if code in SETTLING:
        s.state = replace(s.state, settle=Settle.STOP)
    _end_sequence(s, code, text)
    s.go(Trigger.FAULT)
    s.state = replace(
        s.state,
        fault=Fault(code, text, s.inputs.now_ns, servo_id),
        error_since_ns=(),
        load_since_ns=(),
        noise=(),
        connected=s.state.connected and s.inputs.sample.port_open,
    )


# ----------------------------------------------------------------------------------------------- commands


def _command(s: _Step, command: Command) -> None:
    """Carry out one command, or refuse it and change nothing."""
    before = s.state
    kept = len(s.writes), len(s.events), len(s.replies), s.goal
    try:
        match command:
            case Connected():
                _connected(s, command)
            case HostLost():
                _stop(s, "HOST_LOST")
            case Hold(request_id):
                _hold(s, request_id)
            case TorqueOn(request_id):
                _torque_on(s, request_id)
            case Release(request_id):
                s.go(Trigger.RELEASE)
                if s.state.motion is not None:
                    _finish_motion(s, "RELEASED", "")
                _end_sequence(s, "RELEASED")
                s.state = replace(s.state, settle=Settle.NO)
                _torque_off(s)
                s.reply(request_id, True)
            case Teach(request_id):
                s.go(Trigger.TEACH)
                _torque_off(s)
                s.state = replace(s.state, request_id=request_id)
            case TeachEnd(request_id):
                s.go(Trigger.TEACH_END)
                _end_sequence(s, "TEACH_ENDED")
                s.reply(request_id, True)
            case Run(request_id, trajectory):
                _run(s, request_id, trajectory)
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


def _connected(s: _Step, command: Connected) -> None:
    text = "every servo answers as the calibration says"
    if s.state.fault is not None and s.state.fault.code == "PORT_GONE" and not s.state.connected:
        s.events.append(Event("warning", "PORT_BACK", "the port is back; the fault stays until `armctl clear`"))
    if command.restarted:
        s.events.append(Event("warning", "RESTARTED", "the control process was restarted; the arm is taken as found"))
    s.state = replace(s.state, connected=True, adopted=s.state.fault is not None, problems=command.problems)
    if command.problems and s.state.mode is not Mode.FAULTED:
        first = command.problems[0]
        text = "; ".join(problem.text for problem in command.problems)
        _latch(s, first.code, text, first.servo_id)
    elif not command.problems:
        s.events.append(Event("info", "CONNECTED", text))


def _hold(s: _Step, request_id: int) -> None:
    if s.state.settle is not Settle.NO:
        _abandon_settling(s, "STOPPED", "it was stopped")
    if s.state.motion is not None:
        _stop(s, "STOPPED")
        s.state = replace(s.state, hold_request_ids=(*s.state.hold_request_ids, request_id))
        return
    limp = s.state.mode in (Mode.OFF, Mode.TEACHING)
    s.reply(request_id, True, message="the arm is limp; there is nothing to hold" if limp else "")


def _stop(s: _Step, code: str) -> None:
    motion = s.state.motion
    if motion is not None and not motion.stop_code:
        s.state = replace(s.state, motion=replace(motion, stop_code=code))


def _end_sequence(s: _Step, code: str, text: str = "") -> None:
    """Tell whoever waits for the present sequence that it will not end well."""
    s.reply(s.state.request_id, False, code, text or "another request came first")
    s.state = replace(s.state, request_id=None, anchor=None)


def _torque_off(s: _Step) -> None:
    s.goal = None  # a goal after it would switch the torque on again
    s.writes.extend(
        Write(servo_id, ax12a.TORQUE_ENABLE.address, ax12a.TORQUE_ENABLE.size, 0) for servo_id in s.arm.servo_ids
    )


def _torque_on(s: _Step, request_id: int) -> None:
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
    _send_goal(s, ticks)
    s.state = replace(s.state, request_id=request_id, anchor=tuple(ticks))


def _run(s: _Step, request_id: int, trajectory: JointTrajectory) -> None:
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


def _clear(s: _Step, request_id: int) -> None:
    if s.state.fault is None:
        s.reply(request_id, True, message="no fault is latched")
        return
    if s.state.motion is not None or s.state.settle is not Settle.NO:
        raise RequestRefused("NOT_CLEARED", "the arm is still coming to rest; try again")
    persisting = _persisting_cause(s)
    if persisting:
        raise RequestRefused("NOT_CLEARED", f"the cause of {s.state.fault.code} persists: {persisting}")
    powered = [registers is not None and registers.torque_enabled for registers in s.registers]
    s.go(Trigger.CLEAR_POWERED if all(powered) else Trigger.CLEAR_LIMP)
    s.state = replace(s.state, fault=None, adopted=True)
    if all(powered):
        _take_goals_over(s)
    s.reply(request_id, True)


def _persisting_cause(s: _Step) -> str:
    """Why the fault cannot be cleared now; empty if it can."""
    if not s.inputs.sample.port_open or not s.state.connected:
        return "the serial port is not open; plug the adapter in"
    if s.state.problems:
        return "; ".join(problem.text for problem in s.state.problems)
    hot = [
        j.name
        for j, now in zip(s.arm.joints, s.joints, strict=True)
        if now.temperature_degC >= s.arm.temperature_limit_degC
    ]
    if hot:
        return f"{', '.join(hot)} above {s.arm.temperature_limit_degC:g} degC; let it cool"
    low_V, high_V = s.arm.voltage_V
    if not all(low_V <= now.voltage_V <= high_V for now in s.joints):
        return f"the supply voltage is outside {low_V:g} to {high_V:g} V"
    silent = [j.name for j, reading in zip(s.arm.joints, s.inputs.sample.servos, strict=True) if not reading.fresh]
    if silent:
        return f"no reply from {', '.join(silent)}"
    on = [r is not None and r.torque_enabled for r in s.registers]
    tripped = [j.name for j, r in zip(s.arm.joints, s.registers, strict=True) if r is not None and not r.torque_limit]
    if any(on) and (tripped or not all(on)):
        limp = tripped or [j.name for j, torque in zip(s.arm.joints, on, strict=True) if not torque]
        return f"{', '.join(limp)} limp while others hold; support the arm and type `armctl release`"
    return ""


# ------------------------------------------------------------------------------------------------ progress


def _adopt(s: _Step) -> None:
    """Take over what the servos are doing: torque on stays on at its goal, off stays off."""
    if not s.state.connected or s.state.adopted or s.state.fault is not None or not s.fresh:
        return
    powered = [registers is not None and registers.torque_enabled for registers in s.registers]
    s.state = replace(s.state, adopted=True)
    if all(powered):
        s.go(Trigger.ADOPT_POWERED)
        _take_goals_over(s)
    elif any(powered):
        index = powered.index(False)
        _latch_servo(s, "LOST_TORQUE", index, "found limp while other servos hold")


def _take_goals_over(s: _Step) -> None:
    goals = tuple(registers.goal for registers in s.registers if registers is not None)
    s.state = replace(s.state, goal=goals, previous_goal=None, error_since_ns=())


def _advance(s: _Step) -> None:
    if s.state.mode is Mode.ENERGISING and s.state.phase > 0:
        _energise(s)
    elif s.state.mode is Mode.TEACHING and s.state.request_id is not None and s.state.phase > 0:
        _verify_limp(s)
    if s.state.settle is not Settle.NO:
        _settle(s)
    if s.state.motion is not None:
        _move(s, s.state.motion)


def _settle(s: _Step) -> None:
    """The slow way to rest: come to a stop, go there, see that it is there, switch torque off."""
    goal = s.state.goal
    assert goal is not None
    if any(r is None or not r.torque_enabled or not r.torque_limit for r in s.registers):
        return _abandon_settling(s, "LOST_TORQUE", "a servo has no torque")
    if any(joint.age_s > SILENT_AGE_S for joint in s.joints):
        return _abandon_settling(s, "SERVO_SILENT", "a servo does not answer")
    if s.state.motion is not None:
        return None
    if s.state.settle is Settle.STOP:
        q = [joint.position_rad(tick) for joint, tick in zip(s.arm.joints, goal, strict=True)]
        rest = [joint.rest_rad for joint in s.arm.joints]
        way = approach_trajectory(q, rest, s.arm, s.robot, s.period_s, "to rest")
        if lowest_link_m(way, s.robot) < s.arm.floor_m:
            return _abandon_settling(s, "LIMIT", "the straight way to rest leads below the floor")
        s.state = replace(s.state, motion=Motion(way, None), settle=Settle.MOVE, phase=0)
    elif s.state.settle is Settle.MOVE:
        s.state = replace(s.state, settle=Settle.VERIFY, phase=0)
    elif s.fresh and all(
        abs(now.position_rad - joint.rest_rad) <= REST_TOLERANCE_RAD
        for now, joint in zip(s.joints, s.arm.joints, strict=True)
    ):
        _torque_off(s)
        s.events.append(Event("info", "PARKED", "the arm is at its rest pose; torque is off"))
        s.reply(s.state.request_id, True)
        if s.state.mode is Mode.PARKING:
            s.go(Trigger.PARKED)
        s.state = replace(s.state, settle=Settle.NO, request_id=None)
    elif s.state.phase > VERIFY_TICKS:
        _abandon_settling(s, "NOT_AT_REST", "the arm is over 3 deg from its rest pose")
    return None


def _abandon_settling(s: _Step, code: str, why: str) -> None:
    """Hold instead: torque is never cut but at rest."""
    _stop(s, code)
    text = f"the arm does not go to rest: {why}; it holds"
    s.events.append(Event("warning", code, text))
    s.state = replace(s.state, settle=Settle.NO)
    _end_sequence(s, code, text)
    if s.state.mode is Mode.PARKING and s.state.motion is None:
        s.go(Trigger.STOPPED)


def _energise(s: _Step) -> None:
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
        _torque_off(s)
        s.events.append(Event("warning", "JUMP_REFUSED", surprise))
        s.go(Trigger.ENERGISE_FAILED)
        _end_sequence(s, "JUMP_REFUSED", surprise)
    elif s.state.phase == 1:
        s.writes.extend(Write(i, ax12a.TORQUE_ENABLE.address, ax12a.TORQUE_ENABLE.size, 1) for i in s.arm.servo_ids)
        _send_goal(s, anchor)  # again: a limp servo may have let its goal follow the shaft
    elif 1 <= ramp <= RAMP_TICKS:
        for joint in s.arm.joints:
            full = ax12a.TORQUE_LIMIT.maximum * joint.torque_limit_ratio
            limit = round(SOFT_TORQUE + (full - SOFT_TORQUE) * ramp / RAMP_TICKS)
            s.writes.append(Write(joint.servo_id, ax12a.TORQUE_LIMIT.address, ax12a.TORQUE_LIMIT.size, limit))
    elif ramp > RAMP_TICKS:
        s.reply(s.state.request_id, True)
        s.go(Trigger.ENERGISED)
        s.state = replace(s.state, request_id=None, anchor=None, error_since_ns=())


def _surprise(s: _Step, index: int, anchor: int) -> str:
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


def _verify_limp(s: _Step) -> None:
    """Answer the teach request once every servo is seen without torque."""
    if s.fresh and not any(registers is None or registers.torque_enabled for registers in s.registers):
        s.reply(s.state.request_id, True)
        s.state = replace(s.state, request_id=None)
    elif s.state.phase > SEQUENCE_TICKS:
        index = next((i for i, r in enumerate(s.registers) if r is not None and r.torque_enabled), 0)
        _latch_servo(s, "NOT_LIMP", index, "torque stayed on although it was switched off")


def _move(s: _Step, motion: Motion) -> None:
    """Send the trajectory's position one tick ahead."""
    trajectory = motion.trajectory
    if not motion.begun and motion.progress_s >= trajectory.begin_s:
        motion = replace(motion, begun=True)
        s.events.append(Event("info", "PLAN_BEGIN", trajectory.label))
    if not motion.ended and motion.progress_s >= trajectory.end_s > trajectory.begin_s:
        motion = replace(motion, ended=True)
        s.events.append(Event("info", "PLAN_END", trajectory.label))
    if motion.progress_s >= trajectory.duration_s:
        return _finish_motion(s, motion.stop_code, "")
    if s.inputs.late_ns > LATE_NS and not motion.stop_code:
        motion = replace(motion, stop_code="LATE")
        s.events.append(Event("warning", "LATE", f"a tick came {s.inputs.late_ns / 1e6:.0f} ms late (bound 250)"))
    waiting = bool(motion.stop_code) or any(joint.age_s > PAUSE_AGE_S for joint in s.joints)
    change = s.period_s / STOP_S
    rate = max(0.0, motion.rate - change) if waiting else min(1.0, motion.rate + change)
    if rate == 0.0 and motion.stop_code:
        return _finish_motion(s, motion.stop_code, "")
    progress_s = min(motion.progress_s + rate * s.period_s, trajectory.duration_s)
    s.state = replace(s.state, motion=replace(motion, progress_s=progress_s, rate=rate))
    q = sample_trajectory(trajectory, progress_s)
    _send_goal(s, [round(joint.tick(position)) for joint, position in zip(s.arm.joints, q, strict=True)])
    return None


def _finish_motion(s: _Step, code: str, text: str) -> None:
    motion = s.state.motion
    assert motion is not None
    s.reply(motion.request_id, not code, code, text or (f"the motion was stopped ({code})" if code else ""))
    for request_id in s.state.hold_request_ids:
        s.reply(request_id, True)
    if s.state.mode is Mode.MOVING or (s.state.mode is Mode.PARKING and s.state.settle is Settle.NO):
        s.go(Trigger.STOPPED)
    s.state = replace(s.state, motion=None, hold_request_ids=())


def sample_trajectory(trajectory: JointTrajectory, time_s: float) -> tuple[float, ...]:
    """Joint positions [rad] at `time_s`, linear between grid points."""
    points = trajectory.positions_rad
    place = min(max(time_s / trajectory.period_s, 0.0), len(points) - 1.0)
    index = min(int(place), len(points) - 2)
    part = place - index
    return tuple(a + part * (b - a) for a, b in zip(points[index], points[index + 1], strict=True))


def _send_goal(s: _Step, ticks: Sequence[int]) -> None:
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
