"""One log on one page: joints against goals, load, voltage, temperature, the tool in space, states, faults, events."""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording.disk import new_file
from armctl.recording.timeline import Motion, Timeline
from armctl.report.page import Page, curve, in_space
from armctl.trajectory.straightness import distance_to_line

# Most points of a curve; a longer log shows the extremes of each stretch.
POINTS = 4000
EVENTS = 500
LEVELS = {20: "info", 30: "warning", 40: "error"}
COLOURS = ("#d1495b", "#d98e1f", "#2f9e6e", "#3f7fd0", "#9a6bd1", "#7d8b99")
STATE_COLOURS = {
    "starting": "#c8d0d8",
    "off": "#9aa7b4",
    "energising": "#e3b34c",
    "holding": "#2f9e6e",
    "moving": "#3f7fd0",
    "parking": "#6fb7c9",
    "teaching": "#9a6bd1",
    "releasing": "#b39ddb",
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
    states = _stretches(timeline.states, timeline)
    faults = [stretch for stretch in _stretches(timeline.faults, timeline) if stretch[2]]
    rows = [("state", what, _UNKNOWN_COLOUR, begin, end) for begin, end, what in states if what]
    rows += [("fault", what.partition(":")[0], STATE_COLOURS["faulted"], begin, end) for begin, end, what in faults]
    description, title = "States and faults of the arm over time", "What the arm did"
    with page.chart(description, title, "time, s", "", height=220, barmode="overlay") as chart:
        seen: set[str] = set()
        for row, name, colour, begin_s, end_s in rows:
            bar = {"y": [row], "base": [begin_s], "x": [end_s - begin_s], "orientation": "h", "name": name}
            look = {"marker": {"color": STATE_COLOURS.get(name, colour)}, "showlegend": name not in seen}
            hover = f"{name}, {begin_s:.1f} to {end_s:.1f} s<extra></extra>"
            chart.add_bar(**bar, **look, legendgroup=name, hovertemplate=hover)
            seen.add(name)
        chart.update_yaxes(categoryorder="array", categoryarray=["fault", "state"])
    if faults:
        told = [(f"{begin_s:.1f} to {end_s:.1f}", what) for begin_s, end_s, what in faults]
        page.table(("time s", "fault"), told, words=True)


def _joint_figures(page: Page, timeline: Timeline) -> None:
    page.heading("Joints against their goals")
    title = "Joint angles (dotted: goals; none while limp)"
    with page.chart("Measured joint angles and goals over time", title, "time, s", "angle, deg") as chart:
        for j, (name, colour) in enumerate(zip(timeline.arm.joint_names, cycle(COLOURS), strict=False)):
            measured, goal = np.degrees(timeline.position_rad[:, j]), np.degrees(timeline.goal_rad[:, j])
            _curve(chart, timeline.time_s, measured, name, colour, legendgroup=name)
            dotted = {"width": 1, "dash": "dot", "legendgroup": name, "showlegend": False}
            _curve(chart, timeline.time_s, goal, f"{name} goal", colour, **dotted)
    _quantity(page, timeline, np.degrees(timeline.position_rad - timeline.goal_rad), "Distance from the goal", "deg")


def _servo_figures(page: Page, timeline: Timeline) -> None:
    page.heading("Servos")
    _quantity(page, timeline, timeline.load_ratio * 100.0, "Load", "% of full output")
    _quantity(page, timeline, timeline.voltage_V, "Supply voltage", "V")
    _quantity(page, timeline, timeline.temperature_degC, "Temperature", "degC")


def _quantity(page: Page, timeline: Timeline, values: FloatArray, title: str, unit: str) -> None:
    y = f"{title.lower()}, {unit}"
    with page.chart(f"{title} of every joint over time", title, "time, s", y, height=320) as chart:
        for name, colour, column in zip(timeline.arm.joint_names, cycle(COLOURS), values.T, strict=False):
            _curve(chart, timeline.time_s, column, name, colour, width=1.5)


def _tool_figure(page: Page, timeline: Timeline) -> None:
    known = np.flatnonzero(np.isfinite(timeline.tool[:, 0]))
    if not len(known):
        return
    page.heading("Tool in space")
    # Evenly in time: a path has no extremes of one axis that would stand for the others.
    rows = known[np.unique(np.linspace(0, len(known) - 1, min(POINTS, len(known))).astype(np.int64))]
    x, y, z = (timeline.tool[rows, :3] * 1000.0).astype(np.float32).T
    line = {"width": 4, "color": timeline.time_s[rows], "colorscale": "Viridis", "colorbar": {"title": "time, s"}}
    description = "Path of the tool in space, coloured by time"
    with page.chart(description, "Tool path by the encoders", "", "", height=560) as chart:
        hover = "%{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>"
        chart.add_scatter3d(x=x, y=y, z=z, mode="lines", line=line, name="tool", hovertemplate=hover)
        in_space(chart, np.stack([x, y, z], axis=1))


def _line_figures(page: Page, timeline: Timeline) -> None:
    """How straight each run was: its distance from the line between its commanded ends."""
    lines = [(motion, *ends) for motion in timeline.motions if (ends := _ends(timeline, motion)) is not None]
    rows, curves = [], []
    for (motion, A, B), colour in zip(lines, cycle(COLOURS), strict=False):
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
        curves.append((along_mm, error_mm, name, colour))
    if not rows:
        return
    page.heading("Straightness of the runs")
    page.table(
        ("run", "mean mm", "maximum mm", "time s"),
        rows,
        "Distance of the tool, by the encoders, from the line between the commanded ends of each run "
        "(Raharjo et al. eqs. 19, 20).",
    )
    description = "Distance of the tool from the line along each run"
    with page.chart(description, "Distance from the line", "along the line, mm", "distance, mm", height=320) as chart:
        for drawn in curves:
            curve(chart, *drawn)


def _ends(timeline: Timeline, motion: Motion) -> tuple[FloatArray, FloatArray] | None:
    """Where the tool was to begin and end; None where these make no line."""
    chain = robots.get(timeline.arm.robot, timeline.arm.lengths_m).chain
    A, B = (tool_position(chain, np.array(q[: chain.n])) for q in (motion.begin_rad, motion.end_rad))
    return None if math.dist(A, B) < 1e-6 else (A, B)


def _event_table(page: Page, timeline: Timeline) -> None:
    page.heading("Events")
    shown = timeline.happenings[:EVENTS]
    left_out = len(timeline.happenings) - len(shown)
    note = f"The first {EVENTS}; {left_out} more stand in the log." if left_out else ""
    rows = [
        (f"{(one.time_ns - timeline.start_ns) / NS_PER_S:.1f}", LEVELS.get(one.level, str(one.level)), one.text)
        for one in shown
    ]
    page.table(("time s", "level", "event"), rows, note, words=True)
