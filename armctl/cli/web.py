"""`armctl web`: the dashboard."""

import os
from pathlib import Path

import click

from armctl.cli.output import CONFIG, SOCKET, Output, command


@command("web", SOCKET, CONFIG)
@click.option("--port", type=click.IntRange(1, 65535), default=8080, help="TCP port on 127.0.0.1.")
def web_command(output: Output, port: int) -> None:
    """Serve the dashboard on this computer, until Ctrl-C.

    Prints `ready ADDRESS`; the address holds the token that opens the page. Nobody else can reach it: for another
    computer use a tunnel, `ssh -L 8080:127.0.0.1:8080 HOST`, and open the printed address there.

    Example: armctl web
    """
    from armctl.files import socket_path
    from armctl.host.service_manager import notify
    from armctl.web.server import serve

    runtime = os.environ.get("RUNTIME_DIRECTORY")

    def ready(address: str) -> None:
        notify("READY=1")
        output.ready("address", address)

    serve(
        output.arm,
        output.config,
        socket=socket_path(output.socket),
        port=port,
        token_file=Path(runtime) / "address" if runtime else None,
        ready=ready,
    )
