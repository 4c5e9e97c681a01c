"""Single motions, jogging, and what can be said to a run under way."""

from __future__ import annotations

import math
import time
from typing import Any

import click

from armctl.cli.arm import request
from armctl.cli.output import HOLDS, POINT, Output, output_option, socket_option
from armctl.errors import ConfigError


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """Numbers with commas between them, `count` of them or any."""

    name = "a,b,..."

    def __init__(self, count: int | None = None) -> None:
        self._count = count

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not numbers with commas between them", param, ctx)
        if self._count is not None and len(numbers) != self._count:
            self.fail(f"{value!r} has {len(numbers)} numbers, not {self._count}", param, ctx)
        if not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r}: every number must be finite", param, ctx)
        return numbers


@click.command("move")
@click.option(
    "--joints", "joints_rad", type=Numbers(), help="Joint positions in the calibration file's order, radians."
)
@click.option("--xyz", "point_m", type=POINT, help="Tool point, metres; the pose nearest to the present one is taken.")
@click.option("--pose", type=Numbers(6), metavar="x,y,z,r,p,y", help="Tool point, and roll, pitch, yaw in radians.")
@click.option("--deg", is_flag=True, help="Angles are in degrees.")
@click.option(
    "--duration", "duration_s", type=click.FloatRange(0.1, 600.0), help="Seconds.  [default: at most 20 deg/s]"
)
@socket_option
@output_option
def move_command(
    output: Output,
    deg: bool,
    socket: str | None,
    **asked: Any,
) -> None:
    """Go somewhere and hold there: all joints start and arrive at once, slowly unless a duration is given.

    Checked as a whole before it starts, recorded like a run. Ctrl-C stops the arm.

    Example: armctl move --xyz 0.18,0,0.15
    """
    from armctl.client import Client
    from armctl.config import validate
    from armctl.trajectory.target import MoveRequest

    if sum(asked[target] is not None for target in ("joints_rad", "point_m", "pose")) != 1:
        raise ConfigError("armctl move", "--joints/--xyz/--pose", "one target is wanted", "give just one of them")
    for name, metres in (("joints_rad", 0), ("pose", 3)):
        if deg and asked[name] is not None:
            asked[name] = (*asked[name][:metres], *map(math.radians, asked[name][metres:]))
    request = validate(MoveRequest, asked, "move")
    with Client(socket) as client:
        output.after_interrupt = HOLDS
        output.say("moving; Ctrl-C stops the arm")
        result = client.call("move", **request.model_dump(exclude_none=True))
    if not output.result(result):
        place = ", ".join(f"{value * 1000.0:.1f}" for value in result["position_m"])
        output.say(
            f"{result['recording']}: at {place} mm after {result['duration_s']:.1f} s, "
            f"{result['position_error_mm']:.1f} mm off (by the encoders)"
        )


@click.command("jog")
@click.option("--joint", help="Name of the joint to turn.")
@click.option("--axis", type=click.Choice(["x", "y", "z"]), help="Axis of the base frame to lead the tool along.")
@click.option(
    "--speed", type=float, required=True, help="rad/s of the joint, m/s of the tool; negative for the other way."
)
@click.option("--deg", is_flag=True, help="The joint's speed is in deg/s.")
@click.option("--seconds", type=click.FloatRange(0.1, 60.0), default=1.0, show_default=True, help="How long.")
@socket_option
@output_option
def jog_command(
    output: Output, joint: str | None, axis: str | None, speed: float, deg: bool, seconds: float, socket: str | None
) -> None:
    """Turn one joint, or lead the tool along an axis, for as long as this command lives.

    The arm stops by itself when its heartbeats cease: Ctrl-C, a lost connection, a killed terminal. It slows down
    before limits and floor, and is never faster than 20 deg/s a joint.

    Example: armctl jog --axis z --speed 0.02 --seconds 2
    """
    from armctl.client import Client

    if (joint is None) == (axis is None):
        raise ConfigError("armctl jog", "--joint/--axis", "one thing to jog is wanted", "give one of them")
    if not math.isfinite(speed) or abs(speed) > 1000.0:
        raise ConfigError("armctl jog", "--speed", f"{speed} is no speed", "20 deg/s is the fastest a joint goes")
    with Client(socket) as client:
        names = [known["name"] for known in client.call("status")["joints"]]
        if joint is not None and joint not in names:
            raise ConfigError("armctl jog", "--joint", f"no joint {joint!r}", f"known: {', '.join(names)}")
        wanted: dict[str, Any] = {}
        if axis is not None:
            wanted["tool_m_s"] = [speed * (axis == one) for one in "xyz"]
        else:
            turn = max(-10.0, min(10.0, math.radians(speed) if deg else speed))
            wanted["joints_rad_s"] = [turn * (name == joint) for name in names]
        output.after_interrupt = HOLDS
        end_s = time.monotonic() + seconds
        client.call("jog", **wanted, begin=True)
        while time.monotonic() < end_s:
            client.call("jog", **wanted)  # answered by the next tick: the loop needs no clock of its own
        state = client.call("stop")
        tool = client.call("status")["tool"]
    if not output.result({**state, "position_m": tool["position_m"]}):
        output.say(f"{state['state']}, tool at " + ", ".join(f"{x * 1000.0:.1f}" for x in tool["position_m"]) + " mm")


@click.command("pause")
@socket_option
@output_option
def pause_command(output: Output, socket: str | None) -> None:
    """Bring the run under way to rest on its path. Open to everyone; `armctl resume` goes on.

    Example: armctl pause
    """
    request(output, socket, "pause")


@click.command("resume")
@socket_option
@output_option
def resume_command(output: Output, socket: str | None) -> None:
    """Go on with a paused run.

    Example: armctl resume
    """
    request(output, socket, "resume")


@click.command("rate")
@click.argument("rate", type=click.FloatRange(0.1, 1.0))
@socket_option
@output_option
def rate_command(output: Output, rate: float, socket: str | None) -> None:
    """Let the run under way go at RATE (0.1 to 1) of its planned speed.

    Example: armctl rate 0.5
    """
    request(output, socket, "rate", rate=rate)
