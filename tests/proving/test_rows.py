"""The judge on what has to be reported, on bursts, on late readings and on programs that died."""

from collections.abc import Callable

import pytest

from armctl.dynamixel import ax12a
from armctl.messages import Mode
from armctl.sim.faults import Fault
from proving.duties import Sent
from tests.proving.judged import MIDDLE, Bench, N, running


@pytest.mark.parametrize(("ticks", "broken"), [(2, set()), (3, {"8"})])
def test_8_a_goal_computed_from_an_old_reading(ticks: int, broken: set[str]) -> None:
    bench = running()
    bench.ticks(ticks, heard=False)
    bench.goal(MIDDLE + 5)
    assert bench.broken == broken


@pytest.mark.parametrize("register", [register for register in ax12a.REGISTERS if register.eeprom])
def test_9_a_write_to_the_eeprom(register: ax12a.Register) -> None:
    bench = Bench()
    bench.write(0, register, register.default)
    assert bench.broken == {"9"}


def test_a_burst_of_goals() -> None:
    bench = Bench()
    for k in range(5):
        bench.now_s += 0.05
        bench.goal(MIDDLE, k)
    assert bench.broken == {"late"}


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
def test_a_program_that_died_leaves_a_still_arm(step: float, broken: set[str]) -> None:
    bench = running()
    bench.servos[0].goal = MIDDLE + 39
    bench.judge.died(bench.now_s, bench.servos)
    for k in range(4):
        bench.at(MIDDLE + step * k)
        bench.tick()
    assert bench.broken - {"6"} == broken


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
def test_a_fault_that_nobody_reports_or_under_another_code(kind: str, code: str, told: str) -> None:
    bench = running()
    one = None if kind == "unplug" else 2
    value = {"hot": 70.0, "brown_out": 7.0}.get(kind)
    bench.plan(kind, 3.0, one, value=value)
    bench.tick(Mode.MOVING)
    said = {"well": (Mode.FAULTED, code), "wrongly": (Mode.FAULTED, "OVERLOAD"), "not at all": (Mode.MOVING, "")}[told]
    bench.ticks(10, *said)
    assert bench.broken == (set() if told == "well" else {"rows"})


@pytest.mark.parametrize(("told", "broken"), [(True, set()), (False, {"6", "rows"})])
@pytest.mark.parametrize("duration_s", [0.01, 0.15, 1.0])
def test_every_unplug_however_short_stops_the_arm_and_is_reported(
    duration_s: float, told: bool, broken: set[str]
) -> None:
    bench = running()
    bench.plan("unplug", duration_s, None, in_s=0.02)
    bench.tick(Mode.MOVING)
    for _ in range(8):
        if told:
            bench.tick(Mode.FAULTED, "PORT_GONE")
        else:
            bench.move(5)
    assert bench.broken == broken


@pytest.mark.parametrize(("after_s", "broken"), [(2.5, set()), (3.5, {"rows"}), (None, {"rows"})])
@pytest.mark.parametrize("duration_s", [0.05, 2.0])
def test_a_port_is_reported_back_within_three_seconds(
    duration_s: float, after_s: float | None, broken: set[str]
) -> None:
    bench = running()
    begin_s = bench.now_s
    bench.judge.plan(Fault(kind="unplug", begin_s=begin_s, duration_s=duration_s))
    bench.tick(Mode.MOVING)
    while bench.now_s < begin_s + duration_s + 4.0:
        bench.tick(Mode.FAULTED, "PORT_GONE")
        if after_s is not None and bench.now_s >= begin_s + duration_s + after_s:
            bench.judge.port_back()
    assert bench.broken == broken


@pytest.mark.parametrize(("limit", "broken"), [(0, {"rows"}), (1023, set())])
def test_a_servo_that_shut_itself_down_is_not_just_without_torque(limit: int, broken: set[str]) -> None:
    bench = running()
    bench.servos[2].torque, bench.servos[2].limit = False, limit
    bench.tick(Mode.FAULTED, "LOST_TORQUE")
    assert bench.broken == broken


def test_a_joint_that_cannot_follow_and_nobody_reports_it() -> None:
    bench = Bench()
    bench.at(MIDDLE - 32.0)
    bench.ticks(12, Mode.HOLDING)
    assert bench.broken == {"rows"}


def test_a_joint_far_from_its_goal_counts_from_when_a_program_watches() -> None:
    bench = Bench()
    bench.at(MIDDLE - 32.0)
    bench.judge.died(bench.now_s, bench.servos)
    bench.ticks(10)
    bench.judge.back()
    bench.ticks(6, Mode.HOLDING)
    bench.tick(Mode.FAULTED, "BLOCKED")
    assert bench.broken == set()


@pytest.mark.parametrize(("mode", "broken"), [(Mode.OFF, set()), (Mode.HOLDING, {"6"})])
def test_6_an_arm_that_lost_torque_and_was_let_go_before_anybody_had_to_latch_may_run_again(
    mode: Mode, broken: set[str]
) -> None:
    bench = Bench()
    bench.plan("trip", 0.1)
    bench.servos[0].torque, bench.servos[0].limit = False, 0
    bench.tick(Mode.HOLDING)
    bench.ask("release")
    bench.tick(mode)
    bench.servos[0].torque, bench.servos[0].limit = True, 1023  # later
    bench.ask("torque_on")
    bench.ticks(20, Mode.HOLDING)
    bench.ask("run")
    bench.tick(Mode.MOVING)
    bench.move(15)
    assert bench.broken == broken


@pytest.mark.parametrize(
    ("asked", "code", "broken"),
    [
        (("clear", "torque_on"), "", set()),
        (("clear", "torque_on"), "TRIPPED", {"4"}),
        (("torque_on", "clear"), "", {"4"}),
    ],
)
def test_4_torque_may_come_on_in_the_tick_of_a_clear_that_was_granted(
    asked: tuple[str, ...], code: str, broken: set[str]
) -> None:
    bench = Bench(torque=False)
    bench.tick(Mode.FAULTED, "TRIPPED")
    bench.ask(*asked)
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    bench.tick(Mode.FAULTED if code else Mode.ENERGISING, code)
    assert bench.broken == broken


@pytest.mark.parametrize(("code", "broken"), [("HOT", set()), ("", {"6"}), ("BLOCKED", {"6"})])
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
def test_another_writers_goal_that_is_read_back_and_not_reported(read_back: bool, told: bool) -> None:
    bench = running()
    bench.goal(MIDDLE)
    bench.plan("second_writer", 3.0)
    for _ in range(8):
        bench.servos[0].goal = MIDDLE + 20
        if read_back:
            bench.hear()
        bench.goal(MIDDLE)  # overwritten at once
        bench.tick(*((Mode.FAULTED, "OTHER_WRITER") if told else (Mode.HOLDING, "")))
    assert bench.broken == (set() if told or not read_back else {"rows"})
