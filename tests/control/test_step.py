"""What holds of the control step whatever happens."""

import math
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.messages import (
    Clear,
    Command,
    Hold,
    Inputs,
    Park,
    Release,
    Run,
    Sample,
    ServoReading,
    Teach,
    TeachEnd,
    TorqueOn,
)
from tests.control.ideal_arm import PERIOD_S, IdealArm, holding, line

COMMANDS = st.sampled_from(["park", "hold", "release", "torque", "teach", "end", "run", "clear"])


@given(st.lists(st.tuples(COMMANDS, st.integers(0, 6)), max_size=25))
@settings(deadline=None, max_examples=60)
def test_any_command_sequence_keeps_goals_inside_limits_and_answers_everyone(story: list[tuple[str, int]]) -> None:
    arm = IdealArm().connect()
    asked = 0
    for name, ticks in story:
        asked += 1
        commands: dict[str, Command] = {
            "hold": Hold(asked),
            "park": Park(asked),
            "release": Release(asked),
            "torque": TorqueOn(asked),
            "teach": Teach(asked),
            "end": TeachEnd(asked),
            "run": Run(asked, line(arm, seconds=0.5, delta_rad=0.2)),
            "clear": Clear(asked),
        }
        arm.run_tick(commands[name])
        arm.run_ticks(ticks)
    arm.run_ticks(60)
    assert set(arm.replies) == set(range(1, asked + 1))
    assert arm.state.fault is None
    for goal in arm.goals:
        for tick, joint in zip(goal, arm.arm.joints, strict=True):
            assert joint.limits_tick[0] <= tick <= joint.limits_tick[1]
    for a, b in pairwise(arm.goals):
        assert max(abs(x - y) for x, y in zip(a, b, strict=True)) <= 60.0 * PERIOD_S / math.degrees(ax12a.TICK_RAD) + 1


def test_the_same_inputs_give_the_same_outputs() -> None:
    arm = holding()
    inputs = Inputs(arm.tick, arm.now_ns, Sample(arm.now_ns, _readings(arm)), (Run(5, line(arm)),))
    first = step(arm.state, inputs, arm.arm, arm.robot, PERIOD_S)
    assert step(arm.state, inputs, arm.arm, arm.robot, PERIOD_S) == first


def _readings(arm: IdealArm):  # type: ignore[no-untyped-def]

    return tuple(
        ServoReading(i, bytes(b), arm.now_ns, True) for i, b in zip(arm.arm.servo_ids, arm.blocks, strict=True)
    )
