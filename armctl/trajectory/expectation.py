"""What to expect of a plan on a real arm: the plan's own bow, and what the lag model and whole ticks leave.

Each joint is off by a constant, its zero offset, and by an error that comes and goes along the line. Both are drawn,
always with the same seed, for many runs; the median of the runs is expected. Of random lines with 1, 2, 8 via points it
says 1.03, 0.93, 0.90 mm (at most 2.4, 2.3, 2.3); on 8 simulated arms that nobody had measured the true tool was 1.02,
0.90, 0.83 mm off (at most 3.1, 2.9, 2.4): single jumps of a joint that sticks are larger than it knows.
"""

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.chain import SerialChain, jacobian, tool_position
from armctl.messages import LagModel
from armctl.trajectory import lag
from armctl.trajectory.interpolate import columns_at, joint_path, time_law
from armctl.trajectory.plan import Plan, lead
from armctl.trajectory.straightness import distance_to_line

# Of a value that is rounded to whole ticks, and of one reading of an encoder, noise included.
ROUNDED_TICK = 12.0**-0.5
READING_TICK = 0.58
# What the model of a new arm leaves of an arm that nobody has measured, once the trim has worked.
UNKNOWN_TICK = 0.8
RUNS, SAMPLES = 200, 51
# How many independent values an error takes along a line; a joint that sticks makes few large ones (Laplace).
KNOTS = 13


def expected_mm(arm: ArmConfig, chain: SerialChain, plan: Plan, model: LagModel | None) -> tuple[float, float]:
    """Mean and largest distance of the tool from the plan's line that are to be expected [mm].

    Args:
        arm: Where goals are not corrected, it stays behind its goals by all of its lag.
        model: Of the very arm; None: there is none.
    """
    n = chain.n
    left = np.full(n, UNKNOWN_TICK)
    if model is not None and model.residual_tick:
        left = np.sqrt(np.maximum(np.square(model.residual_tick) - READING_TICK**2, 0.0))
    s = np.linspace(0.0, 1.0, SAMPLES)
    waypoints, knots = np.array(plan.waypoints_rad)[:, :n], np.array(plan.waypoint_progress)
    q = joint_path(waypoints, knots, time_law(s), plan.interpolation)
    if not arm.correction:
        X = lag.regressors(chain, q, lead(plan)[:n], plan.duration_s / (SAMPLES - 1))
        q = q - lag.predict(model or lag.nominal(arm, chain), X)
    rng = np.random.default_rng(0)
    offset = ROUNDED_TICK * rng.standard_normal((RUNS, 1, n))
    varying = np.sqrt((left**2 + ROUNDED_TICK**2) / 2.0) * rng.laplace(size=(RUNS, KNOTS, n))
    along = np.stack([columns_at(s, np.linspace(0.0, 1.0, KNOTS), one) for one in varying])
    moved = np.einsum("mij,rmj->rmi", jacobian(chain, q)[:, :3], TICK_RAD * (offset + along))
    A, B = np.array(plan.from_m), np.array(plan.to_m)
    off_mm = 1e3 * distance_to_line(tool_position(chain, q) + moved, A, B)
    return float(np.median(off_mm.mean(axis=1))), float(np.median(off_mm.max(axis=1)))
