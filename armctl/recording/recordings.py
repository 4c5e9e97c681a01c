"""Takes by name: the candidates an optimisation starts from, and the runs it is judged by.

A take is NAME.mcap in the recordings folder, NAME.mcap.part while it is recorded or after a crash. Names are
plain (config.NAME_PATTERN), links are not followed, and nothing is ever overwritten.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from armctl.clock import NS_PER_S
from armctl.config import NAME_PATTERN
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.recording.channels import CONTROL, JOINT_STATES, ROSOUT
from armctl.recording.disk import PART, owned, publish, writing
from armctl.recording.log_file import LogFile
from armctl.recording.reader import joint_track
from armctl.recording.recover import recover

SUFFIX = ".mcap"


@dataclass(frozen=True)
class Recording:
    """Joint positions of one take.

    `time_s` (m,) counts from the first sample; `positions_rad` has shape (m, n) with the joints in the order of
    `joint_names`. `plan_s` is the window in which a plan proper was executed, if one was: [begin, end].
    """

    name: str
    path: Path
    arm_id: str
    calibration_hash: str
    joint_names: tuple[str, ...]
    # Epoch time of the first sample [ns].
    start_ns: int
    time_s: FloatArray
    positions_rad: FloatArray
    plan_s: tuple[float, float] | None
    complete: bool

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])

    @property
    def samples(self) -> int:
        return len(self.time_s)

    @property
    def plan_positions_rad(self) -> FloatArray:
        """The samples inside the plan's window; all of them where no plan ran."""
        if self.plan_s is None:
            return self.positions_rad
        begin_s, end_s = self.plan_s
        return self.positions_rad[(self.time_s >= begin_s) & (self.time_s <= end_s)]


def load(path: Path) -> Recording:
    """A take, or any log, as joint positions; of a cut one what is intact.

    Args:
        path: The file; where it does not exist, its part is read.
    Raises:
        LogError: the file is missing, is no log, or holds no joint states.
    """
    if not path.exists() and (part := path.with_name(path.name + PART)).exists():
        path = part
    marks: dict[str, int] = {}
    with LogFile(path) as log:
        found = log.payloads((JOINT_STATES, ROSOUT))
        joints = joint_track(log, found.get(JOINT_STATES))
        if ROSOUT in found:
            for time_ns, data in zip(found[ROSOUT].log_time_ns, found[ROSOUT].data, strict=True):
                line = log.codec(ROSOUT).decode(data)
                if line.get("name") == CONTROL and line.get("function") in ("PLAN_BEGIN", "PLAN_END"):
                    marks[line["function"]] = time_ns
        window = None
        if len(marks) == 2:
            begin_s, end_s = ((marks[key] - joints.start_ns) / NS_PER_S for key in ("PLAN_BEGIN", "PLAN_END"))
            window = (begin_s, end_s) if begin_s <= end_s else None
        facts = log.facts
        return Recording(
            name=take_name(path),
            path=path,
            arm_id=facts.get("arm_id", ""),
            calibration_hash=facts.get("calibration_hash", ""),
            joint_names=joints.names,
            start_ns=joints.start_ns,
            time_s=joints.time_s,
            positions_rad=joints.position_rad,
            plan_s=window,
            complete=log.complete,
        )


def find(folder: Path, name: str) -> Path:
    """The file of a take.

    Raises:
        LogError: the name is not acceptable, or there is no such take; the message lists the known names.
    """
    path = take_path(folder, name)
    for candidate in (path, path.with_name(path.name + PART)):
        if candidate.is_file() and not candidate.is_symlink():
            return candidate
    known = ", ".join(take_name(found) for found in take_files(folder))
    raise LogError(f"recording {name}: none of that name in {folder}; known: {known or 'none'}")


def take_path(folder: Path, name: str) -> Path:
    """Where a finished take of that name is.

    Raises:
        LogError: the name is not acceptable.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        raise LogError(
            f"recording {name!r}: a name has 1 to 64 letters, digits and . _ - and begins with a letter or digit"
        )
    return folder / f"{name}{SUFFIX}"


def rename(folder: Path, old: str, new: str) -> Path:
    """Give a take another name; a part is recovered on the way.

    Raises:
        LogError: no such take, or the new name is not acceptable or taken.
    """
    source, target = find(folder, old), take_path(folder, new)
    if target.exists() or target.with_name(target.name + PART).exists():
        raise LogError(f"recording {new}: exists already; nothing is overwritten")
    if source.name.endswith(PART):
        return recover(source, target).path
    with writing(target):
        publish(source, target)
    return target


def delete(folder: Path, name: str) -> Path:
    """Delete a take.

    Raises:
        LogError: no such take, it is being recorded, or it cannot be deleted.
    """
    path = find(folder, name)
    with owned(path), writing(path):
        path.unlink()
    return path


def take_name(path: Path) -> str:
    """Name of the take in a file."""
    return path.name.removesuffix(PART).removesuffix(SUFFIX)


def take_files(folder: Path) -> Iterator[Path]:
    """The file of every take of a folder by name; a finished one hides a part of the same name.

    Raises:
        LogError: the folder cannot be read.
    """
    try:
        whole, parts = [*folder.glob(f"*{SUFFIX}")], [*folder.glob(f"*{SUFFIX}{PART}")]
    except OSError as error:  # the folder vanished meanwhile
        raise LogError(f"{folder}: cannot be read: {error.strerror}") from None
    finished = {path.name for path in whole}
    for path in sorted((*whole, *parts)):
        if path.is_file() and not path.is_symlink() and (not path.name.endswith(PART) or path.stem not in finished):
            yield path
