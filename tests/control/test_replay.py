"""A story with every command, on simulated servos: its log replays bit for bit, and so does each command's JSON."""

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl import json_text, messages
from armctl.config import Config
from armctl.json_text import command_from_json, to_json
from armctl.kinematics import robots
from armctl.kinematics.transform import cos_sin
from armctl.messages import Clear, Hold, Jog, Mode, Park, Pause, Resume, Run, SetRate, Teach
from armctl.recording import replay
from armctl.recording.writer import LogContext, LogWriter
from tests.control.test_loop import ARM, Rig

TURN = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "command",
    [Pause(1), Resume(2), SetRate(3, 1 / 3), Jog(4, TURN, begin=True), Jog(5, tool_m_s=(0.1 + 0.2, -0.0, 1e-300))],
)
def test_a_command_survives_json_bit_for_bit(command: messages.Command) -> None:
    assert command_from_json(to_json(command)) == command


def test_reading_commands_leaves_nothing_behind() -> None:
    text = to_json(Pause(1))
    command_from_json(text)
    known = json_text._adapter.cache_info().currsize
    for _ in range(20):
        command_from_json(text)
    assert json_text._adapter.cache_info().currsize == known


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The log of a story with every command, and its ticks."""
    rig = Rig()
    rig.ticks(3)
    rig.ticks(15, messages.TorqueOn(1))
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
    rig.ticks(8, Park(40))
    rig.ticks(5, Hold(41))
    rig.simulated.servos[2].protect(overloaded=True)
    rig.ticks(5)
    assert rig.mode() is Mode.FAULTED
    rig.ticks(3, messages.Release(42))
    rig.ticks(3, Clear(43))
    rig.ticks(4, Teach(44))
    rig.ticks(2, messages.TeachEnd(45))
    assert {code for code in rig.codes() if code.startswith("JOG")} == {"JOG_BEGIN", "JOG_END"}

    robot = robots.get(ARM.robot, ARM.lengths_m)
    path = tmp_path_factory.mktemp("story") / "story.mcap"
    writer = LogWriter(path, LogContext(ARM, robot, Config(), "/dev/robot", 0.1))
    for record in rig.records:
        writer.write_tick(record)
    writer.close()
    return path, len(rig.records)


def test_a_log_with_every_command_replays_without_a_mismatch(story: tuple[Path, int]) -> None:
    path, ticks = story
    result = replay.check(path)
    assert (result.mismatches, result.first_mismatch) == (0, "")
    assert result.ticks == ticks


def rounded_elsewhere(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function on another machine: its last bit is another."""

    def other(*arguments: Any, **options: Any) -> Any:
        result = function(*arguments, **options)
        return np.nextafter(result, np.inf) if isinstance(result, float | np.ndarray) else result

    return other


def test_a_log_replays_the_same_where_libraries_round_otherwise(
    story: tuple[Path, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sines by another C library, `sum` and `hypot` of another Python, powers by another numpy."""
    path, _ = story
    for module in (np, math):
        for name in ("cos", "sin", "tan", "hypot", "exp", "pow", "power", "atan2", "arctan2", "dist"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, rounded_elsewhere(getattr(module, name)))
    monkeypatch.setattr("builtins.sum", rounded_elsewhere(sum))
    cos_sin.cache_clear()
    result = replay.check(path)
    cos_sin.cache_clear()
    assert (result.mismatches, result.first_mismatch) == (0, "")


CHECK = """
import pathlib, sys
from armctl.recording.replay import check
result = check(pathlib.Path(sys.argv[1]))
print(result.messages, result.mismatches)
"""


def test_a_log_replays_the_same_on_a_processor_without_fused_products(story: tuple[Path, int]) -> None:
    """Where the C library is glibc for x86, which is told here that this is such a processor."""
    fewer = {**os.environ, "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"}
    checked = subprocess.run([sys.executable, "-c", CHECK, story[0]], env=fewer, capture_output=True, check=True)
    messages, mismatches = map(int, checked.stdout.split())
    assert messages > 300
    assert mismatches == 0
