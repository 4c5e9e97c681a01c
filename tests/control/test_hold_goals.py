"""Goals are sent until they are read back; another program's are overruled, unless it goes on."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control import faults
from armctl.control.tick import LED_OFF_TICKS
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, Packet
from armctl.messages import Clear, Hold, Mode, Release, Run
from tests.control.damaged_arm import Rig, is_goal
from tests.control.ideal_arm import IdealArm, holding, line, running


def write_goal(rig: Rig, joint: int, tick: int) -> None:
    """Another program's SYNC_WRITE of one goal."""
    data = bytes((ax12a.GOAL.address, 2, joint + 1)) + tick.to_bytes(2, "little")
    rig.simulated.servos[joint].handle(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, data))


@settings(max_examples=20, deadline=None)
@given(st.frozensets(st.integers(1, 25), max_size=12), st.integers(0, 2**16))
def test_goals_that_are_lost_are_no_other_program_and_the_run_ends_where_it_should(
    lost: frozenset[int], seed: int
) -> None:
    runs_of_losses = "".join("x" if tick in lost else " " for tick in range(30)).split()
    rig = Rig(seed % 97).holding()
    rig.records.clear()
    rig.port.damages = lambda packet: is_goal(packet) and len(rig.records) in lost
    begin = rig.goals_rad[0]
    rig.ticks(70, Run(5, rig.turned(20.0)))
    assert "OTHER_WRITER" not in rig.codes()
    if max(map(len, runs_of_losses), default=0) <= 4:
        assert rig.replies()[5].ok
        assert rig.goals_rad[0] - begin == pytest.approx(math.radians(20.0), abs=0.01)
    goals = [servo.get(ax12a.GOAL) for servo in rig.simulated.servos]
    assert goals == list(rig.loop.state.goal)


def test_two_goals_lost_in_a_row_are_ours() -> None:
    arm = running(5)
    arm.deaf = {0}
    arm.run_ticks(2)
    arm.deaf = set()
    arm.run_ticks(25)
    assert (arm.code(), arm.replies[5].ok) == ("", True)


def test_an_earlier_goal_that_comes_back_after_the_last_one_was_seen_is_another_program_s() -> None:
    arm = running(5)
    arm.run_ticks(30)
    assert arm.mode() is Mode.HOLDING
    earlier = arm.goals[-4][0]
    assert earlier != arm.get(0, ax12a.GOAL)
    arm.put(0, ax12a.GOAL, earlier)
    arm.run_tick()
    assert arm.fault() == ("OTHER_WRITER", 1)


def test_an_earlier_goal_that_a_servo_goes_on_to_show_for_a_second_is_another_program_s() -> None:
    """One that moves so slowly that most of its goals are the same."""
    arm = holding()
    arm.run_tick(Run(5, line(arm, delta_rad=0.03, seconds=6.0)))
    arm.run_ticks(15)
    first = arm.get(0, ax12a.GOAL)

    def write_it_again(arm: IdealArm) -> None:
        arm.put(0, ax12a.GOAL, first)

    arm.after_write = write_it_again
    ticks = 0
    while arm.code() != "OTHER_WRITER":
        arm.run_tick()
        ticks += arm.state.goal[0] != first
        assert ticks <= 12


def test_a_joint_that_is_led_back_to_an_earlier_goal_again_and_again_is_led_by_another_program_and_not_kept() -> None:
    """It is where its goal of now wants it, however far from ours."""
    arm = holding()
    arm.run_tick(Run(5, line(arm, delta_rad=0.6, seconds=2.0)))
    arm.run_ticks(3)
    first = arm.get(0, ax12a.GOAL)

    def lead_back(arm: IdealArm) -> None:
        arm.put(0, ax12a.GOAL, first)
        arm.put(0, ax12a.PRESENT_POSITION, first)

    arm.after_write = lead_back
    while not arm.code():
        arm.run_tick()
    assert arm.fault() == ("OTHER_WRITER", 1)
    assert "BLOCKED" not in arm.events


def test_a_servo_that_was_silent_shows_a_goal_of_ours_however_long_ago() -> None:
    arm = running(5)
    arm.silent = {1}
    arm.run_ticks(40)
    arm.silent = set()
    arm.run_ticks(3)
    assert "SERVO_SILENT" in arm.events
    assert "OTHER_WRITER" not in arm.events


def test_the_last_goal_of_a_stop_is_sent_again_while_another_servo_is_unheard() -> None:
    arm = running(5)
    arm.deaf = {0}
    arm.run_ticks(3, Hold(6))
    arm.deaf, arm.silent = set(), {2}
    arm.run_ticks(2)
    assert arm.get(0, ax12a.GOAL) == arm.state.goal[0]


@pytest.mark.parametrize("seed", range(6))
def test_one_foreign_goal_is_taken_back_and_the_arm_is_where_it_was(seed: int) -> None:
    rig = Rig(seed).holding()
    if seed % 2:  # the servos' own speed is still that of a motion
        rig.ticks(12, Run(5, rig.turned(30.0, seconds=1.0)))
    before, ours = rig.joint_deg(0), rig.loop.state.goal
    write_goal(rig, 0, ours[0] + (-1) ** seed * 200)
    travelled = []
    for _ in range(25):
        rig.ticks(1)
        travelled.append(abs(rig.joint_deg(0) - before))
    assert rig.code() == "OTHER_WRITER"
    assert max(travelled) < 13.0, "led off by what it does in a tick"
    assert travelled[-1] < 1.5
    assert rig.simulated.servos[0].get(ax12a.GOAL) == ours[0]
    rig.ticks(1, Clear(6))
    assert (rig.replies()[6].ok, rig.loop.state.goal) == (True, ours)


def test_clear_does_not_adopt_a_foreign_goal_that_is_not_overruled_yet() -> None:
    rig = Rig().holding()
    ours = rig.loop.state.goal
    rig.port.damages = is_goal
    write_goal(rig, 0, ours[0] + 20)
    rig.ticks(3)
    rig.ticks(1, Clear(6))
    assert (rig.replies()[6].code, rig.loop.state.goal) == ("NOT_CLEARED", ours)
    rig.port.damages = lambda _packet: False
    rig.ticks(3)
    rig.ticks(1, Clear(7))
    assert (rig.replies()[7].ok, rig.loop.state.goal) == (True, ours)


def test_an_arm_that_was_led_off_is_held_where_it_is_and_not_brought_back() -> None:
    arm = holding()
    away = arm.get(0, ax12a.PRESENT_POSITION) + round(LED_OFF_TICKS) + 2
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, away)
    goals = arm.goals_in(10)
    assert [goal[0] for goal in goals] == [away][: len(goals)]
    assert (arm.code(), arm.state.goal[0], arm.get(0, ax12a.PRESENT_POSITION)) == ("OTHER_WRITER", away, away)


def test_what_seems_led_off_on_a_noisy_line_is_told_nothing() -> None:
    arm = holding()
    for tick in range(60):
        arm.noisy = {3, 4, 5} if tick % 2 else set()
        arm.run_tick()
    arm.noisy = set()
    assert arm.code() == "BUS_NOISE"
    ours = arm.state.goal
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, ours[0] + 230)
    outputs = arm.run_ticks(3)
    assert (outputs.goal, outputs.writes, arm.state.goal) == (None, (), ours)
    assert "OTHER_WRITER" in arm.events
    arm.run_ticks(4)  # nothing has come damaged for half a second
    assert arm.state.goal[0] == ours[0] + 230


def test_what_seems_led_off_while_other_replies_come_damaged_is_told_nothing() -> None:
    arm = holding()
    ours, arm.noisy = arm.state.goal, {2, 3}
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, ours[0] + 96)
    outputs = arm.run_ticks(3)
    assert (outputs.goal, outputs.writes, arm.state.goal) == (None, (), ours)
    assert arm.code() == "OTHER_WRITER"
    arm.noisy = set()
    arm.run_ticks(2)
    assert arm.state.goal[0] == ours[0] + 96


def test_what_seems_led_off_while_another_servo_is_not_heard_is_told_nothing() -> None:
    arm = holding()
    ours, arm.silent = arm.state.goal, {2}
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, ours[0] + 96)
    outputs = arm.run_ticks(4)
    assert (outputs.goal, outputs.writes, arm.state.goal) == (None, (), ours)
    assert "OTHER_WRITER" in arm.events
    arm.silent = set()
    arm.run_ticks(2)
    assert arm.state.goal[0] == ours[0] + 96


def test_who_is_led_off_keeps_no_other_joint_from_being_held() -> None:
    arm = holding()
    ours = arm.state.goal
    for joint, away in ((0, 30), (1, round(LED_OFF_TICKS) + 5)):
        for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
            arm.put(joint, register, ours[joint] + away)
    outputs = arm.run_tick()
    told = {write.servo_id: write.value for write in outputs.writes if write.address == ax12a.GOAL.address}
    assert (outputs.goal, told) == (None, {arm.arm.servo_ids[0]: ours[0]})
    arm.run_tick()
    assert arm.state.goal[1] == arm.get(1, ax12a.PRESENT_POSITION)


def test_one_reading_that_is_another_servo_s_moves_no_arm() -> None:
    arm = holding()
    ours, shown = arm.state.goal, arm.get(0, ax12a.PRESENT_POSITION)
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, 900)
    goals = arm.goals_in(1)
    for register, value in ((ax12a.GOAL, ours[0]), (ax12a.PRESENT_POSITION, shown)):
        arm.put(0, register, value)
    assert all(goal[0] == ours[0] for goal in (*goals, *arm.goals_in(10)))
    assert arm.state.goal == ours


def test_only_a_program_that_goes_on_writing_is_given_way_to_and_the_card_says_so() -> None:
    rig = Rig().holding()
    rig.fault("second_writer", 1, value=25, duration_s=3.0)
    rig.ticks(3)
    assert rig.code() == "OTHER_WRITER"
    rig.ticks(12)
    assert rig.code() == "OVERRULED"
    rig.records.clear()
    rig.ticks(10)
    assert not any(record.outputs.goal or record.outputs.writes for record in rig.records)
    fault, joints = rig.loop.state.fault, rig.records[-1].outputs.joints
    assert fault is not None
    assert "led by the other program" in faults.card(fault, joints, False)[0]
    rig.ticks(15)
    there = rig.joint_deg(0)
    rig.ticks(5, Clear(6))
    assert (rig.replies()[6].ok, rig.mode()) == (True, Mode.HOLDING)
    assert rig.joint_deg(0) == pytest.approx(there, abs=0.5)


def test_a_port_that_was_away_leaves_the_arm_where_it_is_found() -> None:
    arm = holding()
    arm.port_open = False
    arm.run_ticks(5)
    for register in (ax12a.GOAL, ax12a.PRESENT_POSITION):
        arm.put(0, register, 600)
    arm.port_open = True
    arm.goals.clear()
    arm.run_ticks(5)
    assert arm.goals == []


def test_torque_that_appears_on_a_limp_arm_is_not_led_to_where_the_arm_once_was() -> None:
    rig = Rig().holding()
    rig.ticks(30, Run(5, rig.turned(20.0, seconds=2.0)))
    rig.ticks(4, Release(6))
    write_goal(rig, 0, round(rig.simulated.servos[0].position_tick) + 5)
    rig.records.clear()
    rig.ticks(5)
    assert rig.code() == "NOT_LIMP"
    assert not any(record.outputs.goal or record.outputs.writes for record in rig.records)


@pytest.mark.parametrize("sinks", [-40, 0, 25])
def test_a_servo_that_went_limp_by_itself_and_is_woken_stays_where_it_is(sinks: int) -> None:
    arm = holding()
    before = arm.get(0, ax12a.GOAL)
    arm.put(0, ax12a.TORQUE_ENABLE, 0)
    arm.put(0, ax12a.PRESENT_POSITION, before + sinks)
    arm.run_ticks(5)
    arm.put(0, ax12a.TORQUE_ENABLE, 1)
    arm.put(0, ax12a.GOAL, before + sinks - 29)
    arm.run_ticks(2)
    assert "OTHER_WRITER" in arm.events
    assert arm.get(0, ax12a.GOAL) == before + sinks


def test_a_servo_that_seemed_limp_elsewhere_keeps_its_goal_when_it_shows_it_again() -> None:
    # A second servo with its id may have answered in its place.
    arm = holding()
    before = arm.get(0, ax12a.GOAL)
    arm.put(0, ax12a.TORQUE_ENABLE, 0)
    arm.put(0, ax12a.PRESENT_POSITION, before - 29)
    arm.run_ticks(5)
    arm.put(0, ax12a.TORQUE_ENABLE, 1)
    arm.put(0, ax12a.PRESENT_POSITION, before)
    arm.run_ticks(3)
    assert arm.get(0, ax12a.GOAL) == before


def test_a_servo_that_went_limp_beyond_its_limit_and_is_woken_is_led_to_the_limit_and_no_farther() -> None:
    arm = holding()
    high = arm.arm.joints[0].limits_tick[1]
    arm.put(0, ax12a.TORQUE_ENABLE, 0)
    arm.put(0, ax12a.PRESENT_POSITION, high + 1)
    arm.run_ticks(5)
    arm.put(0, ax12a.TORQUE_ENABLE, 1)
    arm.put(0, ax12a.GOAL, high - 55)
    arm.run_ticks(2)
    assert arm.get(0, ax12a.GOAL) == high


def test_a_goal_that_is_withheld_on_a_noisy_line_makes_the_earlier_one_nobody_elses() -> None:
    arm = holding()
    goal = arm.get(0, ax12a.GOAL)
    arm.deaf = {0}
    arm.put(0, ax12a.PRESENT_POSITION, goal - 150)
    arm.put(0, ax12a.PRESENT_LOAD, 780)
    arm.run_ticks(5)
    assert arm.code() == "BLOCKED"
    assert arm.state.goal[0] == goal - 150, "where it stood, as far as anybody saw"
    arm.put(0, ax12a.PRESENT_POSITION, goal)
    arm.put(0, ax12a.PRESENT_LOAD, 0)
    arm.noisy = {1, 2, 3, 4, 5}
    arm.run_ticks(14)
    arm.noisy, arm.deaf = set(), set()
    arm.run_ticks(30)
    assert arm.get(0, ax12a.GOAL) == goal
    assert not {fault.code for fault in arm.state.faults} & {"OTHER_WRITER", "OVERRULED"}
