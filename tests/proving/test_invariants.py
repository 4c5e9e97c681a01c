"""Every checker of the invariants: a stream that violates it is caught, one that does not is left alone.

Here those of goals and of torque; `test_duties.py` and `test_rows.py` have what a fault obliges to.
"""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.messages import Mode
from proving.evidence import Sent
from tests.proving.judged import ARM, MIDDLE, Bench, N, running


def test_a_motion_a_stop_and_a_torque_on_as_they_should_be_break_nothing(limp: Bench) -> None:
    limp.ask("torque_on")
    before = [replace(servo) for servo in limp.servos]
    for servo in limp.servos:
        servo.torque = True
    goal = MIDDLE.to_bytes(2, "little") + (16).to_bytes(2, "little")
    sent = [Sent(index, ax12a.GOAL.address, goal) for index in range(N)]
    limp.judge.wrote(limp.now_s, sent, before, limp.servos)
    limp.ticks(7, Mode.ENERGISING)
    limp.tick(Mode.HOLDING)
    limp.ask("run")
    for _ in range(10):
        limp.move(15)
    limp.ask("hold")
    limp.move(12)
    limp.move(5)
    limp.ticks(20, Mode.HOLDING)
    assert limp.judge.violations == []


@pytest.mark.parametrize("ticks", [-1, 1])
def test_1_a_goal_outside_the_limits_of_its_joint(holding: Bench, ticks: int) -> None:
    low, high = ARM.joints[1].limits_tick
    holding.goal(high + 1 if ticks > 0 else low - 1, 1)
    assert "1" in holding.broken


@given(step=st.integers(-100, 100))
def test_2_a_goal_step_is_bounded_by_speed_and_period(step: int) -> None:
    bench = running()
    bench.move(step)
    assert ("2" in bench.broken) == (abs(step) > (60.0 + 4.0) / 10.0 / 300.0 * 1023.0 + 1.0)


def test_2_a_servo_that_missed_a_goal_may_get_two_steps_at_once_and_not_more(moving: Bench) -> None:
    moving.goal(MIDDLE + 20)
    moving.servos[0].goal = MIDDLE  # it did not hear
    moving.tick()
    moving.goal(MIDDLE + 40)
    assert moving.broken == set()
    moving.servos[0].goal = MIDDLE
    moving.tick()
    moving.goal(MIDDLE + 60)
    assert moving.broken == {"2"}


def test_2_what_counts_is_where_the_servo_said_it_was_when_it_was_read(moving: Bench) -> None:
    moving.plan("frozen_sensor", 0.1)
    moving.tick(Mode.MOVING)
    moving.at(MIDDLE + 90)  # it sees again, just after it was read
    moving.goal(MIDDLE - 10)
    assert moving.broken == set()


@pytest.mark.parametrize(("steps", "broken"), [(2, set()), (3, {"2"})])
def test_2_no_goal_goes_over_12_deg_ahead_even_of_a_joint_that_something_holds(steps: int, broken: set[str]) -> None:
    bench = running()
    bench.plan("blocked_joint", 5.0)
    for _ in range(steps):
        bench.move(15, follow=False)
    assert bench.broken == broken
    bench.move(-15, follow=False)
    assert bench.broken == broken


@pytest.mark.parametrize(("asked", "broken"), [("clear", set()), ("pause", {"2"})])
def test_2_beside_a_clear_a_goal_may_go_on_from_the_one_sent_or_the_one_held(asked: str, broken: set[str]) -> None:
    for known in (MIDDLE, MIDDLE + 40):
        bench = running()
        bench.goal(MIDDLE)
        bench.tick(Mode.MOVING)
        bench.servos[0].goal = MIDDLE + 40  # another program's
        bench.at(MIDDLE + 20)
        bench.hear()
        bench.ask(asked)
        bench.goal(known + 10)
        assert bench.broken == (broken if known > MIDDLE else set())


def test_2_a_joint_over_12_deg_from_its_goal(holding: Bench) -> None:
    holding.at(MIDDLE - 42.0)
    holding.tick()
    assert holding.broken == {"2"}


def test_2_a_shaft_that_was_thrown_off_is_excused_until_it_is_back_however_late_a_tick_comes(holding: Bench) -> None:
    holding.plan("frozen_sensor", 0.5)
    holding.at(MIDDLE - 200.0)
    holding.ticks(10, Mode.FAULTED, "BLOCKED")
    holding.now_s += 1.7
    holding.ticks(2, Mode.FAULTED, "BLOCKED")
    assert "2" not in holding.broken


def test_2_a_joint_that_something_holds_is_excused_and_its_neighbour_is_not(holding: Bench) -> None:
    holding.plan("blocked_joint", 1.0)
    holding.at(MIDDLE - 42.0)
    holding.tick()
    assert holding.broken == set()
    holding.at(MIDDLE - 42.0, 1)
    holding.tick()
    assert holding.broken == {"2"}


@pytest.mark.parametrize(("goal", "broken"), [(MIDDLE - 200, set()), (MIDDLE - 199, {"2"})])
def test_2_a_goal_where_a_joint_that_something_moves_said_it_was_is_no_motion(goal: int, broken: set[str]) -> None:
    bench = Bench()
    bench.plan("frozen_sensor", 0.05)
    bench.at(MIDDLE - 200.0)
    bench.hear()
    bench.at(MIDDLE - 207.0)  # it has turned round since
    bench.tick(heard=False)
    bench.ask("hold")
    bench.goal(goal)
    assert bench.broken == broken


@pytest.mark.parametrize("speed", [0, 92])
def test_2_and_3_a_speed_of_none_or_too_much(holding: Bench, speed: int) -> None:
    holding.write(0, ax12a.MOVING_SPEED, speed)
    assert holding.broken == {"3" if speed == 0 else "2"}


def test_a_goal_at_the_servos_own_position_is_no_motion(holding: Bench) -> None:
    holding.ask("hold")
    holding.at(MIDDLE - 25.0)
    holding.ticks(8)
    holding.goal(MIDDLE - 24)
    assert holding.broken == set()


@pytest.mark.parametrize(
    ("held", "broken"),
    [
        ({"speed": 16}, set()),
        ({"speed": 0}, {"3"}),
        ({"speed": 16, "limit": 300}, {"3"}),
    ],
)
def test_3_torque_comes_on_softly_and_slowly(limp: Bench, held: dict[str, int], broken: set[str]) -> None:
    limp.ask("torque_on")
    limp.goal(MIDDLE, torque=True, **held)
    assert limp.broken == broken


def test_3_torque_comes_on_with_a_goal_elsewhere(limp: Bench) -> None:
    limp.ask("torque_on")
    limp.goal(MIDDLE + 4, torque=True)
    assert limp.broken == {"3"}


@pytest.mark.parametrize(
    ("servo", "own", "broken"), [(0, MIDDLE, set()), (1, MIDDLE, {"3"}), (None, MIDDLE, set()), (0, MIDDLE + 40, {"3"})]
)
def test_3_another_programs_goal_at_torque_on_is_not_this_ones(servo: int | None, own: int, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.ask("torque_on")
    one = None if servo is None else ARM.servo_ids[servo]
    bench.plan("second_writer", 5.0, one)
    bench.goal(own)
    bench.tick()
    bench.servos[0].goal = MIDDLE + 40
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    assert bench.broken & {"3"} == broken


@pytest.mark.parametrize(("goal", "broken"), [(MIDDLE + 9, {"3"}), (MIDDLE - 9, set())])
def test_3_a_joint_that_turns_to_its_goal_at_torque_on_jumps_and_one_that_turns_from_it_sags(
    limp: Bench, goal: int, broken: set[str]
) -> None:
    limp.ask("torque_on")
    limp.goal(MIDDLE, torque=True)
    limp.servos[0].goal = goal
    limp.at(MIDDLE + 8.0)
    limp.tick()
    assert limp.broken == broken


@pytest.mark.parametrize(
    ("kinds", "broken"),
    [((), {"3"}), (("same_id",), {"3"}), (("lost",), {"3"}), (("lost", "same_id"), set())],
)
def test_3_a_jump_at_torque_on_is_excused_only_where_another_servo_answers(
    kinds: tuple[str, ...], broken: set[str], limp: Bench
) -> None:
    for kind in kinds:
        limp.plan(kind, 3.0)
    limp.ask("torque_on")
    limp.goal(MIDDLE, torque=True)
    limp.servos[0].goal = MIDDLE + 9
    limp.at(MIDDLE + 8.0)
    limp.tick()
    assert limp.broken & {"3"} == broken


def test_4_torque_comes_on_and_nobody_asked(limp: Bench) -> None:
    limp.goal(MIDDLE, torque=True)
    assert limp.broken == {"4"}


def test_4_a_fault_voids_what_was_asked_before_it(limp: Bench) -> None:
    limp.ask("torque_on")
    limp.tick(Mode.FAULTED, "SERVO_SILENT")
    limp.goal(MIDDLE, torque=True)
    assert limp.broken == {"4"}


@pytest.mark.parametrize(("asked", "broken"), [("release", set()), ("teach", set()), ("park", {"5"}), ("hold", {"5"})])
def test_5_torque_goes_off_on_request_alone(holding: Bench, asked: str, broken: set[str]) -> None:
    holding.ask(asked)
    holding.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert holding.broken == broken


@pytest.mark.parametrize(("unheard", "broken"), [(12, set()), (0, {"5"})])
def test_5_a_torque_on_that_waits_for_its_servos_may_be_undone_later(unheard: int, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.ask("torque_on")
    bench.goal(MIDDLE, torque=True)
    for k in range(25):
        lost = [(3, 2)] if k < unheard else []
        bench.judge.polled(bench.now_s, lost, N - len(lost), N + len(lost))
        bench.tick(Mode.ENERGISING)
    bench.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert bench.broken == broken


@pytest.mark.parametrize(("away", "broken"), [(0, set()), (11, set()), (14, {"5"})])
def test_5_torque_goes_off_at_the_rest_pose_that_was_asked_for(holding: Bench, away: int, broken: set[str]) -> None:
    for index, joint in enumerate(ARM.joints):
        holding.at(joint.tick(joint.rest_rad), index)
        holding.servos[index].goal = holding.servos[index].sensed_tick
    holding.servos[0].sensed_tick += away
    holding.ask("park")
    holding.judge.reported(holding.now_s, Mode.PARKING, "")
    holding.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert holding.broken == broken


def test_5_the_way_to_rest_is_slow(holding: Bench) -> None:
    holding.ask("park")
    for _ in range(6):
        holding.move(9, mode=Mode.PARKING)
    assert holding.broken == set()
    holding.move(10, mode=Mode.PARKING)
    assert holding.broken == {"5"}


@pytest.mark.parametrize(("away", "broken"), [(40, set()), (60, {"2"})])
def test_2_a_joint_that_was_led_far_off_is_not_brought_back(moving: Bench, away: int, broken: set[str]) -> None:
    moving.goal(MIDDLE)
    moving.plan("second_writer", 0.05)
    moving.at(MIDDLE + away)
    moving.servos[0].goal = MIDDLE + away  # another program's
    moving.tick()
    moving.goal(MIDDLE)
    assert moving.broken == broken


@pytest.mark.parametrize(("back", "broken"), [(True, set()), (False, {"2", "7"})])
def test_2_what_servos_hold_once_the_port_is_back_is_what_another_goal_is_taken_back_to(
    moving: Bench, back: bool, broken: set[str]
) -> None:
    moving.goal(MIDDLE)
    moving.plan("unplug", 0.1, None)
    moving.servos[0].goal = MIDDLE + 40  # another program's, while the port is gone
    moving.at(MIDDLE + 50)
    moving.tick(Mode.FAULTED, "PORT_GONE")
    if back:
        moving.judge.port_back()
    moving.ticks(20, Mode.FAULTED, "PORT_GONE")
    moving.plan("second_writer", 0.05)
    moving.servos[0].goal = MIDDLE + 80
    moving.tick(Mode.FAULTED, "PORT_GONE")
    moving.goal(MIDDLE + 40)
    assert moving.broken & {"2", "7"} == broken


@pytest.mark.parametrize(("step", "broken"), [(9, set()), (10, {"2"})])
def test_2_a_jog_is_slow(holding: Bench, step: int, broken: set[str]) -> None:
    holding.ask("jog")
    holding.tick(Mode.JOGGING)
    holding.ask("jog")
    holding.move(step, mode=Mode.JOGGING)
    assert holding.broken == broken
