"""From hand to line: recordings, optimize, run, play. `teach` makes the recordings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.output import CONFIG, JSON, RECORDED, SOCKET, Output, command, off
from armctl.cli.tables import show_rows, show_table
from armctl.errors import ConfigError, LogError, NoDaemon
from armctl.files import data_dir, is_file, read_text

if TYPE_CHECKING:
    from armctl.genetic.request import OptimizeRequest
    from armctl.trajectory.playback import TaughtMotion

# Of a motion that is sent to the daemon: its socket takes 64 KiB a line.
MOST_NUMBERS = 6000


OWN_LINE = "the straight line between its own ends"
WANTED = "the wanted line"


def in_words(recording: dict[str, Any], line: str = OWN_LINE) -> str:
    """A recording in one line, which says off which line the tool was."""
    error = "the tool never left its place" if (recording["mean_error_mm"] is None) else off(recording, line)
    return f"{recording['name']}: {recording['duration_s']:.1f} s, {recording['samples']} samples, {error}"


@click.group("recordings", invoke_without_command=True)
@click.pass_context
def recordings_command(ctx: click.Context) -> None:
    """The recorded candidates.

    Example: armctl recordings
    """
    if ctx.invoked_subcommand is None:
        ctx.invoke(recordings_list)


recordings_command.params += [SOCKET, JSON]


@command("list", SOCKET, group=recordings_command)
def recordings_list(output: Output) -> None:
    """Every recording; errors are against the line from its first to its last tool point.

    Example: armctl recordings list
    """
    found = output.ask("recordings_list")
    output.answer(found, partial(show_list, output, found))


def show_list(output: Output, found: dict[str, Any]) -> None:
    unreadable = found.get("unreadable", ())
    if found["recordings"]:
        title = f"Recordings; how far the tool was off {OWN_LINE}, mm"
        show_rows(output.console, "recordings", title, found["recordings"])
    elif not unreadable:
        output.say("no recordings; make some with `armctl teach NAME`")
    for entry in unreadable:
        output.say(f"not shown: {entry['problem']}")


def _on_recording(output: Output, method: str, words: Callable[[dict[str, Any]], str], **params: Any) -> None:
    """One request about a recording, and what the daemon says of it."""
    recording = output.ask(f"recordings_{method}", **params)
    output.answer({"recordings": [recording]}, words(recording))


@command("show", SOCKET, group=recordings_command)
def recordings_show(output: Output, name: str) -> None:
    """One recording.

    Example: armctl recordings show line-1
    """
    _on_recording(output, "show", lambda found: f"{in_words(found)}\n{found['path']}", name=name)


@command("rename", SOCKET, group=recordings_command)
def recordings_rename(output: Output, name: str, to: str) -> None:
    """Rename a recording; a name that is taken is refused.

    Example: armctl recordings rename line-1 line-good
    """
    _on_recording(output, "rename", lambda renamed: str(renamed["path"]), name=name, to=to)


@command("delete", SOCKET, group=recordings_command)
def recordings_delete(output: Output, name: str) -> None:
    """Delete a recording.

    Example: armctl recordings delete line-1
    """
    _on_recording(output, "delete", lambda _: f"{name} deleted", name=name)


@command("optimize", SOCKET, CONFIG)
def optimize_command(
    output: Output, recordings: tuple[str, ...], via: int, profile: str, out: Path | None, **line: Any
) -> None:
    """Straighten RECORDINGS (names, or files) by a genetic algorithm and choose the intermediate points.

    A process of the daemon does the work; without a daemon, this command does it. Ctrl-C ends it and writes nothing.

    Example: armctl optimize line-1 line-2 line-3 --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --via 2
    """
    from armctl.config import validate
    from armctl.genetic.algorithm import PROFILES
    from armctl.genetic.request import OptimizeRequest
    from armctl.recording.disk import put

    out = out or Path(f"plan-via{via}.json")
    if out.exists():
        raise LogError(f"{out} exists; choose another name with --out, or delete it")
    how = {"via": (via,), "settings": PROFILES[profile], "free": profile == "default"}
    request = validate(OptimizeRequest, {**line, **how}, "optimize")
    put(out, "")  # a file that cannot be written is told before the work
    out.unlink()
    output.after_interrupt = "the optimisation has ended, and no plan was written; the arm was not moved"
    with output.progress("optimising", PROFILES[profile].generations) as show:

        def tell(told: dict[str, Any]) -> None:
            show(told["generation"] + 1, f"{told['best']:.3f} mm")

        try:
            if any(map(is_file, recordings)):
                raise NoDaemon  # files need no daemon
            with output.client() as client:
                result = client.call("optimize", on_progress=tell, recordings=recordings, **request.model_dump())
        except NoDaemon:
            result = _optimize_here(output, recordings, request, lambda g, best, _mean: show(g + 1, f"{best:.3f} mm"))
    (plan,) = result["plans"]
    put(out, plan["text"])
    plan = {"path": str(out)} | {key: value for key, value in plan.items() if key != "text"}
    answer = {key: result[key] for key in ("baseline", "best_take_mm", "ga", "exact", "gap_ratio", "free")}
    output.answer({**answer, "plan": plan}, partial(show_optimum, output, result, plan))


def show_optimum(output: Output, result: dict[str, Any], plan: dict[str, Any]) -> None:
    def row(path: str, of: dict[str, Any], kind: str = "") -> tuple[str, ...]:
        return path, f"{of[f'{kind}mean_error_mm']:.2f}", f"{of[f'{kind}max_error_mm']:.2f}"

    found = {
        "genetic algorithm": result["ga"],
        f"exact optimum, gap {result['gap_ratio']:.2%}": result["exact"],
        "genes set free": result["free"],
    }
    whose = "this arm's" if plan["sag_model"] else "a new arm's"
    rows = [
        *(row(take["name"], take) for take in result["baseline"]),
        *((*row(path, error)[:2], "") for path, error in found.items() if error),
        row(f"plan with {plan['via']} via points, on perfect servos", plan, "predicted_"),
        row(f"to be expected, by {whose} model of the sag", plan, "expected_"),
    ]
    title = f"Distance from {WANTED}, at places of equal progress, mm"
    show_table(output.console, title, ("path", "mean", "maximum"), rows, words=("path",))


def _optimize_here(output: Output, recordings: tuple[str, ...], request: OptimizeRequest, show: Any) -> dict[str, Any]:
    from armctl.commissioning import sag_file
    from armctl.host.jobs import OptimizeJob, optimize_task
    from armctl.recording.recordings import path_of

    arm = output.arm
    paths = tuple(path_of(data_dir(output.config) / "recordings", name) for name in recordings)
    return optimize_task(OptimizeJob(arm, paths, request, sag_file.load(output.config, arm)), show)


@command("run", SOCKET)
def run_command(output: Output, plan: Path, refine: int) -> int:
    """Pre-flight PLAN, approach its start slowly, run it, record it and compare with the prediction.

    With --refine its points are moved by what the encoders showed, and it is run again. A corrected plan is kept only
    if it is better by more than the noise of the readings. Ctrl-C stops the arm: it slows down on its path and holds.
    Exit status 1 if something ended the refinement before its time; what was reached is kept.

    Example: armctl run plan-via2.json --refine 3
    """
    from armctl.trajectory.plan import plan_from_text

    if plan.suffix in (".yaml", ".yml"):
        raise ConfigError(str(plan), "", "a plan is JSON; this looks like a program", f"`armctl program run {plan}`")
    wanted = plan_from_text(read_text(plan, "plan"), str(plan)).model_dump()
    return refined(output, "running", "run", {"plan": wanted, "refine": refine}, WANTED)


def refined(output: Output, doing: str, what: str, asked: dict[str, Any], wanted: str) -> int:
    """Do something that the daemon may refine, and show every round; the exit status.

    Args:
        wanted: Where the tool was to be, in words.
    """

    def tell(told: dict[str, Any]) -> None:
        if "warning" in told:
            output.warned(told)
        else:
            output.warn(f"after {told['runs']} of at most {told['of']} runs, {_in_words(told['round'], wanted)}")

    result = output.carry_out(doing, what, asked, kept=RECORDED, told=tell)
    if not output.json:
        for row in result.get("rounds", ()):
            output.say(_in_words(row, wanted))
        if result.get("ended"):
            output.say(f"ended before its time: {result['ended']['code']}: {result['ended']['text']}")
        if "plan" in result:
            best = f"the best one: armctl {what} {result['plan']}"
            output.say(best if result["plan"] else "no correction was kept: no file is written")
    output.answer(result, off=off(result, wanted))
    return 1 if result.get("ended") else 0


def _in_words(row: dict[str, Any], wanted: str) -> str:
    """A round of a refinement, as whoever has never seen one understands it."""
    error = off(row, wanted, 2)
    if row["round"] == 0:
        return f"as it was: {error}"
    return f"correction {row['round']}: {error}, {'kept' if row['kept'] else 'not better by more than noise: not kept'}"


@command("play", SOCKET)
def play_command(output: Output, name: str, **how: Any) -> None:
    """Move as was taught: a take or a run by its name, or a file: a log, or a table (CSV) of joint angles.

    A table has a header: time_s, and a column a joint, named by it, in radians, or with _deg behind it in degrees; or
    it comes from `armctl log export`. The motion is smoothed, approached slowly and eased in; a gripper moves with it.
    The whole is checked before it starts, and is recorded like a run. Ctrl-C stops the arm.

    Example: armctl play line-1 --rate 0.5
    """
    from armctl.config import validate
    from armctl.trajectory.playback import PlayRequest

    what = {"motion": _motion_in(Path(name))} if is_file(name) else {"name": name}
    request = validate(PlayRequest, {**what, **how}, "play")
    result = output.carry_out("playing", "play", request, kept=RECORDED)
    output.answer(result, off=off(result, "where the tool was taught to be at the same progress"))


def _motion_in(file: Path) -> TaughtMotion:
    """The motion in a log, or in a table of joint angles."""
    from armctl.recording import recordings
    from armctl.trajectory.playback import motion_from_text

    if file.suffix == ".csv":
        motion = motion_from_text(read_text(file, "motion"), str(file))
    else:
        motion = recordings.taught(recordings.load(file))
    if (numbers := len(motion.time_s) * (len(motion.joints) + 1)) > MOST_NUMBERS:
        much = f"{len(motion.time_s)} rows are {numbers} numbers, at most {MOST_NUMBERS} reach the daemon at once"
        raise ConfigError(str(file), "time_s", much, "leave rows out, or play a recording by its name")
    return motion
