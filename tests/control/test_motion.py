"""Runs in the control step: goals one tick ahead, stops on the path, and what is refused before the wire."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.motion import sample_trajectory
from armctl.control.requests import START_TOLERANCE_RAD
from armctl.control.tick import MINIMUM_SPEED_UNITS
from armctl.dynamixel import ax12a
from armctl.messages import Hold, HostLost, HostSilent, JointTrajectory, Mode, Release, Run
from tests.control.ideal_arm import PERIOD_S, IdealArm, holding, line, running


def test_a_run_streams_goals_one_tick_ahead_and_answers_at_its_end() -> None:
    arm = holding()
    arm.goals.clear()
    trajectory = line(arm, begin_s=0.5, end_s=1.5)
    outputs = arm.run_tick(Run(5, trajectory))
    assert outputs.mode is Mode.MOVING
    arm.run_ticks(25)
    assert (arm.mode(), arm.replies[5].ok) == (Mode.HOLDING, True)
    assert arm.events.count("PLAN_BEGIN") == arm.events.count("PLAN_END") == 1
    assert arm.goals[-1][0] == round(arm.arm.joints[0].tick(trajectory.positions_rad[-1][0]))
    assert len(arm.goals) == 20
    steps = [abs(b[0] - a[0]) for a, b in pairwise(arm.goals)]
    assert max(steps) <= 5  # 0.02 rad a tick is 4 servo ticks


@pytest.mark.parametrize("after_s", [0.006, 0.05, 0.095, 0.1, 0.3])
def test_a_goal_soon_after_another_is_given_the_speed_for_both_ways(after_s: float) -> None:
    arm = running(6)
    first = arm.outputs
    arm.now_ns += round((after_s - PERIOD_S) * 1e9)
    second = arm.run_tick()
    assert first is not None
    assert first.goal is not None
    assert second.goal is not None
    ways = [abs(after[0] - before[0]) for before, after in pairwise(arm.goals[-3:])]
    left = ways[0] * (1.0 - after_s / PERIOD_S) if after_s < 0.9 * PERIOD_S else 0.0
    units = max(MINIMUM_SPEED_UNITS, ax12a.moving_speed_units((left + ways[1]) * ax12a.TICK_RAD / PERIOD_S))
    fastest = ax12a.moving_speed_units(arm.arm.joints[0].speed_limit_rad_s)
    assert second.goal.speeds[0] == pytest.approx(min(units, fastest), abs=1)
    # Nothing is owed for ever: a tick later every ramp is where it ought to be, or as near as its speed limit lets it.
    third = arm.run_tick()
    assert third.goal is not None
    way = abs(arm.goals[-1][0] - arm.goals[-2][0])
    wanted = max(MINIMUM_SPEED_UNITS, ax12a.moving_speed_units(way * ax12a.TICK_RAD / PERIOD_S))
    assert third.goal.speeds[0] == wanted or units > fastest


def test_speeds_let_every_joint_arrive_together_and_never_say_unlimited() -> None:
    arm = holding()
    outputs = arm.run_tick(Run(5, line(arm, delta_rad=1.9)))
    assert outputs.goal is not None
    moved = abs(outputs.goal.ticks[0] - arm.goals[-2][0]) * ax12a.TICK_RAD
    assert outputs.goal.speeds[0] * ax12a.SPEED_UNIT_RAD_S >= moved / PERIOD_S
    assert outputs.goal.speeds[1:] == (MINIMUM_SPEED_UNITS,) * 5


@given(st.integers(0, 18))
@settings(max_examples=10)
def test_a_stop_comes_to_rest_on_the_path_within_300_ms(after: int) -> None:
    arm = running()
    arm.run_ticks(after)
    arm.goals.clear()
    arm.run_ticks(4, Hold(6))
    assert (arm.mode(), arm.replies[6].ok, arm.replies[5].ok) == (Mode.HOLDING, True, False)
    assert arm.replies[5].code == "STOPPED"
    assert len(arm.goals) <= 2
    columns = list(zip(*arm.goals, strict=True))
    assert all(len(set(column)) == 1 for column in columns[1:])


@given(st.integers(0, 18))
@settings(deadline=None, max_examples=10)
def test_a_silent_host_slows_the_arm_down_as_a_stop_does(after: int) -> None:
    arm, stopped = running(), running()
    for one, word in ((arm, HostSilent()), (stopped, Hold(6))):
        one.run_ticks(after)
        one.run_ticks(4, word)
    assert (arm.mode(), arm.goals) == (Mode.HOLDING, stopped.goals)
    assert arm.replies[5].code == "HOST_SILENT"
    assert arm.events.count("HOST_SILENT") == 1


def test_losing_the_host_stops_the_arm() -> None:
    arm = running()
    arm.run_ticks(4, HostLost())
    assert (arm.mode(), arm.replies[5].code) == (Mode.HOLDING, "HOST_LOST")


def test_hold_is_served_in_every_mode() -> None:
    arm = IdealArm().connect()
    assert "limp" in arm.ask(Hold(1)).message
    arm = holding()
    assert arm.ask(Hold(2)).ok


def test_a_late_tick_stops_the_motion() -> None:
    arm = running()
    arm.late_ns = 300_000_000
    arm.run_tick()
    arm.late_ns = 0
    arm.run_ticks(3)
    assert arm.replies[5].code == "LATE"
    assert "LATE" in arm.events
    assert arm.mode() is Mode.HOLDING


def test_release_is_refused_while_moving() -> None:
    arm = running()
    assert (arm.ask(Release(6)).code, arm.mode()) == ("ILLEGAL_TRANSITION", Mode.MOVING)


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        (lambda t: replace(t, positions_rad=t.positions_rad[:1]), "LIMIT", "2 to 1714 points"),
        (lambda t: replace(t, positions_rad=t.positions_rad[:1] * 1715), "LIMIT", "1714 points, not 1715"),
        (lambda t: replace(t, times_s=(0.0, 1.0)), "LIMIT", "every point needs a time"),
        (lambda t: replace(t, times_s=(*(0.1 * i for i in range(20)), 1.9)), "LIMIT", "must rise"),
        (lambda t: replace(t, times_s=(*(0.1 * i for i in range(20)), math.nan)), "LIMIT", "must rise"),
        (lambda t: replace(t, times_s=tuple(0.01 * i for i in range(21))), "LIMIT", "its limit is 60"),
        (lambda t: replace(t, period_s=0.0), "LIMIT", "period 0.0 s"),
        (lambda t: replace(t, positions_rad=tuple(p[:5] for p in t.positions_rad)), "LIMIT", "6 finite"),
        (lambda t: replace(t, positions_rad=((math.nan,) * 6, *t.positions_rad[1:])), "LIMIT", "6 finite"),
        (lambda t: replace(t, positions_rad=(*t.positions_rad, (3.0, *t.positions_rad[0][1:]))), "LIMIT", "171.9 deg"),
        (lambda t: replace(t, positions_rad=(*t.positions_rad, (-3.0, *t.positions_rad[0][1:]))), "LIMIT", "-171.9"),
        (lambda t: replace(t, period_s=0.001), "LIMIT", "its limit is 60"),
        (
            lambda t: replace(t, positions_rad=tuple((p[0] + 0.1, *p[1:]) for p in t.positions_rad)),
            "START_MISMATCH",
            "5.7 deg",
        ),
    ],
)
def test_a_run_that_must_not_be_is_refused_before_the_wire(
    change: Callable[[JointTrajectory], JointTrajectory], code: str, text: str
) -> None:
    arm = holding()
    arm.goals.clear()
    assert arm.ask(Run(5, change(line(arm)))).code == code
    assert text in arm.replies[5].message
    assert arm.mode() is Mode.HOLDING
    assert not arm.goals


def test_a_run_needs_torque() -> None:
    arm = IdealArm().connect()
    assert "torque on" in arm.ask(Run(5, line(arm))).message


def test_a_motion_pauses_for_a_stale_servo_and_goes_on() -> None:
    arm = running(5)
    arm.silent = {2}
    arm.run_ticks(4)
    assert arm.state.motion is not None
    assert arm.state.motion.rate == 0.0
    arm.silent = set()
    arm.run_ticks(25)
    assert arm.replies[5].ok


def test_a_goal_lost_on_the_wire_is_said_again() -> None:
    arm = holding()
    arm.deaf = {0}
    arm.run_tick(Run(5, line(arm, seconds=0.2, delta_rad=0.1)))
    arm.deaf = set()
    arm.run_ticks(4)
    assert arm.replies[5].ok
    assert arm.get(0, ax12a.GOAL) == arm.goals[-1][0]


def test_sampling_holds_the_ends() -> None:
    t = JointTrajectory(0.1, ((0.0,), (1.0,), (3.0,)))
    assert [sample_trajectory(t, x)[0] for x in (-1.0, 0.0, 0.05, 0.15, 0.2, 9.0)] == pytest.approx(
        [0, 0, 0.5, 2, 3, 3]
    )


def test_points_with_times_of_their_own_are_gone_through_at_those() -> None:
    t = JointTrajectory(0.1, ((0.0,), (1.0,), (3.0,)), times_s=(0.0, 2.0, 3.0))
    assert [sample_trajectory(t, x)[0] for x in (-1.0, 0.0, 1.0, 2.0, 2.5, 3.0, 9.0)] == [0, 0, 0.5, 1, 2, 3, 3]
    arm = holding()
    start = arm.positions_rad()
    there = (start[0] - 0.4, *start[1:])
    arm.goals.clear()
    arm.run_tick(Run(5, JointTrajectory(0.1, (start, there, there), times_s=(0.0, 2.0, 3.0))))
    arm.run_ticks(29)
    assert 5 not in arm.replies
    arm.run_ticks(3)
    assert arm.replies[5].ok
    assert arm.goals[19:30] == [arm.goals[-1]] * 11


def test_start_tolerance_is_the_documented_two_degrees() -> None:
    assert math.degrees(START_TOLERANCE_RAD) == pytest.approx(2.0)
