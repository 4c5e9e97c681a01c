"""Arms and clouds seen along an axis, in flat charts.

A browser keeps only some sixteen 3D charts alive on a page: each arm is drawn in space once, its other views are flat.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from armctl.kinematics.chain import SerialChain, link_frames
from armctl.kinematics.transform import FloatArray
from armctl.report.kinematics import COLOURS, arm_figures, workspace_figures
from armctl.report.page import plotly

if TYPE_CHECKING:
    import plotly.graph_objects as go

SHOWN_POINTS = 2500
IN_SPACE = "from the side and above"
FLAT = {"front (along x)": (1, 2), "left (along y)": (0, 2), "top (along z)": (0, 1)}
"""View -> the axes to the right and upwards."""
ARM_VIEWS = (IN_SPACE, *FLAT)
WORKSPACE_VIEWS = ("Workspace in 3D", "Projection on yz", "Projection on xz", "Projection on xy")


def arm(chain: SerialChain, arms: dict[str, FloatArray], view: str) -> go.Figure:
    """Arms as lines through their joints in one of `ARM_VIEWS`; configurations [rad], shape (n,), by name."""
    if view == IN_SPACE:
        return arm_figures(chain, arms)[view]
    i, j = FLAT[view]
    lines = []
    for k, ((name, q), colour) in enumerate(zip(arms.items(), COLOURS, strict=False)):
        points = link_frames(chain, q)[:, :3, 3]
        # Where arms coincide the first still shows around the second.
        line = {"color": colour, "width": 9 if k == 0 else 3}
        shape = {"type": "scatter", "mode": "lines+markers", "line": line, "marker": {"size": 8, "color": colour}}
        lines.append({"x": points[:, i], "y": points[:, j], "name": name, **shape})
    return plotly()(lines, layout=_layout(i, j))


def workspace(points_m: FloatArray, extent_m: FloatArray, view: str) -> go.Figure:
    """A cloud, shape (m, 3), and the box of its exact extents, shape (3, 2), in one of `WORKSPACE_VIEWS`."""
    if view == WORKSPACE_VIEWS[0]:
        return workspace_figures(points_m, extent_m)[view]
    i, j = list(FLAT.values())[WORKSPACE_VIEWS.index(view) - 1]
    shown = points_m[:: max(1, len(points_m) // SHOWN_POINTS)]
    dots = {"type": "scatter", "x": shown[:, i], "y": shown[:, j], "mode": "markers", "name": "random configurations"}
    (left, right), (low, high) = extent_m[i], extent_m[j]
    box = {"x": [left, right, right, left, left], "y": [low, low, high, high, low], "name": "exact extents"}
    return plotly()(
        [
            {**dots, "marker": {"size": 3, "color": COLOURS[3], "opacity": 0.45}},
            {**box, "type": "scatter", "mode": "lines", "line": {"color": COLOURS[0], "width": 2}},
        ],
        layout=_layout(i, j),
    )


def _layout(i: int, j: int) -> dict[str, Any]:
    up = {"title": f"{'xyz'[j]} [m]", "scaleanchor": "x"}
    return {"xaxis": {"title": f"{'xyz'[i]} [m]"}, "yaxis": up, "height": 420}
