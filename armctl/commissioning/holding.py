"""Kinematic calibration with torque on: zeros, and every length and twist of the arm's table, from touched points.

An arm that stands by itself bends as it does at work, so what is found fits work. Rules.
1. Parameters are the joints' zeros, and a, alpha and d of each row, the tool's place too where the convention has it
   apart. More of them than a sheet tells at once: each has a prior, `SD`, of what an assembly by hand is off by. So
   none has to be held, and what the points do not show stays where it was, with the prior's deviation.
2. Points that the fit has not seen show how good it is: each point is left out in turn, the rest is fitted, and the
   distance to that point counts (`held_out_mm`). An arm that would be no better there than it was is not changed.
3. The result is the arm's own table: a `robot` with a name becomes one.

On simulated arms, 24 touches of 0.5 mm over a sheet: 1.2 mm on other points (before 2.4) for a careful assembly,
2.0 (5.7) for a typical and 3.7 (10.8) for a poor one. What is left are brackets that bend and waves of the sensors.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from armctl.commissioning.calibration import MAX_RMS_MM, Touch, check_points, mean_ticks, recalibrated
from armctl.config import ArmConfig, JointConfig, validate
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, link_frames, tool_position
from armctl.kinematics.transform import FloatArray, rpy_from_matrix
from armctl.kinematics.urdf_reader import table_row

# Standard deviations of a zero and a twist [rad] and of a length [m], before anybody has touched a point.
SD_RAD, SD_M = np.radians(1.0), 1e-3
# Of a coordinate of a touch, with what the model cannot express [m].
TOUCH_M = 0.7e-3
STEP, ITERATIONS = 1e-6, 5


class Held(NamedTuple):
    """What a calibration under torque found; distances are means over all touches."""

    arm: ArmConfig
    # `name`, `value`, `sd` and `unit` of each.
    parameters: list[dict[str, Any]]
    before_mm: float
    after_mm: float
    # Of points that were left out of the fit.
    held_out_mm: float


def standing_ticks(arm: ArmConfig, seen: Sequence[Sequence[dict[str, Any]]]) -> tuple[float, ...]:
    """Mean position of every joint's servo, from the `joints` of some statuses of an arm that stands by itself.

    Raises:
        RequestRefused: its torque is off (LIMP), or it moved.
    """
    if not all(joint["torque_enabled"] for joints in seen for joint in joints):
        raise RequestRefused("LIMP", "torque is off; type `armctl torque on` elsewhere, and lead the arm anew")
    ticks = [[joint.tick(told["position_rad"]) for joint, told in zip(arm.joints, one, strict=True)] for one in seen]
    return mean_ticks(arm.joints, np.array(ticks))


def fit(arm: ArmConfig, touches: Sequence[Touch]) -> Held:
    """The arm whose tool was where it was held.

    Raises:
        RequestRefused: too few touches or points; no arm like this one fits them (POOR_FIT), or the best is no better
            on points that it has not seen (NO_BETTER).
    """
    check_points(arm, [touch.point_m for touch in touches])
    chain = robots.of(arm).chain
    n, joints = chain.n, arm.joints[: chain.n]
    points = np.array([touch.point_m for touch in touches])
    ticks = (touch.ticks[:n] for touch in touches)
    q = np.array([[joint.position_rad(tick) for joint, tick in zip(joints, row, strict=True)] for row in ticks])
    x, sd = _solved(chain, q, points, np.zeros(len(_sd(chain))))
    before, after = (_off_mm(chain, q, points, changes) for changes in (np.zeros(len(x)), x))
    if not (rms_mm := float(np.sqrt((after**2).mean()))) <= MAX_RMS_MM:
        text = f"the best arm is {rms_mm:.1f} mm off its points, at most {MAX_RMS_MM:.0f} mm make sense"
        raise RequestRefused("POOR_FIT", f"{text}; check order and unit of the points, the frame, joints' directions")
    held_out = np.empty(len(points))
    for point in np.unique(points, axis=0):
        out = (points == point).all(axis=1)
        held_out[out] = _off_mm(chain, q[out], points[out], _solved(chain, q[~out], points[~out], x)[0])
    if not held_out.mean() < before.mean():
        text = f"{held_out.mean():.2f} mm off points that it has not seen, {before.mean():.2f} mm as it is"
        raise RequestRefused("NO_BETTER", f"the arm would be {text}; touch more points, in more postures")
    sd *= max(1.0, rms_mm / (1e3 * TOUCH_M * 3.0**0.5))
    each = zip(_labels(joints, chain), x.tolist(), sd.tolist(), strict=False)
    parameters = [
        {"name": name, "value": value + scale * more, "sd": abs(scale) * deviation, "unit": unit}
        for (name, value, scale, unit), more, deviation in each
    ]
    zeros = [*(one["value"] for one in parameters[:n]), *(joint.zero_tick for joint in arm.joints[n:])]
    data = recalibrated(arm, zeros, {}).model_dump(mode="json", exclude_unset=True, exclude={"lengths_m"})
    new = validate(ArmConfig, data | {"robot": table_of(_changed(chain, x))}, "the new calibration")
    return Held(new, parameters, float(before.mean()), float(after.mean()), float(held_out.mean()))


def table_of(chain: SerialChain) -> dict[str, Any]:
    """A chain as the `robot` of an arm's file has it."""
    rows = [{key: round(value, 7) for key, value in table_row(row).items()} for row in chain.rows]
    table: dict[str, Any] = {"convention": chain.convention, "dh": rows}
    if chain.has_tool:
        *_, last, tool = link_frames(chain, np.zeros(chain.n))
        T = np.linalg.inv(last) @ tool
        rpy_deg = np.degrees(rpy_from_matrix(T[:3, :3]))
        table |= {"tool_m": T[:3, 3].round(7).tolist(), "tool_rpy_deg": rpy_deg.round(7).tolist()}
    return table


def _labels(joints: Sequence[JointConfig], chain: SerialChain) -> Iterator[tuple[str, float, float, str]]:
    """Of each parameter its name, present value, what of that a change of 1 is, and its unit."""
    for joint in joints:
        yield f"{joint.name}.zero_tick", joint.zero_tick, -joint.direction / TICK_RAD, "tick"
    for number, row in enumerate(chain.rows, 1):
        yield f"robot.dh.{number}.a_m", row.a, 1.0, "m"
        yield f"robot.dh.{number}.alpha_deg", math.degrees(row.alpha), math.degrees(1.0), "deg"
        yield f"robot.dh.{number}.d_m", row.d, 1.0, "m"
    for key in "abd":
        yield f"robot.tool.{key}_m", getattr(chain.tool, key), 1.0, "m"


def _sd(chain: SerialChain) -> FloatArray:
    """The priors' standard deviations: zeros [rad]; a [m], alpha [rad], d [m] of each row; the tool's place [m]."""
    tool = [SD_M] * 3 * (chain.convention == "modified")
    return np.array([SD_RAD] * chain.n + [SD_M, SD_RAD, SD_M] * chain.n + tool)


def _changed(chain: SerialChain, x: FloatArray) -> SerialChain:
    """The chain with its rows, and the tool, changed by so much; zeros are not the chain's."""
    n = chain.n
    more = zip(chain.rows, x[n : 4 * n].reshape(n, 3).tolist(), strict=True)
    rows = tuple(replace(row, a=row.a + a, alpha=row.alpha + alpha, d=row.d + d) for row, (a, alpha, d) in more)
    tool, by = chain.tool, dict(zip("abd", x[4 * n :].tolist(), strict=False))
    return replace(chain, rows=rows, tool=replace(tool, **{key: getattr(tool, key) + by[key] for key in by}))


def _off_mm(chain: SerialChain, q: FloatArray, points: FloatArray, x: FloatArray) -> FloatArray:
    """Distances of tool and point, shape (m,)."""
    return np.asarray(1e3 * np.linalg.norm(_missed(chain, q, points, x), axis=1))


def _missed(chain: SerialChain, q: FloatArray, points: FloatArray, x: FloatArray) -> FloatArray:
    """Tool less point [m], shape (m, 3)."""
    return tool_position(_changed(chain, x), q + x[: chain.n]) - points


def _solved(chain: SerialChain, q: FloatArray, points: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The likeliest changes and their standard deviations, by Gauss-Newton from x; derivatives are differences."""
    sd, steps = _sd(chain), STEP * np.eye(len(x))
    for _ in range(ITERATIONS):
        r = _missed(chain, q, points, x).ravel()
        J = np.stack([(_missed(chain, q, points, x + step).ravel() - r) / STEP for step in steps], axis=1)
        A = np.concatenate([J / TOUCH_M, np.diag(1.0 / sd)])
        x = x - np.linalg.lstsq(A, np.concatenate([r / TOUCH_M, x / sd]), rcond=None)[0]
    return x, np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
