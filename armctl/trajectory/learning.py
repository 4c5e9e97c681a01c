"""An arm's lag model learnt from the motions that it makes anyway.

Rules.
1. The sums (`lag.Summary`) of each motion that ended well are kept, of the last `KEPT`. Same motions, same model.
2. A sample is goal less reading, both at the instant of the reading. It counts once the joint has gone a way in this
   motion (see `lag.summary`).
3. A joint's coefficients, fitted to all but the newest motions, have to predict these better than those in use do.
   Then the fit to all of them takes their place, each joint by itself.
4. A motion that leaves far more than the model is known to leave tells of a change: a heavier tool, more friction,
   another arm. It is told, and changes no model. After a second one what was learnt before is forgotten, and the model
   stays until rule 3 finds a better one; was the next motion as foreseen, the strange one is forgotten.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.transform import FloatArray
from armctl.messages import LagModel
from armctl.trajectory import lag
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.lag import Summary

# Motions that are kept, and without which nothing is judged.
KEPT, FEWEST = 40, 5
# What share of them is held out to judge a model by, and how many at least.
HELD_SHARE, HELD = 0.25, 2
# What a model has to leave of the held-out motions, of what the one in use leaves.
BETTER = 0.97
# A change: so many times what the model is known to leave of a joint's lag, and so many ticks more.
CHANGED, CHANGED_TICK = 2.5, 1.0
# After so many motions in a row that tell of a change what was learnt before them is forgotten.
STRANGE = 2
# Samples of a joint without which a motion tells nothing of it.
SAMPLES = 15


class Seen(NamedTuple):
    """One motion, tick by tick: m ticks from its first goal on, n joints of the chain."""

    # When each goal is due [s], shape (m,).
    due_s: FloatArray
    # The goals as they were sent, and where the joints are wanted then [rad], shape (m, n).
    goals_rad: FloatArray
    wanted_rad: FloatArray
    # When each joint was read [s], and what it said [rad], shape (m, n).
    read_s: FloatArray
    positions_rad: FloatArray
    # Whether it answered, shape (m, n).
    fresh: NDArray[np.bool_]


def sums_of(chain: SerialChain, seen: Seen, period_s: float) -> Summary:
    """What a motion tells while it lasts."""
    n, wanted, due_s = chain.n, seen.wanted_rad, seen.due_s
    going = np.flatnonzero(np.diff(wanted, axis=0).any(axis=1))
    end = int(going[-1]) + 1 if len(going) else 0
    X = lag.regressors(chain, wanted, np.zeros(n), period_s)
    X[:, :, n + 1] = np.gradient(wanted, due_s, axis=0).T
    # Goals and regressors are those of the instant at which each joint was read.
    y, at = np.empty_like(wanted), np.empty_like(X)
    for i in range(n):
        then = columns_at(seen.read_s[:, i], due_s, np.column_stack([seen.goals_rad[:, i], X[i]]))
        y[:, i], at[i] = then[:, 0] - seen.positions_rad[:, i], then[:, 1:]
    within = (seen.read_s >= due_s[0]) & (seen.read_s <= due_s[end])
    return lag.summary(y, at, seen.fresh & within)


class Experience(NamedTuple):
    """What is kept of an arm's motions, the oldest first, and how many of them in a row told of a change."""

    motions: tuple[Summary, ...] = ()
    strange: int = 0


class Lesson(NamedTuple):
    """What one motion more has taught."""

    experience: Experience
    # What is to be used from now on; None: what is in use.
    model: LagModel | None = None
    # What is not as the model says; empty: nothing.
    change: str = ""


def learn(arm: ArmConfig, chain: SerialChain, experience: Experience, present: LagModel, latest: Summary) -> Lesson:
    """Take in one motion more.

    Args:
        present: The model in use; the nominal one has no residuals, and so no change is told of it.
    """
    change = changed(arm, present, latest)
    strange = experience.strange + 1 if change else 0
    known = experience.motions
    if strange == STRANGE:
        known = known[-1:]
    elif experience.strange == 1 and not change:
        known = known[:-1]
    motions = (*known, latest)[-KEPT:]
    found = None if strange == 1 else better(arm, chain, motions, present)
    return Lesson(Experience(motions, strange if found is None else 0), found, change)


def changed(arm: ArmConfig, present: LagModel, latest: Summary) -> str:
    """What a motion shows that the model in use cannot explain; empty: nothing."""
    if not present.residual_tick:
        return ""
    left = latest.rms_rad(np.array(present.rows)) / TICK_RAD
    worst = [
        f"{joint.name} was {now:.1f} ticks off what was foreseen ({known:.1f} before)"
        for joint, now, known, count in zip(arm.joints, left, present.residual_tick, latest.count, strict=False)
        if count >= SAMPLES and now > max(CHANGED * known, known + CHANGED_TICK)
    ]
    if not worst:
        return ""
    return f"the arm is not as its model says: {'; '.join(worst)}; if it is to stay so, `armctl calibrate --sag`"


def better(arm: ArmConfig, chain: SerialChain, motions: Sequence[Summary], present: LagModel) -> LagModel | None:
    """A model of all motions, if one of all but the newest predicts these better than the one in use; else None."""
    if len(motions) < FEWEST:
        return None
    held = max(HELD, round(HELD_SHARE * len(motions)))
    newest = lag.total(motions[-held:])
    in_use = np.array(present.rows)
    trial = np.array(lag.fitted(arm, chain, motions[:-held]).rows)
    wins = (newest.squares(trial) < BETTER**2 * newest.squares(in_use)) & (newest.count >= SAMPLES)
    if not wins.any():
        return None
    return lag.model_of(arm, np.where(wins[:, None], np.array(lag.fitted(arm, chain, motions).rows), in_use), motions)
