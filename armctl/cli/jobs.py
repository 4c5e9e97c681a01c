"""From hand to line: teach, recordings, optimize, run."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from armctl.cli.arm import COUNTDOWN, count_down
from armctl.cli.keys import keys
from armctl.cli.output import HOLDS, POINT, Output, config_option, output_option, socket_option
from armctl.cli.tables import show_table
from armctl.errors import ConfigError, LogError, NoDaemon, RequestRefused

if TYPE_CHECKING:
    from armctl.client import Client
    from armctl.genetic.request import OptimizeRequest

Point = tuple[float, float, float]

AT_START_M = 0.04
"""How near its start a take begins."""
MOVED_M = 0.03
"""How far the tool goes before a rest can end a take."""
STILL_M = 0.004
"""Largest change of the tool's place that still counts as rest."""
SETTLE_S = 0.5
REST_S = 1.0
ENTER = frozenset("\r\n")


@click.command("teach")
@click.argument("name")
@click.option("--takes", type=click.IntRange(1, 100), default=1, show_default=True, help="How many to record.")
@click.option("--from", "from_m", type=POINT, help="Start of the wanted line, metres: shows each take's error.")
@click.option("--to", "to_m", type=POINT, help="End of the wanted line, metres.")
@COUNTDOWN
@socket_option
@output_option
def teach_command(
    output: Output,
    name: str,
    takes: int,
    from_m: Point | None,
    to_m: Point | None,
    countdown: int,
    socket: str | None,
) -> None:
    """Make the arm limp, and record while you guide it by hand. Ctrl-C ends it; the arm stays limp.

    Carry the tool to the start and rest it there for half a second (or press Enter): the take begins. Guide it along
    the line; it ends when the tool rests for a second (or on Enter). Rest it for half a second on the way, or press any
    other key, to mark a via point. Every further take begins where the first did. Takes are named NAME, or NAME-1,
    NAME-2, ... and never overwrite one another.

    Example: armctl teach line --takes 5 --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10
    """
    from armctl.client import Client

    if (from_m is None) != (to_m is None):
        raise ConfigError("armctl teach", "--from/--to", "one end of the line is missing", "give both or neither")
    names = [name] if takes == 1 else [f"{name}-{take}" for take in range(1, takes + 1)]
    made = []
    with Client(socket) as commander, Client(socket) as watcher, keys(sys.stdin) as pressed:
        taken = {recording["name"] for recording in commander.call("recordings_list")["recordings"]} & set(names)
        if taken:
            raise LogError(f"recording {sorted(taken)[0]} exists; choose another name, or delete it")
        if any(joint["torque_enabled"] for joint in commander.call("status")["joints"]):
            count_down(output, countdown)
        output.after_interrupt = "the arm stays limp, so support it; takes that were begun are kept; `armctl torque on`"
        commander.call("teach_begin")
        output.say("the arm is limp; support it")
        tool = _Tool(output, watcher, partial(pressed.wait, 0.0))
        start = from_m
        try:
            for take in names:
                place = "start" if start is None else "start at " + ", ".join(f"{x:.3f}" for x in start)
                output.say(f"{take}: carry the tool to the {place} and rest it there (or press Enter)")
                start = tool.settle(start)
                commander.call("take_begin", name=take)
                output.say(f"{take}: recording; guide it along the line and rest it at the end (or press Enter)")
                marks: list[dict[str, Any]] = []
                end = tool.guided(start, partial(_mark, commander, marks))
                commander.call("take_end")
                line: dict[str, Any] = {} if from_m is None else {"from_m": from_m, "to_m": to_m}
                shown = commander.call("recordings_show", name=take, **line)
                # Whoever rests at the end has dwelt there first.
                shown["marks"] = [one for one in marks if math.dist(one["position_m"], end) > AT_START_M]
                made.append(shown)
                output.say(_described(made[-1]))
        finally:
            commander.call("teach_end")
    output.result({"recordings": made})


def _mark(commander: Client, marks: list[dict[str, Any]]) -> None:
    marks.append(commander.call("take_mark"))


class _Tool:
    """The tool's place as the daemon sees it, followed tick by tick.

    Args:
        key: What was pressed since it was last asked, one character; empty: nothing.
    """

    def __init__(self, output: Output, watcher: Client, key: Callable[[], str]) -> None:
        self._output, self._key = output, key
        self._snapshots = watcher.subscribe()
        self._recent: deque[Point] = deque(maxlen=100)
        self._warned = False

    def settle(self, start: Point | None) -> Point:
        """Wait until the tool rests near `start` (anywhere if None), or for Enter; returns where it is."""
        moved = start is not None
        self._recent.clear()
        while True:
            place, period_s, key = self._next()
            moved = moved or math.dist(place, self._recent[0]) > MOVED_M
            near = start is None or math.dist(place, start) <= AT_START_M
            if key in ENTER or (moved and near and self._rests(SETTLE_S, period_s)):
                return place

    def guided(self, start: Point, mark: Callable[[], None]) -> Point:
        """Wait until the tool has gone along and rests again, or for Enter; returns where it is.

        Args:
            mark: Called where the tool dwells on its way, or a key other than Enter is pressed.
        """
        moved = False
        last = start
        self._recent.clear()
        while True:
            place, period_s, key = self._next()
            moved = moved or math.dist(place, start) > AT_START_M + MOVED_M
            if key in ENTER or (moved and self._rests(REST_S, period_s)):
                return place
            dwells = math.dist(place, last) > AT_START_M and self._rests(SETTLE_S, period_s)
            if key or dwells:
                last = place
                mark()

    def _rests(self, seconds: float, period_s: float) -> bool:
        count = round(seconds / period_s)
        recent = list(self._recent)[-count:]
        return len(recent) == count and all(math.dist(place, recent[-1]) < STILL_M for place in recent)

    def _next(self) -> tuple[Point, float, str]:
        """The tool's place after the next tick, the tick's length, and the key that was pressed."""
        snapshot = next(self._snapshots)
        if snapshot["state"] != "teaching":
            fault = snapshot["fault"]
            why = f"{fault['code']}: {fault['text']}" if fault else f"the arm is {snapshot['state']}"
            raise RequestRefused("TEACH_ENDED", f"teaching ended: {why}; finished takes are kept")
        x, y, z = snapshot["tool"]["position_m"]
        speed_m_s = snapshot["tool"]["speed_m_s"] or 0.0
        limit_m_s = snapshot["tool_speed_limit_m_s"]
        if speed_m_s > limit_m_s and not self._warned:
            self._warned = True
            speed, limit = (f"{1000.0 * value:.0f}" for value in (speed_m_s, limit_m_s))
            self._output.say(f"the tool moves at {speed} mm/s; slower than {limit} is safer and smoother")
        self._recent.append((x, y, z))
        return (x, y, z), float(snapshot["period_s"]), self._key()


def _described(recording: dict[str, Any]) -> str:
    text = f"{recording['name']}: {recording['duration_s']:.1f} s, {recording['samples']} samples"
    if recording["mean_error_mm"] is None:
        return f"{text}, the tool never left its place"
    return (
        f"{text}, {recording['mean_error_mm']:.1f} mm mean and {recording['max_error_mm']:.1f} mm at most off the line"
    )


@click.group("recordings", invoke_without_command=True)
@socket_option
@output_option
@click.pass_context
def recordings_command(ctx: click.Context, output: Output, socket: str | None) -> None:
    """The recorded candidates.

    Example: armctl recordings
    """
    if ctx.invoked_subcommand is None:
        _list(output, socket)


def _list(output: Output, socket: str | None) -> None:
    from armctl.client import Client

    with Client(socket) as client:
        found = client.call("recordings_list")
    if output.result(found):
        return
    if found["recordings"]:
        show_recordings(output, found["recordings"])
    elif "unreadable" not in found:
        output.say("no recordings; make some with `armctl teach NAME`")
    for entry in found.get("unreadable", ()):
        output.say(f"not shown: {entry['problem']}")


def show_recordings(output: Output, recordings: Sequence[dict[str, Any]]) -> None:
    rows = [
        (
            one["name"],
            f"{one['duration_s']:.1f}",
            str(one["samples"]),
            *("-" if one[key] is None else f"{one[key]:.1f}" for key in ("mean_error_mm", "max_error_mm")),
        )
        for one in recordings
    ]
    title = "Recordings; how far off the line the tool was, mm"
    show_table(output.console, title, ("name", "s", "samples", "mean", "maximum"), rows, words=("name",))


@recordings_command.command("list")
@socket_option
@output_option
def recordings_list(output: Output, socket: str | None) -> None:
    """Every recording; errors are against the line from its first to its last tool point.

    Example: armctl recordings list
    """
    _list(output, socket)


@recordings_command.command("show")
@click.argument("name")
@socket_option
@output_option
def recordings_show(output: Output, name: str, socket: str | None) -> None:
    """One recording.

    Example: armctl recordings show line-1
    """
    from armctl.client import Client

    with Client(socket) as client:
        found = client.call("recordings_show", name=name)
    if not output.result({"recordings": [found]}):
        output.say(_described(found))
        output.say(found["path"])


@recordings_command.command("rename")
@click.argument("name")
@click.argument("to")
@socket_option
@output_option
def recordings_rename(output: Output, name: str, to: str, socket: str | None) -> None:
    """Give a recording another name, never one that is taken.

    Example: armctl recordings rename line-1 line-good
    """
    from armctl.client import Client

    with Client(socket) as client:
        renamed = client.call("recordings_rename", name=name, to=to)
    if not output.result({"recordings": [renamed]}):
        output.say(renamed["path"])


@recordings_command.command("delete")
@click.argument("name")
@socket_option
@output_option
def recordings_delete(output: Output, name: str, socket: str | None) -> None:
    """Delete a recording.

    Example: armctl recordings delete line-1
    """
    from armctl.client import Client

    with Client(socket) as client:
        deleted = client.call("recordings_delete", name=name)
    if not output.result({"recordings": [deleted]}):
        output.say(f"{name} deleted")


@click.command("optimize")
@click.argument("recordings", nargs=-1, required=True)
@click.option("--from", "from_m", type=POINT, required=True, help="Start of the line, metres.")
@click.option("--to", "to_m", type=POINT, required=True, help="End of the line, metres.")
@click.option("--via", type=click.IntRange(0, 20), default=2, show_default=True, help="Intermediate points.")
@click.option("--duration", "duration_s", type=click.FloatRange(0.5, 600.0), default=5.0, show_default=True)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option(
    "--profile",
    type=click.Choice(("default", "paper")),
    default="default",
    show_default=True,
    help="paper: the published operators, recorded genes alone.",
)
@click.option(
    "--objective",
    type=click.Choice(("mean", "mix", "max")),
    default="mean",
    show_default=True,
    help="What is made small: the mean distance, its root mean square, or the largest.",
)
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), help="The plan file.  [default: plan-viaN.json]"
)
@socket_option
@config_option
@output_option
def optimize_command(
    output: Output,
    recordings: tuple[str, ...],
    via: int,
    profile: Literal["default", "paper"],
    out: Path | None,
    socket: str | None,
    config_file: str | None,
    **line: Any,
) -> None:
    """Straighten RECORDINGS (names, or files) by a genetic algorithm and choose the intermediate points.

    Works in a process of the daemon's; without a daemon, in this one. Ctrl-C ends it and writes nothing.

    Example: armctl optimize line-1 line-2 line-3 --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --via 2
    """
    from armctl.client import Client
    from armctl.config import validate
    from armctl.genetic.algorithm import PROFILES
    from armctl.genetic.request import OptimizeRequest

    out = out or Path(f"plan-via{via}.json")
    if out.exists():
        raise LogError(f"{out} exists; choose another name with --out, or delete it")
    how = {"via": (via,), "settings": PROFILES[profile], "free": profile == "default"}
    request = validate(OptimizeRequest, {**line, **how}, "optimize")
    output.after_interrupt = "the optimisation has ended, and no plan was written; the arm was not moved"
    with output.progress("optimising", PROFILES[profile].generations) as show:
        try:
            if any("/" in recording for recording in recordings):
                raise NoDaemon  # files by path need no daemon
            with Client(socket) as client:
                result = client.call(
                    "optimize",
                    recordings=recordings,
                    on_progress=lambda p: show(p["generation"] + 1, f"{p['best']:.3f} mm"),
                    **request.model_dump(),
                )
        except NoDaemon:
            result = _optimize_here(
                recordings, config_file, request, lambda g, best, _mean: show(g + 1, f"{best:.3f} mm")
            )
    (plan,) = result["plans"]
    try:
        out.write_text(plan["text"], encoding="utf-8")
    except OSError as error:
        raise LogError(f"{out}: cannot write the plan: {error.strerror}") from None
    plan = {"path": str(out)} | {key: value for key, value in plan.items() if key != "text"}
    if output.result({**{key: result[key] for key in ("baseline", "ga", "exact", "gap_ratio", "free")}, "plan": plan}):
        return
    show_optimum(output, result, plan)
    output.say(f"run it with: armctl run {out}")


def show_optimum(output: Output, result: dict[str, Any], plan: dict[str, Any]) -> None:
    rows = [
        (str(one["name"]), f"{one['mean_error_mm']:.2f}", f"{one['max_error_mm']:.2f}") for one in result["baseline"]
    ]
    rows.append(("genetic algorithm", f"{result['ga']['mean_error_mm']:.2f}", ""))
    rows.append((f"exact optimum, gap {result['gap_ratio']:.2%}", f"{result['exact']['mean_error_mm']:.2f}", ""))
    if result["free"]:
        rows.append(("genes set free", f"{result['free']['mean_error_mm']:.2f}", ""))
    mean, worst = (f"{plan[f'predicted_{kind}_error_mm']:.2f}" for kind in ("mean", "max"))
    rows.append((f"plan with {plan['via']} via points, on perfect servos", mean, worst))
    title = "Distance from the line, mm"
    show_table(output.console, title, ("path", "mean", "maximum"), rows, words=("path",))


def _optimize_here(
    recordings: tuple[str, ...], config_file: str | None, request: OptimizeRequest, progress: Any
) -> dict[str, Any]:
    from armctl.files import data_dir, load_arm, load_config
    from armctl.host.jobs import OptimizeJob, optimize_task

    config = load_config(config_file)
    folder = data_dir(config) / "recordings"
    paths = tuple(Path(name) if "/" in name else folder / f"{name}.mcap" for name in recordings)
    return optimize_task(OptimizeJob(load_arm(config.arm), paths, request), progress)


@click.command("run")
@click.argument("plan", type=click.Path(dir_okay=False, path_type=Path))
@socket_option
@output_option
def run_command(output: Output, plan: Path, socket: str | None) -> None:
    """Pre-flight PLAN, approach its start slowly, run it, record it and compare with the prediction.

    Ctrl-C stops the arm: it slows down on its path and holds.

    Example: armctl run plan-via2.json
    """
    from armctl.client import Client
    from armctl.files import read_text
    from armctl.trajectory.plan import plan_from_text

    parsed = plan_from_text(read_text(plan, "plan"), str(plan))
    with Client(socket) as client:
        output.after_interrupt = f"{HOLDS}, and what was recorded is kept"
        output.say("running; Ctrl-C stops the arm")
        result = client.call("run", plan=parsed.model_dump())
    if not output.result(result):
        output.say(
            f"{result['recording']}: {result['mean_error_mm']:.1f} mm mean and {result['max_error_mm']:.1f} mm at most "
            f"off the line in {result['duration_s']:.1f} s (by the encoders; predicted on perfect servos: "
            f"{result['predicted_mean_error_mm']:.1f} and {result['predicted_max_error_mm']:.1f})"
        )
