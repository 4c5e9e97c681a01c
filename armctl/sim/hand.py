"""The hand that guides an arm: a torque-limited spring and damper at every joint, pulling along a path.

One take: carry the arm from where it is to the start, dwell, lead the tool roughly along a straight line, dwell,
and then support the arm at the end until `release` or the next take. A person does neither follow the line nor
begin and end on its ends: a smooth random wobble, drawn by the take's seed, is added along each axis, the
posture differs a little, and the speed varies about a minimum-jerk profile. The hand is strong enough for a limp arm;
a powered one resists it.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import UnreachableTarget
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.transform import FloatArray

# Fastest joint while the arm is carried to the start.
CARRY_SPEED_RAD_S = 0.8
CARRY_MIN_S = 1.0
DWELL_BEFORE_S = 0.7
DWELL_AFTER_S = 1.2
# Range of the time along the line when none is asked for.
DURATION_S = (4.2, 5.8)
# Inverse kinematics is solved this often; straight joint-space lines in between.
KNOT_S = 0.04
# Range of the wobble's amplitude along each axis.
WOBBLE_M = (0.005, 0.015)
# Waves of wobble along the line, each weaker than the one before.
WOBBLE_CYCLES = (0.4, 1.0, 1.7)
# Standard deviation of the posture among takes.
POSTURE_RAD = 0.05
STIFFNESS_NM_RAD = 60.0
DAMPING_NM_S = 0.6
# Of the hand at one joint.
MAX_TORQUE_NM = 2.0


def hand_torque(behind_rad: float, slower_rad_s: float) -> float:
    """Torque of the hand [N m] on a joint that is so far behind its aim and so much slower; 0 without an aim, nan."""
    if math.isnan(behind_rad):
        return 0.0
    return min(max(STIFFNESS_NM_RAD * behind_rad + DAMPING_NM_S * slower_rad_s, -MAX_TORQUE_NM), MAX_TORQUE_NM)


class Guided(NamedTuple):
    """When a take happens, in seconds from its acceptance."""

    # Everything: carrying, both dwells and the line.
    duration_s: float
    # The tool leaves for the line's end.
    begin_s: float
    # It has arrived there.
    end_s: float


@dataclass(eq=False)
class _Take:
    seed: int
    start_s: float
    # Where the arm was taken up.
    from_rad: list[float]
    line_m: tuple[FloatArray, FloatArray]
    # Shape (waves, 3).
    amplitude_m: FloatArray
    phase_rad: FloatArray
    # Weights of the sines that vary the speed.
    pace: FloatArray
    # Where the hand is along the line, every `KNOT_S`; as far as it is solved.
    knots_rad: list[list[float]] = field(default_factory=list)
    when: Guided = field(init=False)


class Hand:
    """A person's hand at a simulated arm; it begins with hands off."""

    def __init__(
        self, arm: ArmConfig, chain: SerialChain, now_s: Callable[[], float], positions_rad: Callable[[], FloatArray]
    ) -> None:
        """
        Args:
            chain: The arm's true geometry.
            now_s: Tells the arm's time.
            positions_rad: Tells where its joints truly are, shape (n,).
        """
        self._chain, self._now_s, self._positions_rad = chain, now_s, positions_rad
        self._take: _Take | None = None
        # Asked for more than once in each moment of a take.
        self._aim = lru_cache(maxsize=1)(self._aim_in)
        self._limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
        span = self._limits[:, 1] - self._limits[:, 0]
        # Bent the same way at every joint beyond the second: an arm arched over its work, far from its stops.
        self._posture = self._limits.mean(axis=1) - 0.2 * span * (np.arange(chain.n) >= 2)

    @property
    def holding(self) -> bool:
        """Whether the hand is at the arm."""
        return self._take is not None

    def moment(self, time_s: float) -> tuple[int, float]:
        """The seed of the take under way, and the time since it began; 0 and all the arm's time with hands off."""
        return (0, time_s) if self._take is None else (self._take.seed, time_s - self._take.start_s)

    def guide(self, from_m: FloatArray, to_m: FloatArray, *, seed: int, duration_s: float | None = None) -> Guided:
        """Begin a take now, from wherever the arm is; one under way is broken off.

        Args:
            from_m: Begin of the line in the base frame [m], shape (3,).
            to_m: End of the line [m], shape (3,).
            duration_s: Time along the line; by the seed when None.
        Raises:
            UnreachableTarget: an end of the line, or its middle, is out of reach.
            ValueError: the duration is not positive.
        """
        if duration_s is not None and not 0.0 < duration_s < math.inf:
            raise ValueError(f"duration_s {duration_s}: a take lasts longer than 0 s")
        rng = np.random.default_rng(seed)
        line = (np.asarray(from_m, dtype=np.float64), np.asarray(to_m, dtype=np.float64))
        peak = rng.uniform(*WOBBLE_M, size=3)
        guess = self._posture + POSTURE_RAD * rng.standard_normal(self._chain.n)
        line_s = float(rng.uniform(*DURATION_S)) if duration_s is None else duration_s
        take = _Take(
            seed=seed,
            start_s=self._now_s(),
            from_rad=self._held_rad(),
            line_m=line,
            amplitude_m=np.array([0.5, 0.3, 0.2])[:, None] * peak,
            phase_rad=rng.uniform(0.0, 2.0 * math.pi, size=(len(WOBBLE_CYCLES), 3)),
            pace=rng.uniform(-0.3, 0.3, size=2),
        )
        # The line's own points are required, the wobble is not.
        q = guess
        for share_of_line in (0.0, 0.5, 1.0):
            q = solve_position(self._chain, line[0] + share_of_line * (line[1] - line[0]), q, self._limits)
        take.knots_rad.append(self._solve(take, 0.0, line_s, guess))
        return self._begin(take, line_s, DWELL_AFTER_S)

    def hold(self, joints_rad: FloatArray, free: int | None = None) -> Guided:
        """Lead every joint to a position [rad], shape (n,), and hold it there, as one does who sets an arm up.

        Args:
            free: Index of a joint that is left alone from now on.
        """
        to_rad = [math.nan if i == free else float(q) for i, q in enumerate(joints_rad)]
        from_rad, nothing = self._held_rad(), np.zeros(3)
        take = _Take(0, self._now_s(), from_rad, (nothing, nothing), nothing, nothing, nothing, [to_rad, to_rad])
        return self._begin(take)

    def _begin(self, take: _Take, line_s: float = 0.0, after_s: float = 0.0) -> Guided:
        """Take the arm up, from now on; when which part of it happens."""
        ways = (abs(to - at) for to, at in zip(take.knots_rad[0], take.from_rad, strict=False) if not math.isnan(to))
        # Minimum jerk peaks at 1.875 of its mean.
        begin_s = max(CARRY_MIN_S, 1.875 * max(ways, default=0.0) / CARRY_SPEED_RAD_S) + DWELL_BEFORE_S
        take.when = Guided(begin_s + line_s + after_s, begin_s, begin_s + line_s)
        self._take = take
        return take.when

    def _held_rad(self) -> list[float]:
        """Where every joint is held; one that already is keeps being so, else the arm would sag for a moment."""
        here_rad = self._positions_rad().tolist()
        aims_rad = self.aim(self._now_s())[0] if self.holding else here_rad
        return [here if math.isnan(aim) else aim for aim, here in zip(aims_rad, here_rad, strict=True)]

    def release(self) -> None:
        """Let go of the arm."""
        self._take = None

    def aim(self, time_s: float) -> tuple[list[float], list[float]]:
        """Where a hand that holds wants every joint [rad], and how fast [rad/s], at a time of the arm."""
        take = self._take
        assert take is not None
        time_s -= take.start_s
        if time_s - take.when.begin_s >= take.when.end_s - take.when.begin_s:
            time_s = math.inf  # the aim stays
        return self._aim(take, time_s)

    def _aim_in(self, take: _Take, time_s: float) -> tuple[list[float], list[float]]:
        others = take.from_rad[len(take.knots_rad[0]) :]
        ahead_s = 1e-3
        here, there = self._at(take, time_s), self._at(take, time_s + ahead_s)
        return here + others, [(b - a) / ahead_s for a, b in zip(here, there, strict=True)] + [0.0] * len(others)

    def _at(self, take: _Take, time_s: float) -> list[float]:
        """Aim of the chain's joints [rad] at a time within the take."""
        begin_s, end_s = take.when.begin_s, take.when.end_s
        if time_s < begin_s:
            s = _minimum_jerk(time_s / (begin_s - DWELL_BEFORE_S))
            return [a + s * (b - a) for a, b in zip(take.from_rad, take.knots_rad[0], strict=False)]
        line_s = end_s - begin_s
        x = min(time_s - begin_s, line_s) / KNOT_S
        k = int(x)
        # Solved one by one as time passes, so that no single call takes long.
        while len(take.knots_rad) < k + 2:
            knot_s = min(len(take.knots_rad) * KNOT_S, line_s)
            take.knots_rad.append(self._solve(take, knot_s, line_s, np.array(take.knots_rad[-1])))
        before, after = take.knots_rad[k], take.knots_rad[k + 1]
        return [a + (x - k) * (b - a) for a, b in zip(before, after, strict=True)]

    def _solve(self, take: _Take, time_s: float, line_s: float, guess: FloatArray) -> list[float]:
        u = time_s / line_s
        # Time itself is bent, staying monotone: the weights' sum is below 1.
        bent = u + sum(float(w) * math.sin(k * math.pi * u) / (k * math.pi) for k, w in enumerate(take.pace, start=1))
        line_from, line_to = take.line_m
        wobble = np.zeros(3)
        for cycles, amplitude, phase in zip(WOBBLE_CYCLES, take.amplitude_m, take.phase_rad, strict=True):
            wobble += amplitude * np.sin(2.0 * math.pi * cycles * u + phase)
        on_line = line_from + _minimum_jerk(bent) * (line_to - line_from)
        # Where the wobble leads out of reach the hand keeps to the line, and where that does too it waits.
        for target in (on_line + wobble, on_line):
            with contextlib.suppress(UnreachableTarget):
                guess = solve_position(self._chain, target, guess, self._limits, tolerance_m=1e-5, iterations=50)
                break
        return [float(angle) for angle in guess]


def _minimum_jerk(u: float) -> float:
    """Share of the way at the share u of the time, at rest at both ends."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))
