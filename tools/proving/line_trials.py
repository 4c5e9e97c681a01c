"""The straight line on many simulated arms, each drawn at random and unlike what the planner assumes.

One trial: an arm whose masses, friction, stall torques, play and zero offsets its seed draws, eight calibration lines,
one random line, and the experiment on it for every number of via points, judged by the true tool pose.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.course import Via
from armctl.lab.line_experiment import Budget, drawn_ways, experiment
from armctl.lab.line_results import true_mm, unseen_mm
from armctl.lab.rig import VirtualRig
from armctl.lab.sag_identification import identify, random_line
from armctl.lab.stage import silent
from armctl.lab.study.limits import tick_floor_mm
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.course import Line
from armctl.trajectory.interpolate import RAMP, time_of_progress
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import Measured, seen_mm

ARM = "ax12-line"
DURATION_S = 5.0
# How far out a trial's line may lead, of the stretched arm: farther out the weakest motors cannot lift it.
STRETCH = 0.85
# Codes of refusals that say of a line that this arm cannot follow or lift it: another one is drawn.
REFUSED_LINES = ("LINE", "PREFLIGHT", "LIMIT", "TOO_HEAVY")
# A tick: within one, stiction lets a slow joint start and stop.
SPEED_SPAN_S = 0.1


@dataclass(frozen=True)
class Trial:
    """One arm and line."""

    seed: int
    via: tuple[Via, ...]
    rounds: int = 5
    period_s: float = 0.1
    spec: ArmSpec = RANDOM_SPEC


def run(trial: Trial) -> dict[str, Any]:
    """The true errors of a trial: for each `via` those of every round, and those of the best plan run anew.

    `seen_mm` is what the rounds were compared by, run by run, and `seen_again_mm` the same of the new run.
    """
    rng = np.random.default_rng(trial.seed)
    rig = VirtualRig(SimulatedArm(load_arm(ARM), seed=trial.seed, spec=trial.spec), trial.period_s)
    model = identify(rig, rng)
    refused = []
    while True:
        A, B = random_line(rig, rng, stretch=STRETCH)
        wanted = Line(A, B, DURATION_S)
        try:
            ways = drawn_ways(rig, wanted, trial.seed)
            outcomes = experiment(rig, wanted, trial.via, Budget(trial.rounds, 1, trial.seed), model, ways, silent)
            break
        except RequestRefused as refusal:
            if refusal.code not in REFUSED_LINES:
                raise
            refused.append(str(refusal))
    chain = rig.robot.chain
    return {
        "seed": trial.seed,
        "from_m": A.tolist(),
        "to_m": B.tolist(),
        "refused": refused,
        "residual_tick": list(model.residual_tick),
        "via": {
            str(outcome.via): {
                "rounds_mm": [_mean([true_mm(run, wanted) for run in one.runs]) for one in outcome.rounds],
                "kept": [one.number for one in outcome.rounds if one.kept],
                "seen_mm": [list(one.run_mm) for one in outcome.rounds],
                "seen_again_mm": seen_mm(rig, outcome.best, outcome.runs[0]),
                "repeat_true_mm": [[true_mm(run, wanted)[0] for run in one.runs] for one in outcome.rounds],
                "final_mm": true_mm(outcome.runs[0], wanted),
                "encoder_mm": wanted.errors_mm(tool_position(chain, outcome.runs[0].positions_rad[:, : chain.n])),
                "duration_s": outcome.runs[0].duration_s,
                "tick_mm": tick_floor_mm(rig, outcome.best, wanted),
                "unseen_mm": unseen_mm(rig, outcome.best.plan)["zero_offset_mm"],
                "via_speed_ratio": via_speed_ratio(outcome.best.plan, outcome.runs[0]),
            }
            for outcome in outcomes
        },
    }


def via_speed_ratio(plan: Plan, run: Measured) -> float:
    """How fast the true tool passes the via point where it is slowest, over its cruise speed.

    The cruise speed is the median of the middle, where the time law is constant, and only via points in it count: at
    the ends the tool speeds up and slows down as it should. Speeds are means over `SPEED_SPAN_S`; 1.0 without points.
    """
    true_time_s, true_tool_m = run.true_time_s, run.true_tool_m
    assert true_time_s is not None
    assert true_tool_m is not None
    via_s = time_of_progress(np.array(plan.waypoint_progress[1:-1])) * plan.duration_s
    begin_s, end_s = RAMP * plan.duration_s, (1.0 - RAMP) * plan.duration_s
    inside = via_s[(via_s >= begin_s) & (via_s <= end_s)]
    if not len(inside):
        return 1.0

    def speed_m_s(time_s: FloatArray) -> FloatArray:
        ends = [
            np.stack([np.interp(time_s + half, true_time_s, column) for column in true_tool_m.T], axis=1)
            for half in (-SPEED_SPAN_S / 2.0, SPEED_SPAN_S / 2.0)
        ]
        return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1) / SPEED_SPAN_S)

    cruise_m_s = np.median(speed_m_s(np.linspace(begin_s, end_s, 301)))
    return float(speed_m_s(inside).min() / cruise_m_s)


def _mean(errors: list[tuple[float, float]]) -> tuple[float, float]:
    mean, most = np.mean(errors, axis=0).tolist()
    return mean, most
