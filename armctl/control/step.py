"""One control step, pure: (state, inputs) -> (state, outputs).

Rules.
1. All time comes from the inputs, all memory is in the state: the same inputs give the same outputs, bit for
   bit, which is what makes every log a test. On every machine: no sine, power, sum or matrix product is a library's,
   which may round otherwise in its next version.
2. Goals are positions of the trajectory one tick ahead; what stops feeding goals stops the arm within two.
3. A stop runs the trajectory's own time down to zero within `STOP_S`, so the arm stays on its path.
4. Torque is enabled only by the energising sequence, on request, at the position the arm has; it is disabled
   only on request (`release`, `teach`), at a rest pose that is seen, or to undo an energising that went wrong.
5. A fault latches. While it is latched nothing advances, save the deceleration of rule 3 and, for a fault that
   would soon end in a dropped arm, the slow way to rest.
6. What the servos report, not what was written, decides whether a sequence goes on.
"""

from __future__ import annotations

from armctl.config import ArmConfig
from armctl.control.detect import detect_faults
from armctl.control.machine import State, replace
from armctl.control.requests import carry_out
from armctl.control.sequences import adopt, advance
from armctl.control.tick import Registers, Tick, decode
from armctl.dynamixel.ax12a import load_ratio, speed_rad_s
from armctl.kinematics.chain import tool_pose
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import quaternion_from_columns
from armctl.messages import Inputs, JointState, Outputs, ToolPose


def step(state: State, inputs: Inputs, arm: ArmConfig, robot: Robot, period_s: float) -> tuple[State, Outputs]:
    """The next state and everything the arm is to be told.

    Args:
        state: What the last step remembered; `State()` at first.
        inputs: This tick's sample and commands; `sample.servos` in the order of `arm.joints`.
        period_s: Time between ticks.
    """
    servos = inputs.sample.servos
    registers = tuple([decode(reading.registers) for reading in servos])
    s = Tick(
        state=replace(state, phase=state.phase + 1),
        inputs=inputs,
        arm=arm,
        robot=robot,
        period_s=period_s,
        joints=_joint_states(inputs, registers, arm),
        registers=registers,
        fresh=all(reading.fresh for reading in servos),
    )
    detect_faults(s)
    for command in inputs.commands:
        carry_out(s, command)
    adopt(s)
    advance(s)
    positions = tuple([r.position for r in registers if r is not None])
    last_ticks = positions if len(positions) == len(arm.joints) else ()
    if s.goal is None:
        s.state = replace(s.state, last_ticks=last_ticks)
    else:
        s.state = replace(
            s.state,
            last_ticks=last_ticks,
            previous_goal=s.state.goal,
            goal=s.goal.ticks,
            ramp=s.ramp,
            goal_ns=inputs.now_ns,
        )
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
        rate=None if motion is None else 0.0 if motion.paused else motion.wanted_rate,
    )


def _joint_states(inputs: Inputs, registers: tuple[Registers | None, ...], arm: ArmConfig) -> tuple[JointState, ...]:
    now_ns = inputs.now_ns
    states: list[JointState] = []
    for reading, r, joint in zip(inputs.sample.servos, registers, arm.joints, strict=True):
        if r is None:
            states.append(JointState(False, 0.0, 0.0, 0.0, 0.0, 0.0, False, now_ns / 1e9))
            continue
        direction = joint.direction
        states.append(
            JointState(
                True,
                joint.position_rad(r.position),
                direction * speed_rad_s(r.speed),
                direction * load_ratio(r.load),
                r.voltage / 10.0,
                float(r.temperature),
                r.torque_enabled != 0,
                (now_ns - reading.stamp_ns) / 1e9,
            )
        )
    return tuple(states)


def _tool_pose(joints: tuple[JointState, ...], robot: Robot) -> ToolPose | None:
    if not all(joint.known for joint in joints):
        return None
    chain = robot.chain
    X, Y, Z, P = tool_pose(chain, [joint.position_rad for joint in joints[: chain.n]])
    return ToolPose(P, quaternion_from_columns(X, Y, Z))
