"""The tool is brought to its place at rest, once a trajectory is over.

Rules.
1. The arm is looked at for `LOOK_S` once it stands. Then goals change by whole ticks, those of all joints together,
   such that the tool comes nearest to its place; and again, for `REST_S` in all, its last rest included. From the first
   time on that this would gain too little (`GAIN_M`) nothing changes: noise and stiction would have the arm hunt.
2. A joint that turns back has its friction to overcome first. The model foresees how much that takes of a change, and
   each such change shows it. A joint that was led on until now has all of it to overcome, or none; of one that has
   stood, its goal shows how much: it is ahead of the joint by what gravity takes, and by what friction holds. One that
   did not turn when it was to sticks, and pushed further would jump past its place: it is left where it stands, and the
   others make up for it.
3. A joint that is far off, and pushes on, is kept from where it is wanted. No trim is larger than `TRIM_RAD`, and no
   correction in all than `MOST_RAD` (see motion.py).
"""

import math
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from armctl.control.machine import Following, Motion, Settling
from armctl.control.tick import Tick
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.chain import jacobian
from armctl.messages import Event
from armctl.trajectory.lag import lags_rad

TRIM_RAD = math.radians(3.0)
# No correction is larger in all.
MOST_RAD = math.radians(7.0)
# No correction makes a goal farther from its joint, but for the way that this goes by itself: one that is blocked is to
# be told of as that, and one held short of its place pushes with less than what trips it: 0.8 at 7.5 deg.
AWAY_RAD = math.radians(7.0)
FAR_RAD = math.radians(3.0)
# Until the arm stands, how long it is looked at then, and in all.
WAIT_S, LOOK_S, REST_S = 0.2, 0.4, 3.0
# What a change is to gain, the first one, and by how much more each that follows.
GAIN_M, GAIN_RISE = 0.0003, 1.3
# A joint has stood where it was led on by less than its friction takes, in the last part of a trajectory.
STOOD_S = 2.0
# What turning a joint back costs, and what share of twice its friction it takes.
REVERSAL_M, REVERSAL_SHARE = 0.0003, 0.85
# A change that overcomes this share of a reversal, or more, shows what a whole one takes.
WHOLE = 0.9
# One that has turned by less than this has not turned.
TURNED_RAD = 0.5 * TICK_RAD
# Ticks that goals change by at once, of all joints, and what each is to gain.
MOST_TICKS, LEAST_M = 12, 0.00002


def settle(s: Tick, motion: Motion, earlier_rad: Sequence[float]) -> bool:
    """Bring the tool to its place once a trajectory is over, tick by tick; False: it is as near as it will come.

    Args:
        earlier_rad: Where the joints were wanted `STOOD_S` before its end, shape (joints,).
    """
    f, n, now = s.state.following, s.robot.chain.n, motion.settling or Settling()
    if f is None or not f.corrected or now.ticks >= s.ticks_in(REST_S):
        return False
    wait, look = s.ticks_in(WAIT_S, least=1), s.ticks_in(LOOK_S)
    now = replace(now, ticks=now.ticks + 1, heard=now.heard + s.fresh)
    if s.fresh and now.heard > wait:
        errors = [f.wanted_rad[i] - s.joints[i].position_rad for i in range(n)]
        now = replace(now, sum_rad=tuple([a + b for a, b in zip(now.sum_rad or (0.0,) * n, errors, strict=True)]))
    motion.settling = now
    if not s.fresh or now.heard < wait + look:
        return True
    errors = [total / look for total in now.sum_rad]
    if not now.count:
        s.state.following = f = replace(f, side=_sides(s, f, errors, earlier_rad))
    stuck = (*now.stuck, *_sticking(now, errors))
    changes = _changes(s, f, errors, stuck, GAIN_M * GAIN_RISE**now.count)
    if not any(changes) or now.ticks + wait + look > s.ticks_in(REST_S):
        return False
    slack = _slack_rad(s, now, errors)
    seen = (tuple(changes), stuck, tuple(errors), tuple(_change(s, f, changes, slack)), tuple(slack))
    motion.settling = Settling(now.ticks, 0, (), now.count + 1, *seen)
    return True


def _sides(s: Tick, f: Following, error_rad: Sequence[float], earlier_rad: Sequence[float]) -> tuple[float, ...]:
    """On which side friction pushes, of every joint (rule 2)."""
    n, model, sides = s.robot.chain.n, s.lag_model(), list(f.side)
    gravity_rad = lags_rad(model, s.robot.chain, f.wanted_rad, (0.0,) * n, (0.0,) * n)
    for i, (row, goal_rad) in enumerate(zip(model.rows, s.goals_rad(), strict=False)):
        if friction_rad := abs(row[n]):
            held_rad = goal_rad - f.wanted_rad[i] + error_rad[i] - gravity_rad[i]
            led = min(1.0, abs(f.wanted_rad[i] - earlier_rad[i]) / friction_rad)
            sides[i] = led * sides[i] + (1.0 - led) * min(max(held_rad / friction_rad, -1.0), 1.0)
    return tuple(sides)


def _sticking(last: Settling, error_rad: Sequence[float]) -> tuple[int, ...]:
    """Which joints did not turn when they were last to."""
    turned = enumerate(zip(last.asked, last.error_rad, error_rad, strict=True) if last.asked else ())
    return tuple([i for i, (asked, before, now) in turned if (before - now) * asked < TURNED_RAD * abs(asked)])


def _slack_rad(s: Tick, last: Settling, error_rad: Sequence[float]) -> list[float]:
    """What a reversal takes of a change, of every joint: by its friction, or by what the last reversal showed."""
    if not last.back_rad:
        return [REVERSAL_SHARE * 2.0 * abs(row[s.robot.chain.n]) for row in s.lag_model().rows]
    found = []
    for slack, back, before, now in zip(last.slack_rad, last.back_rad, last.error_rad, error_rad, strict=True):
        turned = before - now if back > 0.0 else now - before
        seen = back != 0.0 and turned > TURNED_RAD
        found.append(min(max(abs(back) - turned, 0.0), 2.0 * slack) if seen else slack)
    return found


def _changes(s: Tick, f: Following, error_rad: Sequence[float], stuck: Container[int], gain_m: float) -> list[int]:
    """By how many ticks each joint is to turn so that the tool is nearest to its place: tick by tick the nearest one.

    All 0: it would gain less than `gain_m`.
    """
    n = s.robot.chain.n
    J: list[list[float]] = jacobian(s.robot.chain, np.array(f.wanted_rad[:n]))[:3].tolist()
    off_m = [0.0, 0.0, 0.0]
    for k, row in enumerate(J):
        for slope, error in zip(row, error_rad, strict=True):
            off_m[k] += slope * error
    changes = [0] * n
    first_m = now_m = _length(off_m)
    for _ in range(MOST_TICKS):
        found = []
        for i, way in [(i, way) for i in range(n) for way in (1, -1)]:
            kept = abs(error_rad[i]) > FAR_RAD and s.joints[i].load_ratio * error_rad[i] > 0.0
            if changes[i] * way < 0 or i in stuck or kept:
                continue
            left_m = [off - way * row[i] * TICK_RAD for off, row in zip(off_m, J, strict=True)]
            turns = not changes[i] and way * f.side[i] < 0.0
            found.append((_length(left_m) + REVERSAL_M * turns, i, way, left_m))
        best_m, i, way, left_m = min(found, default=(math.inf, 0, 0, off_m))
        if best_m > now_m - LEAST_M:
            break
        now_m, off_m = best_m, left_m
        changes[i] += way
    return changes if now_m < first_m - gain_m else [0] * n


def _length(v: Sequence[float]) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _change(s: Tick, f: Following, changes: Sequence[int], slack_rad: Sequence[float]) -> list[float]:
    """Have the joints turn by so many ticks; by how much the goal of each changes that turns back [rad]."""
    trims, sides, goal, back = list(f.trim_rad), list(f.side), list(s.state.goal[: len(s.joints)]), [0.0] * len(changes)
    for i, change in enumerate(changes):
        if not change:
            continue
        way = 1 if change > 0 else -1
        share = (1.0 - way * sides[i]) / 2.0
        step_rad = change * TICK_RAD + way * share * slack_rad[i]
        ticks = round((min(max(trims[i] + step_rad, -TRIM_RAD), TRIM_RAD) - trims[i]) / TICK_RAD)
        goal_rad = s.goals_rad()[i]
        ahead_rad, given_rad = goal_rad - s.joints[i].position_rad, goal_rad - f.wanted_rad[i]
        room_rad = min(AWAY_RAD - way * ahead_rad, MOST_RAD - way * given_rad)
        ticks = way * max(0, min(way * ticks, math.floor(room_rad / TICK_RAD)))
        trims[i] += ticks * TICK_RAD
        goal[i] += s.wire[i].direction * ticks
        sides[i] = float(way)
        back[i] = ticks * TICK_RAD if share > WHOLE else 0.0
    s.state.following = replace(f, trim_rad=tuple(trims), side=tuple(sides))
    s.send_goal(goal)
    told = ", ".join([f"{s.arm.joints[i].name} {change:+d}" for i, change in enumerate(changes) if change])
    s.events.append(Event("info", "CORRECTED", f"at rest, by ticks: {told}"))
    return back
