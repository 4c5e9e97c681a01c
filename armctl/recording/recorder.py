"""The recorder: one thread that writes what is put into one bounded queue.

Which files it writes, and when it begins another one, is said in rotation.py.

Rules.
1. Whoever puts a record never waits: for no disk, no lock that is held during input or output, no full queue.
   A record that finds the queue full is dropped and counted; the next one says how many were.
2. Recording may fail, control may not: a full, slow or failing disk ends in `problem`, and nobody else notices.
3. What was put a second ago is on the disk: it is flushed so often that the time the disk needs is within that
   second, and at once when a fault appears. Closing writes the whole queue first.
4. A disk that takes longer than that is asked again only when all that came meanwhile is written: it loses nothing.
"""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue

from armctl.clock import NS_PER_S, Clock, MonotonicClock
from armctl.errors import LogError
from armctl.messages import TickRecord
from armctl.recording.compact import Compaction
from armctl.recording.disk import DISK, Disk
from armctl.recording.recordings import take_path
from armctl.recording.rotation import LOG, SNAPSHOT, TAKE, Compactor, Files, WallClock
from armctl.recording.writer import LogContext

QUEUE_RECORDS = 3000
# Longest time from the beginning of one flush to the end of the next one.
FLUSH_NS = 9 * NS_PER_S // 10
# A flush that takes longer breaks the promise of one second, and becomes a `problem`.
SLOW_NS = NS_PER_S
CLOSE_S = 2.0
TAKE_END_S = 10.0
_log = logging.getLogger(__name__)


class Recorder:
    """The daemon's log, and one named take at a time.

    Args:
        clock: Says when to flush and when to try again.
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
        wall_ns: WallClock = time.time_ns,
        queue_records: int = QUEUE_RECORDS,
        disk: Disk = DISK,
        compactor: Compactor | None = None,
    ) -> None:
        self._clock = clock or MonotonicClock()
        self._log_dir, self._recordings_dir, self._queue_records = log_dir, recordings_dir, queue_records
        # Shared with the thread, which does what is in it, too, full or not; None: nothing more will come.
        self._queue: SimpleQueue[TickRecord | Callable[[], None] | None] = SimpleQueue()
        # Ticks lost because the queue was full: since the last one that was not, and since the start.
        self._dropped = self.dropped_records = 0
        # The thread's own.
        compactor = compactor or Compaction().start
        self._files = Files(context, log_dir, clock=self._clock, wall_ns=wall_ns, disk=disk, compactor=compactor)
        self._flushed_ns, self._flush_took_ns = self._clock.now_ns(), 0
        # What came during the last flush, if that was a slow one, and is not written yet.
        self._behind = 0
        self._slow_problem = ""
        # The caller's own: final name of the take being recorded.
        self.take_path: Path | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Why something is not being recorded, beginning with NO_SPACE, LOG_ERROR or SLOW_DISK; empty: all is well."""
        return self._files.log_problem or self._files.take_problem or self._slow_problem

    @property
    def log_path(self) -> Path | None:
        """The log being written, a part until it is ended; None while there is none."""
        log = self._files.log
        return None if log is None else log.part

    def put(self, record: TickRecord) -> None:
        """Record one tick. Never blocks."""
        if self._queue.qsize() >= self._queue_records:
            self._dropped += 1
            self.dropped_records += 1
            return
        if self._dropped:
            record, self._dropped = replace(record, dropped=record.dropped + self._dropped), 0
        self._queue.put(record)

    def note(self, text: str, time_ns: int) -> None:
        """Record a note (JSON) on /armctl/command at a monotonic time. Never blocks."""
        if self._queue.qsize() < self._queue_records:
            self._queue.put(partial(self._files.note, text, time_ns))

    def check(self) -> None:
        """Raises LogError where no take can be begun now."""
        if self._files.log_problem:
            raise LogError(f"no take can be recorded now: {self._files.log_problem}")

    def begin_take(self, name: str) -> Path:
        """Record into a take as well from now on.

        Returns:
            The path the take will have once it is ended.
        Raises:
            LogError: the name is not acceptable or taken, a take is being recorded, or it cannot be written.
        """
        path = take_path(self._recordings_dir, name)
        if self.take_path is not None:
            raise LogError(f"take {name}: {self.take_path.stem} is being recorded; end it first")
        self.check()
        take = self._files.new_take(path)
        self._files.take_problem = ""
        self._queue.put(partial(self._files.begin_take, take))
        self.take_path = path
        return path

    def end_take(self) -> Path | None:
        """End the take, and return its path when the file is complete; None if none was being recorded.

        Raises:
            LogError: it could not be completed, or ended early; what was written is kept.
        """
        path, self.take_path = self.take_path, None
        if path is None:
            return None
        done = threading.Event()
        self._queue.put(partial(self._files.close, TAKE))
        self._queue.put(done.set)
        completed = done.wait(TAKE_END_S) and path.exists()
        early, problem = self._files.take_problem, self.problem or "the disk does not answer"
        self._files.take_problem = ""
        if not completed:
            raise LogError(f"{path}: the take could not be completed ({problem}); what was written stays as a part")
        if early:
            raise LogError(f"{path}: the take ended early ({early}); it holds what came before")
        return path

    def close(self) -> None:
        """Write what is queued, close and rename the files; gives up after 2 s, which leaves parts to recover."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            _log.error("the disk did not take the log within %g s; it stays as a part and is recovered later", CLOSE_S)

    # ------------------------------------------------------------------------------------------ the thread

    def _run(self) -> None:
        files, urgent = self._files, False
        while True:
            wait_ns = self._flush_due_ns() - self._clock.now_ns() if files.written else FLUSH_NS
            with suppress(Empty):
                item = self._queue.get(timeout=min(max(wait_ns, FLUSH_NS // 100), FLUSH_NS) / NS_PER_S)
                if item is None:
                    break
                if isinstance(item, TickRecord):
                    urgent |= files.record(item)
                else:
                    item()
            self._behind = max(0, self._behind - 1)
            if files.written and (urgent or self._clock.now_ns() >= self._flush_due_ns()) and not self._behind:
                self._flush()
                urgent = False
        files.close(TAKE, SNAPSHOT, LOG)

    def _flush_due_ns(self) -> int:
        """When to begin the next flush for it to be over in time, if the disk is as fast as it was."""
        return self._flushed_ns + max(0, FLUSH_NS - self._flush_took_ns)

    def _flush(self) -> None:
        self._flushed_ns = self._clock.now_ns()
        self._files.flush()
        self._flush_took_ns = self._clock.now_ns() - self._flushed_ns
        slow, took_s = self._flush_took_ns > SLOW_NS, self._flush_took_ns / NS_PER_S
        text = f"SLOW_DISK: {self._log_dir}: writing took {took_s:.1f} s, and so much is lost if the power fails"
        if slow and not self._slow_problem:
            _log.warning("%s", text)
        self._slow_problem = text if slow else ""
        self._files.check_space()
        self._behind = self._queue.qsize() if self._flush_took_ns > FLUSH_NS else 0
