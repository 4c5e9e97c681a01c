"""The straight line on many simulated arms, each drawn at random and unlike what the planner assumes.

One trial: an arm whose masses, friction, stall torques, play and zero offsets its seed draws, eight calibration lines,
one random line, and the experiment on it for every number of via points, judged by the true tool pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import calibrate_sag, line, refine
from armctl.lab.line import Via
from armctl.lab.rig import Measured, VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.interpolate import RAMP, time_law, time_of_progress
from armctl.trajectory.line_path import onto
from armctl.trajectory.plan import Plan, plan_positions

ARM = "ax12-line"
DURATION_S = 5.0
STRETCH = 0.85
"""How far out a trial's line may lead, of the stretched arm: farther out the weakest motors cannot lift it."""
REFUSED_LINES = ("LINE", "PREFLIGHT", "LIMIT", "TOO_HEAVY")
"""Codes of refusals that say of a line that this arm cannot follow or lift it: another one is drawn."""
SPEED_SPAN_S = 0.1
"""A tick: within one, stiction lets a slow joint start and stop."""
EFFECTS: dict[str, dict[str, Any]] = {
    "sag": {"servo_kg": 0.0, "bracket_kg": 0.0, "tool_kg": (0.0, 0.0)},
    "friction": {"friction_Nm": (0.0, 0.0)},
    "backlash": {"play_deg": (0.0, 0.0)},
    "noise": {"noise_tick": 0.0},
    "offset": {"zero_offset_within_tick": 0.0},
}
"""What of the specification switches one effect off."""


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
    model = calibrate_sag.identify(rig, rng)
    refused = []
    while True:
        A, B = calibrate_sag.random_line(rig, rng, stretch=STRETCH)
        wanted = refine.Line(A, B, DURATION_S)
        try:
            outcomes = line.experiment(
                rig,
                wanted,
                trial.via,
                repeats=1,
                rounds=trial.rounds,
                seed=trial.seed,
                model=model,
                stage=line.silent,
            )
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
                "seen_again_mm": refine.seen_mm(rig, outcome.best, outcome.runs[0]),
                "repeat_true_mm": [[true_mm(run, wanted)[0] for run in one.runs] for one in outcome.rounds],
                "final_mm": true_mm(outcome.runs[0], wanted),
                "encoder_mm": line.errors_mm(tool_position(chain, outcome.runs[0].positions_rad[:, : chain.n]), wanted),
                "duration_s": outcome.runs[0].duration_s,
                "tick_mm": tick_floor_mm(rig, outcome.best, wanted),
                "unseen_mm": line.unseen_mm(rig, outcome.best.plan)["zero_offset_mm"],
                "via_speed_ratio": via_speed_ratio(outcome.best.plan, outcome.runs[0]),
            }
            for outcome in outcomes
        },
    }


def tick_floor_mm(rig: VirtualRig, best: refine.Round, wanted: refine.Line) -> tuple[float, float]:
    """What whole ticks alone would cost on perfect servos: the goals rounded, straight joint lines in between."""
    chain = rig.robot.chain
    time_s = np.linspace(0.0, wanted.duration_s, 10 * (refine.rows_of(wanted, rig.period_s) - 1) + 1)
    goals = plan_positions(best.plan, time_s)[:, : chain.n]
    whole = refine.sent_rad(rig.arm, goals[::10])
    between = np.stack([np.interp(time_s, time_s[::10], column) for column in (whole - goals[::10]).T], axis=1)
    straight = onto(chain, _along(wanted, time_s), goals, _anywhere(chain.n), 12)[0]
    return line.errors_mm(tool_position(chain, straight + between), wanted)


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


def _along(wanted: refine.Line, time_s: FloatArray) -> FloatArray:
    return wanted.A + time_law(time_s / wanted.duration_s)[:, None] * (wanted.B - wanted.A)


def _anywhere(n: int) -> FloatArray:
    return np.tile([-np.pi, np.pi], (n, 1))


def _mean(errors: list[tuple[float, float]]) -> tuple[float, float]:
    mean, most = np.mean(errors, axis=0).tolist()
    return mean, most


def true_mm(measured: Measured, wanted: refine.Line) -> tuple[float, float]:
    assert measured.true_tool_m is not None
    return line.errors_mm(measured.true_tool_m, wanted)
