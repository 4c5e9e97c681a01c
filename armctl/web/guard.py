"""What a request must be before anything looks at it.

Rules.
1. The `Host` is exactly one of the server's own names: a name that was rebound to the loopback address is not.
2. An `Origin`, where one is sent, is the server's own, and `Sec-Fetch-Site`, where one is sent, says the same origin
   or that the user typed the address. Nothing is ever shared with another origin.
3. Below /api every request carries a token (`tokens.py`). A page gets it from the address that the server printed
   (behind the `#`, which browsers do not send) or asks for it, and a WebSocket says it in its first message. Who may
   only look may ask with GET, and stop the arm. Wrong tokens are answered `WRONG_RATE` times a second.
4. A body is JSON by its content type, at most 64 KiB, and strict as the socket's is.
5. Every answer forbids scripts, frames and connections from elsewhere, and is not kept unless it says how it may be.
"""

import contextlib
import json
import time
import tomllib
from contextvars import ContextVar
from pathlib import Path

from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from armctl.host.allowance import TokenBucket
from armctl.host.jsonrpc import MAX_LINE_BYTES, ProtocolError, strict_json
from armctl.web.tokens import Person, Tokens

TOKEN_HEADER, ROLE_HEADER = "x-armctl-token", "x-armctl-role"
# Wrong tokens of all senders together, a second and at once.
WRONG_RATE = 5.0
WRONG_BURST = 50.0
# Whose request is being served.
PERSON: ContextVar[str] = ContextVar("person", default="")
_SAID = tomllib.loads(Path(__file__).with_name("guard.toml").read_text("utf-8"))
HEADERS: dict[str, str] = _SAID["headers"]


class Refused(Exception):
    """A request that is none of ours: HTTP status, stable code and the reason."""

    def __init__(self, status: int, code: str, reason: str) -> None:
        self.status, self.code, self.reason = status, code, reason
        super().__init__(reason)


class Guard:
    """ASGI middleware that lets through what keeps the rules.

    Args:
        names: What this computer is called in its network; by these names, and by the address at which it was reached,
            it is served over TLS. None: only this computer itself is served.
    """

    def __init__(self, app: ASGIApp, *, tokens: Tokens, port: int, names: tuple[str, ...] | None = None) -> None:
        self._app, self.who, self._port = app, tokens.who, port
        self._lan, self._scheme = names is not None, "http" if names is None else "https"
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]", *(names or ()))}
        self._wrong = TokenBucket(WRONG_RATE, WRONG_BURST, time.monotonic())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers, told = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}, HEADERS
        try:
            self._check_sender(headers, scope)
            if scope["type"] == "http":
                if scope["path"].startswith("/api"):
                    PERSON.set((person := self._checked(headers, scope)).name)
                    told = HEADERS | {ROLE_HEADER: person.role}
                receive = await _checked_body(scope, headers, receive)
        except Refused as refused:
            await _refuse(scope, receive, send, refused)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message.setdefault("headers", [])
                sent = MutableHeaders(scope=message)
                for name, value in told.items():
                    sent.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)

    def _check_sender(self, headers: dict[str, str], scope: Scope) -> None:
        host, socket = headers.get("host", ""), scope["type"] == "websocket"
        reached = self._lan and host == f"{(scope.get('server') or ('',))[0]}:{self._port}"
        if host not in self._hosts and not reached:
            raise Refused(421, "WRONG_HOST", f"this server is not {host[:100]!r}; use the address that it printed")
        origin = headers.get("origin")
        if (origin is not None or socket) and origin != f"{self._scheme}://{host}":
            raise Refused(403, "WRONG_ORIGIN", f"requests from {str(origin)[:100]!r} are not served")
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            raise Refused(403, "WRONG_ORIGIN", "requests from other sites are not served")

    def let_in(self, token: object) -> Person:
        """Who says this token.

        Raises:
            Refused: nobody does, or wrong ones come too fast.
        """
        if (person := self.who(token)) is not None:
            return person
        if not self._wrong.take(time.monotonic()):
            raise Refused(429, "RATE_LIMIT", "too many wrong tokens; wait")
        raise Refused(401, "NO_TOKEN", _SAID["no_token"])

    def _checked(self, headers: dict[str, str], scope: Scope) -> Person:
        person = self.let_in(headers.get(TOKEN_HEADER, ""))
        if person.role == "look" and scope["method"] not in ("GET", "HEAD") and scope["path"] != "/api/stop":
            raise Refused(403, "LOOK_ONLY", f"{person.name} may look, and stop the arm; `armctl web token` gives roles")
        return person


async def _checked_body(scope: Scope, headers: dict[str, str], receive: Receive) -> Receive:
    """The request's body, read and checked, as a receiver that gives it once more."""
    body = b""
    with contextlib.suppress(ClientDisconnect):
        async for chunk in Request(scope, receive).stream():
            body += chunk
            if len(body) > MAX_LINE_BYTES:
                raise Refused(413, "TOO_LARGE", f"a body is at most {MAX_LINE_BYTES} bytes")
    if scope["method"] in ("POST", "PUT", "PATCH", "DELETE") and (body or scope["method"] != "DELETE"):
        if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            raise Refused(415, "NOT_JSON", "send application/json")
        try:
            strict_json(body or b"{}")
        except ProtocolError as error:
            raise Refused(400, "NOT_JSON", error.problem) from None
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def again() -> Message:
        return waiting.pop() if waiting else await receive()

    return again


async def _refuse(scope: Scope, receive: Receive, send: Send, refused: Refused) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": refused.reason[:120]})
        return
    error = {"code": refused.code, "message": refused.reason, "reasons": [refused.reason]}
    body = json.dumps({"error": error}).encode()
    await Response(body, refused.status, {**HEADERS, "connection": "close"}, "application/json")(scope, receive, send)
