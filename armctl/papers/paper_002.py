"""002: the straight line of an AX-12A arm (`ax12-line`): Table II and Figs. 7 to 12 by the virtual experiment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.files import load_arm
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import calibrate_sag, line
from armctl.lab.refine import Line
from armctl.lab.rig import Measured, VirtualRig
from armctl.papers.page import PaperReport, Picture, Row
from armctl.papers.verdict import Effort, Stage, error
from armctl.report import kinematics as drawn
from armctl.report.line import PAPER_ROWS
from armctl.report.page import plotly
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory.straightness import distance_to_line, progress_along_line

if TYPE_CHECKING:
    import plotly.graph_objects as go

PAPER = "002"
FROM_M = (0.18, -0.125, 0.10)
TO_M = (0.18, 0.125, 0.10)
VIA = (0, 1, 2)
PERIOD_S = 0.1


@dataclass(frozen=True, eq=False)
class Experiment:
    """What the simulated arm did."""

    wanted: Line
    takes_m: tuple[FloatArray, ...]
    """Tool paths of the guided candidates."""
    before: dict[int, Measured]
    """By number of via points, before any correction."""
    after: dict[int, list[Measured]]
    duration_s: dict[int, float]
    ga: dict[str, Any] | None
    ga_tool_m: FloatArray | None


def experiment(effort: Effort, seed: int, stage: Stage) -> tuple[VirtualRig, Experiment]:
    """Guide candidates, optimise them, run 0, 1 and 2 via points, correct, repeat; all in virtual time."""
    arm = load_arm("ax12-line")
    rig = VirtualRig(SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC), PERIOD_S)
    durations = {via: PAPER_ROWS[via][2] for via in VIA}
    wanted = Line(np.array(FROM_M), np.array(TO_M), durations[0])
    with stage("002: guiding by hand", 1):
        takes = line.guided_takes(rig, wanted, seed)
    ga = path = None
    if takes:
        with stage("002: genetic algorithm", 1):
            ga, path = line.genetic(takes, rig, wanted, VIA, seed)
    model = None
    if effort.rounds:
        with stage("002: calibration lines", calibrate_sag.LINES) as show:
            model = calibrate_sag.identify(rig, np.random.default_rng(seed), show=lambda done: show(done, ""))
    before, after = {}, {}
    for via in VIA:
        timed = Line(wanted.A, wanted.B, durations[via])
        outcome = line.experiment(
            rig, timed, [via], repeats=effort.repeats, rounds=effort.rounds, seed=seed, model=model, stage=stage
        )[0]
        before[via], after[via] = outcome.rounds[0].measured, outcome.runs
    chain = rig.robot.chain
    return rig, Experiment(
        wanted,
        tuple(tool_position(chain, take[:, : chain.n]) for take in takes or ()),
        before,
        after,
        {via: float(np.mean([run.duration_s for run in runs])) for via, runs in after.items()},
        ga,
        None if path is None else tool_position(chain, path),
    )


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    rig, done = experiment(effort, seed, stage)
    rows = [row for via in VIA for row in _rows(done, via, effort)]
    pictures = [
        Picture("Figs. 7 and 8: initial population", "tool paths guided by hand", lambda: _takes_figure(done)),
        *(_experiment_picture(done, via) for via in VIA),
        Picture("Fig. 12: comparison", "mean and maximum error beside print", lambda: _bars(done)),
    ]
    return PaperReport(PAPER, "a straight line with an AX-12A arm", _notes(rig, done), tuple(rows), (), tuple(pictures))


def _experiment_picture(done: Experiment, via: int) -> Picture:
    described = f"distance from the line along the path with {via} via points"
    return Picture(f"Fig. {9 + via}: experiment {via + 1}", described, lambda: _deviation(done, via))


def _notes(rig: VirtualRig, done: Experiment) -> tuple[str, ...]:
    notes = [
        f"One simulated arm drawn by the seed ({rig.arm.arm_id}) and one line, lengths chosen here (print has none), "
        f"from {FROM_M} to {TO_M} m in the paper's times, sampled each 100 ms. The error is that of the tool's true "
        "place; the paper's is by the encoders. Before: the interpolated plan as it is. After: with the sag model and "
        "the corrections learnt from what the encoders saw.",
    ]
    if done.ga is not None:
        notes.append(
            f"Genetic algorithm over {len(done.takes_m)} guided recordings: mean {done.ga['mean_error_mm']:.3f} mm "
            f"over the recorded genes, {done.ga['gap_ratio']:.2%} above the exact optimum of the same problem."
        )
    return tuple(notes)


def _rows(done: Experiment, via: int, effort: Effort) -> list[Row]:
    mean_mm, max_mm, time_s = PAPER_ROWS[via]
    name = f"Table II, experiment {via + 1}"
    why = {0: "it swings an arc without a via point, and sags"}.get(via, "an uncorrected arm sags")
    found = [("before", _errors_mm(done, [done.before[via]]))]
    if effort.rounds:
        found.append(("after", _errors_mm(done, done.after[via])))
    rows = []
    for when, (mean, most) in found:
        rows.append(error(PAPER, f"{name}, mean error, {when}", mean_mm, mean, "mm", why=why))
        rows.append(error(PAPER, f"{name}, maximum error, {when}", max_mm, most, "mm", why=why))
    took = done.duration_s[via]
    verdict = "equal" if abs(took - time_s) < 0.05 else f"differs: the arm needs {took:.1f} s for this plan"
    return [*rows, Row(PAPER, f"{name}, time (asked for as printed)", time_s, took, "s", verdict)]


def _errors_mm(done: Experiment, runs: list[Measured]) -> tuple[float, float]:
    """Mean and maximum distance of the tool's true place from the line [mm], averaged over runs."""
    found = [line.errors_mm(run.true_tool_m, done.wanted) for run in runs if run.true_tool_m is not None]
    mean, most = np.array(found).mean(axis=0).tolist()
    return mean, most


def _takes_figure(done: Experiment) -> go.Figure:
    figure = plotly()()
    for k, take in enumerate(done.takes_m):
        _add_path(figure, take, done, f"recording {k + 1}", drawn.COLOURS[3], 1)
    if done.ga_tool_m is not None:
        _add_path(figure, done.ga_tool_m, done, "genetic algorithm", drawn.COLOURS[2], 3)
    _label(figure)
    return figure


def _deviation(done: Experiment, via: int) -> go.Figure:
    figure = plotly()()
    before = done.before[via].true_tool_m
    if before is not None:
        _add_path(figure, before, done, "before correction", drawn.COLOURS[0], 2)
    for k, run in enumerate(done.after[via]):
        if run.true_tool_m is not None:
            _add_path(figure, run.true_tool_m, done, f"final plan, run {k + 1}", drawn.COLOURS[2], 2)
    figure.add_hline(y=PAPER_ROWS[via][0], line={"dash": "dot", "color": "#888"}, annotation_text="mean in print")
    _label(figure)
    return figure


def _add_path(figure: go.Figure, points: FloatArray, done: Experiment, name: str, colour: str, width: int) -> None:
    A, B = done.wanted.A, done.wanted.B
    along = progress_along_line(points, A, B) * float(np.linalg.norm(B - A)) * 1e3
    away = distance_to_line(points, A, B) * 1e3
    figure.add_scatter(x=along, y=away, mode="lines", name=name, line={"color": colour, "width": width})


def _label(figure: go.Figure) -> None:
    figure.update_layout(xaxis_title="along the line [mm]", yaxis_title="distance from the line [mm]", height=380)


def _bars(done: Experiment) -> go.Figure:
    figure = plotly()()
    names = [f"experiment {via + 1}" for via in VIA]
    before = [_errors_mm(done, [done.before[via]]) for via in VIA]
    after = [_errors_mm(done, done.after[via]) for via in VIA]
    for k, what in enumerate(("mean", "maximum")):
        for who, values, colour in (
            ("print", [PAPER_ROWS[via][k] for via in VIA], drawn.COLOURS[5]),
            ("before", [pair[k] for pair in before], drawn.COLOURS[0]),
            ("final plan", [pair[k] for pair in after], drawn.COLOURS[2]),
        ):
            opacity = 1.0 if k == 0 else 0.55
            figure.add_bar(x=names, y=values, name=f"{what}, {who}", marker={"color": colour, "opacity": opacity})
    figure.update_layout(yaxis_title="distance from the line [mm]", height=420)
    return figure
