"""`armctl study paper`: the paper's Table II beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from armctl.cli.output import Output
from armctl.cli.study.options import PAGE, Point, gathered, line_options, work_options
from armctl.cli.tables import show_table


@click.command("paper")
@line_options
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--xlsx", type=PAGE, metavar="FILE", help="Write the recorded angles of all runs.")
@work_options
def paper_command(
    output: Output,
    from_m: Point,
    to_m: Point,
    duration_s: float,
    xlsx: Path | None,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    config_file: str | None,
) -> None:
    """The paper's experiments 1, 2 and 3, five runs each, by its own genetic algorithm: Table II beside ours.

    Example: armctl study paper --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --xlsx angles.xlsx
    """
    from armctl.files import load_arm, load_config
    from armctl.lab.study import table_ii

    config = load_config(config_file)
    arm = load_arm(config.arm)
    cases = [table_ii.Case(arm, from_m, to_m, via, duration_s, seed) for via in (0, 1, 2)]
    experiments = gathered(output, "experiments", table_ii.work, cases, workers, scheduler)
    if xlsx is not None:
        table_ii.write_angles(xlsx, arm.joint_names, experiments)
    rows = [one.row for one in experiments]
    if not output.result({"rows": rows, "seed": seed, "xlsx": None if xlsx is None else str(xlsx)}):
        show_paper(output, rows)


def show_paper(output: Output, rows: Sequence[dict[str, Any]]) -> None:
    shown = []
    for row in rows:
        paper = row["paper"]
        shown.append(
            (
                str(row["experiment"]),
                str(row["via"]),
                f"{row['recorded_mean_error_mm']:.1f} +- {row['spread_mm']:.1f}",
                f"{row['mean_error_mm']:.1f} / {row['max_error_mm']:.1f}",
                f"{row['duration_s']:.1f}",
                f"{paper['mean_error_mm']:.1f} / {paper['max_error_mm']:.1f}",
                f"{paper['duration_s']:.1f}",
            )
        )
    show_table(
        output.console,
        "Distance from the line by the encoders, mean / maximum, mm",
        ("experiment", "via", "recorded, mean", "found", "s", "paper", "s"),
        shown,
    )
