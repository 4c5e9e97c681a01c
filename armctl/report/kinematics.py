"""Pictures of kinematics: an arm, the cloud of points in its reach, and the curves of a trajectory.

A browser keeps only some sixteen charts in space alive on a page: what has many views is drawn in space once, and flat
in its other views.
"""

from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.chain import SerialChain, forward_kinematics, link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.kinematics.workspace import ReachabilityMap
from armctl.report.page import CLOSE, TEXTS, Figure, Page, axes, in_space
from armctl.report.page import curve as line
from armctl.trajectory.quintic import Curves

# Points of a cloud that are drawn; more only make the page slow.
SHOWN_POINTS = 5000
COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#555555")
IN_SPACE = "from the side and above"
# View -> the axes to the right and upwards.
FLAT = {"front (along x)": (1, 2), "left (along y)": (0, 2), "top (along z)": (0, 1)}
ARM_VIEWS = (IN_SPACE, *FLAT)
PLANES = {f"Projection on {'xyz'[i]}{'xyz'[j]}": (i, j) for i, j in FLAT.values()}
WORKSPACE_IN_SPACE = "Workspace in 3D"
WORKSPACE_VIEWS = (WORKSPACE_IN_SPACE, *PLANES)
Arms = dict[str, FloatArray]
UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
HEIGHT = 440
# What of a trajectory is drawn -> the field of `Curves`, and its unit there; metres are drawn as millimetres.
CURVES: dict[str, tuple[str, str]] = {title: (field, unit) for title, (field, unit) in TEXTS["curves"].items()}


def arm(
    chain: SerialChain,
    arms: Arms,
    view: str = IN_SPACE,
    tool_m: FloatArray | None = None,
    *,
    unit: str = "mm",
    axes_m: float = 0.0,
) -> Figure:
    """Arms as lines through their joints, to one scale.

    Args:
        arms: Configuration [rad], shape (n,), of each arm by its name.
        view: One of `ARM_VIEWS`.
        tool_m: The path of a tool in space, shape (m, 3).
        unit: One of `UNITS`.
        axes_m: How long the axes n, o, a of each tool are drawn; 0: not at all.
    """
    lines, drawn, plane = list[dict[str, Any]](), list[FloatArray](), FLAT.get(view)

    def add(points_m: FloatArray, name: str, mode: str = "lines", **style: Any) -> None:
        drawn.append(points_m * UNITS[unit])
        lines.append({**_along(drawn[-1], plane), "mode": mode, "name": name, **style})

    for k, ((name, q), colour) in enumerate(zip(arms.items(), COLOURS, strict=False)):
        # Where arms coincide the first still shows around the second.
        style = {"line": {"color": colour, "width": 9 if k == 0 else 4}, "marker": {"size": 5, "color": colour}}
        add(link_frames(chain, q)[:, :3, 3], name, "lines+markers", **style)
        T = forward_kinematics(chain, q)
        for axis, along, colour in zip("noa", T[:3, :3].T, COLOURS[1:4], strict=False) if axes_m else ():
            add(T[:3, 3] + np.outer((0.0, axes_m), along), axis, line={"color": colour, "width": 6})
    if tool_m is not None:
        add(tool_m, "tool path")
    return _seen(lines, np.concatenate(drawn), plane, unit)


def workspace(points_m: FloatArray, extent_m: FloatArray, view: str) -> Figure:
    """A cloud, shape (m, 3), and the box of its exact extents, shape (3, 2); `view`: one of `WORKSPACE_VIEWS`."""
    shown, plane = points_m[:: max(1, len(points_m) // SHOWN_POINTS)] * 1e3, PLANES.get(view)
    marker = {"size": 1.3, "color": COLOURS[3]} if plane is None else {"size": 2, "color": COLOURS[3], "opacity": 0.45}
    lines = [{**_along(shown, plane), "mode": "markers", "name": "random configurations", "marker": marker}]
    if plane is not None:
        (left, right), (low, high) = extent_m[list(plane)] * 1e3
        corners = {"x": [left, right, right, left, left], "y": [low, low, high, high, low], "type": "scatter"}
        lines.append({**corners, "name": "exact extents", "line": {"color": COLOURS[0], "width": 2}})
    return _seen(lines, shown, plane)


def reachability(reach: ReachabilityMap) -> Figure:
    """The points of a grid that are in reach; the colour tells in how many ways."""
    shown = reach.points_m[reach.reachable] * 1e3
    scale = {"color": reach.share[reach.reachable], "colorbar": {"title": {"text": "share"}}}
    marker = {"size": 3, "opacity": 0.7, **scale}
    return _seen([{**_along(shown, None), "mode": "markers", "marker": marker}], shown, None)


def curve(curves: Curves, title: str, first: int | None = None) -> Figure:
    """One of `CURVES` over time, a line for each joint or axis; all but the `first` ones on demand."""
    field, unit = CURVES[title]
    values, unit = in_mm(getattr(curves, field), unit)
    if unit.startswith("deg"):
        values, names = np.degrees(values), [f"joint {i + 1}" for i in range(values.shape[1])]
    else:
        names = ["x", "y", "z"]
    chart = axes("time [s]", f"{title.lower()} [{unit}]", 320)
    for k, (column, name, colour) in enumerate(zip(values.T, names, COLOURS * 6, strict=False)):
        line(chart, curves.time_s, column, name, colour, visible=True if first is None or k < first else "legendonly")
    return chart


def by_generation(figure: Figure, name: str, colour: str, best: FloatArray, mean: FloatArray) -> None:
    """Add the best and the mean of a genetic algorithm's population, one value a generation from the first on."""
    for values, which, dash in ((best, "best", "solid"), (mean, "mean", "dot")):
        line(figure, np.arange(1, len(values) + 1), values, name.format(which), colour, dash=dash)


def in_mm(values: FloatArray, unit: str) -> tuple[FloatArray, str]:
    """What is in metres (a second ...) in millimetres; anything else as it is."""
    return (values * 1e3, f"m{unit}") if unit.startswith("m") else (values, unit)


def extents_table(box_m: FloatArray, points_m: FloatArray) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...], str]:
    """Exact extents, shape (3, 2), beside those of a cloud, shape (m, 3): header, rows and caption."""
    boxes_mm = np.column_stack([box_m, points_m.min(axis=0), points_m.max(axis=0)]) * 1e3
    rows = tuple((axis, *(f"{value:.4f}" for value in row)) for axis, row in zip("xyz", boxes_mm, strict=True))
    header = ("axis", "exact least", "exact greatest", "random least", "random greatest")
    return header, rows, f"millimetres, within the joint ranges; random: {len(points_m)} configurations"


def write_workspace(
    robot: Robot, extent_m: FloatArray, points_m: FloatArray, reach: ReachabilityMap | None, path: Path
) -> None:
    """A page with the workspace."""
    page = Page(f"Workspace of {robot.name}")
    page.text(robot.source)
    page.table(*extents_table(extent_m, points_m))
    for view in (WORKSPACE_IN_SPACE, *sorted(PLANES)):
        page.heading(view)
        page.figure(workspace(points_m, extent_m, view), f"{view}: tool points of random configurations")
    if reach is not None:
        page.heading("Reachability")
        page.text("Colour: the share of the directions and branches tried at a point that keeps the joint ranges.")
        page.figure(reachability(reach), "points of a grid that the tool reaches")
    page.write(path)


def write_trajectory(robot: Robot, curves: Curves, path: Path) -> None:
    """A page with a trajectory's curves and the arm at its ends."""
    page = Page(f"Trajectory of {robot.name}")
    ends = {"start": curves.position_rad[0], "end": curves.position_rad[-1]}
    page.heading("In space")
    page.figure(arm(robot.chain, ends, tool_m=curves.tool_position_m), "the arm at both ends and the path of its tool")
    for title in CURVES:
        page.heading(title)
        page.figure(curve(curves, title), f"{title} over time")
    page.write(path)


def _along(points: FloatArray, plane: tuple[int, int] | None) -> dict[str, Any]:
    """A curve through points, shape (m, 3), in space or flat."""
    x, *more = points.T if plane is None else points.T[list(plane)]
    return {"type": "scatter", "x": x, "y": more[0]} | ({"type": "scatter3d", "z": more[1]} if plane is None else {})


def _seen(lines: list[dict[str, Any]], points: FloatArray, plane: tuple[int, int] | None, unit: str = "mm") -> Figure:
    """A chart of lines around points [unit], shape (m, 3): in space, or flat with two axes to one scale."""
    chart = Figure({**CLOSE, "height": HEIGHT}, lines)
    if plane is None:
        in_space(chart, points, unit)
        return chart
    right, up = ({"title": {"text": f"{'xyz'[axis]} [{unit}]"}, "constrain": "domain"} for axis in plane)
    chart.layout |= {"xaxis": right, "yaxis": {**up, "scaleanchor": "x"}}
    return chart
