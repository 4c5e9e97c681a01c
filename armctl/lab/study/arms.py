"""One line, or one plan, on many simulated arms drawn at random: masses, stall torques, friction, play, zero offsets.

How straight it comes out on one arm says little: each arm of the batch is another. Every arm is calibrated, corrected
and judged by itself, by the true pose of its tool; a plan is run on each as it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.lab import calibrate_sag, line, refine
from armctl.lab.line import Via
from armctl.lab.rig import Measured, VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.placement import Objective
from armctl.trajectory.plan import Plan


@dataclass(frozen=True)
class Case:
    """One arm, and what it shall do: each number of via points along the line, or the plan."""

    arm: ArmConfig
    seed: int
    """Which arm of the batch."""
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[Via, ...]
    duration_s: float
    rounds: int
    period_s: float
    objective: Objective = "mix"
    plan: Plan | None = None
    spec: ArmSpec = RANDOM_SPEC


def work(case: Case) -> list[dict[str, Any]]:
    """One row for each number of via points, or for the plan; `refused` tells why where this arm cannot do it."""
    rig = VirtualRig(SimulatedArm(case.arm, seed=case.seed, spec=case.spec), case.period_s)
    wanted = refine.Line(np.array(case.from_m), np.array(case.to_m), case.duration_s, case.objective)
    if case.plan is not None:
        try:
            measured = rig.run(case.plan)
        except RequestRefused as refusal:
            return [_refused(case, case.plan.via, refusal)]
        return [{**_row(case, case.plan.via, rig, wanted, case.plan, measured), "before": None}]
    found = []
    model = calibrate_sag.identify(rig, np.random.default_rng(case.seed)) if case.rounds else None
    for via in case.via:
        try:
            (outcome,) = line.experiment(
                rig,
                wanted,
                (via,),
                repeats=1,
                rounds=case.rounds,
                seed=case.seed,
                model=model,
                stage=line.silent,
            )
        except RequestRefused as refusal:
            found.append(_refused(case, via, refusal))
            continue
        before = line.row(wanted, via, rig, outcome.rounds[0].plan, [outcome.rounds[0].measured])
        row = _row(case, via, rig, wanted, outcome.best.plan, outcome.runs[0])
        found.append({**row, "before": before["truth"], "rounds": len(outcome.rounds) - 1})
    return found


def _row(case: Case, via: Via, rig: VirtualRig, wanted: refine.Line, plan: Plan, measured: Measured) -> dict[str, Any]:
    row = line.row(wanted, via, rig, plan, [measured])
    told = ("mean_error_mm", "max_error_mm", "duration_s", "truth", "predicted_mean_error_mm", "predicted_max_error_mm")
    return {"arm": case.seed, "via": via, **{key: row[key] for key in told}, "refused": None}


def _refused(case: Case, via: Via, refusal: RequestRefused) -> dict[str, Any]:
    return {"arm": case.seed, "via": via, "refused": str(refusal)}


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median, worst and spread of the true errors over the arms, for each number of via points."""
    result = []
    for via in dict.fromkeys(row["via"] for row in rows):
        some = [row for row in rows if row["via"] == via]
        done = [row for row in some if row["refused"] is None]
        one: dict[str, Any] = {"via": via, "arms": len(done), "refused": len(some) - len(done)}
        for name, key in (("before", "before"), ("truth", "truth")):
            errors = [row[key] for row in done if row[key] is not None]
            for error in ("mean_error_mm", "max_error_mm") if errors else ():
                values = np.array([values[error] for values in errors])
                one.setdefault(name, {})[error] = {
                    "median": float(np.median(values)),
                    "worst": float(values.max()),
                    "spread": float(values.std()),
                }
        result.append(one)
    return result
