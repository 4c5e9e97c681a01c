"""What `identify` finds unfit: each cause by its code, its servo and what to do; and what is no problem."""

import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Register
from armctl.dynamixel.bus import ServoBus
from tests.dynamixel.conftest import ScriptedPort, Spoil, bad_checksum, echo, fine, late, lost, twice


def test_fit_arm_has_no_problems(bus: ServoBus, arm: ArmConfig) -> None:
    assert bus.identify(arm.joints) == ()


def test_missing_servo_is_named_with_its_joint(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.silent = {3}
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("SERVO_SILENT", 3)
    assert problem.text.startswith("servo 3 (elbow): no reply; check")


def test_silent_bus_is_one_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.silent = set(arm.servo_ids)
    (problem,) = bus.identify(arm.joints)
    assert problem.code == "BUS_DEAD"
    for cause in ("not a byte came", "supply", "1000000 baud", "cable"):
        assert cause in problem.text
    assert bus.read_sample().bus_us <= 40_000  # the generous timeout of identify is over


def test_bus_of_garbage_is_one_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils = {servo_id: [echo] * 9 for servo_id in arm.servo_ids}
    (problem,) = bus.identify(arm.joints)
    assert problem.code == "BUS_DEAD"
    assert "only garbled bytes" in problem.text


def test_other_model_is_named_and_its_table_not_judged(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.place(2, ax12a.MODEL, 18)
    port.place(2, ax12a.CCW_LIMIT, 1)
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("WRONG_MODEL", 2)
    assert "model number 18, wanted 12" in problem.text


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
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, register: Register, value: int, text: str
) -> None:
    port.place(3, register, value)
    problems = bus.identify(arm.joints)
    assert [(problem.code, problem.servo_id) for problem in problems] == [("EEPROM_MISMATCH", 3)] * bool(text)
    for problem in problems:
        assert problem.text.startswith("servo 3 (elbow): ")
        assert text in problem.text
        assert "type `armctl servo mend 3 --port scripted`" in problem.text


def test_a_servo_from_the_factory_is_one_problem_that_names_both_missing_walls(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig
) -> None:
    for register in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT):
        port.place(2, register, register.default)
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("EEPROM_MISMATCH", 2)
    assert "cw_angle_limit is 0, wanted 155 to 171; ccw_angle_limit is 1023, wanted 750 to 766" in problem.text


@pytest.mark.parametrize("spoils", [[fine, *[twice(400)] * 6], [bad_checksum] * 20], ids=["second reply", "collision"])
def test_doubled_replies_hint_at_two_servos_with_one_id(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, spoils: list[Spoil]
) -> None:
    port.spoils[3] = list(spoils)
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("DUPLICATE_ID", 3)
    assert "two servos with this id" in problem.text


@pytest.mark.parametrize("spoiled", [1, 2, 3, 4])
@pytest.mark.parametrize("spoil", [lost, bad_checksum, late(22_000), late(30_000), late(45_000)])
def test_a_servo_that_is_misheard_for_a_moment_is_fit(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, spoil: Spoil, spoiled: int
) -> None:
    port.spoils[3] = [spoil] * spoiled
    assert bus.identify(arm.joints) == ()
    assert all(reading.fresh for reading in bus.read_sample().servos)


@pytest.mark.parametrize("delay_us", [22_000, 30_000, 45_000, 70_000])
def test_replies_that_come_late_for_a_moment_are_no_second_servo(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, delay_us: int
) -> None:
    port.spoils[3] = [fine, *[late(delay_us)] * 4]
    assert bus.identify(arm.joints) == ()


def test_an_adapter_that_is_slow_now_and_then_is_fit(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils = {servo_id: [late(12_000)] for servo_id in arm.servo_ids[1:]}
    port.spoils[arm.servo_ids[0]] = [late(12_000), fine] * 2
    assert bus.identify(arm.joints) == ()
    assert port._latency_ms <= 8.0


@pytest.mark.parametrize(("adapter_us", "codes"), [(16_000, ["SLOW_ADAPTER"]), (2_000, [])])
def test_slow_adapter_is_told_from_a_usual_one_and_from_a_dead_bus_and_still_read(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, adapter_us: int, codes: list[str]
) -> None:
    port.adapter_us = adapter_us
    problems = bus.identify(arm.joints)
    assert [problem.code for problem in problems] == codes
    assert all("adds 16.0 ms" in problem.text and "latency_timer" in problem.text for problem in problems)
    assert all(reading.fresh for reading in bus.read_sample().servos)


def test_colliding_replies_answer_twice_and_others_do_not(bus: ServoBus, port: ScriptedPort) -> None:
    port.spoils[3] = [bad_checksum] * 6
    assert bus.answers_twice(3)
    assert not bus.answers_twice(2)
    assert not bus.answers_twice(77)
