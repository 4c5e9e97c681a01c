"""Kinematic calibration with torque on: zeros, and all of the arm's table, from touched points.

An arm that stands by itself bends as it does at work, so what is found fits work. Rules.
1. Parameters are the joints' zeros; a, alpha and d of each row, waves of its sensor and what its weight bends; and the
   tool's place and weight where the convention has it apart. More of them than a sheet tells at once: each has a prior,
   `SD`, of what an assembly by hand is off by. So none has to be held, and what the points do not show stays where it
   was, with the prior's deviation.
2. Points that the fit has not seen show how good it is: each point is left out in turn, and how far a fit of the rest
   is off it counts (`held_out_mm`). An arm that would be no better there than it was is not changed.
3. The result is the arm's own table: a `robot` with a name becomes one.
4. The next point to touch, and the posture, is what tells most (greedy D-optimal): of all that are left the one by
   whose touch the determinant of the information about all parameters, the priors' included, grows most. So who stops
   early has the best that so many touches give.

On simulated arms, 24 touches of 0.5 mm: 0.7 mm at other places (before 2.8) for a careful assembly, 1.0 (6.2) for a
typical and 2.0 (11.4) for a poor one (`tools/prove calibration`).
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from armctl.commissioning.calibration import MAX_RMS_MM, Touch, check_points, mean_ticks, recalibrated, slopes
from armctl.commissioning.texts import refusal
from armctl.config import ArmConfig, JointConfig, validate
from armctl.control.jog import led
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import UnreachableTarget
from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, link_frames, tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.target import point_target
from armctl.kinematics.transform import FloatArray, rpy_from_matrix
from armctl.kinematics.urdf_reader import table_row
from armctl.messages import Jog
from armctl.trajectory.collision import floor_clearance, judged_pairs, link_clearance, link_points
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.target import postures_at

# Standard deviations of a zero and a twist [rad] and of a length [m], before anybody has touched a point.
SD_RAD, SD_M = np.radians(1.0), 1e-3
# Of each wave of a sensor [rad], and of what a weight bends a joint by [rad/m].
WAVE_RAD, BEND_RAD_M = np.radians(0.3), np.radians(0.4)
# Of a coordinate of a touch, with what the model cannot express [m].
TOUCH_M = 0.7e-3
STEP, ITERATIONS = 1e-6, 5
# Of a point, those nearest to the rest pose: among more, there are some in which arms bend as no table tells.
POSTURES = 7
# How the tip is led down by keys, and how near to a point it has to come by them.
LED_M, NEAR_M = 1e-3, 8e-3
# Where points of a sheet of A4 are, and how high a box is.
AHEAD_M, ASIDE_M, BOX_M = (0.085, 0.135, 0.185, 0.235), (-0.085, 0.0, 0.085), 0.06
# With fewer points nobody has measured how good a calibration is; on so many boxes at most they are looked for.
FEW, MOST_BOXES = 8, 8
# How far the tip may be from its point, by the arm's file, when a touch is taken: an arm that keys have not led yet is
# 30 mm above it, and a poor assembly is off by less than 26 mm in 99 of 100 postures over a sheet.
FAR_M = 25e-3
# No assembly is off by more standard deviations; the hand of a poor one bends by nearly 7.
MOST_SD = 8.0
DEG = math.degrees(1.0)


class Held(NamedTuple):
    """What a calibration under torque found; distances are means over all touches."""

    arm: ArmConfig
    # `name`, `value`, `sd` and `unit` of each.
    parameters: list[dict[str, Any]]
    before_mm: float
    after_mm: float
    # Of points that were left out of the fit.
    held_out_mm: float
    # Of each touch, after.
    residuals_mm: list[float]


def standing_ticks(arm: ArmConfig, seen: Sequence[Sequence[dict[str, Any]]]) -> tuple[float, ...]:
    """Mean position of every joint's servo, from the `joints` of some statuses of an arm that stands by itself.

    Raises:
        RequestRefused: its torque is off (LIMP), or it moved.
    """
    if not all(joint["torque_enabled"] for joints in seen for joint in joints):
        raise refusal("LIMP")
    ticks = [[joint.tick(told["position_rad"]) for joint, told in zip(arm.joints, one, strict=True)] for one in seen]
    return mean_ticks(arm.joints, np.array(ticks))


Point = tuple[float, float, float]


class Way(NamedTuple):
    """One way to touch a point."""

    # Which point of the sheet, from 1.
    number: int
    point_m: Point
    # Which of the ways to this point, from 0.
    posture: int
    # Where the chain's joints are above it [rad]; none: wherever a hand holds the limp arm.
    q_rad: tuple[float, ...] = ()


def ways_above(arm: ArmConfig, points_m: Sequence[Point], up_m: float) -> list[Way]:
    """Postures in which the arm can stand with its tool so far above each point, and from which keys lead it down.

    Of each point there are at most `POSTURES`, those nearest to the rest pose; of one out of reach there are none.
    """
    robot, ways = robots.of(arm), list[Way]()
    rest_rad = [joint.rest_rad for joint in arm.joints]
    for number, point_m in enumerate(points_m, 1):
        with suppress(UnreachableTarget):
            above = point_target(np.add(point_m, (0.0, 0.0, up_m)))
            found = postures_at(above, rest_rad, DrivenArm(arm, robot, 1.0))
            kept = [q[: robot.chain.n] for q in found if _leads_down(arm, robot, q, up_m)]
            ways += [Way(number, point_m, k, tuple(q)) for k, q in enumerate(kept[:POSTURES])]
    return ways


def _leads_down(arm: ArmConfig, robot: Robot, q: Sequence[float], up_m: float) -> bool:
    """Whether keys lead the tip of an arm at q, shape (joints,), straight down so far, millimetre by millimetre.

    No joint may come to its limit, no link to another or to the floor, neither there nor on the way.
    """
    n, limits_rad = robot.chain.n, np.array([joint.limits_rad for joint in arm.joints])
    way = [np.array(q)]
    for _ in range(round(up_m / LED_M)):
        way.append(way[-1] + led(arm, robot, way[-1].tolist(), Jog(0, (), (0.0, 0.0, -LED_M))))
    points = link_points(robot.chain, np.array(way)[:, :n])
    gaps_m = link_clearance(points, judged_pairs(points[0], arm.link_radius_m), arm.link_radius_m)
    clear = (gaps_m >= 0.0).all() and (floor_clearance(points, arm.floor_m, arm.link_radius_m) >= -NEAR_M).all()
    low, high = limits_rad[:n].T
    within = ((low < np.array(way)[1:, :n]) & (np.array(way)[1:, :n] < high)).all()
    return bool(clear and within and up_m - (points[0, -1, 2] - points[-1, -1, 2]) <= NEAR_M)


def sheet_points(arm: ArmConfig, up_m: float, boxes: int = 0) -> list[Point]:
    """Points of a sheet for an arm that it can stand so far above, every other one on a box; none: it reaches none.

    For an arm that hangs high over the table all are on boxes: on as few more as give `FEW` points, or else the most.

    Args:
        boxes: On how many boxes the lowest are, at least.
    """
    low_m = arm.floor_m + BOX_M * boxes
    raised = ((x, y, low_m + BOX_M * ((i + j) % 2)) for i, x in enumerate(AHEAD_M) for j, y in enumerate(ASIDE_M))
    found = list({way.number: way.point_m for way in ways_above(arm, [*raised], up_m)}.values())
    if len(found) >= FEW or boxes == MOST_BOXES:
        return found
    return max(found, sheet_points(arm, up_m, boxes + 1), key=len)


def left(ways: Sequence[Way], made: Collection[Way], skipped: Collection[int], touches: int) -> list[Way]:
    """Ways that are still to be gone: of no point that is skipped, or has been touched so often."""
    times = Counter(way.number for way in made)
    return [way for way in ways if way not in made and way.number not in skipped and times[way.number] < touches]


def touch_by(arm: ArmConfig, way: Way, ticks: Sequence[float]) -> Touch:
    """The touch of a point; RequestRefused (FAR): the tip of an arm that stands by itself is far from it."""
    touch, chain = Touch(point_m=way.point_m, ticks=tuple(ticks)), robots.of(arm).chain
    off_m = math.dist(tool_position(chain, _positions(arm.joints[: chain.n], [touch])[0]), way.point_m)
    if way.q_rad and off_m > FAR_M:
        raise refusal("FAR", off_mm=1e3 * off_m, number=way.number, most_mm=1e3 * FAR_M)
    return touch


def begun(arm: ArmConfig, touches: Sequence[Touch], ways: Sequence[Way], points_m: Sequence[Point]) -> dict[Way, Touch]:
    """Touches of an earlier session, each by the way to its point whose posture is nearest.

    Raises:
        RequestRefused: one is on none of the points (POINTS).
    """
    made = dict[Way, Touch]()
    for i, (touch, q) in enumerate(zip(touches, _positions(arm.joints, touches).tolist(), strict=True), 1):
        if touch.point_m not in points_m:
            raise refusal("POINTS", touch=i, place=touch.point_m)
        number = points_m.index(touch.point_m) + 1
        free = [way for way in ways if way.number == number and way not in made]
        # Beyond those that are wanted, a touch counts as one of no way that is asked for.
        spare = Way(number, touch.point_m, -i)
        made[min(free, key=lambda way: math.dist(way.q_rad, q[: len(way.q_rad)]), default=spare)] = touch
    return made


def most_telling(arm: ArmConfig, touches: Sequence[Touch], ways: Sequence[Way]) -> list[Way]:
    """The ways in the order of how much a touch adds to what the touches made so far tell, most first (rule 4)."""
    chain = robots.of(arm).chain
    sd, x = _sd(chain), np.zeros(len(_sd(chain)))
    made = _slopes(chain, _positions(arm.joints[: chain.n], touches), x) / TOUCH_M
    new = _slopes(chain, np.array([way.q_rad for way in ways]), x) / TOUCH_M
    covariance = np.linalg.inv(np.diag(sd**-2.0) + made.T @ made)
    # By how much log det(A) grows if J' J is added to A.
    J = new.reshape(len(ways), 3, -1)
    _, gains = np.linalg.slogdet(np.eye(3) + J @ covariance @ J.swapaxes(1, 2))
    return [ways[i] for i in np.argsort(-gains, kind="stable")]


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
    q = _positions(joints, touches)
    x, J, covariance = _solved(chain, q, points)
    missed = _missed(chain, q, points, x)
    before, after = (_distances_mm(off) for off in (_missed(chain, q, points, np.zeros(len(x))), missed))
    worst = {"touch": int(after.argmax()) + 1, "worst_mm": float(after.max())}
    if not (rms_mm := float(np.sqrt((after**2).mean()))) <= MAX_RMS_MM:
        raise refusal("POOR_FIT holding", rms_mm=rms_mm, most_mm=MAX_RMS_MM, **worst)
    labels, times = list(_labels(joints, chain)), np.abs(x) / _sd(chain)
    if times.max() > MOST_SD:
        name, value, scale, unit = labels[int(times.argmax())]
        to = value + scale * float(x[times.argmax()])
        raise refusal("POOR_FIT far", name=name, before=value, after=to, unit=unit, **worst)
    # What the fit would miss a point by if that point had no part in it: the fit is straight near its end.
    pulled, held_out = J @ covariance @ J.T / TOUCH_M**2, np.empty(len(points))
    for point in np.unique(points, axis=0):
        out = (points == point).all(axis=1)
        rows = np.repeat(out, 3)
        alone = np.linalg.solve(np.eye(rows.sum()) - pulled[np.ix_(rows, rows)], missed[out].ravel())
        held_out[out] = _distances_mm(alone.reshape(-1, 3))
    if not held_out.mean() < before.mean():
        raise refusal("NO_BETTER", held_out_mm=held_out.mean(), before_mm=before.mean())
    sd = np.sqrt(np.diag(covariance)) * max(1.0, rms_mm / (1e3 * TOUCH_M * 3.0**0.5))
    each = zip(labels, x.tolist(), sd.tolist(), strict=False)
    parameters = [
        {"name": name, "value": value + scale * more, "sd": abs(scale) * deviation, "unit": unit}
        for (name, value, scale, unit), more, deviation in each
    ]
    zeros = [*(one["value"] for one in parameters[:n]), *(joint.zero_tick for joint in arm.joints[n:])]
    data = recalibrated(arm, zeros, {}).model_dump(mode="json", exclude_unset=True, exclude={"lengths_m"})
    new = validate(ArmConfig, data | {"robot": table_of(_changed(chain, x))}, "the new calibration")
    return Held(new, parameters, float(before.mean()), float(after.mean()), float(held_out.mean()), after.tolist())


def table_of(chain: SerialChain) -> dict[str, Any]:
    """A chain as the `robot` of an arm's file has it."""
    rows = [{key: np.round(value, 7).tolist() for key, value in table_row(row).items()} for row in chain.rows]
    table: dict[str, Any] = {"convention": chain.convention, "dh": rows, "base_m": list(chain.base_m)}
    if chain.has_tool:
        *_, last, tool = link_frames(chain, np.zeros(chain.n))
        T = np.linalg.inv(last) @ tool
        rpy_deg = np.degrees(rpy_from_matrix(T[:3, :3]))
        table |= {"tool_m": T[:3, 3].round(7).tolist(), "tool_rpy_deg": rpy_deg.round(7).tolist()}
        table["tool_bend_deg_m"] = round(math.degrees(chain.tool.bend), 7)
    return table


def _labels(joints: Sequence[JointConfig], chain: SerialChain) -> Iterator[tuple[str, float, float, str]]:
    """Of each parameter its name, present value, what of that a change of 1 is, and its unit."""
    for joint in joints:
        yield f"{joint.name}.zero_tick", joint.zero_tick, -joint.direction / TICK_RAD, "tick"
    for number, row in enumerate(chain.rows, 1):
        at = f"robot.dh.{number}."
        yield f"{at}a_m", row.a, 1.0, "m"
        yield f"{at}alpha_deg", math.degrees(row.alpha), DEG, "deg"
        yield f"{at}d_m", row.d, 1.0, "m"
        for which, share in enumerate(row.waves, 1):
            yield f"{at}waves_deg.{which}", math.degrees(share), DEG, "deg"
        yield f"{at}bend_deg_m", math.degrees(row.bend), DEG, "deg/m"
    for key in "abd":
        yield f"robot.tool.{key}_m", getattr(chain.tool, key), 1.0, "m"
    yield "robot.tool_bend_deg_m", math.degrees(chain.tool.bend), DEG, "deg/m"


def _sd(chain: SerialChain) -> FloatArray:
    """The priors' standard deviations, in the order of `_labels`; angles in radians."""
    row = [SD_M, SD_RAD, SD_M, *[WAVE_RAD] * 4, BEND_RAD_M]
    tool = [SD_M, SD_M, SD_M, BEND_RAD_M] * (chain.convention == "modified")
    return np.array([SD_RAD] * chain.n + row * chain.n + tool)


def _changed(chain: SerialChain, x: FloatArray) -> SerialChain:
    """The chain with its rows, and the tool, changed by so much; zeros are not the chain's."""
    n, rows = chain.n, []
    for row, (a, alpha, d, *waves, bend) in zip(chain.rows, x[n : 9 * n].reshape(n, 8).tolist(), strict=True):
        shares = tuple(share + more for share, more in zip(row.waves, waves, strict=True))
        moved = row.a + a, row.alpha + alpha, row.d + d, row.offset, row.b, row.beta
        rows.append(DHRow(*moved, waves=shares, bend=row.bend + bend))
    tool, by = chain.tool, dict(zip(("a", "b", "d", "bend"), x[9 * n :].tolist(), strict=False))
    return replace(chain, rows=tuple(rows), tool=replace(tool, **{key: getattr(tool, key) + by[key] for key in by}))


def _distances_mm(off_m: FloatArray) -> FloatArray:
    return np.asarray(1e3 * np.linalg.norm(off_m, axis=1))


def _missed(chain: SerialChain, q: FloatArray, points: FloatArray, x: FloatArray) -> FloatArray:
    """Tool less point [m], shape (m, 3)."""
    return tool_position(_changed(chain, x), q + x[: chain.n]) - points


def _positions(joints: Sequence[JointConfig], touches: Sequence[Touch]) -> FloatArray:
    """Of the joints [rad], shape (m, joints), by what the servos read."""
    q = [[joint.position_rad(tick) for joint, tick in zip(joints, one.ticks, strict=False)] for one in touches]
    return np.reshape(q, (-1, len(joints)))


def _slopes(chain: SerialChain, q: FloatArray, x: FloatArray) -> FloatArray:
    """What each parameter moves every coordinate of the tool by, shape (3 m, parameters)."""
    return slopes(lambda at: _missed(chain, q, np.zeros(3), at).ravel(), x, STEP)


def _solved(chain: SerialChain, q: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The likeliest changes, by Gauss-Newton; what each of them moves every coordinate by, and their covariance."""
    sd = _sd(chain)
    x = np.zeros(len(sd))
    for _ in range(ITERATIONS):
        r, J = _missed(chain, q, points, x).ravel(), _slopes(chain, q, x)
        A = np.concatenate([J / TOUCH_M, np.diag(1.0 / sd)])
        x = x - np.linalg.lstsq(A, np.concatenate([r / TOUCH_M, x / sd]), rcond=None)[0]
    return x, J, np.linalg.inv(A.T @ A)
