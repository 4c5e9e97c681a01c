"""A recorder on a clock of the test's own."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import Config, LogConfig
from armctl.messages import TickRecord
from armctl.recording.recorder import Recorder
from tests.recording.factory import CONTEXT

WALL_NS = 1_750_000_000 * NS_PER_S


class Rig:
    """A recorder on a clock of the test's own, in step with its thread through `settle`."""

    def __init__(self, folder: Path, compactor: Callable[[Path], object] | None = None, **log: Any) -> None:
        self.logs, self.takes = folder / "logs", folder / "recordings"
        self.clock = VirtualClock(5 * NS_PER_S)
        self.wall_offset_ns = WALL_NS
        # Folders that were to be compacted.
        self.compacted: list[Path] = []
        self.recorder = Recorder(
            CONTEXT._replace(config=Config(log=LogConfig(free_bytes=log.pop("free_bytes", 0), **log))),
            self.logs,
            self.takes,
            clock=self.clock,
            wall_ns=lambda: self.clock.now_ns() + self.wall_offset_ns,
            compactor=compactor or self.compacted.append,
        )

    def settle(self) -> None:
        """Return when the thread has done everything queued before."""
        done = threading.Event()
        self.recorder._queue.put(done.set)
        assert done.wait(10.0)

    def put(self, records: list[TickRecord]) -> None:
        """Records at their own times."""
        for record in records:
            self.clock.sleep_until_ns(record.inputs.now_ns)
            self.recorder.put(record)
            self.settle()

    @property
    def part(self) -> Path:
        """The log being written."""
        assert self.recorder.log_path is not None
        return self.recorder.log_path

    def close(self) -> list[Path]:
        self.recorder.close()
        return sorted(self.logs.glob("*"))

    def only_log(self) -> Path:
        """The one file there is when all is written."""
        (path,) = self.close()
        return path


def failing(number: int) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail
