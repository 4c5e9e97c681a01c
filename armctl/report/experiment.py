"""The evidence of a straight-line experiment: before and after correction, and what limits the rest.

Every figure that stands for several runs says their spread. Where a true tool path is known it is what is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report import pareto, picture
from armctl.report.line import (
    COLOURS,
    PAPER_ROWS,
    ExperimentReport,
    LineRun,
    along_and_off,
    errors_mm,
    layout,
    space_figure,
)
from armctl.report.page import Page, plotly
from armctl.trajectory.straightness import distance_to_line

BEFORE = "#b9c2cd"


def write(report: ExperimentReport, path: Path) -> None:
    """Write the page; where `path` ends in .svg, a picture of the paths alone."""
    if path.suffix == ".svg":
        picture.write(report, path)
        return
    figure = plotly()
    page = Page("Straight line: before and after correction")
    begin, end = (", ".join(f"{value:.3f}" for value in point) for point in (report.from_m, report.to_m))
    page.text(f"The tool was to move from ({begin}) to ({end}) m in a straight line.")
    for note in report.notes:
        page.text(note)
    _table(page, report)
    _paths(page, figure, report)
    _deviation(page, figure, report)
    _convergence(page, figure, report)
    _prediction(page, figure, report)
    if report.limits:
        _limits(page, figure, report)
    if report.fronts:
        pareto.add_fronts(page, report.fronts)
    page.write(path)


def _name(via: int | str) -> str:
    return str(via) if via == "stream" else f"{via} via"


def _real(run: LineRun) -> FloatArray:
    return run.tool_m if run.truth_tool_m is None else run.truth_tool_m


def _spread(pairs: Sequence[tuple[float, float]]) -> str:
    (mean, most), (mean_spread, most_spread) = np.mean(pairs, axis=0), np.std(pairs, axis=0)
    if len(pairs) == 1:  # one run tells nothing about a spread
        return f"{mean:.2f} / {most:.2f}"
    return f"{mean:.2f} ± {mean_spread:.2f} / {most:.2f} ± {most_spread:.2f}"


def _table(page: Page, report: ExperimentReport) -> None:
    rows = []
    for one in report.outcomes:
        by_encoder = [errors_mm(run.tool_m, report.from_m, report.to_m) for run in one.runs]
        truths = [
            errors_mm(run.truth_tool_m, report.from_m, report.to_m) for run in one.runs if run.truth_tool_m is not None
        ]
        durations = [run.duration_s for run in one.runs]
        paper = PAPER_ROWS.get(one.via) if isinstance(one.via, int) else None
        rows.append(
            (
                one.via,
                "{:.1f} / {:.1f}".format(*errors_mm(_real(one.before), report.from_m, report.to_m)),
                f"{one.runs[0].predicted_mean_mm:.2f} / {one.runs[0].predicted_max_mm:.2f}",
                _spread(by_encoder),
                _spread(truths) if truths else "unknown",
                f"{np.mean(durations):.2f}" + (f" ± {np.std(durations):.2f}" if len(durations) > 1 else ""),
                len(one.runs),
                len(one.rounds) - 1,
                "-" if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f} in {paper[2]:.1f} s",
            )
        )
    page.heading("Distance from the line")
    page.table(
        ("via", "before", "predicted", "by encoders", "true", "time s", "repeats", "corrections", "paper"),
        rows,
        "Mean / maximum distance of the tool from the line AB, mm (eqs. 19, 20), ± standard deviation over the "
        "repeats. Before: the plain plan on the arm as it is, true where known. Predicted: the corrected plan with "
        "what was learnt of the arm. Paper: Raharjo et al., Table II.",
    )


def _paths(page: Page, figure: type, report: ExperimentReport) -> None:
    page.heading("Path against line, in space, from above and from the side")
    chart = figure()
    paths = []
    for one, colour in zip(report.outcomes, COLOURS, strict=False):
        paths.append((f"{_name(one.via)}, before", _real(one.before), BEFORE))
        paths.append((f"{_name(one.via)}, after", _real(one.runs[0]), colour))
    space_figure(chart, report.from_m, report.to_m, paths)
    page.figure(chart, "Tool paths in space before and after correction")
    length = float(np.linalg.norm(report.to_m - report.from_m)) * 1000.0
    for axis, title in ((1, "from above: sideways deviation"), (2, "from the side: upward deviation")):
        chart = figure()
        chart.add_scatter(x=[0, length], y=[0, 0], mode="lines", line={"color": "#7d8b99", "width": 2}, name="line AB")
        for one, colour in zip(report.outcomes, COLOURS, strict=False):
            for label, run, style in (
                ("before", one.before, {"color": colour, "width": 1, "dash": "dot"}),
                ("after", one.runs[0], {"color": colour, "width": 2}),
            ):
                view = along_and_off(_real(run), report.from_m, report.to_m)
                chart.add_scatter(x=view[0], y=view[axis], mode="lines", line=style, name=f"{_name(one.via)}, {label}")
            via = along_and_off(one.runs[0].via_tool_m, report.from_m, report.to_m)
            if isinstance(one.via, int) and one.via:
                chart.add_scatter(
                    x=via[0],
                    y=via[axis],
                    mode="markers",
                    marker={"color": colour, "size": 8, "symbol": "diamond"},
                    name=f"{one.via} via points as commanded",
                    visible="legendonly",
                )
        layout(chart, title, "along the line, mm", "off the line, mm")
        page.figure(chart, f"Tool paths before and after correction, {title}")


def _deviation(page: Page, figure: type, report: ExperimentReport) -> None:
    page.heading("Deviation along the path")
    chart = figure()
    for one, colour in zip(report.outcomes, COLOURS, strict=False):
        for number, run in enumerate(one.runs):
            points = _real(run)
            chart.add_scatter(
                x=along_and_off(points, report.from_m, report.to_m)[0],
                y=distance_to_line(points, report.from_m, report.to_m) * 1000.0,
                mode="lines",
                line={"color": colour, "width": 1.5},
                opacity=1.0 if number == 0 else 0.35,
                name=_name(one.via),
                legendgroup=str(one.via),
                showlegend=number == 0,
            )
    layout(chart, "Distance from the line after correction, every repeat", "along the line, mm", "distance, mm")
    page.figure(chart, "Distance of the tool from the line along the path, every repeat after correction")


def _convergence(page: Page, figure: type, report: ExperimentReport) -> None:
    page.heading("Convergence")
    chart = figure()
    for one, colour in zip(report.outcomes, COLOURS, strict=False):
        for label, dash, errors in (
            ("true", "solid", [errors_mm(_real(run), report.from_m, report.to_m)[0] for run in one.rounds]),
            ("by encoders", "dot", [errors_mm(run.tool_m, report.from_m, report.to_m)[0] for run in one.rounds]),
        ):
            chart.add_scatter(
                x=list(range(len(errors))),
                y=errors,
                mode="lines+markers",
                line={"color": colour, "dash": dash},
                name=f"{_name(one.via)}, {label}",
            )
    layout(chart, "Mean distance by round of correction (0: before any)", "round", "mean distance, mm")
    chart.update_layout(yaxis_type="log")
    page.figure(chart, "Mean distance from the line by round of correction")
    if report.best_cost_mm:
        chart = figure()
        chart.add_scatter(
            x=list(range(1, len(report.best_cost_mm) + 1)),
            y=list(report.best_cost_mm),
            mode="lines",
            line={"color": "#2a7f62"},
            name="best individual",
        )
        if report.exact_mean_mm is not None:
            chart.add_hline(
                y=report.exact_mean_mm, line={"color": "#7d8b99", "dash": "dot"}, annotation_text="exact optimum"
            )
        layout(chart, "Genetic algorithm on recorded genes", "generation", "cost, mm")
        page.figure(chart, "Best cost of the genetic algorithm by generation")


def _prediction(page: Page, figure: type, report: ExperimentReport) -> None:
    page.heading("Prediction against measurement")
    chart = figure()
    names = [_name(one.via) for one in report.outcomes]
    by_encoder = [[errors_mm(run.tool_m, report.from_m, report.to_m)[0] for run in one.runs] for one in report.outcomes]
    real = [[errors_mm(_real(run), report.from_m, report.to_m)[0] for run in one.runs] for one in report.outcomes]
    bars: tuple[tuple[str, str, list[float], list[float] | None], ...] = (
        ("predicted", "#b9c2cd", [one.runs[0].predicted_mean_mm for one in report.outcomes], None),
        (
            "by encoders",
            "#3a6ea5",
            [float(np.mean(some)) for some in by_encoder],
            [float(np.std(s)) for s in by_encoder],
        ),
        ("true", "#2a7f62", [float(np.mean(some)) for some in real], [float(np.std(some)) for some in real]),
    )
    for name, colour, values, spread in bars:
        error = None if spread is None else {"type": "data", "array": spread}
        chart.add_bar(x=names, y=values, error_y=error, name=name, marker={"color": colour})
    layout(chart, "Mean distance after correction, ± standard deviation over the repeats", "", "mean distance, mm")
    page.figure(chart, "Predicted, measured and true mean distance")


def _limits(page: Page, figure: type, report: ExperimentReport) -> None:
    page.heading("What limits the rest")
    for stage, title in (("after_mm", "after correction"), ("before_mm", "before correction")):
        chart = figure()
        for via, colour in zip(dict.fromkeys(row["via"] for row in report.limits), COLOURS, strict=False):
            some = [row for row in report.limits if row["via"] == via]
            chart.add_bar(
                x=["all effects" if row["without"] is None else f"without {row['without']}" for row in some],
                y=[row[stage] for row in some],
                error_y={"type": "data", "array": [row["spread_mm"] for row in some]} if stage == "after_mm" else None,
                name=_name(via),
                marker={"color": colour},
            )
        layout(chart, f"True mean distance {title}, one effect switched off at a time", "", "mean distance, mm")
        page.figure(chart, f"True mean distance {title} with one effect of the simulator switched off at a time")
    page.table(
        ("via", "without", "before, mm", "after, mm", "whole ticks, mm", "zero offsets, mm"),
        [
            (
                row["via"],
                row["without"] or "nothing: all effects",
                f"{row['before_mm']:.2f}",
                f"{row['after_mm']:.2f} ± {row['spread_mm']:.2f}",
                f"{row['ticks_mm']:.2f}" if row["without"] is None else "",
                f"{row['unseen_mm']:.2f}" if row["without"] is None else "",
            )
            for row in report.limits
        ],
        "Effects do not add up: removing one leaves the others to act alone. Whole ticks: what rounding goals to ticks "
        "costs on perfect servos. Zero offsets: what up to half a tick, which no encoder sees, costs on average.",
    )
