import numpy as np
import pytest

from armctl.kinematics.chain import tool_position
from armctl.lab.course import courses
from armctl.lab.rig import TRUTH_NS, VirtualRig
from armctl.lab.study.limits import EFFECTS
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import ArmSpec
from armctl.trajectory.course import Line, plan_of
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import lag_of
from tests.genetic import hand
from tests.host.doubles import refused
from tests.lab.daemon import true_path

# An arm without the faults of one, so that its motion can be held against the plan.
KIND = ArmSpec(**{name: value for effect in EFFECTS.values() for name, value in effect.items()})
LINE = Line(hand.A, hand.B, 3.0)


def rig(spec: ArmSpec = KIND, seed: int = 1) -> VirtualRig:
    return VirtualRig(SimulatedArm(hand.arm(), seed=seed, spec=spec))


@pytest.fixture
def on() -> VirtualRig:
    return rig()


def plan(on: VirtualRig, via: int | None = 4) -> Plan:
    ways = line_paths(on.arm, on.robot, LINE.A, LINE.B, LINE.duration_s, np.random.default_rng(0), most=12)
    return plan_of(on, next(courses(on, LINE, via, ways)), 0)


def test_a_perfect_arm_is_measured_where_its_plan_says_and_in_its_time(on: VirtualRig) -> None:
    wanted = plan(on)
    measured = on.run(wanted, corrected=False)
    assert measured.duration_s == pytest.approx(3.0, abs=1e-3)
    assert len(measured.time_s) == 31
    np.testing.assert_allclose(measured.time_s, np.arange(31) * 0.1, atol=0.01)
    assert np.abs(lag_of(on, wanted, measured)).max() < np.radians(1.5)


def test_the_truth_is_looked_at_every_few_milliseconds_from_begin_to_end(on: VirtualRig) -> None:
    time_s, tool_m = true_path(on.run(plan(on)))
    assert len(time_s) == len(tool_m)
    np.testing.assert_allclose(np.diff(time_s), TRUTH_NS / 1e9)
    assert time_s[0] < 0.005 < 2.995 < time_s[-1]


def test_looking_at_the_truth_changes_nothing_and_a_seed_repeats_a_run() -> None:
    spec = ArmSpec()
    first, second = (rig(spec, 4).run(plan(rig(spec, 4))) for _ in range(2))
    np.testing.assert_array_equal(first.positions_rad, second.positions_rad)
    np.testing.assert_array_equal(true_path(first)[1], true_path(second)[1])


def test_a_plan_that_must_not_run_is_refused_with_every_reason(on: VirtualRig) -> None:
    with refused("PREFLIGHT", "made for arm"):
        on.run(plan(on).model_copy(update={"arm_id": "other"}))


def test_a_guided_take_goes_from_A_to_B_and_the_arm_holds_afterwards() -> None:
    on = rig(ArmSpec())
    tool = tool_position(on.robot.chain, on.teach(hand.A, hand.B, seed=5)[:, :5])
    assert np.linalg.norm(tool[[0, -1]] - [hand.A, hand.B], axis=1).max() < 0.03
    assert on.run(plan(on)).duration_s == pytest.approx(3.0, abs=1e-3)
