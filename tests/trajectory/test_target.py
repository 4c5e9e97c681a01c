"""Where the joints have to be: on the target or a line, inside the limits, near the present pose; or how far it is."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.solution import solve
from armctl.kinematics.target import point_target, pose_target
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy
from armctl.trajectory.course import Line
from armctl.trajectory.line_path import MARGIN_RAD, STATIONS, levers_m, line_paths, onto, sensitivity_m
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.target import postures_at
from tests.genetic import hand
from tests.host.doubles import refused
from tests.trajectory.conftest import ARM, CHAIN, LIMITS, ROBOT

N = CHAIN.n
ON = DrivenArm(ARM, ROBOT, 0.1)
NOW = tuple(math.radians(degrees) for degrees in (0.0, 87.0, -65.0, -64.0, -33.0, 20.0))

configurations = st.tuples(*(st.floats(low, high) for low, high in LIMITS.tolist()))


def at_point(point: FloatArray) -> list[float]:
    return postures_at(point_target(point), NOW, ON, nearest=True)[0]


@given(configurations)
@settings(max_examples=25)
def test_every_point_some_pose_reaches_is_reached_within_the_limits(q: tuple[float, ...]) -> None:
    point = tool_position(CHAIN, np.array(q))
    found = at_point(point)
    assert tool_position(CHAIN, np.array(found[:N])) == pytest.approx(point, abs=2e-6)
    assert found[N:] == list(NOW[N:])
    for position, joint in zip(found, ARM.joints, strict=True):
        assert joint.limits_rad[0] <= position <= joint.limits_rad[1]


def test_the_solution_near_the_present_pose_is_taken() -> None:
    here = tool_position(CHAIN, np.array(NOW[:N]))
    assert np.abs(np.subtract(at_point(np.add(here, (0.0, 0.0, 0.005))), NOW)).max() < math.radians(5.0)


def test_a_point_out_of_reach_says_how_near_the_tool_comes() -> None:
    reach = sum(row.a for row in CHAIN.rows)
    shoulder = np.array([0.0, 0.0, CHAIN.rows[0].d])
    target = np.add(shoulder, (reach + 0.1, 0.0, 0.0))
    with pytest.raises(UnreachableTarget, match=r"no nearer than 100\.0 mm") as caught:
        at_point(target)
    assert caught.value.least_error_m == pytest.approx(0.1, abs=1e-4)


@given(configurations)
@settings(max_examples=20)
def test_a_pose_near_the_present_one_is_reached(q: tuple[float, ...]) -> None:
    wanted = np.array(NOW[:N]) + 0.1 * np.clip(np.array(q), -1.0, 1.0)
    T = forward_kinematics(CHAIN, wanted)
    assert forward_kinematics(CHAIN, np.array(postures_at(pose_target(T), NOW, ON)[0][:N])) == pytest.approx(
        T, abs=1e-3
    )


SIX = ("transfer-6dof", "wristed")


def six_joints(name: str, folder: Path) -> ArmConfig:
    """A shipped arm, or one of a URDF whose last three axes meet: no frame is as a table would have it."""
    if name != "wristed":
        return load_arm(name)
    links = "".join(f'<link name="l{i}"/>' for i in range(8))
    for i, (xyz, rpy, axis) in enumerate(WRISTED):
        ends = f'<parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        kind, limit = ("revolute", '<limit lower="-2.2" upper="1.9"/>') if i < 6 else ("fixed", "")
        links += f'<joint name="j{i}" type="{kind}">{ends}{limit}</joint>'
    (folder / "wristed.urdf").write_text(f'<robot name="wristed">{links}</robot>')
    joints = [{"name": f"j{i}", "servo_id": i + 1} for i in range(6)]
    told = {"arm_id": "wristed", "robot": {"urdf": "wristed.urdf", "tool": "l7"}, "joints": joints}
    (folder / "wristed.yaml").write_text(yaml.safe_dump(told))
    return load_arm(str(folder / "wristed.yaml"))


WRISTED = [
    ("0 0 0.06", "0 0 0.5", "0 0 -1"),
    ("0.02 0.01 0.03", "0 0 0", "0 -1 0"),
    ("0 0 0.12", "0 0 0", "0 1 0"),
    ("0.01 0 0.05", "0 0 0", "0 0 -1"),
    ("0 0 0.05", "0 0 0", "0 1 0"),
    ("0 0 0.04", "0 0 0", "0 0 1"),
    ("0 0 0.05", "0.4 -0.8 0.2", "0 0 1"),
]


@pytest.mark.parametrize("name", SIX)
def test_a_pose_of_joints_within_the_limits_is_never_said_to_be_out_of_reach(name: str, tmp_path: Path) -> None:
    """One in three has a joint at its limit. Nothing that inverse kinematics lists is nearer than the first posture."""
    arm, rng = six_joints(name, tmp_path), np.random.default_rng(5)
    robot = robots.of(arm)
    limits = np.array([joint.limits_rad for joint in arm.joints])
    for k in range(24):
        q, here = rng.uniform(limits[:, 0], limits[:, 1], (2, 6))
        if k % 3 == 0:
            q[k % 6] = limits[k % 6, k % 2]
        T = forward_kinematics(robot.chain, q)
        found = np.array(postures_at(pose_target(T), here.tolist(), DrivenArm(arm, robot, 0.1)))
        np.testing.assert_allclose(forward_kinematics(robot.chain, found), [T] * len(found), atol=1e-5)
        assert ((found >= limits[:, 0]) & (found <= limits[:, 1])).all()
        listed = solve(robot, pose_target(T), present=here, limits=limits).solutions
        ways = [np.abs(np.subtract(one.q_rad, here)).max() for one in listed if one.within_limits]
        assert np.abs(found[0] - here).max() <= min([*ways, np.abs(q - here).max()]) + 1e-5


def test_a_pose_the_arm_cannot_take_says_how_far_off_it_stays() -> None:
    with pytest.raises(UnreachableTarget, match=r"no nearer than .* mm and .* deg"):
        postures_at(pose_target(pose_from_xyz_rpy(0.18, 0.0, 0.15, yaw=math.pi / 2.0)), NOW, ON)


# --------------------------------------------------------------------------------------------------------- along a line


def ways(A: object, B: object, duration_s: float = 5.0, seed: int = 0) -> np.ndarray:
    return line_paths(ON, Line(np.array(A), np.array(B), duration_s), np.random.default_rng(seed), most=40)


@pytest.fixture(scope="module")
def found() -> np.ndarray:
    return ways(hand.A, hand.B)


def test_every_way_is_on_the_line_at_every_station_and_within_limits(found: np.ndarray) -> None:
    assert found.shape[1:] == (STATIONS, 5)
    on_line = hand.A + np.linspace(0.0, 1.0, STATIONS)[:, None] * (hand.B - hand.A)
    np.testing.assert_allclose(tool_position(CHAIN, found), [on_line] * len(found), atol=2e-6)
    assert ((found >= LIMITS[:, 0] + MARGIN_RAD) & (found <= LIMITS[:, 1] - MARGIN_RAD)).all()


def test_the_most_promising_way_comes_first_and_a_seed_repeats_them(found: np.ndarray) -> None:
    assert (np.diff(sensitivity_m(CHAIN, found, hand.A, hand.B)) >= 0.0).all()
    np.testing.assert_array_equal(found, ways(hand.A, hand.B))


def test_the_first_way_turns_no_joint_around(found: np.ndarray) -> None:
    steps = np.diff(found[0], axis=0)
    back = np.minimum(np.maximum(steps, 0.0).sum(axis=0), np.maximum(-steps, 0.0).sum(axis=0))
    assert back.max() < np.radians(1.0)


def test_a_lever_is_how_far_a_joint_moves_the_tool_across_the_line() -> None:
    q = hand.joint_line()[20]
    along = (hand.B - hand.A) / np.linalg.norm(hand.B - hand.A)
    for joint, lever in enumerate(levers_m(CHAIN, q, hand.A, hand.B)):
        moved = q + 1e-6 * np.eye(5)[joint]
        shift = (tool_position(CHAIN, moved) - tool_position(CHAIN, q)) / 1e-6
        assert lever == pytest.approx(float(np.linalg.norm(shift - along * (shift @ along))), abs=1e-5)


@pytest.mark.parametrize(
    ("A", "B", "duration_s", "match"),
    [
        ((0.18, 0.0, 0.1), (0.18, 0.0, 0.1), 5.0, "nearly the same point"),
        ((0.18, 0.0, 0.1), (float("nan"), 0.0, 0.1), 5.0, "finite"),
        (hand.A, hand.B, 0.0, "duration"),
        ((0.6, 0.0, 0.1), (0.18, 0.1, 0.1), 5.0, r"A \(0.600,0.000,0.100\) m is .* mm out of reach; the nearest point"),
        (hand.A, hand.B, 0.6, r"give \d+\.\d s or more"),
        ((-0.15, 0.1, 0.1), (0.25, 0.1, 0.1), 5.0, "both ends can be reached"),
    ],
)
def test_a_line_that_cannot_be_followed_is_refused_with_what_would_do(
    A: object, B: object, duration_s: float, match: str
) -> None:
    with refused("LINE", match):
        ways(A, B, duration_s)


def test_the_duration_a_refusal_names_is_enough() -> None:
    with pytest.raises(RequestRefused) as refusal:
        ways(hand.A, hand.B, 0.6)
    assert len(ways(hand.A, hand.B, float(str(refusal.value).split("give ")[1].split(" s")[0]) + 0.1))


def test_a_point_out_of_reach_keeps_the_distance_that_is_told() -> None:
    target = np.array([[0.6, 0.0, 0.1]])
    q, missed = onto(CHAIN, target, hand.joint_line()[:1], LIMITS, 60)
    np.testing.assert_allclose(missed, np.linalg.norm(target - tool_position(CHAIN, q), axis=1))
    assert missed[0] >= 0.6 - 0.38
