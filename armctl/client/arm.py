"""The arm for programs in Python: every motion by its name, with typed parameters and answers.

    with Arm() as arm:
        arm.torque_on()
        arm.move(xyz=(0.18, 0.0, 0.15))
        arm.play("line-1")

Rules.
1. Angles are radians, places x, y, z in metres from the base. A method answers when the motion has come to its end.
2. What a client moves ends with it. Ctrl-C stops the arm, also in a notebook, which keeps the connection. The end of
   the `with` block or of the process closes the connection: the daemon sees it and slows the arm down.
3. What fails in the daemon is raised here, an `ArmctlError` with every reason. One that was stopped is one.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

import numpy as np

from armctl.client.answers import Followed, Moved, Programmed, Recorded, State, Status
from armctl.client.asynchronous import AsyncClient
from armctl.client.blocking import Client
from armctl.client.protocol import Requests, heartbeats
from armctl.errors import ArmctlError
from armctl.files import read_text
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.plan import plan_from_text
from armctl.trajectory.program import program_from_text
from armctl.trajectory.tool_path import Kind

T = TypeVar("T")
# Of each kind of answer: it, or what has to be awaited for it.
StateT = TypeVar("StateT")
StatusT = TypeVar("StatusT")
MovedT = TypeVar("MovedT")
FollowedT = TypeVar("FollowedT")
ProgrammedT = TypeVar("ProgrammedT")
Later = Coroutine[Any, Any, T]

Numbers = Sequence[float] | FloatArray
Goal = Numbers | None
Time = float | None
# One tick, and its joint positions [rad], shape (joints,); those that are not known are NaN.
Sample = tuple[Status, FloatArray]
Points = Sequence[Numbers] | FloatArray
Kinds = Sequence[Kind]


class Commands(Generic[StateT, StatusT, MovedT, FollowedT, ProgrammedT]):
    """What an arm can be asked for.

    Every method raises `ArmctlError`: what was asked was refused, with every reason, or was stopped, or failed.
    """

    def _each(self, requests: Requests) -> T:  # type: ignore[type-var]  # a method says which answer it is
        """The answer to the last of the requests, asked one after the other."""
        raise NotImplementedError

    def _ask(self, method: str, **params: Any) -> T:  # type: ignore[type-var]
        return self._each([(method, {name: value for name, value in params.items() if value is not None})])

    def status(self) -> StatusT:
        """One snapshot, of now."""
        return self._ask("status")

    def stop(self) -> StateT:
        """Slow down on the path and hold; answers when the arm is still."""
        return self._ask("stop")

    def pause(self) -> StateT:
        """Come to rest on the path; `resume` goes on."""
        return self._ask("pause")

    def resume(self) -> StateT:
        """Go on after `pause`."""
        return self._ask("resume")

    def torque_on(self) -> StateT:
        """Hold the present position."""
        return self._ask("torque_on")

    def release(self, *, confirm: Literal[True]) -> StateT:
        """Go limp: the arm drops, so support it."""
        return self._ask("release", confirm=confirm)

    def park(self) -> StateT:
        """Go slowly to the rest pose, and limp there."""
        return self._ask("park")

    def clear(self) -> StateT:
        """End the faults whose cause is gone."""
        return self._ask("clear")

    def move(self, *, xyz: Goal = None, joints_rad: Goal = None, pose: Goal = None, duration_s: Time = None) -> MovedT:
        """Go to one of: a tool point [m], joint positions [rad], or a pose x, y, z [m], roll, pitch, yaw [rad].

        Args:
            duration_s: None: at most 20 deg/s.
        """
        return self._ask("move", point_m=xyz, joints_rad=joints_rad, pose=pose, duration_s=duration_s)

    def jog(self, seconds: float, *, tool_m_s: Numbers = (), joints_rad_s: Numbers = ()) -> StateT:
        """Lead the tool [m/s], or turn the joints [rad/s], for so long; without further heartbeats the arm stops."""
        return self._each(heartbeats(seconds, tool_m_s=tool_m_s, joints_rad_s=joints_rad_s))

    def reach(self, xyz: Numbers, *, gripper: Literal["stay", "grip", "let_go"] = "stay") -> MovedT:
        """Come to a point [m] straight from above; grip what is there, or let it go, and back off."""
        return self._ask("reach", point_m=xyz, gripper=gripper)

    def grip(self, grip: Literal["close", "open"] = "close") -> MovedT:
        """Close the gripper until its load shows a grip, or open it."""
        return self._ask("grip", grip=grip)

    def play(self, name: str, *, rate: float = 1.0, repeat: int = 1) -> FollowedT:
        """Move as was taught.

        Args:
            name: Of the recording.
            rate: Taught seconds a second, 0.1 to 2.
            repeat: How often.
        """
        return self._ask("play", name=name, rate=rate, repeat=repeat)

    def path(
        self, points_m: Points, *, kinds: Kinds = (), duration_s: Time = None, tolerance_mm: float = 2, refine: int = 0
    ) -> FollowedT:
        """Lead the tool along points [m], shape (m, 3): by a `line`, or an `arc` that goes `through` another.

        Args:
            kinds: How each point is reached; empty: by lines.
            duration_s: None: about 30 mm/s.
            tolerance_mm: How far a corner may be cut.
            refine: Further runs at most, which correct it.
        """
        how = {"kinds": kinds, "duration_s": duration_s, "tolerance_mm": tolerance_mm, "refine": refine}
        return self._ask("path", points_m=points_m, **how)

    def run(self, plan: str | Path, *, refine: int = 0) -> FollowedT:
        """Run the plan in a file.

        Args:
            refine: Further runs at most, which correct it.
        """
        wanted = plan_from_text(read_text(Path(plan), "plan"), str(plan))
        return self._ask("run", plan=wanted.model_dump(mode="json"), refine=refine)

    def program_run(self, file: str | Path, *, from_step: str | None = None) -> ProgrammedT:
        """Run the program in a file, from where it stands, or from a step."""
        program = program_from_text(read_text(Path(file), "program"), str(file), Path(file).stem)
        return self._ask("program_run", from_step=from_step, **program.model_dump(exclude_none=True))


class Arm(Commands[State, Status, Moved, Followed, Programmed], Client):
    """The arm behind a socket, for programs that wait for each answer.

    Args:
        socket: The daemon's; None: `ARMCTL_SOCKET`, else the usual place.
    Raises:
        NoDaemon: nobody answers there.
    """

    def samples(self) -> Iterator[Sample]:
        """What the arm does, tick by tick; whoever lags loses the oldest."""
        return map(_sample, self.subscribe())

    def teach(self, name: str, until: Callable[[], object] = input, *, confirm: bool = False) -> Recorded:
        """Record a take of the limp arm, while you lead it, until a function returns: Enter is pressed, unless told.

        Args:
            confirm: The arm may go limp now, and drop. One that is limp already needs no such word.
        """
        self.call("teach_begin", confirm=confirm or self.status()["state"] == "off")
        try:
            self.call("take_begin", name=name)
            until()
            return cast(Recorded, self.call("take_end"))
        finally:
            self.call("teach_end")

    def _each(self, requests: Requests) -> Any:
        try:
            for method, params in requests:
                answer = self.call(method, **params)
        except ArmctlError:
            raise
        except BaseException:  # a notebook, say, keeps the connection: without this the arm would go on
            self.call("stop")
            raise
        return answer


class AsyncArm(Commands[Later[State], Later[Status], Later[Moved], Later[Followed], Later[Programmed]], AsyncClient):
    """The same for programs that do several things at once: `async with AsyncArm() as arm: await arm.move(...)`."""

    async def samples(self) -> AsyncIterator[Sample]:
        """As `Arm.samples`."""
        async for snapshot in self.subscribe():
            yield _sample(snapshot)

    async def _each(self, requests: Requests) -> Any:  # type: ignore[override]  # `Later` of each kind of answer
        try:
            for method, params in requests:
                answer = await self.call(method, **params)
        except asyncio.CancelledError:
            await self.call("stop")
            raise
        return answer


def _sample(status: Any) -> Sample:
    return status, np.array([joint["position_rad"] for joint in status["joints"]], np.float64)
