"""A disk that remembers what it was asked, and what a power cut may leave of it.

Rules.
1. `CutDisk` does everything for real in a folder, and notes each write, sync and change of a name.
2. What was written to a file since it was last synced is kept or lost by the sector, in any order; its length may be
   anything from the synced one on; where a lost sector lies inside it, there are zeros or somebody's old bytes.
3. Names made, changed or removed since their folder was last synced are each kept or lost, in any order.
4. What was synced stays.

Stricter than a journalling file system, which keeps names in order and syncs a new name together with its data.
"""

import errno
import io
import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armctl.recording.disk import Disk

SECTOR = 512
ERRORS = (errno.ENOSPC, errno.EIO)


@dataclass(frozen=True)
class Operation:
    """One thing the disk was asked to do, at a virtual time [ns]; `number` is the file's, names are relative."""

    kind: str
    time_ns: int
    number: int = 0
    offset: int = 0
    data: bytes = b""
    old: str = ""
    new: str = ""


@dataclass
class _File:
    synced: bytes = b""
    written: bytearray = field(default_factory=bytearray)
    pending: list[tuple[int, int]] = field(default_factory=list)


class CutDisk(Disk):
    """Files below `root`, with a record of every operation.

    Args:
        now_ns: Virtual time.
        fail: Called with the number of each operation before it is done; an OSError it raises is the disk's.
    """

    def __init__(self, root: Path, now_ns: Callable[[], int], fail: Callable[[int], None] | None = None) -> None:
        self.root = root
        self.operations: list[Operation] = []
        self.done = 0
        self._now_ns, self._fail = now_ns, fail
        self._created = 0

    def create(self, path: Path) -> io.BufferedWriter:
        self._begin()
        stream = super().create(path)
        stream.close()
        self._created += 1
        raw = _Noted(path, self, -self._created)
        self.note("create", number=raw.number, new=self._relative(path))
        return io.BufferedWriter(raw)

    def sync(self, stream: io.BufferedWriter) -> None:
        stream.flush()
        self._begin()
        assert isinstance(stream.raw, _Noted)
        self.note("sync", number=stream.raw.number)

    def sync_folder(self, folder: Path) -> None:
        self._begin()
        self.note("sync_folder", new=self._relative(folder))

    def link(self, old: Path, new: Path) -> None:
        self._begin()
        super().link(old, new)
        self.note("link", old=self._relative(old), new=self._relative(new))

    def replace(self, old: Path, new: Path) -> None:
        self._begin()
        super().replace(old, new)
        self.note("replace", old=self._relative(old), new=self._relative(new))

    def remove(self, path: Path) -> None:
        self._begin()
        super().remove(path)
        self.note("remove", old=self._relative(path))

    def note(self, kind: str, **facts: Any) -> None:
        """Something the proof wants to find among the operations."""
        self.operations.append(Operation(kind, self._now_ns(), **facts))

    def _begin(self) -> None:
        self.done += 1
        if self._fail is not None:
            self._fail(self.done)

    def _relative(self, path: Path) -> str:
        return str(path.relative_to(self.root))


class _Noted(io.FileIO):
    """The file below a stream."""

    def __init__(self, path: Path, disk: CutDisk, number: int) -> None:
        super().__init__(path, "wb")
        self.number = number
        self._disk = disk

    def write(self, data: Any) -> int:
        self._disk._begin()
        offset = self.tell()
        written = super().write(data)
        self._disk.note("write", number=self.number, offset=offset, data=bytes(data))
        return written


def leave(operations: list[Operation], rng: random.Random, root: Path) -> None:
    """Make in the empty folder `root` one of the states in which a power cut after these operations may leave it."""
    files: dict[int, _File] = {}
    names: dict[str, int] = {}
    pending: list[Operation] = []
    for operation in operations:
        _apply(operation, files, names, pending)
    kept = rng.choice((0.0, 0.5, 0.9, 1.0))
    for operation in pending:
        if rng.random() < kept:
            _rename(operation, names)
    # Two names of one file are two names of one file afterwards.
    made: dict[int, Path] = {}
    for name, number in sorted(names.items()):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if number in made:
            os.link(made[number], path)
        else:
            path.write_bytes(_content(files[number], rng))
            made[number] = path


def _apply(operation: Operation, files: dict[int, _File], names: dict[str, int], pending: list[Operation]) -> None:
    if operation.kind == "create":
        files[operation.number] = _File()
    if operation.kind in ("create", "link", "replace", "remove"):
        pending.append(operation)
    elif operation.kind == "write":
        file = files[operation.number]
        end = operation.offset + len(operation.data)
        file.written[operation.offset : end] = operation.data
        file.pending.append((operation.offset, end))
    elif operation.kind == "sync":
        file = files[operation.number]
        file.synced, file.pending = bytes(file.written), []
    elif operation.kind == "sync_folder":
        for change in [one for one in pending if str(Path(one.new or one.old).parent) == operation.new]:
            _rename(change, names)
            pending.remove(change)


def _rename(change: Operation, names: dict[str, int]) -> None:
    if change.kind == "create":
        names[change.new] = change.number
    elif change.kind == "remove":
        names.pop(change.old, None)
    elif change.old in names:
        names[change.new] = names[change.old]
        if change.kind == "replace":
            del names[change.old]


def _content(file: _File, rng: random.Random) -> bytes:
    """What a file holds after the cut."""
    if not file.pending:
        return file.synced
    kept = rng.choice((0.0, 0.3, 0.7, 0.95, 1.0))
    written = bytes(file.written)
    noise = rng.random() < 0.5
    content = bytearray(rng.randbytes(len(written)) if noise else bytes(len(written)))
    content[: len(file.synced)] = file.synced
    end = len(file.synced)
    for sector in range(len(file.synced) // SECTOR, -(-len(written) // SECTOR)):
        if rng.random() < kept:
            begin = max(sector * SECTOR, len(file.synced))
            content[begin : (sector + 1) * SECTOR] = written[begin : (sector + 1) * SECTOR]
            end = min((sector + 1) * SECTOR, len(written))
    return bytes(content[: rng.randint(end, len(written))])


def failing_once(at: int, number: int, count: int = 1) -> Callable[[int], None]:
    """A fault of the disk: `count` operations from the `at`-th on fail with the error of that number."""

    def fail(operation: int) -> None:
        if at <= operation < at + count:
            raise OSError(number, os.strerror(number))

    return fail
