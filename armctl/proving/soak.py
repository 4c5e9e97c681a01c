"""Virtual hours of the control process under random faults, commands and timing, judged by the simulated servos.

One seed makes all episodes (`story.py`); each is played by itself (`episode.py`) and judged (`invariants.py`), on as
many worker processes as asked for. The first that fails is shrunk to a short story, told in plain words beside the
one command that repeats it.

Beyond what the judge sees in each episode: some are played twice and must say the same on the wire (invariant 13), the
step is run again on some of their inputs and must say the same (replay), and a worker's open files stay the same and
its memory within 1 MiB a simulated day and what its allocator keeps (invariant 14).
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armctl.control.machine import State
from armctl.control.step import step
from armctl.messages import TickRecord, from_json, to_json
from armctl.proving.episode import PERIOD_S, Episode, Outcome, Stage, stage
from armctl.proving.story import LONGEST_S, SHORTEST_S, Story, draw, shrink

SEED = 1
TWICE_EVERY = 40
"""Of so many episodes one is played twice, and its steps repeated; as is each worker's first."""
SHRINK_S = 120.0
MIB_PER_DAY = 1.0
SLACK_MIB = 8.0
"""What an allocator keeps from the largest episode so far."""
WARM = 30
"""Episodes of a worker before its memory counts."""
CHUNK = 4

ROWS: dict[str, tuple[str, ...]] = {
    "lost or slow reply": ("NO_REPLY in a reading",),
    "bad checksum, garbage, echo, wrong id, late reply": ("BUS_NOISE in a reading",),
    "noise above 10 % in 10 s": ("BUS_NOISE",),
    "two servos with one id": ("DUPLICATE_ID",),
    "a servo silent": ("SERVO_SILENT",),
    "whole bus silent": ("BUS_DEAD",),
    "USB unplugged": ("PORT_GONE",),
    "USB replugged": ("PORT_BACK",),
    "another program on the port": ("OTHER_WRITER",),
    "torque on a limp arm, not from here": ("NOT_LIMP",),
    "adapter latency 16 ms": ("SLOW_ADAPTER",),
    "brown-out, servo reboot": ("LOST_TORQUE",),
    "heat": ("HOT",),
    "voltage": ("VOLTAGE",),
    "load": ("OVERLOAD",),
    "tripped": ("TRIPPED",),
    "blocked joint, stuck sensor": ("BLOCKED",),
    "EEPROM differs, wheel mode": ("EEPROM_MISMATCH",),
    "goal outside limits, NaN, inf": ("refused or ended: LIMIT",),
    "torque-on jump": ("refused or ended: JUMP_REFUSED",),
    "start pose differs": ("refused or ended: START_MISMATCH",),
    "late ticks, skipped": ("late ticks",),
    "late ticks, over 250 ms": ("LATE",),
    "SIGTERM, host lost": ("SIGTERM",),
    "SIGKILL": ("RESTARTED",),
}
"""Rows of the fault matrix at or below the control process, by what the episodes count."""


@dataclass
class Tally:
    """What a number of episodes came to."""

    runs: int = 0
    virtual_s: float = 0.0
    busy_s: float = 0.0
    rows: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, str, float, str]] = field(default_factory=list)
    """Episode, invariant, when and what."""
    grown_mib: float = 0.0

    def add(self, other: Tally) -> None:
        self.runs += other.runs
        self.virtual_s += other.virtual_s
        self.busy_s += other.busy_s
        self.rows.update(other.rows)
        self.failures += other.failures
        self.grown_mib = max(self.grown_mib, other.grown_mib)


def play(story: Story, on: Stage, *, twice: bool = False) -> Outcome:
    """One episode; with `twice` also what must come out the same again."""
    outcome = Episode(story, on, keep_records=twice).play()
    if twice and not outcome.violations:
        again = Episode(story, on)
        if again.play().wire != outcome.wire:
            again.judge.found(outcome.virtual_s, "13", "the same seed gave other bytes on the wire")
        if (tick := first_mismatch(outcome.records, on)) is not None:
            again.judge.found(outcome.virtual_s, "replay", f"the step, run again, differs at tick {tick}")
        outcome.violations += again.judge.violations
    outcome.records.clear()
    return outcome


def first_mismatch(records: list[TickRecord], on: Stage) -> int | None:
    """The first record that the step does not give again from the logged inputs; None: there is none."""
    state = State()
    for index, record in enumerate(records):
        if record.inputs.tick == 0:
            state = State()
        state, outputs = step(state, record.inputs, on.arm, on.robot, PERIOD_S)
        if to_json(outputs) != to_json(record.outputs):
            return index
        if record.keyframe:
            if to_json(state) != record.keyframe:
                return index
            state = from_json(State, record.keyframe)
    return None


_stage: Stage | None = None
_baseline: tuple[float, int, float] | None = None
"""Memory [MiB], open files and simulated time [s] of this worker once it was warm."""
_tally = Tally()
"""Of this worker, since it began."""


def _begin() -> None:
    global _stage
    logging.disable(logging.CRITICAL)
    _stage = stage()


def _episodes(work: tuple[int, range]) -> Tally:
    """Play some episodes in this process."""
    assert _stage is not None
    seed, episodes = work
    tally = Tally()
    for episode in episodes:
        begin_s = time.process_time()
        story = draw(seed, episode, _stage.arm)
        outcome = play(story, _stage, twice=episode % TWICE_EVERY == 0 or not _tally.runs)
        tally.runs += 1
        tally.virtual_s += outcome.virtual_s
        tally.busy_s += time.process_time() - begin_s
        tally.rows.update(outcome.rows)
        tally.failures += [(episode, v.invariant, v.time_s, v.text) for v in outcome.violations]
    _tally.add(tally)
    _watch_process(tally, episodes[-1])
    return tally


def _watch_process(tally: Tally, episode: int) -> None:
    """Invariant 14: this process's memory and open files."""
    global _baseline
    if _tally.runs < WARM:
        return
    gc.collect()
    memory_mib, files = _memory_mib(), len(os.listdir("/proc/self/fd"))
    if _baseline is None:
        _baseline = memory_mib, files, _tally.virtual_s
    tally.grown_mib = memory_mib - _baseline[0]
    bound_mib = SLACK_MIB + MIB_PER_DAY * (_tally.virtual_s - _baseline[2]) / 86400.0
    if tally.grown_mib > bound_mib:
        text = f"memory grew by {tally.grown_mib:.1f} MiB (bound {bound_mib:.1f})"
        tally.failures.append((episode, "14", 0.0, text))
    if files != _baseline[1]:
        tally.failures.append((episode, "14", 0.0, f"{files} open files, {_baseline[1]} before"))


def _memory_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def prove(
    seed: int = SEED,
    *,
    hours: float = 1.0,
    workers: int = 2,
    episode: int | None = None,
    budget_s: float = SHRINK_S,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Play `hours` virtual hours, or one episode alone.

    Args:
        budget_s: How long the first failure may be shrunk.
        tell: Takes lines for a person: progress, and the story of a failure.
    """
    if episode is not None:
        episodes = range(episode, episode + 1)
    else:
        episodes = range(max(1, round(hours * 3600.0 / ((SHORTEST_S + LONGEST_S) / 2.0))))
    begin_s = time.monotonic()
    total, told_s = Tally(), begin_s
    for tally in _played(seed, episodes, workers):
        total.add(tally)
        for number, invariant, at_s, text in tally.failures:
            tell(f"episode {number}, {at_s:.2f} s, invariant {invariant}: {text}")
        now_s = time.monotonic()
        if now_s - told_s >= 10.0:
            told_s = now_s
            left_s = (now_s - begin_s) * (len(episodes) - total.runs) / total.runs
            tell(
                f"{total.runs} of {len(episodes)} episodes, {total.virtual_s / 3600.0:.1f} h, "
                f"{len(total.failures)} violations, about {left_s / 60.0:.0f} min left"
            )
    failed = sorted({failure[0] for failure in total.failures if failure[1] != "14"})
    repeat = f"tools/prove soak --seed {seed} --episode {failed[0]}" if failed else ""
    if failed:
        before = logging.root.manager.disable
        logging.disable(logging.CRITICAL)
        tell_story(seed, failed[0], budget_s, tell)
        logging.disable(before)
        tell(f"repeat it: {repeat}")
    rows = {row: sum(total.rows[key] for key in keys) for row, keys in ROWS.items()}
    return {
        "runs": total.runs,
        "violations": len(total.failures),
        "hours": round(total.virtual_s / 3600.0, 3),
        "realtime_ratio": round(total.virtual_s / max(total.busy_s, 1e-9), 1),
        "seconds": round(time.monotonic() - begin_s, 1),
        "rows": [{"row": row, "hits": hits} for row, hits in rows.items()],
        "failures": [
            {"episode": number, "invariant": invariant, "time_s": round(at_s, 3), "text": text}
            for number, invariant, at_s, text in sorted(total.failures)[:100]
        ],
        "grown_MiB": round(total.grown_mib, 2),
        "repeat": repeat,
        "seed": seed,
    }


def _played(seed: int, episodes: range, workers: int) -> Iterator[Tally]:
    work = [(seed, episodes[at : at + CHUNK]) for at in range(0, len(episodes), CHUNK)]
    if workers == 1 or len(work) == 1:
        before = logging.root.manager.disable
        _begin()
        yield from map(_episodes, work)
        logging.disable(before)
        return
    with multiprocessing.get_context("spawn").Pool(workers, _begin) as pool:
        yield from pool.imap_unordered(_episodes, work)


def tell_story(seed: int, episode: int, budget_s: float, tell: Callable[[str], None]) -> None:
    """Shrink a failing episode and tell it."""
    on = stage()
    story = draw(seed, episode, on.arm)
    first = play(story, on, twice=True)
    if not first.violations:
        tell(f"episode {episode} fails no more when played alone")
        return
    wanted = first.violations[0].invariant

    def fails_at_s(shorter: Story) -> float | None:
        found = [v for v in play(shorter, on, twice=wanted in ("13", "replay")).violations if v.invariant == wanted]
        return found[0].time_s if found else None

    short = shrink(story, fails_at_s, budget_s)
    outcome = play(short, on)
    tell(f"episode {episode}, {len(story.lines)} lines, shrunk to {len(short.lines)}:")
    told, often = "", 0
    for at_s, text in outcome.told:
        often = often + 1 if text == told else 0
        if often <= 1:
            tell(f"{at_s:9.2f} s  {text}" + (" (and again)" if often else ""))
        told = text
    for violation in outcome.violations or first.violations:
        tell(f"{violation.time_s:9.2f} s  INVARIANT {violation.invariant} BROKEN: {violation.text}")
