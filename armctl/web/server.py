"""`armctl web`: the dashboard on one port of the loopback interface."""

import asyncio
import errno
import os
import secrets
import socket as socket_module
from collections.abc import Callable
from pathlib import Path

from armctl.config import ArmConfig, Config
from armctl.errors import ArmctlError, ConfigError

TOKEN_BYTES = 24


def serve(
    arm: ArmConfig, config: Config, *, socket: Path, port: int, token_file: Path | None, ready: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        socket: The daemon's socket.
        port: TCP port on 127.0.0.1.
        token_file: Where the address with its token is written, for whoever may read it; None: nowhere.
        ready: Called with that address once pages are served.
    Raises:
        ArmctlError: the extra is not installed, or the port is taken.
    """
    try:
        import uvicorn

        from armctl.web.app import create_app
        from armctl.web.crowd import Connection
    except ImportError as error:
        raise ArmctlError(f"the dashboard needs {error.name}; install it with: pip install 'armctl[web]'") from None

    token = secrets.token_urlsafe(TOKEN_BYTES)
    _, guard = create_app(arm, config, socket=socket, token=token, port=port)
    settings = uvicorn.Config(
        guard,
        host="127.0.0.1",
        port=port,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws_max_size=4096,
        ws_max_queue=4,
        http=Connection,
        backlog=128,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(settings)
    address = f"http://127.0.0.1:{port}/#token={token}"

    try:  # before anything runs: the server itself would end the program over it
        listening = socket_module.create_server(("127.0.0.1", port))
    except OSError as error:
        why = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be had: {error.strerror}"
        raise ConfigError("armctl web", "--port", f"{port} {why}", "choose another with --port") from None

    async def run() -> None:
        serving = asyncio.create_task(server.serve([listening]))
        while not server.started and not serving.done():
            await asyncio.sleep(0.01)
        if server.started:
            if token_file is not None:
                _write_private(token_file, address + "\n")
            ready(address)
        await serving

    try:
        asyncio.run(run())
    finally:
        listening.close()
        if token_file is not None:
            token_file.unlink(missing_ok=True)


def _write_private(path: Path, text: str) -> None:
    """A file that only its owner and group can read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o640), "w") as file:
        file.write(text)
