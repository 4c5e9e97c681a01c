"""Pictures of kinematics: an arm in four views, a workspace in 3D and three projections, the curves of a trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.kinematics.chain import SerialChain, link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.kinematics.workspace import ReachabilityMap
from armctl.report.page import Page, plotly
from armctl.trajectory.quintic import Curves

if TYPE_CHECKING:
    import plotly.graph_objects as go

SHOWN_POINTS = 8000
"""Points of a cloud that are drawn; more only make the page slow."""
COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#555555")
_PLANES = ((0, 1), (0, 2), (1, 2))
_VIEWS = {
    "from the side and above": (1.4, 1.4, 0.9),
    "front (along x)": (2.2, 0.0, 0.0),
    "left (along y)": (0.0, 2.2, 0.0),
    "top (along z)": (0.0, 0.0, 2.2),
}


def workspace_figures(points_m: FloatArray, extent_m: FloatArray) -> dict[str, go.Figure]:
    """The cloud in 3D and in the planes xy, xz, yz, with the box of the exact extents; keyed by what they show."""
    figure = plotly()
    shown = points_m[:: max(1, len(points_m) // SHOWN_POINTS)]
    x, y, z = shown.T
    cloud = {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "markers", "marker": {"size": 1.2, "color": z}}
    figures = {"Workspace in 3D": figure([cloud], layout=_scene((1.4, 1.4, 0.9)))}
    for i, j in _PLANES:
        (low_i, high_i), (low_j, high_j) = extent_m[i], extent_m[j]
        box = {
            "type": "scatter",
            "x": [low_i, high_i, high_i, low_i, low_i],
            "y": [low_j, low_j, high_j, high_j, low_j],
            "mode": "lines",
            "line": {"color": COLOURS[0], "width": 1},
            "name": "exact extents",
        }
        dots = {
            "type": "scattergl",
            "x": shown[:, i],
            "y": shown[:, j],
            "mode": "markers",
            "marker": {"size": 2, "color": COLOURS[3], "opacity": 0.4},
            "name": "random configurations",
        }
        a, b = "xyz"[i], "xyz"[j]
        layout = {"xaxis": {"title": f"{a} [m]"}, "yaxis": {"title": f"{b} [m]", "scaleanchor": "x"}, "height": 480}
        figures[f"Projection on {a}{b}"] = figure([dots, box], layout=layout)
    return figures


def reachability_figure(reach: ReachabilityMap) -> go.Figure:
    """The points of a grid that are in reach, coloured by how freely."""
    inside = reach.reachable
    x, y, z = reach.points_m[inside].T
    marker = {"size": 3, "color": reach.share[inside], "colorbar": {"title": "share"}, "opacity": 0.7}
    points = {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "markers", "marker": marker}
    return plotly()([points], layout=_scene((1.4, 1.4, 0.9)))


def arm_figures(chain: SerialChain, arms: dict[str, FloatArray]) -> dict[str, go.Figure]:
    """Arms as lines through their joints, keyed by view: in space, from the front, from the left, from above.

    Args:
        arms: Configuration [rad], shape (n,), of each arm by its name.
    """
    figure = plotly()
    lines = []
    for (name, q), colour in zip(arms.items(), COLOURS, strict=False):
        x, y, z = link_frames(chain, q)[:, :3, 3].T
        lines.append(
            {
                "type": "scatter3d",
                "x": x,
                "y": y,
                "z": z,
                "name": name,
                "mode": "lines+markers",
                "line": {"width": 8, "color": colour},
                "marker": {"size": 4, "color": colour},
            }
        )
    return {view: figure(lines, layout=_scene(eye)) for view, eye in _VIEWS.items()}


def curve_figures(curves: Curves) -> dict[str, go.Figure]:
    """Position, velocity and acceleration of the joints, and of the tool, over time."""
    names = [f"joint {i + 1}" for i in range(curves.position_rad.shape[1])]
    axes = ["x", "y", "z"]
    shown = (
        ("Joint positions", "deg", np.degrees(curves.position_rad), names),
        ("Joint velocities", "deg/s", np.degrees(curves.velocity_rad_s), names),
        ("Joint accelerations", "deg/s²", np.degrees(curves.acceleration_rad_s2), names),
        ("Tool position", "m", curves.tool_position_m, axes),
        ("Tool velocity", "m/s", curves.tool_velocity_m_s, axes),
        ("Tool acceleration", "m/s²", curves.tool_acceleration_m_s2, axes),
        ("Tool angular velocity", "rad/s", curves.tool_angular_velocity_rad_s, axes),
        ("Tool angular acceleration", "rad/s²", curves.tool_angular_acceleration_rad_s2, axes),
    )
    return {title: time_figure(curves.time_s, values, labels, unit) for title, unit, values, labels in shown}


def time_figure(time_s: FloatArray, values: FloatArray, names: list[str], unit: str) -> go.Figure:
    """Columns of values, shape (m, k), over time."""
    lines = [
        {"type": "scatter", "x": time_s, "y": column, "name": name, "line": {"color": colour}}
        for column, name, colour in zip(values.T, names, COLOURS * 6, strict=False)
    ]
    return plotly()(
        lines,
        layout={"xaxis": {"title": "time [s]"}, "yaxis": {"title": unit}, "height": 320, "margin": {"t": 20, "b": 60}},
    )


def write_workspace(
    robot: Robot, extent_m: FloatArray, points_m: FloatArray, reach: ReachabilityMap | None, path: Path
) -> None:
    """A page with the workspace."""
    page = Page(f"Workspace of {robot.name}")
    page.text(robot.source)
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    rows = [
        (axis, f"{extent_m[i, 0]:.6f}", f"{extent_m[i, 1]:.6f}", f"{low[i]:.6f}", f"{high[i]:.6f}")
        for i, axis in enumerate("xyz")
    ]
    note = f"metres, within the joint ranges; random: {len(points_m)} configurations"
    page.table(("axis", "exact least", "exact greatest", "random least", "random greatest"), rows, note)
    for title, figure in workspace_figures(points_m, extent_m).items():
        page.heading(title)
        page.figure(figure, f"{title}: tool points of random configurations")
    if reach is not None:
        page.heading("Reachability")
        page.text("Colour: the share of the directions and branches tried at a point that keeps the joint ranges.")
        page.figure(reachability_figure(reach), "points of a grid that the tool reaches")
    page.write(path)


def write_trajectory(robot: Robot, curves: Curves, path: Path) -> None:
    """A page with a trajectory's curves and the arm at its ends."""
    page = Page(f"Trajectory of {robot.name}")
    ends = {"start": curves.position_rad[0], "end": curves.position_rad[-1]}
    x, y, z = curves.tool_position_m.T
    way: dict[str, Any] = {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "lines", "name": "tool path"}
    space = arm_figures(robot.chain, ends)["from the side and above"]
    space.add_trace(way)
    page.heading("In space")
    page.figure(space, "the arm at both ends and the path of its tool")
    for title, figure in curve_figures(curves).items():
        page.heading(title)
        page.figure(figure, f"{title} over time")
    page.write(path)


def _scene(eye: tuple[float, float, float]) -> dict[str, Any]:
    camera = {"eye": dict(zip("xyz", eye, strict=True)), "projection": {"type": "orthographic"}}
    if eye[0] == eye[1] == 0.0:
        camera["up"] = {"x": 0, "y": 1, "z": 0}
    axes = {f"{axis}axis": {"title": f"{axis} [m]"} for axis in "xyz"}
    return {"scene": {"aspectmode": "data", "camera": camera, **axes}, "height": 560}
