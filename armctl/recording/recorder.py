"""The recorder: one thread that feeds the log, and a take or a snapshot while there is one, from one bounded queue.

Rules.
1. Whoever puts a record never waits: for no disk, no lock that is held during input or output, no full queue.
   A record that finds the queue full is dropped and counted; the next one tells how many were.
2. Recording may fail, control may not: a full, slow or failing disk ends in `problem`, is tried again every
   `RETRY_NS`, and nobody else notices.
3. Every file can be replayed alone: the recorder keeps the newest ticks back to a keyframe (history.py), and hands
   them to each file it begins.
4. What was put a second ago is on the disk: it is flushed so often that the time the disk needs is within that
   second, and at once when a fault appears. Closing drains the queue first.
5. Around a fault a snapshot is kept beside the log, which no bound on the logs deletes (quota.py).
"""

import errno
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from armctl.clock import NS_PER_S, Clock, MonotonicClock
from armctl.errors import LogError
from armctl.messages import Connected, Event, TickRecord
from armctl.recording import quota
from armctl.recording.channels import Anchor
from armctl.recording.compact import Compaction
from armctl.recording.disk import DISK, PART, Disk
from armctl.recording.history import History
from armctl.recording.recordings import take_path
from armctl.recording.writer import LogContext, LogWriter

QUEUE_RECORDS = 3000
FLUSH_NS = 9 * NS_PER_S // 10
"""From the beginning of one flush to the end of the next one."""
SLOW_NS = NS_PER_S
"""A flush that takes longer breaks the promise of one second, and is told."""
RETRY_NS = 5 * NS_PER_S
CLOSE_S = 2.0
TAKE_END_S = 10.0
MAX_SNAPSHOT = 10
"""A snapshot lasts no longer than so many times its ordinary length, however many faults follow each other."""
CLOCK_STEP_NS = NS_PER_S // 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Note:
    topic: str
    text: str
    time_ns: int


class Compactor(Protocol):
    """Compacts the finished logs of a folder, some time."""

    def start(self, folder: Path) -> None: ...


class Recorder:
    """Main log with rotation, and one named take at a time.

    Args:
        clock: What flushing and retrying go by.
        wall_ns: Epoch time [ns].
        queue_records: Bound of the queue.
        disk: Where the files go.
        compactor: Told of the folder when a log was rotated.
    """

    def __init__(
        self,
        context: LogContext,
        log_dir: Path,
        recordings_dir: Path,
        *,
        clock: Clock | None = None,
        wall_ns: Callable[[], int] = time.time_ns,
        queue_records: int = QUEUE_RECORDS,
        disk: Disk = DISK,
        compactor: Compactor | None = None,
    ) -> None:
        self._log_problem = self._take_problem = self._slow_problem = ""
        self._context, self._log_dir, self._recordings_dir = context, log_dir, recordings_dir
        self._clock, self._wall_ns = clock or MonotonicClock(), wall_ns
        self._queue_records = queue_records
        self._disk, self._compactor = disk, compactor or Compaction()
        # Shared with the thread, under the condition's lock.
        self._condition = threading.Condition()
        self._queue: deque[TickRecord | _Note | Callable[[], None]] = deque()
        self._dropped = 0
        self._dropped_total = 0
        self._closing = False
        # The thread's own.
        self._writer: LogWriter | None = None
        self._take: LogWriter | None = None
        self._snapshot: LogWriter | None = None
        self._snapshot_end_ns = 0
        self._previous = ""
        self._history = History(context.config.log.snapshot_s, context.period_s)
        self._last: TickRecord | None = None
        self._written = False
        self._flushed_ns, self._flush_took_ns = self._clock.now_ns(), 0
        self._retry_ns = 0
        self._clock_offset_ns: int | None = None
        # The caller's own.
        self._take_path: Path | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Why something is not being recorded, beginning with NO_SPACE, LOG_ERROR or SLOW_DISK; empty: all is well."""
        return self._log_problem or self._take_problem or self._slow_problem

    @property
    def dropped_records(self) -> int:
        """Ticks lost since the start because the queue was full."""
        return self._dropped_total

    @property
    def log_path(self) -> Path | None:
        """Final name of the log being written; None while there is none."""
        writer = self._writer
        return None if writer is None else writer.path

    @property
    def take_path(self) -> Path | None:
        """Final name of the take being recorded; None while there is none."""
        return self._take_path

    def put(self, record: TickRecord) -> None:
        """Record one tick. Never blocks."""
        self._put(record)

    def note(self, topic: str, text: str, time_ns: int) -> None:
        """Record a text (JSON) on a std_msgs/String topic at a monotonic time. Never blocks."""
        self._put(_Note(topic, text, time_ns))

    def begin_take(self, name: str) -> Path:
        """Record into a take as well from now on.

        Returns:
            The path the take will have once it is ended.
        Raises:
            LogError: the name is not acceptable or taken, a take is being recorded, or it cannot be written.
        """
        path = take_path(self._recordings_dir, name)
        if self._take_path is not None:
            raise LogError(f"take {name}: {self._take_path.stem} is being recorded; end it first")
        if self._log_problem:
            raise LogError(f"take {name}: cannot be recorded now: {self._log_problem}")
        writer = self._writer
        anchor = Anchor(self._wall_ns(), self._clock.now_ns()) if writer is None else writer.anchor
        take = LogWriter(path, self._context, anchor=anchor, disk=self._disk)

        def begin() -> None:
            beginning = self._history.beginning()
            take.begin(beginning.keyframe, beginning.inputs_only)
            self._take = take

        self._take_problem = ""
        self._put(begin)
        self._take_path = take.path
        return take.path

    def end_take(self) -> Path | None:
        """End the take, and return its path when the file is complete; None if none was being recorded.

        Raises:
            LogError: it could not be completed; what was written is kept as a part.
        """
        path, self._take_path = self._take_path, None
        if path is None:
            return None
        done = threading.Event()

        def end() -> None:
            self._close(self._take)
            done.set()

        self._put(end)
        completed = done.wait(TAKE_END_S) and path.exists()
        problem, self._take_problem = self.problem or "the disk does not answer", ""
        if not completed:
            raise LogError(f"{path}: the take could not be completed ({problem}); what was written stays as a part")
        return path

    def close(self) -> None:
        """Write what is queued, close and rename the files; gives up after 2 s, which leaves parts to recover."""
        with self._condition:
            self._closing = True
            self._condition.notify()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            _log.error("the disk did not take the log within %g s; it stays as a part and is recovered later", CLOSE_S)

    def _put(self, item: TickRecord | _Note | Callable[[], None]) -> None:
        with self._condition:
            full = len(self._queue) >= self._queue_records
            if full and not callable(item):
                self._dropped += isinstance(item, TickRecord)
                self._dropped_total += isinstance(item, TickRecord)
                return
            if isinstance(item, TickRecord) and self._dropped:
                item, self._dropped = replace(item, dropped=item.dropped + self._dropped), 0
            self._queue.append(item)
            self._condition.notify()

    # ------------------------------------------------------------------------------------------ the thread

    def _run(self) -> None:
        while True:
            with self._condition:
                if not self._queue and not self._closing:
                    wait_ns = self._flush_due_ns() - self._clock.now_ns() if self._written else FLUSH_NS
                    self._condition.wait(min(max(wait_ns, FLUSH_NS // 100), FLUSH_NS) / NS_PER_S)
                item = self._queue.popleft() if self._queue else None
                closing = self._closing
            if isinstance(item, TickRecord):
                self._record(item)
            elif isinstance(item, _Note):
                self._note(item)
            elif item is not None:
                item()
            elif closing:
                break
            if self._written and self._clock.now_ns() >= self._flush_due_ns():
                self._flush()
        for writer in (self._take, self._snapshot, self._writer):
            self._close(writer)

    def _flush_due_ns(self) -> int:
        """When to begin the next flush for it to be over in time, if the disk is as fast as it was."""
        return self._flushed_ns + max(0, FLUSH_NS - self._flush_took_ns)

    def _note(self, note: _Note) -> None:
        self._ensure_log()
        self._write(lambda writer: writer.write_note(note.topic, note.text, note.time_ns))

    def _record(self, record: TickRecord) -> None:
        for command in record.inputs.commands:
            if isinstance(command, Connected) and command.firmware:
                self._context = replace(self._context, firmware=command.firmware)
        self._rotate(record)
        self._ensure_log()
        self._write(lambda writer: writer.write_tick(record))
        self._history.add(record)
        before = None if self._last is None else self._last.outputs.fault
        self._last = record
        time_ns = record.inputs.sample.time_ns
        if record.outputs.fault is not None and record.outputs.fault != before:
            self._keep_snapshot(record.outputs.fault.code, time_ns)
            self._flush()
        elif self._snapshot is not None and time_ns >= self._snapshot_end_ns:
            self._close(self._snapshot)

    def _keep_snapshot(self, code: str, time_ns: int) -> None:
        """Keep the ticks before and after a fault; one that follows soon only makes it longer."""
        span_ns = round(self._context.config.log.snapshot_s * NS_PER_S)
        if self._snapshot is not None:
            end_ns = self._snapshot.begin_ns + MAX_SNAPSHOT * span_ns
            self._snapshot_end_ns = min(time_ns + span_ns, end_ns)
            return
        if self._writer is None:
            return  # no space, or no folder: the log tells
        beginning = self._history.beginning(time_ns - span_ns)
        anchor = self._writer.anchor
        stamp = anchor.epoch_ns(time_ns)
        try:
            self._snapshot = LogWriter(
                self._new_path(f"{quota.FAULT}-{_stamp(stamp)}-{code}"),
                self._context,
                keyframe=beginning.keyframe,
                previous=self._writer.path.name,
                anchor=anchor,
                inputs_only=beginning.inputs_only,
                disk=self._disk,
            )
            for record in beginning.records:
                self._snapshot.write_tick(record)
        except (LogError, ValueError) as error:
            _log.error("no snapshot of %s: %s", code, error)
            if self._snapshot is not None:
                self._let_go(self._snapshot, error)
        self._snapshot_end_ns = time_ns + span_ns

    def _rotate(self, record: TickRecord) -> None:
        writer, limits = self._writer, self._context.config.log
        if writer is None:
            return
        age_s = (record.inputs.sample.time_ns - writer.begin_ns) / NS_PER_S
        if age_s >= limits.rotate_s or writer.size_bytes >= limits.rotate_bytes:
            self._close(writer)
            try:
                self._compactor.start(self._log_dir)
            except OSError as error:
                _log.warning("%s: not compacted: %s", writer.path, error)

    def _ensure_log(self) -> None:
        """Open a log where there is none, unless the last attempt failed a moment ago."""
        now_ns = self._clock.now_ns()
        if self._writer is not None or now_ns < self._retry_ns:
            return
        self._retry_ns = now_ns + RETRY_NS
        anchor = Anchor(self._wall_ns(), now_ns)
        try:
            if problem := self._space_problem():
                self._fail(problem)
                return
            beginning = self._history.beginning()
            self._writer = LogWriter(
                self._new_path(f"{quota.LOG}-{_stamp(anchor.wall_ns)}"),
                self._context,
                keyframe=beginning.keyframe,
                previous=self._previous,
                anchor=anchor,
                inputs_only=beginning.inputs_only,
                disk=self._disk,
            )
        except (LogError, OSError) as error:
            self._fail(_problem(error))
            return
        self._previous = self._writer.path.name
        self._retry_ns = 0
        self._clock_offset_ns = anchor.wall_ns - anchor.monotonic_ns
        if self._log_problem:
            _log.info("recording again, to %s", self._writer.path)
        self._log_problem = ""

    def _new_path(self, stem: str) -> Path:
        number = 1
        while True:
            path = self._log_dir / f"{stem}{'' if number == 1 else f'-{number}'}.mcap"
            if not path.exists() and not path.with_name(path.name + PART).exists():
                return path
            number += 1

    def _write(self, action: Callable[[LogWriter], None]) -> None:
        """Do something to every file being written; whichever fails is let go of, the others go on."""
        for writer in (self._writer, self._take, self._snapshot):
            if writer is None:
                continue
            self._written = True
            try:
                action(writer)
            except (LogError, ValueError) as error:
                self._let_go(writer, error)

    def _flush(self) -> None:
        self._written, self._flushed_ns = False, self._clock.now_ns()
        self._watch_wall_clock()
        self._write(LogWriter.flush)
        self._written = False
        self._flush_took_ns = self._clock.now_ns() - self._flushed_ns
        self._tell_slowness()
        if problem := self._space_problem():
            self._fail(problem)
            for writer in (self._writer, self._take, self._snapshot):
                self._close(writer)
            self._retry_ns = self._clock.now_ns() + RETRY_NS

    def _tell_slowness(self) -> None:
        slow, took_s = self._flush_took_ns > SLOW_NS, self._flush_took_ns / NS_PER_S
        text = f"SLOW_DISK: {self._log_dir}: writing took {took_s:.1f} s, and so much is lost if the power fails"
        if slow and not self._slow_problem:
            _log.warning("%s", text)
        self._slow_problem = text if slow else ""

    def _watch_wall_clock(self) -> None:
        """Tell when the wall clock steps; the files go by their anchors and do not care."""
        now_ns = self._clock.now_ns()
        offset_ns = self._wall_ns() - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            text = f"the wall clock was set by {(offset_ns - self._clock_offset_ns) / NS_PER_S:+.3f} s"
            self._write(lambda writer: writer.write_event(Event("warning", "CLOCK_STEP", text), now_ns))
            self._clock_offset_ns = offset_ns

    def _space_problem(self) -> str:
        """Why nothing may be written, after deleting what may be deleted."""
        limits, folder = self._context.config.log, self._log_dir
        try:
            folder.mkdir(parents=True, exist_ok=True)
            quota.enforce(folder, limits, disk=self._disk)
            free = self._disk.free_bytes(folder)
        except OSError as error:
            return _problem(error)
        if free >= limits.free_bytes:
            return ""
        need = limits.free_bytes / 2**20
        return f"NO_SPACE: {free / 2**20:.0f} MiB free in {folder}, {need:.0f} needed; delete old logs"

    def _close(self, writer: LogWriter | None) -> None:
        if writer is None:
            return
        try:
            writer.close()
        except (LogError, ValueError) as error:
            self._let_go(writer, error)
        else:
            self._forget(writer)

    def _let_go(self, writer: LogWriter, error: Exception) -> None:
        writer.abandon()
        if writer is self._take:
            self._take_problem = _problem(error)
            _log.error("%s", self._take_problem)
        elif writer is self._snapshot:
            _log.error("the snapshot of a fault ends here: %s", error)
        else:
            self._fail(_problem(error))
            self._retry_ns = self._clock.now_ns() + RETRY_NS
        self._forget(writer)

    def _forget(self, writer: LogWriter) -> None:
        if writer is self._take:
            self._take = None
        elif writer is self._snapshot:
            self._snapshot = None
        else:
            self._writer = None

    def _fail(self, problem: str) -> None:
        if problem != self._log_problem:
            _log.error("%s", problem)
        self._log_problem = problem


def _stamp(epoch_ns: int) -> str:
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(epoch_ns // NS_PER_S))


def _problem(error: Exception) -> str:
    cause = error if isinstance(error, OSError) else error.__cause__
    number = cause.errno if isinstance(cause, OSError) else None
    code = "NO_SPACE" if number in (errno.ENOSPC, errno.EDQUOT) else "LOG_ERROR"
    return f"{code}: {error}"
