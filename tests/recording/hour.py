"""An hour of log for tests that need one, written once."""

from functools import cache
from pathlib import Path

from armctl.recording.compact import compact
from proving.log_rig import repeated
from tests.recording.factory import make_records
from tests.recording.logs import write

TICKS = 36_000


@cache
def hour_log(folder: Path) -> Path:
    """A compacted log of an hour at 10 Hz: a minute of the control step, repeated at later times."""
    path = write(folder / "armctl-20250615T150645Z.mcap", repeated(make_records(600), TICKS), flush_ticks=9)
    assert compact(path)
    return path
