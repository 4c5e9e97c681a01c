"""What an arm's servos are like, found from what they were told and what they said: pure numbers, no arm.

Rules.
1. A servo's output tells where its speed ramp is: |error| = margin + (|output| - punch) / gain, in whole ticks. The
   ramp itself follows from goals and speeds as they were sent. What lies between the two is the delay; and which of two
   ramps fits, one that goes on or one that begins at the shaft, tells `ramp_from_reference`.
2. A joint that slides balances its torques (v: velocity, G: gravity, s: the sign of v):
   output * voltage / 12 V = v / no_load - G / stall + s (coulomb + load_friction |G|) / stall + bias + inertia * a
   for all joints at once: masses, strengths and frictions that explain it best, and are likely beforehand (`PRIOR`).
3. A joint that stands bears at most its stiction: what it bore last before it broke away tells the ratio.
4. A joint that stands while gravity on it turns over crosses its play, and its goal and motor do not.
5. What the data do not show is left out, and said in words. Standard deviations are those of the fit, and no less than
   what the equations leave out (`FLOOR`).

Ticks, outputs, velocities and gravity are the servo's own, counter-clockwise positive; h is a joint's index.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import LOAD_MAX, TICK_RAD
from armctl.dynamixel.servos import MODELS
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.transform import FloatArray
from armctl.trajectory import lag

RATED_V, SERVO_KG, TOOL_KG = 12.0, 0.0746, 0.08
# Standard deviations of what is likely beforehand: shares of a servo's mass, the tool's, strength, no-load speed and
# friction; friction of a load, bias of the output, inertia over strength [s^2].
PRIOR = {"servo": 0.09, "tool": 0.15, "stall": 0.12, "speed": 0.06, "friction": 1.5}
PRIOR |= {"load": 0.05, "bias": 0.01, "inertia": 0.006}
FRICTION_SHARE, LOAD_FRICTION, INERTIA_S2 = 0.08, 0.075, 0.006
# Samples that are close to one another tell less than so many.
SPOILS = 5.0
DELAYS_S = np.arange(0.0, 0.1, 0.001)
# A delay whose standard deviation would be larger was not seen; what is farther off a ramp is none of it.
UNSEEN_DELAY_S, OUTLIER_TICK = 0.008, 8.0
# An output that is not limited; a joint that slides steadily; instants between two readings; two readings that follow.
FULL, STEADY_RAD_S, PARTS, GAP_S = 0.9, 0.12, 20, 0.3
# Samples without which nothing is said, and with which all is; of a stand on either side of a play, and before it.
FEWEST, MOST, STAND, SETTLES = 40, 20_000, 15, 8
# Gravity that pushes a shaft to an end of its play [N m], and what of its friction may turn its motor.
PUSHES_NM, TURNS = 0.02, 0.75
# The least standard deviations: friction, speed, slope (shares), play [deg], delay [s].
FLOOR = {"friction": 0.04, "speed": 0.06, "play": 0.02, "delay": 0.0015, "slope": 0.02}
QUANTITIES = ("coulomb_Nm", "stiction_ratio", "slope_tick", "punch", "play_deg", "delay_ms")


@dataclass(frozen=True, eq=False)
class Trace:
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
            part = {one.name: getattr(trace, one.name)[new] for one in fields(cls)}
            parts.append(part | {key: part[key] + later_s for key in ("read_s", "sent_s")})
            last_s = end_s
        return cls(**{one.name: np.concatenate([part[one.name] for part in parts]) for one in fields(cls)})


@dataclass(eq=False)
class JointFound:
    """What was found of one joint: values with their standard deviations, and why of `QUANTITIES` some are missing.

    Beside these it has `stall_Nm`, `no_load_rad_s`, `load_friction`, `noise_tick` and `gain` (output per tick).
    """

    name: str
    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    unseen: dict[str, str] = field(default_factory=dict)
    # How much better a ramp that goes on explains it than one from the shaft: logarithm of the ratio of likelihoods.
    ramp_evidence: float = 0.0

    def __getitem__(self, key: str) -> float:
        return self.values[key][0]


@dataclass(frozen=True, eq=False)
class Found:
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
    q = np.array([joint.direction for joint in arm.joints]) * TICK_RAD
    q = q * (trace.position_tick - [joint.zero_tick for joint in arm.joints])
    basis = gravity(arm, chain, q) * np.array([joint.direction for joint in arm.joints])[:, None, None]
    kg, bias = _balance(arm, trace, basis, joints)
    for h, found in enumerate(joints):
        _fit_stiction(trace, h, basis[h] @ kg, float(bias[h]), found)
        _fit_play(trace, h, basis[h] @ kg, found)
    return Found(joints, [SERVO_KG, *kg.tolist()])


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
    if found.ramp_evidence < 0.0 or seen is None:
        found.unseen["delay_ms"] = (
            "with each goal its ramp begins at the shaft, and it jumps" if seen else "see slope_tick"
        )
        return
    found.values["gain"] = gain, gain * FLOOR["slope"]
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


def gravity(arm: ArmConfig, chain: SerialChain, q: FloatArray) -> FloatArray:
    """Of each mass about each joint [N m/kg], shape (joints, m, n + 1), at positions q [rad], shape (m, joints)."""
    n = chain.n
    reach = lag.regressors(chain, np.vstack([q, q[-1:]])[:, :n], np.zeros(n), 0.1)[:, :-1, :n]
    # A link carries what is beyond it; the mass midway along the last one counts half there.
    carries = np.triu(np.ones((n, n + 1)))
    carries[n - 1, n - 1] = 0.5
    found = np.zeros((len(arm.joints), len(q), n + 1))
    found[:n] = -lag.GRAVITY_M_S2 * reach @ carries
    return found


def _balance(
    arm: ArmConfig, trace: Trace, basis: FloatArray, joints: Sequence[JointFound]
) -> tuple[FloatArray, FloatArray]:
    """Masses [kg] and biases of the outputs; frictions and strengths go to the joints (rule 2)."""
    count, n = len(joints), basis.shape[2] - 1
    usual = usual_kg(arm, n)
    stall0 = np.array([MODELS[j.model].stall_torque_Nm * (1 if j.pair is None else 2) for j in arm.joints])
    free0 = np.array([MODELS[joint.model].no_load_speed_rad_s for joint in arm.joints])
    slid = [_sliding(trace, h, found) for h, found in enumerate(joints)]
    loads = [(basis[h, k] + basis[h, k + 1]) / 2.0 for h, (k, *_) in enumerate(slid)]
    kinds = ("stall", "speed", "friction", "load", "bias", "inertia")
    prior = np.concatenate(
        [np.full(n, PRIOR["servo"]), [PRIOR["tool"]], np.repeat([PRIOR[key] for key in kinds], count)]
    )
    theta = np.zeros(len(prior))

    def parts(theta: FloatArray) -> list[FloatArray]:
        kg, stall, free, friction, load, bias, inertia = np.split(theta, n + 1 + count * np.arange(len(kinds)))
        stall = stall0 * np.exp(stall)
        coulomb = stall * FRICTION_SHARE * np.exp(friction)
        return [
            usual * np.exp(kg),
            stall,
            free0 * np.exp(free),
            coulomb,
            LOAD_FRICTION + load,
            bias,
            INERTIA_S2 + inertia,
        ]

    def left(theta: FloatArray) -> list[FloatArray]:
        kg, stall, free, coulomb, load, bias, inertia = parts(theta)
        found = []
        for h, (B, (_, y, v, a)) in enumerate(zip(loads, slid, strict=True)):
            G = B @ kg
            torque = np.sign(v) * (coulomb[h] + load[h] * np.abs(G)) - G
            found.append(y - v / free[h] - torque / stall[h] - bias[h] - inertia[h] * a)
        return found

    for _ in range(6):
        now = left(theta)
        sd = np.concatenate([np.full(len(r), max(math.sqrt(float(r @ r) / max(len(r), 1)), 0.003)) for r in now])
        r = np.concatenate(now) / sd
        J = np.stack([(np.concatenate(left(theta + d)) / sd - r) / 1e-5 for d in 1e-5 * np.eye(len(theta))], axis=1)
        cov = np.linalg.inv(J.T @ J / SPOILS + np.diag(prior**-2))
        theta = theta - cov @ (J.T @ r / SPOILS + theta * prior**-2)
    kg, *found, bias, _ = parts(theta)
    for h, joint in enumerate(joints):
        v, (stall, free, coulomb, load) = slid[h][2], (float(one[h]) for one in found)
        at = n + 1 + count * np.arange(4) + h
        sds = np.sqrt(np.diag(cov)[at]).tolist()
        both = math.sqrt(float(cov[np.ix_(at[[0, 2]], at[[0, 2]])].sum()))
        joint.values |= {
            "stall_Nm": (stall, stall * sds[0]),
            "no_load_rad_s": (free, free * math.hypot(sds[1], FLOOR["speed"])),
        }
        joint.values["load_friction"] = max(load, 0.0), sds[3]
        if min((v > 0.0).sum(), (v < 0.0).sum()) >= FEWEST / 4:
            joint.values["coulomb_Nm"] = coulomb, coulomb * math.hypot(both, FLOOR["friction"])
        else:
            joint.unseen["coulomb_Nm"] = "it did not slide long enough, both ways"
    return kg, bias


def _sliding(trace: Trace, h: int, found: JointFound) -> tuple[NDArray[Any], FloatArray, FloatArray, FloatArray]:
    """Where a joint slides steadily from one reading to the next, and means in between: output at `RATED_V`, velocity
    [rad/s], acceleration [rad/s^2].

    In between the shaft goes evenly, and the controller sees whole ticks of what is between it and the ramp. Goals and
    readings keep step, so that outputs at the readings alone would always tell of the same moment of a tick.
    """
    if "delay_ms" not in found.values:  # where it came to stand friction is as often on this side as on that
        stands = (trace.velocity_rad_s[1:-1, h] == 0.0) & (trace.velocity_rad_s[:-2, h] != 0.0) & trace.known[1:-1, h]
        k = 1 + np.flatnonzero(stands)
        return k, trace.output[k, h] * trace.voltage_V[k, h] / RATED_V, np.zeros(len(k)), np.zeros(len(k))
    gain, punch = found["gain"], found["punch"] / LOAD_MAX
    ramps = partial(ramp_tick, trace, h, delay_s=1e-3 * found["delay_ms"], from_reference=found.ramp_evidence > 0.0)
    t, v, output, margin = (one[:, h] for one in (trace.read_s, trace.velocity_rad_s, trace.output, trace.margin_tick))
    # The shaft, once by what it says, and once by what its output tells of its error.
    worked = ramps(t) - np.sign(output) * (margin + (np.abs(output) - punch) / gain)
    said_var, worked_var = found["noise_tick"] ** 2 + 1.0 / 12.0, 1.0 / 6.0
    share = np.where((output != 0.0) & (np.abs(output) < FULL), said_var / (said_var + worked_var), 0.0)
    x = share * worked + (1.0 - share) * trace.position_tick[:, h]
    slow, fast = np.sort(np.abs([v[:-1], v[1:]]), axis=0)
    steady = (slow >= STEADY_RAD_S) & (v[1:] * v[:-1] > 0.0) & (fast < 2.0 * slow) & (np.diff(t) < GAP_S)
    told = _told(trace, h)
    k = np.flatnonzero(steady & told[1:] & told[:-1])
    k = k[:: 1 + len(k) // MOST]
    length_s, u = t[k + 1] - t[k], (np.arange(PARTS) + 0.5) / PARTS
    error = ramps(t[k, None] + length_s[:, None] * u) - x[k, None] - (x[k + 1] - x[k])[:, None] * u
    whole = np.floor(np.abs(error))

    def works(whole: FloatArray) -> FloatArray:
        beyond = whole - margin[k, None]
        return np.where(beyond > 0.0, punch + beyond * gain, 0.0)

    part = np.abs(error) - whole
    mean = (np.sign(error) * ((1.0 - part) * works(whole) + part * works(whole + 1.0))).mean(axis=1)
    volts = (trace.voltage_V[k, h] + trace.voltage_V[k + 1, h]) / (2.0 * RATED_V)
    return k, mean * volts, (x[k + 1] - x[k]) * TICK_RAD / length_s, (v[k + 1] - v[k]) / length_s


def _fit_stiction(trace: Trace, h: int, G: FloatArray, bias: float, found: JointFound) -> None:
    """What a joint bears before it breaks away (rule 3), over its friction."""
    if "coulomb_Nm" not in found.values:
        found.unseen["stiction_ratio"] = "its friction was not seen"
        return
    output, v = trace.output[:, h], trace.velocity_rad_s[:, h]
    torque = found["stall_Nm"] * (output * trace.voltage_V[:, h] / RATED_V - bias) + G
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
    sd = max(abs(most - least) / 4.0, 0.08 * least)
    found.values["stiction_ratio"] = max(1.0, least + (most - least) / 4.0), sd


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
