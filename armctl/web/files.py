"""What the dashboard reads from files and keeps in them: recordings, plans and logs, thinned out for drawing."""

import asyncio
from pathlib import Path as FilePath
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import FileResponse

from armctl import __version__
from armctl.config import NAME_PATTERN, ArmConfig, Config, Name
from armctl.errors import LogError
from armctl.files import data_dir
from armctl.host.jobs import RecordedRequest
from armctl.host.methods import Nothing
from armctl.kinematics import robots
from armctl.kinematics.chain import link_frames, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording import reader, recordings
from armctl.trajectory.plan import plan_positions
from armctl.web import plans
from armctl.web.connections import Connections

# Of a curve sent to a page.
MOST_POINTS = 1000

NamePath = Annotated[str, Path(pattern=NAME_PATTERN)]
Seconds = Annotated[float, Query(ge=0.0, allow_inf_nan=False)]


class OptimizeBody(RecordedRequest):
    """As `optimize` on the socket; the plans are kept as NAME-viaN."""

    name: Name


class Files:
    """The routes of one arm's files."""

    def __init__(self, daemon: Connections, arm: ArmConfig, config: Config) -> None:
        self._daemon, self._arm = daemon, arm
        self._chain = robots.get(arm.robot, arm.lengths_m).chain
        self._folder = data_dir(config)
        self._plans, self._logs = self._folder / "plans", self._folder / "logs"

    def routes(self) -> APIRouter:
        """Every route. What does not await is run in a thread by the framework: files are read there."""
        router = APIRouter()
        for method, path, handler in (
            ("GET", "/arm", self.arm_),
            ("GET", "/recordings", self.list_recordings),
            ("GET", "/recordings/{name}", self.recording),
            ("DELETE", "/recordings/{name}", self.delete_recording),
            ("POST", "/optimize", self.optimize),
            ("GET", "/plans", self.list_plans),
            ("GET", "/plans/{name}", self.plan),
            ("DELETE", "/plans/{name}", self.delete_plan),
            ("POST", "/plans/{name}/run", self.run),
            ("GET", "/logs", self.list_logs),
            ("GET", "/logs/{name}", self.log),
            ("GET", "/logs/{name}/file", self.log_file),
        ):
            router.add_api_route(path, handler, methods=[method])
        return router

    def arm_(self) -> dict[str, Any]:
        """The arm's joints and their limits."""
        arm = self._arm
        return {
            "arm_id": arm.arm_id,
            "robot": arm.robot,
            "joints": [{"name": joint.name, "limits_rad": joint.limits_rad} for joint in arm.joints],
            "temperature_limit_degC": arm.temperature_limit_degC,
            "voltage_V": arm.voltage_V,
            "version": __version__,
        }

    # ------------------------------------------------------------------------------------------------- recordings

    async def list_recordings(self) -> dict[str, Any]:
        """The candidates, and every run that was recorded."""
        return await self._daemon.call("recordings_list")

    def recording(self, name: NamePath) -> dict[str, Any]:
        """One recording with its tool path."""
        found = recordings.load(recordings.find(self._folder / "recordings", name))
        kept = _thinned(len(found.time_s))
        return {
            "name": name,
            "time_s": found.time_s[kept].tolist(),
            "positions_rad": found.positions_rad[kept].tolist(),
            "tool_m": self._tool_m(found.positions_rad[kept]),
            "plan_s": found.plan_s,
        }

    async def delete_recording(self, name: NamePath) -> dict[str, Any]:
        """Delete a recording."""
        return await self._daemon.call("recordings_delete", name=name)

    # ------------------------------------------------------------------------------------------------------ plans

    async def optimize(self, body: OptimizeBody) -> dict[str, Any]:
        """Straighten recordings; answers when it is done, progress comes over the stream."""
        result = await self._daemon.call("optimize", **body.model_dump(mode="json", exclude={"name"}))
        for plan in result["plans"]:
            plan["name"] = f"{body.name}-via{plan['via']}"
            await asyncio.to_thread(plans.save, self._plans, plan["name"], plan.pop("text"))
        return result

    def list_plans(self) -> dict[str, Any]:
        """Plans kept here, the newest first."""
        return {"plans": plans.listed(self._plans)}

    def plan(self, name: NamePath) -> dict[str, Any]:
        """One plan with its predicted tool path."""
        found = plans.load(self._plans, name)
        positions_rad = plan_positions(found, np.linspace(0.0, found.duration_s, 201))
        return {"name": name, "plan": found.model_dump(mode="json"), "tool_m": self._tool_m(positions_rad)}

    def delete_plan(self, name: NamePath) -> dict[str, Any]:
        """Delete a plan."""
        plans.delete(self._plans, name)
        return {"name": name}

    async def run(self, name: NamePath, _: Nothing) -> dict[str, Any]:
        """Pre-flight, approach, run and record a plan; answers when it has ended."""
        found = await asyncio.to_thread(plans.load, self._plans, name)
        return await self._daemon.call("run", plan=found.model_dump(mode="json"))

    # ------------------------------------------------------------------------------------------------------- logs

    def list_logs(self) -> dict[str, Any]:
        """The daemon's logs, the newest first."""
        found = [(path.stat(), path.name) for path in self._logs.glob("*.mcap*")]
        found.sort(key=lambda log: (log[0].st_mtime_ns, log[1]), reverse=True)
        return {"logs": [{"name": name, "bytes": about.st_size} for about, name in found]}

    def log(self, name: NamePath, from_s: Seconds = 0.0, to_s: Seconds | None = None) -> dict[str, Any]:
        """Joint angles, links and the tool of one log over a span of time, thinned out for drawing."""
        track = reader.ticks(_log_path(self._logs, name))
        inside = np.flatnonzero((track.time_s >= from_s) & (track.time_s <= (np.inf if to_s is None else to_s)))
        kept = inside[_thinned(len(inside))]
        links = link_frames(self._chain, track.position_rad[kept][:, : self._chain.n])[:, 1:, :3, 3].round(5)
        return {
            "name": name,
            "names": list(track.names),
            "duration_s": float(track.time_s[-1]),
            "time_s": track.time_s[kept].round(4).tolist(),
            "position_rad": track.position_rad[kept].round(5).tolist(),
            "links_m": np.concatenate([np.zeros((len(kept), 1, 3)), links], axis=1).tolist(),
            "tool_m": links[:, -1].tolist(),
        }

    def log_file(self, name: NamePath) -> Response:
        """The MCAP file itself."""
        return FileResponse(_log_path(self._logs, name), media_type="application/octet-stream", filename=name)

    def _tool_m(self, positions_rad: FloatArray) -> list[list[float]]:
        tool_m: list[list[float]] = tool_position(self._chain, positions_rad[:, : self._chain.n]).round(6).tolist()
        return tool_m


def _log_path(folder: FilePath, name: str) -> FilePath:
    path = folder / name
    if not path.name.endswith((".mcap", ".mcap.part")) or path.is_symlink() or not path.is_file():
        raise LogError(f"there is no log {name}")
    return path


def _thinned(count: int) -> Any:
    """Indices of at most `MOST_POINTS` of `count` points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)) if count else np.arange(0)
