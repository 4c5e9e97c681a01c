"""Whether `armctl identify` finds what simulated arms are truly like, and whether their twins foretell their motions.

Arms are drawn at random with the simulator's whole range on: put together typically, half of them with worn servos,
half with ramps that begin at the shaft. They have what the estimator's equations lack: motors that get warm, horns with
play, links that bend behind the sensor, twisted axes, wrong lengths and zeros, supply that falls along the chain. Each
is behind the daemon's own host, in virtual time, and the command's own functions move it and read its recordings.

The truth is read from the simulated joints. What is judged of each quantity, over all arms:
1. The interval of 95 % holds the truth in at least 90 % of the joints that tell it.
2. No interval is wider than twice the bound: friction 15 %, play 0.1 deg, delay 10 ms, slope a step of its register.
   Of a joint whose axis bears no load neither strength nor play can be seen: its friction is judged apart where it is
   told; where only its share of the strength is said, this is judged, as it is said. Of its play the estimator has to
   say that it was not seen. Friction under load is told of nine in ten.
3. The values are within the bounds in at least 90 % of the joints; `ramp_from_reference` is right on every arm.
4. It takes at most 300 s of the arm's time.
5. In held-out motions the twin has the tool within 1.0 mm of where the arm has it (median; by the shafts and the arm's
   file, as an encoder would show it). Beside it: how far the tool is off what is asked for.
"""

import asyncio
import math
import re
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armctl.config import Config
from armctl.files import find_arm_file, load_arm
from armctl.kinematics import robots
from armctl.lab import identification as lab
from armctl.messages import TickRecord
from armctl.sim.spec import DEFAULT_SPEC, RANGE_SPEC, put_together
from armctl.sim.twin import load_twin
from armctl.trajectory.identification import Trace, identify
from armctl.trajectory.plan import Plan, plan_positions, plan_through, preflight
from armctl.trajectory.preflight import DrivenArm
from proving import reading
from proving.arms import arm_text
from proving.hosted_arm import HostedArm
from proving.truth import FloatArray, Reach
from proving.workers import WORKERS, carry_out

ARM = "ax12-line"
ARMS, MOTIONS, MOTION_S = 40, 6, 8.0
COVERED, MOST_S, TWIN_MM = 0.9, 300.0, 1.0
Z95 = 1.96
# Half of the widest interval, and how far off a value may be: as a share of the truth, or as such.
SHARES = {"coulomb_Nm": 0.15}
BOUNDS = {"play_deg": 0.1, "delay_ms": 10.0}
REGISTER_TICK, PUNCH = 32.0, 32.0
# About where held-out motions lead [deg], either way.
ABOUT_DEG = ((0.0, 60.0), (90.0, 25.0), (-75.0, 35.0), (-10.0, 40.0), (0.0, 40.0), (0.0, 60.0))
GRAVITY_AXIS = ("base", "roll")


@dataclass(frozen=True)
class Trial:
    """One arm."""

    seed: int
    worn: bool
    from_reference: bool


class Watched(HostedArm):
    """A hosted arm of which the shafts are noted as its encoders see them, without noise [tick]."""

    def _see(self, record: TickRecord) -> None:
        super()._see(record)
        self.__dict__.setdefault("ticks_seen", []).append([servo.position_tick for servo in self.simulated.servos])


class Client:
    """Asks a hosted arm as a blocking client asks the daemon."""

    def __init__(self, loop: asyncio.AbstractEventLoop, arm: Watched) -> None:
        self._loop, self._arm = loop, arm

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        if method == "status":
            joints = [{"position_rad": q} for q in self._arm.virtual.goals_rad]
            return {"period_s": self._arm.virtual.period_s, "joints": joints}
        return self._loop.run_until_complete(self._arm.ask(method, **params))


def hosted(loop: asyncio.AbstractEventLoop, folder: Path, seed: int, spec: Any) -> tuple[Watched, Client]:
    async def made() -> Watched:
        return Watched(find_arm_file(ARM), folder, seed, lambda q: q, spec)

    folder.mkdir()
    arm = loop.run_until_complete(made())
    client = Client(loop, arm)
    client.call("torque_on")
    return arm, client


def trial(job: Trial) -> dict[str, Any]:
    """Identify one arm, and foretell its motions by its twin."""
    spec = put_together(RANGE_SPEC, "typical", "worn" if job.worn else "new")
    spec = replace(spec, variants=replace(spec.variants, ramp_from_reference=job.from_reference))
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    try:
        with tempfile.TemporaryDirectory(prefix="armctl-") as name:
            return _trial(job, spec, loop, Path(name))
    finally:
        loop.close()


def _trial(job: Trial, spec: Any, loop: asyncio.AbstractEventLoop, folder: Path) -> dict[str, Any]:
    arm = load_arm(ARM)
    true_arm, client = hosted(loop, folder / "arm", job.seed, spec)
    chain, joints = robots.of(arm).chain, list(range(len(arm.joints)))
    quick = lab.moved(client, arm, joints, lambda *_: None, quick=True)  # type: ignore[arg-type]  # it is asked alike
    ramp_quick = identify(arm, chain, Trace.joined(quick)).ramp_from_reference
    begun_ns = true_arm.virtual.clock.now_ns()
    traces = lab.moved(client, arm, joints, lambda *_: None, quick=False)  # type: ignore[arg-type]
    took_s = (true_arm.virtual.clock.now_ns() - begun_ns) / 1e9
    found = identify(arm, chain, Trace.joined(traces))
    path = lab.save(Config(arm=str(find_arm_file(ARM)), data_dir=str(folder)), arm, found)
    rows = [
        {"name": row["name"], "true": truth(joint), **{key: value for key, value in row.items() if key != "name"}}
        for row, joint in zip(lab.told(found), true_arm.simulated._joints, strict=False)  # the truth is nowhere else
    ]
    twin, twin_client = hosted(
        loop, folder / "twin", 0, put_together(DEFAULT_SPEC, "perfect", "new", load_twin(path, arm))
    )
    apart_mm, off_mm = [], []
    for plan in held_out(arm, job.seed):
        one, other = (driven(*pair, plan) for pair in ((true_arm, client), (twin, twin_client)))
        wanted = asked_for(plan, len(one))
        m = min(len(one), len(other), len(wanted))
        apart_mm.append(1e3 * np.linalg.norm(one[:m] - other[:m], axis=1))
        off_mm.append(1e3 * np.linalg.norm(one[:m] - wanted[:m], axis=1))
    true_arm.close()
    twin.close()
    return {
        "seed": job.seed,
        "worn": job.worn,
        "rows": rows,
        "ramp": [job.from_reference, found.ramp_from_reference, ramp_quick],
        "took_s": took_s,
        "faults": sorted(true_arm.faults),
        "twin_mm": float(np.median(np.concatenate(apart_mm))),
        "off_mm": float(np.median(np.concatenate(off_mm))),
    }


def truth(joint: Any) -> dict[str, float]:
    """What a simulated joint is like."""
    return {
        "coulomb_Nm": joint.coulomb_Nm,
        "stiction_ratio": joint.stiction_Nm / joint.coulomb_Nm,
        "slope_tick": joint.servo.slope_share * REGISTER_TICK,
        "punch": PUNCH,
        "play_deg": math.degrees(2.0 * joint.half_play_rad),
        "delay_ms": float(joint.dead_steps),
        "friction_share": joint.coulomb_Nm / joint.stall_Nm,
    }


def held_out(arm: Any, seed: int) -> list[Plan]:
    """Motions that have no part in the identification."""
    rng, robot, plans = np.random.default_rng((seed, 77)), robots.of(arm), list[Plan]()
    while len(plans) < MOTIONS:
        q = np.radians([[mid + rng.uniform(-half, half) for mid, half in ABOUT_DEG] for _ in range(3)])
        ends = Reach(reading.read(arm_text(ARM)), robot.chain).tool_m(q[[0, -1]]).tolist()
        asked: dict[str, Any] = {"from_m": tuple(ends[0]), "to_m": tuple(ends[1]), "interpolation": "cubic", "seed": 0}
        plan = plan_through(arm, q, np.array([0.0, 0.5, 1.0]), (0.0, 0.0), duration_s=MOTION_S, **asked)
        if not preflight(plan, DrivenArm(arm, robot, 0.1), plan.waypoints_rad[0]):
            plans.append(plan)
    return plans


def driven(arm: Watched, client: Client, plan: Plan) -> FloatArray:
    """Where the tool is at each tick of a plan, by the shafts and the arm's file [m], shape (m, 3)."""
    client.call("run", plan=plan.model_dump(mode="json"), corrected=False)
    begin, end = arm._planned
    judged = reading.read(arm_text(ARM))
    ticks = np.array(arm.__dict__["ticks_seen"][begin:end])
    return by_file(judged, arm, np.radians(
        [[j.direction * (tick - j.zero_tick) * reading.TICK_DEG for tick, j in zip(row, judged.joints, strict=True)]
         for row in ticks.tolist()]
    ))  # fmt: skip


def by_file(judged: reading.Arm, arm: Watched, q: FloatArray) -> FloatArray:
    return Reach(judged, arm.virtual.robot.chain).tool_m(q)


def asked_for(plan: Plan, count: int) -> FloatArray:
    """Where the tool is to be at each tick of a plan [m]."""
    arm = load_arm(ARM)
    q = plan_positions(plan, np.arange(count) * np.float64(0.1))
    return Reach(reading.read(arm_text(ARM)), robots.of(arm).chain).tool_m(q)


def prove(seed: int, tell: Callable[[str], None], *, arms: int = ARMS, workers: int = WORKERS) -> dict[str, Any]:
    """What was found, quantity by quantity, and every bound that was broken."""
    began_s = time.monotonic()
    jobs = [Trial(seed * 1000 + k, bool(k % 2), bool((k // 2) % 2 == 0)) for k in range(arms)]
    done = carry_out(trial, jobs, tell, workers)
    rows, violations = judged(done)
    return {
        "runs": len(done),
        "violations": violations,
        "rows": rows,
        "twin_mm": statistics.median(one["twin_mm"] for one in done),
        "off_mm": statistics.median(one["off_mm"] for one in done),
        "longest_s": max(one["took_s"] for one in done),
        "seconds": time.monotonic() - began_s,
        "seed": seed,
    }


def judged(done: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[str]]:
    """A row a quantity, and what was broken."""
    rows, violations = [], list[str]()
    joints = [(one["seed"], row) for one in done for row in one["rows"]]
    for key in ("coulomb_Nm", "stiction_ratio", "slope_tick", "punch", "play_deg", "delay_ms"):
        for loaded in (True, False) if key == "coulomb_Nm" else (None,):
            some = [(s, r) for s, r in joints if loaded is None or (r["name"] in GRAVITY_AXIS) is not loaded]
            row, broken = _quantity(key, some)
            if loaded is not None:
                row["what"] += ", axis loaded" if loaded else ", axis without load"
            rows.append(row)
            if loaded and row["seen"] < COVERED:
                broken.append(f"was told of {row['seen']:.0%} of the joints, bound {COVERED:.0%}")
            if loaded is False and not row["seen"] and any(said_share(one) for _, one in some):
                broken = []  # this share is judged below
            violations += [f"{row['what']}: {text}" for text in broken]
    off = np.array([share / row["true"]["friction_share"] - 1.0 for _, row in joints if (share := said_share(row))])
    if len(off):
        what, near = "friction over strength, said in words", float((np.abs(off) <= SHARES["coulomb_Nm"]).mean())
        rows.append({"what": what, "seen": len(off) / len(joints), "within_bound": near})
        if near < COVERED:
            violations.append(f"{what}: {near:.0%} are within {SHARES['coulomb_Nm']:g}, bound {COVERED:.0%}")
    for one in done:
        where = f"arm {one['seed']}"
        wanted, found, quick = one["ramp"]
        violations += [
            f"{where}: ramp_from_reference {said}, truly {wanted}" for said in (found, quick) if said != wanted
        ]
        if one["took_s"] > MOST_S:
            violations.append(f"{where}: took {one['took_s']:.0f} s of the arm's time, bound {MOST_S:g}")
        if one["faults"]:
            violations.append(f"{where}: faults {', '.join(one['faults'])}")
        violations += [
            f"{where}, {row['name']}: the play of a shaft without load was invented"
            for row in one["rows"]
            if row["name"] in GRAVITY_AXIS and row["play_deg"] is not None
        ]
    if (twin_mm := statistics.median(one["twin_mm"] for one in done)) > TWIN_MM:
        violations.append(f"the twin has the tool {twin_mm:.2f} mm off, median, bound {TWIN_MM:g}")
    return rows, violations


def said_share(row: dict[str, Any]) -> float:
    """Friction over strength, where this is all that is said of a joint's friction; 0: it is not."""
    said = re.search(r"([\d.]+)% of that", row["unseen"].get("coulomb_Nm", ""))
    return float(said[1]) / 100.0 if said else 0.0


def _quantity(key: str, joints: list[tuple[int, dict[str, Any]]]) -> tuple[dict[str, Any], list[str]]:
    """How one quantity was found in some joints, and what of it was broken."""
    seen = [(row[key], row[f"{key}_sd"], row["true"][key]) for _, row in joints if row[key] is not None]
    if not seen:
        return {"what": key, "seen": 0.0}, ["was seen in no joint"]
    value, sd, true = np.array(seen).T
    covered = float((np.abs(value - true) <= Z95 * sd).mean())
    if key in SHARES:
        off, half, bound = np.abs(value / true - 1.0), Z95 * sd / value, SHARES[key]
    elif key == "slope_tick":  # steps of the register
        off, half, bound = np.abs(np.log2(value / true)), np.log2(1.0 + Z95 * sd / value), 1.0
    else:
        off, half, bound = np.abs(value - true), Z95 * sd, BOUNDS.get(key, math.inf)
    row = {
        "what": key, "seen": len(seen) / len(joints), "covered": covered, "off_median": float(np.median(off)),
        "within_bound": float((off <= bound).mean()), "half_width_median": float(np.median(half)),
        "narrow": float((half <= bound).mean()), "bias": float(np.median(value - true)),
    }  # fmt: skip
    narrow, near = float((half <= bound).mean()), float((off <= bound).mean())
    broken = []
    if covered < COVERED:
        broken.append(f"{covered:.0%} of the intervals of 95 % hold the truth, bound {COVERED:.0%}")
    if near < COVERED:
        broken.append(f"{near:.0%} are within {bound:g}, bound {COVERED:.0%}")
    if narrow < 1.0:
        broken.append(f"{1.0 - narrow:.0%} of the intervals are wider than twice {bound:g}")
    return row, broken
