"""What holds of the control step whatever happens."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from armctl import messages
from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.messages import (
    Clear,
    Command,
    Hold,
    Inputs,
    Jog,
    Park,
    Release,
    Run,
    Sample,
    SetRate,
    Teach,
    TeachEnd,
    TorqueOn,
)
from tests.control.ideal_arm import PERIOD_S, IdealArm, energising, holding, line, running

REQUESTS = st.sampled_from([Park, Hold, Release, TorqueOn, Teach, TeachEnd, Clear, Run])


@given(st.lists(st.tuples(REQUESTS, st.integers(0, 6)), max_size=25))
@settings(max_examples=60)
def test_any_command_sequence_keeps_goals_inside_limits_and_answers_everyone(story: list[tuple[Any, int]]) -> None:
    arm = IdealArm().connect()
    for asked, (request, ticks) in enumerate(story, 1):
        trajectory = [line(arm, seconds=0.5, delta_rad=0.2)] if request is Run else []
        arm.run_ticks(ticks + 1, request(asked, *trajectory))
    arm.run_ticks(60)
    assert set(arm.replies) == set(range(1, len(story) + 1))
    assert arm.state.fault is None
    for goal in arm.goals:
        for tick, joint in zip(goal, arm.arm.joints, strict=True):
            assert joint.limits_tick[0] <= tick <= joint.limits_tick[1]
    for a, b in pairwise(arm.goals):
        assert max(abs(x - y) for x, y in zip(a, b, strict=True)) <= 60.0 * PERIOD_S / math.degrees(ax12a.TICK_RAD) + 1


def _readings(arm: IdealArm):  # type: ignore[no-untyped-def]
    return tuple(
        messages.ServoReading(i, bytes(b), arm.now_ns, True) for i, b in zip(arm.arm.servo_ids, arm.blocks, strict=True)
    )


REFUSED = {"ILLEGAL_TRANSITION", "NO_REPLY", "LIMIT", "START_MISMATCH", "NOT_CLEARED"}
# It begins where the arm is not.
UNFIT = messages.JointTrajectory(PERIOD_S, ((0.5,) * 6, (0.6,) * 6))


@given(
    st.sampled_from([holding, running, energising, lambda: IdealArm(), lambda: IdealArm().connect()]),
    st.sampled_from(["", "teach", "heat", "park", "jog"]),
    st.integers(0, 8),
    st.sampled_from([
        TorqueOn(9), Release(9), Teach(9), TeachEnd(9), Run(9, UNFIT), messages.Pause(9), messages.Resume(9),
        SetRate(9, 0.5), SetRate(9, 2.0), Park(9), Clear(9),
        Jog(9, (0.1,)), Jog(9, (0.1,) * 6, begin=True), Jog(9, (), (0.1, 0.0), True),
    ]),
)  # fmt: skip
@settings(max_examples=150)
def test_a_refused_command_changes_nothing_but_that_it_is_answered(
    make: Callable[[], IdealArm], happens: str, ticks: int, command: Command
) -> None:
    arm = make()
    if happens == "heat":
        arm.put(2, ax12a.PRESENT_TEMPERATURE, 70)
    first: dict[str, Command] = {"teach": Teach(8), "park": Park(8), "jog": Jog(8, (0.1,) * 6, begin=True)}
    arm.run_ticks(ticks + 1, *(asked for name, asked in first.items() if name == happens))
    inputs = Inputs(arm.tick, arm.now_ns, Sample(arm.now_ns, _readings(arm)))
    state, outputs = step(arm.state, inputs, arm.arm, arm.robot, PERIOD_S)
    after, said = step(arm.state, replace(inputs, commands=(command,)), arm.arm, arm.robot, PERIOD_S)
    mine = [reply for reply in said.replies if reply.request_id == 9]
    if mine and not mine[0].ok and mine[0].code in REFUSED and "does not go to rest" not in mine[0].message:
        assert after == state
        assert replace(said, replies=()) == replace(outputs, replies=())
        assert [reply for reply in said.replies if reply.request_id != 9] == list(outputs.replies)
