"""What a straight-line experiment found: as rows of numbers, and as a page draws it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.json_text import named
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.course import Via
from armctl.lab.rig import Rig
from armctl.messages import LagModel
from armctl.report.line import DrawnOutcome, LineRun
from armctl.trajectory import straightness
from armctl.trajectory.course import Line
from armctl.trajectory.line_path import levers_m
from armctl.trajectory.plan import Plan, plan_positions
from armctl.trajectory.refinement import Measured, Round, repeat_noise_mm

PREDICTED_POINTS = 201


class Outcome(NamedTuple):
    """What became of one number of via points."""

    via: Via
    # Round 0 is before any correction.
    rounds: list[Round]
    best: Round
    # Of the plan that was kept last, run anew.
    runs: list[Measured]


def row(line: Line, via: Via, rig: Rig, plan: Plan, runs: Sequence[Measured]) -> dict[str, Any]:
    """One row of the experiment: means over the runs, and their spread."""
    chain = rig.robot.chain
    by_encoder = np.array([line.errors_mm(tool_position(chain, run.positions_rad[:, : chain.n])) for run in runs])
    paths_m = [run.true_tool_m for run in runs if run.true_tool_m is not None]
    true, own = (np.array([of(tool_m) for tool_m in paths_m]) for of in (line.errors_mm, straightness.own_chord_mm))

    # Column by column: sums over rows of pairs would round otherwise.
    def both(of: Callable[[FloatArray], Any], errors: FloatArray, prefix: str = "") -> dict[str, float]:
        names = f"{prefix}mean_error_mm", f"{prefix}max_error_mm"
        return dict(zip(names, (float(of(column)) for column in errors.T), strict=True))

    result: dict[str, Any] = {
        "via": via,
        **both(np.mean, by_encoder),
        "duration_s": float(np.mean([run.duration_s for run in runs])),
        "truth": both(np.mean, true) if len(true) else None,
        "own_chord": both(np.mean, own) if len(own) else None,
        **named(plan, "predicted_mean_error_mm", "predicted_max_error_mm"),
        "runs": len(runs),
        "spread": both(np.std, by_encoder),
        "recordings": [run.recording for run in runs if run.recording],
    }
    if len(true):
        result["spread"] |= both(np.std, true, "true_")
    return result


def true_mm(measured: Measured, line: Line) -> tuple[float, float]:
    """Mean and largest distance of the tool's real path from the line [mm]; known of a simulated arm only."""
    assert measured.true_tool_m is not None
    return line.errors_mm(measured.true_tool_m)


def rms_lever_m(chain: SerialChain, q: FloatArray, A: FloatArray, B: FloatArray) -> float:
    """How far the tool goes off the line AB for a turn of every joint by a radian at random, root mean square [m]."""
    return float(np.sqrt((levers_m(chain, q, A, B) ** 2).sum(axis=-1).mean()))


def unseen_mm(rig: Rig, plan: Plan) -> dict[str, float]:
    """An estimate of what no encoder shows: how far zero offsets of up to half a tick, evenly spread, move the tool."""
    q = np.array(plan.waypoints_rad)[:, : rig.robot.chain.n]
    rms_mm = rms_lever_m(rig.robot.chain, q, np.array(plan.from_m), np.array(plan.to_m)) * 1e3
    return {"zero_offset_mm": rms_mm * TICK_RAD / np.sqrt(12.0), "per_degree_mm": rms_mm * float(np.radians(1.0))}


def as_json(rig: Rig, line: Line, outcomes: Sequence[Outcome], model: LagModel | None) -> dict[str, Any]:
    """The outcomes in the terms of `armctl experiment line --json`."""
    refined: dict[int, list[dict[str, Any]]] = {}
    for outcome in outcomes:
        for found in outcome.rounds:
            told = {"kept": found.kept, "filtered_mm": found.filtered_mm}
            refined.setdefault(found.number, []).append(row(line, outcome.via, rig, found.plan, found.runs) | told)
    return {
        "rows": [row(line, one.via, rig, one.best.plan, one.runs) for one in outcomes],
        "before": refined[0],
        "refined": [{"round": number, "rows": rows} for number, rows in sorted(refined.items())],
        "sag_model": None if model is None else {"lines": model.lines, "residual_tick": list(model.residual_tick)},
        "repeat_noise_mm": {str(one.via): repeat_noise_mm(one.rounds) for one in outcomes},
        "unseen": {str(one.via): unseen_mm(rig, one.best.plan) for one in outcomes},
    }


def drawn(rig: Rig, outcome: Outcome) -> DrawnOutcome:
    """The outcome as a page draws it."""

    def of(plan: Plan, run: Measured) -> LineRun:
        return line_run(rig.robot.chain, outcome.via, plan, run)

    rounds = [of(one.plan, one.measured) for one in outcome.rounds]
    return DrawnOutcome(outcome.via, rounds[0], [of(outcome.best.plan, run) for run in outcome.runs], rounds)


def line_run(chain: SerialChain, via: Via, plan: Plan, measured: Measured) -> LineRun:
    """One execution of a plan as a page draws it."""

    def tool_m(q: FloatArray) -> FloatArray:
        return tool_position(chain, q[:, : chain.n])

    return LineRun(
        via=via,
        duration_s=measured.duration_s,
        predicted_mean_mm=plan.predicted_mean_error_mm,
        predicted_max_mm=plan.predicted_max_error_mm,
        predicted_tool_m=tool_m(plan_positions(plan, np.linspace(0.0, plan.duration_s, PREDICTED_POINTS))),
        via_tool_m=tool_m(np.array(plan.waypoints_rad)[1:-1]),
        time_s=measured.time_s,
        positions_rad=measured.positions_rad,
        goals_rad=plan_positions(plan, np.clip(measured.time_s, 0.0, plan.duration_s)),
        tool_m=tool_m(measured.positions_rad),
        truth_tool_m=measured.true_tool_m,
    )
