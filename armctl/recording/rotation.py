"""The files that a daemon writes: its log, rotated and kept within bounds, a take, and the snapshot of a fault.

Rules.
1. A log is rotated when it is old or large enough (`LogConfig`), and when the wall clock was set: the next record
   begins another one, and the finished one is compacted (compact.py). The oldest logs are deleted when all of them take
   too much; a file's number, which only rises, says which those are (quota.py).
2. A file that fails is abandoned and the others go on. A log is tried again every `RETRY_NS`; at once where its file or
   folder was taken away. While the folder cannot be written the open files go on.
3. Every file can be replayed alone: the newest ticks back to a keyframe (`History`) are handed to each one.
4. Around a fault a snapshot is kept beside the log; a bound of its own deletes the oldest (quota.py). It alone has what
   went over the wire from `WIRE_BEFORE_NS` before a fault to `WIRE_AFTER_NS` after it.

Everything here runs in the recorder's thread (recorder.py), but for what its docstring says is for others.
"""

import errno
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from armctl.clock import NS_PER_S, Clock
from armctl.errors import LogError
from armctl.messages import Connected, Event, TickRecord
from armctl.recording import quota
from armctl.recording.channels import Anchor
from armctl.recording.disk import PART, Disk
from armctl.recording.writer import LogContext, LogWriter

RETRY_NS = 5 * NS_PER_S
# Longest snapshot, as a multiple of its ordinary length: faults may follow each other without end.
MAX_SNAPSHOT = 10
# Ticks kept beyond those of the last `keep_s`; several times what stands between two keyframes.
MAX_RECORDS = 2000
CLOCK_STEP_NS = NS_PER_S // 2
# The seconds of a ROS 2 stamp have 31 bits. A clock that is set to 2038 or later counts from 1970 again: times that are
# wrong are better than no log.
STAMPS_NS = 2**31 * NS_PER_S
WIRE_BEFORE_NS, WIRE_AFTER_NS = 2 * NS_PER_S, NS_PER_S
# Most pieces of the wire kept; of 2 s at 100 Hz and 10 servos they are 4000.
MAX_WIRE = 8000
LOG, TAKE, SNAPSHOT = "log", "take", "snapshot"
Ticks = tuple[TickRecord, ...]
# Tells epoch time [ns].
WallClock = Callable[[], int]
# Compacts the finished logs of a folder, some time.
Compactor = Callable[[Path], object]
_log = logging.getLogger(__name__)


class History:
    """The latest ticks, for files that begin with something that happened before them.

    A file replays alone if it begins with a keyframe and the inputs of every tick since; a snapshot of a fault wants
    the ticks before the fault as well. So the history reaches back to the newest keyframe older than `keep_s`.
    """

    def __init__(self, keep_s: float, period_s: float) -> None:
        self._keep_ns = round(keep_s * NS_PER_S)
        self._records: deque[TickRecord] = deque(maxlen=MAX_RECORDS + round(keep_s / period_s))

    def add(self, record: TickRecord) -> None:
        """The newest tick."""
        self._records.append(record)
        if not record.keyframe:
            return
        begin_ns = record.inputs.sample.time_ns - self._keep_ns
        older = [i for i, old in enumerate(self._records) if old.keyframe and old.inputs.sample.time_ns <= begin_ns]
        for _ in range(older[-1] if older else 0):
            self._records.popleft()

    def beginning(self, begin_ns: int | None = None) -> tuple[str, Ticks, Ticks]:
        """What a file begins with: a keyframe (empty: none is known), ticks for replay alone, ticks of its own.

        Args:
            begin_ns: The file's own ticks are those since then (monotonic); None: those from now on.
        """
        records = tuple(self._records)
        first = len(records)
        while begin_ns is not None and first > 0 and records[first - 1].inputs.sample.time_ns >= begin_ns:
            first -= 1
        for index in range(first - 1, -1, -1):
            if records[index].keyframe:
                return records[index].keyframe, records[index + 1 : first], records[first:]
        return "", (), records[first:]


class Files:
    """The log, and a take and a snapshot while there is one.

    Args:
        wall_ns: Epoch time [ns].
        compactor: Told of the folder when a log was rotated.
    """

    def __init__(
        self, context: LogContext, folder: Path, *, clock: Clock, wall_ns: WallClock, disk: Disk, compactor: Compactor
    ) -> None:
        # Why there is no log, or no take any more. Other threads read these two.
        self.log_problem = self.take_problem = ""
        # Whether something was written since the last flush.
        self.written = False
        self._context, self._folder, self._disk = context, folder, disk
        self._clock, self._compactor = clock, compactor
        self._wall_ns: WallClock = lambda: wall_ns() % STAMPS_NS
        self._open: dict[str, LogWriter] = {}
        self._history = History(context.config.log.snapshot_s, context.period_s)
        # Those of the latest tick: code, and since when.
        self._faults: set[tuple[str, int]] = set()
        # What went over the wire lately and is in no file.
        self._wire: deque[tuple[int, bool, bytes]] = deque(maxlen=MAX_WIRE)
        self._previous = ""
        self._snapshot_end_ns = self._wire_end_ns = self._retry_ns = 0
        self._clock_offset_ns: int | None = None
        self._retention = quota.Retention(folder, context.config.log, clock.now_ns, disk)
        # Whether no file can be begun or finished.
        self._read_only = False

    @property
    def log(self) -> LogWriter | None:
        """The log being written; for others its part and anchor alone."""
        return self._open.get(LOG)

    def new_take(self, path: Path) -> LogWriter:
        """A file for a take, with the log's clock anchor; for others. `begin_take` puts it to use.

        Raises:
            LogError: it cannot be written.
        """
        anchor = Anchor(self._wall_ns(), self._clock.now_ns()) if self.log is None else self.log.anchor
        return LogWriter(path, self._context, anchor=anchor, disk=self._disk)

    def begin_take(self, take: LogWriter) -> None:
        """Record into the take as well from now on."""
        keyframe, inputs_only, _ = self._history.beginning()
        take.begin(keyframe, inputs_only)
        self._open[TAKE] = take

    def note(self, text: str, time_ns: int) -> None:
        """Record a note (JSON) on /armctl/command at a monotonic time."""
        self._ensure_log()
        self._write(lambda writer: writer.write_note(text, time_ns))

    def record(self, record: TickRecord) -> bool:
        """Record a tick; whether it has to be on the disk at once."""
        for command in record.inputs.commands:
            if isinstance(command, Connected) and command.firmware:
                self._context = self._context._replace(firmware=command.firmware)
        self._wire += record.wire
        record = replace(record, wire=())
        self._rotate(record)
        self._ensure_log()
        self._write(lambda writer: writer.write_tick(record))
        self._history.add(record)
        time_ns, faults = record.inputs.sample.time_ns, record.outputs.faults
        new = [fault.code for fault in faults if (fault.code, fault.since_ns) not in self._faults]
        self._faults = {(fault.code, fault.since_ns) for fault in faults}
        if new:
            self._keep_snapshot(new[0], time_ns)
        elif SNAPSHOT in self._open and time_ns >= self._snapshot_end_ns:
            self.close(SNAPSHOT)
        while self._wire and self._wire[0][0] < time_ns - WIRE_BEFORE_NS:
            self._wire.popleft()
        if time_ns < self._wire_end_ns and self._wire:
            self._write(lambda writer: writer.write_wire(self._wire, time_ns), SNAPSHOT)
            self._wire.clear()
        return bool(new)

    def flush(self) -> None:
        """Return when everything written is on the disk."""
        self._watch_wall_clock()
        self._watch_files()
        self._write(LogWriter.flush)
        self.written = False

    def check_space(self) -> None:
        """Delete what may be deleted; close all files if the disk is too full all the same."""
        self._read_only = self._folder.is_dir() and not os.access(self._folder, os.W_OK | os.X_OK)
        if self._read_only:
            self._fail(f"LOG_ERROR: {self._folder}: can no longer be written; what is open goes on, nothing new begins")
        elif problem := self._space_problem():
            self._fail(problem)
            self.take_problem = problem if TAKE in self._open else self.take_problem
            self.close(LOG, TAKE, SNAPSHOT)
            self._retry_ns = self._clock.now_ns() + RETRY_NS
        elif self.log is not None:
            self.log_problem = ""

    def close(self, *kinds: str) -> None:
        """Finish the open files of these kinds."""
        self._write(LogWriter.close, *kinds)
        for kind in kinds:
            self._open.pop(kind, None)

    # ------------------------------------------------------------------------------------------ rotation

    def _rotate(self, record: TickRecord) -> None:
        """End the log if it is old or large enough; the next `_ensure_log` begins another one."""
        log, limits = self.log, self._context.config.log
        if log is None or self._read_only:
            return
        age_s = (record.inputs.sample.time_ns - log.begin_ns) / NS_PER_S
        if age_s >= limits.rotate_s or log.size_bytes >= limits.rotate_bytes:
            self.close(LOG)
            self._tidy()

    def _tidy(self) -> None:
        """Have compacted what is finished, and recovered what was abandoned."""
        try:
            self._compactor(self._folder)
        except OSError as error:
            _log.warning("%s: not compacted: %s", self._folder, error)

    def _ensure_log(self) -> None:
        """Open a log where there is none, unless the last attempt failed a moment ago."""
        now_ns = self._clock.now_ns()
        if self.log is not None or now_ns < self._retry_ns:
            return
        self._retry_ns = now_ns + RETRY_NS
        anchor = Anchor(self._wall_ns(), now_ns)
        try:
            if problem := self._space_problem():
                self._fail(problem)
                return
            self._begin(LOG, f"{quota.LOG}-{_stamp(anchor.wall_ns)}", self._previous, anchor)
        except (LogError, OSError) as error:
            self._fail(_problem(error))
            return
        log = self._open[LOG]
        self._previous = log.path.name
        self._retry_ns = 0
        self._clock_offset_ns = anchor.wall_ns - anchor.monotonic_ns
        if self.log_problem:
            _log.info("recording again, to %s", log.path)
            self._tidy()
        self.log_problem = ""

    def _keep_snapshot(self, code: str, time_ns: int) -> None:
        """Keep the ticks before and after a fault; one that follows soon only makes it longer."""
        span_ns = round(self._context.config.log.snapshot_s * NS_PER_S)
        self._snapshot_end_ns, self._wire_end_ns = time_ns + span_ns, time_ns + WIRE_AFTER_NS
        if (snapshot := self._open.get(SNAPSHOT)) is not None:
            self._snapshot_end_ns = min(self._snapshot_end_ns, snapshot.begin_ns + MAX_SNAPSHOT * span_ns)
            return
        if (log := self.log) is None:
            return  # no space, or no folder: the log's problem says so
        stem = f"{quota.FAULT}-{_stamp(log.anchor.epoch_ns(time_ns))}-{code}"
        try:
            records = self._begin(SNAPSHOT, stem, log.path.name, log.anchor, time_ns - span_ns)
        except (LogError, OSError) as error:
            _log.error("no snapshot of %s: %s", code, error)
            return
        for record in records:
            self._write(partial(LogWriter.write_tick, record=record), SNAPSHOT)

    def _begin(self, kind: str, stem: str, previous: str, anchor: Anchor, begin_ns: int | None = None) -> Ticks:
        """Open a file beside the logs; returns the ticks since `begin_ns`, which are to be written to it."""
        numbers = iter(self._retention.next_number, None)
        paths = (self._folder / f"{stem}-{number:0{quota.DIGITS}d}.mcap" for number in numbers)
        path = next(path for path in paths if not path.exists() and not path.with_name(path.name + PART).exists())
        keyframe, inputs_only, records = self._history.beginning(begin_ns)
        self._open[kind] = LogWriter(path, self._context, previous=previous, anchor=anchor, disk=self._disk)
        self._open[kind].begin(keyframe, inputs_only)
        return records

    # ------------------------------------------------------------------------------------------ failures

    def _write(self, action: Callable[[LogWriter], None], *kinds: str) -> None:
        """Do something to every open file, or those of these kinds; one that fails is abandoned, the others go on."""
        for kind in kinds or (LOG, TAKE, SNAPSHOT):
            if kind in self._open:
                self.written = True
                try:
                    action(self._open[kind])
                except (LogError, ValueError) as error:
                    self._abandon(kind, error)

    def _abandon(self, kind: str, error: Exception) -> None:
        """Abandon a file that failed; it stays as a part, to be recovered."""
        self._open.pop(kind).abandon()
        if kind == TAKE:
            self.take_problem = _problem(error)
            _log.error("%s", self.take_problem)
        elif kind == SNAPSHOT:
            _log.error("the snapshot of a fault ends here: %s", error)
        else:
            self._fail(_problem(error))
            self._retry_ns = self._clock.now_ns() + RETRY_NS

    def _fail(self, problem: str) -> None:
        if problem != self.log_problem:
            _log.error("%s", problem)
        self.log_problem = problem

    def _space_problem(self) -> str:
        """Why nothing may be written, after deleting what may be deleted."""
        limits, folder = self._context.config.log, self._folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._retention.enforce(0 if self.log is None else self.log.size_bytes)
            free = self._disk.free_bytes(folder)
        except OSError as error:
            return _problem(error)
        if free >= limits.free_bytes:
            return ""
        free_mib, need_mib = (f"{size / 2**20:.0f}" for size in (free, limits.free_bytes))
        return f"NO_SPACE: {free_mib} MiB free, {need_mib} needed; {quota.remedy(folder)}"

    def _watch_files(self) -> None:
        """Let go of files that are no longer where they were begun: what is written to them nobody will find."""
        for kind in (LOG, TAKE, SNAPSHOT):
            if kind in self._open and not self._open[kind].in_place:
                self._abandon(kind, LogError(f"{self._open[kind].part}: was taken away while it was written"))
                self._retry_ns = 0

    def _watch_wall_clock(self) -> None:
        """Note in the files when the wall clock steps, and begin another log: a file's times come from its anchor."""
        now_ns = self._clock.now_ns()
        offset_ns = self._wall_ns() - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            text = f"the wall clock was set by {(offset_ns - self._clock_offset_ns) / NS_PER_S:+.3f} s"
            self._write(lambda writer: writer.write_event(Event("warning", "CLOCK_STEP", text), now_ns))
            self._clock_offset_ns = offset_ns
            if not self._read_only:
                self.close(LOG)
                self._tidy()


def _stamp(epoch_ns: int) -> str:
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(epoch_ns // NS_PER_S))


def _problem(error: Exception) -> str:
    cause = error if isinstance(error, OSError) else error.__cause__
    number = cause.errno if isinstance(cause, OSError) else None
    return f"{'NO_SPACE' if number in (errno.ENOSPC, errno.EDQUOT) else 'LOG_ERROR'}: {error}"
