"""Whether a tool that is led by hand truly goes straight: jogs on arms drawn at random, to their end and back.

An arm is sent to a place, led from there in a direction drawn at random until its way is over or it is told that the
tool can go no farther, and led back the same way. Judged is the true tool: how far it is aside, at the worst instant,
of the straight line through where it stood.

| row | the arm | bounds: median, 95 % [mm] |
|-|-|-|
| identified | has its own model, from eight calibration lines | 6, 12 |
| no model | is taken for one of new servos | 6, 12 |
| 50 g more | bears at its tool what its model does not know | 6, 14 |

Whatever row: a tool that hardly moves is told why, and no fault is latched.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.errors import RequestRefused
from armctl.messages import LagModel
from armctl.trajectory.target import MoveRequest
from proving import place
from proving.figures import violated
from proving.served_arm import ServedArm, identified
from proving.truth import FloatArray, off_line_mm, within
from proving.workers import WORKERS, carry_out

ARMS, TARGETS = 20, 10
# Of each row: median and 95 % [mm].
ROWS = {"identified": (6.0, 12.0), "no model": (6.0, 12.0), "50 g more": (6.0, 14.0)}
SHARE = 0.95
SLOWEST_M_S, FASTEST_M_S = 0.005, 0.05
WAY_M, LONGEST_S = 0.2, 8.0
# So far a tool goes that is led somewhere, as a share of what is asked for.
MOVED = 0.1


@dataclass(frozen=True)
class Trial:
    """One arm, and how often it is led."""

    seed: int
    targets: int
    rows: tuple[str, ...] = tuple(ROWS)


def run(trial: Trial) -> dict[str, Any]:
    """How far aside the tool was on each way, and what must not have been."""
    found: dict[str, Any] = {"seed": trial.seed, "ways": {}, "broken": [], "told": 0}
    model = identified(trial.seed)
    for name in trial.rows:
        found["ways"][name] = ways(trial, name, model, found)
    return found


def ways(trial: Trial, name: str, model: LagModel, found: dict[str, Any]) -> list[dict[str, float]]:
    """Lead an arm out and back from place to place; a fresh one each time."""
    row, rng = place.ROWS[name], np.random.default_rng((trial.seed, 29))
    led: list[dict[str, float]] = []
    for number in range(trial.targets):
        arm = ServedArm(trial.seed, row.spec, model=model if row.identified else None)
        _goes_somewhere(arm, rng)
        way = rng.normal(size=3)
        way *= np.exp(rng.uniform(np.log(SLOWEST_M_S), np.log(FASTEST_M_S))) / np.linalg.norm(way)
        for direction, tool_m_s in (("out", way), ("back", -way)):
            one, broken = _led(arm, tool_m_s, found)
            led.append(one | {"back": float(direction == "back")})
            found["broken"] += [f"{name}, jog {number} {direction}: {text}" for text in broken]
    return led


def _goes_somewhere(arm: ServedArm, rng: np.random.Generator) -> None:
    for _ in range(place.MOST_REFUSED):
        x, y, z = arm.truly.point(rng).tolist()
        try:
            arm.move(MoveRequest(point_m=(x, y, z)))
        except RequestRefused as refusal:
            if refusal.code not in place.REFUSED:
                raise
            continue
        arm.wait(place.SOON_S)
        return
    raise AssertionError(f"{place.MOST_REFUSED} places refused")


def _led(arm: ServedArm, tool_m_s: FloatArray, found: dict[str, Any]) -> tuple[dict[str, float], list[str]]:
    """Lead the tool once; how far aside it was [mm], and what is wrong."""
    speed_m_s = float(np.linalg.norm(tool_m_s))
    asked_s = min(WAY_M / speed_m_s, LONGEST_S)
    begin_m = arm.tool_m
    told = arm.jog(tool_m_s, asked_s)
    found["told"] += bool(told)
    along_mm = 1e3 * float(((arm.path_m - begin_m) @ tool_m_s).max()) / speed_m_s
    broken = [f"{code} latched" for code in arm.looks[-1].faults]
    if not told and along_mm < MOVED * 1e3 * speed_m_s * asked_s:
        broken.append(f"it goes {along_mm:.1f} mm of {1e3 * speed_m_s * asked_s:.0f}, and nobody is told why")
    return {"aside_mm": float(off_line_mm(arm.path_m, begin_m, begin_m + tool_m_s).max()), "along_mm": along_mm}, broken


def prove(
    seed: int,
    tell: Callable[[str], None],
    *,
    arms: int = ARMS,
    targets: int = TARGETS,
    rows: tuple[str, ...] = tuple(ROWS),
    workers: int = WORKERS,
) -> dict[str, Any]:
    """A row for each kind of arm, and everything that was broken."""
    began_s = time.monotonic()
    done = carry_out(run, [Trial(seed * 1000 + k, targets, rows) for k in range(arms)], tell, workers)
    table = [_row(name, [way for one in done for way in one["ways"][name]]) for name in rows]
    return {
        "runs": sum(row["ways"] for row in table),
        "violations": violated(table, done),
        "rows": table,
        "told": sum(one["told"] for one in done),
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }


def _row(name: str, led: Sequence[dict[str, float]]) -> dict[str, Any]:
    aside = [way["aside_mm"] for way in led]
    (most_mm, most_share_mm), median_mm, share_mm = ROWS[name], statistics.median(aside), within(aside, SHARE)
    return {
        "what": name,
        "ways": len(led),
        "median_mm": round(median_mm, 1),
        "share_mm": round(share_mm, 1),
        "worst_mm": round(max(aside), 1),
        "out_mm": round(within([way["aside_mm"] for way in led if not way["back"]], SHARE), 1),
        "back_mm": round(within([way["aside_mm"] for way in led if way["back"]], SHARE), 1),
        "along_mm": round(statistics.median(way["along_mm"] for way in led), 1),
        "bound": f"{most_mm:g}/{most_share_mm:g}",
        "held": median_mm <= most_mm and share_mm <= most_share_mm,
    }
