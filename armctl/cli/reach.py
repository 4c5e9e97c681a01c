"""Reaching for a point, and the cycle of a transfer robot."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from armctl.cli.output import FILE, HOLDS, POINT, SOCKET, Output, command, millimetres
from armctl.cli.tables import show_table
from armctl.errors import ConfigError


@command("reach", SOCKET)
@click.option("--xyz", "point_m", type=POINT, required=True, help="Tool point, metres.")
@click.option("--grip", is_flag=True, help="Open, close until the load shows a grip, and back off.")
@click.option("--let-go", is_flag=True, help="Open there, and back off.")
@click.option(
    "--method",
    "ik",
    type=click.Choice(("closed", "numeric", "ga", "ga-improved")),
    default="closed",
    help="Inverse kinematics: closed form, numeric, or a genetic algorithm.",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Of a genetic algorithm.")
@click.option("--off", "off_m", type=click.FloatRange(0.005, 0.3), default=0.05, help="Length of the approach, metres.")
@click.option("--along", type=click.Choice(("above", "tool")), default="above", help="Direction of the approach.")
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
    with output.client() as client:
        output.after_interrupt = HOLDS
        output.say("reaching; Ctrl-C stops the arm")
        result = client.call("reach", **request.model_dump())
    words = f"; gripped: {'yes' if result['gripped'] else 'nothing'}" if grip else ""
    output.answer(
        result,
        f"{result['recording']}: at {millimetres(result['position_m'])}, {result['position_error_mm']:.1f} mm off "
        f"(by the encoders){words}",
    )
    return 1 if grip and not result["gripped"] else 0


@command("transfer", SOCKET)
@click.option("--pick", "pick_m", type=POINT, default="0.176,-0.132,-0.15", help="First station.")
@click.option("--place", "place_m", type=POINT, default="0.176,0.132,-0.15", help="Second station.")
@click.option("--height", "height_m", type=click.FloatRange(0.005, 0.5), default=0.06, help="Metres.")
@click.option("--lift", "lift_s", type=click.FloatRange(0.1, 60.0), default=2.0, help="Seconds.")
@click.option("--carry", "carry_s", type=click.FloatRange(0.1, 60.0), default=4.0, help="Seconds.")
@click.option("--dwell", "dwell_s", type=click.FloatRange(0.0, 60.0), default=0.5, help="Seconds.")
@click.option("--cycles", type=click.IntRange(1, 20), default=1, help="How often.")
@click.option("--out", type=FILE, help="Page with the curves (HTML).")
@click.option("--virtual", metavar="NAME|FILE", help="On simulated servos of this arm in virtual time; no daemon.")
@click.option("--log", "log_path", type=FILE, help="Where --virtual writes its log.")
@click.option("--seed", type=click.IntRange(0, 2**31), default=0, help="Of --virtual's arm.")
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
        with output.client() as client:
            output.after_interrupt = HOLDS
            output.say("transferring; Ctrl-C stops the arm")
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
    shown = [
        (
            str(row["figure"]),
            row["quantity"],
            *(f"{row[key]:.4f}" for key in ("model_peak", "recorded_peak", "rms_difference")),
            row["unit"],
        )
        for row in rows
    ]
    columns = ("figure", "quantity", "model", "recorded", "rms apart", "unit")
    show_table(output.console, "Peaks of the paw's midpoint", columns, shown, words=("figure", "quantity", "unit"))
