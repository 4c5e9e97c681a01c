"""A daemon beside a resting arm: what it shows, and what its log holds when it has ended."""

from itertools import pairwise

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from armctl.clock import NS_PER_S
from armctl.recording import reader, replay
from armctl.recording.channels import CYCLE
from tests.scenarios.bench import ARM, bench, simulator

pytestmark = pytest.mark.pty

TICKS = 25


def test_resting_arm_is_shown_fresh_and_every_tick_stands_in_the_log() -> None:
    with simulator() as arm, bench(arm.port) as b:
        daemon = b.start_daemon()
        begin = b.until(lambda snapshot: snapshot["state"] not in ("starting", "restarting"))
        for snapshot in (begin, b.until(lambda snapshot: snapshot["tick"] >= begin["tick"] + TICKS)):
            assert snapshot["state"] == "off"
            assert snapshot["fault"] is None
            assert [joint["name"] for joint in snapshot["joints"]] == list(ARM.joint_names)
            assert all(joint["age_s"] < 0.2 for joint in snapshot["joints"])
        assert daemon.end() == 0

        (log,) = b.logs.iterdir()
        info = reader.info(log)
        cycles = [message.value for message in reader.read(log, (CYCLE,))]
        assert info.complete
        assert [cycle["tick"] for cycle in cycles] == list(range(len(cycles)))
        assert len(cycles) > TICKS
        # A tick more than 50 ms late leaves one out of the grid; a busy machine may do that once.
        gaps_s = [(after["time_ns"] - before["time_ns"]) / NS_PER_S for before, after in pairwise(cycles)]
        assert sum(gaps_s) / len(gaps_s) == pytest.approx(0.1, abs=0.006)

        with AnyReader([log]) as bag:
            decoded = [bag.deserialize(data, connection.msgtype) for connection, _, data in bag.messages()]
        assert len(decoded) == info.messages
        with log.open("rb") as stream:
            assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == info.messages
        result = replay.check(log)
        assert (result.ticks, result.mismatches) == (len(cycles), 0)
