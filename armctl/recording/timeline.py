"""A log as what a person watches: one frame a tick, and a whole log of them as arrays.

Rules.
1. A frame is a tick that the file holds completely (its cycle is there); ticks kept for replay alone are none.
2. Positions, speeds and loads are what the daemon said (/joint_states), the rest is what the servos said (their
   registers). What is not known is NaN.
3. The goal is the one in the servo's register while it has torque: what the servo was told, whoever told it.
4. State and fault hold from the /diagnostics that tells of them until the next one; it comes on every change.
5. Time 0 is the first frame.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.columns import Payloads, Table
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.notes import parse_note
from armctl.recording.replay import log_setup

BLOCK_FRAMES = 500
_TORQUE, _GOAL, _VOLTAGE, _TEMPERATURE = (
    register.address - ax12a.STATUS_BEGIN
    for register in (ax12a.TORQUE_ENABLE, ax12a.GOAL, ax12a.PRESENT_VOLTAGE, ax12a.PRESENT_TEMPERATURE)
)
# What every frame is made of, and what it tells of the joints.
_SAMPLED = (channels.SERVOS, channels.JOINT_STATES, channels.TCP_POSE)
_OF_JOINTS = (*channels.QUANTITIES.values(), "goal_rad", "voltage_V", "temperature_degC")
# Of the cycle of a tick, in the order of a frame's `cycle`.
CYCLE_KEYS = ("bus_us", "lateness_us", "retries", "overrun", "dropped")
# What happened beside them.
_HAPPENED = (channels.ROSOUT, channels.COMMAND, channels.WRITES)
_TOPICS = (*_SAMPLED, channels.DIAGNOSTICS, *_HAPPENED, channels.CYCLE)
_NAMES = {register.address: register.name for register in ax12a.REGISTERS}
_UNKNOWN_TOOL = (math.nan,) * 7


@dataclass(frozen=True, slots=True)
class Happening:
    """Something that is no sample: a request, its outcome, register writes, an event. `level` is that of /rosout."""

    time_ns: int
    level: int
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Motion:
    """One plan that was run to its end: when, and the joint positions [rad] it was to begin and end at."""

    label: str
    begin_rad: tuple[float, ...]
    end_rad: tuple[float, ...]
    begin_ns: int = 0
    end_ns: int = 0


@dataclass(frozen=True, slots=True)
class Frame:
    """One tick; every sequence has one value a joint, in the calibration's order."""

    time_ns: int
    tick: int
    position_rad: list[float]
    velocity_rad_s: list[float]
    load_ratio: list[float]
    goal_rad: list[float]
    voltage_V: list[float]
    temperature_degC: list[float]
    torque_enabled: list[bool]
    # Whether the servo answered in this tick.
    fresh: list[bool]
    cycle: list[float]
    # x, y, z [m] and the quaternion x, y, z, w.
    tool: tuple[float, ...]
    state: str
    # CODE: text; empty if there is none.
    fault: str


class Frames:
    """The frames of an open log in file order; what happened, and what was commanded, collects on the way.

    Args:
        topics: What is read of the log.
    Raises:
        LogError: the file was not written by armctl, or its beginning is damaged.
    """

    def __init__(self, log: LogFile, topics: Sequence[str] = _TOPICS) -> None:
        self.arm: ArmConfig = log_setup(log).arm
        self.happenings: list[Happening] = []
        self.motions: list[Motion] = []
        self._log, self._topics = log, topics
        self._state = self._fault = ""
        # Servos, joints and tool of the tick that is not over yet, by topic.
        self._tick: dict[str, Any] = {}
        self._run: Motion | None = None

    def __iter__(self) -> Iterator[Frame]:
        for message in self._log.messages(self._topics):
            value = self._log.decode(message)
            try:
                frame = self._take(message, value)
            except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as error:
                # A file from elsewhere may bear our topics with anything in them.
                raise self._log.misfit(message, error) from None
            if frame is not None:
                yield frame

    def columns(self) -> dict[str, Any] | None:
        """All frames at once: by the name of a frame's field an array with a row a frame, in a tenth of the time.

        None where the log is damaged, or is not as armctl writes it; then its ticks tell one by one, in another pass.
        """
        found = self._log.payloads((*_SAMPLED, channels.CYCLE, channels.DIAGNOSTICS))
        try:
            return self._columns(found) if self._log.complete else None
        except (LookupError, TypeError, ValueError, AttributeError, LogError):
            return None

    def _columns(self, found: dict[str, Payloads]) -> dict[str, Any] | None:
        cycles = [(t, t.numbers("inputs_only") == 0) for t in self._log.tables(channels.CYCLE, found[channels.CYCLE])]
        time_ns = np.concatenate([t.log_time_ns[own] for t, own in cycles]).astype(np.int64)
        order = np.argsort(time_ns)
        tick = np.concatenate([t.numbers("tick")[own] for t, own in cycles]).astype(np.int64)[order]
        time_ns = time_ns[order]
        values: dict[str, Any] = {key: np.full((len(tick), len(self.arm.joints)), math.nan) for key in _OF_JOINTS}
        values["tool"] = np.full((len(tick), len(_UNKNOWN_TOOL)), math.nan)
        values |= {key: np.zeros((len(tick), len(self.arm.joints)), np.bool_) for key in ("torque_enabled", "fresh")}
        told_of = [np.concatenate([t.numbers(key)[own] for t, own in cycles])[order] for key in CYCLE_KEYS]
        values["cycle"] = np.stack(told_of, axis=1)
        for topic in _SAMPLED:
            told = 0
            for table in self._log.tables(topic, found.get(topic, Payloads())):
                rows = np.searchsorted(time_ns, table.log_time_ns.astype(np.int64)).clip(max=len(tick) - 1)
                kept = (time_ns[rows] == table.log_time_ns) & (tick[rows] & 0xFFFFFFFF == table.sequence)
                told += int(kept.sum())
                self._enter(topic, table, rows[kept], kept, values)
            if told != len(tick) and topic != channels.TCP_POSE:
                return None
        diagnosed_ns, told_then = np.array(found[channels.DIAGNOSTICS].log_time_ns, np.int64), [("", "")]
        for data in found[channels.DIAGNOSTICS].data:
            self._diagnosed(self._log.codec(channels.DIAGNOSTICS).decode(data))
            told_then.append((self._state, self._fault))
        if (np.diff(time_ns) <= 0).any() or (np.diff(diagnosed_ns) < 0).any():
            return None
        state, fault = zip(*[told_then[at] for at in np.searchsorted(diagnosed_ns, time_ns, side="right")], strict=True)
        return {"time_ns": time_ns, "tick": tick, "state": state, "fault": fault, **values}

    def _enter(self, topic: str, table: Table, rows: Any, kept: Any, values: dict[str, Any]) -> None:
        """Put what messages of one shape say of their frames where it belongs; some are of no frame."""
        columns: dict[str, Any] = table.columns
        if topic == channels.TCP_POSE:
            parts = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
            values["tool"][rows] = np.stack([columns[f"pose.{part}"][kept] for part in parts], axis=1)
        elif topic == channels.JOINT_STATES:
            names = [set(column.tolist()) for path, column in columns.items() if path.startswith("name[")]
            for index, (name,) in enumerate(names):  # or there is more than one at its place
                for key, quantity in channels.QUANTITIES.items():
                    values[quantity][rows, self.arm.joint_names.index(name)] = columns[key][kept, index]
        elif f"servos[{len(self.arm.joints)}].id" in columns:
            raise ValueError("another number of servos")
        else:
            for index, joint in enumerate(self.arm.joints):
                values["fresh"][rows, index] = columns[f"servos[{index}].fresh"][kept]
                block: Any = columns[f"servos[{index}].registers"][kept].astype(np.int64)
                if block.shape[1]:
                    torque, goal = block[:, _TORQUE] > 0, block[:, _GOAL] + 256 * block[:, _GOAL + 1]
                    values["torque_enabled"][rows, index] = torque
                    values["goal_rad"][rows, index] = np.where(torque, joint.position_rad(goal), math.nan)
                    values["voltage_V"][rows, index] = block[:, _VOLTAGE] / 10.0
                    values["temperature_degC"][rows, index] = block[:, _TEMPERATURE]

    def _take(self, message: LogMessage, value: Value) -> Frame | None:
        """One message; the frame, if a tick ends with it."""
        topic, tick = message.topic, self._tick
        if topic == channels.SERVOS:
            self._tick = {topic: value}
        elif topic == channels.JOINT_STATES:
            tick[topic] = value
        elif topic == channels.TCP_POSE:
            position, turn = value["pose"]["position"], value["pose"]["orientation"]
            tick[topic] = (*(position[axis] for axis in "xyz"), *(turn[axis] for axis in "xyzw"))
        elif topic == channels.DIAGNOSTICS:
            self._diagnosed(value)
        elif topic == channels.CYCLE:
            self._tick = {}
            if not value["inputs_only"] and tick.keys() >= {channels.SERVOS, channels.JOINT_STATES}:
                return self._frame(message.log_time_ns, value, tick)
        else:
            self._happened(message, value)
        return None

    def _frame(self, time_ns: int, cycle: Value, tick: dict[str, Any]) -> Frame:
        joints, servos = tick[channels.JOINT_STATES], tick[channels.SERVOS]["servos"]
        registers, names = [servo["registers"] for servo in servos], self.arm.joint_names
        if len(registers) != len(names):
            raise ValueError(f"{len(registers)} servos, the arm has {len(names)}")
        values = zip(*(joints[key] for key in channels.QUANTITIES), strict=False)
        told = dict(zip(joints["name"], values, strict=False))
        columns = map(list, zip(*(told.get(name, (math.nan,) * 3) for name in names), strict=True))
        torque = [bool(block and block[_TORQUE]) for block in registers]
        return Frame(
            time_ns=time_ns,
            tick=cycle["tick"],
            **dict(zip(channels.QUANTITIES.values(), columns, strict=True)),
            goal_rad=[
                joint.position_rad(ax12a.register_value(ax12a.GOAL, block)) if on else math.nan
                for joint, block, on in zip(self.arm.joints, registers, torque, strict=True)
            ],
            voltage_V=[block[_VOLTAGE] / 10.0 if block else math.nan for block in registers],
            temperature_degC=[float(block[_TEMPERATURE]) if block else math.nan for block in registers],
            torque_enabled=torque,
            fresh=[servo["fresh"] for servo in servos],
            cycle=[cycle[key] for key in CYCLE_KEYS],
            tool=tick.get(channels.TCP_POSE, _UNKNOWN_TOOL),
            state=self._state,
            fault=self._fault,
        )

    def _diagnosed(self, value: Value) -> None:
        arm = next((status for status in value["status"] if status["name"] == "armctl: arm"), None)
        if arm is None:
            return
        facts = {pair["key"]: pair["value"] for pair in arm["values"]}
        self._state = facts.get("mode", arm["message"])
        self._fault = arm["message"].removeprefix(f"{self._state}: ") if facts.get("fault") else ""

    def _happened(self, message: LogMessage, value: Value) -> None:
        time_ns = message.log_time_ns
        if message.topic == channels.ROSOUT:
            source = "" if value["name"] == channels.CONTROL else f"{value['name']}: "
            self.happenings.append(Happening(time_ns, value["level"], value["function"], f"{source}{value['msg']}"))
            self._mark(value["function"], time_ns)
        elif message.topic == channels.WRITES:
            failed = any(not write["confirmed"] for write in value["writes"])
            self.happenings.append(Happening(time_ns, 30 if failed else 20, "WRITE", _written(value["writes"])))
        elif (record := channels.parse_record(value["data"])) is None:
            if (asked := _request(value["data"])) is not None:
                self.happenings.append(Happening(time_ns, 20, *asked))
        elif record[1] == "command" and record[2].get("kind") == "run":
            self._commanded(record[2])

    def _mark(self, code: str, time_ns: int) -> None:
        """Where the plan proper of the last run begins and ends."""
        if code == "PLAN_BEGIN" and self._run is not None:
            self._run = replace(self._run, begin_ns=time_ns)
        elif code == "PLAN_END" and self._run is not None and self._run.begin_ns:
            self.motions.append(replace(self._run, end_ns=time_ns))
            self._run = None

    def _commanded(self, run: dict[str, Any]) -> None:
        path = run["trajectory"]
        rows, period_s = path["positions_rad"], path["period_s"]
        if times := path.get("times_s"):
            begin, end = (
                [float(np.interp(path[key], times, column)) for column in zip(*rows, strict=True)]
                for key in ("begin_s", "end_s")
            )
        else:
            begin, end = (rows[min(round(path[key] / period_s), len(rows) - 1)] for key in ("begin_s", "end_s"))
        self._run = Motion(str(path["label"]), tuple(begin), tuple(end))


def _written(writes: Sequence[Value]) -> str:
    """What was written to whom, and who did not confirm it."""
    servos: dict[str, list[str]] = {}
    for write in writes:
        what = f"{_NAMES.get(write['address'], write['address'])} = {write['value']}"
        servos.setdefault(what, []).append(f"{write['servo_id']}{'' if write['confirmed'] else ' (not confirmed)'}")
    return "wrote " + "; ".join(f"{what} to servo {', '.join(ids)}" for what, ids in servos.items())


def _request(text: str) -> tuple[str, str] | None:
    """(code, text) of what a client asked for, as the host notes it; None for other notes."""
    note = parse_note(text)
    if "request" not in note:
        return None
    reasons = "; ".join(map(str, note.get("reasons", ())))
    outcome = str(note.get("outcome", "")) + (f": {reasons}" if reasons else "")
    return "REQUEST", f"{note['request']} by {note.get('who', 'somebody')}: {outcome}"


@dataclass(frozen=True)
class Timeline:
    """A whole log as arrays over its m frames and n joints.

    `time_s` (m,) counts from the first frame; joint arrays have shape (m, n), `tool` (m, 7) holds x, y, z [m] and
    the quaternion x, y, z, w, `cycle` (m, 5) what `CYCLE_KEYS` names. `states` and `faults` list (from which frame on,
    what).
    """

    path: Path
    arm: ArmConfig
    # Epoch time of the first frame [ns].
    start_ns: int
    time_s: FloatArray
    tick: NDArray[np.int64]
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    load_ratio: FloatArray
    goal_rad: FloatArray
    voltage_V: FloatArray
    temperature_degC: FloatArray
    torque_enabled: NDArray[np.bool_]
    fresh: NDArray[np.bool_]
    cycle: FloatArray
    tool: FloatArray
    states: tuple[tuple[int, str], ...]
    faults: tuple[tuple[int, str], ...]
    happenings: tuple[Happening, ...]
    motions: tuple[Motion, ...]
    complete: bool

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])

    def index(self, time_s: float) -> int:
        """The frame that stands at a time: the newest at or before it, the first one before them all."""
        # A time that was computed from a frame's own must find that frame.
        return max(0, int(np.searchsorted(self.time_s, time_s + 1e-6, side="right")) - 1)

    def state(self, frame: int) -> str:
        """State of the arm at a frame."""
        return next(name for begin, name in reversed(self.states) if begin <= frame)

    def fault(self, frame: int) -> str:
        """`CODE: text` of the fault at a frame; empty: none."""
        return next(name for begin, name in reversed(self.faults) if begin <= frame)


_TYPES: dict[str, Any] = dict.fromkeys(("time_ns", "tick"), np.int64) | dict.fromkeys(("state", "fault"), np.object_)
_TYPES |= dict.fromkeys(("torque_enabled", "fresh"), np.bool_)


def _changes(names: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """From which frame on, what."""
    return tuple((i, name) for i, name in enumerate(names) if i == 0 or name != names[i - 1])


def load(path: Path, progress: Callable[[float], None] | None = None) -> Timeline:
    """A whole log as arrays.

    Args:
        progress: Called with the fraction read.
    Raises:
        LogError: the file is no log of armctl's, or holds no whole tick.
    """
    blocks: dict[str, list[Any]] = {field.name: [] for field in fields(Frame)}
    with LogFile(path) as log:
        arrays = Frames(log).columns() or {}
    with LogFile(path) as log:
        found = iter(frames := Frames(log, _HAPPENED if arrays else _TOPICS))
        # In blocks: the frames of a whole log as objects would take ten times the memory of its arrays.
        while block := list(islice(found, BLOCK_FRAMES)):
            for name, parts in blocks.items():
                parts.append(np.array([getattr(frame, name) for frame in block], _TYPES.get(name, np.float64)))
            if progress is not None and len(block) == BLOCK_FRAMES:
                progress(log.progress)
        if not arrays and not blocks["tick"]:
            raise LogError(f"{path}: holds no whole tick; there is nothing to show")
        arrays = arrays or {name: np.concatenate(parts) for name, parts in blocks.items()}
        time_ns, states, faults = (arrays.pop(name) for name in ("time_ns", "state", "fault"))
        return Timeline(
            path=path,
            arm=frames.arm,
            start_ns=int(time_ns[0]),
            time_s=(time_ns - time_ns[0]) / NS_PER_S,
            **arrays,
            states=_changes(states),
            faults=_changes(faults),
            happenings=tuple(frames.happenings),
            motions=tuple(frames.motions),
            complete=log.complete,
        )
