"""`armctl study pareto`: error against duration and against the number of via points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.kinematics import NumbersType
from armctl.cli.output import Output
from armctl.cli.study.options import PAGE, Point, candidates, gathered, line_options, whole_numbers, work_options
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.lab.study import arms, pareto
    from armctl.trajectory.placement import Objective


@click.command("pareto")
@click.argument("recordings", nargs=-1)
@line_options
@click.option("--via", type=NumbersType(), default="0,1,2,3,5,8", show_default=True, help="Numbers of via points.")
@click.option("--durations", type=NumbersType(), default="1,1.5,2,3,5,8", show_default=True, help="Seconds.")
@click.option("--arms", "count", type=click.IntRange(0, 1000), default=0, show_default=True, help="Simulated arms.")
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mean", show_default=True)
@click.option("--report", type=PAGE, metavar="HTML", help="Write a page with the fronts drawn.")
@work_options
def pareto_command(
    output: Output,
    recordings: tuple[str, ...],
    from_m: Point,
    to_m: Point,
    via: tuple[float, ...],
    durations: tuple[float, ...],
    count: int,
    rounds: int,
    objective: Objective,
    report: Path | None,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    config_file: str | None,
) -> None:
    """Error against duration and against the number of via points, the best of each marked.

    RECORDINGS (or takes of the simulated hand) are optimised for every duration. With --arms so many simulated arms run
    every combination, corrected, and are judged by their true tool path.

    Example: armctl study pareto --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --arms 4 --report pareto.html
    """
    from armctl.files import load_arm, load_config
    from armctl.lab.study import arms, pareto
    from armctl.report import pareto as page

    config = load_config(config_file)
    arm = load_arm(config.arm)
    counts = tuple(whole_numbers("--via", via))
    takes = candidates(output, config, arm, recordings, from_m, to_m, seed)
    cases = [
        pareto.Case(arm, takes, from_m, to_m, counts, duration_s, seed, objective) for duration_s in sorted(durations)
    ]
    on_arms = [
        arms.Case(arm, seed + number, from_m, to_m, counts, duration_s, rounds, config.period_s, objective)
        for duration_s in sorted(durations)
        for number in range(count)
    ]
    rows = marked_fronts(output, cases, on_arms, workers, scheduler)
    if report is not None:
        page.write(rows, report)
    if not output.result({"rows": rows, "seed": seed, "report": None if report is None else str(report)}):
        show_fronts(output, rows)


def show_fronts(output: Output, rows: Sequence[dict[str, Any]]) -> None:
    shown = []
    for row in rows:
        truth = row.get("truth")
        shown.append(
            (
                f"{row['duration_s']:g}",
                str(row["via"]),
                f"{row['recorded_mean_error_mm']:.2f}" if row["feasible"] else "too fast",
                f"{row['predicted_mean_error_mm']:.2f}",
                "-" if truth is None else f"{truth['mean_error_mm']:.2f} +- {truth['spread_mm']:.2f}",
                "*" if row["front_duration"] else "",
                "*" if row["front_via"] else "",
            )
        )
    show_table(
        output.console,
        "Distance from the line, mm; * no other is better in both",
        ("s", "via", "recorded", "predicted", "true", "by time", "by via"),
        shown,
    )


def marked_fronts(
    output: Output,
    cases: Sequence[pareto.Case],
    on_arms: Sequence[arms.Case],
    workers: int | None,
    scheduler: str | None,
) -> list[dict[str, Any]]:
    """Rows of every duration and number of via points, with the truth of the arms that ran them, fronts marked."""
    from armctl.lab.study import arms, pareto

    rows = [row for some in gathered(output, "optimising", pareto.work, cases, workers, scheduler) for row in some]
    if on_arms:
        done = gathered(output, "running on arms", arms.work, on_arms, workers, scheduler)
        ran = [{**row, "wanted_s": case.duration_s} for case, some in zip(on_arms, done, strict=True) for row in some]
        rows = pareto.with_truth(rows, ran)
    return pareto.with_fronts(rows)
