"""Single motions, jogging, and what can be said to a run under way."""

import math
import time
from typing import Any

import click

from armctl.cli.output import HOLDS, POINT, SOCKET, Numbers, Output, command, millimetres
from armctl.errors import ConfigError

POSE = Numbers(6, "six numbers x,y,z,roll,pitch,yaw")


@command("move", SOCKET)
@click.option(
    "--joints", "joints_rad", type=Numbers(), help="Joint positions in the calibration file's order, radians."
)
@click.option("--xyz", "point_m", type=POINT, help="Tool point, metres; the pose nearest to the present one is taken.")
@click.option("--pose", type=POSE, metavar="x,y,z,r,p,y", help="Tool point, and roll, pitch, yaw in radians.")
@click.option("--deg", is_flag=True, help="Angles are in degrees.")
@click.option(
    "--duration", "duration_s", type=click.FloatRange(0.1, 600.0), help="Seconds.  [default: at most 20 deg/s]"
)
def move_command(output: Output, deg: bool, **asked: Any) -> None:
    """Go somewhere and hold there: all joints start and arrive at once, slowly unless a duration is given.

    The whole motion is checked before it starts, and is recorded like a run. Ctrl-C stops the arm.

    Example: armctl move --xyz 0.18,0,0.15
    """
    from armctl.config import validate
    from armctl.trajectory.target import MoveRequest

    if sum(asked[target] is not None for target in ("joints_rad", "point_m", "pose")) != 1:
        raise ConfigError("armctl move", "--joints/--xyz/--pose", "one target is wanted", "give just one of them")
    for name, metres in (("joints_rad", 0), ("pose", 3)):
        if deg and asked[name] is not None:
            asked[name] = (*asked[name][:metres], *map(math.radians, asked[name][metres:]))
    request = validate(MoveRequest, asked, "move")
    with output.client() as client:
        output.after_interrupt = HOLDS
        output.say("moving; Ctrl-C stops the arm")
        result = client.call("move", **request.model_dump(exclude_none=True))
    output.answer(
        result,
        f"{result['recording']}: at {millimetres(result['position_m'])} after {result['duration_s']:.1f} s, "
        f"{result['position_error_mm']:.1f} mm off (by the encoders)",
    )


@command("jog", SOCKET)
@click.option("--joint", help="Name of the joint to turn.")
@click.option("--axis", type=click.Choice(["x", "y", "z"]), help="Axis of the base frame to move the tool along.")
@click.option(
    "--speed", type=float, required=True, help="rad/s of the joint, m/s of the tool; negative for the other way."
)
@click.option("--deg", is_flag=True, help="The joint's speed is in deg/s.")
@click.option("--seconds", type=click.FloatRange(0.1, 60.0), default=1.0, help="How long.")
def jog_command(output: Output, joint: str | None, axis: str | None, speed: float, deg: bool, seconds: float) -> None:
    """Turn one joint, or move the tool along an axis, for as long as this command runs.

    The arm stops by itself when this command ends: by Ctrl-C, a lost connection, a closed terminal. It slows down
    before limits and floor, and is never faster than 20 deg/s a joint.

    Example: armctl jog --axis z --speed 0.02 --seconds 2
    """
    if (joint is None) == (axis is None):
        raise ConfigError("armctl jog", "--joint/--axis", "one thing to jog is wanted", "give one of them")
    if not math.isfinite(speed) or abs(speed) > 1000.0:
        raise ConfigError("armctl jog", "--speed", f"{speed} is no speed", "20 deg/s is the fastest a joint goes")
    with output.client() as client:
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
    position_m = tool["position_m"]
    output.answer({**state, "position_m": position_m}, f"{state['state']}, tool at {millimetres(position_m)}")
