"""The judge on motion after what stops it, and on what a latched fault allows: caught, or left alone."""

import pytest

from armctl.messages import Mode
from armctl.sim.faults import Fault
from tests.proving.judged import ARM, MIDDLE, Bench, advancing, running


@pytest.mark.parametrize(
    ("kind", "bound_s"), [("mute", 0.2), ("dead_bus", 0.2), ("unplug", 0.1), ("trip", 0.1), ("brown_out", 0.2)]
)
def test_6_goals_that_advance_on_after_a_fault(moving: Bench, kind: str, bound_s: float) -> None:
    one = None if kind in ("dead_bus", "unplug") else 3
    moving.plan(kind, 1.5, one)
    late_s = advancing(moving)
    assert late_s is not None
    assert bound_s + 0.3 < late_s <= bound_s + 0.51


@pytest.mark.parametrize(("late_s", "broken"), [(0.7, set()), (0.0, {"6"})])
def test_6_a_silence_that_ends_while_the_program_is_late_is_a_short_one(late_s: float, broken: set[str]) -> None:
    bench = running()
    bench.plan("mute", 0.93, 3)
    bench.ticks(3, Mode.MOVING)
    for _ in range(1 if late_s else 8):
        bench.now_s += late_s
        bench.tick(Mode.HOLDING)
    bench.ask("run")
    bench.tick(Mode.MOVING)
    advancing(bench)
    assert bench.broken & {"6", "rows"} == (broken | {"rows"} if broken else broken)


@pytest.mark.parametrize(("mode", "broken"), [(Mode.STARTING, set()), (Mode.HOLDING, {"6"})])
def test_6_a_program_that_starts_waits_for_a_silent_servo(holding: Bench, mode: Mode, broken: set[str]) -> None:
    holding.tick(mode)
    holding.plan("mute", 0.97, 3)
    holding.ticks(11, mode)
    holding.ticks(2, Mode.HOLDING)
    holding.ask("run")
    holding.tick(Mode.MOVING)
    advancing(holding)
    assert holding.broken & {"6"} == broken


@pytest.mark.parametrize(("unheard", "broken"), [(6, set()), (0, {"rows"})])
def test_a_sag_that_is_over_soon_after_it_could_be_seen_has_not_lasted(
    holding: Bench, unheard: int, broken: set[str]
) -> None:
    at_s = holding.now_s
    sag = Fault(kind="brown_out", servo_id=1, begin_s=at_s, duration_s=1.2, value=6.86, probability=0.0)
    holding.judge.plan(sag)
    holding.ticks(unheard, Mode.HOLDING, heard=False)
    holding.ticks(15, Mode.HOLDING)
    assert holding.broken & {"rows"} == broken


@pytest.mark.parametrize(("told", "broken"), [("VOLTAGE", set()), ("", {"rows"})])
def test_a_sag_that_had_not_lasted_before_a_silence_is_told_when_a_servo_is_heard_again(
    holding: Bench, told: str, broken: set[str]
) -> None:
    sag = Fault(kind="brown_out", servo_id=None, begin_s=holding.now_s, duration_s=4.4, value=7.5, probability=0.0)
    holding.judge.plan(sag)
    holding.ticks(5, Mode.HOLDING)
    holding.ticks(4, Mode.HOLDING, heard=False)
    holding.ticks(2, Mode.FAULTED if told else Mode.HOLDING, told)
    assert holding.broken & {"rows"} == broken


@pytest.mark.parametrize(
    ("silent", "kind", "broken"), [(1, "mute", set()), (2, "mute", {"rows"}), (None, "dead_bus", set())]
)
def test_what_began_while_nobody_could_hear_it_is_reported_afterwards(
    moving: Bench, silent: int | None, kind: str, broken: set[str]
) -> None:
    one = None if silent is None else ARM.servo_ids[silent]
    moving.plan(kind, 0.45, one)
    moving.tick(Mode.MOVING, heard=False)
    hot = Fault(kind="hot", servo_id=ARM.servo_ids[1], begin_s=moving.now_s, duration_s=2.0, value=68.9)
    moving.judge.plan(hot)
    moving.ticks(26 if silent == 2 else 6, Mode.MOVING, heard=silent == 2)
    moving.tick(Mode.FAULTED, "HOT")
    assert moving.broken & {"rows"} == broken


@pytest.mark.parametrize(("later_s", "broken"), [(0.0, set()), (0.04, set()), (0.16, {"rows"})])
@pytest.mark.parametrize("planned_first", [True, False])
def test_what_was_silent_before_anybody_heard_it_is_reported_afterwards(
    moving: Bench, planned_first: bool, later_s: float, broken: set[str]
) -> None:
    both = [
        Fault(kind="trip", servo_id=1, begin_s=moving.now_s, duration_s=0.2),
        Fault(kind="dead_bus", begin_s=moving.now_s + later_s, duration_s=0.75),
    ]
    for fault in both if planned_first else both[::-1]:
        moving.judge.plan(fault)
    moving.tick(Mode.HOLDING, heard=later_s > 0.1)
    moving.ticks(8, Mode.HOLDING, heard=False)
    moving.tick(Mode.FAULTED, "TRIPPED")
    assert moving.broken & {"rows"} == broken


@pytest.mark.parametrize(("late_s", "broken"), [(1.3, set()), (0.0, {"7"})])
def test_7_what_a_frozen_sensor_moves_may_come_back_after_a_late_tick(late_s: float, broken: set[str]) -> None:
    bench = running()
    bench.plan("frozen_sensor", 1.0)
    bench.tick(Mode.FAULTED, "BLOCKED")
    bench.at(MIDDLE + 100.0)
    bench.ticks(8, Mode.FAULTED, "BLOCKED")
    bench.now_s += late_s
    bench.at(MIDDLE + 10.0)
    bench.ticks(1 if late_s else 13, Mode.FAULTED, "BLOCKED")
    bench.at(MIDDLE + 5.0)
    bench.tick(Mode.FAULTED, "BLOCKED")
    assert bench.broken == broken


@pytest.mark.parametrize(("falls", "broken"), [(True, set()), (False, {"6"})])
def test_6_a_joint_may_be_moved_by_a_limp_one_that_falls(moving: Bench, falls: bool, broken: set[str]) -> None:
    moving.ask("hold")
    moving.at(MIDDLE + 8)
    moving.ticks(12, Mode.HOLDING)
    moving.servos[1].torque = False
    moving.tick(Mode.HOLDING)
    moving.at(MIDDLE + 4)
    moving.at(MIDDLE - (40 if falls else 1), 1)
    moving.tick(Mode.HOLDING)
    assert moving.broken == broken


@pytest.mark.parametrize(("places", "broken"), [((0, 4), set()), ((0, 4, 8, 4), {"6"})])
def test_6_a_joint_may_swing_about_its_place_and_not_go_on(
    moving: Bench, places: tuple[int, ...], broken: set[str]
) -> None:
    moving.goal(MIDDLE - 20)
    for k in range(40):
        if k == 10:
            moving.ask("hold")
        moving.at(MIDDLE + places[k % len(places)])
        moving.tick(Mode.MOVING if k < 12 else Mode.HOLDING)
    assert moving.broken == broken
    moving.at(MIDDLE - 8)
    moving.tick(Mode.HOLDING)
    assert moving.broken == {"6"}, "somewhere else is no swing"


def test_6_a_short_silence_obliges_only_while_it_lasts(moving: Bench) -> None:
    moving.plan("mute", 0.45, 3)
    moving.ticks(5, Mode.MOVING)
    assert advancing(moving) is None


@pytest.mark.parametrize(("duration_s", "broken"), [(0.15, set()), (0.6, {"6"})])
def test_6_an_arm_on_its_way_to_rest_may_go_on_after_a_short_unplug_alone(duration_s: float, broken: set[str]) -> None:
    bench = Bench()
    bench.ask("run")
    bench.tick(Mode.FAULTED, "OVERLOAD")
    bench.plan("unplug", duration_s, None, in_s=0.02)
    bench.ticks(3, Mode.FAULTED, "OVERLOAD")
    bench.hear()
    advancing(bench, mode=Mode.FAULTED, code="OVERLOAD")
    assert bench.broken & {"6", "rows"} == broken


@pytest.mark.parametrize("word", ["hold", "pause", "host_lost"])
def test_6_goals_that_advance_on_after_a_stop(moving: Bench, word: str) -> None:
    moving.ask(word)
    late_s = advancing(moving)
    assert late_s is not None
    assert late_s < 0.7


def test_6_a_resumed_run_may_advance(moving: Bench) -> None:
    moving.ask("pause")
    moving.judge.asked(moving.now_s + 0.2, "resume")
    assert advancing(moving) is None


def test_6_a_late_tick_stops_the_motion(moving: Bench) -> None:
    moving.now_s += 0.5
    moving.tick(Mode.MOVING)
    assert advancing(moving) is not None


def test_6_a_jog_without_heartbeats(holding: Bench) -> None:
    holding.ask("jog")
    assert advancing(holding, mode=Mode.JOGGING) is not None


def test_6_an_arm_that_is_not_still_in_time(holding: Bench) -> None:
    holding.ask("hold")
    holding.servos[0].goal = MIDDLE + 39
    for k in range(10):
        holding.at(MIDDLE + 3.5 * k)
        holding.tick()
    assert holding.broken == {"6"}


def test_6_a_program_that_adopts_writes_no_goal(holding: Bench) -> None:
    holding.judge.died(holding.now_s, holding.servos)
    holding.tick()
    holding.judge.back()
    holding.goal(MIDDLE)
    assert holding.broken == {"6"}


def test_7_a_goal_that_advances_while_a_fault_is_latched(moving: Bench) -> None:
    late_s = advancing(moving, mode=Mode.FAULTED, code="OTHER_WRITER")
    assert late_s is not None
    assert "7" in moving.broken
    assert late_s < 0.7


@pytest.mark.parametrize(("code", "broken"), [("", set()), ("BLOCKED", {"7"})])
def test_7_a_motion_asked_for_together_with_a_clear_needs_the_clear_to_be_granted(code: str, broken: set[str]) -> None:
    bench = running()
    bench.ticks(5, Mode.FAULTED, "BLOCKED")
    bench.ask("clear", "park")
    bench.goal(MIDDLE + 5)
    bench.tick(Mode.FAULTED if code else Mode.PARKING, code)
    assert bench.broken == broken


@pytest.mark.parametrize(("asked", "broken"), [(("clear", "run"), set()), (("clear",), {"6"})])
def test_6_a_motion_asked_for_together_with_a_clear_ends_an_older_hold(
    moving: Bench, asked: tuple[str, ...], broken: set[str]
) -> None:
    moving.ask("hold")
    moving.ticks(8, Mode.HOLDING)
    moving.ticks(8, Mode.FAULTED, "SERVO_SILENT")
    moving.ask(*asked)
    moving.goal(MIDDLE + 5)
    moving.tick(Mode.MOVING)
    moving.move(5)
    assert moving.broken == broken


def test_7_heat_may_send_the_arm_to_rest_and_nowhere_else(holding: Bench) -> None:
    holding.stand_off_rest()
    holding.tick(Mode.FAULTED, "HOT")
    assert advancing(holding, mode=Mode.FAULTED, code="HOT") is None
    holding.move(-5, mode=Mode.FAULTED, code="HOT")
    assert holding.broken == {"7", "rest"}


@pytest.mark.parametrize(("step", "seen"), [(2, False), (3, True)])
def test_7_on_the_way_to_rest_goals_go_back_by_what_a_correction_adds_and_not_by_more(
    holding: Bench, step: int, seen: bool
) -> None:
    holding.stand_off_rest()
    holding.tick(Mode.FAULTED, "HOT")
    assert advancing(holding, mode=Mode.FAULTED, code="HOT") is None
    holding.at(holding.servos[0].goal - 20.0)  # it hangs down
    holding.tick(Mode.FAULTED, "HOT")
    holding.move(-step, follow=False, mode=Mode.FAULTED, code="HOT")
    assert ("7" in holding.broken) == seen


@pytest.mark.parametrize("there", [500.0, 514.0])
@pytest.mark.parametrize(("steps", "seen"), [(4, False), (6, True)])
def test_7_a_joint_that_comes_from_below_its_rest_is_led_there_by_goals_beyond_it_as_far_as_a_correction_may_be(
    holding: Bench, steps: int, seen: bool, there: float
) -> None:
    holding.servos[0].goal = 412  # the base rests at 512
    holding.at(412.0)
    holding.tick(Mode.FAULTED, "HOT")
    assert advancing(holding, mode=Mode.FAULTED, code="HOT") is None
    holding.at(500.0)
    holding.tick(Mode.FAULTED, "HOT")
    for _ in range(steps):
        holding.move(5, follow=False, mode=Mode.FAULTED, code="HOT")
        holding.at(there)
    assert ("7" in holding.broken) == seen


@pytest.mark.parametrize(("came", "steps", "seen"), [(509, 4, False), (509, 6, True), (480, 4, True)])
def test_7_a_joint_that_came_from_near_its_rest_is_led_to_either_side_of_it_as_far_as_a_correction_may_be(
    holding: Bench, came: int, steps: int, seen: bool
) -> None:
    holding.servos[0].goal = came  # the base rests at 512
    holding.at(float(came))
    holding.ticks(35, Mode.FAULTED, "HOT")
    for _ in range(steps):
        holding.move(-5, follow=False, mode=Mode.FAULTED, code="HOT")
    assert ("7" in holding.broken) == seen


@pytest.mark.parametrize(("mode", "code", "broken"), [(Mode.JOGGING, "", set()), (Mode.FAULTED, "HOT", {"7"})])
def test_7_a_jog_that_comes_with_clear_is_no_way_to_rest_once_the_fault_is_gone(
    holding: Bench, mode: Mode, code: str, broken: set[str]
) -> None:
    holding.tick(Mode.FAULTED, "HOT")
    holding.ticks(5, Mode.FAULTED, "HOT")
    holding.ask("clear", "jog")
    holding.goal(holding.servos[0].goal - 5)
    holding.tick(mode, code)
    assert holding.broken == broken


@pytest.mark.parametrize(("way", "broken"), [(5, set()), (-5, {"7"})])
def test_7_the_way_to_rest_goes_on_where_a_clear_and_a_jog_are_refused(
    holding: Bench, way: int, broken: set[str]
) -> None:
    holding.stand_off_rest()
    holding.ticks(35, Mode.FAULTED, "HOT")
    holding.move(5, mode=Mode.FAULTED, code="HOT")
    holding.ask("clear", "jog")
    holding.move(way, mode=Mode.FAULTED, code="HOT")
    assert holding.broken == broken


@pytest.mark.parametrize("stopped_by", ["a silence", "hold"])
@pytest.mark.parametrize("announced", [True, False])
def test_7_heat_that_outlasts_a_silence_may_send_the_arm_to_rest_once_that_is_announced(
    holding: Bench, stopped_by: str, announced: bool
) -> None:
    holding.stand_off_rest()
    holding.tick(Mode.FAULTED, "HOT")
    holding.now_s += 0.5
    for k in range(38):
        if (stopped_by, k) == ("hold", 20):
            holding.ask("hold")
        if announced and k == 30:
            holding.judge.rest_announced()
        holding.tick(Mode.FAULTED, "SERVO_SILENT", heard=k > 5, also="HOT")
    holding.goal(405)
    wrong = {"6"} if stopped_by == "hold" else set()
    assert holding.broken - {"faults"} == wrong | (set() if announced else {"7"})


def test_7_a_fault_that_is_cleared_though_its_cause_lasts(holding: Bench) -> None:
    holding.tick(Mode.FAULTED, "SERVO_SILENT")
    holding.judge.reported(holding.now_s, Mode.HOLDING, "", "mute is in force")
    assert holding.broken == {"7"}


def test_heat_that_is_set_anew_below_the_bound_is_told_by_nobody(holding: Bench) -> None:
    holding.plan("hot", 0.05, 1, value=70.0)
    holding.tick(Mode.HOLDING)
    holding.plan("hot", 0.05, 1, value=64.0)
    holding.ticks(30, Mode.HOLDING)
    assert holding.broken == set()


@pytest.mark.parametrize(("ticks", "broken"), [(3, set()), (12, {"6"})])
def test_6_a_joint_whose_goal_was_given_up_swings(ticks: int, broken: set[str]) -> None:
    bench = running()
    bench.ask("host_silent")
    bench.ticks(12, Mode.HOLDING)
    bench.servos[0].goal += 20
    bench.judge.asked(bench.now_s, "clear")
    bench.tick(Mode.HOLDING)
    bench.ticks(ticks, Mode.HOLDING)
    bench.at(bench.servos[0].shaft_tick + 5.0)
    bench.tick(Mode.HOLDING)
    assert bench.broken & {"6"} == broken


@pytest.mark.parametrize(("kind", "broken"), [("lost", set()), ("duplicated", {"6"})])
def test_6_a_goal_that_was_lost_arrives_later(kind: str, broken: set[str]) -> None:
    bench = running()
    bench.servos[0].goal += 20
    bench.ask("hold")
    bench.ticks(12, Mode.HOLDING)
    bench.plan(kind, 1.0, 3)
    bench.tick(Mode.HOLDING)
    bench.at(bench.servos[0].shaft_tick + 6.0)
    bench.tick(Mode.HOLDING)
    assert bench.broken & {"6"} == broken
