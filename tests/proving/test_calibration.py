"""The proof of calibration: one arm for real, and its judgement on made-up outcomes."""

from typing import Any

import pytest

from proving import calibration


def outcome(geometry: str, **changes: Any) -> dict[str, Any]:
    """What was found of one arm, as it should be."""
    found = {"seed": 1, "geometry": geometry, "refused": "", "said_before_mm": 3.0, "said_mm": 1.0, "held_out_mm": 1.1}
    if geometry == calibration.DRAWS:
        for key in ("first", "refined", "perfect_first", "perfect_refined"):
            found |= {f"{key}_mm": [1.0, 2.5], f"{key}_chord_mm": 0.7}
    return found | {"fit_mm": 0.5, "moved_before_mm": 3.1, "moved_mm": 1.2} | changes


def test_what_is_right_breaks_nothing() -> None:
    rows, violations = calibration.judged([outcome(way) for way in calibration.BOUNDS_MM])
    assert violations == []
    assert [row["geometry"] for row in rows] == ["careful", "typical", "poor", "typical"]


@pytest.mark.parametrize(
    ("way", "changes", "text"),
    [
        ("careful", {"said_mm": 1.2}, "careful: the tool is 1.2 mm from where it is said to be, bound 1.1"),
        ("poor", {"refused": "NO_BETTER: why"}, "poor, arm 1: NO_BETTER: why"),
        ("typical", {"refined_mm": [1.7, 3.0]}, "typical: lines are [1.7, 3.0] mm from AB"),
        ("typical", {"refined_mm": [1.5, 3.7]}, "typical: lines are [1.5, 3.7] mm from AB"),
        ("typical", {"refined_chord_mm": 0.9}, "typical: 1.29 times as far from straight"),
    ],
)
def test_what_is_wrong_is_told(way: str, changes: dict[str, Any], text: str) -> None:
    done = [outcome(one, **(changes if one == way else {})) for one in calibration.BOUNDS_MM]
    assert [one for one in calibration.judged(done)[1] if one.startswith(text)]


def test_a_poor_arm_is_where_it_is_said_to_be_after_its_calibration() -> None:
    found = calibration.run(calibration.Trial(3, "poor"))
    assert found["refused"] == ""
    assert found["said_mm"] < 0.5 * found["said_before_mm"]
    assert found["moved_mm"] < 0.5 * found["moved_before_mm"]
