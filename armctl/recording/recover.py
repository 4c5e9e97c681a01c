"""Recovery: the intact part of a cut or damaged log as a finished file.

Rules.
1. The old file is not touched until the new one is complete, on the disk and has its name. Only a `.part` is
   removed then; a damaged finished file is kept.
2. Nothing is overwritten, and a part that somebody is writing is left alone.
3. Messages, attachments and metadata are taken over byte for byte.
"""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import DISK, Disk
from armctl.recording.reader import LogFile
from armctl.recording.writer import LIBRARY, PART, PROFILE, publish, writing

BROKEN = ".broken"
RECOVERED = "recovered"
"""Metadata record of a recovered file: what it was made from, and what was lost."""
_UNFINISHED = ".recovering"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecoverResult:
    """Outcome of one recovery.

    `lost_s` is the log time between intact chunks, and of a last chunk that begins in the file and does not end
    there. What had not reached the disk when writing ended (1 s at most) the file cannot tell.
    """

    recovered_messages: int
    lost_s: float
    path: Path


def recover(path: Path, target: Path | None = None, *, disk: Disk = DISK) -> RecoverResult:
    """Write what is intact in `path` to a finished file.

    Args:
        target: The new file; without it NAME.mcap for NAME.mcap.part, else NAME-recovered.mcap, or a name with a
            number if that is taken.
    Raises:
        LogError: nothing can be recovered, the file is being written, or the new one cannot be.
    """
    if target is None:
        target = _free_name(path)
    elif target.exists():
        raise LogError(f"{target}: exists already; nothing is overwritten")
    with owned(path), LogFile(path) as log:
        unfinished = target.with_name(target.name + _UNFINISHED)
        with writing(unfinished):
            if unfinished.exists():
                disk.remove(unfinished)  # left behind by a recovery that was killed
            with disk.create(unfinished) as stream:
                writer = ChunkWriter(stream, PROFILE, LIBRARY)
                messages = copy(log, writer)
                lost_s = log.lost_ns / NS_PER_S
                facts = {"from": path.name, "messages": str(messages), "lost_s": f"{lost_s:.9f}"}
                writer.add_metadata(RECOVERED, facts)
                writer.finish()
                disk.sync(stream)
            if messages == 0:
                disk.remove(unfinished)
                raise LogError(f"{path}: holds no intact message; nothing to recover")
            publish(unfinished, target, disk)
            if path.name.endswith(PART):
                disk.remove(path)
        return RecoverResult(messages, lost_s, target)


def recover_folder(folder: Path, *, disk: Disk = DISK) -> tuple[RecoverResult, ...]:
    """Recover every part in a folder, as a daemon does when it starts.

    A part with nothing in it is set aside as NAME.part.broken; one that is being written is left alone.
    """
    results = []
    for part in sorted(folder.glob(f"*{PART}")):
        if part.is_symlink() or not part.is_file():
            continue
        final = part.with_name(part.name.removesuffix(PART))
        if final.exists() and final.samefile(part):
            disk.remove(part)  # killed between naming the finished file and removing its old name
            continue
        try:
            result = recover(part, disk=disk)
        except PartInUse:
            continue
        except LogError as error:
            _log.error("%s", error)
            if part.exists() and not (broken := part.with_name(part.name + BROKEN)).exists():
                disk.replace(part, broken)
            continue
        _log.warning("%s: recovered %d messages, %.3f s lost", part, result.recovered_messages, result.lost_s)
        results.append(result)
    return tuple(results)


class PartInUse(LogError):
    """Another process is writing the part."""


def copy(log: LogFile, writer: ChunkWriter) -> int:
    """Everything intact in `log` to `writer`, byte for byte and in order; the number of messages."""
    for attachment in log.attachments.values():
        writer.add_attachment(attachment.log_time, attachment.name, attachment.media_type, attachment.data)
    for name, facts in log.metadata.items():
        # A metadata record has no checksum of its own; the seed, which says the same of our files, has.
        writer.add_metadata(name, log.facts if name == "armctl" else facts)
    schemas: dict[int, int] = {}
    channels: dict[str, int] = {}

    def register() -> None:
        for channel in log.channels.values():
            if channel.topic in channels:
                continue
            schema = log.schemas.get(channel.schema_id)
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.add_schema(schema.name, schema.encoding, schema.data)
            schema_id = schemas.get(channel.schema_id, 0)
            channels[channel.topic] = writer.add_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )

    register()
    count = 0
    for message in log.messages():
        if message.topic not in channels:
            register()
        writer.add_message(channels[message.topic], message.log_time_ns, message.sequence, message.data)
        count += 1
    return count


def _free_name(path: Path) -> Path:
    plain = path.name.removesuffix(PART)
    stem = plain.removesuffix(".mcap")
    candidate = path.with_name(plain if path.name.endswith(PART) else f"{stem}-recovered.mcap")
    number = 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{stem}-recovered{'' if number == 2 else f'-{number - 1}'}.mcap")
    return candidate


@contextmanager
def owned(path: Path) -> Iterator[None]:
    """Hold the lock a writer would hold.

    Raises:
        PartInUse: a writer has it.
        LogError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise PartInUse(f"{path}: is being written; end the recording first") from None
            yield
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
