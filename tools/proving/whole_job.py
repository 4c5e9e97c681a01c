"""Any arm does the whole job: chains drawn at random, of which there is nothing but a file.

One trial: an arm of `drawn_arms`, written to a folder, simulated servos, and the daemon's own host over them. The hand
leads the limp arm along a line of which the arm is capable; then follow the requests of the rows below. Lines that the
package refuses before anything moves are drawn again, and told by their code; so are lines that no hand can lead.

| step | what holds, by the true tool |
|-|-|
| file | `arm check` finds nothing; the tool stands where the drawn chain has it, at 1000 poses |
| teach | three takes; the track of each is where the tool went |
| play | the tool stays near the taught path |
| optimize | a plan of two via points comes out |
| run | refined at most three times, and the plan that was kept run once more, near the line |
| move | three points of the line, the tool stands there |
| reach | a point of the line, from above or along the tool; a gripper that closes holds nothing |
| park | limp, and in the rest pose |

No fault may be latched in any of it. The truth is the drawn chain and the shafts of the simulated servos, whose zeros
are off by half a tick each (one standard deviation), which no encoder shows.
"""

import asyncio
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armctl.commissioning.arm_file import judged
from armctl.errors import ArmctlError, RequestRefused, UnreachableTarget
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics
from armctl.sim.arm import SimulatedArm
from proving.drawn_arms import FILE, DrawnArm, drawn
from proving.hosted_arm import PERIOD_S, HostedArm
from proving.truth import FloatArray, off_line_mm
from proving.workers import WORKERS, carry_out

ARMS, TAKES, REFINE = 10, 3, 3
DURATION_S = 5.0
# How long a line is, how high and how far in front it lies at least [m], and how far out of the stretched arm: farther
# out a few millimetres are many degrees, and motors of such a chain work at their limit.
LINE_M, LOWEST_M, NEAR_M, STRETCH = (0.08, 0.14), 0.04, 0.07, 0.85
SAME_M, POSES = 1e-9, 1000
# Bounds by the true tool [mm].
TRACK_MM, PLAY_MM, RUN_MM, MOVE_MM, REACH_MM = 6.0, (2.5, 6.0), (2.5, 5.0), 3.0, 4.0
REST_DEG = 5.0
STEPS = ("file", "teach", "play", "optimize", "run", "move", "reach", "park")
# What may be said of a line or a point before anything moves; then others are drawn.
REFUSED = ("LINE", "PREFLIGHT", "LIMIT", "LIMITS", "TOO_HEAVY", "UNREACHABLE")
MOST_REFUSED, MOST_DRAWN = 12, 4000
RESTS, REST_ROOM_DEG = 60, 4.0
# No joint of an arm at rest lies lower.
REST_M = 0.03


@dataclass(frozen=True)
class Trial:
    """One arm."""

    seed: int
    number: int


def run(trial: Trial) -> dict[str, Any]:
    """What held of one arm, the figures of it, what was refused, and what is broken."""
    return asyncio.run(_whole(trial))


async def _whole(trial: Trial) -> dict[str, Any]:
    rng = np.random.default_rng((trial.seed, trial.number, 37))
    found: dict[str, Any] = {"number": trial.number, "held": [], "figures": {}, "refused": [], "broken": []}
    with tempfile.TemporaryDirectory(prefix="armctl-arms-") as name:
        file, arm = written(trial, Path(name), rng)
        found["arm"] = arm.kind
        if why := _file(file, arm, rng):
            found["broken"].append(f"file: {why}")
            return found
        found["held"].append("file")
        for attempt in range(MOST_REFUSED):
            folder = Path(name) / str(attempt)
            folder.mkdir()
            line = drawn_line(file, arm, rng)
            if line is None:
                found["broken"].append(f"no line among {MOST_DRAWN} can be led by hand")
                return found
            job = Job(HostedArm(file, folder, trial.seed, arm.tool_m), arm, line, trial.seed)
            try:
                await job.done()
            except RequestRefused as refusal:
                if refusal.code in REFUSED:
                    found["refused"].append(f"{job.step}: {refusal.code}")
                    found["why"] = str(refusal)[:300]
                    continue
                job.broken.append(f"{job.step}: {refusal.code}: {refusal}")
            except ArmctlError as error:
                job.broken.append(f"{job.step}: {error}")
            finally:
                job.hosted.close()
            found["held"] += job.held
            found["figures"] = job.figures
            found["broken"] += job.broken
            return found
        found["broken"].append(f"{MOST_REFUSED} lines refused, the last: {found['why']}")
    return found


def written(trial: Trial, folder: Path, rng: np.random.Generator) -> tuple[Path, DrawnArm]:
    """The files of an arm, folded to a rest pose of which `arm check` finds nothing to say."""
    arm = drawn(trial.seed, trial.number)
    low, high = np.degrees(arm.limits_rad).T
    rests = rng.uniform(low + REST_ROOM_DEG, high - REST_ROOM_DEG, (50 * RESTS, arm.n)).round(1)
    rests[:, 0] = 0.0
    origins, axes = arm.axes(np.radians(rests))
    # What has least weight to hold up lies best: a unit of it at each joint, and at the tool.
    arms_m = origins[:, None, 2:] - origins[:, 1:-1, None]
    moments = np.cross(arms_m, axes[:, 1:, None])[..., 2] * (np.arange(1, arm.n)[:, None] < np.arange(2, arm.n + 1))
    heavy = np.abs(moments.sum(axis=2)).max(axis=1) + np.where(origins[:, 2:, 2].min(axis=1) < REST_M, math.inf, 0.0)
    for rest in rests[np.argsort(heavy)[:RESTS]].tolist():
        file = arm.resting(rest).write(folder)
        if judged(str(file)).ok:
            return file, arm.resting(rest)
    return arm.write(folder), arm


def _file(file: Path, arm: DrawnArm, rng: np.random.Generator) -> str:
    """What is wrong with what the package makes of the file."""
    judgement = judged(str(file))
    if not judgement.ok:
        return json.dumps(judgement.problems)
    robot = robots.of(load_arm(str(file)))
    q = rng.uniform(arm.limits_rad[:, 0], arm.limits_rad[:, 1], (POSES, arm.n))
    off = float(np.abs(forward_kinematics(robot.chain, q) - arm.tool_pose(q)).max())
    if off > SAME_M or np.abs(robot.limits_rad - arm.limits_rad).max() > SAME_M:
        return f"the tool is off by {off:.2g}, limits are {np.degrees(robot.limits_rad).tolist()} deg"
    return ""


def drawn_line(file: Path, arm: DrawnArm, rng: np.random.Generator) -> tuple[FloatArray, FloatArray] | None:
    """A line in front of the arm, along which a hand can lead it in every take; None: there is none."""
    hand = SimulatedArm(load_arm(str(file))).hand
    origins = arm.axes(np.zeros((1, arm.n)))[0][0]
    shoulder, stretched = origins[1], float(np.linalg.norm(np.diff(origins[1:], axis=0), axis=1).sum())
    for _ in range(MOST_DRAWN):
        q = rng.uniform(0.8 * arm.limits_rad[:, 0], 0.8 * arm.limits_rad[:, 1])[None]
        middle, way = arm.tool_m(q)[0], rng.standard_normal(3) * (1.0, 1.0, 0.4)
        half = rng.uniform(*LINE_M) / 2.0 * way / np.linalg.norm(way)
        A, B = middle - half, middle + half
        points = A + np.linspace(0.0, 1.0, 9)[:, None] * (B - A)
        far = float(np.linalg.norm(points - shoulder, axis=1).max()) > STRETCH * stretched
        if far or points[:, 2].min() < LOWEST_M or points[:, 0].min() < NEAR_M:
            continue
        try:
            for take in range(TAKES):
                hand.guide(A, B, seed=take)
        except UnreachableTarget:
            continue
        return A, B
    return None


class Job:
    """The whole job of one arm along one line."""

    def __init__(self, hosted: HostedArm, arm: DrawnArm, line: tuple[FloatArray, FloatArray], seed: int) -> None:
        self.hosted, self.arm, (self.A, self.B), self.seed = hosted, arm, line, seed
        self.held: list[str] = []
        self.broken: list[str] = []
        self.figures: dict[str, float] = {}
        self.step = ""
        # The first take's true tool points.
        self.taught_m: FloatArray = np.empty((0, 3))

    async def done(self) -> None:
        """Every step.

        Raises:
            ArmctlError: something is refused.
        """
        for self.step in STEPS[1:]:
            wrong = await getattr(self, f"_{self.step}")()
            if self.hosted.faults:
                wrong = [*wrong, f"faults {', '.join(sorted(self.hosted.faults))}"]
            self.broken += [f"{self.step}: {text}" for text in wrong]
            if not wrong:
                self.held.append(self.step)

    def _within(self, name: str, value_mm: float, bound_mm: float) -> list[str]:
        self.figures[name] = max(round(value_mm, 2), self.figures.get(name, 0.0))
        return [] if value_mm <= bound_mm else [f"{name} {value_mm:.2f} mm (bound {bound_mm:g})"]

    def _at(self, share: float) -> tuple[float, float, float]:
        x, y, z = (self.A + share * (self.B - self.A)).tolist()
        return x, y, z

    async def _teach(self) -> list[str]:
        hosted, wrong = self.hosted, []
        for take in range(TAKES):
            await hosted.ask("teach_begin", confirm=True)
            guided = hosted.simulated.hand.guide(self.A, self.B, seed=take)
            hosted.ticks(math.floor(guided.begin_s / PERIOD_S) - 3)
            begin = len(hosted.shafts_rad)
            await hosted.ask("take_begin", name=f"take{take}")
            hosted.ticks(math.ceil((guided.end_s - guided.begin_s) / PERIOD_S) + 10)
            await hosted.ask("take_end")
            true_m = self.arm.tool_m(np.array(hosted.shafts_rad[begin:]))
            await hosted.ask("teach_end")
            await hosted.ask("torque_on")
            hosted.simulated.hand.release()
            track = await hosted.ask("recordings_track", name=f"take{take}")
            wrong += self._within("track", float(_off_path_mm(np.array(track["tool_m"]), true_m).max()), TRACK_MM)
            if take == 0:
                self.taught_m = true_m
        await hosted.ask("park")
        await hosted.ask("torque_on")
        return wrong

    async def _play(self) -> list[str]:
        await self.hosted.ask("play", name="take0")
        off = _off_path_mm(self.hosted.path_m, self.taught_m)
        mean_mm, max_mm = PLAY_MM
        return [
            *self._within("play mean", float(off.mean()), mean_mm),
            *self._within("play max", float(off.max()), max_mm),
        ]

    async def _optimize(self) -> list[str]:
        takes = tuple(f"take{take}" for take in range(TAKES))
        ends = {"from_m": self._at(0.0), "to_m": self._at(1.0)}
        told = await self.hosted.ask(
            "optimize", recordings=takes, via=(2,), duration_s=DURATION_S, seed=self.seed, **ends
        )
        self._plan = json.loads(told["plans"][0]["text"])
        return [] if self._plan["via"] == 2 else [f"a plan of {self._plan['via']} via points"]

    async def _run(self) -> list[str]:
        told = await self.hosted.ask("run", plan=self._plan, refine=REFINE)
        kept = json.loads(Path(told["plan"]).read_text(encoding="utf-8")) if told.get("plan") else self._plan
        await self.hosted.ask("run", plan=kept)
        off = off_line_mm(self.hosted.path_m, self.A, self.B)
        mean_mm, max_mm = RUN_MM
        return [
            *self._within("run mean", float(off.mean()), mean_mm),
            *self._within("run max", float(off.max()), max_mm),
        ]

    async def _move(self) -> list[str]:
        wrong = []
        for share in (0.1, 0.9, 0.5):
            await self.hosted.ask("move", point_m=self._at(share))
            off_mm = 1e3 * math.dist(self.hosted.tool_m, self._at(share))
            wrong += self._within("move", off_mm, MOVE_MM)
        return wrong

    async def _reach(self) -> list[str]:
        """Where the straight way to a point from above is none, that along the tool, or that to another point."""
        grips = self.hosted.arm.gripper is not None
        how: dict[str, Any] = {"off_m": 0.02, "gripper": "grip" if grips else "stay"}
        refusals: list[RequestRefused] = []
        for share in (0.3, 0.7, 0.5):
            for along in ("above", "tool"):
                try:
                    told = await self.hosted.ask("reach", point_m=self._at(share), along=along, **how)
                except RequestRefused as refusal:
                    if refusal.code not in REFUSED:
                        raise
                    refusals.append(refusal)
                    continue
                wrong = self._within("reach", float(told["position_error_mm"]), REACH_MM)
                if grips:
                    wrong += ["it says that it holds what is not there"] if told["gripped"] else []
                else:
                    wrong += self._within("reach", 1e3 * math.dist(self.hosted.tool_m, self._at(share)), REACH_MM)
                return wrong
        raise refusals[0]

    async def _park(self) -> list[str]:
        told = await self.hosted.ask("park")
        rest = [joint["rest_deg"] for joint in yaml.safe_load(self.arm.files[FILE])["joints"]]
        off = np.abs(np.degrees(self.hosted.simulated.true_positions()[: self.arm.n]) - rest)
        wrong = [] if told["state"] == "off" else [f"it is {told['state']}"]
        return wrong + ([f"{off.max():.1f} deg from rest (bound {REST_DEG:g})"] if off.max() > REST_DEG else [])


def _off_path_mm(points: FloatArray, path: FloatArray) -> FloatArray:
    """How far points are from a path through others [mm], shape (m,)."""
    A, way = path[:-1], np.diff(path, axis=0)
    share = ((points[:, None] - A) * way).sum(axis=2) / np.maximum((way**2).sum(axis=1), 1e-18)
    near = A + np.clip(share, 0.0, 1.0)[..., None] * way
    return np.asarray(1e3 * np.linalg.norm(points[:, None] - near, axis=2).min(axis=1))


def prove(seed: int, tell: Callable[[str], None], *, arms: int = ARMS, workers: int = WORKERS) -> dict[str, Any]:
    """What held of each arm, and what did not."""
    began_s = time.monotonic()
    found = carry_out(run, [Trial(seed, number) for number in range(arms)], tell, workers)
    broken = [f"arm {one['number']} ({one['arm']}): {text}" for one in found for text in one["broken"]]
    missing = [
        f"arm {one['number']} ({one['arm']}): only {', '.join(one['held']) or 'nothing'} held"
        for one in found
        if not one["broken"] and one["held"] != list(STEPS)
    ]
    return {
        "runs": len(found),
        "violations": broken + missing,
        "arms": [{key: one[key] for key in ("number", "arm", "held", "refused")} | one["figures"] for one in found],
        "seed": seed,
        "seconds": round(time.monotonic() - began_s, 1),
    }
