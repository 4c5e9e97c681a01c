"""What a limp arm does by itself while it is set up: one servo wiggles, and at last every joint moves a little.

Rules of the wiggle; the first motion keeps those of the control step.
1. The servo is limp before and after, whatever happens in between, and nothing else of the arm has torque.
2. Before it gets torque its own angle limits are those that a hand has shown, and its torque limit is one of `TORQUES`.
3. It never gets a goal within `ROOM_TICK` of these limits. A servo nearer to one stays limp.
"""

import math
from typing import NamedTuple

import numpy as np

from armctl.clock import NS_PER_S
from armctl.commissioning.eeprom import mend, read_table, write_confirmed
from armctl.commissioning.texts import refusal
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.chain import jacobian
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import Command, Mode, Park, Run, TorqueOn, Write
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.preflight import DrivenArm, preflight_motion

# How far it turns (8.8 deg), and what stays free between its goal and a limit (4.4 deg).
WIGGLE_TICK, ROOM_TICK = 30, 15
# 10 deg/s, with 30 % of full torque, or 50 % where that does not turn it.
SPEED, TORQUES = 15, (307, 512)
# A weak servo comes to stand a little short of its goal.
NEAR_TICK = 14
POLL_NS, PATIENCE_NS = NS_PER_S // 20, 3 * NS_PER_S
# A joint whose tool point moves by less [m/rad] is told by how the tool turns.
LEAST_M = 0.03
# The first motion, and how long each part of it may take.
FIRST_RAD, PATIENCE_S = math.radians(5.0), 20.0


class Wall(NamedTuple):
    """A servo, and between which ticks it may turn."""

    servo_id: int
    name: str
    model: str
    limits_tick: tuple[int, int]


def wiggle(bus: ServoBus, wall: Wall) -> None:
    """Turn a limp servo by `WIGGLE_TICK` towards higher ticks and back; takes 2 to 12 s.

    Raises:
        RequestRefused: too near to a limit, not fit to be written, or it did not turn.
        PortGone: the port vanished.
    """
    servo_id, (low, high) = wall.servo_id, wall.limits_tick
    start = _position(bus, wall)
    if not low + ROOM_TICK <= start <= high - WIGGLE_TICK - ROOM_TICK:
        raise refusal("NO_ROOM", servo_id=servo_id, name=wall.name, tick=start, low=low, high=high)
    mend(bus, [wall])
    farthest = start
    try:
        write_confirmed(bus, servo_id, ax12a.TORQUE_LIMIT, TORQUES[0])
        for register, value in ((ax12a.GOAL, start), (ax12a.MOVING_SPEED, SPEED)):
            bus.write(Write(servo_id, register.address, register.size, value))  # a limp servo may keep another goal
        write_confirmed(bus, servo_id, ax12a.TORQUE_ENABLE, 1)
        for torque in TORQUES:
            write_confirmed(bus, servo_id, ax12a.TORQUE_LIMIT, torque)
            for goal in (start + WIGGLE_TICK, start):
                write_confirmed(bus, servo_id, ax12a.GOAL, goal)
                farthest = max(farthest, _reach(bus, wall, goal))
            if farthest >= start + WIGGLE_TICK - NEAR_TICK:
                break
    finally:
        write_confirmed(bus, servo_id, ax12a.TORQUE_ENABLE, 0)
    write_confirmed(bus, servo_id, ax12a.TORQUE_LIMIT, ax12a.MAX_TORQUE.default)
    if farthest < start + WIGGLE_TICK - NEAR_TICK:
        raise refusal("NOT_TURNED", servo_id=servo_id, name=wall.name, ticks=farthest - start, wanted=WIGGLE_TICK)


def _reach(bus: ServoBus, wall: Wall, goal: int) -> int:
    """Wait until the servo is near its goal, as long as it may take; where it then is."""
    clock = bus.port.clock
    end_ns = clock.now_ns() + PATIENCE_NS
    while abs((tick := _position(bus, wall)) - goal) > 1 and clock.now_ns() < end_ns:
        clock.sleep_until_ns(clock.now_ns() + POLL_NS)
    return tick


def _position(bus: ServoBus, wall: Wall) -> int:
    status = read_table(bus, wall.servo_id, ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE)
    return ax12a.register_value(ax12a.PRESENT_POSITION, status)


def sense(robot: Robot, q: FloatArray, joint: int) -> str:
    """What is seen where the position of a joint grows, as the end of "does the tool ...".

    Args:
        q: About where the arm is [rad], shape (n,) or longer.
        joint: Its index; beyond the chain it is said of the tool's own axis.
    """
    if joint >= robot.chain.n:
        return "turn counter-clockwise, for one who looks at its tip"
    place, turn = np.split(jacobian(robot.chain, q[: robot.chain.n])[:, joint], 2)
    ways = ("forward", "left", "up"), ("backward", "right", "down")
    if np.abs(place).max() >= LEAST_M:
        axis = int(np.abs(place).argmax())
        return f"go {ways[int(place[axis] < 0.0)][axis]}"
    axis = int(np.abs(turn).argmax())
    way, view = "counter-" * bool(turn[axis] > 0.0) + "clockwise", ("the front", "the left", "above")[axis]
    return f"turn {way}, seen from {view}"


# --------------------------------------------------------------------------------------- all joints at once


def first_motion(bus: ServoBus, arm: ArmConfig, period_s: float) -> None:
    """Switch torque on, move every joint a little towards the middle of its range and back, and park: limp at the end.

    Raises:
        RequestRefused: pre-flight, a fault, or the arm does not do it in time; it then holds where it is.
    """
    on = DrivenArm(arm, robots.of(arm), period_s)
    loop = ControlLoop(bus, bus.port.clock, arm, on.robot, period_s)
    # Three ticks see whether it stands still. It may hold already, where a motion was broken off.
    if [loop.tick(()).outputs.mode for _ in range(3)][-1] is not Mode.HOLDING:
        _carry_out(loop, TorqueOn(1), period_s)
    here = [joint.position_rad(tick) for joint, tick in zip(arm.joints, loop.state.goal, strict=False)]
    to_middle = [sum(joint.limits_rad) / 2.0 for joint in arm.joints] - np.array(here)
    away = (here + np.clip(to_middle, -FIRST_RAD, FIRST_RAD)).tolist()
    for number, (start, end) in enumerate(((here, away), (away, here)), start=2):
        way = approach_trajectory(start, end, on, "first motion")
        if reasons := preflight_motion(np.array(way.positions_rad), on):
            raise RequestRefused("PREFLIGHT", reasons)
        _carry_out(loop, Run(number, way), period_s)
    _carry_out(loop, Park(4), period_s)


def _carry_out(loop: ControlLoop, command: Command, period_s: float) -> None:
    """Tick until a command is answered and its motion over."""
    answered = None
    for tick in range(int(PATIENCE_S / period_s)):
        record = loop.tick(() if tick else (command,))
        answered = next(iter(record.outputs.replies), answered)
        if fault := record.outputs.fault:
            raise RequestRefused(fault.code, f"{fault.text}; the arm stands where it is, and holds if it has torque")
        if answered is not None and not answered.ok:
            raise RequestRefused(answered.code, answered.message)
        if answered is not None and record.outputs.mode in (Mode.HOLDING, Mode.OFF):
            return
    raise RequestRefused("NO_ANSWER", "the arm did not do it in time; `armctl doctor`")
