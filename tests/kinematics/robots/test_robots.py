"""Each robot against what its paper prints."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.robots import papers
from armctl.kinematics.solution import solve
from armctl.kinematics.target import point_target
from armctl.kinematics.transform import finite
from tests.kinematics.conftest import assert_at


def test_the_five_robots_and_their_conventions() -> None:
    known = {name: robots.get(name) for name in robots.names()}
    assert all(robot.limits_rad.shape == (robot.chain.n, 2) for robot in known.values())
    assert {name: (robot.chain.convention, robot.chain.n) for name, robot in known.items()} == {
        "xiang-6dof": ("standard", 5),
        "puma560": ("standard", 6),
        "ax12-line": ("standard", 5),
        "lanzhou-4dof": ("modified", 4),
        "transfer-6dof": ("modified", 6),
    }


@pytest.mark.parametrize(
    ("name", "q_deg", "position_m"),
    [
        # Section 4.1, Fig. 5; print: x 219, z 139 mm, y not given.
        ("lanzhou-4dof", papers.FIG_5_DEG, (0.219, 0.042, 0.097)),
        # Section 2.1, initial position; print: (660, 0, 640) mm.
        ("transfer-6dof", papers.INITIAL_DEG, (0.0, -0.160, 0.450)),
        # Stretched forward it reaches 0.38 m from the shoulder.
        ("ax12-line", (0.0,) * 5, (0.38, 0.0, 0.10)),
    ],
)
def test_published_poses_hold(name: str, q_deg: tuple[float, ...], position_m: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(tool_position(robots.get(name).chain, np.radians(q_deg)), position_m, atol=1e-15)


def test_eq_2_of_lanzhou_holds() -> None:
    robot = robots.get("lanzhou-4dof")
    d1, a2, d2, a3, a4, a5 = (robot.lengths_m[name] for name in ("d1", "a2", "d2", "a3", "a4", "a5"))
    for q in np.random.default_rng(0).uniform(-math.pi, math.pi, (50, 4)):
        c1, s1 = math.cos(q[0]), math.sin(q[0])
        t2, t23, t234 = np.cumsum(q[1:]).tolist()
        out = a2 + a3 * math.cos(t2) + a4 * math.cos(t23) + a5 * math.cos(t234)
        c, s = math.cos(t234), math.sin(t234)
        expected = [
            [c1 * c, -c1 * s, -s1, c1 * out - d2 * s1],
            [s1 * c, -s1 * s, c1, s1 * out + d2 * c1],
            [-s, -c, 0.0, d1 - a3 * math.sin(t2) - a4 * math.sin(t23) - a5 * s],
        ]
        np.testing.assert_allclose(forward_kinematics(robot.chain, q)[:3], expected, atol=1e-12)


def test_the_wrist_of_transfer_is_spherical() -> None:
    chain = robots.get("transfer-6dof", {"d6": 0.0}).chain
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (20, 6))
    elsewhere = q.copy()
    elsewhere[:, 3:] += 1.0
    np.testing.assert_allclose(tool_position(chain, q), tool_position(chain, elsewhere), atol=1e-15)
    assert papers.TRANSFER.lengths_m == {"a1": 0.100, "a2": 0.450, "d4": 0.160, "d6": 0.100}


def test_model_eq_18_of_xiang_holds_for_all_three_coordinates() -> None:
    """Angles of eq. (18) count from the vertical; the hand's joint has a quarter turn in Fig. 9."""
    robot = papers.XIANG
    l1, l2, l3, l4 = (robot.lengths_m[name] for name in ("d1", "a2", "a3", "d5"))
    for q1, t2, t3, t4 in np.random.default_rng(2).uniform(-math.pi, math.pi, (50, 4)):
        q = np.array([q1, math.pi / 2.0 - t2, -t3, -t4 - math.pi / 2.0, 0.7])
        out = l2 * math.sin(t2) + l3 * math.sin(t2 + t3) + l4 * math.sin(t2 + t3 + t4)
        up = l1 + l2 * math.cos(t2) + l3 * math.cos(t2 + t3) + l4 * math.cos(t2 + t3 + t4)
        expected = [out * math.cos(q1), out * math.sin(q1), up]
        np.testing.assert_allclose(tool_position(robot.chain, q), expected, atol=1e-12)


@pytest.mark.parametrize(("name", "length"), [("puma560", "a2"), ("lanzhou-4dof", "a5"), ("transfer-6dof", "d6")])
def test_lengths_change_and_the_closed_form_with_them(name: str, length: str) -> None:
    robot = robots.get(name, {length: 0.5})
    T = forward_kinematics(robot.chain, np.full(robot.chain.n, 0.4))
    assert robot.closed_form is not None
    assert_at(robot.chain, finite(robot.closed_form.poses(T[None])), T)
    with pytest.raises(ConfigError, match="is no length"):
        robots.get(name, {length: math.nan})


@pytest.mark.parametrize("a2", [-0.1, 0.0])
def test_a_link_of_no_or_of_negative_length_is_solved_all_the_same(a2: float) -> None:
    robot = robots.get("ax12-line", {"a2": a2})
    place = tool_position(robot.chain, np.array((0.3, 0.9, -1.0, 0.4, 0.2)))
    best = solve(robot, point_target(place)).solutions[0]
    np.testing.assert_allclose(tool_position(robot.chain, np.array(best.q_rad)), place, atol=1e-6)


@given(st.lists(st.floats(-math.pi, math.pi), min_size=5, max_size=5))
def test_equations_7_to_18_of_the_line_arm_hold_with_their_two_corrections(angles: list[float]) -> None:
    robot = robots.get("ax12-line")
    d1, a2, a3, a4, a56 = (robot.lengths_m[name] for name in ("d1", "a2", "a3", "a4", "a56"))
    t1, t2, t3, t4, t5 = angles
    C1, S1, C2, S2, C4, S4 = (f(t) for t in (t1, t2, t4) for f in (math.cos, math.sin))
    C23, S23, C45, S45 = (f(t) for t in (t2 + t3, t4 + t5) for f in (math.cos, math.sin))
    along, across = a4 * C4 + a56 * C45, a4 * S4 + a56 * S45
    p_x = C1 * (a2 * C2 + a3 * C23) + C1 * C23 * along - C1 * S23 * across  # (eq. 10); print lacks the last term
    p_y = S1 * (a2 * C2 + a3 * C23) + S1 * C23 * along - S1 * S23 * across  # (eq. 14); print has a2 C2 - a3 C23
    p_z = d1 + S23 * along + C23 * across + a2 * S2 + a3 * S23  # (eq. 18)
    expected = [
        [C1 * C23 * C45 - C1 * S23 * S45, -C1 * S23 * C45 - C1 * C23 * S45, S1, p_x],  # (eqs. 7 to 10)
        [S1 * C23 * C45 - S1 * S23 * S45, -S1 * S23 * C45 - S1 * C23 * S45, -C1, p_y],  # (eqs. 11 to 14)
        [S23 * C45 + C23 * S45, C23 * C45 - S23 * S45, 0.0, p_z],  # (eqs. 15 to 18)
    ]
    np.testing.assert_allclose(forward_kinematics(robot.chain, np.array(angles))[:3], expected, atol=1e-12)


def test_lengths_are_replaced_by_name() -> None:
    longer = robots.get("ax12-line", {"a2": 0.205})
    np.testing.assert_allclose(tool_position(longer.chain, np.zeros(5)), [0.48, 0.0, 0.10], atol=1e-15)
    assert robots.get("ax12-line", {}) is robots.get("ax12-line")


def test_unknown_robot_and_unknown_length_name_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"known: .*ax12-line"):
        robots.get("hal")
    with pytest.raises(ConfigError, match="a9: no such length; known: d1, a2, a3, a4, a56"):
        robots.get("ax12-line", {"a9": 1.0})
