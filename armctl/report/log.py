"""One log on one page: joints against goals, load, voltage, temperature, the tool in space, states, faults, events."""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording.disk import new_file
from armctl.recording.timeline import Happening, Motion, Timeline
from armctl.report.page import Page, cube, curve, layout, plotly
from armctl.trajectory.straightness import distance_to_line

# Most points of a curve; a longer log shows the extremes of each stretch.
POINTS = 4000
EVENTS = 500
COLOURS = ("#d1495b", "#d98e1f", "#2f9e6e", "#3f7fd0", "#9a6bd1", "#7d8b99")
STATE_COLOURS = {
    "off": "#9aa7b4",
    "energising": "#e3b34c",
    "holding": "#2f9e6e",
    "moving": "#3f7fd0",
    "parking": "#6fb7c9",
    "teaching": "#9a6bd1",
    "faulted": "#d1495b",
}
_UNKNOWN_COLOUR = "#7d8b99"


def write(timeline: Timeline, path: Path, checked: Mapping[str, Any] | None = None) -> None:
    """Write the page.

    Args:
        checked: Outcome of a re-run, if there was one: `ticks`, `messages`, `mismatches`.
    Raises:
        LogError: `path` exists already or cannot be written.
    """
    page = Page(f"Log {timeline.path.name}")
    begun = datetime.fromtimestamp(timeline.start_ns / NS_PER_S, UTC)
    page.text(
        f"Arm {timeline.arm.arm_id}, {begun:%Y-%m-%d %H:%M:%S} UTC, {timeline.duration_s:.1f} s, "
        f"{len(timeline.time_s)} ticks."
    )
    if not timeline.complete:
        page.text("The file was cut or is damaged: what is intact is shown.")
    if checked:
        page.text(
            f"Run through the control step again: {checked['ticks']} ticks, {checked['messages']} messages, "
            f"{checked['mismatches']} mismatches."
        )
    _state_figure(page, timeline)
    _joint_figures(page, timeline)
    _tool_figure(page, timeline)
    _line_figures(page, timeline)
    _servo_figures(page, timeline)
    _event_table(page, timeline)
    with new_file(path) as stream:
        stream.write(page.html().encode())


def thinned(values: FloatArray, most: int = POINTS) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Which rows to draw: all of a short column; of a long one the lowest and the highest of each stretch, in order.

    Args:
        values: One column, shape (m,).
        most: Bound of the number of rows, those at gaps aside.
    """
    m = len(values)
    if m <= most:
        return np.arange(m)
    unknown = np.isnan(values)
    low, high = np.where(unknown, np.inf, values), np.where(unknown, -np.inf, values)
    rows = {0, m - 1}
    for begin, end in pairwise(np.linspace(0, m, most // 2 + 1).astype(np.int64).tolist()):
        rows |= {begin + int(low[begin:end].argmin()), begin + int(high[begin:end].argmax())}
    edges = np.flatnonzero(np.diff(unknown))  # where a curve breaks off, and where it goes on
    return np.unique(np.concatenate([np.array(sorted(rows)), edges, edges + 1]))


def _curve(chart: Any, time_s: FloatArray, values: FloatArray, name: str, colour: str, **more: Any) -> None:
    rows = thinned(values)
    x, y = time_s[rows].astype(np.float32), values[rows].astype(np.float32)
    curve(chart, x, y, name, colour, connectgaps=False, **more)


def _stretches(changes: Sequence[tuple[int, str]], timeline: Timeline) -> list[tuple[float, float, str]]:
    """(begin [s], end [s], what) of each stretch between two changes."""
    begins = [float(timeline.time_s[frame]) for frame, _ in changes]
    ends = [*begins[1:], timeline.duration_s]
    return [(begin, end, what) for begin, end, (_, what) in zip(begins, ends, changes, strict=True)]


def _state_figure(page: Page, timeline: Timeline) -> None:
    page.heading("State and faults")
    chart = plotly()()
    seen: set[str] = set()
    rows = [("state", _stretches(timeline.states, timeline)), ("fault", _stretches(timeline.faults, timeline))]
    for row, stretches in rows:
        for begin_s, end_s, what in stretches:
            name = what if row == "state" else what.partition(":")[0]
            if not name:
                continue
            chart.add_bar(
                y=[row],
                base=[begin_s],
                x=[end_s - begin_s],
                orientation="h",
                name=name,
                legendgroup=name,
                showlegend=name not in seen,
                marker={
                    "color": STATE_COLOURS.get(name, STATE_COLOURS["faulted"] if row == "fault" else _UNKNOWN_COLOUR)
                },
                hovertemplate=f"{name}, {begin_s:.1f} to {end_s:.1f} s<extra></extra>",
            )
            seen.add(name)
    layout(chart, "What the arm did", "time, s", "", height=220, barmode="overlay")
    chart.update_yaxes(categoryorder="array", categoryarray=["fault", "state"])
    page.figure(chart, "States and faults of the arm over time")
    faults = [(f"{begin:.1f} to {end:.1f}", what) for begin, end, what in _stretches(timeline.faults, timeline) if what]
    if faults:
        page.table(("time s", "fault"), faults, words=True)


def _joint_figures(page: Page, timeline: Timeline) -> None:
    page.heading("Joints against their goals")
    chart = plotly()()
    for j, name in enumerate(timeline.arm.joint_names):
        colour = COLOURS[j % len(COLOURS)]
        measured, goal = np.degrees(timeline.position_rad[:, j]), np.degrees(timeline.goal_rad[:, j])
        _curve(chart, timeline.time_s, measured, name, colour, legendgroup=name)
        dotted = {"width": 1, "dash": "dot", "legendgroup": name, "showlegend": False}
        _curve(chart, timeline.time_s, goal, f"{name} goal", colour, **dotted)
    layout(chart, "Joint angles (dotted: goals; none while limp)", "time, s", "angle, deg")
    page.figure(chart, "Measured joint angles and goals over time")
    _quantity(page, timeline, np.degrees(timeline.position_rad - timeline.goal_rad), "Distance from the goal", "deg")


def _servo_figures(page: Page, timeline: Timeline) -> None:
    page.heading("Servos")
    _quantity(page, timeline, timeline.load_ratio * 100.0, "Load", "% of full output")
    _quantity(page, timeline, timeline.voltage_V, "Supply voltage", "V")
    _quantity(page, timeline, timeline.temperature_degC, "Temperature", "degC")


def _quantity(page: Page, timeline: Timeline, values: FloatArray, title: str, unit: str) -> None:
    chart = plotly()()
    for j, name in enumerate(timeline.arm.joint_names):
        _curve(chart, timeline.time_s, values[:, j], name, COLOURS[j % len(COLOURS)], width=1.5)
    layout(chart, title, "time, s", f"{title.lower()}, {unit}", height=320)
    page.figure(chart, f"{title} of every joint over time")


def _tool_figure(page: Page, timeline: Timeline) -> None:
    known = np.flatnonzero(np.isfinite(timeline.tool[:, 0]))
    if not len(known):
        return
    page.heading("Tool in space")
    # Evenly in time: a path has no extremes of one axis that would stand for the others.
    rows = known[np.unique(np.linspace(0, len(known) - 1, min(POINTS, len(known))).astype(np.int64))]
    x, y, z = (timeline.tool[rows, :3] * 1000.0).astype(np.float32).T
    chart = plotly()()
    chart.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="lines",
        line={"width": 4, "color": timeline.time_s[rows], "colorscale": "Viridis", "colorbar": {"title": "time, s"}},
        name="tool",
        hovertemplate="%{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>",
    )
    layout(chart, "Tool path by the encoders", "", "", height=560)
    cube(
        chart,
        np.stack([x, y, z], axis=1),
        {"eye": {"x": 1.5, "y": -1.5, "z": 0.9}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}},
    )
    page.figure(chart, "Path of the tool in space, coloured by time")


def _line_figures(page: Page, timeline: Timeline) -> None:
    """How straight each run was: its distance from the line between its commanded ends."""
    lines = [(motion, *ends) for motion in timeline.motions if (ends := _ends(timeline, motion)) is not None]
    rows, chart = [], plotly()()
    for number, (motion, A, B) in enumerate(lines):
        begin, end = (
            timeline.index((time_ns - timeline.start_ns) / NS_PER_S) for time_ns in (motion.begin_ns, motion.end_ns)
        )
        points = timeline.tool[begin : end + 1, :3]
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            continue
        error_mm = distance_to_line(points, A, B) * 1000.0
        along_mm = (points - A) @ (B - A) / np.linalg.norm(B - A) * 1000.0
        name = f"{motion.label}, {timeline.time_s[begin]:.1f} s"
        duration_s = (motion.end_ns - motion.begin_ns) / NS_PER_S
        rows.append((name, f"{error_mm.mean():.2f}", f"{error_mm.max():.2f}", f"{duration_s:.1f}"))
        curve(chart, along_mm, error_mm, name, COLOURS[number % len(COLOURS)])
    if not rows:
        return
    page.heading("Straightness of the runs")
    page.table(
        ("run", "mean mm", "maximum mm", "time s"),
        rows,
        "Distance of the tool, by the encoders, from the line between the commanded ends of each run "
        "(Raharjo et al. eqs. 19, 20).",
    )
    layout(chart, "Distance from the line", "along the line, mm", "distance, mm", height=320)
    page.figure(chart, "Distance of the tool from the line along each run")


def _ends(timeline: Timeline, motion: Motion) -> tuple[FloatArray, FloatArray] | None:
    """Where the tool was to begin and end; None where these make no line."""
    chain = robots.get(timeline.arm.robot, timeline.arm.lengths_m).chain
    A, B = (tool_position(chain, np.array(q[: chain.n])) for q in (motion.begin_rad, motion.end_rad))
    return None if math.dist(A, B) < 1e-6 else (A, B)


def _event_table(page: Page, timeline: Timeline) -> None:
    page.heading("Events")
    shown = timeline.happenings[:EVENTS]
    left_out = len(timeline.happenings) - len(shown)
    page.table(
        ("time s", "level", "event"),
        [(f"{(one.time_ns - timeline.start_ns) / NS_PER_S:.1f}", _level(one), one.text) for one in shown],
        f"The first {EVENTS}; {left_out} more stand in the log." if left_out else "",
        words=True,
    )


def _level(happening: Happening) -> str:
    return {20: "info", 30: "warning", 40: "error"}.get(happening.level, str(happening.level))
