"""An hour of log for tests that need one, written once."""

from functools import cache
from pathlib import Path

from armctl.recording.compact import compact
from armctl.recording.writer import LogWriter
from proving.damage import UnsyncedDisk
from proving.log_rig import repeated
from tests.recording.factory import ANCHOR, CONTEXT, make_records

TICKS = 36_000


@cache
def hour_log(folder: Path) -> Path:
    """A compacted log of an hour at 10 Hz: a minute of the control step, repeated at later times."""
    writer = LogWriter(folder / "armctl-20250615T150645Z.mcap", CONTEXT, anchor=ANCHOR, disk=UnsyncedDisk())
    for record in repeated(make_records(600), TICKS):
        writer.write_tick(record)
        if record.inputs.tick % 9 == 0:
            writer.flush()
    writer.close()
    assert compact(writer.path)
    return writer.path
