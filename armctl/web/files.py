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

    def recordings(self) -> APIRouter:
        router, daemon, arm = APIRouter(), self._daemon, self._arm

        @router.get("/arm")
        async def arm_() -> dict[str, Any]:
            """The arm's joints and their limits."""
            return {
                "arm_id": arm.arm_id,
                "robot": arm.robot,
                "joints": [{"name": joint.name, "limits_rad": joint.limits_rad} for joint in arm.joints],
                "temperature_limit_degC": arm.temperature_limit_degC,
                "voltage_V": arm.voltage_V,
                "version": __version__,
            }

        @router.get("/recordings")
        async def list_recordings() -> dict[str, Any]:
            """The candidates, and every run that was recorded."""
            return await daemon.call("recordings_list")

        @router.get("/recordings/{name}")
        async def recording(name: NamePath) -> dict[str, Any]:
            """One recording with its tool path."""
            return await asyncio.to_thread(self._recording, name)

        @router.delete("/recordings/{name}")
        async def delete_recording(name: NamePath) -> dict[str, Any]:
            """Delete a recording."""
            return await daemon.call("recordings_delete", name=name)

        return router

    def plans(self) -> APIRouter:
        router, daemon, folder = APIRouter(), self._daemon, self._folder / "plans"

        @router.post("/optimize")
        async def optimize(body: OptimizeBody) -> dict[str, Any]:
            """Straighten recordings; answers when it is done, progress comes over the stream."""
            result = await daemon.call("optimize", **body.model_dump(mode="json", exclude={"name"}))
            for plan in result["plans"]:
                plan["name"] = f"{body.name}-via{plan['via']}"
                await asyncio.to_thread(plans.save, folder, plan["name"], plan.pop("text"))
            return result

        @router.get("/plans")
        async def list_plans() -> dict[str, Any]:
            """Plans kept here, the newest first."""
            return {"plans": await asyncio.to_thread(plans.listed, folder)}

        @router.get("/plans/{name}")
        async def plan(name: NamePath) -> dict[str, Any]:
            """One plan with its predicted tool path."""
            found = await asyncio.to_thread(plans.load, folder, name)
            positions_rad = plan_positions(found, np.linspace(0.0, found.duration_s, 201))
            return {"name": name, "plan": found.model_dump(mode="json"), "tool_m": self._tool_m(positions_rad)}

        @router.delete("/plans/{name}")
        async def delete_plan(name: NamePath) -> dict[str, Any]:
            """Delete a plan."""
            await asyncio.to_thread(plans.delete, folder, name)
            return {"name": name}

        @router.post("/plans/{name}/run")
        async def run(name: NamePath, _: Nothing) -> dict[str, Any]:
            """Pre-flight, approach, run and record a plan; answers when it has ended."""
            found = await asyncio.to_thread(plans.load, folder, name)
            return await daemon.call("run", plan=found.model_dump(mode="json"))

        return router

    def logs(self) -> APIRouter:
        router, folder = APIRouter(), self._folder / "logs"

        @router.get("/logs")
        async def list_logs() -> dict[str, Any]:
            """The daemon's logs, the newest first."""

            def listed() -> list[dict[str, Any]]:
                found = [(path.stat(), path.name) for path in folder.glob("*.mcap*")]
                found.sort(key=lambda log: (log[0].st_mtime_ns, log[1]), reverse=True)
                return [{"name": name, "bytes": about.st_size} for about, name in found]

            return {"logs": await asyncio.to_thread(listed)}

        @router.get("/logs/{name}")
        async def log(name: NamePath, from_s: Seconds = 0.0, to_s: Seconds | None = None) -> dict[str, Any]:
            """Joint angles, links and the tool of one log over a span of time, thinned out for drawing."""
            return await asyncio.to_thread(lambda: self._log(_log_path(folder, name), from_s, to_s))

        @router.get("/logs/{name}/file")
        async def log_file(name: NamePath) -> Response:
            """The MCAP file itself."""
            return FileResponse(_log_path(folder, name), media_type="application/octet-stream", filename=name)

        return router

    def _tool_m(self, positions_rad: FloatArray) -> list[list[float]]:
        tool_m: list[list[float]] = tool_position(self._chain, positions_rad[:, : self._chain.n]).round(6).tolist()
        return tool_m

    def _recording(self, name: str) -> dict[str, Any]:
        found = recordings.load(recordings.find(self._folder / "recordings", name))
        kept = _thinned(len(found.time_s))
        return {
            "name": name,
            "time_s": found.time_s[kept].tolist(),
            "positions_rad": found.positions_rad[kept].tolist(),
            "tool_m": self._tool_m(found.positions_rad[kept]),
            "plan_s": found.plan_s,
        }

    def _log(self, path: FilePath, from_s: float, to_s: float | None) -> dict[str, Any]:
        track = reader.ticks(path)
        time_s = track.time_s - (track.time_s[0] if len(track.time_s) else 0.0)
        inside = np.flatnonzero((time_s >= from_s) & (time_s <= (np.inf if to_s is None else to_s)))
        kept = inside[_thinned(len(inside))]
        links = link_frames(self._chain, track.position_rad[kept][:, : self._chain.n])[:, 1:, :3, 3].round(5)
        base = np.zeros((len(kept), 1, 3))
        return {
            "name": path.name,
            "names": list(track.names),
            "duration_s": float(time_s[-1]) if len(time_s) else 0.0,
            "time_s": time_s[kept].round(4).tolist(),
            "position_rad": track.position_rad[kept].round(5).tolist(),
            "links_m": np.concatenate([base, links], axis=1).tolist(),
            "tool_m": links[:, -1].tolist(),
        }


def _log_path(folder: FilePath, name: str) -> FilePath:
    path = folder / name
    if not path.name.endswith((".mcap", ".mcap.part")) or path.is_symlink() or not path.is_file():
        raise LogError(f"there is no log {name}")
    return path


def _thinned(count: int) -> Any:
    """Indices of at most `MOST_POINTS` of `count` points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)) if count else np.arange(0)
