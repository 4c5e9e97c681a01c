"""How straight lines of every class come out, by the true tool path, on arms drawn at random.

One trial: an arm, its model from calibration lines, and a line of each class. The first run is the job's: the plan that
the package makes of the line, run with correction on an arm that has only just been switched on. Then every number of
via points is refined. Lines are drawn again where the judge finds no way of the arm along them; where the package
refuses one that the judge finds within reach, that is told by its code.

| row | bounds: mean/max of the true distance from the line [mm] |
|-|-|
| first run, n=2 | median of every class; 95 % of all runs |
| refined, each n | median of every class, and for n=2 and a stream the worst |

No encoder shows zeros that are off by up to half a tick: what they alone move the tool across the line stands beside
each row (`unseen_mm`), as does the distance from the path's own best straight line (`chord_mm`).
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from armctl.errors import RequestRefused
from armctl.lab import correction
from armctl.lab.course import Via, courses
from armctl.lab.line_experiment import Budget, drawn_ways, experiment
from armctl.lab.stage import silent
from armctl.messages import LagModel
from armctl.trajectory.course import Line
from proving.served_arm import ServedArm, identified
from proving.truth import CLASSES, Drawn, covered, off_chord_mm, off_line_mm, within
from proving.workers import WORKERS, carry_out

ARMS = 20
VIA: tuple[Via, ...] = (1, 2, 8, "stream")
FIRST_VIA = 2
ROUNDS = 5
DURATION_S = 5.0
DURATION_SHARE = 0.05
# A path that leaves out more of its line is not that line.
COVERED = (0.93, 1.07)
# What the package may say of a line: another one is drawn, and it is told how often.
REFUSED = ("LINE", "PREFLIGHT", "LIMIT", "TOO_HEAVY")
MOST_REFUSED = 30


class Bound(NamedTuple):
    """Mean and maximum that may not be exceeded [mm]; None: nothing is said."""

    median: tuple[float, float] | None = None
    share: tuple[float, float] | None = None
    worst: tuple[float, float] | None = None

    def __str__(self) -> str:
        named = (("median", self.median), ("95 %", self.share), ("worst", self.worst))
        return ", ".join(f"{name} {pair[0]:g}/{pair[1]:g}" for name, pair in named if pair)


FIRST, FIRST_OF_ALL = Bound((1.2, 2.8)), Bound(share=(2.0, 4.7))
REFINED: dict[Via, Bound] = {
    1: Bound((1.2, 3.0)),
    2: Bound((0.9, 2.4), worst=(1.6, 4.2)),
    8: Bound((0.8, 2.2)),
    "stream": Bound((0.75, 2.0), worst=(1.5, 4.0)),
}


@dataclass(frozen=True)
class Trial:
    """One arm, and which lines it draws."""

    seed: int
    classes: tuple[str, ...] = CLASSES
    # Refined; none: the first run alone.
    via: tuple[Via, ...] = VIA
    correction: bool = True


def refine(rig: ServedArm, line: Line, via: Via, model: LagModel, seed: int) -> None:
    """Refine a line as the package has it done today; the last run is that of what came out."""
    experiment(rig, line, (via,), Budget(ROUNDS, 1, seed), model, drawn_ways(rig, line, seed), silent)


def first(rig: ServedArm, line: Line, via: int, seed: int, model: LagModel) -> None:
    """One run of the plan that the package makes of a line."""
    candidates = courses(rig, line, via, drawn_ways(rig, line, seed))
    correction.first_run(rig, candidates, model, seed, corrected=rig.arm.correction)


def run(trial: Trial) -> dict[str, Any]:
    """What the true tool did on every line of a trial, how many lines were drawn in vain, and what was refused why."""
    lines = [_of_class(trial, kind, identified(trial.seed)) for kind in trial.classes]
    return {"seed": trial.seed, "lines": lines}


def _of_class(trial: Trial, kind: str, model: LagModel) -> dict[str, Any]:
    rng = np.random.default_rng((trial.seed, CLASSES.index(kind), 17))
    refused: list[str] = []
    beyond = 0
    while len(refused) < MOST_REFUSED:
        arm = ServedArm(trial.seed, correction=trial.correction, model=model)
        drawn = arm.truly.line(kind, rng)
        beyond += drawn.beyond
        found: dict[str, Any] = {"class": kind, "runs": {}, "broken": [], "beyond": beyond, "refused": refused}
        line = Line(drawn.A, drawn.B, DURATION_S)
        try:
            first(arm, line, FIRST_VIA, trial.seed, model)
            found["runs"]["first"] = _judged(arm, drawn)
            for via in trial.via:
                again = ServedArm(trial.seed, correction=trial.correction, model=model)
                refine(again, line, via, model, trial.seed)
                found["runs"][str(via)] = _judged(again, drawn)
        except RequestRefused as refusal:
            if refusal.code in REFUSED:
                refused.append(refusal.code)
                continue
            found["broken"].append(f"{drawn.A.round(3).tolist()} to {drawn.B.round(3).tolist()}: {refusal}")
        return found
    return {"class": kind, "runs": {}, "broken": ["no line is let through"], "beyond": beyond, "refused": refused}


def _judged(arm: ServedArm, drawn: Drawn) -> dict[str, Any]:
    """The last motion of an arm beside the line it was to draw."""
    A, B, path = drawn.A, drawn.B, arm.path_m
    off = off_line_mm(path, A, B)
    return {
        "mean_mm": float(off.mean()),
        "max_mm": float(off.max()),
        "chord_mm": float(off_chord_mm(path).mean()),
        "covered": covered(path, A, B),
        "late": (arm.took_s / DURATION_S) - 1.0,
        "unseen_mm": arm.truly.unseen_mm(drawn.way_rad, A, B),
    }


def prove(
    seed: int,
    tell: Callable[[str], None],
    *,
    arms: int = ARMS,
    classes: Sequence[str] = CLASSES,
    via: tuple[Via, ...] = VIA,
    workers: int = WORKERS,
    correction: bool = True,
) -> dict[str, Any]:
    """A row for each class and number of via points, and every bound that was broken."""
    began_s = time.monotonic()
    trials = [Trial(seed * 1000 + k, tuple(classes), via, correction=correction) for k in range(arms)]
    done = carry_out(run, trials, tell, workers)
    lines = [line | {"seed": one["seed"]} for one in done for line in one["lines"]]
    rows = [_row(lines, "all", "first", FIRST_OF_ALL)]
    for kind in classes:
        of_class = [line for line in lines if line["class"] == kind]
        rows.append(_row(of_class, kind, "first", FIRST))
        rows += [_row(of_class, kind, str(one), REFINED[one]) for one in via]
    violations = [
        f"{row['class']}, {row['run']}, n={row['n']}: median {row['median_mm']}, 95 % {row['share_mm']}, worst "
        f"{row['worst_mm']} mm, bound {row['bound']}"
        for row in rows
        if not row["held"]
    ]
    for line in lines:
        where = f"arm {line['seed']}, {line['class']}"
        violations += [f"{where}: {text}" for text in line["broken"]]
        violations += [f"{where}, {name}: {why}" for name, found in line["runs"].items() for why in astray(found)]
    return {
        "runs": sum(len(line["runs"]) for line in lines),
        "violations": violations,
        "rows": rows,
        "drawn_again": [_again([line for line in lines if line["class"] == kind], kind) for kind in classes],
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }


def astray(found: dict[str, Any]) -> list[str]:
    """Why a run was not the motion that was asked for, however straight it is."""
    reasons = []
    if not COVERED[0] <= found["covered"] <= COVERED[1]:
        reasons.append(f"its path covers {found['covered']:.2f} of the line")
    if abs(found["late"]) > DURATION_SHARE:
        reasons.append(f"took {100.0 * found['late']:+.0f} % of its time longer")
    return reasons


def _row(lines: Sequence[dict[str, Any]], kind: str, name: str, bound: Bound) -> dict[str, Any]:
    """One class and number of via points: pairs are mean and maximum [mm]."""
    runs = [line["runs"][name] for line in lines if name in line["runs"]]
    row: dict[str, Any] = {
        "class": kind,
        "n": FIRST_VIA if name == "first" else name,
        "run": "first" if name == "first" else "refined",
        "lines": len(runs),
        "bound": str(bound),
        "held": False,
    }
    if not runs:
        return row | {"median_mm": "-", "share_mm": "-", "worst_mm": "-"}
    columns = [[run[key] for run in runs] for key in ("mean_mm", "max_mm")]
    median, share, worst = (
        [of(column) for column in columns] for of in (statistics.median, lambda values: within(values, 0.95), max)
    )
    held = all(
        figure <= most
        for figures, bounds in ((median, bound.median), (share, bound.share), (worst, bound.worst))
        for figure, most in zip(figures, bounds or figures, strict=True)
    )
    return row | {
        "median_mm": _pair(median),
        "share_mm": _pair(share),
        "worst_mm": _pair(worst),
        "held": held,
        "chord_mm": round(statistics.median(run["chord_mm"] for run in runs), 2),
        "unseen_mm": round(statistics.median(run["unseen_mm"] for run in runs), 2),
    }


def _again(lines: Sequence[dict[str, Any]], kind: str) -> dict[str, Any]:
    """How many lines of a class were drawn in vain."""
    beyond, refused = sum(line["beyond"] for line in lines), [code for line in lines for code in line["refused"]]
    drawn = beyond + len(refused) + len(lines)
    counts = {code: refused.count(code) for code in REFUSED if code in refused}
    return {
        "class": kind,
        "share": round((beyond + len(refused)) / max(1, drawn), 3),
        "beyond": beyond,
        "refused": counts,
    }


def _pair(figures: Sequence[float]) -> str:
    return "/".join(f"{figure:.2f}" for figure in figures)
