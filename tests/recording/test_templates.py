"""Templates give the codec's bytes, for every type and for every tick."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.messages import Fault, TickRecord
from armctl.recording import channels
from armctl.recording.cdr import Value, codec
from armctl.recording.channels import TOPICS
from armctl.recording.templates import MAX_TEMPLATES, Template, TickEncoder
from proving.log_bench import message_numbers
from tests.recording.altered import with_outputs, with_sample, without_first_joint
from tests.recording.factory import ANCHOR, ARM, ROBOT, make_records, tick_messages
from tests.recording.test_cdr import NAMES, values

RECORDS = make_records(60)


def stamped(value: Any, stamp: Value) -> Any:
    """The same with one instant for every stamp."""
    if isinstance(value, dict):
        return stamp if value.keys() == {"sec", "nanosec"} else {key: stamped(one, stamp) for key, one in value.items()}
    return [stamped(one, stamp) for one in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", [name for name in NAMES if "Time" not in name and "Trajectory" not in name])
def test_a_template_gives_the_bytes_of_the_codec(name: str) -> None:
    @settings(max_examples=30)
    @given(values(name), st.integers(0, 2**31 - 1), st.integers(0, 10**9 - 1))
    def check(value: Value, sec: int, nanosec: int) -> None:
        if name == "builtin_interfaces/Duration":
            return
        value = stamped(value, {"sec": sec, "nanosec": nanosec})
        assert Template(name, value).encode([sec, nanosec, *message_numbers(name, value)]) == codec(name).encode(value)

    check()


def odd(record: TickRecord) -> TickRecord:
    """The tick with a silent servo and a joint that is not known."""
    servos = list(record.inputs.sample.servos)
    servos[1] = replace(servos[1], fresh=False, problem="NO_REPLY", error=0x24)
    servos[2] = replace(servos[2], registers=b"", stamp_ns=0, fresh=False, problem="PORT_GONE")
    record = with_sample(record, servos=tuple(servos), port_open=False, retries=3)
    record = with_outputs(without_first_joint(record), goal=None, faults=(Fault("HOT", "it is", 5, 2),))
    return replace(record, inputs=replace(record.inputs, late_ns=10**9), dropped=2)


def test_every_tick_is_encoded_as_channels_says() -> None:
    encoder = TickEncoder(ARM, ROBOT)
    for record in [*RECORDS, *map(odd, RECORDS), *RECORDS[:3]]:
        encoded = [*encoder.inputs(record, ANCHOR), *encoder.outputs(record, ANCHOR), encoder.cycle(record, ANCHOR)]
        assert encoded == [(topic, TOPICS[topic].codec.encode(value)) for topic, value in tick_messages(record)]
        topic, data = encoder.cycle(record, ANCHOR, inputs_only=True)
        _, value = channels.row_message(channels.cycle_row(record, inputs_only=True), record, ANCHOR)
        assert data == TOPICS[topic].codec.encode(value)


def test_shapes_without_end_are_not_kept() -> None:
    encoder = TickEncoder(ARM, ROBOT)
    record = RECORDS[30]
    for index in range(3 * MAX_TEMPLATES):
        first, *others = record.inputs.sample.servos
        encoder.inputs(with_sample(record, servos=(replace(first, problem=f"PROBLEM_{index}"), *others)), ANCHOR)
        assert len(encoder._templates) <= MAX_TEMPLATES


@pytest.mark.parametrize("given_numbers", [[1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, "3"]])
def test_numbers_that_do_not_fit_are_refused(given_numbers: list[Any]) -> None:
    template = Template("geometry_msgs/Point", {"x": 0.0, "y": 0.0, "z": 0.0})
    with pytest.raises(ValueError, match=r"numbers|float"):
        template.encode([0, 0, *given_numbers])
