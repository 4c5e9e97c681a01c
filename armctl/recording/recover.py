"""Recovery: the intact part of a cut or damaged log as a finished file.

Rules.
1. The old file is not touched until the new one is complete, on the disk and has its name. Only a `.part` is
   removed then; a damaged finished file is kept.
2. Nothing is overwritten, and a part that somebody is writing is left alone.
3. Messages, attachments and metadata are taken over byte for byte.
"""

import logging
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import DISK, PART, Disk, PartInUse, new_file, owned, writing
from armctl.recording.log_file import LogFile
from armctl.recording.replay import RECOVERED
from armctl.recording.rewrite import Rewrite

BROKEN = ".broken"
_UNFINISHED = ".recovering"
_log = logging.getLogger(__name__)


class RecoverResult(NamedTuple):
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
    target = target or _free_name(path)
    with owned(path), LogFile(path) as log:
        with new_file(target, disk, suffix=_UNFINISHED) as stream:
            writer = ChunkWriter(stream)
            messages = Rewrite(log, writer).add(log.messages())
            if messages == 0:
                raise LogError(f"{path}: holds no intact message; nothing to recover")
            lost_s = log.lost_ns / NS_PER_S
            writer.add_metadata(RECOVERED, {"from": path.name, "messages": str(messages), "lost_s": f"{lost_s:.9f}"})
            writer.finish()
        if path.name.endswith(PART):
            with writing(path):
                disk.remove(path)
        return RecoverResult(messages, lost_s, target)


def recover_folder(folder: Path, *, disk: Disk = DISK) -> None:
    """Recover every part in a folder, as a daemon does when it starts.

    A part with nothing in it is set aside as NAME.part.broken. One that is being written is left alone, and one for
    which the disk has no room.
    """
    for part in sorted(folder.glob(f"*{PART}")):
        if part.is_symlink() or not part.is_file():
            continue
        final = part.with_name(part.name.removesuffix(PART))
        if final.exists() and final.samefile(part):
            disk.remove(part)  # killed between naming the finished file and removing its old name
            continue
        try:
            result = recover(part, disk=disk)
            _log.warning("%s: recovered %d messages, %.3f s lost", part, result.recovered_messages, result.lost_s)
        except PartInUse:
            continue
        except LogError as error:
            if error.__cause__ is not None:  # the new file could not be written
                _log.error("%s; %s stays, and the next start tries again", error, part.name)
                continue
            text = "%s: it was cut as it began, or is damaged; it is kept as %s%s, and may be deleted"
            _log.warning(text, error, part.name, BROKEN)
            if part.exists() and not (broken := part.with_name(part.name + BROKEN)).exists():
                disk.replace(part, broken)


def _free_name(path: Path) -> Path:
    """The log's own name for a part, if it is free; else a name that says what it is, with a number if need be."""
    plain = path.name.removesuffix(PART)
    stem = plain.removesuffix(".mcap")
    names = chain((plain, f"{stem}-recovered.mcap"), (f"{stem}-recovered-{number}.mcap" for number in count(2)))
    return next(free for name in names if not (free := path.with_name(name)).exists())
