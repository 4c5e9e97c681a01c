"""Pages about logs: one log judged and drawn, with what came before its faults, or two drawn over one another.

What is judged and drawn, and by which bounds, stands in log.yaml.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armctl.clock import NS_PER_S
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording.disk import new_file
from armctl.recording.notes import LEVELS
from armctl.recording.recordings import drawn
from armctl.recording.timeline import CYCLE_KEYS, Motion, Timeline
from armctl.report.line import distance_curve
from armctl.report.page import Marked, Page, curve, in_space
from armctl.trajectory.straightness import errors_mm

# Most points of a curve; a longer log shows the extremes of each stretch.
POINTS = 2000
EVENTS = 500
# What is shown around a fault [s], and of how many faults.
BEFORE_S, AFTER_S = 10.0, 1.0
FAULTS = 5
NAMES = {level: name for name, level in LEVELS.items()}
Answer = Mapping[str, Any]
ABOUT = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
COLOURS = ABOUT["colours"]
# How a verdict's figure is made of what is known of a joint.
_MADE: dict[str, Any] = {"mean": np.mean, "max": np.max, "min": np.min, "p99": lambda values: np.percentile(values, 99)}


def write(path: Path, *logs: Timeline, checked: Answer | None = None, rows: Sequence[Answer] = ()) -> None:
    """Write the page of a log, or of two, the second one dashed.

    Args:
        checked: Outcome of a re-run, if there was one: `ticks`, `messages`, `mismatches`.
        rows: What `recording.entry.diff` says of the two.
    Raises:
        LogError: `path` exists already or cannot be written.
    """
    page = Page(f"Log {' and '.join(one.path.name for one in logs)}", light=True)
    for one in logs:
        begun = f"{datetime.fromtimestamp(one.start_ns / NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
        page.text(f"{one.path.name}: arm {one.arm.arm_id}, {begun}, {one.duration_s:.1f} s, {len(one.time_s)} ticks.")
        if not one.complete:
            page.text("The file was cut or is damaged: what is intact is shown.")
        page.heading(f"Verdicts{_of(one, logs)}")
        _verdicts(page, one)
    if len(logs) == 2 and all(one.motions for one in logs):
        logs = tuple(map(_from_its_plan, logs))
        page.text("Time 0 is where the first plan of each begins.")
    if checked:
        counts = ", ".join(f"{checked[key]} {key}" for key in ("ticks", "messages", "mismatches"))
        page.text(f"Run through the control step again: {counts}.")
    if rows:
        page.heading("Figures")
        told = {float: "{:.6g}", type(None): ""}
        cells = [[told.get(type(cell), "{}").format(cell) for cell in row.values()] for row in rows]
        page.table(("quantity", "solid", "dashed", "difference"), cells)
    for one in logs:
        page.heading(f"State and faults{_of(one, logs)}")
        _state_figure(page, one)
        _before_faults(page, one, _of(one, logs))
    _charts(page, ABOUT["charts"], *logs)
    _tool_figure(page, *logs)
    _line_figures(page, *logs)
    for one in logs:
        page.heading(f"Events{_of(one, logs)}")
        _event_table(page, one)
    with new_file(path) as stream:
        stream.write(page.html().encode())


def _of(log: Timeline, logs: Sequence[Timeline]) -> str:
    """Which log a heading is about, where there are two."""
    return f" of {log.path.name}" if len(logs) > 1 else ""


def _from_its_plan(log: Timeline) -> Timeline:
    """The log with time 0 where its first plan begins."""
    later_ns = log.motions[0].begin_ns - log.start_ns
    return replace(log, start_ns=log.start_ns + later_ns, time_s=log.time_s - later_ns / NS_PER_S)


def _columns(log: Timeline) -> dict[str, FloatArray]:
    """What is judged and drawn, a row a tick; of joints shape (m, n), NaN where it is not known."""
    bus, load = dict(zip(CYCLE_KEYS, log.cycle.T, strict=True)), 100.0 * log.load_ratio
    off_deg = np.degrees(log.position_rad - log.goal_rad)
    missing = (np.diff(log.tick) - 1).clip(min=0).sum()  # another control process counts anew
    period_s = log.duration_s / max(1, len(log.tick) - 1 + missing) or math.inf
    return {
        "angle_deg": np.degrees(log.position_rad), "goal_deg": np.degrees(log.goal_rad), "off_deg": off_deg,
        "distance_deg": np.abs(off_deg), "load_percent": load, "effort_percent": np.abs(load),
        "voltage_V": log.voltage_V, "supply_left_V": log.voltage_V - log.arm.voltage_V[0],
        "temperature_degC": log.temperature_degC,
        "heat_left_degC": log.arm.temperature_limit_degC - log.temperature_degC,
        "lost_percent": 100.0 * ~log.fresh, "lost": np.cumsum(~log.fresh, axis=0), "retries": np.cumsum(bus["retries"]),
        "retries_percent": 100.0 * (bus["retries"] > 0), "late_percent": 100.0 * bus["overrun"],
        "round_percent": 1e-4 * bus["bus_us"] / period_s, "round_ms": bus["bus_us"] / 1e3,
        "late_ms": bus["lateness_us"] / 1e3,
        "faults": np.full(1, float(len(_faults(log)))), "missing": np.full(1, float(missing + bus["dropped"].sum())),
    }  # fmt: skip


def _verdicts(page: Page, log: Timeline) -> None:
    rows, columns, names = [], _columns(log), log.arm.joint_names
    for about in ABOUT["verdicts"]:
        good, bad, values = about["good"], about["bad"], columns[about["column"]]
        sign, mark = (1, "<=") if good <= bad else (-1, ">=")
        known = [(one[np.isfinite(one)], name) for one, name in zip(np.atleast_2d(values.T), names, strict=False)]
        found = [(sign * float(_MADE[about["of"]](one)), name) for one, name in known if len(one)]
        worst, joint = max(found, default=(math.nan, ""))
        verdict = "good" if worst <= sign * good else "watch" if worst <= sign * bad else "bad" if found else "unknown"
        text = f"{sign * worst:.3g} {about['unit']}" + (f" ({joint})" if values.ndim == 2 and found else "")
        what = about["what"] + (f": {about['remedy']}" if verdict in ("watch", "bad") else "")
        rows.append((what, Marked(verdict, ABOUT["looks"][verdict]), text, f"{mark} {good:g} ({bad:g})"))
    counted = ", ".join(f"{sum(row[1].text == verdict for row in rows)} {verdict}" for verdict in ABOUT["looks"])
    page.table(("", "verdict", "found", "good (bad beyond)"), rows, f"{counted}.", words=True)


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


def _charts(page: Page, charts: Sequence[Answer], *logs: Timeline, ticks: slice = slice(None)) -> None:
    """Columns over time, a curve a joint; those of a second log are dashed."""
    drawn = [_columns(log) for log in logs]
    for about in charts:
        title, heading = about["title"], about["heading"]
        with page.chart(f"{title} over time", title, "time, s", about["unit"], 320, heading) as chart:
            for log, columns, dashed in zip(logs, drawn, (None, "dash"), strict=False):
                for key, dash in about["columns"].items():
                    curves = zip(log.arm.joint_names, cycle(COLOURS), np.atleast_2d(columns[key].T), strict=False)
                    for name, colour, values in curves:
                        rows = thinned(values[ticks])
                        x, y = (column[ticks][rows].astype(np.float32) for column in (log.time_s, values))
                        first = dash == "solid" and columns[key].ndim == 2 and not dashed
                        more: dict[str, Any] = {"legendgroup": name, "showlegend": first}
                        curve(chart, x, y, name, colour, dash=dashed or dash, connectgaps=False, **more)


def _state_figure(page: Page, log: Timeline) -> None:
    drawn: dict[tuple[str, str], list[tuple[float, float]]] = {}
    told = []
    for row, changes in (("state", log.states), ("fault", log.faults)):
        times = [*(float(log.time_s[frame]) for frame, _ in changes), log.duration_s]
        for (_, what), (begin_s, end_s) in zip(changes, pairwise(times), strict=True):
            if what:
                drawn.setdefault((row, what.partition(":")[0]), []).append((begin_s, end_s - begin_s))
                told.append((row, f"{begin_s:.1f} to {end_s:.1f}", what))
    with page.chart(**ABOUT["state chart"]) as chart:
        for (row, name), bars in drawn.items():
            base, x = zip(*bars, strict=True)
            colour = {"color": ABOUT["states"].get(name if row == "state" else row, COLOURS[-1])}
            chart.add("bar", y=[row] * len(bars), base=base, x=x, orientation="h", name=name, marker=colour)
    if faults := [cells for row, *cells in told if row == "fault"]:
        page.table(("time s", "fault"), faults[:EVENTS], words=True)


def _faults(log: Timeline) -> list[tuple[float, str]]:
    """When each fault came up [s], and which."""
    came = [(float(log.time_s[frame]), what.partition(":")[0]) for frame, what in log.faults]
    return [now for before, now in pairwise([(0.0, ""), *came]) if now[1] not in ("", before[1])]


def _before_faults(page: Page, log: Timeline, of: str) -> None:
    for at_s, code in _faults(log)[:FAULTS]:
        page.heading(f"Before {code} at {at_s:.1f} s{of}")
        _event_table(page, log, at_s - BEFORE_S, at_s + AFTER_S)
        around = slice(log.index(at_s - BEFORE_S), log.index(at_s + AFTER_S) + 1)
        _charts(page, [{**chart, "heading": ""} for chart in ABOUT["charts"] if "before" in chart], log, ticks=around)


def _tool_figure(page: Page, *logs: Timeline) -> None:
    known = [np.flatnonzero(np.isfinite(log.tool[:, 0])) for log in logs]
    if not all(map(len, known)):
        return
    # Evenly in time: a path has no extremes of one axis that would stand for the others.
    rows = [one[drawn(len(one), POINTS)] for one in known]
    paths = [(log.tool[some, :3] * 1000.0).astype(np.float32) for log, some in zip(logs, rows, strict=True)]
    by_time = {"color": logs[0].time_s[rows[0]].astype(np.float32), "colorbar": {"title": {"text": "time, s"}}}
    with page.chart(**ABOUT["tool chart"]) as chart:
        for log, points, colour in zip(logs, paths, (COLOURS[3], COLOURS[0]), strict=False):
            (x, y, z), line = points.T, {"color": colour} if len(logs) == 2 else by_time
            chart.add("scatter3d", x=x, y=y, z=z, mode="lines", line=line, name=log.path.name)
        in_space(chart, np.concatenate(paths))


def _line_figures(page: Page, *logs: Timeline) -> None:
    """How straight each run was: its distance from the line between its commanded ends."""
    lines = [(log, motion, *ends) for log in logs for motion in log.motions if (ends := _ends(log, motion)) is not None]
    rows, curves = [], []
    for (log, motion, A, B), colour in zip(lines, cycle(COLOURS), strict=False):
        begin, end = (log.index((time_ns - log.start_ns) / NS_PER_S) for time_ns in (motion.begin_ns, motion.end_ns))
        points = log.tool[begin : end + 1, :3]
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            continue
        mean_mm, max_mm = errors_mm(points, A, B)
        name = f"{motion.label}, {log.time_s[begin]:.1f} s" + (f", {log.path.name}" if log is not logs[0] else "")
        rows.append((name, f"{mean_mm:.2f}", f"{max_mm:.2f}", f"{(motion.end_ns - motion.begin_ns) / NS_PER_S:.1f}"))
        curves.append(((A, B), points, name, colour))
    if not rows:
        return
    page.heading("Straightness of the runs")
    told = "Distance of the tool, by the encoders, from the line between the commanded ends"
    page.table(("run", "mean mm", "maximum mm", "time s"), rows, f"{told} of each run (Raharjo et al. eqs. 19, 20).")
    with page.chart(**ABOUT["line chart"]) as chart:
        for drawn in curves:
            distance_curve(chart, *drawn)


def _ends(timeline: Timeline, motion: Motion) -> tuple[FloatArray, FloatArray] | None:
    """Where the tool was to begin and end; None where these make no line."""
    chain = robots.get(timeline.arm.robot, timeline.arm.lengths_m).chain
    A, B = (tool_position(chain, np.array(q[: chain.n])) for q in (motion.begin_rad, motion.end_rad))
    return None if math.dist(A, B) < 1e-6 else (A, B)


def _event_table(page: Page, log: Timeline, begin_s: float = -math.inf, end_s: float = math.inf) -> None:
    told = [((one.time_ns - log.start_ns) / NS_PER_S, one.level, one.text) for one in log.happenings]
    inside = [one for one in told if begin_s <= one[0] <= end_s]
    rows = [(f"{at_s:.1f}", NAMES.get(level, str(level)), text) for at_s, level, text in inside]
    note = f"The first {EVENTS}; {len(rows) - EVENTS} more stand in the log." if len(rows) > EVENTS else ""
    page.table(("time s", "level", "event"), rows[:EVENTS], note, words=True)
