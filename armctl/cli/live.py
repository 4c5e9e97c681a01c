"""`armctl live`: the arm in Foxglove, Lichtblick and PlotJuggler."""

from importlib.resources import files
from pathlib import Path

import click

from armctl.cli.output import CONFIG, FILE, SOCKET, Output, command, kept_option

ARM = kept_option(
    "arm_name", "--arm", metavar="NAME|FILE", help="Calibration of the daemon's arm, if it is not the configured one."
)


@command("live", ARM, SOCKET, CONFIG)
@click.option("--port", type=click.IntRange(0, 65535), default=8765, help="0: any that is free.")
@click.option("--layout", type=FILE, metavar="FILE", help="Only write a Foxglove layout that fits logs and live view.")
def live_command(output: Output, port: int, layout: Path | None) -> None:
    """Let Foxglove, Lichtblick or PlotJuggler watch the arm, until Ctrl-C.

    Prints `ready ws://127.0.0.1:PORT`; open that as a Foxglove WebSocket. Viewers can only look. Any program of this
    machine can connect, no other machine can. The log holds all that is shown here, and more.

    Example: armctl live --layout armctl.json; armctl live
    """
    from armctl.recording.disk import new_file
    from armctl.web import live

    if layout is not None:
        with new_file(layout) as stream:
            stream.write(files("armctl").joinpath("docs/foxglove-layout.json").read_bytes())
        said = f"{layout}: import it in Foxglove or Lichtblick (Layouts, Import from file)"
        output.answer({"layout": str(layout)}, said)
        return
    live.serve(
        output.socket, output.arm, port, lambda found: output.ready("url", f"ws://{live.HOST}:{found}"), output.warn
    )
