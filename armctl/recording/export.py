"""Logs as tables: CSV, Excel, Parquet.

Rules.
1. A column's name says its unit, or that it has none: `shoulder.position_rad`, `shoulder.load_ratio`.
2. Every table begins with `time_epoch_s` and `time_s`, seconds since the log's first tick.
3. Values are the log's own, unrounded (Excel keeps 15 digits of them); what is not known is empty. Lists without
   names are JSON text, bytes are hexadecimal.
4. One row at a time: memory does not grow with the log. An Excel sheet ends at the most rows Excel reads and the
   next one goes on.
5. A file gets its name when it is complete, and replaces nothing.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError, LogError
from armctl.recording import channels
from armctl.recording.edit import Progress, first_ns, new_file
from armctl.recording.reader import LogFile
from armctl.recording.timeline import Frame, Frames
from armctl.recording.writer import writing

Format = Literal["csv", "xlsx", "parquet"]
Cell = bool | int | float | str | None
Row = dict[str, Cell]

EXCEL_ROWS = 1_048_576
"""Rows of a sheet, its header included."""
EXCEL_TEXT = 32_767
BATCH_ROWS = 5000
PROGRESS_ROWS = 2000
TICKS = "ticks"
ANGLES = "angles"
_QUANTITIES = (
    "position_rad", "goal_rad", "velocity_rad_s", "load_ratio", "voltage_V", "temperature_degC", "torque_enabled",
)  # fmt: skip


@dataclass(frozen=True)
class ExportResult:
    """Files that were written, and the rows of each table."""

    paths: tuple[Path, ...]
    rows: dict[str, int]
    complete: bool
    """Whether the log was closed properly and nothing in it is damaged."""


def export(
    path: Path,
    out: Path,
    kind: Format,
    topics: Sequence[str] = (),
    progress: Progress | None = None,
    *,
    excel_rows: int = EXCEL_ROWS,
) -> ExportResult:
    """Write tables of a log.

    Without topics: one row a tick with everything about every joint and the tool; in Excel beside it a sheet of
    joint angles in degrees. With topics: the fields of each one's messages; of several topics CSV and Parquet
    make a folder `out` with a file each.

    Args:
        progress: Called with the fraction done.
        excel_rows: Most rows of a sheet.
    Raises:
        LogError: the log cannot be read or holds nothing of a topic, `out` exists or cannot be written.
        ArmctlError: a package is missing; the message names the extra that brings it.
    """
    tables = topics or ((TICKS, ANGLES) if kind == "xlsx" else (TICKS,))
    folder = len(tables) > 1 and kind != "xlsx"
    rows: dict[str, int] = {}
    paths = [out / f"{table.strip('/').replace('/', '-')}.{kind}" for table in tables] if folder else [out]
    complete = True

    def fill(sink: Sink, table: str) -> None:
        nonlocal complete
        begun = len(rows)

        def show(fraction: float) -> None:
            if progress is not None:
                progress((begun + fraction) / len(tables))

        rows[table], whole = _fill(path, table, sink, show)
        complete = complete and whole

    if folder:
        if out.exists():
            raise LogError(f"{out}: exists already; choose another name, nothing is overwritten")
        with writing(out):
            out.mkdir(parents=True)
        for table, file in zip(tables, paths, strict=True):
            with new_file(file) as stream, _sink(stream, kind, excel_rows) as sink:
                fill(sink, table)
    else:
        with new_file(out) as stream, _sink(stream, kind, excel_rows) as sink:
            for table in tables:
                fill(sink, table)
    return ExportResult(tuple(paths), rows, complete)


def _fill(path: Path, table: str, sink: Sink, progress: Progress) -> tuple[int, bool]:
    """Write one table; its rows, and whether the log is complete."""
    columns = _columns(path, table, lambda fraction: progress(fraction / 2.0))
    with LogFile(path) as log:
        sink.begin(table, columns, {"source": path.name, **log.facts})
        count = 0
        for row in _rows(log, table, first_ns(path)):
            sink.add([row.get(name) for name in columns])
            count += 1
            if count % PROGRESS_ROWS == 0:
                progress((1.0 + log.progress) / 2.0)
        sink.end()
        return count, log.complete


def _columns(path: Path, table: str, progress: Progress) -> dict[str, type]:
    """Every column that comes up, in the order in which they do, and the type that holds all its cells.

    Raises:
        LogError: there are no rows.
    """
    found: dict[str, type | None] = {}
    count = 0
    with LogFile(path) as log:
        for row in _rows(log, table, first_ns(path)):
            count += 1
            if count % PROGRESS_ROWS == 0:
                progress(log.progress)
            for name, cell in row.items():
                found[name] = _common(found.get(name), cell)
        if not count:
            known = ", ".join(sorted(log.topics)) or "none"
            raise LogError(f"{path}: holds nothing for a table of {table}; topics: {known}")
    return {name: kind or float for name, kind in found.items()}


def _common(kind: type | None, cell: Cell) -> type | None:
    """What holds the cells so far and one more."""
    if cell is None:
        return kind
    new = next(one for one in (bool, int, float, str) if isinstance(cell, one))
    if isinstance(cell, int) and not -(2**63) <= cell < 2**63:
        new = str
    if kind is None or kind is new:
        return new
    return float if {kind, new} == {int, float} else str


# ------------------------------------------------------------------------------------------------------- rows


def _rows(log: LogFile, table: str, zero_ns: int) -> Iterator[Row]:
    if table in (TICKS, ANGLES):
        frames = Frames(log)
        make = _tick_row if table == TICKS else _angle_row
        for frame in frames:
            yield _times(frame.time_ns, zero_ns) | make(frame, frames.arm.joint_names)
        return
    for message in log.messages((table,)):
        row = _times(message.log_time_ns, zero_ns)
        _flatten(row, "", log.codec(table).decode(message.data), table)
        yield row


def _times(time_ns: int, zero_ns: int) -> Row:
    return {"time_epoch_s": Seconds(time_ns), "time_s": (time_ns - zero_ns) / NS_PER_S}


class Seconds(float):
    """A time that remembers its nanoseconds: those of an epoch time are more than a float holds."""

    time_ns: int

    def __new__(cls, time_ns: int) -> Seconds:
        made = super().__new__(cls, time_ns / NS_PER_S)
        made.time_ns = time_ns
        return made

    def __str__(self) -> str:
        return f"{self.time_ns // NS_PER_S}.{self.time_ns % NS_PER_S:09d}"


def _tick_row(frame: Frame, names: Sequence[str]) -> Row:
    row: Row = {"tick": frame.tick, "state": frame.state, "fault": frame.fault}
    for index, name in enumerate(names):
        for quantity in _QUANTITIES:
            row[f"{name}.{quantity}"] = _known(getattr(frame, quantity)[index])
    for axis, value in zip(("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"), frame.tool, strict=True):
        row[f"tool.{axis}"] = _known(value)
    return row


def _angle_row(frame: Frame, names: Sequence[str]) -> Row:
    """What the paper's recorder wrote: the angle of every joint."""
    angles = zip(names, frame.position_rad, strict=True)
    return {f"{name}.position_deg": _known(math.degrees(angle)) for name, angle in angles}


def _known(value: float) -> Cell:
    return None if value != value else value


def _flatten(row: Row, prefix: str, value: Any, topic: str) -> None:
    """Add what a message holds to a row, nested names joined by dots."""
    if isinstance(value, dict) and value.keys() >= {"name", "position", "velocity", "effort"}:
        effort = "load_ratio" if topic == channels.JOINT_STATES else "effort"
        for key, quantity in (("position", "position_rad"), ("velocity", "velocity_rad_s"), ("effort", effort)):
            row.update(zip([f"{name}.{quantity}" for name in value["name"]], value[key], strict=False))
        _flatten(row, "header.", value["header"], topic)
    elif isinstance(value, dict) and value.keys() == {"sec", "nanosec"}:
        row[prefix[:-1] + "_s"] = Seconds(value["sec"] * NS_PER_S + value["nanosec"])
    elif isinstance(value, dict):
        unit = "_m" if value.keys() == {"x", "y", "z"} else ""
        for key, part in value.items():
            _flatten(row, f"{prefix}{key}{unit}.", part, topic)
    elif isinstance(value, list) and (named := _by_name(value)):
        # The list's own name says nothing that its members' do not.
        outer = prefix.rpartition(".")[0].rpartition(".")[0]
        for name, part in named.items():
            _flatten(row, f"{outer}.{name}." if outer else f"{name}.", part, topic)
    else:
        row[prefix[:-1]] = _cell(value)


def _by_name(parts: list[Any]) -> dict[str, Any]:
    """The members of a list by the name each of them bears; nothing if they bear none, or the same one twice."""
    for key in ("child_frame_id", "name", "key"):
        if all(isinstance(part, dict) and part.get(key) for part in parts):
            named = {str(part[key]): {name: one for name, one in part.items() if name != key} for part in parts}
            if len(named) == len(parts):
                # A name with a single value needs no third word.
                return {name: part.get("value", part) for name, part in named.items()}
    return {}


def _cell(value: Any) -> Cell:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return json.dumps(value, default=bytes.hex)
    cell: Cell = value
    return cell


# ------------------------------------------------------------------------------------------------------ files


class Sink(Protocol):
    """A file that takes tables."""

    def begin(self, table: str, columns: dict[str, type], facts: dict[str, str]) -> None:
        """Begin a table; `facts` say what it is of."""
        ...

    def add(self, cells: list[Cell]) -> None: ...

    def end(self) -> None:
        """End the table."""
        ...


class _Csv:
    def __init__(self, stream: BinaryIO) -> None:
        self._text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
        self._rows = csv.writer(self._text)

    def begin(self, table: str, columns: dict[str, type], facts: dict[str, str]) -> None:
        self._rows.writerow(columns)

    def add(self, cells: list[Cell]) -> None:
        self._rows.writerow([str(cell) if isinstance(cell, Seconds) else cell for cell in cells])

    def end(self) -> None:
        self._text.flush()
        self._text.detach()


class _Excel:
    def __init__(self, stream: BinaryIO, most_rows: int) -> None:
        try:
            import openpyxl
        except ImportError:
            raise missing_extra("Excel files", "openpyxl") from None
        self._book, self._stream, self._most_rows = openpyxl.Workbook(write_only=True), stream, most_rows
        self._sheet: Any = None
        self._count = self._sheets = 0

    def begin(self, table: str, columns: dict[str, type], facts: dict[str, str]) -> None:
        self._table, self._columns, self._sheets = table, list(columns), 0
        self._new_sheet()

    def add(self, cells: list[Cell]) -> None:
        if self._count == self._most_rows:
            self._new_sheet()
        self._sheet.append([self._excel_cell(cell) for cell in cells])
        self._count += 1

    def end(self) -> None:
        pass

    def save(self) -> None:
        self._book.save(self._stream)

    def _new_sheet(self) -> None:
        self._sheets += 1
        # Excel allows 31 characters, and none of []:*?/\
        name = re.sub(r"[\[\]:*?/\\]", "-", self._table.strip("/"))[:24]
        self._sheet = self._book.create_sheet(name if self._sheets == 1 else f"{name} {self._sheets}")
        self._sheet.freeze_panes = "C2"
        self._sheet.append(self._columns)
        self._count = 1

    def _excel_cell(self, cell: Cell) -> Any:
        if isinstance(cell, str):
            from openpyxl.cell import WriteOnlyCell
            from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

            text = WriteOnlyCell(self._sheet, ILLEGAL_CHARACTERS_RE.sub("\N{REPLACEMENT CHARACTER}", cell)[:EXCEL_TEXT])
            text.data_type = "s"  # never a formula, whatever it begins with
            return text
        if isinstance(cell, float):
            return float(cell) if math.isfinite(cell) else None
        return cell


class _Parquet:
    def __init__(self, stream: BinaryIO) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError:
            raise missing_extra("Parquet files", "pyarrow") from None
        self._arrow, self._stream = pyarrow, stream
        self._waiting: list[list[Cell]] = []

    def begin(self, table: str, columns: dict[str, type], facts: dict[str, str]) -> None:
        arrow = self._arrow
        kinds = {bool: arrow.bool_(), int: arrow.int64(), float: arrow.float64(), str: arrow.string()}
        self._texts = [kind is str for kind in columns.values()]
        schema = arrow.schema([(name, kinds[kind]) for name, kind in columns.items()], metadata=facts)
        self._schema, self._file = schema, arrow.parquet.ParquetWriter(self._stream, schema, compression="zstd")

    def add(self, cells: list[Cell]) -> None:
        self._waiting.append(
            [str(cell) if text and cell is not None else cell for cell, text in zip(cells, self._texts, strict=True)]
        )
        if len(self._waiting) == BATCH_ROWS:
            self._pack()

    def end(self) -> None:
        if self._waiting:
            self._pack()
        self._file.close()

    def _pack(self) -> None:
        fields = zip(zip(*self._waiting, strict=True), self._schema, strict=True)
        arrays = [self._arrow.array(column, field.type) for column, field in fields]
        self._file.write_batch(self._arrow.record_batch(arrays, schema=self._schema))
        self._waiting.clear()


def missing_extra(what: str, package: str) -> ArmctlError:
    """The error that tells how to get a package."""
    return ArmctlError(f"{what} need {package}; install it with: pip install 'armctl[export]'")


@contextmanager
def _sink(stream: BinaryIO, kind: Format, excel_rows: int) -> Iterator[Sink]:
    if kind == "xlsx":
        book = _Excel(stream, excel_rows)
        try:
            yield book
        finally:
            book.save()  # also what will be thrown away: sheets that are begun have to be ended
    else:
        yield _Csv(stream) if kind == "csv" else _Parquet(stream)
