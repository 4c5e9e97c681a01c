"""A story with every command, on simulated servos: its log replays bit for bit, and so does each command's JSON."""

from __future__ import annotations

from pathlib import Path

import pytest

from armctl import messages
from armctl.config import Config
from armctl.kinematics import robots
from armctl.messages import (
    Clear,
    Command,
    Hold,
    Jog,
    Mode,
    Park,
    Pause,
    Release,
    Resume,
    Run,
    SetRate,
    Teach,
    TeachEnd,
    TorqueOn,
    command_from_json,
    to_json,
)
from armctl.recording import replay
from armctl.recording.writer import LogContext, LogWriter
from tests.control.test_loop import ARM, Rig

TURN = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "command",
    [Pause(1), Resume(2), SetRate(3, 1 / 3), Jog(4, TURN, begin=True), Jog(5, tool_m_s=(0.1 + 0.2, -0.0, 1e-300))],
)
def test_a_command_survives_json_bit_for_bit(command: Command) -> None:
    assert command_from_json(to_json(command)) == command


def test_reading_commands_leaves_nothing_behind() -> None:
    text = to_json(Pause(1))
    command_from_json(text)
    known = messages._adapter.cache_info().currsize
    for _ in range(20):
        command_from_json(text)
    assert messages._adapter.cache_info().currsize == known


def test_a_log_with_every_command_replays_without_a_mismatch(tmp_path: Path) -> None:
    rig = Rig()
    rig.ticks(3)
    rig.ticks(15, TorqueOn(1))
    rig.ticks(8, Run(2, rig.line()))
    for command, ticks in ((Pause(3), 6), (SetRate(4, 0.5), 2), (Resume(5), 8), (Hold(6), 5)):
        rig.ticks(ticks, command)
    for tick in range(8):
        rig.ticks(1, Jog(10 + tick, TURN, begin=tick == 0))
    for tick in range(8):
        rig.ticks(1, Jog(20 + tick, tool_m_s=(0.0, 0.0, 0.05), begin=tick == 0) if tick else Hold(19))
    rig.ticks(2, Jog(30, tool_m_s=(0.0, 0.0, 0.05), begin=True), Pause(31))
    rig.ticks(8)
    assert rig.mode() is Mode.HOLDING
    rig.ticks(3, Park(40))
    rig.ticks(5, Hold(41))
    rig.simulated.servos[2].protect(overloaded=True)
    rig.ticks(5)
    assert rig.mode() is Mode.FAULTED
    rig.ticks(3, Release(42))
    rig.ticks(3, Clear(43))
    rig.ticks(4, Teach(44))
    rig.ticks(2, TeachEnd(45))
    assert {code for code in rig.codes() if code.startswith("JOG")} == {"JOG_BEGIN", "JOG_END"}

    robot = robots.get(ARM.robot, ARM.lengths_m)
    path = tmp_path / "story.mcap"
    writer = LogWriter(path, LogContext(ARM, robot, Config(), "/dev/robot", 0.1))
    for record in rig.records:
        writer.write_tick(record)
    writer.close()
    result = replay.check(path)
    assert (result.mismatches, result.first_mismatch) == (0, "")
    assert result.ticks == len(rig.records) - 1
