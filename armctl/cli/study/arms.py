"""`armctl study arms`: one line on many simulated arms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.experiment import ViaType
from armctl.cli.output import POINT, Output
from armctl.cli.study.options import PAGE, Point, gathered, work_options
from armctl.cli.tables import show_table
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.lab.line import Via
    from armctl.trajectory.placement import Objective


@click.command("arms")
@click.argument("plan", required=False, type=PAGE)
@click.option("--from", "from_m", type=POINT, help="Start of the line, metres; not with a plan.")
@click.option("--to", "to_m", type=POINT, help="End of the line, metres; not with a plan.")
@click.option("--via", type=ViaType(), default="2", show_default=True, help="Numbers of via points; auto; stream.")
@click.option("--arms", "count", type=click.IntRange(1, 10_000), default=20, show_default=True)
@click.option("--refine", "rounds", type=click.IntRange(0, 20), default=5, show_default=True, help="Corrections.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--objective", type=click.Choice(("mean", "mix", "max")), default="mix", show_default=True)
@click.option("--period", "period_s", type=click.FloatRange(0.01, 1.0), help="Tick of the arms.  [default: 0.1]")
@work_options
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
    from armctl.files import load_arm, load_config, read_text
    from armctl.lab.line import check_via
    from armctl.lab.study import arms
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
    rows = [row for some in gathered(output, "arms", arms.work, cases, workers, scheduler) for row in some]
    summary = arms.summary(rows)
    if not output.result({"rows": rows, "summary": summary, "seed": seed}):
        show_arms(output, summary, rows, count)


def show_arms(output: Output, summary: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]], count: int) -> None:
    shown = []
    for one in summary:
        before, truth = one.get("before"), one.get("truth")
        shown.append(
            (
                str(one["via"]),
                "-" if before is None else _pair(before["mean_error_mm"]),
                "-" if truth is None else _pair(truth["mean_error_mm"]),
                "-" if truth is None else f"{truth['mean_error_mm']['spread']:.2f}",
                "-" if truth is None else _pair(truth["max_error_mm"]),
                str(one["arms"]),
                str(one["refused"]),
            )
        )
    show_table(
        output.console,
        f"True distance from the line on {count} arms, median / worst, mm",
        ("via", "before, mean", "mean", "+-", "max", "arms", "refused"),
        shown,
    )
    for row in rows:
        if row["refused"]:
            output.say(f"arm {row['arm']}, via {row['via']}: {row['refused']}")


def _pair(values: dict[str, float]) -> str:
    return f"{values['median']:.2f} / {values['worst']:.2f}"
