"""Commands on files alone: no daemon needed."""

from __future__ import annotations

import math
from pathlib import Path

import click

from armctl.cli.output import Output, output_option

LOG = click.Path(path_type=Path, dir_okay=False)


@click.command("replay")
@click.argument("log", type=LOG)
@click.option("--check", is_flag=True, help="Re-run every tick and compare bit for bit.")
@output_option
def replay_command(output: Output, log: Path, check: bool) -> int:
    """Show what LOG holds, or (--check) re-run what the daemon did and compare bit for bit.

    Example: armctl replay ~/.local/share/armctl/recordings/demo-1.mcap --check
    """
    from armctl.recording import reader, replay

    if not check:
        table = reader.ticks(log)
        if output.result({"ticks": len(table.time_s), "messages": reader.info(log).messages}):
            return 0
        output.say("time s  " + "  ".join(f"{name:>9}" for name in table.names) + "   (deg)")
        for time_s, row in zip(table.time_s, table.position_rad, strict=True):
            output.say(f"{time_s:6.2f}  " + "  ".join(f"{math.degrees(value):9.2f}" for value in row))
        return 0
    with output.progress("replaying", 1.0) as show:
        result = replay.check(log, progress=lambda fraction: show(fraction, ""))
    same = result.mismatches == 0 and result.ticks > 0
    if not output.result(
        {
            "ticks": result.ticks,
            "messages": result.messages,
            "mismatches": result.mismatches,
            "seconds": result.seconds,
            "realtime_ratio": result.realtime_ratio,
            "first_mismatch": result.first_mismatch,
        }
    ):
        verdict = "bit for bit the same" if same else f"{result.mismatches} mismatches, first: {result.first_mismatch}"
        if result.ticks == 0:
            verdict = "nothing to replay: the log holds no complete tick after a keyframe"
        output.say(
            f"{result.ticks} ticks, {result.messages} messages re-run in {result.seconds:.2f} s "
            f"({result.realtime_ratio:.0f} x real time): {verdict}"
        )
    return 0 if same else 1


@click.group("log")
def log_command() -> None:
    """Look into and mend MCAP logs."""


@log_command.command("info")
@click.argument("log", type=LOG)
@output_option
def info(output: Output, log: Path) -> None:
    """What LOG holds: messages, duration, topics, whether it was closed properly."""
    from armctl.recording import reader

    found = reader.info(log)
    if output.result(
        {
            "messages": found.messages,
            "start_s": found.start_s,
            "duration_s": found.duration_s,
            "topics": found.topics,
            "complete": found.complete,
        }
    ):
        return
    output.say(f"{found.messages} messages in {found.duration_s:.1f} s")
    for topic, count in sorted(found.topics.items()):
        output.say(f"  {topic:<24}{count:>9}")
    if not found.complete:
        output.say(f"The file was not closed properly; its intact part is shown. Mend it: armctl log recover {log}")


@log_command.command("recover")
@click.argument("log", type=LOG)
@output_option
def recover(output: Output, log: Path) -> None:
    """Write every intact message of a truncated LOG into a finished file beside it."""
    from armctl.recording import recover as recovery

    result = recovery.recover(log)
    if not output.result(
        {"recovered_messages": result.recovered_messages, "lost_s": result.lost_s, "path": str(result.path)}
    ):
        output.say(f"{result.recovered_messages} messages recovered into {result.path}")
        output.say(f"lost: {result.lost_s:.1f} s, and what was not yet written (at most 1 s)")


@click.command("robots")
@output_option
def robots_command(output: Output) -> None:
    """The robot models armctl knows."""
    from armctl.kinematics import robots

    known = [robots.get(name) for name in robots.names()]
    rows = [{"name": r.name, "joints": r.chain.n, "convention": r.chain.convention, "source": r.source} for r in known]
    if not output.result({"robots": rows}):
        for row in rows:
            output.say(f"{row['name']}: {row['joints']} joints, {row['convention']} DH; {row['source']}")
