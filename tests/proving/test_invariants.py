"""Every checker of the invariants: a stream that violates it is caught, one that does not is left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.messages import Mode
from armctl.sim.faults import Fault
from proving.duties import Sent, Servo
from proving.invariants import Judge

ARM = load_arm("ax12-line")
PERIOD_S = 0.1
N = len(ARM.joints)
MIDDLE = 500


class Bench:
    """Servos that hold what is written to them, at the middle of their range, before a judge."""

    def __init__(self, torque: bool = True) -> None:
        self.judge = Judge(ARM, PERIOD_S, [joint.limits_tick for joint in ARM.joints])
        self.servos = [Servo(torque, MIDDLE, 100, 1023 if torque else 128, float(MIDDLE), MIDDLE) for _ in range(N)]
        self.now_s = 1.0
        self.judge.back()
        self.judge.asked(0.0, "clear")
        self.judge.reported(0.0, Mode.HOLDING if torque else Mode.OFF, "")
        self.tick()

    def hear(self) -> None:
        for index, servo in enumerate(self.servos):
            self.judge.heard(self.now_s, index, servo.sensed_tick, servo.goal if servo.torque else None)

    def tick(self, mode: Mode | None = None, code: str = "", *, heard: bool = True) -> None:
        """The end of a tick, a period later."""
        self.now_s += PERIOD_S
        if heard:
            self.hear()
        self.judge.ticked(self.now_s, self.servos)
        if mode is not None:
            self.judge.reported(self.now_s, mode, code)

    def write(self, index: int, register: ax12a.Register, value: int, **after: float | bool) -> None:
        """One write, and what the servo holds then."""
        before = [replace(servo) for servo in self.servos]
        for name, held in after.items():
            setattr(self.servos[index], name, held)
        data = value.to_bytes(register.size, "little")
        self.judge.wrote(self.now_s, [Sent(index, register.address, data)], before, self.servos)

    def goal(self, ticks: int, index: int = 0, **after: float | bool) -> None:
        self.write(index, ax12a.GOAL, ticks, goal=ticks, **after)

    def move(self, ticks: int, *, follow: bool = True, mode: Mode = Mode.MOVING, code: str = "") -> None:
        """A tick of a motion of joint 0, whose shaft is there at its end."""
        self.goal(self.servos[0].goal + ticks)
        if follow:
            self.at(self.servos[0].goal)
        self.tick(mode, code)

    def at(self, ticks: float, index: int = 0) -> None:
        self.servos[index].shaft_tick, self.servos[index].sensed_tick = ticks, round(ticks)

    @property
    def broken(self) -> set[str]:
        return {violation.invariant for violation in self.judge.violations}


def running() -> Bench:
    bench = Bench()
    bench.judge.asked(bench.now_s, "run")
    bench.tick(Mode.MOVING)
    return bench


def test_a_motion_a_stop_and_a_torque_on_as_they_should_be_break_nothing() -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    before = [replace(servo) for servo in bench.servos]
    for servo in bench.servos:
        servo.torque = True
    goal = MIDDLE.to_bytes(2, "little") + (16).to_bytes(2, "little")
    sent = [Sent(index, ax12a.GOAL.address, goal) for index in range(N)]
    bench.judge.wrote(bench.now_s, sent, before, bench.servos)
    for _ in range(7):
        bench.tick(Mode.ENERGISING)
    bench.tick(Mode.HOLDING)
    bench.judge.asked(bench.now_s, "run")
    for _ in range(10):
        bench.move(15)
    bench.judge.asked(bench.now_s, "hold")
    bench.move(12)
    bench.move(5)
    for _ in range(20):
        bench.tick(Mode.HOLDING)
    assert bench.judge.violations == []


@pytest.mark.parametrize("ticks", [-1, 1])
def test_1_a_goal_outside_the_limits_of_its_joint(ticks: int) -> None:
    bench = Bench()
    low, high = ARM.joints[1].limits_tick
    bench.goal(high + 1 if ticks > 0 else low - 1, 1)
    assert "1" in bench.broken


@settings(deadline=None)
@given(step=st.integers(-100, 100))
def test_2_a_goal_step_is_bounded_by_speed_and_period(step: int) -> None:
    bench = running()
    bench.move(step)
    assert ("2" in bench.broken) == (abs(step) > 60.0 / 10.0 / 300.0 * 1023.0 + 1.0)


def test_2_a_servo_that_missed_a_goal_may_get_two_steps_at_once_and_not_more() -> None:
    bench = running()
    bench.goal(MIDDLE + 20)
    bench.servos[0].goal = MIDDLE  # it did not hear
    bench.tick()
    bench.goal(MIDDLE + 40)
    assert bench.broken == set()
    bench.servos[0].goal = MIDDLE
    bench.tick()
    bench.goal(MIDDLE + 60)
    assert bench.broken == {"2"}


def test_2_what_counts_is_where_the_servo_said_it_was_when_it_was_read() -> None:
    bench = running()
    bench.judge.plan(Fault(kind="frozen_sensor", servo_id=ARM.servo_ids[0], begin_s=bench.now_s, duration_s=0.1))
    bench.tick(Mode.MOVING)
    bench.at(MIDDLE + 90)  # it sees again, just after it was read
    bench.goal(MIDDLE - 10)
    assert bench.broken == set()


@pytest.mark.parametrize(("steps", "broken"), [(2, set()), (3, {"2"})])
def test_2_no_goal_goes_over_12_deg_ahead_even_of_a_joint_that_something_holds(steps: int, broken: set[str]) -> None:
    bench = running()
    bench.judge.plan(Fault(kind="blocked_joint", servo_id=ARM.servo_ids[0], begin_s=bench.now_s, duration_s=5.0))
    for _ in range(steps):
        bench.move(15, follow=False)
    assert bench.broken == broken
    bench.move(-15, follow=False)
    assert bench.broken == broken


@pytest.mark.parametrize(("asked", "broken"), [("clear", set()), ("pause", {"2"})])
def test_2_beside_a_clear_a_goal_may_go_on_from_the_one_sent_or_the_one_held(asked: str, broken: set[str]) -> None:
    for known in (MIDDLE, MIDDLE + 40):
        bench = running()
        bench.goal(MIDDLE)
        bench.tick(Mode.MOVING)
        bench.servos[0].goal = MIDDLE + 40  # another program's
        bench.at(MIDDLE + 20)
        bench.hear()
        bench.judge.asked(bench.now_s, asked)
        bench.goal(known + 10)
        assert bench.broken == (broken if known > MIDDLE else set())


def test_2_a_joint_over_12_deg_from_its_goal() -> None:
    bench = Bench()
    bench.at(MIDDLE - 42.0)
    bench.tick()
    assert bench.broken == {"2"}


def test_2_a_joint_that_something_holds_is_excused_and_its_neighbour_is_not() -> None:
    bench = Bench()
    bench.judge.plan(Fault(kind="blocked_joint", servo_id=1, begin_s=bench.now_s, duration_s=1.0))
    bench.at(MIDDLE - 42.0)
    bench.tick()
    assert bench.broken == set()
    bench.at(MIDDLE - 42.0, 1)
    bench.tick()
    assert bench.broken == {"2"}


@pytest.mark.parametrize(("goal", "broken"), [(MIDDLE - 200, set()), (MIDDLE - 199, {"2"})])
def test_2_a_goal_where_a_joint_that_something_moves_said_it_was_is_no_motion(goal: int, broken: set[str]) -> None:
    bench = Bench()
    bench.judge.plan(Fault(kind="frozen_sensor", servo_id=1, begin_s=bench.now_s, duration_s=0.05))
    bench.at(MIDDLE - 200.0)
    bench.hear()
    bench.at(MIDDLE - 207.0)  # it has turned round since
    bench.tick(heard=False)
    bench.judge.asked(bench.now_s, "hold")
    bench.goal(goal)
    assert bench.broken == broken


@pytest.mark.parametrize("speed", [0, 92])
def test_2_and_3_a_speed_of_none_or_too_much(speed: int) -> None:
    bench = Bench()
    bench.write(0, ax12a.MOVING_SPEED, speed)
    assert bench.broken == {"3" if speed == 0 else "2"}


def test_a_goal_at_the_servos_own_position_is_no_motion() -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, "hold")
    bench.at(MIDDLE - 25.0)
    for _ in range(8):
        bench.tick()
    bench.goal(MIDDLE - 24)
    assert bench.broken == set()


@pytest.mark.parametrize(
    ("held", "broken"),
    [
        ({"speed": 16}, set()),
        ({"speed": 0}, {"3"}),
        ({"speed": 16, "limit": 300}, {"3"}),
    ],
)
def test_3_torque_comes_on_softly_and_slowly(held: dict[str, int], broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    bench.goal(MIDDLE, torque=True, **held)
    assert bench.broken == broken


def test_3_torque_comes_on_with_a_goal_elsewhere() -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    bench.goal(MIDDLE + 4, torque=True)
    assert bench.broken == {"3"}


@pytest.mark.parametrize(
    ("servo", "own", "broken"), [(0, MIDDLE, set()), (1, MIDDLE, {"3"}), (None, MIDDLE, set()), (0, MIDDLE + 40, {"3"})]
)
def test_3_another_programs_goal_at_torque_on_is_not_this_ones(servo: int | None, own: int, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    one = None if servo is None else ARM.servo_ids[servo]
    bench.judge.plan(Fault(kind="second_writer", servo_id=one, begin_s=bench.now_s, duration_s=5.0))
    bench.goal(own)
    bench.tick()
    bench.servos[0].goal = MIDDLE + 40
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    assert bench.broken & {"3"} == broken


@pytest.mark.parametrize(("goal", "broken"), [(MIDDLE + 9, {"3"}), (MIDDLE - 9, set())])
def test_3_a_joint_that_turns_to_its_goal_at_torque_on_jumps_and_one_that_turns_from_it_sags(
    goal: int, broken: set[str]
) -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    bench.goal(MIDDLE, torque=True)
    bench.servos[0].goal = goal
    bench.at(MIDDLE + 8.0)
    bench.tick()
    assert bench.broken == broken


def test_4_torque_comes_on_and_nobody_asked() -> None:
    bench = Bench(torque=False)
    bench.goal(MIDDLE, torque=True)
    assert bench.broken == {"4"}


def test_4_a_fault_voids_what_was_asked_before_it() -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    bench.tick(Mode.FAULTED, "SERVO_SILENT")
    bench.goal(MIDDLE, torque=True)
    assert bench.broken == {"4"}


@pytest.mark.parametrize(("asked", "broken"), [("release", set()), ("teach", set()), ("park", {"5"}), ("hold", {"5"})])
def test_5_torque_goes_off_on_request_alone(asked: str, broken: set[str]) -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, asked)
    bench.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert bench.broken == broken


@pytest.mark.parametrize(("unheard", "broken"), [(12, set()), (0, {"5"})])
def test_5_a_torque_on_that_waits_for_its_servos_may_be_undone_later(unheard: int, broken: set[str]) -> None:
    bench = Bench(torque=False)
    bench.judge.asked(bench.now_s, "torque_on")
    bench.goal(MIDDLE, torque=True)
    for k in range(25):
        lost = [(3, 2)] if k < unheard else []
        bench.judge.polled(bench.now_s, lost, N - len(lost), N + len(lost))
        bench.tick(Mode.ENERGISING)
    bench.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert bench.broken == broken


@pytest.mark.parametrize(("away", "broken"), [(0, set()), (11, set()), (14, {"5"})])
def test_5_torque_goes_off_at_the_rest_pose_that_was_asked_for(away: int, broken: set[str]) -> None:
    bench = Bench()
    for index, joint in enumerate(ARM.joints):
        bench.at(joint.tick(joint.rest_rad), index)
        bench.servos[index].goal = bench.servos[index].sensed_tick
    bench.servos[0].sensed_tick += away
    bench.judge.asked(bench.now_s, "park")
    bench.judge.reported(bench.now_s, Mode.PARKING, "")
    bench.write(0, ax12a.TORQUE_ENABLE, 0, torque=False)
    assert bench.broken == broken


def test_5_the_way_to_rest_is_slow() -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, "park")
    for _ in range(6):
        bench.move(7, mode=Mode.PARKING)
    assert bench.broken == set()
    bench.move(9, mode=Mode.PARKING)
    assert bench.broken == {"5"}


def advancing(bench: Bench, **of_move: object) -> float | None:
    """Seconds until advancing goals become a violation, at most 2."""
    begin_s = bench.now_s
    for _ in range(20):
        bench.move(5, **of_move)  # type: ignore[arg-type]  # of move
        if bench.broken & {"6", "7"}:
            return bench.now_s - begin_s
    return None


@pytest.mark.parametrize(
    ("kind", "bound_s"), [("mute", 0.2), ("dead_bus", 0.2), ("unplug", 0.1), ("trip", 0.1), ("brown_out", 0.2)]
)
def test_6_goals_that_advance_on_after_a_fault(kind: str, bound_s: float) -> None:
    bench = running()
    one = None if kind in ("dead_bus", "unplug") else 3
    bench.judge.plan(Fault(kind=kind, servo_id=one, begin_s=bench.now_s, duration_s=1.5))
    late_s = advancing(bench)
    assert late_s is not None
    assert bound_s + 0.3 < late_s <= bound_s + 0.51


@pytest.mark.parametrize(("late_s", "broken"), [(0.7, set()), (0.0, {"6"})])
def test_6_a_silence_that_ends_while_the_program_is_late_is_a_short_one(late_s: float, broken: set[str]) -> None:
    bench = running()
    bench.judge.plan(Fault(kind="mute", servo_id=3, begin_s=bench.now_s, duration_s=0.93))
    for _ in range(3):
        bench.tick(Mode.MOVING)
    for _ in range(1 if late_s else 8):
        bench.now_s += late_s
        bench.tick(Mode.HOLDING)
    bench.judge.asked(bench.now_s, "run")
    bench.tick(Mode.MOVING)
    advancing(bench)
    assert bench.broken & {"6", "rows"} == (broken | {"rows"} if broken else broken)


@pytest.mark.parametrize(
    ("silent", "kind", "broken"), [(1, "mute", set()), (2, "mute", {"rows"}), (None, "dead_bus", set())]
)
def test_what_began_while_nobody_could_hear_it_is_reported_afterwards(
    silent: int | None, kind: str, broken: set[str]
) -> None:
    bench = running()
    one = None if silent is None else ARM.servo_ids[silent]
    bench.judge.plan(Fault(kind=kind, servo_id=one, begin_s=bench.now_s, duration_s=0.45))
    bench.tick(Mode.MOVING, heard=False)
    hot = Fault(kind="hot", servo_id=ARM.servo_ids[1], begin_s=bench.now_s, duration_s=2.0, value=68.9)
    bench.judge.plan(hot)
    for _ in range(6):
        bench.tick(Mode.MOVING)
    bench.tick(Mode.FAULTED, "HOT")
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(("later_s", "broken"), [(0.0, set()), (0.04, set()), (0.16, {"rows"})])
@pytest.mark.parametrize("planned_first", [True, False])
def test_what_was_silent_before_anybody_heard_it_is_reported_afterwards(
    planned_first: bool, later_s: float, broken: set[str]
) -> None:
    bench = running()
    both = [
        Fault(kind="trip", servo_id=1, begin_s=bench.now_s, duration_s=0.2),
        Fault(kind="dead_bus", begin_s=bench.now_s + later_s, duration_s=0.75),
    ]
    for fault in both if planned_first else both[::-1]:
        bench.judge.plan(fault)
    for _ in range(9):
        bench.tick(Mode.HOLDING, heard=False)
    bench.tick(Mode.FAULTED, "TRIPPED")
    assert bench.broken & {"rows"} == broken


@pytest.mark.parametrize(("late_s", "broken"), [(1.3, set()), (0.0, {"7"})])
def test_7_what_a_frozen_sensor_moves_may_come_back_after_a_late_tick(late_s: float, broken: set[str]) -> None:
    bench = running()
    bench.judge.plan(Fault(kind="frozen_sensor", servo_id=1, begin_s=bench.now_s, duration_s=1.0))
    bench.tick(Mode.FAULTED, "BLOCKED")
    bench.at(MIDDLE + 100.0)
    for _ in range(8):
        bench.tick(Mode.FAULTED, "BLOCKED")
    bench.now_s += late_s
    bench.at(MIDDLE + 10.0)
    for _ in range(1 if late_s else 13):
        bench.tick(Mode.FAULTED, "BLOCKED")
    bench.at(MIDDLE + 5.0)
    bench.tick(Mode.FAULTED, "BLOCKED")
    assert bench.broken == broken


@pytest.mark.parametrize(("falls", "broken"), [(True, set()), (False, {"6"})])
def test_6_a_joint_may_be_moved_by_a_limp_one_that_falls(falls: bool, broken: set[str]) -> None:
    bench = running()
    bench.judge.asked(bench.now_s, "hold")
    bench.at(MIDDLE + 8)
    for _ in range(12):
        bench.tick(Mode.HOLDING)
    bench.servos[1].torque = False
    bench.tick(Mode.HOLDING)
    bench.at(MIDDLE + 4)
    bench.at(MIDDLE - (40 if falls else 1), 1)
    bench.tick(Mode.HOLDING)
    assert bench.broken == broken


def test_6_a_short_silence_obliges_only_while_it_lasts() -> None:
    bench = running()
    bench.judge.plan(Fault(kind="mute", servo_id=3, begin_s=bench.now_s, duration_s=0.45))
    for _ in range(5):
        bench.tick(Mode.MOVING)
    assert advancing(bench) is None


@pytest.mark.parametrize(("duration_s", "broken"), [(0.15, set()), (0.6, {"6"})])
def test_6_an_arm_on_its_way_to_rest_may_go_on_after_a_short_unplug_alone(duration_s: float, broken: set[str]) -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, "run")
    bench.tick(Mode.FAULTED, "OVERLOAD")
    bench.judge.plan(Fault(kind="unplug", begin_s=bench.now_s + 0.02, duration_s=duration_s))
    for _ in range(3):
        bench.tick(Mode.FAULTED, "OVERLOAD")
    bench.hear()
    advancing(bench, mode=Mode.FAULTED, code="OVERLOAD")
    assert bench.broken & {"6", "rows"} == broken


@pytest.mark.parametrize("word", ["hold", "pause", "host_lost"])
def test_6_goals_that_advance_on_after_a_stop(word: str) -> None:
    bench = running()
    bench.judge.asked(bench.now_s, word)
    late_s = advancing(bench)
    assert late_s is not None
    assert late_s < 0.7


def test_6_a_resumed_run_may_advance() -> None:
    bench = running()
    bench.judge.asked(bench.now_s, "pause")
    bench.judge.asked(bench.now_s + 0.2, "resume")
    assert advancing(bench) is None


def test_6_a_late_tick_stops_the_motion() -> None:
    bench = running()
    bench.now_s += 0.5
    bench.tick(Mode.MOVING)
    assert advancing(bench) is not None


def test_6_a_jog_without_heartbeats() -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, "jog")
    assert advancing(bench, mode=Mode.JOGGING) is not None


def test_6_an_arm_that_is_not_still_in_time() -> None:
    bench = Bench()
    bench.judge.asked(bench.now_s, "hold")
    bench.servos[0].goal = MIDDLE + 39
    for k in range(10):
        bench.at(MIDDLE + 3.5 * k)
        bench.tick()
    assert bench.broken == {"6"}


def test_6_a_program_that_adopts_writes_no_goal() -> None:
    bench = Bench()
    bench.judge.died(bench.now_s, bench.servos)
    bench.tick()
    bench.judge.back()
    bench.goal(MIDDLE)
    assert bench.broken == {"6"}


def test_7_a_goal_that_advances_while_a_fault_is_latched() -> None:
    bench = running()
    late_s = advancing(bench, mode=Mode.FAULTED, code="OTHER_WRITER")
    assert late_s is not None
    assert "7" in bench.broken
    assert late_s < 0.7


@pytest.mark.parametrize(("code", "broken"), [("", set()), ("OTHER_WRITER", {"7"})])
def test_7_a_motion_asked_for_together_with_a_clear_needs_the_clear_to_be_granted(code: str, broken: set[str]) -> None:
    bench = running()
    for _ in range(5):
        bench.tick(Mode.FAULTED, "OTHER_WRITER")
    bench.judge.asked(bench.now_s, "clear")
    bench.judge.asked(bench.now_s, "park")
    bench.goal(MIDDLE + 5)
    bench.tick(Mode.FAULTED if code else Mode.PARKING, code)
    assert bench.broken == broken


@pytest.mark.parametrize(("asked", "broken"), [(("clear", "run"), set()), (("clear",), {"6"})])
def test_6_a_motion_asked_for_together_with_a_clear_ends_an_older_hold(
    asked: tuple[str, ...], broken: set[str]
) -> None:
    bench = running()
    bench.judge.asked(bench.now_s, "hold")
    for _ in range(8):
        bench.tick(Mode.HOLDING)
    for _ in range(8):
        bench.tick(Mode.FAULTED, "PORT_GONE")
    for kind in asked:
        bench.judge.asked(bench.now_s, kind)
    bench.goal(MIDDLE + 5)
    bench.tick(Mode.MOVING)
    bench.move(5)
    assert bench.broken == broken


def test_7_heat_may_send_the_arm_to_rest_and_nowhere_else() -> None:
    bench = Bench()
    bench.servos[0].goal = 400  # the base rests at 512
    bench.at(400.0)
    bench.tick(Mode.FAULTED, "HOT")
    assert advancing(bench, mode=Mode.FAULTED, code="HOT") is None
    bench.move(-5, mode=Mode.FAULTED, code="HOT")
    assert bench.broken == {"7"}


def test_7_a_fault_that_is_cleared_though_its_cause_lasts() -> None:
    bench = Bench()
    bench.tick(Mode.FAULTED, "SERVO_SILENT")
    bench.judge.reported(bench.now_s, Mode.HOLDING, "", "mute is in force")
    assert bench.broken == {"7"}


@pytest.mark.parametrize(("ticks", "broken"), [(2, set()), (3, {"8"})])
def test_8_a_goal_computed_from_an_old_reading(ticks: int, broken: set[str]) -> None:
    bench = running()
    for _ in range(ticks):
        bench.tick(heard=False)
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
    bench.judge.asked(bench.now_s, "torque_on")
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
    bench.judge.plan(Fault(kind=kind, servo_id=one, begin_s=bench.now_s, duration_s=3.0, value=value))
    bench.tick(Mode.MOVING)
    said = {"well": (Mode.FAULTED, code), "wrongly": (Mode.FAULTED, "OVERLOAD"), "not at all": (Mode.MOVING, "")}[told]
    for _ in range(10):
        bench.tick(*said)
    assert bench.broken == (set() if told == "well" else {"rows"})


@pytest.mark.parametrize(("told", "broken"), [(True, set()), (False, {"6", "rows"})])
@pytest.mark.parametrize("duration_s", [0.01, 0.15, 1.0])
def test_every_unplug_however_short_stops_the_arm_and_is_reported(
    duration_s: float, told: bool, broken: set[str]
) -> None:
    bench = running()
    bench.judge.plan(Fault(kind="unplug", begin_s=bench.now_s + 0.02, duration_s=duration_s))
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
    for _ in range(12):
        bench.tick(Mode.HOLDING)
    assert bench.broken == {"rows"}


def test_a_joint_far_from_its_goal_counts_from_when_a_program_watches() -> None:
    bench = Bench()
    bench.at(MIDDLE - 32.0)
    bench.judge.died(bench.now_s, bench.servos)
    for _ in range(10):
        bench.tick()
    bench.judge.back()
    for _ in range(6):
        bench.tick(Mode.HOLDING)
    bench.tick(Mode.FAULTED, "BLOCKED")
    assert bench.broken == set()


@pytest.mark.parametrize(("mode", "broken"), [(Mode.OFF, set()), (Mode.HOLDING, {"6"})])
def test_6_an_arm_that_lost_torque_and_was_let_go_before_anybody_had_to_latch_may_run_again(
    mode: Mode, broken: set[str]
) -> None:
    bench = Bench()
    bench.judge.plan(Fault(kind="trip", servo_id=1, begin_s=bench.now_s, duration_s=0.1))
    bench.servos[0].torque, bench.servos[0].limit = False, 0
    bench.tick(Mode.HOLDING)
    bench.judge.asked(bench.now_s, "release")
    bench.tick(mode)
    bench.servos[0].torque, bench.servos[0].limit = True, 1023  # later
    bench.judge.asked(bench.now_s, "torque_on")
    for _ in range(20):
        bench.tick(Mode.HOLDING)
    bench.judge.asked(bench.now_s, "run")
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
    for kind in asked:
        bench.judge.asked(bench.now_s, kind)
    bench.write(0, ax12a.TORQUE_ENABLE, 1, torque=True)
    bench.tick(Mode.FAULTED if code else Mode.ENERGISING, code)
    assert bench.broken == broken


@pytest.mark.parametrize(("code", "broken"), [("HOT", set()), ("", {"6"}), ("BLOCKED", {"6"})])
def test_6_after_a_hold_only_a_fault_that_sends_the_arm_to_rest_moves_it(code: str, broken: set[str]) -> None:
    bench = running()
    bench.judge.asked(bench.now_s, "hold")
    for _ in range(8):
        bench.tick(Mode.HOLDING)
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
    bench.judge.plan(Fault(kind="second_writer", servo_id=1, begin_s=bench.now_s, duration_s=3.0))
    for _ in range(8):
        bench.servos[0].goal = MIDDLE + 20
        if read_back:
            bench.hear()
        bench.goal(MIDDLE)  # overwritten at once
        bench.tick(*((Mode.FAULTED, "OTHER_WRITER") if told else (Mode.HOLDING, "")))
    assert bench.broken == (set() if told or not read_back else {"rows"})
