"""The page of an identified arm: what was learnt, beside what the simulator assumes. Without names, paths or dates."""

import math
from pathlib import Path

from armctl.report.page import Page
from armctl.trajectory.identification import Found

# Of each quantity: heading, unit, what the simulator draws of new servos and of worn ones, and its column here.
ASSUMED = {
    "coulomb_Nm": ("Friction", "N m", 0.08, 0.24),
    "stiction_ratio": ("Stiction over friction", "", 1.02, 1.61),
    "slope_tick": ("Compliance slope", "tick", 19.2, 32.0),
    "punch": ("Punch", "of 1023", 32.0, 32.0),
    "play_deg": ("Play between motor and shaft", "deg", 0.25, 1.5),
    "delay_ms": ("Delay from a goal to the controller", "ms", 17.4, 50.2),
    "stall_Nm": ("Strength at 12 V", "N m", 1.2, 1.8),
    "no_load_rad_s": ("Speed without load at 12 V", "rad/s", 5.56, 6.80),
    "load_friction": ("Friction of a load, per load", "", 0.0, 0.15),
}
LIKELY = 2.0


def write(found: Found, path: Path) -> None:
    """Write the page.

    Raises:
        LogError: it cannot be written.
    """
    page, rows = Page("What these servos are like", light=True), []
    page.text(
        "Found by small motions, or from logs. Joints are counted from the base. Bars are two standard deviations; the "
        "grey band is what armctl's simulator draws, from new servos to worn ones."
    )
    for key, (title, unit, low, high) in ASSUMED.items():
        seen = [(number, *joint.values[key]) for number, joint in enumerate(found.joints, 1) if key in joint.values]
        off = [number for number, value, sd in seen if not low - LIKELY * sd <= value <= high + LIKELY * sd]
        verdict = "refuted by joint " + ", ".join(map(str, off)) if off else "confirmed"
        rows.append((title, f"{low:g} to {high:g} {unit}", f"{verdict} ({len(seen)} seen)" if seen else "not seen"))
        if not seen:
            continue
        numbers, values, sds = zip(*seen, strict=True)
        with page.chart(f"{title} of each joint", title, "joint", unit, 260) as chart:
            for edge in (low, high):
                ends = [0.5, len(found.joints) + 0.5]
                chart.add("scatter", x=ends, y=[edge, edge], name="assumed", mode="lines", line={"color": "#999"})
            bars = {"type": "data", "array": [LIKELY * sd for sd in sds]}
            chart.add("scatter", x=numbers, y=values, error_y=bars, name="found", mode="markers")
    ramp = {True: "confirmed", False: "refuted: they begin at the shaft", None: "not seen"}[found.ramp_from_reference]
    rows.append(("A new goal goes on from the speed ramp's place", "yes", ramp))
    page.heading("What the simulator assumes")
    page.table(("assumption", "assumed", "this arm"), rows, words=True)
    columns = [(title, key) for key, (title, *_) in ASSUMED.items()]

    def cell(values: dict[str, tuple[float, float]], key: str) -> str:
        if key not in values:
            return "not seen"
        value, sd = values[key]
        digits = max(0, 1 - math.floor(math.log10(sd)))
        return f"{value:.{digits}f} \u00b1 {sd:.{digits}f}"

    page.heading("All figures, with standard deviations")
    page.table(
        ("joint", *(title for title, _ in columns)),
        [(number, *(cell(joint.values, key) for _, key in columns)) for number, joint in enumerate(found.joints, 1)],
    )
    page.write(path)
