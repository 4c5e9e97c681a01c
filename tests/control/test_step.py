"""The control step, driven by ideal servos: sequences, stops, faults, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.machine import Phase
from armctl.control.motion import sample_trajectory
from armctl.control.requests import START_TOLERANCE_RAD
from armctl.control.sequences import SOFT_TORQUE
from armctl.control.step import step
from armctl.control.tick import MINIMUM_SPEED_UNITS
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.messages import (
    Clear,
    Command,
    Connected,
    Hold,
    HostLost,
    Inputs,
    JointTrajectory,
    Mode,
    Park,
    Problem,
    Release,
    Run,
    Sample,
    ServoReading,
    Teach,
    TeachEnd,
    TorqueOn,
)
from tests.control.ideal_arm import PERIOD_S, IdealArm


def line(
    arm: IdealArm, delta_rad: float = -0.4, seconds: float = 2.0, begin_s: float = 0.0, end_s: float = 0.0
) -> JointTrajectory:
    """A joint-space line of the elbow-like joint 0 from where the arm is."""
    start = arm.positions_rad()
    count = round(seconds / PERIOD_S) + 1
    points = tuple((start[0] + delta_rad * k / (count - 1), *start[1:]) for k in range(count))
    return JointTrajectory(PERIOD_S, points, begin_s, end_s, label="line")


def holding() -> IdealArm:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.run_ticks(12)
    assert arm.mode() is Mode.HOLDING
    assert arm.replies[1].ok
    return arm


def test_a_limp_arm_is_adopted_limp_and_nothing_is_written() -> None:
    arm = IdealArm().connect()
    outputs = arm.run_ticks(3)
    assert outputs.mode is Mode.OFF
    assert not arm.goals
    assert not outputs.writes


def test_a_powered_arm_is_adopted_at_its_goal_and_nothing_is_written() -> None:
    arm = IdealArm().power().connect()
    assert arm.mode() is Mode.HOLDING
    assert arm.state.goal == tuple(arm.get(i, ax12a.GOAL) for i in range(6))
    assert not arm.goals


def test_a_half_powered_arm_is_a_fault_that_names_the_limp_servo() -> None:
    arm = IdealArm().power()
    arm.put(3, ax12a.TORQUE_ENABLE, 0)
    arm.connect()
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == ("LOST_TORQUE", 4)


def test_torque_on_softens_and_sets_the_goal_before_it_enables() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    first = arm.run_tick(TorqueOn(1))
    assert first.mode is Mode.ENERGISING
    limits = [w for w in first.writes if w.address == ax12a.TORQUE_LIMIT.address]
    assert [w.value for w in limits] == [SOFT_TORQUE] * 6
    assert not [w for w in first.writes if w.address == ax12a.TORQUE_ENABLE.address]
    assert first.goal is not None
    assert first.goal.ticks == tuple(arm.get(i, ax12a.PRESENT_POSITION) for i in range(6))
    assert all(speed > 0 for speed in first.goal.speeds)
    second = arm.run_tick()
    assert [w.value for w in second.writes if w.address == ax12a.TORQUE_ENABLE.address] == [1] * 6
    arm.run_ticks(10)
    assert arm.mode() is Mode.HOLDING
    assert [arm.get(i, ax12a.TORQUE_LIMIT) for i in range(6)] == [1023] * 6
    assert arm.replies[1].ok


def test_torque_comes_on_where_goals_follow_limp_shafts_that_are_not_quite_where_they_were() -> None:
    arm = IdealArm()

    def follow(arm: IdealArm) -> None:
        for index in range(6):
            if not arm.get(index, ax12a.TORQUE_ENABLE):
                arm.put(index, ax12a.GOAL, arm.get(index, ax12a.PRESENT_POSITION))
            elif arm.get(index, ax12a.TORQUE_LIMIT) == SOFT_TORQUE and arm.state.phase is Phase.PREPARING:
                # What a goal does not energise is limp still, and one tick off by noise.
                arm.put(index, ax12a.TORQUE_ENABLE, 0)
                arm.put(index, ax12a.GOAL, arm.get(index, ax12a.PRESENT_POSITION) + 1)

    arm.after_write = follow
    arm.connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    assert not arm.get(0, ax12a.TORQUE_ENABLE)
    arm.run_ticks(12)
    assert (arm.mode(), arm.replies[1].ok) == (Mode.HOLDING, True)


def test_a_servo_that_does_not_take_its_limit_makes_torque_on_back_out() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.after_write = lambda a: a.put(2, ax12a.TORQUE_LIMIT, 1023)
    arm.run_tick(TorqueOn(1))
    arm.run_tick()
    assert arm.mode() is Mode.OFF
    assert not arm.replies[1].ok
    assert "servo 3 (elbow) shows torque limit 1023" in arm.replies[1].message
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6


@pytest.mark.parametrize(
    ("register", "value", "text", "phase"),
    [
        (ax12a.GOAL, 700, "shows goal 700", 1),
        (ax12a.PRESENT_POSITION, 560, "moved while torque came on", 2),
        (ax12a.TORQUE_ENABLE, 0, "did not take torque", 2),
    ],
)
def test_any_surprise_while_torque_comes_on_backs_out(
    register: ax12a.Register, value: int, text: str, phase: int
) -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.run_ticks(phase - 1)
    arm.put(0, register, value)
    arm.run_tick()
    assert arm.mode() is Mode.OFF
    assert arm.replies[1].code == "JUMP_REFUSED"
    assert text in arm.replies[1].message


def about_to_energise_limp_servos() -> IdealArm:
    """An arm whose servos no goal energises, one tick before torque is to come on."""
    arm = IdealArm().connect()

    def stay_limp(arm: IdealArm) -> None:
        for index in range(6):
            if arm.state.phase is Phase.PREPARING:
                arm.put(index, ax12a.TORQUE_ENABLE, 0)

    arm.after_write = stay_limp
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    return arm


def test_a_limp_shaft_that_moves_off_before_torque_comes_on_backs_out() -> None:
    arm = about_to_energise_limp_servos()
    arm.put(0, ax12a.PRESENT_POSITION, arm.get(0, ax12a.PRESENT_POSITION) + 4)
    arm.run_tick()
    assert arm.mode() is Mode.OFF
    assert arm.replies[1].code == "JUMP_REFUSED"
    assert "moved while torque came on" in arm.replies[1].message


def test_torque_comes_on_at_the_goal_that_a_limp_shaft_has_not_left_by_more_than_half_a_degree() -> None:
    arm = about_to_energise_limp_servos()
    for position in (515, 518):
        arm.put(0, ax12a.PRESENT_POSITION, position)
        arm.run_tick()
        assert not any(arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6))
        assert arm.get(0, ax12a.GOAL) == position
    arm.run_tick()
    assert all(arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6))
    arm.run_ticks(12)
    assert (arm.mode(), arm.replies[1].ok) == (Mode.HOLDING, True)


def test_torque_on_is_refused_for_a_moving_arm_and_outside_the_limits() -> None:
    arm = IdealArm().connect()
    arm.put(0, ax12a.PRESENT_POSITION, 600)
    arm.run_tick(TorqueOn(1))
    assert "joint base is moving" in arm.replies[1].message
    arm.put(1, ax12a.PRESENT_POSITION, 900)
    arm.run_tick()
    arm.run_tick(TorqueOn(2))
    assert arm.replies[2].code == "LIMIT"
    assert "joint shoulder" in arm.replies[2].message
    assert not arm.goals


def test_a_joint_a_tick_outside_its_limit_is_energised_at_the_limit() -> None:
    arm = IdealArm().connect()
    high = arm.arm.joints[1].limits_tick[1]
    arm.put(1, ax12a.PRESENT_POSITION, high + 1)
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    assert arm.goals[0][1] == high


def test_energising_waits_for_a_servo_that_misses_a_tick() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.silent = {5}
    arm.run_ticks(2)
    assert arm.mode() is Mode.ENERGISING
    arm.silent = set()
    arm.run_ticks(12)
    assert arm.mode() is Mode.HOLDING


def test_a_run_streams_goals_one_tick_ahead_and_answers_at_its_end() -> None:
    arm = holding()
    arm.goals.clear()
    trajectory = line(arm, begin_s=0.5, end_s=1.5)
    outputs = arm.run_tick(Run(5, trajectory))
    assert outputs.mode is Mode.MOVING
    arm.run_ticks(25)
    assert arm.replies[5].ok
    assert arm.mode() is Mode.HOLDING
    assert arm.events.count("PLAN_BEGIN") == arm.events.count("PLAN_END") == 1
    assert arm.goals[-1][0] == round(arm.arm.joints[0].tick(trajectory.positions_rad[-1][0]))
    assert len(arm.goals) == 20
    steps = [abs(b[0] - a[0]) for a, b in pairwise(arm.goals)]
    assert max(steps) <= 5  # 0.02 rad a tick is 4 servo ticks


@pytest.mark.parametrize("after_s", [0.006, 0.05, 0.095, 0.1, 0.3])
def test_a_goal_soon_after_another_is_given_the_speed_for_both_ways(after_s: float) -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(6)
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
@settings(deadline=None, max_examples=10)
def test_a_stop_comes_to_rest_on_the_path_within_300_ms(after: int) -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(after)
    arm.goals.clear()
    arm.run_tick(Hold(6))
    arm.run_ticks(3)
    assert arm.mode() is Mode.HOLDING
    assert arm.replies[6].ok
    assert not arm.replies[5].ok
    assert arm.replies[5].code == "STOPPED"
    assert len(arm.goals) <= 2
    columns = list(zip(*arm.goals, strict=True))
    assert all(len(set(column)) == 1 for column in columns[1:])


def test_losing_the_host_stops_the_arm() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_tick(HostLost())
    arm.run_ticks(3)
    assert arm.mode() is Mode.HOLDING
    assert arm.replies[5].code == "HOST_LOST"


def test_hold_is_served_in_every_mode() -> None:
    arm = IdealArm().connect()
    arm.run_tick(Hold(1))
    assert "limp" in arm.replies[1].message
    arm = holding()
    arm.run_tick(Hold(2))
    assert arm.replies[2].ok


def test_a_late_tick_stops_the_motion() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.late_ns = 300_000_000
    arm.run_tick()
    arm.late_ns = 0
    arm.run_ticks(3)
    assert arm.replies[5].code == "LATE"
    assert "LATE" in arm.events
    assert arm.mode() is Mode.HOLDING


def test_teaching_is_entered_only_when_every_servo_is_seen_limp() -> None:
    arm = holding()
    outputs = arm.run_tick(Teach(3))
    assert [w.value for w in outputs.writes] == [0] * 6
    assert 3 not in arm.replies
    arm.run_tick()
    assert arm.replies[3].ok
    arm.goals.clear()
    outputs = arm.run_ticks(5)
    assert not arm.goals
    assert not outputs.writes
    arm.run_tick(TeachEnd(4))
    assert arm.mode() is Mode.OFF


def test_a_servo_that_stays_stiff_in_teaching_is_a_fault() -> None:
    arm = holding()
    arm.after_write = lambda a: a.put(4, ax12a.TORQUE_ENABLE, 1)
    arm.run_tick(Teach(3))
    arm.run_ticks(7)
    assert arm.replies[3].code == "NOT_LIMP"
    assert arm.mode() is Mode.FAULTED


def test_torque_that_appears_while_teaching_is_a_fault() -> None:
    arm = holding()
    arm.run_tick(Teach(3))
    arm.run_tick()
    arm.put(1, ax12a.TORQUE_ENABLE, 1)
    arm.run_tick()
    assert arm.state.fault is not None
    assert arm.state.fault.code == "NOT_LIMP"


def test_release_switches_torque_off_and_answers_a_pending_teach() -> None:
    arm = holding()
    arm.run_tick(Teach(3), Release(4))
    assert arm.replies[3].code == "RELEASED"
    assert arm.replies[4].ok
    assert arm.mode() is Mode.OFF
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6


def test_release_is_refused_while_moving() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_tick(Release(6))
    assert arm.replies[6].code == "ILLEGAL_TRANSITION"
    assert arm.mode() is Mode.MOVING


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        (lambda t: replace(t, positions_rad=t.positions_rad[:1]), "LIMIT", "2 to 4000 points"),
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
    arm.run_tick(Run(5, change(line(arm))))
    assert arm.replies[5].code == code
    assert text in arm.replies[5].message
    assert arm.mode() is Mode.HOLDING
    assert not arm.goals


def test_a_run_needs_torque() -> None:
    arm = IdealArm().connect()
    arm.run_tick(Run(5, line(arm)))
    assert "torque on" in arm.replies[5].message


def test_a_motion_pauses_for_a_stale_servo_and_goes_on() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(5)
    arm.silent = {2}
    arm.run_ticks(4)
    assert arm.state.motion is not None
    assert arm.state.motion.rate == 0.0
    arm.silent = set()
    arm.run_ticks(25)
    assert arm.replies[5].ok


def test_a_silent_servo_latches_and_the_others_hold() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(5)
    arm.silent = {2}
    arm.run_ticks(9)
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == ("SERVO_SILENT", 3)
    assert arm.state.motion is None
    assert not arm.replies[5].ok
    arm.goals.clear()
    arm.run_ticks(5)
    assert not arm.goals
    arm.run_tick(Clear(7))
    assert "no reply from elbow" in arm.replies[7].message
    arm.silent = set()
    arm.run_tick()
    arm.silent = {1}  # one reply lost just then is no cause: that servo was heard a tick ago
    arm.run_tick(Clear(8))
    assert arm.replies[8].ok
    assert arm.mode() is Mode.HOLDING


def test_a_silent_bus_is_one_fault() -> None:
    arm = holding()
    arm.silent = set(range(6))
    arm.run_ticks(7)
    assert arm.state.fault is not None
    assert arm.state.fault.code == "BUS_DEAD"


def test_a_silent_bus_is_one_fault_also_where_its_servos_fell_silent_one_by_one() -> None:
    arm = holding()
    arm.silent = {0, 1}
    arm.run_tick()
    arm.silent = set(range(6))
    arm.run_ticks(6)
    assert arm.state.fault is not None
    assert arm.state.fault.code == "BUS_DEAD"


def test_no_goal_goes_out_while_a_servo_is_unheard_lest_it_wakes_one_that_restarted() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(5)
    arm.silent = {2}
    arm.goals.clear()
    arm.run_ticks(3)
    assert not arm.goals
    arm.silent = set()
    arm.put(2, ax12a.TORQUE_ENABLE, 0)  # it restarted
    arm.run_tick()
    assert arm.state.fault is not None
    assert arm.state.fault.code == "LOST_TORQUE"
    assert arm.get(2, ax12a.TORQUE_ENABLE) == 0


def test_unplugging_latches_at_once_and_clears_only_after_replugging() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.port_open = False
    arm.run_tick()
    assert arm.state.fault is not None
    assert arm.state.fault.code == "PORT_GONE"
    assert arm.replies[5].code == "PORT_GONE"
    arm.run_tick(Clear(6))
    assert "not open" in arm.replies[6].message
    arm.port_open = True
    arm.run_tick(Connected())
    assert "PORT_BACK" in arm.events
    assert arm.mode() is Mode.FAULTED
    arm.goals.clear()
    arm.run_tick(Connected(), Clear(7))
    assert arm.replies[7].ok
    assert arm.mode() is Mode.HOLDING
    assert not arm.goals
    assert arm.events.count("PORT_BACK") == 1


@pytest.mark.parametrize(
    ("register", "value", "code"),
    [
        (ax12a.TORQUE_ENABLE, 0, "LOST_TORQUE"),
        (ax12a.TORQUE_LIMIT, 0, "TRIPPED"),
        (ax12a.GOAL, 300, "OTHER_WRITER"),
    ],
)
def test_what_a_servo_reports_against_us_latches_in_one_tick(register: ax12a.Register, value: int, code: str) -> None:
    arm = holding()
    arm.put(3, register, value)
    arm.run_tick()
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == (code, 4)


@pytest.mark.parametrize(
    ("register", "value", "code"),
    [
        (ax12a.CW_SLOPE, 128, "OTHER_WRITER"),
        (ax12a.PUNCH, 100, "OTHER_WRITER"),
        (ax12a.TORQUE_LIMIT, 700, "OTHER_WRITER"),
        (ax12a.TORQUE_LIMIT, 1023, "LOST_TORQUE"),
    ],
)
def test_settings_that_change_by_themselves_latch_in_one_tick(register: ax12a.Register, value: int, code: str) -> None:
    """The last one is a servo that has restarted, and that a goal has energised again before it was read."""
    soft = load_arm("ax12-line")
    halved = tuple(joint.model_copy(update={"torque_limit_ratio": 0.5}) for joint in soft.joints)
    arm = IdealArm(soft.model_copy(update={"joints": halved})).connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.run_ticks(20)
    assert arm.mode() is Mode.HOLDING
    arm.put(3, register, value)
    arm.run_tick()
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == (code, 4)
    assert not arm.outputs or not arm.outputs.goal


def test_an_adopted_arm_keeps_the_settings_it_is_found_with() -> None:
    arm = IdealArm().power()
    arm.put(3, ax12a.PUNCH, 40)
    arm.put(3, ax12a.CW_SLOPE, 64)
    arm.connect().run_ticks(5)
    assert arm.mode() is Mode.HOLDING


def test_a_torque_limit_that_missed_the_end_of_the_ramp_is_told_again() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.run_ticks(6)
    arm.put(2, ax12a.TORQUE_LIMIT, 844)
    arm.run_ticks(1)
    assert arm.mode() is Mode.ENERGISING
    arm.run_ticks(2)
    assert arm.mode() is Mode.HOLDING
    assert arm.get(2, ax12a.TORQUE_LIMIT) == 1023


def test_a_servo_that_never_takes_its_full_torque_limit_makes_torque_on_back_out() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    arm.run_ticks(6)
    arm.after_write = lambda a: a.put(2, ax12a.TORQUE_LIMIT, 844)
    arm.run_ticks(20)
    assert arm.mode() is Mode.OFF
    assert "servo 3 (elbow) shows torque limit 844" in arm.replies[1].message


@pytest.mark.parametrize("release", [True, False])
def test_torque_that_appears_or_stays_on_a_limp_arm_is_a_fault(release: bool) -> None:
    arm = holding() if release else IdealArm().connect()
    if release:
        arm.after_write = lambda a: a.put(1, ax12a.TORQUE_ENABLE, 1)
        arm.run_tick(Release(5))
    else:
        arm.run_ticks(5)
        arm.put(1, ax12a.TORQUE_ENABLE, 1)
    arm.run_ticks(4)
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == ("NOT_LIMP", 2)
    arm.run_tick(Clear(6))
    assert "armctl release" in arm.replies[6].message


def test_a_refused_clear_names_every_cause_and_what_to_do() -> None:
    arm = holding()
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.run_tick()
    arm.put(1, ax12a.PRESENT_TEMPERATURE, 70)
    arm.put(2, ax12a.PRESENT_VOLTAGE, 70)
    arm.run_ticks(2)
    arm.run_tick(Clear(1))
    for text in ("shoulder above 65 degC", "7.0 V", "wrist limp while others hold", "armctl release"):
        assert text in arm.replies[1].message


def test_a_limp_servo_among_powered_ones_must_be_released_before_clearing() -> None:
    arm = holding()
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.run_tick()
    arm.run_tick(Clear(1))
    assert "armctl release" in arm.replies[1].message
    arm.run_tick(Release(2))
    assert arm.mode() is Mode.FAULTED
    arm.run_tick(Clear(3))
    assert arm.mode() is Mode.OFF
    arm.run_tick(TorqueOn(4))
    arm.run_ticks(12)
    assert arm.replies[4].ok


def test_a_blocked_joint_latches_and_its_goal_becomes_its_position_once() -> None:
    arm = holding()
    arm.stuck = {0}
    arm.run_tick(Run(5, line(arm, delta_rad=0.8)))
    arm.run_ticks(12)
    assert arm.state.fault is not None
    assert arm.state.fault.code == "BLOCKED"
    assert arm.goals[-1][0] == arm.get(0, ax12a.PRESENT_POSITION)
    arm.goals.clear()
    arm.run_ticks(5)
    assert not arm.goals
    arm.run_tick(Clear(7))
    assert arm.replies[7].ok


def away() -> IdealArm:
    """Holding, some way from the rest pose."""
    arm = holding()
    arm.run_tick(Run(90, line(arm, delta_rad=0.6)))
    arm.run_ticks(25)
    assert arm.replies[90].ok
    return arm


def at_rest(arm: IdealArm) -> bool:
    ways = zip(arm.positions_rad(), arm.arm.joints, strict=True)
    return all(abs(position - joint.rest_rad) < math.radians(3.0) for position, joint in ways)


def test_park_goes_slowly_to_rest_and_is_limp_there() -> None:
    arm = away()
    arm.goals.clear()
    outputs = arm.run_tick(Park(5))
    assert outputs.mode is Mode.PARKING
    arm.run_ticks(60)
    assert arm.replies[5].ok
    assert arm.mode() is Mode.OFF
    assert at_rest(arm)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6
    fastest = max(abs(b[0] - a[0]) for a, b in pairwise(arm.goals)) * ax12a.TICK_RAD / PERIOD_S
    assert fastest <= math.radians(20.0) + ax12a.TICK_RAD / PERIOD_S


def test_park_can_be_stopped_on_its_way() -> None:
    arm = away()
    arm.run_tick(Park(5))
    arm.run_ticks(10)
    arm.run_tick(Hold(6))
    arm.run_ticks(4)
    assert arm.mode() is Mode.HOLDING
    assert arm.replies[5].code == "STOPPED"
    assert arm.replies[6].ok
    assert not at_rest(arm)


def test_an_arm_that_does_not_get_to_rest_keeps_its_torque() -> None:
    arm = away()
    arm.run_tick(Park(5))
    arm.run_ticks(8)
    rest = round(arm.arm.joints[3].tick(arm.arm.joints[3].rest_rad))
    arm.after_write = lambda a: a.put(3, ax12a.PRESENT_POSITION, rest - 15)  # hangs 4.4 deg low
    arm.run_ticks(60)
    assert arm.replies[5].code == "NOT_AT_REST"
    assert arm.mode() is Mode.HOLDING
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [1] * 6


def test_a_way_to_rest_below_the_floor_is_not_taken() -> None:
    arm = away()
    arm.arm = arm.arm.model_copy(update={"floor_m": 1.0})
    arm.run_tick(Park(5))
    arm.run_ticks(3)
    assert arm.replies[5].code == "LIMIT"
    assert arm.mode() is Mode.HOLDING


@pytest.mark.parametrize(
    ("register", "value", "code", "seconds"),
    [
        (ax12a.PRESENT_TEMPERATURE, 66, "HOT", 0.1),
        (ax12a.PRESENT_VOLTAGE, 85, "VOLTAGE", 0.1),
        (ax12a.PRESENT_LOAD, 900, "OVERLOAD", 2.2),
    ],
)
def test_strain_sends_the_arm_to_rest_before_a_servo_trips(
    register: ax12a.Register, value: int, code: str, seconds: float
) -> None:
    arm = away()
    arm.run_tick(Run(5, line(arm, delta_rad=0.3, seconds=4.0)))
    arm.put(2, register, value)
    arm.run_ticks(round(seconds / PERIOD_S))
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.state.fault.servo_id) == (code, 3)
    arm.run_ticks(70)
    assert arm.replies[5].code == code
    assert at_rest(arm)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6
    assert arm.mode() is Mode.FAULTED
    arm.run_tick(Clear(7))
    cleared = code == "OVERLOAD"  # the load went with the torque; heat and voltage are still what they were
    assert arm.replies[7].ok is cleared
    arm.put(2, register, 120 if register is ax12a.PRESENT_VOLTAGE else 40)
    arm.run_tick(Clear(8))
    assert arm.replies[8].ok
    assert arm.mode() is Mode.OFF


@pytest.mark.parametrize("register", [ax12a.TORQUE_ENABLE, ax12a.TORQUE_LIMIT])
def test_the_way_to_rest_ends_where_torque_is_lost(register: ax12a.Register) -> None:
    arm = away()
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(5)
    arm.after_write = lambda a: a.put(1, register, 0)
    arm.run_ticks(5)
    assert arm.state.motion is None
    assert "LOST_TORQUE" in arm.events
    arm.goals.clear()
    arm.run_ticks(30)
    assert not arm.goals


def test_the_way_to_rest_ends_where_a_servo_falls_silent() -> None:
    arm = away()
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(5)
    arm.silent = {4}
    arm.run_ticks(10)
    assert "SERVO_SILENT" in arm.events
    assert arm.state.motion is None


def test_a_fault_on_the_way_to_rest_ends_it() -> None:
    arm = away()
    arm.run_tick(Park(5))
    arm.run_ticks(5)
    arm.put(3, ax12a.GOAL, 300)
    arm.run_tick()
    assert arm.replies[5].code == "OTHER_WRITER"
    arm.goals.clear()
    arm.run_ticks(30)
    assert not arm.goals


def test_release_on_the_way_to_rest_is_limp_at_once() -> None:
    arm = away()
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(5)
    arm.run_tick(Release(6))
    arm.goals.clear()
    arm.run_ticks(20)
    assert not arm.goals


def test_damaged_replies_above_a_tenth_latch_and_below_do_not() -> None:
    arm = holding()
    latched = []
    for joints in ({0}, {0, 1, 2}):
        for tick in range(100):
            arm.noisy = joints if tick % 2 else set()
            arm.run_tick()
        latched.append(arm.state.fault and arm.state.fault.code)
    assert latched == [None, "BUS_NOISE"]


def test_a_goal_lost_on_the_wire_is_said_again() -> None:
    arm = holding()
    arm.deaf = {0}
    arm.run_tick(Run(5, line(arm, seconds=0.2, delta_rad=0.1)))
    arm.deaf = set()
    arm.run_ticks(4)
    assert arm.replies[5].ok
    assert arm.get(0, ax12a.GOAL) == arm.goals[-1][0]


def test_problems_found_at_connection_forbid_torque_until_they_are_gone() -> None:
    arm = IdealArm()
    problem = Problem("WRONG_MODEL", "servo 2 (shoulder): model 29, not an AX-12A", 2)
    arm.run_tick(Connected((problem,)))
    assert arm.state.fault is not None
    assert arm.state.fault.code == "WRONG_MODEL"
    arm.run_tick(TorqueOn(1))
    assert not arm.replies[1].ok
    arm.run_tick(Connected((problem,)), Clear(2))
    assert "model 29" in arm.replies[2].message
    arm.run_tick(Connected(), Clear(3))
    assert arm.mode() is Mode.OFF


def test_clear_without_a_fault_says_so() -> None:
    arm = holding()
    arm.run_tick(Clear(1))
    assert "no fault" in arm.replies[1].message


def test_clear_waits_for_the_arm_to_come_to_rest() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(5)
    arm.put(3, ax12a.PRESENT_VOLTAGE, 80)
    arm.run_tick(Clear(1))
    assert "coming to rest" in arm.replies[1].message


def test_release_while_a_fault_decelerates_ends_the_motion() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm)))
    arm.run_ticks(5)
    arm.put(3, ax12a.PRESENT_VOLTAGE, 80)
    arm.run_tick(Release(6))
    assert arm.state.motion is None
    assert arm.outputs is not None
    assert arm.outputs.goal is None


def test_a_restart_is_told() -> None:
    arm = IdealArm().power()
    arm.run_tick(Connected(restarted=True))
    assert "RESTARTED" in arm.events
    assert arm.mode() is Mode.HOLDING
    assert not arm.goals


def test_an_unheard_servo_has_an_age_that_grows_and_no_tool_pose() -> None:
    arm = IdealArm(silent={1})
    first = arm.run_tick()
    second = arm.run_tick()
    assert first.tool is None
    assert not first.joints[1].known
    assert second.joints[1].age_s > first.joints[1].age_s


COMMANDS = st.sampled_from(["park", "hold", "release", "torque", "teach", "end", "run", "clear"])


@given(st.lists(st.tuples(COMMANDS, st.integers(0, 6)), max_size=25))
@settings(deadline=None, max_examples=60)
def test_any_command_sequence_keeps_goals_inside_limits_and_answers_everyone(story: list[tuple[str, int]]) -> None:
    arm = IdealArm().connect()
    asked = 0
    for name, ticks in story:
        asked += 1
        commands: dict[str, Command] = {
            "hold": Hold(asked),
            "park": Park(asked),
            "release": Release(asked),
            "torque": TorqueOn(asked),
            "teach": Teach(asked),
            "end": TeachEnd(asked),
            "run": Run(asked, line(arm, seconds=0.5, delta_rad=0.2)),
            "clear": Clear(asked),
        }
        arm.run_tick(commands[name])
        arm.run_ticks(ticks)
    arm.run_ticks(60)
    assert set(arm.replies) == set(range(1, asked + 1))
    assert arm.state.fault is None
    for goal in arm.goals:
        for tick, joint in zip(goal, arm.arm.joints, strict=True):
            assert joint.limits_tick[0] <= tick <= joint.limits_tick[1]
    for a, b in pairwise(arm.goals):
        assert max(abs(x - y) for x, y in zip(a, b, strict=True)) <= 60.0 * PERIOD_S / math.degrees(ax12a.TICK_RAD) + 1


def test_the_same_inputs_give_the_same_outputs() -> None:
    arm = holding()
    inputs = Inputs(arm.tick, arm.now_ns, Sample(arm.now_ns, _readings(arm)), (Run(5, line(arm)),))
    first = step(arm.state, inputs, arm.arm, arm.robot, PERIOD_S)
    assert step(arm.state, inputs, arm.arm, arm.robot, PERIOD_S) == first


def _readings(arm: IdealArm):  # type: ignore[no-untyped-def]

    return tuple(
        ServoReading(i, bytes(b), arm.now_ns, True) for i, b in zip(arm.arm.servo_ids, arm.blocks, strict=True)
    )


def test_sampling_holds_the_ends() -> None:
    t = JointTrajectory(0.1, ((0.0,), (1.0,), (3.0,)))
    assert [sample_trajectory(t, x)[0] for x in (-1.0, 0.0, 0.05, 0.15, 0.2, 9.0)] == pytest.approx(
        [0, 0, 0.5, 2, 3, 3]
    )


def test_start_tolerance_is_the_documented_two_degrees() -> None:
    assert math.degrees(START_TOLERANCE_RAD) == pytest.approx(2.0)
