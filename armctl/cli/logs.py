"""Commands on files alone: no daemon needed."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from armctl import __version__
from armctl.cli.output import FILE, Output, command, kept_option
from armctl.cli.tables import show_table
from armctl.errors import ArmctlError

if TYPE_CHECKING:
    from armctl.clock import Clock
    from armctl.recording.player import Player, Wait
    from armctl.recording.replay import ReplayResult
    from armctl.recording.timeline import Timeline

LOG = click.argument("log", type=FILE)
NEW_FILE = click.option("--out", type=FILE, required=True, metavar="PATH", help="The new file.")
EVENTS_SHOWN = 6
# Between two lines where there is no terminal.
LINE_S = 1.0
KEYS_HELP = "space: pause   left, right: 5 s back, forward   + -: rate   l: loop   q: leave"


PLAYED = kept_option(
    "arm_name", "--arm", metavar="NAME|FILE", help="Which arm --onto-sim plays; the configured one if left out."
)


@command("replay", PLAYED)
@LOG
@click.option("--check", is_flag=True, help="Re-run every tick and compare bit for bit.")
@click.option("--rate", type=click.FloatRange(0.01, 1000.0), default=1.0, help="Times real time.")
@click.option("--start", "start_s", type=click.FloatRange(0.0), default=0.0, metavar="S", help="Begin here.")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--report", type=FILE, metavar="HTML", help="Write a page about LOG instead.")
@click.option("--onto-sim", is_flag=True, help="Let a simulated arm repeat the motion instead, and compare.")
@click.option("--foreign", is_flag=True, help="Take a LOG of another arm with --onto-sim.")
@click.option("--seed", default=0, help="Draws what the simulated arm is like.")
def replay_command(
    output: Output, log: Path, check: bool, report: Path | None, onto_sim: bool, foreign: bool, seed: int, **shown: Any
) -> int:
    """Watch LOG in the terminal, or re-run what the daemon did and compare it bit for bit (--check).

    Keys while watching: space pauses, left and right seek 5 s, + and - change the rate, l loops, q leaves. Where
    there is no terminal, a line a second is printed. With --json LOG is re-run and compared as with --check.

    Example: armctl replay ~/.local/share/armctl/recordings/demo-1.mcap --rate 4
    """
    if onto_sim:
        return _onto_sim(output, log, foreign, seed)
    answer: dict[str, Any] = {}
    same = True
    if check or output.json:
        result = _checked(output, log)
        same = result.mismatches == 0 and result.ticks > 0
        answer = vars(result).copy()
    if report is not None:
        from armctl.report import log as page

        page.write(_loaded(output, log), report, answer)
        answer["report"] = str(report)
        if not output.json:
            output.say(f"report: {report}")
    if not output.result(answer) and not check and report is None:
        from armctl.cli.keys import keys
        from armctl.clock import MonotonicClock

        timeline = _loaded(output, log)
        with keys(sys.stdin) as pressed:
            _watch(output, timeline, pressed.wait, MonotonicClock(), **shown)
    return 0 if same else 1


def _checked(output: Output, log: Path) -> ReplayResult:
    from armctl.recording import replay

    with output.progress("re-running", 1.0) as show:
        result = replay.check(log, progress=show)
    verdict = "bit for bit the same"
    if result.ticks == 0:
        verdict = "nothing to replay: the log holds no complete tick after a keyframe"
    elif result.mismatches:
        verdict = f"{result.mismatches} mismatches, first: {result.first_mismatch}"
        if result.version != __version__:
            verdict += f"; it was made by armctl {result.version}, this is {__version__}: check it with that one"
    if not output.json:
        output.say(
            f"{result.ticks} ticks, {result.messages} messages re-run in {result.seconds:.2f} s "
            f"({result.realtime_ratio:.0f} x real time): {verdict}"
        )
        if result.not_compared:
            names = ", ".join(result.not_compared)
            output.say(f"not compared, since the log's armctl wrote them otherwise or not at all: {names}")
    return result


def _loaded(output: Output, log: Path) -> Timeline:
    from armctl.recording import timeline

    with output.progress("reading", 1.0) as show:
        return timeline.load(log, progress=show)


def _onto_sim(output: Output, log: Path, foreign: bool, seed: int) -> int:
    from armctl.lab import rehearsal

    timeline, played = _loaded(output, log), output.arm
    with output.progress("on the simulated arm", 1.0) as show:
        result = rehearsal.rehearse(timeline, played, foreign=foreign, seed=seed, progress=show)
    told = (
        f"{result.duration_s:.1f} s on a simulated {played.arm_id}: joints within "
        f"{math.degrees(result.joint_max_rad):.2f} deg of the log (rms {math.degrees(result.joint_rms_rad):.2f}), "
        f"tool within {1e3 * result.tool_max_m:.1f} mm (mean {1e3 * result.tool_mean_m:.1f})"
    )
    if result.stretched_s > 0.05:
        told += f"\nslowed down by {result.stretched_s:.1f} s, where the log is faster than this arm may be"
    if result.clipped_rad > 0.01:
        told += f"\nkept inside the limits, up to {math.degrees(result.clipped_rad):.1f} deg from the log"
    output.answer(asdict(result), told)
    return 0


# --------------------------------------------------------------------------------------------------- watching


def _watch(
    output: Output, timeline: Timeline, wait: Wait, clock: Clock, *, rate: float, start_s: float, loop: bool
) -> None:
    from armctl.recording.player import Player, play

    if start_s > timeline.duration_s:
        raise ArmctlError(f"--start {start_s:g}: {timeline.path} lasts {timeline.duration_s:.1f} s; begin earlier")
    player = Player(timeline.duration_s, rate=rate, loop=loop, at_s=start_s)
    if output.console.is_terminal:
        with Live(console=output.console, auto_refresh=False) as live:
            play(player, lambda now: live.update(picture(timeline, now), refresh=True), wait, clock)
    else:
        play(player, lambda now: output.say(line(timeline, now.at_s)), wait, clock, LINE_S)


def picture(timeline: Timeline, player: Player) -> RenderableType:
    """One frame for a terminal: joints, tool, state, fault, and what happened last."""
    i = timeline.index(player.at_s)
    joints = Table(box=None, pad_edge=False)
    joints.add_column("joint", overflow="fold")
    for column in ("deg", "goal", "deg/s", "load %", "V", "degC", "torque"):
        joints.add_column(column, justify="right", no_wrap=True, overflow="fold")
    for j, name in enumerate(timeline.arm.joint_names):
        joints.add_row(
            name,
            _number(math.degrees(timeline.position_rad[i, j]), 1),
            _number(math.degrees(timeline.goal_rad[i, j]), 1),
            _number(math.degrees(timeline.velocity_rad_s[i, j]), 0),
            _number(timeline.load_ratio[i, j] * 100.0, 0),
            _number(timeline.voltage_V[i, j], 1),
            _number(timeline.temperature_degC[i, j], 0),
            "on" if timeline.torque_enabled[i, j] else "off",
        )
    fault = timeline.fault(i)
    now_ns = timeline.start_ns + round(player.at_s * 1e9)
    happened = [event for event in timeline.happenings if event.time_ns <= now_ns][-EVENTS_SHOWN:]
    mode = "paused" if player.paused else f"{player.rate:g} x"
    return Group(
        Text(f"{timeline.arm.arm_id}: {timeline.state(i)}", style="bold red" if fault else "bold"),
        joints,
        Text(f"tool at {_tool(timeline, i)}"),
        *([Text(fault, style="red")] if fault else []),
        *(Text(f"{(event.time_ns - timeline.start_ns) / 1e9:8.1f} s  {event.text}", style="dim") for event in happened),
        ProgressBar(total=max(timeline.duration_s, 1e-9), completed=player.at_s, width=60),
        Text(f"{player.at_s:.1f} of {timeline.duration_s:.1f} s   {mode}{'   loop' if player.loop else ''}"),
        Text(KEYS_HELP, style="dim"),
    )


def line(timeline: Timeline, at_s: float) -> str:
    """One frame as a line of text."""
    i = timeline.index(at_s)
    angles = " ".join(f"{_number(math.degrees(q), 1):>7}" for q in timeline.position_rad[i].tolist())
    fault = f"  {timeline.fault(i)}" if timeline.fault(i) else ""
    return f"{at_s:8.1f} s  {timeline.state(i):<10} {angles} deg  tool {_tool(timeline, i)}{fault}"


def _tool(timeline: Timeline, i: int) -> str:
    return ", ".join(_number(value * 1000.0, 1) for value in timeline.tool[i, :3].tolist()) + " mm"


def _number(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"


# ------------------------------------------------------------------------------------------------------- files


@click.group("log")
def log_command() -> None:
    """Read, cut, join, convert and repair MCAP logs.

    Example: armctl log info armctl-20250615T120000Z.mcap
    """


# What `log info` tells.
INFO = ("messages", "start_s", "duration_s", "topics", "complete")


@command("info", group=log_command)
@LOG
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
    if not found.complete:
        output.say(f"The file was not closed properly; its intact part is shown. Repair it: armctl log recover {log}")


def show_topics(output: Output, topics: Mapping[str, int]) -> None:
    rows = [(topic, str(count)) for topic, count in sorted(topics.items())]
    show_table(output.console, "", ("topic", "messages"), rows, words=("topic",))


@command("recover", group=log_command)
@LOG
def recover(output: Output, log: Path) -> None:
    """Write every intact message of a truncated LOG into a finished file beside it.

    Example: armctl log recover armctl-20250615T120000Z.mcap.part
    """
    from armctl.recording import recover as recovery

    result = recovery.recover(log)
    output.answer(
        asdict(result) | {"path": str(result.path)},
        f"{result.recovered_messages} messages recovered into {result.path}\n"
        f"lost: {result.lost_s:.1f} s, and what was not yet written (at most 1 s)",
    )


@command("export", group=log_command)
@LOG
@click.option("--format", "kind", type=click.Choice(["csv", "xlsx", "parquet"]), required=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="PATH", help="The new file.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC", help="Only the messages of TOPIC; repeatable.")
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
@LOG
@click.option("--from", "begin_s", type=float, default=0.0, help="Seconds since the beginning.")
@click.option("--to", "end_s", type=float, help="Seconds since the beginning; the end if left out.")
@NEW_FILE
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
@click.argument("logs", type=FILE, nargs=-1, required=True)
@NEW_FILE
def merge(output: Output, logs: tuple[Path, ...], out: Path) -> None:
    """Write consecutive LOGS of one daemon as one file; the order in which they are named does not matter.

    Example: armctl log merge armctl-20250615T12*.mcap --out noon.mcap
    """
    from armctl.recording import edit

    with output.progress("merging", 1.0) as show:
        result = edit.merge(logs, out, show)
    _edited(output, result)


def _edited(output: Output, result: Any) -> None:
    answer = asdict(result) | {"path": str(result.path)}
    output.answer(answer, f"{result.messages} messages, {result.duration_s:.1f} s: {result.path}")
    if result.damaged:
        output.warn(f"{result.damaged} damaged places were left out")
