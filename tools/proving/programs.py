"""Random programs on a simulated arm with a gripper, in virtual time: whatever happens meanwhile, each goes on where it
stood or says why not, and none leaves a step out.

| happens | what it is |
|-|-|
| stop | somebody stops the arm |
| fault | a servo is silent for a second; then the fault is cleared |
| control killed, daemon killed | a process ends; another one begins with what is on the disk |
| power cut | both end, and every servo restarts without torque; somebody holds the arm and switches it on again |

Judged by what the control process was told to do, what it answered, and where the simulated shafts then were; not by
what the daemon says of it. Every move, path and taught motion of a program turns the first joint to where no other one
does, so what was done is read off that joint. A program that refuses to go on is begun anew where it may refuse that:
what it held was dropped (a power cut, or a taught motion that opens the gripper and was not done).
"""

import asyncio
import itertools
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from armctl.errors import ArmctlError, RequestRefused
from armctl.files import find_arm_file
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.messages import Mode, Run, TickRecord
from armctl.sim.faults import Fault
from proving.hosted_arm import MOST_TICKS, HostedArm
from proving.workers import WORKERS, carry_out

ARM = "xiang-6dof"
PROGRAMS = 100
KINDS = ("stop", "fault", "control killed", "daemon killed", "power cut")
MOST_HAPPENINGS = 5
# A happening comes at most so many ticks after a program was begun.
WITHIN_TICKS = 150
# Where the other joints are: there a path begins near to where a move ends.
OTHERS = (0.949, -0.405, -0.591, 1.338, 0.0)
GRIPPER = 5
APART_RAD = 0.06
# With more motions the first joint would come to its limit.
MOST_MOTIONS = 40
# Farther from its place than that, the first joint is nearer to another one.
THERE_RAD = APART_RAD / 2.0
MUTE_S = 1.0
# Within its limits a joint gets torque; somebody holds each so far inside.
HELD_INSIDE_RAD = math.radians(2.0)
# Begun so often, a program makes no headway.
MOST_BEGINS = 30

Steps = list[dict[str, Any]]


# ---------------------------------------------------------------------------------------------- what is drawn


@dataclass(frozen=True)
class Trial:
    """A program, and what happens meanwhile: (ticks after it was begun, what)."""

    seed: tuple[int, int]
    steps: Steps
    # Whether there is something to grip.
    thing: bool
    happenings: tuple[tuple[int, str], ...]


def drawn(seed: int, number: int) -> Trial:
    rng = np.random.default_rng((seed, number))
    while True:
        steps = _steps(rng, 2, itertools.count(1))
        if wanted(steps, thing=True) and wanted(steps, thing=False) and _places(steps) <= MOST_MOTIONS:
            break
    count = int(rng.integers(1, MOST_HAPPENINGS + 1))
    kinds = rng.permutation(len(KINDS))[:count]
    happenings = tuple((int(rng.integers(1, WITHIN_TICKS)), KINDS[kind]) for kind in kinds)
    return Trial((seed, number), steps, bool(rng.integers(2)), happenings)


def _steps(rng: np.random.Generator, depth: int, numbers: Iterator[int]) -> Steps:
    return [_step(rng, depth, numbers) for _ in range(int(rng.integers(2, 6) if depth == 2 else rng.integers(1, 4)))]


def _step(rng: np.random.Generator, depth: int, numbers: Iterator[int]) -> dict[str, Any]:
    if depth and rng.random() < 0.25:
        inner = [_steps(rng, depth - 1, numbers) for _ in range(2)]
        if rng.random() < 0.5:
            return {"repeat": {"times": int(rng.integers(2, 4)), "steps": inner[0]}}
        return {"if_gripped": {"then": inner[0], "otherwise": inner[1]}}
    kind = str(rng.choice(["move", "move", "move", "play", "path", "close", "open", "wait_s"]))
    if kind in MOTIONS:
        return {kind: MOTIONS[kind](round(APART_RAD * (next(numbers) - MOST_MOTIONS // 2), 5))}
    return {"wait_s": 0.4} if kind == "wait_s" else {"grip": kind}


def _move(to_rad: float) -> dict[str, Any]:
    return {"joints_rad": [to_rad, *OTHERS]}


def _taught(to_rad: float) -> dict[str, Any]:
    """A motion of the whole arm, the gripper too: it is open."""
    rows = [[turn, *OTHERS] for turn in np.linspace(to_rad - APART_RAD / 2.0, to_rad, 5).tolist()]
    names = ["waist", "shoulder", "elbow", "wrist", "roll", "gripper"]
    return {"motion": {"joints": names, "time_s": [0.0, 0.25, 0.5, 0.75, 1.0], "positions_rad": rows}}


def _path(to_rad: float) -> dict[str, Any]:
    x, y, z = tool_position(robots.get(ARM).chain, np.array([0.0, *OTHERS[:-1]]))
    radius_m = math.hypot(x, y)
    turns = (to_rad - APART_RAD / 2.0, to_rad)
    return {"points_m": [[radius_m * math.cos(turn), radius_m * math.sin(turn), float(z)] for turn in turns]}


MOTIONS: dict[str, Callable[[float], dict[str, Any]]] = {"move": _move, "play": _taught, "path": _path}


def _goes_to_rad(kind: str, what: dict[str, Any]) -> float:
    """Where a motion ends, of the first joint."""
    if kind == "path":
        x, y, _ = what["points_m"][-1]
        return math.atan2(y, x)
    return float(what["joints_rad"][0] if kind == "move" else what["motion"]["positions_rad"][-1][0])


def _places(steps: Steps) -> int:
    """How many motions there are, of both branches."""
    count = 0
    for [(kind, what)] in map(dict.items, steps):
        inner = [what[key] for key in ("steps", "then", "otherwise") if isinstance(what, dict) and key in what]
        count += (kind in MOTIONS) + sum(map(_places, inner))
    return count


# ---------------------------------------------------------------------------------------------- what is to be done


def wanted(steps: Steps, *, thing: bool) -> list[Any]:
    """What is to be done, by the definition of a program: places of the first joint [rad], `close` and `open`."""
    motions, gripped = [], False

    def do(some: Steps) -> None:
        nonlocal gripped
        for [(kind, what)] in map(dict.items, some):
            if kind == "repeat":
                for _ in range(what["times"]):
                    do(what["steps"])
            elif kind == "if_gripped":
                do(what["then" if gripped else "otherwise"])
            elif kind == "grip":
                gripped = what == "close" and thing
                motions.append(what)
            elif kind in MOTIONS:
                gripped = gripped and kind != "play"
                motions.append(_place(_goes_to_rad(kind, what)))

    do(steps)
    return motions


def _place(at_rad: float) -> float:
    """A place by which a motion is known: two of them are half of `APART_RAD` from each other, or more."""
    return round(at_rad, 2)


def in_a_row(motions: Iterable[Any]) -> list[tuple[Any, int]]:
    """Each motion, and how often it comes in a row."""
    return [(what, len(list(same))) for what, same in groupby(motions)]


# ---------------------------------------------------------------------------------------------------- one trial


@dataclass
class Story:
    """What became of a program."""

    trial: Trial
    # Each motion that the arm was told since the program was begun anew: what, its request, and whether it was done.
    told: list[list[Any]] = field(default_factory=list)
    resumed: int = 0
    begun_anew: int = 0
    # What really happened: the program may end before its turn.
    happened: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)

    def done(self) -> list[Any]:
        return [what for what, _, done in self.told if done]


class Arm(HostedArm):
    """The arm, and who stands beside it."""

    def __init__(self, folder: Path, story: Story) -> None:
        super().__init__(find_arm_file(ARM), folder, story.trial.seed[1], lambda q: q[:, :3])
        self.folder, self.story = folder, story
        if story.trial.thing:  # as thick as the open gripper
            gripper_id = self.arm.joints[GRIPPER].servo_id
            self.simulated.faults.begin(Fault(kind="blocked_joint", servo_id=gripper_id), self.simulated.time_s)
        self.virtual.on_tick = self._watch

    def _watch(self, record: TickRecord) -> None:
        told = self.story.told
        for command in record.inputs.commands:
            if isinstance(command, Run):
                way = command.trajectory
                place = _place(way.positions_rad[-1][0])
                told.append(
                    ["close" if way.grip else "open" if way.label == "let go" else place, command.request_id, False]
                )
        for reply in record.outputs.replies:
            if told and reply.request_id == told[-1][1] and reply.ok:
                what, at_rad = told[-1][0], float(self.simulated.true_positions()[0])
                if not isinstance(what, str) and abs(at_rad - what) > THERE_RAD:
                    self.story.broken.append(f"a motion to {what} rad ended at {at_rad:.3f}")
                told[-1][2] = True

    async def holding(self) -> None:
        """Clear what is over, and switch torque on where it is off."""
        self.ticks(3)
        if self.virtual.loop.state.mode is Mode.FAULTED:
            await self.ask("clear")
        if self.virtual.loop.state.mode is Mode.OFF:
            await self.ask("torque_on")

    async def happens(self, kind: str, work: "asyncio.Task[dict[str, Any]]") -> None:
        """Let it happen; the program has ended for it, and the arm holds again."""
        self.story.happened.append(kind)
        muted = held = None
        if kind == "stop":
            await self.ask("stop")
        elif kind == "fault":
            fault = Fault(kind="mute", servo_id=self.arm.joints[1].servo_id, duration_s=MUTE_S)
            muted = self.simulated.faults.begin(fault, self.simulated.time_s)
        else:
            if kind != "control killed":
                work.cancel()  # it ends where it waits: nothing more is written
                await asyncio.wait({work})
                self.close()
                self.serve(self.folder)
                for told in self.story.told[-1:]:
                    told[1] = None  # the next one counts its requests anew
            if kind == "power cut":
                low, high = np.array([joint.limits_rad for joint in self.arm.joints]).T
                inside = np.clip(self.simulated.true_positions(), low + HELD_INSIDE_RAD, high - HELD_INSIDE_RAD)
                held = self.simulated.hand.hold(inside)
                for servo in self.simulated.servos:
                    servo.reboot()
            self._host.control_lost()
            self.virtual.restart(restarted=kind != "power cut")
            self._host.exchange.attach(1, self._send)
        await self.pass_by(MOST_TICKS, work)
        if muted is not None:
            self.ticks(round((MUTE_S + 1.0) / self.virtual.period_s))
        if held is not None:  # it stands still before it gets torque
            self.ticks(math.ceil((held.duration_s + 0.5) / self.virtual.period_s))
        await self.holding()
        self.simulated.hand.release()


async def lived(folder: Path, trial: Trial) -> Story:
    """The program, begun as often as it takes."""
    story = Story(trial)
    arm = Arm(folder, story)
    try:
        await arm.holding()
        await _to_its_end(arm, story)
    except (ArmctlError, AssertionError) as error:
        story.broken.append(f"{type(error).__name__}: {error}")
    finally:
        arm.close()
    expected, done = in_a_row(wanted(trial.steps, thing=trial.thing)), in_a_row(story.done())
    if [what for what, _ in done] != [what for what, _ in expected]:
        story.broken.append(f"done was {done}, wanted {expected}")
    else:
        again = [times - once for (_, times), (_, once) in zip(done, expected, strict=True)]
        if min(again) < 0 or sum(again) > len(story.happened):
            story.broken.append(f"done was {done}, wanted {expected}, after {', '.join(story.happened) or 'nothing'}")
    return story


async def _to_its_end(arm: Arm, story: Story) -> None:
    program: dict[str, Any] = {"name": "random", "steps": story.trial.steps}
    left, cut = [*story.trial.happenings], False
    stands: str | None = None
    from_step: str | None = None
    for _ in range(MOST_BEGINS):
        after, kind = left.pop(0) if left else (MOST_TICKS, "")
        work = arm.begin("program_run", from_step=from_step, **program)
        await arm.pass_by(after, work)
        if not work.done() and kind:
            await arm.happens(kind, work)
        if work.cancelled():  # nobody hears what became of it
            cut = cut or kind == "power cut"
        elif (why := work.exception()) is not None:
            if not isinstance(why, RequestRefused):
                raise why
            if why.code == "NOT_RESUMED":
                if not (story.trial.thing and (cut or _opens(stands, story.trial.steps))):
                    raise why
                story.told.clear()
                story.begun_anew += 1
                stands, from_step = None, "1"
                left.insert(0, (after, kind))
                continue
            if why.code != "STOPPED":
                raise why
        else:
            result = work.result()
            if result["resumed_at"] != stands:
                raise ArmctlError(f"it went on at {result['resumed_at']}, and stood at {stands}")
            story.resumed += stands is not None
            if result["ended"] is None:
                return
        from_step = None
        checked = await arm.ask("program_check", **program)
        stands = checked["resumed_at"]
        if stands is None and not _due(story):
            return  # it had just ended
    raise ArmctlError(f"not at its end after {MOST_BEGINS} begins")


def _due(story: Story) -> bool:
    """Whether something is still to be done."""
    trial = story.trial
    return [w for w, _ in in_a_row(story.done())] != [w for w, _ in in_a_row(wanted(trial.steps, thing=trial.thing))]


def _opens(at: str | None, steps: Steps) -> bool:
    """Whether the step of that name plays a motion, which opens the gripper."""
    step: dict[str, Any] = {"repeat": {"steps": steps}}
    for part in (at or "1").partition("@")[0].split("."):
        [inner] = step.values()
        step = inner["steps"][int(part) - 1] if part.isdecimal() else {part: {"steps": inner[part]}}
    return "play" in step


# ------------------------------------------------------------------------------------------------------ all of them


def run(trial: Trial) -> dict[str, Any]:
    """One program, in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as folder:
        story = asyncio.run(lived(Path(folder), trial))
    return {"number": trial.seed[1], "motions": len(wanted(trial.steps, thing=trial.thing)), "happened": story.happened,
            "resumed": story.resumed, "begun_anew": story.begun_anew, "broken": story.broken}  # fmt: skip


def prove(seed: int, tell: Callable[[str], None], *, runs: int = PROGRAMS, workers: int = WORKERS) -> dict[str, Any]:
    """So many programs, and everything that was broken."""
    began_s = time.monotonic()
    done = carry_out(run, [drawn(seed, number) for number in range(runs)], tell, workers)
    return {
        "runs": len(done),
        "happened": {kind: sum(one["happened"].count(kind) for one in done) for kind in KINDS},
        "resumed": sum(one["resumed"] for one in done),
        "begun_anew": sum(one["begun_anew"] for one in done),
        "motions": sum(one["motions"] for one in done),
        "violations": [f"program {one['number']}: {text}" for one in done for text in one["broken"]],
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }
