"""002: the straight line of an AX-12A arm (`ax12-line`): Table II and Figs. 7 to 12 by the paper's own procedure.

Each simulated arm makes the experiments with 0, 1 and 2 intermediate points: five recordings of 100 ms a sample, of
which the genetic algorithm makes one path. Errors are by the encoders, as the paper's are; the true ones stand beside.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

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
from armctl.papers.comparison import Effort, PaperReport, Picture, Row, Table, error, unprinted
from armctl.papers.transcription import introduced
from armctl.report import kinematics as drawn
from armctl.report.line import ALONG, PRINTED, distance_curve, paths_in_space
from armctl.report.page import Figure, axes, curve
from armctl.trajectory.plan import plan_positions
from armctl.trajectory.straightness import distance_to_line

ARM = "ax12-line"
A, B = np.array(FROM_M), np.array(TO_M)
# What of an experiment is measured.
MEASURES = ("GA as printed", "GA improved", "recordings", "recordings, true", "interpolated joints")
# By intermediate points: most of what recordings are off without any is in their goals, with some it is not.
SAGS = "the arm sags, and nothing corrects it; the paper's lengths and load are not printed"
WHY = ("joints interpolated between the ends bend this line; the paper's line and lengths are not printed", SAGS, SAGS)


class Experiment(NamedTuple):
    """One of an arm's three."""

    # Mean and maximum distance from the line [mm], shape (len(MEASURES), 2), by the encoders if nothing is said.
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
        case = replace(case, duration_s=PRINTED[via].duration_s)
        plan, runs, taken = table_ii.recorded(case)
        printed, improved = (one.optimum() for one in (taken, replace(taken, settings=DEFAULT)))
        paths = (printed.ga.path, improved.ga.path)
        recorded_m = tuple(tool_position(chain, take[:, : chain.n]) for take in taken.takes)
        found_mm = [(path.mean_error_mm, path.max_error_mm) for path in paths]
        # At the same stations as the paths, and not while the arm stands at an end.
        found_mm.append(tuple(np.mean([(one.mean_error_mm, one.max_error_mm) for one in printed.baseline], axis=0)))
        found_mm.append(tuple(np.mean([true_mm(run, case.line) for run in runs], axis=0)))
        goals = plan_positions(plan, np.arange(0.0, plan.duration_s, table_ii.PERIOD_S))
        found_mm.append(case.line.errors_mm(tool_position(chain, goals[:, : chain.n])))
        took_s = float(np.mean([run.duration_s for run in runs]))
        done.append(Experiment(np.array(found_mm), took_s, recorded_m, (paths[0].tool_m, paths[1].tool_m)))
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
    pictures = _views("Fig. 7: individual", "one recording, sample by sample", first[0], 1)
    pictures += _views("Fig. 8: initial population", "five recordings", first[0], RUNS)
    for via in VIA:
        pictures += _views(f"Fig. {9 + via}: experiment {via + 1}", f"{via} intermediate points", first[via])
    together = "distance over time, each by the GA as printed"
    pictures.append(Picture("Fig. 12: comparison", together, partial(_over_time, first)))
    told = introduced("002", arms=effort.arms, from_m=FROM_M, to_m=TO_M, runs=RUNS)
    return PaperReport(*told, tuple(rows), (_table(errors_mm),), tuple(pictures))


def _rows(errors_mm: FloatArray, done: list[Experiment], via: int) -> list[Row]:
    """Of one experiment, errors of shape (arms, measures, 2)."""
    rows, print_ = [], PRINTED[via]
    for k, name in enumerate(MEASURES):
        for of, printed, values in zip(("mean", "maximum"), print_[:2], errors_mm[:, k].T, strict=True):
            quantity = f"Table II, experiment {via + 1}, {of} error, {name}, median of {len(values)} arms"
            median = float(np.median(values))
            scored = error(quantity, printed, median, "mm", why=WHY[via])
            rows.append(scored if k < 2 else unprinted(quantity, median, "mm"))
    took = float(np.mean([one.duration_s for one in done]))
    verdict = "equal" if abs(took - print_.duration_s) < 0.05 else f"differs: the arm needs {took:.1f} s for this plan"
    name = f"Table II, experiment {via + 1}, time (asked for as printed)"
    return [*rows, Row(name, print_.duration_s, took, "s", verdict)]


def _table(errors_mm: FloatArray) -> Table:
    """Medians and spread of errors, shape (arms, experiments, measures, 2), beside Table II."""
    rows: list[tuple[str, ...]] = []
    for via in VIA:
        mean_mm, max_mm, _ = PRINTED[via]
        rows.append((f"{via + 1}, print", f"{mean_mm:.2f}", "", f"{max_mm:.2f}", ""))
        for k, name in enumerate(MEASURES):
            low, median, high = np.percentile(errors_mm[:, via, k], (25, 50, 75), axis=0)
            told = (f"{value:.2f}" for of in (0, 1) for value in (median[of], high[of] - low[of]))
            rows.append((f"{via + 1}, {name}", *told))
    header = ("experiment", "mean", "its spread", "maximum", "its spread")
    note = f"mm; medians of {len(errors_mm)} arms, spread: between quartiles; by the encoders if nothing is said"
    return Table("Table II: by the paper's procedure", header, tuple(rows), note)


def _views(title: str, described: str, one: Experiment, runs: int | None = None) -> list[Picture]:
    """Recordings in space and away from the line: the first `runs` alone, or all and what both algorithms make of them.

    The first and the last gene of a path stand on the line, where the recordings are not: its ends are held.
    """
    paths = [(f"recording {k + 1}", path, drawn.COLOURS[3]) for k, path in enumerate(one.recorded_m[:runs])]
    if runs is None:
        paths += zip(MEASURES, one.found_m, (drawn.COLOURS[0], drawn.COLOURS[2]), strict=False)

    def space() -> Figure:
        figure = axes("", "", drawn.HEIGHT)
        paths_in_space(figure, (A, B), paths)
        return figure

    def away() -> Figure:
        figure = axes(ALONG, "distance from the line, mm", drawn.HEIGHT, rangemode="tozero")
        mode = "lines+markers" if runs == 1 else "lines"
        for name, tool_m, colour in paths:
            distance_curve(figure, (A, B), tool_m, name, colour, width=4 if name == MEASURES[0] else 1.5, mode=mode)
        return figure

    return [Picture(title, f"{described}, in space", space), Picture(title, f"{described}, from the line AB", away)]


def _over_time(done: list[Experiment]) -> Figure:
    figure = axes("time [s]", "distance from the line [mm]", drawn.HEIGHT)
    for via, one in enumerate(done):
        away = distance_to_line(one.found_m[0], A, B) * 1e3
        name, colour = f"experiment {via + 1}", drawn.COLOURS[2 * via]
        curve(figure, np.linspace(0.0, one.duration_s, len(away)), away, name, colour)
        ends, mean = [0.0, PRINTED[via].duration_s], PRINTED[via].mean_error_mm
        curve(figure, ends, [mean, mean], f"{name}, mean in print", colour, dash="dot")
    return figure
