"""Torque in the control step: taken over as it is found, coming on carefully, and going."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.machine import Phase
from armctl.control.sequences import SOFT_TORQUE
from armctl.dynamixel import ax12a
from armctl.messages import Clear, Command, Mode, Release, Teach, TeachEnd, TorqueOn
from tests.control.damaged_arm import Rig, writes
from tests.control.ideal_arm import IdealArm, energising, holding


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
    assert arm.fault() == ("LOST_TORQUE", 4)


def test_what_came_on_before_a_fault_keeps_its_goal_against_another_program() -> None:
    arm = energising()
    while arm.state.phase is not Phase.CONFIRMING:
        arm.run_tick()
    arm.silent = set(range(6))
    arm.run_ticks(8)
    assert (arm.code(), arm.state.powered) == ("BUS_DEAD", None)
    arm.silent = set()
    ours = arm.state.goal
    arm.put(3, ax12a.GOAL, ours[3] + 19)
    arm.run_ticks(2)
    assert "OTHER_WRITER" in arm.events
    assert (arm.state.goal, arm.get(3, ax12a.GOAL)) == (ours, ours[3])
    assert arm.ask(Clear(7)).ok
    assert arm.mode() is Mode.HOLDING


@pytest.mark.parametrize("limp", [set(), {3, 4, 5}])
def test_a_goal_that_followed_its_limp_shaft_before_a_fault_is_nobody_else_s(limp: set[int]) -> None:
    arm = energising()
    while arm.state.phase is not Phase.ENABLING:
        arm.run_tick()
    arm.silent = set(range(6))
    arm.run_ticks(8)
    arm.silent = set()
    for i in range(6):
        arm.put(i, ax12a.TORQUE_ENABLE, int(i not in limp))
    arm.put(0, ax12a.GOAL, arm.state.goal[0] - 1)
    arm.run_ticks(2)
    assert "OTHER_WRITER" not in arm.events
    assert ("LOST_TORQUE" in arm.events) == bool(limp)
    assert arm.get(0, ax12a.GOAL) == arm.state.goal[0]


def test_torque_does_not_come_on_where_a_shaft_that_swings_went_beyond_its_limit() -> None:
    arm = IdealArm().connect()
    low = arm.arm.servos[1].limits_tick[0]
    for off in (3, 4, 4, 3, 4, 5, 3, 0, 7, -1, -2, -6, -7, -7, -8, *(-7,) * 30):
        arm.put(1, ax12a.PRESENT_POSITION, low + off)
        arm.run_tick(*((TorqueOn(1),) if off == -6 else ()))
        assert not arm.get(1, ax12a.TORQUE_ENABLE)
    assert (arm.replies[1].ok, arm.replies[1].code) == (False, "LIMIT")
    assert "beyond its limit" in arm.replies[1].message


def test_torque_on_softens_and_sets_the_goal_before_it_enables() -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    first = arm.run_tick(TorqueOn(1))
    assert first.mode is Mode.ENERGISING
    limits = [w for w in first.writes if w.address == ax12a.TORQUE_LIMIT.address]
    assert [w.value for w in limits] == [SOFT_TORQUE] * 6
    assert not [w for w in first.writes if w.address == ax12a.TORQUE_ENABLE.address]
    assert first.goal is None, "it might energise a servo that has missed its soft limit"
    second = arm.run_tick()
    assert second.goal is not None
    assert second.goal.ticks == tuple(arm.get(i, ax12a.PRESENT_POSITION) for i in range(6))
    assert all(speed > 0 for speed in second.goal.speeds)
    third = arm.run_tick()
    assert [w.value for w in third.writes if w.address == ax12a.TORQUE_ENABLE.address] == [1] * 6
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


def about_to_energise_limp_servos() -> IdealArm:
    """An arm whose servos no goal energises, one tick before torque is to come on."""
    arm = IdealArm().connect()

    def stay_limp(arm: IdealArm) -> None:
        for index in range(6):
            if arm.state.phase is Phase.PREPARING:
                arm.put(index, ax12a.TORQUE_ENABLE, 0)

    arm.after_write = stay_limp
    arm.run_ticks(16)  # by now its sensors are known to be quiet
    arm.run_tick(TorqueOn(1))
    return arm


@pytest.mark.parametrize(
    ("make", "register", "value", "problem", "ticks"),
    [
        (energising, ax12a.GOAL, 700, "NOT_TAKEN: servo 1 (base) shows goal 700", 0),
        (energising, ax12a.TORQUE_LIMIT, 1023, "NOT_TAKEN: servo 1 (base) shows torque limit 1023", 0),
        (energising, ax12a.PRESENT_POSITION, 560, "JUMP_REFUSED: servo 1 (base) moved while torque came on", 1),
        (energising, ax12a.TORQUE_ENABLE, 0, "NOT_TAKEN: servo 1 (base) did not take torque", 1),
        # Its goal was lost, and shown all the same: that of a limp servo may follow its shaft.
        (about_to_energise_limp_servos, ax12a.MOVING_SPEED, 0, "NOT_TAKEN: servo 1 (base) has no speed", 1),
        # More than half a degree, before torque comes on.
        (about_to_energise_limp_servos, ax12a.PRESENT_POSITION, 516, "JUMP_REFUSED: servo 1 (base) moved", 0),
    ],
)
def test_any_surprise_while_torque_comes_on_backs_out(
    make: Callable[[], IdealArm], register: ax12a.Register, value: int, problem: str, ticks: int
) -> None:
    arm = make()
    arm.run_ticks(ticks)
    arm.put(0, register, value)
    arm.run_ticks(2)
    assert arm.mode() is Mode.OFF
    assert f"{arm.replies[1].code}: {arm.replies[1].message}".startswith(problem)
    assert not any(arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6))


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
    assert "joint base is moving" in arm.ask(TorqueOn(1)).message
    arm.put(1, ax12a.PRESENT_POSITION, 900)
    arm.run_tick()
    assert arm.ask(TorqueOn(2)).code == "LIMIT"
    assert "joint shoulder" in arm.replies[2].message
    assert not arm.goals


def test_a_joint_a_tick_outside_its_limit_is_energised_at_the_limit() -> None:
    arm = IdealArm().connect()
    high = arm.arm.joints[1].limits_tick[1]
    arm.put(1, ax12a.PRESENT_POSITION, high + 1)
    arm.run_tick()
    arm.run_ticks(2, TorqueOn(1))
    assert arm.goals[0][1] == high


def test_energising_waits_for_a_servo_that_misses_a_tick() -> None:
    arm = energising()
    arm.silent = {5}
    arm.run_ticks(2)
    assert arm.mode() is Mode.ENERGISING
    arm.silent = set()
    arm.run_ticks(12)
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
    arm.run_ticks(8, Teach(3))
    assert (arm.mode(), arm.replies[3].code) == (Mode.FAULTED, "NOT_LIMP")


def test_release_switches_torque_off_and_answers_a_pending_teach() -> None:
    arm = holding()
    arm.run_tick(Teach(3), Release(4))
    assert (arm.replies[3].code, arm.mode(), 4 in arm.replies) == ("RELEASED", Mode.RELEASING, False)
    arm.run_tick()
    assert (arm.mode(), arm.replies[4].ok) == (Mode.OFF, True)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6


def test_an_adopted_arm_keeps_the_settings_it_is_found_with() -> None:
    arm = IdealArm().power()
    arm.put(3, ax12a.PUNCH, 40)
    arm.put(3, ax12a.CW_SLOPE, 64)
    arm.connect().run_ticks(5)
    assert arm.mode() is Mode.HOLDING


def test_a_torque_limit_that_missed_the_end_of_the_ramp_is_told_again() -> None:
    arm = energising()
    arm.run_ticks(6)
    arm.put(2, ax12a.TORQUE_LIMIT, 844)
    arm.run_ticks(1)
    assert arm.mode() is Mode.ENERGISING
    arm.run_ticks(2)
    assert arm.mode() is Mode.HOLDING
    assert arm.get(2, ax12a.TORQUE_LIMIT) == 1023


def test_a_servo_that_never_takes_its_full_torque_limit_makes_torque_on_back_out() -> None:
    arm = energising()
    arm.run_ticks(6)
    arm.after_write = lambda a: a.put(2, ax12a.TORQUE_LIMIT, 844)
    arm.run_ticks(20)
    assert arm.mode() is Mode.OFF
    assert "servo 3 (elbow) shows torque limit 844" in arm.replies[1].message


@pytest.mark.parametrize(("command", "stays", "ticks"), [(Release(5), True, 6), (Teach(5), False, 1), (None, False, 1)])
def test_torque_that_appears_or_stays_on_a_limp_arm_is_a_fault(
    command: Command | None, stays: bool, ticks: int
) -> None:
    arm = holding() if command else IdealArm().connect()
    if stays:
        arm.after_write = lambda a: a.put(1, ax12a.TORQUE_ENABLE, 1)
    arm.run_ticks(2, *([command] if command else []))
    arm.put(1, ax12a.TORQUE_ENABLE, 1)
    arm.run_ticks(ticks)
    assert arm.fault() == ("NOT_LIMP", 2)
    assert "armctl release" in arm.ask(Clear(6)).message


@pytest.mark.parametrize("period_s", [0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0])
def test_the_torque_limit_rises_for_half_a_second_at_every_period(period_s: float) -> None:
    arm = IdealArm(period_s=period_s).connect()
    arm.run_tick()
    arm.run_tick(TorqueOn(1))
    limits: list[int] = []
    while arm.mode() is not Mode.HOLDING and len(limits) < 500:
        arm.run_tick()
        if arm.get(0, ax12a.TORQUE_ENABLE):
            limits.append(arm.get(0, ax12a.TORQUE_LIMIT))
    rising = [limit for limit in limits if limit < limits[-1]]
    assert limits == sorted(limits)
    assert limits[0] == SOFT_TORQUE
    assert 0.5 <= len(rising) * period_s <= max(0.5, period_s) + 3.0 * period_s


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 6), st.frozensets(st.integers(0, 7), min_size=1))
def test_no_servo_has_more_than_soft_torque_before_the_ramp_whichever_writes_are_damaged(
    servo_id: int, damaged: frozenset[int]
) -> None:
    rig = Rig()
    begin, hard = len(rig.records), set()

    def damages(packet: bytes) -> bool:
        for servo in rig.simulated.servos:
            if servo.torque_enabled and servo.get(ax12a.TORQUE_LIMIT) > SOFT_TORQUE:
                hard.add(rig.loop.state.phase)
        return writes(packet, ax12a.TORQUE_LIMIT, servo_id) and len(rig.records) - begin in damaged

    rig.port.damages = damages
    rig.ticks(30, TorqueOn(1))
    assert hard <= {Phase.RAMPING, Phase.CONFIRMING, Phase.HOLDING, Phase.RELEASING}
    assert 1 in rig.replies()
    assert rig.replies()[1].ok == (rig.mode() is Mode.HOLDING)
    assert rig.stiff() in ([], list(range(1, 7)))
