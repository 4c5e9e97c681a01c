"""The recorder: one thread that feeds the log, and a take while there is one, from one bounded queue.

Rules.
1. Whoever puts a record never waits: for no disk, no lock that is held during input or output, no full queue.
   A record that finds the queue full is dropped and counted; the next one tells how many were.
2. Recording may fail, control may not: a full disk or a failing one ends in `problem`, is tried again every
   `RETRY_NS`, and nobody else notices.
3. Every file can be replayed alone: the recorder keeps the newest keyframe and the records after it, and hands
   them to each file it begins.
4. Data reach the disk every second, and at once when a fault appears. Closing drains the queue first.
"""

from __future__ import annotations

import errno
import logging
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from armctl.clock import NS_PER_S, Clock, MonotonicClock
from armctl.errors import LogError
from armctl.messages import Event, TickRecord
from armctl.recording.channels import Anchor
from armctl.recording.recordings import take_path
from armctl.recording.writer import LogContext, LogWriter

QUEUE_RECORDS = 3000
FLUSH_NS = NS_PER_S
RETRY_NS = 5 * NS_PER_S
CLOSE_S = 2.0
TAKE_END_S = 10.0
MAX_RECORDS_AFTER_KEYFRAME = 2000
CLOCK_STEP_NS = NS_PER_S // 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Note:
    topic: str
    text: str
    time_ns: int


class Recorder:
    """Main log with rotation, and one named take at a time.

    Args:
        clock: What flushing and retrying go by.
        wall_ns: Epoch time [ns].
        queue_records: Bound of the queue.
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
    ) -> None:
        self._log_problem = self._take_problem = ""
        self._context, self._log_dir, self._recordings_dir = context, log_dir, recordings_dir
        self._clock, self._wall_ns = clock or MonotonicClock(), wall_ns
        self._queue_records = queue_records
        # Shared with the thread, under the condition's lock.
        self._condition = threading.Condition()
        self._queue: deque[TickRecord | _Note | Callable[[], None]] = deque()
        self._dropped = 0
        self._closing = False
        # The thread's own.
        self._writer: LogWriter | None = None
        self._take: LogWriter | None = None
        self._previous = ""
        self._keyframe = ""
        self._after_keyframe: list[TickRecord] = []
        self._last: TickRecord | None = None
        self._written = False
        self._flushed_ns = self._clock.now_ns()
        self._retry_ns = 0
        self._clock_offset_ns: int | None = None
        # The caller's own.
        self._take_path: Path | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Why something is not being recorded, beginning with NO_SPACE or LOG_ERROR; empty if all is well."""
        return self._log_problem or self._take_problem

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
        take = LogWriter(path, self._context, anchor=anchor)

        def begin() -> None:
            take.begin(self._keyframe, tuple(self._after_keyframe))
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
                    self._condition.wait(FLUSH_NS / NS_PER_S)
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
            if self._written and self._clock.now_ns() - self._flushed_ns >= FLUSH_NS:
                self._flush()
        self._close(self._take)
        self._close(self._writer)

    def _note(self, note: _Note) -> None:
        self._ensure_log()
        self._write(lambda writer: writer.write_note(note.topic, note.text, note.time_ns))

    def _record(self, record: TickRecord) -> None:
        last = self._last
        if record.dropped or (last is not None and record.inputs.tick != last.inputs.tick + 1):
            self._keyframe = ""
        self._rotate(record)
        self._ensure_log()
        self._write(lambda writer: writer.write_tick(record))
        self._last = record
        if record.keyframe:
            self._keyframe, self._after_keyframe = record.keyframe, []
        elif self._keyframe and len(self._after_keyframe) < MAX_RECORDS_AFTER_KEYFRAME:
            self._after_keyframe.append(record)
        else:
            self._keyframe, self._after_keyframe = "", []
        before = None if last is None else last.outputs.fault
        if record.outputs.fault is not None and record.outputs.fault != before:
            self._flush()

    def _rotate(self, record: TickRecord) -> None:
        writer, limits = self._writer, self._context.config.log
        if writer is None:
            return
        age_s = (record.inputs.sample.time_ns - writer.begin_ns) / NS_PER_S
        if age_s >= limits.rotate_s or writer.size_bytes >= limits.rotate_bytes:
            self._close(writer)

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
            self._writer = LogWriter(
                self._new_path(anchor),
                self._context,
                keyframe=self._keyframe,
                previous=self._previous,
                anchor=anchor,
                inputs_only=tuple(self._after_keyframe) if self._keyframe else (),
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

    def _new_path(self, anchor: Anchor) -> Path:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(anchor.wall_ns // NS_PER_S))
        number = 1
        while True:
            path = self._log_dir / f"armctl-{stamp}{'' if number == 1 else f'-{number}'}.mcap"
            if not path.exists() and not path.with_name(path.name + ".part").exists():
                return path
            number += 1

    def _write(self, action: Callable[[LogWriter], None]) -> None:
        """Do something to the log and to the take; whichever fails is let go of, the other goes on."""
        for writer in (self._writer, self._take):
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
        if problem := self._space_problem():
            self._fail(problem)
            self._close(self._writer)
            self._close(self._take)
            self._retry_ns = self._clock.now_ns() + RETRY_NS

    def _watch_wall_clock(self) -> None:
        """Tell when the wall clock steps; the files go by their anchors and do not care."""
        now_ns = self._clock.now_ns()
        offset_ns = self._wall_ns() - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            text = f"the wall clock was set by {(offset_ns - self._clock_offset_ns) / NS_PER_S:+.3f} s"
            self._write(lambda writer: writer.write_event(Event("warning", "CLOCK_STEP", text), now_ns))
            self._clock_offset_ns = offset_ns

    def _space_problem(self) -> str:
        need = self._context.config.log.free_bytes
        folder = self._log_dir
        try:
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
        except OSError as error:
            return _problem(error)
        if free >= need:
            return ""
        return f"NO_SPACE: {free / 2**20:.0f} MiB free in {folder}, {need / 2**20:.0f} needed; delete old logs"

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
        else:
            self._fail(_problem(error))
            self._retry_ns = self._clock.now_ns() + RETRY_NS
        self._forget(writer)

    def _forget(self, writer: LogWriter) -> None:
        if writer is self._take:
            self._take = None
        else:
            self._writer = None

    def _fail(self, problem: str) -> None:
        if problem != self._log_problem:
            _log.error("%s", problem)
        self._log_problem = problem


def _problem(error: Exception) -> str:
    cause = error if isinstance(error, OSError) else error.__cause__
    number = cause.errno if isinstance(cause, OSError) else None
    code = "NO_SPACE" if number in (errno.ENOSPC, errno.EDQUOT) else "LOG_ERROR"
    return f"{code}: {error}"
