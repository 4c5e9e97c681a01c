"""A sheet of points to touch, to be printed true to scale, as SVG: x ahead of the base is up the page.

The base stands on the page too, so that nobody has to measure where the page lies.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armctl.errors import RequestRefused
from armctl.recording.disk import writing
from armctl.report.page import TEXTS

# What stands around the outermost points: their coordinates, and what no printer prints on; below them the ruler.
AROUND_MM, FOOT_MM = 15.0, 30.0


def write(points_m: Sequence[tuple[float, float, float]], arm_id: str, floor_m: float, path: Path) -> str:
    """Draw points in the base frame [m], numbered as they come, on the smallest paper that holds them; which it is.

    Raises:
        RequestRefused: no paper does.
        LogError: it cannot be written.
    """
    about, mm = TEXTS["sheet"], 1000.0 * (np.array(points_m) - (0.0, 0.0, floor_m)).round(4)
    # To the left and ahead, the base among them.
    low, high = ((0.0 + of([*mm[:, 1::-1], (0.0, 0.0)], axis=0)) for of in (np.min, np.max))
    wide, long = high - low + (2.0 * AROUND_MM, 2.0 * AROUND_MM + FOOT_MM)
    paper = next((paper for paper, (width, height) in about["papers"].items() if wide <= width and long <= height), "")
    if not paper:
        raise RequestRefused("SHEET", about["too large"].format(wide=wide, long=long))
    width, height = about["papers"][paper]
    # Where the base stands on the page.
    left, top = ((np.array([width, height - FOOT_MM]) + low + high) / 2.0).tolist()
    page = {"width": width, "height": height, "paper": paper, "arm_id": arm_id, "left": left, "top": top}
    marks, lines = "", Counter[tuple[float, float]]()
    for number, (x, y, up) in enumerate(mm.tolist(), 1):
        told = {"number": number, "x": x, "y": y, "up": up, "left": left - y, "top": top - x}
        # Of points one above the other the names stand one below the other.
        marks += about["raised" if up else "point"].format(line=3.6 * lines[x, y], **told)
        lines[x, y] += 2 if up else 1
    with writing(path):
        path.write_text(
            about["page"].format(marks=marks, foot=height - FOOT_MM, across=width - 16, **page), encoding="utf-8"
        )
    return paper
