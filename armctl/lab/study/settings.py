"""Settings of the genetic algorithm compared: population, crossover and mutation probability, on the same recordings.

The comparison that Xiang et al. make by hand, with seeds repeated for its spread and the exact optimum beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.genetic.algorithm import Settings
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray

SETTLED_SHARE = 1.01
"""A run counts as settled from the generation on whose best cost is within 1 % of its last."""


@dataclass(frozen=True, eq=False)
class Case:
    """One run of the genetic algorithm."""

    arm: ArmConfig
    takes: tuple[FloatArray, ...]
    """Joint positions of each recording [rad], shape (samples, joints)."""
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    duration_s: float
    settings: Settings
    seed: int


def cases(
    base: Case,
    populations: Sequence[int],
    crossover_probabilities: Sequence[float],
    mutation_probabilities: Sequence[float],
    repeats: int,
) -> list[Case]:
    """Every combination, each with `repeats` seeds from the base's on; the seeds are the same for all of them.

    Raises:
        ConfigError: a setting is out of range.
    """
    return [
        replace(
            base,
            settings=replace(base.settings, population=P, crossover_probability=Pc, mutation_probability=Pm),
            seed=base.seed + repeat,
        )
        for P, Pc, Pm in product(populations, crossover_probabilities, mutation_probabilities)
        for repeat in range(repeats)
    ]


def work(case: Case) -> dict[str, Any]:
    """What one run found.

    Raises:
        RequestRefused: the recordings are unfit.
    """
    result = optimize(
        case.takes,
        case.arm,
        robots.get(case.arm.robot, case.arm.lengths_m),
        OptimizeRequest(
            from_m=case.from_m,
            to_m=case.to_m,
            via=(),
            duration_s=case.duration_s,
            seed=case.seed,
            settings=case.settings,
            free=False,
        ),
    )
    best = np.array(result.ga.best_cost_mm)
    return {
        "population": case.settings.population,
        "crossover_probability": case.settings.crossover_probability,
        "mutation_probability": case.settings.mutation_probability,
        "mean_error_mm": result.ga.mean_error_mm,
        "gap_ratio": result.gap_ratio,
        "feasible": result.feasible,
        "settled_generation": int(np.argmax(best <= SETTLED_SHARE * best[-1])) + 1,
        "exact_mean_error_mm": result.exact.mean_error_mm,
    }


def rows(found: Sequence[dict[str, Any]], repeats: int) -> list[dict[str, Any]]:
    """One row a setting, over its repeats; `found` as `work` told of `cases`."""
    result = []
    for begin in range(0, len(found), repeats):
        some = found[begin : begin + repeats]
        errors = np.array([one["mean_error_mm"] for one in some])
        result.append(
            {
                **{key: some[0][key] for key in ("population", "crossover_probability", "mutation_probability")},
                "mean_error_mm": float(errors.mean()),
                "spread_mm": float(errors.std()),
                "best_mm": float(errors.min()),
                "gap_ratio": float(np.mean([one["gap_ratio"] for one in some])),
                "feasible": sum(one["feasible"] for one in some),
                "settled_generation": float(np.mean([one["settled_generation"] for one in some])),
                "exact_mean_error_mm": some[0]["exact_mean_error_mm"],
                "repeats": len(some),
            }
        )
    return result
