"""What `identify` finds unfit: each cause by its code, its servo and what to do; and what is no problem."""

import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Register
from armctl.dynamixel.identify import answers_twice
from armctl.dynamixel.servos import MODELS, ServoModel
from tests.dynamixel.conftest import ARM, FINE, LOST, ScriptedBus, Spoil, bad_checksum, echo, good_after


def the_problem(bus: ScriptedBus, code: str, servo_id: int | None = None) -> str:
    """What is said of the only one there is."""
    (problem,) = bus.identify(ARM.joints)
    assert (problem.code, problem.servo_id) == (code, servo_id)
    return problem.text


def test_fit_arm_has_no_problems(bus: ScriptedBus) -> None:
    assert bus.identify(ARM.joints) == ()


def test_missing_servo_is_named_with_its_joint(bus: ScriptedBus) -> None:
    bus.port.silent = {3}
    assert the_problem(bus, "SERVO_SILENT", 3).startswith("servo 3 (elbow): no reply; check")


def test_silent_bus_is_one_problem(bus: ScriptedBus) -> None:
    bus.port.silent = set(ARM.servo_ids)
    told = the_problem(bus, "BUS_DEAD")
    for cause in ("not a byte came", "supply", "1000000 baud", "cable"):
        assert cause in told
    assert bus.read_sample().bus_us <= 40_000  # the generous timeout of identify is over


def test_bus_of_garbage_is_one_problem(bus: ScriptedBus) -> None:
    bus.port.spoils = {servo_id: [echo] * 9 for servo_id in ARM.servo_ids}
    assert "only garbled bytes" in the_problem(bus, "BUS_DEAD")


def test_other_model_is_named_and_its_table_not_judged(bus: ScriptedBus) -> None:
    bus.port.place(2, ax12a.MODEL, 18)
    bus.port.place(2, ax12a.CCW_LIMIT, 1)
    assert "model number 18, wanted 12" in the_problem(bus, "WRONG_MODEL", 2)


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_a_joint_takes_the_servo_that_its_file_names_and_no_other(bus: ScriptedBus, model: ServoModel) -> None:
    joints = [joint.model_copy(update={"model": model.name}) if joint.servo_id == 2 else joint for joint in ARM.joints]
    bus.port.place(2, ax12a.MODEL, model.model_number)
    assert bus.identify(joints) == ()
    bus.port.place(2, ax12a.MODEL, 29)
    [problem] = bus.identify(joints)
    assert (problem.code, problem.servo_id) == ("WRONG_MODEL", 2)
    assert f"model number 29, wanted {model.model_number} ({model.name.upper()})" in problem.text


def test_another_known_servo_is_told_by_the_line_that_the_file_needs(bus: ScriptedBus) -> None:
    bus.port.place(2, ax12a.MODEL, 18)
    assert "write `model: ax-18a` for it" in the_problem(bus, "WRONG_MODEL", 2)


@pytest.mark.parametrize(
    ("register", "value", "text"),
    [
        (ax12a.CW_LIMIT, 100, "cw_angle_limit is 100, wanted 2 to 18"),
        (ax12a.CW_LIMIT, 0, "cw_angle_limit is 0, wanted 2 to 18"),
        (ax12a.CCW_LIMIT, 1000, "ccw_angle_limit is 1000, wanted 1006 to 1022"),
        (ax12a.CCW_LIMIT, 0, "ccw_angle_limit is 0, wanted 1006"),
        (ax12a.RETURN_LEVEL, 1, "status_return_level is 1, wanted 2"),
        (ax12a.SHUTDOWN, 0, "shutdown is 0, wanted 36 in it"),
        (ax12a.SHUTDOWN, 4, "shutdown is 4, wanted 36 in it"),
        (ax12a.TEMPERATURE_LIMIT, 150, "temperature_limit is 150, wanted at most 85"),
        (ax12a.TEMPERATURE_LIMIT, 86, "temperature_limit is 86"),
        (ax12a.TEMPERATURE_LIMIT, 60, ""),
        (ax12a.SHUTDOWN, 127, ""),
        (ax12a.RETURN_DELAY, 0, ""),
        (ax12a.MAX_TORQUE, 500, ""),
        (ax12a.CW_LIMIT, 2, ""),
    ],
)
def test_eeprom_that_forbids_motion_is_shown_and_no_other(
    bus: ScriptedBus, register: Register, value: int, text: str
) -> None:
    bus.port.place(3, register, value)
    if not text:
        assert bus.identify(ARM.joints) == ()
        return
    told = the_problem(bus, "EEPROM_MISMATCH", 3)
    assert told.startswith("servo 3 (elbow): ")
    assert text in told
    assert "type `armctl servo mend 3 --port scripted`" in told


def test_a_servo_from_the_factory_is_one_problem_that_names_both_missing_walls(bus: ScriptedBus) -> None:
    for register in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT):
        bus.port.place(2, register, register.default)
    told = "cw_angle_limit is 0, wanted 155 to 171; ccw_angle_limit is 1023, wanted 750 to 766"
    assert told in the_problem(bus, "EEPROM_MISMATCH", 2)


QUESTION = f"; is this really {ARM.arm_id}? If not, start the daemon with --arm NAME (`armctl arms` lists them); "


@pytest.mark.parametrize(("differ", "silent", "asked"), [
    ((2, 3), (), {2, 3}), ((2,), (5,), {2, 5}), ((1, 2, 3), (6,), {1, 2, 3, 6}), ((2,), (), set()), ((), (4, 5), set()),
])  # fmt: skip
def test_servos_that_may_be_another_arm_s_ask_for_the_arm_before_anything_is_written_into_them(
    bus: ScriptedBus, differ: tuple[int, ...], silent: tuple[int, ...], asked: set[int]
) -> None:
    for servo_id in differ:
        bus.port.place(servo_id, ax12a.CCW_LIMIT, 600)
    bus.port.silent = set(silent)
    told = {problem.servo_id: problem.text for problem in bus.identify(ARM.joints)}
    assert {servo_id for servo_id, text in told.items() if QUESTION in text} == asked
    assert set(told) == {*differ, *silent}
    for servo_id in differ:
        assert told[servo_id].partition(QUESTION)[2].partition("`")[0] in ("if it is, end the daemon, type ", "")


@pytest.mark.parametrize(
    "spoils", [[FINE, *[good_after(0, 400)] * 10], [bad_checksum] * 20], ids=["reply", "collision"]
)
def test_doubled_replies_hint_at_two_servos_with_one_id(bus: ScriptedBus, spoils: list[Spoil]) -> None:
    bus.port.spoils[3] = list(spoils)
    assert "two servos with this id" in the_problem(bus, "DUPLICATE_ID", 3)


@pytest.mark.parametrize("spoiled", [1, 2, 3, 4])
@pytest.mark.parametrize("spoil", [LOST, bad_checksum, good_after(22_000), good_after(30_000), good_after(45_000)])
def test_a_servo_that_is_misheard_for_a_moment_is_fit(bus: ScriptedBus, spoil: Spoil, spoiled: int) -> None:
    bus.port.spoils[3] = [spoil] * spoiled
    assert bus.identify(ARM.joints) == ()
    assert all(reading.fresh for reading in bus.read_sample().servos)


def test_a_bad_cable_that_garbles_a_reading_and_its_confirmation_is_no_second_servo(bus: ScriptedBus) -> None:
    bus.port.spoils[3] = [FINE, *[bad_checksum] * 2, FINE, *[bad_checksum] * 4]
    assert bus.identify(ARM.joints) == ()


@pytest.mark.parametrize("delay_us", [22_000, 30_000, 45_000, 70_000])
def test_late_replies_for_a_moment_are_no_second_servo(bus: ScriptedBus, delay_us: int) -> None:
    bus.port.spoils[3] = [FINE, *[good_after(delay_us)] * 4]
    assert bus.identify(ARM.joints) == ()


def test_an_adapter_that_is_slow_now_and_then_is_fit(bus: ScriptedBus) -> None:
    bus.port.spoils = {servo_id: [good_after(12_000)] for servo_id in ARM.servo_ids[1:]}
    bus.port.spoils[ARM.servo_ids[0]] = [good_after(12_000), FINE] * 2
    assert bus.identify(ARM.joints) == ()
    assert bus.port._latency_ms <= 8.0


@pytest.mark.parametrize(("adapter_us", "codes"), [(16_000, ["SLOW_ADAPTER"]), (2_000, [])])
def test_slow_adapter_is_told_from_a_usual_one_and_from_a_dead_bus_and_still_read(
    bus: ScriptedBus, adapter_us: int, codes: list[str]
) -> None:
    bus.port.adapter_us = adapter_us
    problems = bus.identify(ARM.joints)
    assert [problem.code for problem in problems] == codes
    assert all("adds 16.0 ms" in problem.text and "latency_timer" in problem.text for problem in problems)
    assert all(reading.fresh for reading in bus.read_sample().servos)


def test_colliding_replies_answer_twice_and_others_do_not(bus: ScriptedBus) -> None:
    bus.port.spoils[3] = [bad_checksum] * 10
    assert answers_twice(bus, 3)
    assert not answers_twice(bus, 2)
    assert not answers_twice(bus, 77)
