"""What limits a corrected straight line: the whole experiment again with one effect of the simulator switched off.

The same arm, line and seed every time: only one effect is missing, so the difference is that effect's share. Timing is
switched off by a tick five times as short. What whole ticks alone would cost on perfect servos stands beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.lab import calibrate_sag, line, refine, trials
from armctl.lab.evidence import outcome
from armctl.lab.line import Via
from armctl.lab.rig import VirtualRig
from armctl.report.line import LineRun, Outcome, errors_mm
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory.placement import Objective

TIMING = "timing"
WITHOUT: tuple[str | None, ...] = (None, *trials.EFFECTS, TIMING)
"""What is switched off; None: nothing."""
TIMING_SHARE = 0.2


@dataclass(frozen=True)
class Case:
    """One arm and line, with one effect switched off."""

    arm: ArmConfig
    seed: int
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[Via, ...]
    duration_s: float
    rounds: int
    repeats: int
    period_s: float
    objective: Objective = "mix"
    without: str | None = None


@dataclass(frozen=True, eq=False)
class Evidence:
    """Rows of numbers, and the paths behind them."""

    rows: list[dict[str, Any]]
    outcomes: list[Outcome]


def work(case: Case) -> Evidence:
    """Calibrate the arm, run the experiment, tell the true errors.

    Raises:
        RequestRefused: the line cannot be followed, or the arm stopped.
    """
    spec = RANDOM_SPEC
    period_s = case.period_s
    if case.without == TIMING:
        period_s *= TIMING_SHARE
    elif case.without is not None:
        spec = replace(spec, **trials.EFFECTS[case.without])
    rig = VirtualRig(SimulatedArm(case.arm, seed=case.seed, spec=spec), period_s)
    wanted = refine.Line(np.array(case.from_m), np.array(case.to_m), case.duration_s, case.objective)
    model = calibrate_sag.identify(rig, np.random.default_rng(case.seed)) if case.rounds else None
    found = line.experiment(
        rig,
        wanted,
        case.via,
        repeats=case.repeats,
        rounds=case.rounds,
        seed=case.seed,
        model=model,
        stage=line.silent,
    )
    rows, outcomes = [], []
    for one in found:
        shown = outcome(rig, one)
        outcomes.append(shown)
        before = _true_mm(shown.before, wanted)
        after = np.array([_true_mm(run, wanted) for run in shown.runs])
        rows.append(
            {
                "via": one.via,
                "without": case.without,
                "before_mm": before[0],
                "before_max_mm": before[1],
                "after_mm": float(after[:, 0].mean()),
                "after_max_mm": float(after[:, 1].mean()),
                "spread_mm": float(after[:, 0].std()),
                "ticks_mm": trials.tick_floor_mm(rig, one.best, wanted)[0],
                "unseen_mm": line.unseen_mm(rig, one.best.plan)["zero_offset_mm"],
            }
        )
    return Evidence(rows, outcomes)


def with_shares(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, each told what its effect costs: error with everything less that without it [mm]."""
    whole = {row["via"]: row for row in rows if row["without"] is None}
    return [
        {
            **row,
            "before_share_mm": whole[row["via"]]["before_mm"] - row["before_mm"],
            "after_share_mm": whole[row["via"]]["after_mm"] - row["after_mm"],
        }
        for row in rows
    ]


def _true_mm(run: LineRun, wanted: refine.Line) -> tuple[float, float]:
    assert run.truth_tool_m is not None
    return errors_mm(run.truth_tool_m, wanted.A, wanted.B)
