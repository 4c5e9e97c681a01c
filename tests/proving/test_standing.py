"""The judge on arms that stand: what is told of them, what they push, and what may send them to rest."""

import pytest

from armctl.dynamixel import ax12a
from armctl.messages import Mode
from proving.rules import RED
from tests.proving.judged import ARM, JUDGED, MIDDLE, PERIOD_S, Bench, running


def test_every_rule_that_is_not_kept_yet_is_one_of_the_judges() -> None:
    assert {"faults", "rest", "stall", "yields", "limp", "cause", "soft", "held", "diagnosis"} >= RED


@pytest.mark.parametrize(("mode", "torque", "broken"), [
    (Mode.OFF, True, {"status"}), (Mode.TEACHING, True, {"status"}), (Mode.HOLDING, True, set()),
    (Mode.HOLDING, False, {"status"}), (Mode.MOVING, False, {"status"}), (Mode.OFF, False, set()),
])  # fmt: skip
def test_what_is_told_of_torque_is_so(mode: Mode, torque: bool, broken: set[str]) -> None:
    bench = Bench()
    for servo in bench.servos:
        servo.torque = torque
    bench.ticks(8, mode)
    assert bench.red == broken


def test_torque_is_not_told_of_before_every_servo_is_heard(holding: Bench) -> None:
    holding.servos[2].torque = False
    holding.ticks(20, Mode.HOLDING, heard=False)
    assert "status" not in holding.red


def test_an_arm_that_is_told_to_hold_gets_no_goal_that_advances(holding: Bench) -> None:
    holding.tick(Mode.HOLDING)
    holding.move(5, mode=Mode.HOLDING)
    assert holding.red == {"status"}


@pytest.mark.parametrize(("output", "gravity", "seconds", "broken"), [
    (0.5, 0.0, 3.0, set()), (0.5, 0.0, 4.0, {"stall"}), (-0.5, 0.0, 4.0, {"stall"}),
    (0.7, 0.6, 9.0, set()), (0.4, 0.0, 9.0, set()), (0.5, -0.3, 4.0, {"stall"}), (0.2, 0.64, 9.0, set()),
])  # fmt: skip
def test_no_motor_pushes_for_good_beyond_gravity(
    holding: Bench, output: float, gravity: float, seconds: float, broken: set[str]
) -> None:
    holding.feel(output, gravity=gravity)
    holding.ticks(round(seconds / PERIOD_S), Mode.HOLDING)
    assert holding.red == broken


@pytest.mark.parametrize(("output", "broken"), [(0.8, set()), (1.0, {"stall"}), (-0.5, {"stall"})])
def test_what_an_arm_may_carry_is_no_push(holding: Bench, output: float, broken: set[str]) -> None:
    holding.feel(output, gravity=0.3, carrying=0.5)
    holding.ticks(40, Mode.FAULTED, "BUS_NOISE")
    assert holding.red & {"stall"} == broken


@pytest.mark.parametrize(("output", "broken"), [(0.1, {"rows"}), (0.4, set())])
def test_contact_needs_a_joint_that_pushes(holding: Bench, output: float, broken: set[str]) -> None:
    holding.feel(output)
    holding.ticks(25, Mode.HOLDING)
    holding.tick(Mode.FAULTED, "CONTACT")
    assert holding.red == broken


def test_an_arm_that_sees_nothing_may_seem_to_push(holding: Bench) -> None:
    holding.plan("frozen_sensor", 1.0, servo_id=None)
    holding.feel(0.1)
    holding.ticks(3, Mode.HOLDING)
    holding.tick(Mode.FAULTED, "CONTACT")
    assert holding.red == set()


@pytest.mark.parametrize("why", ["hold", "latch"])
def test_what_is_stopped_pushes_for_two_seconds_at_most(holding: Bench, why: str) -> None:
    holding.feel(0.5)
    if why == "hold":
        holding.ask("hold")
    holding.ticks(24, *((Mode.HOLDING, "") if why == "hold" else (Mode.FAULTED, "BLOCKED")))
    assert holding.red == {"stall"}


@pytest.mark.parametrize(("code", "broken"), [("", {"stall"}), ("OVERLOAD", set())])
def test_what_a_hand_leads_may_push_once_that_is_told(holding: Bench, code: str, broken: set[str]) -> None:
    holding.feel(0.9)
    for _ in range(40):
        holding.judge.led(holding.now_s)
        holding.tick(Mode.FAULTED if code else Mode.HOLDING, code)
    assert holding.red & {"stall"} == broken


@pytest.mark.parametrize(("volts", "broken"), [(8.95, set()), (9.04, set()), (9.08, {"rest"})])
def test_a_supply_that_wavers_about_its_bound_may_be_told_as_the_servos_round_it(
    holding: Bench, volts: float, broken: set[str]
) -> None:
    holding.feel(volts=volts)
    holding.ticks(6, Mode.HOLDING)
    holding.feel(volts=8.94)
    holding.tick(Mode.FAULTED, "VOLTAGE")
    assert holding.red == broken


@pytest.mark.parametrize(("unheard", "heard", "broken"), [(0, 1, False), (3, 1, False), (3, 2, True), (0, 2, True)])
def test_a_load_that_is_cleared_is_told_again_once_its_servo_is_heard(
    holding: Bench, unheard: int, heard: int, broken: bool
) -> None:
    holding.feel(0.9, gravity=0.9)
    holding.ticks(24, Mode.HOLDING)
    holding.ticks(8, Mode.FAULTED, "OVERLOAD")
    holding.ask("clear")
    holding.tick(Mode.HOLDING)
    holding.ticks(unheard, Mode.HOLDING, heard=False)
    holding.ticks(heard, Mode.HOLDING)
    assert ("rows" in holding.red) == broken


@pytest.mark.parametrize(("limit", "broken"), [(1023, {"7"}), (128, set())])
def test_what_was_left_with_a_part_of_its_strength_cannot_stand(holding: Bench, limit: int, broken: set[str]) -> None:
    holding.servos[0].limit = limit
    holding.ticks(12, Mode.FAULTED, "SERVO_SILENT")
    for at in (495.0, 485.0, 480.0, 485.0):
        holding.at(at)
        holding.tick(Mode.FAULTED, "SERVO_SILENT")
    assert holding.broken == broken


@pytest.mark.parametrize(("limit", "program", "broken"), [
    (307, "on a bad line", set()), (307, "on a good line", {"2"}), (1023, "on a bad line", {"2"}),
    (307, "dead", set()), (1023, "dead", {"limp"}),
])  # fmt: skip
def test_what_was_left_with_a_part_of_its_strength_may_sag_until_the_next_program_can_take_it_over(
    holding: Bench, limit: int, program: str, broken: set[str]
) -> None:
    if program == "on a bad line":
        holding.plan("corrupted", 5.0, servo_id=None)
    elif program == "dead":
        holding.judge.died(holding.now_s, holding.servos)
    holding.servos[0].limit = limit
    for below in (0.0, 20.0, 35.0, 50.0):
        holding.at(MIDDLE - below)
        holding.tick(None if program == "dead" else Mode.STARTING, heard=program != "dead")
    assert holding.red & {"2", "limp"} == broken


@pytest.mark.parametrize(("lasts", "volts", "celsius", "code", "broken"), [
    (0.2, 8.0, 30.0, "VOLTAGE", {"rest"}), (0.8, 8.0, 30.0, "VOLTAGE", set()),
    (1.0, 12.0, 67.0, "HOT", {"rest"}), (2.2, 12.0, 67.0, "HOT", set()), (0.2, 12.0, 71.0, "HOT", set()),
    (0.5, 12.0, 30.0, "HOT", {"rest", "rows"}),
])  # fmt: skip
def test_what_sends_the_arm_to_rest_has_lasted(
    holding: Bench, lasts: float, volts: float, celsius: float, code: str, broken: set[str]
) -> None:
    holding.feel(volts=volts, celsius=celsius)
    holding.ticks(round(lasts / PERIOD_S), Mode.HOLDING)
    holding.tick(Mode.FAULTED, code)
    assert holding.red == broken


@pytest.mark.parametrize(("told", "broken"), [(20, {"rest"}), (29, set())])
def test_the_way_to_rest_is_announced_three_seconds_ahead(holding: Bench, told: int, broken: set[str]) -> None:
    holding.servos[0].goal = 400  # the base rests at 512
    holding.at(400.0)
    holding.tick(Mode.FAULTED, "OVERLOAD")
    holding.ticks(told, Mode.FAULTED, "OVERLOAD")
    for _ in range(3):
        holding.move(5, mode=Mode.FAULTED, code="OVERLOAD")
    assert holding.red == broken


@pytest.mark.parametrize(("also", "broken"), [("", {"faults"}), ("TRIPPED", set()), ("HOT", {"faults"})])
def test_a_fault_is_told_by_its_name_though_another_one_is_latched(holding: Bench, also: str, broken: set[str]) -> None:
    holding.tick(Mode.FAULTED, "BLOCKED")
    holding.plan("trip", 0.1, 2)
    holding.tick(Mode.FAULTED, "BLOCKED")
    for _ in range(10):
        holding.tick(Mode.FAULTED, "BLOCKED", also=also)
    assert holding.red == broken


@pytest.mark.parametrize("code", ["OTHER_WRITER", "TRIPPED", "LOST_TORQUE", "PORT_GONE"])
def test_a_fault_that_is_told_has_its_cause(code: str) -> None:
    bench = running()
    for servo in bench.servos:
        servo.limit = 1023
    bench.ticks(2, Mode.MOVING)
    bench.tick(Mode.FAULTED, code)
    assert bench.red == {"rows"}


@pytest.mark.parametrize(("ahead_s", "broken"), [(0.0, set()), (0.0006, set()), (0.002, {"rows"})])
def test_the_world_may_be_a_step_ahead_of_the_clock(moving: Bench, ahead_s: float, broken: set[str]) -> None:
    moving.plan("unplug", 0.1, None, in_s=PERIOD_S + ahead_s)
    moving.tick(Mode.FAULTED, "PORT_GONE")
    assert moving.red == broken


@pytest.mark.parametrize(
    ("again", "also", "latency_s", "broken"),
    [
        (True, "", 0.0, set()),
        (False, "", 0.0, {"yields"}),
        (False, "NOT_LIMP", 0.0, set()),
        (False, "", 1.5, set()),
        (False, "", 0.3, {"yields"}),
    ],
)
def test_a_foreign_goal_does_not_stay_but_on_a_limp_arm_or_unheard(
    moving: Bench, again: bool, also: str, latency_s: float, broken: set[str]
) -> None:
    moving.goal(MIDDLE + 5)
    moving.goal(MIDDLE + 5)
    if latency_s:
        moving.plan("latency", latency_s, None, value=16.0)
    moving.plan("second_writer", 0.2)
    moving.tick(Mode.MOVING)
    moving.servos[0].goal = MIDDLE + 30
    for _ in range(5):
        moving.tick(Mode.FAULTED, "OTHER_WRITER", also=also)
    if again:
        moving.goal(MIDDLE + 5)
    for _ in range(7):
        moving.tick(Mode.FAULTED, "OTHER_WRITER", also=also)
    assert moving.red == broken


def test_a_joint_that_was_led_off_far_holds_where_it_is(moving: Bench) -> None:
    moving.goal(MIDDLE + 5)
    moving.goal(MIDDLE + 5)
    moving.plan("second_writer", 0.2)
    moving.tick(Mode.MOVING)
    moving.servos[0].goal = MIDDLE + 60
    moving.servos[0].sensed_tick = MIDDLE + 60
    moving.ticks(12, Mode.FAULTED, "OTHER_WRITER")
    assert "yields" not in moving.red


@pytest.mark.parametrize(("held", "broken"), [(MIDDLE + 6, set()), (MIDDLE + 100, {"2"})])
def test_2_a_goal_that_was_lost_brings_nothing_back_that_goes_there_anyway(
    moving: Bench, held: int, broken: set[str]
) -> None:
    moving.goal(MIDDLE + 5)
    moving.goal(MIDDLE + 5)
    moving.servos[0].goal = held
    moving.at(MIDDLE + 100.0)
    moving.hear()
    moving.goal(MIDDLE + 5)
    assert moving.broken == broken


@pytest.mark.parametrize(("ok", "torque", "broken"), [
    (True, True, {"limp"}), (True, False, set()), (False, True, set())])  # fmt: skip
def test_release_says_what_is(ok: bool, torque: bool, broken: set[str]) -> None:
    bench = Bench(torque=torque)
    bench.judge.replied(bench.now_s, "release", ok, bench.servos)
    assert bench.red == broken


def test_torque_does_not_come_on_while_a_servo_is_hot(limp: Bench) -> None:
    limp.feel(celsius=68.0)
    limp.ticks(25, Mode.OFF)
    limp.ask("torque_on")
    limp.goal(MIDDLE, torque=True, limit=128)
    assert limp.red == {"cause"}
    assert ARM.temperature_limit_degC == 65.0


@pytest.mark.parametrize(("asked", "ticks", "broken"), [
    ("hold", 11, set()), ("hold", 16, {"stall"}), ("pause", 24, set())])  # fmt: skip
def test_a_push_counts_from_the_stop_on(holding: Bench, asked: str, ticks: int, broken: set[str]) -> None:
    holding.feel(0.5)
    holding.ticks(10, Mode.HOLDING)
    holding.ask(asked)
    holding.ticks(ticks, Mode.HOLDING)
    assert holding.red == broken


@pytest.mark.parametrize(("ticks", "broken"), [(8, set()), (24, {"stall"})])
def test_what_is_stopped_may_push_while_the_program_is_late_and_no_longer(
    holding: Bench, ticks: int, broken: set[str]
) -> None:
    holding.feel(0.5)
    holding.ask("hold")
    holding.ticks(4, Mode.HOLDING)
    holding.now_s += 1.4
    holding.ticks(ticks, Mode.HOLDING)
    assert holding.red == broken


def test_what_is_stopped_may_push_longer_where_a_servo_was_not_heard(holding: Bench) -> None:
    holding.feel(0.5)
    holding.ask("hold")
    holding.tick(Mode.HOLDING, heard=False)
    holding.ticks(17, Mode.HOLDING)
    assert holding.red == set()


@pytest.mark.parametrize(("also", "broken"), [("OVERLOAD", set()), ("", {"faults"})])
def test_a_motor_that_works_too_hard_is_told_of_beside_whatever_else(
    holding: Bench, also: str, broken: set[str]
) -> None:
    holding.feel(0.9, gravity=0.9)
    for _ in range(30):
        holding.tick(Mode.FAULTED, "BUS_NOISE", also=also)
    assert holding.red & {"faults", "rows"} == broken


@pytest.mark.parametrize(("also", "broken"), [("OVERLOAD", set()), ("", {"faults"})])
def test_a_motor_that_works_too_hard_is_told_of_as_soon_as_it_is_heard_again(
    holding: Bench, also: str, broken: set[str]
) -> None:
    holding.feel(0.9, gravity=0.9)
    holding.ticks(25, Mode.FAULTED, "BUS_NOISE")
    holding.ticks(2, Mode.FAULTED, "BUS_NOISE", heard=False)
    for _ in range(2):
        holding.tick(Mode.FAULTED, "BUS_NOISE", also=also)
    assert holding.red & {"faults"} == broken


@pytest.mark.parametrize(("ticks", "broken"), [(1, set()), (2, {"rows"})])
def test_a_motor_that_works_too_hard_is_told_of_again_as_soon_as_that_is_cleared(
    holding: Bench, ticks: int, broken: set[str]
) -> None:
    holding.feel(0.9, gravity=0.9)
    holding.ticks(40, Mode.FAULTED, "OVERLOAD")
    holding.ask("clear")
    holding.ticks(ticks, Mode.HOLDING)
    holding.tick(Mode.FAULTED, "OVERLOAD")
    assert holding.red & {"faults", "rows"} == broken


@pytest.mark.parametrize(("ticks", "broken"), [(20, set()), (30, {"faults"})])
def test_a_program_that_has_just_begun_sees_what_a_motor_works_once_it_has_asked_who_is_there(
    holding: Bench, ticks: int, broken: set[str]
) -> None:
    holding.feel(0.9, gravity=0.9)
    holding.ticks(12, Mode.STARTING)
    holding.ticks(ticks, Mode.FAULTED, "BUS_NOISE")
    assert holding.red & {"faults"} == broken


@pytest.mark.parametrize(("late_s", "broken"), [(1.3, set()), (0.0, {"rest"})])
def test_a_supply_that_was_low_until_just_now_has_lasted(holding: Bench, late_s: float, broken: set[str]) -> None:
    holding.feel(volts=7.0)
    holding.tick(Mode.HOLDING)
    holding.now_s += late_s
    holding.feel()
    holding.tick(Mode.FAULTED, "VOLTAGE")
    assert holding.broken & {"rest"} == broken


@pytest.mark.parametrize(("also", "broken"), [("BLOCKED", set()), ("", {"rest"})])
def test_a_supply_is_told_at_once_with_what_it_holds_up_alone(holding: Bench, also: str, broken: set[str]) -> None:
    holding.feel(volts=7.0)
    holding.servos[0].goal = MIDDLE + 40
    holding.ticks(2, Mode.HOLDING)
    holding.tick(Mode.FAULTED, "VOLTAGE", also=also)
    assert holding.red - {"2", "7"} == broken


def test_what_lasted_may_be_told_in_the_tick_in_which_it_ends(holding: Bench) -> None:
    holding.feel(volts=8.0)
    holding.ticks(6, Mode.HOLDING)
    holding.feel()
    holding.tick(Mode.FAULTED, "VOLTAGE")
    assert holding.red == set()


@pytest.mark.parametrize(("volts", "broken"), [(8.95, set()), (8.8, {"cause"})])
def test_torque_comes_on_only_where_the_supply_is_in_range_as_servos_tell_it(volts: float, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.feel(volts=volts)
    bench.ticks(5, Mode.OFF)
    bench.ask("torque_on")
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    assert bench.red & {"cause"} == broken


@pytest.mark.parametrize(("before_s", "broken"), [(0.02, set()), (0.3, {"5"})])
def test_a_horn_that_slips_as_torque_goes_off_at_rest_could_not_be_seen(before_s: float, broken: set[str]) -> None:
    bench = Bench()
    for i, servo in enumerate(bench.servos):
        rest = JUDGED.servos[i].rest_tick
        servo.goal = round(rest)
        bench.at(rest, i)
    bench.ask("park")
    bench.ticks(3, Mode.PARKING)
    bench.plan("pair_mismatch", 9.0)
    if before_s > PERIOD_S:
        bench.ticks(round(before_s / PERIOD_S), Mode.PARKING)
    bench.servos[0].sensed_tick += 25
    bench.now_s += min(before_s, 0.02)
    bench.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert bench.red == broken


@pytest.mark.parametrize(
    ("servo_id", "before_s", "off", "broken"),
    [(1, 0.3, 5, set()), (1, 0.6, 5, {"3"}), (2, 0.3, 5, {"3"}), (1, 0.3, 40, {"3"})],
)
def test_where_a_horn_has_just_slipped_torque_may_come_on_at_the_place_before(
    servo_id: int, before_s: float, off: int, broken: set[str]
) -> None:
    bench = Bench(torque=False)
    bench.plan("pair_mismatch", 9.0, servo_id)
    bench.at(MIDDLE + off)
    bench.ticks(round(before_s / PERIOD_S), Mode.OFF)
    bench.ask("torque_on")
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    assert bench.red == broken
