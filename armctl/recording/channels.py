"""What a tick becomes in the log: topics, types, and the values of their messages.

Rules.
1. All is pure: a tick record, the file's clock anchor, arm and robot give the messages, bit for bit.
   Replay calls `output_rows`, `event_messages` and `cycle_row` with outputs it computed itself, and compares bytes.
2. Every message of a tick carries the instant of its sample, as log time, publish time and header stamp;
   its sequence number is the tick.
3. Inputs come first, outputs after them, and `/armctl/cycle` is last: a tick whose cycle is missing was cut.
4. What is not known is left out: a joint whose servo never answered is not in `/joint_states`.
"""

import struct
import time
import zlib
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import chain, repeat
from operator import attrgetter
from typing import Any, NamedTuple, Self

import numpy as np

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.json_text import to_json
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, quaternion_from_matrix
from armctl.kinematics.urdf import BASE, fixed_frames, moving_frames, moving_links
from armctl.messages import Command, Event, JointState, JointTrajectory, Reply, Run, ServoReading, TickRecord
from armctl.recording.cdr import Codec, Value, codec
from armctl.recording.notes import LEVELS, parse_note
from armctl.recording.schemas import full_name
from armctl.recording.shapes import Shape

# A tick that begins later than this is an overrun.
OVERRUN_NS = 50_000_000
# Bound on the shapes that an encoder keeps.
MAX_SHAPES = 64
# Who wrote a line of /rosout: the control step (repeated by replay) or the recorder.
CONTROL = "armctl.control"
RECORDING = "armctl.recording"

# Fields that the message of a servo and its `ServoReading` have in common.
READING = ("registers", "stamp_ns", "fresh", "error", "problem")
# What /joint_states says of each joint, as ROS calls it and as it is called here.
QUANTITIES = {"position": "position_rad", "velocity": "velocity_rad_s", "effort": "load_ratio"}
# What /diagnostics says of each joint.
_HEALTH = ("temperature_degC", "voltage_V", "load_ratio", "torque_enabled", "age_s")
_OF_A_JOINT = attrgetter(*JointState.__slots__)
_JOINT = struct.Struct(f"<{len(JointState.__slots__)}d")
Message = tuple[str, Value]


class Topic(NamedTuple):
    """One channel of a log."""

    name: str
    type: str
    latched: bool = False

    @property
    def codec(self) -> Codec:
        return codec(self.type)

    @property
    def metadata(self) -> dict[str, str]:
        """Channel metadata: the quality of service rosbag2 offers when it plays the file."""
        depth, durability = (1, 1) if self.latched else (10, 2)  # transient_local, volatile
        forever = "{sec: 9223372036, nsec: 854775807}"
        kept = f"- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n"
        times = (
            f"  deadline: {forever}\n  lifespan: {forever}\n  liveliness: 1\n  liveliness_lease_duration: {forever}\n"
        )
        return {"offered_qos_profiles": f"{kept}{times}  avoid_ros_namespace_conventions: false\n"}


# Every channel of a log, registered at the start of each file whether used or not.
TOPICS: dict[str, Topic] = {}


def register_column(blocks: Any, register: ax12a.Register) -> Any:
    """A register's value in what a servo said n times, uint8 of shape (n, STATUS_SIZE)."""
    begin = register.address - ax12a.STATUS_BEGIN
    return blocks[:, begin : begin + register.size] @ 256 ** np.arange(register.size)


def _topic(name: str, short_type: str, *, latched: bool = False) -> str:
    TOPICS[name] = Topic(name, full_name(short_type), latched)
    return name


JOINT_STATES = _topic("/joint_states", "sensor_msgs/JointState")
JOINT_COMMANDS = _topic("/joint_commands", "sensor_msgs/JointState")
TF = _topic("/tf", "tf2_msgs/TFMessage")
TF_STATIC = _topic("/tf_static", "tf2_msgs/TFMessage", latched=True)
TCP_POSE = _topic("/tcp_pose", "geometry_msgs/PoseStamped")
SERVOS = _topic("/armctl/servos", "armctl_msgs/ServoArray")
WRITES = _topic("/armctl/writes", "armctl_msgs/WriteArray")
CYCLE = _topic("/armctl/cycle", "armctl_msgs/Cycle")
WIRE = _topic("/armctl/wire", "armctl_msgs/Wire")
COMMAND = _topic("/armctl/command", "std_msgs/String")
STATE = _topic("/armctl/state", "std_msgs/String")
JOINT_TRAJECTORY = _topic("/joint_trajectory", "trajectory_msgs/JointTrajectory")
DIAGNOSTICS = _topic("/diagnostics", "diagnostic_msgs/DiagnosticArray")
ROSOUT = _topic("/rosout", "rcl_interfaces/Log")
ROBOT_DESCRIPTION = _topic("/robot_description", "std_msgs/String", latched=True)


class Anchor(NamedTuple):
    """One instant in both kinds of time; it turns monotonic into epoch nanoseconds for a whole file."""

    wall_ns: int
    monotonic_ns: int

    @classmethod
    def now(cls) -> Self:
        return cls(time.time_ns(), time.monotonic_ns())

    def epoch_ns(self, time_ns: int) -> int:
        """Epoch time [ns] of a monotonic time [ns]; never before the epoch, which no log format can express."""
        return max(0, self.wall_ns + time_ns - self.monotonic_ns)


class Row(NamedTuple):
    """A message that comes every tick, as numbers too: a shape (shapes.py) makes bytes of these without the message."""

    topic: str
    # Messages of one shape differ in their numbers alone.
    shape: Hashable
    # In the order of their fields; a uint8[] is one item, of bytes.
    numbers: list[Any]
    value: Callable[[], Value]


class TickEncoder:
    """Makes bytes of the messages of ticks: of rows, by their numbers alone where their shape came before."""

    def __init__(self) -> None:
        self._shapes: dict[Hashable, Shape | None] = {}

    def encode(self, message: Row | Message) -> bytes:
        """CDR bytes of a message.

        Raises:
            ValueError: a value does not fit its field.
        """
        codec = TOPICS[message[0]].codec
        if not isinstance(message, Row):
            return codec.encode(message[1])
        key = message.topic, message.shape
        if key not in self._shapes:
            if len(self._shapes) >= MAX_SHAPES:
                self._shapes.clear()
            self._shapes[key] = codec.shape(message.value())
        if (shape := self._shapes[key]) is not None:
            with suppress(struct.error):  # field by field it comes again, and tells of which field
                return shape.pack(message.numbers)
        return codec.encode(message.value())


def servos_row(record: TickRecord, anchor: Anchor, arm: ArmConfig) -> Row:
    """What every servo said."""
    readings, header = record.inputs.sample.servos, _header(_epoch_ns(record, anchor))
    numbers = [*header["stamp"].values()]
    for reading in readings:
        numbers += (reading.servo_id, reading.fresh, reading.error, reading.stamp_ns, reading.registers)
    shape = tuple([(reading.problem, len(reading.registers)) for reading in readings])
    return Row(SERVOS, shape, numbers, partial(_servos, header, readings, arm.servo_names))


def command_messages(record: TickRecord) -> list[Message]:
    """What clients asked of this tick."""
    return _records(record, "command", record.inputs.commands)


def output_rows(record: TickRecord, anchor: Anchor, arm: ArmConfig, robot: Robot) -> list[Row]:
    """Those outputs that come every tick: joints, and goal, frames and tool where there are some."""
    outputs, header = record.outputs, _header(_epoch_ns(record, anchor))
    stamp = [*header["stamp"].values()]
    known = [(name, joint) for name, joint in zip(arm.joint_names, outputs.joints, strict=True) if joint.known]
    numbers = [getattr(joint, quantity) for quantity in QUANTITIES.values() for _, joint in known]
    names = tuple([name for name, _ in known])
    rows = [Row(JOINT_STATES, names, stamp + numbers, partial(_joints, header, names, numbers))]
    if (goal := outputs.goal) is not None:
        numbers = [servo.position_rad(tick) for servo, tick in zip(arm.servos, goal.ticks, strict=True)]
        numbers += [speed * ax12a.SPEED_UNIT_RAD_S for speed in goal.speeds]
        rows.append(Row(JOINT_COMMANDS, (), stamp + numbers, partial(_joints, header, arm.servo_names, numbers)))
    if (tool := outputs.tool) is not None:
        q = np.array([joint.position_rad for joint in outputs.joints])
        frames = [_placing(T) for T in moving_frames(arm, robot, q)]
        numbers = [number for frame in frames for number in (*stamp, *frame)]
        rows.append(Row(TF, (), numbers, partial(_transforms, header, moving_links(arm), frames)))
        placing = [*tool.position_m, *tool.quaternion]
        rows.append(Row(TCP_POSE, (), stamp + placing, partial(_pose, header, placing)))
    return rows


def event_messages(record: TickRecord, anchor: Anchor, arm: ArmConfig) -> list[Message]:
    """Those outputs that do not come every tick: accepted trajectories, register writes, replies, events."""
    inputs, outputs, epoch_ns = record.inputs, record.outputs, _epoch_ns(record, anchor)
    header = _header(epoch_ns)
    runs = [command.trajectory for command in inputs.commands if isinstance(command, Run)]
    messages: list[Message] = [(JOINT_TRAJECTORY, _joint_trajectory(header, run, arm)) for run in runs]
    if outputs.writes:
        results = chain(record.confirmed, repeat(False))
        writes = [asdict(write) | {"confirmed": done} for write, done in zip(outputs.writes, results, strict=False)]
        messages.append((WRITES, {"header": header, "writes": writes}))
    messages += _records(record, "reply", outputs.replies)
    return messages + [(ROSOUT, log_line(event, epoch_ns, CONTROL)) for event in outputs.events]


def wire_message(pieces: Iterable[tuple[int, bool, bytes]], epoch_ns: int) -> Message:
    """What went over the wire: when [ns, monotonic], whether it was sent, and the bytes."""
    keys = ("time_ns", "sent", "data")
    return WIRE, {"header": _header(epoch_ns), "pieces": [dict(zip(keys, one, strict=True)) for one in pieces]}


def cycle_row(record: TickRecord, anchor: Anchor, *, inputs_only: bool = False) -> Row:
    """How the tick went, the times of its inputs, mode and faults; the last message of every tick."""
    inputs, outputs, sample = record.inputs, record.outputs, record.inputs.sample
    header, faults = _header(_epoch_ns(record, anchor)), [asdict(fault) for fault in outputs.faults]
    numbers = {
        "tick": inputs.tick,
        "now_ns": inputs.now_ns,
        "time_ns": sample.time_ns,
        "late_ns": inputs.late_ns,
        "lateness_us": record.lateness_us,
        "bus_us": sample.bus_us,
        "write_us": record.write_us,
        "retries": sample.retries,
        "dropped": record.dropped,
        "overrun": inputs.late_ns > OVERRUN_NS,
        "port_open": sample.port_open,
        "inputs_only": inputs_only,
        "goal_sent": record.goal_sent,
        "progress": -1.0 if outputs.progress is None else outputs.progress,
        "rate": -1.0 if outputs.rate is None else outputs.rate,
        "rest_in_s": -1.0 if outputs.rest_in_s is None else outputs.rest_in_s,
        # Most of it stands in no message of every tick, being repeated from the registers.
        "joints_crc": zlib.crc32(b"".join([_JOINT.pack(*_OF_A_JOINT(joint)) for joint in outputs.joints])),
    }
    since: list[int] = []
    for fault in faults:
        fault["servo_id"] = -1 if fault["servo_id"] is None else fault["servo_id"]
        since += (fault["since_ns"], fault["servo_id"])
    texts = [(fault["code"], fault["text"], fault["follows"]) for fault in faults]
    told = {"mode": outputs.mode, "wanted": outputs.wanted_rad, "faults": faults}
    shape = (outputs.mode, len(outputs.wanted_rad), *texts)
    flat = [*header["stamp"].values(), *numbers.values(), *outputs.wanted_rad, *since]
    return Row(CYCLE, shape, flat, lambda: {"header": header, **numbers, **told})


def static_transforms(epoch_ns: int, arm: ArmConfig, robot: Robot) -> Message:
    """The frames that do not move against a link, once for a file."""
    frames = fixed_frames(arm, robot)
    transforms = [_transform(_header(epoch_ns, parent), child, _placing(T)) for parent, child, T in frames]
    return TF_STATIC, {"transforms": transforms}


def string_message(topic: str, text: str) -> Message:
    """Free text (a robot description, JSON) on a std_msgs/String topic."""
    return topic, {"data": text}


def diagnostics(record: TickRecord, anchor: Anchor, arm: ArmConfig) -> Message:
    """Mode and fault of the arm, and the health of every servo."""
    outputs, sample = record.outputs, record.inputs.sample
    fault = outputs.fault
    facts = {"mode": outputs.mode, "fault": fault.code if fault else "", "port_open": sample.port_open}
    message = f"{outputs.mode}: {fault.code}: {fault.text}" if fault else f"{outputs.mode}"
    status = [_status(2 if fault else 0, "arm", message, arm.arm_id, facts)]
    for servo, name, reading in zip(arm.servos, arm.servo_names, sample.servos, strict=True):
        level, message, facts, joint = 3, "never answered", {}, outputs.joints[servo.of]
        if joint.known:
            message = reading.problem or " ".join(ax12a.ErrorBit.names(reading.error)) or "ok"
            level, facts = int(message != "ok"), {key: getattr(joint, key) for key in _HEALTH}
        status.append(_status(level, name, message, f"servo {servo.servo_id}", facts))
    return DIAGNOSTICS, {"header": _header(_epoch_ns(record, anchor)), "status": status}


def log_line(event: Event, epoch_ns: int, source: str) -> Value:
    """An event as a line of /rosout; its code stands in `function`."""
    where = "" if event.servo_id is None else f" (servo {event.servo_id})"
    return {
        "stamp": stamp(epoch_ns),
        "level": LEVELS[event.severity],
        "name": source,
        "msg": f"{event.code}{where}: {event.text}",
        "file": "",
        "function": event.code,
        "line": 0,
    }


def _records(record: TickRecord, kind: str, parts: Iterable[Command | Reply]) -> list[Message]:
    """What `parse_record` reads: commands or replies of a tick on /armctl/command."""
    return [string_message(COMMAND, f'{{"tick":{record.inputs.tick},"{kind}":{to_json(part)}}}') for part in parts]


def parse_record(text: str) -> tuple[int, str, Any] | None:
    """(tick, "command" or "reply", its JSON) of a line on /armctl/command; None for the notes of others."""
    data = parse_note(text)
    if list(data) in (["tick", "command"], ["tick", "reply"]):
        _, kind = data
        return data["tick"], kind, data[kind]
    return None


def stamp(epoch_ns: int) -> Value:
    """An epoch time as ROS 2 writes it."""
    return {"sec": epoch_ns // NS_PER_S, "nanosec": epoch_ns % NS_PER_S}


def _epoch_ns(record: TickRecord, anchor: Anchor) -> int:
    return anchor.epoch_ns(record.inputs.sample.time_ns)


def _header(epoch_ns: int, frame_id: str = BASE) -> Value:
    return {"stamp": stamp(epoch_ns), "frame_id": frame_id}


def _servos(header: Value, readings: Sequence[ServoReading], names: Sequence[str]) -> Value:
    servos = [
        {"id": reading.servo_id, "name": name, **{key: getattr(reading, key) for key in READING}}
        for name, reading in zip(names, readings, strict=True)
    ]
    return {"header": header, "servos": servos}


def _joints(header: Value, names: Sequence[str], numbers: list[float]) -> Value:
    n = len(names)
    values = {key: numbers[place * n : (place + 1) * n] for place, key in enumerate(QUANTITIES)}
    return {"header": header, "name": list(names), **values}


def _axes(values: Iterable[float]) -> Value:
    """A vector or a quaternion."""
    return dict(zip("xyzw", values, strict=False))


def _placing(T: FloatArray) -> list[float]:
    """x, y, z [m] and the quaternion x, y, z, w of a frame."""
    return [*T[:3, 3].tolist(), *quaternion_from_matrix(T[:3, :3])]


def _transform(header: Value, child: str, placing: list[float]) -> Value:
    transform = {"translation": _axes(placing[:3]), "rotation": _axes(placing[3:])}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _transforms(header: Value, links: Sequence[str], frames: list[list[float]]) -> Value:
    return {"transforms": [_transform(header, link, placing) for link, placing in zip(links, frames, strict=True)]}


def _pose(header: Value, placing: list[float]) -> Value:
    return {"header": header, "pose": {"position": _axes(placing[:3]), "orientation": _axes(placing[3:])}}


def _joint_trajectory(header: Value, trajectory: JointTrajectory, arm: ArmConfig) -> Value:
    unsaid: Value = {key: [] for key in ("velocities", "accelerations", "effort")}
    rows, period_s = trajectory.positions_rad, trajectory.period_s
    times_s = trajectory.times_s or [index * period_s for index in range(len(rows))]
    stamps = [stamp(round(time_s * NS_PER_S)) for time_s in times_s]
    points = [unsaid | {"positions": [*row], "time_from_start": at} for row, at in zip(rows, stamps, strict=False)]
    return {"header": header, "joint_names": list(arm.joint_names), "points": points}


def _status(level: int, name: str, message: str, hardware_id: str, facts: dict[str, Any]) -> Value:
    values = [{"key": key, "value": str(value)} for key, value in facts.items()]
    return {"level": level, "name": f"armctl: {name}", "message": message, "hardware_id": hardware_id, "values": values}
