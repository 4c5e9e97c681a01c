"""The motion of the joints that leads the tool along an outline."""

import math

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.trajectory.line_path import MARGIN_RAD
from armctl.trajectory.path_motion import PathMotion, path_motion
from armctl.trajectory.preflight import DrivenArm, peak_rates
from armctl.trajectory.tool_path import Outline, PathRequest
from tests.host.doubles import refused
from tests.trajectory.conftest import ARM, CHAIN, LIMITS, REST, ROBOT

PERIOD_S = 0.02
ZIGZAG = ((0.16, -0.06, 0.1), (0.22, -0.03, 0.12), (0.16, 0.0, 0.1), (0.22, 0.03, 0.08), (0.16, 0.06, 0.1))


def made(request: PathRequest) -> PathMotion:
    return path_motion(request, REST, DrivenArm(ARM, ROBOT, PERIOD_S))


def rows(motion: PathMotion) -> tuple[np.ndarray, np.ndarray]:
    """Share of the motion's time, shape (m,), and the chain's joint positions [rad] then, shape (m, n)."""
    way = motion.trajectory
    q = np.array(way.positions_rad)[:, : CHAIN.n]
    share = (np.arange(len(q)) * PERIOD_S - way.begin_s) / (way.end_s - way.begin_s)
    inside = (share > -1e-6) & (share < 1.0 + 1e-6)
    return np.clip(share[inside], 0.0, 1.0), q[inside]


@pytest.fixture(scope="module")
def zigzag() -> PathMotion:
    return made(PathRequest(points_m=ZIGZAG, tolerance_mm=3.0))


def test_the_tool_is_on_the_rounded_path_all_the_time_and_at_its_ends_in_the_end(zigzag: PathMotion) -> None:
    share, q = rows(zigzag)
    tool = tool_position(CHAIN, q)
    off = zigzag.reference.off_m(tool, share)
    assert off.max() <= 0.003
    assert zigzag.rounding_m.max() == pytest.approx(off.max(), abs=2e-4)
    np.testing.assert_allclose(tool[[0, -1]], [ZIGZAG[0], ZIGZAG[-1]], atol=1e-4)
    # Where it is not rounded it is exact.
    outline = Outline(PathRequest(points_m=ZIGZAG, tolerance_mm=3.0))
    way = np.linspace(0.0, outline.length_m, 4001)
    nearest = np.linalg.norm(tool[:, None] - outline.rounded(way), axis=2).min(axis=1)
    assert nearest.max() < 1e-4


def test_the_reference_rises_in_progress_and_passes_every_corner(zigzag: PathMotion) -> None:
    reference = zigzag.reference
    assert (np.diff(reference.progress) > 0.0).all()
    assert (reference.progress[0], reference.progress[-1]) == (0.0, 1.0)
    for corner in ZIGZAG:
        assert np.linalg.norm(reference.tool_m - corner, axis=1).min() < 5e-4


def test_no_joint_leaves_its_limits_less_the_room_for_corrections_or_jumps_to_another_branch(
    zigzag: PathMotion,
) -> None:
    _, q = rows(zigzag)
    assert (q > LIMITS[:, 0] + MARGIN_RAD - 1e-6).all()
    assert (q < LIMITS[:, 1] - MARGIN_RAD + 1e-6).all()
    assert np.abs(np.diff(q, 2, axis=0)).max() < math.radians(0.5)


@pytest.mark.no_cover
def test_an_arm_that_faces_its_path_does_not_turn_its_base_around_for_it() -> None:
    arm = load_arm("xiang-6dof")
    robot = robots.get(arm.robot, arm.lengths_m)
    now = (0.51, 0.949, -0.405, -0.591, 1.338, 0.0)
    radius_m, z = (float(tool_position(robot.chain, np.array([0.0, *now[1:5]]))[i]) for i in (0, 2))
    turned = set()
    for to_rad in np.arange(0.03, 0.9, 0.03):
        ends = tuple((radius_m * math.cos(turn), radius_m * math.sin(turn), z) for turn in (to_rad - 0.015, to_rad))
        way = path_motion(PathRequest(points_m=ends), now, DrivenArm(arm, robot, 0.1)).trajectory
        turned.add(round(math.degrees(way.positions_rad[-1][0] - to_rad)))
    assert turned == {0}


@given(st.integers(0, 2**32 - 1), st.floats(0.2, 10.0))
@settings(max_examples=5, deadline=None)
def test_progress_never_goes_back_and_no_limit_of_speed_is_broken(seed: int, tolerance_mm: float) -> None:
    rng = np.random.default_rng(seed)
    points = np.array([0.19, 0.0, 0.12]) + rng.uniform(-1.0, 1.0, (5, 3)) * np.array([0.04, 0.08, 0.03])
    try:
        motion = made(PathRequest(points_m=tuple(map(tuple, points.tolist())), tolerance_mm=tolerance_mm))
    except RequestRefused:
        reject()  # what the arm cannot do is another claim
    _, q = rows(motion)
    speed, acceleration = peak_rates(q, PERIOD_S)
    joints = ARM.joints[: CHAIN.n]
    assert (speed <= [joint.speed_limit_rad_s * 1.001 for joint in joints]).all()
    assert (acceleration <= [joint.acceleration_limit_rad_s2 * 1.001 for joint in joints]).all()
    outline = Outline(PathRequest(points_m=tuple(map(tuple, points.tolist())), tolerance_mm=tolerance_mm))
    way = np.linspace(0.0, outline.length_m, 4001)
    reference = outline.sharp(way)
    at = [int(np.argmin(np.linalg.norm(reference - point, axis=1))) for point in motion.reference.tool_m[::100]]
    assert (np.diff(at) >= 0).all()


def test_a_tight_corner_is_passed_more_slowly_than_the_rest_where_joints_need_it() -> None:
    sharp = made(PathRequest(points_m=ZIGZAG[:3], tolerance_mm=0.1, duration_s=4.0))
    reference = sharp.reference
    speed = np.linalg.norm(np.diff(reference.tool_m, axis=0), axis=1) / np.diff(reference.progress)
    corner = int(np.argmin(np.linalg.norm(reference.tool_m - ZIGZAG[1], axis=1)))
    assert speed[corner] < 0.8 * speed.max()
    even = speed[len(speed) // 4 : len(speed) // 3]
    assert np.ptp(even) < 0.02 * even.max(), "elsewhere it is constant"


def test_the_duration_that_a_refusal_names_is_enough() -> None:
    short = PathRequest(points_m=ZIGZAG, duration_s=0.6)
    with refused("PREFLIGHT", r"give \d+\.\d s or more") as caught:
        made(short)
    enough_s = float(str(caught.value).split("give ")[1].split(" s")[0]) + 0.1
    assert made(short.model_copy(update={"duration_s": enough_s})).trajectory.duration_s > enough_s
