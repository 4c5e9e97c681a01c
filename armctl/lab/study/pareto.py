"""Error against duration and against the number of via points: how far more time or more points help.

There are two judges. The optimiser predicts an error for recorded candidates on perfect servos; a shorter duration
leaves it fewer paths that keep the joints' limits. Simulated arms run the line, corrected, and their true tool pose is
measured; faster motion lags more. A row is on a front if no other is at least as good in both and better in one.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from armctl.json_text import named
from armctl.kinematics.transform import FloatArray
from armctl.lab.study import arms
from armctl.lab.study.case import Case, Found, Row
from armctl.lab.study.workers import Workers
from armctl.report.pareto import error_mm


def every_duration(case: Case, *, durations: Sequence[float], arms: int) -> list[Case]:
    """The case in every duration [s], shortest first; so many simulated arms run what each finds."""
    return [replace(case, duration_s=duration_s, arms=arms) for duration_s in sorted(durations)]


def run(case: Case) -> Found:
    """One row for each number of via points.

    Raises:
        RequestRefused: the recordings are unfit.
    """
    result = case.optimum([count for count in case.via if isinstance(count, int)], free=True)
    found = {"duration_s": case.duration_s, **named(result, "feasible", "gap_ratio")}
    found |= {f"recorded_{key}": getattr(result.ga.path, key) for key in ("mean_error_mm", "max_error_mm")}
    plans = (named(plan, "via", "predicted_mean_error_mm", "predicted_max_error_mm") for plan in result.plans)
    return Found([found | plan for plan in plans])


def judged(rows: Sequence[Row], cases: Sequence[Case], workers: Workers) -> list[Row]:
    """The rows of `run` with the truth of the arms that ran them, if any did, and the fronts marked."""
    on_arms = [each for case in cases for each in arms.every_arm(case, arms=case.arms)]
    if on_arms:
        done = workers.carry_out("running on arms", arms.run, on_arms)
        ran = [row | {"wanted_s": each.duration_s} for each, one in zip(on_arms, done, strict=True) for row in one.rows]
        rows = with_truth(rows, ran)
    return with_fronts(rows)


def with_truth(rows: Sequence[Row], ran: Sequence[Row]) -> list[Row]:
    """The rows with the true errors of the arms that ran them: mean and spread over the arms.

    Args:
        ran: Rows of `arms.run`, each with the `wanted_s` it was asked for.
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


def with_fronts(rows: Sequence[Row]) -> list[Row]:
    """The rows with two marks: whether each is on the front of error against duration, and against via points."""
    errors = np.array([error_mm(row) for row in rows])
    for key, mark in (("duration_s", "front_duration"), ("via", "front_via")):
        on = on_front(np.array([row[key] for row in rows], dtype=float), errors)
        rows = [{**row, mark: bool(one)} for row, one in zip(rows, on, strict=True)]
    return list(rows)


def on_front(first: FloatArray, second: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which pairs are on the front, shape (m,): no other pair is better. Small is good; infinite is never on it."""
    no_worse = (first[None] <= first[:, None]) & (second[None] <= second[:, None])
    better = (first[None] < first[:, None]) | (second[None] < second[:, None])
    return np.isfinite(second) & ~(no_worse & better).any(axis=1)
