from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armctl.clock import NS_PER_S
from armctl.kinematics.chain import tool_position
from armctl.lab.course import courses
from armctl.lab.rig import TRUTH_NS, VirtualRig, measured_run
from armctl.lab.study.limits import EFFECTS
from armctl.messages import Run
from armctl.recording.recordings import Recording, load
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault, Faults
from armctl.sim.spec import ArmSpec
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.course import Line, plan_of
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan, joint_trajectory
from armctl.trajectory.refinement import lag_of, waited_long
from tests.genetic import hand
from tests.host.doubles import refused
from tests.lab.daemon import true_path
from tests.recording.logs import write

# An arm without the faults of one, so that its motion can be held against the plan.
KIND = ArmSpec(**{name: value for effect in EFFECTS.values() for name, value in effect.items()})
LINE = Line(hand.A, hand.B, 3.0)


def rig(spec: ArmSpec = KIND, seed: int = 1) -> VirtualRig:
    return VirtualRig(SimulatedArm(hand.arm(), seed=seed, spec=spec))


@pytest.fixture
def on() -> VirtualRig:
    return rig()


def plan(on: VirtualRig, via: int | None = 4) -> Plan:
    ways = line_paths(on, LINE, np.random.default_rng(0), most=12)
    return plan_of(on, next(courses(on, LINE, via, ways)), 0)


def test_a_perfect_arm_is_measured_where_its_plan_says_and_in_its_time(on: VirtualRig) -> None:
    wanted = plan(on)
    measured = on.run(wanted, corrected=False)
    assert measured.duration_s == pytest.approx(3.0, abs=1e-3)
    assert len(measured.time_s) == 31
    np.testing.assert_allclose(measured.time_s, np.arange(31) * 0.1, atol=0.01)
    assert np.abs(lag_of(on, wanted, measured)).max() < np.radians(1.5)


def test_readings_of_a_recorded_run_have_the_times_of_its_plan_though_the_arm_waited(
    on: VirtualRig, tmp_path: Path
) -> None:
    wanted = plan(on)

    def recorded(name: str, *faults: Fault) -> Recording:
        arm = VirtualArm(SimulatedArm(hand.arm(), seed=1, spec=KIND, faults=Faults(faults, seed=1)))
        arm.energise(5)
        trajectory = replace(joint_trajectory(wanted, arm, arm.goals_rad), corrected=False)
        records = arm.carry_out(Run(arm.next_id(), trajectory))
        begun_ns.append(
            next(r.inputs.sample.time_ns for r in records for e in r.outputs.events if e.code == "PLAN_BEGIN")
        )
        return load(write(tmp_path / f"{name}.mcap", records))

    begun_ns = list[int]()
    smooth = recorded("smooth")
    assert smooth.plan_s is not None
    assert smooth.waited_s[smooth.time_s <= smooth.plan_s[1]].max() == 0.0
    mute = Fault(kind="mute", servo_id=3, begin_s=begun_ns[0] / NS_PER_S + 1.45, duration_s=0.1)
    waited = recorded("waited", mute)
    assert waited.waited_s[-1] == pytest.approx(smooth.waited_s[-1] + waited.duration_s - smooth.duration_s, abs=0.02)
    assert waited.waited_s[-1] > 0.05
    for run in (smooth, waited):
        assert run.plan_s is not None
        measured = measured_run(run, run.plan_s[1] - run.plan_s[0])
        assert measured.time_s[-1] == pytest.approx(3.0, abs=0.06)
        assert np.abs(lag_of(on, wanted, measured)).max() < np.radians(1.5)
        assert not waited_long(wanted.duration_s, measured.duration_s, on.period_s)
    assert waited_long(wanted.duration_s, 3.3, on.period_s)


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
