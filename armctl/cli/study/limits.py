"""`armctl study limits`: what limits the corrected line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.experiment import ViaType
from armctl.cli.output import Output
from armctl.cli.study.options import PAGE, Point, candidates, gathered, line_options, work_options
from armctl.cli.study.pareto import marked_fronts
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.lab.line import Via
    from armctl.trajectory.placement import Objective


FRONT_SHARES = (0.5, 0.7, 1.0, 1.6, 2.4)
"""Durations of the fronts on the page, over the one asked for."""


@click.command("limits")
@line_options
@click.option("--via", type=ViaType(), default="1,2,8,stream", show_default=True, help="Via points; auto; stream.")
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--repeats", type=click.IntRange(1, 100), default=5, show_default=True, help="Runs of each final plan.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mix", show_default=True)
@click.option("--report", type=PAGE, metavar="HTML", help="Write the page with all the evidence.")
@work_options
def limits_command(
    output: Output,
    from_m: Point,
    to_m: Point,
    via: tuple[Via, ...],
    rounds: int,
    repeats: int,
    duration_s: float,
    objective: Objective,
    report: Path | None,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    config_file: str | None,
) -> None:
    """What limits the corrected line: the experiment on one simulated arm, then with one effect after another off.

    Example: armctl study limits --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --report evidence.html
    """
    import numpy as np

    from armctl.files import load_arm, load_config
    from armctl.lab.line import check_via
    from armctl.lab.study import arms, limits, pareto
    from armctl.report import experiment as page
    from armctl.report.line import ExperimentReport

    check_via(via)
    config = load_config(config_file)
    arm = load_arm(config.arm)
    cases = [
        limits.Case(arm, seed, from_m, to_m, via, duration_s, rounds, repeats, config.period_s, objective, without)
        for without in limits.WITHOUT
    ]
    found = gathered(output, "one effect off at a time", limits.work, cases, workers, scheduler)
    rows = limits.with_shares([row for one in found for row in one.rows])
    if report is not None:
        takes = candidates(output, config, arm, (), from_m, to_m, seed)
        counts = tuple(one for one in via if isinstance(one, int))
        durations = [duration_s * share for share in FRONT_SHARES] if counts else []
        fronts = marked_fronts(
            output,
            [pareto.Case(arm, takes, from_m, to_m, counts, one_s, seed) for one_s in durations],
            [
                arms.Case(arm, seed, from_m, to_m, counts, one_s, rounds, config.period_s, objective)
                for one_s in durations
            ],
            workers,
            scheduler,
        )
        page.write(
            ExperimentReport(
                from_m=np.array(from_m),
                to_m=np.array(to_m),
                outcomes=found[0].outcomes,
                limits=rows,
                fronts=fronts,
                notes=(f"Simulated arm {seed} of the batch, {repeats} repeats of each final plan.",),
            ),
            report,
        )
    if not output.result({"rows": rows, "seed": seed, "report": None if report is None else str(report)}):
        show_limits(output, rows, rows[: len(found[0].rows)])


def show_limits(output: Output, rows: Sequence[dict[str, Any]], complete: Sequence[dict[str, Any]]) -> None:
    shown = [
        (
            str(row["via"]),
            row["without"] or "nothing",
            f"{row['before_mm']:.2f}",
            f"{row['after_mm']:.2f}",
            f"{row['spread_mm']:.2f}",
            f"{row['after_share_mm']:+.2f}",
        )
        for row in rows
    ]
    show_table(
        output.console,
        "True mean distance from the line, mm, one effect off",
        ("via", "without", "before", "after", "+-", "its share"),
        shown,
        words=("without",),
    )
    for row in complete:
        output.say(
            f"via {row['via']}: whole ticks alone {row['ticks_mm']:.2f} mm, zero offsets no encoder sees "
            f"{row['unseen_mm']:.2f} mm"
        )
