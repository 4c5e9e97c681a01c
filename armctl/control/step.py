"""One control step, pure: (state, inputs) -> (state, outputs).

Rules.
1. All time comes from the inputs, all memory is in the state: the same inputs give the same outputs, bit for
   bit, which is what makes every log a test. On every machine: no sine, power, sum or matrix product is a library's,
   which may round otherwise in its next version.
2. Goals are positions of the trajectory one tick ahead; what stops feeding goals stops the arm within two.
3. A stop runs the trajectory's own time down to zero within `STOP_S`, so the arm stays on its path.
4. Torque is enabled only by the energising sequence, on request, at the position the arm has; it is disabled
   only on request (`release`, `teach`), at a rest pose that is seen, or to undo an energising that went wrong.
5. A fault latches, and hides no other: all of them are judged in every mode. While one is latched nothing advances,
   save the deceleration of rule 3 and, while what would soon end in a dropped arm lasts, the slow way to rest, which is
   announced and can be called off.
6. What the servos report, not what was written, decides whether a sequence goes on; and what was decided is sent until
   they report it (`enforce.py`).
7. The state that is given in is never changed. The step copies it once, works on the copy, and returns that.
"""

from armctl.config import ArmConfig
from armctl.control.detect import REST_AHEAD_S, detect_faults, look_at_ramps
from armctl.control.enforce import hold_goals, switch_off
from armctl.control.jog import advance_jog
from armctl.control.machine import ENERGISING, MODE, TO_REST, Jogging, Motion, Phase, State
from armctl.control.motion import duration_s, move
from armctl.control.pairs import folded
from armctl.control.relief import look_for_push
from armctl.control.requests import carry_out
from armctl.control.sequences import adopt, energise, go_to_rest
from armctl.control.stillness import MANY
from armctl.control.tick import Tick, WireJoint, wire_joints
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Status
from armctl.kinematics.chain import tool_pose
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import quaternion_from_columns
from armctl.messages import Event, Inputs, JointState, Outputs, ToolPose

# A tick that comes later than this stops the motion: the servos have stood at their last goal meanwhile.
LATE_NS = 250_000_000


def step(state: State, inputs: Inputs, arm: ArmConfig, robot: Robot, period_s: float) -> tuple[State, Outputs]:
    """The next state and everything the arm is to be told.

    Args:
        state: What the last step remembered; `State()` at first. It stays as it is.
        inputs: This tick's sample and commands; `sample.servos` in the order of `arm.servos`.
        period_s: Time between ticks.
    """
    readings = inputs.sample.servos
    servos = tuple([ax12a.decode(reading.registers) for reading in readings])
    state, wire = _own(state), wire_joints(arm)
    each, fresh = _servo_states(inputs, servos, wire), all(reading.fresh for reading in readings)
    joints = folded(each, readings, arm) if arm.pairs else each
    s = Tick(state, inputs, arm, wire, robot, period_s, joints, each, servos, fresh)
    state.ticks += 1
    detect_faults(s)
    look_at_ramps(s)
    if state.letting_go is not None:
        switch_off(s)
    for command in inputs.commands:
        carry_out(s, command)
    if state.phase is Phase.FOUND:
        adopt(s)
    _advance(s)
    over = state.powered or not state.last_ticks or inputs.late_ns > LATE_NS
    state.earlier_ticks = () if over else (*state.earlier_ticks[2 - MANY :], state.last_ticks)
    state.last_ticks = () if None in servos else tuple([servo.position for servo in servos if servo])
    if s.goal is not None:
        s.remember(s.goal.ticks)
        state.ramp = s.ramp
    motion = state.motion
    return state, Outputs(
        mode=MODE[state.phase],
        faults=state.faults,
        joints=s.joints,
        tool=_tool_pose(s.joints, robot),
        writes=tuple(s.writes),
        goal=s.goal,
        replies=tuple(s.replies),
        events=tuple(s.events),
        progress=None if motion is None else motion.progress_s / max(duration_s(motion.trajectory), 1e-9),
        rate=None if motion is None else 0.0 if motion.paused else motion.wanted_rate,
        rest_in_s=_rest_in_s(s),
        wanted_rad=s.wanted_rad(),
    )


def _rest_in_s(s: Tick) -> float | None:
    if s.state.phase is Phase.FAULT_STOPPING:
        return max(0.0, (s.ticks_in(REST_AHEAD_S) - s.state.ticks) * s.period_s)
    return 0.0 if s.state.phase in (Phase.FAULT_GOING, Phase.FAULT_CHECKING) else None


def _own(state: State) -> State:
    """A copy that the step may change: of the state and of the two objects in it that can change."""
    own = State(**vars(state))
    if own.motion is not None:
        own.motion = Motion(**vars(own.motion))
    if own.jog is not None:
        own.jog = Jogging(**vars(own.jog))
    return own


def _advance(s: Tick) -> None:
    """Whatever is under way goes on by a tick."""
    if s.state.phase in ENERGISING:
        energise(s)
    if s.inputs.late_ns > LATE_NS:
        s.events.append(Event("warning", "LATE", f"a tick came {s.inputs.late_ns / 1e6:.0f} ms late (bound 250)"))
        s.stop_motion("LATE")
    if s.state.phase in TO_REST:
        go_to_rest(s)
    if s.state.motion is not None:
        move(s, s.state.motion)
    if s.state.jog is not None:
        advance_jog(s, s.state.jog)
    if s.state.looks or s.state.borne_ratio:
        look_for_push(s)
    if s.goal is None:
        hold_goals(s)


def _servo_states(
    inputs: Inputs, servos: tuple[Status | None, ...], wire: tuple[WireJoint, ...]
) -> tuple[JointState, ...]:
    """What every servo makes of its joint, in SI: its numbers, turned where it is mounted the other way round."""
    now_ns = inputs.now_ns
    return tuple([
        JointState(False, 0.0, 0.0, 0.0, 0.0, 0.0, False, now_ns / 1e9)
        if servo is None
        else JointState(
            True,
            joint.position_rad(servo.position),
            joint.direction * servo.speed_rad_s,
            joint.direction * servo.load_ratio,
            servo.voltage_V,
            servo.temperature_degC,
            servo.torque_enabled != 0,
            (now_ns - reading.stamp_ns) / 1e9,
        )
        for reading, servo, joint in zip(inputs.sample.servos, servos, wire, strict=True)
    ])  # fmt: skip


def _tool_pose(joints: tuple[JointState, ...], robot: Robot) -> ToolPose | None:
    if not all(joint.known for joint in joints):
        return None
    X, Y, Z, P = tool_pose(robot.chain, [joint.position_rad for joint in joints][: robot.chain.n])
    return ToolPose(P, quaternion_from_columns(X, Y, Z))
