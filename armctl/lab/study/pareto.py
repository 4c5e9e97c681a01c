"""Error against duration and against the number of via points: what more time or more points buys, and what no longer.

Two judges. What the optimiser predicts for recorded candidates (perfect servos): shorter durations leave it fewer paths
that keep the joints' limits. And what simulated arms then really do, corrected, by their true tool pose: faster motion
lags more. A row is on a front if no other is at least as good in both respects and better in one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.genetic.algorithm import DEFAULT, Settings
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.placement import Objective


@dataclass(frozen=True, eq=False)
class Case:
    """One duration."""

    arm: ArmConfig
    takes: tuple[FloatArray, ...]
    """Joint positions of each recording [rad], shape (samples, joints)."""
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[int, ...]
    duration_s: float
    seed: int
    objective: Objective = "mean"
    settings: Settings = DEFAULT


def work(case: Case) -> list[dict[str, Any]]:
    """One row for each number of via points.

    Raises:
        RequestRefused: the recordings are unfit.
    """
    result = optimize(
        case.takes,
        case.arm,
        robots.get(case.arm.robot, case.arm.lengths_m),
        OptimizeRequest(
            from_m=case.from_m,
            to_m=case.to_m,
            via=case.via,
            duration_s=case.duration_s,
            seed=case.seed,
            settings=case.settings,
            objective=case.objective,
        ),
    )
    return [
        {
            "duration_s": case.duration_s,
            "via": plan.via,
            "recorded_mean_error_mm": result.ga.mean_error_mm,
            "recorded_max_error_mm": result.ga.path.max_error_mm,
            "feasible": result.feasible,
            "gap_ratio": result.gap_ratio,
            "predicted_mean_error_mm": plan.predicted_mean_error_mm,
            "predicted_max_error_mm": plan.predicted_max_error_mm,
        }
        for plan in result.plans
    ]


def with_truth(rows: Sequence[dict[str, Any]], ran: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with the true errors of the arms that ran them: mean and spread over the arms.

    Args:
        ran: Rows of `arms.work`, each with the `wanted_s` it was asked for.
    """
    result = []
    for row in rows:
        some = [one for one in ran if (one["via"], one["wanted_s"]) == (row["via"], row["duration_s"])]
        truths = [one["truth"]["mean_error_mm"] for one in some if one["refused"] is None]
        refused = sorted({one["refused"] for one in some if one["refused"] is not None})
        truth = None
        if truths:
            truth = {"mean_error_mm": float(np.mean(truths)), "spread_mm": float(np.std(truths)), "arms": len(truths)}
        result.append({**row, "truth": truth, "refused": refused})
    return result


def error_mm(row: dict[str, Any]) -> float:
    """What a row is judged by: the truth where arms were asked, else the prediction; infinite where neither ran."""
    if "truth" in row:
        return np.inf if row["truth"] is None else float(row["truth"]["mean_error_mm"])
    return float(row["predicted_mean_error_mm"]) if row["feasible"] else np.inf


def with_fronts(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, each told whether it is on the front of error against duration, and of error against via points."""
    errors = np.array([error_mm(row) for row in rows])
    fronts = {key: on_front(np.array([row[key] for row in rows], dtype=float), errors) for key in ("duration_s", "via")}
    return [
        {**row, "front_duration": bool(by_time), "front_via": bool(by_via)}
        for row, by_time, by_via in zip(rows, fronts["duration_s"], fronts["via"], strict=True)
    ]


def on_front(first: FloatArray, second: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which pairs no other beats, both to be small; shape (m,). Infinite ones never are."""
    no_worse = (first[None] <= first[:, None]) & (second[None] <= second[:, None])
    better = (first[None] < first[:, None]) | (second[None] < second[:, None])
    return np.isfinite(second) & ~(no_worse & better).any(axis=1)
