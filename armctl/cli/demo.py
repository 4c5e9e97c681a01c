"""`armctl demo`."""

from pathlib import Path
from typing import Any

import click

from armctl.cli.output import FOLDER, Output, command
from armctl.cli.tables import show_rows


@command("demo")
@click.option(
    "--out", type=FOLDER, default=Path("armctl-demo"), help="Folder for logs, recordings, plans and the report."
)
@click.option("--seed", type=click.IntRange(0, 2**31), default=0, help="Repeats a demonstration.")
def demo_command(output: Output, out: Path, seed: int) -> int:
    """The whole job on simulated servos, in about three minutes.

    A simulated hand teaches five candidates, the genetic algorithm straightens them, the daemon runs the result through
    0, 1 and 2 intermediate points: plain, then corrected by what these runs showed of the arm. Every log is replayed
    bit for bit, and a report is written.

    Example: armctl demo --out demo
    """
    from armctl.lab import demo

    result = demo.run(out.absolute(), seed, output.progress)
    output.answer(result, lambda: show(output, result))
    return 0 if result["replay"]["mismatches"] == 0 else 1


def show(output: Output, result: dict[str, Any]) -> None:
    from armctl.report.line import PRINTED

    rows = [{**row, "paper": PRINTED[row["via"]]} for row in result["rows"]]
    show_rows(output.console, "demo", "Distance of the tool from the line, mean / maximum, mm", rows)
    replayed = result["replay"]
    output.say(
        "Plain: goals are the plan's own positions. Corrected: goals lead them by how the arm lagged before.\n"
        "Predicted: perfect servos. Encoders: what the servos measured, as in the paper. True: the tool's real place\n"
        "against the wanted line. Own line: against the straight line that fits it best.\n"
        f"Genetic algorithm: {result['ga']['mean_error_mm']:.2f} mm mean over the recorded genes, "
        f"{result['gap_ratio']:.2%} above the exact optimum.\n"
        f"Replay: {replayed['ticks']} ticks, {replayed['messages']} messages, {replayed['mismatches']} mismatches.\n"
        f"Report: {result['report']}"
    )
