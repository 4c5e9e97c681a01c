"""The genetic algorithm of the straight line beside DEAP, PyGAD and pymoo in the same run: evaluations a second, cost.

Population 100, 300 generations, 60 samples, recordings of a simulated arm. Two problems:
- "as printed": mean distance of the chosen points to the line (eq. 20), any sample of any recording at any place;
- "with limits": joint speed, joint acceleration and progress count too, as `armctl optimize` has it.
Every library gets the same table to look costs up in, the same first population, its usual operators for whole numbers
(two-point crossover, random changes, its own survival), and its fastest way of evaluating: pymoo and PyGAD whole
populations, DEAP one at a time. Rounds alternate; the best time and the median cost count.
"""

import random
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

import numpy as np

from armctl.files import load_arm
from armctl.genetic.algorithm import DEFAULT, GeneticAlgorithm, Settings
from armctl.genetic.alignment import align
from armctl.genetic.path_cost import PathCost, path_cost
from armctl.genetic.shortest_path import shortest_path
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.transform import FloatArray, IntArray
from armctl.lab.rig import VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.trajectory.interpolate import time_of_progress
from armctl.trajectory.straightness import distance_to_line, progress_along_line
from proving.figures import check, row

POPULATION, GENERATIONS, SAMPLES, TAKES = 100, 300, 60, 10
ROUNDS = 3
DURATION_S = 6.0
PYMOO_RATIO, DEAP_RATIO = 8.0, 15.0
CROSSOVER, MUTATION = 0.9, 1.0 / SAMPLES
AS_PRINTED = Settings(
    population=POPULATION,
    generations=GENERATIONS,
    crossover="one cut",
    crossover_probability=CROSSOVER,
    mutation_probability=MUTATION,
    selection="truncation",
)
WITH_LIMITS = replace(
    DEFAULT, population=POPULATION, generations=GENERATIONS, charge_shares=(1.0,), searches=0, stall_generations=0
)

# Costs [m] of chromosomes, shape (P, m) -> (P,).
Evaluate = Callable[[IntArray], FloatArray]
# Least cost found with this evaluation, first population, number of choices and seed.
Minimise = Callable[[Evaluate, IntArray, int, int], float]


@dataclass
class _Library:
    who: str
    minimise: Minimise
    seconds: float = field(default=np.inf, init=False)
    evaluations: int = field(default=0, init=False)
    costs: list[float] = field(default_factory=list, init=False)

    @property
    def evaluations_per_s(self) -> float:
        return self.evaluations / self.seconds


def bench(seed: int, generations: int = GENERATIONS, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` of a speed is to armctl's, of a cost to the exact optimum."""
    costs = _problem(seed)
    table = costs.table()
    exact = {
        "as printed": float(costs.distance_m.min(axis=1).mean()),
        "with limits": float(evaluate(table, shortest_path(table))),
    }
    stations = np.arange(SAMPLES)

    def as_printed(genes: IntArray) -> FloatArray:
        return np.asarray(costs.distance_m[stations, genes].mean(axis=-1))

    def with_limits(genes: IntArray) -> FloatArray:
        return evaluate(table, genes)

    works: list[tuple[str, Evaluate, Settings]] = [
        ("as printed", as_printed, AS_PRINTED),
        ("with limits", with_limits, WITH_LIMITS),
    ]
    rows, checks = [], []
    for work, cost, settings in works:
        settings = replace(settings, generations=generations)
        libraries = [
            _Library("armctl", _armctl(settings, table)),
            _Library("pymoo", _pymoo(generations)),
            _Library("PyGAD", _pygad(generations)),
            _Library("DEAP", _deap(generations)),
        ]
        for number in range(rounds):
            for one in libraries:
                _measure(one, cost, TAKES, seed * 1000 + number)
        ours = libraries[0]
        for one in libraries:
            rate, found = one.evaluations_per_s, median(one.costs)
            rows.append(row(f"straight line, {work}", one.who, rate, "evaluations/s", rate / ours.evaluations_per_s))
            rows.append(row(f"straight line, {work}", one.who, found * 1e3, "mm, least cost", found / exact[work]))
        rows.append(row(f"straight line, {work}", "exact optimum", exact[work] * 1e3, "mm, least cost", 1.0))
        by_name = {one.who: one for one in libraries}
        # With limits armctl's crossover weighs 2^60 mixtures for each child: there the cost counts, not the number.
        for who, bound in (("pymoo", PYMOO_RATIO), ("DEAP", DEAP_RATIO)) if work == "as printed" else ():
            ratio = ours.evaluations_per_s / by_name[who].evaluations_per_s
            checks.append(check(f"genetic algorithm, {work}: evaluations/s over {who}'s", ratio, bound, least=True))
        best = min(median(one.costs) for one in libraries[1:])
        share = median(ours.costs) / best
        checks.append(check(f"genetic algorithm, {work}: final cost over the best peer's", round(share, 9), 1.0))
    return {"rows": rows, "checks": checks, "seed": seed}


def _problem(seed: int) -> PathCost:
    rig = VirtualRig(SimulatedArm(load_arm("ax12-line"), seed=seed))
    A, B = np.array([0.18, -0.125, 0.10]), np.array([0.18, 0.125, 0.10])
    takes = [rig.teach(A, B, seed * 1000 + take) for take in range(TAKES)]
    chain = rig.robot.chain
    candidates = align(takes, rig.arm, chain, A, B, SAMPLES)
    moving = rig.arm.joints[: chain.n]
    return path_cost(
        candidates,
        distance_to_line(candidates.tool_m, A, B),
        time_of_progress(candidates.progress) * DURATION_S,
        np.array([joint.speed_limit_rad_s for joint in moving]),
        np.array([joint.acceleration_limit_rad_s2 for joint in moving]),
        progress_along_line(candidates.tool_m, A, B),
    )


def _measure(library: _Library, cost: Evaluate, choices: int, seed: int) -> None:
    asked = 0

    def counted(genes: IntArray) -> FloatArray:
        nonlocal asked
        asked += len(genes)
        return cost(genes)

    first = np.random.default_rng(seed).integers(0, choices, (POPULATION, SAMPLES))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began_s = time.perf_counter()
        found = library.minimise(counted, first, choices, seed)
        seconds = time.perf_counter() - began_s
    if library.evaluations == 0 or asked / seconds > library.evaluations_per_s:
        library.evaluations, library.seconds = asked, seconds
    library.costs.append(found)


def _armctl(settings: Settings, table: FloatArray) -> Minimise:
    def minimise(cost: Evaluate, first: IntArray, choices: int, seed: int) -> float:
        algorithm = GeneticAlgorithm(first, choices, settings, np.random.default_rng(seed), triple_cost=table)
        for _ in range(settings.generations):
            algorithm.tell(cost(algorithm.ask()))
        return algorithm.best_cost

    return minimise


def _pymoo(generations: int) -> Minimise:
    def minimise(cost: Evaluate, first: IntArray, choices: int, seed: int) -> float:
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.core.problem import Problem
        from pymoo.operators.crossover.pntx import TwoPointCrossover
        from pymoo.operators.mutation.pm import PM
        from pymoo.operators.repair.rounding import RoundingRepair
        from pymoo.optimize import minimize

        class Line(Problem):  # type: ignore[misc]
            def _evaluate(self, x: IntArray, out: dict[str, Any], *_: Any, **__: Any) -> None:
                out["F"] = cost(x)

        algorithm = GA(
            pop_size=POPULATION,
            sampling=first,
            crossover=TwoPointCrossover(prob=CROSSOVER, repair=RoundingRepair()),
            mutation=PM(prob_var=MUTATION, eta=3.0, vtype=float, repair=RoundingRepair()),
            eliminate_duplicates=False,
        )
        problem = Line(n_var=SAMPLES, n_obj=1, xl=0, xu=choices - 1, vtype=int)
        return float(minimize(problem, algorithm, ("n_gen", generations), seed=seed, verbose=False).F[0])

    return minimise


def _pygad(generations: int) -> Minimise:
    def minimise(cost: Evaluate, first: IntArray, choices: int, seed: int) -> float:
        import pygad

        def fitness(_: Any, genes: Any, __: Any) -> Any:
            return (-cost(np.atleast_2d(np.asarray(genes, dtype=np.intp)))).tolist()

        run = pygad.GA(
            num_generations=generations,
            num_parents_mating=POPULATION // 2,
            initial_population=first,
            gene_type=int,
            gene_space=list(range(choices)),
            fitness_func=fitness,
            fitness_batch_size=POPULATION,
            parent_selection_type="tournament",
            crossover_type="two_points",
            crossover_probability=CROSSOVER,
            mutation_type="random",
            mutation_probability=MUTATION,
            keep_elitism=2,
            random_seed=seed,
            suppress_warnings=True,
        )
        run.run()
        return -float(run.best_solution(pop_fitness=run.last_generation_fitness)[1])

    return minimise


def _deap(generations: int) -> Minimise:
    def minimise(cost: Evaluate, first: IntArray, choices: int, seed: int) -> float:
        from deap import algorithms, base, tools

        class Fitness(base.Fitness):  # type: ignore[misc]
            weights = (-1.0,)

        class Individual(list):  # type: ignore[type-arg]
            def __init__(self, genes: Any) -> None:
                super().__init__(genes)
                self.fitness = Fitness()

        random.seed(seed)
        toolbox = base.Toolbox()
        toolbox.register("mate", tools.cxTwoPoint)
        toolbox.register("mutate", tools.mutUniformInt, low=0, up=choices - 1, indpb=MUTATION)
        toolbox.register("select", tools.selTournament, tournsize=3)
        toolbox.register("evaluate", lambda genes: (float(cost(np.array([genes]))[0]),))
        best = tools.HallOfFame(1)
        algorithms.eaSimple(
            [Individual(genes) for genes in first.tolist()],
            toolbox,
            cxpb=CROSSOVER,
            mutpb=1.0,
            ngen=generations,
            halloffame=best,
            verbose=False,
        )
        return float(best[0].fitness.values[0])

    return minimise
