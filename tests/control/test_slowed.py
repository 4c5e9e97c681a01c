"""A motion that lost replies delay says so, once, with figures; one paused, slowed or stopped by will does not."""

import functools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.messages import Event, Hold, Pause, Resume, Run, SetRate
from tests.control.ideal_arm import IdealArm, holding, line

WAY_S = 6.0


def run_through(arm: IdealArm, lost: list[bool], rate: float = 1.0) -> tuple[list[tuple[int, Event]], int]:
    """The warnings of a run of 6 s with their ticks, and how many ticks it took; `lost` repeats itself."""
    told: list[tuple[int, Event]] = []
    commands: tuple[Run | SetRate, ...] = (Run(5, line(arm, delta_rad=-0.8, seconds=WAY_S)), SetRate(6, rate))
    for tick in range(1000):
        arm.silent = {2} if tick and lost[tick % len(lost)] else set()
        outputs = arm.run_tick(*(() if tick else commands))
        told += [(tick, event) for event in outputs.events if event.code == "SLOWED"]
        if 5 in arm.replies:
            return told, tick
    raise AssertionError("the run never ended")


@functools.cache
def free_ticks(rate: float) -> int:
    """How long the run takes where every reply comes."""
    return run_through(holding(), [False], rate)[1]


@given(st.lists(st.booleans(), min_size=2, max_size=12), st.sampled_from([0.5, 1.0]))
@settings(deadline=None, max_examples=40)
def test_a_motion_tells_once_that_lost_replies_make_it_a_fifth_longer_and_else_nothing(
    lost: list[bool], rate: float
) -> None:
    if all(lost[i] and lost[i - 1] for i in range(len(lost))) or sum(lost) > 2 * len(lost) / 3:
        lost = [*lost, False, False]
    told, ticks = run_through(holding(), lost, rate)
    late_s = (ticks - free_ticks(rate)) / 10.0
    if late_s > 0.2 * WAY_S / rate + 0.21:
        assert len(told) == 1
    elif late_s < 0.2 * WAY_S / rate - 0.01:
        assert told == []
    for tick, event in told:
        assert tick < ticks, "while it runs"
        assert event.severity == "warning"


def test_the_words_have_figures_and_the_cause() -> None:
    [(tick, event)], ticks = run_through(holding(), [True, False, False])
    assert ticks / 10.0 > 1.2 * WAY_S
    assert tick < ticks
    assert "replies were lost in " in event.text
    assert f"of {tick} ticks" in event.text
    assert "late by 1.3 s so far, of a motion of 6.0 s (bound 20%); check the bus cable" in event.text


def test_short_motions_are_not_told_of_for_less_than_half_a_second() -> None:
    arm = holding()
    arm.run_tick(Run(5, line(arm, seconds=1.0, delta_rad=-0.2)))
    arm.silent = {2}
    arm.run_ticks(3)
    arm.silent = set()
    arm.run_ticks(20)
    assert arm.replies[5].ok
    assert "SLOWED" not in arm.events


@pytest.mark.parametrize("stopped", [False, True])
def test_pauses_and_stops_are_no_slowness(stopped: bool) -> None:
    arm = holding()
    arm.run_ticks(5, Run(5, line(arm, seconds=3.0, delta_rad=-0.4)))
    for request_id in range(10, 20):
        arm.run_ticks(3, Pause(request_id))
        arm.silent = {1}
        arm.run_ticks(4)
        arm.silent = set()
        arm.run_ticks(4, Hold(99) if stopped else Resume(request_id + 100))
    arm.run_ticks(40)
    assert "SLOWED" not in arm.events
