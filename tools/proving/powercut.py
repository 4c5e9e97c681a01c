"""Power cuts and failing writes while the recorder is at work; invariant 10 judged after the recovery.

A story of 15 s is recorded once by the real recorder: log files that rotate and are compacted, a take that ends, one
that is under way, a fault and its snapshot. Then the power is cut after any of the disk's operations, the folder is put
into a state the disk may be in (cut_disk.py), the recovery of a starting daemon runs on it, sometimes it is cut as
well and runs again, and what can be read is compared with what was put:

1. No message is there that was not recorded, byte for byte.
2. Every tick that was put over a second before the cut is in a log.
3. A take that was reported as finished is there, whole.

The second part: the story again with the disk's n-th operation failing, for every n; beside the above, putting never
raises, the user is told, and the log goes on when the disk does.

The third part: one log cut at every byte of its last 64 KiB and at random places, and with random bits flipped
(damage.py).

The fourth part: logs under a clock that is set and a folder that fills, vanishes or cannot be written (retention.py).
"""

import contextlib
import os
import random
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import LogConfig
from armctl.errors import LogError
from armctl.messages import Fault, TickRecord
from armctl.recording.channels import CYCLE, JOINT_COMMANDS, JOINT_STATES, SERVOS, TCP_POSE, TF
from armctl.recording.compact import compact_folder
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.recorder import Recorder
from armctl.recording.recover import recover_folder
from armctl.recording.rotation import RETRY_NS
from proving import damage, retention
from proving.cut_disk import ERRORS, CutDisk, Operation, failing_once, leave
from proving.log_rig import log_context, memory_folder, quietly, settle, simulated_records

CUTS = 10_000
LAST_BYTES = 2**16
BYTE_CUTS_SHARD = 2**12
RANDOM_DAMAGES = 2000
DAMAGED_TICKS = 180
SHARD = 250
FOLDERS = ("logs", "recordings")
TICKS = 150
# Tick at which a take begins, at which it ends, its name.
TAKES = ((20, 60, "first"), (65, 90, "second"), (100, 10**9, "third"))
FAULT_TICK = 75
WALL_NS = 1_750_000_000 * NS_PER_S
LIMITS = LogConfig(free_bytes=0, rotate_s=5.0, snapshot_s=2.0)
# So many operations fail in a row.
FAILING_OPERATIONS = (1, 4)
# Operations after which the disk may be in another state than before.
CHANGING = ("create", "write", "sync", "sync_folder", "link", "replace", "remove")
# Whose messages are the same whichever files they go to.
TICK_TOPICS = (JOINT_STATES, JOINT_COMMANDS, TF, TCP_POSE, SERVOS)
Truth = frozenset[LogMessage]


@dataclass
class Story:
    """What was put, what the disk did, and what the files held."""

    records: list[TickRecord]
    operations: list[Operation]
    truth: Truth = frozenset()
    takes: dict[str, tuple[LogMessage, ...]] = field(default_factory=dict)
    told: bool = False
    raised: list[str] = field(default_factory=list)


@dataclass
class Tally(damage.Tally):
    """What was tried, and what was found; the runs are power cuts."""

    recoveries_cut: int = 0
    faults: int = 0
    faults_told: int = 0

    def add(self, other: "Tally") -> None:
        self.add_findings(other)
        for name in ("runs", "recoveries_cut", "faults", "faults_told"):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def prove(seed: int, cuts: int = CUTS) -> dict[str, Any]:
    """The proof, spread over the machine's cores."""
    shards = -(-cuts * retention.STORIES // CUTS)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        cutting = [pool.submit(cut, seed, at, min(SHARD, cuts - at * SHARD)) for at in range(-(-cuts // SHARD))]
        failing = [pool.submit(fail, seed, first, 8) for first in range(8)]
        byte_cutting = [pool.submit(cut_bytes, seed, begin) for begin in range(0, LAST_BYTES, BYTE_CUTS_SHARD)]
        damaging = pool.submit(damage_randomly, seed, RANDOM_DAMAGES)
        telling = [pool.submit(retention.tell, seed, at, shards) for at in range(shards)]
        tally = Tally()
        for job in (*cutting, *failing):
            tally.add(job.result())
        kept = [job.result() for job in telling]
        byte_cuts, damages = [job.result() for job in byte_cutting], damaging.result()
    for other in (*byte_cuts, *damages, *kept):
        tally.add_findings(other)
    return {
        "runs": tally.runs,
        "violations": tally.violations,
        "worst_loss_s": tally.worst_loss_s,
        "loss_bound_s": damage.LOSS_BOUND_S,
        "recoveries_cut": tally.recoveries_cut,
        "write_faults": tally.faults,
        "write_faults_told": tally.faults_told,
        "byte_cuts": sum(one.runs for one in byte_cuts),
        "random_cuts": damages[0].runs,
        "bit_flips": damages[1].runs,
        "clock_stories": sum(one.runs for one in kept),
        "logs_deleted": sum(one.deleted for one in kept),
        "summary_bytes": sum(one.summary_bytes for one in kept),
        "examples": tally.examples,
        "seed": seed,
    }


def cut_bytes(seed: int, begin: int) -> damage.Tally:
    """The log cut at every byte of a part of its last 64 KiB."""
    with memory_folder() as root:
        data = _damaged(seed, root)
        first = len(data) - LAST_BYTES + begin
        return damage.Damage(data, root).cut(range(first, first + BYTE_CUTS_SHARD))


@quietly()
def damage_randomly(seed: int, count: int) -> tuple[damage.Tally, damage.Tally]:
    """The log cut at random places, and with random bits flipped, and recovered."""
    with memory_folder() as root:
        data, rng = _damaged(seed, root), random.Random(seed)
        log = damage.Damage(data, root)
        places = [rng.randrange(len(data)) for _ in range(count)]
        return log.cut(places, recovering=True), log.flip(rng, count, recovering=True)


def _damaged(seed: int, root: Path) -> bytes:
    return damage.part_bytes(simulated_records(seed, DAMAGED_TICKS), root)


@quietly()
def cut(seed: int, shard: int, runs: int, *, after_kinds: Sequence[str] = CHANGING) -> Tally:
    """So many power cuts of the story of a seed, each after an operation of one of these kinds."""
    tally, rng, story = Tally(), random.Random(f"{seed} {shard}"), told_story(seed)
    places = [number for number, one in enumerate(story.operations, start=1) if one.kind in after_kinds]
    for _ in range(runs):
        with memory_folder() as root:
            after = rng.choice(places)
            done = story.operations[:after]
            # As late as can be: the next operation was about to be done.
            now_ns = story.operations[min(after, len(story.operations) - 1)].time_ns
            leave(done, rng, root)
            if rng.random() < 0.25:
                root = _cut_recovery(root, rng, tally)
            tally.runs += 1
            _judge(root, story, done, now_ns, tally)
    return tally


@quietly()
def fail(seed: int, first: int, stride: int) -> Tally:
    """The story with every `stride`-th operation of the disk failing, from the `first` on, in every way."""
    tally, whole = Tally(), told_story(seed)
    operations = sum(one.kind not in ("put", "finished") for one in whole.operations)
    for at in range(first + 1, operations + 1, stride):
        for number in ERRORS:
            for count in FAILING_OPERATIONS:
                with memory_folder() as root:
                    story = _tell(seed, root, failing_once(at, number, count))
                    tally.faults += 1
                    tally.faults_told += story.told
                    _judge_fault(root, story, whole.truth, f"{count} operations failing from {at} on", count, tally)
    return tally


@cache
def told_story(seed: int) -> Story:
    """The story on a disk that does what it is asked."""
    with memory_folder() as root:
        return _tell(seed, root, None)


def _tell(seed: int, root: Path, failing: Any) -> Story:
    """Let the recorder record the story."""
    clock = VirtualClock(5 * NS_PER_S)
    disk = CutDisk(root, clock.now_ns, failing)
    story = Story(_records(seed), disk.operations)
    logs, recordings = (root / folder for folder in FOLDERS)
    logs.mkdir()
    recordings.mkdir()
    recorder = Recorder(
        log_context(LIMITS),
        logs,
        recordings,
        clock=clock,
        wall_ns=lambda: WALL_NS + clock.now_ns(),
        disk=disk,
        compactor=partial(compact_folder, disk=disk),  # at once, where the recorder asks for it
    )
    truth: set[LogMessage] = set()
    for record in story.records:
        clock.sleep_until_ns(record.inputs.now_ns)
        try:
            disk.note("put", number=record.inputs.tick)
            recorder.put(record)
            settle(recorder)
            _take(recorder, record.inputs.tick, root, story, disk)
        except Exception as error:  # whatever it is, it would have hit control
            story.raised.append(f"tick {record.inputs.tick}: {error!r}")
            break
        story.told = story.told or bool(recorder.problem)
        if failing is None and record.inputs.tick % 20 == 19:
            truth |= _messages(root)
    recorder.close()
    story.told = story.told or bool(recorder.problem)
    story.truth = frozenset(truth | _messages(root))
    return story


def _take(recorder: Recorder, tick: int, root: Path, story: Story, disk: CutDisk) -> None:
    for begin, end, name in TAKES:
        with contextlib.suppress(LogError):
            if tick == begin:
                recorder.begin_take(name)
            elif tick == end and recorder.take_path is not None and (path := recorder.end_take()) is not None:
                disk.note("finished", new=str(path.relative_to(root)))
                story.takes[str(path.relative_to(root))] = _read(path)


@cache
def _records(seed: int) -> list[TickRecord]:
    records = simulated_records(seed, TICKS)
    faults = (Fault("HOT", "made up for the snapshot", records[FAULT_TICK].inputs.now_ns, 3),)
    return [
        replace(record, outputs=replace(record.outputs, faults=faults if record.inputs.tick >= FAULT_TICK else ()))
        for record in records
    ]


def _cut_recovery(root: Path, rng: random.Random, tally: Tally) -> Path:
    """Recover, cut the power on the way, and return the folder that is left."""
    disk = CutDisk(root, lambda: 0)
    first: dict[int, str] = {}
    for path in _files(root):
        name, inode = str(path.relative_to(root)), path.stat().st_ino
        if inode in first:
            disk.note("link", old=first[inode], new=name)
            continue
        first[inode] = name
        disk.note("create", number=inode, new=name)
        disk.note("write", number=inode, data=path.read_bytes())
        disk.note("sync", number=inode)
    for name in FOLDERS:
        disk.note("sync_folder", new=name)
    begun = len(disk.operations)
    for folder in FOLDERS:
        recover_folder(root / folder, disk=disk)
    left = root / "after"
    leave(disk.operations[: rng.randint(begun, len(disk.operations))], rng, left)
    tally.recoveries_cut += 1
    return left


def _judge(root: Path, story: Story, done: list[Operation], now_ns: int, tally: Tally) -> None:
    where = f"cut after operation {len(done)} of {len(story.operations)}"
    try:
        for folder in FOLDERS:
            recover_folder(root / folder, disk=damage.UnsyncedDisk())
        found = _messages(root)
    except Exception as error:  # any exception at all is what this looks for
        tally.violation(f"{where}: the recovery raised {error!r}")
        return
    if not found <= story.truth:
        tally.violation(f"{where}: {len(found - story.truth)} messages that were never recorded")
    logged = _ticks(root)
    missing = [one.time_ns for one in done if one.kind == "put" and one.number not in logged]
    loss_s = (now_ns - min(missing)) / NS_PER_S if missing else 0.0
    tally.worst_loss_s = max(tally.worst_loss_s, loss_s)
    if loss_s > damage.LOSS_BOUND_S:
        tally.violation(f"{where}: {loss_s:.3f} s lost")
    for one in done:
        if one.kind == "finished" and not _same(root / one.new, story.takes[one.new]):
            tally.violation(f"{where}: the finished take {one.new} is not what it was")


def _judge_fault(root: Path, story: Story, truth: Truth, where: str, count: int, tally: Tally) -> None:
    for text in story.raised:
        tally.violation(f"{where}: {text}")
    try:
        for folder in FOLDERS:
            recover_folder(root / folder, disk=damage.UnsyncedDisk())
        found = _messages(root)
    except Exception as error:  # as above
        tally.violation(f"{where}: the recovery raised {error!r}")
        return
    known = {_timeless(message) for message in truth}
    if any(message.topic in TICK_TOPICS and _timeless(message) not in known for message in found):
        tally.violation(f"{where}: messages that were never recorded")
    logged = _ticks(root)
    missing = [tick.inputs.now_ns for tick in story.records if tick.inputs.tick not in logged]
    if missing:
        if not story.told:
            tally.violation(f"{where}: {len(missing)} ticks are missing, and nobody was told")
        # Each failing operation may cost one attempt to go on.
        if max(missing) - min(missing) > count * RETRY_NS + damage.LOSS_BOUND_S * NS_PER_S:
            tally.violation(f"{where}: {(max(missing) - min(missing)) / NS_PER_S:.1f} s are missing")
    for name, messages in story.takes.items():
        if not _same(root / name, messages):
            tally.violation(f"{where}: the finished take {name} is not what it was")


def _timeless(message: LogMessage) -> LogMessage:
    """The message of a tick, without the time a file gives to those that a replay needs and that are not its own."""
    return message._replace(log_time_ns=0) if message.topic == SERVOS else message


def _files(root: Path) -> list[Path]:
    return sorted(path for folder in FOLDERS for path in (root / folder).glob("*") if path.is_file())


def _read(path: Path) -> tuple[LogMessage, ...]:
    with LogFile(path) as log:
        return tuple(log.messages())


def _same(path: Path, messages: tuple[LogMessage, ...]) -> bool:
    try:
        return _read(path) == messages
    except LogError:
        return False


def _messages(root: Path) -> Truth:
    """Everything in finished files and parts."""
    found: set[LogMessage] = set()
    for path in _files(root):
        with contextlib.suppress(LogError):
            found.update(_read(path))
    return frozenset(found)


def _ticks(root: Path) -> set[int]:
    """The ticks in finished logs of the daemon."""
    found = set()
    for path in (root / "logs").glob("armctl-*.mcap"):
        with contextlib.suppress(LogError), LogFile(path) as log:
            for message in log.messages((CYCLE,)):
                cycle = log.codec(CYCLE).decode(message.data)
                if not cycle["inputs_only"]:
                    found.add(cycle["tick"])
    return found
