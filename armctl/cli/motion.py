"""What moves the arm somewhere: `armctl move`, `jog`, `path`, `reach` and `transfer`."""

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armctl.cli.jobs import refined
from armctl.cli.keys import attended, keys
from armctl.cli.output import HOLDS, SOCKET, Output, command, millimetres
from armctl.cli.tables import show_rows
from armctl.errors import ConfigError, RequestRefused
from armctl.files import load_arm, read_text


@command("move", SOCKET)
def move_command(output: Output, deg: bool, **asked: Any) -> None:
    """Go somewhere and hold there: all joints start and arrive at once, slowly unless a duration is given.

    The whole motion is checked before it starts, and is recorded like a run. Ctrl-C stops the arm.

    Example: armctl move --xyz 0.18,0,0.15
    """
    from armctl.config import validate
    from armctl.trajectory.target import MoveRequest

    if sum(asked[target] is not None for target in ("joints_rad", "point_m", "pose")) != 1:
        raise ConfigError("armctl move", "--joints/--xyz/--pose", "one target is wanted", "give just one of them")
    farthest = max((*(asked["joints_rad"] or ()), *(asked["pose"] or ())[3:]), key=abs, default=0.0)
    if not deg and abs(farthest) > 10.0:
        raise ConfigError("armctl move", "", f"{farthest:g} is no angle of a joint in rad", "`--deg` takes degrees")
    for name, metres in (("joints_rad", 0), ("pose", 3)):
        if deg and asked[name] is not None:
            asked[name] = (*asked[name][:metres], *map(math.radians, asked[name][metres:]))
    result = output.carry_out("moving", "move", validate(MoveRequest, asked, "move"))
    output.answer(result, place=millimetres(result["position_m"]))


# Key -> where it leads the tool; how long after it was pressed last, as terminals repeat a key that is held down.
LEADS = {"up": "x+", "down": "x-", "left": "y+", "right": "y-", "u": "z+", "d": "z-"}
HELD_S = 0.6
KEYS_HELP = "arrows: forward, back, left, right; u, d: up, down; +, -: faster, slower; any other key: stop"


@command("jog", SOCKET)
def jog_command(output: Output, joint: str | None, axis: str | None, speed: float, deg: bool, seconds: float) -> None:
    """Turn one joint, or move the tool along an axis, for --seconds (1 unless given); with neither, by keys.

    The arm stops by itself when this command ends, also before: by Ctrl-C, a lost connection, a closed terminal. It
    slows down before limits and floor, and is never faster than 20 deg/s a joint. The tool is led straight or not at
    all: at the edge of the reach, or of what the arm can lift, it stops. By keys it moves while one is held down.

    Example: armctl jog --axis z --speed 0.02 --seconds 2
    """
    if (joint is not None and axis is not None) or (joint is axis is None and not attended(sys.stdin)):
        raise ConfigError("armctl jog", "--joint/--axis", "one thing to jog is wanted", "give one of them")
    if not math.isfinite(speed) or abs(speed) > 1000.0:
        raise ConfigError("armctl jog", "--speed", f"{speed} is no speed", "20 deg/s is the fastest a joint goes")
    from armctl.client.protocol import heartbeats

    output.after_interrupt = HOLDS
    with output.client() as client:
        status = client.call("status")
        names = [known["name"] for known in status["joints"]]
        if joint is not None and joint not in names:
            raise ConfigError("armctl jog", "--joint", f"no joint {joint!r}", f"known: {', '.join(names)}")
        if axis is joint is None:
            by_keys(output, client.call, abs(speed), "q: leave")
        else:
            turn = max(-10.0, min(10.0, math.radians(speed) if deg else speed))
            joints = [turn * (name == joint) for name in names] if joint else []
            tool = _lead(f"{axis}+", speed) if axis else []
            for method, params in heartbeats(seconds, joints_rad_s=joints, tool_m_s=tool):
                client.call(method, **params)
        status = client.call("status")
    position_m = status["tool"]["position_m"]
    output.answer({"state": status["state"], "position_m": position_m}, place=millimetres(position_m))


def _lead(way: str, speed_m_s: float) -> list[float]:
    """A velocity of the tool [m/s] along an axis, such as `z-`."""
    return [(speed_m_s if way[1] == "+" else -speed_m_s) * (axis == way[0]) for axis in "xyz"]


def by_keys(output: Output, call: Callable[..., Any], speed_m_s: float, more: str, ends: str = "q") -> str:
    """Lead the tool as long as keys say so; each answer comes when the next word is due. What is refused is said.

    Args:
        more: What is said of the keys that end it.
        ends: These keys.
    Returns:
        Which of them was pressed.
    """
    way, until_s, moves, why = "", 0.0, False, ""
    with keys(sys.stdin) as pressed:
        output.say(f"{KEYS_HELP}; {more}")
        while not (key := pressed.wait(0.0 if moves else 0.05)) or key not in ends:
            speed_m_s = min(max(speed_m_s * {"+": 1.25, "-": 0.8}.get(key, 1.0), 0.002), 0.25)
            if key and key not in "+-":
                way, until_s, why = LEADS.get(key, ""), time.monotonic() + HELD_S, ""
            leads = bool(way) and time.monotonic() < until_s
            output.live(f"{1000.0 * speed_m_s:.0f} mm/s" + f" along {way}" * leads + why)
            if leads:
                try:
                    call("jog", tool_m_s=_lead(way, speed_m_s), begin=not moves)
                except RequestRefused as refusal:
                    way, why = "", f": {refusal}"
            elif moves:
                call("stop")
            moves = leads
        if moves:
            call("stop")
    return key


@command("path", SOCKET)
def path_command(output: Output, file: Path, refine: int, **how: Any) -> int:
    """Lead the tool along the points in FILE: lines and arcs with rounded corners.

    FILE is a table (CSV) with a header: x_m,y_m,z_m, and kind where wanted. kind is line, or through and arc for an arc
    of a circle: from the point before through this one to the next. The whole motion is checked before it starts, and
    is recorded like a run. Ctrl-C stops the arm.
    With --refine it is led again, corrected by what the encoders showed. What is better by more than the noise of the
    readings is kept as a file, which is a FILE as well. Exit status 1 if something ended that before its time.

    Example: armctl path square.csv --duration 15
    """
    from armctl.trajectory.tool_path import path_from_text

    asked = {**path_from_text(read_text(file, "path"), str(file), **how).model_dump(), "refine": refine}
    return refined(output, "following the path", "path", asked, "the path as the file has it")


@command("reach", SOCKET)
def reach_command(output: Output, grip: bool, let_go: bool, **way: Any) -> int:
    """Bring the tool to a point along a short straight line, correcting for sag; grip what is there, or let it go.

    Without --grip and --let-go the tool stays at the point and the gripper as it is. Ctrl-C stops the arm. Exit status
    1 if a grip was wanted and the gripper found nothing.

    Example: armctl reach --xyz 0.20,0.05,0.06 --grip
    """
    from armctl.config import validate
    from armctl.trajectory.grasp import ReachRequest

    if grip and let_go:
        raise ConfigError("armctl reach", "--grip/--let-go", "both are wanted", "give one of them")
    gripper = "grip" if grip else "let_go" if let_go else "stay"
    result = output.carry_out("reaching", "reach", validate(ReachRequest, {**way, "gripper": gripper}, "reach"))
    words = f"; gripped: {'yes' if result['gripped'] else 'nothing'}" if grip else ""
    output.answer(result, place=millimetres(result["position_m"]), found=words)
    return 1 if grip and not result["gripped"] else 0


@command("transfer", SOCKET)
def transfer_command(
    output: Output, out: Path | None, virtual: str | None, log_path: Path | None, seed: int, **stations: Any
) -> None:
    """Pick at one station, carry, place at the other, and go back: the paper's transfer robot at work, or another arm.

    The tool points down, as with `reach --direction 0,0,-1`. Displacement, velocity, acceleration, angular velocity and
    angular acceleration of the paw's midpoint are computed from the log the daemon records and compared with the model.
    Link lengths are the calibration file's (`lengths_m`).

    Example: armctl transfer --carry 3 --out transfer.html
    """
    from armctl.config import validate
    from armctl.report import transfer_curves as report
    from armctl.trajectory.transfer import TransferRequest

    request = validate(TransferRequest, stations, "transfer")
    answer = {}
    if virtual is not None:
        from armctl.lab.virtual_transfer import record

        if log_path is None:
            raise ConfigError("armctl transfer", "--log", "--virtual needs a file for its log", "give --log FILE.mcap")
        record(load_arm(virtual), request, log_path, seed=seed)
    else:
        if log_path is not None:
            raise ConfigError("armctl transfer", "--log", "the daemon keeps its own recordings", "leave it out")
        answer = output.carry_out("transferring", "transfer", request)
        log_path = Path(output.ask("recordings_show", name=answer["recording"])["path"])
    done = report.load(log_path)
    if out is not None:
        report.write(done, out)
    rows = report.table(done)
    told = {"recording": log_path.stem, "log": str(log_path), "cycle": request.model_dump(), "rows": rows}
    if not output.result({**told, "report": None if out is None else str(out), **answer}):
        show_rows(output.console, "transfer", "Peaks of the paw's midpoint", rows)
        output.say(f"recorded: {log_path}" + ("" if out is None else f"; drawn: {out}"))
