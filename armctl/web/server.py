"""`armctl web`: the dashboard on one port of the loopback interface, or over TLS on one of the local network."""

import asyncio
import errno
import os
import re
import secrets
import signal
import socket as socket_module
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.clock import ask_for_precedence
from armctl.config import Config
from armctl.errors import ArmctlError, ConfigError
from armctl.files import data_dir
from armctl.host.service_manager import endings, notify
from armctl.web.tokens import TOKEN_BYTES, private

if TYPE_CHECKING:
    import uvicorn


def serve(
    config: Config,
    *,
    socket: Path,
    port: int,
    ready: Callable[[str], None],
    config_file: str | None = None,
    lan: bool = False,
) -> None:
    """Serve until SIGINT, SIGTERM or SIGHUP.

    Of a service the address with its token is kept in its `RUNTIME_DIRECTORY`, for whoever may read it, and the next
    start takes its token; this server's own key and certificate lie in its `STATE_DIRECTORY`.

    Args:
        socket: The daemon's socket.
        port: TCP port.
        ready: Called once pages are served, with their address; that of a service without its token.
        config_file: Of this program, as it was named; people's tokens lie beside it.
        lan: Whether the local network is served, over TLS, and not this computer alone.
    Raises:
        ArmctlError: the extra is not installed, the port is taken, or no key can be made.
    """
    try:
        import uvicorn

        from armctl.web.app import create_app
        from armctl.web.crowd import Connection
    except ImportError as error:
        raise ArmctlError(f"the dashboard needs {error.name}; install it with: pip install 'armctl[web]'") from None

    runtime, state = os.environ.get("RUNTIME_DIRECTORY"), os.environ.get("STATE_DIRECTORY")
    token_file = Path(runtime) / "address" if runtime else None
    token = (token_file and _kept_token(token_file)) or secrets.token_urlsafe(TOKEN_BYTES)
    host, scheme, name = "127.0.0.1", "http", "127.0.0.1"
    names: tuple[str, ...] | None = None
    key = certificate = None
    if lan:
        host, scheme, name = "0.0.0.0", "https", socket_module.gethostname()
        keys = Path(state) if state else data_dir(config) / "web"
        names, (key, certificate) = (name, f"{name}.local"), _tls(keys, name)
    _, guard = create_app(config, socket=socket, token=token, port=port, names=names, config_file=config_file)
    settings = uvicorn.Config(
        guard, host=host, port=port, ssl_keyfile=key, ssl_certfile=certificate, log_level="warning", access_log=False,
        server_header=False, proxy_headers=False, ws_max_size=4096, ws_max_queue=4, http=Connection, backlog=128,
        timeout_keep_alive=30, timeout_graceful_shutdown=2,
    )  # fmt: skip
    server = uvicorn.Server(settings)
    address = f"{scheme}://{name}:{port}/#token={token}"

    listening = _listening(host, port)  # before anything runs: the server itself would end the program over it

    def started() -> None:
        if token_file is not None:
            token_file.parent.mkdir(parents=True, exist_ok=True)
            private(token_file, address + "\n")
        ask_for_precedence()  # STOP over the page does not wait for whatever else is computed
        notify("READY=1")
        # What a service prints stands in the journal; its token is in the file alone.
        ready(address if token_file is None else address.partition("#")[0])

    try:
        asyncio.run(_serving(server, listening, started))
    finally:
        listening.close()


def _listening(host: str, port: int) -> socket_module.socket:
    try:
        listening = socket_module.create_server((host, port))
    except OSError as error:
        why = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be had: {error.strerror}"
        raise ConfigError("armctl web", "--port", f"{port} {why}", "choose another with --port") from None
    # Connections inherit it; without, the body of an answer waits up to 40 ms for word that its head has come.
    listening.setsockopt(socket_module.IPPROTO_TCP, socket_module.TCP_NODELAY, 1)
    return listening


async def _serving(server: "uvicorn.Server", listening: socket_module.socket, started: Callable[[], None]) -> None:
    """Serve on a socket until told to end; `started` is called once pages are served."""
    if signal.SIGHUP in endings():
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, setattr, server, "should_exit", True)
    serving = asyncio.create_task(server.serve([listening]))
    while not server.started and not serving.done():
        await asyncio.sleep(0.01)
    if server.started:
        started()
    await serving


def _kept_token(path: Path) -> str:
    """The token of the start before; empty: there was none."""
    try:
        found = re.search(r"#token=([\w-]{20,})\n", path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return ""
    return found[1] if found else ""


def _tls(folder: Path, name: str) -> tuple[Path, Path]:
    """Where this server's own key and certificate are; made by the first start.

    Raises:
        ArmctlError: they cannot be made.
    """
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    if not (key.is_file() and certificate.is_file()):
        about = ("-subj", f"/CN={name}", "-addext", f"subjectAltName=DNS:{name},DNS:{name}.local")
        how = ("-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "3650")
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            command = ("openssl", "req", *how, *about, "-keyout", str(key), "-out", str(certificate))
            made = subprocess.run(command, capture_output=True, text=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            remedy = "install it: sudo apt install openssl"
            raise ArmctlError(f"no key can be made in {folder}: {error}; {remedy}") from None
        if made.returncode != 0:
            raise ArmctlError(f"no key can be made in {folder}: {made.stderr.strip()[-300:]}")
        key.chmod(0o600)
    return key, certificate
