"""Replay: a log's inputs through the control step again, its outputs compared byte for byte.

Rules.
1. Configuration, calibration, robot and clock anchor are the file's own.
2. It begins at tick 0, with which every control process begins, or at the first keyframe. Where ticks are missing, or
   the log says that some were dropped, it waits for the next one; where a keyframe comes along the way, the state must
   equal it.
3. The messages are made by the very function that made them for the log (channels.py).
4. What is not judged is told: a tick whose state is not known, or whose cycle is missing because it was cut off, is
   `skipped`; a stretch of time of which nothing was judged, or in which something may have been, is one of the `gaps`.
5. Each file of a merged one keeps its own clock anchor: a tick uses the anchor that gives its log time.
6. What the world answered to the outputs (times, confirmed writes) is taken over from the log: no step can compute it.
7. What the wire carried around a fault is for people: the servos' registers, which came of it, are what is judged.
8. A topic that the file lacks or declares otherwise, being of another build, is not compared, and the result says so.
"""

import json
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig, parse_yaml, validate
from armctl.control.machine import State
from armctl.control.step import step as control_step
from armctl.errors import ConfigError, LogError
from armctl.json_text import command_from_json, from_json, to_json
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Inputs, Outputs, Sample, ServoReading, TickRecord
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.channels import TOPICS, Anchor, Message, Row, TickEncoder
from armctl.recording.log_file import LogFile, LogMessage, Progress
from armctl.recording.provenance import other_program
from armctl.recording.schemas import schema_text
from armctl.recording.writer import DIAGNOSTICS_PERIOD_NS

# Characters of a value in `first_mismatch`.
SHOWN = 200
# Metadata record of a file that was merged from several; `anchors` are those of the later ones, wall/monotonic.
MERGED = "merged"
# Metadata record of a recovered file: what it was made from, and what was lost.
RECOVERED = "recovered"
_COMPARED = (
    channels.JOINT_STATES, channels.JOINT_COMMANDS, channels.TF, channels.TCP_POSE, channels.JOINT_TRAJECTORY,
    channels.WRITES, channels.COMMAND, channels.ROSOUT, channels.CYCLE, channels.DIAGNOSTICS,
)  # fmt: skip
# What a cycle tells of the world beside the inputs.
_TOLD = ("lateness_us", "write_us", "dropped", "goal_sent")
# A control step (see control/step.py); the last argument is its period [s].
Step = Callable[[State, Inputs, ArmConfig, Robot, float], tuple[State, Outputs]]


@dataclass
class ReplayResult:
    """Outcome of a check. `messages` were compared, `mismatches` of them differ; `first_mismatch` says where."""

    # Whose outputs were compared, and `judged` as well.
    ticks: int = 0
    messages: int = 0
    mismatches: int = 0
    seconds: float = 0.0
    realtime_ratio: float = 0.0
    first_mismatch: str = ""
    # The same in parts: `tick`, `field`, `logged` and `computed`; `ulps` between them where both are floats.
    first: dict[str, Any] | None = None
    # Topics that the log's armctl did not write, or not as this one does; known from the first judged tick on.
    not_compared: tuple[str, ...] = ()
    # Ticks of the file's own that could not be judged.
    skipped: int = 0
    # Where nothing was judged, `from_s` and `to_s` since the file's first tick; None: nobody knows how long.
    gaps: tuple[dict[str, float | None], ...] = ()
    # Of the armctl that made the log: another one may decide otherwise.
    version: str = ""
    # Its commit and the digest of its sources (see provenance.py); empty: they are not in the log.
    commit: str = ""
    sources: str = ""

    @property
    def judged(self) -> int:
        return self.ticks

    @property
    def passed_over(self) -> bool:
        """Whether anything in the file was not judged."""
        return bool(self.skipped or self.gaps or self.not_compared)


class LogSetup(NamedTuple):
    """What a file says about the arm it is of."""

    arm: ArmConfig
    robot: Robot
    period_s: float
    anchor: Anchor
    # Of the files that were merged behind the first one.
    later_anchors: tuple[Anchor, ...] = ()

    def anchor_of(self, time_ns: int, epoch_ns: int) -> Anchor:
        """The anchor that gives a monotonic time its epoch time; the first one if none does."""
        fitting = (anchor for anchor in self.later_anchors if anchor.epoch_ns(time_ns) == epoch_ns)
        return self.anchor if self.anchor.epoch_ns(time_ns) == epoch_ns else next(fitting, self.anchor)


def log_setup(log: LogFile) -> LogSetup:
    """Arm, robot, period and clock anchor from a file's own attachments.

    Raises:
        LogError: the file was not written by armctl, or its beginning is damaged.
    """
    where = f"{log.path}: calibration.yaml"
    try:
        arm = validate(ArmConfig, parse_yaml(log.text("calibration.yaml"), where), where)
        facts, robot, merged = log.facts, log.seed()["robot"], log.metadata.get(MERGED, {})
        return LogSetup(
            arm=arm,
            robot=robots.get(robot["name"] if isinstance(arm.robot, str) else arm.robot, robot["lengths_m"]),
            period_s=float(facts["period_s"]),
            anchor=Anchor(int(facts["anchor_wall_ns"]), int(facts["anchor_monotonic_ns"])),
            later_anchors=tuple(Anchor(*map(int, pair.split("/"))) for pair in merged.get("anchors", "").split()),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        text = f"{log.path}: does not say what it is a log of ({error}); it was not written by armctl"
        raise LogError(text) from None


@dataclass
class _Tick:
    """The messages of one tick, collected until its cycle completes them."""

    servos: Value | None = None
    # The tick that each one was asked of, and its JSON.
    commands: list[tuple[int, Any]] = field(default_factory=list)
    confirmed: tuple[bool, ...] = ()
    logged: dict[str, list[bytes]] = field(default_factory=dict)


def check(path: Path, progress: Progress | None = None, *, step: Step = control_step) -> ReplayResult:
    """Run a log's inputs through the control step and compare with what is logged.

    Args:
        progress: Called with the fraction done.
        step: What to run the inputs through.
    Raises:
        LogError: the file is no log of armctl's, holds no state to begin at, or cannot be parsed.
    """
    begun_s = time.perf_counter()
    with LogFile(path, progress) as log:
        rerun = Rerun(log, log_setup(log), step)
        for message in log.messages():
            rerun.take(message)
        result = rerun.end()
    if not rerun.keyframes and not result.ticks:
        raise LogError(f"{path}: holds no keyframe; there is no state to begin at")
    result.seconds = time.perf_counter() - begun_s
    result.realtime_ratio = rerun.duration_ns / NS_PER_S / max(result.seconds, 1e-9)
    return result


class Rerun:
    """The control step over a log's inputs, compared on the way: messages in, figures out."""

    def __init__(self, log: LogFile, setup: LogSetup, step: Step = control_step) -> None:
        self.keyframes = self.duration_ns = 0
        version, commit, sources = (log.facts.get(key, "") for key in ("version", "commit", "sources"))
        self.found = ReplayResult(version=version, commit=commit, sources=sources)
        # State after the last tick; None: not known.
        self.state: State | None = None
        self._log, self._setup, self._step = log, setup, step
        self._encoder = TickEncoder()
        self._last_tick: int | None = None
        self._last_ns = 0
        self._tick = _Tick()
        # Epoch times [ns] of the file's first own tick and of the last one, and since when nothing is judged.
        self._zero_ns = self._own_ns = self._gap_ns = 0
        self._gaps: list[tuple[int, int | None]] = []
        # What diagnostics are written of when it changes (see writer.py); empty: not known.
        self._diagnosed: tuple[object, ...] = ()

    def end(self) -> ReplayResult:
        """What was found, behind the last message: with what the file lacks there."""
        self._cut_off()
        log, gaps = self._log, self._gaps
        cut = not log.ended or RECOVERED in log.metadata or not (log.complete or log.damaged)
        if self._gap_ns:
            gaps.append((self._gap_ns, None if cut else self._own_ns))
        elif cut:
            gaps.append((self._own_ns, None))
        elif log.damaged and not gaps:
            gaps.append((self._zero_ns, self._own_ns))  # what was lost there nobody knows
        since = [[None if at is None else (at - self._zero_ns) / NS_PER_S for at in gap] for gap in gaps]
        self.found.gaps = tuple({"from_s": from_s, "to_s": to_s} for from_s, to_s in since)
        return self.found

    def take(self, message: LogMessage) -> None:
        """The next message of the file.

        Raises:
            LogError: it is not what armctl writes.
        """
        with self._log.as_written(message.topic):
            self._take(message)

    def _take(self, message: LogMessage) -> None:
        topic = message.topic
        compared = topic in _COMPARED
        if topic == channels.STATE:
            self._keyframe(self._log.decode(message)["data"])
        elif topic == channels.SERVOS:
            # Servos come first: whatever was collected without a cycle belonged to a tick that was cut.
            self._cut_off()
            self._tick = _Tick(servos=self._log.decode(message))
        elif topic == channels.COMMAND:
            number, kind, data = channels.parse_record(self._log.decode(message)["data"]) or (0, "", None)
            if kind == "command":
                self._tick.commands.append((number, data))
            compared = kind == "reply"
        elif topic == channels.ROSOUT:
            compared = self._log.decode(message)["name"] == channels.CONTROL
        if compared:
            self._tick.logged.setdefault(topic, []).append(message.data)
        if topic == channels.WRITES:
            self._tick.confirmed = tuple(write["confirmed"] for write in self._log.decode(message)["writes"])
        elif topic == channels.CYCLE:
            tick, self._tick = self._tick, _Tick()
            self._finish(tick, self._log.decode(message), message.log_time_ns)

    def _keyframe(self, text: str) -> None:
        self.keyframes += 1
        state = self._parsed(from_json, State, text)
        if self.state is not None:
            self.found.messages += 1
            if state != self.state:
                self._differs(channels.STATE, state, self.state, lambda one: json.loads(to_json(one)))
        self.state = state

    def _cut_off(self) -> None:
        """Count what was collected of a tick that has no cycle; a trimmed file begins with diagnostics of its own."""
        self.found.skipped += self._tick.servos is not None or not self._tick.logged.keys() <= {channels.DIAGNOSTICS}

    def _finish(self, tick: _Tick, cycle: Value, epoch_ns: int) -> None:
        number, time_ns, own = cycle["tick"], cycle["time_ns"], not cycle["inputs_only"]
        if (self._last_tick is not None and number != self._last_tick + 1) or cycle["dropped"] or tick.servos is None:
            self.state, self._diagnosed = None, ()
            self._gap_ns = self._gap_ns or self._own_ns
        if number == 0:
            self.state = State()
        previous_ns = self._last_ns
        self._last_tick, self._last_ns = number, time_ns
        if own:
            self._zero_ns, self._own_ns = self._zero_ns or epoch_ns, epoch_ns
        if self.state is None or tick.servos is None:
            self.found.skipped += own
            self._gap_ns = self._gap_ns or epoch_ns * own
            return
        if own and self._gap_ns:
            self._gaps.append((self._gap_ns, epoch_ns))
            self._gap_ns = 0
        setup = self._setup
        inputs = self._inputs(tick.servos["servos"], tick.commands, cycle)
        try:
            self.state, outputs = self._step(self.state, inputs, setup.arm, setup.robot, setup.period_s)
        except Exception as error:  # the log may be anybody's, and say anything
            raise LogError(f"{self._log.path}: tick {number}: the control step cannot take it: {error!r}") from error
        if not own:
            return
        if not self.found.ticks:
            declared = self._log.declarations
            ours = {topic: schema_text(TOPICS[topic].type).encode() for topic in _COMPARED}
            self.found.not_compared = tuple(topic for topic, text in ours.items() if declared.get(topic) != text)
        self.found.ticks += 1
        self.duration_ns += time_ns - previous_ns if previous_ns else 0
        told = {key: cycle[key] for key in _TOLD if key in cycle}
        record = TickRecord(inputs, outputs, confirmed=tick.confirmed, **told)
        before = self.found.mismatches
        for topic, logged, computed in self._pairs(tick, record, setup.anchor_of(time_ns, epoch_ns)):
            # Diagnostics sum up the others: what these have shown is not counted again.
            if topic != channels.DIAGNOSTICS or self.found.mismatches == before:
                self._compare(topic, logged, computed)

    def _pairs(self, tick: _Tick, record: TickRecord, anchor: Anchor) -> Iterator[tuple[str, list[bytes], list[bytes]]]:
        """What the log holds of each topic in a tick, and what is computed."""
        arm, robot = self._setup.arm, self._setup.robot
        messages: list[Row | Message] = [*channels.output_rows(record, anchor, arm, robot)]
        messages += [*channels.event_messages(record, anchor, arm), channels.cycle_row(record, anchor)]
        now = (record.inputs.sample.time_ns // DIAGNOSTICS_PERIOD_NS, record.outputs.mode, record.outputs.faults)
        due = self._diagnosed and self._diagnosed != now
        self._diagnosed = now
        if due or channels.DIAGNOSTICS in tick.logged:  # a file of several has more of them than are due
            messages.append(channels.diagnostics(record, anchor, arm))
        for topic in _COMPARED:
            if topic not in self.found.not_compared:
                computed = [self._encoder.encode(message) for message in messages if message[0] == topic]
                yield topic, tick.logged.get(topic, []), computed

    def _inputs(self, servos: list[Value], commands: list[tuple[int, Any]], cycle: Value) -> Inputs:
        ids = tuple(servo["id"] for servo in servos)
        if ids != self._setup.arm.servo_ids:
            raise LogError(f"{self._log.path}: servos {ids} in a log of an arm with {self._setup.arm.servo_ids}")
        readings = tuple(ServoReading(servo["id"], **{key: servo[key] for key in channels.READING}) for servo in servos)
        sample = Sample(cycle["time_ns"], readings, **{key: cycle[key] for key in ("bus_us", "retries", "port_open")})
        asked = [json.dumps(data) for tick, data in commands if tick == cycle["tick"]]
        parsed = tuple(self._parsed(command_from_json, text) for text in asked)
        return Inputs(cycle["tick"], cycle["now_ns"], sample, parsed, cycle["late_ns"])

    def _parsed(self, parse: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return parse(*arguments)
        except (ValueError, RecursionError) as error:
            why = str(error).splitlines()[0] + other_program(self._log.facts)
            raise LogError(f"{self._log.path}: a record cannot be understood: {why}") from None

    def _compare(self, topic: str, logged: list[bytes], computed: list[bytes]) -> None:
        self.found.messages += max(len(logged), len(computed))
        for ours, theirs in zip_longest(logged, computed):
            if ours != theirs:
                self._differs(topic, ours, theirs, TOPICS[topic].codec.decode)

    def _differs(self, topic: str, logged: Any, computed: Any, plain: Callable[[Any], Value]) -> None:
        self.found.mismatches += 1
        if self.found.first is None:
            values = (None if one is None else plain(one) for one in (logged, computed))
            field, *differing = _difference(topic, *values)
            # As JSON that everybody reads: what is no number is a word.
            ours, theirs = json.loads(json.dumps(differing), parse_constant=str)
            ulps = _ulps(ours, theirs) if isinstance(ours, float) and isinstance(theirs, float) else None
            tick = self._last_tick
            told = ("nothing" if one is None else json.dumps(one)[:SHOWN] for one in (ours, theirs))
            self.found.first = {"tick": tick, "field": field, "logged": ours, "computed": theirs, "ulps": ulps}
            self.found.first_mismatch = "tick {}, {}: logged {}, computed {}".format(tick, field, *told)


def _difference(name: str, logged: Any, computed: Any) -> tuple[str, Any, Any]:
    """Name and values of the first field in which two messages differ; those of one that lists more are None."""
    parts: Iterator[tuple[str, Any, Any]] = iter(())
    if isinstance(logged, dict) and isinstance(computed, dict):
        parts = ((f"{name}.{key}", value, computed.get(key)) for key, value in logged.items())
    elif isinstance(logged, list) and isinstance(computed, list):
        pairs = zip_longest(logged, computed)
        parts = ((f"{name}[{index}]", ours, theirs) for index, (ours, theirs) in enumerate(pairs))
    # By their texts: 0.0 is not -0.0 in the bytes.
    differing = next((part for part in parts if repr(part[1]) != repr(part[2])), None)
    return (name, logged, computed) if differing is None else _difference(*differing)


def _ulps(a: float, b: float) -> int:
    """How many floats lie from one to the other."""
    places = (bits if bits >= 0 else -(bits & 2**63 - 1) for bits in struct.unpack("<2q", struct.pack("<2d", a, b)))
    return abs(int.__sub__(*places))
