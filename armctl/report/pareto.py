"""Two fronts on one page: error against duration, and error against the number of via points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from armctl.report.page import Page, plotly

_COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#5a6878", "#9a5b2e", "#3f8f9b")


def write(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write the page of a study of durations and via points (the rows of `armctl study pareto`)."""
    page = Page("Straight line: error against time and against via points")
    add_fronts(page, rows)
    page.write(path)


def add_fronts(page: Page, rows: Sequence[dict[str, Any]]) -> None:
    """Add both fronts and their table to a page."""
    truth = any(row.get("truth") for row in rows)

    def error(row: dict[str, Any]) -> float | None:
        if truth:
            return float(row["truth"]["mean_error_mm"]) if row["truth"] else None
        return float(row["predicted_mean_error_mm"]) if row["feasible"] else None

    def spread(row: dict[str, Any]) -> float:
        return float(row["truth"]["spread_mm"]) if row.get("truth") else 0.0

    judge = "true distance, simulated arms after correction" if truth else "predicted distance, perfect servos"
    page.heading("Error against time and against via points")
    page.text(f"Judged by: {judge}. A ringed point is on the front: no other is as good in both and better in one.")
    for axis, by, front, title in (
        ("duration_s", "via", "front_duration", "duration, s"),
        ("via", "duration_s", "front_via", "via points"),
    ):
        chart = plotly()()
        for number, value in enumerate(dict.fromkeys(row[by] for row in rows)):
            some = [row for row in rows if row[by] == value and error(row) is not None]
            colour = _COLOURS[number % len(_COLOURS)]
            chart.add_scatter(
                x=[row[axis] for row in some],
                y=[error(row) for row in some],
                error_y={"type": "data", "array": [spread(row) for row in some], "visible": truth},
                mode="lines+markers",
                line={"color": colour, "width": 1.5},
                name=f"{value} via points" if by == "via" else f"{value:g} s",
            )
        best = sorted((row for row in rows if row[front]), key=lambda row: float(row[axis]))
        chart.add_scatter(
            x=[row[axis] for row in best],
            y=[error(row) for row in best],
            mode="lines+markers",
            line={"color": "#7d8b99", "width": 2, "dash": "dot"},
            marker={"size": 14, "symbol": "circle-open", "line": {"width": 2}},
            name="front",
        )
        chart.update_layout(
            title=f"Mean distance from the line against {title}",
            xaxis_title=title,
            yaxis_title="mean distance, mm",
            yaxis_type="log",
            template="plotly_white",
            height=420,
            margin={"l": 60, "r": 20, "t": 50, "b": 50},
        )
        page.figure(chart, f"Mean distance from the line against {title}, the front marked")
    page.table(
        ("s", "via", "recorded genes, mm", "predicted, mm", "true, mm", "front by time", "front by via"),
        [
            (
                f"{row['duration_s']:g}",
                row["via"],
                f"{row['recorded_mean_error_mm']:.2f}" if row["feasible"] else "no path keeps the limits",
                f"{row['predicted_mean_error_mm']:.3f}",
                _true(row.get("truth")),
                "yes" if row["front_duration"] else "",
                "yes" if row["front_via"] else "",
            )
            for row in rows
        ],
        "Recorded genes: what the genetic algorithm found. Predicted: its plan, genes and via points free.",
    )


def _true(truth: dict[str, Any] | None) -> str:
    if truth is None:
        return "-"
    spread = f" ± {truth['spread_mm']:.2f}" if truth["arms"] > 1 else ""
    return f"{truth['mean_error_mm']:.2f}{spread}"
