"""Settings of the genetic algorithm compared on the same recordings: population, crossover and mutation probability.

Xiang et al. make this comparison by hand. Here every setting is run with several seeds, which gives the spread, and the
exact optimum is computed as well.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from armctl.json_text import named
from armctl.lab.study.case import Case, Found, Row

# A run counts as settled from the generation on whose best cost is within 1 % of its last.
SETTLED_SHARE = 1.01
# What differs from case to case, besides the seed.
VARIED = ("population", "crossover_probability", "mutation_probability")


def every_setting(
    case: Case, *, population: Sequence[int], pc: Sequence[float], pm: Sequence[float], repeats: int
) -> list[Case]:
    """Every combination, each with `repeats` seeds from the case's on; the seeds are the same for all of them.

    Args:
        pc, pm: Probabilities of crossover and mutation.
    Raises:
        ConfigError: a setting is out of range.
    """
    settings = [
        replace(case.settings, population=P, crossover_probability=Pc, mutation_probability=Pm)
        for P, Pc, Pm in product(population, pc, pm)
    ]
    seeds = range(case.seed, case.seed + repeats)
    asked = replace(case, repeats=repeats, objective="mean")
    return [replace(asked, settings=one, seed=seed) for one in settings for seed in seeds]


def run(case: Case) -> Found:
    """What one run of the genetic algorithm found.

    Raises:
        RequestRefused: the recordings are unfit.
    """
    result = case.optimum()
    best = np.array(result.ga.best_cost_mm)
    row = {
        **named(case.settings, *VARIED),
        **named(result, "gap_ratio", "feasible"),
        "mean_error_mm": result.ga.path.mean_error_mm,
        "settled_generation": int(np.argmax(best <= SETTLED_SHARE * best[-1])) + 1,
        "exact_mean_error_mm": result.exact.mean_error_mm,
    }
    return Found([row])


def over_seeds(rows: Sequence[Row], cases: Sequence[Case], *_: object) -> list[Row]:
    """One row a setting, over its seeds; `rows` in the order of `every_setting`, a case each."""
    result, repeats = [], cases[0].repeats
    for begin in range(0, len(rows), repeats):
        some = rows[begin : begin + repeats]
        means = np.array([row["mean_error_mm"] for row in some])
        told: Row = {name: some[0][name] for name in (*VARIED, "exact_mean_error_mm")}
        told |= {name: float(np.mean([row[name] for row in some])) for name in ("gap_ratio", "settled_generation")}
        told |= {"mean_error_mm": float(means.mean()), "spread_mm": float(means.std()), "best_mm": float(means.min())}
        result.append(told | {"feasible": sum(row["feasible"] for row in some), "repeats": len(some)})
    return result
