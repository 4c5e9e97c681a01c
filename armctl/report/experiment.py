"""The page of a straight-line experiment: before and after correction, and what limits the error that is left.

A figure that is a mean of several runs is shown with their spread. Where the true tool path is known, it is drawn.
"""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report import line, pareto, picture
from armctl.report.page import TEXTS, Page, curve
from armctl.trajectory.straightness import errors_mm


def write(report: line.ExperimentReport, path: Path) -> None:
    """Write the page; where `path` ends in .svg, a picture of the paths alone."""
    if path.suffix == ".svg":
        picture.write(report, path)
        return
    page = Page("Straight line: before and after correction")
    page.text(line.wanted(report.ends), *report.notes)
    shown = []
    for one, colour in zip(report.outcomes, cycle(line.COLOURS), strict=False):
        after = f"after corrections: {len(one.rounds) - 1}"
        shown += [line.Shown(one.via, *runs, colour) for runs in (("before", [one.before]), (after, one.runs))]
    line.add_distances(page, report.ends, shown)
    line.add_paths(page, report.ends, shown)
    line.add_deviations(page, report.ends, shown)
    _convergence(page, report)
    _prediction(page, report)
    if report.limits:
        _limits(page, report)
    if report.fronts:
        pareto.add_fronts(page, report.fronts)
    page.write(path)


def _convergence(page: Page, report: line.ExperimentReport) -> None:
    with page.chart(**TEXTS["line"]["convergence"], type="log") as chart:
        for one, colour in zip(report.outcomes, line.COLOURS, strict=False):
            for label, dash, paths in (
                ("true", "solid", [run.real_tool_m for run in one.rounds]),
                ("by encoders", "dot", [run.tool_m for run in one.rounds]),
            ):
                errors, name = _mean_errors_mm(report, paths), f"{line.via_text(one.via)}, {label}"
                curve(chart, list(range(len(errors))), errors, name, colour, dash=dash, mode="lines+markers")
    if report.best_cost_mm:
        levels = {} if report.exact_mean_mm is None else {"exact optimum": report.exact_mean_mm}
        line.add_generations(page, {"best": report.best_cost_mm}, levels)


def _prediction(page: Page, report: line.ExperimentReport) -> None:
    with page.chart(**TEXTS["line"]["prediction"]) as chart:
        names = [line.via_text(one.via) for one in report.outcomes]
        predicted = [one.runs[0].predicted_mean_mm for one in report.outcomes]
        chart.add("bar", x=names, y=predicted, name="predicted", marker={"color": line.FAINT})
        for name, colour, paths in (
            ("by encoders", "#3a6ea5", [[run.tool_m for run in one.runs] for one in report.outcomes]),
            ("true", line.GREEN, [[run.real_tool_m for run in one.runs] for one in report.outcomes]),
        ):
            errors = [_mean_errors_mm(report, some) for some in paths]
            spread = {"type": "data", "array": [float(np.std(some)) for some in errors]}
            means = [float(np.mean(some)) for some in errors]
            chart.add("bar", x=names, y=means, error_y=spread, name=name, marker={"color": colour})


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
                values, spreads = ([row[key] for row in some] for key in (stage, "spread_mm"))
                spread = {"type": "data", "array": spreads, "visible": stage == "after_mm"}
                chart.add("bar", x=names, y=values, error_y=spread, name=line.via_text(via), marker={"color": colour})
    page.table(rows=[_limit(row) for row in report.limits], **TEXTS["line"]["limits"])


def _limit(row: dict[str, Any]) -> tuple[str, ...]:
    floors = (f"{row[floor]:.2f}" if row["without"] is None else "" for floor in ("ticks_mm", "unseen_mm"))
    after = f"{row['after_mm']:.2f} ± {row['spread_mm']:.2f}"
    return str(row["via"]), row["without"] or "nothing: all effects", f"{row['before_mm']:.2f}", after, *floors
