"""The whole optimisation: recordings -> candidates -> genetic algorithm, held against the exact optimum -> plans.

The straight line of Raharjo et al. with the problem made honest: as printed, the best point of every sample is the
optimum of eq. 20 and a chromosome of copies of A scores zero. Here genes are aligned by progress (`alignment.py`), a
path must be one the arm can follow (`path_cost.py`), and its true optimum is known (`shortest_path.py`).
By default the genetic algorithm is a memetic one: its crossover finds the cheapest mixture of two parents exactly, by
dynamic programming, and some children search. So it is expected at the optimum, and no proof that evolution alone gets
there; the paper's own operators are the profile "paper".
Genes are recorded configurations and, unless the paper's own procedure is wanted, means of two of them.
Joints that do not move the tool are carried along: at each station the mean of the recordings. After evolution the
genes may leave the recordings (`free_path.py`) and via points the line (`placement.py`), unless the paper's own
procedure is wanted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.genetic.algorithm import GeneticAlgorithm, Settings
from armctl.genetic.alignment import Candidates, align, with_blends
from armctl.genetic.free_path import free_path
from armctl.genetic.path_cost import PathCost, path_cost
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.shortest_path import shortest_path
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, IntArray
from armctl.messages import LONGEST_S
from armctl.trajectory.interpolate import time_of_progress
from armctl.trajectory.placement import StraightMotion, place
from armctl.trajectory.plan import Plan, plan_through
from armctl.trajectory.straightness import distance_to_line, errors_mm, mean_error, progress_along_line
from armctl.trajectory.via_points import choose_via_points, predict_tool_path

STATIONS_PER_S = 10.0
FEWEST_STATIONS, MOST_STATIONS = 10, 100
# Called with the number of a generation (from 1), the best and the mean cost [mm].
Progress = Callable[[int, float, float], None]


@dataclass(frozen=True, eq=False)
class LineError:
    """How far a tool path is off the line."""

    mean_error_mm: float
    max_error_mm: float


@dataclass(frozen=True, eq=False)
class TakeError(LineError):
    """How far a recording by itself is off the line, and what the genetic algorithm took of it."""

    # At how many stations its path is this recording's, alone or blended with another.
    genes: int


@dataclass(frozen=True, eq=False)
class StationPath(LineError):
    """Where the arm is at each of the m stations."""

    # Joint positions [rad], shape (m, joints).
    positions_rad: FloatArray
    # Tool points [m], shape (m, 3).
    tool_m: FloatArray
    # Whether the path keeps every joint's speed and acceleration limit in the nominal time, and never goes back.
    feasible: bool


@dataclass(frozen=True, eq=False)
class CandidatePath(StationPath):
    """A path through the candidates."""

    # Index of the candidate used at each station, shape (m,).
    genes: IntArray
    # The error that was made small (mean, or p-norm), the charges for broken limits in it.
    cost_mm: float


class GeneticRun(NamedTuple):
    """What the genetic algorithm found, and how it went."""

    path: CandidatePath
    generations: int
    evaluations: int
    # Least cost so far, charges in full, after each generation.
    best_cost_mm: tuple[float, ...]
    # Mean cost, with the charges in force then, of the individuals that each generation's selection kept.
    mean_cost_mm: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class FreePath(StationPath):
    """A path near recorded genes."""

    largest_offset_rad: float


class StraightLineResult(NamedTuple):
    """Everything a report shows."""

    candidates: Candidates
    # Each recording by itself, at the same stations as the paths below.
    baseline: tuple[TakeError, ...]
    ga: GeneticRun
    exact: CandidatePath
    # Cost of the genetic algorithm's path over the exact least cost, minus 1.
    gap_ratio: float
    # The genetic algorithm's path, its genes off the recordings; what the plans are made of, where it was wanted.
    free: FreePath | None
    # One for each entry of `via`.
    plans: tuple[Plan, ...]
    # Where no path keeps the limits: the duration from which on one over recorded genes does; None: there is none
    # within `LONGEST_S`, or none is needed.
    least_duration_s: float | None

    @property
    def feasible(self) -> bool:
        """Whether the path that the plans are made of keeps the limits."""
        return (self.free or self.ga.path).feasible


def optimize(
    takes: Sequence[FloatArray], arm: ArmConfig, robot: Robot, asked: OptimizeRequest, progress: Progress | None = None
) -> StraightLineResult:
    """The straightest motions from A to B that the recordings hold.

    Args:
        takes: Joint positions [rad], each of shape (samples, joints), in the arm's joint order.
        progress: Called after each generation.
    Raises:
        RequestRefused: the line or a recording is unfit; `reasons` names all that were found.
    """
    line = _Line(takes, arm, robot.chain, asked)
    candidates = line.candidates(asked.duration_s)
    costs = line.cost(candidates, asked.duration_s)
    table = costs.table()
    rng = np.random.default_rng(asked.seed)
    genes, best_cost_mm, mean_cost_mm, evaluations = _evolve(costs, len(takes), asked.settings, rng, progress)
    found, exact = (line.path(candidates, costs, table, some) for some in (genes, shortest_path(table)))
    freed = line.freed(found, candidates.progress) if asked.free else None
    chosen = freed or found
    alone, used = costs.distance_m.T[: len(takes)] * 1e3, candidates.takes[found.genes]
    return StraightLineResult(
        candidates=candidates,
        baseline=tuple(
            TakeError(float(row.mean()), float(row.max()), int((used == take).any(axis=1).sum()))
            for take, row in enumerate(alone)
        ),
        ga=GeneticRun(found, asked.settings.generations, evaluations, best_cost_mm, mean_cost_mm),
        exact=exact,
        # A recording that is perfect leaves nothing to divide by: a nanometre stands for it.
        gap_ratio=(found.cost_mm - exact.cost_mm) / max(exact.cost_mm, 1e-6),
        free=freed,
        plans=tuple(line.plan(chosen.positions_rad, candidates.progress, count) for count in asked.via),
        least_duration_s=None if chosen.feasible else _least_duration_s(line.kept, asked.duration_s),
    )


class _Line:
    """The line of a request, and what a path along it costs."""

    def __init__(
        self, recordings: Sequence[FloatArray], arm: ArmConfig, chain: SerialChain, request: OptimizeRequest
    ) -> None:
        self._recordings, self._arm, self._chain, self._request = recordings, arm, chain, request
        self._ends = A, B = np.array(request.from_m), np.array(request.to_m)
        reasons = [
            f"{name} lies at height {z:.3f} m, below the floor at {arm.floor_m:.3f} m; raise it"
            for name, z in zip("AB", (A[2], B[2]), strict=True)
            if z < arm.floor_m
        ]
        if reasons:
            raise RequestRefused("BAD_REQUEST", reasons)
        self._limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])

    def candidates(self, nominal_s: float) -> Candidates:
        """The recordings at as many stations as a motion of that duration has; blends too where genes may be free."""
        fewest = max(STATIONS_PER_S * nominal_s, FEWEST_STATIONS, max(self._request.via, default=0) + 2)
        stations = round(min(fewest, MOST_STATIONS))
        some = align(self._recordings, self._arm, self._chain, *self._ends, stations)
        return with_blends(some, self._arm, self._chain, *self._ends) if self._request.free else some

    def cost(self, some: Candidates, nominal_s: float) -> PathCost:
        distance, along = distance_to_line(some.tool_m, *self._ends), progress_along_line(some.tool_m, *self._ends)
        moving = self._arm.joints[: self._chain.n]
        speed_limits = np.array([joint.speed_limit_rad_s for joint in moving])
        acceleration_limits = np.array([joint.acceleration_limit_rad_s2 for joint in moving])
        time_s = time_of_progress(some.progress) * nominal_s
        return path_cost(some, distance, time_s, speed_limits, acceleration_limits, along, self._request.objective)

    def kept(self, nominal_s: float) -> bool:
        """Whether some path through the candidates keeps the limits in that duration."""
        slower = self.cost(self.candidates(nominal_s), nominal_s)
        return not evaluate(slower.breaks, shortest_path(slower.table())) > 0.0

    def path(self, candidates: Candidates, costs: PathCost, table: FloatArray, genes: IntArray) -> CandidatePath:
        station, n = np.arange(len(genes)), self._chain.n
        positions = candidates.positions_rad[genes, station]
        alone = candidates.takes[:, 0] == candidates.takes[:, 1]
        positions[:, n:] = candidates.positions_rad[alone, :, n:].mean(axis=0)
        distance = costs.distance_m[station, genes] * 1e3
        return CandidatePath(
            genes=genes,
            positions_rad=positions,
            tool_m=candidates.tool_m[genes, station],
            mean_error_mm=float(distance.mean()),
            max_error_mm=float(distance.max()),
            cost_mm=costs.norm_m(float(evaluate(table, genes))) * 1e3,
            feasible=not evaluate(costs.breaks, genes) > 0.0,
        )

    def freed(self, found: CandidatePath, progress: FloatArray) -> FreePath:
        """The path with its genes off the recordings."""
        chain, n = self._chain, self._chain.n

        def breaks(q: FloatArray) -> float:
            # The tables of a single candidate hold what its one path breaks.
            single = Candidates(progress, q[None], tool_position(chain, q)[None], np.zeros((1, 2), dtype=np.intp))
            return float(self.cost(single, self._request.duration_s).breaks.sum())

        q = free_path(chain, found.positions_rad[:, :n], progress, self._ends, self._limits, breaks)
        tool = tool_position(chain, q)
        return FreePath(
            *errors_mm(tool, *self._ends),
            positions_rad=np.concatenate([q, found.positions_rad[:, n:]], axis=1),
            tool_m=tool,
            largest_offset_rad=float(np.abs(q - found.positions_rad[:, :n]).max()),
            feasible=not breaks(q) > 0.0,
        )

    def plan(self, path: FloatArray, progress: FloatArray, count: int) -> Plan:
        """The plan with `count` via points through a path, joint positions [rad] of shape (m, joints)."""
        chain, n, request, interpolation = self._chain, self._chain.n, self._request, self._request.interpolation
        kept = [0, *choose_via_points(chain, path[:, :n], progress, count, interpolation, self._ends), len(path) - 1]
        waypoints, knots = path[kept], progress[kept]
        tool_m = predict_tool_path(chain, waypoints[:, :n], knots, interpolation)
        if request.free and count > 0:
            motion = StraightMotion(chain, interpolation, *self._ends, self._limits, objective=request.objective)
            off_line = place(motion, waypoints[:, :n], knots)
            moved = waypoints.copy()
            moved[1:-1, :n] = off_line.waypoints[1:-1]  # A and B are held exactly
            moved_tool_m = predict_tool_path(chain, moved[:, :n], off_line.knots, interpolation)
            if mean_error(moved_tool_m, *self._ends) < mean_error(tool_m, *self._ends):
                waypoints, knots, tool_m = moved, off_line.knots, moved_tool_m
        asked = request.model_dump(include={"from_m", "to_m", "duration_s", "interpolation", "seed"})
        return plan_through(self._arm, waypoints, knots, errors_mm(tool_m, *self._ends), **asked)


def _least_duration_s(kept: Callable[[float], bool], begin_s: float) -> float | None:
    """The shortest duration above `begin_s`, in whole tenths of a second, that is `kept`; to a few per cent."""
    low = high = int(10.0 * begin_s)
    while not kept(high / 10.0):
        if high >= 10.0 * LONGEST_S:
            return None  # some limits know no time: every recording goes back
        low, high = high, min(2 * high + 1, int(10.0 * LONGEST_S))
    while high - low > max(1, high // 20):
        middle = (low + high) // 2
        low, high = (low, middle) if kept(middle / 10.0) else (middle, high)
    return high / 10.0


def _evolve(
    costs: PathCost, recordings: int, settings: Settings, rng: np.random.Generator, progress: Progress | None
) -> tuple[IntArray, tuple[float, ...], tuple[float, ...], int]:
    stations, choices = costs.distance_m.shape
    # The first population is the recordings themselves, as in the paper (Fig. 8); searches bring blends in.
    initial = np.repeat(np.arange(recordings, dtype=np.intp)[:, None], stations, axis=1)
    tables = [costs.table(share) for share in settings.charge_shares]
    part, begun, improved = 0, 0, 0
    algorithm = GeneticAlgorithm(initial, choices, settings, rng, triple_cost=tables[0])
    best, least = initial[0], np.inf
    best_cost_mm, mean_cost_mm = [], []
    for generation in range(1, settings.generations + 1):
        before = algorithm.best_cost
        algorithm.tell(evaluate(tables[part], algorithm.ask()))
        if algorithm.best_cost < before:
            improved = generation
        if (cost := float(evaluate(tables[-1], algorithm.best))) < least:
            best, least = algorithm.best, cost
        best_cost_mm.append(costs.norm_m(least) * 1e3)
        mean_cost_mm.append(costs.norm_m(algorithm.mean_cost) * 1e3)
        if progress is not None:
            progress(generation, best_cost_mm[-1], mean_cost_mm[-1])
        stalled = 0 < settings.stall_generations <= generation - max(improved, begun)
        if stalled or (part + 1 < len(tables) and generation - begun >= settings.generations // len(tables)):
            part, begun = (part + 1) % len(tables), generation
            if part == 0:
                algorithm = GeneticAlgorithm(initial, choices, settings, rng, triple_cost=tables[0])
            else:
                algorithm.restart(tables[part])
    return best, tuple(best_cost_mm), tuple(mean_cost_mm), settings.generations * settings.population
