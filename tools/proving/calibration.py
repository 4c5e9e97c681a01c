"""Whether an arm put together by hand is where it is told to be after `calibrate --holding`, and draws straight lines.

Arms are drawn at random, each put together carefully, typically or poorly: zeros, lengths, twists, sensors with waves,
brackets that bend under load, play of the horn. The program knows the arm's file alone. It brings the tip near 8 points
of a sheet, each in 3 postures, in the order in which the command asks for them; a clumsy hand presses it onto the
point, 0.5 mm beside it (root mean square). What the servos read there is what the fit gets. The file that comes out is
read anew, and the same arm is served by it.

A tick moves the tip by 1 mm and more, so that keys alone would leave it 1 mm off. A finger turns the shafts, which the
sensors show; what it bends behind them, a tenth of a millimetre, counts as clumsiness.

| judged, by the true tool | bounds [mm] |
|-|-|
| where the program says the tool stands, at other places | careful 1.1, typical 1.5, poor 2.5: median of the arms |
| refusals of a fit | none |
| a line, typical arms, model and two rounds of refinement, n=2: its distance from AB | mean/max 1.6/3.6, median |
| its distance from its own straight line | 1.2 times that of the same arm put together perfectly |

Beside these: where `move --xyz` brings the tool, and both before the calibration.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.commissioning import holding
from armctl.commissioning.calibration import Touch, calibration_text
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.lab.sag_identification import identify
from armctl.sim.spec import RANDOM_SPEC, ArmSpec, put_together
from armctl.trajectory.course import Line
from armctl.trajectory.target import MoveRequest
from proving.arms import arm_of
from proving.lines import DURATION_S, FIRST_VIA, first, refine
from proving.served_arm import ServedArm
from proving.truth import CLASSES, FloatArray, off_chord_mm, off_line_mm
from proving.workers import WORKERS, carry_out

ARMS, POINTS, POSTURES, PLACES = 40, 8, 3, 20
# The sheet, and what it may be laid upon: ahead, to the left, up.
SHEET_M = ((0.12, 0.26), (-0.14, 0.14), (0.03, 0.15))
# How far the tip is from the point.
CLUMSY_M = 0.5e-3
SETTLE_S, LOOK_S = 2.0, 2.0
BOUNDS_MM = {"careful": 1.1, "typical": 1.5, "poor": 2.5}
# Which of them draw lines, and how far these may be from AB (mean, maximum) and from straight, as a multiple.
DRAWS, LINE_MM, CHORD = "typical", (1.6, 3.6), 1.2
REFUSED = ("LINE", "PREFLIGHT", "LIMIT", "TOO_HEAVY")


@dataclass(frozen=True)
class Trial:
    """One arm, and how it was put together."""

    seed: int
    geometry: str

    @property
    def spec(self) -> ArmSpec:
        return put_together(RANDOM_SPEC, self.geometry, "new")


def run(trial: Trial) -> dict[str, Any]:
    """Calibrate one arm, and see where it is before and afterwards."""
    rng = np.random.default_rng((trial.seed, 23))
    found: dict[str, Any] = {"seed": trial.seed, "geometry": trial.geometry, "refused": "", "faults": 0}
    arm = _Arm(trial, None, found)
    touches, ways, made = list[Touch](), offered(arm.served.arm, rng), list[holding.Way]()
    while due := holding.left(ways, made, (), POSTURES):
        way = holding.most_telling(arm.served.arm, touches, due)[0]
        if arm.stands((*way.q_rad, *arm.served.goals_rad[len(way.q_rad) :])):
            touches.append(touch(arm.served, np.array(way.point_m), rng))
            made.append(way)
        else:
            ways.remove(way)
    places = list(sheet(PLACES, rng))
    found["said_before_mm"], found["moved_before_mm"] = stood(arm, places)
    try:
        held = holding.fit(arm.served.arm, touches)
    except RequestRefused as refusal:
        return found | {"refused": str(refusal), "said_mm": found["said_before_mm"]}
    known = arm_of(calibration_text(held.arm, ["calibrated"]))
    found["said_mm"], found["moved_mm"] = stood(_Arm(trial, known, found), places)
    found |= {"held_out_mm": held.held_out_mm, "fit_mm": held.after_mm}
    return found | (lines(trial, known) if trial.geometry == DRAWS else {})


class _Arm:
    """An arm that is sent from place to place; one that a fault stopped, being too weak there, begins anew."""

    def __init__(self, trial: Trial, known: ArmConfig | None, found: dict[str, Any]) -> None:
        self._trial, self._known, self._found = trial, known, found
        self._begin()

    def _begin(self) -> None:
        self.served = ServedArm(self._trial.seed, self._trial.spec, taken=self._known)

    def moved(self, point: FloatArray) -> bool:
        """Ask for the tool there; whether the arm went, and stands there."""
        x, y, z = point.tolist()
        return self._goes(MoveRequest(point_m=(x, y, z)))

    def stands(self, q: tuple[float, ...]) -> bool:
        """Ask for a posture; whether the arm went, and stands in it."""
        return self._goes(MoveRequest(joints_rad=q))

    def _goes(self, request: MoveRequest) -> bool:
        went = True
        try:
            self.served.move(request)
            self.served.wait(SETTLE_S)
        except RequestRefused:
            went = False
        if self.served.looks[-1].faults:
            self._found["faults"] += 1
            self._begin()
            return False
        return went


def offered(arm: ArmConfig, rng: np.random.Generator) -> list[holding.Way]:
    """Points of a sheet, and the postures above each that the command would offer."""
    ways: list[holding.Way] = []
    for number in range(POINTS):
        found: list[holding.Way] = []
        while len(found) < POSTURES:
            [point] = sheet(1, rng)
            x, y, z = point.tolist()
            found = holding.ways_above(arm, [(x, y, z)], 0.0)
        ways += [way._replace(number=number) for way in found]
    return ways


def sheet(count: int, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Points [m] that the hand may lead the tip to."""
    low, high = np.array(SHEET_M).T
    yield from rng.uniform(low, high, (count, 3))


def touch(arm: ServedArm, point: FloatArray, rng: np.random.Generator) -> Touch:
    """Press the tip, which is near a point, there with a finger, and read the servos."""
    seen = np.mean([[joint.position_rad for joint in one.outputs.joints] for one in arm.wait(LOOK_S)], axis=0)
    tip = point + CLUMSY_M / math.sqrt(3.0) * rng.standard_normal(3)
    seen += pressed(arm, tip - arm.tool_m)
    x, y, z = point.tolist()
    ticks = [joint.tick(position) for joint, position in zip(arm.arm.joints, seen.tolist(), strict=True)]
    return Touch(point_m=(x, y, z), ticks=tuple(ticks))


def pressed(arm: ServedArm, by_m: FloatArray) -> FloatArray:
    """What every joint turns by [rad] when the tip is pressed so far: the least turns that do it."""
    q, h = np.array(arm.looks[-1].joints_rad), 1e-6
    slopes = [arm.truly.tool_m(np.array([q + step, q - step])) for step in h * np.eye(len(q))]
    J = np.array([(one - other) / (2.0 * h) for one, other in slopes]).T
    return np.asarray(np.linalg.pinv(J) @ by_m)


def stood(arm: _Arm, places: list[FloatArray]) -> tuple[float, float]:
    """How far the tool is from where the program says it is, and from where it was asked for [mm], means."""
    said, asked = [], []
    for place in places:
        if arm.moved(place):
            truly = arm.served.tool_m
            told = [one.outputs.tool.position_m for one in arm.served.wait(LOOK_S) if one.outputs.tool is not None]
            said.append(float(np.linalg.norm(np.mean(told, axis=0) - truly)))
            asked.append(float(np.linalg.norm(place - truly)))
    return 1e3 * statistics.mean(said), 1e3 * statistics.mean(asked)


def lines(trial: Trial, known: ArmConfig) -> dict[str, Any]:
    """One line by the calibrated arm and by the same arm put together perfectly: from AB and from straight [mm]."""
    kind, rng = CLASSES[trial.seed % len(CLASSES)], np.random.default_rng((trial.seed, 29))
    arms: dict[str, dict[str, Any]] = {
        "": {"spec": trial.spec, "taken": known}, "perfect_": {"spec": put_together(RANDOM_SPEC, "perfect", "new")},
    }  # fmt: skip
    models = {key: identify(ServedArm(trial.seed, **how), np.random.default_rng(0)) for key, how in arms.items()}
    while True:
        found: dict[str, Any] = {"class": kind}
        drawn = ServedArm(trial.seed).truly.line(kind, rng)
        line = Line(drawn.A, drawn.B, DURATION_S)
        try:
            for key, how in arms.items():
                for name, draw in (("first", first), ("refined", refine)):
                    arm = ServedArm(trial.seed, **how, model=models[key])
                    if draw is first:
                        first(arm, line, FIRST_VIA, trial.seed, models[key])
                    else:
                        refine(arm, line, FIRST_VIA, models[key], trial.seed)
                    off = off_line_mm(arm.path_m, drawn.A, drawn.B)
                    found[f"{key}{name}_mm"] = [float(off.mean()), float(off.max())]
                    found[f"{key}{name}_chord_mm"] = float(off_chord_mm(arm.path_m).mean())
        except RequestRefused as refusal:
            if refusal.code not in REFUSED:
                raise
            continue
        return found


def prove(seed: int, tell: Callable[[str], None], *, arms: int = ARMS, workers: int = WORKERS) -> dict[str, Any]:
    """A row for each way of putting an arm together, and every bound that was broken."""
    began_s = time.monotonic()
    done = carry_out(run, [Trial(seed * 1000 + k, way) for k in range(arms) for way in BOUNDS_MM], tell, workers)
    rows, violations = judged(done)
    return {
        "runs": len(done),
        "violations": violations,
        "rows": rows,
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }


def judged(done: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows, and what was broken."""
    rows, violations = [], list[str]()
    for way, bound_mm in BOUNDS_MM.items():
        arms = [one for one in done if one["geometry"] == way]
        keys = ("said_before_mm", "said_mm", "held_out_mm", "fit_mm", "moved_before_mm", "moved_mm")
        row = {key: _median([one[key] for one in arms if key in one]) for key in keys}
        faults = sum(one.get("faults", 0) for one in arms)
        rows.append({"geometry": way, "arms": len(arms), "bound_mm": bound_mm} | row | {"too_weak": faults})
        if not row["said_mm"] <= bound_mm:
            violations.append(f"{way}: the tool is {row['said_mm']} mm from where it is said to be, bound {bound_mm:g}")
        violations += [f"{way}, arm {one['seed']}: {one['refused']}" for one in arms if one["refused"]]
    drew = [one for one in done if "refined_mm" in one]
    if drew:
        means = {
            key: [_median([one[f"{key}_mm"][k] for one in drew]) for k in (0, 1)]
            for key in ("first", "refined", "perfect_first", "perfect_refined")
        }
        ratio = _median([one["refined_chord_mm"] for one in drew]) / _median(
            [one["perfect_refined_chord_mm"] for one in drew]
        )
        rows.append({"geometry": DRAWS, "lines": len(drew)} | means | {"chord_ratio": round(ratio, 2)})
        if any(figure > most for figure, most in zip(means["refined"], LINE_MM, strict=True)):
            violations.append(f"{DRAWS}: lines are {means['refined']} mm from AB, bound {LINE_MM[0]:g}/{LINE_MM[1]:g}")
        if ratio > CHORD:
            violations.append(
                f"{DRAWS}: {ratio:.2f} times as far from straight as put together perfectly, bound {CHORD}"
            )
    return rows, violations


def _median(values: list[float]) -> float:
    return round(statistics.median(values), 2) if values else math.nan
