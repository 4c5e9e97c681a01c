"""What moves the arm somewhere: `armctl move`, `jog`, `path`, `reach` and `transfer`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from armctl.cli.output import HOLDS, SOCKET, Output, command, millimetres
from armctl.cli.tables import show_rows
from armctl.errors import ConfigError


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
    for name, metres in (("joints_rad", 0), ("pose", 3)):
        if deg and asked[name] is not None:
            asked[name] = (*asked[name][:metres], *map(math.radians, asked[name][metres:]))
    request = validate(MoveRequest, asked, "move")
    with output.motion("moving") as client:
        result = client.call("move", **request.model_dump(exclude_none=True))
    output.answer(
        result,
        f"{result['recording']}: at {millimetres(result['position_m'])} after {result['duration_s']:.1f} s, "
        f"{result['position_error_mm']:.1f} mm off (by the encoders)",
    )


@command("jog", SOCKET)
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
    from armctl.client.protocol import heartbeats

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
        for method, params in heartbeats(seconds, **wanted):
            state = client.call(method, **params)
        tool = client.call("status")["tool"]
    position_m = tool["position_m"]
    output.answer({**state, "position_m": position_m}, f"{state['state']}, tool at {millimetres(position_m)}")


@command("path", SOCKET)
def path_command(output: Output, file: Path, **how: Any) -> None:
    """Lead the tool along the points in FILE: lines and arcs with rounded corners.

    FILE is a table (CSV) with a header: x_m,y_m,z_m, and kind where wanted. kind is line, or through and arc for an arc
    of a circle: from the point before through this one to the next. The whole motion is checked before it starts, and
    is recorded like a run. Ctrl-C stops the arm.

    Example: armctl path square.csv --duration 15
    """
    from armctl.files import read_text
    from armctl.trajectory.tool_path import path_from_text

    request = path_from_text(read_text(file, "path"), str(file), **how)
    with output.motion("following the path", kept=", and what was recorded is kept") as client:
        result = client.call("path", **request.model_dump(exclude_none=True))
    output.answer(
        result,
        f"{result['recording']}: {result['mean_error_mm']:.1f} mm mean and {result['max_error_mm']:.1f} mm at most off "
        f"the path in {result['duration_s']:.1f} s (by the encoders; rounding its corners leads "
        f"{result['predicted_max_error_mm']:.1f} mm off)",
    )


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
    request = validate(ReachRequest, {**way, "gripper": gripper}, "reach")
    with output.motion("reaching") as client:
        result = client.call("reach", **request.model_dump(exclude_none=True))
    words = f"; gripped: {'yes' if result['gripped'] else 'nothing'}" if grip else ""
    output.answer(
        result,
        f"{result['recording']}: at {millimetres(result['position_m'])}, {result['position_error_mm']:.1f} mm off "
        f"(by the encoders){words}",
    )
    return 1 if grip and not result["gripped"] else 0


@command("transfer", SOCKET)
def transfer_command(
    output: Output, out: Path | None, virtual: str | None, log_path: Path | None, seed: int, **stations: Any
) -> None:
    """Pick at one station, carry, place at the other, and go back: the paper's transfer robot at work.

    The paw points down. Displacement, velocity, acceleration, angular velocity and angular acceleration of its midpoint
    are computed from the log the daemon records and compared with the model. Link lengths are the calibration file's
    (`lengths_m`).

    Example: armctl transfer --carry 3 --out transfer.html
    """
    from armctl.config import validate
    from armctl.report import transfer_curves as report
    from armctl.trajectory.transfer import TransferRequest

    request = validate(TransferRequest, stations, "transfer")
    answer = {}
    if virtual is not None:
        from armctl.files import load_arm
        from armctl.lab.virtual_transfer import record

        if log_path is None:
            raise ConfigError("armctl transfer", "--log", "--virtual needs a file for its log", "give --log FILE.mcap")
        record(load_arm(virtual), request, log_path, seed=seed)
    else:
        if log_path is not None:
            raise ConfigError("armctl transfer", "--log", "the daemon keeps its own recordings", "leave it out")
        with output.motion("transferring") as client:
            answer = client.call("transfer", **request.model_dump())
            log_path = Path(client.call("recordings_show", name=answer["recording"])["path"])
    done = report.load(log_path)
    if out is not None:
        report.write(done, out)
    rows = report.table(done)
    result = {
        "recording": log_path.stem,
        "log": str(log_path),
        "cycle": request.model_dump(),
        "rows": rows,
        "report": None if out is None else str(out),
        **answer,
    }
    if not output.result(result):
        show_curves(output, rows)
        output.say(f"recorded: {log_path}" + ("" if out is None else f"; drawn: {out}"))


def show_curves(output: Output, rows: Sequence[dict[str, Any]]) -> None:
    show_rows(output.console, "transfer", "Peaks of the paw's midpoint", rows)
