"""`armctl study ga`: settings of the genetic algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import click

from armctl.cli.kinematics import NumbersType
from armctl.cli.output import Output
from armctl.cli.study.options import Point, candidates, gathered, line_options, whole_numbers, work_options
from armctl.cli.tables import show_table


@click.command("ga")
@click.argument("recordings", nargs=-1)
@line_options
@click.option("--population", type=NumbersType(), default="50,95,200", show_default=True)
@click.option("--pc", type=NumbersType(), default="0.4,0.6,0.8", show_default=True, help="Crossover probabilities.")
@click.option("--pm", type=NumbersType(), default="0.001,0.01,0.05", show_default=True, help="Mutation probabilities.")
@click.option("--generations", type=click.IntRange(10, 100_000), default=300, show_default=True)
@click.option("--profile", type=click.Choice(("paper", "default")), default="paper", show_default=True)
@click.option("--repeats", type=click.IntRange(1, 1000), default=5, show_default=True, help="Seeds of each setting.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@work_options
def ga_command(
    output: Output,
    recordings: tuple[str, ...],
    from_m: Point,
    to_m: Point,
    population: tuple[float, ...],
    pc: tuple[float, ...],
    pm: tuple[float, ...],
    generations: int,
    profile: Literal["paper", "default"],
    repeats: int,
    duration_s: float,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    config_file: str | None,
) -> None:
    """Settings of the genetic algorithm compared on RECORDINGS, or on takes of the simulated hand.

    Example: armctl study ga --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --population 50,95,200
    """
    from dataclasses import replace

    from armctl.files import load_arm, load_config
    from armctl.genetic.algorithm import PROFILES
    from armctl.lab.study import settings

    config = load_config(config_file)
    arm = load_arm(config.arm)
    base = settings.Case(
        arm=arm,
        takes=(),
        from_m=from_m,
        to_m=to_m,
        duration_s=duration_s,
        settings=replace(PROFILES[profile], generations=generations),
        seed=seed,
    )
    settings.cases(base, whole_numbers("--population", population), pc, pm, repeats)  # refuses bad ones before any work
    base = replace(base, takes=candidates(output, config, arm, recordings, from_m, to_m, seed))
    cases = settings.cases(base, whole_numbers("--population", population), pc, pm, repeats)
    rows = settings.rows(gathered(output, "evolving", settings.work, cases, workers, scheduler), repeats)
    if not output.result({"rows": rows, "seed": seed}):
        show_settings(output, rows)


def show_settings(output: Output, rows: Sequence[dict[str, Any]]) -> None:
    shown = [
        (
            str(row["population"]),
            f"{row['crossover_probability']:g}",
            f"{row['mutation_probability']:g}",
            f"{row['mean_error_mm']:.3f}",
            f"{row['spread_mm']:.3f}",
            f"{row['best_mm']:.3f}",
            f"{row['exact_mean_error_mm']:.3f}",
            f"{row['gap_ratio']:.1%}",
            f"{row['settled_generation']:.0f}",
        )
        for row in rows
    ]
    show_table(
        output.console,
        f"Mean distance from the line over {rows[0]['repeats']} seeds, mm",
        ("population", "Pc", "Pm", "mean", "+-", "best", "exact", "gap", "settled"),
        shown,
    )
