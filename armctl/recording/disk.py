"""What the files of a log need of the operating system, in one place that a proof can replace.

`Disk` does what changes the disk. The functions below it are made of it: they lock, name and finish files.

Rules.
1. A new file never takes the name of another; only `replace` puts one in the place of another, in one step.
2. A name is on the disk after `sync_folder`, data are after `sync`; before that either may be lost in a power cut,
   in any order. Whoever removes a name syncs the folder that holds the new one first.
3. Errors of `Disk` are OSErrors; `writing` and `owned` turn them into LogErrors that say which file it was.
"""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter
from pathlib import Path

from armctl.errors import LogError

# Ends the name of a log that is being written, or was when its writer died.
PART = ".part"


class PartInUse(LogError):
    """Another process is writing the part."""


class Disk:
    """The operating system's files."""

    def create(self, path: Path) -> BufferedWriter:
        """A new file, locked until it is closed.

        Raises:
            FileExistsError: the name is taken.
        """
        stream = open(path, "xb")  # noqa: SIM115  # the caller closes it
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            stream.close()
            path.unlink()
            raise
        return stream

    def sync(self, stream: BufferedWriter) -> None:
        """Return when everything written is on the disk."""
        stream.flush()
        os.fdatasync(stream.fileno())

    def sync_folder(self, folder: Path) -> None:
        """Return when the names in a folder are on the disk."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def name(self, old: Path, new: Path) -> None:
        """Give a file another name, on the disk when this returns.

        Raises:
            FileExistsError: the new name is taken.
        """
        try:
            self.link(old, new)
        except OSError as error:
            # File systems without hard links (FAT): the check and the renaming are two steps there.
            if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS) or new.exists():
                raise
            self.replace(old, new)
        else:
            self.sync_folder(new.parent)
            self.remove(old)
        self.sync_folder(new.parent)

    def link(self, old: Path, new: Path) -> None:
        """A second name for a file."""
        os.link(old, new)

    def replace(self, old: Path, new: Path) -> None:
        """Put a file in the place of another."""
        os.replace(old, new)

    def remove(self, path: Path) -> None:
        """Take a name away."""
        path.unlink()

    def free_bytes(self, folder: Path) -> int:
        """What may still be written below a folder."""
        return shutil.disk_usage(folder).free


DISK = Disk()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the operating system's errors into one that says what could not be written.

    Raises:
        LogError: with the OSError as its cause.
    """
    try:
        yield
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def owned(path: Path) -> Iterator[None]:
    """Hold the lock that a writer would hold.

    Raises:
        PartInUse: a writer has it.
        LogError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
    except BlockingIOError:
        raise PartInUse(f"{path}: is being written; end what writes it, or wait for it") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def publish(part: Path, path: Path, disk: Disk = DISK) -> None:
    """Give a finished file its name, unless the name is taken; the folder entry is on the disk afterwards.

    Raises:
        LogError: the name is taken; the part stays.
        OSError: the folder cannot be written.
    """
    try:
        disk.name(part, path)
    except FileExistsError:
        raise LogError(f"{path}: appeared meanwhile; nothing is overwritten, the data are in {part.name}") from None


def put(path: Path, text: str, *, replacing: bool = True) -> None:
    """Have a file hold a text, and its folder be there; it is on the disk when this returns.

    Args:
        replacing: Whether it takes the place of the file that has the name.
    Raises:
        LogError: the name is taken, or it cannot be written.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path, replacing=replacing) as stream:
        stream.write(text.encode())


@contextmanager
def new_file(
    path: Path, disk: Disk = DISK, *, suffix: str = ".unfinished", replacing: bool = False
) -> Iterator[BufferedWriter]:
    """A stream that becomes `path` when the block is left without an error, and nothing otherwise.

    Args:
        suffix: Added to the name while the file is not finished.
        replacing: Whether it takes the place of the file that has the name.
    Raises:
        PartInUse: another process is making the file.
        LogError: the name is taken, or it cannot be written.
    """
    if path.exists() and not replacing:
        raise LogError(f"{path}: exists already; choose another name, nothing is overwritten")
    unfinished = path.with_name(path.name + suffix)
    with writing(path):
        if unfinished.exists():
            with owned(unfinished), writing(unfinished):
                disk.remove(unfinished)  # left behind by one that was killed
        # The lock is held until the file has its name: nobody takes it for one that was left behind.
        with disk.create(unfinished) as stream:
            try:
                yield stream
                disk.sync(stream)
                if replacing:
                    disk.replace(unfinished, path)
                    disk.sync_folder(path.parent)
                else:
                    publish(unfinished, path, disk)
            except BaseException:
                with suppress(OSError):
                    disk.remove(unfinished)
                raise
