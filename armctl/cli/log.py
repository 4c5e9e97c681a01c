"""Commands on logs: a folder of them, and one file. No daemon is needed."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from os.path import basename
from pathlib import Path
from typing import Any

import click

from armctl.cli.output import CONFIG, Output, command
from armctl.cli.tables import show_rows
from armctl.files import logs_dir
from armctl.recording import search
from armctl.recording.index import Index

Row = dict[str, Any]
Ask = Callable[[Index], list[Row]]


@click.group("log")
def log_command() -> None:
    """Find, compare, read, cut, join, convert and repair MCAP logs.

    Example: armctl log find code:TRIPPED
    """


# ------------------------------------------------------------------------------------------------ a folder of them


def _answer(
    output: Output, folder: Path | None, key: str, table: str, ask: Ask, shown: Callable[[Row], Row] = dict
) -> None:
    """What is asked of the index of a folder, brought up to date; None: the folder of the daemon."""
    with Index(folder or logs_dir(output.config_file)) as index:
        index.catch_up()
        if index.unread:
            output.warn(f"{index.unread} older logs are still being read, and missing here; ask again in a minute")
        rows = ask(index)
    output.answer({key: rows, "unread": index.unread}, lambda: show_rows(output.console, table, "", map(shown, rows)))


@command("list", CONFIG, group=log_command)
def log_list(output: Output, log_dir: Path | None) -> None:
    """List every log: when it began, of which arm, which faults came up in it.

    Example: armctl log list
    """

    def shown(row: Row) -> Row:
        return row | {"name": basename(row["path"]), "told": " ".join(_told(row))}

    _answer(output, log_dir, "logs", "logs", search.listing, shown)


def _told(row: Mapping[str, Any]) -> list[str]:
    """What is to be known of a log in a list: what it suffered, what people noted, and what is wrong with the file."""
    wrong = row["problem"].removeprefix(f"{row['path']}: ") or ("" if row["complete"] else "(not ended, or damaged)")
    return [*row["faults"], *row["notes"], *([wrong] if wrong else [])]


@command("find", CONFIG, group=log_command)
def log_find(output: Output, expression: tuple[str, ...], log_dir: Path | None) -> None:
    """Find what happened, in all logs: every word of EXPRESSION has to fit.

    code:HOT  servo:3  level:error  arm:ID  log:GLOB  after:2025-06-01  before:2025-06-15T12:00  or any part of a text;
    by the minute: load>0.8  temperature>60  voltage<10  error>3 (degrees from the goal).

    Example: armctl log find code:TRIPPED servo:3 after:2025-06-01
    """

    def shown(row: Row) -> Row:
        return row | {"name": basename(row["log"]), "time": f"{row['time']:.19}"}

    _answer(output, log_dir, "events", "events", partial(search.find, expression=" ".join(expression)), shown)


@command("stats", CONFIG, group=log_command)
def log_stats(output: Output, period: str, log_dir: Path | None) -> None:
    """Tell what every joint went through, week by week: is a servo wearing out?

    Example: armctl log stats --by month
    """
    _answer(output, log_dir, "rows", "stats", partial(search.stats, period=period))


@command("diff", group=log_command)
def log_diff(output: Output, a: Path, b: Path, report: Path | None) -> None:
    """Compare two logs, quantity by quantity.

    Example: armctl log diff line-1.mcap line-2.mcap --report line.html
    """
    from armctl.recording import entry

    rows = entry.diff(a, b)
    if report is not None:
        from armctl.recording.timeline import load
        from armctl.report import log as page

        page.write(report, load(a), load(b), rows=rows)
    shown = [{key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows]
    answer = {"rows": rows} | ({"report": str(report)} if report else {})
    output.answer(answer, lambda: show_rows(output.console, "diff", "", shown))


@command("note", group=log_command)
def log_note(output: Output, log: Path, text: str) -> None:
    """Keep a note about LOG; `log list` shows it, and `log find` finds it.

    Example: armctl log note armctl-20250615T120000Z-000012.mcap "new gripper"
    """
    from armctl.recording.notes import add_note

    add_note(log, text)
    output.answer({"log": str(log), "text": text}, f"noted: {log.name}: {text}")


# ------------------------------------------------------------------------------------------------------- files


# What `log info` tells.
INFO = ("messages", "start_s", "duration_s", "topics", "complete", "summary_ok")


@command("info", group=log_command)
def info(output: Output, log: Path) -> None:
    """Tell what LOG holds: messages, duration, topics, whether it was closed properly.

    Example: armctl log info armctl-20250615T120000Z.mcap
    """
    from armctl.recording import reader

    found = reader.info(log)
    if output.result({key: getattr(found, key) for key in INFO}):
        return
    output.say(f"{found.messages} messages in {found.duration_s:.1f} s")
    show_topics(output, found.topics)
    damaged = "Its summary is damaged, and some readers will refuse it"
    trouble = damaged if found.complete else "The file was not closed properly; its intact part is shown"
    if not (found.complete and found.summary_ok):
        output.say(f"{trouble}. Repair it: armctl log recover {log}")


def show_topics(output: Output, topics: Mapping[str, int]) -> None:
    rows = [{"topic": topic, "messages": count} for topic, count in sorted(topics.items())]
    show_rows(output.console, "topics", "", rows)


@command("recover", group=log_command)
def recover(output: Output, log: Path) -> None:
    """Write every intact message of a truncated LOG into a finished file beside it.

    Example: armctl log recover armctl-20250615T120000Z.mcap.part
    """
    from armctl.recording import recover as recovery

    result = recovery.recover(log)
    output.answer(result._asdict() | {"path": str(result.path)})


@command("export", group=log_command)
def export(output: Output, log: Path, kind: Any, out: Path, topics: tuple[str, ...]) -> None:
    """Write LOG as a table: one row for each tick, units in the column names.

    Without --topic there is a column for everything about every joint, and for the tool. An Excel file also has the
    joint angles in degrees on a sheet of their own. With several --topic, csv and parquet make a folder PATH.

    Example: armctl log export demo-1.mcap --format xlsx --out demo-1.xlsx
    """
    from armctl.recording import export as exporting

    with output.progress("exporting", 1.0) as show:
        result = exporting.export(log, out, kind, topics, show)
    answer = {"paths": [str(path) for path in result.paths], "rows": result.rows, "complete": result.complete}
    told = [f"{table}: {rows} rows" for table, rows in result.rows.items()]
    output.answer(answer, "\n".join([*told, f"written: {', '.join(map(str, result.paths))}"]))
    if not result.complete:
        output.warn(f"{log} was not closed properly, or is damaged; its intact part was exported")


@command("trim", group=log_command)
def trim(output: Output, log: Path, begin_s: float, end_s: float | None, out: Path) -> None:
    """Write a part of LOG as a log of its own, which opens and replays alone.

    Example: armctl log trim armctl-20250615T120000Z.mcap --from 60 --to 75 --out lift.mcap
    """
    from armctl.recording import edit

    with output.progress("trimming", 1.0) as show:
        result = edit.trim(log, out, begin_s, math.inf if end_s is None else end_s, show)
    _edited(output, result)
    if result.begins_with_state is False:
        output.warn("no state is known where it begins; a replay starts at the first keyframe in it")


@command("merge", group=log_command)
def merge(output: Output, logs: tuple[Path, ...], out: Path) -> None:
    """Write consecutive LOGS of one daemon as one file; the order in which they are named does not matter.

    The daemon may have been started anew between two of them: the gap is told, and marked in the file.

    Example: armctl log merge armctl-20250615T12*.mcap --out noon.mcap
    """
    from armctl.recording import edit

    with output.progress("merging", 1.0) as show:
        result = edit.merge(logs, out, show)
    for gap in result.gaps:
        output.warn("nothing was recorded from {from_s:.3f} s to {to_s:.3f} s".format(**gap))
    _edited(output, result)


def _edited(output: Output, result: Any) -> None:
    output.answer(asdict(result) | {"path": str(result.path)})
    if result.damaged:
        output.warn(f"{result.damaged} damaged places were left out")
