from __future__ import annotations

from dataclasses import replace

import pytest

from armctl.lab.rig import VirtualRig
from armctl.lab.study.arms import Case, summary, work
from armctl.lab.study.table_ii import Case as Experiment
from armctl.lab.study.table_ii import _through_points
from armctl.sim.arm import SimulatedArm
from tests.genetic import hand

A, B = (0.18, -0.1, 0.10), (0.18, 0.1, 0.10)


def case(**changes: object) -> Case:
    plain = Case(hand.arm(), 1, A, B, (2, "stream"), 5.0, rounds=0, period_s=0.1)
    return replace(plain, **changes)  # type: ignore[arg-type]


def test_arms_differ_and_the_same_arm_repeats_its_bits() -> None:
    first, again, other = work(case()), work(case()), work(case(seed=2))
    assert first == again
    assert [row["via"] for row in first] == [2, "stream"]
    assert all(row["refused"] is None for row in first)
    assert first[0]["truth"] != other[0]["truth"]


def test_correction_brings_an_arm_onto_the_line() -> None:
    (row,) = work(case(via=(2,), rounds=3))
    assert row["before"]["mean_error_mm"] > 5.0
    assert row["truth"]["mean_error_mm"] < 2.5
    assert 1 <= row["rounds"] <= 3


def test_a_plan_is_run_as_it_stands() -> None:
    rig = VirtualRig(SimulatedArm(hand.arm(), seed=0))
    plan = _through_points(rig, Experiment(hand.arm(), A, B, 1, 5.0, seed=0))
    (row,) = work(case(plan=plan, rounds=5))
    assert row["via"] == 1
    assert row["before"] is None
    assert row["truth"]["mean_error_mm"] > 5.0  # nothing corrected it
    (refused,) = work(case(plan=plan.model_copy(update={"calibration_hash": "other"})))
    assert "calibration" in refused["refused"]


def test_an_arm_that_cannot_do_it_says_why_and_is_counted() -> None:
    rows = work(case(duration_s=0.6))
    assert all("s or more" in row["refused"] for row in rows)
    assert summary(rows) == [
        {"via": 2, "arms": 0, "refused": 1},
        {"via": "stream", "arms": 0, "refused": 1},
    ]


def test_a_summary_is_over_the_arms_that_ran() -> None:
    def row(mean: float) -> dict[str, object]:
        errors = {"mean_error_mm": mean, "max_error_mm": 2.0 * mean}
        return {"via": 2, "refused": None, "truth": errors, "before": None}

    (one,) = summary([row(1.0), row(2.0), row(6.0), {"via": 2, "refused": "too heavy"}])
    assert (one["arms"], one["refused"]) == (3, 1)
    assert "before" not in one
    assert one["truth"]["mean_error_mm"]["median"] == 2.0
    assert one["truth"]["max_error_mm"]["worst"] == 12.0
    assert one["truth"]["mean_error_mm"]["spread"] == pytest.approx((14.0 / 3.0) ** 0.5)
