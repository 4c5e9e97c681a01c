"""The straight-line experiment: before any correction, with the sag model, refined, repeated; and the GA beside it.

Round 0 is the plain plan on the arm as it is. Round 1 runs with the sag model's prediction, where there is one; later
rounds are corrected by what the ones before showed. The plan that was kept last is then run `repeats` times anew: those
runs are the experiment's rows, so that no lucky run stands for the plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.genetic.algorithm import PROFILES
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import refine
from armctl.lab.refine import Course, Line, Round
from armctl.lab.rig import Measured, Rig, VirtualRig
from armctl.lab.sag_model import SagModel
from armctl.trajectory.line_path import levers_m, line_paths
from armctl.trajectory.plan import Plan
from armctl.trajectory.straightness import distance_to_line, mean_error

Via = int | Literal["auto", "stream"]
Profile = Literal["default", "paper"]
"""Of the genetic algorithm."""
MOST_VIA = 20
AUTO_VIA = range(9)
TAKES = 5

Progress = Callable[[float, str], None]
Stage = Callable[[str, float], AbstractContextManager[Progress]]
"""Begins a stage of so many steps; what it yields is told how many are done."""


@contextmanager
def silent(_label: str, _total: float) -> Iterator[Progress]:
    """A stage nobody is told of."""
    yield lambda _done, _note: None


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one number of via points."""

    via: Via
    rounds: list[Round]
    """Round 0 is before any correction."""
    best: Round
    runs: list[Measured]
    """Of the plan that was kept last, anew."""


def experiment(
    rig: Rig,
    line: Line,
    via: Sequence[Via],
    *,
    repeats: int,
    rounds: int,
    seed: int,
    model: SagModel | None,
    stage: Stage,
    tolerance_mm: float = 1.0,
    ways: FloatArray | None = None,
) -> list[Outcome]:
    """One outcome for each entry of `via`, in order.

    Args:
        rounds: Corrections at most; 0: the plain plan alone.
        tolerance_mm: Mean error that `auto` asks for.
        ways: Joint positions along the line [rad], shape (ways, stations, n); None: they are drawn by the seed.
    Raises:
        RequestRefused: the line cannot be followed, or the arm stopped.
    """
    if ways is None:
        ways = drawn_ways(rig, line, seed)
    outcomes = []
    for one in via:
        count = choose_via(rig, line, model, ways, tolerance_mm) if one == "auto" else one
        points = None if count == "stream" else int(count)
        with stage(f"via {one}" if one != "auto" else f"via auto: {count}", 1 + rounds + repeats) as show:
            done = run_rounds(rig, line, points, rounds, seed, model, ways, show)
            best = refine.best_of(done)
            runs = []
            for repeat in range(repeats):
                runs.append(rig.run(best.plan))
                show(1 + rounds + repeat + 1, f"repeat {repeat + 1} of {repeats}")
        outcomes.append(Outcome(count, done, best, runs))
    return outcomes


def drawn_ways(rig: Rig, line: Line, seed: int) -> FloatArray:
    """Joint positions along the line [rad], shape (ways, stations, n).

    Raises:
        RequestRefused: the line cannot be followed.
    """
    rng = np.random.default_rng(seed)
    return line_paths(rig.arm, rig.robot, line.A, line.B, line.duration_s, rng, most=refine.DRAWN_WAYS)


def run_rounds(
    rig: Rig,
    line: Line,
    via: int | None,
    rounds: int,
    seed: int,
    model: SagModel | None,
    ways: FloatArray,
    show: Progress = lambda _done, _note: None,
) -> list[Round]:
    """Round 0 and the corrected ones; via None is a goal every tick."""

    def tell(one: Round) -> None:
        show(one.number + 1, f"round {one.number}: {one.filtered_mm:.2f} mm")

    before = refine.first_run(rig, refine.courses(rig, line, via, None, ways), model, seed)
    tell(before)
    if rounds == 0:
        return [replace(before, kept=True)]
    if model is None:
        return refine.refine(rig, before, rounds, tell)
    first = refine.first_run(rig, refine.courses(rig, line, via, model, ways), model, seed, 1)
    tell(first)
    if first.filtered_mm < before.filtered_mm:
        return [before, *refine.refine(rig, first, rounds - 1, tell)]
    # The model does harm: it is of another arm, or the arm has changed.
    start, *later = refine.refine(rig, before, rounds - 1, tell)
    return [start, first, *(replace(one, number=one.number + 1) for one in later)]


def choose_via(rig: Rig, line: Line, model: SagModel | None, ways: FloatArray, tolerance_mm: float) -> int:
    """The fewest via points whose plan is predicted to be as straight as wanted; the most there are, if none is."""
    for count in AUTO_VIA:
        course: Course = next(refine.courses(rig, line, count, model, ways))
        points = tool_position(rig.robot.chain, course.expected_rad)
        if float(mean_error(points, line.A, line.B)) * 1e3 + servo_floor_mm(rig, course) <= tolerance_mm:
            return count
    return AUTO_VIA[-1]


def servo_floor_mm(rig: Rig, course: Course) -> float:
    """What whole ticks and friction leave at the tool, whatever the plan."""
    line = course.line
    lever = levers_m(rig.robot.chain, course.expected_rad, line.A, line.B)
    return refine.SERVO_ERROR_RAD * float(np.sqrt((lever**2).sum(axis=-1).mean())) * 1e3


def unseen_mm(rig: Rig, plan: Plan) -> dict[str, float]:
    """What no encoder shows, estimated: zero offsets drawn evenly from within half a tick move the tool by so much."""
    n = rig.robot.chain.n
    q = np.array(plan.waypoints_rad)[:, :n]
    lever = levers_m(rig.robot.chain, q, np.array(plan.from_m), np.array(plan.to_m))
    rms = float(np.sqrt((lever**2).sum(axis=-1).mean())) * 1e3
    return {
        "zero_offset_mm": rms * TICK_RAD / np.sqrt(12.0),
        "per_degree_mm": rms * float(np.radians(1.0)),
    }


def row(line: Line, via: Via, rig: Rig, plan: Plan, runs: Sequence[Measured]) -> dict[str, Any]:
    """One row of the experiment: means over the runs, and their spread."""
    chain = rig.robot.chain
    by_encoder = np.array([errors_mm(tool_position(chain, run.positions_rad[:, : chain.n]), line) for run in runs])
    truths = [errors_mm(run.true_tool_m, line) for run in runs if run.true_tool_m is not None]
    result: dict[str, Any] = {
        "via": via,
        "mean_error_mm": float(by_encoder[:, 0].mean()),
        "max_error_mm": float(by_encoder[:, 1].mean()),
        "duration_s": float(np.mean([run.duration_s for run in runs])),
        "truth": None,
        "predicted_mean_error_mm": plan.predicted_mean_error_mm,
        "predicted_max_error_mm": plan.predicted_max_error_mm,
        "runs": len(runs),
        "spread": {
            "mean_error_mm": float(by_encoder[:, 0].std()),
            "max_error_mm": float(by_encoder[:, 1].std()),
        },
        "recordings": [run.recording for run in runs if run.recording],
    }
    if truths:
        true = np.array(truths)
        result["truth"] = {"mean_error_mm": float(true[:, 0].mean()), "max_error_mm": float(true[:, 1].mean())}
        result["spread"]["true_mean_error_mm"] = float(true[:, 0].std())
        result["spread"]["true_max_error_mm"] = float(true[:, 1].std())
    return result


def errors_mm(points: FloatArray, line: Line) -> tuple[float, float]:
    """Mean and largest distance of tool points to the line [mm]."""
    distance = distance_to_line(points, line.A, line.B) * 1e3
    return float(distance.mean()), float(distance.max())


def as_json(rig: Rig, line: Line, outcomes: Sequence[Outcome], model: SagModel | None) -> dict[str, Any]:
    """The outcomes in the terms of `armctl experiment line --json`."""
    most = max((one.rounds[-1].number for one in outcomes), default=0)
    refined = []
    for number in range(most + 1):
        rows = []
        for outcome in outcomes:
            for one in outcome.rounds:
                if one.number == number:
                    kept = {"kept": one.kept, "filtered_mm": one.filtered_mm}
                    rows.append(row(line, outcome.via, rig, one.plan, one.runs) | kept)
        refined.append({"round": number, "rows": rows})
    return {
        "rows": [row(line, one.via, rig, one.best.plan, one.runs or [one.best.measured]) for one in outcomes],
        "before": refined[0]["rows"] if refined else [],
        "refined": refined,
        "sag_model": None if model is None else {"lines": model.lines, "residual_tick": list(model.residual_tick)},
        "repeat_noise_mm": {str(one.via): refine.repeat_noise_mm(one.rounds) for one in outcomes},
        "unseen": {str(one.via): unseen_mm(rig, one.best.plan) for one in outcomes},
    }


def genetic(
    takes: Sequence[FloatArray], rig: Rig, line: Line, via: Sequence[Via], seed: int, profile: Profile = "default"
) -> tuple[dict[str, Any], FloatArray]:
    """What the genetic algorithm makes of recorded candidates, and its path [rad], shape (stations, n).

    Args:
        profile: "paper": the paper's operators and order, its genes are recorded ones and stay so.
    Raises:
        RequestRefused: the recordings are unfit; every reason.
    """
    counts = tuple(sorted({one for one in via if isinstance(one, int)}))
    result = optimize(
        takes,
        rig.arm,
        rig.robot,
        OptimizeRequest(
            from_m=tuple(line.A.tolist()),
            to_m=tuple(line.B.tolist()),
            via=counts,
            duration_s=line.duration_s,
            seed=seed,
            settings=PROFILES[profile],
            free=profile == "default",
        ),
    )
    ga, exact = result.ga, result.exact
    return {
        "profile": profile,
        "mean_error_mm": ga.path.mean_error_mm,
        "max_error_mm": ga.path.max_error_mm,
        "generations": ga.generations,
        "evaluations": ga.evaluations,
        "feasible": ga.path.feasible,
        "exact_mean_error_mm": exact.mean_error_mm,
        "gap_ratio": result.gap_ratio,
        "history": {"best_cost_mm": list(ga.best_cost_mm)},
        "baseline": [{"mean_error_mm": one.mean_error_mm, "max_error_mm": one.max_error_mm} for one in result.baseline],
        "plans": [
            {
                "via": plan.via,
                "predicted_mean_error_mm": plan.predicted_mean_error_mm,
                "predicted_max_error_mm": plan.predicted_max_error_mm,
            }
            for plan in result.plans
        ],
    }, ga.path.positions_rad[:, : rig.robot.chain.n]


def guided_takes(rig: VirtualRig, line: Line, seed: int, takes: int = TAKES) -> list[FloatArray] | None:
    """Recordings of the simulated hand guiding the limp arm along the line; None: its posture does not reach it all."""
    try:
        return [rig.teach(line.A, line.B, seed * 1000 + take) for take in range(takes)]
    except UnreachableTarget:
        return None


def check_via(via: Sequence[Via]) -> None:
    """
    Raises:
        RequestRefused: a number of via points is out of range.
    """
    reasons = [
        f"{one} via points wanted; give 0 to {MOST_VIA}, auto or stream"
        for one in via
        if isinstance(one, int) and not 0 <= one <= MOST_VIA
    ]
    if reasons or not via:
        raise RequestRefused("BAD_REQUEST", reasons or "no number of via points given")
