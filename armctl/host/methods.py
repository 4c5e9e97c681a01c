"""What clients can ask for: names, parameters, and which part of the daemon answers."""

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from armctl.config import Frozen, Name
from armctl.errors import ArmctlError, RequestRefused
from armctl.genetic.alignment import align
from armctl.genetic.straight_line import Progress
from armctl.host import plans, programs, teaching
from armctl.host.exchange import COMMANDS
from armctl.host.host import Host
from armctl.host.jobs import OptimizeJob, RecordedRequest
from armctl.host.jsonrpc import error_data
from armctl.host.motions import move, path, play, run, transfer
from armctl.host.reach import grip, reach
from armctl.host.refining import MOST_FURTHER, refine, refine_path
from armctl.host.server import PERSON, Connection, Method
from armctl.kinematics.chain import tool_position
from armctl.recording import recordings
from armctl.recording.recordings import describe, drawn, listing
from armctl.trajectory.bounds import Metre, Point, Radian
from armctl.trajectory.grasp import GripRequest, ReachRequest
from armctl.trajectory.plan import Plan, plan_positions, plan_to_text
from armctl.trajectory.playback import PlayRequest, TaughtMotion
from armctl.trajectory.program import Program, ProgramRequest
from armctl.trajectory.reference import error_mm
from armctl.trajectory.straightness import distance_to_line
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.tool_path import PathRequest
from armctl.trajectory.transfer import TransferRequest

Handler = Callable[[Connection, Any], Awaitable[dict[str, Any]]]
RunOptimisation = Callable[[OptimizeJob, Progress], Awaitable[dict[str, Any]]]


class Nothing(Frozen):
    """No parameters."""


class Confirmed(Frozen):
    """What makes the arm fall has to be meant: `confirm` is true once the arm is supported."""

    confirm: Literal[True]

    @model_validator(mode="before")
    @classmethod
    def _meant(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("confirm") is not True:
            raise ValueError("confirm: the arm goes limp and drops; support it, then give confirm: true")
        return given


class Named(Frozen):
    name: Name


class Show(Named):
    """A recording, and the line its errors are wanted against; without one, that from its first to its last point."""

    from_m: Point | None = None
    to_m: Point | None = None

    def _check(self) -> None:
        if (self.from_m is None) != (self.to_m is None):
            raise ValueError("from_m, to_m: a line has both ends; give both or neither")


class KeptPlan(Frozen):
    name: Name
    plan: Plan


class Rename(Named):
    to: Name


class HowToRun(Frozen):
    # Whether goals are corrected, so that the joints are where the plan has them.
    corrected: bool = True
    # Further runs at most, which correct the plan.
    refine: int = Field(0, ge=0, le=MOST_FURTHER)


class RunRequest(HowToRun):
    plan: Plan


class PathRun(PathRequest):
    refine: int = Field(0, ge=0, le=MOST_FURTHER)


class Rate(Frozen):
    rate: float = Field(ge=0.1, le=1.0)


class JogBeat(Frozen):
    """The velocity wanted until the next heartbeat: of the joints or of the tool."""

    joints_rad_s: Annotated[tuple[Radian, ...], Field(max_length=32, strict=False)] = ()
    tool_m_s: Annotated[tuple[Metre, ...], Field(max_length=3, strict=False)] = ()
    begin: bool = False


# Places of equal progress at which a take is held against a line, so that dwelling costs nothing: those of `optimize`
# for a motion of 5 s.
STATIONS = 51
# Heartbeats of a jog are logged as commands of the control step; an optimisation moves nothing.
UNNOTED = ("jog", "optimize")
# What is learnt from.
MOTIONS = {"run", "move", "reach", "grip", "transfer", "play", "path", "program_run"}


def _observed(look: Callable[[], dict[str, Any]]) -> Method:
    async def handle(_: Connection, __: Nothing) -> dict[str, Any]:
        return look()

    return Method(Nothing, handle, observes=True)


def _in_thread(work: Callable[[Any], dict[str, Any]]) -> Handler:
    """What files are asked for, beside the loop that serves everybody."""

    async def handle(_: Connection, p: Any) -> dict[str, Any]:
        return await asyncio.to_thread(work, p)

    return handle


def _command(host: Host, name: str) -> Method:
    # What makes the arm fall has to be confirmed.
    return Method(Confirmed if name == "release" else Nothing, lambda client, _: host.command(client, name))


def _at(path: Path) -> dict[str, Any]:
    """A recording's name, and where it is or was."""
    return {"name": recordings.take_name(path), "path": str(path)}


class Methods:
    """The table of methods over one host, and the optimisation under way."""

    def __init__(self, host: Host, recordings_dir: Path, run_optimisation: RunOptimisation) -> None:
        self._host, self._recordings_dir = host, recordings_dir
        self._plans_dir = recordings_dir.parent / "plans"
        self._run_optimisation = run_optimisation
        self._job_ids = itertools.count(1)
        self._job: tuple[Connection, asyncio.Future[dict[str, Any]]] | None = None

    def table(self) -> dict[str, Method]:
        """Every method by name."""
        host, folder, kept = self._host, self._recordings_dir, self._plans_dir
        site = programs.Site(host.arm, host.robot, host.period_s, folder)
        methods = {
            "status": _observed(host.status),
            "log": _observed(host.log),
            "subscribe": Method(Nothing, self._subscribe, observes=True),
            **dict.fromkeys(("stop", "hold"), Method(Nothing, lambda _, __: host.stop(), always=True)),
            **{name: _command(host, name) for name in COMMANDS},
            "teach_begin": Method(Confirmed, lambda client, _: teaching.begin(host, client)),
            "take_begin": Method(Named, lambda client, p: teaching.take_begin(host, client, p.name)),
            "take_mark": Method(Nothing, lambda client, _: teaching.take_mark(host, client)),
            "take_end": Method(Nothing, lambda client, _: teaching.take_end(host, client)),
            "teach_end": Method(Nothing, lambda client, _: teaching.end(host, client)),
            "run": Method(RunRequest, self._run),
            "path": Method(PathRun, self._lead),
            "play": Method(PlayRequest, self._play),
            "move": Method(MoveRequest, partial(move, host)),
            "reach": Method(ReachRequest, partial(reach, host)),
            "grip": Method(GripRequest, partial(grip, host)),
            "transfer": Method(TransferRequest, partial(transfer, host)),
            "program_check": Method(Program, _in_thread(lambda p: programs.checked(site, p, programs.pose_now(host)))),
            "program_run": Method(ProgramRequest, lambda client, p: programs.run(host, client, site, p)),
            "pause": Method(Nothing, lambda _, __: host.pause(), always=True),
            "resume": Method(Nothing, lambda client, _: host.resume(client)),
            "rate": Method(Rate, lambda client, p: host.rate(client, p.rate)),
            "jog": Method(JogBeat, lambda client, p: host.jog(client, p.joints_rad_s, p.tool_m_s, p.begin)),
            "recordings_list": Method(Nothing, _in_thread(lambda _: listing(folder, host.robot)), observes=True),
            "recordings_show": Method(Show, _in_thread(self._recordings_show), observes=True),
            "recordings_rename": Method(Rename, _in_thread(lambda p: _at(recordings.rename(folder, p.name, p.to)))),
            "recordings_delete": Method(Named, _in_thread(lambda p: _at(recordings.delete(folder, p.name)))),
            "recordings_track": Method(Named, _in_thread(self._recordings_track), observes=True),
            "plans_list": Method(Nothing, _in_thread(lambda _: plans.listing(kept)), observes=True),
            "plans_show": Method(Named, _in_thread(self._plans_show), observes=True),
            "plans_save": Method(KeptPlan, _in_thread(lambda p: plans.save(kept, p.name, plan_to_text(p.plan)))),
            "plans_delete": Method(Named, _in_thread(lambda p: plans.delete(kept, p.name))),
            "optimize": Method(RecordedRequest, self._optimize),
        }
        return {
            name: method if method.observes or name in UNNOTED else method._replace(handle=self._noted(name, method))
            for name, method in methods.items()
        }

    def client_gone(self, client: Connection) -> None:
        """End what nobody waits for any more."""
        self._host.client_gone(client)
        if self._job is not None and self._job[0] is client:
            self._job[1].cancel()

    def _noted(self, name: str, method: Method) -> Handler:
        """The method's handler, whose use and outcome go into the log.

        The answer of a motion tells what is not as the arm's model says.
        """

        async def noted(client: Connection, p: Any) -> dict[str, Any]:
            outcome: dict[str, Any] = {"request": name, "who": client.name}
            outcome |= {"person": person} if (person := PERSON.get()) else {}
            if isinstance(p, Named):
                outcome["params"] = p.model_dump()
            try:
                result = await method.handle(client, p)
            except ArmctlError as error:
                data = error_data(error)
                self._host.note({**outcome, "outcome": data["code"], "reasons": data["reasons"]})
                raise
            self._host.note({**outcome, "outcome": "ok"})
            notice = self._host.notice if name in MOTIONS else ""
            return {**result, "notice": notice} if notice else result

        return noted

    async def _subscribe(self, client: Connection, _: Nothing) -> dict[str, Any]:
        client.subscribed = True
        return {"subscribed": True, "period_s": self._host.period_s}

    async def _run(self, client: Connection, p: RunRequest) -> dict[str, Any]:
        if not p.refine:
            return await run(self._host, client, p.plan, corrected=p.corrected)
        return await refine(self._host, client, p.plan, p.refine, self._plans_dir, corrected=p.corrected)

    async def _lead(self, client: Connection, p: PathRun) -> dict[str, Any]:
        request = PathRequest.model_validate(p.model_dump(exclude={"refine"}))
        if not p.refine:
            return await path(self._host, client, request)
        return await refine_path(self._host, client, request, p.refine, self._plans_dir)

    async def _optimize(self, client: Connection, p: RecordedRequest) -> dict[str, Any]:
        if self._job is not None:
            raise RequestRefused("BUSY", f"client {self._job[0].name} is optimising; try again when it is done")
        job = next(self._job_ids)
        paths = tuple(map(self._path, p.recordings))

        def progress(generation: int, best: float, mean: float) -> None:
            client.notify("progress", {"job": job, "generation": generation, "best": best, "mean": mean})

        work = asyncio.ensure_future(self._optimized(paths, p, progress))
        self._job = client, work
        try:
            return {"job": job, **await work}
        except asyncio.CancelledError:
            raise RequestRefused("CANCELLED", "the client left, and its optimisation ended") from None
        finally:
            self._job = None

    async def _play(self, client: Connection, p: PlayRequest) -> dict[str, Any]:
        path = Path() if p.name is None else self._path(p.name)

        def motion() -> TaughtMotion:  # loaded once the client commands: a stop meanwhile, or its leaving, is heard
            return p.motion or recordings.taught(recordings.load(path))

        return await play(self._host, client, motion, p)

    async def _optimized(self, paths: tuple[Path, ...], p: RecordedRequest, progress: Progress) -> dict[str, Any]:
        model = await self._host.own_model()
        return await self._run_optimisation(OptimizeJob(self._host.arm, paths, p, model), progress)

    def _path(self, name: str) -> Path:
        return recordings.find(self._recordings_dir, name)

    def _recordings_show(self, p: Show) -> dict[str, Any]:
        found, host = recordings.load(self._path(p.name)), self._host
        if p.from_m is None or p.to_m is None:
            return describe(found, host.robot, with_marks=True)
        shown = describe(found, host.robot, (p.from_m, p.to_m), with_marks=True)
        A, B = np.array([p.from_m, p.to_m])
        with contextlib.suppress(RequestRefused):  # it does not lead from one to the other
            along = align([found.positions_rad], host.arm, host.robot.chain, A, B, STATIONS)
            shown |= error_mm(distance_to_line(along.tool_m[0], A, B))
        return shown

    def _recordings_track(self, p: Named) -> dict[str, Any]:
        """Its path, thinned out for drawing."""
        found = recordings.load(self._path(p.name))
        kept = drawn(len(found.time_s))
        chain = self._host.robot.chain
        return {
            "name": p.name,
            "time_s": found.time_s[kept].tolist(),
            "positions_rad": found.positions_rad[kept].tolist(),
            "tool_m": tool_position(chain, found.positions_rad[kept][:, : chain.n]).round(6).tolist(),
            "plan_s": found.plan_s,
        }

    def _plans_show(self, p: Named) -> dict[str, Any]:
        found, chain = plans.load(self._plans_dir, p.name), self._host.robot.chain
        positions_rad = plan_positions(found, np.linspace(0.0, found.duration_s, 201))
        tool_m = tool_position(chain, positions_rad[:, : chain.n]).round(6).tolist()
        return {"name": p.name, "plan": found.model_dump(mode="json"), "tool_m": tool_m}
