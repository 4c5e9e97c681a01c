"""The straight-line report: what was taught, what the optimiser made of it, how straight the arm then moved."""

from collections.abc import Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report.page import TEXTS, Figure, Page, curve, in_space
from armctl.trajectory.straightness import Ends, distance_to_line, errors_mm, own_chord_mm


class Printed(NamedTuple):
    """What the paper prints of one experiment."""

    mean_error_mm: float
    max_error_mm: float
    duration_s: float


# By number of via points, Raharjo et al. Table II; `armctl/lab/table_ii.py` makes that table anew.
PRINTED: dict[int | str, Printed] = {via: Printed(*row) for via, row in TEXTS["line"]["printed"].items()}

# What was done about the arm's lag: nothing, the control step led goals by it, or further runs corrected the plan too.
Goals = Literal["plain", "corrected", "refined"]

COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3")
FAINT, GREY, GREEN = "#b9c2cd", "#7d8b99", "#2a7f62"
# Dash and width of a path by what was done about the arm's lag: the better its goals, the more it stands out.
STROKES = {"plain": ("dot", 1.5), "corrected": ("dash", 2.0), "refined": ("solid", 2.5)}
STROKES |= {"before": ("dot", 1.0), "after": ("solid", 2.0)}
# Of a curve that is drawn once its name is clicked.
ON_DEMAND: dict[str, Any] = {"dash": "dash", "width": 1, "visible": "legendonly"}
# Of a genetic algorithm, at least.
SHOWN_GENERATIONS = 10
ALONG, OFF = "along the line, mm", "off the line, mm"
# Which of `along_and_off` is seen from where.
VIEWS = ((1, "from above: sideways deviation"), (2, "from the side: upward deviation"))


class LineRun(NamedTuple):
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


class DrawnOutcome(NamedTuple):
    """What became of one number of via points."""

    via: int | str
    # The plain plan on the arm as it is.
    before: LineRun
    # The best corrected plan, repeated.
    runs: Sequence[LineRun]
    # Each correction in order, from the plain plan on.
    rounds: Sequence[LineRun]


class ExperimentReport(NamedTuple):
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


class LineReport(NamedTuple):
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


class Shown(NamedTuple):
    """Runs of one plan. The first one's path is drawn; its repeats stand beside it where distances are."""

    via: int | str
    # What was done about the arm's lag, one of `STROKES`.
    goals: str
    runs: Sequence[LineRun]
    colour: str

    @property
    def name(self) -> str:
        """Its name among others: `2 via, corrected`."""
        return f"{via_text(self.via)}, {self.goals}"

    @property
    def strokes(self) -> dict[str, Any]:
        return dict(zip(("dash", "width"), STROKES[self.goals.split()[0]], strict=True))


def via_text(via: int | str) -> str:
    return str(via) if via == "stream" else f"{via} via"


def wanted(ends: Ends) -> str:
    begin, end = (", ".join(f"{value:.3f}" for value in point) for point in ends)
    return f"The tool was to move from ({begin}) to ({end}) m in a straight line."


def write(report: LineReport, path: Path) -> None:
    """Write the page."""
    page = Page("Straight line: taught, optimised, run")
    page.text(wanted(report.ends), TEXTS["line"]["made"].format(recordings=len(report.candidates_m)), *report.notes)
    colours = dict(zip(dict.fromkeys(run.via for run in report.runs), COLOURS, strict=False))
    shown = [Shown(run.via, run.goals, [run], colours[run.via]) for run in report.runs]
    add_distances(page, report.ends, shown)
    _candidates(page, report)
    add_paths(page, report.ends, shown, report.candidates_m)
    add_deviations(page, report.ends, shown)
    page.heading("Genetic algorithm by generation")
    best_take_mm = min(mean_mm for _, mean_mm, _, _ in report.candidate_errors_mm)
    levels = {"exact optimum": report.exact_mean_mm, "best take": best_take_mm}
    add_generations(page, {"best": report.best_mm, "mean": report.mean_mm}, levels)
    _joint_figures(page, shown, report.joint_names)
    page.write(path)


def add_distances(page: Page, ends: Ends, shown: Sequence[Shown]) -> None:
    """The table of how far off the line each plan was."""
    rows = []
    for one in shown:
        first, paper, durations_s = one.runs[0], PRINTED.get(one.via), [run.duration_s for run in one.runs]
        truths = [run.truth_tool_m for run in one.runs if run.truth_tool_m is not None]
        told = (
            _spread([(first.predicted_mean_mm, first.predicted_max_mm)]),
            _spread([errors_mm(run.tool_m, *ends) for run in one.runs]),
            "-" if paper is None else "{:.1f} / {:.1f} in {:.1f} s".format(*paper),
            _spread([errors_mm(truth, *ends) for truth in truths]),
            _spread([own_chord_mm(truth) for truth in truths]),
        )
        took = f"{np.mean(durations_s):.2f}" + (f" ± {np.std(durations_s):.2f}" if len(durations_s) > 1 else "")
        rows.append((one.via, one.goals, *told, took, len(one.runs)))
    page.heading("Distance from the line")
    page.table(rows=rows, **TEXTS["line"]["distances"])


def _spread(pairs: Sequence[tuple[float, float]]) -> str:
    if not pairs:
        return "unknown"
    (mean, most), (mean_spread, most_spread) = np.mean(pairs, axis=0), np.std(pairs, axis=0)
    if len(pairs) == 1:  # one run tells nothing about a spread
        return f"{mean:.2f} / {most:.2f}"
    return f"{mean:.2f} ± {mean_spread:.2f} / {most:.2f} ± {most_spread:.2f}"


def _candidates(page: Page, report: LineReport) -> None:
    page.heading("Candidates")
    found = (("genetic algorithm", report.ga_mean_mm), ("exact optimum of the same genes", report.exact_mean_mm))
    taken = report.candidate_errors_mm
    rows = [(name, f"{mean:.2f}", f"{largest:.2f}", str(genes)) for name, mean, largest, genes in taken]
    rows += [(name, f"{mean:.3f}", "", "") for name, mean in found]
    about = TEXTS["line"]["candidates"]
    page.table(about["header"], rows, about["caption"].format(gap=report.gap_ratio * 100.0))


def along_and_off(tool_m: FloatArray, A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Progress along AB, sideways (horizontal) and upward deviation from it [mm]."""
    direction = (B - A) / np.linalg.norm(B - A)
    sideways = np.cross(direction, (0.0, 0.0, 1.0))
    if np.linalg.norm(sideways) < 1e-6:  # a vertical line has no horizontal direction of its own
        sideways = np.array([1.0, 0.0, 0.0])
    sideways = sideways / np.linalg.norm(sideways)
    offset = (tool_m - A) * 1000.0
    return offset @ direction, offset @ sideways, offset @ np.cross(sideways, direction)


def add_paths(page: Page, ends: Ends, shown: Sequence[Shown], candidates_m: Sequence[FloatArray] = ()) -> None:
    """The tool paths in space and in both `VIEWS`: taught, commanded and run."""
    ways = [(one.name, one.runs[0].real_tool_m, one.colour if one.strokes["dash"] != "dot" else FAINT) for one in shown]
    with page.chart(**TEXTS["line"]["paths"]) as chart:
        paths_in_space(chart, ends, ways)
    for axis, title in VIEWS:
        with page.chart(f"Tool paths against the line AB, {title}", title, ALONG, OFF) as chart:
            draw = partial(_path_curve, chart, ends, axis)
            for index, candidate in enumerate(candidates_m):
                draw(candidate, "taught", FAINT, width=1, legendgroup="taught", showlegend=index == 0)
            draw(np.stack(ends), "line AB", GREY)
            for one in shown:
                judge = "by encoders" if one.runs[0].truth_tool_m is None else "true"
                draw(one.runs[0].real_tool_m, f"{one.name}, {judge}", one.colour, **one.strokes)
            for one in {one.via: one for one in shown}.values():  # one plan, however it ran
                name, plan = via_text(one.via), one.runs[0]
                draw(plan.predicted_tool_m, f"{name}, commanded", one.colour, **ON_DEMAND)
                diamonds = {"color": one.colour, "size": 8, "symbol": "diamond"}
                draw(plan.via_tool_m, f"{name} points", one.colour, mode="markers", marker=diamonds, showlegend=False)


def _path_curve(chart: Figure, ends: Ends, axis: int, tool_m: FloatArray, name: str, colour: str, **more: Any) -> None:
    view = along_and_off(tool_m, *ends)
    curve(chart, view[0], view[axis], name, colour, **more)


def add_deviations(page: Page, ends: Ends, shown: Sequence[Shown]) -> None:
    """Distance from the line along it, of every run."""
    with page.chart(**TEXTS["line"]["deviations"]) as chart:
        for one in shown:
            for number, run in enumerate(one.runs):
                group = {"legendgroup": one.name, "showlegend": number == 0, "opacity": 0.35 if number else 1.0}
                judge = "by encoders" if run.truth_tool_m is None else "true"
                distance_curve(chart, ends, run.real_tool_m, f"{one.name}, {judge}", one.colour, **one.strokes, **group)
            if (first := one.runs[0]).truth_tool_m is not None:
                distance_curve(chart, ends, first.tool_m, f"{one.name}, by encoders", one.colour, **ON_DEMAND)


def distance_curve(chart: Figure, ends: Ends, tool_m: FloatArray, name: str, colour: str, **more: Any) -> None:
    """Distance from the line AB along it."""
    curve(chart, along_and_off(tool_m, *ends)[0], distance_to_line(tool_m, *ends) * 1000.0, name, colour, **more)


def add_generations(page: Page, costs_mm: dict[str, Sequence[float] | FloatArray], levels: dict[str, float]) -> None:
    """The genetic algorithm's costs by generation, the best one's first, and what they are held against.

    As many generations are shown as it took to the best one, and half as many more; the rest stands to the right.
    """
    description = f"{' and '.join(costs_mm).capitalize()} cost of the genetic algorithm by generation"
    with page.chart(description, "Genetic algorithm on the recordings", "generation", "mean distance, mm") as chart:
        for (name, cost_mm), colour in zip(costs_mm.items(), (GREEN, FAINT), strict=False):
            curve(chart, np.arange(len(cost_mm)), cost_mm, name, colour)
        across = {"type": "line", "xref": "x domain", "x0": 0, "x1": 1, "line": {"color": GREY, "dash": "dot"}}
        chart.layout["shapes"] = [{**across, "y0": mm, "y1": mm} for mm in levels.values()]
        end = {"xref": "x domain", "x": 1, "xanchor": "right", "yanchor": "bottom", "showarrow": False}
        chart.layout["annotations"] = [{**end, "y": mm, "text": name} for name, mm in levels.items()]
        found = int(np.argmin(np.asarray(next(iter(costs_mm.values())))))
        chart.layout["xaxis"]["range"] = [0, max(SHOWN_GENERATIONS, found + found // 2)]


def _joint_figures(page: Page, shown: Sequence[Shown], joint_names: Sequence[str]) -> None:
    page.heading("Joint angles against time")
    for one in shown:
        run, title = one.runs[0], f"{one.name} (dotted: the plan)"
        with page.chart(f"Joint angles against time: {one.name}", title, "time, s", "joint angle, deg") as chart:
            measured, goals = np.degrees(run.positions_rad), np.degrees(run.goals_rad)
            for joint, (name, colour) in enumerate(zip(joint_names, cycle((*COLOURS, "#5a6878")), strict=False)):
                for values, label, dash in ((measured, name, "solid"), (goals, f"{name} commanded", "dot")):
                    group: dict[str, Any] = {"legendgroup": name, "showlegend": values is measured}
                    curve(chart, run.time_s, values[:, joint], label, colour, dash=dash, **group)


def paths_in_space(chart: Figure, ends: Ends, paths: Sequence[tuple[str, FloatArray, str]]) -> None:
    """Tool paths (name, points [m], colour) in space beside the line AB, all axes to one scale."""
    AB = np.stack(ends) * 1000.0
    x, y, z = AB.T
    style = {"line": {"color": GREY, "width": 6}, "marker": {"size": 4, "color": GREY}}
    chart.add("scatter3d", x=x, y=y, z=z, mode="lines+markers", name="line AB", **style)
    for name, points, colour in paths:
        x, y, z = points.T * 1000.0
        chart.add("scatter3d", x=x, y=y, z=z, mode="lines", name=name, line={"color": colour, "width": 4})
    in_space(chart, np.concatenate([AB, *(points * 1000.0 for _, points, _ in paths)]))
