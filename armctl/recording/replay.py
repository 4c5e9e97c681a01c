"""Replay: a log's inputs through the control step again, its outputs compared byte for byte.

Rules.
1. Configuration, calibration, robot and clock anchor are the file's own.
2. It begins at the first keyframe. Where ticks are missing, or the log says that some were dropped, it waits for
   the next keyframe; where a keyframe comes along the way, the state must equal it.
3. The messages are made by the very function that made them for the log (channels.py).
4. A tick whose cycle is missing was cut off and is not judged.
5. Each file of a merged one keeps its own clock anchor: a tick uses the anchor that gives its log time.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig, parse_yaml, validate
from armctl.control.machine import State
from armctl.control.step import step as control_step
from armctl.errors import ConfigError, LogError
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Inputs, Outputs, Sample, ServoReading, TickRecord, command_from_json, from_json
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.channels import TOPICS, Anchor
from armctl.recording.log_file import LogFile, LogMessage

PROGRESS_TICKS = 500
# Metadata record of a file that was merged from several; `anchors` are those of the later ones, wall/monotonic.
MERGED = "merged"
_COMPARED = (
    channels.JOINT_STATES, channels.JOINT_COMMANDS, channels.TF, channels.TCP_POSE, channels.JOINT_TRAJECTORY,
    channels.COMMAND, channels.ROSOUT,
)  # fmt: skip
# A control step (see control/step.py); the last argument is its period [s].
Step = Callable[[State, Inputs, ArmConfig, Robot, float], tuple[State, Outputs]]


@dataclass(frozen=True)
class ReplayResult:
    """Outcome of a check. `messages` were compared, `mismatches` of them differ; `first_mismatch` says where."""

    ticks: int
    messages: int
    mismatches: int
    seconds: float
    realtime_ratio: float
    first_mismatch: str
    # Of the armctl that made the log: another one may decide otherwise.
    version: str


@dataclass(frozen=True)
class LogSetup:
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
            robot=robots.get(robot["name"], robot["lengths_m"]),
            period_s=float(facts["period_s"]),
            anchor=Anchor(int(facts["anchor_wall_ns"]), int(facts["anchor_monotonic_ns"])),
            later_anchors=tuple(Anchor(*map(int, pair.split("/"))) for pair in merged.get("anchors", "").split()),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise LogError(
            f"{log.path}: does not say what it is a log of ({error}); it was not written by armctl"
        ) from None


@dataclass
class _Tick:
    """The messages of one tick, collected until its cycle completes them."""

    servos: Value | None = None
    records: list[tuple[int, str, Any]] = field(default_factory=list)
    logged: dict[str, list[bytes]] = field(default_factory=dict)


def check(path: Path, progress: Callable[[float], None] | None = None, *, step: Step = control_step) -> ReplayResult:
    """Run a log's inputs through the control step and compare with what is logged.

    Args:
        progress: Called with the fraction done.
        step: What to run the inputs through.
    Raises:
        LogError: the file is no log of armctl's, holds no keyframe, or cannot be parsed.
    """
    begun_s = time.perf_counter()
    with LogFile(path) as log:
        replay = Rerun(log, log_setup(log), step)
        for message in log.messages():
            replay.take(message)
            if progress is not None and message.topic == channels.CYCLE and replay.ticks % PROGRESS_TICKS == 0:
                progress(log.progress)
        version = log.facts.get("version", "")
    if not replay.keyframes:
        raise LogError(f"{path}: holds no keyframe; there is no state to begin at")
    counts = {key: getattr(replay, key) for key in ("ticks", "messages", "mismatches", "first_mismatch")}
    seconds = time.perf_counter() - begun_s
    ratio = replay.duration_ns / NS_PER_S / max(seconds, 1e-9)
    return ReplayResult(seconds=seconds, realtime_ratio=ratio, version=version, **counts)


class Rerun:
    """The control step over a log's inputs, compared on the way: messages in, figures out."""

    def __init__(self, log: LogFile, setup: LogSetup, step: Step = control_step) -> None:
        self.ticks = self.messages = self.mismatches = self.keyframes = self.duration_ns = 0
        self.first_mismatch = ""
        # State after the last tick; None: not known.
        self.state: State | None = None
        self._log, self._setup, self._step = log, setup, step
        self._last_tick: int | None = None
        self._last_ns = 0
        self._tick = _Tick()

    def take(self, message: LogMessage) -> None:
        """The next message of the file.

        Raises:
            LogError: it is not what armctl writes.
        """
        try:
            self._take(message)
        except (TypeError, ValueError, AttributeError, LookupError) as error:
            raise self._log.misfit(message, error) from None

    def _take(self, message: LogMessage) -> None:
        topic = message.topic
        compared = topic in _COMPARED
        if topic == channels.STATE:
            self._keyframe(self._log.decode(message)["data"])
        elif topic == channels.SERVOS:
            # Servos come first: whatever was collected without a cycle belonged to a tick that was cut.
            self._tick = _Tick(servos=self._log.decode(message))
        elif topic == channels.COMMAND:
            record = channels.parse_record(self._log.decode(message)["data"])
            if record is not None:
                self._tick.records.append(record)
            compared = record is not None and record[1] == "reply"
        elif topic == channels.CYCLE:
            tick, self._tick = self._tick, _Tick()
            self._finish(tick, self._log.decode(message), message.log_time_ns)
        elif topic == channels.ROSOUT:
            compared = self._log.decode(message)["name"] == channels.CONTROL
        if compared:
            self._tick.logged.setdefault(topic, []).append(message.data)

    def _keyframe(self, text: str) -> None:
        self.keyframes += 1
        state = self._parsed(from_json, State, text)
        if self.state is not None:
            self._compare(channels.STATE, [state], [self.state])
        self.state = state

    def _finish(self, tick: _Tick, cycle: Value, epoch_ns: int) -> None:
        number, time_ns = cycle["tick"], cycle["time_ns"]
        gap = self._last_tick is not None and number != self._last_tick + 1
        if gap or cycle["dropped"] or tick.servos is None:
            self.state = None
        previous_ns = self._last_ns
        self._last_tick, self._last_ns = number, time_ns
        if self.state is None or tick.servos is None:
            return
        setup = self._setup
        inputs = self._inputs(tick.servos, tick.records, cycle)
        try:
            self.state, outputs = self._step(self.state, inputs, setup.arm, setup.robot, setup.period_s)
        except Exception as error:  # the log may be anybody's, and say anything
            raise LogError(f"{self._log.path}: tick {number}: the control step cannot take it: {error!r}") from error
        if cycle["inputs_only"]:
            return
        self.ticks += 1
        self.duration_ns += time_ns - previous_ns if previous_ns else 0
        computed: dict[str, list[bytes]] = {}
        anchor = setup.anchor_of(time_ns, epoch_ns)
        for topic, value in channels.output_messages(TickRecord(inputs, outputs), anchor, setup.arm, setup.robot):
            computed.setdefault(topic, []).append(TOPICS[topic].codec.encode(value))
        for topic in _COMPARED:
            self._compare(topic, tick.logged.get(topic, []), computed.get(topic, []))

    def _inputs(self, servos: Value, records: list[tuple[int, str, Any]], cycle: Value) -> Inputs:
        ids = tuple(servo["id"] for servo in servos["servos"])
        if ids != self._setup.arm.servo_ids:
            raise LogError(f"{self._log.path}: servos {ids} in a log of an arm with {self._setup.arm.servo_ids}")
        readings = tuple(
            ServoReading(servo["id"], **{key: servo[key] for key in channels.READING}) for servo in servos["servos"]
        )
        sample = Sample(cycle["time_ns"], readings, **{key: cycle[key] for key in ("bus_us", "retries", "port_open")})
        commands = tuple(
            self._parsed(command_from_json, json.dumps(data))
            for tick, kind, data in records
            if kind == "command" and tick == cycle["tick"]
        )
        return Inputs(cycle["tick"], cycle["now_ns"], sample, commands, cycle["late_ns"])

    def _parsed(self, parse: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return parse(*arguments)
        except (ValueError, RecursionError) as error:
            raise LogError(f"{self._log.path}: a record cannot be understood: {error}") from None

    def _compare(self, topic: str, logged: list[Any], computed: list[Any]) -> None:
        self.messages += max(len(logged), len(computed))
        wrong = sum(a != b for a, b in zip_longest(logged, computed))
        self.mismatches += wrong
        if wrong and not self.first_mismatch:
            self.first_mismatch = f"tick {self._last_tick}, {topic}: {wrong} of {len(logged)} messages differ"
