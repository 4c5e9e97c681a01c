"""The tool measured from outside, by a camera or a tracker, and what that shows that no encoder sees."""

from pathlib import Path

import numpy as np

from armctl.errors import ConfigError, RequestRefused
from armctl.files import read_text
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording.recordings import Recording
from armctl.strict_yaml import csv_table, finite
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.refinement import smoothed

COLUMNS = ("t_s", "x_m", "y_m", "z_m")
EVEN = 51
# Standard deviation of the window over which the difference is averaged, of the whole.
SMOOTH = 0.05


def read(path: Path) -> tuple[FloatArray, FloatArray]:
    """An external measurement of one run: columns t_s, x_m, y_m, z_m, time counted from the plan's begin.

    Returns:
        Times [s], shape (k,), increasing, and tool points in the base frame [m], shape (k, 3).
    Raises:
        ConfigError: the file cannot be read, or is not such a table; names line and column.
    """
    _, found = csv_table(read_text(path, "measurement"), str(path), COLUMNS, f"the table needs {', '.join(COLUMNS)}")
    rows = [[finite(cells[column], str(path), where) for column in COLUMNS] for where, cells in found]
    table = np.array(rows).reshape(-1, 4)
    if len(table) < 2 or not (np.diff(table[:, 0]) > 0.0).all():
        raise ConfigError(str(path), "t_s", "needs two rows or more, times increasing")
    return table[:, 0], table[:, 1:]


def unseen_m(time_s: FloatArray, tool_m: FloatArray, run: Recording, chain: SerialChain) -> FloatArray:
    """Where the tool was, less where the encoders had it, at `EVEN` even times of the run's plan [m], shape (EVEN, 3).

    Args:
        time_s, tool_m: See `read`.
        run: The recording of the very run that was measured.
    Raises:
        RequestRefused: the recording holds no plan, or the measurement leaves most of it out.
    """
    if run.plan_s is None:
        raise RequestRefused("MEASURED", f"recording {run.name} holds no executed plan; name the run that was measured")
    begin_s, end_s = run.plan_s
    duration_s = end_s - begin_s
    if time_s[0] > 0.1 * duration_s or time_s[-1] < 0.9 * duration_s:
        covered = f"the measurement covers {time_s[0]:.2f} to {time_s[-1]:.2f} s of a plan of {duration_s:.2f} s"
        raise RequestRefused("MEASURED", f"{covered}; measure all of it, time counted from the plan's begin")
    at_s = np.linspace(0.0, duration_s, EVEN)
    by_encoder = tool_position(chain, columns_at(at_s, run.time_s - begin_s, run.positions_rad[:, : chain.n]))
    return smoothed(columns_at(at_s, time_s, tool_m) - by_encoder, 1.0 / (EVEN - 1), SMOOTH)
