"""How an arm is identified: small motions of one joint after the other through the daemon, and their logs.

Rules.
1. Every motion is a plan: pre-flight judges the whole of it, the daemon records it, and Ctrl-C stops the arm. It is not
   corrected, so that the goals of joints that are to stand stay.
2. The arm stands where gravity on its joints is least. For each joint that feels gravity another one leans it this way
   and that, just so far that its shaft crosses its play and its motor stands; a joint that gravity does not mind sweeps
   meanwhile. Then each of the others sweeps, where gravity pulls it this way and where it pulls it that way, and the
   last joint leans with it, so that those that carry it tell what it weighs.
3. A sweep is fast for delay and motor, slower for friction, and creeps at last for stiction. All that the recordings
   hold counts, for the joints that stand as well.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.commissioning import sag_file
from armctl.commissioning.arm_file import renew
from armctl.config import ArmConfig, Config
from armctl.dynamixel import ax12a
from armctl.errors import LogError, RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import rehearsal
from armctl.lab.stage import Progress
from armctl.recording import channels
from armctl.recording.log_file import LogFile
from armctl.recording.replay import log_setup
from armctl.recording.timeline import Timeline
from armctl.report.identified import Compared
from armctl.sim.spec import DEFAULT_SPEC, put_together
from armctl.sim.twin import TwinJoint, load_twin
from armctl.trajectory import identification
from armctl.trajectory.identification import QUANTITIES, Found, Trace
from armctl.trajectory.interpolate import time_law
from armctl.trajectory.plan import Plan, plan_through, preflight
from armctl.trajectory.preflight import Driven, DrivenArm

# How far a joint sweeps to either side [rad], and its legs: to where, as a share of it, and how fast [deg/s].
SWEEP_RAD = math.radians(16.0)
LEGS = [(share, 45.0) for share in (1.0, -1.0, 0.8, -0.8, 0.6, -0.6, 0.35, -0.35, 0.0)]
LEGS += [(0.1, 1.6), (0.0, 1.6), (0.1, 1.6)]
HALF = [*LEGS[:2], *LEGS[4:6], LEGS[8], *LEGS[-3:-1]]
QUICK = [(0.4, 16.0), (-0.4, 16.0), (0.4, 25.0), (-0.4, 25.0), (0.0, 16.0)]
# So little that no speed lasts: goals and readings keep step, and at one speed would always tell of the same moment.
ACCELERATION_RAD_S2 = math.radians(50.0)
# A joint sweeps where so much gravity pulls [N m], at most so far out; what is fast is so much slower where it must be.
PULLS_NM, OUT_RAD, SLOWER, FAST_DEG_S = 0.5, (math.radians(55.0), math.radians(30.0), 0.0), (1.0, 0.6, 0.35), 18.0
# With how much gravity on it a joint stands on either side of its balance, and how long on each; at most so far over.
LEANS_NM, LEAN_S, MOST_LEAN_RAD = 0.04, (1.5, 5.0, 9.0, 5.0), math.radians(25.0)
LOOK_S = 0.1
# A joint that turns gravity about others by less than this does not mind it [N m/rad].
NEUTRAL_NM = 0.03
STARTS, STEPS, TRIED, HEAVY_NM2 = 400, 80, 40, 0.005
# How far joints then are from the base pose [rad], and how fast the farthest goes [rad/s]; none: for how long [s].
Move = tuple[Mapping[int, float], float]
# Some of them, by how far out they are and how much slower.
Moves = Callable[..., Iterable[Move]]


def leg(way_rad: float, speed_rad_s: float, period_s: float) -> FloatArray:
    """A way from 0 [rad], a row a period: constant acceleration, speed, deceleration."""
    far = abs(way_rad)
    v = min(speed_rad_s, math.sqrt(far * ACCELERATION_RAD_S2))
    if not v:
        return np.zeros(0)
    rise_s = v / ACCELERATION_RAD_S2
    end_s = far / v + rise_s
    t = np.minimum(period_s * np.arange(1, math.ceil(end_s / period_s) + 1), end_s)
    near_s = np.minimum(t, end_s - t)  # to its nearer end
    gone = v * np.where(near_s < rise_s, near_s * near_s / (2.0 * rise_s), near_s - rise_s / 2.0)
    return np.asarray(math.copysign(1.0, way_rad) * np.where(2.0 * t < end_s, gone, far - gone))


def rows_of(base: FloatArray, moves: Iterable[Move], period_s: float) -> FloatArray:
    """All joints [rad], a row a period, from where the arm stands on."""
    rows = [base]
    for to, speed in moves:
        here = rows[-1]
        way = np.array([base[j] + to[j] - here[j] if j in to else 0.0 for j in range(len(base))])
        most = float(np.abs(way).max())
        share = leg(most, speed, period_s) / most if most else np.zeros(0 if to else round(speed / period_s))
        rows += list(here + np.outer(share, way))
    return np.array(rows)


def sweep(joint: int, legs: Iterable[tuple[float, float]], last: int, out_rad: float, slower: float) -> Iterator[Move]:
    """A joint's legs to either side of where it is so far out, and another one leans as it does."""
    for about in (out_rad, -out_rad) if out_rad else (0.0,):
        to = {last: math.copysign(OUT_RAD[0], about)} if out_rad else {}
        for share, speed in ((0.0, 40.0), *legs):
            yield to | {joint: about + share * SWEEP_RAD}, math.radians(speed) * (slower if speed > FAST_DEG_S else 1.0)


def lean(by: int, about_rad: float, lean_rad: float, sweeping: int | None, *_: float) -> Iterator[Move]:
    """A joint leans the arm this way and that, while another one sweeps."""
    legs, here = cycle(LEGS), 0.0
    for k, left_s in enumerate(LEAN_S):
        yield {by: about_rad + (lean_rad if k % 2 else -lean_rad)}, math.radians(FAST_DEG_S)
        if sweeping is None:
            yield {}, left_s
        while sweeping is not None and left_s > 0.0:
            share, speed = next(legs)
            left_s -= LOOK_S * len(leg((share - here) * SWEEP_RAD, math.radians(speed), LOOK_S))
            here = share
            yield {sweeping: share * SWEEP_RAD}, math.radians(speed)


def gravity_Nm(on: Driven, q: FloatArray) -> FloatArray:
    """About each joint of an arm nobody has weighed, at positions q [rad]: both of shape (m, joints)."""
    arm, chain = on.arm, on.robot.chain
    return np.asarray((identification.burdens(arm, chain, q)[0] @ identification.usual_kg(arm, chain.n)).T)


def balanced(on: Driven) -> list[FloatArray]:
    """Poses [rad], shape (joints,), in which gravity is least, the highest tool first."""
    rng = np.random.default_rng(0)
    low, high = np.array([joint.limits_rad for joint in on.arm.joints]).T
    middle, room = (low + high) / 2.0, 1.25 * SWEEP_RAD
    low, high = np.minimum(low + room, middle), np.maximum(high - room, middle)
    q = rng.uniform(low, high, (STARTS, len(low)))

    def cost(q: FloatArray) -> FloatArray:
        return np.asarray(np.square(gravity_Nm(on, q)).sum(axis=1))

    for k in range(STEPS):
        near = np.clip(q + rng.normal(0.0, 0.5 * 0.92**k, q.shape), low, high)
        q = np.where((cost(near) < cost(q))[:, None], near, q)
    for k in range(len(middle)):  # what gravity does not mind stays in the middle
        aside = np.where(np.arange(len(middle)) == k, middle, q)
        q = np.where((np.abs(cost(aside) - cost(q)) < 1e-9)[:, None], aside, q)
    height_m = tool_position(on.robot.chain, q[:, : on.robot.chain.n])[:, 2]
    return list(q[np.lexsort((-height_m, cost(q) > HEAVY_NM2))[:TRIED]])


def plans(on: Driven, joints: Sequence[int], quick_at: Sequence[float] | None = None) -> list[tuple[str, Plan]]:
    """The motions that identify some joints, and which one each is for.

    Args:
        quick_at: Where the arm stands [rad]: a few degrees there, of the joints that have room; None: all of it.
    Raises:
        RequestRefused: NO_ROOM.
    """
    for base in balanced(on) if quick_at is None else [np.array(quick_at)]:
        quick = [(j, 0.0, partial(sweep, j, QUICK, j)) for j in joints]
        wanted = quick if quick_at is not None else _wanted(on, base, joints)
        found = [(on.arm.joints[j].name, _allowed(on, base, most, moves)) for j, most, moves in wanted]
        kept = [(name, plan) for name, plan in found if plan is not None]
        if kept and (quick_at is not None or len(kept) == len(found)):
            return kept
    raise RequestRefused("NO_ROOM", "no pose leaves the joints room to move; widen limits_deg, or name fewer --joints")


def _allowed(on: Driven, base: FloatArray, most_rad: float, moves: Moves) -> Plan | None:
    """The farthest and fastest way of some moves that pre-flight allows."""
    for out_rad, slower in product(sorted({min(most_rad, out) for out in OUT_RAD}, reverse=True), SLOWER):
        q = rows_of(base, moves(out_rad, slower), on.period_s)
        first, last = tool_position(on.robot.chain, q[[0, -1], : on.robot.chain.n]).tolist()
        asked: dict[str, Any] = {"from_m": tuple(first), "to_m": tuple(last), "interpolation": "linear", "seed": 0}
        knots = time_law(np.linspace(0.0, 1.0, len(q)))
        plan = plan_through(on.arm, q, knots, (0.0, 0.0), duration_s=on.period_s * (len(q) - 1), **asked)
        if not preflight(plan, on, plan.waypoints_rad[0]):
            return plan
    return None


def _wanted(on: Driven, base: FloatArray, joints: Sequence[int]) -> Iterator[tuple[int, float, Moves]]:
    """For which joint, how far out at most, and the moves."""
    step = 0.05 * np.eye(len(base))
    grows = (gravity_Nm(on, base + step) - gravity_Nm(on, base - step)).T / 0.1
    heavy = [j for j in range(len(base)) if np.abs(grows[j]).max() > NEUTRAL_NM]
    neutral = [j for j in joints if np.abs(grows[:, j]).max() < NEUTRAL_NM]
    leant = [j for j in heavy if j in joints and len(heavy) > 1]
    [now] = gravity_Nm(on, base[None])
    for j, sweeping in zip(leant, cycle(neutral or [None]), strict=False):
        by = next(k for k in heavy if k != j and abs(grows[j, k]) > 0.8 * np.abs(np.delete(grows[j], j)).max())
        lean_rad = min(LEANS_NM / abs(float(grows[j, by])), MOST_LEAN_RAD)
        yield j, 0.0, partial(lean, by, -float(now[j] / grows[j, by]), lean_rad, sweeping)
    for j in joints:
        if j in heavy:
            yield j, PULLS_NM / abs(float(grows[j, j])), partial(sweep, j, HALF, heavy[-1])
        elif len(leant) < len(neutral):
            yield j, 0.0, partial(sweep, j, LEGS, j)


def moved(client: Client, arm: ArmConfig, joints: Sequence[int], tell: Progress, *, quick: bool) -> list[Trace]:
    """Have the daemon's arm do the motions, and go back to where it was; what its recordings hold.

    Args:
        tell: Called with the share that is done, and which joint comes next.
    Raises:
        RequestRefused: NO_ROOM, or what the daemon says.
    """
    status, traces = client.call("status"), list[Trace]()
    start = [joint["position_rad"] for joint in status["joints"]]
    wanted = plans(DrivenArm(arm, robots.of(arm), status["period_s"]), joints, start if quick else None)
    for done, (name, plan) in enumerate(wanted):
        tell(done / len(wanted), name)
        recording = client.call("run", plan=plan.model_dump(mode="json"), corrected=False)["recording"]
        traces.append(read(Path(client.call("recordings_show", name=recording)["path"]))[1])
    client.call("move", joints_rad=start)
    return traces


def read(path: Path) -> tuple[ArmConfig, Trace]:
    """What a log holds of an arm's servos; a goal left for them after the last of them was read.

    Raises:
        LogError: it is no log of armctl's, or tells nothing of servos.
    """
    with LogFile(path) as log:
        arm, said = log_setup(log).arm, log.payloads((channels.SERVOS,))[channels.SERVOS]
        tables = log.tables(channels.SERVOS, said) if len(said.size) else ()
    if not (table := max(tables, key=lambda table: len(table.sequence), default=None)):
        raise LogError(f"{path}: tells nothing of servos; there is nothing to learn from")
    n = len(arm.joints)
    for i, joint in enumerate(arm.joints):
        if not np.asarray(table.columns[f"servos[{i}].registers"]).size:
            raise LogError(f"{path}: servo {joint.servo_id} ({joint.name}) never answered; give logs in which all did")
    stamps_ns, fresh, blocks = (
        np.stack([np.asarray(table.columns[f"servos[{i}].{key}"]) for i in range(n)], axis=1)
        for key in ("stamp_ns", "fresh", "registers")
    )

    def register(one: ax12a.Register) -> FloatArray:
        return np.asarray(channels.register_column(blocks.reshape(-1, blocks.shape[2]), one), np.float64).reshape(-1, n)

    def signed(one: ax12a.Register) -> FloatArray:
        return np.where(register(one) >= 1024.0, 1024.0 - register(one), register(one))

    read_s, goal, speed = stamps_ns / NS_PER_S, register(ax12a.GOAL), register(ax12a.MOVING_SPEED)
    new = np.append(((np.diff(goal, axis=0) != 0.0) | (np.diff(speed, axis=0) != 0.0)).any(axis=1), False)
    return arm, Trace(
        read_s=read_s,
        sent_s=np.where(new, read_s.max(axis=1), math.nan),
        goal_tick=np.roll(goal, -1, axis=0),
        speed_tick_s=np.roll(speed, -1, axis=0) * (ax12a.SPEED_UNIT_RAD_S / ax12a.TICK_RAD),
        shown_tick=goal,
        position_tick=register(ax12a.PRESENT_POSITION),
        output=signed(ax12a.PRESENT_LOAD) / ax12a.LOAD_MAX,
        velocity_rad_s=signed(ax12a.PRESENT_SPEED) * ax12a.SPEED_UNIT_RAD_S,
        voltage_V=register(ax12a.PRESENT_VOLTAGE) / 10.0,
        margin_tick=register(ax12a.CW_MARGIN),
        slope_tick=register(ax12a.CW_SLOPE),
        punch=register(ax12a.PUNCH) / ax12a.LOAD_MAX,
        known=(fresh > 0) & (register(ax12a.TORQUE_ENABLE) > 0.0),
    )


# ------------------------------------------------------------------------------------------- what becomes of it


def told(found: Found) -> list[dict[str, Any]]:
    """What was found of each joint, as JSON; null: it was not seen, and `unseen` says why."""
    rows = []
    for joint in found.joints:
        row: dict[str, Any] = {"name": joint.name}
        for key in QUANTITIES:
            row[key], row[f"{key}_sd"] = joint.values.get(key, (None, None))
        rows.append(row | {"unseen": joint.unseen})
    return rows


def compared(timeline: Timeline, spec: Path, progress: Callable[[float], None]) -> Compared:
    """What the twin in a file foretells of a log.

    Raises:
        ConfigError: the file is no twin of the log's arm.
        RequestRefused, LogError: see `rehearsal.foretold`.
    """
    twin = put_together(DEFAULT_SPEC, "perfect", "new", load_twin(spec, timeline.arm))
    played = rehearsal.foretold(timeline, twin, progress)
    bands = np.array([one.followed_rad for one in played])
    middle = np.median(bands, axis=0)
    tool_m = rehearsal.tool_apart_m(played[0]._replace(followed_rad=middle), robots.of(timeline.arm).chain)
    time_s, measured = played[0].time_s, played[0].logged_rad
    return Compared(timeline.arm.joint_names, time_s, measured, bands.min(axis=0), middle, bands.max(axis=0), tool_m)


def twin_path(config: Config) -> Path:
    """Where the twin of the arm is kept."""
    return sag_file.path_of(config).with_suffix("").with_suffix(".twin.json")


def save(config: Config, arm: ArmConfig, found: Found) -> Path:
    """Write the twin of the arm beside its lag model; the one before stays in its history.

    Raises:
        ConfigError: it cannot be written there.
    """
    kept = TwinJoint.model_fields.keys()
    joints = {one.name: {k: v for k, (v, _) in (one.likely | one.values).items() if k in kept} for one in found.joints}
    about = {"arm_id": arm.arm_id, "ramp_from_reference": found.ramp_from_reference, "points_kg": found.points_kg}
    path = twin_path(config)
    renew(path, json.dumps(about | {"joints": joints}, indent=1) + "\n")
    return path
