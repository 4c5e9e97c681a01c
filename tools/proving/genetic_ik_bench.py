"""The genetic algorithm of Xiang Yao et al. for a point, beside pymoo and DEAP in the same run.

Everybody gets the same targets, 95 individuals, 300 generations, 16 bits for each of four joints, crossover 0.6 and
mutation 0.01 a bit, and evaluates a whole population in one call of armctl's forward kinematics, so what differs is
the algorithm's own work. DEAP has the paper's roulette too; pymoo keeps its tournament and its survival of the best of
parents and children, which find better than a roulette does: hence time and final distance both count.
"""

import math
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.genetic import improved, plain
from armctl.kinematics.genetic.chromosomes import Coding
from armctl.kinematics.genetic.problem import points_problem
from armctl.kinematics.inverse import refine_poses
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from proving.figures import check, row

TARGETS = 100
# Targets of those that take a second each.
PEER_TARGETS = 5
ROUNDS = 3
SPEED_BOUND = 30.0
WORK = "GA for a point, 95 x 300"
OURS = "armctl, GA of 000 with polish, batch"
IMPROVED = "armctl, improved GA without polish, batch"

# Targets [m], shape (m, 3) -> configurations [rad], shape (m, n).
Solver = Callable[[FloatArray], FloatArray]


def bench(seed: int, targets: int = TARGETS, peer_targets: int = PEER_TARGETS, rounds: int = ROUNDS) -> dict[str, Any]:
    """Time [ms] a target and mean final distance [mm] of each, over the same first targets."""
    robot = robots.get("xiang-6dof")
    points = reachable_points(robot, seed, targets)
    compared = min(peer_targets, targets)
    solvers: dict[str, tuple[Solver, int]] = {
        OURS: (lambda wanted: _polished(robot, wanted, _plain(robot, wanted, seed)), targets),
        "armctl, GA of 000, batch": (lambda wanted: _plain(robot, wanted, seed), targets),
        "armctl, GA of 000 with polish, one by one": (lambda wanted: _alone(robot, wanted, seed), compared),
        IMPROVED: (lambda wanted: _improved(robot, wanted, seed), targets),
        "DEAP, the same operators": (lambda wanted: _each(wanted, _deap(robot, seed)), compared),
        "pymoo, its own selection": (lambda wanted: _each(wanted, _pymoo(robot, seed)), compared),
    }
    ms, distance_mm = dict.fromkeys(solvers, math.inf), dict.fromkeys(solvers, math.inf)
    for _ in range(rounds):
        for who, (solve, count) in solvers.items():
            begin = time.perf_counter()
            q = solve(points[:count])
            ms[who] = min(ms[who], (time.perf_counter() - begin) / count * 1e3)
            gap = np.linalg.norm(tool_position(robot.chain, q) - points[:count], axis=1)
            distance_mm[who] = float(gap[:compared].mean()) * 1e3
    rows = [row(WORK, who, value, "ms a target", value / ms[OURS]) for who, value in ms.items()]
    rows += [
        row("mean final distance", who, value, "mm", value / distance_mm[who]) for who, value in distance_mm.items()
    ]
    peers = [who for who in solvers if not who.startswith("armctl")]
    fastest, nearest = min(ms[who] for who in peers), min(distance_mm[who] for who in peers)
    checks = [
        check("fastest of pymoo and DEAP / GA of 000 with polish", fastest / ms[OURS], SPEED_BOUND, least=True),
        check("its final distance / the nearer of theirs", distance_mm[OURS] / nearest, 1.0),
        check("fastest of pymoo and DEAP / improved GA", fastest / ms[IMPROVED], 1.0, least=True),
        check("the improved GA's distance / the nearer of theirs", distance_mm[IMPROVED] / nearest, 1.0),
    ]
    return {"rows": rows, "checks": checks}


def reachable_points(robot: Robot, seed: int, count: int) -> FloatArray:
    """Tool points [m], shape (count, 3), of random configurations."""
    q = np.random.default_rng((seed, 2)).uniform(-np.pi, np.pi, (count, robot.chain.n))
    return tool_position(robot.chain, q)


def _plain(robot: Robot, wanted: FloatArray, seed: int) -> FloatArray:
    problem = points_problem(robot.chain, wanted, robot.limits_rad)
    return plain.evolve(problem, plain.PAPER, [[seed, run] for run in range(len(wanted))]).q_rad


def _improved(robot: Robot, wanted: FloatArray, seed: int) -> FloatArray:
    problem = points_problem(robot.chain, wanted, robot.limits_rad)
    return improved.evolve(problem, improved.DEFAULT, [[seed, run] for run in range(len(wanted))]).q_rad


def _polished(robot: Robot, wanted: FloatArray, q: FloatArray) -> FloatArray:
    T = points_problem(robot.chain, wanted, robot.limits_rad).T
    return refine_poses(robot.chain, T, q, robot.limits_rad, turned=False)


def _alone(robot: Robot, wanted: FloatArray, seed: int) -> FloatArray:
    return _each(wanted, lambda one: _polished(robot, one[None], _plain(robot, one[None], seed))[0])


def _each(wanted: FloatArray, solve: Callable[[FloatArray], FloatArray]) -> FloatArray:
    return np.array([solve(one) for one in wanted])


def _distance(robot: Robot, wanted: FloatArray, bits: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance [m] and configuration [rad] of chromosomes given as bits, shape (m, length)."""
    problem = points_problem(robot.chain, wanted[None], robot.limits_rad)
    coding = Coding(problem.limits_rad[list(problem.free)], plain.PAPER.bits)
    weights = 2.0 ** np.arange(coding.bits - 1, -1, -1)
    words = (bits.reshape(len(bits), coding.joints, coding.bits) @ weights).astype(np.uint32)
    q = problem.configurations(coding.angles(words[None]))[0]
    return np.asarray(np.linalg.norm(tool_position(robot.chain, q) - wanted, axis=1)), q


def _deap(robot: Robot, seed: int) -> Callable[[FloatArray], FloatArray]:
    """Its own loop and operators: roulette on 1 / distance, one cut, flipped bits; the best ever is kept aside."""
    import random

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from deap import algorithms, base, creator, tools
    settings, length = plain.PAPER, 4 * plain.PAPER.bits
    if not hasattr(creator, "NearIndividual"):
        creator.create("NearFitness", base.Fitness, weights=(1.0,))
        creator.create("NearIndividual", list, fitness=creator.NearFitness)
    toolbox = base.Toolbox()
    toolbox.register("mate", tools.cxOnePoint)
    toolbox.register("mutate", tools.mutFlipBit, indpb=settings.mutation_probability)
    toolbox.register("select", tools.selRoulette)

    def solve(wanted: FloatArray) -> FloatArray:
        random.seed(seed)  # DEAP draws from the interpreter's own generator
        population = [
            creator.NearIndividual(random.getrandbits(1) for _ in range(length)) for _ in range(settings.population)
        ]
        nearest, best = math.inf, population[0][:]
        for generation in range(settings.generations):
            if generation:
                drawn = toolbox.select(population, len(population))
                population = algorithms.varAnd(drawn, toolbox, settings.crossover_probability, 1.0)
            distance, _ = _distance(robot, wanted, np.array(population, dtype=np.float64))
            for individual, value in zip(population, distance.tolist(), strict=True):
                individual.fitness.values = (1.0 / max(value, 1e-12),)
            first = int(distance.argmin())
            if distance[first] < nearest:
                nearest, best = float(distance[first]), population[first][:]
        return np.asarray(_distance(robot, wanted, np.array([best], dtype=np.float64))[1][0])

    return solve


def _pymoo(robot: Robot, seed: int) -> Callable[[FloatArray], FloatArray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.core.problem import Problem
        from pymoo.operators.crossover.pntx import SinglePointCrossover
        from pymoo.operators.mutation.bitflip import BitflipMutation
        from pymoo.operators.sampling.rnd import BinaryRandomSampling
        from pymoo.optimize import minimize
    settings, length = plain.PAPER, 4 * plain.PAPER.bits

    class Near(Problem):  # type: ignore[misc]  # pymoo has no types
        def __init__(self, wanted: FloatArray) -> None:
            super().__init__(n_var=length, n_obj=1, xl=0, xu=1, vtype=bool)
            self.wanted = wanted

        def _evaluate(self, x: Any, out: dict[str, Any], *_: Any, **__: Any) -> None:
            out["F"] = _distance(robot, self.wanted, np.asarray(x, dtype=np.float64))[0]

    def solve(wanted: FloatArray) -> FloatArray:
        algorithm = GA(
            pop_size=settings.population,
            sampling=BinaryRandomSampling(),
            crossover=SinglePointCrossover(prob=settings.crossover_probability),
            mutation=BitflipMutation(prob=1.0, prob_var=settings.mutation_probability),
            eliminate_duplicates=False,
        )
        found = minimize(Near(wanted), algorithm, ("n_gen", settings.generations), seed=seed, verbose=False)
        return np.asarray(_distance(robot, wanted, np.asarray(found.X, dtype=np.float64)[None])[1][0])

    return solve
