"""`armctl replay`: a log watched, checked, drawn or repeated. No daemon is needed."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armctl.cli.keys import keys
from armctl.cli.output import Output, command, kept_option
from armctl.cli.screen import Screen, filled
from armctl.cli.tables import QUANTITIES, joint_cells, number, table_lines
from armctl.clock import Clock, MonotonicClock
from armctl.errors import ArmctlError
from armctl.recording.player import Player, Wait, play

if TYPE_CHECKING:
    from armctl.recording.replay import ReplayResult
    from armctl.recording.timeline import Timeline

EVENTS_SHOWN = 6
# Between two lines where there is no terminal.
LINE_S = 1.0
KEYS_HELP = "space: pause   left, right: 5 s back, forward   + -: rate   l: loop   q: leave"


PLAYED = kept_option("--arm arm_name", help="Which arm --onto-sim plays; the configured one if left out.")


@command("replay", PLAYED)
def replay_command(output: Output, log: Path, check: bool, allow_gaps: bool, report: Path | None, **shown: Any) -> int:
    """Watch LOG in the terminal, or re-run what the daemon did and compare it bit for bit (--check).

    The check fails as well where ticks are missing, or could not be judged; --allow-gaps lets that pass.

    Keys while watching: space pauses, left and right seek 5 s, + and - change the rate, l loops, q leaves. Where
    there is no terminal, a line a second is printed. With --json LOG is re-run and compared as with --check.

    Example: armctl replay ~/.local/share/armctl/recordings/demo-1.mcap --rate 4
    """
    onto_sim, foreign, seed = (shown.pop(name) for name in ("onto_sim", "foreign", "seed"))
    if onto_sim:
        return _onto_sim(output, log, foreign, seed)
    answer: dict[str, Any] = {}
    same = True
    if check or output.json:
        result = _checked(output, log)
        same = result.mismatches == 0 and result.ticks > 0 and (allow_gaps or not result.passed_over)
        answer = vars(result) | {"judged": result.judged}
    if report is not None:
        from armctl.report import log as page

        page.write(report, loaded(output, log), checked=answer)
        answer["report"] = str(report)
        if not output.json:
            output.say(f"report: {report}")
    if not output.result(answer) and not check and report is None:
        timeline = loaded(output, log)
        with keys(sys.stdin) as pressed:
            _watch(output, timeline, pressed.wait, MonotonicClock(), **shown)
    return 0 if same else 1


def _checked(output: Output, log: Path) -> ReplayResult:
    from armctl.recording import log_file, provenance, replay

    with output.progress("re-running", 1.0) as show:
        result = replay.check(log, progress=show)
    verdict = "what was judged is bit for bit the same" if result.passed_over else "bit for bit the same"
    if result.ticks == 0:
        verdict = "nothing to replay: the log holds no complete tick after a keyframe"
    elif result.mismatches:
        verdict = f"{result.mismatches} mismatches, first: {result.first_mismatch}"
        with log_file.LogFile(log) as file:
            verdict += provenance.other_program(file.facts)
    if not output.json:
        ran = f"{result.ticks} ticks, {result.messages} messages re-run in {result.seconds:.2f} s"
        output.say(f"{ran} ({result.realtime_ratio:.0f} x real time): {verdict}")
        if result.skipped:
            output.say(f"not judged: {result.skipped} ticks, because ticks before them are missing or were cut off")
        for gap in result.gaps:
            end = "its end, and nobody knows what is missing" if gap["to_s"] is None else f"{gap['to_s']:.1f} s"
            output.say(f"nothing judged from {gap['from_s']:.1f} s to {end}")
        if result.not_compared:
            names = ", ".join(result.not_compared)
            output.say(f"not compared, since the log's armctl wrote them otherwise or not at all: {names}")
    return result


def loaded(output: Output, log: Path) -> Timeline:
    from armctl.recording import timeline

    with output.progress("reading", 1.0) as show:
        return timeline.load(log, progress=show)


def _onto_sim(output: Output, log: Path, foreign: bool, seed: int) -> int:
    from armctl.lab import rehearsal

    timeline, played = loaded(output, log), output.arm
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
    output.answer(result._asdict(), told)
    return 0


# --------------------------------------------------------------------------------------------------- watching


def _watch(
    output: Output, timeline: Timeline, wait: Wait, clock: Clock, *, rate: float, start_s: float, loop: bool
) -> None:
    if start_s > timeline.duration_s:
        raise ArmctlError(f"--start {start_s:g}: {timeline.path} lasts {timeline.duration_s:.1f} s; begin earlier")
    player = Player(timeline.duration_s, rate=rate, loop=loop, at_s=start_s)
    if output.console.is_terminal:
        play(player, lambda now: output.console.draw(picture(timeline, now, output.console)), wait, clock)
    else:
        play(player, lambda now: output.say(line(timeline, now.at_s)), wait, clock, LINE_S)


def picture(timeline: Timeline, player: Player, screen: Screen) -> list[str]:
    """One frame for a terminal: joints, tool, state, fault, and what happened last."""
    i = timeline.index(player.at_s)
    joints = []
    for j, name in enumerate(timeline.arm.joint_names):
        read = {quantity: getattr(timeline, quantity)[i, j] for quantity, *_ in QUANTITIES.values()}
        joints.append((name, *joint_cells(read, QUANTITIES), "on" if timeline.torque_enabled[i, j] else "off"))
    now_ns = timeline.start_ns + round(player.at_s * 1e9)
    known = [event for event in timeline.happenings if event.time_ns <= now_ns][-EVENTS_SHOWN:]
    happened = [f"{(event.time_ns - timeline.start_ns) / 1e9:8.1f} s  {event.text}" for event in known]
    mode = ("paused" if player.paused else f"{player.rate:g} x") + "   loop" * player.loop
    fault = timeline.fault(i)
    return [
        *screen.wrapped(f"{timeline.arm.arm_id}: {timeline.state(i)}", bold=True, **{"fg": "red"} if fault else {}),
        *table_lines(screen, ("joint", *QUANTITIES, "torque"), joints, ("joint",)),
        *screen.wrapped(f"tool at {_tool(timeline, i)}"),
        *screen.wrapped(fault, fg="red"),
        *(line for text in happened for line in screen.wrapped(text, dim=True)),
        filled(player.at_s / max(timeline.duration_s, 1e-9), min(60, screen.width)),
        *screen.wrapped(f"{player.at_s:.1f} of {timeline.duration_s:.1f} s   {mode}"),
        *screen.wrapped(KEYS_HELP, dim=True),
    ]


def line(timeline: Timeline, at_s: float) -> str:
    """One frame as a line of text."""
    i = timeline.index(at_s)
    angles = " ".join(f"{number(q, math.degrees(1.0), 1):>7}" for q in timeline.position_rad[i].tolist())
    fault = f"  {timeline.fault(i)}" if timeline.fault(i) else ""
    return f"{at_s:8.1f} s  {timeline.state(i):<10} {angles} deg  tool {_tool(timeline, i)}{fault}"


def _tool(timeline: Timeline, i: int) -> str:
    return ", ".join(number(value, 1000.0, 1) for value in timeline.tool[i, :3].tolist()) + " mm"
