"""Columns hold what the codec decodes, for every type and every shape."""

from contextlib import suppress
from pathlib import Path
from pprint import pformat
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import LogError
from armctl.recording import columns
from armctl.recording.cdr import HEADER, Value, codec
from armctl.recording.columns import Payloads, Table, Texts
from armctl.recording.reader import read, read_columns
from armctl.recording.schemas import MESSAGES, PRIMITIVES, fields
from tests.recording.factory import make_records
from tests.recording.logs import write
from tests.recording.refusals import cannot
from tests.recording.test_cdr import NAMES, values


def payloads(data: list[bytes]) -> Payloads:
    numbers, sizes = np.arange(len(data)), np.array([*map(len, data)], np.int64)
    return Payloads(numbers.astype(np.uint64), numbers.astype(np.uint32), numbers, sizes, b"".join(data))


def message(name: str, table: Table, row: int, prefix: str = "") -> Value:
    """One message of a table as the codec gives it."""

    def element(kind: str, place: str) -> Any:
        if kind in MESSAGES:
            return message(kind, table, row, f"{place}.")
        texts = table.columns[place]
        assert isinstance(texts, Texts)
        return texts[row]

    value: Value = {}
    for item in fields(name):
        path = prefix + item.name
        if item.type in PRIMITIVES:
            column = table.columns[path]
            assert isinstance(column, np.ndarray)
            is_blob = item.is_array and item.type in ("byte", "uint8")
            value[item.name] = bytes(column[row]) if is_blob else column[row].tolist()
        elif item.is_array:
            held = len({key[len(path) :].split("]")[0] for key in table.columns if key.startswith(f"{path}[")})
            value[item.name] = [element(item.type, f"{path}[{index}]") for index in range(held)]
        else:
            value[item.name] = element(item.type, path)
    return value


@settings(max_examples=150)
@given(st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), st.lists(values(name), max_size=6))))
def test_columns_hold_what_the_codec_decodes(named: tuple[str, list[Value]]) -> None:
    name, given_values = named
    data = [codec(name).encode(value) for value in given_values]
    tables = columns.tables(name, MESSAGES, payloads(data))
    assert sum(len(table.sequence) for table in tables) == len(data)
    for table in tables:
        assert sorted(table.sequence.tolist()) == table.sequence.tolist()
        for row, number in enumerate(table.sequence.tolist()):
            # As text, which tells types apart and finds NaN equal to NaN.
            assert pformat(message(name, table, row)) == pformat(codec(name).decode(data[number]))


@settings(max_examples=150)
@given(st.sampled_from(NAMES), st.lists(st.binary(max_size=120), min_size=1, max_size=3))
def test_any_bytes_make_columns_or_a_log_error(name: str, data: list[bytes]) -> None:
    with suppress(LogError):
        for table in columns.tables(name, MESSAGES, payloads([HEADER + one for one in data])):
            for column in table.columns.values():
                column.tolist()


@settings(max_examples=100)
@given(st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), values(name))), st.data())
def test_a_cut_message_among_whole_ones_is_a_log_error(named: tuple[str, Value], draw: st.DataObject) -> None:
    name, value = named
    whole = codec(name).encode(value)
    cut = draw.draw(st.integers(0, len(whole) - 1))
    cannot(columns.tables, name, MESSAGES, payloads([whole, whole[:cut], whole]), why=name)


def test_messages_of_other_shapes_make_other_tables_in_order_of_appearance() -> None:
    def text(names: list[str]) -> bytes:
        header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": ""}
        numbers = [float(len(names))] * len(names)
        joints = {"header": header, "name": names, "position": numbers, "velocity": numbers, "effort": numbers}
        return codec("sensor_msgs/JointState").encode(joints)

    data = [text(["a"]), text(["a", "b"]), text(["a"]), text([])]
    tables = columns.tables("sensor_msgs/JointState", MESSAGES, payloads(data))
    assert [table.sequence.tolist() for table in tables] == [[0, 2], [1], [3]]
    assert [table.numbers("position").tolist() for table in tables] == [[[1.0], [1.0]], [[2.0, 2.0]], [[]]]
    cannot(tables[0].numbers, "nothing", why="known: header")


def test_too_many_shapes_columns_and_levels_are_a_log_error() -> None:
    blobs = [HEADER + count.to_bytes(4, "little") + bytes(count) for count in range(300)]
    cannot(columns.tables, "pkg/Blob", {"pkg/Blob": "uint8[] data"}, payloads(blobs), why="shapes")
    texts = HEADER + (30_000).to_bytes(4, "little") + b"\1\0\0\0\0\0\0\0" * 30_000
    many = {"pkg/Many": "pkg/Text[] all", "pkg/Text": "string data"}
    cannot(columns.tables, "pkg/Many", many, payloads([texts]), why="columns")
    deep = {f"pkg/T{i}": f"pkg/T{i + 1} x" for i in range(40)} | {"pkg/T40": "uint8 x"}
    cannot(columns.tables, "pkg/T0", deep, payloads([HEADER + b"\1"]), why="nested deeper")


def test_a_whole_log_as_columns_is_the_log_message_by_message(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", make_records(120))
    tables = read_columns(path)
    expected: dict[str, list[Value]] = {}
    for one in read(path):
        expected.setdefault(one.topic, []).append(one.value)
    assert tables.keys() == expected.keys()
    for topic, found in tables.items():
        assert sum(len(table.sequence) for table in found) == len(expected[topic])
    (states,) = tables["/joint_states"]
    assert states.numbers("position").tolist() == [value["position"] for value in expected["/joint_states"]]
    assert states.columns["name[0]"].tolist() == [value["name"][0] for value in expected["/joint_states"]]
    alone = read_columns(path, ("/joint_states",))
    assert alone.keys() == {"/joint_states"}
    np.testing.assert_array_equal(alone["/joint_states"][0].numbers("effort"), states.numbers("effort"))


def test_a_text_that_is_no_utf8_is_a_log_error_when_it_is_asked_for() -> None:
    (table,) = columns.tables("std_msgs/String", MESSAGES, payloads([HEADER + b"\2\0\0\0\xff\0"]))
    cannot(table.columns["data"].tolist, why="UTF-8")
