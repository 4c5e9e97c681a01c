"""The hand that guides a limp arm."""

import math

import numpy as np
import pytest

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.errors import UnreachableTarget
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.hand import MAX_TORQUE_NM, Guided, hand_torque

FROM_M, TO_M = np.array([0.18, -0.125, 0.10]), np.array([0.18, 0.125, 0.10])


@pytest.fixture
def simulated(arm: ArmConfig) -> SimulatedArm:
    return SimulatedArm(arm)


def take(simulated: SimulatedArm, seed: int, begin_ns: int = NS_PER_S) -> tuple[Guided, FloatArray]:
    """One take; the true tool every 10 ms from its acceptance to its end."""
    simulated.advance(begin_ns)
    guided = simulated.hand.guide(FROM_M, TO_M, seed=seed)
    tool = []
    for k in range(round(guided.duration_s * 100)):
        simulated.advance(begin_ns + (k + 1) * 10_000_000)
        tool.append(simulated.true_tool_position())
    return guided, np.array(tool)


def line_of(guided: Guided, tool: FloatArray) -> FloatArray:
    return tool[round(guided.begin_s * 100) : round(guided.end_s * 100)]


@pytest.mark.parametrize("seed", range(6))
def test_take_dwells_and_then_runs_along_the_line_but_not_on_it(arm: ArmConfig, seed: int) -> None:
    guided, tool = take(SimulatedArm(arm, seed=seed), seed)
    dwell = tool[round((guided.begin_s - 0.4) * 100) : round(guided.begin_s * 100)]
    assert np.ptp(dwell, axis=0).max() < 1e-3
    line = line_of(guided, tool)
    for at, wanted in ((line[0], FROM_M), (line[-1], TO_M)):
        assert 1e-3 < np.linalg.norm(at - wanted) < 30e-3
    along = (TO_M - FROM_M) / np.linalg.norm(TO_M - FROM_M)
    miss_m = np.linalg.norm(np.cross(line - FROM_M, along), axis=1)
    assert 2e-3 < miss_m.mean() < 20e-3
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / 0.01 < 0.25
    assert 4.0 < guided.end_s - guided.begin_s < 6.0
    assert guided.duration_s - guided.end_s == pytest.approx(1.2)


def test_takes_differ_by_seed_and_only_by_seed(arm: ArmConfig) -> None:
    first, same, other = (line_of(*take(SimulatedArm(arm), seed)) for seed in (1, 1, 2))
    assert first.tolist() == same.tolist()
    m = min(len(first), len(other))
    assert np.abs(first[:m] - other[:m]).max() > 2e-3


def test_arm_is_supported_after_the_take_and_falls_when_let_go(simulated: SimulatedArm) -> None:
    guided, tool = take(simulated, 1)
    later_ns = NS_PER_S + round((guided.duration_s + 60.0) * 1e9)
    simulated.advance(later_ns)
    assert simulated.true_tool_position() == pytest.approx(tool[-1], abs=1e-3)
    assert simulated.hand.holding
    simulated.hand.release()
    simulated.advance(later_ns + NS_PER_S)
    assert simulated.true_tool_position()[2] < tool[-1][2] - 0.05


def test_next_take_begins_where_the_last_one_ended(simulated: SimulatedArm) -> None:
    guided, first = take(simulated, 1)
    _, second = take(simulated, 2, NS_PER_S + round(guided.duration_s * 100) * 10_000_000)
    assert np.linalg.norm(second[0] - first[-1]) < 1e-3


def test_joints_are_led_to_a_posture_and_held_there_but_for_the_one_that_is_left_free(simulated: SimulatedArm) -> None:
    simulated.advance(NS_PER_S)
    wanted = np.array([0.2, 1.2, -1.0, -0.6, 0.1, 0.3])
    first = simulated.hand.hold(wanted)
    simulated.advance(NS_PER_S + round(first.duration_s * 1e9))
    assert simulated.true_positions() == pytest.approx(wanted, abs=0.03)
    freed = simulated.hand.hold(np.array([0.2, 1.2, -0.5, -0.6, 0.1, -0.3]), free=1)
    simulated.advance(2 * NS_PER_S + round((first.duration_s + freed.duration_s) * 1e9))
    there = simulated.true_positions()
    assert np.delete(there, 1) == pytest.approx([0.2, -0.5, -0.6, 0.1, -0.3], abs=0.03)
    assert there[1] < 1.0
    assert simulated.hand.guide(FROM_M, TO_M, seed=1).duration_s > 0.0


def test_line_out_of_reach_is_refused_and_nobody_holds_the_arm(simulated: SimulatedArm) -> None:
    with pytest.raises(UnreachableTarget):
        simulated.hand.guide(FROM_M, np.array([0.6, 0.0, 0.1]), seed=1)
    assert not simulated.hand.holding


@pytest.mark.parametrize("duration_s", [0.0, -1.0, math.inf, math.nan])
def test_impossible_durations_are_refused(simulated: SimulatedArm, duration_s: float) -> None:
    with pytest.raises(ValueError, match="duration_s"):
        simulated.hand.guide(FROM_M, TO_M, seed=1, duration_s=duration_s)


def test_wobble_that_leaves_the_reach_does_not_stop_the_hand(simulated: SimulatedArm) -> None:
    simulated.advance(NS_PER_S)
    edge = 0.3795
    begin, end = np.array([edge, 0.0, 0.1]), np.array([edge * math.cos(0.3), edge * math.sin(0.3), 0.1])
    simulated.advance(NS_PER_S + round(simulated.hand.guide(begin, end, seed=1).duration_s * 1e9))
    assert np.linalg.norm(simulated.true_tool_position() - end) < 0.05


def test_force_of_the_hand_is_limited() -> None:
    assert hand_torque(10.0, 0.0) == MAX_TORQUE_NM
    assert hand_torque(0.0, -10.0) == -MAX_TORQUE_NM
    assert hand_torque(0.01, 0.1) == pytest.approx(0.66)
