"""Pause, resume and rate: the trajectory's own time slows down and goes on, and never runs faster than planned."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.messages import Command, Hold, Mode, Pause, Resume, Run, SetRate
from tests.control.ideal_arm import IdealArm, holding, line


def running(seconds: float = 4.0) -> IdealArm:
    arm = holding()
    arm.run_ticks(7, Run(5, line(arm, delta_rad=-0.8, seconds=seconds)))
    return arm


def test_a_pause_rests_on_the_path_until_it_is_resumed() -> None:
    arm = running()
    assert arm.ask(Pause(6)).ok
    arm.run_ticks(3)
    rest, sent = arm.goals[-1], len(arm.goals)
    outputs = arm.run_ticks(100)
    assert (arm.state.goal, arm.goals[sent:]) == (rest, [])
    assert (outputs.mode, outputs.rate) == (Mode.MOVING, 0.0)
    arm.run_ticks(41, Resume(7))
    assert (arm.replies[7].ok, arm.mode(), arm.replies[5].ok) == (True, Mode.HOLDING, True)


def test_a_paused_run_can_be_stopped() -> None:
    arm = running()
    arm.run_ticks(6, Pause(6))
    arm.run_ticks(3, Hold(7))
    assert (arm.replies[7].ok, arm.mode(), arm.replies[5].code) == (True, Mode.HOLDING, "STOPPED")


def test_at_half_rate_a_run_takes_twice_as_long() -> None:
    def ticks(rate: float) -> int:
        arm = running()
        begin = arm.tick
        arm.run_tick(SetRate(6, rate))
        while 5 not in arm.replies:
            arm.run_tick()
        assert arm.replies[5].ok
        return arm.tick - begin

    assert ticks(0.5) == pytest.approx(2 * ticks(1.0), abs=3)


@pytest.mark.parametrize("rate", [0.0, 0.05, 1.01, -1.0, float("nan")])
def test_a_rate_beyond_what_was_checked_is_refused(rate: float) -> None:
    arm = running()
    assert arm.ask(SetRate(6, rate)).code == "LIMIT"


@pytest.mark.parametrize("command", [Pause(6), Resume(6), SetRate(6, 0.5)])
def test_without_a_run_there_is_nothing_to_pause(command: Command) -> None:
    arm = holding()
    arm.run_tick(command)
    assert arm.replies[6].code == "ILLEGAL_TRANSITION"
    arm = running()
    arm.run_tick(Hold(7), command)
    assert arm.replies[6].code == "ILLEGAL_TRANSITION", "a run that is being stopped stays stopped"


CHANGES = st.sampled_from([Pause(6), Resume(7), SetRate(8, 0.3), SetRate(9, 1.0)])


@given(st.lists(st.tuples(CHANGES, st.integers(0, 5)), max_size=12))
@settings(max_examples=40)
def test_whatever_is_said_to_a_run_it_stays_on_its_path_within_its_speed(story: list[tuple[Command, int]]) -> None:
    arm = running(2.0)
    planned = max(abs(b[0] - a[0]) for a, b in pairwise(arm.goals))
    for command, ticks in story:
        arm.run_tick(command)
        arm.run_ticks(ticks)
    arm.run_tick(Resume(10))
    arm.run_ticks(41, SetRate(11, 1.0))
    assert arm.replies[5].ok
    base = [goal[0] for goal in arm.goals]
    assert base == sorted(base, reverse=True)
    assert max(abs(b - a) for a, b in pairwise(base)) <= planned + 1
    assert {goal[1:] for goal in arm.goals} == {arm.goals[-1][1:]}
