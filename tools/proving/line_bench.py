"""How straight a joint-interpolated motion can be, by the number of via points, on perfect servos.

Random lines of 20-30 cm, each in the posture that `line_paths` likes best. For each number of via points: joints
interpolated through points on the line, straight and curved; the same with the points placed off the line; and what
whole ticks alone cost, goals on the line each rounded to the nearest tick (`tick floor`).
"""

from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.course import Line
from armctl.trajectory.interpolate import Interpolation, joint_path
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.placement import StraightMotion, place
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.straightness import distance_to_line
from armctl.trajectory.via_points import predict_tool_path
from proving.figures import check, row

LINES = 20
VIA = (0, 1, 2, 3, 5, 8)
DURATION_S = 5.0
LENGTH_M = (0.2, 0.3)
TICK_STATIONS = 201
# What armctl does with via points at least halves their error.
HALF = 0.5
KINDS: tuple[Interpolation, ...] = ("linear", "cubic")

# Mean and maximum error of each line [mm].
Errors = list[tuple[float, float]]


def bench(seed: int, lines: int = LINES) -> dict[str, Any]:
    """Rows and checks; `ratio` is to straight joint interpolation through points on the line."""
    arm = load_arm("ax12-line")
    robot = robots.get(arm.robot, arm.lengths_m)
    rng = np.random.default_rng(seed)
    found: dict[tuple[int, str], Errors] = {}
    floor: Errors = []
    for _ in range(lines):
        A, B, way = _drawn(arm, robot, rng)
        floor.append(_tick_floor(arm, robot, way, A, B))
        for via in VIA:
            for who, pair in _errors(arm, robot, way, via, A, B).items():
                found.setdefault((via, who), []).append(pair)
    rows, checks = [], []
    for via in VIA:
        for index, unit in enumerate(("mm mean", "mm max")):
            plain = _middle(found[via, "linear, on the line"], index)
            for (count, who), errors in found.items():
                if count == via:
                    value = _middle(errors, index)
                    rows.append(row(f"straight line, {via} via points", who, value, unit, value / plain))
        if via:
            share = _middle(found[via, "cubic, placed"], 0) / _middle(found[via, "linear, on the line"], 0)
            name = f"straight line, {via} via points: curved and placed over straight and on the line"
            checks.append(check(name, share, HALF))
    for index, unit in enumerate(("mm mean", "mm max")):
        rows.append(row("straight line, any number", "tick floor", _middle(floor, index), unit, 1.0))
    return {"rows": rows, "checks": checks, "seed": seed}


def _middle(errors: Errors, index: int) -> float:
    return float(np.mean([one[index] for one in errors]))


def _drawn(arm: ArmConfig, robot: Robot, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A line that can be followed, and the best way along it, shape (stations, n)."""
    while True:
        direction = rng.standard_normal(3)
        half = rng.uniform(*LENGTH_M) / 2.0 * direction / np.linalg.norm(direction)
        middle = rng.uniform((0.10, -0.2, 0.05), (0.28, 0.2, 0.25))
        A, B = middle - half, middle + half
        try:
            return A, B, line_paths(DrivenArm(arm, robot, 0.1), Line(A, B, DURATION_S), rng, most=1)[0]
        except RequestRefused:
            continue


def _errors(
    arm: ArmConfig, robot: Robot, way: FloatArray, via: int, A: FloatArray, B: FloatArray
) -> dict[str, tuple[float, float]]:
    chain = robot.chain
    knots = np.linspace(0.0, 1.0, via + 2)
    on_line = joint_path(way, np.linspace(0.0, 1.0, len(way)), knots, "cubic")
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
    found = {}
    for kind in KINDS:
        found[f"{kind}, on the line"] = _mm(predict_tool_path(chain, on_line, knots, kind), A, B)
        if via:
            placed = place(StraightMotion(chain, kind, A, B, limits, objective="mean"), on_line, knots)
            found[f"{kind}, placed"] = _mm(predict_tool_path(chain, placed.waypoints, placed.knots, kind), A, B)
    return found


def _tick_floor(arm: ArmConfig, robot: Robot, way: FloatArray, A: FloatArray, B: FloatArray) -> tuple[float, float]:
    at = np.linspace(0.0, 1.0, TICK_STATIONS)
    q = joint_path(way, np.linspace(0.0, 1.0, len(way)), at, "cubic")
    for i, joint in enumerate(arm.joints[: robot.chain.n]):
        q[:, i] = [joint.position_rad(round(joint.tick(angle))) for angle in q[:, i]]
    return _mm(tool_position(robot.chain, q), A, B)


def _mm(points: FloatArray, A: FloatArray, B: FloatArray) -> tuple[float, float]:
    distance = distance_to_line(points, A, B) * 1e3
    return float(distance.mean()), float(distance.max())
