"""The straight-line report: what was taught, what the optimiser made of it, how straight the arm then moved."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report.page import Page, curve, in_space
from armctl.trajectory.straightness import distance_to_line, errors_mm, own_chord_mm


class Printed(NamedTuple):
    """What the paper prints of one experiment."""

    mean_error_mm: float
    max_error_mm: float
    duration_s: float


# By number of via points, Raharjo et al. Table II; `armctl/lab/table_ii.py` makes that table anew.
PRINTED: dict[int | str, Printed] = {
    0: Printed(10.1499, 19.51644, 5.0),
    1: Printed(7.42501, 16.52173, 7.7),
    2: Printed(7.00036, 14.69483, 7.8),
}

# What was done about the arm's lag: nothing, the control step led goals by it, or further runs corrected the plan too.
Goals = Literal["plain", "corrected", "refined"]

COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3")
FAINT, GREY, GREEN = "#b9c2cd", "#7d8b99", "#2a7f62"
# Of a genetic algorithm, at least.
SHOWN_GENERATIONS = 10
ALONG, OFF = "along the line, mm", "off the line, mm"
# Which of `along_and_off` is seen from where.
VIEWS = ((1, "from above: sideways deviation"), (2, "from the side: upward deviation"))


@dataclass(frozen=True)
class LineRun:
    """One execution of one plan; paths in the base frame [m], times from the plan's start [s]."""

    # How many, or "stream".
    via: int | str
    duration_s: float
    predicted_mean_mm: float
    predicted_max_mm: float
    predicted_tool_m: FloatArray
    via_tool_m: FloatArray
    time_s: FloatArray
    positions_rad: FloatArray
    goals_rad: FloatArray
    # By the encoders.
    tool_m: FloatArray
    # By an outside measurement (the simulator's true pose), where there is one.
    truth_tool_m: FloatArray | None = None
    goals: Goals = "plain"

    @property
    def real_tool_m(self) -> FloatArray:
        """Where the tool was: really, if that is known, else by the encoders."""
        return self.tool_m if self.truth_tool_m is None else self.truth_tool_m

    @property
    def told(self) -> str:
        """Its name among others: `2 via, corrected`."""
        return f"{self.via} via, {self.goals}"


@dataclass(frozen=True, eq=False)
class DrawnOutcome:
    """What became of one number of via points."""

    via: int | str
    # The plain plan on the arm as it is.
    before: LineRun
    # The best corrected plan, repeated.
    runs: Sequence[LineRun]
    # Each correction in order, from the plain plan on.
    rounds: Sequence[LineRun]


# Of a line AB [m], each shape (3,).
Ends = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class ExperimentReport:
    """Everything the page shows. Parts without data are left out."""

    ends: Ends
    outcomes: Sequence[DrawnOutcome]
    # Of the genetic algorithm, by generation.
    best_cost_mm: Sequence[float] = ()
    exact_mean_mm: float | None = None
    # True mean errors [mm] with one effect switched off: `via`, `without` (None: with all), `before_mm`, `after_mm`,
    # `spread_mm`, `ticks_mm`, `unseen_mm`.
    limits: Sequence[dict[str, Any]] = ()
    # Rows of `armctl study pareto`.
    fronts: Sequence[dict[str, Any]] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class LineReport:
    """Everything the page shows."""

    ends: Ends
    joint_names: Sequence[str]
    candidates_m: Sequence[FloatArray]
    # Name, mean and maximum error of each candidate, and at how many stations the genetic algorithm took it.
    candidate_errors_mm: Sequence[tuple[str, float, float, int]]
    ga_mean_mm: float
    exact_mean_mm: float
    gap_ratio: float
    # Best and mean cost by generation.
    best_mm: FloatArray
    mean_mm: FloatArray
    runs: Sequence[LineRun]
    notes: Sequence[str] = ()


def write(report: LineReport, path: Path) -> None:
    """Write the page."""
    page = Page("Straight line: taught, optimised, run")
    begin, end = map(point_text, report.ends)
    page.text(
        f"The tool was to move from ({begin}) to ({end}) m in a straight line. "
        f"{len(report.candidates_m)} hand-guided recordings went into the genetic algorithm; the arm then ran its "
        "result through 0, 1 and 2 intermediate points: plain, with the plan's own positions as goals, then corrected "
        "by what the plain runs had shown of the arm, then refined by a further run.",
        *report.notes,
    )
    _table(page, report)
    _path_figures(page, report)
    _deviation_figure(page, report)
    _convergence_figure(page, report)
    _joint_figures(page, report)
    page.write(path)


def point_text(point: FloatArray) -> str:
    return ", ".join(f"{value:.3f}" for value in point)


def _table(page: Page, report: LineReport) -> None:
    rows = []
    for run in report.runs:
        encoder = errors_mm(run.tool_m, *report.ends)
        truth = None if run.truth_tool_m is None else errors_mm(run.truth_tool_m, *report.ends)
        own = None if run.truth_tool_m is None else own_chord_mm(run.truth_tool_m)
        paper = PRINTED.get(run.via)
        pairs = ((run.predicted_mean_mm, run.predicted_max_mm), encoder, paper and paper[:2], truth, own)
        told = ("-" if pair is None else "{:.1f} / {:.1f}".format(*pair) for pair in pairs)
        took = "-" if paper is None else f"{paper.duration_s:.1f}"
        rows.append((run.via, run.goals, *told, f"{run.duration_s:.1f}", took))
    page.heading("Distance from the line")
    page.table(
        ("via points", "goals", "predicted", "by encoders", "paper", "true", "own line", "time s", "paper's time s"),
        rows,
        "Mean / maximum distance of the tool from the line AB, mm (eqs. 19, 20). Predicted: the commanded motion on "
        "perfect servos. By encoders: servo angles through forward kinematics, as the paper measured its Table II. "
        "True: the tool's real place, with sag under gravity, play and zero offsets. Own line: the real path against "
        "the straight line that fits it best.",
    )
    page.heading("Candidates")
    found = (("genetic algorithm", report.ga_mean_mm), ("exact optimum of the same genes", report.exact_mean_mm))
    page.table(
        ("recording", "mean mm", "maximum mm", "genes taken"),
        [(name, f"{mean:.2f}", f"{largest:.2f}", genes) for name, mean, largest, genes in report.candidate_errors_mm]
        + [(name, f"{mean:.3f}", "", "") for name, mean in found],
        "A gene is one recording's configuration, or the mean of two, which counts for both. It is a memetic "
        "algorithm: its crossover finds the cheapest mixture of two parents exactly, by dynamic programming. "
        f"The genetic algorithm is {report.gap_ratio * 100.0:.2f} % above the exact optimum (dynamic programming).",
    )


def along_and_off(
    tool_m: FloatArray, from_m: FloatArray, to_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Progress along AB, sideways (horizontal) and upward deviation from it [mm]."""
    direction = (to_m - from_m) / np.linalg.norm(to_m - from_m)
    sideways = np.cross(direction, (0.0, 0.0, 1.0))
    if np.linalg.norm(sideways) < 1e-6:  # a vertical line has no horizontal direction of its own
        sideways = np.array([1.0, 0.0, 0.0])
    sideways = sideways / np.linalg.norm(sideways)
    upward = np.cross(sideways, direction)
    offset = (tool_m - from_m) * 1000.0
    return offset @ direction, offset @ sideways, offset @ upward


def _path_figures(page: Page, report: LineReport) -> None:
    page.heading("Path against line, in space, from above and from the side")
    ends, runs = report.ends, _coloured(report.runs)
    paths = [(run.told, run.real_tool_m, FAINT if run.goals == "plain" else colour) for run, colour in runs]
    space_figure(page, ends, paths, "Tool paths in space against the line AB")
    for axis, title in VIEWS:
        with page.chart(f"Tool paths against the line AB, {title}", title, ALONG, OFF) as chart:
            for index, candidate in enumerate(report.candidates_m):
                group = {"legendgroup": "taught", "showlegend": index == 0}
                path_curve(chart, ends, axis, candidate, "taught", FAINT, width=1, **group)
            wanted_curve(chart, ends)
            for run, colour in runs:
                judge = "by encoders" if run.truth_tool_m is None else "true"
                dash, width = _strokes(run)
                path_curve(chart, ends, axis, run.real_tool_m, f"{run.told}, {judge}", colour, dash=dash, width=width)
            for run, colour in {run.via: (run, colour) for run, colour in runs}.values():  # one plan, however it ran
                name, hidden = f"{run.via} via, commanded", {"visible": "legendonly"}
                path_curve(chart, ends, axis, run.predicted_tool_m, name, colour, width=1, dash="dash", **hidden)
                via_markers(chart, ends, axis, run, colour, f"{run.via} via points", showlegend=False)


def _coloured(runs: Sequence[LineRun]) -> list[tuple[LineRun, str]]:
    """Each run with the colour of its number of via points."""
    colours = dict(zip(dict.fromkeys(run.via for run in runs), COLOURS, strict=False))
    return [(run, colours[run.via]) for run in runs]


def _strokes(run: LineRun) -> tuple[str, float]:
    """Dash and width of its path: the better its goals, the more it stands out."""
    return {"plain": ("dot", 1.5), "corrected": ("dash", 2.0), "refined": ("solid", 2.5)}[run.goals]


def wanted_curve(chart: Any, ends: Ends) -> None:
    """The line AB, seen from above or from the side."""
    curve(chart, [0, float(np.linalg.norm(ends[1] - ends[0])) * 1000.0], [0, 0], "line AB", GREY)


def path_curve(chart: Any, ends: Ends, axis: int, tool_m: FloatArray, name: str, colour: str, **more: Any) -> None:
    """A tool path seen along one of `VIEWS`."""
    view = along_and_off(tool_m, *ends)
    curve(chart, view[0], view[axis], name, colour, **more)


def via_markers(chart: Any, ends: Ends, axis: int, run: LineRun, colour: str, name: str, **more: Any) -> None:
    """Where a run's via points are commanded, seen along one of `VIEWS`."""
    via = along_and_off(run.via_tool_m, *ends)
    marker = {"color": colour, "size": 8, "symbol": "diamond"}
    chart.add_scatter(x=via[0], y=via[axis], mode="markers", marker=marker, name=name, **more)


def distance_curve(chart: Any, ends: Ends, tool_m: FloatArray, name: str, colour: str, **more: Any) -> None:
    """Distance from the line AB along it."""
    distance_mm = distance_to_line(tool_m, *ends) * 1000.0
    curve(chart, along_and_off(tool_m, *ends)[0], distance_mm, name, colour, **more)


def level(chart: Any, mm: float, name: str) -> None:
    """What a genetic algorithm is held against."""
    chart.add_hline(y=mm, line={"color": GREY, "dash": "dot"}, annotation_text=name)


def improving(chart: Any, best_mm: FloatArray | Sequence[float]) -> None:
    """Show as many generations as it took to the best one, and half as many more; the rest stands to the right."""
    found = int(np.argmin(np.asarray(best_mm)))
    chart.update_xaxes(range=[0, max(SHOWN_GENERATIONS, found + found // 2)])


def _deviation_figure(page: Page, report: LineReport) -> None:
    page.heading("Deviation along the path")
    description = "Distance of the tool from the line AB along the path, for each run"
    with page.chart(description, "Distance from the line", ALONG, "distance, mm") as chart:
        for run, colour in _coloured(report.runs):
            dash, width = _strokes(run)
            more = {"dash": "dash", "width": 1, "visible": "legendonly"}
            if run.truth_tool_m is None:
                more = {"dash": dash, "width": width}
            else:
                name = f"{run.told}, true"
                distance_curve(chart, report.ends, run.truth_tool_m, name, colour, dash=dash, width=width)
            distance_curve(chart, report.ends, run.tool_m, f"{run.told}, by encoders", colour, **more)


def _convergence_figure(page: Page, report: LineReport) -> None:
    page.heading("Genetic algorithm by generation")
    description = "Best and mean cost of the genetic algorithm by generation"
    title = "Mean distance of the best and of the average individual"
    with page.chart(description, title, "generation", "mean distance, mm") as chart:
        generations = np.arange(len(report.best_mm))
        curve(chart, generations, report.best_mm, "best", GREEN)
        curve(chart, generations, report.mean_mm, "mean", FAINT)
        level(chart, report.exact_mean_mm, "exact optimum")
        level(chart, min(mean_mm for _, mean_mm, _, _ in report.candidate_errors_mm), "best take")
        improving(chart, report.best_mm)


def _joint_figures(page: Page, report: LineReport) -> None:
    page.heading("Joint angles against time")
    for run in report.runs:
        description = f"Joint angles against time: {run.told}"
        title = f"{run.told} (dotted: the plan)"
        with page.chart(description, title, "time, s", "joint angle, deg") as chart:
            measured, goals = np.degrees(run.positions_rad), np.degrees(run.goals_rad)
            for joint, (name, colour) in enumerate(zip(report.joint_names, cycle((*COLOURS, "#5a6878")), strict=False)):
                for values, label, dash in ((measured, name, "solid"), (goals, f"{name} commanded", "dot")):
                    group: dict[str, Any] = {"legendgroup": name, "showlegend": values is measured}
                    curve(chart, run.time_s, values[:, joint], label, colour, dash=dash, **group)


def space_figure(page: Page, ends: Ends, paths: Sequence[tuple[str, FloatArray, str]], description: str) -> None:
    """Add tool paths (name, points [m], colour) in space beside the line AB, all axes to one scale."""
    with page.chart(description, "Tool paths in space", "", "", height=600) as chart:
        paths_in_space(chart, ends, paths)


def paths_in_space(chart: Any, ends: Ends, paths: Sequence[tuple[str, FloatArray, str]]) -> None:
    """Draw what `space_figure` adds."""
    AB = np.stack(ends) * 1000.0
    x, y, z = AB.T
    style = {"line": {"color": GREY, "width": 6}, "marker": {"size": 4, "color": GREY}}
    chart.add_scatter3d(x=x, y=y, z=z, mode="lines+markers", name="line AB", **style)
    for name, points, colour in paths:
        x, y, z = points.T * 1000.0
        chart.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name, line={"color": colour, "width": 4})
    in_space(chart, np.concatenate([AB, *(points * 1000.0 for _, points, _ in paths)]))
