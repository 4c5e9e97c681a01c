"""Takes by name: the candidates an optimisation starts from, and the runs it is judged by.

A take is NAME.mcap in the recordings folder, NAME.mcap.part while it is recorded or after a crash. Names are
plain (config.NAME_PATTERN), links are not followed, and nothing is ever overwritten.

Rules of lists of them.
1. One bad take never hides the others: what cannot be read is listed apart, with what is wrong with it.
2. A figure that cannot be computed is None: no line is defined by a single point, and none by an arm that stood still.
"""

import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.clock import NS_PER_S
from armctl.config import NAME_PATTERN, validate
from armctl.errors import LogError
from armctl.files import is_file
from armctl.json_text import named
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.recording.channels import COMMAND, CONTROL, CYCLE, JOINT_STATES, ROSOUT
from armctl.recording.columns import Table
from armctl.recording.disk import PART, owned, publish, writing
from armctl.recording.log_file import LogFile
from armctl.recording.notes import parse_note
from armctl.recording.reader import read
from armctl.recording.recover import recover
from armctl.trajectory.dead_time import moving_part
from armctl.trajectory.playback import DECIMALS, TaughtMotion
from armctl.trajectory.straightness import errors_mm

SUFFIX = ".mcap"
# Ends closer than this make no line: their distance is rounding, not motion (a servo tick moves the tool far more).
MIN_LINE_M = 1e-6
# Of a curve that is sent to be drawn.
MOST_POINTS = 1000
# Names of takes in an error.
MOST_NAMED = 8
Line = tuple[Sequence[float], Sequence[float]]
_log = logging.getLogger(__name__)


class Recording(NamedTuple):
    """Joint positions of one take.

    `time_s` (m,) counts from the first sample; `positions_rad` has shape (m, n) with the joints in the order of
    `joint_names`. `plan_s` is the window in which a plan proper was executed, if one was: [begin, end]. `waited_s` (m,)
    tells for how long until then the arm had stood, or been slowed down, in a motion (0 where the log tells of none).
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
    waited_s: FloatArray

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])

    @property
    def samples(self) -> int:
        return len(self.time_s)

    @property
    def played(self) -> slice:
        """The samples that count: of a run the plan proper, of a take not its dead time at both ends."""
        if self.plan_s is None:
            return moving_part(self.positions_rad)
        begin, end = np.searchsorted(self.time_s, self.plan_s[0]), np.searchsorted(self.time_s, self.plan_s[1], "right")
        return slice(int(begin), int(end))


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
        found = log.payloads((JOINT_STATES, CYCLE, ROSOUT))
        tables = log.tables(JOINT_STATES, found[JOINT_STATES]) if len(found[JOINT_STATES].size) else ()
        # A joint that has never answered is in no message: those count that name the most.
        names, table = max(map(_named, tables), key=lambda named: len(named[0]), default=((), None))
        if table is None or not names:
            raise LogError(f"{path}: holds no joint states")
        times_ns = table.log_time_ns.astype(np.int64)
        start_ns = int(times_ns[0])
        for time_ns, data in found[ROSOUT]:
            line = log.codec(ROSOUT).decode(data)
            if line.get("name") == CONTROL and line.get("function") in ("PLAN_BEGIN", "PLAN_END"):
                marks[line["function"]] = time_ns
        window = None
        if len(marks) == 2:
            begin_s, end_s = ((marks[key] - start_ns) / NS_PER_S for key in ("PLAN_BEGIN", "PLAN_END"))
            window = (begin_s, end_s) if begin_s <= end_s else None
        facts, cycles = log.facts, log.tables(CYCLE, found[CYCLE]) if len(found[CYCLE].size) else ()
        return Recording(
            name=take_name(path),
            path=path,
            arm_id=facts.get("arm_id", ""),
            calibration_hash=facts.get("calibration_hash", ""),
            joint_names=names,
            start_ns=start_ns,
            time_s=(times_ns - start_ns) / NS_PER_S,
            positions_rad=table.numbers("position"),
            plan_s=window,
            complete=log.complete,
            waited_s=_waited_s(cycles, times_ns),
        )


def _named(table: Table) -> tuple[tuple[str, ...], Table]:
    """The joints of a table, if it has a position for each of them."""
    names = tuple(str(column[0]) for path, column in table.columns.items() if path.startswith("name["))
    return names if table.numbers("position").shape[-1] == len(names) else (), table


def _waited_s(cycles: Sequence[Table], times_ns: NDArray[np.int64]) -> FloatArray:
    """For how long the arm had waited at some times: while its motion went on less than it did in most ticks [s]."""
    cycles = [table for table in cycles if "progress" in table.columns]
    at_ns = np.concatenate([np.empty(0, np.int64), *(table.log_time_ns.astype(np.int64) for table in cycles)])
    progress = np.concatenate([np.empty(0), *(np.asarray(table.columns["progress"]) for table in cycles)])
    order = np.argsort(at_ns)
    at_ns, progress = at_ns[order], progress[order][:-1]
    # What a tick does is seen by the next one.
    steps = np.diff(progress, prepend=-1.0)
    if not (steps > 0.0).any():
        return np.zeros(len(times_ns))
    share = np.clip(1.0 - steps / np.median(steps[steps > 0.0]), 0.0, 1.0)
    waited_ns = np.append(0.0, np.cumsum(np.where((progress >= 0.0) & (share > 0.1), share * np.diff(at_ns), 0.0)))
    return np.asarray(np.interp(times_ns, at_ns, waited_ns) / NS_PER_S)


def drawn(count: int, most: int = MOST_POINTS) -> Any:
    """Indices of at most so many of `count` points, evenly, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)) if count else np.arange(0)


def taught(recording: Recording) -> TaughtMotion:
    """What of a recording is played: of a run the plan proper, of a take not its dead time at both ends.

    Raises:
        ConfigError: it is too short or too long to be played.
    """
    time_s, positions_rad = recording.time_s[recording.played], recording.positions_rad[recording.played]
    data = {
        "joints": recording.joint_names,
        "time_s": tuple(np.round(time_s, 6).tolist()),
        "positions_rad": tuple(map(tuple, np.round(positions_rad, DECIMALS).tolist())),
        **named(recording, "arm_id", "calibration_hash"),
    }
    return validate(TaughtMotion, data, f"recording {recording.name}")


def find(folder: Path, name: str) -> Path:
    """The file of a take.

    Raises:
        LogError: the name is not acceptable, or there is no such take; the message lists the newest ones.
    """
    path = take_path(folder, name)
    for candidate in (path, path.with_name(path.name + PART)):
        if candidate.is_file() and not candidate.is_symlink():
            return candidate
    files = sorted(take_files(folder), key=lambda found: found.stat().st_mtime, reverse=True)
    known = ", ".join(sorted(map(take_name, files[:MOST_NAMED]))) or "none"
    known += f", and {len(files) - MOST_NAMED} older ones" * (len(files) > MOST_NAMED)
    raise LogError(f"recording {name}: none of that name in {folder}; known: {known}")


def path_of(folder: Path, name: str) -> Path:
    """The file that a person means: a file itself, else that of a take.

    Raises:
        LogError: as `find`.
    """
    return Path(name) if is_file(name) else find(folder, name)


def take_path(folder: Path, name: str) -> Path:
    """Where a finished take of that name is.

    Raises:
        LogError: the name is not acceptable.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        rule = "a name has 1 to 64 letters, digits and . _ - and begins with a letter or digit"
        raise LogError(f"recording {name!r}: {rule}")
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


def listing(folder: Path, robot: Robot) -> dict[str, list[dict[str, Any]]]:
    """Every take of a folder by name.

    Returns:
        `recordings`: the readable takes (see `describe`). `unreadable`, only where there are some: `name`, `path` and
        `problem` of the others.
    Raises:
        LogError: the folder cannot be read.
    """
    found: dict[str, list[dict[str, Any]]] = {"recordings": []}
    for path in take_files(folder):
        try:
            found["recordings"].append(describe(load(path), robot))
        except LogError as error:
            _log.warning("recording cannot be read: %s", error)
            entry = {"name": take_name(path), "path": str(path), "problem": str(error)}
            found.setdefault("unreadable", []).append(entry)
    return found


def describe(take: Recording, robot: Robot, line: Line | None = None, *, with_marks: bool = False) -> dict[str, Any]:
    """A recording as lists show it. Of a run only the plan proper counts, of a take not its dead time at both ends.

    Args:
        line: What its errors are measured against [m]; None: from its first to its last tool point. They are None
            where these make no line.
        with_marks: Whether to look for marked via points as well, which reads the file once more.
    """
    errors: tuple[float | None, float | None] = (None, None)
    # Positions may be any number a float can hold: what overflows becomes None below.
    with np.errstate(all="ignore"):
        played = take.played
        part_rad = take.positions_rad[played, : robot.chain.n]
        if len(part_rad) and part_rad.shape[1] == robot.chain.n and np.isfinite(part_rad).all():
            points_m = tool_position(robot.chain, part_rad)
            A, B = (np.asarray(end, np.float64) for end in line or (points_m[0], points_m[-1]))
            if np.linalg.norm(B - A) > MIN_LINE_M:
                errors = errors_mm(points_m, A, B)
    return {
        **named(take, "name", "duration_s", "samples", "arm_id", "calibration_hash", "complete"),
        "path": str(take.path),
        "mean_error_mm": errors[0],
        "max_error_mm": errors[1],
        "dead_samples": [0, 0] if take.plan_s else [played.start, take.samples - played.stop],
        **({"marks": via_marks(take.path)} if with_marks else {}),
    }


def via_marks(path: Path) -> list[dict[str, Any]]:
    """The via points that were marked while a take was recorded."""
    keys = ("tick", "position_m", "joints_rad")
    return [{key: note[key] for key in keys} for note in noted(path, "VIA_MARK") if note.keys() >= set(keys)]


def noted(path: Path, event: str) -> list[dict[str, Any]]:
    """The notes in a log that tell of an event; lines that are none are passed over.

    Raises:
        LogError: the file is no log.
    """
    notes = (parse_note(message.value.get("data", "")) for message in read(path, (COMMAND,)))
    return [note for note in notes if note.get("event") == event]
