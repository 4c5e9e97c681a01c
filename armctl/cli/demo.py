"""`armctl demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table

from armctl.cli.output import Output, output_option


@click.command("demo")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("armctl-demo"),
    show_default=True,
    help="Folder for logs, recordings, plans and the report.",
)
@click.option("--seed", type=click.IntRange(0, 2**31), default=0, show_default=True, help="Repeats a demonstration.")
@output_option
def demo_command(output: Output, out: Path, seed: int) -> int:
    """The whole job on simulated servos, in about two minutes.

    A simulated hand teaches five candidates, the genetic algorithm straightens them, the daemon runs the result through
    0, 1 and 2 intermediate points, every log is replayed bit for bit, and a report is written.

    Example: armctl demo --out demo
    """
    from armctl import demo
    from armctl.report.page import plotly

    plotly()  # refuse now rather than after two minutes
    result = demo.run(out.absolute(), seed, output.progress)
    if not output.result(result):
        _show(output, result)
    return 0 if result["replay"]["mismatches"] == 0 else 1


def _show(output: Output, result: dict[str, Any]) -> None:
    from armctl.report.line import PAPER_ROWS

    table = Table(
        title="Distance of the tool from the line, mean / maximum, mm",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    for column in ("via", "predicted", "encoders", "true", "s", "paper", "s"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in result["rows"]:
        paper = PAPER_ROWS[row["via"]]
        table.add_row(
            str(row["via"]),
            f"{row['predicted_mean_error_mm']:.1f} / {row['predicted_max_error_mm']:.1f}",
            f"{row['mean_error_mm']:.1f} / {row['max_error_mm']:.1f}",
            f"{row['truth']['mean_error_mm']:.1f} / {row['truth']['max_error_mm']:.1f}",
            f"{row['duration_s']:.1f}",
            f"{paper[0]:.1f} / {paper[1]:.1f}",
            f"{paper[2]:.1f}",
        )
    output.console.print(table)
    replayed = result["replay"]
    output.say(
        "Predicted: perfect servos. True: the tool's real place, sag under gravity included; nothing corrects it yet.\n"
        f"Genetic algorithm: {result['ga']['mean_error_mm']:.2f} mm mean over the recorded genes, "
        f"{result['gap_ratio']:.2%} above the exact optimum.\n"
        f"Replay: {replayed['ticks']} ticks, {replayed['messages']} messages, {replayed['mismatches']} mismatches.\n"
        f"Report: {result['report']}"
    )
