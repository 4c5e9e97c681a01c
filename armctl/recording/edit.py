"""Trimming and merging logs.

Rules.
1. A new file opens alone: attachments, metadata, channels and the latched topics stand at its beginning, the
   latched ones with the time it begins at.
2. A new file replays alone: it begins at a keyframe. Where the old one has none there, the state is computed by
   the control step from the keyframe before, and used only if everything on the way is bit for bit as logged.
3. All other messages are taken over byte for byte.
4. Sources are only read. The new file gets its name when it is complete and on the disk, and replaces nothing.
"""

import logging
import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from armctl.clock import NS_PER_S
from armctl.control.machine import State
from armctl.errors import LogError, RequestRefused
from armctl.json_text import to_json
from armctl.messages import Event
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import PART, new_file
from armctl.recording.log_file import LogFile, LogMessage, Progress
from armctl.recording.replay import MERGED, LogSetup, Rerun, log_setup
from armctl.recording.rewrite import Rewrite

TRIMMED = "trimmed"
# Most messages kept since the last keyframe, to compute the state at a cut; several times what is between two.
MAX_WARMUP_MESSAGES = 40_000
_LATCHED = tuple(topic.name for topic in channels.TOPICS.values() if topic.latched)
# Topics whose newest message goes on being true: what a file that begins in the middle must say first.
_STANDING = (*_LATCHED, channels.DIAGNOSTICS)
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EditResult:
    """A file that was written. `damaged`: places in its sources that could not be read."""

    path: Path
    messages: int
    duration_s: float
    damaged: int = 0
    # Of a trimmed file, whether a replay begins with its first tick and not at a later keyframe.
    begins_with_state: bool | None = None


@dataclass(frozen=True)
class MergeResult(EditResult):
    """Of several files one. `gaps`: between which times [s since the first tick] two of them have nothing."""

    gaps: tuple[dict[str, float], ...] = ()


def first_ns(path: Path) -> int:
    """Log time of a log's first own tick [ns]; of its first message where it holds no ticks.

    Raises:
        LogError: the file is no log, or holds no message.
    """
    for topics in ((channels.JOINT_STATES,), None):
        with LogFile(path) as log:
            for message in log.messages(topics):
                return message.log_time_ns
    raise LogError(f"{path}: holds no message")


def trim(path: Path, out: Path, begin_s: float, end_s: float, progress: Progress | None = None) -> EditResult:
    """Write the part [begin_s, end_s) of a log to a file of its own.

    Args:
        begin_s, end_s: Seconds since the log's first tick.
        progress: Called with the fraction done.
    Raises:
        LogError: the log cannot be read, `out` exists or cannot be written.
        RequestRefused: the part is empty.
    """
    if not begin_s < end_s:
        raise RequestRefused("EMPTY", f"{begin_s:g} s to {end_s:g} s is no stretch of time; let it end after it begins")
    zero_ns = first_ns(path)
    # Further than any file goes is as good as for ever.
    begin_ns, end_ns = (zero_ns + round(max(-1e9, min(bound, 1e9)) * NS_PER_S) for bound in (begin_s, end_s))
    facts = {"from": path.name, "begin_s": repr(begin_s), "end_s": repr(end_s)}
    with LogFile(path, progress) as log, _rewriting(out, log, TRIMMED, facts) as copy:
        before = _Before(log)
        taken, has_state, has_ticks = 0, False, channels.SERVOS in log.topics
        for message in log.messages():
            # A tick is taken whole: it begins with its servos, whatever others noted at about the same time.
            if message.log_time_ns < begin_ns or (has_ticks and not taken and message.topic != channels.SERVOS):
                before.take(message)
            elif message.log_time_ns < end_ns:
                if taken == 0:
                    has_state = before.write(copy, message)
                copy.add((message,))
                taken += 1
        if taken == 0:
            until = f"to {end_s:g} s after" if end_s < math.inf else "after"
            raise RequestRefused("EMPTY", f"{path}: holds nothing {begin_s:g} s {until} its beginning")
    return EditResult(out, copy.messages, copy.duration_s, log.damaged, has_state)


def merge(paths: Sequence[Path], out: Path, progress: Progress | None = None) -> MergeResult:
    """Write consecutive files of one daemon as one, in the order of their time.

    Where a tick is missing between two of them, because the daemon was started anew or the machine lost power, the new
    file has a line with the code GAP on /rosout, and the result has a gap.

    The first one's attachments are kept. Of a later one's beginning only what goes on from the file before is: its
    latched topics and the inputs of ticks that the file before holds are there already.

    Args:
        paths: Two files or more, in any order.
        progress: Called with the fraction done.
    Raises:
        LogError: a file cannot be read or is damaged, two of them overlap or do not follow each other, `out` exists
            or cannot be written.
        RequestRefused: FOREIGN_LOG, a file of another arm or another daemon.
    """
    if len(paths) < 2:
        raise LogError(f"{paths[0] if paths else out}: one file makes no merger; name two or more")
    ordered = sorted(paths, key=first_ns)

    def show(done: int) -> Progress | None:
        """What is called with the fraction read of one of the files."""
        return None if progress is None else lambda fraction: progress((done + fraction) / len(ordered))

    with LogFile(ordered[0], show(0)) as first:
        setups = [_checked(first, path) for path in ordered]
        anchors = dict.fromkeys(anchor for setup in setups for anchor in (setup.anchor, *setup.later_anchors))
        later = " ".join(f"{a.wall_ns}/{a.monotonic_ns}" for a in anchors if a != setups[0].anchor)
        names = " ".join(path.name for path in ordered)
        with _rewriting(out, first, MERGED, {"from": names, "anchors": later}) as copy:
            merger = _Merger(copy)
            merger.take(first, None)
            for done, (before, path) in enumerate(pairwise(ordered), 1):
                with LogFile(path, show(done)) as log:
                    copy.follow(log)
                    merger.take(log, before)
    return MergeResult(out, copy.messages, copy.duration_s, gaps=tuple(merger.gaps))


def _checked(first: LogFile, path: Path) -> LogSetup:
    """What a file says of itself, if that fits the first one.

    Raises:
        RequestRefused: it is of another arm, or another daemon.
    """
    with LogFile(path) as log:
        setup = log_setup(log)
        for key in ("arm_id", "calibration_hash", "host", "port", "period_s"):
            if (ours := first.facts.get(key)) != (theirs := log.facts.get(key)):
                found = f"{key} is {theirs}, in {first.path} it is {ours}"
                raise RequestRefused("FOREIGN_LOG", f"{path}: {found}; only files of one daemon are merged")
        for topic, text in log.declarations.items():
            if first.declarations.get(topic, text) != text:
                found = f"{path}: has another type for {topic} than {first.path}"
                raise LogError(f"{found}; they are of two versions of armctl")
        return setup


class _Merger:
    """Ticks of one file after the other; knows which one was the last."""

    def __init__(self, copy: Rewrite) -> None:
        self._copy = copy
        # The last tick, and the last one that is a file's own.
        self._tick: int | None = None
        self._own: int | None = None
        self._own_ns = self._zero_ns = 0
        self._anchors: set[str | None] = set()
        self.gaps: list[dict[str, float]] = []

    def take(self, log: LogFile, before: Path | None) -> None:
        """All of a file; `before` is the one it must follow.

        Raises:
            LogError: it does not, or it is damaged.
        """
        tick: list[LogMessage] = []
        begun = before is None
        for message in log.messages():
            if before is None or message.topic not in _LATCHED:
                tick.append(message)
            if message.topic == channels.CYCLE or len(tick) > MAX_WARMUP_MESSAGES:
                begun = self._end_tick(log, tick, before, begun)
                tick = []
        self._copy.add(tick)
        self._anchors.add(log.facts.get("anchor_wall_ns"))
        if not log.complete:
            raise LogError(f"{log.path}: is damaged or has no end; mend it first: armctl log recover {log.path}")

    def _end_tick(self, log: LogFile, tick: list[LogMessage], before: Path | None, begun: bool) -> bool:
        """Take over what ends with a cycle; whether the file's own ticks have begun."""
        message, time_ns = tick[-1], tick[-1].log_time_ns
        cycle = log.decode(message)
        if not {"tick", "inputs_only"} <= cycle.keys():
            raise LogError(f"{log.path}: {message.topic} is not as armctl writes it")
        number = cycle["tick"]
        goes_on = self._tick is not None and number == self._tick + 1
        if before is not None and not begun:
            if cycle["inputs_only"] and not goes_on:
                return False
            self._follows(log, before, message, goes_on)
            # Those that are missing may be there for a replay alone.
            if not cycle["inputs_only"] and self._own not in (None, number - 1):
                self._mark(message)
            tick = [message for message in tick if message.topic != channels.STATE]
        self._copy.add(tick)
        self._tick, self._zero_ns = number, self._zero_ns or time_ns
        if not cycle["inputs_only"]:
            self._own, self._own_ns = number, time_ns
        return begun or not cycle["inputs_only"]

    def _follows(self, log: LogFile, before: Path, message: LogMessage, goes_on: bool) -> None:
        overlap_s = (self._own_ns - message.log_time_ns) / NS_PER_S
        if overlap_s >= 0.0:
            found = f"begins {overlap_s:.1f} s before {before} ends"
            raise LogError(f"{log.path}: {found}; files that overlap are not merged")
        previous = log.facts.get("previous", "")
        started = not previous and log.facts.get("anchor_wall_ns") not in self._anchors
        if not (goes_on or started or previous == before.name.removesuffix(PART)):
            found = f"does not follow {before}, but {previous or 'a part of it that is missing'}"
            raise LogError(f"{log.path}: {found}; only consecutive files are merged")

    def _mark(self, message: LogMessage) -> None:
        """Say that ticks are missing before a message."""
        from_s, to_s = ((time_ns - self._zero_ns) / NS_PER_S for time_ns in (self._own_ns, message.log_time_ns))
        self.gaps.append({"from_s": from_s, "to_s": to_s})
        event = Event("warning", "GAP", f"nothing was recorded for {to_s - from_s:.3f} s before this")
        self._copy.say(channels.ROSOUT, channels.log_line(event, message.log_time_ns, channels.RECORDING), message)


class _Before:
    """What lies before a cut: the newest of what goes on being true, and the way from the last keyframe."""

    def __init__(self, log: LogFile) -> None:
        self._log = log
        self._standing: dict[str, LogMessage] = {}
        self._since: deque[LogMessage] = deque()

    def take(self, message: LogMessage) -> None:
        if message.topic in _STANDING:
            self._standing[message.topic] = message
        if message.topic == channels.STATE or len(self._since) >= MAX_WARMUP_MESSAGES:
            self._since.clear()  # with a tick missing, the state cannot be computed
        if message.topic == channels.STATE or self._since:
            self._since.append(message)

    def write(self, copy: Rewrite, first: LogMessage) -> bool:
        """Say it again just before the first message behind the cut; whether a replay can begin there."""
        for topic, message in self._standing.items():
            copy.say(topic, _stamped(self._log.decode(message), first.log_time_ns), first)
        if (state := self._state() if self._since else None) is not None:
            copy.say(channels.STATE, {"data": to_json(state)}, first)
        return state is not None

    def _state(self) -> State | None:
        try:
            rerun = Rerun(self._log, log_setup(self._log))
            for message in self._since:
                rerun.take(message)
        except LogError as error:
            _log.warning("no state at the cut: %s", error)
            return None
        return None if rerun.found.mismatches else rerun.state


@contextmanager
def _rewriting(out: Path, log: LogFile, name: str, facts: dict[str, str]) -> Iterator[Rewrite]:
    """A new file that begins with the head of `log`; it ends with what else the last log has shown by then."""
    with new_file(out) as stream:
        writer = ChunkWriter(stream)
        rewrite = Rewrite(log, writer, name, facts)
        yield rewrite
        rewrite.keep()
        writer.finish()


def _stamped(value: Value, epoch_ns: int) -> Value:
    """A message with its stamps, or those of what it lists, set to a time."""
    if "header" in value:
        return value | {"header": value["header"] | {"stamp": channels.stamp(epoch_ns)}}
    transforms = value.get("transforms")
    if isinstance(transforms, list):
        return value | {"transforms": [_stamped(transform, epoch_ns) for transform in transforms]}
    return value
