import numpy as np
import pytest

from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.trajectory.line_path import MARGIN_RAD, STATIONS, levers_m, line_paths, onto, sensitivity_m
from tests.genetic import hand
from tests.host.doubles import refused
from tests.trajectory.conftest import ARM, CHAIN, LIMITS, ROBOT


def ways(A: object, B: object, duration_s: float = 5.0, seed: int = 0) -> np.ndarray:
    return line_paths(ARM, ROBOT, np.array(A), np.array(B), duration_s, np.random.default_rng(seed), most=40)


@pytest.fixture(scope="module")
def found() -> np.ndarray:
    return ways(hand.A, hand.B)


def test_every_way_is_on_the_line_at_every_station_and_within_limits(found: np.ndarray) -> None:
    assert found.shape[1:] == (STATIONS, 5)
    on_line = hand.A + np.linspace(0.0, 1.0, STATIONS)[:, None] * (hand.B - hand.A)
    np.testing.assert_allclose(
        tool_position(CHAIN, found), np.broadcast_to(on_line, (len(found), STATIONS, 3)), atol=2e-6
    )
    assert (found >= LIMITS[:, 0] + MARGIN_RAD).all()
    assert (found <= LIMITS[:, 1] - MARGIN_RAD).all()


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
        moved = q.copy()
        moved[joint] += 1e-6
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
