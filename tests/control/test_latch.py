"""Faults in the control step: what latches, what happens to the arm, and what clears it."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.faults import CODES
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.messages import Clear, Connected, Mode, Park, Problem, Release, Run, Teach, TorqueOn
from tests.control.ideal_arm import IdealArm, holding, line, running


def test_a_silent_servo_latches_and_the_others_hold() -> None:
    arm = running(5)
    arm.silent = {2}
    arm.run_ticks(9)
    assert arm.fault() == ("SERVO_SILENT", 3)
    assert arm.state.motion is None
    assert not arm.replies[5].ok
    assert not arm.goals_in(5)
    assert "no reply from elbow" in arm.ask(Clear(7)).message
    arm.silent = set()
    arm.run_tick()
    arm.silent = {1}  # one reply lost just then is no cause: that servo was heard a tick ago
    assert (arm.ask(Clear(8)).ok, arm.mode()) == (True, Mode.HOLDING)


@pytest.mark.parametrize("first", [set(range(6)), {0, 1}])
def test_a_silent_bus_is_one_fault_also_where_its_servos_fell_silent_one_by_one(first: set[int]) -> None:
    arm = holding()
    arm.silent = first
    arm.run_tick()
    arm.silent = set(range(6))
    arm.run_ticks(6)
    assert arm.code() == "BUS_DEAD"


def test_no_goal_goes_out_while_a_servo_is_unheard_lest_it_wakes_one_that_restarted() -> None:
    arm = running(5)
    arm.silent = {2}
    assert not arm.goals_in(3)
    arm.silent = set()
    arm.put(2, ax12a.TORQUE_ENABLE, 0)  # it restarted
    arm.run_tick()
    assert arm.code() == "LOST_TORQUE"
    assert arm.get(2, ax12a.TORQUE_ENABLE) == 0


def test_unplugging_latches_at_once_and_clears_only_after_replugging() -> None:
    arm = running()
    arm.port_open = False
    arm.run_tick()
    assert arm.code() == "PORT_GONE"
    assert arm.replies[5].code == "PORT_GONE"
    assert "not open" in arm.ask(Clear(6)).message
    arm.port_open = True
    arm.run_tick(Connected())
    assert "PORT_BACK" in arm.events
    assert arm.mode() is Mode.FAULTED
    arm.goals.clear()
    arm.run_tick(Connected(), Clear(7))
    assert (arm.mode(), arm.replies[7].ok) == (Mode.HOLDING, True)
    assert not arm.goals
    assert arm.events.count("PORT_BACK") == 1


def test_a_port_that_goes_again_before_a_clear_is_told_to_be_back_again() -> None:
    arm = holding()
    for times in (1, 2):
        arm.port_open = False
        arm.run_ticks(3)
        assert not arm.state.connected
        arm.port_open = True
        arm.run_tick(Connected())
        assert arm.events.count("PORT_BACK") == times


def test_a_strain_is_told_while_servos_behind_a_new_port_are_still_asked_who_they_are() -> None:
    arm = holding()
    arm.port_open = False
    arm.run_tick()
    arm.port_open = True
    arm.put(3, ax12a.PRESENT_LOAD, 1023)
    arm.run_ticks(22)
    assert [fault.code for fault in arm.state.faults] == ["PORT_GONE", "OVERLOAD"]


@pytest.mark.parametrize(
    ("register", "value", "code"),
    [
        (ax12a.TORQUE_ENABLE, 0, "LOST_TORQUE"),
        (ax12a.TORQUE_LIMIT, 0, "TRIPPED"),
        (ax12a.GOAL, 300, "OTHER_WRITER"),
        (ax12a.CW_SLOPE, 128, "OTHER_WRITER"),
        (ax12a.PUNCH, 100, "OTHER_WRITER"),
        (ax12a.TORQUE_LIMIT, 700, "OTHER_WRITER"),
        # A servo that has restarted, and that a goal has energised again before it was read.
        (ax12a.TORQUE_LIMIT, 1023, "LOST_TORQUE"),
    ],
)
def test_what_a_servo_reports_against_us_latches_in_one_tick(register: ax12a.Register, value: int, code: str) -> None:
    soft = load_arm("ax12-line")
    halved = tuple(joint.model_copy(update={"torque_limit_ratio": 0.5}) for joint in soft.joints)
    arm = IdealArm(soft.model_copy(update={"joints": halved})).connect()
    arm.run_tick()
    arm.run_ticks(21, TorqueOn(1))
    assert arm.mode() is Mode.HOLDING
    held = arm.state.goal
    arm.put(3, register, value)
    goal = arm.run_tick().goal
    assert (goal and goal.ticks) == (held if register is ax12a.GOAL else None), "taken back at once"
    assert arm.fault() == (code, 4)


def test_a_refused_clear_names_every_cause_and_what_to_do() -> None:
    arm = holding()
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.run_tick()
    arm.put(1, ax12a.PRESENT_TEMPERATURE, 70)
    arm.put(2, ax12a.PRESENT_VOLTAGE, 70)
    arm.run_ticks(2)
    arm.run_tick(Clear(1))
    for text in ("shoulder above 65 degC", "7.0 V", "wrist limp while others hold", "armctl release"):
        assert text in arm.replies[1].message


def test_a_limp_servo_among_powered_ones_must_be_released_before_clearing() -> None:
    arm = holding()
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.run_tick()
    assert "armctl release" in arm.ask(Clear(1)).message
    arm.run_tick(Release(2))
    assert arm.mode() is Mode.FAULTED
    arm.run_tick(Clear(3))
    assert arm.mode() is Mode.OFF
    arm.run_ticks(13, TorqueOn(4))
    assert arm.replies[4].ok


def test_a_blocked_joint_latches_and_its_goal_becomes_its_position_once() -> None:
    arm = holding()
    arm.stuck = {0}
    arm.run_ticks(13, Run(5, line(arm, delta_rad=0.8)))
    assert arm.code() == "BLOCKED"
    assert arm.goals[-1][0] == arm.get(0, ax12a.PRESENT_POSITION)
    assert not arm.goals_in(5)
    assert arm.ask(Clear(7)).ok


def test_a_joint_that_a_sagging_supply_holds_up_is_told_with_its_cause() -> None:
    arm = holding()
    arm.stuck = {0}
    arm.run_tick(Run(5, line(arm, delta_rad=0.8)))
    while not arm.state.faults:
        if arm.state.error_since_ns[0]:
            arm.put(0, ax12a.PRESENT_VOLTAGE, 70)  # less than half a second ago
        arm.run_tick()
    found = [(fault.code, fault.servo_id, fault.follows) for fault in arm.state.faults]
    assert found == [("VOLTAGE", 1, ""), ("BLOCKED", 1, "VOLTAGE")]


def test_damaged_replies_above_a_tenth_latch_and_below_do_not() -> None:
    arm = holding()
    latched = []
    for joints in ({0}, {0, 1, 2}):
        for tick in range(100):
            arm.noisy = joints if tick % 2 else set()
            arm.run_tick()
        latched.append(arm.state.fault and arm.state.fault.code)
    assert latched == [None, "BUS_NOISE"]


def test_noise_that_was_cleared_is_not_told_of_once_more() -> None:
    arm = holding()
    for tick in range(60):
        arm.noisy = {0, 1, 2} if tick % 2 else set()
        arm.run_tick()
    assert arm.code() == "BUS_NOISE"
    arm.noisy = set()
    assert arm.ask(Clear(7)).ok
    arm.run_ticks(50)
    assert arm.code() == ""


def test_problems_found_at_connection_forbid_torque_until_they_are_gone() -> None:
    arm = IdealArm()
    problem = Problem("WRONG_MODEL", "servo 2 (shoulder): model 29, not an AX-12A", 2)
    arm.run_tick(Connected((problem,)))
    assert arm.code() == "WRONG_MODEL"
    assert not arm.ask(TorqueOn(1)).ok
    arm.run_tick(Connected((problem,)), Clear(2))
    assert "model 29" in arm.replies[2].message
    arm.run_tick(Connected(), Clear(3))
    assert arm.mode() is Mode.OFF


def test_clear_without_a_fault_says_so() -> None:
    arm = holding()
    assert "no fault" in arm.ask(Clear(1)).message


def test_an_unheard_servo_has_an_age_that_grows_and_no_tool_pose() -> None:
    arm = IdealArm(silent={1})
    first = arm.run_tick()
    second = arm.run_tick()
    assert first.tool is None
    assert not first.joints[1].known
    assert second.joints[1].age_s > first.joints[1].age_s


# What a servo shows of each fault, lasting; and whether only an arm under torque can have it.
SHOWN: dict[str, tuple[Callable[[IdealArm], object], bool]] = {
    "SERVO_SILENT": (lambda arm: arm.silent.add(1), False),
    "TRIPPED": (lambda arm: arm.put(0, ax12a.TORQUE_LIMIT, 0), True),
    "LOST_TORQUE": (lambda arm: arm.put(2, ax12a.TORQUE_ENABLE, 0), True),
    "HOT": (lambda arm: arm.put(2, ax12a.PRESENT_TEMPERATURE, 70), False),
    "VOLTAGE": (lambda arm: arm.put(3, ax12a.PRESENT_VOLTAGE, 80), False),
    "OVERLOAD": (lambda arm: arm.put(3, ax12a.PRESENT_LOAD, 900), False),
    "OTHER_WRITER": (lambda arm: arm.put(4, ax12a.PUNCH, 100), True),
}
SITUATIONS: dict[str, Callable[[], IdealArm]] = {
    "off": lambda: IdealArm().connect(),
    "holding": holding,
    "moving": lambda: running(3),
    "teaching": lambda: taught(),
    "parking": lambda: parking(),
}


def taught() -> IdealArm:
    arm = holding()
    arm.run_ticks(4, Teach(6))
    return arm


def parking() -> IdealArm:
    arm = running(25)
    arm.run_ticks(4, Park(6))
    return arm


@pytest.mark.no_cover
@given(st.sampled_from(sorted(SITUATIONS)), st.permutations(sorted(SHOWN)), st.lists(st.integers(0, 12), min_size=2))
@settings(max_examples=40)
def test_no_fault_hides_another_in_any_mode_and_in_any_order(situation: str, codes: list[str], gaps: list[int]) -> None:
    arm = SITUATIONS[situation]()
    arm.arm = arm.arm.model_copy(update={"rest_on_strain": False})
    happened = set()
    for code, gap in zip(codes, gaps, strict=False):
        show, powered = SHOWN[code]
        if not powered or situation in ("holding", "moving", "parking"):
            show(arm)
            happened.add(code)
            arm.run_ticks(gap)
    arm.run_ticks(100)
    assert {fault.code for fault in arm.state.faults} - {"CONTACT"} == happened, "a load that lasts is a push as well"
    order = [CODES.index(fault.code) for fault in arm.state.faults]
    assert order == sorted(order), "the worst first"
    assert arm.outputs is not None
    assert arm.outputs.faults == arm.state.faults


def test_another_writer_does_not_hide_heat_which_sends_the_arm_to_rest_once_that_has_ended() -> None:
    arm = running(5)
    arm.put(3, ax12a.PUNCH, 100)
    arm.put(2, ax12a.PRESENT_TEMPERATURE, 66)
    arm.run_ticks(60)
    assert [fault.code for fault in arm.state.faults] == ["HOT", "OTHER_WRITER"]
    assert not arm.goals_in(20)
    arm.put(3, ax12a.PUNCH, arm.arm.joints[3].compliance.punch)
    arm.run_ticks(150)
    assert [arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)] == [0] * 6


def test_a_fault_that_another_one_explains_says_so() -> None:
    arm = holding()
    arm.silent = set(range(6))
    arm.run_ticks(8)
    arm.silent = set()
    for i in (1, 2):
        arm.put(i, ax12a.TORQUE_ENABLE, 0)  # the supply was off
    arm.put(3, ax12a.PRESENT_TEMPERATURE, 70)
    arm.put(3, ax12a.TORQUE_LIMIT, 0)
    arm.run_ticks(25)
    found = [(fault.code, fault.servo_id, fault.follows) for fault in arm.state.faults]
    assert found == [
        ("BUS_DEAD", None, ""),
        ("LOST_TORQUE", 2, "BUS_DEAD"),
        ("LOST_TORQUE", 3, "BUS_DEAD"),
        ("TRIPPED", 4, "HOT"),
        ("HOT", 4, ""),
    ]
