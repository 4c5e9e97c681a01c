"""An arm that is asked as a daemon's is: what the judge sees of it, and what nobody else does."""

import numpy as np
import pytest

from armctl.trajectory.plan import Plan
from armctl.trajectory.target import MoveRequest
from proving import served_arm
from proving.served_arm import ARM, LOOK_NS, ServedArm

HERE_RAD = tuple(np.radians([10.0, 60.0, -70.0, -20.0, 10.0, 0.0]).tolist())


def plan(arm: ServedArm) -> Plan:
    there = [*(np.array(HERE_RAD) + np.radians([10.0, 5.0, -5.0, 0.0, 0.0, 0.0])).tolist()]
    return Plan(
        arm_id=ARM,
        calibration_hash=arm.arm.calibration_hash,
        from_m=(0.1, 0.0, 0.1),
        to_m=(0.2, 0.0, 0.1),
        duration_s=3.0,
        via=0,
        interpolation="linear",
        waypoints_rad=(HERE_RAD, tuple(there)),
        waypoint_progress=(0.0, 1.0),
        predicted_mean_error_mm=0.0,
        predicted_max_error_mm=0.0,
        seed=0,
    )


def test_a_run_is_looked_at_every_few_milliseconds_and_nothing_of_that_is_handed_out() -> None:
    arm = ServedArm(4)
    measured = arm.run(plan(arm))
    assert (measured.true_time_s, measured.true_tool_m) == (None, None)
    assert len(measured.time_s) == 31
    assert abs(len(arm.path_m) - 3.0e9 / LOOK_NS) <= 1
    # Where the encoders have it, and where it is: near to each other, and not the same.
    seen = arm.truly.tool_m(measured.positions_rad[[0, -1]])
    apart_mm = 1e3 * np.linalg.norm(seen - arm.path_m[[0, -1]], axis=1)
    assert (apart_mm > 0.01).all()
    assert (apart_mm < 8.0).all()


def test_looking_changes_nothing_and_a_seed_repeats_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = ServedArm(4), ServedArm(4)
    seen = [arm.run(plan(arm)).positions_rad for arm in (first, second)]
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(first.path_m, second.path_m)
    monkeypatch.setattr(served_arm, "LOOK_NS", 97_000_000)
    seldom = ServedArm(4)
    np.testing.assert_array_equal(seldom.run(plan(seldom)).positions_rad, seen[0])
    assert len(seldom.path_m) < len(first.path_m) / 20


def test_goals_are_those_that_the_servos_have() -> None:
    arm = ServedArm(4, correction=False)
    arm.move(MoveRequest(joints_rad=HERE_RAD))
    tick = np.radians(300.0 / 1023.0)
    np.testing.assert_allclose(arm.looks[-1].goals_rad, HERE_RAD, atol=0.5 * tick + 1e-9)
    assert np.abs(np.array(arm.looks[-1].joints_rad) - HERE_RAD).max() > tick
