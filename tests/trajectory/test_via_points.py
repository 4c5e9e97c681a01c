from itertools import combinations

import numpy as np
import pytest

from armctl.kinematics.chain import tool_position
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.straightness import max_error, mean_error
from armctl.trajectory.via_points import SAMPLES, choose_via_points, predict_tool_path
from tests.genetic import hand

CHAIN = hand.robot().chain
LINE = hand.joint_line()[::4]
PROGRESS = np.linspace(0.0, 1.0, len(LINE))


def error_mm(indices: tuple[int, ...], kind: Interpolation) -> float:
    kept = [0, *indices, len(LINE) - 1]
    tool = predict_tool_path(CHAIN, LINE[kept], PROGRESS[kept], kind)
    return float(mean_error(tool, hand.A, hand.B)) * 1e3


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("count", [1, 2])
def test_up_to_two_via_points_are_the_best_of_all_choices(kind: Interpolation, count: int) -> None:
    chosen = choose_via_points(CHAIN, LINE, PROGRESS, count, kind, hand.A, hand.B)
    best = min(combinations(range(1, len(LINE) - 1), count), key=lambda indices: error_mm(indices, kind))
    assert error_mm(chosen, kind) == error_mm(best, kind)


@pytest.mark.parametrize("count", [3, 5])
def test_no_exchange_of_one_via_point_improves_more_of_them(count: int) -> None:
    chosen = choose_via_points(CHAIN, LINE, PROGRESS, count, "linear", hand.A, hand.B)
    assert len(set(chosen)) == count
    assert list(chosen) == sorted(chosen)
    found = error_mm(chosen, "linear")
    for old in chosen:
        rest = [index for index in chosen if index != old]
        for new in set(range(1, len(LINE) - 1)) - set(chosen):
            assert error_mm(tuple(sorted([*rest, new])), "linear") >= found


def test_every_further_via_point_on_the_line_makes_it_straighter() -> None:
    errors = [
        error_mm(choose_via_points(CHAIN, LINE, PROGRESS, count, "linear", hand.A, hand.B), "linear")
        for count in range(5)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[2] < 0.15 * errors[0]


def test_all_inner_points_and_none_are_possible_and_more_are_not() -> None:
    short, progress = LINE[::4], PROGRESS[::4]
    assert choose_via_points(CHAIN, short, progress, 0, "cubic", hand.A, hand.B) == ()
    assert choose_via_points(CHAIN, short, progress, 3, "cubic", hand.A, hand.B) == (1, 2, 3)
    with pytest.raises(ValueError, match="4 via points wanted from a path with 3"):
        choose_via_points(CHAIN, short, progress, 4, "cubic", hand.A, hand.B)


def test_predicted_motion_begins_at_A_and_ends_at_B() -> None:
    tool = predict_tool_path(CHAIN, LINE[[0, 8, 16]], PROGRESS[[0, 8, 16]], "cubic")
    assert tool.shape == (SAMPLES, 3)
    np.testing.assert_allclose(tool[[0, -1]], tool_position(CHAIN, LINE[[0, 16]]), atol=1e-12)
    assert float(max_error(tool, hand.A, hand.B)) < 0.005
