"""A log cut off, or with a bit flipped: what is read and recovered from it, against what was written.

1. A message that was not written is never there, nor one twice.
2. A cut costs the chunk it hits and nothing before it: 1.0 s at most.
3. A flipped bit costs one chunk at most, be it the first one.
4. Recovery raises nothing but LogError, and its file holds exactly what could be read.
"""

import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from io import BufferedWriter
from pathlib import Path

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.messages import TickRecord
from armctl.recording.channels import Anchor
from armctl.recording.chunks import CHUNK, RECORD
from armctl.recording.disk import PART, Disk
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.recover import recover
from armctl.recording.writer import LogWriter
from proving.log_rig import log_context

LOSS_BOUND_S = 1.0
MOST_EXAMPLES = 5
FLUSH_TICKS = 9
CHUNK_OPCODE = 6
ANCHOR = Anchor(1_750_000_000 * NS_PER_S, 5 * NS_PER_S)


class UnsyncedDisk(Disk):
    """A disk that is never waited for; what a power cut would leave of it does not matter here."""

    def sync(self, stream: BufferedWriter) -> None:
        stream.flush()

    def sync_folder(self, folder: Path) -> None:
        pass


@dataclass
class Tally:
    """What was tried, and what was found."""

    runs: int = 0
    violations: int = 0
    worst_loss_s: float = 0.0
    examples: list[str] = field(default_factory=list)

    def violation(self, text: str) -> None:
        self.violations += 1
        if len(self.examples) < MOST_EXAMPLES:
            self.examples.append(text)

    def add_findings(self, other: "Tally") -> None:
        """What another tally found, but not what it tried."""
        self.violations += other.violations
        self.worst_loss_s = max(self.worst_loss_s, other.worst_loss_s)
        self.examples = (self.examples + other.examples)[:MOST_EXAMPLES]


def part_bytes(records: list[TickRecord], folder: Path) -> bytes:
    """A log as it lies on the disk when the power fails: flushed as the recorder does, without an end."""
    writer = LogWriter(folder / "part.mcap", log_context(), anchor=ANCHOR, disk=UnsyncedDisk())
    for record in records:
        writer.write_tick(record)
        if record.inputs.tick % FLUSH_TICKS == FLUSH_TICKS - 1:
            writer.flush()
    writer.flush()
    data = writer.part.read_bytes()
    writer.abandon()
    writer.part.unlink()
    return data


def chunk_places(data: bytes) -> list[tuple[int, int]]:
    """Where each chunk of an undamaged file begins and ends."""
    at, found = 8, []
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        if opcode == CHUNK_OPCODE:
            found.append((at, at + RECORD.size + length))
        at += RECORD.size + length
    return found


class Damage:
    """Does damage to copies of one log in a folder.

    Args:
        data: The undamaged log, with or without its end.
        folder: Empty; for the copies.
    """

    def __init__(self, data: bytes, folder: Path) -> None:
        self._data, self._path = data, folder / f"damaged.mcap{PART}"
        self._whole = self._read(data)
        self._true = frozenset(self._whole)
        self._chunks = chunk_places(data)
        times_ns = [CHUNK.unpack_from(data, begin + RECORD.size)[:2] for begin, _ in self._chunks]
        self._ends_ns = [end_ns for _, end_ns in times_ns]
        # Where two chunks share an instant each of its messages could be of either: count it to both.
        self._largest = max(sum(begin <= one.log_time_ns <= end for one in self._whole) for begin, end in times_ns)

    def cut(self, places: Iterable[int], *, recovering: bool = False) -> Tally:
        """Cut the log off at each of these bytes."""
        tally = Tally()
        for place in places:
            tally.runs += 1
            found = self._judge(self._data[:place], f"cut at byte {place}", tally, recovering)
            if found is None:
                continue
            if found != self._whole[: len(found)]:
                tally.violation(f"cut at byte {place}: what is left is not the beginning")
            hit = next((i for i, (_, end) in enumerate(self._chunks) if end > place), None)
            before_ns = found[-1].log_time_ns if found else self._whole[0].log_time_ns
            loss_s = 0.0 if hit is None else (self._ends_ns[hit] - before_ns) / NS_PER_S
            tally.worst_loss_s = max(tally.worst_loss_s, loss_s)
            if loss_s > LOSS_BOUND_S:
                tally.violation(f"cut at byte {place}: {loss_s:.3f} s lost")
        return tally

    def flip(self, rng: random.Random, count: int, *, recovering: bool = False) -> Tally:
        """Flip one random bit behind the magic, so many times."""
        tally = Tally()
        for _ in range(count):
            tally.runs += 1
            place, bit = rng.randrange(8, len(self._data)), rng.randrange(8)
            data = bytearray(self._data)
            data[place] ^= 1 << bit
            where = f"bit {bit} of byte {place} flipped"
            found = self._judge(bytes(data), where, tally, recovering)
            if found is not None and len(found) < len(self._whole) - self._largest:
                tally.violation(f"{where}: {len(self._whole) - len(found)} messages lost")
        return tally

    def _judge(self, data: bytes, where: str, tally: Tally, recovering: bool) -> list[LogMessage] | None:
        """What can be read; None if that is an error, as it is where nothing is left."""
        try:
            found = self._read(data)
            if not self._true.issuperset(found):
                tally.violation(f"{where}: a message that was never written")
            if len(set(found)) != len(found):
                tally.violation(f"{where}: a message twice")
            if recovering and found:
                result = recover(self._path, disk=UnsyncedDisk())
                if self._read(result.path.read_bytes()) != found:
                    tally.violation(f"{where}: the recovered file is another one")
                result.path.unlink()
        except LogError as error:
            if len(data) >= self._chunks[0][1]:
                tally.violation(f"{where}: nothing could be read ({error})")
            return None
        except Exception as error:  # any other exception at all is what this looks for
            tally.violation(f"{where}: raised {error!r}")
            return None
        return found

    def _read(self, data: bytes) -> list[LogMessage]:
        self._path.write_bytes(data)
        with LogFile(self._path) as log:
            return list(log.messages())
