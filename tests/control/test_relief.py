"""A joint that pushes against something is relieved and told of; one that bears a weight is not."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from armctl.config import ArmConfig
from armctl.control.machine import State
from armctl.control.relief import PUSH_RATIO, explained_ratio
from armctl.control.step import _servo_states
from armctl.control.tick import Tick, wire_joints
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import Clear, Hold, Inputs, Mode, Pause, Resume, Run, Sample, ServoReading
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from tests.control.damaged_arm import Rig, is_goal
from tests.control.ideal_arm import IdealArm, holding

NEAR_ZERO = 0.3
# The elbow bears 0.23 of its strength, and 0.54 if the arm were as heavy as may be.
ELBOW_OUT_DEG = (0.0, 110.0, -40.0, -100.0, 0.0, 0.0)


def blocked(joint: int = 0, seed: int = 3, away_deg: float = 5.0) -> Rig:
    """A run against something that holds a joint, until the joint is so far from its goal, or two degrees more."""
    rig = Rig(seed).holding()
    rig.ticks(8, Run(5, rig.turned(60.0 if joint == 0 else -60.0, joint, seconds=6.0)))
    rig.fault("blocked_joint", joint + 1)
    while abs(math.degrees(rig.goals_rad[joint]) - rig.joint_deg(joint)) < away_deg:
        rig.ticks(1)
    return rig


def goals_in(rig: Rig, *ticks: int) -> Callable[[bytes], bool]:
    """Which goals are sent in some ticks."""
    return lambda packet: is_goal(packet) and len(rig.records) in ticks


@pytest.mark.parametrize("disturb", ["nothing", "another servo unheard", "the goal damaged"])
def test_a_blocked_joint_is_relieved_whatever_is_lost_then(disturb: str) -> None:
    rig = blocked()
    while rig.code() != "BLOCKED":
        if disturb == "another servo unheard" and rig.loop.state.error_since_ns[:1] > (0,):
            rig.fault("mute", 5, duration_s=0.6)
        if disturb == "the goal damaged":
            now = len(rig.records)
            rig.port.damages = goals_in(rig, now, now + 1)
        rig.ticks(1)
    rig.ticks(5)
    assert rig.outputs()[0] < NEAR_ZERO


@pytest.mark.parametrize("joint", [0, 5])
def test_a_stop_against_something_does_not_go_on_pushing(joint: int) -> None:
    rig = blocked(joint)
    rig.ticks(1, Hold(6))
    rig.ticks(12)
    assert rig.outputs()[joint] < NEAR_ZERO
    assert rig.mode() is Mode.HOLDING


def test_a_joint_that_is_heard_every_other_time_does_not_go_on_pushing_after_a_stop() -> None:
    rig = blocked()
    rig.ticks(1, Hold(6))
    for _ in range(6):
        rig.fault("mute", 1, duration_s=0.15)
        rig.ticks(2)
    assert rig.outputs()[0] < NEAR_ZERO
    assert rig.mode() is Mode.HOLDING


def test_what_was_relieved_in_a_pause_and_is_led_on_is_no_weight() -> None:
    rig = blocked(away_deg=3.5)
    rig.ticks(3, Hold(5))
    rig.ticks(1, Run(6, rig.turned(10.0, seconds=6.0)))
    rig.ticks(6, Pause(7))
    assert any(look.relieved for look in rig.loop.state.looks)
    rig.ticks(3, Resume(8))
    assert rig.outputs()[0] > NEAR_ZERO
    rig.ticks(12, Hold(9))
    assert rig.mode() is Mode.HOLDING
    assert rig.outputs()[0] < NEAR_ZERO
    assert not any(rig.loop.state.borne_ratio)


def test_a_relief_is_sent_until_it_is_read_back() -> None:
    rig = blocked()
    rig.ticks(1, Hold(6))
    rig.ticks(2)
    rig.port.damages = goals_in(rig, *range(len(rig.records), len(rig.records) + 6))
    rig.ticks(12)
    assert rig.outputs()[0] < NEAR_ZERO


@pytest.mark.parametrize("seed", range(4))
def test_a_hundred_stops_in_a_row_lower_the_tool_by_2_mm_at_most(seed: int) -> None:
    rig = Rig(seed, RANDOM_SPEC).holding().at()
    rig.ticks(10)
    before_m = rig.simulated.true_tool_position()[2]
    for count in range(100):
        rig.ticks(5, Hold(1000 + count))
    assert rig.mode() is Mode.HOLDING
    assert before_m - rig.simulated.true_tool_position()[2] < 2e-3


@pytest.mark.parametrize(("joint", "lean_deg"), [(0, 5.0), (2, 4.5)])
def test_a_lasting_push_at_standstill_is_a_fault_and_is_relieved(joint: int, lean_deg: float) -> None:
    rig = Rig().holding().at(ELBOW_OUT_DEG)
    rig.fault("blocked_joint", joint + 1)
    rig.ticks(65, Run(5, rig.turned(lean_deg, joint, seconds=1.0)))
    assert "CONTACT" in rig.codes()
    assert rig.loop.state.fault is not None
    assert rig.loop.state.fault.servo_id == joint + 1
    rig.ticks(10)
    assert rig.outputs()[joint] < NEAR_ZERO
    rig.ticks(1, Clear(6))
    assert rig.mode() is Mode.HOLDING


def test_a_joint_that_stands_pushes_on_while_another_one_moves() -> None:
    rig = Rig().holding()
    rig.fault("blocked_joint", 6)
    rig.ticks(25, Run(5, rig.turned(5.0, 5, seconds=1.0)))
    rig.ticks(20, Run(6, rig.turned(20.0, seconds=6.0)))
    assert rig.code() == "CONTACT"
    rig.ticks(20)
    assert rig.outputs()[5] < NEAR_ZERO


def test_a_push_seen_before_a_silence_has_not_lasted() -> None:
    arm = holding()
    arm.put(0, ax12a.PRESENT_LOAD, 500)
    arm.run_ticks(3)
    arm.silent = {0}
    arm.run_ticks(30)
    arm.silent = set()
    arm.put(0, ax12a.PRESENT_LOAD, 0)
    arm.run_ticks(10)
    assert "CONTACT" not in arm.events


@pytest.mark.parametrize(("load", "relieved"), [(0, False), (900, True)])
def test_another_servo_that_answers_in_a_joint_s_name_moves_no_joint(load: int, relieved: bool) -> None:
    arm = holding()
    goal = arm.state.goal[0]
    arm.put(0, ax12a.PRESENT_POSITION, goal - 100)
    arm.put(0, ax12a.PRESENT_LOAD, load)
    arm.run_ticks(10)
    assert arm.code() == "BLOCKED"
    assert (arm.state.goal[0] != goal) == relieved


@pytest.mark.parametrize("seed", range(4))
def test_a_stretched_arm_that_bears_its_weight_pushes_against_nothing(seed: int) -> None:
    rig = Rig(seed, RANDOM_SPEC).holding().at()
    rig.ticks(60)
    assert (rig.mode(), rig.code()) == (Mode.HOLDING, "")


def test_what_comes_back_after_a_relief_is_a_weight_and_walks_no_arm_down() -> None:
    arm = holding()
    arm.put(0, ax12a.PRESENT_LOAD, 500)

    def sag(arm: IdealArm) -> None:
        arm.put(0, ax12a.PRESENT_POSITION, arm.get(0, ax12a.GOAL) - 16)

    arm.after_write = sag
    goals = {arm.state.goal[0]}
    for count in range(10):
        arm.run_ticks(15, Hold(100 + count))
        arm.run_ticks(15, Clear(200 + count))
        goals.add(arm.state.goal[0])
    assert len(goals) == 2, "relieved once"
    assert (arm.mode(), arm.code()) == (Mode.HOLDING, "")


def test_a_hand_that_pulled_after_a_relief_and_has_let_go_is_no_weight() -> None:
    arm = holding()
    arm.put(0, ax12a.PRESENT_LOAD, 900)
    arm.stuck = {0}
    arm.put(0, ax12a.PRESENT_POSITION, arm.get(0, ax12a.GOAL) - 16)
    arm.run_ticks(15, Hold(5))
    assert arm.state.borne_ratio[0] > PUSH_RATIO, "what pulls on is taken for a weight at first"
    arm.put(0, ax12a.PRESENT_LOAD, 0)
    arm.run_ticks(5)
    arm.put(0, ax12a.PRESENT_LOAD, 700)
    arm.run_ticks(25)
    assert arm.code() == "CONTACT"


@pytest.mark.parametrize("name", ["ax12-line", "lanzhou-4dof", "xiang-6dof", "transfer-6dof"])
def test_gravity_of_every_arm_that_may_be_built_is_explained_in_every_pose(name: str) -> None:
    arm = load_arm(name)
    robot, rng = robots.get(arm.robot, arm.lengths_m), np.random.default_rng(7)
    for seed in range(20):
        simulated = SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC)
        for _ in range(20):
            q = np.array([rng.uniform(*joint.limits_rad) for joint in arm.joints])
            needed_Nm = [-torque for torque, _ in simulated._body.masses.loads(q[: robot.chain.n].tolist())]
            for (low, high), needed, joint in zip(explained(arm, robot, q), needed_Nm, simulated._joints, strict=False):
                ratio = needed / joint.stall_Nm
                # A servo may sit elsewhere on its axis.
                assert low - 0.2 * PUSH_RATIO <= ratio <= high + 0.2 * PUSH_RATIO


def explained(arm: ArmConfig, robot: Robot, q: FloatArray) -> list[tuple[float, float]]:
    """What the step takes for explained in a pose."""
    readings = []
    for joint, angle in zip(arm.joints, q, strict=True):
        block = bytearray(26)
        block[ax12a.POSITION_AT : ax12a.POSITION_AT + 2] = round(joint.tick(angle)).to_bytes(2, "little")
        block[ax12a.PRESENT_VOLTAGE.address - 24] = 120
        readings.append(ServoReading(joint.servo_id, bytes(block), 1, True))
    inputs = Inputs(0, 1, Sample(1, tuple(readings)))
    servos, wire = tuple(ax12a.decode(reading.registers) for reading in readings), wire_joints(arm)
    each = _servo_states(inputs, servos, wire)
    return explained_ratio(Tick(State(), inputs, arm, wire, robot, 0.1, each, each, servos, True))


@pytest.mark.parametrize("lasts_s", [0.05, 3.0])
def test_what_another_program_wakes_on_a_limp_arm_pushes_against_nothing(lasts_s: float) -> None:
    rig = Rig()
    rig.fault("blocked_joint", 1)
    rig.fault("second_writer", 1, value=60.0, duration_s=lasts_s)
    pushes = []
    for _ in range(60):
        rig.ticks(1)
        pushes.append(rig.outputs()[0])
    assert "NOT_LIMP" in rig.codes()
    assert max(pushes) > NEAR_ZERO, "the program was there"
    assert max(pushes[-20:]) < NEAR_ZERO
    assert rig.stiff() == [1]


def test_what_another_program_wakes_bears_its_weight_and_does_not_sink() -> None:
    """The elbow of an arm; somebody else has put 5 degrees between goal and shaft."""
    arm = IdealArm().connect()
    for i, (joint, deg) in enumerate(zip(arm.arm.joints, ELBOW_OUT_DEG, strict=True)):
        for register in (ax12a.PRESENT_POSITION, ax12a.GOAL):
            arm.put(i, register, round(joint.tick(math.radians(deg))))
    arm.run_ticks(3)
    low, high = explained(arm.arm, arm.robot, np.radians(ELBOW_OUT_DEG))[2]
    assert low == 0.0 < 0.4 < high < 0.7
    direction = arm.arm.joints[2].direction
    arm.put(2, ax12a.TORQUE_ENABLE, 1)
    arm.put(2, ax12a.GOAL, arm.get(2, ax12a.PRESENT_POSITION) + 16 * direction)
    given = arm.get(2, ax12a.GOAL)

    def works(ratio: float) -> None:
        arm.put(2, ax12a.PRESENT_LOAD, round(1023 * ratio) + (0 if direction > 0 else 1024))
        arm.run_ticks(20)
        assert arm.outputs is not None
        assert arm.outputs.joints[2].load_ratio == pytest.approx(ratio, abs=0.01)

    works(high - 0.05)
    assert (arm.code(), arm.get(2, ax12a.GOAL)) == ("NOT_LIMP", given)
    works(0.95)
    assert arm.get(2, ax12a.GOAL) == arm.get(2, ax12a.PRESENT_POSITION)


def test_a_process_that_finds_an_arm_that_pushes_relieves_it_before_it_is_taken_over() -> None:
    """Its start found one servo silent, so it waits for `clear`."""
    rig = blocked()
    rig.fault("mute", 5, duration_s=2.0)
    rig.restart()
    rig.ticks(15)
    assert rig.code() == "SERVO_SILENT"
    assert rig.outputs()[0] > NEAR_ZERO
    rig.ticks(15)
    assert rig.code() == "SERVO_SILENT"
    assert rig.outputs()[0] < NEAR_ZERO
    assert len(rig.stiff()) == len(rig.simulated.servos)
