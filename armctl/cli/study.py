"""`armctl study`: settings of the genetic algorithm, durations, simulated arms; here or on a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table

from armctl.cli.experiment import ViaType
from armctl.cli.kinematics import NumbersType
from armctl.cli.output import POINT, Output, config_option, output_option
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config
    from armctl.experiment.line import Via
    from armctl.kinematics.transform import FloatArray
    from armctl.study import arms, pareto
    from armctl.trajectory.placement import Objective

F = TypeVar("F", bound=Callable[..., Any])
A = TypeVar("A")
R = TypeVar("R")
Point = tuple[float, float, float]
TAKES = 5
FRONT_SHARES = (0.5, 0.7, 1.0, 1.6, 2.4)
"""Durations of the fronts on the page, over the one asked for."""
PAGE = click.Path(dir_okay=False, path_type=Path)


@click.group("study")
def study_command() -> None:
    """The same work many times over: settings, durations, arms drawn at random.

    Work is shared among this machine's processors; with --scheduler a Dask cluster does it, whose workers must have
    armctl installed. A seed repeats the figures, whoever works.

    Example: armctl study ga --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10
    """


def _line(function: F) -> F:
    function = click.option("--to", "to_m", type=POINT, required=True, help="End of the line, metres.")(function)
    return click.option("--from", "from_m", type=POINT, required=True, help="Start of the line, metres.")(function)


def _work(function: F) -> F:
    options = (
        click.option("--seed", type=click.IntRange(0, 2**31), default=0, show_default=True, help="Repeats a study."),
        click.option("--workers", type=click.IntRange(1, 1024), help="Processes.  [default: one a processor]"),
        click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler that does the work: tcp://host:8786."),
        config_option,
        output_option,
    )
    for option in reversed(options):
        function = option(function)
    return function


def _carry_out(
    output: Output, label: str, work: Callable[[A], R], cases: Sequence[A], workers: int | None, scheduler: str | None
) -> list[R]:
    from armctl.study.workers import carry_out

    count = workers or len(os.sched_getaffinity(0))
    with output.progress(label, len(cases)) as show:
        return carry_out(
            work,
            cases,
            workers=count,
            scheduler=scheduler,
            tell=lambda done: show(done, f"{done} of {len(cases)}"),
        )


def _takes(
    output: Output, config: Config, arm: ArmConfig, names: Sequence[str], from_m: Point, to_m: Point, seed: int
) -> tuple[FloatArray, ...]:
    """The named recordings; without names, takes of the simulated hand."""
    import numpy as np

    from armctl.config import data_dir
    from armctl.experiment.rig import VirtualRig
    from armctl.jobs import load_takes
    from armctl.recording import recordings
    from armctl.sim.arm import SimulatedArm
    from armctl.sim.spec import RANDOM_SPEC

    if names:
        folder = data_dir(config) / "recordings"
        paths = [Path(name) if "/" in name else recordings.find(folder, name) for name in names]
        return tuple(take.positions_rad for take in load_takes(arm, paths))
    rig = VirtualRig(SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC), config.period_s)
    takes = []
    with output.progress("guiding by hand", TAKES) as show:
        for take in range(TAKES):
            takes.append(rig.teach(np.array(from_m), np.array(to_m), seed * 1000 + take))
            show(take + 1, "")
    return tuple(takes)


def _whole(name: str, values: Sequence[float]) -> list[int]:
    if any(value != int(value) for value in values):
        raise ConfigError("armctl study ga", name, f"{list(values)} are not whole numbers")
    return [int(value) for value in values]


@study_command.command("ga")
@click.argument("recordings", nargs=-1)
@_line
@click.option("--population", type=NumbersType(), default="50,95,200", show_default=True)
@click.option("--pc", type=NumbersType(), default="0.4,0.6,0.8", show_default=True, help="Crossover probabilities.")
@click.option("--pm", type=NumbersType(), default="0.001,0.01,0.05", show_default=True, help="Mutation probabilities.")
@click.option("--generations", type=click.IntRange(10, 100_000), default=300, show_default=True)
@click.option("--profile", type=click.Choice(("paper", "default")), default="paper", show_default=True)
@click.option("--repeats", type=click.IntRange(1, 1000), default=5, show_default=True, help="Seeds of each setting.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@_work
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

    from armctl.config import load_arm, load_config
    from armctl.genetic.algorithm import PROFILES
    from armctl.study import settings

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
    settings.cases(base, _whole("--population", population), pc, pm, repeats)  # refuses bad ones before any work
    base = replace(base, takes=_takes(output, config, arm, recordings, from_m, to_m, seed))
    cases = settings.cases(base, _whole("--population", population), pc, pm, repeats)
    rows = settings.rows(_carry_out(output, "evolving", settings.work, cases, workers, scheduler), repeats)
    if output.result({"rows": rows, "seed": seed}):
        return
    table = _table(f"Mean distance from the line over {repeats} seeds, mm")
    for column in ("population", "Pc", "Pm", "mean", "+-", "best", "exact", "gap", "settled"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
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
    output.console.print(table)


@study_command.command("arms")
@click.argument("plan", required=False, type=PAGE)
@click.option("--from", "from_m", type=POINT, help="Start of the line, metres; not with a plan.")
@click.option("--to", "to_m", type=POINT, help="End of the line, metres; not with a plan.")
@click.option("--via", type=ViaType(), default="2", show_default=True, help="Numbers of via points; auto; stream.")
@click.option("--arms", "count", type=click.IntRange(1, 10_000), default=20, show_default=True)
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mix", show_default=True)
@click.option("--period", "period_s", type=click.FloatRange(0.01, 1.0), help="Tick of the arms.  [default: 0.1]")
@_work
def arms_command(
    output: Output,
    plan: Path | None,
    from_m: Point | None,
    to_m: Point | None,
    via: tuple[Via, ...],
    count: int,
    rounds: int,
    duration_s: float,
    objective: Objective,
    period_s: float | None,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    config_file: str | None,
) -> None:
    """One line, or PLAN as it stands, on many simulated arms drawn at random: the spread of its true error.

    Example: armctl study arms --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --via 2,stream --arms 20
    """
    from armctl.config import load_arm, load_config, read_text
    from armctl.experiment.line import check_via
    from armctl.study import arms
    from armctl.trajectory.plan import plan_from_text

    config = load_config(config_file)
    arm = load_arm(config.arm)
    parsed = None
    if plan is not None:
        parsed = plan_from_text(read_text(plan, "plan"), str(plan))
        from_m, to_m, duration_s = parsed.from_m, parsed.to_m, parsed.duration_s
    elif from_m is None or to_m is None:
        raise ConfigError("armctl study arms", "--from/--to", "no line", "give both ends, or a plan")
    check_via(via)
    cases = [
        arms.Case(
            arm=arm,
            seed=seed + number,
            from_m=from_m,
            to_m=to_m,
            via=via,
            duration_s=duration_s,
            rounds=rounds,
            period_s=period_s or config.period_s,
            objective=objective,
            plan=parsed,
        )
        for number in range(count)
    ]
    rows = [row for some in _carry_out(output, "arms", arms.work, cases, workers, scheduler) for row in some]
    summary = arms.summary(rows)
    if output.result({"rows": rows, "summary": summary, "seed": seed}):
        return
    table = _table(f"True distance from the line on {count} arms, median / worst, mm")
    for column in ("via", "before, mean", "mean", "+-", "max", "arms", "refused"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in summary:
        before, truth = one.get("before"), one.get("truth")
        table.add_row(
            str(one["via"]),
            "-" if before is None else _pair(before["mean_error_mm"]),
            "-" if truth is None else _pair(truth["mean_error_mm"]),
            "-" if truth is None else f"{truth['mean_error_mm']['spread']:.2f}",
            "-" if truth is None else _pair(truth["max_error_mm"]),
            str(one["arms"]),
            str(one["refused"]),
        )
    output.console.print(table)
    for row in rows:
        if row["refused"]:
            output.say(f"arm {row['arm']}, via {row['via']}: {row['refused']}")


@study_command.command("pareto")
@click.argument("recordings", nargs=-1)
@_line
@click.option("--via", type=NumbersType(), default="0,1,2,3,5,8", show_default=True, help="Numbers of via points.")
@click.option("--durations", type=NumbersType(), default="1,1.5,2,3,5,8", show_default=True, help="Seconds.")
@click.option("--arms", "count", type=click.IntRange(0, 1000), default=0, show_default=True, help="Simulated arms.")
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mean", show_default=True)
@click.option("--report", type=PAGE, metavar="HTML", help="Write a page with the fronts drawn.")
@_work
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
    from armctl.config import load_arm, load_config
    from armctl.report import pareto as page
    from armctl.report.page import plotly
    from armctl.study import arms, pareto

    if report is not None:
        plotly()
    config = load_config(config_file)
    arm = load_arm(config.arm)
    counts = tuple(_whole("--via", via))
    takes = _takes(output, config, arm, recordings, from_m, to_m, seed)
    cases = [
        pareto.Case(arm, takes, from_m, to_m, counts, duration_s, seed, objective) for duration_s in sorted(durations)
    ]
    on_arms = [
        arms.Case(arm, seed + number, from_m, to_m, counts, duration_s, rounds, config.period_s, objective)
        for duration_s in sorted(durations)
        for number in range(count)
    ]
    rows = _fronts(output, cases, on_arms, workers, scheduler)
    if report is not None:
        page.write(rows, report)
    if output.result({"rows": rows, "seed": seed, "report": None if report is None else str(report)}):
        return
    table = _table("Distance from the line, mm; * no other is better in both")
    for column in ("s", "via", "recorded", "predicted", "true", "by time", "by via"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        truth = row.get("truth")
        table.add_row(
            f"{row['duration_s']:g}",
            str(row["via"]),
            f"{row['recorded_mean_error_mm']:.2f}" if row["feasible"] else "too fast",
            f"{row['predicted_mean_error_mm']:.2f}",
            "-" if truth is None else f"{truth['mean_error_mm']:.2f} +- {truth['spread_mm']:.2f}",
            "*" if row["front_duration"] else "",
            "*" if row["front_via"] else "",
        )
    output.console.print(table)


def _fronts(
    output: Output,
    cases: Sequence[pareto.Case],
    on_arms: Sequence[arms.Case],
    workers: int | None,
    scheduler: str | None,
) -> list[dict[str, Any]]:
    """Rows of every duration and number of via points, with the truth of the arms that ran them, fronts marked."""
    from armctl.study import arms, pareto

    rows = [row for some in _carry_out(output, "optimising", pareto.work, cases, workers, scheduler) for row in some]
    if on_arms:
        done = _carry_out(output, "running on arms", arms.work, on_arms, workers, scheduler)
        ran = [{**row, "wanted_s": case.duration_s} for case, some in zip(on_arms, done, strict=True) for row in some]
        rows = pareto.with_truth(rows, ran)
    return pareto.with_fronts(rows)


@study_command.command("limits")
@_line
@click.option("--via", type=ViaType(), default="1,2,8,stream", show_default=True, help="Via points; auto; stream.")
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--repeats", type=click.IntRange(1, 100), default=5, show_default=True, help="Runs of each final plan.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mix", show_default=True)
@click.option("--report", type=PAGE, metavar="HTML", help="Write the page with all the evidence.")
@_work
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

    from armctl.config import load_arm, load_config
    from armctl.experiment.line import check_via
    from armctl.report import experiment as page
    from armctl.report.page import plotly
    from armctl.study import arms, limits, pareto

    if report is not None:
        plotly()
    check_via(via)
    config = load_config(config_file)
    arm = load_arm(config.arm)
    cases = [
        limits.Case(arm, seed, from_m, to_m, via, duration_s, rounds, repeats, config.period_s, objective, without)
        for without in limits.WITHOUT
    ]
    found = _carry_out(output, "one effect off at a time", limits.work, cases, workers, scheduler)
    rows = limits.with_shares([row for one in found for row in one.rows])
    if report is not None:
        takes = _takes(output, config, arm, (), from_m, to_m, seed)
        counts = tuple(one for one in via if isinstance(one, int))
        durations = [duration_s * share for share in FRONT_SHARES] if counts else []
        fronts = _fronts(
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
            page.ExperimentReport(
                from_m=np.array(from_m),
                to_m=np.array(to_m),
                outcomes=found[0].outcomes,
                limits=rows,
                fronts=fronts,
                notes=(f"Simulated arm {seed} of the batch, {repeats} repeats of each final plan.",),
            ),
            report,
        )
    if output.result({"rows": rows, "seed": seed, "report": None if report is None else str(report)}):
        return
    table = _table("True mean distance from the line, mm, with one effect switched off")
    for column in ("via", "without", "before", "after", "+-", "its share"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            str(row["via"]),
            row["without"] or "nothing",
            f"{row['before_mm']:.2f}",
            f"{row['after_mm']:.2f}",
            f"{row['spread_mm']:.2f}",
            f"{row['after_share_mm']:+.2f}",
        )
    output.console.print(table)
    for row in rows[: len(found[0].rows)]:
        output.say(
            f"via {row['via']}: whole ticks alone {row['ticks_mm']:.2f} mm, zero offsets no encoder sees "
            f"{row['unseen_mm']:.2f} mm"
        )


@study_command.command("paper")
@_line
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--xlsx", type=PAGE, metavar="FILE", help="Write the recorded angles of all runs.")
@_work
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
    from armctl.config import load_arm, load_config
    from armctl.study import table_ii

    config = load_config(config_file)
    arm = load_arm(config.arm)
    cases = [table_ii.Case(arm, from_m, to_m, via, duration_s, seed) for via in (0, 1, 2)]
    experiments = _carry_out(output, "experiments", table_ii.work, cases, workers, scheduler)
    if xlsx is not None:
        table_ii.write_angles(xlsx, arm.joint_names, experiments)
    rows = [one.row for one in experiments]
    if output.result({"rows": rows, "seed": seed, "xlsx": None if xlsx is None else str(xlsx)}):
        return
    table = _table("Distance from the line by the encoders, mean / maximum, mm")
    for column in ("experiment", "via", "recorded, mean", "found", "s", "paper", "s"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        paper = row["paper"]
        table.add_row(
            str(row["experiment"]),
            str(row["via"]),
            f"{row['recorded_mean_error_mm']:.1f} +- {row['spread_mm']:.1f}",
            f"{row['mean_error_mm']:.1f} / {row['max_error_mm']:.1f}",
            f"{row['duration_s']:.1f}",
            f"{paper['mean_error_mm']:.1f} / {paper['max_error_mm']:.1f}",
            f"{paper['duration_s']:.1f}",
        )
    output.console.print(table)


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)


def _pair(values: dict[str, float]) -> str:
    return f"{values['median']:.2f} / {values['worst']:.2f}"
