"""Shapes give the bytes and the values that the codec gives field by field, for every type and for every tick."""

import time
from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.messages import Fault, TickRecord
from armctl.recording import cdr, channels
from armctl.recording.cdr import Codec, Value, codec, schema_codec
from armctl.recording.channels import TOPICS, Row
from armctl.recording.schemas import MESSAGES, schema_text
from armctl.recording.shapes import Shape, shape
from proving.log_bench import message_numbers
from tests.recording.altered import with_outputs, with_sample, without_first_joint
from tests.recording.factory import ANCHOR, ARM, ROBOT, make_records
from tests.recording.test_cdr import NAMES, values

RECORDS = make_records(60)


def fresh(name: str) -> Codec:
    """A codec that has met nothing."""
    return schema_codec.__wrapped__(name, schema_text(name))


def met(name: str, value: Value) -> Shape | None:
    return shape(name, value, MESSAGES)


@pytest.mark.parametrize("name", NAMES)
def test_a_shape_gives_what_the_codec_gives_and_nothing_of_another_shape(name: str) -> None:
    """Field by field the first message of a codec is encoded and decoded."""

    @settings(max_examples=30)
    @given(values(name), values(name))
    def check(example: Value, value: Value) -> None:
        if (known := met(name, example)) is None:
            return
        for one in (example, value):
            data = fresh(name).encode(one)
            found = known.decode(data)
            # By their texts: 0.0 is not -0.0, and the order of keys is that of columns in a table.
            assert found is None or repr(found) == repr(fresh(name).decode(data))
        assert known.decode(fresh(name).encode(example)) is not None
        assert known.pack(message_numbers(name, example)) == fresh(name).encode(example)
        assert known.decode(fresh(name).encode(example) + b"x") is None

    check()


def odd(record: TickRecord) -> TickRecord:
    """The tick with a silent servo and a joint that is not known."""
    servos = list(record.inputs.sample.servos)
    servos[1] = replace(servos[1], fresh=False, problem="NO_REPLY", error=0x24)
    servos[2] = replace(servos[2], registers=b"", stamp_ns=0, fresh=False, problem="PORT_GONE")
    record = with_sample(record, servos=tuple(servos), port_open=False, retries=3)
    record = with_outputs(without_first_joint(record), goal=None, faults=(Fault("HOT", "it is", 5, 2),))
    return replace(record, inputs=replace(record.inputs, late_ns=10**9), dropped=2)


def rows_of(record: TickRecord) -> list[Row]:
    rows = [channels.servos_row(record, ANCHOR, ARM), *channels.output_rows(record, ANCHOR, ARM, ROBOT)]
    return rows + [channels.cycle_row(record, ANCHOR, inputs_only=only) for only in (False, True)]


def test_every_tick_is_encoded_as_field_by_field() -> None:
    encoder = channels.TickEncoder()
    for record in [*RECORDS, *map(odd, RECORDS), *RECORDS[:3]]:
        for row in rows_of(record):
            codec = TOPICS[row.topic].codec
            assert codec.shape(row.value()) is not None
            assert encoder.encode(row) == codec.encode(row.value())
        for message in channels.event_messages(record, ANCHOR, ARM):
            assert encoder.encode(message) == TOPICS[message[0]].codec.encode(message[1])


def test_a_number_that_does_not_fit_its_field_is_told_as_by_the_codec() -> None:
    encoder, row = channels.TickEncoder(), rows_of(RECORDS[0])[-1]
    encoder.encode(row)
    told = row.value() | {"retries": 2**70}
    with pytest.raises(ValueError, match="armctl_msgs/Cycle: argument out of range"):
        encoder.encode(row._replace(numbers=[2**70] * len(row.numbers), value=lambda: told))


def test_an_encoder_keeps_no_shapes_without_end() -> None:
    encoder, row = channels.TickEncoder(), rows_of(RECORDS[0])[-1]
    for number in range(2 * channels.MAX_SHAPES):
        told = row.value() | {"mode": f"MODE{number}"}
        data = encoder.encode(row._replace(shape=(number,), value=lambda told=told: told))  # type: ignore[misc]
        assert data == TOPICS[row.topic].codec.encode(told)
    assert len(encoder._shapes) <= channels.MAX_SHAPES


def test_shapes_without_end_are_not_kept() -> None:
    one = fresh("std_msgs/Header")
    for number in range(300):
        header = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "x" * (number % 100) + str(number)}
        assert one.decode(one.encode(header)) == header
    assert len(one._decoded) <= cdr.MAX_SIZES
    assert max(map(len, one._decoded.values())) <= cdr.MAX_SHAPES


def test_long_messages_and_those_of_text_have_no_shape() -> None:
    assert met("geometry_msgs/Point", {"x": 0.0, "y": 0.0, "z": 0.0}) is not None
    assert met("std_msgs/String", {"data": "some text"}) is None
    point: Value = {key: [0.0] for key in ("positions", "velocities", "accelerations", "effort")}
    point["time_from_start"] = {"sec": 0, "nanosec": 0}
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    for count, known in ((10, True), (100, False)):
        value = {"header": header, "joint_names": [], "points": [point] * count}
        assert (met("trajectory_msgs/JointTrajectory", value) is not None) == known


@settings(max_examples=200)
@given(st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), values(name))), st.data())
def test_what_is_no_message_is_a_value_error(named: tuple[str, Value], draw: st.DataObject) -> None:
    name, example = named
    other, places = deepcopy(example), list(places_in(example))
    *path, last = draw.draw(st.sampled_from(places))
    inner: Any = other
    for step in path:
        inner = inner[step]
    if isinstance(inner, dict) and draw.draw(st.booleans()):
        inner[f"{last}x"] = inner.pop(last) if draw.draw(st.booleans()) else 0
    else:
        inner[last] = draw.draw(
            st.sampled_from([None, "x", "", 1, -1, 2**70, 0.5, [], [1], {}, b"", b"12", ["x"], [{}]])
        )
    try:
        data = codec(name).encode(other)
    except ValueError:
        return
    assert codec(name).encode(codec(name).decode(data)) == data


def places_in(value: Any) -> Any:
    """The way to every part of a message, at least to its first field."""
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield (key,)
            yield from ((key, *further) for further in places_in(part))


def test_a_long_message_takes_time_in_proportion() -> None:
    def took_s(texts: int) -> float:
        value = {"a": ["text"] * texts}
        begun_s = time.process_time()
        one = schema_codec.__wrapped__("pkg/msg/Texts", "string[] a")
        for _ in range(3):
            assert one.decode(one.encode(value)) == value
        return time.process_time() - begun_s

    few, many = (min(took_s(texts) for _ in range(3)) for texts in (10_000, 80_000))
    assert many < 25 * few, "with eight times as much"


def test_a_codec_is_known_by_both_names() -> None:
    assert codec("geometry_msgs/msg/Point").name == codec("geometry_msgs/Point").name
