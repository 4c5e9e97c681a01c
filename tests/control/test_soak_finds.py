"""What the soak found in the control step, each as its shortest story."""

import math
from itertools import pairwise

import pytest

from armctl.control.detect import BEHIND_TICKS
from armctl.control.motion import LEAD_TICKS
from armctl.dynamixel import ax12a
from armctl.messages import Clear, Command, Connected, Hold, Jog, Mode, Release, Run, Teach, TorqueOn
from tests.control.ideal_arm import IdealArm, energising, holding, line

# 54 deg/s, the limit being 60.
FAST_RAD, FAST_S = -1.9, 2.0


def test_a_servo_in_time_gets_a_full_step_each_tick() -> None:
    arm = holding()
    arm.run_ticks(13, Run(2, line(arm, FAST_RAD, FAST_S)))
    assert {abs(b[0] - a[0]) for a, b in pairwise(arm.goals[-12:])} <= {18, 19}


def test_no_goal_is_farther_ahead_than_the_bound_and_a_servo_that_stays_behind_is_blocked() -> None:
    arm = holding()
    start = arm.get(0, ax12a.PRESENT_POSITION)
    arm.stuck = {0}
    begin = len(arm.goals)
    arm.run_ticks(9, Run(2, line(arm, FAST_RAD, FAST_S)))
    assert 28 < max(abs(goal[0] - start) for goal in arm.goals[begin:]) <= LEAD_TICKS
    assert arm.code() == "BLOCKED"


def test_a_servo_that_catches_up_lets_the_run_go_on_to_its_end() -> None:
    arm = holding()
    arm.run_tick(Run(2, line(arm, FAST_RAD, FAST_S)))
    arm.stuck = {0}
    arm.run_ticks(2)
    arm.stuck = set()
    arm.run_ticks(30)
    assert (arm.mode(), arm.replies[2].ok) == (Mode.HOLDING, True)
    assert arm.get(0, ax12a.PRESENT_POSITION) == round(arm.arm.joints[0].tick(arm.arm.joints[0].rest_rad + FAST_RAD))


def test_a_servo_that_missed_goals_gets_the_speed_to_catch_up_as_the_motion_ends() -> None:
    arm = holding()
    arm.run_ticks(6, Run(2, line(arm, FAST_RAD, FAST_S)))
    arm.deaf = {0}
    arm.run_tick()
    last = arm.run_tick(Hold(3)).goal
    assert last is not None
    left, limit = abs(last.ticks[0] - arm.get(0, ax12a.GOAL)), arm.arm.joints[0].speed_limit_rad_s
    needed_rad_s = min(left * ax12a.TICK_RAD / arm.period_s, limit)
    assert left > 24
    assert ax12a.moving_speed_units(0.95 * needed_rad_s) <= last.speeds[0] <= ax12a.moving_speed_units(limit)


@pytest.mark.parametrize(("command", "mode"), [(Teach(2), Mode.TEACHING), (Release(2), Mode.OFF)])
def test_an_arm_that_is_let_go_in_its_first_tick_is_not_taken_over(command: Command, mode: Mode) -> None:
    arm = IdealArm().power()
    arm.run_ticks(11, Connected(restarted=True), command)
    assert (arm.mode(), arm.state.fault) == (mode, None)
    assert not any(arm.get(index, ax12a.TORQUE_ENABLE) for index in range(6))
    assert arm.replies[2].ok


@pytest.mark.parametrize("others", [(), (1, 2, 3, 4, 5)])
def test_a_servo_that_restarted_during_a_late_tick_of_a_run_gets_no_goal(others: tuple[int, ...]) -> None:
    arm = holding()
    arm.run_ticks(9, Run(2, line(arm)))
    for index in (0, *others):
        arm.put(index, ax12a.TORQUE_ENABLE, 0)
        arm.put(index, ax12a.MOVING_SPEED, 0)
    assert not arm.goals_in(20)
    assert arm.code() == "LOST_TORQUE"
    assert not arm.get(0, ax12a.TORQUE_ENABLE)


def test_a_servo_that_restarts_while_a_latched_run_slows_down_gets_no_goal() -> None:
    arm = holding()
    arm.run_ticks(9, Run(2, line(arm)))
    arm.put(3, ax12a.PRESENT_VOLTAGE, 80)
    arm.run_ticks(6)
    assert arm.code() == "VOLTAGE"
    arm.put(4, ax12a.TORQUE_ENABLE, 0)
    assert not arm.goals_in(20)
    assert not arm.get(4, ax12a.TORQUE_ENABLE)


def test_torque_comes_on_where_a_shaft_is_after_a_late_tick_not_where_it_was_led_before() -> None:
    arm = IdealArm().connect()
    place = arm.get(0, ax12a.PRESENT_POSITION)
    for off in (5, 9, 6, 8, 5, 9, 6, 8, 9, 6, 7, 11, 7, 3, 3):
        arm.put(0, ax12a.PRESENT_POSITION, place + off)
        arm.run_tick()
    arm.put(0, ax12a.PRESENT_POSITION, place)
    arm.late_ns = 1_660_000_000
    arm.run_tick()
    arm.late_ns = 0
    for k, off in enumerate((1, 2, 2)):
        arm.put(0, ax12a.PRESENT_POSITION, place + off)
        arm.run_tick(*(() if k else (TorqueOn(1),)))
    assert (arm.mode(), abs(arm.state.goal[0] - (place + 2)) <= 1) == (Mode.ENERGISING, True)


def test_a_servo_found_on_its_way_to_where_somebody_else_led_it_from_says_nothing_of_ramps() -> None:
    arm, behind = IdealArm().power(), round(BEHIND_TICKS) + 3
    arm.put(2, ax12a.PRESENT_POSITION, arm.get(2, ax12a.GOAL) - behind)
    arm.deaf = {2}
    arm.connect()
    arm.run_ticks(5, Run(2, line(IdealArm())))
    assert arm.mode() is Mode.MOVING
    assert "RAMP_RESTARTS" not in arm.events


def test_a_jog_that_ends_calls_no_servo_farther_away_from_where_it_was_thrown() -> None:
    arm = holding()
    for tick in range(6):
        arm.run_tick(Jog(10 + tick, (0.0, 0.0, math.radians(20.0), 0.0, 0.0, 0.0), begin=tick == 0))
    arm.stuck = {2}
    before, last = arm.goals[-2][2], arm.goals[-1][2]
    thrown = last + math.copysign(150, last - before)
    arm.put(2, ax12a.PRESENT_POSITION, round(thrown))
    arm.run_ticks(2, Hold(3))
    assert "JOG_END" in arm.events
    assert abs(arm.goals[-1][2] - thrown) <= abs(last - thrown)


def test_an_arm_whose_torque_on_was_interrupted_is_not_taken_for_one_that_holds() -> None:
    arm = IdealArm().power()
    for index in range(6):
        arm.put(index, ax12a.TORQUE_LIMIT, 307)
    arm.connect()
    assert (arm.mode(), arm.code()) == (Mode.FAULTED, "LOST_TORQUE")
    assert "armctl release" in arm.ask(Clear(1)).message
    arm.run_tick(Release(2))
    arm.run_tick()
    assert (arm.ask(Clear(3)).ok, arm.mode()) == (True, Mode.OFF)


def test_a_servo_that_falls_silent_during_torque_on_leaves_a_fault_that_release_resolves() -> None:
    arm = energising()
    arm.run_ticks(4)
    arm.silent = {2}
    arm.run_ticks(8)
    arm.silent = set()
    assert "without full torque" in arm.ask(Clear(2)).message
    arm.run_tick(Release(3))
    arm.run_tick()
    assert (arm.ask(Clear(4)).ok, arm.mode()) == (True, Mode.OFF)


@pytest.mark.parametrize("enabled", [0, 1])
def test_a_servo_that_shut_itself_down_while_nobody_was_in_charge_is_found_tripped(enabled: int) -> None:
    arm = IdealArm().power()
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.put(3, ax12a.TORQUE_ENABLE, enabled)  # the manuals differ on whether it drops this too
    arm.connect()
    assert arm.fault() == ("TRIPPED", 4)
    assert arm.goals == []
