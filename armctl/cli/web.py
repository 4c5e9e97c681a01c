"""`armctl web`: the dashboard."""

from __future__ import annotations

import os
from pathlib import Path

import click

from armctl.cli.output import Output, config_option, output_option, socket_option


@click.command("web")
@click.option("--port", type=click.IntRange(1, 65535), default=8080, show_default=True, help="TCP port on 127.0.0.1.")
@socket_option
@config_option
@output_option
def web_command(output: Output, port: int, socket: str | None, config_file: str | None) -> None:
    """Serve the dashboard on this computer, until Ctrl-C.

    Prints `ready ADDRESS`; the address holds the token that opens the page. Nobody else can reach it: for another
    computer use a tunnel, `ssh -L 8080:127.0.0.1:8080 HOST`, and open the printed address there.

    Example: armctl web
    """
    from armctl.files import load_arm, load_config, socket_path
    from armctl.host.service_manager import notify
    from armctl.web.server import serve

    config = load_config(config_file)
    runtime = os.environ.get("RUNTIME_DIRECTORY")

    def ready(address: str) -> None:
        notify("READY=1")
        if not output.result({"address": address}):
            click.echo(f"ready {address}")

    serve(
        load_arm(config.arm),
        config,
        socket=socket_path(socket),
        port=port,
        token_file=Path(runtime) / "address" if runtime else None,
        ready=ready,
    )
