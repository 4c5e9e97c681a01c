"""The codec against mcap-ros2-support and rosbags, for every type."""

import math
import struct
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armctl.errors import LogError
from armctl.recording.cdr import HEADER, Value, codec, schema_codec
from armctl.recording.schemas import MESSAGES, PRIMITIVES, fields, full_name, parse_schema, schema_text
from tests.recording.refusals import cannot

NAMES = sorted(MESSAGES)
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)


# Those that are no whole numbers of their size; rosbags takes the octet as signed.
PLAIN = {"string": TEXT, "bool": st.booleans(), "byte": st.integers(0, 127)}
PLAIN |= dict.fromkeys(("float32", "float64"), st.floats(width=64))


def _primitive(kind: str) -> st.SearchStrategy[Any]:
    if kind in PLAIN:
        return PLAIN[kind]
    count = 2 ** (8 * struct.calcsize(PRIMITIVES[kind]))
    least = -count // 2 if PRIMITIVES[kind].islower() else 0
    return st.integers(least, least + count - 1)


def values(name: str) -> st.SearchStrategy[Value]:
    """Any value of a message type."""
    members = {}
    for field in fields(name):
        single = values(field.type) if field.type in MESSAGES else _primitive(field.type)
        if field.is_array:
            single = st.binary(max_size=30) if field.type == "uint8" else st.lists(single, max_size=3)
        members[field.name] = single
    return st.fixed_dictionaries(members)


def _plain(message: Any) -> Any:
    """A decoded message of another library as plain values; NaN as a word, so that equal means equal."""
    if names := getattr(message, "__dataclass_fields__", getattr(message, "__slots__", ())):
        message = {key: getattr(message, key) for key in names if key[0].islower()}
    if isinstance(message, dict):
        return {key: _plain(value) for key, value in message.items()}
    if hasattr(message, "tolist"):
        message = message.tolist()
    if isinstance(message, list | bytes):
        return [_plain(value) for value in message]
    return "nan" if isinstance(message, float) and math.isnan(message) else message


@pytest.mark.parametrize("name", NAMES)
def test_mcap_ros2_support_rosbags_and_the_stored_schema_give_the_same_bytes_and_values(name: str) -> None:
    full, text = full_name(name), schema_text(name)
    encoder, decoder = serialize_dynamic(full, text)[full], generate_dynamic(full, text)[full]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, full))
    assert parse_schema(full, text)[name].split() == MESSAGES[name].split()

    @settings(max_examples=40)
    @given(values(name))
    def check(value: Value) -> None:
        data = codec(name).encode(value)
        assert data == encoder(value)
        found = (
            codec(name).decode(data),
            schema_codec(full, text).decode(data),
            decoder(data),
            store.deserialize_cdr(data, full),
        )
        assert [_plain(message) for message in found] == [_plain(value)] * 4

    check()


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("armctl_msgs/")])
def test_standard_types_are_declared_as_ros_declares_them(name: str) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    ours = get_types_from_msg(schema_text(name), full_name(name))
    assert ours[full_name(name)][1] == store.fielddefs[full_name(name)][1]


@pytest.mark.parametrize(
    ("stamp", "named"),
    [
        ({"sec": 1}, "nanosec"),
        ({"sec": 1, "nanosecond": 2}, "nanosec, nanosecond"),
        ({"sec": 1, "nanosec": 2, "more": 3}, "more"),
        ({"sec": "1", "nanosec": 2}, ""),
        ({"sec": 2**31, "nanosec": 2}, ""),
    ],
)
def test_a_wrong_field_or_value_is_refused_by_name_also_where_it_is_nested(stamp: Value, named: str) -> None:
    for name, value in (("builtin_interfaces/Time", stamp), ("std_msgs/Header", {"stamp": stamp, "frame_id": ""})):
        with pytest.raises(ValueError, match=f"{name}: .*{named}"):
            codec(name).encode(value)


@given(st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), values(name))), st.data())
def test_a_cut_message_is_an_error_or_decodes_to_nothing_longer(named: tuple[str, Value], data: st.DataObject) -> None:
    name, value = named
    encoded = codec(name).encode(value)
    cut = data.draw(st.integers(0, len(encoded) - 1))
    cannot(codec(name).decode, encoded[:cut], why=name)


@settings(max_examples=300)
@given(st.sampled_from(NAMES), st.binary(max_size=200))
def test_any_bytes_decode_or_raise_a_log_error(name: str, data: bytes) -> None:
    with suppress(LogError):
        codec(name).decode(HEADER + data)


def test_big_endian_is_refused() -> None:
    cannot(codec("std_msgs/String").decode, b"\x00\x00\x00\x00\x00\x00\x00\x01\x00", why="little-endian")


def test_an_empty_message_type_has_one_byte() -> None:
    data = schema_codec("std_msgs/msg/Empty", "").encode({"structure_needs_at_least_one_member": 0})
    assert data == HEADER + b"\0"


MANY = "".join(f"pkg/Many a{i}\n" for i in range(1100))
UNREADABLE = ["pkg/Missing x", "float64[3] fixed", "float64 x y", "float64 Bad-Name", "pkg/Self again", MANY]


@pytest.mark.parametrize("text", [*UNREADABLE, "pkg/Self[] again"])
def test_a_schema_that_cannot_be_read_is_a_log_error(text: str) -> None:
    text += f"\n{'=' * 80}\nMSG: pkg/Many\nstring x\n"
    cannot(schema_codec, "pkg/msg/Self", text, why="pkg/")


def test_constants_and_comments_are_no_fields() -> None:
    value = schema_codec("pkg/msg/A", "byte OK=0 # fine\n# nothing\nint8 x # the value\n\n").decode(HEADER + b"\xff")
    assert value == {"x": -1}


@pytest.mark.parametrize("name", NAMES)
def test_messages_that_follow_one_of_their_shape_are_read_as_it_was(name: str) -> None:
    """A codec that has met nothing reads every message step by step; one that has met them may not."""

    @settings(max_examples=10)
    @given(st.lists(values(name), min_size=1, max_size=3))
    def check(seen: list[Value]) -> None:
        fresh = schema_codec.__wrapped__(name, schema_text(name))
        data = [codec(name).encode(value) for value in seen]
        for one in [*data, *data]:
            # By their texts: 0.0 is not -0.0, and the order of keys is that of columns in a table.
            assert repr(fresh.decode(one)) == repr(schema_codec.__wrapped__(name, schema_text(name)).decode(one))

    check()


def test_a_text_of_the_same_length_is_another_shape() -> None:
    fresh = schema_codec.__wrapped__("std_msgs/Header", schema_text("std_msgs/Header"))
    headers = [
        {"stamp": {"sec": n, "nanosec": 5}, "frame_id": frame} for n in range(9) for frame in ("a", "b", "é"[:0])
    ]
    assert [fresh.decode(codec("std_msgs/Header").encode(header)) for header in headers] == headers
    damaged = codec("std_msgs/Header").encode(headers[0])[:-2] + b"\xff\0"
    with pytest.raises(LogError, match="damaged message"):
        fresh.decode(damaged)
