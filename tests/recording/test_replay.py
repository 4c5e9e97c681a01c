"""What replay knows beyond one file: clocks of merged files, and a comparison that goes on message by message."""

from __future__ import annotations

from pathlib import Path

import pytest

from armctl.errors import LogError
from armctl.recording import replay
from armctl.recording.channels import Anchor
from armctl.recording.reader import LogFile
from armctl.recording.replay import LogSetup, Rerun, log_setup
from tests.recording.factory import ANCHOR, ARM, PERIOD_S, ROBOT, make_records
from tests.recording.simulated import write_log

RECORDS = make_records(40, keyframe_ticks=15)


def test_a_tick_goes_by_the_anchor_its_log_time_is_of() -> None:
    later = Anchor(ANCHOR.wall_ns + 777, ANCHOR.monotonic_ns)
    setup = LogSetup(ARM, ROBOT, PERIOD_S, ANCHOR, (later,))
    time_ns = ANCHOR.monotonic_ns + 10**9
    assert setup.anchor_of(time_ns, ANCHOR.epoch_ns(time_ns)) == ANCHOR
    assert setup.anchor_of(time_ns, later.epoch_ns(time_ns)) == later
    assert setup.anchor_of(time_ns, 12345) == ANCHOR  # of none: compared with the first, and found to differ


def test_the_state_is_known_after_every_tick_from_the_first_keyframe_on(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", RECORDS)
    known = []
    with LogFile(path) as log:
        rerun = Rerun(log, log_setup(log))
        for message in log.messages():
            rerun.take(message)
            if message.topic == "/armctl/cycle":
                known.append(rerun.state is not None)
    assert known == [False] + [True] * 39
    assert (rerun.ticks, rerun.mismatches, rerun.keyframes) == (39, 0, 3)


def test_anchors_that_cannot_be_read_are_an_error_of_the_log(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", RECORDS)
    with LogFile(path) as log:
        log.metadata[replay.MERGED] = {"anchors": "1/2/3 x"}
        with pytest.raises(LogError):
            log_setup(log)
