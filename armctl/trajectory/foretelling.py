"""Where a servo is at its next reading, by what it was told: its motor and the masses that foretell it best. No arm.

The position controller (`docs/simulator.md`) sees whole ticks, and where in its tick a shaft is is not known. So what
is foretold is a mean over some places of it; how it changes with the numbers, which in whole ticks it does by leaps, is
taken from a controller whose output is the mean over all places. With each goal, a delay after it was sent, the ramp
goes on, or begins at the shaft. v: velocity, G: gravity, s: the side of v, inertia: that of motor and gears, and of the
masses about the axis:

    stall (output * voltage / 12 V - v / no_load) - inertia * dv/dt + G = s (coulomb + load_friction |G|)

A shaft that stands does so up to `ratio` times this friction. A heavy joint is not yet steady when it is read again:
so all of what lies between two readings is integrated, many stretches at once.

Ticks, outputs, velocities and gravity are the servo's own, counter-clockwise positive; h is a joint's index.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.transform import FloatArray

STEPS, LEAST_INERTIA_S2 = 50, 5e-4
FRICTION_SHARE = 0.08
# Where in its tick a shaft may be.
PLACES = (-0.375, -0.125, 0.125, 0.375)
# Of each number in `Motor`: what is likely, its standard deviation (of the first three as a share), and the difference
# by which a derivative is taken.
LIKELY = (
    (0.0, 0.12, 0.02), (0.0, 0.06, 0.02), (0.0, 1.5, 0.04), (0.075, 0.045, 0.01), (1.25, 0.15, 0.03),
    (0.034, 0.012, 0.002), (0.0015, 0.0015, 0.0003), (0.0, 0.014, 0.005),
)  # fmt: skip
# Shares of a servo's mass and the tool's.
SERVO_SHARE, TOOL_SHARE, SHARE_STEP = 0.09, 0.15, 0.02
# Stretches that are close to one another, and the same wrong equations, tell less than so many.
SPOILS = 20.0
# Rounds at most, the change in standard deviations after which there is none more, the longest way of one in steps; the
# deviations of what is foretold [tick, rad/s, share of full output], and from how many on one counts less. They are not
# taken from what is left: where all is wrong nothing would count.
ROUNDS, DONE, LEAP, OFF, FAR = 20, 0.1, 15.0, ((0.3,), (0.02,), (0.01,)), 2.0
# Whole ticks leave leaps, about which the last rounds go to and fro: the mean of these counts. Derivatives take most of
# the time; after the first rounds one serves several.
LAST, FIRST, SERVES = 10, 3, 4


class Motor(NamedTuple):
    """One joint's motor and gears."""

    stall_Nm: float
    no_load_rad_s: float
    coulomb_Nm: float
    load_friction: float
    stiction_ratio: float
    delay_s: float
    # Of motor and gears, over `stall_Nm`.
    inertia_s2: float
    # How far its position is beyond what its servo and the arm's file say.
    zero_rad: float


class Stretches(NamedTuple):
    """From one reading of a servo to the next, m times: arrays of shape (m,) where nothing else is said."""

    length_s: FloatArray
    # At their begins; the second: in which tick the controller sees the shaft.
    shaft_tick: FloatArray
    whole_tick: FloatArray
    ramp_tick: FloatArray
    velocity_rad_s: FloatArray
    # After which time a goal was sent, inf: none; goals [tick] and speeds [tick/s] before and after it, shape (2, m).
    sent_s: FloatArray
    goal_tick: FloatArray
    speed_tick_s: FloatArray
    from_reference: bool
    margin_tick: FloatArray
    punch: float
    # Output per tick.
    gain: float
    # Share of the rated voltage.
    volts: FloatArray
    # Of each weight, at begin and end, shape (2, m, weights): of each mass [N m/kg], and for each joint of all masses
    # again, what they gain as its position grows [N m/(kg rad)].
    gravity: FloatArray
    # Of each weight, at the begin, shape (m, weights); those for the joints have none.
    inertia_m2: FloatArray
    # How far the shaft went [tick], and at the end velocity and output: shape (3, m).
    seen: FloatArray


def output(stretches: Stretches, error_tick: FloatArray) -> FloatArray:
    """Of the controller at an error, the mean over all places in a tick, shape (m,)."""
    whole = np.floor(np.abs(error_tick))
    low, high = (
        np.where(beyond > 0.0, np.minimum(stretches.punch + beyond * stretches.gain, 1.0), 0.0)
        for beyond in (whole - stretches.margin_tick, whole + 1.0 - stretches.margin_tick)
    )
    return np.asarray(np.sign(error_tick) * (low + (np.abs(error_tick) - whole) * (high - low)))


def foretold(one: Stretches, weights: FloatArray, motor: Motor, place: FloatArray | float | None = None) -> FloatArray:
    """What is to be seen at the ends, as `Stretches.seen`.

    Args:
        place: Where in its tick each shaft begins; None: the mean over all places.
    """
    dt = one.length_s / STEPS
    sees: Callable[[FloatArray], FloatArray] = np.asarray if place is None else np.rint
    begin = one.shaft_tick if place is None else one.whole_tick + place
    x, ramp, v = begin, one.ramp_tick, one.velocity_rad_s
    gravity, waits = one.gravity @ weights, np.isfinite(one.sent_s)
    inertia = max(motor.inertia_s2, LEAST_INERTIA_S2) * motor.stall_Nm + one.inertia_m2 @ weights
    for i in range(STEPS):
        later = np.clip(i + 1.0 - (one.sent_s + motor.delay_s) / dt, 0.0, 1.0)  # share of the step after the new goal
        if not one.from_reference:
            begins = waits & (later > 0.0)
            ramp, waits = np.where(begins, sees(x), ramp), waits & ~begins
        G = gravity[0] + (gravity[1] - gravity[0]) * ((i + 0.5) / STEPS)
        friction = motor.coulomb_Nm + motor.load_friction * np.abs(G)
        torque = motor.stall_Nm * (output(one, sees(ramp) - sees(x)) * one.volts - v / motor.no_load_rad_s) + G
        side = np.where(v != 0.0, np.sign(v), np.sign(torque))
        after = v + (torque - side * friction) * dt / inertia
        stands = (v == 0.0) & (np.abs(torque) <= motor.stiction_ratio * friction)
        v = np.where(stands | (after * side <= 0.0), 0.0, after)
        x = x + v * dt / TICK_RAD
        for goal, speed, part_s in zip(one.goal_tick, one.speed_tick_s, ((1.0 - later) * dt, later * dt), strict=True):
            ramp = ramp + np.clip(goal - ramp, -speed * part_s, speed * part_s)
    return np.array([x - begin, v, output(one, sees(ramp) - sees(x))])


class Guess(NamedTuple):
    """What is usual: masses [kg], and of each joint strength, speed and, if it was seen, delay with its deviation."""

    kg: FloatArray
    stall_Nm: FloatArray
    no_load_rad_s: FloatArray
    # [s], shape (2, joints); NaN: not seen.
    delay_s: FloatArray

    def prior(self) -> FloatArray:
        """Standard deviations of all numbers: of masses, then of each joint's `Motor`."""
        motors = np.tile([sd for _, sd, _ in LIKELY], (len(self.stall_Nm), 1))
        at = Motor._fields.index("delay_s")
        motors[:, at] = np.where(np.isnan(self.delay_s[1]), motors[:, at], self.delay_s[1])
        return np.concatenate([[SERVO_SHARE] * (len(self.kg) - 1), [TOOL_SHARE], motors.ravel()])

    def means(self, theta: FloatArray, h: int) -> tuple[FloatArray, Motor]:
        """Weights (masses [kg], and those times the zeros of each joint [rad]), and the motor of a joint."""
        n = len(self.kg)
        zeros_rad = theta[n + len(LIKELY) - 1 :: len(LIKELY)]
        a = theta[n + len(LIKELY) * h :][: len(LIKELY)] + [usual for usual, _, _ in LIKELY]
        stall_Nm, seen_s = float(self.stall_Nm[h] * math.exp(a[0])), self.delay_s[0, h]
        delay_s = float(a[5] if np.isnan(seen_s) else seen_s + theta[n + len(LIKELY) * h + 5])
        return np.outer([1.0, *zeros_rad], self.kg * np.exp(theta[:n])).ravel(), Motor(
            stall_Nm, float(self.no_load_rad_s[h] * math.exp(a[1])), stall_Nm * FRICTION_SHARE * math.exp(a[2]),
            max(float(a[3]), 0.0), max(float(a[4]), 1.0), max(delay_s, 0.0), float(a[6]), float(a[7]),
        )  # fmt: skip


def fit(guess: Guess, seen: Mapping[int, Stretches]) -> tuple[FloatArray, FloatArray]:
    """The numbers (see `Guess.prior`) that foretell best what was seen of some joints, and their covariance."""
    prior, n = guess.prior(), len(guess.kg)
    step = np.concatenate([[SHARE_STEP] * n, np.tile([one for _, _, one in LIKELY], len(guess.stall_Nm))])
    theta: FloatArray = np.zeros(len(prior))
    cov: FloatArray = np.diag(prior**2)
    slopes: dict[int, FloatArray] = {}
    way = []
    for count in range(ROUNDS):
        if count < FIRST or count % SERVES == 0:
            slopes.clear()
        bend, lean = np.diag(prior**-2), theta * prior**-2
        for own, J, r in _slopes(guess, seen, theta, step, slopes):
            bend[np.ix_(own, own)] += J @ J.T / SPOILS
            lean[own] += J @ r / SPOILS
        cov = np.asarray(np.linalg.inv(bend))
        change = -cov @ lean
        theta = theta + np.clip(change, -LEAP * step, LEAP * step)
        if np.abs(change / np.sqrt(np.diag(cov))).max() < DONE:
            return theta, cov
        way.append(theta)
    return np.mean(way[-LAST:], axis=0), cov


def _slopes(
    guess: Guess, seen: Mapping[int, Stretches], theta: FloatArray, step: FloatArray, slopes: dict[int, FloatArray]
) -> Iterator[tuple[NDArray[np.int64], FloatArray, FloatArray]]:
    """Of each joint that was seen: which numbers count, the derivatives, and what is left, in standard deviations.

    Args:
        slopes: Those of the joints that are made already.
    """
    n = len(guess.kg)
    for h, one in seen.items():

        def left(theta: FloatArray, place: float | None = None, h: int = h, one: Stretches = one) -> FloatArray:
            return foretold(one, *guess.means(theta, h), place) - one.seen

        felt = (np.abs(one.gravity).max(axis=(0, 1)) > 1e-6).reshape(-1, n)
        zeros = n - 1 + len(LIKELY) * (1 + np.flatnonzero(felt[1:].any(axis=1)))
        own = np.unique(np.r_[np.flatnonzero(felt[0]), zeros, n + len(LIKELY) * h + np.arange(8)])
        r = np.mean([left(theta, place) for place in PLACES], axis=0)
        weight = 1.0 / np.sqrt(np.maximum(1.0, np.abs(r) / np.multiply(FAR, OFF))) / OFF
        if h not in slopes:
            here = left(theta)
            slopes[h] = np.array([(left(theta + d) - here) / d.max() for d in np.eye(len(theta))[own] * step])
        yield own, (weight * slopes[h]).reshape(len(own), -1), (weight * r).ravel()
