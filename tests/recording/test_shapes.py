"""Shapes give the bytes and the values that the codec gives field by field, for every type and for every tick."""

import time
from collections.abc import Hashable
from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.messages import Fault, TickRecord
from armctl.recording import cdr, channels
from armctl.recording.cdr import Codec, Value, codec, schema_codec
from armctl.recording.channels import TOPICS
from armctl.recording.schemas import MESSAGES, schema_text
from armctl.recording.shapes import Shape, shape
from proving.log_bench import message_numbers
from tests.recording.altered import with_outputs, with_sample, without_first_joint
from tests.recording.factory import ANCHOR, ARM, ROBOT, make_records, tick_messages
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
            assert known.encode(one) in (data, None)
            if len(data) == len(fresh(name).encode(example)):
                found = known.decode(data)
                # By their texts: 0.0 is not -0.0, and the order of keys is that of columns in a table.
                assert found is None or repr(found) == repr(fresh(name).decode(data))
                assert (known.encode(one) is None) == (found is None)
        assert known.encode(example) == known.pack(message_numbers(name, example)) == fresh(name).encode(example)
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


def test_every_tick_is_encoded_as_field_by_field() -> None:
    seen = {topic.type: fresh(topic.type) for topic in TOPICS.values()}
    for record in [*RECORDS, *map(odd, RECORDS), *RECORDS[:3]]:
        for topic, value in tick_messages(record):
            name = TOPICS[topic].type
            assert seen[name].encode(value) == fresh(name).encode(value)


def test_the_rows_of_every_tick_have_the_numbers_of_its_messages() -> None:
    shapes: dict[Hashable, Shape | None] = {}
    for record in [*RECORDS, *map(odd, RECORDS)]:
        rows = [channels.servos_row(record, ANCHOR, ARM), *channels.output_rows(record, ANCHOR, ARM, ROBOT)]
        for row in [*rows, *(channels.cycle_row(record, ANCHOR, inputs_only=only) for only in (False, True))]:
            codec = TOPICS[row.topic].codec
            known = shapes.setdefault((row.topic, row.shape), codec.shape(row.value()))
            assert known is not None
            assert known.pack(row.numbers) == codec.encode(row.value())


def test_shapes_without_end_are_not_kept() -> None:
    one = fresh("std_msgs/Header")
    for number in range(300):
        header = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "x" * (number % 100) + str(number)}
        assert one.decode(one.encode(header)) == header
    assert len(one._encoded) <= cdr.MAX_ENCODED
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
def test_what_is_no_message_is_refused_by_a_codec_that_has_met_one_as_by_one_that_has_not(
    named: tuple[str, Value], draw: st.DataObject
) -> None:
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
    seen, results = fresh(name), []
    seen.encode(example)
    for one in (seen, fresh(name)):
        try:
            results.append(repr(one.encode(other)))
        except ValueError as error:
            results.append(str(error))
    assert results[0] == results[1]


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
