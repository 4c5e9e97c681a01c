"""Logs as tables: CSV, Excel, Parquet.

Rules.
1. A column's name says its unit, or that it has none: `shoulder.position_rad`, `shoulder.load_ratio`.
2. Every table begins with `time_epoch_s` and `time_s`, seconds since the log's first tick.
3. Values are the log's own, unrounded (Excel keeps 15 digits of them); what is not known is empty. Lists without
   names are JSON text, bytes are hexadecimal.
4. One row at a time: memory does not grow with the log, but for Parquet's table of ticks, which is made column by
   column in a tenth of the time. An Excel sheet ends at the most rows Excel reads and the
   next one goes on.
5. A file gets its name when it is complete, and replaces nothing.
"""

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Literal, Self

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError, LogError
from armctl.recording import channels
from armctl.recording.disk import new_file, writing
from armctl.recording.edit import Progress, first_ns
from armctl.recording.log_file import LogFile
from armctl.recording.timeline import Frame, Frames

Format = Literal["csv", "xlsx", "parquet"]
Cell = bool | int | float | str | None
Row = dict[str, Cell]

# Rows of a sheet, its header included.
EXCEL_ROWS = 1_048_576
EXCEL_TEXT = 32_767
BATCH_ROWS = 5000
PROGRESS_ROWS = 2000
TICKS = "ticks"
ANGLES = "angles"
_QUANTITIES = (
    "position_rad", "goal_rad", "velocity_rad_s", "load_ratio", "voltage_V", "temperature_degC", "torque_enabled",
)  # fmt: skip


_TOOL = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class ExportResult:
    """Files that were written, and the rows of each table."""

    paths: tuple[Path, ...]
    rows: dict[str, int]
    # Whether the log was closed properly and nothing in it is damaged.
    complete: bool


def export(
    path: Path, out: Path, kind: Format, topics: Sequence[str] = (), progress: Progress | None = None
) -> ExportResult:
    """Write tables of a log.

    Without topics: one row a tick with everything about every joint and the tool; in Excel beside it a sheet of
    joint angles in degrees. With topics: the fields of each one's messages; of several topics CSV and Parquet
    make a folder `out` with a file each.

    Args:
        progress: Called with the fraction done.
    Raises:
        LogError: the log cannot be read or holds nothing of a topic, `out` exists or cannot be written.
        ArmctlError: a package is missing; the message names the extra that brings it.
    """
    names = tuple(topics) or ((TICKS, ANGLES) if kind == "xlsx" else (TICKS,))
    if len(names) == 1 or kind == "xlsx":
        files = {out: names}
    else:
        files = {out / f"{name.strip('/').replace('/', '-')}.{kind}": (name,) for name in names}
        if out.exists():
            raise LogError(f"{out}: exists already; choose another name, nothing is overwritten")
        with writing(out):
            out.mkdir(parents=True)
    done: list[_Table] = []

    def show(fraction: float) -> None:
        if progress is not None:
            progress((len(done) - 1 + fraction) / len(names))

    def tables(wanted: Sequence[str]) -> Iterator[_Table]:
        for name in wanted:
            done.append(_Table(path, name, show))
            if not (kind == "parquet" and name == TICKS and done[-1].take_columns()):
                done[-1].look()
            yield done[-1]

    write = {"csv": _write_csv, "xlsx": _write_excel, "parquet": _write_parquet}[kind]
    for file, wanted in files.items():
        with new_file(file) as stream:
            write(stream, tables(wanted))
    return ExportResult(tuple(files), {one.name: one.count for one in done}, all(one.complete for one in done))


class _Table:
    """One table of a log, which is read twice: `look` finds the columns, then `rows` gives the cells.

    Args:
        show: Called with the fraction done.
    """

    def __init__(self, path: Path, name: str, show: Progress) -> None:
        self.name = name
        # Rows given so far.
        self.count = 0
        # Whether the log is complete; known after the last row.
        self.complete = False
        # Every column in the order in which they come up, and the type that holds all its cells.
        self.columns: dict[str, type] = {}
        self.facts: dict[str, str] = {}
        self._path, self._show = path, show
        # All cells by column, where they come at once.
        self._cells: dict[str, Any] = {}

    def take_columns(self) -> bool:
        """Take all cells of the table of ticks at once; False where they have to be looked for one by one."""
        with LogFile(self._path) as log:
            if (found := (frames := Frames(log)).columns()) is None:
                return False
            self.facts, self.complete = {"source": self._path.name, **log.facts}, log.complete
        times = [_times(time_ns, int(found["time_ns"][0])) for time_ns in found["time_ns"].tolist()]
        self._cells = {name: [row[name] for row in times] for name in times[0]}
        self._cells |= {key: found[key] for key in ("tick", "state", "fault")}
        for index, name in enumerate(frames.arm.joint_names):
            self._cells |= {f"{name}.{quantity}": found[quantity][:, index] for quantity in _QUANTITIES}
        self._cells |= {f"tool.{axis}": column for axis, column in zip(_TOOL, found["tool"].T, strict=True)}
        for name, cells in self._cells.items():
            if isinstance(cells, np.ndarray):
                self._cells[name] = np.where(cells == cells, cells, np.array(None)).tolist()  # NaN: not known
        first = {name: next((cell for cell in cells if cell is not None), 0.0) for name, cells in self._cells.items()}
        self.columns = {name: _common(None, cell) or float for name, cell in first.items()}
        return True

    def look(self) -> None:
        """Find the columns.

        Raises:
            LogError: there are no rows.
        """
        found: dict[str, type | None] = {}
        for row in self._read(0.0):
            for name, cell in row.items():
                found[name] = _common(found.get(name), cell)
        self.columns = {name: kind or float for name, kind in found.items()}

    def rows(self) -> Iterator[Sequence[Cell]]:
        """The cells of every row, one for each column."""
        cells = zip(*self._cells.values(), strict=True)
        for row in cells if self._cells else ([row.get(name) for name in self.columns] for row in self._read(0.5)):
            self.count += 1
            yield row

    def _read(self, begun: float) -> Iterator[Row]:
        """The log's rows; `begun`: fraction done before the first one."""
        count = 0
        with LogFile(self._path) as log:
            self.facts = {"source": self._path.name, **log.facts}
            for count, row in enumerate(_rows(log, self.name, first_ns(self._path)), 1):  # used below
                yield row
                if count % PROGRESS_ROWS == 0:
                    self._show(begun + log.progress / 2.0)
            if not count:
                known = ", ".join(sorted(log.topics)) or "none"
                raise LogError(f"{self._path}: holds nothing for a table of {self.name}; topics: {known}")
            self.complete = log.complete


def _common(kind: type | None, cell: Cell) -> type | None:
    """What holds the cells so far and one more."""
    if cell is None:
        return kind
    new = next(candidate for candidate in (bool, int, float, str) if isinstance(cell, candidate))
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

    def __new__(cls, time_ns: int) -> Self:
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
    for axis, value in zip(_TOOL, frame.tool, strict=True):
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
    """The members of a list by their names; nothing if one has no name, or two have the same."""
    for key in ("child_frame_id", "name", "key"):
        if all(isinstance(part, dict) and part.get(key) for part in parts):
            named = {str(part[key]): {name: value for name, value in part.items() if name != key} for part in parts}
            if len(named) == len(parts):
                # A name with a single value needs no third word.
                return {name: part.get("value", part) for name, part in named.items()}
    return {}


def _cell(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    return json.dumps(value, default=bytes.hex) if isinstance(value, list) else value


# ------------------------------------------------------------------------------------------------------ files


def _write_csv(stream: BinaryIO, tables: Iterator[_Table]) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text)
    for table in tables:
        rows.writerow(table.columns)
        rows.writerows([str(cell) if isinstance(cell, Seconds) else cell for cell in row] for row in table.rows())
    text.detach()


def _write_excel(stream: BinaryIO, tables: Iterator[_Table]) -> None:
    book = extra("Excel files", "openpyxl").Workbook(write_only=True)
    sheet: Any = None
    try:
        for table in tables:
            # Excel allows 31 characters, and none of []:*?/\
            name = re.sub(r"[\[\]:*?/\\]", "-", table.name.strip("/"))[:24]
            for index, row in enumerate(table.rows()):
                sheets, place = divmod(index, EXCEL_ROWS - 1)
                if place == 0:
                    sheet = book.create_sheet(f"{name} {sheets + 1}" if sheets else name)
                    sheet.freeze_panes = "C2"
                    sheet.append(list(table.columns))
                sheet.append([_excel_cell(sheet, cell) for cell in row])
    finally:
        book.save(stream)  # also what will be thrown away: sheets that are begun have to be ended


def _excel_cell(sheet: Any, cell: Cell) -> Any:
    if isinstance(cell, str):
        from openpyxl.cell import WriteOnlyCell
        from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

        text = WriteOnlyCell(sheet, ILLEGAL_CHARACTERS_RE.sub("\N{REPLACEMENT CHARACTER}", cell)[:EXCEL_TEXT])
        text.data_type = "s"  # never a formula, whatever it begins with
        return text
    if isinstance(cell, float):
        return float(cell) if math.isfinite(cell) else None
    return cell


def _write_parquet(stream: BinaryIO, tables: Iterator[_Table]) -> None:
    pyarrow, parquet = extra("Parquet files", "pyarrow"), import_module("pyarrow.parquet")
    types = {bool: pyarrow.bool_(), int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    for table in tables:
        schema = pyarrow.schema([(name, types[kind]) for name, kind in table.columns.items()], metadata=table.facts)
        rows = table.rows()
        with parquet.ParquetWriter(stream, schema, compression="zstd") as file:
            while batch := list(islice(rows, BATCH_ROWS)):
                columns = zip(table.columns.values(), zip(*batch, strict=True), strict=True)
                arrays = [pyarrow.array(_of_type(kind, cells), types[kind]) for kind, cells in columns]
                file.write_batch(pyarrow.record_batch(arrays, schema=schema))


def _of_type(kind: type, cells: Sequence[Cell]) -> Sequence[Cell]:
    """The cells of a column; in one of texts other values become texts."""
    return [None if cell is None else str(cell) for cell in cells] if kind is str else cells


def extra(what: str, package: str, name: str = "export") -> Any:
    """A package that the extra `name` brings.

    Raises:
        ArmctlError: it is missing; the message tells how to get it.
    """
    try:
        return import_module(package)
    except ImportError:
        raise ArmctlError(f"{what} need {package}; install it with: pip install 'armctl[{name}]'") from None
