"""Logs as tables: CSV, Excel, Parquet.

Rules.
1. A column's name says its unit, or that it has none: `shoulder.position_rad`, `shoulder.load_ratio`.
2. Every table begins with `time_epoch_s` and `time_s`, seconds since the log's first tick.
3. Values are the log's own, unrounded (Excel keeps 15 digits of them); what is not known is empty. Lists without
   names are JSON text, bytes are hexadecimal.
4. The table of ticks is made column by column, in a tenth of the time; the messages of a topic are read one by one, so
   that memory does not grow with them. An Excel sheet ends at the most rows Excel reads and the next one goes on.
5. A file gets its name when it is complete, and replaces nothing.
"""

import csv
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, BinaryIO, Literal, Self

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError, LogError
from armctl.recording import channels, timeline
from armctl.recording.disk import new_file, writing
from armctl.recording.edit import first_ns
from armctl.recording.log_file import LogFile, Progress
from armctl.recording.timeline import Timeline

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
    with LogFile(path) as log:
        facts = {"source": path.name, **log.facts}
    ticks, given = cache(partial(timeline.load, path)), 0
    made = [_of_ticks(name, ticks()) if name in (TICKS, ANGLES) else _of_topic(name, path) for name in names]
    total = sum(table.count for table in made)

    def rows(table: _Table) -> Iterator[Sequence[Cell]]:
        nonlocal given
        for row in table.rows:
            if progress is not None and given % PROGRESS_ROWS == 0:
                progress(given / total)
            given += 1
            yield row

    shown = [replace(table, rows=rows(table)) for table in made]
    files = {out: shown}
    if len(names) > 1 and kind != "xlsx":
        files = {out / f"{one.name.strip('/').replace('/', '-')}.{kind}": [one] for one in shown}
        if out.exists():
            raise LogError(f"{out}: exists already; choose another name, nothing is overwritten")
        with writing(out):
            out.mkdir(parents=True)
    writers: dict[str, Callable[[BinaryIO, Sequence[_Table]], None]] = {
        "csv": _write_csv, "xlsx": _write_excel, "parquet": partial(_write_parquet, facts),
    }  # fmt: skip
    for file, tables in files.items():
        with new_file(file) as stream:
            writers[kind](stream, tables)
    return ExportResult(tuple(files), {one.name: one.count for one in made}, all(one.complete for one in made))


@dataclass(frozen=True)
class _Table:
    """`columns` in their order, with the type that holds all cells of each; `rows` have a cell for each of them."""

    name: str
    columns: dict[str, type]
    rows: Iterable[Sequence[Cell]]
    count: int
    complete: bool


def _of_ticks(name: str, seen: Timeline) -> _Table:
    times_ns = np.rint(seen.time_s * NS_PER_S).astype(np.int64) + seen.start_ns
    times = [_times(time_ns, seen.start_ns) for time_ns in times_ns.tolist()]
    cells: dict[str, Any] = {key: [row[key] for row in times] for key in times[0]}
    if name == ANGLES:  # what the paper's recorder wrote
        angles = zip(seen.arm.joint_names, np.degrees(seen.position_rad).T, strict=True)
        cells |= {f"{joint}.position_deg": column for joint, column in angles}
    else:
        cells["tick"] = seen.tick
        for key, changes in (("state", seen.states), ("fault", seen.faults)):
            since = pairwise([*changes, (len(times), "")])
            cells[key] = [what for (begin, what), (end, _) in since for _ in range(begin, end)]
        for index, joint in enumerate(seen.arm.joint_names):
            cells |= {f"{joint}.{quantity}": getattr(seen, quantity)[:, index] for quantity in _QUANTITIES}
        cells |= {f"tool.{axis}": column for axis, column in zip(_TOOL, seen.tool.T, strict=True)}
    for key, column in cells.items():
        if isinstance(column, np.ndarray):
            cells[key] = np.where(column == column, column, np.array(None)).tolist()  # NaN: not known
    first = {key: next((cell for cell in column if cell is not None), 0.0) for key, column in cells.items()}
    columns = {key: _common(None, cell) or float for key, cell in first.items()}
    return _Table(name, columns, zip(*cells.values(), strict=True), len(times), seen.complete)


def _of_topic(topic: str, path: Path) -> _Table:
    """The messages of a topic, which is read twice: for the columns, then for the cells.

    Raises:
        LogError: there are none.
    """
    zero_ns, found, count = first_ns(path), dict[str, type | None](), 0

    def read(log: LogFile) -> Iterator[Row]:
        for message in log.messages((topic,)):
            row = _times(message.log_time_ns, zero_ns)
            _flatten(row, "", log.decode(message), topic)
            yield row

    def cells() -> Iterator[Sequence[Cell]]:
        with LogFile(path) as log:
            yield from ([row.get(name) for name in found] for row in read(log))

    with LogFile(path) as log:
        for row in read(log):
            count += 1
            for name, cell in row.items():
                found[name] = _common(found.get(name), cell)
        if not count:
            known = ", ".join(sorted(log.topics)) or "none"
            raise LogError(f"{path}: holds nothing for a table of {topic}; topics: {known}")
        return _Table(topic, {name: kind or float for name, kind in found.items()}, cells(), count, log.complete)


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
        plain = value.hex() if isinstance(value, bytes) else value
        row[prefix[:-1]] = json.dumps(plain, default=bytes.hex) if isinstance(plain, list) else plain


def _by_name(parts: list[Any]) -> dict[str, Any]:
    """The members of a list by their names; nothing if one has no name, or two have the same."""
    for key in ("child_frame_id", "name", "key"):
        if all(isinstance(part, dict) and part.get(key) for part in parts):
            named = {str(part[key]): {name: value for name, value in part.items() if name != key} for part in parts}
            if len(named) == len(parts):
                # A name with a single value needs no third word.
                return {name: part.get("value", part) for name, part in named.items()}
    return {}


# ------------------------------------------------------------------------------------------------------ files


def _write_csv(stream: BinaryIO, tables: Sequence[_Table]) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text)
    for table in tables:
        rows.writerow(table.columns)
        rows.writerows([str(cell) if isinstance(cell, Seconds) else cell for cell in row] for row in table.rows)
    text.detach()


def _write_excel(stream: BinaryIO, tables: Sequence[_Table]) -> None:
    book = extra("Excel files", "openpyxl").Workbook(write_only=True)
    sheet: Any = None
    try:
        for table in tables:
            # Excel allows 31 characters, and none of []:*?/\
            name = re.sub(r"[\[\]:*?/\\]", "-", table.name.strip("/"))[:24]
            for index, row in enumerate(table.rows):
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
    return (float(cell) if math.isfinite(cell) else None) if isinstance(cell, float) else cell


def _write_parquet(facts: dict[str, str], stream: BinaryIO, tables: Sequence[_Table]) -> None:
    pyarrow, parquet = extra("Parquet files", "pyarrow"), import_module("pyarrow.parquet")
    types = {bool: pyarrow.bool_(), int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    for table in tables:
        schema = pyarrow.schema([(name, types[kind]) for name, kind in table.columns.items()], metadata=facts)
        rows = iter(table.rows)
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
