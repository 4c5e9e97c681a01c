"""Pictures of kinematics: an arm, the cloud of points in its reach, and the curves of a trajectory.

A browser keeps only some sixteen charts in space alive on a page: what has many views is drawn in space once, and flat
in its other views.
"""

from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.chain import SerialChain, link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.kinematics.workspace import ReachabilityMap
from armctl.report.page import Figure, Page, plotly
from armctl.trajectory.quintic import Curves

# Points of a cloud that are drawn, on a page of its own and among other pictures; more only make the page slow.
SHOWN_POINTS, SHOWN_AMONG_OTHERS = 8000, 2500
COLOURS = ("#b0413e", "#c98a1b", "#2a7f62", "#3a6ea5", "#7a4fa3", "#555555")
IN_SPACE = "from the side and above"
# View -> the axes to the right and upwards.
FLAT = {"front (along x)": (1, 2), "left (along y)": (0, 2), "top (along z)": (0, 1)}
ARM_VIEWS = (IN_SPACE, *FLAT)
PLANES = {f"Projection on {'xyz'[i]}{'xyz'[j]}": (i, j) for i, j in FLAT.values()}
WORKSPACE_IN_SPACE = "Workspace in 3D"
WORKSPACE_VIEWS = (WORKSPACE_IN_SPACE, *PLANES)
# What of a trajectory is drawn -> the field of `Curves`, and the unit it is drawn in.
CURVES: dict[str, tuple[str, str]] = {
    "Joint positions": ("position_rad", "deg"),
    "Joint velocities": ("velocity_rad_s", "deg/s"),
    "Joint accelerations": ("acceleration_rad_s2", "deg/s²"),
    "Tool position": ("tool_position_m", "m"),
    "Tool velocity": ("tool_velocity_m_s", "m/s"),
    "Tool acceleration": ("tool_acceleration_m_s2", "m/s²"),
    "Tool angular velocity": ("tool_angular_velocity_rad_s", "rad/s"),
    "Tool angular acceleration": ("tool_angular_acceleration_rad_s2", "rad/s²"),
}


def arm(
    chain: SerialChain, arms: dict[str, FloatArray], view: str = IN_SPACE, tool_m: FloatArray | None = None
) -> Figure:
    """Arms as lines through their joints.

    Args:
        arms: Configuration [rad], shape (n,), of each arm by its name.
        view: One of `ARM_VIEWS`.
        tool_m: The path of a tool in space, shape (m, 3).
    """
    lines: list[dict[str, Any]] = []
    for k, ((name, q), colour) in enumerate(zip(arms.items(), COLOURS, strict=False)):
        x, y, z = points = link_frames(chain, q)[:, :3, 3].T
        line = {"mode": "lines+markers", "name": name}
        if view == IN_SPACE:
            style = {"line": {"width": 8, "color": colour}, "marker": {"size": 4, "color": colour}}
            lines.append({"type": "scatter3d", "x": x, "y": y, "z": z, **line, **style})
        else:
            i, j = FLAT[view]
            # Where arms coincide the first still shows around the second.
            style = {"line": {"color": colour, "width": 9 if k == 0 else 3}, "marker": {"size": 8, "color": colour}}
            lines.append({"type": "scatter", "x": points[i], "y": points[j], **line, **style})
    if tool_m is not None:
        x, y, z = tool_m.T
        lines.append({"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "lines", "name": "tool path"})
    return plotly()(lines, layout=_space() if view == IN_SPACE else _plane(*FLAT[view], height=420))


def workspace(points_m: FloatArray, extent_m: FloatArray, view: str, *, alone: bool = False) -> Figure:
    """A cloud, shape (m, 3), and the box of its exact extents, shape (3, 2).

    Args:
        view: One of `WORKSPACE_VIEWS`.
        alone: Whether this is the page's only subject: then more points are drawn.
    """
    most = SHOWN_POINTS if alone or view == WORKSPACE_IN_SPACE else SHOWN_AMONG_OTHERS
    x, y, z = shown = points_m[:: max(1, len(points_m) // most)].T
    if view == WORKSPACE_IN_SPACE:
        marker: dict[str, Any] = {"size": 1.2, "color": z}
        cloud = {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "markers", "marker": marker}
        return plotly()([cloud], layout=_space())
    i, j = PLANES[view]
    (left, right), (low, high) = extent_m[i], extent_m[j]
    marker = {"size": 2 if alone else 3, "color": COLOURS[3], "opacity": 0.4 if alone else 0.45}
    dots = {"type": "scattergl" if alone else "scatter", "mode": "markers", "name": "random configurations"}
    line = {"color": COLOURS[0], "width": 1 if alone else 2}
    corners = {"x": [left, right, right, left, left], "y": [low, low, high, high, low]}
    return plotly()(
        [
            {**dots, "x": shown[i], "y": shown[j], "marker": marker},
            {"type": "scatter", "mode": "lines", "name": "exact extents", "line": line, **corners},
        ],
        layout=_plane(i, j, height=480 if alone else 420),
    )


def reachability(reach: ReachabilityMap) -> Figure:
    """The points of a grid that are in reach; the colour tells in how many ways."""
    x, y, z = reach.points_m[reach.reachable].T
    marker = {"size": 3, "color": reach.share[reach.reachable], "colorbar": {"title": "share"}, "opacity": 0.7}
    points = {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "markers", "marker": marker}
    return plotly()([points], layout=_space())


def curve(curves: Curves, title: str) -> Figure:
    """One of `CURVES` over time, a line for each joint or axis."""
    field, unit = CURVES[title]
    values = getattr(curves, field)
    if unit.startswith("deg"):
        values, names = np.degrees(values), [f"joint {i + 1}" for i in range(values.shape[1])]
    else:
        names = ["x", "y", "z"]
    lines = [
        {"type": "scatter", "x": curves.time_s, "y": column, "name": name, "line": {"color": colour}}
        for column, name, colour in zip(values.T, names, COLOURS * 6, strict=False)
    ]
    axes = {"xaxis": {"title": "time [s]"}, "yaxis": {"title": unit}}
    return plotly()(lines, layout={**axes, "height": 320, "margin": {"t": 20, "b": 60}})


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
    for view in (WORKSPACE_IN_SPACE, *sorted(PLANES)):
        page.heading(view)
        page.figure(workspace(points_m, extent_m, view, alone=True), f"{view}: tool points of random configurations")
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


def _space() -> dict[str, Any]:
    camera = {"eye": {"x": 1.4, "y": 1.4, "z": 0.9}, "projection": {"type": "orthographic"}}
    axes = {f"{axis}axis": {"title": f"{axis} [m]"} for axis in "xyz"}
    return {"scene": {"aspectmode": "data", "camera": camera, **axes}, "height": 560}


def _plane(i: int, j: int, height: int) -> dict[str, Any]:
    up = {"title": f"{'xyz'[j]} [m]", "scaleanchor": "x"}
    return {"xaxis": {"title": f"{'xyz'[i]} [m]"}, "yaxis": up, "height": height}
