"""Commands that look at the arm or change what it does now."""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from typing import Any

import click
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armctl.cli.output import HOLDS, Output, output_option, socket_option


@click.command("status")
@socket_option
@output_option
def status_command(output: Output, socket: str | None) -> None:
    """One snapshot: state, fault, joints, tool.

    Example: armctl status
    """
    from armctl.client import Client

    with Client(socket) as client:
        snapshot = client.call("status")
    if not output.result(snapshot):
        output.console.print(picture(snapshot))


@click.command("watch")
@socket_option
@output_option
def watch_command(output: Output, socket: str | None) -> None:
    """The snapshot live, until Ctrl-C; looking never moves the arm.

    Without a terminal, as in a pipe, one line a second.

    Example: armctl watch
    """
    from armctl.client import Client

    with Client(socket) as client, suppress(KeyboardInterrupt):
        snapshots = client.subscribe()
        if output.json:
            for snapshot in snapshots:
                print(json.dumps(snapshot, allow_nan=False), flush=True)
        elif output.console.is_terminal:
            with Live(console=output.console, auto_refresh=False) as live:
                for snapshot in snapshots:
                    live.update(picture(snapshot), refresh=True)
        else:
            for index, snapshot in enumerate(snapshots):
                if index % max(1, round(1.0 / snapshot["period_s"])) == 0:
                    print(_line(snapshot), flush=True)


WIDEST_NAME = 14
BAR = 12
"""Characters that show where a joint is between its limits."""
NEAR_LIMIT = 0.03
"""Of the range between its limits, from where on a joint's place is shown in red."""


def picture(snapshot: dict[str, Any]) -> RenderableType:
    joints = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("joint", "id", "deg", "limits", "deg/s", "load %", "V", "degC", "torque", "age s"):
        left = column in ("joint", "limits")
        width = WIDEST_NAME if column == "joint" else None
        joints.add_column(
            column, justify="left" if left else "right", no_wrap=width is None, overflow="fold", max_width=width
        )
    for joint in snapshot["joints"]:
        known = joint["position_rad"] is not None
        joints.add_row(
            joint["name"],
            str(joint["servo_id"]),
            f"{math.degrees(joint['position_rad']):.1f}" if known else "-",
            _place(joint) if known else "",
            f"{math.degrees(joint['velocity_rad_s']):.0f}" if known else "-",
            f"{joint['load_ratio'] * 100.0:.0f}" if known else "-",
            f"{joint['voltage_V']:.1f}" if known else "-",
            f"{joint['temperature_degC']:.0f}" if known else "-",
            ("on" if joint["torque_enabled"] else "off") if known else "-",
            f"{joint['age_s']:.2f}" if joint["age_s"] is not None else "never",
        )
    speed_m_s = None if snapshot["tool"] is None else snapshot["tool"]["speed_m_s"]
    limit_m_s = snapshot["tool_speed_limit_m_s"]
    hurried = snapshot["state"] == "teaching" and (speed_m_s or 0.0) > limit_m_s
    parts: list[RenderableType] = [
        Text(f"{snapshot['arm_id']}: {snapshot['state']}", style="bold red" if snapshot["fault"] else "bold"),
        joints,
        Text(
            f"tool at {_tool(snapshot)}" + (f" (keep it below {1000.0 * limit_m_s:.0f})" if hurried else ""),
            style="bold red" if hurried else "",
        ),
    ]
    if snapshot["progress"] is not None:
        done = round(snapshot["progress"] * 2 * BAR)
        parts.append(Text(f"{'━' * done}{'╌' * (2 * BAR - done)} {_progress(snapshot)}"))
    if snapshot["recording"]:
        parts.append(Text(f"recording {snapshot['recording']}"))
    if snapshot["log"]["problem"]:
        parts.append(Text(f"logging stands still: {snapshot['log']['problem']}", style="red"))
    if fault := snapshot["fault"]:
        card = f"{fault['code']} since {fault['since_s']:.0f} s: {fault['text']}\n  the arm: {fault['arm']}"
        parts.append(Text(f"{card}\n  next: {fault['next']}", style="red"))
    return Group(*parts)


def _place(joint: dict[str, Any]) -> Text:
    """A joint between its limits, as a mark on a bar."""
    low, high = joint["limits_rad"]
    share = (joint["position_rad"] - low) / (high - low)
    at = max(0, min(BAR - 1, math.floor(share * BAR)))
    text = Text("╌" * at + "●" + "╌" * (BAR - 1 - at))
    if not NEAR_LIMIT <= share <= 1.0 - NEAR_LIMIT:
        text.stylize("red", at, at + 1)
    return text


def _tool(snapshot: dict[str, Any]) -> str:
    tool = snapshot["tool"]
    if tool is None:
        return "unknown"
    place = ", ".join(f"{value * 1000.0:.1f}" for value in tool["position_m"]) + " mm"
    return place if tool["speed_m_s"] is None else f"{place}, {tool['speed_m_s'] * 1000.0:.0f} mm/s"


def _progress(snapshot: dict[str, Any]) -> str:
    rate = snapshot["rate"]
    return f"{snapshot['progress']:.0%} of the way, " + (f"rate {rate:g}" if rate else "paused")


def _line(snapshot: dict[str, Any]) -> str:
    """A snapshot in one line."""
    parts = [f"tick {snapshot['tick']}", snapshot["state"], f"tool {_tool(snapshot)}"]
    known = [joint for joint in snapshot["joints"] if joint["temperature_degC"] is not None]
    if known:
        hottest = max(known, key=lambda joint: float(joint["temperature_degC"]))
        parts.append(f"hottest {hottest['temperature_degC']:.0f} degC ({hottest['name']})")
        parts.append(f"lowest {min(joint['voltage_V'] for joint in known):.1f} V")
    if snapshot["progress"] is not None:
        parts.append(_progress(snapshot))
    if fault := snapshot["fault"]:
        parts.append(f"{fault['code']}: {fault['text']}; next: {fault['next']}")
    return "; ".join(parts)


def request(output: Output, socket: str | None, method: str, **params: Any) -> None:
    from armctl.client import Client

    with Client(socket) as client:
        state = client.call(method, **params)
    if not output.result(state):
        output.say(str(state["state"]))


@click.command("stop")
@socket_option
@output_option
def stop_command(output: Output, socket: str | None) -> None:
    """Stop now: decelerate on the path and hold. Open to everyone, always.

    Example: armctl stop
    """
    request(output, socket, "stop")


@click.command("hold")
@socket_option
@output_option
def hold_command(output: Output, socket: str | None) -> None:
    """The same as stop.

    Example: armctl hold
    """
    request(output, socket, "hold")


@click.command("clear")
@socket_option
@output_option
def clear_command(output: Output, socket: str | None) -> None:
    """Acknowledge a latched fault; refused while its cause persists, with what to do about it.

    Example: armctl clear
    """
    from armctl.client import Client

    with Client(socket) as client:
        state = client.call("clear")
    if not output.result(state):
        output.say(str(state["state"]) + ("; go on with `armctl torque on`" if state["state"] == "off" else ""))


@click.command("park")
@socket_option
@output_option
def park_command(output: Output, socket: str | None) -> None:
    """Go slowly to the rest pose, and go limp there. `armctl stop`, or Ctrl-C, keeps the arm where it is.

    Example: armctl park
    """
    output.after_interrupt = HOLDS
    request(output, socket, "park")


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
    """Switch torque off after a countdown. The arm drops: support it.

    Example: armctl release --countdown 5
    """
    from armctl.client import Client

    with Client(socket) as client:
        if any(joint["torque_enabled"] for joint in client.call("status")["joints"]):
            output.after_interrupt = "torque stays on"
            count_down(output, countdown)
    request(output, socket, "release", confirm=True)


@click.group("torque")
def torque_command() -> None:
    """Switch the servos' torque on; `armctl release` switches it off.

    Example: armctl torque on
    """


@torque_command.command("on")
@socket_option
@output_option
def torque_on(output: Output, socket: str | None) -> None:
    """Carefully energise the arm where it is.

    Example: armctl torque on
    """
    request(output, socket, "torque_on")
