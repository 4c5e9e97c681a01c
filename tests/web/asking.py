"""What a browser asks of the dashboard's application, which is called without a server."""

import asyncio
from typing import Any

import httpx
from starlette.types import Message

from armctl.web.guard import Guard

TOKEN = "the-token"
ADDRESS = "http://127.0.0.1:8080"


def asked(guard: Guard, method: str, path: str, headers: dict[str, str] | None = None, **more: Any) -> httpx.Response:
    """The answer to a request."""

    async def asking() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(guard), base_url=ADDRESS) as client:
            return await client.request(method, path, headers=headers, **more)

    return asyncio.run(asking())


def streamed(guard: Guard, *said: Message, origin: str | None = ADDRESS) -> list[Message]:
    """What a page that says this over a WebSocket is sent; it leaves after the second message."""
    sent: list[Message] = []
    script: list[Message] = [{"type": "websocket.connect"}, *said]

    async def receive() -> Message:
        while not script and len(sent) < 2:
            await asyncio.sleep(0)
        return script.pop(0) if script else {"type": "websocket.disconnect", "code": 1001}

    async def send(message: Message) -> None:
        sent.append(message)

    async def serve() -> None:
        await guard(scope, receive, send)

    headers = [(b"host", b"127.0.0.1:8080")] + ([] if origin is None else [(b"origin", origin.encode())])
    scope = {"type": "websocket", "path": "/api/stream", "headers": headers, "subprotocols": [], "query_string": b""}
    asyncio.run(serve())
    return sent
