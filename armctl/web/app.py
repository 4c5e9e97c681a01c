"""The dashboard's HTTP interface; its OpenAPI description stands at /api/openapi.json.

Requests are checked by the same rules as on the daemon's socket and carried out by the daemon; what fails there is
answered with its code, message and reasons. Only files of recordings and logs are read here, so that no file from
elsewhere is ever parsed in the daemon.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import hashlib
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, FastAPI, Path, Query, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from starlette.exceptions import HTTPException

from armctl import __version__
from armctl.config import NAME_PATTERN, ArmConfig, Config, Name
from armctl.errors import ArmctlError, ConfigError, LogError, NoDaemon
from armctl.files import data_dir
from armctl.host.jobs import RecordedRequest
from armctl.host.jsonrpc import ProtocolError, error_data, strict_json
from armctl.host.methods import Confirmed, Named, Nothing
from armctl.kinematics import robots
from armctl.kinematics.chain import link_frames, tool_position
from armctl.recording import reader, recordings
from armctl.trajectory.plan import plan_positions
from armctl.web import plans
from armctl.web.daemon import Daemon
from armctl.web.guard import Guard

STATIC = FilePath(__file__).parent / "static"
TOKEN_WAIT_S = 5.0
MOST_POINTS = 1000
"""Of a curve sent to a page."""

NamePath = Annotated[str, Path(pattern=NAME_PATTERN)]
ErrorBody = {"description": "Refused: `error` holds `code`, `message` and `reasons`."}
REFUSALS: dict[int | str, dict[str, Any]] = dict.fromkeys(
    (400, 401, 403, 404, 405, 409, 413, 415, 421, 422, 503), ErrorBody
)


class OptimizeBody(RecordedRequest):
    """As `optimize` on the socket; the plans are kept as NAME-viaN."""

    name: Name


@dataclass(frozen=True)
class Places:
    """Where things lie."""

    recordings: FilePath
    logs: FilePath
    plans: FilePath


def create_app(arm: ArmConfig, config: Config, *, socket: FilePath, token: str, port: int) -> tuple[FastAPI, Guard]:
    """The application, and the guard that every request passes first."""
    data = data_dir(config)
    places = Places(data / "recordings", data / "logs", data / "plans")
    chain = robots.get(arm.robot, arm.lengths_m).chain

    def enrich(snapshot: dict[str, Any]) -> dict[str, Any]:
        """With the joints of the arm in space, for the picture."""
        positions = [joint["position_rad"] for joint in snapshot["joints"]]
        if any(position is None for position in positions):
            return {**snapshot, "links_m": []}
        frames = link_frames(chain, np.array(positions)[: chain.n])
        return {**snapshot, "links_m": [[0.0, 0.0, 0.0], *frames[1:, :3, 3].round(5).tolist()]}

    daemon = Daemon(socket, enrich)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        async with daemon.running():
            yield

    app = FastAPI(
        title="armctl",
        version=__version__,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/openapi.json",
        redirect_slashes=False,
        lifespan=lifespan,
    )
    app.add_exception_handler(ArmctlError, _refused)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _not_served)
    guard = Guard(app, token=token, port=port)
    app.include_router(_live(daemon, guard))
    app.include_router(_commands(daemon), prefix="/api")
    app.include_router(_teaching(daemon), prefix="/api")
    app.include_router(_files(daemon, places, arm), prefix="/api")
    app.include_router(_pages())
    return app, guard


async def _refused(_: Request, error: Exception) -> Response:
    assert isinstance(error, ArmctlError)
    status = 503 if isinstance(error, NoDaemon) else 404 if isinstance(error, LogError) else 409
    if isinstance(error, ConfigError):
        status = 422
    data = error_data(error)  # the socket's codes
    return _error(status, data["code"], str(error), data["reasons"])


async def _invalid(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    return _error(422, "INVALID", "; ".join(reasons), reasons)


async def _not_served(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = {404: "NOT_FOUND", 405: "WRONG_METHOD"}.get(error.status_code, "REFUSED")
    reason = f"{request.method} {request.url.path[:100]} is not served; what is stands at /api/openapi.json"
    return _error(error.status_code, code, reason, [reason], error.headers)


def _error(
    status: int, code: str, message: str, reasons: list[str], headers: Mapping[str, str] | None = None
) -> Response:
    return JSONResponse({"error": {"code": code, "message": message, "reasons": reasons}}, status, headers)


def _live(daemon: Daemon, guard: Guard) -> APIRouter:
    router = APIRouter()

    @router.websocket("/api/stream")
    async def stream(socket: WebSocket) -> None:
        """Snapshots and progress as they come, after a first message `{"token": "..."}`."""
        await socket.accept()
        try:
            async with asyncio.timeout(TOKEN_WAIT_S):
                said = strict_json((await socket.receive_text()).encode(errors="replace"))
        except (TimeoutError, ProtocolError, KeyError, WebSocketDisconnect):
            said = None
        if not guard.token_is(said.get("token") if isinstance(said, dict) else None):
            with contextlib.suppress(RuntimeError):
                await socket.close(1008, "the token is missing or wrong")
            return
        async with daemon.page() as messages:
            leaving = asyncio.create_task(_until_left(socket))
            while not leaving.done():
                waiting = asyncio.create_task(messages.get())
                await asyncio.wait((leaving, waiting), return_when=asyncio.FIRST_COMPLETED)
                if waiting.done():
                    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                        await socket.send_text(waiting.result())
                else:
                    waiting.cancel()

    return router


async def _until_left(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError, KeyError):
        while True:
            await socket.receive_text()


def _commands(daemon: Daemon) -> APIRouter:
    router = APIRouter(responses=REFUSALS, tags=["commands"])

    @router.get("/status")
    async def status() -> dict[str, Any]:
        """One snapshot, as `armctl status --json`."""
        return await daemon.call("status")

    @router.post("/stop")
    async def stop(_: Nothing) -> dict[str, Any]:
        """Decelerate and hold. Served in every state, to anybody."""
        return await daemon.stop()

    def command(path: str, method: str, text: str) -> None:
        async def carry_out(_: Nothing) -> dict[str, Any]:
            return await daemon.call(method)

        carry_out.__doc__ = text
        router.add_api_route(path, carry_out, methods=["POST"], name=method)

    command("/torque-on", "torque_on", "Carefully energise the arm where it is.")
    command("/park", "park", "Slowly to the rest pose, then limp.")
    command("/clear", "clear", "Acknowledge the latched fault; refused while its cause persists.")

    @router.post("/release")
    async def release(body: Confirmed) -> dict[str, Any]:
        """Switch torque off: the arm drops unless it is supported, which `confirm` says."""
        return await daemon.call("release", confirm=body.confirm)

    return router


def _teaching(daemon: Daemon) -> APIRouter:
    router = APIRouter(responses=REFUSALS, tags=["teaching"])

    @router.post("/teach/begin")
    async def teach_begin(_: Nothing) -> dict[str, Any]:
        """Make the arm limp for guiding by hand."""
        return await daemon.call("teach_begin")

    @router.post("/teach/end")
    async def teach_end(_: Nothing) -> dict[str, Any]:
        """Leave teaching; the arm stays limp."""
        return await daemon.call("teach_end")

    @router.post("/take/begin")
    async def take_begin(body: Named) -> dict[str, Any]:
        """Record a candidate."""
        return await daemon.call("take_begin", name=body.name)

    @router.post("/take/end")
    async def take_end(_: Nothing) -> dict[str, Any]:
        """The candidate is complete."""
        return await daemon.call("take_end")

    return router


def _files(daemon: Daemon, places: Places, arm: ArmConfig) -> APIRouter:
    router = APIRouter(responses=REFUSALS, tags=["files"])
    chain = robots.get(arm.robot, arm.lengths_m).chain

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

        def load() -> dict[str, Any]:
            found = recordings.load(recordings.find(places.recordings, name))
            kept = _thinned(len(found.time_s))
            tool = tool_position(chain, found.positions_rad[kept][:, : chain.n])
            return {
                "name": name,
                "time_s": found.time_s[kept].tolist(),
                "positions_rad": found.positions_rad[kept].tolist(),
                "tool_m": tool.round(6).tolist(),
                "plan_s": found.plan_s,
            }

        return await asyncio.to_thread(load)

    @router.delete("/recordings/{name}")
    async def delete_recording(name: NamePath) -> dict[str, Any]:
        """Delete a recording."""
        return await daemon.call("recordings_delete", name=name)

    @router.post("/optimize")
    async def optimize(body: OptimizeBody) -> dict[str, Any]:
        """Straighten recordings; answers when it is done, progress comes over the stream."""
        wanted = body.model_dump(mode="json", exclude={"name", "settings"})
        result = await daemon.call("optimize", **wanted)
        for plan in result["plans"]:
            plan["name"] = f"{body.name}-via{plan['via']}"
            await asyncio.to_thread(plans.save, places.plans, plan["name"], plan.pop("text"))
        return result

    @router.get("/plans")
    async def list_plans() -> dict[str, Any]:
        """Plans kept here, the newest first."""
        return {"plans": await asyncio.to_thread(plans.listed, places.plans)}

    @router.get("/plans/{name}")
    async def plan(name: NamePath) -> dict[str, Any]:
        """One plan with its predicted tool path."""
        found = await asyncio.to_thread(plans.load, places.plans, name)
        time_s = np.linspace(0.0, found.duration_s, 201)
        tool = tool_position(chain, plan_positions(found, time_s)[:, : chain.n])
        return {"name": name, "plan": found.model_dump(mode="json"), "tool_m": tool.round(6).tolist()}

    @router.delete("/plans/{name}")
    async def delete_plan(name: NamePath) -> dict[str, Any]:
        """Delete a plan."""
        await asyncio.to_thread(plans.delete, places.plans, name)
        return {"name": name}

    @router.post("/plans/{name}/run")
    async def run(name: NamePath, _: Nothing) -> dict[str, Any]:
        """Pre-flight, approach, run and record a plan; answers when it has ended."""
        found = await asyncio.to_thread(plans.load, places.plans, name)
        return await daemon.call("run", plan=found.model_dump(mode="json"))

    @router.get("/logs")
    async def list_logs() -> dict[str, Any]:
        """The daemon's logs, the newest first."""

        def listed() -> list[dict[str, Any]]:
            found = [(path.stat(), path.name) for path in places.logs.glob("*.mcap*")]
            found.sort(key=lambda one: (one[0].st_mtime_ns, one[1]), reverse=True)
            return [{"name": name, "bytes": about.st_size} for about, name in found]

        return {"logs": await asyncio.to_thread(listed)}

    @router.get("/logs/{name}")
    async def log(
        name: NamePath,
        from_s: Annotated[float, Query(ge=0.0, allow_inf_nan=False)] = 0.0,
        to_s: Annotated[float | None, Query(ge=0.0, allow_inf_nan=False)] = None,
    ) -> dict[str, Any]:
        """Joint angles, links and the tool of one log over a span of time, thinned out for drawing."""

        def load() -> dict[str, Any]:
            track = reader.ticks(_log_path(places.logs, name))
            time_s = track.time_s - (track.time_s[0] if len(track.time_s) else 0.0)
            inside = np.flatnonzero((time_s >= from_s) & (time_s <= (np.inf if to_s is None else to_s)))
            kept = inside[_thinned(len(inside))]
            links = link_frames(chain, track.position_rad[kept][:, : chain.n])[:, 1:, :3, 3].round(5)
            base = np.zeros((len(kept), 1, 3))
            return {
                "name": name,
                "names": list(track.names),
                "duration_s": float(time_s[-1]) if len(time_s) else 0.0,
                "time_s": time_s[kept].round(4).tolist(),
                "position_rad": track.position_rad[kept].round(5).tolist(),
                "links_m": np.concatenate([base, links], axis=1).tolist(),
                "tool_m": links[:, -1].tolist(),
            }

        return await asyncio.to_thread(load)

    @router.get("/logs/{name}/file")
    async def log_file(name: NamePath) -> Response:
        """The MCAP file itself."""
        return FileResponse(_log_path(places.logs, name), media_type="application/octet-stream", filename=name)

    return router


def _log_path(folder: FilePath, name: str) -> FilePath:
    path = folder / name
    if not path.name.endswith((".mcap", ".mcap.part")) or path.is_symlink() or not path.is_file():
        raise LogError(f"there is no log {name}")
    return path


def _thinned(count: int) -> Any:
    """Indices of at most `MOST_POINTS` of `count` points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)) if count else np.arange(0)


def _pages() -> APIRouter:
    import plotly

    router = APIRouter(include_in_schema=False)

    def page(path: str, file: FilePath, media_type: str) -> None:
        @functools.cache
        def packed() -> tuple[bytes, bytes, str]:
            data = file.read_bytes()
            return data, gzip.compress(data, 6, mtime=0), f'W/"{hashlib.sha256(data).hexdigest()[:16]}"'

        async def serve(request: Request) -> Response:
            data, small, tag = await asyncio.to_thread(packed)
            # Kept by the browser, and asked about each time: an update is never missed.
            headers = {"etag": tag, "cache-control": "no-cache", "vary": "accept-encoding"}
            if tag in request.headers.get("if-none-match", ""):
                return Response(status_code=304, headers=headers)
            if "gzip" in request.headers.get("accept-encoding", ""):
                return Response(small, headers={**headers, "content-encoding": "gzip"}, media_type=media_type)
            return Response(data, headers=headers, media_type=media_type)

        router.add_api_route(path, serve, methods=["GET"])

    page("/", STATIC / "index.html", "text/html")
    for name, media_type in (("app.js", "text/javascript"), ("style.css", "text/css"), ("icon.svg", "image/svg+xml")):
        page(f"/{name}", STATIC / name, media_type)
    page("/plotly.js", FilePath(plotly.__file__).parent / "package_data" / "plotly.min.js", "text/javascript")
    return router
