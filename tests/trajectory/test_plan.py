import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator

from armctl.config import ArmConfig
from armctl.errors import ConfigError
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory import plan as module
from armctl.trajectory.plan import Plan, joint_trajectory, plan_from_text, plan_positions, plan_to_text, preflight
from armctl.trajectory.preflight import DrivenArm
from tests.genetic import hand
from tests.genetic.hand import changed
from tests.kinematics.conftest import rngs
from tests.trajectory.conftest import ARM, REST, ROBOT

WRONG = yaml.safe_load(Path(__file__).with_name("wrong_plans.yaml").read_text(encoding="utf-8"))
LINE = np.column_stack([hand.joint_line(), np.full(65, 0.3)])


def make_plan(**changes: Any) -> Plan:
    kept = [0, 20, 44, 64]
    fields: dict[str, Any] = {
        "arm_id": ARM.arm_id,
        "calibration_hash": ARM.calibration_hash,
        "from_m": tuple(hand.A.tolist()),
        "to_m": tuple(hand.B.tolist()),
        "duration_s": 5.0,
        "via": 2,
        "interpolation": "cubic",
        "waypoints_rad": tuple(map(tuple, LINE[kept].tolist())),
        "waypoint_progress": tuple(index / 64 for index in kept),
        "predicted_mean_error_mm": 0.2,
        "predicted_max_error_mm": 0.4,
        "seed": 3,
    }
    return Plan(**(fields | changes))


def reasons_for(arm: ArmConfig, plan: Plan | None = None, q_now: list[float] = REST) -> tuple[str, ...]:
    plan = plan or make_plan()
    return preflight(
        plan.model_copy(update={"calibration_hash": arm.calibration_hash}), DrivenArm(arm, ROBOT, 0.1), q_now
    )


def the_reason(arm: ArmConfig = ARM, plan: Plan | None = None, q_now: list[float] = REST) -> str:
    (reason,) = reasons_for(arm, plan, q_now)
    return reason


@given(rngs, st.integers(0, 5), st.sampled_from(["linear", "cubic"]))
def test_a_plan_survives_its_text_form_bit_for_bit(rng: Generator, via: int, interpolation: str) -> None:
    plan = make_plan(
        via=via,
        interpolation=interpolation,
        duration_s=float(rng.uniform(1, 9)),
        waypoints_rad=tuple(map(tuple, rng.standard_normal((via + 2, 6)).tolist())),
        waypoint_progress=(0.0, *sorted(rng.uniform(0.01, 0.99, via).tolist()), 1.0),
    )
    assert plan_from_text(plan_to_text(plan), "line.plan") == plan


@pytest.mark.parametrize(("key", "value", "match"), WRONG["values"])
def test_a_wrong_plan_is_refused_naming_the_key(key: str, value: object, match: str) -> None:
    data = json.loads(plan_to_text(make_plan())) | {key: value}
    with pytest.raises(ConfigError, match=match) as caught:
        plan_from_text(json.dumps(data), "line.plan")
    assert str(caught.value).startswith("line.plan: ")


@pytest.mark.parametrize(("text", "match"), [("[" * 100_000, "not JSON"), *WRONG["texts"]])
def test_text_that_is_no_plan_is_refused(text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        plan_from_text(text, "line.plan")


def test_the_plan_runs_between_its_ends_and_stands_still_outside() -> None:
    q = plan_positions(make_plan(), np.array([-1.0, 0.0, 2.5, 5.0, 6.0]))
    np.testing.assert_allclose(q[[0, 1, 3, 4]], LINE[[0, 0, 64, 64]], atol=1e-12)
    np.testing.assert_allclose(tool_position(ROBOT.chain, q[:, :5])[2], [0.18, 0.0, 0.10], atol=1e-3)


@given(st.sampled_from([0.01, 0.05, 0.1]), st.floats(1.0, 9.0), rngs)
@settings(max_examples=40)
def test_a_trajectory_starts_where_the_arm_is_and_follows_the_plan_between_its_marks(
    period_s: float, duration_s: float, rng: Generator
) -> None:
    q_now = (np.array(REST) + rng.uniform(-1.5, 1.5, 6)).tolist()
    plan = make_plan(duration_s=duration_s)
    trajectory = joint_trajectory(plan, DrivenArm(ARM, ROBOT, period_s), q_now)
    q = np.array(trajectory.positions_rad)
    time_s = np.arange(len(q)) * period_s
    assert trajectory.positions_rad[0] == tuple(q_now)
    assert trajectory.end_s - trajectory.begin_s == pytest.approx(duration_s)
    assert trajectory.duration_s >= trajectory.end_s + module.SETTLE_S - 1e-9
    inside = (time_s >= trajectory.begin_s - 1e-9) & (time_s <= trajectory.end_s)
    planned = plan_positions(plan, np.clip(time_s[inside] - trajectory.begin_s, 0, None))
    np.testing.assert_allclose(q[inside], planned, atol=1e-8)
    dwell = (time_s >= trajectory.begin_s - module.DWELL_S + 1e-9) & (time_s <= trajectory.begin_s)
    np.testing.assert_allclose(q[dwell], np.broadcast_to(LINE[0], q[dwell].shape), atol=1e-9)
    np.testing.assert_allclose(q[time_s > trajectory.end_s][-1], LINE[64], atol=1e-12)
    approach = np.abs(np.diff(q[time_s < trajectory.begin_s], axis=0)) / period_s
    assert np.degrees(approach.max()) <= 20.0 + 1e-6


def test_a_plan_that_does_not_move_lets_an_arm_at_its_start_only_dwell() -> None:
    still = make_plan(waypoints_rad=(tuple(LINE[0]),) * 4)
    trajectory = joint_trajectory(still, DrivenArm(ARM, ROBOT, 0.05), LINE[0].tolist())
    assert (trajectory.begin_s, trajectory.end_s) == pytest.approx((module.DWELL_S, module.DWELL_S + 5.0))


@given(rngs, st.sampled_from([0.02, 0.1]))
@settings(max_examples=30)
def test_every_joint_comes_to_the_start_in_the_direction_in_which_it_leaves(rng: Generator, period_s: float) -> None:
    plan = make_plan(interpolation=rng.choice(["linear", "cubic"]))
    q_now = (np.array(REST) + rng.uniform(-1.0, 1.0, 6)).tolist()
    trajectory = joint_trajectory(plan, DrivenArm(ARM, ROBOT, period_s), q_now)
    q = np.array(trajectory.positions_rad)
    begin = round(trajectory.begin_s / period_s)
    last = q[begin] - q[begin - round((module.DWELL_S + 0.5) / period_s)]
    ahead = module.lead(plan)
    assert (np.abs(ahead) <= module.LEAD_RAD).all()
    moving = np.abs(ahead) > 1e-6
    assert (np.sign(last[moving]) == np.sign(ahead[moving])).all()
    np.testing.assert_allclose(last[~moving], 0.0, atol=1e-5)


@pytest.mark.parametrize("ticks", [33, 34, 77, 100, 123])
@pytest.mark.parametrize("period_s", [0.1, 0.02])
def test_a_clock_that_adds_up_ticks_finds_the_begin_and_the_end_on_their_ticks(ticks: int, period_s: float) -> None:
    q_now = LINE[0].copy()
    q_now[0] += 0.001 * ticks
    trajectory = joint_trajectory(make_plan(), DrivenArm(ARM, ROBOT, period_s), q_now.tolist())
    progress_s, seen = 0.0, []
    while progress_s < trajectory.duration_s:
        seen.append(progress_s)
        progress_s += period_s
    begin, end = (next(k for k, at in enumerate(seen) if at >= mark) for mark in (trajectory.begin_s, trajectory.end_s))
    assert (begin, end - begin) == (round(trajectory.begin_s / period_s), round(5.0 / period_s))


def test_the_approach_keeps_slower_joints_and_the_tool_within_their_limits() -> None:
    def approach(arm: ArmConfig) -> FloatArray:
        trajectory = joint_trajectory(make_plan(), DrivenArm(arm, ROBOT, 0.01), [LINE[0, 0] + 0.3, *LINE[0, 1:]])
        return np.array(trajectory.positions_rad)[: int(trajectory.begin_s * 100)]

    slow = approach(changed(ARM, 0, speed_limit_deg_s=5.0))
    gentle = approach(changed(ARM, 0, acceleration_limit_deg_s2=2.0))
    crawling = approach(changed(ARM, tool_speed_limit_m_s=0.01))
    assert min(map(len, (slow, gentle, crawling))) > len(approach(ARM))
    assert np.degrees(np.abs(np.diff(slow, axis=0)).max()) * 100.0 <= 5.0 + 1e-6
    assert np.degrees(np.abs(np.diff(gentle, 2, axis=0)).max()) * 1e4 <= 2.0 + 1e-3
    tool = tool_position(ROBOT.chain, crawling[:, :5])
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() * 100.0 <= 0.01


@pytest.mark.parametrize("q_now", [REST[:5], [*REST[:5], math.nan]])
def test_unknown_joint_positions_make_no_trajectory(q_now: list[float]) -> None:
    with pytest.raises(ValueError, match="one finite number"):
        joint_trajectory(make_plan(), DrivenArm(ARM, ROBOT, 0.05), q_now)
    assert "not 6 known joint angles" in the_reason(q_now=q_now)


@pytest.mark.parametrize("period_s", [0.0, -0.1, math.nan, math.inf])
def test_a_period_must_be_positive(period_s: float) -> None:
    with pytest.raises(ValueError, match="period_s"):
        joint_trajectory(make_plan(), DrivenArm(ARM, ROBOT, period_s), REST)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_sound_plan_may_run_from_the_rest_pose(interpolation: str) -> None:
    assert preflight(make_plan(interpolation=interpolation), DrivenArm(ARM, ROBOT, 0.1), REST) == ()


def test_a_plan_of_another_arm_or_calibration_may_not_run() -> None:
    assert "arm 'other', this is 'ax12-line'" in the_reason(plan=make_plan(arm_id="other"))
    (reason,) = preflight(make_plan(calibration_hash="0000"), DrivenArm(ARM, ROBOT, 0.1), REST)
    assert "calibration 0000" in reason


def test_a_plan_of_fewer_joints_may_not_run() -> None:
    rows = tuple(tuple(row[:5]) for row in make_plan().waypoints_rad)
    assert "moves 5 joints, the arm has 6" in the_reason(plan=make_plan(waypoints_rad=rows))


def test_limits_tool_speed_and_floor_are_watched_over_the_whole_motion_with_value_and_bound() -> None:
    reason = the_reason(changed(ARM, 1, limits_deg=(-10, 100), rest_deg=90), q_now=LINE[0].tolist())
    assert "shoulder would go to 108.7 deg, outside its limits -10.0 to 100.0 deg" in reason
    reason = the_reason(q_now=[math.radians(-147.0), *REST[1:]])
    assert "base stands at -147.0 deg, outside its limits -145.0 to 145.0 deg" in reason
    reason = the_reason(changed(ARM, tool_speed_limit_m_s=0.03))
    assert re.search(r"the tool would reach 0\.06\d m/s, at most 0\.030 m/s", reason)
    reason = the_reason(changed(ARM, floor_m=0.105), q_now=LINE[0].tolist())
    assert re.search(r"come down to 0\.(09|10)\d m, .*floor at 0\.105 m", reason)


def test_half_a_tick_outside_a_limit_is_rounding() -> None:
    assert reasons_for(ARM, q_now=[math.radians(-145.1), *REST[1:]]) == ()


@pytest.mark.parametrize(
    ("limit", "bound", "unit"), [("speed_limit_deg_s", 15.0, "deg/s"), ("acceleration_limit_deg_s2", 20.0, "deg/s2")]
)
def test_joint_speed_and_acceleration_name_a_duration_that_suffices(limit: str, bound: float, unit: str) -> None:
    arm = changed(ARM, 0, **{limit: bound})
    reason = the_reason(arm)
    assert re.search(rf"base would reach .*at most {bound} {unit};", reason)
    needed_s = float(reason.split("duration of ")[1].split(" s")[0])
    assert reasons_for(arm, make_plan(duration_s=needed_s + 0.1)) == ()


def test_every_reason_is_told_at_once() -> None:
    arm = changed(changed(ARM, 0, speed_limit_deg_s=15.0), tool_speed_limit_m_s=0.03, floor_m=0.12)
    assert len(preflight(make_plan(arm_id="other"), DrivenArm(arm, ROBOT, 0.1), LINE[0].tolist())) == 4
