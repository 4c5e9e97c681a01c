"""Two fronts on one page: error against duration, and error against the number of via points."""

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from armctl.report.page import TEXTS, Page, curve

_COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#5a6878", "#9a5b2e", "#3f8f9b")


def write(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write the page of a study of durations and via points (the rows of `armctl study pareto`)."""
    page = Page("Straight line: error against time and against via points")
    add_fronts(page, rows)
    page.write(path)


def add_fronts(page: Page, rows: Sequence[dict[str, Any]]) -> None:
    """Add both fronts and their table to a page."""
    truth = any(row.get("truth") for row in rows)
    judge = "true distance, simulated arms after correction" if truth else "predicted distance, perfect servos"
    page.heading("Error against time and against via points")
    page.text(f"Judged by: {judge}. A ring marks the front: no other point is as good in both and better in one.")
    for axis, by, front, title in (
        ("duration_s", "via", "front_duration", "duration, s"),
        ("via", "duration_s", "front_via", "via points"),
    ):
        heading = f"Mean distance from the line against {title}"
        with page.chart(f"{heading}, the front marked", heading, title, "mean distance, mm", type="log") as chart:
            for value, colour in zip(dict.fromkeys(row[by] for row in rows), cycle(_COLOURS), strict=False):
                some = [row for row in rows if row[by] == value and math.isfinite(error_mm(row))]
                name = f"{value} via points" if by == "via" else f"{value:g} s"
                spreads = [float(row["truth"]["spread_mm"]) if row.get("truth") else 0.0 for row in some]
                bars = {"type": "data", "array": spreads, "visible": truth}
                x, y = [row[axis] for row in some], [error_mm(row) for row in some]
                curve(chart, x, y, name, colour, width=1.5, mode="lines+markers", error_y=bars)
            best = sorted((row for row in rows if row[front]), key=lambda row: float(row[axis]))
            x, y = [row[axis] for row in best], [error_mm(row) for row in best]
            rings = {"size": 14, "symbol": "circle-open", "line": {"width": 2}}
            curve(chart, x, y, "front", "#7d8b99", dash="dot", mode="lines+markers", marker=rings)
    page.table(rows=[_told(row) for row in rows], **TEXTS["line"]["fronts"])


def error_mm(row: dict[str, Any]) -> float:
    """The error a row is judged by: the true one if arms ran it, else the predicted one; infinite if nothing ran."""
    if "truth" in row:
        return math.inf if row["truth"] is None else float(row["truth"]["mean_error_mm"])
    return float(row["predicted_mean_error_mm"]) if row["feasible"] else math.inf


def _told(row: dict[str, Any]) -> tuple[str, ...]:
    genes = f"{row['recorded_mean_error_mm']:.2f}" if row["feasible"] else "no path keeps the limits"
    cells = (str(row["via"]), genes, f"{row['predicted_mean_error_mm']:.3f}", _true(row.get("truth")))
    return f"{row['duration_s']:g}", *cells, *("yes" if row[front] else "" for front in ("front_duration", "front_via"))


def _true(truth: dict[str, Any] | None) -> str:
    if truth is None:
        return "-"
    spread = f" ± {truth['spread_mm']:.2f}" if truth["arms"] > 1 else ""
    return f"{truth['mean_error_mm']:.2f}{spread}"
