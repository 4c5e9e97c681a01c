"""Torque off is sent until every servo is seen limp; whoever asked hears what is so."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.messages import Clear, Command, Mode, Park, Release, Teach, TeachEnd
from tests.control.damaged_arm import Rig, writes
from tests.control.ideal_arm import IdealArm, energising, holding

TICKS = st.frozensets(st.integers(0, 9))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 5), TICKS, st.booleans(), st.sampled_from([Release, Teach]))
def test_whichever_replies_and_writes_are_lost_the_arm_ends_limp_and_the_answer_says_what_is(
    servo: int, lost: frozenset[int], hears: bool, kind: Callable[[int], Command]
) -> None:
    rig = Rig().holding()
    rig.records.clear()
    for tick in range(20):
        if tick in lost:
            rig.fault("lost" if hears else "mute", servo + 1, duration_s=0.099)
        rig.ticks(1, *([kind(5)] if tick == 0 else []))
        if rig.mode() in (Mode.OFF, Mode.TEACHING) and not rig.loop.state.letting_go:
            assert rig.stiff() == [], f"limp is what is shown in tick {tick}"
        if 5 in rig.replies():
            reply = rig.replies().pop(5)
            assert reply.ok or f"servo {servo + 1}" in reply.message
            assert not (reply.ok and rig.stiff())
    assert rig.stiff() == []
    assert rig.loop.state.letting_go is None
    assert 5 in rig.replies()


def test_a_dropout_of_150_ms_does_not_leave_a_servo_stiff_in_an_arm_that_is_off() -> None:
    rig = Rig().holding()
    rig.fault("mute", 2, duration_s=0.25)
    rig.ticks(8, Release(5))
    assert (rig.mode(), rig.stiff(), rig.replies()[5].ok) == (Mode.OFF, [], True)


@pytest.mark.parametrize(("silent_s", "stiff"), [(0.25, []), (2.0, [2])])
def test_a_program_that_leaves_answers_release_first(silent_s: float, stiff: list[int]) -> None:
    rig = Rig().holding()
    rig.fault("mute", 2, duration_s=silent_s)
    rig.ticks(1, Release(5))
    rig.loop.run(lambda: (), lambda record: not rig.on_tick(record), lambda: True)
    assert (rig.stiff(), rig.replies()[5].ok) == (stiff, not stiff)


def test_release_names_a_servo_that_stays_stiff_and_goes_on_telling_it() -> None:
    rig = Rig().holding()
    rig.port.damages = lambda packet: writes(packet, ax12a.TORQUE_ENABLE, 2)
    rig.ticks(7, Release(5))
    assert rig.replies()[5].code == "NOT_LIMP"
    assert "servo 2 (shoulder)" in rig.replies()[5].message
    assert (rig.code(), rig.stiff()) == ("NOT_LIMP", [2])
    assert "still going off (shoulder)" in _refusal(rig, Clear(6))
    rig.port.damages = lambda _packet: False
    rig.ticks(3)
    assert rig.stiff() == []
    rig.ticks(1, Clear(7))
    assert (rig.replies()[7].ok, rig.mode()) == (True, Mode.OFF)


def test_who_asks_again_and_again_hears_of_a_servo_that_stays_stiff_as_soon() -> None:
    rig = Rig().holding()
    rig.fault("mute", 2, duration_s=5.0)
    for request_id in range(5, 9):
        rig.ticks(3, Release(request_id))
    assert [rig.replies()[request_id].code for request_id in (5, 6)] == ["NOT_LIMP"] * 2
    rig.ticks(6)
    assert {rig.replies()[request_id].code for request_id in range(5, 9)} == {"NOT_LIMP"}


def _refusal(rig: Rig, command: Clear) -> str:
    rig.ticks(1, command)
    reply = rig.replies()[command.request_id]
    assert not reply.ok
    return reply.message


def test_release_of_a_latched_arm_keeps_the_fault_and_is_as_thorough() -> None:
    rig = Rig().holding()
    rig.fault("trip", 4)
    rig.ticks(3)
    rig.fault("mute", 2, duration_s=0.35)
    rig.ticks(2, Release(5))
    assert (rig.code(), rig.stiff(), 5 in rig.replies()) == ("TRIPPED", [2], False)
    rig.ticks(5)
    assert (rig.code(), rig.mode(), rig.stiff(), rig.replies()[5].ok) == ("TRIPPED", Mode.FAULTED, [], True)


@pytest.mark.parametrize("code", ["SERVO_SILENT", "PORT_GONE"])
def test_a_fault_while_torque_goes_off_does_not_end_it(code: str) -> None:
    rig = Rig().holding()
    if code == "PORT_GONE":
        rig.ticks(1)
        rig.fault("unplug", begin_s=0.05, duration_s=0.4)
    else:
        rig.fault("mute", 2, duration_s=1.0)
    rig.ticks(8, Release(5))
    assert (rig.replies()[5].code, rig.code()) == ("NOT_LIMP", "SERVO_SILENT") or code == "PORT_GONE"
    rig.ticks(15)
    assert (rig.stiff(), rig.mode()) == ([], Mode.FAULTED if rig.code() else Mode.OFF)


def test_a_servo_that_is_not_there_is_told_for_half_a_second_and_again_when_it_is_heard() -> None:
    arm = holding()
    arm.silent = {3}
    told = []
    for tick in range(12):
        writes = arm.run_tick(*([Release(5)] if tick == 0 else [])).writes
        told.append([write.servo_id for write in writes if write.address == ax12a.TORQUE_ENABLE.address])
    assert told[1:5] == [[4]] * 4
    assert told[6:] == [[]] * 6
    assert "servo 4 (wrist): not heard since" in arm.replies[5].message
    arm.silent = set()
    arm.run_ticks(2)
    assert (arm.get(3, ax12a.TORQUE_ENABLE), arm.state.letting_go) == (0, None)


def test_a_limp_arm_is_judged_although_it_takes_long_to_identify() -> None:
    arm = IdealArm()
    arm.silent = {5}
    arm.run_ticks(3, Release(5))
    assert not arm.events.count("SERVO_SILENT"), "nobody knows yet whether it is there"
    arm.silent = set()
    arm.run_ticks(2)
    assert arm.mode() is Mode.OFF
    arm.silent = {3}
    arm.run_ticks(7)
    assert arm.fault() == ("SERVO_SILENT", 4)


def test_torque_that_another_program_gives_a_servo_seen_limp_is_not_cut() -> None:
    arm = holding()
    arm.silent = {3}
    arm.run_ticks(2, Release(5))
    arm.put(1, ax12a.TORQUE_ENABLE, 1)
    arm.run_ticks(1)
    assert (arm.get(1, ax12a.TORQUE_ENABLE), arm.fault()) == (1, ("NOT_LIMP", 2))
    arm.silent = set()
    arm.run_ticks(12)
    assert (arm.get(1, ax12a.TORQUE_ENABLE), arm.get(3, ax12a.TORQUE_ENABLE)) == (1, 0)


@pytest.mark.parametrize("command", [Release(5), Teach(5)])
def test_no_goal_goes_to_an_arm_that_is_being_let_go(command: Command) -> None:
    arm = holding()
    arm.after_write = lambda a: a.put(2, ax12a.TORQUE_ENABLE, 1)
    arm.run_tick(command)
    arm.put(1, ax12a.GOAL, 300)
    assert arm.goals_in(15) == []


def test_everybody_who_asked_for_a_release_is_answered_and_who_asked_to_teach_hears_of_it() -> None:
    arm = holding()
    arm.run_tick(Teach(3), Release(4), Release(5))
    assert (arm.replies[3].code, 4 in arm.replies) == ("RELEASED", False)
    arm.run_tick()
    assert arm.replies[4].ok
    assert arm.replies[5].ok
    assert arm.mode() is Mode.OFF


def test_teaching_that_ends_before_the_arm_is_limp_still_makes_it_limp() -> None:
    arm = holding()
    arm.silent = {2}
    arm.run_ticks(2, Teach(3))
    arm.run_tick(TeachEnd(4))
    assert (arm.replies[3].code, arm.mode()) == ("TEACH_ENDED", Mode.RELEASING)
    arm.silent = set()
    arm.run_ticks(3)
    assert (arm.mode(), arm.get(2, ax12a.TORQUE_ENABLE)) == (Mode.OFF, 0)


def test_a_parked_arm_is_answered_for_when_it_is_seen_limp() -> None:
    rig = Rig().holding()
    rig.port.damages = lambda packet: writes(packet, ax12a.TORQUE_ENABLE, 2)
    rig.ticks(1, Park(5))
    while rig.mode() is Mode.PARKING:
        rig.ticks(1)
    rig.ticks(2)
    assert (rig.mode(), 5 in rig.replies(), rig.stiff()) == (Mode.RELEASING, False, [2])
    rig.port.damages = lambda _packet: False
    rig.ticks(2)
    assert (rig.mode(), rig.replies()[5].ok, rig.stiff()) == (Mode.OFF, True, [])


def test_a_torque_on_that_is_refused_leaves_no_servo_stiff() -> None:
    arm = energising()
    arm.run_ticks(1)
    arm.put(0, ax12a.PRESENT_POSITION, 560)
    arm.silent = set()
    arm.after_write = lambda a: a.put(4, ax12a.TORQUE_ENABLE, int(a.tick < 9))
    arm.run_ticks(3)
    assert arm.replies[1].code == "JUMP_REFUSED"
    arm.run_ticks(6)
    assert not any(arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6))
    assert arm.mode() is Mode.OFF


def test_a_limp_servo_is_seen_by_ideal_arms_at_any_period() -> None:
    for period_s in (0.01, 0.1, 1.0):
        arm = IdealArm(period_s=period_s).power().connect()
        arm.run_tick(Release(1))
        arm.run_tick()
        assert (arm.replies[1].ok, arm.mode()) == (True, Mode.OFF)
