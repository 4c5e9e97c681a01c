"""What an arm's servos are like, found from what they were told and what they said: pure numbers, no arm.

Rules.
1. A servo's output tells where its speed ramp is: |error| = margin + (|output| - punch) / gain, in whole ticks. The
   ramp itself follows from goals and speeds as they were sent. What lies between the two is the delay; and which of two
   ramps fits, one that goes on or one that begins at the shaft, tells `ramp_from_reference`.
2. One reading foretells the next (`foretelling.py`), for all joints at once: the masses, zeros, strengths and frictions
   that do so best, and are likely beforehand. Ramps that begin at the shaft show their delay by this alone.
3. A joint that stands bears at most its stiction: what it bore last before it broke away tells the ratio.
4. A joint that stands while gravity on it turns over crosses its play, and its goal and motor do not.
5. What the data do not show is left out, and said in words. Standard deviations are those of the fit, and no less than
   what the equations leave out (`FLOOR`).

Ticks, outputs, velocities and gravity are the servo's own, counter-clockwise positive; h is a joint's index.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import LOAD_MAX, TICK_RAD
from armctl.dynamixel.servos import MODELS
from armctl.kinematics.chain import SerialChain, cross, joint_axes
from armctl.kinematics.transform import FloatArray
from armctl.trajectory import foretelling, lag

RATED_V, SERVO_KG, TOOL_KG = 12.0, 0.0746, 0.08
DELAYS_S = np.arange(0.0, 0.1, 0.001)
# A delay whose standard deviation would be larger was not seen; what is farther off a ramp is none of it.
UNSEEN_DELAY_S, OUTLIER_TICK = 0.008, 8.0
# An output that is not limited; two readings that follow one another; what is usual where it was not seen.
FULL, GAP_S, USUAL = 0.9, 0.3, {"delay_ms": (34.0, 12.0), "noise_tick": (1.0, 0.5)}
# A delay that only motions tell is told if it is known so well [s]; stretches of motion that tell all.
SEEN_DELAY_S, STRETCHES = 0.004, 1500
# A friction is told if it is known so well (as a share).
SEEN_FRICTION = 0.076
# Samples without which nothing is said, and with which all is; of a stand on either side of a play, and before it.
FEWEST, MOST, STAND, SETTLES = 40, 20_000, 15, 8
# Gravity that pushes a shaft to an end of its play [N m], and what of its friction may turn its motor.
PUSHES_NM, TURNS = 0.02, 0.75
# The least standard deviations: friction, speed, slope (shares), play [deg], delay [s].
FLOOR = {"friction": 0.055, "speed": 0.06, "play": 0.02, "delay": 0.0015, "jump": 0.003, "slope": 0.02}
QUANTITIES = ("coulomb_Nm", "stiction_ratio", "slope_tick", "punch", "play_deg", "delay_ms")


class Trace(NamedTuple):
    """Servos tick by tick: m ticks, n joints (of pairs the first servo); arrays of shape (m, n), but `sent_s` (m,)."""

    # When each servo was read, and when goals were sent [s]; NaN: none was.
    read_s: FloatArray
    sent_s: FloatArray
    # What was sent [tick, tick/s], and the goal that each servo showed before [tick].
    goal_tick: FloatArray
    speed_tick_s: FloatArray
    shown_tick: FloatArray
    position_tick: FloatArray
    # Share of full output, and speed [rad/s].
    output: FloatArray
    velocity_rad_s: FloatArray
    voltage_V: FloatArray
    # As the registers have them; punch as a share of full output.
    margin_tick: FloatArray
    slope_tick: FloatArray
    punch: FloatArray
    # Whether it answered, and had torque.
    known: NDArray[np.bool_]

    @classmethod
    def joined(cls, traces: Sequence[Self]) -> Self:
        """One after the other; what two hold counts once, and clocks may begin anew."""
        parts: list[dict[str, Any]] = []
        last_s, later_s = -math.inf, 0.0
        for trace in traces:
            begin_s, end_s = np.quantile(trace.read_s[:, 0], (0.0, 1.0)).tolist()
            new = trace.read_s[:, 0] > (last_s if begin_s < last_s < end_s else -math.inf)
            later_s += 0.0 if end_s > last_s else last_s  # the machine was started anew
            part = {name: column[new] for name, column in trace._asdict().items()}
            parts.append(part | {key: part[key] + later_s for key in ("read_s", "sent_s")})
            last_s = end_s
        return cls(**{name: np.concatenate([part[name] for part in parts]) for name in cls._fields})


@dataclass(eq=False)
class JointFound:
    """What was found of one joint: values with their standard deviations, and why of `QUANTITIES` some are missing.

    Beside these it has `zero_deg`, `stall_Nm`, `no_load_rad_s`, `load_friction`, `noise_tick` and `gain` (output
    per tick).
    """

    name: str
    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    unseen: dict[str, str] = field(default_factory=dict)
    # Of friction and delay, told or not, what is likely by all that was seen: a twin has this.
    likely: dict[str, tuple[float, float]] = field(default_factory=dict)
    # How much better a ramp that goes on explains it than one from the shaft: logarithm of the ratio of likelihoods.
    ramp_evidence: float = 0.0

    def __getitem__(self, key: str) -> float:
        return self.values[key][0]


class Found(NamedTuple):
    joints: list[JointFound]
    # On each axis, midway to the tool and at the tool.
    points_kg: list[float]

    @property
    def ramp_from_reference(self) -> bool | None:
        """None: no joint shows it."""
        evidence = sum(joint.ramp_evidence for joint in self.joints)
        return evidence > 0.0 if evidence else None


def identify(arm: ArmConfig, chain: SerialChain, trace: Trace) -> Found:
    """What is known of an arm by a trace."""
    joints = [JointFound(joint.name) for joint in arm.joints]
    for h, found in enumerate(joints):
        _fit_controller(trace, h, found)
    directions = np.array([joint.direction for joint in arm.joints])
    q = directions * TICK_RAD * (trace.position_tick - [joint.zero_tick for joint in arm.joints])
    # The masses, and what they gain as each joint goes on.
    gains = [(burdens(arm, chain, q + d) - burdens(arm, chain, q - d)) / 2e-4 for d in 1e-4 * np.eye(len(joints))]
    loads = np.concatenate([burdens(arm, chain, q), *gains], axis=3)
    loads[0] *= directions[:, None, None]
    loads[1, :, :, chain.n + 1 :] = 0.0
    weights = _balance(arm, trace, loads, joints)
    for h, found in enumerate(joints):
        _fit_stiction(trace, h, loads[0, h] @ weights, found)
        _fit_play(trace, h, loads[0, h] @ weights, found)
        value, sd = found.values.get("coulomb_Nm", (1.0, 0.0))
        if sd > SEEN_FRICTION * value:
            del found.values["coulomb_Nm"]
            found.unseen["coulomb_Nm"] = f"no load shows its strength; {value / found['stall_Nm']:.1%} of that"
    return Found(joints, [SERVO_KG, *weights[: chain.n + 1].tolist()])


# ------------------------------------------------------------------------------------------- the controller


def ramp_tick(trace: Trace, h: int, at_s: FloatArray, delay_s: float, *, from_reference: bool) -> FloatArray:
    """Where the speed ramp of a servo is at some instants [s] from its first goal on [tick], shape as the instants."""
    sent = np.flatnonzero(np.isfinite(trace.sent_s))
    begin_s, goal, speed = trace.sent_s[sent], trace.goal_tick[sent, h], trace.speed_tick_s[sent, h]
    k = np.maximum(np.searchsorted(begin_s + delay_s, at_s, side="right") - 1, 0)
    if from_reference:
        begin, here, before_s = np.empty(len(sent)), 0.0, -math.inf
        columns = begin_s, trace.shown_tick[sent, h], goal, np.diff(begin_s, append=math.inf) * speed
        for j, (now_s, shown, to, way) in enumerate(zip(*(one.tolist() for one in columns), strict=True)):
            begin[j] = here = shown if now_s - before_s > GAP_S else here
            here, before_s = to if abs(to - here) <= way else here + math.copysign(way, to - here), now_s
        start = begin[k]
    else:
        start = np.interp(begin_s[k] + delay_s, trace.read_s[:, h], trace.position_tick[:, h])
    left, since_s = goal[k] - start, np.maximum(at_s - begin_s[k] - delay_s, 0.0)
    return np.asarray(start + np.sign(left) * np.minimum(np.abs(left), speed[k] * since_s))


def _told(trace: Trace, h: int) -> NDArray[np.bool_]:
    """Ticks of which it is known where the ramp is, shape (m,)."""
    sent_s = trace.sent_s[np.isfinite(trace.sent_s)]
    begun_s = sent_s[0] + DELAYS_S[-1] if len(sent_s) else math.inf
    return np.asarray(trace.known[:, h] & (trace.read_s[:, h] > begun_s))


def _fit_controller(trace: Trace, h: int, found: JointFound) -> None:
    """Slope, punch, delay and kind of ramp of one joint (rule 1)."""
    output = trace.output[:, h]
    rows = np.flatnonzero(_told(trace, h) & (output != 0.0) & (np.abs(output) < FULL))
    rows = rows[:: 1 + len(rows) // MOST]
    output, at_s, at = output[rows], trace.read_s[rows, h], trace.position_tick[rows, h]
    if len(rows) < FEWEST / 4:
        found.unseen |= dict.fromkeys(("slope_tick", "punch", "delay_ms"), "it hardly worked")
        return
    usual, seen = float(np.median(trace.punch[rows, h])), lattice(np.abs(output))
    gain, least = seen or ((1.0 - usual) / float(np.median(trace.slope_tick[rows, h])), usual)
    # Levels do not tell with which whole error they begin; its register tells about where.
    punch = least + gain * round((usual - least) / gain)
    error = np.sign(output) * (trace.margin_tick[rows, h] + (np.abs(output) - punch) / gain)
    rss = {}
    for kind in (True, False):
        ramps = np.array([ramp_tick(trace, h, at_s, delay_s, from_reference=kind) for delay_s in DELAYS_S])
        rss[kind] = np.square(np.clip(ramps - at - error, -OUTLIER_TICK, OUTLIER_TICK)).sum(axis=1)
    found.ramp_evidence = len(at) / 2.0 * math.log(rss[False].min() / rss[True].min())
    curve = rss[found.ramp_evidence > 0.0]
    k, slope_tick = int(curve.argmin()), (1.0 - punch) / gain
    variance = float(curve[k]) / (len(at) - 1.0)
    if seen is None:
        found.unseen |= dict.fromkeys(("slope_tick", "punch"), "its output was seen in too few steps")
    else:
        found.values["slope_tick"] = slope_tick, slope_tick * FLOOR["slope"]
        found.values["punch"] = LOAD_MAX * punch, LOAD_MAX * 0.05 * gain
        found.values["gain"] = gain, gain * FLOOR["slope"]
    if found.ramp_evidence < 0.0 or seen is None:
        found.unseen["delay_ms"] = "no motion was fast enough to show it" if seen else "see slope_tick"
        return
    found.values["noise_tick"] = math.sqrt(max(variance - 2.0 / 12.0, 0.0)), 0.1
    near = np.abs(np.arange(len(DELAYS_S)) - k) <= 15
    bend, lean, _ = np.polyfit(DELAYS_S[near] - DELAYS_S[k], curve[near], 2).tolist()
    if bend <= 0.0 or math.sqrt(variance / bend) > UNSEEN_DELAY_S:
        found.unseen["delay_ms"] = "no motion was fast enough to show it"
        return
    delay_s = min(max(DELAYS_S[k] - lean / (2.0 * bend), 0.0), DELAYS_S[-1])
    found.values["delay_ms"] = 1e3 * delay_s, 1e3 * math.hypot(1.4 * math.sqrt(variance / bend), FLOOR["delay"])


def lattice(output: FloatArray) -> tuple[float, float] | None:
    """Output per tick, and where outputs > 0, shape (m,), begin, less whole ticks; None: too few levels were seen.

    The widest lattice that explains all levels is the one.
    """
    levels, counts = np.unique(output, return_counts=True)
    levels = levels[counts >= 2]
    if len(output) < FEWEST or len(levels) < 3:
        return None
    for gain in 1.0 / np.geomspace(2.0, 150.0, 3000):
        offset = float(np.angle(np.exp(2j * np.pi * levels / gain).mean())) / (2.0 * np.pi) * gain
        k = np.round((levels - offset) / gain)
        if np.ptp(k) >= 2 and np.abs(levels - offset - k * gain).max() < 1.2 / LOAD_MAX:
            b, a = np.polyfit(k, levels, 1).tolist()
            return b, a % b
    return None


# ------------------------------------------------------------------------------------------------ friction


def usual_kg(arm: ArmConfig, n: int) -> FloatArray:
    """Masses of an arm nobody has weighed: on each axis of the chain but the first, midway to the tool, the tool's."""
    servos = [1 if joint.pair is None else 2 for joint in arm.joints]
    return np.array([*(SERVO_KG * k for k in servos[1:n]), SERVO_KG * sum(servos[n:]), TOOL_KG])


def burdens(arm: ArmConfig, chain: SerialChain, q: FloatArray) -> FloatArray:
    """Gravity [N m/kg] and inertia [m^2] of each mass about each joint, at positions q [rad], shape (m, joints).

    Returns:
        Both, shape (2, joints, m, n + 1).
    """
    axes, tool_m = joint_axes(chain, q[:, : chain.n])
    points = [*(origin for _, origin in axes[1:]), (axes[-1][1] + tool_m) / 2.0, tool_m]
    found = np.zeros((2, len(arm.joints), len(q), len(points)))
    for h, (axis, origin) in enumerate(axes):
        for k in range(h, len(points)):
            arm_m = cross(axis, points[k] - origin)
            found[:, h, :, k] = -lag.GRAVITY_M_S2 * arm_m[2], np.square(arm_m).sum(axis=0)
    return found


def _balance(arm: ArmConfig, trace: Trace, loads: FloatArray, joints: Sequence[JointFound]) -> FloatArray:
    """The weights of `loads` (see `Stretches.gravity`); what else motions tell goes to the joints (rule 2)."""
    models = [MODELS[joint.model] for joint in arm.joints]
    strong = [model.stall_torque_Nm * (1 if j.pair is None else 2) for model, j in zip(models, arm.joints, strict=True)]
    delays = [joint.values.get("delay_ms", (math.nan, math.nan)) for joint in joints]
    speeds = np.array([model.no_load_speed_rad_s for model in models])
    kg = usual_kg(arm, loads.shape[3] // (1 + len(joints)) - 1)
    guess = foretelling.Guess(kg, np.array(strong), speeds, 1e-3 * np.array(delays).T)
    seen = {h: _stretches(trace, h, loads[:, h], found) for h, found in enumerate(joints) if "gain" in found.values}
    theta, cov = foretelling.fit(guess, {h: one for h, one in seen.items() if len(one.length_s)})
    count = len(foretelling.LIKELY)
    for h, joint in enumerate(joints):
        motor, at = guess.means(theta, h)[1], len(guess.kg) + count * h + np.arange(count)
        sds = foretelling.Motor(*np.sqrt(np.diag(cov)[at]).tolist())
        both = math.sqrt(float(cov[np.ix_(at[[0, 2]], at[[0, 2]])].sum()))
        free = motor.no_load_rad_s
        joint.values["zero_deg"] = math.degrees(motor.zero_rad), math.degrees(sds.zero_rad)
        joint.values["stall_Nm"] = motor.stall_Nm, motor.stall_Nm * sds.stall_Nm
        joint.values["no_load_rad_s"] = free, free * math.hypot(sds.no_load_rad_s, FLOOR["speed"])
        joint.values["load_friction"] = motor.load_friction, sds.load_friction
        joint.likely["delay_ms"] = delay = 1e3 * motor.delay_s, 1e3 * math.hypot(sds.delay_s, FLOOR["jump"])
        joint.likely["coulomb_Nm"] = friction = motor.coulomb_Nm, motor.coulomb_Nm * math.hypot(both, FLOOR["friction"])
        v = seen[h].seen[1] if h in seen else np.zeros(0)
        if min((v > 0.0).sum(), (v < 0.0).sum()) < FEWEST / 4:
            joint.unseen["coulomb_Nm"] = "it did not slide long enough, both ways" if h in seen else "see slope_tick"
            continue
        joint.values["coulomb_Nm"] = friction
        if "delay_ms" not in joint.values and sds.delay_s <= SEEN_DELAY_S:
            joint.values["delay_ms"] = delay
            joint.unseen.pop("delay_ms", None)
    return guess.means(theta, 0)[0]


def _stretches(trace: Trace, h: int, loads: FloatArray, found: JointFound) -> foretelling.Stretches:
    """Where a joint slides one way or breaks away, so that its motor stays on one side of its play."""
    t, v, output, margin = (one[:, h] for one in (trace.read_s, trace.velocity_rad_s, trace.output, trace.margin_tick))
    gain, punch = found["gain"], found["punch"] / LOAD_MAX
    delay_s, noise_tick = (found.values.get(key, usual)[0] for key, usual in USUAL.items())
    ramp = ramp_tick(trace, h, t, 1e-3 * delay_s, from_reference=found.ramp_evidence > 0.0)
    # The shaft, once by what it says, and once by what its output tells of its error.
    worked = ramp - np.sign(output) * (margin + (np.abs(output) - punch) / gain)
    said_var, worked_var = noise_tick**2 + 1.0 / 12.0, 1.0 / 6.0
    said = trace.position_tick[:, h]
    both = worked + (said - worked) * worked_var / (said_var + worked_var)
    x = np.where(output != 0.0, both, np.clip(said, ramp - 1.0 - margin, ramp + 1.0 + margin))
    behind = np.where(output != 0.0, worked, np.clip(said, ramp - margin, ramp + margin)) - ramp
    k = np.arange(1, len(t) - 1)
    sides = np.sign([v[:-2], v[1:-1], v[2:]])
    one_way = np.abs(sides.sum(axis=0)) == np.abs(sides).sum(axis=0)
    told, limited = _told(trace, h), np.abs(output) >= FULL
    moves = (v[k] != 0.0) | (v[k + 1] != 0.0) | ((output[k] != 0.0) & (k % 3 == 0))
    near = told[:-2] & told[1:-1] & told[2:] & (t[2:] - t[1:-1] < GAP_S)
    k = k[one_way & moves & near & ~(limited[1:-1] | limited[2:])]
    k = k[:: 1 + len(k) // STRETCHES]
    volts = (trace.voltage_V[k, h] + trace.voltage_V[k + 1, h]) / (2.0 * RATED_V)
    return foretelling.Stretches(
        length_s=t[k + 1] - t[k], shaft_tick=x[k], whole_tick=(np.rint(ramp) + np.rint(behind))[k], ramp_tick=ramp[k],
        velocity_rad_s=v[k], goal_tick=np.array([trace.shown_tick[k, h], trace.goal_tick[k, h]]),
        sent_s=np.where(np.isfinite(trace.sent_s[k]), trace.sent_s[k] - t[k], math.inf),
        speed_tick_s=trace.speed_tick_s[[k - 1, k], h], from_reference=found.ramp_evidence > 0.0,
        margin_tick=margin[k], punch=punch, gain=gain, volts=volts, gravity=loads[0, [k, k + 1]],
        inertia_m2=loads[1, k], seen=np.array([x[k + 1] - x[k], v[k + 1], output[k + 1]]),
    )  # fmt: skip


def _fit_stiction(trace: Trace, h: int, G: FloatArray, found: JointFound) -> None:
    """What a joint bears before it breaks away (rule 3), over its friction."""
    if "coulomb_Nm" not in found.values:
        found.unseen["stiction_ratio"] = "its friction was not seen"
        return
    output, v = trace.output[:, h], trace.velocity_rad_s[:, h]
    torque = found["stall_Nm"] * output * trace.voltage_V[:, h] / RATED_V + G
    bears = np.abs(torque) / (found["coulomb_Nm"] + found["load_friction"] * np.abs(G))
    breaks = trace.known[1:-1, h] & (v[1:-1] == 0.0) & (v[2:] * torque[1:-1] > 0.0) & (output[1:-1] != 0.0)
    k = 1 + np.flatnonzero(breaks & (trace.read_s[2:, h] - trace.read_s[:-2, h] < 2.0 * GAP_S))
    if len(k) < 4:
        found.unseen["stiction_ratio"] = "it hardly ever broke away"
        return
    # It broke away within so many steps of its output more.
    steps = 1.0 + np.abs(trace.shown_tick[k + 1, h] - trace.shown_tick[k - 1, h])
    least = float(np.quantile(bears[k], 0.9))
    most = float(np.quantile(bears[k] * (1.0 + found["stall_Nm"] * found["gain"] * steps / np.abs(torque[k])), 0.1))
    # Most of what came last before was close below.
    found.values["stiction_ratio"] = max(1.0, least + (most - least) / 4.0), max(abs(most - least) / 4.0, 0.08 * least)


def _fit_play(trace: Trace, h: int, G: FloatArray, found: JointFound) -> None:
    """How far the shaft goes when gravity turns over and its goal stays (rule 4)."""
    flips: list[tuple[float, float]] = []
    stood: list[tuple[float, float, float]] = []  # at one goal: the side, where [tick], its variance
    side = np.where(np.abs(G) < PUSHES_NM, 0.0, np.sign(G))
    coulomb_Nm, _ = found.values.get("coulomb_Nm", (0.1, 0.0))
    turned = np.abs(G) > TURNS * coulomb_Nm
    goal = trace.shown_tick[:, h]
    changes = (np.diff(side) != 0.0) | (np.diff(goal) != 0.0) | np.diff(turned)
    for a, b in pairwise([0, *(1 + np.flatnonzero(changes)).tolist(), len(side), len(side)]):
        at, over = trace.position_tick[a:b, h][trace.known[a:b, h]], a == len(side)
        if over or turned[a] or goal[a] != goal[max(a - 1, 0)] or (side[a] and STAND / 3 < len(at) < STAND + SETTLES):
            # The first time the motor may have found its place.
            pairs = [(one, two) for one, two in pairwise(stood) if one[0] != two[0]][len(stood) > 2 :]
            flips += [(two[0] * (two[1] - one[1]), one[2] + two[2]) for one, two in pairs]
            stood = []
        if not over and side[a] and not turned[a] and len(at) >= STAND + SETTLES:
            stood.append((float(side[a]), float(at[SETTLES:].mean()), max(float(at.var()), 0.1) / len(at[SETTLES:])))
    if not flips:
        found.unseen["play_deg"] = "gravity on it never turned over while its goal stayed"
        return
    ways, variances = np.array(flips).T
    # Two flips have a stretch between them in common.
    sd_tick = max(math.sqrt(2.0 * variances.sum()), float(ways.std()) * math.sqrt(len(ways))) / len(ways)
    tick_deg = math.degrees(TICK_RAD)
    found.values["play_deg"] = max(0.0, float(ways.mean())) * tick_deg, math.hypot(sd_tick * tick_deg, FLOOR["play"])
