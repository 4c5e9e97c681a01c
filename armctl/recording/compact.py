"""Compaction: a log that was flushed every second, rewritten with large chunks, in its place.

Rules.
1. A log is replaced only by a file that was read back and holds the same messages in the same order, bit for bit;
   on the disk before it takes the name. What is damaged, being written or compacted already is left alone.
2. It runs in a process of its own that takes what time nobody else wants, recovers first what a crash left, and brings
   the index of the folder up to date last (index.py):
   `python -m armctl.recording.compact FOLDER...`.
"""

import contextlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

from armctl.errors import LogError
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import DISK, Disk, new_file, owned
from armctl.recording.index import bring_up_to_date
from armctl.recording.log_file import LogFile
from armctl.recording.quota import stock
from armctl.recording.recover import recover_folder
from armctl.recording.rewrite import Rewrite

# Metadata record of a file that needs no more compacting.
COMPACTED = "compacted"
# zstd level; a higher one takes more time and hardly makes the files smaller.
LEVEL = 9
# Size of a chunk before compression. The numbers of a moving arm repeat after a while: with chunks of 1 MiB, which
# are too short for that, a file is a fifth larger.
CHUNK_BYTES = 4 * 2**20
_UNFINISHED = ".compacting"
_log = logging.getLogger(__name__)


def compact(path: Path, *, disk: Disk = DISK) -> bool:
    """Rewrite one log in its place; False if there is nothing to gain.

    Raises:
        LogError: the log cannot be read, is damaged, or the new file cannot be written; the old one is as it was.
    """
    with owned(path), LogFile(path) as log:
        if COMPACTED in log.metadata:
            return False
        with new_file(path, disk, suffix=_UNFINISHED, replacing=True) as stream:
            writer = ChunkWriter(stream, level=LEVEL, chunk_bytes=CHUNK_BYTES)
            writer.add_metadata(COMPACTED, {"from_bytes": str(path.stat().st_size)})
            rewrite = Rewrite(log, writer)
            rewrite.add(log.messages())
            rewrite.keep()
            writer.finish()
            stream.flush()
            if not _same(path, path.with_name(path.name + _UNFINISHED)):
                raise LogError(f"{path}: is damaged; it stays as it is. Mend it: armctl log recover {path}")
    return True


def compact_folder(folder: Path, *, disk: Disk = DISK) -> None:
    """Compact every log in a folder that is not yet."""
    for stored in stock(folder).logs:
        try:
            compact(stored.path, disk=disk)
        except LogError as error:
            _log.warning("not compacted: %s", error)


class Compaction:
    """Compacts a folder in a process of its own, one at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *folders: Path) -> None:
        """Begin, unless the last one is still at it: the next one will find what it leaves.

        Raises:
            OSError: no process can be started.
        """
        if self._process is None or self._process.poll() is not None:
            command = [sys.executable, "-m", "armctl.recording.compact", *map(str, folders)]
            quiet = subprocess.DEVNULL
            # In a session of its own: the daemon's goes before others.
            self._process = subprocess.Popen(command, stdin=quiet, stdout=quiet, start_new_session=True)
            # So that nothing defunct is left of it until the next hour.
            threading.Thread(target=self._process.wait, name="compaction", daemon=True).start()


def _same(one: Path, other: Path) -> bool:
    """Whether two logs hold the same messages in the same order, and the same about themselves."""
    with LogFile(one) as a, LogFile(other) as b:
        messages = all(ours == theirs for ours, theirs in zip_longest(a.messages(), b.messages()))
        about = [{name: one.data for name, one in log.attachments.items()} | log.facts for log in (a, b)]
        return messages and a.complete and b.complete and about[0] == about[1]


def main(folders: Sequence[str]) -> None:
    """Body of the process."""
    os.nice(19)
    for folder in map(Path, folders):
        with contextlib.suppress(OSError):  # a folder that is gone
            recover_folder(folder)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    for folder in map(Path, folders):
        with contextlib.suppress(OSError, LogError):
            compact_folder(folder)
            if stock(folder).logs:  # a folder of takes needs no index
                bring_up_to_date(folder)


if __name__ == "__main__":
    main(sys.argv[1:])
