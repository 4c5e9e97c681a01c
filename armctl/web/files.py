"""Recordings and plans, which the daemon keeps, logs, which are read here, and the simulator's hand."""

import asyncio
import itertools
import json
import math
import tomllib
from contextlib import suppress
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Depends, Path, Query, Response
from fastapi.responses import FileResponse
from pydantic import Field

from armctl import __version__
from armctl.config import NAME_PATTERN, ArmConfig, Config, Frozen, Name
from armctl.errors import LogError, NoDaemon, RequestRefused
from armctl.files import data_dir, driven_arm, load_arm
from armctl.host.jobs import RecordedRequest
from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.host.methods import HowToRun, Named, Nothing
from armctl.json_text import named
from armctl.kinematics import robots
from armctl.kinematics.chain import joint_axes, tool_position
from armctl.recording import search
from armctl.recording.index import Index
from armctl.recording.recordings import drawn, load
from armctl.sim.control import SimulatorClient, control_path
from armctl.trajectory.bounds import Joints
from armctl.trajectory.course import bent
from armctl.trajectory.plan import Plan, Point
from armctl.trajectory.program import program_from_text
from armctl.web.connections import Connections

# By method and path the function of `Files` that answers.
ROUTES: dict[str, str] = tomllib.loads(FilePath(__file__).with_name("files.toml").read_text("utf-8"))
# Of what is found in the logs, so many are shown, the newest.
MOST_FOUND = 200
NamePath = Annotated[str, Path(pattern=NAME_PATTERN)]
Seconds = Annotated[float, Query(ge=0.0, allow_inf_nan=False)]


class OptimizeBody(RecordedRequest):
    """As `optimize` on the socket; the plans are kept as NAME-viaN."""

    name: Name


class BendBody(Frozen):
    """Which intermediate point of a plan, the first is 1, is to be where [m]."""

    point: int = Field(ge=1)
    to_m: Point


class ProgramBody(Named):
    """A program in YAML, and the step that a run begins with: where it stands, if none is named."""

    text: str = Field(max_length=MAX_LINE_BYTES)
    from_step: str | None = None


class HandBody(Frozen):
    """A line [m] for the simulator's hand; each seed wobbles in its own way."""

    from_m: Point
    to_m: Point
    seed: int = Field(default=0, ge=0)


class HoldBody(Frozen):
    """Where the simulator's hand is to hold the joints [rad], and which one it leaves free, by its index."""

    joints_rad: Joints
    free: int | None = Field(None, ge=0)


class Files:
    """The routes of one arm's files."""

    def __init__(self, daemon: Connections, config: Config) -> None:
        self._daemon, self._configured = daemon, config.arm
        self.serve(load_arm(config.arm))
        self.period_s = config.period_s
        self._logs = data_dir(config) / "logs"
        self._simulator = control_path(FilePath(config.port or "no port"))

    def serve(self, arm: ArmConfig) -> None:
        """From now on it is this arm."""
        self.arm, self.robot = arm, robots.of(arm)

    async def follow(self) -> None:
        """Serve the arm that the daemon drives; where there is no daemon, it stays the one before.

        Raises:
            ConfigError: no file of an arm says the same of it.
        """
        with suppress(NoDaemon):
            told = self._daemon.snapshot or await self._daemon.call("status")
            if (self.arm.arm_id, self.arm.calibration_hash) != (told["arm_id"], told["calibration_hash"]):
                self.serve((await asyncio.to_thread(driven_arm, self._configured, told))[1])

    def routes(self) -> APIRouter:
        """Every route. What does not await is run in a thread by the framework: files are read there."""
        router = APIRouter()
        for route, handler in ROUTES.items():
            method, path = route.split()
            first = [Depends(self.follow)] if handler in ("arm_", "bend", "log") else []  # shows the arm
            router.add_api_route(path, getattr(self, handler), methods=[method], dependencies=first)
        return router

    def arm_(self) -> dict[str, Any]:
        """The arm: its joints with their limits, and where their axes and the tool are at positions 0."""
        arm, chain, hand, gripper = self.arm, self.robot.chain, self.arm.gripper, None
        if hand is not None:
            ends_rad = {f"{end}_rad": math.radians(getattr(hand, f"{end}_deg")) for end in ("open", "closed")}
            gripper = {"index": arm.joint_names.index(hand.joint), **ends_rad}
        axes, tool = joint_axes(chain, np.zeros((1, chain.n)))
        return {
            **named(arm, "arm_id", "calibration_hash", "floor_m", "temperature_limit_degC", "voltage_V"),
            "robot": arm.robot_name,
            "joints": [{"name": joint.name, "limits_rad": joint.limits_rad} for joint in arm.joints],
            "axes": [{"place_m": P[:, 0].tolist(), "direction": Z[:, 0].tolist()} for Z, P in axes],
            "tool_m": tool[:, 0].tolist(),
            "gripper": gripper,
            "simulated": self._simulator.exists(),
            "version": __version__,
        }

    # ------------------------------------------------------------------------------------------------------ plans

    async def optimize(self, body: OptimizeBody) -> dict[str, Any]:
        """Straighten recordings; answers when it is done, progress comes over the stream."""
        if taken := (await self._kept()).intersection([f"{body.name}-via{via}" for via in body.via]):
            raise RequestRefused("EXISTS", f"a plan {min(taken)} exists; choose another name, or delete it")
        result = await self._daemon.call("optimize", **body.model_dump(mode="json", exclude={"name"}))
        for plan in result["plans"]:
            plan["name"] = f"{body.name}-via{plan['via']}"
            await self._daemon.call("plans_save", name=plan["name"], plan=json.loads(plan.pop("text")))
        return result

    async def run(self, name: NamePath, body: HowToRun) -> dict[str, Any]:
        """Pre-flight, approach, run and record a plan, and correct it by further runs; answers when that has ended."""
        return await self._daemon.call("run", plan=(await self._plan(name))["plan"], **body.model_dump())

    async def bend(self, name: NamePath, body: BendBody) -> dict[str, Any]:
        """A plan with one intermediate point elsewhere, in the posture nearest to its own; kept as NAME-bentN."""
        plan = Plan.model_validate((await self._plan(name))["plan"])
        changed = await asyncio.to_thread(bent, self, plan, body.point, body.to_m)
        kept = await self._kept()
        stem = name.rpartition("-bent")[0] or name
        free = next(some for i in itertools.count(1) if (some := f"{stem}-bent{i}") not in kept)
        await self._daemon.call("plans_save", name=free, plan=changed.model_dump(mode="json"))
        return await self._plan(free)

    async def _plan(self, name: str) -> dict[str, Any]:
        return await self._daemon.call("plans_show", name=name)

    async def _kept(self) -> set[str]:
        return {plan["name"] for plan in (await self._daemon.call("plans_list"))["plans"]}

    # --------------------------------------------------------------------------------------------------- programs

    async def program(self, what: Literal["check", "run"], body: ProgramBody) -> dict[str, Any]:
        """Check a program from where the arm is, or run it to its end; each step that is done comes over the stream."""
        program = program_from_text(body.text, "the program", body.name).model_dump(exclude_none=True)
        program |= {"from_step": body.from_step} if what == "run" else {}
        return await self._daemon.call(f"program_{what}", **program)

    # ----------------------------------------------------------------------------------------- the simulator's hand

    def hand(self, body: HandBody) -> dict[str, Any]:
        """Let the simulator's hand carry the limp arm to a line and lead it along; answers how long that takes."""
        with SimulatorClient(self._simulator) as simulator:
            return simulator.guide(body.from_m, body.to_m, seed=body.seed)._asdict()

    def hold(self, body: HoldBody) -> dict[str, Any]:
        """Let the simulator's hand lead every joint where it is wanted, and hold it; answers how long that takes."""
        with SimulatorClient(self._simulator) as simulator:
            return simulator.hold(body.joints_rad, body.free)._asdict()

    def seen(self) -> dict[str, Any]:
        """What one sees who stands beside the simulated arm."""
        with SimulatorClient(self._simulator) as simulator:
            return simulator.state()

    def let_go(self, _: Nothing) -> dict[str, Any]:
        """Take the simulator's hand off the arm."""
        with SimulatorClient(self._simulator) as simulator:
            simulator.let_go()
        return {"holding": False}

    # ------------------------------------------------------------------------------------------------------- logs

    def find(self, expression: Annotated[str, Query(max_length=200)]) -> dict[str, Any]:
        """Events, or minutes of servos, of all logs, as `armctl log find` has them; the newest first."""
        with Index(self._logs) as index:
            index.catch_up()
            found = search.find(index, expression)
        newest = [{**row, "log": FilePath(row["log"]).name} for row in reversed(found[-MOST_FOUND:])]
        return {"found": newest, "left_off": len(found) - len(newest), "unread": index.unread}

    def list_logs(self) -> dict[str, Any]:
        """The daemon's logs, the newest first."""
        found = [(path.stat(), path.name) for path in self._logs.glob("*.mcap*") if _is_log(path)]
        found.sort(key=lambda log: (log[0].st_mtime_ns, log[1]), reverse=True)
        return {"logs": [{"name": name, "bytes": about.st_size} for about, name in found]}

    def log(self, name: NamePath, from_s: Seconds = 0.0, to_s: Seconds | None = None) -> dict[str, Any]:
        """Joint angles and the tool of one log over a span of time, thinned out for drawing."""
        track, n = load(_log_path(self._logs, name)), self.robot.chain.n
        if (track.arm_id, track.joint_names[:n]) != (self.arm.arm_id, self.arm.joint_names[:n]):
            told = f"{name} is of {track.arm_id or 'an unknown arm'} with {', '.join(track.joint_names)}"
            raise LogError(f"{told}; what is drawn here is {self.arm.arm_id} with {', '.join(self.arm.joint_names)}")
        inside = np.flatnonzero((track.time_s >= from_s) & (track.time_s <= (np.inf if to_s is None else to_s)))
        kept = inside[drawn(len(inside))]
        tool_m = tool_position(self.robot.chain, track.positions_rad[kept][:, :n])
        return {
            "name": name,
            "names": list(track.joint_names),
            "duration_s": track.duration_s,
            "time_s": track.time_s[kept].round(4).tolist(),
            "position_rad": track.positions_rad[kept].round(5).tolist(),
            "tool_m": tool_m.round(5).tolist(),
        }

    def log_file(self, name: NamePath) -> Response:
        """The MCAP file itself."""
        return FileResponse(_log_path(self._logs, name), media_type="application/octet-stream", filename=name)


def _log_path(folder: FilePath, name: str) -> FilePath:
    if not _is_log(path := folder / name):
        raise LogError(f"there is no log {name}")
    return path


def _is_log(path: FilePath) -> bool:
    return path.name.endswith((".mcap", ".mcap.part")) and not path.is_symlink() and path.is_file()
