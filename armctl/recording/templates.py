"""The messages of every tick, straight from the record to bytes.

Rules.
1. channels.py says what the messages are; here they are only made faster. The bytes are the same: the tests compare
   them, and so does every replay, which uses channels.py.
2. A message whose texts and counts are known is one `struct`: only its numbers change. A `Template` is made from
   one example, by the declarations the codec is made from.
3. A tick of another shape (a servo with a problem, a joint that is not known) has another template.
"""

import struct
from collections.abc import Callable, Hashable, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import quaternion_from_matrix
from armctl.kinematics.urdf import moving_frames
from armctl.messages import Goal, Outputs, Sample, TickRecord, ToolPose
from armctl.recording import channels
from armctl.recording.cdr import HEADER, Value
from armctl.recording.channels import TOPICS, Anchor, Message
from armctl.recording.schemas import PRIMITIVES, fields, short_name

MAX_TEMPLATES = 64
_TIME = "builtin_interfaces/Time"
_STAMP = {"sec": 0, "nanosec": 1}
Encoded = tuple[str, bytes]


class Template:
    """Bytes of one message type in one shape.

    Args:
        name: Short name of the type.
        example: A message of that shape; its texts and counts are kept, its numbers are not.
    """

    def __init__(self, name: str, example: Value) -> None:
        self._format, self._size = "<", 0
        self._constant = bytearray(HEADER)  # not yet part of the format
        self._constants: list[bytes] = []
        self._order: list[tuple[bool, int]] = []
        self._numbers = len(_STAMP)
        self._message(name, example)
        self._end_constant()
        self._format += "0s"  # so that there are always two items or more, and itemgetter gives a tuple
        self._order.append((True, len(self._constants)))
        self._constants.append(b"")
        self._pack = struct.Struct(self._format).pack
        self._pick = itemgetter(*(index + is_constant * self._numbers for is_constant, index in self._order))

    def encode(self, numbers: list[Any]) -> bytes:
        """CDR bytes.

        Args:
            numbers: Seconds and nanoseconds of every stamp in the message, then all other numbers in the order of
                their fields; a uint8[] is one item, of bytes.
        Raises:
            ValueError: a number does not fit its field, or there are more or fewer than the shape has.
        """
        if len(numbers) != self._numbers:
            raise ValueError(f"{len(numbers)} numbers for a message with {self._numbers}")
        try:
            return self._pack(*self._pick(numbers + self._constants))
        except struct.error as error:
            raise ValueError(str(error)) from None

    def _message(self, name: str, value: Value) -> None:
        for item in fields(name):
            content = value[item.name]
            if not item.is_array:
                self._single(item.type, content, _STAMP[item.name] if name == _TIME else None)
                continue
            self._bytes(4, struct.pack("<I", len(content)))
            if item.type in ("byte", "uint8"):
                self._number(f"{len(content)}s", 1, len(content), None)
                continue
            for element in content:
                self._single(item.type, element, None)

    def _single(self, kind: str, content: Any, slot: int | None) -> None:
        if kind == "string":
            text = content.encode() + b"\0"
            self._bytes(4, struct.pack("<I", len(text)) + text)
        elif kind in PRIMITIVES:
            size = struct.calcsize(PRIMITIVES[kind])
            self._number(PRIMITIVES[kind], size, size, slot)
        else:
            self._message(kind, content)

    def _position(self) -> int:
        return self._size + len(self._constant) - len(HEADER)

    def _bytes(self, alignment: int, data: bytes) -> None:
        self._constant += bytes(-self._position() % alignment) + data

    def _number(self, character: str, alignment: int, size: int, slot: int | None) -> None:
        self._constant += bytes(-self._position() % alignment)
        self._end_constant()
        self._format += character
        self._size += size
        self._order.append((False, self._numbers if slot is None else slot))
        self._numbers += slot is None

    def _end_constant(self) -> None:
        if self._constant:
            self._format += f"{len(self._constant)}s"
            self._size += len(self._constant)
            self._order.append((True, len(self._constants)))
            self._constants.append(bytes(self._constant))
            self._constant.clear()


class TickEncoder:
    """Encodes ticks of one arm; the same messages in the same order as channels.py gives."""

    def __init__(self, arm: ArmConfig, robot: Robot) -> None:
        self._arm, self._robot = arm, robot
        self._templates: dict[Hashable, Template] = {}

    def inputs(self, record: TickRecord, anchor: Anchor) -> list[Encoded]:
        """`channels.input_messages`, encoded."""
        sample = record.inputs.sample
        shape = tuple([(reading.problem, len(reading.registers)) for reading in sample.servos])
        template = self._template(
            channels.SERVOS, shape, lambda: channels.input_messages(record, anchor, self._arm)[:1]
        )
        return [
            (channels.SERVOS, template.encode(_stamp(record, anchor) + _servos(sample))),
            *map(_encode, channels.command_messages(record)),
        ]

    def outputs(self, record: TickRecord, anchor: Anchor) -> list[Encoded]:
        """`channels.output_messages`, encoded."""
        outputs, stamp = record.outputs, _stamp(record, anchor)
        known = tuple([joint.known for joint in outputs.joints])

        def example() -> list[Message]:
            return channels.output_messages(record, anchor, self._arm, self._robot)

        def encode(topic: str, numbers: list[float], shape: Hashable = ()) -> Encoded:
            return topic, self._template(topic, shape, example).encode(stamp + numbers)

        messages = [encode(channels.JOINT_STATES, _joint_states(outputs), known)]
        if outputs.goal is not None:
            messages.append(encode(channels.JOINT_COMMANDS, _joint_commands(outputs.goal, self._arm)))
        if outputs.tool is not None:
            messages.append(encode(channels.TF, self._transforms(outputs)))
            messages.append(encode(channels.TCP_POSE, _pose(outputs.tool)))
        return [*messages, *map(_encode, channels.event_messages(record, anchor, self._arm))]

    def cycle(self, record: TickRecord, anchor: Anchor, *, inputs_only: bool = False) -> Encoded:
        """`channels.cycle_message`, encoded."""
        template = self._template(channels.CYCLE, (), lambda: [channels.cycle_message(record, anchor)])
        cycle = channels.cycle_numbers(record, inputs_only=inputs_only)
        return channels.CYCLE, template.encode([*_stamp(record, anchor), *cycle.values()])

    def _transforms(self, outputs: Outputs) -> list[float]:
        q = np.array([joint.position_rad for joint in outputs.joints])
        numbers: list[float] = []
        for T in moving_frames(self._arm, self._robot, q):
            numbers += T[:3, 3].tolist()
            numbers += quaternion_from_matrix(T[:3, :3])
        return numbers

    def _template(self, topic: str, shape: Hashable, examples: Callable[[], Sequence[Message]]) -> Template:
        template = self._templates.get((topic, shape))
        if template is None:
            if len(self._templates) >= MAX_TEMPLATES:
                self._templates.clear()
            (value,) = (value for name, value in examples() if name == topic)
            template = self._templates[topic, shape] = Template(short_name(TOPICS[topic].type), value)
        return template


def _encode(message: Message) -> Encoded:
    topic, value = message
    return topic, TOPICS[topic].codec.encode(value)


def _stamp(record: TickRecord, anchor: Anchor) -> list[Any]:
    return [*divmod(anchor.epoch_ns(record.inputs.sample.time_ns), NS_PER_S)]


def _servos(sample: Sample) -> list[Any]:
    numbers: list[Any] = []
    for reading in sample.servos:
        numbers += (reading.servo_id, reading.fresh, reading.error, reading.stamp_ns, reading.registers)
    return numbers


def _joint_states(outputs: Outputs) -> list[float]:
    known = [joint for joint in outputs.joints if joint.known]
    return [
        *[joint.position_rad for joint in known],
        *[joint.velocity_rad_s for joint in known],
        *[joint.load_ratio for joint in known],
    ]


def _joint_commands(goal: Goal, arm: ArmConfig) -> list[float]:
    positions = [joint.position_rad(tick) for joint, tick in zip(arm.joints, goal.ticks, strict=True)]
    return positions + [speed * ax12a.SPEED_UNIT_RAD_S for speed in goal.speeds]


def _pose(tool: ToolPose) -> list[float]:
    return [*tool.position_m, *tool.quaternion]
