"""A genetic algorithm over whole-number genes, driven from outside: ask for individuals, tell their costs.

The cycle is the paper's (Fig. 6, after Michalewicz): reproduction first (crossover, then mutation), then selection,
with elitism. The caller evaluates a whole population at a time and minimises; nothing here knows what a gene means.

Crossover is one of
- "one cut": the paper's, random pairs cut at a random place;
- "optimal": the cheapest mixture of two parents' genes, by a table of triple costs; some donors are individuals of the
  first population, so that what selection has lost can come back.
Selection is one of
- "roulette": the elite (fitness at or above a threshold) of parents and offspring stays, the rest is drawn from the
  offspring in proportion to fitness (eqs. 21, 22);
- "truncation": the best of parents and offspring together survive (mu + lambda), of equal costs only one.

Where there is a table of triple costs a few children a generation may also learn: a short window of neighbouring
genes of a survivor is re-chosen at once, all others held. A window is a small part of a chromosome and lies anywhere,
so this improves what evolution has found and cannot find it by itself.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armctl.errors import ConfigError
from armctl.genetic import operators
from armctl.genetic.shortest_path import window_search
from armctl.kinematics.genetic.chromosomes import check_settings
from armctl.kinematics.transform import FloatArray, IntArray


@dataclass(frozen=True)
class Settings:
    """What shapes a run; probabilities, threshold and fraction are within 0..1.

    The paper prints no numbers for its operators; the defaults are common ones.
    """

    population: int = 100
    generations: int = 300
    crossover: Literal["one cut", "optimal"] = "one cut"
    # Share of the chromosomes that take part in crossover (Pc).
    crossover_probability: float = 0.6
    # Share of all genes of the population that change (Pm).
    mutation_probability: float = 0.01
    selection: Literal["roulette", "truncation"] = "roulette"
    # Charges for broken limits as shares of the true ones, one for each equal part of the generations, the last 1.
    # While charges are low, evolution passes through paths that break a limit to better ones behind them.
    charge_shares: tuple[float, ...] = (1.0,)
    # Children of a generation that are a survivor with one window re-chosen, half of them the best survivor.
    searches: int = 0
    # Length of that window; never more than a quarter of a chromosome.
    window_genes: int = 10
    # Generations without a better cost after which the run goes on to the next share of the charges, and from the
    # last to the first again with the recordings anew; 0: never before its time.
    stall_generations: int = 0
    # Fitness, relative to the best, from which on an individual is elite (roulette only).
    elite_threshold: float = 1.0
    # Most of the population that may be elite (roulette only).
    elite_fraction: float = 0.1

    def __post_init__(self) -> None:
        check_settings(self)
        shares = self.charge_shares
        if not 1 <= len(shares) <= self.generations or shares[-1] != 1.0 or not all(share >= 0.0 for share in shares):
            wanted = f"1 to {self.generations} numbers (the generations), not negative, the last of them 1"
            raise ConfigError("genetic algorithm", "charge_shares", f"{shares} must be {wanted}")


# The paper's operators.
PAPER = Settings(elite_threshold=0.95)

# What comes near the exact optimum.
DEFAULT = Settings(
    generations=200,
    crossover="optimal",
    crossover_probability=1.0,
    mutation_probability=0.0,
    selection="truncation",
    charge_shares=(0.001, 0.01, 0.1, 1.0),
    searches=8,
    stall_generations=8,
)

PROFILES = {"default": DEFAULT, "paper": PAPER}

# Share of optimal crossovers whose donor comes from the first population.
_FIRST_DONORS = 0.3


@dataclass(eq=False)
class GeneticAlgorithm:
    """State of one run: `ask`, evaluate, `tell`, for as long as wanted.

    Raises:
        ValueError: optimal crossover without `triple_cost`.
    """

    # Chromosomes to start from, shape (any, genes), repeated or cut to the population's size.
    initial: IntArray
    choices: int
    settings: Settings
    rng: np.random.Generator
    # Shape (genes - 2, choices, choices, choices).
    triple_cost: FloatArray | None = None

    def __post_init__(self) -> None:
        if (self.settings.crossover == "optimal" or self.settings.searches) and self.triple_cost is None:
            raise ValueError("optimal crossover and searches need a table of triple costs to know what fits")
        self._asked = np.resize(self.initial, (self.settings.population, self.initial.shape[1]))
        self._parents = self._asked[:0]
        self._parent_cost: FloatArray = np.empty(0)
        self.best: IntArray = self._asked[0].copy()
        self.best_cost = np.inf

    def restart(self, triple_cost: FloatArray) -> None:
        """Go on with the first population and the survivors under a new cost; what is best is asked anew."""
        self.triple_cost = triple_cost
        self._asked = np.concatenate([self.initial, self._parents])[: self.settings.population]
        self._parents, self._parent_cost = self._asked[:0], np.empty(0)
        self.best_cost = np.inf

    @property
    def mean_cost(self) -> float:
        """Mean cost of the individuals that the last selection kept."""
        return float(self._parent_cost.mean())

    def ask(self) -> IntArray:
        """The individuals whose costs `tell` wants next, shape (population, genes)."""
        return self._asked

    def tell(self, cost: FloatArray) -> None:
        """Select by the costs (>= 0, shape (population,)) of the individuals asked for, and reproduce."""
        if cost.min() < self.best_cost:
            self.best, self.best_cost = self._asked[cost.argmin()].copy(), float(cost.min())
        pool_cost = np.concatenate([self._parent_cost, cost])
        kept = self._truncation(pool_cost) if self.settings.selection == "truncation" else self._roulette(pool_cost)
        self._parents, self._parent_cost = np.concatenate([self._parents, self._asked])[kept], pool_cost[kept]
        self._asked = self._offspring()

    def _truncation(self, cost: FloatArray) -> IntArray:
        # Equal cost nearly always means the same chromosome, and copies would crowd everything else out.
        _, distinct = np.unique(cost, return_index=True)
        return np.resize(distinct, self.settings.population)

    def _roulette(self, cost: FloatArray) -> IntArray:
        settings = self.settings
        fitness = operators.fitness_from_cost(cost)
        elite = operators.elite(fitness, settings.elite_threshold, round(settings.elite_fraction * settings.population))
        newborn = len(self._parents)
        drawn = operators.roulette(fitness[newborn:], settings.population - len(elite), self.rng)
        return np.concatenate([elite, newborn + drawn])

    def _offspring(self) -> IntArray:
        settings, rng, parents, table = self.settings, self.rng, self._parents, self.triple_cost
        if table is not None and settings.crossover == "optimal":
            old = self.initial[rng.integers(0, len(self.initial), len(parents))]
            donors = np.where(rng.random((len(parents), 1)) < _FIRST_DONORS, old, rng.permutation(parents))
            children = operators.optimal_crossover(parents, donors, table, settings.crossover_probability, rng)
        else:
            children = operators.one_cut_crossover(parents, settings.crossover_probability, rng)
        children = operators.mutate(children, self.choices, settings.mutation_probability, rng)
        if table is not None and settings.searches:
            genes = parents.shape[1]
            length = min(settings.window_genes, max(1, genes // 4))
            for child in range(min(settings.searches, len(children))):
                survivor = parents[0 if child % 2 else rng.integers(0, len(parents))]
                children[child] = window_search(table, survivor, int(rng.integers(0, genes - length + 1)), length)
        return children
