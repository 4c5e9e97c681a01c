"""The picture of a snapshot that `armctl status` and `armctl watch` show."""

import io
import math
from typing import Any

from armctl.cli.arm import BAR, _line, _place, picture
from armctl.cli.screen import Screen
from tests.cli.test_tables import LONGEST_NAME, assert_whole
from tests.words import missing


def _snapshot(**changes: Any) -> dict[str, Any]:
    joint = {
        "name": "base", "servo_id": 1, "limits_rad": (-1.5, 1.5), "position_rad": 0.5, "velocity_rad_s": 0.0,
        "load_ratio": -0.2, "voltage_V": 12.0, "temperature_degC": 31.0, "torque_enabled": True, "age_s": 0.04,
    }  # fmt: skip
    silent = dict.fromkeys(joint) | {"name": "shoulder", "servo_id": 2, "limits_rad": (-1.5, 1.5)}
    return {
        "arm_id": "arm", "tick": 7, "period_s": 0.1, "state": "holding", "fault": None, "faults": [], "notice": None,
        "joints": [joint, silent],
        "tool": {"position_m": [0.18, 0.0, 0.1], "rpy_rad": [0.0, 0.0, 0.0], "speed_m_s": 0.3},
        "tool_speed_limit_m_s": 0.25, "progress": None, "rate": None, "recording": None,
        "log": {"path": "x", "problem": "", "dropped": 0}, **changes,
    }  # fmt: skip


FAULT = {
    "code": "BLOCKED", "servo_id": 1, "since_s": 3.2, "arm": "still", "next": "free it", "text": "stuck",
    "follows": None,
}  # fmt: skip
HOT = {**FAULT, "code": "HOT", "next": "let it cool", "text": "66 degC", "follows": "BLOCKED"}


def _text(snapshot: dict[str, Any]) -> str:
    return "\n".join(picture(snapshot, Screen(file=io.StringIO(), columns=80)))


def test_the_picture_shows_the_tool_s_speed_and_warns_a_teaching_hand_only() -> None:
    assert "180.0, 0.0, 100.0 mm, 300 mm/s" in _text(_snapshot())
    assert "below 250" not in _text(_snapshot())
    assert "below 250" in _text(_snapshot(state="teaching"))


def test_the_picture_shows_how_far_a_run_is_and_whether_it_is_paused() -> None:
    assert "40% of the way, rate 0.5" in _text(_snapshot(progress=0.4, rate=0.5))
    assert "40% of the way, paused" in _text(_snapshot(progress=0.4, rate=0.0))


def test_the_picture_of_a_snapshot_shows_the_fault_card() -> None:
    text = _text(_snapshot(fault=HOT, faults=[HOT, FAULT], recording="line-1", tool=None))
    faults = ("BLOCKED", "follows from BLOCKED", "next: let it cool", "next: free it")
    assert not missing(text, "28.6", "never", *faults, "recording line-1", "unknown")


def test_a_joint_is_shown_between_its_limits_and_by_another_mark_beyond_them() -> None:
    """A parked arm rests near them."""

    def place(position_rad: float) -> str:
        return _place({"position_rad": position_rad, "limits_rad": (-1.0, 1.0)})

    assert (place(-1.2), place(-1.0)) == ("!" + "╌" * (BAR - 1), "●" + "╌" * (BAR - 1))
    assert place(0.0).index("●") == BAR // 2
    assert (place(1.0), place(1.2)) == ("╌" * (BAR - 1) + "●", "╌" * (BAR - 1) + "!")


def test_the_longest_picture_fits_80_columns() -> None:
    [joint, silent] = _snapshot()["joints"]
    wide = {**joint, "name": LONGEST_NAME, "servo_id": 253, "position_rad": -2.6, "velocity_rad_s": -11.9}
    wide |= {"load_ratio": -1.0, "temperature_degC": 100.0, "age_s": 1234.56, "limits_rad": (-math.pi, math.pi)}
    tool = {"position_m": [-0.123, -0.234, -0.345], "speed_m_s": 1.234}
    log = {"problem": "no space left on the disk that holds the logs; recording goes on when there is some"}
    faults = [{**FAULT, "code": "EEPROM_MISMATCH", "text": "servo 253: " + "a sentence of many words " * 5}]
    moving = _snapshot(state="energising", joints=[wide] * 6 + [silent], tool=tool, progress=1.0, rate=0.5)
    shown = {**moving, "arm_id": LONGEST_NAME, "recording": LONGEST_NAME, "log": log, "fault": FAULT, "faults": faults}
    text = assert_whole(lambda output: output.console.print(*picture(shown, output.console)))
    assert text.count("-149.0") == 6
    assert not missing(text, "●╌", "EEPROM_MISMATCH")


def test_a_snapshot_in_one_line_tells_state_place_heat_and_fault() -> None:
    told = _line(_snapshot(fault=FAULT, faults=[FAULT], progress=0.4, rate=0.0))
    words = ("tick 7; holding", "180.0, 0.0, 100.0 mm", "31 degC (base)", "12.0 V", "40%", "next: free it")
    assert not missing(told, *words)
    nothing = dict.fromkeys(_snapshot()["joints"][0])
    assert _line(_snapshot(joints=[nothing], tool=None)) == "tick 7; holding; tool unknown"
