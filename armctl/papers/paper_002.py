"""002: the straight line of an AX-12A arm (`ax12-line`): Table II and Figs. 7 to 12 by the paper's own procedure.

Each simulated arm makes the experiments with 0, 1 and 2 intermediate points: five recordings of 100 ms a sample, of
which the genetic algorithm makes one path. Errors are by the encoders, as the paper's are; the true ones stand beside.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from armctl.files import load_arm
from armctl.genetic.algorithm import DEFAULT
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import table_ii
from armctl.lab.line_results import true_mm
from armctl.lab.stage import Stage
from armctl.lab.study.case import Case
from armctl.lab.table_ii import FROM_M, RUNS, TO_M, VIA
from armctl.papers.page import PaperReport, Picture, Row, Table
from armctl.papers.transcription import introduced
from armctl.papers.verdict import Effort, error, unprinted
from armctl.report import kinematics as drawn
from armctl.report.line import PRINTED
from armctl.report.page import Figure, axes, curve
from armctl.trajectory.straightness import distance_to_line, progress_along_line

ARM = "ax12-line"
A, B = np.array(FROM_M), np.array(TO_M)
ALONG_AND_AWAY = ("along the line [mm]", "distance from the line [mm]")
# What of an experiment is measured.
MEASURES = ("GA as printed", "GA improved", "recordings", "recordings, true")
WHY = "the arm sags, and nothing corrects it; the paper's lengths and load are not printed"


@dataclass(frozen=True, eq=False)
class Experiment:
    """One of an arm's three."""

    # Mean and maximum distance from the line [mm], shape (len(MEASURES), 2); all but the last by the encoders.
    errors_mm: FloatArray
    duration_s: float
    # Tool paths by the encoders: each recording, and what both algorithms make of them.
    recorded_m: tuple[FloatArray, ...]
    found_m: tuple[FloatArray, FloatArray]


def experiments(seed: int) -> list[Experiment]:
    """The paper's procedure on the simulated arm of a seed, without, with one and with two intermediate points."""
    arm = load_arm(ARM)
    chain = robots.get(arm.robot, arm.lengths_m).chain
    done = []
    for case in table_ii.every_experiment(Case(arm=arm, seed=seed, from_m=FROM_M, to_m=TO_M, duration_s=5.0)):
        (via,) = case.via
        found = table_ii.run(replace(case, duration_s=PRINTED[via].duration_s))
        taken = replace(case, takes=tuple(run.positions_rad for run in found.evidence))
        printed, improved = (one.optimum() for one in (taken, replace(taken, settings=DEFAULT)))
        paths = (printed.ga.path, improved.ga.path)
        recorded_m = tuple(tool_position(chain, take[:, : chain.n]) for take in taken.takes)
        errors = [(path.mean_error_mm, path.max_error_mm) for path in paths]
        # At the same stations as the paths, and not while the arm stands at an end.
        alone = [(one.mean_error_mm, one.max_error_mm) for one in printed.baseline]
        errors.append(tuple(np.mean(alone, axis=0)))
        errors.append(tuple(np.mean([true_mm(run, case.line) for run in found.evidence], axis=0)))
        found_m = (paths[0].tool_m, paths[1].tool_m)
        done.append(Experiment(np.array(errors), found.rows[0]["duration_s"], recorded_m, found_m))
    return done


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    arms = []
    with stage("002: the paper's procedure", effort.arms) as show:
        for k in range(effort.arms):
            arms.append(experiments(seed + k))
            show(k + 1, f"arm {k + 1}")
    # Shape (arms, experiments, measures, 2).
    errors_mm = np.array([[one.errors_mm for one in arm] for arm in arms])
    rows = [row for via in VIA for row in _rows(errors_mm[:, via], [arm[via] for arm in arms], via)]
    first = arms[0]
    pictures = [
        Picture("Fig. 7: individual", "one recording", lambda: _paths(first[0], 1)),
        Picture("Fig. 8: initial population", "five recordings", lambda: _paths(first[0], RUNS)),
        *(
            Picture(
                f"Fig. {9 + via}: experiment {via + 1}",
                f"recordings and what the algorithm makes of them, {via} intermediate points",
                partial(_paths, first[via], RUNS, found=True),
            )
            for via in VIA
        ),
        Picture("Fig. 12: comparison", "distance from the line over time, each experiment", lambda: _over_time(first)),
    ]
    told = introduced("002", arms=effort.arms, from_m=FROM_M, to_m=TO_M, runs=RUNS)
    return PaperReport(*told, tuple(rows), (_table(errors_mm),), tuple(pictures))


def _rows(errors_mm: FloatArray, done: list[Experiment], via: int) -> list[Row]:
    """Of one experiment, errors of shape (arms, measures, 2)."""
    rows, print_ = [], PRINTED[via]
    for k, name in enumerate(MEASURES):
        for of, printed, values in zip(("mean", "maximum"), print_[:2], errors_mm[:, k].T, strict=True):
            quantity = f"Table II, experiment {via + 1}, {of} error, {name}, median of {len(values)} arms"
            median = float(np.median(values))
            rows.append(error(quantity, printed, median, "mm", why=WHY) if k < 2 else unprinted(quantity, median, "mm"))
    took = float(np.mean([one.duration_s for one in done]))
    verdict = "equal" if abs(took - print_.duration_s) < 0.05 else f"differs: the arm needs {took:.1f} s for this plan"
    name = f"Table II, experiment {via + 1}, time (asked for as printed)"
    return [*rows, Row(name, print_.duration_s, took, "s", verdict)]


def _table(errors_mm: FloatArray) -> Table:
    """Medians and spread of errors, shape (arms, experiments, measures, 2), beside Table II."""
    rows: list[tuple[str, ...]] = []
    for via in VIA:
        mean_mm, max_mm, _ = PRINTED[via]
        rows.append((str(via + 1), "print", f"{mean_mm:.2f}", "", f"{max_mm:.2f}", ""))
        for k, name in enumerate(MEASURES):
            low, median, high = np.percentile(errors_mm[:, via, k], (25, 50, 75), axis=0)
            told = (f"{value:.2f}" for of in (0, 1) for value in (median[of], high[of] - low[of]))
            rows.append((str(via + 1), name, *told))
    header = ("experiment", "", "mean", "its spread", "maximum", "its spread")
    note = f"mm; medians of {len(errors_mm)} arms, spread: between quartiles; by the encoders if nothing is said"
    return Table("Table II: by the paper's procedure", header, tuple(rows), note)


def _away_mm(tool_m: FloatArray) -> FloatArray:
    return distance_to_line(tool_m, A, B) * 1e3


def _paths(one: Experiment, runs: int, *, found: bool = False) -> Figure:
    figure = axes(*ALONG_AND_AWAY, 400)
    drawn_m = [(f"recording {k + 1}", path, drawn.COLOURS[3], 1) for k, path in enumerate(one.recorded_m[:runs])]
    if found:
        best = zip(MEASURES, one.found_m, (drawn.COLOURS[0], drawn.COLOURS[2]), (5, 2), strict=False)
        drawn_m += best
    for name, tool_m, colour, width in drawn_m:
        along = progress_along_line(tool_m, A, B) * float(np.linalg.norm(B - A)) * 1e3
        curve(figure, along, _away_mm(tool_m), name, colour, width=width)
    return figure


def _over_time(done: list[Experiment]) -> Figure:
    figure = axes("time [s]", "distance from the line, GA as printed [mm]", 420)
    for via, one in enumerate(done):
        away = _away_mm(one.found_m[0])
        time_s = np.linspace(0.0, one.duration_s, len(away))
        name, colour = f"experiment {via + 1}", drawn.COLOURS[2 * via]
        curve(figure, time_s, away, name, colour)
        line = {"dash": "dot", "color": colour}
        figure.add_hline(y=PRINTED[via][0], line=line, annotation_text=f"mean in print, {via + 1}")
    return figure
