"""Two simulated servos on one shaft: one offset a seed, torques that add, goals that fight, a horn that slips."""

from dataclasses import replace

import numpy as np
import pytest

from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec
from tests.paired import paired_arm

ARM = paired_arm()
FIRST, SECOND = ARM.pairs[0]
MS = 1_000_000
ALIKE = replace(DEFAULT_SPEC, pair_offset_tick=0.0)


def offset_tick(arm: SimulatedArm) -> float:
    """How far the shoulder's second servo is off the mirrored first one."""
    return arm.servos[FIRST].position_tick + arm.servos[SECOND].position_tick - 1023.0


def held(arm: SimulatedArm, first: int, second: int, seconds: float = 2.0) -> SimulatedArm:
    """The shoulder's servos under torque at these goals."""
    for index, goal in ((FIRST, first), (SECOND, second)):
        for register, value in ((ax12a.GOAL, goal), (ax12a.TORQUE_ENABLE, 1)):
            arm.servos[index].set(register, value)
    for ms in range(0, round(seconds * 1000) + 1, 20):
        arm.advance(ms * MS)
    return arm


@pytest.mark.parametrize("spec", [DEFAULT_SPEC, replace(DEFAULT_SPEC, pair_offset_tick=15.0)])
def test_a_seed_draws_the_offset_of_a_pair_within_its_bound(spec: ArmSpec) -> None:
    found = [offset_tick(SimulatedArm(ARM, seed=seed, spec=spec)) for seed in range(12)]
    assert found == [offset_tick(SimulatedArm(ARM, seed=seed, spec=spec)) for seed in range(12)]
    assert max(map(abs, found)) <= spec.pair_offset_tick
    assert len(set(found)) == len(found)


def test_a_measured_table_is_true_but_for_a_zero_offset() -> None:
    arm = SimulatedArm(paired_arm({"table": [[170, 866], [760, 270]]}), seed=3)
    first, second = (arm.servos[i].position_tick for i in (FIRST, SECOND))
    link = arm.config.servos[SECOND].linkage
    assert link is not None
    assert second == pytest.approx(link.second(first), abs=DEFAULT_SPEC.zero_offset_tick)


def test_what_a_pair_draws_changes_nothing_of_the_other_servos() -> None:
    pairs, singles = SimulatedArm(ARM, seed=5), SimulatedArm(load_arm("ax12-line"), seed=5)
    assert [servo.shaft_rad for servo in singles.servos] == [servo.shaft_rad for servo in pairs.servos[:6]]


def test_one_shaft_moves_both_servos_and_their_torques_add() -> None:
    """Each bears half of what one would bear alone."""
    pair, one = (held(SimulatedArm(ARM, seed=2, spec=ALIKE), 488, 1023 - 488) for _ in range(2))
    alone = SimulatedArm(ARM, seed=2, spec=ALIKE)
    alone.servos[FIRST].set(ax12a.GOAL, 488)
    alone.servos[FIRST].set(ax12a.TORQUE_ENABLE, 1)
    for ms in range(0, 2001, 20):
        alone.advance(ms * MS)
    assert np.array_equal(pair.true_positions(), one.true_positions())
    assert offset_tick(pair) == pytest.approx(0.0, abs=1e-6)
    loads = [pair.servos[i].output for i in (FIRST, SECOND)]
    assert loads[0] == pytest.approx(-loads[1], abs=0.04)
    assert abs(loads[0]) < 0.75 * abs(alone.servos[FIRST].output)


@pytest.mark.parametrize("off", [6, 15, 30])
def test_goals_that_do_not_belong_together_show_as_load_on_both(off: int) -> None:
    arm = held(SimulatedArm(ARM, seed=2, spec=ALIKE), 340, 1023 - 340 + off)
    together = (arm.servos[FIRST].output + arm.servos[SECOND].output) / 2.0
    assert together == pytest.approx(0.032 + max(0.0, off / 2.0 - 1.0) / 32.0 * 0.968, abs=0.04)


def test_a_horn_slips_and_comes_back() -> None:
    arm = held(SimulatedArm(ARM, seed=2, spec=ALIKE), 340, 1023 - 340)
    number = arm.faults.begin(Fault(kind="pair_mismatch", servo_id=12, value=15.0), arm.time_s)
    arm.advance(2_500 * MS)
    assert offset_tick(arm) == pytest.approx(15.0, abs=1e-6)
    assert arm.servos[SECOND].output < -0.15
    arm.faults.end(number)
    arm.advance(5_000 * MS)
    assert offset_tick(arm) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("servo_id", [2, 12])
def test_what_holds_either_servo_holds_the_joint(servo_id: int) -> None:
    arm = SimulatedArm(ARM, seed=2, spec=ALIKE)
    arm.advance(0)
    arm.faults.begin(Fault(kind="blocked_joint", servo_id=servo_id), arm.time_s)
    before = arm.true_positions()[FIRST]
    held(arm, 500, 1023 - 500)
    assert arm.true_positions()[FIRST] == pytest.approx(before, abs=0.01)


def test_how_time_is_cut_changes_nothing() -> None:
    def run(step_ms: int) -> list[float]:
        arm = SimulatedArm(ARM, seed=4)
        for ms in range(0, 1201, step_ms):
            if ms == 120:
                for index, goal in ((FIRST, 600), (SECOND, 423)):
                    arm.servos[index].set(ax12a.GOAL, goal)
                    arm.servos[index].set(ax12a.TORQUE_ENABLE, 1)
            arm.advance(ms * MS)
        return [*arm.true_positions().tolist(), *(servo.output for servo in arm.servos)]

    assert run(1) == run(20) == run(120)
