"""A picture of a line before and after correction, as SVG: for a README, a lab report, a slide.

The tool's paths are seen from above and from the side, true to scale, in the colours of the reader's screen.
"""

import html
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from armctl.recording.disk import writing
from armctl.recording.recordings import drawn as evenly
from armctl.report.line import ExperimentReport, LineRun, along_and_off
from armctl.report.page import TEXTS
from armctl.trajectory.straightness import errors_mm

WIDTH = 800
MARGIN = 24
LINE_HEIGHT = 24
VIEWS = ((1, "from above"), (2, "from the side"))
LEAST_HALF_HEIGHT_MM = 6.0
RULER_MM = 50
# Points of a curve: more cannot be told apart.
POINTS = 300
STYLE = Path(__file__).with_name("picture.css")


def write(report: ExperimentReport, path: Path) -> None:
    """Write the picture to `path`."""
    with writing(path):
        path.write_text(svg(report), encoding="utf-8")


def svg(report: ExperimentReport) -> str:
    """The picture: one outcome under the other."""
    blocks: list[str] = []
    top = float(MARGIN)
    for outcome in report.outcomes:
        heading = "a goal every tick" if outcome.via == "stream" else f"{outcome.via} intermediate points"
        named = (("before", outcome.before), ("after", outcome.runs[0]))
        for words, kind in ((f"The same line with {heading}", ""), *((_told(report, *one), one[0]) for one in named)):
            blocks.append(f'<text class="{kind}" x="{MARGIN}" y="{top + 16:.0f}">{html.escape(words)}</text>')
            top += LINE_HEIGHT
        for axis, view in VIEWS:
            drawn, height = _view(report, named, axis, view, top)
            blocks += drawn
            top += height
    top += LINE_HEIGHT
    style = STYLE.read_text(encoding="utf-8")
    return str(TEXTS["picture"].format(width=WIDTH, height=top, style=style, drawn="".join(blocks)))


def _told(report: ExperimentReport, when: str, run: LineRun) -> str:
    mean_mm, max_mm = errors_mm(run.real_tool_m, *report.ends)
    judge = "" if run.truth_tool_m is not None else " by the encoders"
    return f"{when}: {mean_mm:.1f} mm off the line on average, {max_mm:.1f} mm at most{judge}"


def _view(
    report: ExperimentReport, named: Sequence[tuple[str, LineRun]], axis: int, view: str, top: float
) -> tuple[list[str], float]:
    """Paths seen along one direction, and the height that takes."""
    real = ((kind, run.real_tool_m) for kind, run in named)
    paths = [(kind, along_and_off(tool_m[evenly(len(tool_m), POINTS)], *report.ends)) for kind, tool_m in real]
    length = float(np.linalg.norm(np.subtract(*report.ends))) * 1000.0
    along = np.concatenate([[0.0, length], *(seen[0] for _, seen in paths)])
    off = np.concatenate([[-LEAST_HALF_HEIGHT_MM, LEAST_HALF_HEIGHT_MM], *(seen[axis] for _, seen in paths)])
    scale = (WIDTH - 2 * MARGIN) / float(np.ptp(along))
    x = MARGIN + (-along.min()) * scale
    y = top + LINE_HEIGHT + off.max() * scale
    height = float(np.ptp(off)) * scale + 2 * LINE_HEIGHT

    def curve(kind: str, points: Iterator[tuple[float, float]]) -> str:
        return f'<path class="{kind}" d="M{"L".join(f"{x + a * scale:.1f} {y - b * scale:.1f}" for a, b in points)}"/>'

    drawn = [f'<text class="quiet" x="{MARGIN}" y="{top + 16:.0f}">{view}</text>']
    drawn.append(curve("wanted", iter(((0.0, 0.0), (length, 0.0)))))
    drawn += [curve(kind, zip(seen[0].tolist(), seen[axis].tolist(), strict=True)) for kind, seen in paths]
    drawn += [f'<circle class="end" cx="{x + at * scale:.1f}" cy="{y:.1f}" r="4"/>' for at in (0.0, length)]
    if axis == VIEWS[-1][0]:
        foot, right = top + height, WIDTH - MARGIN
        drawn.append(f'<path class="ruler" d="M{right - RULER_MM * scale:.1f} {foot:.1f}H{right}"/>')
        drawn.append(f'<text class="quiet" x="{right}" y="{foot - 6:.0f}" text-anchor="end">{RULER_MM} mm</text>')
    return drawn, height
