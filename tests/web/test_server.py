"""`armctl web` as a program's caller meets it: its port, its token's file, and a daemon that is not there."""

import gc
import os
import socket
import stat
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from armctl.cli import main
from armctl.config import Config
from armctl.web import server
from armctl.web.guard import TOKEN_HEADER
from tests.terminal import free_port
from tests.words import missing

# What only the daemon can answer.
ASKED = (("GET", "/api/status"), ("GET", "/api/recordings"), ("POST", "/api/stop"))


@pytest.fixture
def taken() -> Iterator[int]:
    """A port of the loopback interface that somebody else has."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield int(other.getsockname()[1])


def test_a_taken_port_is_wrong_usage_says_so_and_leaves_no_token_behind(
    taken: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    assert main(["web", "--port", str(taken), "--socket", str(tmp_path / "nobody.sock")]) == 2
    gc.collect()  # a task that nobody asked about tells its error when it goes
    said = capsys.readouterr()
    assert said.out == ""  # it was never ready
    assert missing(said.err, f"{taken} is taken", "choose another with --port", "Traceback") == ["Traceback"]
    assert not (tmp_path / "run" / "address").exists()


def test_the_token_is_for_owner_and_group_while_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Served from this thread; another asks, then lets it end."""
    made: list[uvicorn.Server] = []
    serve = uvicorn.Server.serve

    async def remembered(self: uvicorn.Server, sockets: list[socket.socket] | None = None) -> None:
        made.append(self)
        await serve(self, sockets)

    monkeypatch.setattr(uvicorn.Server, "serve", remembered)
    port = free_port()
    file = tmp_path / "run" / "address"
    seen: dict[str, Any] = {}

    def look(address: str) -> None:
        seen["address"], seen["mode"] = file.read_text().strip(), stat.S_IMODE(os.stat(file).st_mode)
        base, _, token = seen["address"].partition("/#token=")
        assert address == f"{base}/"  # what a service prints has no token
        with httpx.Client(base_url=base, headers={TOKEN_HEADER: token}) as client:
            for method, path in ASKED:
                answer = client.request(method, path, json=None if method == "GET" else {})
                seen[path] = answer.status_code, answer.json()["error"]["message"]
        made[0].should_exit = True

    config, nobody = Config(data_dir=str(tmp_path)), tmp_path / "nobody.sock"
    with ThreadPoolExecutor() as lookers:

        def ready(address: str) -> None:
            lookers.submit(look, address)

        monkeypatch.setenv("RUNTIME_DIRECTORY", str(file.parent))
        server.serve(config, socket=nobody, port=port, ready=ready)
    assert str(seen["address"]).startswith(f"http://127.0.0.1:{port}/#token=")
    assert seen["mode"] == 0o640  # whatever the umask
    assert file.read_text().strip() == seen["address"]  # for the next start
    for _, path in ASKED:
        status, message = seen[path]
        assert status == 503
        assert "start it with `armctl daemon --port PORT`" in message
