"""The slow way to rest in the control step: for `park`, and for faults that would soon drop the arm."""

import math
from itertools import pairwise

import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.messages import Clear, Hold, HostSilent, Mode, Park, Release, Run, TorqueOn
from tests.control.ideal_arm import PERIOD_S, IdealArm, holding, line, running


def away() -> IdealArm:
    """Holding, some way from the rest pose."""
    arm = holding()
    arm.run_ticks(26, Run(90, line(arm, delta_rad=0.6)))
    assert arm.replies[90].ok
    return arm


def strained() -> IdealArm:
    """On its way to rest for heat."""
    arm = away()
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(55)
    assert arm.code() == "HOT"
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
    assert (arm.mode(), arm.replies[5].ok) == (Mode.OFF, True)
    assert at_rest(arm)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6
    fastest = max(abs(b[0] - a[0]) for a, b in pairwise(arm.goals)) * ax12a.TICK_RAD / PERIOD_S
    assert fastest <= math.radians(20.0) + ax12a.TICK_RAD / PERIOD_S


def test_park_can_be_stopped_on_its_way() -> None:
    arm = away()
    arm.run_ticks(11, Park(5))
    arm.run_ticks(5, Hold(6))
    assert (arm.mode(), arm.replies[5].code, arm.replies[6].ok) == (Mode.HOLDING, "STOPPED", True)
    assert not at_rest(arm)


def test_an_arm_that_does_not_get_to_rest_keeps_its_torque() -> None:
    arm = away()
    arm.run_ticks(9, Park(5))
    rest = round(arm.arm.joints[3].tick(arm.arm.joints[3].rest_rad))
    arm.after_write = lambda a: a.put(3, ax12a.PRESENT_POSITION, rest - 15)  # hangs 4.4 deg low
    arm.run_ticks(60)
    assert (arm.mode(), arm.replies[5].code) == (Mode.HOLDING, "NOT_AT_REST")
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [1] * 6


def test_a_way_to_rest_below_the_floor_is_not_taken() -> None:
    arm = away()
    arm.arm = arm.arm.model_copy(update={"floor_m": 1.0})
    arm.run_ticks(4, Park(5))
    assert (arm.mode(), arm.replies[5].code) == (Mode.HOLDING, "LIMIT")


@pytest.mark.parametrize(
    ("register", "value", "code", "seconds"),
    [
        (ax12a.PRESENT_TEMPERATURE, 66, "HOT", 2.2),
        (ax12a.PRESENT_VOLTAGE, 85, "VOLTAGE", 0.7),
        (ax12a.PRESENT_LOAD, 900, "OVERLOAD", 2.2),
    ],
)
def test_strain_sends_the_arm_to_rest_before_a_servo_trips(
    register: ax12a.Register, value: int, code: str, seconds: float
) -> None:
    arm = away()
    arm.run_tick(Run(5, line(arm, delta_rad=0.3, seconds=4.0)))
    arm.put(2, register, value)
    arm.run_ticks(round(seconds / PERIOD_S) - 2)
    assert not arm.state.faults, "a dip moves no arm"
    arm.run_ticks(2)
    assert arm.fault() == (code, 3)
    while "REST_AHEAD" not in arm.events:
        arm.run_tick()
    arm.run_ticks(3)
    assert not arm.goals_in(25), "it says so 3 s ahead"
    arm.run_ticks(70)
    # A joint that stands, and gives so much, pushes against something as well.
    assert arm.replies[5].code == ("CONTACT" if code == "OVERLOAD" else code)
    assert at_rest(arm)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6
    assert arm.mode() is Mode.FAULTED
    arm.run_tick(Clear(7))
    cleared = code == "OVERLOAD"  # the load went with the torque; heat and voltage are still what they were
    assert arm.replies[7].ok is cleared
    arm.put(2, register, 120 if register is ax12a.PRESENT_VOLTAGE else 40)
    assert (arm.ask(Clear(8)).ok, arm.mode()) == (True, Mode.OFF)


@pytest.mark.parametrize(
    ("register", "value", "code"),
    [
        (ax12a.TORQUE_ENABLE, 0, "LOST_TORQUE"),
        (ax12a.TORQUE_LIMIT, 0, "TRIPPED"),
        (ax12a.TORQUE_LIMIT, 700, "OTHER_WRITER"),
        (ax12a.GOAL, 300, "OTHER_WRITER"),
        (ax12a.PUNCH, 0, "OTHER_WRITER"),
    ],
)
def test_the_way_to_rest_ends_where_torque_is_lost_or_another_program_interferes(
    register: ax12a.Register, value: int, code: str
) -> None:
    arm = strained()
    assert len(arm.goals_in(3)) == 3
    arm.put(1, register, value)
    arm.run_ticks(2)
    assert code in arm.events
    assert arm.state.motion is None
    assert set(arm.goals_in(30)) <= {arm.state.goal}
    assert arm.get(1, ax12a.GOAL) == arm.state.goal[1]
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [1, int(register != ax12a.TORQUE_ENABLE), 1, 1, 1, 1]


def test_the_way_to_rest_ends_where_a_servo_falls_silent() -> None:
    arm = strained()
    arm.silent = {4}
    arm.run_ticks(10)
    assert "SERVO_SILENT" in arm.events
    assert arm.state.motion is None


@pytest.mark.parametrize(
    "trouble", ["another servo gets hot", "the supply dips", "a tick comes late", "the host hangs"]
)
def test_trouble_that_only_slows_the_way_to_rest_does_not_end_it_for_good(trouble: str) -> None:
    arm = strained()
    if trouble == "a second servo is hot":
        arm.put(3, ax12a.PRESENT_TEMPERATURE, 66)
    elif trouble == "the supply dips":
        arm.put(3, ax12a.PRESENT_VOLTAGE, 85)
    arm.late_ns = 300_000_000 if trouble == "a tick comes late" else 0
    arm.run_tick(*[HostSilent()] * (trouble == "the host hangs"))
    arm.late_ns = 0
    arm.run_ticks(160)
    assert at_rest(arm)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6


def test_an_arm_of_one_joint_parks() -> None:
    dh = {"convention": "standard", "dh": [{"d_m": 0.06, "a_m": 0.1, "alpha_deg": 0.0}]}
    joint = {"name": "base", "servo_id": 1, "limits_deg": [-140, 140], "rest_deg": 0, "zero_tick": 512, "direction": 1}
    told = {"arm_id": "turntable", "robot": dh, "joints": [joint], "correction": False}
    arm = holding(IdealArm(ArmConfig.model_validate(told)))
    arm.run_ticks(26, Run(90, line(arm, delta_rad=0.3)))
    arm.run_ticks(60, Park(5))
    assert (arm.mode(), arm.replies[5].ok) == (Mode.OFF, True)


def test_what_was_seen_once_before_a_silence_has_not_lasted() -> None:
    arm = away()
    arm.put(2, ax12a.PRESENT_VOLTAGE, 80)
    arm.run_ticks(1)
    arm.silent = {2}
    arm.run_ticks(20)
    arm.put(2, ax12a.PRESENT_VOLTAGE, 120)
    arm.silent = set()
    arm.run_ticks(5)
    assert "SERVO_SILENT" in arm.events
    assert "VOLTAGE" not in arm.events


def test_a_fault_on_the_way_to_rest_ends_it() -> None:
    arm = away()
    arm.run_ticks(6, Park(5))
    arm.put(3, ax12a.GOAL, 300)
    arm.run_tick()
    assert arm.replies[5].code == "OTHER_WRITER"
    assert not arm.goals_in(30)


def test_release_on_the_way_to_rest_is_limp_at_once() -> None:
    arm = strained()
    arm.run_tick(Release(6))
    assert not arm.goals_in(20)


def test_clear_waits_for_the_arm_to_come_to_rest() -> None:
    arm = strained()
    assert "coming to rest" in arm.ask(Clear(1)).message


def test_release_while_a_fault_decelerates_ends_the_motion() -> None:
    arm = running(5)
    arm.put(3, ax12a.PRESENT_VOLTAGE, 80)
    arm.run_ticks(6)
    assert arm.mode() is Mode.FAULTED
    arm.run_tick(Release(6))
    assert arm.state.motion is None
    assert arm.outputs is not None
    assert arm.outputs.goal is None


def test_an_obstacle_on_the_way_to_rest_ends_it_and_is_not_pushed_against() -> None:
    arm = strained()
    arm.stuck = {0}
    arm.run_ticks(20)
    assert [fault.code for fault in arm.state.faults] == ["HOT", "BLOCKED"]
    assert arm.goals[-1][0] == arm.get(0, ax12a.PRESENT_POSITION)
    assert not arm.goals_in(60), "nor does it set off again"


@pytest.mark.parametrize("asked", ["stop", "configuration", "cause over"])
def test_the_way_to_rest_is_called_off(asked: str) -> None:
    arm = away()
    if asked == "configuration":
        arm.arm = arm.arm.model_copy(update={"rest_on_strain": False})
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(30)
    assert (arm.code(), "REST_AHEAD" in arm.events) == ("HOT", asked != "configuration")
    if asked == "stop":
        arm.run_tick(Hold(6))
    elif asked == "cause over":
        arm.put(2, ax12a.PRESENT_TEMPERATURE, 60)
    assert not arm.goals_in(80)
    assert (arm.mode(), arm.code(), arm.outputs and arm.outputs.rest_in_s) == (Mode.FAULTED, "HOT", None)


@pytest.mark.parametrize("stopped", [True, False])
def test_a_stop_calls_the_way_to_rest_off_although_the_arm_waits_for_a_servo(stopped: bool) -> None:
    arm = away()
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(30)
    arm.silent = {0}
    arm.run_ticks(6)
    arm.run_ticks(1, *[Hold(6)] * stopped)
    arm.silent = set()
    assert bool(arm.goals_in(80)) is not stopped
    assert {fault.code for fault in arm.state.faults} == {"HOT", "SERVO_SILENT"}


def test_heat_that_comes_back_sends_the_arm_to_rest_after_all() -> None:
    arm = away()
    for temperature_degC, ticks in ((66, 30), (60, 60), (66, 150)):
        arm.put(2, ax12a.PRESENT_TEMPERATURE, temperature_degC)
        arm.run_ticks(ticks)
    assert at_rest(arm)
    assert not arm.get(2, ax12a.TORQUE_ENABLE)


@pytest.mark.parametrize(("register", "value", "code"), [
    (ax12a.PRESENT_TEMPERATURE, 68, "HOT"), (ax12a.PRESENT_VOLTAGE, 80, "VOLTAGE")
])  # fmt: skip
def test_torque_is_refused_while_it_would_send_the_arm_to_rest(register: ax12a.Register, value: int, code: str) -> None:
    arm = IdealArm().connect()
    arm.run_tick()
    arm.put(2, register, value)
    reply = arm.ask(TorqueOn(1))
    assert (reply.ok, reply.code, arm.mode()) == (False, code, Mode.OFF)
