"""The straight-line report: what was taught, what the optimiser made of it, how straight the arm then moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report.page import Page, plotly
from armctl.trajectory import straightness

PAPER_ROWS: dict[int | str, tuple[float, float, float]] = {
    0: (10.1499, 19.51644, 5.0),
    1: (7.42501, 16.52173, 7.7),
    2: (7.00036, 14.69483, 7.8),
}
"""Mean error [mm], maximum error [mm] and time [s] by number of via points, Raharjo et al. Table II."""

COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3")


@dataclass(frozen=True)
class LineRun:
    """One execution of one plan; paths in the base frame [m], times from the plan's start [s]."""

    via: int | str
    """How many, or "stream"."""
    duration_s: float
    predicted_mean_mm: float
    predicted_max_mm: float
    predicted_tool_m: FloatArray
    via_tool_m: FloatArray
    time_s: FloatArray
    positions_rad: FloatArray
    goals_rad: FloatArray
    tool_m: FloatArray
    """By the encoders."""
    truth_time_s: FloatArray | None = None
    truth_tool_m: FloatArray | None = None
    """By an outside measurement (the simulator's true pose), where there is one."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one number of via points."""

    via: int | str
    before: LineRun
    """The plain plan on the arm as it is."""
    runs: Sequence[LineRun]
    """The best corrected plan, repeated."""
    rounds: Sequence[LineRun]
    """Each correction in order, from the plain plan on."""


@dataclass(frozen=True, eq=False)
class ExperimentReport:
    """Everything the page shows; what is empty is left out."""

    from_m: FloatArray
    to_m: FloatArray
    outcomes: Sequence[Outcome]
    best_cost_mm: Sequence[float] = ()
    """Of the genetic algorithm, by generation."""
    exact_mean_mm: float | None = None
    limits: Sequence[dict[str, Any]] = ()
    """True mean errors [mm] with one effect switched off: `via`, `without` (None: with all), `before_mm`, `after_mm`,
    `spread_mm`, `ticks_mm`, `unseen_mm`."""
    fronts: Sequence[dict[str, Any]] = ()
    """Rows of `armctl study pareto`."""
    notes: Sequence[str] = field(default_factory=tuple)


@dataclass(frozen=True)
class LineReport:
    """Everything the page shows."""

    from_m: FloatArray
    to_m: FloatArray
    joint_names: Sequence[str]
    candidates_m: Sequence[FloatArray]
    candidate_errors_mm: Sequence[tuple[str, float, float]]
    """Name, mean and maximum error of each candidate."""
    ga_tool_m: FloatArray
    ga_mean_mm: float
    exact_mean_mm: float
    gap_ratio: float
    best_mm: FloatArray
    mean_mm: FloatArray
    """Best and mean cost by generation."""
    runs: Sequence[LineRun]
    notes: Sequence[str] = ()


def errors_mm(tool_m: FloatArray, from_m: FloatArray, to_m: FloatArray) -> tuple[float, float]:
    """Mean (eq. 20) and maximum distance from the line [mm]."""
    mean_m, max_m = (error(tool_m, from_m, to_m) for error in (straightness.mean_error, straightness.max_error))
    return float(mean_m) * 1000.0, float(max_m) * 1000.0


def write(report: LineReport, path: Path) -> None:
    """Write the page."""
    figure = plotly()
    page = Page("Straight line: taught, optimised, run")
    page.text(
        f"The tool was to move from ({_point(report.from_m)}) to ({_point(report.to_m)}) m in a straight line. "
        f"{len(report.candidates_m)} hand-guided recordings went into the genetic algorithm; the arm then ran its "
        "result through 0, 1 and 2 intermediate points."
    )
    for note in report.notes:
        page.text(note)
    _table(page, report)
    _path_figure(page, figure, report)
    _deviation_figure(page, figure, report)
    _convergence_figure(page, figure, report)
    _joint_figures(page, figure, report)
    page.write(path)


def _point(point: FloatArray) -> str:
    return ", ".join(f"{value:.3f}" for value in point)


def _table(page: Page, report: LineReport) -> None:
    rows = []
    for run in report.runs:
        encoder = errors_mm(run.tool_m, report.from_m, report.to_m)
        truth = None if run.truth_tool_m is None else errors_mm(run.truth_tool_m, report.from_m, report.to_m)
        paper = PAPER_ROWS.get(run.via)
        rows.append(
            (
                run.via,
                f"{run.predicted_mean_mm:.1f} / {run.predicted_max_mm:.1f}",
                "{:.1f} / {:.1f}".format(*encoder),
                "-" if truth is None else "{:.1f} / {:.1f}".format(*truth),
                f"{run.duration_s:.1f}",
                "-" if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f}",
                "-" if paper is None else f"{paper[2]:.1f}",
            )
        )
    page.heading("Distance from the line")
    page.table(
        ("via points", "predicted", "by encoders", "true", "time s", "paper", "paper's time s"),
        rows,
        "Mean / maximum distance of the tool from the line AB, mm (eqs. 19, 20). Predicted: the commanded motion on "
        "perfect servos. True: the tool's real place; sag under gravity, play and zero offsets are in it. "
        "Paper: Table II.",
    )
    page.heading("Candidates")
    page.table(
        ("recording", "mean mm", "maximum mm"),
        [(name, f"{mean:.2f}", f"{largest:.2f}") for name, mean, largest in report.candidate_errors_mm]
        + [
            ("genetic algorithm", f"{report.ga_mean_mm:.3f}", ""),
            ("exact optimum of the same genes", f"{report.exact_mean_mm:.3f}", ""),
        ],
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


def _path_figure(page: Page, figure: type, report: LineReport) -> None:
    page.heading("Path against line, in space, from above and from the side")
    chart = figure()
    paths = [
        (f"{run.via} via", run.tool_m if run.truth_tool_m is None else run.truth_tool_m, colour)
        for run, colour in zip(report.runs, COLOURS, strict=False)
    ]
    space_figure(chart, report.from_m, report.to_m, paths)
    page.figure(chart, "Tool paths in space against the line AB")
    for axis, title in ((1, "from above: sideways deviation"), (2, "from the side: upward deviation")):
        chart = figure()
        for index, candidate in enumerate(report.candidates_m):
            view = along_and_off(candidate, report.from_m, report.to_m)
            chart.add_scatter(
                x=view[0],
                y=view[axis],
                mode="lines",
                line={"color": "#b9c2cd", "width": 1},
                name="taught",
                legendgroup="taught",
                showlegend=index == 0,
            )
        length = float(np.linalg.norm(report.to_m - report.from_m)) * 1000.0
        chart.add_scatter(x=[0, length], y=[0, 0], mode="lines", line={"color": "#7d8b99", "width": 2}, name="line AB")
        for run, colour in zip(report.runs, COLOURS, strict=False):
            commanded = along_and_off(run.predicted_tool_m, report.from_m, report.to_m)
            chart.add_scatter(
                x=commanded[0],
                y=commanded[axis],
                mode="lines",
                line={"color": colour, "width": 1, "dash": "dot"},
                name=f"{run.via} via, commanded",
                visible="legendonly",
            )
            real = run.tool_m if run.truth_tool_m is None else run.truth_tool_m
            view = along_and_off(real, report.from_m, report.to_m)
            label = "by encoders" if run.truth_tool_m is None else "true"
            chart.add_scatter(
                x=view[0],
                y=view[axis],
                mode="lines",
                line={"color": colour, "width": 2},
                name=f"{run.via} via, {label}",
            )
            via = along_and_off(run.via_tool_m, report.from_m, report.to_m)
            chart.add_scatter(
                x=via[0],
                y=via[axis],
                mode="markers",
                marker={"color": colour, "size": 8, "symbol": "diamond"},
                name=f"{run.via} via points",
                showlegend=False,
            )
        layout(chart, title, "along the line, mm", "off the line, mm")
        page.figure(chart, f"Tool paths against the line AB, {title}")


def _deviation_figure(page: Page, figure: type, report: LineReport) -> None:
    page.heading("Deviation along the path")
    chart = figure()
    for run, colour in zip(report.runs, COLOURS, strict=False):
        for tool_m, dash, label in (
            (run.predicted_tool_m, "dot", "predicted"),
            (run.tool_m, "dash", "by encoders"),
            (run.truth_tool_m, "solid", "true"),
        ):
            if tool_m is None:
                continue
            chart.add_scatter(
                x=along_and_off(tool_m, report.from_m, report.to_m)[0],
                y=straightness.distance_to_line(tool_m, report.from_m, report.to_m) * 1000.0,
                mode="lines",
                line={"color": colour, "dash": dash, "width": 2},
                name=f"{run.via} via, {label}",
            )
    layout(chart, "Distance from the line", "along the line, mm", "distance, mm")
    page.figure(chart, "Distance of the tool from the line AB along the path, for each run")


def _convergence_figure(page: Page, figure: type, report: LineReport) -> None:
    page.heading("Genetic algorithm by generation")
    chart = figure()
    generations = np.arange(len(report.best_mm))
    chart.add_scatter(x=generations, y=report.best_mm, mode="lines", line={"color": "#2a7f62"}, name="best")
    chart.add_scatter(x=generations, y=report.mean_mm, mode="lines", line={"color": "#b9c2cd"}, name="mean")
    chart.add_hline(y=report.exact_mean_mm, line={"color": "#7d8b99", "dash": "dot"}, annotation_text="exact optimum")
    layout(chart, "Mean distance of the best and of the average individual", "generation", "mean distance, mm")
    page.figure(chart, "Best and mean cost of the genetic algorithm by generation")


def _joint_figures(page: Page, figure: type, report: LineReport) -> None:
    page.heading("Joint angles against time")
    for run in report.runs:
        chart = figure()
        for joint, name in enumerate(report.joint_names):
            colour = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#5a6878")[joint % 6]
            for values, dash, suffix in ((run.positions_rad, "solid", ""), (run.goals_rad, "dot", " commanded")):
                chart.add_scatter(
                    x=run.time_s,
                    y=np.degrees(values[:, joint]),
                    mode="lines",
                    line={"color": colour, "dash": dash},
                    name=name + suffix,
                    legendgroup=name,
                    showlegend=not suffix,
                )
        layout(chart, f"{run.via} via points (dotted: commanded)", "time, s", "joint angle, deg")
        page.figure(chart, f"Joint angles against time with {run.via} via points")


def space_figure(
    chart: Any, from_m: FloatArray, to_m: FloatArray, paths: Sequence[tuple[str, FloatArray, str]]
) -> None:
    """Fill a chart with tool paths (name, points [m], colour) in space beside the line AB, all axes to one scale."""
    ends = np.stack([from_m, to_m]) * 1000.0
    chart.add_scatter3d(
        x=ends[:, 0],
        y=ends[:, 1],
        z=ends[:, 2],
        mode="lines+markers",
        line={"color": "#7d8b99", "width": 6},
        marker={"size": 4, "color": "#7d8b99"},
        name="line AB",
    )
    seen = [ends]
    for name, points, colour in paths:
        mm = points * 1000.0
        seen.append(mm)
        chart.add_scatter3d(
            x=mm[:, 0], y=mm[:, 1], z=mm[:, 2], mode="lines", line={"color": colour, "width": 4}, name=name
        )
    every = np.concatenate(seen)
    middle = (every.max(axis=0) + every.min(axis=0)) / 2.0
    half = float(np.ptp(every, axis=0).max()) * 0.55
    axes = {
        f"{axis}axis": {"title": {"text": f"{axis}, mm"}, "range": [float(centre) - half, float(centre) + half]}
        for axis, centre in zip("xyz", middle, strict=True)
    }
    camera = {"eye": {"x": 1.3, "y": -1.3, "z": 0.8}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}}
    layout(chart, "Tool paths in space", "", "")
    chart.update_layout(
        height=600, margin={"l": 0, "r": 0, "t": 50, "b": 0}, scene={"aspectmode": "cube", "camera": camera, **axes}
    )


def layout(chart: Any, title: str, x: str, y: str) -> None:
    chart.update_layout(
        title=title,
        xaxis_title=x,
        yaxis_title=y,
        template="plotly_white",
        height=420,
        margin={"l": 60, "r": 20, "t": 50, "b": 50},
        legend={"font": {"size": 11}},
    )
