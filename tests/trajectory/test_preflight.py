"""Every reason against a motion is told, in the user's words, and a sound motion is not refused."""

import math
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.interpolate import rest_to_rest
from armctl.trajectory.preflight import DrivenArm, peak_rates, preflight_motion
from tests.genetic import hand
from tests.genetic.hand import changed
from tests.kinematics.conftest import rngs
from tests.trajectory.conftest import ARM, REST, ROBOT

UP = np.radians([0.0, 100.0, -60.0, -40.0, 0.0, 0.0])
PERIOD_S = 0.05


def motion(*poses: FloatArray | list[float], arm: ArmConfig = ARM) -> FloatArray:
    """Slowly from pose to pose."""
    places = [np.asarray(pose).tolist() for pose in poses]
    ways = [approach_trajectory(a, b, DrivenArm(arm, ROBOT, PERIOD_S), "") for a, b in pairwise(places)]
    return np.concatenate([np.array(way.positions_rad) for way in ways])


def reasons(q: FloatArray, arm: ArmConfig = ARM, **options: Any) -> tuple[str, ...]:
    return preflight_motion(q, DrivenArm(arm, ROBOT, PERIOD_S), **options)


def the_reason(q: FloatArray, **options: Any) -> str:
    (reason,) = reasons(q, **options)
    return reason


def test_rising_from_rest_and_lying_down_again_may_be_done() -> None:
    assert reasons(motion(REST, UP, REST), start_rad=REST) == ()


def test_demo_lines_may_be_run_in_every_posture_they_are_taught_in() -> None:
    line = np.column_stack([hand.joint_line(), np.zeros(65)])
    assert reasons(np.concatenate([motion(REST, line[0]), np.repeat(line, 2, axis=0), motion(line[-1], REST)])) == ()


@pytest.mark.parametrize(
    ("q", "period_s", "match"),
    [
        (np.zeros(6), PERIOD_S, r"shape \(6,\).* rows or more of 6"),
        (np.zeros((1, 6)), PERIOD_S, r"shape \(1, 6\)"),
        (np.zeros((4, 5)), PERIOD_S, r"shape \(4, 5\)"),
        (np.array([[0.0] * 6, [0.0, math.nan, 0.0, 0.0, 0.0, 0.0]]), PERIOD_S, "shoulder is sent to nan in row 1"),
        (np.array([[0.0, 0.0, math.inf, 0.0, 0.0, 0.0], [0.0] * 6]), PERIOD_S, "elbow is sent to inf in row 0"),
        *((motion(REST, UP), period_s, "the period must be above 0") for period_s in (0.0, -0.1, math.nan, math.inf)),
    ],
)
def test_what_is_no_motion_is_refused_at_once(q: FloatArray, period_s: float, match: str) -> None:
    (reason,) = preflight_motion(q, DrivenArm(ARM, ROBOT, period_s))
    assert re.search(match, reason)


def test_limits_name_joint_value_and_bound_and_the_dead_zone_where_it_is_one() -> None:
    q = np.repeat(UP[None], 3, axis=0)
    q[:, 1] = math.radians(161.0)
    assert the_reason(q) == "shoulder stands at 161.0 deg, outside its limits -10.0 to 160.0 deg"
    q[:, 1], q[:, 5] = UP[1], math.radians(155.0)
    told = r"roll stands at 155\.0 deg, .*; tick 1041 lies in the servo's dead zone \(0 to 1023\)"
    assert re.search(told, the_reason(q))


def test_speed_and_acceleration_name_a_duration_that_suffices() -> None:
    there = UP + np.radians([40.0, 0, 0, 0, 0, 40.0])
    told = reasons(rest_to_rest(UP, there, np.linspace(0.0, 1.0, 11)))
    assert [reason.split(" would")[0] for reason in told] == ["base"] * 2 + ["roll"] * 2 + ["the tool"]
    needed_s = max(float(reason.split("duration of ")[1].split(" s")[0]) for reason in told)
    assert reasons(rest_to_rest(UP, there, np.linspace(0.0, 1.0, round(needed_s / PERIOD_S) + 3))) == ()


def test_advice_is_about_the_duration_its_maker_can_change() -> None:
    rows = rest_to_rest(UP, UP + np.radians([0, 0, 0, 0, 0, 40.0]), np.linspace(0.0, 1.0, 11))
    told = [reasons(rows, duration_s=duration_s)[0] for duration_s in (None, 5.0)]
    whole, part = (float(reason.split("of ")[1].split(" s")[0]) for reason in told)
    assert part == pytest.approx(whole * 5.0 / (10 * PERIOD_S), rel=0.05)


@given(st.floats(0.01, 0.4), st.floats(0.02, 0.4))
def test_peak_rates_of_a_known_motion_are_its_own(turn_rad: float, period_s: float) -> None:
    time_s = np.arange(int(12.0 / period_s)) * period_s
    q = (turn_rad * np.where(time_s < 4.0, 0.0, np.minimum(time_s - 4.0, 4.0)))[:, None]
    speed, acceleration = peak_rates(q, period_s)
    assert speed[0] == pytest.approx(turn_rad, rel=1e-9)
    # From rest to this speed within the window the acceleration is judged over, or the period where that is longer.
    window_s = max(1, round(0.1 / period_s)) * period_s
    assert 0.5 <= acceleration[0] * window_s / turn_rad <= 1.0 + 1e-9


def test_the_start_must_be_where_the_arm_is_to_two_degrees() -> None:
    q = motion(UP, REST)
    near, far = UP + np.radians([[0.0, 0.0, turn_deg, 0.0, 0.0, 0.0] for turn_deg in (1.9, 2.1)])
    assert reasons(q, start_rad=near.tolist()) == ()
    told = "joint elbow: the motion starts 2.1 deg from where the arm is (bound 2)"
    assert the_reason(q, start_rad=far.tolist()).startswith(told)
    for unknown in (UP.tolist()[:5], [*UP.tolist()[:5], math.nan]):
        assert "not 6 known joint angles" in the_reason(q, start_rad=unknown)


def test_links_that_would_touch_are_named_though_only_passed_on_the_way() -> None:
    begin, end = np.radians([[0.0, 60.0, -100.0, -110.0, -40.0, 0.0], [0.0, 150.0, -145.0, -100.0, 60.0, 0.0]])
    told = reasons(motion(begin, end))
    assert told
    assert all("would touch" in reason and "at least 0.050 m" in reason for reason in told)
    assert any("the base column" in reason for reason in told)


def test_what_happens_between_two_rows_far_apart_is_seen_too() -> None:
    """At both ends the tool is above the floor; on the straight joint line between them it points down through it."""
    inwards, outwards = np.radians([[0.0, 40.0, -80.0, -50.0, hand_deg, 0.0] for hand_deg in (-80.0, 80.0)])
    for pose in (inwards, outwards):
        assert reasons(np.stack([pose, pose])) == ()
    (reason,) = preflight_motion(np.stack([inwards, outwards]), DrivenArm(ARM, ROBOT, 60.0))
    assert "the tool would come down to -0.0" in reason


def test_an_arm_that_lies_on_itself_may_unfold_but_not_fold_further() -> None:
    folded, free, tighter = np.radians([[0.0, 100.0, -145.0, wrist, 0.0, 0.0] for wrist in (-60.0, 10.0, -65.0)])
    arm = changed(ARM, floor_m=-1.0)
    assert reasons(np.stack([folded, folded]), arm) == ()
    assert reasons(motion(folded, free), arm) == ()
    assert any("would touch" in reason for reason in reasons(motion(free, folded), arm))
    assert any("would touch" in reason for reason in reasons(motion(folded, tighter), arm))


def test_the_floor_stops_links_by_their_thickness_and_lets_an_arm_that_lies_on_it_rise() -> None:
    lying, lower, below = np.radians([[0.0, 0.0, elbow, 0.0, 60.0, 0.0] for elbow in (-30.0, -31.0, -40.0)])
    underside_m = 0.10 - 0.175 * math.sin(math.radians(30.0)) - 0.025
    told = f"the end of link 4 would come down to {underside_m:.3f} m, below the floor at 0.000 m"
    assert told in the_reason(motion(UP, lying))
    assert reasons(np.stack([lying, lying])) == ()
    assert reasons(motion(lying, UP)) == ()
    assert any("below the floor" in reason for reason in reasons(motion(lying, lower)))
    assert any("below the floor" in reason for reason in reasons(np.stack([below, below])))


def test_the_tool_may_come_down_to_the_floor_itself() -> None:
    def down(tool_m: float) -> FloatArray:
        """Upper arm and forearm level, the rest bent down as far as the tool needs."""
        return np.array([0.0, 0.0, 0.0, -math.asin((0.10 - tool_m) / 0.17), 0.0, 0.0])

    assert reasons(motion(UP, down(0.001))) == ()
    assert "the tool would come down to -0.002 m" in the_reason(motion(UP, down(-0.002)))


def test_every_reason_is_told_at_once() -> None:
    q = motion(UP, np.radians([0.0, 165.0, -60.0, -40.0, 0.0, 0.0]))[::8]
    told = reasons(q, changed(ARM, floor_m=0.2), start_rad=REST)
    for part in ("starts", "outside its limits", "deg/s,", "deg/s2", "m/s,", "floor at 0.200 m"):
        assert any(part in reason for reason in told), part


@given(rngs)
@settings(max_examples=25)
def test_what_may_be_run_may_be_run_backwards(rng: np.random.Generator) -> None:
    low, high = np.array([joint.limits_rad for joint in ARM.joints]).T
    q = motion(*rng.uniform(low, high, (3, 6)))
    there, back = reasons(q), reasons(q[::-1])
    if not there:  # only an arm that stands in a capsule is forgiven something on its way out
        assert not [reason for reason in back if "touch" not in reason and "floor" not in reason]
