"""One line, or one plan, on many simulated arms drawn at random: masses, stall torques, friction, play, zero offsets.

One arm says little about others, because every arm of the batch is different. Each arm is calibrated, corrected and
judged by itself, by the true pose of its tool. A plan is run on each arm as it is.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armctl.errors import RequestRefused
from armctl.lab import line_results
from armctl.lab.course import Via
from armctl.lab.line_experiment import drawn_ways, experiment, identified
from armctl.lab.rig import VirtualRig
from armctl.lab.stage import silent
from armctl.lab.study.case import Case, Found, Row
from armctl.messages import LagModel

TOLD = ("mean_error_mm", "max_error_mm", "duration_s", "truth", "predicted_mean_error_mm", "predicted_max_error_mm")


def every_arm(case: Case, *, arms: int) -> list[Case]:
    """The case on so many arms, drawn by its seed and those that follow it."""
    return [replace(case, seed=case.seed + number) for number in range(arms)]


def run(case: Case) -> Found:
    """One row for each number of via points, or for the plan. `refused` says why, if this arm cannot do it."""
    rig, plan = case.rig(), case.plan
    model = identified(rig, case.rounds, case.seed) if plan is None else None
    rows: list[Row] = []
    for via in case.via if plan is None else (plan.via,):
        try:
            rows.append(_ran(case, via, rig, model))
        except RequestRefused as refusal:
            rows.append({"arm": case.seed, "via": via, "refused": str(refusal)})
    return Found(rows)


def _ran(case: Case, via: Via, rig: VirtualRig, model: LagModel | None) -> Row:
    corrected: Row = {"before": None}
    if case.plan is not None:
        plan, runs = case.plan, [rig.run(case.plan)]
    else:
        ways = drawn_ways(rig, case.line, case.seed)
        (outcome,) = experiment(rig, case.line, (via,), replace(case, repeats=1), model, ways, silent)
        plan, runs, first = outcome.best.plan, outcome.runs, outcome.rounds[0]
        before = line_results.row(case.line, via, rig, first.plan, [first.measured])["truth"]
        corrected = {"before": before, "rounds": len(outcome.rounds) - 1}
    row = line_results.row(case.line, via, rig, plan, runs)
    return {"arm": case.seed, "via": via, **{key: row[key] for key in TOLD}, "refused": None, **corrected}


def summary(rows: Sequence[Row]) -> list[Row]:
    """Median, worst and spread of the true errors over the arms, for each number of via points."""
    result = []
    for via in dict.fromkeys(row["via"] for row in rows):
        some = [row for row in rows if row["via"] == via]
        done = [row for row in some if row["refused"] is None]
        told: Row = {"via": via, "arms": len(done), "refused": len(some) - len(done)}
        for key in ("before", "truth"):
            # Mean and maximum of each arm, shape (arms, 2).
            errors = np.array([[row[key][name] for name in TOLD[:2]] for row in done if row[key] is not None])
            if len(errors):
                over = {"median": np.median(errors, axis=0), "worst": errors.max(axis=0), "spread": errors.std(axis=0)}
                told[key] = {name: {of: float(two[k]) for of, two in over.items()} for k, name in enumerate(TOLD[:2])}
        result.append(told)
    return result
