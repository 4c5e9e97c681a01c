"""The dashboard's HTTP interface; its OpenAPI description stands at /api/openapi.json.

Requests are checked by the same rules as on the daemon's socket and carried out by the daemon; what fails there is
answered with its code, message and reasons. Only files of recordings and logs are read here, so that no file from
elsewhere is ever parsed in the daemon.
"""

import asyncio
import contextlib
import time
import tomllib
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, Query, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import Field
from starlette.exceptions import HTTPException

from armctl import __version__
from armctl.config import Config, Frozen
from armctl.errors import ArmctlError, ConfigError, LogError, NoDaemon
from armctl.files import tokens_path
from armctl.host.jsonrpc import ProtocolError, error_data, strict_json
from armctl.host.methods import Confirmed, JogBeat, Named, Nothing, Rate
from armctl.trajectory.grasp import GripRequest
from armctl.trajectory.playback import PlayRequest
from armctl.trajectory.target import MoveRequest
from armctl.web.connections import Connections
from armctl.web.files import Files, NamePath
from armctl.web.guard import PERSON, Guard, Refused
from armctl.web.pages import pages
from armctl.web.set_up import SetUp
from armctl.web.tokens import Tokens

TOKEN_WAIT_S = 5.0
# The heartbeats of a page that leads the arm come at this part of a tick, of 0.1 s at most.
BEAT_AT = 0.8
# What is remembered of the longest way from an answer to the next heartbeat, each time.
REMEMBERED = 0.9
ErrorBody = {"description": "Refused: `error` holds `code`, `message` and `reasons`."}
REFUSED = (400, 401, 403, 404, 405, 409, 413, 415, 421, 422, 503)
REFUSALS: dict[int | str, dict[str, Any]] = dict.fromkeys(REFUSED, ErrorBody)

# HTTP status of an error of armctl; of every other kind 409.
STATUSES: dict[type[ArmctlError], int] = {NoDaemon: 503, LogError: 404, ConfigError: 422}

# What is handed to the daemon as it is, and what a body there may be.
COMMANDS = tomllib.loads(Path(__file__).with_name("commands.toml").read_text("utf-8"))
KINDS = (Confirmed, GripRequest, MoveRequest, Named, Nothing, PlayRequest, Rate)
BODIES: dict[str, type[Frozen]] = {body.__name__: body for body in KINDS}

# An end of a line in an address.
End = Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Query(min_length=3, max_length=3)]


def create_app(
    config: Config,
    *,
    socket: Path,
    token: str,
    port: int,
    names: tuple[str, ...] | None = None,
    config_file: str | None = None,
) -> tuple[FastAPI, Guard]:
    """The application, and the guard that every request passes first.

    Args:
        token: That of the address that is printed.
        names: See `Guard`.
        config_file: That of the programs that a set-up starts, and where people's tokens lie.
    """
    daemon = Connections(socket, PERSON.get)
    files, set_up = Files(daemon, config), SetUp(config_file, daemon)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        async with daemon.running():
            yield
            await set_up.close()

    app = FastAPI(
        title="armctl",
        version=__version__,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/openapi.json",
        redirect_slashes=False,
        lifespan=lifespan,
        exception_handlers={ArmctlError: _refused, RequestValidationError: _invalid, HTTPException: _not_served},
    )
    guard = Guard(app, tokens=Tokens(tokens_path(config_file), token), port=port, names=names)
    app.include_router(_live(daemon, guard))
    for routes in (_commands(daemon, set_up, Beats(config.period_s)), set_up.routes(), files.routes()):
        app.include_router(routes, prefix="/api", responses=REFUSALS)
    app.include_router(pages())
    return app, guard


async def _refused(_: Request, error: ArmctlError) -> Response:
    status = next((status for kind, status in STATUSES.items() if isinstance(error, kind)), 409)
    data = error_data(error)  # the socket's codes
    return _error(status, data["code"], data["reasons"])


async def _invalid(_: Request, error: RequestValidationError) -> Response:
    return _error(422, "INVALID", [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()])


async def _not_served(request: Request, error: HTTPException) -> Response:
    code = {404: "NOT_FOUND", 405: "WRONG_METHOD"}.get(error.status_code, "REFUSED")
    reason = f"{request.method} {request.url.path[:100]} is not served; what is stands at /api/openapi.json"
    return _error(error.status_code, code, [reason], error.headers)


def _error(status: int, code: str, reasons: list[str], headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"error": {"code": code, "message": "; ".join(reasons), "reasons": reasons}}, status, headers)


def _live(daemon: Connections, guard: Guard) -> APIRouter:
    router = APIRouter()

    @router.websocket("/api/stream")
    async def stream(socket: WebSocket) -> None:
        """Snapshots and progress as they come, after a first message `{"token": "..."}`."""
        await socket.accept()
        said = None
        with contextlib.suppress(TimeoutError, ProtocolError, KeyError, WebSocketDisconnect):
            async with asyncio.timeout(TOKEN_WAIT_S):
                said = strict_json((await socket.receive_text()).encode(errors="replace"))
        token = said.get("token") if isinstance(said, dict) else None
        try:
            guard.let_in(token)
        except Refused as refused:
            with contextlib.suppress(RuntimeError):
                await socket.close(1008, refused.reason.partition(";")[0])
            return
        async with daemon.page() as messages:
            leaving = asyncio.create_task(_left(socket))
            while not leaving.done():
                waiting = asyncio.create_task(messages.get())
                await asyncio.wait((leaving, waiting), return_when=asyncio.FIRST_COMPLETED)
                if guard.who(token) is None:  # it was revoked
                    await socket.close(1008, "the token was revoked")
                    waiting.cancel()
                    break
                if waiting.done():
                    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                        await socket.send_text(waiting.result())
                else:
                    waiting.cancel()

    return router


@dataclass
class Beats:
    """When heartbeats are answered, so that the next one, which is sent then, comes late in the tick.

    The arm goes on for a tick after the one that takes a heartbeat. A page that is silent from then on has been so for
    the less time the younger it was. The way from an answer to the next heartbeat is as long as it was before.
    """

    period_s: float
    answered_s: float = 0.0
    way_s: float = 0.03

    def kept_s(self, now_s: float, begin: bool) -> float:
        """How long to keep the answer of the heartbeat that has just come."""
        tick_s = min(self.period_s, 0.1)
        if not begin:
            self.way_s = max(REMEMBERED * self.way_s, min(now_s - self.answered_s, tick_s))
        return max(0.0, BEAT_AT * tick_s - self.way_s)


def _commands(daemon: Connections, set_up: SetUp, beats: Beats) -> APIRouter:
    router = APIRouter()
    for route, told in COMMANDS.items():
        (verb, path), method = route.split(), told["method"]
        given: dict[str, Any] = {"body": BODIES[told["body"]]} if "body" in told else {}
        given |= {"name": NamePath} if "{name}" in path else {}
        router.add_api_route(path, _handed_on(daemon, method, given, told["text"]), methods=[verb], name=method)

    @router.post("/stop")
    async def stop(_: Nothing) -> dict[str, Any]:
        """Decelerate and hold. Served in every state, to anybody."""
        with contextlib.suppress(*((NoDaemon,) if set_up.break_off() else ())):
            return await daemon.stop()
        return {"state": "off"}

    @router.get("/recordings/{name}/errors")
    async def errors(name: NamePath, from_m: End, to_m: End) -> dict[str, Any]:
        """How far a recording is off a line, among other things; each end is given by three numbers [m]."""
        return await daemon.call("recordings_show", name=name, from_m=from_m, to_m=to_m)

    @router.post("/jog")
    async def jog(request: Request, body: JogBeat) -> dict[str, Any]:
        """Lead the joints or the tool until the next heartbeat, which is due with the answer; who leaves stops them."""
        kept_s = beats.kept_s(time.monotonic(), body.begin)
        beat = asyncio.create_task(daemon.call("jog", **body.model_dump()))
        left = asyncio.create_task(_left(request))
        try:
            await asyncio.wait((beat, left), return_when=asyncio.FIRST_COMPLETED)
            await asyncio.wait((left,), timeout=kept_s)
            beats.answered_s = time.monotonic()
            if not left.done():
                return await beat
            beat.cancel()  # not sent yet, it would lead on after the stop
            return await daemon.stop()
        finally:
            beat.cancel()
            left.cancel()

    return router


async def _left(page: Request | WebSocket) -> None:
    """Wait until whoever asks is gone."""
    with contextlib.suppress(RuntimeError):  # it was gone already
        while not (await page.receive())["type"].endswith(".disconnect"):
            pass


def _handed_on(daemon: Connections, method: str, given: dict[str, Any], text: str) -> Callable[..., Any]:
    """What asks the daemon for a method.

    Args:
        given: What a request has, by its name: the type of each.
    """

    async def carry_out(*, body: Frozen | None = None, **name: str) -> dict[str, Any]:
        return await daemon.call(method, **name, **(body.model_dump() if body else {}))

    # FastAPI reads from these what a request must be, and what the description says.
    carry_out.__doc__ = text
    parameters = [Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind) for name, kind in given.items()]
    carry_out.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return carry_out
