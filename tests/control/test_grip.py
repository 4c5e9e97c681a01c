"""A closing gripper in the control step: what ends its motion, and what goal it is left with."""

from dataclasses import replace

import pytest

from armctl.control.machine import State
from armctl.dynamixel import ax12a
from armctl.json_text import command_from_json, from_json, to_json
from armctl.messages import Grip, JointTrajectory, Mode, Run
from tests.control.ideal_arm import PERIOD_S, IdealArm

JOINT = 5
RATIO = 0.3
STEP_RAD = 0.03


def closing(arm: IdealArm, grip: Grip | None) -> JointTrajectory:
    start = arm.positions_rad()
    rows = tuple((*start[:JOINT], start[JOINT] + STEP_RAD * k) for k in range(31))
    return JointTrajectory(PERIOD_S, rows, label="grip", grip=grip)


def until_holding(arm: IdealArm) -> None:
    for _ in range(100):
        if arm.mode() is Mode.HOLDING:
            return
        arm.run_tick()
    raise AssertionError("it never holds")


def load(arm: IdealArm, ratio: float) -> None:
    """What the gripper's servo says of its output; a servo below its goal pushes counter-clockwise, load positive."""
    magnitude = round(abs(ratio) * ax12a.LOAD_MAX)
    arm.put(JOINT, ax12a.PRESENT_LOAD, magnitude if ratio >= 0.0 else magnitude | 0x400)


def closed_on_something(ratio: float = 0.4) -> IdealArm:
    """The servo stops after five ticks of closing, and its load rises."""
    arm = IdealArm().power().connect()
    arm.run_tick(Run(2, closing(arm, Grip(JOINT, RATIO))))
    arm.run_ticks(5)
    arm.stuck = {JOINT}
    arm.run_tick()
    load(arm, ratio)
    return arm


def test_a_load_that_lasts_ends_the_motion_well_and_the_goal_goes_back_to_where_it_makes_the_load_asked_for() -> None:
    arm = closed_on_something(0.4)
    arm.run_tick()
    assert arm.mode() is Mode.MOVING
    stuck, far = arm.get(JOINT, ax12a.PRESENT_POSITION), arm.goals[-1][JOINT]
    arm.run_tick()
    assert (arm.mode(), arm.replies[2].ok, arm.replies[2].code) == (Mode.HOLDING, True, "GRIPPED")
    assert "GRIPPED" in arm.events
    felt = round(0.4 * ax12a.LOAD_MAX) / ax12a.LOAD_MAX
    assert arm.goals[-1][JOINT] - stuck == round((far - stuck) * RATIO / felt)
    assert 0 < arm.goals[-1][JOINT] - stuck <= far - stuck
    assert arm.goals[-1][:JOINT] == arm.goals[0][:JOINT]


def test_a_load_felt_once_is_no_grip() -> None:
    arm = closed_on_something(0.4)
    arm.run_tick()
    load(arm, 0.1)
    arm.stuck = set()
    until_holding(arm)
    assert (arm.replies[2].ok, arm.replies[2].code) == (True, "")
    assert "GRIPPED" not in arm.events


def test_while_it_resists_the_goal_goes_no_farther() -> None:
    arm = closed_on_something(0.4)
    goals = len(arm.goals)
    arm.run_tick()
    assert len(arm.goals) == goals


@pytest.mark.parametrize("ratio", [0.29, -0.4])
def test_less_load_or_load_the_other_way_is_no_grip(ratio: float) -> None:
    arm = closed_on_something(ratio)
    arm.run_ticks(2)
    assert arm.mode() is Mode.MOVING


def test_a_motion_without_a_grip_minds_no_load() -> None:
    arm = IdealArm().power().connect()
    arm.run_tick(Run(2, closing(arm, None)))
    load(arm, 0.5)
    until_holding(arm)
    assert arm.replies[2].ok
    assert "GRIPPED" not in arm.events


@pytest.mark.parametrize("grip", [Grip(6, 0.3), Grip(-1, 0.3), Grip(5, 0.0), Grip(5, 0.51), Grip(5, float("nan"))])
def test_a_grip_out_of_bounds_is_refused_and_nothing_moves(grip: Grip) -> None:
    arm = IdealArm().power().connect()
    before = arm.state.goal
    assert (arm.ask(Run(2, closing(arm, grip))).code, arm.mode()) == ("LIMIT", Mode.HOLDING)
    assert arm.state.goal == before
    assert not arm.goals


def test_a_grip_survives_json_in_a_command_and_in_a_keyframe_and_older_ones_have_none() -> None:
    arm = closed_on_something()
    command = Run(2, closing(arm, Grip(JOINT, RATIO)))
    assert command_from_json(to_json(command)) == command
    assert from_json(State, to_json(arm.state)) == arm.state
    older = to_json(Run(2, closing(arm, None))).replace(',"grip":null', "")
    assert command_from_json(older) == Run(2, closing(arm, None))
    assert replace(command.trajectory, grip=None) == closing(arm, None)
