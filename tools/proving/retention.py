"""Logs under a clock that is set and a folder that fills, vanishes or cannot be written: what is kept of them.

A story is the recorder at work for half a minute of virtual time, in a folder that holds older logs with stamps of the
past and of the future. Between its parts the wall clock is set, or the daemon is killed or started anew, with a clock
that goes on or in 1970; the disk fills, or the folder vanishes or is read-only. The disk notes in which order files
come into being.

1. A log or snapshot that is deleted is the oldest of its kind, whatever the clock says, and something had to go.
2. Putting never raises, and soon after the last trouble the newest log holds the newest tick.
3. `complete` says of every file that is left what the mcap package says. Beside each story a share of the bytes of a
   log's end are spoilt, one after another: of them too.
"""

import errno
import os
import random
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from io import BufferedWriter
from itertools import islice
from pathlib import Path
from unittest import mock

from mcap.reader import make_reader

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import LogConfig
from armctl.errors import LogError
from armctl.messages import Fault, TickRecord
from armctl.recording import reader
from armctl.recording.channels import CYCLE
from armctl.recording.disk import PART
from armctl.recording.log_file import LogFile
from armctl.recording.recorder import Recorder
from armctl.recording.recover import recover_folder
from armctl.recording.writer import LogWriter
from proving import damage
from proving.log_rig import log_context, memory_folder, quietly, repeated, settle, simulated_records

STORIES = 200
PARTS, PART_TICKS, LAST_TICKS = 12, (8, 30), 80
SIMULATED_TICKS = 200
QUOTA_BYTES = 2**20
# What an open log may hold that is not on the disk yet.
UNWRITTEN_BYTES = 2**17
OLD_LOGS, OLD_BYTES = 20, 50_000
WALL_NS = 1_750_000_000 * NS_PER_S
DAY_NS = 86_400 * NS_PER_S
STEPS_NS = (3600 * NS_PER_S, -3600 * NS_PER_S, DAY_NS, -DAY_NS, -365 * DAY_NS, 4000 * DAY_NS)
STARTS = ("start", "kill", "no clock")
TROUBLES = ("step", "step", "set", *STARTS, "full", "no space", "vanish", "read-only", "fault", "fault")


@dataclass
class Tally(damage.Tally):
    """What was tried, and what was found; the runs are stories."""

    deleted: int = 0
    summary_bytes: int = 0


class Shelf(damage.UnsyncedDisk):
    """A disk that notes what came into being in which order, and judges what is deleted."""

    def __init__(self, logs: Path, tally: Tally, where: str, *, aging: bool) -> None:
        self.read_only = self.no_space = False
        self.free = 2**40
        self.born: dict[str, int] = {}
        self._logs, self._tally, self._where, self._aging = logs, tally, where, aging

    def create(self, path: Path) -> BufferedWriter:
        if self.read_only or self.no_space:
            raise OSError(errno.EROFS if self.read_only else errno.ENOSPC, "made up")
        self.note(path)
        return super().create(path)

    def sync(self, stream: BufferedWriter) -> None:
        if self.no_space:
            raise OSError(errno.ENOSPC, "made up")
        super().sync(stream)

    def link(self, old: Path, new: Path) -> None:
        if self.read_only:
            raise OSError(errno.EROFS, "made up")
        super().link(old, new)

    def remove(self, path: Path) -> None:
        if path.suffix == ".mcap":
            self._judge(path)
        super().remove(path)

    def free_bytes(self, folder: Path) -> int:
        return self.free

    def note(self, path: Path) -> None:
        """A file has come into being, whatever it will be called when it is finished."""
        self.born.setdefault(path.name.partition(".mcap")[0], len(self.born))

    def order(self, path: Path) -> int:
        return self.born[path.name.partition(".mcap")[0].removesuffix("-recovered")]

    def _judge(self, path: Path) -> None:
        kind = path.name.partition("-")[0]
        there = sorted(self._logs.glob(f"{kind}-*.mcap"), key=self.order)
        self._tally.deleted += 1
        if path != there[0]:
            self._tally.violation(f"{self._where}: {path.name} is deleted before {there[0].name}, which is older")
        parts = sum(part.stat().st_size for part in self._logs.glob(f"*{PART}"))
        size = sum(one.stat().st_size for one in there) + (2 * parts if kind == "armctl" else 0)
        if size + UNWRITTEN_BYTES <= QUOTA_BYTES and self.free > 0 and not self._aging:
            self._tally.violation(f"{self._where}: {path.name} is deleted, and nothing had to be")


@quietly()
def tell(seed: int, number: int, stories: int = STORIES) -> Tally:
    """One story of a seed, and its share of spoilt ends."""
    tally, rng = Tally(), random.Random(f"{seed} {number}")
    with memory_folder() as root:
        Teller(rng, root, tally, f"story {number}").tell()
        spoil(rng, root, tally, number, stories)
    tally.runs += 1
    return tally


class Teller:
    """A daemon's recorder on virtual time, and what happens to it."""

    def __init__(self, rng: random.Random, root: Path, tally: Tally, where: str) -> None:
        self._rng, self._tally, self._where = rng, tally, where
        self._logs, self._takes, self._clock, self._offset_ns = root / "logs", root / "takes", VirtualClock(), WALL_NS
        aging = rng.random() < 0.3
        self._limits = LogConfig(
            free_bytes=1, rotate_s=rng.choice((1.0, 2.0, 3600.0)), snapshot_s=1.0, quota_bytes=QUOTA_BYTES,
            snapshots_bytes=QUOTA_BYTES, max_age_s=3 * 86_400.0 if aging else 0.0,
        )  # fmt: skip
        self._disk = Shelf(self._logs, tally, where, aging=aging)
        self._logs.mkdir()
        for number in range(1, OLD_LOGS + 1):
            stamp = f"{rng.choice((1970, 2024, 2025, 2037))}0615T{rng.randrange(24):02d}0000Z"
            old = self._logs / f"armctl-{stamp}-{number:06d}.mcap"
            old.write_bytes(bytes(OLD_BYTES))
            self._disk.note(old)
        self._recorder = self._started()

    def tell(self) -> None:
        """The story, and the judgement at its end."""
        records = iter(_records())
        for trouble in (*self._rng.choices(TROUBLES, k=PARTS), ""):
            self._befall(trouble)
            count = self._rng.randint(*PART_TICKS) if trouble else LAST_TICKS
            with mock.patch("armctl.recording.rotation.os.access", partial(self._access, os.access)):
                for record in islice(records, count):
                    self._put(record, trouble)
        self._recorder.close()
        self._judge(record)

    def _started(self) -> Recorder:
        return Recorder(
            log_context(self._limits),
            self._logs,
            self._takes,
            clock=self._clock,
            wall_ns=lambda: self._clock.now_ns() + self._offset_ns,
            disk=self._disk,
            compactor=partial(recover_folder, disk=self._disk),
        )

    def _befall(self, trouble: str) -> None:
        self._disk.free = 0 if trouble == "full" else 2**40
        self._disk.no_space, self._disk.read_only = trouble == "no space", trouble == "read-only"
        self._fault_ns = self._clock.now_ns()
        if trouble == "step":
            self._offset_ns += max(self._rng.choice(STEPS_NS), -self._offset_ns)
        elif trouble == "set":
            self._offset_ns = WALL_NS
        elif trouble == "vanish":
            shutil.rmtree(self._logs, ignore_errors=True)
        elif trouble in STARTS:
            if trouble == "kill":
                self._recorder._queue.put(self._kill)
            self._recorder.close()
            self._offset_ns = 0 if trouble == "no clock" else self._offset_ns
            recover_folder(self._logs, disk=self._disk)
            self._recorder = self._started()

    def _kill(self) -> None:
        """What is open stays as it is."""
        for kind in tuple(self._recorder._files._open):
            self._recorder._files._open.pop(kind).abandon()

    def _put(self, record: TickRecord, trouble: str) -> None:
        self._clock.sleep_until_ns(record.inputs.now_ns)
        faults = (Fault("HOT", "made up", self._fault_ns, 3),) if trouble == "fault" else ()
        try:
            self._recorder.put(replace(record, outputs=replace(record.outputs, faults=faults)))
            settle(self._recorder)
        except Exception as error:  # whatever it is, it would have hit control
            self._tally.violation(f"{self._where}: {trouble}: {error!r}")

    def _access(self, access: Callable[..., bool], path: Path, mode: int) -> bool:
        return access(path, mode) and not (self._disk.read_only and path == self._logs)

    def _judge(self, last: TickRecord) -> None:
        found = sorted(self._logs.glob("*.mcap*"), key=self._disk.order)
        ticks: list[int] = []
        for newest in [path for path in found if path.name.startswith("armctl-")][-1:]:
            with LogFile(newest) as log:
                ticks = [log.decode(message)["tick"] for message in log.messages((CYCLE,))]
        if ticks[-1:] != [last.inputs.tick]:
            self._tally.violation(f"{self._where}: the newest log ends with {ticks[-1:]}, not with {last.inputs.tick}")
        for path in found:
            _compare(path, self._tally, self._where)


@cache
def _records() -> tuple[TickRecord, ...]:
    return tuple(repeated(simulated_records(1, SIMULATED_TICKS), PARTS * PART_TICKS[1] + LAST_TICKS))


def spoil(rng: random.Random, root: Path, tally: Tally, number: int, stories: int) -> None:
    """Every so-manieth byte of a log's end, spoilt alone."""
    writer = LogWriter(root / "whole.mcap", log_context(), anchor=damage.ANCHOR, disk=damage.UnsyncedDisk())
    for record in _records()[:5]:
        writer.write_tick(record)
    writer.close()
    whole, path = writer.path.read_bytes(), root / "spoilt.mcap"
    begin = int.from_bytes(whole[-8 - 20 : -8 - 12], "little")
    for place in range(begin + number, len(whole), stories):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.randrange(8)]) + whole[place + 1 :])
        tally.summary_bytes += 1
        _compare(path, tally, f"byte {place} of {len(whole)} spoilt")


def _compare(path: Path, tally: Tally, where: str) -> None:
    """Whether `complete` says what the mcap package says."""
    try:
        info = reader.info(path)
        found, complete = info.topics, info.complete
    except LogError:
        found, complete = None, False
    try:
        with path.open("rb") as stream:
            messages = make_reader(stream, validate_crcs=True).iter_messages()
            stock = dict(Counter(channel.topic for _, channel, _ in messages))
    except Exception:  # it has no common type of error
        stock = None
    if complete != (stock is not None and stock == found):
        tally.violation(f"{where}: {path.name}: complete: {complete}, {found}; the mcap package reads {stock}")
