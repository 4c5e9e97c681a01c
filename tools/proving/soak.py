"""Virtual hours of the control process under random faults, commands and timing, judged by the simulated servos.

One seed makes all episodes (`story.py`); each is played by itself (`episode.py`) and judged (`invariants.py`), on as
many worker processes as asked for. The first that fails is shrunk to a short story, told in plain words beside the
one command that repeats it.

Beyond what the judge sees in each episode: every step is run again on its inputs and must say the same (replay); some,
and all that fail, are played twice, must say the same on the wire (invariant 13), and their log is written and replayed
as `armctl logs` would; and a worker's open files stay the same, its memory within 1 MiB a simulated day and what its
caches take (invariant 14).
"""

from __future__ import annotations

import ctypes
import gc
import logging
import math
import multiprocessing
import os
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Self

from armctl.config import Config
from armctl.messages import Command, Run, SetRate, TickRecord
from armctl.recording import replay
from armctl.recording.writer import LogContext, LogWriter
from proving.arms import drawn
from proving.episode import Episode, Stage, stage_of
from proving.evidence import Outcome, Violation
from proving.meetings import never_met, table
from proving.requests import PERIOD_S
from proving.scenes import SCENES_FROM, scene, scene_arm, seeded
from proving.story import LONGEST_S, SHORTEST_S, Story, draw, paired, shrink, thickened

SEED = 1
# Of so many episodes one is played twice, and its log replayed; as is each worker's first, and every failure.
TWICE_EVERY = 40
SHRINK_S = 120.0
MIB_PER_DAY = 1.0
# Caches, each arm's own, fill after the first episodes too.
SLACK_MIB = 3.0
# Episodes of a worker before its memory counts.
WARM = 30
CHUNK = 4
# New objects after which a worker looks for cycles among them; it counts its memory after a full search.
GARBAGE = 50_000

# Rows of the fault matrix at or below the control process, by what the episodes count.
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
    "torque-on jump": ("refused or ended: JUMP_REFUSED", "refused or ended: NOT_TAKEN"),
    "start pose differs": ("refused or ended: START_MISMATCH",),
    "late ticks, skipped": ("late ticks",),
    "late ticks, over 250 ms": ("LATE",),
    "SIGTERM, host lost": ("SIGTERM",),
    "SIGKILL": ("RESTARTED",),
}


@dataclass
class Tally:
    """What a number of episodes came to."""

    runs: int = 0
    virtual_s: float = 0.0
    busy_s: float = 0.0
    rows: Counter[str] = field(default_factory=Counter)
    # Episode, invariant, when and what.
    failures: list[tuple[int, str, float, str]] = field(default_factory=list)
    grown_mib: float = 0.0
    # Which two faults met, and rules that are not kept yet by episode.
    met: Counter[tuple[str, str]] = field(default_factory=Counter)
    red: Counter[str] = field(default_factory=Counter)

    def add(self, other: Tally) -> None:
        self.runs += other.runs
        self.virtual_s += other.virtual_s
        self.busy_s += other.busy_s
        self.rows.update(other.rows)
        self.met.update(other.met)
        self.red.update(other.red)
        self.failures += other.failures
        self.grown_mib = max(self.grown_mib, other.grown_mib)


def drawn_by(seed: int, episode: int, arm: str = "") -> tuple[Stage, Story]:
    """The arm and the story of an episode, or of a scene, the same for the same numbers.

    Args:
        arm: By name; empty: every shipped one in its turn.
    """
    if episode >= SCENES_FROM:
        on = stage_of(scene_arm(drawn(seed, seeded(episode), arm), episode))
        return on, scene(seed, episode, on.arm)
    on = stage_of(drawn(seed, episode, arm))
    story = thickened(draw(seed, episode, on.arm), seed, episode, on.arm)
    return on, paired(story, seed, episode, on.arm)


def play(story: Story, on: Stage, *, twice: bool = False) -> Outcome:
    """One episode; with `twice` also what must come out the same again, and its log (as that of every failure)."""
    outcome = Episode(story, on).play()
    if not (twice or outcome.violations):
        return outcome
    with EpisodeLog(on) as log:
        other = Episode(story, on, log=log.take).play()
        mismatch = log.mismatch()
    if other.wire != outcome.wire:
        outcome.violations.append(Violation("13", outcome.virtual_s, "the same seed gave other bytes on the wire"))
    if mismatch:
        outcome.violations.append(Violation("replay", outcome.virtual_s, mismatch))
    return outcome


class EpisodeLog:
    """The log of an episode, on disk while it is open, and its replay.

    It ends at the first command with a NaN or an infinity: none comes through the socket, and no log can hold one.
    From there on the episode's own repetition of every step has to do.
    """

    def __init__(self, on: Stage) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="armctl-soak-")
        self._path = Path(self._folder.name) / "episode.mcap"
        self._writer = LogWriter(self._path, LogContext(on.arm, on.robot, Config(), "loopback", PERIOD_S))
        self._ticks = 0
        self._over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def take(self, record: TickRecord) -> None:
        """The next record."""
        self._over |= not all(map(finite, record.inputs.commands))
        if not self._over:
            self._writer.write_tick(record)
            self._ticks += 1

    def mismatch(self) -> str:
        """Close it and replay it; the first message that differs, or empty."""
        self._writer.close()
        return replay.check(self._path).first_mismatch if self._ticks else ""


def finite(command: Command) -> bool:
    """Whether a log can hold it: JSON has neither NaN nor infinity."""
    if isinstance(command, Run):
        return all(map(math.isfinite, chain.from_iterable(command.trajectory.positions_rad)))
    return not isinstance(command, SetRate) or math.isfinite(command.rate)


# Memory [MiB], open files and simulated time [s] of this worker once it was warm.
_baseline: tuple[float, int, float] | None = None
# Of this worker, since it began.
_tally = Tally()


def _begin() -> None:
    logging.disable(logging.CRITICAL)


def _begin_worker() -> None:
    """In a process that does nothing else."""
    _begin()
    gc.freeze()  # what is there by now stays; and what an episode drops, counting takes care of
    gc.set_threshold(GARBAGE)


def _episodes(work: tuple[int, str, range]) -> Tally:
    """Play some episodes in this process."""
    seed, arm, episodes = work
    tally = Tally()
    for episode in episodes:
        begin_s = time.process_time()
        on, story = drawn_by(seed, episode, arm)
        twice = episode % TWICE_EVERY == 0 or not (_tally.runs or tally.runs)
        outcome = play(story, on, twice=twice)
        tally.runs += 1
        tally.virtual_s += outcome.virtual_s
        tally.busy_s += time.process_time() - begin_s
        tally.rows.update(outcome.rows)
        tally.met.update(outcome.met)
        tally.red.update(f"{v.invariant}: {episode}" for v in outcome.red)
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
    memory_now_mib, files = memory_mib(), len(os.listdir("/proc/self/fd"))
    if _baseline is None:
        _baseline = memory_now_mib, files, _tally.virtual_s
    tally.grown_mib = memory_now_mib - _baseline[0]
    bound_mib = SLACK_MIB + MIB_PER_DAY * (_tally.virtual_s - _baseline[2]) / 86400.0
    if tally.grown_mib > bound_mib:
        text = f"memory grew by {tally.grown_mib:.1f} MiB (bound {bound_mib:.1f})"
        tally.failures.append((episode, "14", 0.0, text))
    if files != _baseline[1]:
        tally.failures.append((episode, "14", 0.0, f"{files} open files, {_baseline[1]} before"))


def memory_mib() -> float:
    """Of this process, after its allocator has given back whole pages that it only keeps."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc; elsewhere what is kept counts as well
        trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def prove(
    seed: int = SEED,
    *,
    hours: float = 1.0,
    workers: int = 2,
    episode: int | None = None,
    arm: str = "",
    budget_s: float = SHRINK_S,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Play `hours` virtual hours, or one episode alone.

    Args:
        arm: The one to play on, by name; empty: those in `SHIPPED`, in turn.
        budget_s: How long the first failure may be shrunk.
        tell: Takes lines for a person: progress, and the story of a failure.
    """
    if episode is not None:
        episodes = range(episode, episode + 1)
    else:
        episodes = range(max(1, round(hours * 3600.0 / ((SHORTEST_S + LONGEST_S) / 2.0))))
    begin_s = time.monotonic()
    total, told_s = Tally(), begin_s
    for tally in _played(seed, arm, episodes, workers):
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
    which = f" --arm {arm}" if arm else ""
    repeat = f"tools/prove soak --seed {seed} --episode {failed[0]}{which}" if failed else ""
    if failed:
        before = logging.root.manager.disable
        logging.disable(logging.CRITICAL)
        tell_story(seed, failed[0], budget_s, tell, arm)
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
        "red": [{"rule": rule, "episodes": len(found), "first": min(found)} for rule, found in _by_rule(total.red)],
        # Of one episode by itself nobody asks which faults met.
        "pairs_never_met": never_met(total.met) if episode is None else [],
        "pairs": list(table(total.met)) if episode is None else [],
        "grown_MiB": round(total.grown_mib, 2),
        "repeat": repeat,
        "seed": seed,
    }


def _by_rule(red: Counter[str]) -> list[tuple[str, set[int]]]:
    """Episodes in which each rule that is not kept yet was broken."""
    found: dict[str, set[int]] = {}
    for name in red:
        rule, episode = name.split(": ")
        found.setdefault(rule, set()).add(int(episode))
    return sorted(found.items())


def _played(seed: int, arm: str, episodes: range, workers: int) -> Iterator[Tally]:
    work = [(seed, arm, episodes[at : at + CHUNK]) for at in range(0, len(episodes), CHUNK)]
    if workers == 1 or len(work) == 1:
        before = logging.root.manager.disable
        _begin()
        yield from map(_episodes, work)
        logging.disable(before)
        return
    with multiprocessing.get_context("spawn").Pool(workers, _begin_worker) as pool:
        yield from pool.imap_unordered(_episodes, work)


def tell_story(seed: int, episode: int, budget_s: float, tell: Callable[[str], None], arm: str = "") -> None:
    """Shrink a failing episode and tell it."""
    on, story = drawn_by(seed, episode, arm)
    first = play(story, on, twice=True)
    if not first.violations:
        tell(f"episode {episode} fails no more when played alone")
        return
    wanted = first.violations[0].invariant

    def fails_at_s(shorter: Story) -> float | None:
        twice = wanted in ("13", "replay")
        outcome = play(shorter, on, twice=True) if twice else Episode(shorter, on).play()
        found = [v for v in outcome.violations if v.invariant == wanted]
        return found[0].time_s if found else None

    short = shrink(story, fails_at_s, budget_s)
    outcome = Episode(short, on).play()
    tell(f"episode {episode}, {len(story.lines)} lines, shrunk to {len(short.lines)}:")
    told, often = "", 0
    for at_s, text in outcome.told:
        often = often + 1 if text == told else 0
        if often <= 1:
            tell(f"{at_s:9.2f} s  {text}" + (" (and again)" if often else ""))
        told = text
    for violation in outcome.violations or first.violations:
        tell(f"{violation.time_s:9.2f} s  INVARIANT {violation.invariant} BROKEN: {violation.text}")
