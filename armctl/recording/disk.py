"""What the files of a log need of the operating system, in one place that a proof can replace.

Rules.
1. A new file never takes the name of another; only `replace` puts one in the place of another, in one step.
2. A name is on the disk after `sync_folder`, data are after `sync`; before that either may be lost in a power cut,
   in any order. Whoever removes a name syncs the folder that holds the new one first.
3. Errors are OSErrors; the caller knows what it was about to do.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from io import BufferedWriter
from pathlib import Path


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
        except FileExistsError:
            raise
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
