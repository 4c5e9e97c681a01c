"""Where the tool truly comes to stand: `move --xyz` on arms drawn at random, through the daemon's step.

After each move the arm is looked at for a minute. The trajectory ends when its last goal is due, a tick after it was
sent. The true tool is judged 1 s and 3 s later; from then on no servo may get another goal, nor the tool creep. Beside
these stand the largest creep, when the last goal changed, and where the tool is after the minute (median).

| row | the arm | bounds 3 s after: median, 95 % [mm] |
|-|-|-|
| identified | has its own model, from eight calibration lines | 1.2, 2.5 |
| no model | is taken for one of new servos | 1.3, 3.0 |
| 50 g more | bears at its tool what its model does not know | 1.2, 2.8 |
| stiction 1.6 | breaks away later than when its model was made | 1.6, 5.0 |
| reach | is asked to `reach` the same targets, with its model | 1.2, 2.5 |
| transfer | another arm, taken for a new one: at rest in both stations of a cycle | 1.2, 2.5 |

Whatever row: no goal is farther than `MOST_DEG` from the trajectory, and no fault is latched by a correction: one that
the same arm latches on the same ways without any is told as `too_weak`. Three more trials an arm:
- held: a joint is held a little short of its place. Its goal keeps the bound, and it does not count as blocked.
- latched: a fault is latched while the tool is brought to its place. No goal changes until it is cleared.
- another's model: that of another arm, and that of another calibration, are refused.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from armctl.errors import RequestRefused
from armctl.messages import LagModel, Mode
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.grasp import ReachRequest
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.transfer import TransferRequest
from proving.figures import violated
from proving.reading import TICK_DEG
from proving.served_arm import Look, ServedArm, identified
from proving.truth import FloatArray, within
from proving.workers import WORKERS, carry_out

ARMS, TARGETS = 20, 20
# When the true tool is judged, after the trajectory's end, and for how long nothing may change then.
SOON_S, LATER_S, REST_S = 1.0, 3.0, 60.0
CREEP_MM = 0.5
SHARE = 0.95
# No correction bends a goal by more, and a tick of rounding.
MOST_DEG = 7.0 + TICK_DEG
# What the host says where the way to a target is not for this arm: another one is drawn. Every target is within reach,
# so `move` may not call one unreachable; the straight way of `reach` may be.
REFUSED = ("UNREACHABLE", "PREFLIGHT", "LIMIT")
MOST_REFUSED = 100
TOOL_KG = RANDOM_SPEC.tool_kg
# From when a fault is told its motion may slow down.
STOPS_S = 0.25
TRANSFER_ARM = "transfer-6dof"
# A posture with room all around, and joints that are held short of where they are wanted, by less than is trimmed.
READY_RAD = tuple(math.radians(deg) for deg in (0.0, 70.0, -80.0, -20.0, 10.0, 0.0))
HELD_DEG = ((0, 2.0), (1, 2.0), (1, 2.7))
# Long enough at a station for it to count as a place, and to rest there.
DWELL_S = 4.0


@dataclass(frozen=True)
class Row:
    """One kind of arm, and what is asked of it."""

    median_mm: float
    share_mm: float
    spec: ArmSpec = RANDOM_SPEC
    # Whether it has its own model.
    identified: bool = True


ROWS = {
    "identified": Row(1.2, 2.5),
    "no model": Row(1.3, 3.0, identified=False),
    "50 g more": Row(1.2, 2.8, replace(RANDOM_SPEC, tool_kg=(TOOL_KG[0] + 0.05, TOOL_KG[1] + 0.05))),
    "stiction 1.6": Row(1.6, 5.0, replace(RANDOM_SPEC, stiction_ratio=1.6)),
    "reach": Row(1.2, 2.5),
    "transfer": Row(1.2, 2.5),
}


@dataclass(frozen=True)
class Trial:
    """One arm, and how often it is sent somewhere."""

    seed: int
    targets: int
    rows: tuple[str, ...] = tuple(ROWS)
    correction: bool = True


def run(trial: Trial) -> dict[str, Any]:
    """Every stop of every row, what was refused, and what must not have been."""
    found: dict[str, Any] = {"seed": trial.seed, "stops": {}, "refused": [], "broken": []}
    model = identified(trial.seed)
    for name in trial.rows:
        stops = _transfers(trial, found) if name == "transfer" else _stops(trial, name, model, found)
        found["stops"][name] = stops
    for what, why in (("held", held), ("latched", latched)) if trial.correction else ():
        found["broken"] += [f"{what}: {text}" for text in why(trial.seed, model)]
    found["broken"] += [f"another's model: {text}" for text in anothers(trial.seed, model)]
    return found


def _stops(trial: Trial, name: str, model: LagModel, found: dict[str, Any]) -> list[dict[str, float]]:
    """Send an arm from target to target."""
    row, rng = ROWS[name], np.random.default_rng((trial.seed, 19))

    def fresh() -> ServedArm:
        known = model if row.identified else None
        return ServedArm(trial.seed, row.spec, correction=trial.correction, model=known)

    arm, stops, asked = fresh(), [], 0
    # Where it was sent since it was switched on, and stood.
    ways: list[FloatArray] = []
    while asked < trial.targets and len(found["refused"]) < MOST_REFUSED:
        target, broken = arm.truly.point(rng), list[str]()
        arm.looks.clear()
        try:
            _send(arm, name, target)
        except RequestRefused as refusal:
            if refusal.code in REFUSED and not (refusal.code == "UNREACHABLE" and name != "reach"):
                found["refused"].append(f"{name}: {refusal.code}")
                continue
            broken = [str(refusal)]
        else:
            stop, broken = _stop(arm, target)
            stops.append(stop)
        ways.append(target)
        if broken and arm.looks and arm.looks[-1].faults:
            if _is_too_weak(trial, name, ways):
                found["too_weak"] = found.get("too_weak", 0) + 1
                broken = []
            arm, ways = fresh(), []
        found["broken"] += [f"{name}, move {asked} to {np.round(target, 3).tolist()}: {text}" for text in broken]
        asked += 1
    if asked < trial.targets:
        found["broken"].append(f"{name}: {MOST_REFUSED} targets refused, only {asked} of {trial.targets} gone to")
    return stops


def _send(arm: ServedArm, name: str, target: FloatArray) -> None:
    x, y, z = target.tolist()
    if name == "reach":
        arm.reach(ReachRequest(point_m=(x, y, z)))
    else:
        arm.move(MoveRequest(point_m=(x, y, z)))


def _is_too_weak(trial: Trial, name: str, ways: Sequence[FloatArray]) -> bool:
    """Whether the same arm latches a fault on the same ways, and standing at their ends, without any correction."""
    plain = ServedArm(trial.seed, ROWS[name].spec, correction=False)
    with suppress(RequestRefused):  # which names the fault
        for target in ways:
            _send(plain, name, target)
            plain.wait(REST_S + LATER_S)
    return bool(plain.looks[-1].faults)


def _stop(arm: ServedArm, target: FloatArray) -> tuple[dict[str, float], list[str]]:
    """How the last motion ended, and how the arm stood then for a minute."""
    end_s = ended_s(arm.looks, arm.period_s)
    arm.wait(REST_S + LATER_S - (arm.looks[-1].time_s - end_s) + arm.period_s)
    broken = bent(arm)
    standing = [look for look in arm.looks if end_s + LATER_S <= look.time_s]
    # What was decided by then may reach the servos in the tick after.
    goals = [look.goals_rad for look in standing[1:]]
    if changes := sum(a != b for a, b in pairwise(goals)):
        broken.append(f"{changes} other goals in the {REST_S:g} s after its {LATER_S:g} s")
    tools = arm.truly.tool_m(np.array([look.joints_rad for look in standing]))
    creep_mm = 1e3 * float(np.linalg.norm(tools - tools[0], axis=1).max())
    if creep_mm > CREEP_MM:
        broken.append(f"creeps by {creep_mm:.2f} mm (bound {CREEP_MM:g})")
    if codes := {code for look in arm.looks for code in look.faults}:
        broken.append(f"{', '.join(sorted(codes))} latched")
    changed = [after.time_s for before, after in pairwise(arm.looks) if before.goals_rad != after.goals_rad]
    return {
        "soon_mm": away_mm(arm, target, end_s + SOON_S),
        "later_mm": away_mm(arm, target, end_s + LATER_S),
        "rest_mm": 1e3 * float(np.linalg.norm(tools[-1] - target)),
        "creep_mm": creep_mm,
        "settled_s": max(changed) - end_s,
    }, broken


def ended_s(looks: Sequence[Look], period_s: float) -> float:
    """When the last goal of the last trajectory was due."""
    moving = [look for look in looks if look.mode is Mode.MOVING]
    before = max((k for k, look in enumerate(moving) if (look.progress or 0.0) < 1.0), default=-1)
    return moving[min(before + 1, len(moving) - 1)].time_s + period_s


def away_mm(arm: ServedArm, target: FloatArray, time_s: float) -> float:
    """How far the tool truly is from a target at the first look from then on [mm]."""
    look = next(look for look in arm.looks if look.time_s >= time_s - 1e-6)
    return 1e3 * float(np.linalg.norm(arm.truly.tool_m(np.array([look.joints_rad]))[0] - target))


def bent(arm: ServedArm) -> list[str]:
    """Which goals of the last motion are farther from its trajectory than a correction may bend them."""
    worst = (0.0, "", 0.0)
    for look in arm.looks[arm.began :]:
        if look.mode is Mode.MOVING and look.progress is not None:
            asked = _asked_rad(arm, look.progress)
            for joint, goal, q in zip(arm.arm.joints, look.goals_rad, asked, strict=True):
                worst = max(worst, (abs(math.degrees(goal - q)), joint.name, look.progress))
    if worst[0] <= MOST_DEG:
        return []
    return [f"the goal of {worst[1]} is {worst[0]:.1f} deg from its trajectory (bound {MOST_DEG:.1f})"]


def _asked_rad(arm: ServedArm, progress: float) -> list[float]:
    """Where the joints are asked to be at a share of the last motion's time [rad]."""
    assert arm.asked is not None
    rows = np.array(arm.asked.positions_rad)
    times = np.array(arm.asked.times_s) if arm.asked.times_s else np.arange(len(rows)) * arm.asked.period_s
    return [float(np.interp(progress * times[-1], times, column)) for column in rows.T]


# ------------------------------------------------------------------------------------------------ transfer


def _transfers(trial: Trial, found: dict[str, Any]) -> list[dict[str, float]]:
    """Both stations of cycles between places drawn at random, on an arm that can turn its paw down."""
    rng = np.random.default_rng((trial.seed, 23))
    arm = ServedArm(trial.seed, name=TRANSFER_ARM, correction=trial.correction)
    stops: list[dict[str, float]] = []
    while len(stops) < 2 * math.ceil(trial.targets / 10) and len(found["refused"]) < MOST_REFUSED:
        stations = [_station(rng), _station(rng)]
        (pick, place), height_m = stations, 0.04
        arm.looks.clear()
        cycle = TransferRequest(pick_m=pick, place_m=place, height_m=height_m, dwell_s=DWELL_S)
        try:
            arm.transfer(cycle)
        except RequestRefused as refusal:
            if refusal.code in REFUSED:
                found["refused"].append(f"transfer: {refusal.code}")
                continue
            found["broken"].append(f"transfer between {pick} and {place}: {refusal}")
            arm = ServedArm(trial.seed, name=TRANSFER_ARM, correction=trial.correction)
            continue
        assert arm.asked is not None
        begin_s = arm.looks[arm.began].time_s + arm.period_s + arm.asked.begin_s
        there_s = [begin_s + cycle.lift_s, begin_s + 3.0 * cycle.lift_s + cycle.dwell_s + cycle.carry_s]
        for station, at_s in zip(stations, there_s, strict=True):
            target = np.array(station)
            stops.append(
                {
                    "soon_mm": away_mm(arm, target, at_s + SOON_S),
                    "later_mm": away_mm(arm, target, at_s + LATER_S),
                }
            )
        found["broken"] += [f"transfer between {pick} and {place}: {text}" for text in bent(arm)]
    return stops


def _station(rng: np.random.Generator) -> tuple[float, float, float]:
    radius_m, around_rad = rng.uniform(0.11, 0.20), rng.uniform(-1.2, 1.2)
    return radius_m * math.cos(around_rad), radius_m * math.sin(around_rad), rng.uniform(-0.16, -0.06)


# -------------------------------------------------------------------------------------- what must not be corrected


def held(seed: int, model: LagModel | None = None) -> list[str]:
    """A joint is held short of its place, for longer than its motion goes on."""
    broken = []
    for joint, held_deg in HELD_DEG:
        arm = ServedArm(seed, model=model)
        arm.move(MoveRequest(joints_rad=READY_RAD))
        for way_deg in (held_deg, -held_deg):
            target = list(arm.goals_rad)
            target[joint] += math.radians(way_deg)
            arm.strike("blocked_joint", joint, 0.0, 25.0)
            with suppress(RequestRefused):  # which says what holds it
                arm.move(MoveRequest(joints_rad=tuple(target), duration_s=8.0))
            broken += bent(arm)
            # It may push for too long; but it is not far from where it is wanted, and so its goal may not be, either.
            if codes := set(arm.looks[-1].faults):
                broken += [f"{code} is latched by a correction" for code in sorted(codes - {"CONTACT"})]
                break
            arm.wait(20.0)
    return broken


def latched(seed: int, model: LagModel | None = None) -> list[str]:
    """A servo falls silent while the arm moves, or while its tool is brought to its place; then it is there again."""
    broken = []
    for begin_s in (1.0, 2.0 + 0.05):
        arm = ServedArm(seed, model=model)
        arm.strike("mute", len(arm.arm.joints) - 1, begin_s, 0.8)
        arm.looks.clear()
        with suppress(RequestRefused):  # which names the servo
            arm.move(MoveRequest(joints_rad=_a_little_on(arm), duration_s=2.0))
        arm.wait(5.0)
        told_s = next((look.time_s for look in arm.looks if look.faults), math.inf)
        after = [look for look in arm.looks if look.time_s >= told_s + STOPS_S]
        if not after:
            broken.append("a servo that was silent for 0.8 s is not told")
        elif len({look.goals_rad for look in after}) > 1:
            broken.append(f"goals change {STOPS_S:g} s after {after[0].faults[0]} is latched")
    return broken


def _a_little_on(arm: ServedArm) -> tuple[float, ...]:
    """The base turned, and the arm lifted off its rest pose."""
    lifted = np.array(arm.goals_rad)
    lifted[:2] += np.radians([15.0, -25.0])
    return tuple(lifted.tolist())


def anothers(seed: int, model: LagModel) -> list[str]:
    """A model of another arm, and one of another calibration, are offered."""
    arm, broken = ServedArm(seed), []
    for what, other in (
        ("arm", replace(model, arm_id="another")),
        ("calibration", replace(model, calibration_hash="0" * len(model.calibration_hash))),
    ):
        try:
            arm.use(other)
        except RequestRefused as refusal:
            if refusal.code != "MODEL":
                broken.append(f"that of another {what} is refused as {refusal.code}")
        else:
            broken.append(f"that of another {what} is taken")
    return broken


# -------------------------------------------------------------------------------------------------- the proof


def prove(
    seed: int,
    tell: Callable[[str], None],
    *,
    arms: int = ARMS,
    targets: int = TARGETS,
    rows: tuple[str, ...] = tuple(ROWS),
    workers: int = WORKERS,
    correction: bool = True,
) -> dict[str, Any]:
    """A row for each kind of arm and time, and everything that was broken."""
    began_s = time.monotonic()
    trials = [Trial(seed * 1000 + k, targets, rows, correction) for k in range(arms)]
    done = carry_out(run, trials, tell, workers)
    table = [row for name in rows for row in _rows(name, [stop for one in done for stop in one["stops"][name]])]
    violations = violated(table, done)
    refused = [text for one in done for text in one["refused"]]
    return {
        "runs": sum(len(stops) for one in done for stops in one["stops"].values()),
        "violations": violations,
        "rows": table,
        "too_weak": sum(one.get("too_weak", 0) for one in done),
        "refused": {text: refused.count(text) for text in sorted(set(refused))},
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }


def _rows(name: str, stops: Sequence[dict[str, float]]) -> list[dict[str, Any]]:
    """What is told 1 s after the trajectory's end, and what is judged 3 s after it."""
    rows = []
    for when, after_s, bound in (("soon_mm", SOON_S, None), ("later_mm", LATER_S, ROWS[name])):
        away = [stop[when] for stop in stops]
        if not away:
            rows.append({"what": name, "after_s": after_s, "stops": 0, "median_mm": "-", "share_mm": "-",
                         "bound": "some stops", "held": False})  # fmt: skip
            continue
        median_mm, share_mm = statistics.median(away), within(away, SHARE)
        row: dict[str, Any] = {
            "what": name,
            "after_s": after_s,
            "stops": len(away),
            "median_mm": round(median_mm, 2),
            "share_mm": round(share_mm, 2),
            "worst_mm": round(max(away), 2),
            "bound": "told",
            "held": True,
        }
        if bound is not None:
            row["bound"] = f"{bound.median_mm:g}/{bound.share_mm:g}"
            row["held"] = median_mm <= bound.median_mm and share_mm <= bound.share_mm
            for key, of in (("rest_mm", statistics.median), ("creep_mm", max), ("settled_s", max)):
                if figures := [stop[key] for stop in stops if key in stop]:
                    row[key] = round(of(figures), 2)
        rows.append(row)
    return rows
