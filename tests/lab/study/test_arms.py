import pytest

from armctl.lab.line_results import true_mm
from armctl.lab.study.arms import run, summary
from armctl.lab.table_ii import through_points
from tests.lab.study.cases import case


def test_arms_differ_and_the_same_arm_repeats_its_bits() -> None:
    first, again, other = (run(one).rows for one in (case(), case(), case(seed=2)))
    assert first == again
    assert [(row["via"], row["refused"]) for row in first] == [(2, None), ("stream", None)]
    assert first[0]["truth"] != other[0]["truth"]


def test_correction_brings_an_arm_onto_the_line() -> None:
    (row,) = run(case(via=(2,), rounds=3)).rows
    assert row["before"]["mean_error_mm"] > 5.0
    assert row["truth"]["mean_error_mm"] < 2.5
    assert 1 <= row["rounds"] <= 3


def test_a_plan_is_run_as_it_stands() -> None:
    one = case(seed=0, via=(1,))
    plan = through_points(one.rig(), one)
    (row,) = run(case(plan=plan, rounds=5)).rows
    assert (row["via"], row["before"]) == (1, None)
    plain_mm, _ = true_mm(one.rig().run(plan, corrected=False), one.line)
    assert row["truth"]["mean_error_mm"] < 0.7 * plain_mm
    (refused,) = run(case(plan=plan.model_copy(update={"calibration_hash": "other"}))).rows
    assert "calibration" in refused["refused"]


def test_an_arm_that_cannot_do_it_says_why_and_is_counted() -> None:
    rows = run(case(duration_s=0.6)).rows
    assert all("s or more" in row["refused"] for row in rows)
    assert summary(rows) == [{"via": via, "arms": 0, "refused": 1} for via in (2, "stream")]


def test_a_summary_is_over_the_arms_that_ran() -> None:
    def row(mean: float) -> dict[str, object]:
        errors = {"mean_error_mm": mean, "max_error_mm": 2.0 * mean}
        return {"via": 2, "refused": None, "truth": errors, "before": None}

    (one,) = summary([row(1.0), row(2.0), row(6.0), {"via": 2, "refused": "too heavy"}])
    assert (one["arms"], one["refused"], "before" in one) == (3, 1, False)
    mean, worst = one["truth"]["mean_error_mm"], one["truth"]["max_error_mm"]["worst"]
    assert (mean["median"], worst, mean["spread"]) == (2.0, 12.0, pytest.approx((14.0 / 3.0) ** 0.5))
