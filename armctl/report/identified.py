"""Pages of an identified arm, without names, paths or dates.

What was learnt, beside what the simulator assumes; and a log, beside what the twin foretells of it.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from armctl.dynamixel import ax12a
from armctl.kinematics.transform import FloatArray
from armctl.report.page import TEXTS, Page, curve
from armctl.trajectory.identification import Found

# Of each quantity: heading, unit, the least and the most that the simulator draws.
ASSUMED = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
LIKELY = 2.0
MEASURED, BAND = "#b0413e", "#888888"


class Compared(NamedTuple):
    """A log beside what its arm's twin foretells of it; m ticks, n joints."""

    names: tuple[str, ...]
    # From where the motion begins, shape (m,).
    time_s: FloatArray
    # What encoders showed, and what the twin's showed at least, in the middle and at most [rad], all of shape (m, n).
    measured_rad: FloatArray
    least_rad: FloatArray
    middle_rad: FloatArray
    most_rad: FloatArray
    # Distance of the tool from where the twin has it, by encoders [m], shape (m,).
    tool_m: FloatArray

    def rows(self) -> list[dict[str, Any]]:
        """Of each joint how far the twin is off, and in which share of ticks what was measured is within its band."""
        off_deg = np.degrees(np.abs(self.measured_rad - self.middle_rad))
        low, high = self.least_rad - ax12a.TICK_RAD, self.most_rad + ax12a.TICK_RAD
        inside = ((self.measured_rad >= low) & (self.measured_rad <= high)).mean(axis=0)
        rms_deg = np.sqrt((off_deg**2).mean(axis=0))
        columns = zip(self.names, rms_deg.tolist(), off_deg.max(axis=0).tolist(), inside.tolist(), strict=True)
        return [dict(zip(("name", "rms_deg", "max_deg", "inside"), row, strict=True)) for row in columns]


def write(found: Found, path: Path) -> None:
    """Write the page.

    Raises:
        LogError: it cannot be written.
    """
    page, rows = Page("What these servos are like"), []
    page.text(TEXTS["identified"])
    for key, (title, unit, low, high) in ASSUMED.items():
        seen = [(number, *joint.values[key]) for number, joint in enumerate(found.joints, 1) if key in joint.values]
        off = [number for number, value, sd in seen if not low - LIKELY * sd <= value <= high + LIKELY * sd]
        verdict = "refuted by joint " + ", ".join(map(str, off)) if off else "confirmed"
        rows.append((title, f"{low:g} to {high:g} {unit}", f"{verdict} ({len(seen)} seen)" if seen else "not seen"))
        if not seen:
            continue
        numbers, values, sds = zip(*seen, strict=True)
        with page.chart(f"{title} of each joint", title, "joint", unit, 260) as chart:
            chart.layout |= {"showlegend": False, "xaxis": {"title": {"text": "joint"}, "dtick": 1}}
            for edge in (low, high):
                curve(chart, [0.5, len(found.joints) + 0.5], [edge, edge], "assumed", "#999999")
            bars = {"type": "data", "array": [LIKELY * sd for sd in sds]}
            chart.add("scatter", x=numbers, y=values, error_y=bars, name="found", mode="markers")
    ramp = {True: "confirmed", False: "refuted: they begin at the shaft", None: "not seen"}[found.ramp_from_reference]
    rows.append(("A new goal goes on from the speed ramp's place", "yes", ramp))
    page.heading("What the simulator assumes")
    page.table(("assumption", "assumed", "this arm"), rows, words=True)

    def cell(seen: tuple[float, float] | None) -> str:
        digits = max(0, 1 - math.floor(math.log10(seen[1]))) if seen else 0
        return f"{seen[0]:.{digits}f} \u00b1 {seen[1]:.{digits}f}" if seen else "not seen"

    page.heading("All figures, with standard deviations")
    page.table(
        ("joint", *(title for title, *_ in ASSUMED.values())),
        [(number, *(cell(joint.values.get(key)) for key in ASSUMED)) for number, joint in enumerate(found.joints, 1)],
    )
    page.write(path)


def write_compared(found: Compared, path: Path) -> None:
    """Write the page of a log beside what the twin foretells of it.

    Raises:
        LogError: it cannot be written.
    """
    page, rows = Page("This arm and its twin"), found.rows()
    page.text(TEXTS["compared"])
    cells = [(k, f"{r['rms_deg']:.2f}", f"{r['max_deg']:.2f}", f"{r['inside']:.0%}") for k, r in enumerate(rows, 1)]
    page.table(("joint", "rms, deg", "most, deg", "within the band"), cells)
    for k in range(len(rows)):
        with page.chart(f"Joint {k + 1}, measured and foretold", f"Joint {k + 1}", "time, s", "deg", 260) as chart:
            for name, q, how in (
                ("least", found.least_rad, {"width": 0, "showlegend": False}),
                ("foretold", found.most_rad, {"width": 0, "fill": "tonexty"}),
                ("measured", found.measured_rad, {}),
            ):
                curve(chart, found.time_s, np.degrees(q[:, k]), name, BAND if how else MEASURED, **how)
    with page.chart("Distance of the tool from where the twin has it", "Tool", "time, s", "mm", 260) as chart:
        curve(chart, found.time_s, 1e3 * found.tool_m, "apart", MEASURED)
    page.write(path)
