from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.genetic.algorithm import DEFAULT
from armctl.lab.study.case import Row, all_rows
from armctl.lab.study.pareto import every_duration, on_front, run, with_fronts, with_truth
from tests.genetic import hand
from tests.lab.study.cases import case

pairs = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12)


@given(pairs)
def test_on_the_front_is_who_no_other_beats(points: list[tuple[int, int]]) -> None:
    first, second = np.array(points, dtype=float).T
    for point, front in zip(points, on_front(first, second), strict=True):
        beaten = any(a <= point[0] and b <= point[1] and (a, b) != point for a, b in points)
        assert front == (not beaten)


def test_what_could_not_be_done_is_on_no_front() -> None:
    assert on_front(np.array([1.0, 2.0]), np.array([np.inf, 3.0])).tolist() == [False, True]


def optimised(*durations_s: float) -> list[Row]:
    start = case(
        from_m=(0.18, -0.125, 0.10), to_m=(0.18, 0.125, 0.10), via=(0, 2), seed=0, objective="mean",
        takes=tuple(hand.recordings(3, 2)), settings=replace(DEFAULT, generations=30),
    )  # fmt: skip
    return all_rows([run(each) for each in every_duration(start, durations=durations_s, arms=0)])


def test_too_short_a_duration_is_not_feasible_and_a_longer_one_is() -> None:
    rows = optimised(5.0, 0.5)
    assert [(row["duration_s"], row["via"]) for row in rows] == [(0.5, 0), (0.5, 2), (5.0, 0), (5.0, 2)]
    assert [row["feasible"] for row in rows] == [False, False, True, True]
    marked = with_fronts(rows)
    assert [row["front_duration"] for row in marked] == [False, False, False, True]
    assert [row["front_via"] for row in marked] == [False, False, True, True]


def test_where_arms_ran_their_truth_counts_and_who_was_refused_is_out() -> None:
    rows = optimised(5.0)
    ran: list[Row] = [
        {"via": via, "wanted_s": wanted_s, "refused": None, "truth": {"mean_error_mm": mean_mm}}
        for via, wanted_s, mean_mm in ((0, 5.0, 4.0), (0, 5.0, 2.0), (2, 9.0, 0.1))
    ]
    ran.append({"via": 2, "wanted_s": 5.0, "refused": "too heavy"})
    none, two = with_fronts(with_truth(rows, ran))
    assert none["truth"] == {"mean_error_mm": 3.0, "spread_mm": pytest.approx(1.0), "arms": 2}
    assert (two["truth"], two["refused"]) == (None, ["too heavy"])
    assert [row["front_via"] for row in (none, two)] == [True, False]
