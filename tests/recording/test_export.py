"""Tables: what they hold is what others read from the log, and what Excel and Parquet give back."""

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import openpyxl
import pyarrow.parquet
import pytest
from rosbags.highlevel import AnyReader

from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError
from armctl.messages import TickRecord
from armctl.recording import export as exporting
from armctl.recording.channels import TOPICS
from armctl.recording.export import Format, export
from tests.recording.altered import faulty, with_sample, without_first_joint
from tests.recording.factory import ANCHOR, ARM, make_records
from tests.recording.logs import write
from tests.recording.refusals import cannot

RECORDS = make_records(60, seed=3)
WRITE = ("servo_id", "address", "size", "confirmed", "value")
FORMATS: tuple[Format, ...] = ("csv", "xlsx", "parquet")


def table(path: Path) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of an exported file; of an Excel file its first sheet."""
    if path.suffix == ".csv":
        with path.open(newline="") as file:
            header, *rows = csv.reader(file)
        return header, rows
    if path.suffix == ".xlsx":
        return sheet(path, 0)
    found = pyarrow.parquet.read_table(path)
    return found.column_names, [list(row.values()) for row in found.to_pylist()]


def sheet(path: Path, index: int) -> tuple[list[str], list[list[Any]]]:
    book = openpyxl.load_workbook(path, read_only=True)
    header, *rows = [list(row) for row in book.worksheets[index].iter_rows(values_only=True)]
    book.close()
    # Empty cells at the end of a row are not in the file.
    return [str(name) for name in header], [row + [None] * (len(header) - len(row)) for row in rows]


def column(path: Path, name: str) -> list[Any]:
    header, rows = table(path)
    return [row[header.index(name)] for row in rows]


def number(cell: Any) -> float | None:
    """A cell of any format as a number."""
    return None if cell in ("", None) else float(cell)


def same(found: list[float | None], expected: list[float], kind: Format) -> bool:
    """Whether values are equal to the last bit; in Excel, which keeps 15 digits of a number, to those."""
    rounding = 1e-15 if kind == "xlsx" else 0.0
    return found == pytest.approx(expected, rel=rounding, abs=0.0)


@cache
def ros(path: Path, topic: str) -> list[tuple[int, Any]]:
    """(log time, message) of a topic, read by rosbags."""
    with AnyReader([path]) as bag:
        wanted = [connection for connection in bag.connections if connection.topic == topic]
        return [(t, bag.deserialize(data, c.msgtype)) for c, t, data in bag.messages(wanted)]


@pytest.fixture(params=FORMATS)
def kind(request: pytest.FixtureRequest) -> Format:
    return request.param  # type: ignore[no-any-return]


def test_the_table_of_ticks_holds_what_rosbags_reads(log: Path, tmp_path: Path, kind: Format) -> None:
    result = export(log, tmp_path / f"t.{kind}", kind)
    header, rows = table(tmp_path / f"t.{kind}")
    states, poses = ros(log, "/joint_states"), ros(log, "/tcp_pose")
    assert result.rows["ticks"] == len(rows) == len(states)
    assert result.complete
    for row, (time_ns, state), (_, pose) in zip(rows, states, poses, strict=True):
        place = pose.pose.position
        expected = {"time_s": (time_ns - states[0][0]) / NS_PER_S, "time_epoch_s": time_ns / NS_PER_S}
        expected |= {"tool.x_m": place.x, "tool.y_m": place.y, "tool.z_m": place.z}
        for quantity, field in (("position_rad", "position"), ("velocity_rad_s", "velocity"), ("load_ratio", "effort")):
            values = zip(state.name, getattr(state, field).tolist(), strict=True)
            expected |= {f"{name}.{quantity}": value for name, value in values}
        cells = dict(zip(header, row, strict=True))
        assert same([number(cells[key]) for key in expected], list(expected.values()), kind)


@pytest.mark.parametrize(
    "topic", ["/joint_states", "/joint_commands", "/tcp_pose", "/armctl/cycle", "/armctl/writes", "/rosout"]
)
def test_a_topic_holds_what_rosbags_reads(log: Path, tmp_path: Path, kind: Format, topic: str) -> None:
    export(log, tmp_path / f"t.{kind}", kind, (topic,))
    header, rows = table(tmp_path / f"t.{kind}")
    messages = ros(log, topic)
    assert header[:2] == ["time_epoch_s", "time_s"]
    assert len(rows) == len(messages) > 0
    for row, (_, message) in zip(rows, messages, strict=True):
        cells = dict(zip(header, row, strict=True))
        if topic in ("/joint_states", "/joint_commands"):
            found = [number(cells[f"{name}.position_rad"]) for name in message.name]
            assert same(found, message.position.tolist(), kind)
        elif topic == "/tcp_pose":
            turn = message.pose.orientation
            found = [number(cells[f"pose.orientation.{axis}"]) for axis in "xyzw"]
            assert same(found, [turn.x, turn.y, turn.z, turn.w], kind)
        elif topic == "/armctl/cycle":
            for key in ("tick", "now_ns", "bus_us", "late_ns"):
                assert number(cells[key]) == getattr(message, key)
            assert (cells["mode"], cells["faults"]) == (message.mode, "[]")
        elif topic == "/armctl/writes":
            told = [{key: getattr(write, key) for key in WRITE} for write in message.writes]
            assert json.loads(cells["writes"]) == told
        else:
            assert (cells["msg"], number(cells["level"])) == (message.msg, message.level)


def test_every_topic_can_be_exported_and_no_two_columns_share_a_name(log: Path, tmp_path: Path) -> None:
    topics = [topic for topic in TOPICS if ros(log, topic)]
    result = export(log, tmp_path / "all", "csv", topics)
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == sorted(path.name for path in result.paths)
    assert len(topics) == 14
    for topic, path in zip(topics, result.paths, strict=True):
        header, rows = table(path)
        assert len(set(header)) == len(header)
        assert len(rows) == result.rows[topic] == len(ros(log, topic))


def test_csv_keeps_every_nanosecond(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    export(log, path, "csv")
    times = [int(cell.replace(".", "")) for cell in column(path, "time_epoch_s")]
    assert times == [ANCHOR.epoch_ns(record.inputs.sample.time_ns) for record in RECORDS]


def test_registers_are_told_in_units_and_raw(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "t.csv", "csv", ("/armctl/servos",))
    raw = [record.inputs.sample.servos[1].registers.hex() for record in RECORDS]
    assert column(tmp_path / "t.csv", "shoulder.registers") == raw
    export(log, tmp_path / "u.csv", "csv")
    for quantity in ("voltage_V", "temperature_degC"):
        found = list(map(float, column(tmp_path / "u.csv", f"shoulder.{quantity}")))
        assert found == [getattr(record.outputs.joints[1], quantity) for record in RECORDS]


def test_excel_has_the_angles_in_degrees_on_a_sheet_of_their_own(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "t.xlsx", "xlsx")
    header, rows = sheet(tmp_path / "t.xlsx", 1)
    assert header == ["time_epoch_s", "time_s", *(f"{name}.position_deg" for name in ARM.joint_names)]
    for row, record in zip(rows, RECORDS, strict=True):
        assert same(row[2:], [math.degrees(joint.position_rad) for joint in record.outputs.joints], "xlsx")


def test_an_excel_sheet_ends_at_its_limit_and_the_next_goes_on(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert exporting.EXCEL_ROWS == 2**20
    monkeypatch.setattr(exporting, "EXCEL_ROWS", 26)
    export(log, tmp_path / "t.xlsx", "xlsx", ("/armctl/cycle",))
    book = openpyxl.load_workbook(tmp_path / "t.xlsx", read_only=True)
    assert book.sheetnames == ["armctl-cycle", "armctl-cycle 2", "armctl-cycle 3"]
    sheets = [[list(row) for row in found.iter_rows(values_only=True)] for found in book.worksheets]
    book.close()
    assert [len(rows) for rows in sheets] == [26, 26, 11]
    assert sheets[0][0] == sheets[1][0] == sheets[2][0]
    place = sheets[0][0].index("tick")
    assert [row[place] for rows in sheets for row in rows[1:]] == list(range(60))


def test_text_is_never_a_formula_and_never_breaks_the_file(tmp_path: Path) -> None:
    texts = ["=1+1", "bell \x07", "x" * 40_000, '"quoted", and\nbroken']
    log = write(tmp_path / "a.mcap", RECORDS[:1], notes={0: texts})
    for kind in FORMATS:
        export(log, tmp_path / f"t.{kind}", kind, ("/armctl/command",))
        excel = ["=1+1", "bell \N{REPLACEMENT CHARACTER}", "x" * 32_767, texts[3]]
        assert column(tmp_path / f"t.{kind}", "data")[-4:] == (excel if kind == "xlsx" else texts)
    assert openpyxl.load_workbook(tmp_path / "t.xlsx").worksheets[0]["C2"].data_type == "s"


def test_parquet_has_types_and_says_where_it_is_from(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "t.parquet", "parquet")
    schema = pyarrow.parquet.read_schema(tmp_path / "t.parquet")
    types = {name: str(kind) for name, kind in zip(schema.names, schema.types, strict=True)}
    assert types["shoulder.position_rad"] == types["time_s"] == "double"
    assert (types["tick"], types["state"], types["base.torque_enabled"]) == ("int64", "string", "bool")
    told = {"arm_id": ARM.arm_id, "calibration_hash": ARM.calibration_hash, "source": "a.mcap"}
    assert {key: schema.metadata[key.encode()].decode() for key in told} == told


def silent(record: TickRecord) -> TickRecord:
    """The tick while the first servo has never answered."""
    first, *others = record.inputs.sample.servos
    record = with_sample(record, servos=(replace(first, registers=b"", stamp_ns=0, fresh=False), *others))
    return without_first_joint(record)


@pytest.mark.parametrize(
    "records",
    [RECORDS, faulty(RECORDS, 12, 20), [*map(silent, RECORDS[:7]), *RECORDS[7:]], RECORDS[5:]],
    ids=["whole", "with a fault", "first servo silent", "not from the first tick"],
)
def test_every_row_is_what_the_tick_said(tmp_path: Path, records: list[TickRecord]) -> None:
    log = write(tmp_path / "a.mcap", records, inputs_only=RECORDS[2:5] if records[0] is RECORDS[5] else ())
    export(log, tmp_path / "t.parquet", "parquet")
    header, rows = table(tmp_path / "t.parquet")
    begun_ns = records[0].inputs.sample.time_ns
    for row, record in zip(rows, records, strict=True):
        outputs, since_ns = record.outputs, record.inputs.sample.time_ns - begun_ns
        fault = outputs.fault
        cells: dict[str, Any] = {"time_s": since_ns / NS_PER_S, "tick": record.inputs.tick, "state": outputs.mode.value}
        cells["fault"] = f"{fault.code}: {fault.text}" if fault else ""
        for name, joint in zip(ARM.joint_names, outputs.joints, strict=True):
            for quantity in ("position_rad", "velocity_rad_s", "load_ratio"):
                cells[f"{name}.{quantity}"] = getattr(joint, quantity) if joint.known else None
        for name, joint, reading in zip(ARM.joint_names, outputs.joints, record.inputs.sample.servos, strict=True):
            for quantity in ("voltage_V", "temperature_degC"):
                cells[f"{name}.{quantity}"] = getattr(joint, quantity) if reading.registers else None
        assert {key: row[header.index(key)] for key in cells} == cells


def test_what_is_not_known_is_empty(tmp_path: Path, kind: Format) -> None:
    export(write(tmp_path / "a.mcap", [without_first_joint(RECORDS[0]), *RECORDS[1:3]]), tmp_path / f"t.{kind}", kind)
    for name in ("base.position_rad", "tool.x_m"):
        assert [number(cell) is None for cell in column(tmp_path / f"t.{kind}", name)] == [True, False, False]


def test_nested_lists_are_json(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "t.csv", "csv", ("/joint_trajectory",))
    points = json.loads(column(tmp_path / "t.csv", "points")[0])
    ((_, message),) = ros(log, "/joint_trajectory")
    assert [point["positions"] for point in points] == [point.positions.tolist() for point in message.points]


def test_nothing_is_overwritten_and_a_failure_leaves_nothing(log: Path, tmp_path: Path, kind: Format) -> None:
    taken = tmp_path / f"t.{kind}"
    taken.write_bytes(b"mine")
    cannot(export, log, taken, kind, why="exists already")
    assert taken.read_bytes() == b"mine"
    for topics in (("/nothing",), ("/rosout", "/nothing")):
        cannot(export, log, tmp_path / f"u.{kind}", kind, topics, why=r"/nothing; topics: .*/joint_states")
    assert [path.name for path in tmp_path.iterdir()] == [taken.name]


def test_a_cut_log_is_exported_as_far_as_it_goes_and_that_is_told(log: Path, tmp_path: Path) -> None:
    result = export(write(tmp_path / "a.mcap", RECORDS[:30], finish=False), tmp_path / "t.csv", "csv")
    assert (result.rows, result.complete) == ({"ticks": 30}, False)


@pytest.mark.parametrize(("kind", "package"), [("xlsx", "openpyxl"), ("parquet", "pyarrow")])
def test_a_missing_package_is_named_with_its_extra(
    log: Path, tmp_path: Path, kind: Format, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(ArmctlError, match=r"armctl\[export\]"):
        export(log, tmp_path / f"t.{kind}", kind)
    assert list(tmp_path.iterdir()) == []


def test_progress_runs_from_none_to_all(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "PROGRESS_ROWS", 5)
    seen: list[float] = []
    export(log, tmp_path / "t.xlsx", "xlsx", progress=seen.append)
    assert seen == sorted(seen)
    assert len(seen) >= 20
    assert max(seen) <= 1.0
