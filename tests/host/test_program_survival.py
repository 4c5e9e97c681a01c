"""Random programs with stops, faults and kills in between: each goes on or says why not, and none leaves a step out.

Judged by what the servos were told and where they came, not by what the daemon says of it. Every move, path and taught
motion of a program turns the first joint to where no other one does, so what was done is read off the joints.
"""

import asyncio
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from armctl.config import validate
from armctl.control.machine import State
from armctl.dynamixel import ax12a
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.host import programs
from armctl.host.programs import Site
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.messages import Mode, Run, TickRecord
from armctl.trajectory.path_motion import PathMotion, path_motion
from armctl.trajectory.program import ProgramRequest, written_out
from armctl.trajectory.tool_path import PathRequest
from proving.hosted_arm import Inline
from tests.control.ideal_arm import PERIOD_S, IdealArm
from tests.host.bench import Bench

ARM = load_arm("xiang-6dof").model_copy(update={"correction": False})
assert ARM.gripper is not None
GRIPPER = ARM.joint_names.index(ARM.gripper.joint)
Steps = list[dict[str, Any]]
# Where the other joints are: there a path begins near to where a move ends.
OTHERS = (0.949, -0.405, -0.591, 1.338, 0.0)
APART_RAD = 0.03
TOOL_M = tool_position(robots.get(ARM.robot, ARM.lengths_m).chain, np.array([0.0, *OTHERS[:-1]]))
LEAVES = st.sampled_from(["move", "move", "move", "play", "path", "close", "open", "wait"])


def _holders(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    some = st.lists(inner, min_size=1, max_size=3)
    repeats = st.builds(lambda times, steps: {"repeat": {"times": times, "steps": steps}}, st.integers(2, 3), some)
    return repeats | st.builds(lambda a, b: {"if_gripped": {"then": a, "otherwise": b}}, some, some)


SHAPES = st.lists(LEAVES | _holders(LEAVES | _holders(LEAVES)), min_size=2, max_size=5)
KINDS = st.sampled_from(["stop", "fault", "control killed", "daemon killed"])
DISTURBANCES = st.lists(st.tuples(st.integers(1, 60), KINDS), min_size=1, max_size=5)


def _taught(to_rad: float) -> dict[str, Any]:
    """A motion of the whole arm, the gripper too: it is open."""
    turns = np.linspace(to_rad - APART_RAD / 2.0, to_rad, 5).tolist()
    rows = [[turn, *OTHERS] for turn in turns]
    return {"motion": {"joints": ARM.joint_names, "time_s": [0.0, 0.25, 0.5, 0.75, 1.0], "positions_rad": rows}}


def _path(to_rad: float) -> dict[str, Any]:
    radius_m, z = math.hypot(*TOOL_M[:2]), float(TOOL_M[2])
    turns = (to_rad - APART_RAD / 2.0, to_rad)
    return {"points_m": [[radius_m * math.cos(turn), radius_m * math.sin(turn), z] for turn in turns]}


MOTIONS: dict[str, Callable[[float], dict[str, Any]]] = {
    "move": lambda to_rad: {"joints_rad": [to_rad, *OTHERS]},
    "play": _taught,
    "path": _path,
}


PLANNED: dict[Any, PathMotion] = {}


def planned_once(request: PathRequest, q_now: Sequence[float], *where: Any) -> PathMotion:
    """A path is planned in a second or two, and the same one again for each run of a program."""
    key = request, tuple(q_now)
    if key not in PLANNED:
        PLANNED[key] = path_motion(request, q_now, *where)
    return PLANNED[key]


def _goes_to_rad(kind: str, what: dict[str, Any]) -> float:
    """Where a motion ends, of the first joint."""
    if kind == "path":
        x, y, _ = what["points_m"][-1]
        return math.atan2(y, x)
    return float(what["joints_rad"][0] if kind == "move" else what["motion"]["positions_rad"][-1][0])


def filled(shapes: list[Any], numbers: Iterator[int]) -> Steps:
    """The steps of such a shape; each move, path and taught motion turns the first joint to a place of its own."""
    steps: Steps = []
    for shape in shapes:
        if isinstance(shape, str) and shape in MOTIONS:
            steps.append({shape: MOTIONS[shape](round(APART_RAD * next(numbers), 5))})
        elif shape == "wait":
            steps.append({"wait_s": 0.4})
        elif isinstance(shape, str):
            steps.append({"grip": shape})
        else:
            steps.append(
                {k: {n: filled(v, numbers) if n != "times" else v for n, v in w.items()} for k, w in shape.items()}
            )
    return steps


@dataclass
class Wanted:
    """What is to be done, by the definition of a program.

    Args:
        thing: Whether there is something to grip.
    """

    thing: bool
    gripped: bool = False
    # Where the first joint goes [tick], or what the gripper does.
    motions: list[Any] = field(default_factory=list)

    def do(self, steps: Steps) -> list[Any]:
        for step in steps:
            [(kind, what)] = step.items()
            if kind == "repeat":
                for _ in range(what["times"]):
                    self.do(what["steps"])
            elif kind == "if_gripped":
                self.do(what["then" if self.gripped else "otherwise"])
            elif kind == "grip":
                self.gripped = what == "close" and self.thing
                self.motions.append(what)
            elif kind in MOTIONS:
                self.gripped = self.gripped and kind != "play"
                self.motions.append(round(ARM.joints[0].tick(_goes_to_rad(kind, what))))
        return self.motions


def in_a_row(motions: Iterable[Any]) -> dict[tuple[int, Any], int]:
    """Each motion by its place in their order, and how often it comes there in a row."""
    return {(place, what): len(list(same)) for place, (what, same) in enumerate(groupby(motions))}


class Arm(Bench):
    """An arm whose daemon and control process may be killed, and what was done with it."""

    def __init__(self, folder: Path, thing: bool) -> None:
        ideal = IdealArm(ARM, stuck={GRIPPER} if thing else set())
        ideal.after_write = self._unloaded
        super().__init__(ideal)
        self.site = Site(ARM, ideal.robot, PERIOD_S, folder / "recordings")
        # Each motion that the arm was told: what, its request, and whether it was done.
        self.told: list[list[Any]] = []

    @staticmethod
    def _unloaded(arm: IdealArm) -> None:
        """A gripper at its goal pushes no more."""
        if arm.get(GRIPPER, ax12a.GOAL) == arm.get(GRIPPER, ax12a.PRESENT_POSITION):
            arm.put(GRIPPER, ax12a.PRESENT_LOAD, 0)

    def tick(self, **changes: Any) -> TickRecord:
        record = super().tick(**changes)
        for command in record.inputs.commands:
            if isinstance(command, Run):
                way = command.trajectory
                place = round(ARM.joints[0].tick(way.positions_rad[-1][0]))
                what = "close" if way.grip else "open" if way.label == "let go" else place
                self.told.append([what, command.request_id, False])
        for reply in record.outputs.replies:
            if self.told and reply.request_id == self.told[-1][1] and reply.ok:
                what = self.told[-1][0]
                assert isinstance(what, str) or abs(self.arm.get(0, ax12a.PRESENT_POSITION) - what) <= 1
                self.told[-1][2] = True
        return record

    def done(self) -> dict[tuple[int, Any], int]:
        """What was done to its end."""
        return in_a_row(what for what, _, done in self.told if done)

    def restart_control(self) -> None:
        """The control process is killed, and another takes the arm as it finds it."""
        self.host.control_lost()
        self.control.take()
        self.arm.state = State()
        self.control.connect_again()
        self.attach()
        self.tick()

    def restart_daemon(self) -> None:
        """Nothing of the daemon is left but what is on the disk."""
        self.control.take()
        ideal, told, site = self.arm, self.told, self.site
        self.recorder = type(self.recorder)()
        self.host = type(self.host)(ARM, ideal.robot, PERIOD_S, self.recorder, self.clock)
        self.restart_control()
        self.told, self.site = told, site

    def over(self, task: "asyncio.Task[dict[str, Any]]", tick: int | None) -> bool:
        return task.done() or (tick is not None and self.arm.tick >= tick)

    async def disturb(self, kind: str, task: "asyncio.Task[dict[str, Any]]") -> None:
        """Let something happen, until the program has ended for it, and the arm holds again."""
        if kind == "stop":
            await self.served(self.host.stop())
        elif kind == "control killed":
            self.restart_control()
        elif kind == "daemon killed":
            task.cancel()  # it ends where it waits: nothing more is written
            await asyncio.wait({task})
            self.restart_daemon()
        else:
            self.arm.silent = {1}
        await self.until(task.done)
        self.arm.silent = set()
        self.ticks(3)
        if self.arm.mode() is Mode.FAULTED:
            await self.served(self.host.command(self.anna, "clear"))


async def survives(
    arm: Arm, steps: Steps, disturbances: list[tuple[int, str]], expected: dict[tuple[int, Any], int]
) -> None:
    """Run it to its end, whatever happens."""
    await arm.holding()
    request = program = validate(ProgramRequest, {"name": "random", "steps": steps}, "p")
    stands = None
    left = [*disturbances, (0, "")]
    while left:
        after, kind = left.pop(0)
        task = asyncio.ensure_future(programs.run(arm.host, arm.anna, arm.site, request))
        await arm.until(partial(arm.over, task, arm.arm.tick + after if kind else None))
        if not task.done():
            await arm.disturb(kind, task)
        if task.cancelled():  # nobody hears what became of it
            if programs.stands_at(arm.site, request) is None and arm.done().keys() == expected.keys():
                break  # it had just ended
        elif (why := task.exception()) is not None:
            assert isinstance(why, RequestRefused), repr(why)
            if why.code == "NOT_RESUMED":  # a taught motion had opened the gripper, and was not done
                due = next(one.step for one in written_out(request) if one.at == stands)
                assert due is not None
                assert due.play, why
                request = program.model_copy(update={"from_step": stands})
                left.insert(0, (after, kind))
                continue
            assume("poses lead here" not in str(why))  # it is too branched to be checked, and nothing has moved
            assert str(why) == "the program was stopped before it began", why
        else:
            result = task.result()
            assert result["resumed_at"] == stands
            if result["ended"] is None:
                break
            assert result["stands_at"] == result["steps"][-1]["name"]
        request = program
        stands = programs.stands_at(arm.site, request)


@settings(max_examples=20, deadline=None)
@given(SHAPES, st.booleans(), DISTURBANCES)
def test_none_leaves_a_step_out_and_each_goes_on_where_it_was(
    shapes: list[Any], thing: bool, disturbances: list[tuple[int, str]]
) -> None:
    steps = filled(shapes, itertools.count(1))
    expected = in_a_row(Wanted(thing).do(steps))
    assume(expected)

    async def trial(folder: Path) -> None:
        asyncio.get_running_loop().set_default_executor(Inline())
        arm = Arm(folder, thing)
        try:
            with patch.object(programs, "path_motion", planned_once):
                await survives(arm, steps, disturbances, expected)
        finally:
            arm.control.die()
            arm.control.link.close()
        done = arm.done()
        assert done.keys() == expected.keys()
        again = [done[what] - once for what, once in expected.items()]
        assert min(again) >= 0
        assert sum(again) <= len(disturbances)

    with TemporaryDirectory() as folder:
        asyncio.run(trial(Path(folder)))
