"""A log as what a person watches: a frame a tick, all of them as arrays.

Rules.
1. A frame is a tick that the file holds completely (servos, joints, and the cycle that ends it); ticks kept for replay
   alone are none.
2. Positions, speeds and loads are what the daemon said (/joint_states), the rest is what the servos said (their
   registers). What is not known is NaN.
3. The goal is the one in the servo's register while it has torque: what the servo was told, whoever told it.
4. State and fault hold from the /diagnostics that tells of them until the next one; it comes on every change.
5. Time 0 is the first frame.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.columns import Payloads
from armctl.recording.log_file import LogFile, Progress
from armctl.recording.notes import parse_note
from armctl.recording.replay import log_setup
from armctl.trajectory.interpolate import columns_at

_REGISTERS = (ax12a.TORQUE_ENABLE, ax12a.GOAL, ax12a.PRESENT_VOLTAGE, ax12a.PRESENT_TEMPERATURE)
# What every frame is made of, and what it tells of the joints.
_SAMPLED = (channels.SERVOS, channels.JOINT_STATES, channels.TCP_POSE)
_OF_JOINTS = (*channels.QUANTITIES.values(), "goal_rad", "voltage_V", "temperature_degC")
# Of the cycle of a tick, in the order of a frame's `cycle`.
CYCLE_KEYS = ("bus_us", "lateness_us", "retries", "overrun", "dropped")
# Whose health a message tells first; where a message goes on behind its stamp.
ARM_STATUS, STAMP_END = "armctl: arm", 12
# What happened beside them.
_HAPPENED = (channels.ROSOUT, channels.COMMAND, channels.WRITES)
_NAMES = {register.address: register.name for register in ax12a.REGISTERS}


class Happening(NamedTuple):
    """Something that is no sample: a request, its outcome, register writes, an event. `level` is that of /rosout."""

    time_ns: int
    level: int
    code: str
    text: str


class Motion(NamedTuple):
    """One plan that was run to its end: when, and the joint positions [rad] it was to begin and end at."""

    label: str
    begin_rad: tuple[float, ...]
    end_rad: tuple[float, ...]
    begin_ns: int = 0
    end_ns: int = 0


class _Happenings:
    """What happened and what was commanded, collected message by message in file order."""

    def __init__(self) -> None:
        self.happenings: list[Happening] = []
        self.motions: list[Motion] = []
        self._run: Motion | None = None

    def take(self, topic: str, time_ns: int, value: Value) -> None:
        """The next message of one of `_HAPPENED`."""
        if topic == channels.ROSOUT:
            source = "" if value["name"] == channels.CONTROL else f"{value['name']}: "
            self.happenings.append(Happening(time_ns, value["level"], value["function"], f"{source}{value['msg']}"))
            self._mark(value["function"], time_ns)
        elif topic == channels.WRITES:
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
            self._run = self._run._replace(begin_ns=time_ns)
        elif code == "PLAN_END" and self._run is not None and self._run.begin_ns:
            self.motions.append(self._run._replace(end_ns=time_ns))
            self._run = None

    def _commanded(self, run: dict[str, Any]) -> None:
        path = run["trajectory"]
        rows, period_s = path["positions_rad"], path["period_s"]
        ends_s = path["begin_s"], path["end_s"]
        if times := path.get("times_s"):
            begin, end = columns_at(np.array(ends_s), np.array(times), np.array(rows)).tolist()
        else:
            begin, end = (rows[min(round(at_s / period_s), len(rows) - 1)] for at_s in ends_s)
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


def _changes(names: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """From which frame on, what."""
    return tuple((i, name) for i, name in enumerate(names) if i == 0 or name != names[i - 1])


def load(path: Path, progress: Progress | None = None) -> Timeline:
    """A whole log as arrays.

    Args:
        progress: Called with the fraction read.
    Raises:
        LogError: the file is no log of armctl's, or holds no whole tick.
    """
    with LogFile(path, progress) as log:
        arm = log_setup(log).arm
        found = log.payloads((channels.CYCLE, *_SAMPLED, channels.DIAGNOSTICS, *_HAPPENED))
        frames = _frames(log, arm, found)
        told = _Happenings()
        for topic, time_ns, value in _decoded(log, found, *_HAPPENED):
            with log.as_written(topic):
                told.take(topic, time_ns, value)
        time_ns, states, faults = (frames.pop(name) for name in ("time_ns", "states", "faults"))
        return Timeline(
            path=path, arm=arm, start_ns=int(time_ns[0]), time_s=(time_ns - time_ns[0]) / NS_PER_S, **frames,
            states=_changes(states), faults=_changes(faults), happenings=tuple(told.happenings),
            motions=tuple(told.motions), complete=log.complete,
        )  # fmt: skip


def _decoded(log: LogFile, found: dict[str, Payloads], *topics: str) -> Iterator[tuple[str, int, Value]]:
    """Topic, time and value of every message of some topics, in the order of the file."""
    placed = [zip(found[topic].place.tolist(), repeat(topic), found[topic], strict=False) for topic in topics]
    for _, topic, (time_ns, data) in merge(*placed):
        yield topic, time_ns, log.codec(topic).decode(data)


def _frames(log: LogFile, arm: ArmConfig, found: dict[str, Payloads]) -> dict[str, Any]:
    """An array with a row a frame by its name; of times, states and faults too."""
    cycles = log.tables(channels.CYCLE, found[channels.CYCLE])
    if not cycles:
        raise LogError(f"{log.path}: holds no whole tick; there is nothing to show")
    places = np.concatenate([table.place for table in cycles])
    order, shape = np.argsort(places), (len(places), len(arm.joints))
    places, time_ns = places[order], np.concatenate([table.log_time_ns for table in cycles])[order].astype(np.int64)
    with log.as_written(channels.CYCLE):
        keys = ("tick", "inputs_only", *CYCLE_KEYS)
        tick, inputs_only, *told = (np.concatenate([table.columns[key] for table in cycles])[order] for key in keys)
        values: dict[str, Any] = {"time_ns": time_ns, "tick": tick.astype(np.int64), "cycle": np.stack(told, axis=1)}
    values |= {key: np.full(shape, math.nan) for key in _OF_JOINTS}
    values |= {key: np.zeros(shape, np.bool_) for key in ("torque_enabled", "fresh")}
    values["tool"] = np.full((len(places), 7), math.nan)
    whole = inputs_only == 0
    for topic in _SAMPLED:
        known = np.full(len(places), topic == channels.TCP_POSE)
        for table in log.tables(topic, found[topic]):
            # It is of the tick that the next cycle ends, unless its own was lost.
            rows = np.searchsorted(places, table.place).clip(max=len(places) - 1)
            kept = (time_ns[rows] == table.log_time_ns) & (values["tick"][rows] & 0xFFFFFFFF == table.sequence)
            known[rows[kept]] = True
            with log.as_written(topic):
                _enter(arm, topic, table.columns, rows[kept], kept, values)
        whole &= known
    if not whole.any():
        raise LogError(f"{log.path}: holds no whole tick; there is nothing to show")
    modes, before, end = [("", "")], b"", 0
    for _, data in found[channels.DIAGNOSTICS]:
        if end and data[STAMP_END:end] == before[STAMP_END:end]:
            modes.append(modes[-1])  # what else it says is of servos; to read that took half of all the time
            continue
        codec, before = log.codec(channels.DIAGNOSTICS), data
        with log.as_written(channels.DIAGNOSTICS):
            value = codec.decode(data)
            modes.append(_diagnosed(value, modes[-1]))
            first = value["status"][:1]
            end = len(codec.encode(value | {"status": first})) if first and first[0]["name"] == ARM_STATUS else 0
    since = np.searchsorted(found[channels.DIAGNOSTICS].place, places[whole])
    values = {key: column[whole] for key, column in values.items()}
    return values | dict(zip(("states", "faults"), zip(*[modes[at] for at in since], strict=True), strict=True))


def _enter(arm: ArmConfig, topic: str, columns: dict[str, Any], rows: Any, kept: Any, values: dict[str, Any]) -> None:
    """Put what messages of one shape say of their frames where it belongs; those that are `kept` are of some."""
    if topic == channels.TCP_POSE:
        parts = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
        values["tool"][rows] = np.stack([columns[f"pose.{part}"][kept] for part in parts], axis=1)
    elif topic == channels.JOINT_STATES:
        names = [set(column.tolist()) for path, column in columns.items() if path.startswith("name[")]
        for index, (name,) in enumerate(names):  # or there is more than one at its place
            for key, quantity in channels.QUANTITIES.items():
                values[quantity][rows, arm.joint_names.index(name)] = columns[key][kept, index]
    elif f"servos[{len(arm.servos)}].id" in columns:
        raise ValueError("another number of servos")
    else:
        for index, joint in enumerate(arm.joints):
            values["fresh"][rows, index] = columns[f"servos[{index}].fresh"][kept]
            block = columns[f"servos[{index}].registers"][kept]
            if block.shape[1]:
                torque, goal, voltage, temperature = (channels.register_column(block, one) for one in _REGISTERS)
                values["torque_enabled"][rows, index] = torque > 0
                values["goal_rad"][rows, index] = np.where(torque > 0, joint.position_rad(goal), math.nan)
                values["voltage_V"][rows, index] = voltage / 10.0
                values["temperature_degC"][rows, index] = temperature


def _diagnosed(value: Value, before: tuple[str, str]) -> tuple[str, str]:
    """State and fault that a message about the arm's health tells; as before where it tells none."""
    arm = next((status for status in value["status"] if status["name"] == ARM_STATUS), None)
    if arm is None:
        return before
    facts = {pair["key"]: pair["value"] for pair in arm["values"]}
    state = facts.get("mode", arm["message"])
    return state, arm["message"].removeprefix(f"{state}: ") if facts.get("fault") else ""
