"""The page of a straight-line experiment: before and after correction, and what limits the error that is left.

A figure that is a mean of several runs is shown with their spread. Where the true tool path is known, it is drawn.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report import line, pareto, picture
from armctl.report.page import Page, curve
from armctl.trajectory.straightness import errors_mm, own_chord_mm


def write(report: line.ExperimentReport, path: Path) -> None:
    """Write the page; where `path` ends in .svg, a picture of the paths alone."""
    if path.suffix == ".svg":
        picture.write(report, path)
        return
    page = Page("Straight line: before and after correction")
    begin, end = map(line.point_text, report.ends)
    page.text(f"The tool was to move from ({begin}) to ({end}) m in a straight line.", *report.notes)
    _table(page, report)
    _paths(page, report)
    _deviation(page, report)
    _convergence(page, report)
    _prediction(page, report)
    if report.limits:
        _limits(page, report)
    if report.fronts:
        pareto.add_fronts(page, report.fronts)
    page.write(path)


def _name(via: int | str) -> str:
    return str(via) if via == "stream" else f"{via} via"


def _spread(pairs: Sequence[tuple[float, float]]) -> str:
    (mean, most), (mean_spread, most_spread) = np.mean(pairs, axis=0), np.std(pairs, axis=0)
    if len(pairs) == 1:  # one run tells nothing about a spread
        return f"{mean:.2f} / {most:.2f}"
    return f"{mean:.2f} ± {mean_spread:.2f} / {most:.2f} ± {most_spread:.2f}"


def _table(page: Page, report: line.ExperimentReport) -> None:
    rows = []
    for one in report.outcomes:
        by_encoder = [errors_mm(run.tool_m, *report.ends) for run in one.runs]
        truths = [errors_mm(run.truth_tool_m, *report.ends) for run in one.runs if run.truth_tool_m is not None]
        own = [own_chord_mm(run.truth_tool_m) for run in one.runs if run.truth_tool_m is not None]
        durations = [run.duration_s for run in one.runs]
        paper = line.PRINTED.get(one.via) if isinstance(one.via, int) else None
        before, first = errors_mm(one.before.real_tool_m, *report.ends), one.runs[0]
        predicted = f"{first.predicted_mean_mm:.2f} / {first.predicted_max_mm:.2f}"
        printed = "-" if paper is None else "{:.1f} / {:.1f} in {:.1f} s".format(*paper)
        true = (_spread(some) if some else "unknown" for some in (truths, own))
        took = f"{np.mean(durations):.2f}" + (f" ± {np.std(durations):.2f}" if len(durations) > 1 else "")
        measured = (_spread(by_encoder), printed, *true, took, len(one.runs), len(one.rounds) - 1)
        rows.append((one.via, "{:.1f} / {:.1f}".format(*before), predicted, *measured))
    page.heading("Distance from the line")
    page.table(
        ("via", "before", "predicted", "by encoders", "paper", "true", "own line", "time s", "repeats", "corrections"),
        rows,
        "Mean / maximum distance of the tool from the line AB, mm (eqs. 19, 20), ± standard deviation over the "
        "repeats. Before: the plain plan on the arm as it is; the true distance where it is known. Predicted: the "
        "corrected plan, with what was learnt about the arm. Paper: Raharjo et al., Table II, measured by encoders. "
        "True: the tool's real place against AB; own line: against the straight line that fits it best.",
    )


def _paths(page: Page, report: line.ExperimentReport) -> None:
    page.heading("Path against line, in space, from above and from the side")
    ends, shown = report.ends, list(zip(report.outcomes, line.COLOURS, strict=False))
    paths = []
    for one, colour in shown:
        paths.append((f"{_name(one.via)}, before", one.before.real_tool_m, line.FAINT))
        paths.append((f"{_name(one.via)}, after", one.runs[0].real_tool_m, colour))
    line.space_figure(page, ends, paths, "Tool paths in space before and after correction")
    for axis, title in line.VIEWS:
        with page.chart(f"Tool paths before and after correction, {title}", title, line.ALONG, line.OFF) as chart:
            line.wanted_curve(chart, ends)
            for one, colour in shown:
                before, after = one.before.real_tool_m, one.runs[0].real_tool_m
                line.path_curve(chart, ends, axis, before, f"{_name(one.via)}, before", colour, width=1, dash="dot")
                line.path_curve(chart, ends, axis, after, f"{_name(one.via)}, after", colour)
                if isinstance(one.via, int) and one.via:
                    name = f"{one.via} via points as commanded"
                    line.via_markers(chart, ends, axis, one.runs[0], colour, name, visible="legendonly")


def _deviation(page: Page, report: line.ExperimentReport) -> None:
    page.heading("Deviation along the path")
    description = "Distance of the tool from the line along the path, every repeat after correction"
    title = "Distance from the line after correction, every repeat"
    with page.chart(description, title, line.ALONG, "distance, mm") as chart:
        for one, colour in zip(report.outcomes, line.COLOURS, strict=False):
            for number, run in enumerate(one.runs):
                group = {"legendgroup": str(one.via), "showlegend": number == 0, "opacity": 0.35 if number else 1.0}
                line.distance_curve(chart, report.ends, run.real_tool_m, _name(one.via), colour, width=1.5, **group)


def _convergence(page: Page, report: line.ExperimentReport) -> None:
    page.heading("Convergence")
    description = "Mean distance from the line by round of correction"
    title = "Mean distance by round of correction (0: before any)"
    with page.chart(description, title, "round", "mean distance, mm", yaxis_type="log") as chart:
        for one, colour in zip(report.outcomes, line.COLOURS, strict=False):
            for label, dash, paths in (
                ("true", "solid", [run.real_tool_m for run in one.rounds]),
                ("by encoders", "dot", [run.tool_m for run in one.rounds]),
            ):
                errors, name = _mean_errors_mm(report, paths), f"{_name(one.via)}, {label}"
                curve(chart, list(range(len(errors))), errors, name, colour, dash=dash, mode="lines+markers")
    if report.best_cost_mm:
        description = "Best cost of the genetic algorithm by generation"
        with page.chart(description, "Genetic algorithm on the recordings", "generation", "cost, mm") as chart:
            generations = list(range(1, len(report.best_cost_mm) + 1))
            curve(chart, generations, list(report.best_cost_mm), "best individual", line.GREEN)
            if report.exact_mean_mm is not None:
                line.level(chart, report.exact_mean_mm, "exact optimum")
            line.improving(chart, report.best_cost_mm)


def _prediction(page: Page, report: line.ExperimentReport) -> None:
    page.heading("Prediction against measurement")
    title = "Mean distance after correction, ± standard deviation over the repeats"
    with page.chart("Predicted, measured and true mean distance", title, "", "mean distance, mm") as chart:
        names = [_name(one.via) for one in report.outcomes]
        predicted = [one.runs[0].predicted_mean_mm for one in report.outcomes]
        chart.add_bar(x=names, y=predicted, name="predicted", marker={"color": line.FAINT})
        for name, colour, paths in (
            ("by encoders", "#3a6ea5", [[run.tool_m for run in one.runs] for one in report.outcomes]),
            ("true", line.GREEN, [[run.real_tool_m for run in one.runs] for one in report.outcomes]),
        ):
            errors = [_mean_errors_mm(report, some) for some in paths]
            spread = {"type": "data", "array": [float(np.std(some)) for some in errors]}
            means = [float(np.mean(some)) for some in errors]
            chart.add_bar(x=names, y=means, error_y=spread, name=name, marker={"color": colour})


def _mean_errors_mm(report: line.ExperimentReport, paths: Sequence[FloatArray]) -> list[float]:
    return [errors_mm(tool_m, *report.ends)[0] for tool_m in paths]


def _limits(page: Page, report: line.ExperimentReport) -> None:
    page.heading("What limits the rest")
    for stage, title in (("after_mm", "after correction"), ("before_mm", "before correction")):
        description = f"True mean distance {title} with one effect of the simulator switched off at a time"
        heading = f"True mean distance {title}, one effect switched off at a time"
        with page.chart(description, heading, "", "mean distance, mm") as chart:
            for via, colour in zip(dict.fromkeys(row["via"] for row in report.limits), line.COLOURS, strict=False):
                some = [row for row in report.limits if row["via"] == via]
                names = ["all effects" if row["without"] is None else f"without {row['without']}" for row in some]
                spread = {"type": "data", "array": [row["spread_mm"] for row in some]} if stage == "after_mm" else None
                values, marker = [row[stage] for row in some], {"color": colour}
                chart.add_bar(x=names, y=values, error_y=spread, name=_name(via), marker=marker)
    page.table(
        ("via", "without", "before, mm", "after, mm", "whole ticks, mm", "zero offsets, mm"),
        [_limit(row) for row in report.limits],
        "The shares do not add up, because the effects depend on one another. Whole ticks: the error that rounding "
        "goals to ticks causes on perfect servos. Zero offsets: the mean error by offsets of up to half a tick, which "
        "no encoder sees.",
    )


def _limit(row: dict[str, Any]) -> tuple[str, ...]:
    floors = (f"{row[floor]:.2f}" if row["without"] is None else "" for floor in ("ticks_mm", "unseen_mm"))
    after = f"{row['after_mm']:.2f} ± {row['spread_mm']:.2f}"
    return str(row["via"]), row["without"] or "nothing: all effects", f"{row['before_mm']:.2f}", after, *floors
