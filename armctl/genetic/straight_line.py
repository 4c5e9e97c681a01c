"""The whole optimisation: recordings -> candidates -> genetic algorithm, held against the exact optimum -> plans.

The straight line of Raharjo et al. with the problem made honest: as printed, the best point of every sample is the
optimum of eq. 20 and a chromosome of copies of A scores zero. Here genes are aligned by progress (`alignment.py`), a
path must be one the arm can follow (`path_cost.py`), and its true optimum is known (`shortest_path.py`).
Joints that do not move the tool are carried along: at each station the mean of the recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.genetic.algorithm import DEFAULT, GeneticAlgorithm, Settings
from armctl.genetic.alignment import Candidates, align
from armctl.genetic.path_cost import PathCost, path_cost
from armctl.genetic.shortest_path import shortest_path
from armctl.genetic.triple_cost import IntArray, evaluate
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation, time_of_progress
from armctl.trajectory.plan import Plan
from armctl.trajectory.straightness import distance_to_line, max_error, mean_error, progress_along_line
from armctl.trajectory.via_points import choose_via_points, predict_tool_path

STATIONS_PER_S = 10.0
FEWEST_STATIONS, MOST_STATIONS = 10, 100
MAX_VIA = 20
LONGEST_DURATION_S = 600.0


@dataclass(frozen=True)
class LineError:
    """How far a tool path is off the line."""

    mean_error_mm: float
    max_error_mm: float


@dataclass(frozen=True, eq=False)
class CandidatePath:
    """A path through the candidates."""

    genes: IntArray
    """Index of the recording used at each station, shape (m,)."""
    positions_rad: FloatArray
    """Joint positions, shape (m, joints)."""
    tool_m: FloatArray
    """Tool points, shape (m, 3)."""
    mean_error_mm: float
    max_error_mm: float
    cost_mm: float
    """Mean error, and the charges for broken limits."""
    feasible: bool
    """Whether the path keeps every joint's speed and acceleration limit in the nominal time, and never goes back."""


@dataclass(frozen=True, eq=False)
class GeneticRun:
    """What the genetic algorithm found, and how it went."""

    path: CandidatePath
    generations: int
    evaluations: int
    best_cost_mm: tuple[float, ...]
    """Least cost so far in the present part of the run, with the charges in force there, after each generation."""
    mean_cost_mm: tuple[float, ...]
    """Mean cost, likewise, of the individuals that each generation's selection kept."""

    @property
    def mean_error_mm(self) -> float:
        return self.path.mean_error_mm


@dataclass(frozen=True, eq=False)
class StraightLineResult:
    """Everything a report shows."""

    candidates: Candidates
    baseline: tuple[LineError, ...]
    """Each recording by itself, at the same stations as the paths below."""
    ga: GeneticRun
    exact: CandidatePath
    gap_ratio: float
    """Cost of the genetic algorithm's path over the exact least cost, minus 1."""
    plans: tuple[Plan, ...]
    """One for each entry of `via`."""
    plan_tool_m: tuple[FloatArray, ...]
    """Predicted tool points of each plan, shape (samples, 3)."""

    @property
    def feasible(self) -> bool:
        return self.ga.path.feasible


def optimize(
    recordings: Sequence[FloatArray],
    arm: ArmConfig,
    robot: Robot,
    A: Sequence[float] | FloatArray,
    B: Sequence[float] | FloatArray,
    *,
    via: Sequence[int],
    duration_s: float,
    seed: int,
    settings: Settings = DEFAULT,
    interpolation: Interpolation = "cubic",
    progress: Callable[[int, float, float], None] | None = None,
) -> StraightLineResult:
    """The straightest motions from A to B that the recordings hold.

    Args:
        recordings: Joint positions [rad], each of shape (samples, joints), in the arm's joint order.
        A, B: Ends of the line in the base frame [m].
        via: Number of via points of each plan wanted.
        duration_s: Nominal time from A to B.
        seed: Same seed, same result, bit for bit.
        progress: Called after each generation with its number (from 1), the best and the mean cost [mm].
    Raises:
        RequestRefused: an argument or a recording is unfit; `reasons` names all that were found.
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    _check_request(arm, A, B, via, duration_s, seed)
    chain = robot.chain
    stations = round(min(max(STATIONS_PER_S * duration_s, FEWEST_STATIONS, max(via, default=0) + 2), MOST_STATIONS))
    candidates = align(recordings, arm, chain, A, B, stations)
    moving = arm.joints[: chain.n]
    costs = path_cost(
        candidates,
        distance_to_line(candidates.tool_m, A, B),
        time_of_progress(candidates.progress) * duration_s,
        np.array([joint.speed_limit_rad_s for joint in moving]),
        np.array([joint.acceleration_limit_rad_s2 for joint in moving]),
        progress_along_line(candidates.tool_m, A, B),
    )

    def path(genes: IntArray) -> CandidatePath:
        station = np.arange(stations)
        positions = candidates.positions_rad[genes, station]
        positions[:, chain.n :] = candidates.positions_rad[..., chain.n :].mean(axis=0)
        distance = costs.distance_m[station, genes] * 1e3
        return CandidatePath(
            genes=genes,
            positions_rad=positions,
            tool_m=candidates.tool_m[genes, station],
            mean_error_mm=float(distance.mean()),
            max_error_mm=float(distance.max()),
            cost_mm=float(evaluate(table, genes)) * 1e3,
            feasible=not evaluate(costs.breaks, genes) > 0.0,
        )

    table = costs.table()
    genes, best_cost_mm, mean_cost_mm, evaluations = _evolve(costs, settings, np.random.default_rng(seed), progress)
    found, exact = path(genes), path(shortest_path(table))
    plans, plan_tool = [], []
    for count in via:
        moved = found.positions_rad[:, : chain.n]
        chosen = choose_via_points(chain, moved, candidates.progress, count, interpolation, A, B)
        kept = [0, *chosen, stations - 1]
        waypoints, knots = found.positions_rad[kept], candidates.progress[kept]
        tool = predict_tool_path(chain, waypoints[:, : chain.n], knots, interpolation)
        plan_tool.append(tool)
        plans.append(
            Plan(
                arm_id=arm.arm_id,
                calibration_hash=arm.calibration_hash,
                from_m=tuple(A.tolist()),
                to_m=tuple(B.tolist()),
                duration_s=duration_s,
                via=count,
                interpolation=interpolation,
                waypoints_rad=tuple(map(tuple, waypoints.tolist())),
                waypoint_progress=tuple(knots.tolist()),
                predicted_mean_error_mm=float(mean_error(tool, A, B)) * 1e3,
                predicted_max_error_mm=float(max_error(tool, A, B)) * 1e3,
                seed=seed,
            )
        )
    alone = costs.distance_m.T * 1e3
    return StraightLineResult(
        candidates=candidates,
        baseline=tuple(LineError(float(row.mean()), float(row.max())) for row in alone),
        ga=GeneticRun(found, settings.generations, evaluations, best_cost_mm, mean_cost_mm),
        exact=exact,
        # A recording that is perfect leaves nothing to divide by: a nanometre stands for it.
        gap_ratio=(found.cost_mm - exact.cost_mm) / max(exact.cost_mm, 1e-6),
        plans=tuple(plans),
        plan_tool_m=tuple(plan_tool),
    )


def _check_request(
    arm: ArmConfig, A: FloatArray, B: FloatArray, via: Sequence[int], duration_s: float, seed: int
) -> None:
    reasons = []
    for name, point in (("A", A), ("B", B)):
        if point.shape != (3,) or not np.isfinite(point).all():
            reasons.append(f"{name} is {point.tolist()}; give three finite numbers x, y, z in metres")
        elif point[2] < arm.floor_m:
            reasons.append(f"{name} lies at height {point[2]:.3f} m, below the floor at {arm.floor_m:.3f} m; raise it")
    reasons += [f"{count} via points wanted; give 0 to {MAX_VIA}" for count in via if not 0 <= count <= MAX_VIA]
    if not 0.0 < duration_s <= LONGEST_DURATION_S:
        reasons.append(f"duration {duration_s} s; give more than 0 s, at most {LONGEST_DURATION_S:.0f} s")
    if seed < 0:
        reasons.append(f"seed {seed}; give 0 or more")
    if reasons:
        raise RequestRefused("BAD_REQUEST", reasons)


def _evolve(
    costs: PathCost,
    settings: Settings,
    rng: np.random.Generator,
    progress: Callable[[int, float, float], None] | None,
) -> tuple[IntArray, tuple[float, ...], tuple[float, ...], int]:
    stations, recordings = costs.distance_m.shape
    # The first population is the recordings themselves, as in the paper (Fig. 8).
    initial = np.repeat(np.arange(recordings, dtype=np.intp)[:, None], stations, axis=1)
    table = costs.table(settings.charge_shares[0])
    algorithm = GeneticAlgorithm(initial, recordings, settings, rng, triple_cost=table)
    best_cost_mm, mean_cost_mm = [], []
    part, parts = 0, len(settings.charge_shares)
    for generation in range(1, settings.generations + 1):
        if (generation - 1) * parts // settings.generations > part:
            part += 1
            table = costs.table(settings.charge_shares[part])
            algorithm.restart(table)
        algorithm.tell(evaluate(table, algorithm.ask()))
        best_cost_mm.append(algorithm.best_cost * 1e3)
        mean_cost_mm.append(algorithm.mean_cost * 1e3)
        if progress is not None:
            progress(generation, best_cost_mm[-1], mean_cost_mm[-1])
    return algorithm.best, tuple(best_cost_mm), tuple(mean_cost_mm), algorithm.evaluations
