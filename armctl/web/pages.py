"""The dashboard's own files: kept by the browser, asked about each time, and packed for who can unpack."""

import asyncio
import functools
import gzip
import hashlib
from collections.abc import Awaitable, Callable
from pathlib import Path

from fastapi import APIRouter, Request, Response

STATIC = Path(__file__).parent / "static"
TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
# Where each file is served, and as what.
PAGES = {
    "/": (STATIC / "index.html", "text/html"),
    **{f"/{file.name}": (file, TYPES[file.suffix]) for file in sorted(STATIC.iterdir()) if file.suffix in TYPES},
}


def pages() -> APIRouter:
    router = APIRouter(include_in_schema=False)
    for path, (file, media_type) in PAGES.items():
        router.add_api_route(path, _page(file, media_type), methods=["GET"])
    return router


def _page(file: Path, media_type: str) -> Callable[[Request], Awaitable[Response]]:
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

    return serve
