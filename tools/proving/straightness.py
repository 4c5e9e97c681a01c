"""How straight simulated arms can be made to move, by their true tool pose, against the bounds the project set.

`prove`: twenty arms and lines drawn at random. What counts is the plan that at most five rounds came to, chosen by the
encoders and run anew. Beside it: the error before any correction, the first run with the identified model, and what one
effect costs, by switching it off in the simulator.

`prove_refinement`: a hundred arms and lines, and what "never worse than the start, monotone within noise" is taken to
mean. The noise is the standard deviation of what the encoders make of one and the same plan from run to run, over all
plans that were run more than once; the motion itself repeats far better, which is told beside it.
1. The start is the uncorrected run, round 0: the true mean error of the outcome exceeds it nowhere by over 5 %.
2. Kept plans get better: what the encoders make of the outcome, in a run that had no part in choosing it, is above no
   earlier kept plan by more than `LIKELY` deviations of the noise.
3. The first run with the model, round 1, is nearly straight already, and what is left of its error is in part unseen by
   any encoder. Correcting the part that is seen may therefore lead away from the line by a little; by truth the outcome
   exceeds round 1 nowhere by over 5 % and `LIKELY` deviations of the noise. How often by over 5 % alone is told.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from armctl.lab.course import Via
from armctl.lab.study import limits
from proving import line_trials
from proving.line_trials import Trial
from proving.workers import WORKERS, carry_out

ARMS = 20
REFINED_ARMS = 100
ROUNDS = 5
EFFECT_ARMS = 4
VIA: tuple[Via, ...] = (0, 1, 2, 8, "stream")
FAST_PERIOD_S = 0.02
# Mean and maximum of the true distance to the line.
BOUNDS_MM: dict[str, tuple[float, float]] = {
    "via 1 median": (3.2, 7.0),
    "via 2 median": (0.9, 2.3),
    "via 8 median": (0.85, 2.5),
    "via stream median": (0.85, 2.5),
    "via 2 worst": (1.5, 4.0),
    "via 8 worst": (1.5, 4.0),
    "via stream worst": (1.5, 4.0),
    "via 2 first median": (1.3, 3.5),
    "via stream at 50 Hz median": (0.70, 2.1),
}
DURATION_SHARE = 0.05
WORSE_SHARE = 0.05
# Of its cruise speed the tool keeps at a via point.
VIA_SPEED_SHARE = 0.5
# Deviations that normal noise exceeds once in 30,000 cases.
LIKELY = 4.0
REFINED_VIA: tuple[Via, ...] = (2, "stream")

Pair = tuple[float, float]


def prove(
    seed: int,
    tell: Callable[[str], None],
    *,
    arms: int = ARMS,
    effect_arms: int = EFFECT_ARMS,
    via: tuple[Via, ...] = VIA,
    rounds: int = ROUNDS,
    workers: int = WORKERS,
) -> dict[str, Any]:
    """Rows of medians and worst cases, and every bound that was broken."""
    began_s = time.monotonic()
    jobs = [Trial(seed * 1000 + k, via, rounds) for k in range(arms)]
    fast = [replace(job, via=("stream",), period_s=FAST_PERIOD_S) for job in jobs if "stream" in via]
    compared = tuple(one for one in via if one in REFINED_VIA)
    off = {
        effect: [replace(job, via=compared, spec=replace(job.spec, **changes)) for job in jobs[:effect_arms]]
        for effect, changes in limits.EFFECTS.items()
    }
    done = carry_out(line_trials.run, [*jobs, *fast, *(job for some in off.values() for job in some)], tell, workers)
    plain, quick, rest = done[:arms], done[arms : arms + len(fast)], done[arms + len(fast) :]
    rows = [row for one in map(str, via) for row in _rows(f"via {one}", [trial["via"][one] for trial in plain])]
    if quick:
        rows += _rows("via stream at 50 Hz", [trial["via"]["stream"] for trial in quick])
    violations = [
        f"{row['what']}: {row['mean_mm']:.2f}/{row['max_mm']:.2f} mm, bound {bound[0]:g}/{bound[1]:g}"
        for row in rows
        if (bound := BOUNDS_MM.get(row["what"])) is not None and (row["mean_mm"] > bound[0] or row["max_mm"] > bound[1])
    ]
    for trial in plain:
        for one, found in trial["via"].items():
            if abs(found["duration_s"] / line_trials.DURATION_S - 1.0) > DURATION_SHARE:
                violations.append(f"arm {trial['seed']}, via {one}: took {found['duration_s']:.2f} s")
            if (share := found["via_speed_ratio"]) < VIA_SPEED_SHARE:
                violations.append(f"arm {trial['seed']}, via {one}: at a via point {share:.2f} of its cruise speed")
    effects = []
    for index, effect in enumerate(off if effect_arms else ()):
        without = rest[index * effect_arms : (index + 1) * effect_arms]
        effects += [_effect(effect, str(one), plain[:effect_arms], without) for one in compared]
    return {
        "runs": len(done),
        "violations": violations,
        "rows": rows,
        "effects": effects,
        "unseen_mm": float(np.median([found["unseen_mm"] for trial in plain for found in trial["via"].values()])),
        "least_via_speed_ratio": min(found["via_speed_ratio"] for trial in plain for found in trial["via"].values()),
        "refused_lines": sum(len(trial["refused"]) for trial in plain),
        "seconds": time.monotonic() - began_s,
        "seed": seed,
    }


def prove_refinement(
    seed: int,
    tell: Callable[[str], None],
    *,
    arms: int = REFINED_ARMS,
    via: tuple[Via, ...] = REFINED_VIA,
    rounds: int = ROUNDS,
    workers: int = WORKERS,
) -> dict[str, Any]:
    """Rows of medians and worst cases, how often truth got worse, and everything that broke one of the three rules."""
    began_s = time.monotonic()
    jobs = [Trial(seed * 1000 + 500 + k, via, rounds) for k in range(arms)]
    done = carry_out(line_trials.run, jobs, tell, workers)
    all_found = [found for trial in done for found in trial["via"].values()]
    noise_mm = _repeat_noise([some for found in all_found for some in found["seen_mm"]])
    rows, violations = [], []
    for one in map(str, via):
        of_via = [trial["via"][one] for trial in done]
        ratios = np.array([found["final_mm"][0] / found["rounds_mm"][1][0] for found in of_via])
        rows += _rows(f"via {one}", of_via)
        rows.append(
            {
                "what": f"via {one}, outcome over round 1 by truth",
                "median_ratio": float(np.median(ratios)),
                "worst_ratio": float(ratios.max()),
                "share_over_5_percent": float(np.mean(ratios > 1.0 + WORSE_SHARE)),
                "share_better": float(np.mean(ratios < 1.0)),
                "rounds": float(np.mean([len(found["rounds_mm"]) - 1 for found in of_via])),
                "kept": float(np.mean([len(found["kept"]) for found in of_via])),
            }
        )
        violations += [
            f"arm {trial['seed']}, via {one}: {reason}"
            for trial in done
            for reason in worsened(trial["via"][one], noise_mm)
        ]
    return {
        "runs": len(done),
        "violations": violations,
        "rows": rows,
        "repeat_noise_mm": noise_mm,
        "true_repeat_noise_mm": _repeat_noise([some for found in all_found for some in found["repeat_true_mm"]]),
        "refused_lines": sum(len(trial["refused"]) for trial in done),
        "seconds": time.monotonic() - began_s,
        "seed": seed,
    }


def worsened(found: dict[str, Any], noise_mm: float) -> list[str]:
    """Which of the rules of refinement one outcome of a trial broke."""
    reasons = []
    before, first = (mean for mean, _ in found["rounds_mm"][:2])
    final, again = found["final_mm"][0], found["seen_again_mm"]
    if final > (1.0 + WORSE_SHARE) * before:
        reasons.append(f"ends at {final:.2f} mm, began at {before:.2f} mm")
    if final > (1.0 + WORSE_SHARE) * first + LIKELY * noise_mm:
        reasons.append(f"ends at {final:.2f} mm, round 1 had {first:.2f} mm")
    for number in found["kept"]:
        runs = found["seen_mm"][number]
        seen = float(np.median(runs))
        if again > seen + LIKELY * noise_mm * (1.0 + 1.0 / len(runs)) ** 0.5:
            reasons.append(f"the outcome looks like {again:.2f} mm, round {number} looked like {seen:.2f} mm")
    return reasons


def _repeat_noise(repeats: Sequence[Sequence[float]]) -> float:
    """Standard deviation within groups, over all groups."""
    squares = sum(len(some) * float(np.var(some)) for some in repeats)
    return float(np.sqrt(squares / max(1, sum(len(some) - 1 for some in repeats))))


def _rows(what: str, found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    of: dict[str, list[Pair]] = {
        "before": [one["rounds_mm"][0] for one in found],
        "first": [one["rounds_mm"][1] for one in found],
        "": [one["final_mm"] for one in found],
        "whole ticks alone": [one["tick_mm"] for one in found],
    }
    rows = []
    for stage, pairs in of.items():
        for name, pick in (("median", np.median), ("worst", np.max)):
            mean_mm, max_mm = pick(np.array(pairs), axis=0).tolist()
            rows.append({"what": " ".join(filter(None, (what, stage, name))), "mean_mm": mean_mm, "max_mm": max_mm})
    return rows


def _effect(
    effect: str, via: str, with_it: Sequence[dict[str, Any]], without: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Medians with everything, and with the effect switched off: before correction and after."""

    def median(trial: Sequence[dict[str, Any]], pick: Callable[[dict[str, Any]], Pair]) -> float:
        return float(np.median([pick(one["via"][via])[0] for one in trial]))

    return {
        "without": effect,
        "via": via,
        "before_mm": median(without, lambda one: one["rounds_mm"][0]),
        "before_with_mm": median(with_it, lambda one: one["rounds_mm"][0]),
        "after_mm": median(without, lambda one: one["final_mm"]),
        "after_with_mm": median(with_it, lambda one: one["final_mm"]),
    }
