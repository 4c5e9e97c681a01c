"""The messages of every tick, straight from the record to bytes.

Rules.
1. channels.py says what the messages are; here they are only made faster. The bytes are the same: the tests compare
   them, and so does every replay, which uses channels.py.
2. A message whose texts and counts are known is one `struct`: only its numbers change. A `Template` is made from
   one example, by the declarations the codec is made from.
3. A tick of another shape (a servo with a problem, a joint that is not known) has another template.
"""

import struct
from collections.abc import Hashable, Sequence
from itertools import count
from operator import itemgetter
from typing import Any

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.kinematics.robots.robot import Robot
from armctl.messages import TickRecord
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.channels import TOPICS, Anchor, Message, Row
from armctl.recording.schemas import short_name
from armctl.recording.shapes import packer, pieces

MAX_TEMPLATES = 64
_STAMP = {"stamp.sec": 0, "stamp.nanosec": 1}  # where they are in the list of numbers
Encoded = tuple[str, bytes]


class Template:
    """Bytes of one message type in one shape.

    Args:
        name: Short name of the type.
        example: A message of that shape; its texts and counts are kept, its numbers are not.
    """

    def __init__(self, name: str, example: Value) -> None:
        found = pieces(name, example)
        numbers = count(len(_STAMP))
        fields = [_STAMP[content] if content in _STAMP else next(numbers) for code, content in found if code]
        self._numbers = next(numbers)
        self._constants: list[Any] = [content for code, content in found if not code]
        self._pack = packer(found).pack
        places, of_fields = count(self._numbers), iter(fields)  # constants come behind the numbers
        self._pick = itemgetter(*[next(of_fields if code else places) for code, _ in found])

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


class TickEncoder:
    """Encodes ticks of one arm; the same messages in the same order as channels.py gives."""

    def __init__(self, arm: ArmConfig, robot: Robot) -> None:
        self._arm, self._robot = arm, robot
        self._templates: dict[Hashable, Template] = {}

    def inputs(self, record: TickRecord, anchor: Anchor) -> list[Encoded]:
        """What the control step saw in this tick: servos, then commands in their order."""
        return self._encoded(
            record, anchor, [channels.servos_row(record, self._arm)], channels.command_messages(record)
        )

    def outputs(self, record: TickRecord, anchor: Anchor) -> list[Encoded]:
        """`channels.output_messages`, encoded."""
        rows = channels.output_rows(record, self._arm, self._robot)
        return self._encoded(record, anchor, rows, channels.event_messages(record, anchor, self._arm))

    def cycle(self, record: TickRecord, anchor: Anchor, *, inputs_only: bool = False) -> Encoded:
        """How the tick went."""
        return self._encoded(record, anchor, [channels.cycle_row(record, inputs_only=inputs_only)])[0]

    def _encoded(
        self, record: TickRecord, anchor: Anchor, rows: Sequence[Row], messages: Sequence[Message] = ()
    ) -> list[Encoded]:
        stamp = [*divmod(anchor.epoch_ns(record.inputs.sample.time_ns), NS_PER_S)]
        encoded = []
        for row in rows:
            template = self._templates.get((row.topic, row.shape))
            if template is None:
                if len(self._templates) >= MAX_TEMPLATES:
                    self._templates.clear()
                name, (_, value) = short_name(TOPICS[row.topic].type), channels.row_message(row, record, anchor)
                template = self._templates[row.topic, row.shape] = Template(name, value)
            encoded.append((row.topic, template.encode(stamp + row.numbers)))
        return encoded + [(topic, TOPICS[topic].codec.encode(value)) for topic, value in messages]
