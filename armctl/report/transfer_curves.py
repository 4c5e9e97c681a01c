"""Figs. 3 to 7 of Lu & Liu from a log: the motion of the paw's midpoint, recorded and by the model.

Recorded: the encoders' joint positions of the log, made smooth and differentiated by local cubics
(trajectory/smoothing.py) and taken to the tool by forward kinematics and the Jacobian. Model: the cycle's quintics,
rebuilt from the parameters that the log itself holds, taken to the tool in the same way. Time 0 is the cycle's begin.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.recording import timeline
from armctl.recording.channels import COMMAND
from armctl.recording.recordings import noted
from armctl.report.kinematics import COLOURS, in_mm
from armctl.report.page import TEXTS, Figure, Page, axes, curve
from armctl.trajectory.quintic import Curves, curves
from armctl.trajectory.smoothing import local_cubics
from armctl.trajectory.transfer import NOTED, TransferRequest, motion

# Eleven samples at 0.1 s.
HALF_WIDTH_S = 0.55
POINTS = 600
QUANTITIES: list[list[str]] = TEXTS["transfer"]["quantities"]
TITLES = {f"{number}: {what} of the paw's midpoint": (what, field, unit) for number, what, field, unit in QUANTITIES}


class Transfer(NamedTuple):
    """One recorded cycle and its model, at the same instants."""

    log: Path
    robot: Robot
    cycle: TransferRequest
    recorded: Curves
    model: Curves


def load(log: Path) -> Transfer:
    """The cycle in a log that `armctl transfer` made the daemon record.

    Raises:
        LogError: the file is no log of armctl's, or holds no whole cycle.
    """
    cycle, seen = _cycle(log), timeline.load(log)
    run = next((one for one in reversed(seen.motions) if one.label == "transfer"), None)
    if run is None:
        raise LogError(f"{log}: the cycle was not run to its end; there is nothing to draw")
    robot = robots.get(seen.arm.robot, seen.arm.lengths_m)
    model = motion(cycle, seen.arm, robot)
    since_s = seen.time_s - (run.begin_ns - seen.start_ns) / NS_PER_S
    known = np.isfinite(seen.position_rad).all(axis=1)
    at_s = np.linspace(0.0, model.duration_s, POINTS)
    try:
        smooth = local_cubics(since_s[known], seen.position_rad[known, : robot.chain.n], at_s, HALF_WIDTH_S)
    except ValueError as error:
        raise LogError(f"{log}: too many readings of the cycle are missing ({error})") from None
    recorded, wanted = (curves(robot.chain, at_s, *sampled) for sampled in (smooth, model.sample(at_s)))
    return Transfer(log, robot, cycle, recorded, wanted)


def draw(transfer: Transfer, title: str) -> Figure:
    """One of `TITLES` of a cycle that was loaded."""
    what, field, unit = TITLES[title]
    chart = axes("time [s]", f"{what} [{in_mm(np.zeros(0), unit)[1]}]", 420)
    for letter, colour, axis in zip("xyz", COLOURS, range(3), strict=False):
        for who, name, dash in ((transfer.model, "model", "dash"), (transfer.recorded, "recorded", "solid")):
            values, _ = in_mm(getattr(who, field)[:, axis], unit)
            curve(chart, who.time_s, values, f"{letter}, {name}", colour, width=1.6, dash=dash)
    return chart


def table(transfer: Transfer) -> list[dict[str, Any]]:
    """One row a figure: largest absolute value of model and record, and the root mean square of their difference."""
    rows = []
    for number, what, field, unit in QUANTITIES:
        recorded, model = getattr(transfer.recorded, field), getattr(transfer.model, field)
        model_peak, recorded_peak = (float(np.linalg.norm(values, axis=1).max()) for values in (model, recorded))
        rms = math.sqrt(float(((recorded - model) ** 2).sum(axis=1).mean()))
        row = {"model_peak": model_peak, "recorded_peak": recorded_peak, "rms_difference": rms}
        rows.append({"figure": number, "quantity": what, "unit": unit, **row})
    return rows


def write(transfer: Transfer, path: Path) -> None:
    """One HTML page about a cycle."""
    page = Page(f"Pick and transfer: {transfer.robot.name}")
    cycle = transfer.cycle
    lengths = ", ".join(f"{name} {1e3 * length:g}" for name, length in transfer.robot.lengths_m.items())
    given = {"pick": _point(cycle.pick_m), "place": _point(cycle.place_m), "height_mm": 1e3 * cycle.height_m}
    given |= {**cycle.model_dump(), "lengths": lengths, "log": transfer.log.name, "window_s": HALF_WIDTH_S}
    page.text(*(TEXTS["transfer"][part].format_map(given) for part in ("cycle", "curves")))
    told = ([f"{cell:.4f}" if isinstance(cell, float) else cell for cell in row.values()] for row in table(transfer))
    page.table(["figure", "of the paw's midpoint", "unit", "peak, model", "peak, recorded", "rms difference"], [*told])
    for title in TITLES:
        page.heading(title)
        page.figure(draw(transfer, title), f"{title} over time, recorded and by the model, in x, y and z")
    page.write(path)


def _cycle(log: Path) -> TransferRequest:
    """The parameters of the last cycle in a log."""
    if not (notes := noted(log, NOTED)):
        raise LogError(f"{log}: tells of no transfer; record one with `armctl transfer`")
    try:
        return TransferRequest.model_validate(notes[-1]["cycle"])
    except (ValidationError, KeyError) as error:
        raise LogError(f"{log}: {COMMAND} is not as armctl writes it: {error!r}") from None


def _point(point_m: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{1e3 * x:.0f}" for x in point_m) + ") mm"
