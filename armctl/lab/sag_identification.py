"""How the sag model of an arm is identified: a rig runs calibration lines uncorrected, and their lags are explained."""

from collections.abc import Callable, Sequence

import numpy as np

from armctl.errors import RequestRefused
from armctl.kinematics.chain import joint_axes
from armctl.kinematics.transform import FloatArray
from armctl.lab.course import courses, too_heavy
from armctl.lab.rig import Rig
from armctl.messages import LagModel
from armctl.trajectory import lag
from armctl.trajectory.course import Line, plan_of, ticks_of
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan, lead, plan_positions
from armctl.trajectory.refinement import Measured, lag_of, smoothed

LINES = 8
DURATION_S = 5.0
# How far out the lines lead, of the stretched arm: beyond, an uncorrected arm may sag until it counts as blocked.
STRETCH = 0.75
DRAWN_WAYS = 8
MOST_TRIES = 400
# From here on an arm, stretched from its shoulder, gets lines of full length.
LARGE_M = 0.375
MOST_DRAWN = 20_000


def random_line(rig: Rig, rng: np.random.Generator, *, stretch: float = STRETCH) -> tuple[FloatArray, FloatArray]:
    """A random line in the part of the workspace in front of the arm, with room on every side.

    Returns:
        A and B [m], shape (3,).
    Raises:
        RequestRefused: none fits the arm.
    """
    chain, arm = rig.robot.chain, rig.arm
    axes, tool = joint_axes(chain, np.zeros((1, chain.n)))
    places = np.array([place[:, 0] for place in (*(place for _, place in axes), tool)])
    stretched = float(np.linalg.norm(np.diff(places[1:], axis=0), axis=1).sum())
    x, y, z = shoulder = np.array([*places[0, :2], places[1, 2]])
    # A smaller arm gets smaller lines.
    size = min(1.0, stretched / LARGE_M)
    lowest = (x - 0.1 * size, y - 0.3 * size, arm.floor_m + 0.03)
    highest = (x + 0.34 * size, y + 0.3 * size, z + 0.25 * size)
    for _ in range(MOST_DRAWN):
        direction = rng.standard_normal(3)
        half = size * rng.uniform(0.2, 0.3) / 2.0 * direction / np.linalg.norm(direction)
        middle = rng.uniform(lowest, highest)
        points = middle + np.linspace(-1.0, 1.0, 21)[:, None] * half
        if (
            np.linalg.norm(out := points - shoulder, axis=1).max() < stretch * stretched
            and np.hypot(out[:, 0], out[:, 1]).min() > 0.10 * size
            and points[:, 2].min() > arm.floor_m + 0.03
            and np.abs(np.arctan2(out[:, 1], out[:, 0])).max() < 2.0
        ):
            return middle - half, middle + half
    raise RequestRefused("LINE", f"no line fits the {stretched:.3f} m that {arm.arm_id} reaches from its shoulder")


def identify(rig: Rig, rng: np.random.Generator, show: Callable[[int], None] = lambda _: None) -> LagModel:
    """Identify the sag model of the rig's arm from uncorrected lines.

    Raises:
        RequestRefused: the arm cannot run enough lines, or stopped.
    """
    seen: list[lag.Summary] = []
    why = ""
    for _ in range(MOST_TRIES):
        if len(seen) == LINES:
            break
        line = Line(*random_line(rig, rng), DURATION_S)
        try:
            ways = line_paths(rig, line, rng, most=DRAWN_WAYS)
            course = next(courses(rig, line, None, ways[int(rng.integers(len(ways)))][None]))
            plan = plan_of(rig, course, 0)
            if heavy := too_heavy(rig, None, plan):
                why = heavy
                continue
            measured = rig.run(plan, corrected=False)
        except RequestRefused as refusal:
            if refusal.code not in ("PREFLIGHT", "LIMIT", "LINE"):
                raise
            why = str(refusal)
            continue
        seen.append(_told(rig, course.goals_rad, plan, measured))
        show(len(seen))
    if len(seen) < LINES:
        reasons = f"only {len(seen)} of {LINES} calibration lines could be run", f"the last that could not: {why}"
        raise RequestRefused("CALIBRATE", reasons)
    return lag.fitted(rig.arm, rig.robot.chain, seen)


def learnt(rig: Rig, runs: Sequence[tuple[Plan, Measured]]) -> LagModel:
    """The lag model that explains uncorrected runs of plans: of any plans, where `identify` chooses its own lines.

    What runs do not show of an arm stays as the nominal model has it.
    """
    seen = []
    for plan, measured in runs:
        ticks: FloatArray = np.arange(ticks_of(plan.duration_s, rig.period_s), dtype=np.float64)
        seen.append(_told(rig, plan_positions(plan, ticks * rig.period_s), plan, measured))
    return lag.fitted(rig.arm, rig.robot.chain, seen)


def _told(rig: Rig, goals_rad: FloatArray, plan: Plan, measured: Measured) -> lag.Summary:
    """What an uncorrected run tells of how each joint lags behind its goals at every tick."""
    chain, lags = rig.robot.chain, lag_of(rig, plan, measured)
    q = goals_rad[:, : chain.n] - smoothed(lags, rig.period_s)
    return lag.summary(lags, lag.regressors(chain, q, lead(plan)[: chain.n], rig.period_s))
