"""002: the straight line of an AX-12A arm (`ax12-line`): Table II and Figs. 7 to 12 by the virtual experiment."""

from functools import partial

import numpy as np

from armctl.files import load_arm
from armctl.kinematics.transform import FloatArray
from armctl.lab.stage import Stage
from armctl.lab.table_ii import FROM_M, TO_M, VIA, Corrected, corrected
from armctl.papers.page import PaperReport, Picture, Row
from armctl.papers.transcription import introduced
from armctl.papers.verdict import Effort, error
from armctl.report import kinematics as drawn
from armctl.report.line import PRINTED
from armctl.report.page import Figure, axes
from armctl.trajectory.straightness import distance_to_line, progress_along_line

ALONG_AND_AWAY = ("along the line [mm]", "distance from the line [mm]")


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    done = corrected(load_arm("ax12-line"), effort.rounds, effort.repeats, seed, stage)
    rows = [row for via in VIA for row in _rows(done, via, effort)]
    pictures = [
        Picture("Figs. 7 and 8: initial population", "tool paths guided by hand", lambda: _takes_figure(done)),
        *(
            Picture(
                f"Fig. {9 + via}: experiment {via + 1}",
                f"distance from the line along the path with {via} via points",
                partial(_deviation, done, via),
            )
            for via in VIA
        ),
        Picture("Fig. 12: comparison", "mean and maximum error beside print", lambda: _bars(done)),
    ]
    told = introduced(
        "002",
        arm_id=done.arm_id,
        from_m=FROM_M,
        to_m=TO_M,
        takes=len(done.takes_m),
        mean_error_mm=done.optimum.ga.path.mean_error_mm,
        gap_ratio=done.optimum.gap_ratio,
    )
    return PaperReport(*told, tuple(rows), (), tuple(pictures))


def _rows(done: Corrected, via: int, effort: Effort) -> list[Row]:
    mean_mm, max_mm, time_s = PRINTED[via]
    name = f"Table II, experiment {via + 1}"
    why = {0: "it swings an arc without a via point, and sags"}.get(via, "an uncorrected arm sags")
    rows, told = [], {"before": done.before[via]}
    if effort.rounds:
        told["after"] = done.after[via]
    for when, runs in told.items():
        mean, most = done.errors_mm(runs)
        rows.append(error(f"{name}, mean error, {when}", mean_mm, mean, "mm", why=why))
        rows.append(error(f"{name}, maximum error, {when}", max_mm, most, "mm", why=why))
    took = float(np.mean([run.duration_s for run in done.after[via]]))
    verdict = "equal" if abs(took - time_s) < 0.05 else f"differs: the arm needs {took:.1f} s for this plan"
    return [*rows, Row(f"{name}, time (asked for as printed)", time_s, took, "s", verdict)]


def _takes_figure(done: Corrected) -> Figure:
    figure = axes(*ALONG_AND_AWAY, 380)
    for k, take in enumerate(done.takes_m):
        _add_path(figure, take, done, f"recording {k + 1}", drawn.COLOURS[3], 1)
    _add_path(figure, done.optimum.ga.path.tool_m, done, "genetic algorithm", drawn.COLOURS[2], 3)
    return figure


def _deviation(done: Corrected, via: int) -> Figure:
    figure = axes(*ALONG_AND_AWAY, 380)
    for run in done.before[via]:
        _add_path(figure, run.true_tool_m, done, "before correction", drawn.COLOURS[0], 2)
    for k, run in enumerate(done.after[via]):
        _add_path(figure, run.true_tool_m, done, f"final plan, run {k + 1}", drawn.COLOURS[2], 2)
    figure.add_hline(y=PRINTED[via][0], line={"dash": "dot", "color": "#888"}, annotation_text="mean in print")
    return figure


def _add_path(figure: Figure, points: FloatArray | None, done: Corrected, name: str, colour: str, width: int) -> None:
    assert points is not None  # the arm is simulated
    A, B = done.line.A, done.line.B
    along = progress_along_line(points, A, B) * float(np.linalg.norm(B - A)) * 1e3
    away = distance_to_line(points, A, B) * 1e3
    figure.add_scatter(x=along, y=away, mode="lines", name=name, line={"color": colour, "width": width})


def _bars(done: Corrected) -> Figure:
    figure = axes("", "distance from the line [mm]", 420)
    names = [f"experiment {via + 1}" for via in VIA]
    before, after = ([done.errors_mm(runs[via]) for via in VIA] for runs in (done.before, done.after))
    for k, what in enumerate(("mean", "maximum")):
        for who, values, colour in (
            ("print", [PRINTED[via][k] for via in VIA], drawn.COLOURS[5]),
            ("before", [pair[k] for pair in before], drawn.COLOURS[0]),
            ("final plan", [pair[k] for pair in after], drawn.COLOURS[2]),
        ):
            opacity = 1.0 if k == 0 else 0.55
            figure.add_bar(x=names, y=values, name=f"{what}, {who}", marker={"color": colour, "opacity": opacity})
    return figure
