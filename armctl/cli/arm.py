"""Commands that look at the arm or change what it does now."""

from __future__ import annotations

import json
import math
import time
from typing import Any

import click
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armctl.cli.output import Output, output_option, socket_option


@click.command("status")
@socket_option
@output_option
def status_command(output: Output, socket: str | None) -> None:
    """One snapshot: state, fault, joints, tool."""
    from armctl.client import Client

    with Client(socket) as client:
        snapshot = client.call("status")
    if not output.result(snapshot):
        output.console.print(_picture(snapshot))


@click.command("watch")
@socket_option
@output_option
def watch_command(output: Output, socket: str | None) -> None:
    """The snapshot live, until Ctrl-C; looking never moves the arm."""
    from armctl.client import Client

    with Client(socket) as client:
        if output.json:
            for snapshot in client.subscribe():
                print(json.dumps(snapshot, allow_nan=False), flush=True)
        with Live(console=output.console, auto_refresh=False) as live:
            for snapshot in client.subscribe():
                live.update(_picture(snapshot), refresh=True)


def _picture(snapshot: dict[str, Any]) -> RenderableType:
    joints = Table(box=None, pad_edge=False)
    for column in ("joint", "id", "deg", "deg/s", "load %", "V", "degC", "torque", "age s"):
        joints.add_column(column, justify="left" if column == "joint" else "right")
    for joint in snapshot["joints"]:
        known = joint["position_rad"] is not None
        joints.add_row(
            joint["name"],
            str(joint["servo_id"]),
            f"{math.degrees(joint['position_rad']):.1f}" if known else "-",
            f"{math.degrees(joint['velocity_rad_s']):.0f}" if known else "-",
            f"{joint['load_ratio'] * 100.0:.0f}" if known else "-",
            f"{joint['voltage_V']:.1f}" if known else "-",
            f"{joint['temperature_degC']:.0f}" if known else "-",
            ("on" if joint["torque_enabled"] else "off") if known else "-",
            f"{joint['age_s']:.2f}" if joint["age_s"] is not None else "never",
        )
    tool = snapshot["tool"]
    place = "unknown" if tool is None else ", ".join(f"{value * 1000.0:.1f}" for value in tool["position_m"]) + " mm"
    parts: list[RenderableType] = [
        Text(f"{snapshot['arm_id']}: {snapshot['state']}", style="bold red" if snapshot["fault"] else "bold"),
        joints,
        Text(f"tool at {place}"),
    ]
    if snapshot["recording"]:
        parts.append(Text(f"recording {snapshot['recording']}"))
    if snapshot["log"]["problem"]:
        parts.append(Text(f"logging stands still: {snapshot['log']['problem']}", style="red"))
    if fault := snapshot["fault"]:
        card = f"{fault['code']} since {fault['since_s']:.0f} s: {fault['text']}\n  the arm: {fault['arm']}"
        parts.append(Text(f"{card}\n  next: {fault['next']}", style="red"))
    return Group(*parts)


def _request(output: Output, socket: str | None, method: str, **params: Any) -> None:
    from armctl.client import Client

    with Client(socket) as client:
        state = client.call(method, **params)
    if not output.result(state):
        output.say(str(state["state"]))


@click.command("stop")
@socket_option
@output_option
def stop_command(output: Output, socket: str | None) -> None:
    """Stop now: decelerate on the path and hold. Open to everyone, always."""
    _request(output, socket, "stop")


@click.command("hold")
@socket_option
@output_option
def hold_command(output: Output, socket: str | None) -> None:
    """The same as stop."""
    _request(output, socket, "hold")


@click.command("clear")
@socket_option
@output_option
def clear_command(output: Output, socket: str | None) -> None:
    """Acknowledge a latched fault; refused while its cause persists."""
    _request(output, socket, "clear")


@click.command("park")
@socket_option
@output_option
def park_command(output: Output, socket: str | None) -> None:
    """Go slowly to the rest pose, and go limp there. `armctl stop` keeps the arm where it is."""
    _request(output, socket, "park")


COUNTDOWN = click.option(
    "--countdown", type=click.IntRange(0, 60), default=3, show_default=True, help="Seconds to take hold of the arm."
)


def count_down(output: Output, seconds: int) -> None:
    """Give the person time to support the arm before it goes limp."""
    for left in range(seconds, 0, -1):
        output.say(f"support the arm: it goes limp in {left} s (Ctrl-C to keep it)")
        time.sleep(1.0)


@click.command("release")
@COUNTDOWN
@socket_option
@output_option
def release_command(output: Output, socket: str | None, countdown: int) -> None:
    """Switch torque off after a countdown. The arm drops: support it."""
    count_down(output, countdown)
    _request(output, socket, "release", confirm=True)


@click.group("torque")
def torque_command() -> None:
    """Torque."""


@torque_command.command("on")
@socket_option
@output_option
def torque_on(output: Output, socket: str | None) -> None:
    """Carefully energise the arm where it is."""
    _request(output, socket, "torque_on")
