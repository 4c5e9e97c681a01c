"""The page of an identified arm: what was learnt, beside what the simulator assumes. Without names, paths or dates."""

import math
from pathlib import Path

import yaml

from armctl.report.page import TEXTS, Page, curve
from armctl.trajectory.identification import Found

# Of each quantity: heading, unit, the least and the most that the simulator draws.
ASSUMED = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
LIKELY = 2.0


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
