"""`armctl live`: the arm in Foxglove, Lichtblick and PlotJuggler."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import click

from armctl.cli.output import Output, config_option, output_option, socket_option


@click.command("live")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="0: any that is free.")
@click.option("--arm", metavar="NAME|FILE", help="Calibration of the daemon's arm, if it is not the configured one.")
@click.option(
    "--layout",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Only write a Foxglove layout that fits logs and live view.",
)
@socket_option
@config_option
@output_option
def live_command(
    output: Output, port: int, arm: str | None, layout: Path | None, socket: str | None, config_file: str | None
) -> None:
    """Let Foxglove, Lichtblick or PlotJuggler watch the arm, until Ctrl-C.

    Prints `ready ws://127.0.0.1:PORT`; open that as a Foxglove WebSocket. Viewers can only look. Any program of this
    machine can connect, nobody from elsewhere. What one sees here stands in the log, and more.

    Example: armctl live --layout armctl.json; armctl live
    """
    from armctl.files import load_arm, load_config
    from armctl.recording.disk import new_file
    from armctl.web import live

    if layout is not None:
        with new_file(layout) as stream:
            stream.write(files("armctl").joinpath("docs/foxglove-layout.json").read_bytes())
        if not output.result({"layout": str(layout)}):
            output.say(f"{layout}: import it in Foxglove or Lichtblick (Layouts, Import from file)")
        return

    def ready(found: int) -> None:
        if not output.result({"url": f"ws://{live.HOST}:{found}"}):
            click.echo(f"ready ws://{live.HOST}:{found}")

    live.serve(
        socket,
        load_arm(arm or load_config(config_file).arm),
        port,
        ready,
        output.warn,
    )
