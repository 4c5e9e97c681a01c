"""The proofs of straightness: small ones for real, and their judgement on made-up outcomes."""

from collections.abc import Callable
from typing import Any

import pytest

from armctl.lab.study import limits
from proving import line_trials, straightness
from proving.line_trials import Trial


def silent(_line: str) -> None:
    pass


def found(final: float = 0.6, most: float = 1.5, **changes: Any) -> dict[str, Any]:
    """What a trial tells of one number of via points."""
    return {
        "rounds_mm": [(10.0, 20.0), (0.8, 2.0), (0.6, 1.6)],
        "kept": [1, 2],
        "seen_mm": [[9.0], [0.7, 0.8], [0.5, 0.6]],
        "seen_again_mm": 0.55,
        "repeat_true_mm": [[10.0], [0.8, 0.8], [0.6, 0.6]],
        "final_mm": (final, most),
        "duration_s": 5.0,
        "tick_mm": (0.3, 0.9),
        "unseen_mm": 0.4,
        "via_speed_ratio": 0.9,
    } | changes


def outcomes(of: Callable[[Trial], dict[str, Any]], patch: pytest.MonkeyPatch) -> None:
    def run(trial: Trial) -> dict[str, Any]:
        return {"seed": trial.seed, "refused": [], "via": {str(via): of(trial) for via in trial.via}}

    patch.setattr(line_trials, "run", run)


def proved(**options: Any) -> dict[str, Any]:
    return straightness.prove(1, silent, arms=3, effect_arms=1, workers=1, **options)


def test_one_arm_and_line_keep_every_bound_and_weigh_less_without_masses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "EFFECTS", {"sag": limits.EFFECTS["sag"]})
    result = straightness.prove(1, silent, arms=1, effect_arms=1, via=(2,), rounds=2, workers=1)
    assert (result["violations"], result["runs"], result["seed"]) == ([], 2, 1)
    rows = {row["what"]: row["mean_mm"] for row in result["rows"]}
    assert rows["via 2 before median"] > 5.0 > 1.0 > rows["via 2 median"]
    (effect,) = result["effects"]
    assert effect["before_with_mm"] == rows["via 2 before median"] > 2.0 * effect["before_mm"]


def test_three_refinements_keep_every_rule() -> None:
    result = straightness.prove_refinement(1, silent, arms=3, via=("stream",), rounds=2, workers=1)
    assert (result["violations"], result["runs"]) == ([], 3)
    # Of one arm's few runs either deviation would be chance.
    assert 0.01 < result["repeat_noise_mm"] < 0.3
    assert 0.0 < result["true_repeat_noise_mm"] < 1.2 * result["repeat_noise_mm"]


def test_outcomes_within_the_bounds_violate_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda _: found(), monkeypatch)
    result = proved()
    assert result["violations"] == []
    assert result["runs"] == 3 + 3 + len(limits.EFFECTS)
    rows = {row["what"]: (row["mean_mm"], row["max_mm"]) for row in result["rows"]}
    assert rows.keys() >= straightness.BOUNDS_MM.keys()
    assert rows["via 2 before median"] == (10.0, 20.0)
    assert rows["via 2 first median"] == (0.8, 2.0)
    assert {row["without"] for row in result["effects"]} == set(limits.EFFECTS)


@pytest.mark.parametrize("what", straightness.BOUNDS_MM)
def test_every_bound_can_be_broken(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda _: found(), monkeypatch)
    monkeypatch.setitem(straightness.BOUNDS_MM, what, (9.0, 0.1))
    (violation,) = proved()["violations"]
    assert violation.startswith(f"{what}: ")


def test_one_arm_worse_than_the_worst_may_be_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda trial: found(most=4.1 if trial.seed == 1001 else 1.5), monkeypatch)
    assert [text.split(":")[0] for text in proved()["violations"]] == ["via 2 worst", "via 8 worst", "via stream worst"]


def test_a_tool_that_slows_down_at_a_via_point_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda trial: found(via_speed_ratio=0.45 if trial.seed == 1002 else 0.9), monkeypatch)
    result = proved(via=(2,))
    assert result["violations"] == ["arm 1002, via 2: at a via point 0.45 of its cruise speed"]
    assert result["least_via_speed_ratio"] == 0.45


def test_a_motion_that_takes_too_long_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda _: found(duration_s=5.3), monkeypatch)
    assert all("took 5.30 s" in violation for violation in proved()["violations"])
    assert len(proved()["violations"]) == 3 * len(straightness.VIA)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"final": 10.6}, "began at 10.00 mm"),
        ({"final": 1.2}, "round 1 had 0.80 mm"),
        ({"seen_again_mm": 1.0}, "round 2 looked like 0.55 mm"),
    ],
)
def test_every_rule_of_refinement_can_be_broken(
    changes: dict[str, Any], match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes(lambda trial: found(**changes) if trial.seed == 1501 else found(), monkeypatch)
    result = straightness.prove_refinement(1, silent, arms=3, via=(2,), workers=1)
    assert any(match in violation for violation in result["violations"])
    assert all(violation.startswith("arm 1501, via 2: ") for violation in result["violations"])


def test_how_often_truth_is_worse_than_the_first_run_is_told_beside_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda trial: found(final=0.88 if trial.seed % 2 else 0.7), monkeypatch)
    result = straightness.prove_refinement(1, silent, arms=4, via=(2,), workers=1)
    assert result["violations"] == []
    row = next(row for row in result["rows"] if "worst_ratio" in row)
    assert row["share_over_5_percent"] == row["share_better"] == 0.5
    assert row["worst_ratio"] == pytest.approx(1.1)
    assert result["repeat_noise_mm"] == pytest.approx(0.05 * 2.0**0.5)
    assert result["true_repeat_noise_mm"] == 0.0
