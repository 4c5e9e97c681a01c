"""`armctl demo`."""

import os
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
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
    """The whole job on simulated servos, in three to four minutes.

    A simulated hand teaches five candidates, the genetic algorithm straightens them, the daemon runs the result through
    0, 1 and 2 intermediate points: plain, then corrected by what these runs showed of the arm, then refined by a
    further run. Every log is replayed bit for bit, and a report is written.

    Example: armctl demo --out demo
    """
    from armctl.lab import demo

    with _ending_all():
        result = demo.run(out.absolute(), seed, output.progress)
    output.answer(result, lambda: show(output, result))
    return 0 if result["replay"]["mismatches"] == 0 else 1


@contextmanager
def _ending_all() -> Iterator[None]:
    """Told to end, or its terminal closed, this program ends the others first, which have sessions of their own."""
    from armctl.host.service_manager import endings

    def leave(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, leave) for number in endings() if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def show(output: Output, result: dict[str, Any]) -> None:
    from armctl.report.line import PRINTED

    runs = [("corrected" if row["corrected"] else "plain", row) for row in result["rows"]]
    runs += [("refined", row) for row in result["refined"]]
    rows = [{**row, "goals": goals, "paper": PRINTED[row["via"]]} for goals, row in runs]
    show_rows(output.console, "demo", "Distance of the tool from the line, mean / maximum, mm", rows)
    best_take_mm = min(take["mean_error_mm"] for take in result["baseline"])
    replayed = result["replay"]
    ours, papers = (_seconds(durations_s) for durations_s in zip(*map(_durations_s, rows), strict=True))
    output.say(
        f"""\
The motions take {ours}, the paper's {papers}.
Plain: goals are the plan's own positions.
Corrected: goals lead them by how the arm lagged before.
Refined: one run more, its plan corrected by what the first one showed.
Predicted: perfect servos. Encoders: what the servos measured, as in the paper.
True: the tool's real place. Own line: held against its own best line.
Genetic algorithm: {result["ga"]["mean_error_mm"]:.2f} mm mean, the best take {best_take_mm:.2f} mm;
    {result["gap_ratio"]:.2%} above the exact optimum of the same genes.
Replay: {replayed["ticks"]} ticks, {replayed["messages"]} messages, {replayed["mismatches"]} mismatches.
Report: {_short(result["report"])}"""
    )


def _durations_s(row: dict[str, Any]) -> tuple[float, float]:
    return row["duration_s"], row["paper"].duration_s


def _seconds(durations_s: Iterable[float]) -> str:
    """Each duration once, in order."""
    return ", ".join(dict.fromkeys(f"{duration_s:.1f}" for duration_s in durations_s)) + " s"


def _short(path: str) -> str:
    """A path as it is typed from here, where that is shorter."""
    return min(path, os.path.relpath(path), key=len)
