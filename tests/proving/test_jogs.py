"""The proof of jogs: a small one for real, defects that it must see, and its judgement on made-up outcomes."""

from typing import Any

import numpy as np
import pytest

from armctl.trajectory.lag import nominal
from proving import jogs
from proving.jogs import Trial
from proving.served_arm import ServedArm
from proving.truth import FloatArray

ARM, FEW = 3, ("no model",)


def silent(_line: str) -> None:
    pass


def led(targets: int) -> tuple[list[dict[str, float]], dict[str, Any]]:
    """How far aside an arm without a model is led, for real, and what else is found."""
    found: dict[str, Any] = {"broken": [], "told": 0}
    model = nominal(ServedArm(ARM).arm, ServedArm(ARM).robot.chain)
    return jogs.ways(Trial(ARM, targets, FEW), FEW[0], model, found), found


def test_a_tool_is_led_straight_out_and_back() -> None:
    ways, found = led(3)
    assert [way["back"] for way in ways] == [0.0, 1.0] * 3
    assert found["broken"] == []
    assert max(way["aside_mm"] for way in ways) <= jogs.ROWS[FEW[0]][1]
    assert sum(way["along_mm"] > 50.0 for way in ways) >= 4


def test_a_tool_that_is_left_standing_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def stands(arm: ServedArm, _tool_m_s: FloatArray, _seconds: float) -> str:
        arm.path_m = np.array([arm.tool_m, arm.tool_m])
        return ""

    monkeypatch.setattr(ServedArm, "jog", stands)
    _, found = led(1)
    assert [text.partition(": ")[2].partition(" of ")[0] for text in found["broken"]] == ["it goes 0.0 mm"] * 2


def test_a_tool_that_slides_aside_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def slides(arm: ServedArm, tool_m_s: FloatArray, seconds: float) -> str:
        way = tool_m_s / np.linalg.norm(tool_m_s)
        across = np.cross(way, np.roll(way, 1) + 0.1)
        arm.path_m = np.array([arm.tool_m, arm.tool_m + tool_m_s * seconds + 0.03 * across / np.linalg.norm(across)])
        return ""

    monkeypatch.setattr(ServedArm, "jog", slides)
    ways, _ = led(1)
    assert [way["aside_mm"] for way in ways] == pytest.approx([30.0, 30.0])


@pytest.mark.parametrize(
    ("aside_mm", "held"), [([5.0] * 20, True), ([7.0] * 20, False), ([5.0] * 18 + [13.0] * 2, False)]
)
def test_medians_and_what_is_seldom_worse_are_judged(
    aside_mm: list[float], held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways = [{"aside_mm": aside, "along_mm": 100.0, "back": float(k % 2)} for k, aside in enumerate(aside_mm)]
    done = {"seed": 1000, "ways": {FEW[0]: ways}, "broken": [], "told": 3}
    monkeypatch.setattr(jogs, "run", lambda _trial: done)
    result = jogs.prove(1, silent, arms=1, targets=10, rows=FEW, workers=1)
    assert bool(result["violations"]) != held
    assert (result["runs"], result["told"]) == (20, 3)


def test_what_is_broken_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = [{"aside_mm": 1.0, "along_mm": 100.0, "back": 0.0}, {"aside_mm": 1.0, "along_mm": 100.0, "back": 1.0}]
    done = {"seed": 1000, "ways": {FEW[0]: ways}, "broken": ["no model, jog 0 out: LOST_TORQUE latched"], "told": 0}
    monkeypatch.setattr(jogs, "run", lambda _trial: done)
    result = jogs.prove(1, silent, arms=1, targets=1, rows=FEW, workers=1)
    assert result["violations"] == ["arm 1000, no model, jog 0 out: LOST_TORQUE latched"]
