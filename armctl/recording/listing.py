"""Takes as lists show them: how long each one is, and how straight.

Rules.
1. One bad take never hides the others: what cannot be read is listed apart, with what is wrong with it.
2. A figure that cannot be computed is None: no line is defined by a single point, and none by an arm that stood still.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armctl.errors import LogError
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.recording.channels import COMMAND, parse_note
from armctl.recording.reader import read
from armctl.recording.recordings import Recording, load, take_files, take_name
from armctl.trajectory.dead_time import moving_part
from armctl.trajectory.straightness import max_error, mean_error

# Ends closer than this make no line: their distance is rounding, not motion (a servo tick moves the tool far more).
MIN_LINE_M = 1e-6
Line = tuple[Sequence[float], Sequence[float]]
_log = logging.getLogger(__name__)


def listing(folder: Path, robot: Robot) -> dict[str, list[dict[str, Any]]]:
    """Every take of a folder by name.

    Returns:
        `recordings`: the readable takes (see `describe`). `unreadable`, only where there are some: `name`, `path` and
        `problem` of the others.
    Raises:
        LogError: the folder cannot be read.
    """
    found: dict[str, list[dict[str, Any]]] = {"recordings": []}
    for path in take_files(folder):
        try:
            found["recordings"].append(describe(load(path), robot))
        except LogError as error:
            _log.warning("recording cannot be read: %s", error)
            entry = {"name": take_name(path), "path": str(path), "problem": str(error)}
            found.setdefault("unreadable", []).append(entry)
    return found


def describe(
    recording: Recording, robot: Robot, line: Line | None = None, *, with_marks: bool = False
) -> dict[str, Any]:
    """A recording as lists show it. Of a run only the plan proper counts, of a take not its dead time at both ends.

    Args:
        line: What its errors are measured against [m]; None: from its first to its last tool point. They are None
            where these make no line.
        with_marks: Whether to look for marked via points as well, which reads the file once more.
    """
    positions_rad = recording.plan_positions_rad
    moving = slice(0, len(positions_rad))
    errors_m = None
    # Positions may be any number a float can hold: what overflows becomes None below.
    with np.errstate(all="ignore"):
        if recording.plan_s is None:
            moving = moving_part(positions_rad)
        part_rad = positions_rad[moving, : robot.chain.n]
        if len(part_rad) and part_rad.shape[1] == robot.chain.n and np.isfinite(part_rad).all():
            errors_m = _errors_m(tool_position(robot.chain, part_rad), line)
    mean_m, max_m = errors_m or (None, None)
    return {
        "name": recording.name,
        "path": str(recording.path),
        "duration_s": recording.duration_s,
        "samples": recording.samples,
        "mean_error_mm": None if mean_m is None else 1e3 * mean_m,
        "max_error_mm": None if max_m is None else 1e3 * max_m,
        "arm_id": recording.arm_id,
        "calibration_hash": recording.calibration_hash,
        "complete": recording.complete,
        "dead_samples": [moving.start, len(positions_rad) - moving.stop],
        **({"marks": via_marks(recording.path)} if with_marks else {}),
    }


def _errors_m(points_m: FloatArray, line: Line | None) -> tuple[float, float] | None:
    """Mean and largest distance to the line [m]; None where its ends make none."""
    A, B = (np.asarray(end, np.float64) for end in line or (points_m[0], points_m[-1]))
    if not np.linalg.norm(B - A) > MIN_LINE_M:
        return None
    return float(mean_error(points_m, A, B)), float(max_error(points_m, A, B))


def via_marks(path: Path) -> list[dict[str, Any]]:
    """The via points that were marked while a take was recorded."""
    keys = ("tick", "position_m", "joints_rad")
    notes = (parse_note(message.value.get("data", "")) for message in read(path, (COMMAND,)))
    return [
        {key: note[key] for key in keys}
        for note in notes
        if note.get("event") == "VIA_MARK" and note.keys() >= set(keys)
    ]
