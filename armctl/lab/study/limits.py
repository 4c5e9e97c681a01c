"""What limits a corrected straight line: the whole experiment again with one effect of the simulator switched off.

Arm, line and seed are the same every time. Only one effect is missing, so the difference is the share of that effect.
Timing is switched off by a tick that is five times as short. A further column tells the error that whole ticks alone
cause on perfect servos.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armctl.kinematics.chain import tool_position
from armctl.lab.line_experiment import drawn_ways, experiment, guided_takes, identified
from armctl.lab.line_results import drawn, unseen_mm
from armctl.lab.rig import VirtualRig
from armctl.lab.stage import silent
from armctl.lab.study import pareto
from armctl.lab.study.case import Case, Found, Row, all_rows
from armctl.lab.study.workers import Workers
from armctl.report import experiment as page
from armctl.report.line import ExperimentReport
from armctl.sim.spec import EFFECTS as EFFECTS
from armctl.trajectory.course import Line, sent_rad, ticks_of
from armctl.trajectory.interpolate import columns_at, time_law
from armctl.trajectory.line_path import onto
from armctl.trajectory.plan import plan_positions
from armctl.trajectory.refinement import Round
from armctl.trajectory.straightness import errors_mm

TIMING_SHARE = 0.2
# Durations of the fronts on the page, over the one asked for.
FRONT_SHARES = (0.5, 0.7, 1.0, 1.6, 2.4)


def every_effect(case: Case) -> list[Case]:
    """The case as it is, then with each effect switched off."""
    return [
        case,
        *(replace(case, without=effect, spec=replace(case.spec, **off)) for effect, off in EFFECTS.items()),
        replace(case, without="timing", period_s=case.period_s * TIMING_SHARE),
    ]


def run(case: Case) -> Found:
    """Calibrate the arm, run the experiment and tell the true errors. The evidence is what a page draws.

    Raises:
        RequestRefused: the line cannot be followed, or the arm stopped.
    """
    rig, line = case.rig(), case.line
    model = identified(rig, case.rounds, case.seed)
    outcomes = experiment(rig, line, case.via, case, model, drawn_ways(rig, line, case.seed), silent)
    shown = [drawn(rig, outcome) for outcome in outcomes]
    rows = []
    for outcome, paths in zip(outcomes, shown, strict=True):
        # On a simulated arm the real path is the true one.
        before, *after = (errors_mm(run.real_tool_m, line.A, line.B) for run in (paths.before, *paths.runs))
        mean_mm, max_mm = np.array(after).T
        seen = {"before_mm": before[0], "before_max_mm": before[1], "spread_mm": float(mean_mm.std())}
        seen |= {"after_mm": float(mean_mm.mean()), "after_max_mm": float(max_mm.mean())}
        seen["ticks_mm"] = tick_floor_mm(rig, outcome.best, line)[0]
        seen["unseen_mm"] = unseen_mm(rig, outcome.best.plan)["zero_offset_mm"]
        rows.append({"via": outcome.via, "without": case.without, **seen})
    return Found(rows, shown)


def with_shares(rows: Sequence[Row], *_: object) -> list[Row]:
    """The rows, each with the share of its effect: the error with all effects less the error without this one [mm]."""
    whole = {row["via"]: row for row in rows if row["without"] is None}
    return [
        row | {f"{when}_share_mm": whole[row["via"]][f"{when}_mm"] - row[f"{when}_mm"] for when in ("before", "after")}
        for row in rows
    ]


def write(path: Path, cases: Sequence[Case], found: Sequence[Found], rows: Sequence[Row], workers: Workers) -> None:
    """Write the page with all the evidence, the fronts of `pareto` among it."""
    case = cases[0]
    report = ExperimentReport(
        ends=(case.line.A, case.line.B),
        outcomes=found[0].evidence,
        limits=rows,
        fronts=_fronts(replace(case, via=tuple(via for via in case.via if isinstance(via, int))), workers),
        notes=(f"Simulated arm {case.seed} of the batch, {case.repeats} repeats of each final plan.",),
    )
    page.write(report, path)


def _fronts(case: Case, workers: Workers) -> list[Row]:
    takes = tuple(guided_takes(case.rig(), case.line, case.seed, workers.stage))
    durations = [case.duration_s * share for share in FRONT_SHARES] if case.via else []
    cases = pareto.every_duration(replace(case, takes=takes), durations=durations, arms=1)
    # The genetic algorithm makes the mean small, whatever the correction on the arms does.
    found = workers.carry_out("optimising", pareto.run, [replace(one, objective="mean") for one in cases])
    return pareto.judged(all_rows(found), cases, workers)


def tick_floor_mm(rig: VirtualRig, best: Round, line: Line) -> tuple[float, float]:
    """Mean and largest error that whole ticks alone cause on perfect servos [mm]: goals rounded, linear between."""
    chain = rig.robot.chain
    time_s = np.linspace(0.0, line.duration_s, 10 * (ticks_of(line.duration_s, rig.period_s) - 1) + 1)
    goals = plan_positions(best.plan, time_s)[:, : chain.n]
    rounding = columns_at(time_s, time_s[::10], sent_rad(rig.arm, goals[::10]) - goals[::10])
    along = line.A + time_law(time_s / line.duration_s)[:, None] * (line.B - line.A)
    straight = onto(chain, along, goals, np.tile([-np.pi, np.pi], (chain.n, 1)), 12)[0]
    return line.errors_mm(tool_position(chain, straight + rounding))
