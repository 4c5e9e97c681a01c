"""The judge on what has to be reported, on bursts, on late readings and on programs that died."""

from collections.abc import Callable

import pytest

from armctl.dynamixel import ax12a
from armctl.messages import Mode
from armctl.sim.faults import Fault
from proving.evidence import Sent
from tests.proving.judged import MIDDLE, Bench, N, running


@pytest.mark.parametrize(("ticks", "broken"), [(2, set()), (3, {"8"})])
def test_8_a_goal_computed_from_an_old_reading(moving: Bench, ticks: int, broken: set[str]) -> None:
    moving.ticks(ticks, heard=False)
    moving.goal(MIDDLE + 5)
    assert moving.broken == broken


@pytest.mark.parametrize(("ticks", "mode", "broken"), [
    (10, Mode.OFF, set()), (13, Mode.OFF, {"rows"}), (80, Mode.STARTING, set()), (90, Mode.STARTING, {"rows"}),
])  # fmt: skip
def test_a_servo_that_is_not_heard_is_told_of(ticks: int, mode: Mode, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.ticks(2, mode)
    bench.ticks(ticks, mode, heard=False)
    assert bench.red == broken


@pytest.mark.parametrize(("heard", "broken"), [
    ("    x   x", False), ("    x   x   x  ", True), ("xxxxxxx", False), ("xxxxxxxxx", True),
])  # fmt: skip
def test_a_joint_that_cannot_follow_is_told_of_by_the_replies_that_tell_it(
    holding: Bench, heard: str, broken: bool
) -> None:
    holding.at(MIDDLE + 60)
    for each in heard:
        holding.tick(Mode.HOLDING, heard=each == "x")
    assert ("rows" in holding.broken) == broken


@pytest.mark.parametrize("register", [register for register in ax12a.REGISTERS if register.eeprom])
def test_9_a_write_to_the_eeprom(holding: Bench, register: ax12a.Register) -> None:
    holding.write(0, register, register.default)
    assert holding.broken == {"9"}


def test_a_burst_of_goals(holding: Bench) -> None:
    for _ in range(5):
        holding.now_s += 0.05
        holding.goal(MIDDLE)
    assert holding.broken == {"late"}


@pytest.mark.parametrize(("mended", "broken"), [(False, {"rows"}), (True, set())])
def test_torque_never_comes_on_with_a_servo_whose_eeprom_was_left_wrong(mended: bool, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.judge.tampered(3)
    if mended:
        bench.judge.mended(3)
    bench.ask("torque_on")
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    assert bench.broken == broken


@pytest.mark.parametrize(("step", "broken"), [(0.0, set()), (6.0, {"lead"})])
def test_a_program_that_died_leaves_a_still_arm(moving: Bench, step: float, broken: set[str]) -> None:
    moving.servos[0].goal = MIDDLE + 39
    moving.judge.died(moving.now_s, moving.servos)
    for k in range(4):
        moving.at(MIDDLE + step * k)
        moving.tick()
    assert moving.broken - {"6"} == broken


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        ("mute", "SERVO_SILENT"),
        ("unplug", "PORT_GONE"),
        ("trip", "TRIPPED"),
        ("hot", "HOT"),
        ("brown_out", "LOST_TORQUE"),
    ],
)
@pytest.mark.parametrize("told", ["well", "wrongly", "not at all"])
def test_a_fault_that_nobody_reports_or_under_another_code(moving: Bench, kind: str, code: str, told: str) -> None:
    one = None if kind == "unplug" else 2
    value = {"hot": 70.0, "brown_out": 7.0}.get(kind)
    moving.plan(kind, 3.0, one, value=value)
    moving.tick(Mode.MOVING)
    said = {"well": (Mode.FAULTED, code), "wrongly": (Mode.FAULTED, "OVERLOAD"), "not at all": (Mode.MOVING, "")}[told]
    moving.ticks(26 if kind == "hot" else 10, *said)
    assert moving.broken == (set() if told == "well" else {"rows", "faults"})


@pytest.mark.parametrize(("heated", "broken"), [(True, set()), (False, {"rows"})])
def test_heat_of_a_fault_that_is_over_may_be_told_behind_another_one(
    moving: Bench, heated: bool, broken: set[str]
) -> None:
    moving.plan("hot" if heated else "late", 0.3, 3, value=70.0 if heated else 5.0)
    moving.ticks(20, Mode.MOVING)
    moving.plan("brown_out", 0.04, 2, value=7.12)
    moving.tick(Mode.FAULTED, "HOT")
    assert moving.broken == broken


@pytest.mark.parametrize(("told", "broken"), [(True, set()), (False, {"6", "rows", "faults"})])
@pytest.mark.parametrize("duration_s", [0.01, 0.15, 1.0])
def test_every_unplug_however_short_stops_the_arm_and_is_reported(
    moving: Bench, duration_s: float, told: bool, broken: set[str]
) -> None:
    moving.plan("unplug", duration_s, None, in_s=0.02)
    moving.tick(Mode.MOVING)
    for _ in range(8):
        if told:
            moving.tick(Mode.FAULTED, "PORT_GONE")
        else:
            moving.move(5)
    assert moving.broken == broken


@pytest.mark.parametrize(("after_s", "broken"), [(2.5, set()), (3.5, {"rows"}), (None, {"rows"})])
@pytest.mark.parametrize("duration_s", [0.05, 2.0])
def test_a_port_is_reported_back_within_three_seconds(
    moving: Bench, duration_s: float, after_s: float | None, broken: set[str]
) -> None:
    begin_s = moving.now_s
    moving.judge.plan(Fault(kind="unplug", begin_s=begin_s, duration_s=duration_s))
    moving.tick(Mode.MOVING)
    while moving.now_s < begin_s + duration_s + 4.0:
        moving.tick(Mode.FAULTED, "PORT_GONE")
        if after_s is not None and moving.now_s >= begin_s + duration_s + after_s:
            moving.judge.port_back()
    assert moving.broken == broken


def test_where_requests_come_damaged_the_port_is_reported_back_later(moving: Bench) -> None:
    begin_s = moving.now_s
    moving.judge.garbled(begin_s, begin_s + 9.0)
    moving.judge.plan(Fault(kind="unplug", begin_s=begin_s, duration_s=1.0))
    moving.ticks(120, Mode.FAULTED, "PORT_GONE")
    assert "rows" not in moving.broken
    moving.ticks(20, Mode.FAULTED, "PORT_GONE")
    assert "rows" in moving.broken


@pytest.mark.parametrize(("limit", "broken"), [(0, {"rows"}), (1023, set())])
def test_a_servo_that_shut_itself_down_is_not_just_without_torque(moving: Bench, limit: int, broken: set[str]) -> None:
    moving.servos[2].torque, moving.servos[2].limit = False, limit
    moving.tick(Mode.FAULTED, "LOST_TORQUE")
    assert moving.broken == broken


def test_a_servo_that_shut_itself_down_may_be_told_beside_one_that_seems_to_have_lost_its_torque(moving: Bench) -> None:
    moving.servos[2].torque, moving.servos[2].limit = False, 0
    moving.tick(Mode.FAULTED, "LOST_TORQUE", also="TRIPPED")
    assert moving.broken == set()


def test_a_joint_that_cannot_follow_and_nobody_reports_it(holding: Bench) -> None:
    holding.at(MIDDLE - 32.0)
    holding.ticks(12, Mode.HOLDING)
    assert holding.broken == {"rows"}


def test_a_joint_far_from_its_goal_counts_from_when_a_program_watches(holding: Bench) -> None:
    holding.at(MIDDLE - 32.0)
    holding.judge.died(holding.now_s, holding.servos)
    holding.ticks(10)
    holding.judge.back()
    holding.ticks(6, Mode.HOLDING)
    holding.tick(Mode.FAULTED, "BLOCKED")
    assert holding.broken == set()


@pytest.mark.parametrize(("told", "broken"), [("LOST_TORQUE", set()), ("", {"2"})])
def test_a_weak_joint_that_sank_while_nobody_was_in_charge_is_told_by_whoever_comes(
    holding: Bench, told: str, broken: set[str]
) -> None:
    holding.servos[0].limit = 486
    holding.at(MIDDLE - 60.0)
    holding.judge.died(holding.now_s, holding.servos)
    holding.ticks(10)
    holding.judge.back()
    holding.ticks(2, Mode.FAULTED if told else Mode.HOLDING, told)
    assert holding.broken == broken


@pytest.mark.parametrize(("mode", "broken"), [(Mode.OFF, set()), (Mode.HOLDING, {"6"})])
def test_6_an_arm_that_lost_torque_and_was_let_go_before_anybody_had_to_latch_may_run_again(
    holding: Bench, mode: Mode, broken: set[str]
) -> None:
    holding.plan("trip", 0.1)
    holding.servos[0].torque, holding.servos[0].limit = False, 0
    holding.tick(Mode.HOLDING)
    holding.ask("release")
    holding.tick(mode)
    holding.servos[0].torque, holding.servos[0].limit = True, 1023  # later
    holding.ask("torque_on")
    holding.ticks(20, Mode.HOLDING)
    holding.ask("run")
    holding.tick(Mode.MOVING)
    holding.move(15)
    assert holding.broken == broken


@pytest.mark.parametrize(
    ("asked", "code", "broken"),
    [
        (("clear", "torque_on"), "", set()),
        (("clear", "torque_on"), "LOST_TORQUE", {"4"}),
        (("torque_on", "clear"), "", {"4"}),
    ],
)
def test_4_torque_may_come_on_in_the_tick_of_a_clear_that_was_granted(
    limp: Bench, asked: tuple[str, ...], code: str, broken: set[str]
) -> None:
    limp.tick(Mode.FAULTED, "LOST_TORQUE")
    limp.ask(*asked)
    limp.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    limp.tick(Mode.FAULTED if code else Mode.ENERGISING, code)
    assert limp.broken == broken


@pytest.mark.parametrize(("code", "broken"), [("HOT", set()), ("", {"6", "status"}), ("BLOCKED", {"6"})])
def test_6_after_a_hold_only_a_fault_that_sends_the_arm_to_rest_moves_it(code: str, broken: set[str]) -> None:
    bench = running()
    bench.ask("hold")
    bench.ticks(8, Mode.HOLDING)
    bench.at(MIDDLE - 6.0)  # it droops: its goal is not its position
    bench.goal(MIDDLE + 1)
    bench.tick(Mode.FAULTED if code else Mode.HOLDING, code)
    assert bench.broken == broken


@pytest.mark.parametrize(
    ("unheard", "asked", "broken"),
    [([(3, 2)], 7, set()), ([(3, 1)], 6, {"rows"}), ([(3, 1)], 8, set()), ([], 6, set())],
)
def test_a_lost_reply_is_asked_for_again(unheard: list[tuple[int, int]], asked: int, broken: set[str]) -> None:
    bench = Bench()
    bench.judge.polled(bench.now_s, [], N, N)
    bench.judge.polled(bench.now_s, unheard, N - len(unheard), asked)
    assert bench.broken == broken


@pytest.mark.parametrize("where", [lambda sent: sent.value(ax12a.GOAL), lambda sent: sent.value(ax12a.MOVING_SPEED)])
def test_a_write_of_two_registers_tells_both(where: Callable[[Sent], int | None]) -> None:
    assert where(Sent(0, ax12a.GOAL.address, bytes((7, 0, 7, 0)))) == 7
    assert where(Sent(0, ax12a.TORQUE_ENABLE.address, b"\1")) is None


@pytest.mark.parametrize("read_back", [False, True])
@pytest.mark.parametrize("told", [True, False])
def test_another_writers_goal_that_is_read_back_and_not_reported(moving: Bench, read_back: bool, told: bool) -> None:
    moving.goal(MIDDLE)
    moving.plan("second_writer", 3.0)
    for _ in range(8):
        moving.servos[0].goal = MIDDLE + 20
        if read_back:
            moving.hear()
        moving.goal(MIDDLE)  # overwritten at once
        moving.tick(*((Mode.FAULTED, "OTHER_WRITER") if told else (Mode.HOLDING, "")))
    assert moving.broken == (set() if told or not read_back else {"rows"})


@pytest.mark.parametrize("echo", [True, False])
def test_nobody_tells_of_a_writer_whose_goals_are_heard_behind_an_echo(echo: bool) -> None:
    bench = running()
    bench.move(5)
    bench.plan("second_writer", 3.0)
    if echo:
        bench.plan("echo", 2.0, None)
    bench.tick(Mode.MOVING)
    bench.servos[0].goal = MIDDLE + 60
    bench.ticks(8, Mode.MOVING)
    assert any("second_writer" in violation.text for violation in bench.judge.violations) is not echo


@pytest.mark.parametrize(("told_before", "broken"), [(True, set()), (False, {"rows"})])
def test_a_fault_that_comes_back_at_once_after_a_clear_is_not_another_one_s_name(
    holding: Bench, told_before: bool, broken: set[str]
) -> None:
    if told_before:
        holding.tick(Mode.FAULTED, "BUS_NOISE")
        holding.ask("clear")
        holding.tick(Mode.HOLDING)
    holding.plan("hot", 0.5, 1, value=69.0)
    holding.tick(Mode.HOLDING)
    holding.tick(Mode.FAULTED, "BUS_NOISE")
    assert holding.broken & {"rows"} == broken


def test_another_program_s_goal_is_taken_back_to_the_one_that_was_adopted(holding: Bench) -> None:
    holding.judge.died(holding.now_s, holding.servos)
    holding.tick()
    holding.judge.back()
    holding.tick(Mode.HOLDING)
    holding.plan("second_writer", 0.5)
    holding.tick(Mode.HOLDING)
    holding.servos[0].goal = MIDDLE - 50
    holding.tick(Mode.FAULTED, "OTHER_WRITER")
    holding.goal(MIDDLE)
    assert holding.broken == set()
    holding.goal(MIDDLE + 40)
    assert holding.broken


@pytest.mark.parametrize(("heard", "broken"), [(True, {"rows"}), (False, set())])
def test_a_joint_far_from_its_goal_is_reported_by_whoever_hears_it(heard: bool, broken: set[str]) -> None:
    bench = Bench()
    bench.servos[2].sensed_tick -= 40
    bench.ticks(4, Mode.HOLDING)
    bench.ticks(5, Mode.HOLDING, heard=heard)
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(("cut", "broken"), [(True, set()), (False, {"8"})])
def test_8_a_reply_behind_an_echo_that_was_cut_is_a_good_one(moving: Bench, cut: bool, broken: set[str]) -> None:
    moving.plan("echo", 2.0, None)
    if cut:
        moving.judge.garbled(moving.now_s, moving.now_s + 2.0)
    moving.ticks(3, Mode.MOVING)
    moving.move(5)
    assert moving.broken & {"8"} == broken


@pytest.mark.parametrize(("ticks", "again", "broken"), [(4, False, set()), (4, True, {"7"}), (40, False, {"7"})])
def test_7_a_clear_may_wait_for_the_servos_and_a_run_come_with_it(ticks: int, again: bool, broken: set[str]) -> None:
    bench = Bench()
    bench.ticks(8, Mode.FAULTED, "SERVO_SILENT")
    bench.ask("clear")
    bench.ticks(ticks, Mode.FAULTED, "SERVO_SILENT")
    bench.ask("run")
    bench.goal(MIDDLE + 5)
    bench.tick(*((Mode.FAULTED, "SERVO_SILENT") if again else (Mode.MOVING, "")))
    assert bench.broken & {"7"} == broken


@pytest.mark.parametrize(("late_s", "broken"), [(1.7, set()), (0.0, {"rows"})])
def test_a_port_that_was_out_while_the_program_was_late_is_gone(late_s: float, broken: set[str]) -> None:
    bench = Bench()
    bench.plan("unplug", 0.06, None)
    bench.ticks(0 if late_s else 16)
    bench.now_s += late_s
    bench.tick(Mode.FAULTED, "PORT_GONE")
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(("kind", "broken"), [("same_id", set()), ("duplicated", {"rows"})])
def test_a_servo_in_whose_name_another_one_answers_is_not_silent(kind: str, broken: set[str]) -> None:
    bench = Bench()
    bench.plan("lost", 2.0, 3, in_s=0.1)
    bench.plan(kind, 3.0, 3)
    bench.ticks(12, Mode.HOLDING)
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(
    ("kinds", "after_s", "broken"),
    [
        (("lost", "same_id"), 0.0, set()),
        (("lost", "same_id"), 0.3, {"2"}),  # one is over before the other begins
        (("same_id",), 0.0, {"2"}),
        (("lost",), 0.0, {"2"}),
    ],
)
def test_2_where_a_servo_is_in_whose_name_another_one_answers_nobody_can_tell(
    kinds: tuple[str, ...], after_s: float, broken: set[str]
) -> None:
    bench = Bench()
    for k, kind in enumerate(kinds):
        bench.plan(kind, 0.25 if after_s else 3.0, in_s=k * after_s)
    bench.tick(Mode.HOLDING)
    bench.at(MIDDLE + 60)
    bench.ticks(2, Mode.HOLDING)
    assert bench.broken & {"2"} == broken


@pytest.mark.parametrize(
    ("kind", "elsewhere", "broken"), [("same_id", True, set()), ("same_id", False, {"2"}), ("lost", True, {"2"})]
)
def test_2_a_reply_from_another_place_misleads_only_where_two_servos_have_one_id(
    kind: str, elsewhere: bool, broken: set[str]
) -> None:
    bench = Bench()
    bench.plan(kind, 3.0)
    bench.tick(Mode.HOLDING)
    if elsewhere:
        bench.judge.told_elsewhere(bench.now_s, 0)
    bench.at(MIDDLE + 60)
    bench.ticks(2, Mode.HOLDING)
    assert bench.broken & {"2"} == broken


@pytest.mark.parametrize(
    ("code", "broken"),
    [
        ("NOT_LIMP", set()),  # it is limp as before
        ("DUPLICATE_ID", set()),
        ("CONTACT", {"faults"}),
    ],
)
def test_a_servo_that_restarts_behind_a_fault(code: str, broken: set[str]) -> None:
    bench = Bench()
    bench.tick(Mode.FAULTED, code)
    bench.plan("brown_out", 0.25, 3, value=7.0)
    bench.ticks(14, Mode.FAULTED, code)
    assert bench.broken & {"faults"} == broken


@pytest.mark.parametrize(("late_s", "broken"), [(0.7, set()), (0.0, {"rows"})])
def test_a_sag_that_ends_while_the_program_is_late_is_a_short_one(late_s: float, broken: set[str]) -> None:
    bench = Bench()
    sag = Fault(kind="brown_out", servo_id=3, begin_s=bench.now_s, duration_s=0.93, value=8.0, probability=0.0)
    bench.judge.plan(sag)
    bench.ticks(3, Mode.HOLDING)
    bench.now_s += late_s
    bench.ticks(12, Mode.HOLDING)
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(("goal", "broken"), [(MIDDLE + 60, set()), (MIDDLE + 50, {"2"})])
def test_2_a_goal_that_a_servo_holds_already_moves_nothing(goal: int, broken: set[str]) -> None:
    bench = running()
    bench.move(5)
    bench.servos[0].goal = MIDDLE + 60
    bench.goal(goal)
    assert bench.broken & {"2"} == broken
