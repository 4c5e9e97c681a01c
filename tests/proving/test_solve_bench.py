"""The bench of `solve`: a small one for real, a search of its own that finds, and defects that it must see."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.kinematics.chain import forward_kinematics
from armctl.kinematics.solution import Answer, solve
from proving import solve_bench
from proving.drawn_arms import DrawnArm
from proving.solve_bench import CLOSED, DRAWN, FAMILIES, judged, search
from proving.truth import FloatArray

FEW = (40, 20, 3)


def drawn_q(arm: DrawnArm, count: int) -> FloatArray:
    low, high = arm.limits_rad.T
    return np.random.default_rng(count).uniform(low, high, (count, arm.n))


@pytest.mark.parametrize("name", [*CLOSED, *FAMILIES, *DRAWN])
def test_the_judge_has_the_tool_where_the_package_has_it(name: str | int) -> None:
    robot, arm = solve_bench._arm(1, name)
    q = drawn_q(arm, 20)
    np.testing.assert_allclose(arm.tool_pose(q), forward_kinematics(robot.chain, q), atol=1e-11)


@pytest.mark.parametrize("name", CLOSED)
def test_nothing_is_missed_where_there_is_a_closed_form(name: str) -> None:
    told = judged(*solve_bench._arm(1, name), 1, *FEW)
    assert (told.poses, told.none_found, told.missed, told.farther, told.left) == (60, 0, 0, 0, 0)
    assert told.searched >= 4


def test_the_search_finds_the_postures_of_a_spherical_wrist() -> None:
    robot, arm = solve_bench._arm(1, "puma560")
    T = arm.tool_pose(drawn_q(arm, 1))[0]
    found = search(arm, T, drawn_q(arm, 200))
    np.testing.assert_allclose(arm.tool_pose(found), np.broadcast_to(T, (len(found), 4, 4)), atol=1e-6)
    assert robot.closed_form is not None
    for one in robot.closed_form.pose(T.tolist()):
        assert solve_bench._apart(found, np.array(one)).min() < 1e-4


@pytest.mark.parametrize(("cut", "seen"), [
    (lambda told: told.solutions[:1], "missed"), (lambda told: told.solutions[::-1], "missed"),
    (lambda told: tuple(replace(one, within_limits=False) for one in told.solutions), "none_found"),
])  # fmt: skip
def test_what_is_left_out_or_sorted_wrongly_is_seen(monkeypatch: pytest.MonkeyPatch, cut: Any, seen: str) -> None:
    def less(*asked: Any, **how: Any) -> Answer:
        told = solve(*asked, **how)
        return Answer(told.reachable, told.least_position_error_m, tuple(cut(told)))

    monkeypatch.setattr(solve_bench, "solve", less)
    told = judged(*solve_bench._arm(1, "puma560"), 1, *FEW)
    assert getattr(told, seen) > 0


def test_rows_and_checks_of_one_arm_stand_beside_others() -> None:
    result = solve_bench.bench(1, poses=(10, 0, 2), arms=("puma560",))
    told = {check["name"]: check["value"] for check in result["checks"]}
    assert told["puma560: postures missed"] == 0
    peers = [row["who"] for row in result["rows"] if "alone, median" in row["work"]]
    assert [who.split(",")[0] for who in peers] == ["armctl"] * 2 + ["roboticstoolbox"] * 2 + ["pinocchio"]
