"""The proof of lines: a small one for real, defects that it must see, and its judgement on made-up outcomes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armctl.errors import RequestRefused
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import Measured
from proving import lines
from proving.lines import FIRST, FIRST_OF_ALL, REFINED, Trial
from proving.served_arm import ServedArm, identified
from proving.truth import CLASSES

SEED, ARM = 1, 1000


def silent(_line: str) -> None:
    pass


def found(mean: float = 0.5, most: float = 1.5, **changes: Any) -> dict[str, Any]:
    """What a trial tells of one run."""
    told = {"mean_mm": mean, "max_mm": most, "chord_mm": 0.4, "covered": 1.0, "late": 0.0, "unseen_mm": 0.4}
    return told | changes


def outcomes(of: Callable[[Trial, str, str], dict[str, Any]], patch: pytest.MonkeyPatch, **more: Any) -> None:
    def run(trial: Trial) -> dict[str, Any]:
        told = [
            {
                "class": kind,
                "runs": {name: of(trial, kind, name) for name in ("first", *map(str, trial.via))},
                "broken": [],
                "beyond": 3,
                "refused": ["TOO_HEAVY"],
            }
            | more
            for kind in trial.classes
        ]
        return {"seed": trial.seed, "lines": told}

    patch.setattr(lines, "run", run)


def proved(**options: Any) -> dict[str, Any]:
    return lines.prove(SEED, silent, workers=1, **options)


def first_run(kind: str = "vertical", **options: Any) -> dict[str, Any]:
    """The first run of one arm and line, for real."""
    return proved(arms=1, classes=(kind,), via=(), **options)


# ------------------------------------------------------------------------------------------------------ for real


def test_one_line_keeps_its_bounds() -> None:
    result = first_run()
    assert (result["violations"], result["runs"], result["seed"]) == ([], 1, SEED)
    everything, row = result["rows"]
    assert (everything["class"], row["class"], row["n"], row["run"], row["lines"]) == ("all", "vertical", 2, "first", 1)
    assert row["chord_mm"] > 0.05
    assert 0.05 < row["unseen_mm"] < 1.0


def test_a_line_without_correction_is_seen() -> None:
    result = first_run(correction=False)
    assert any(text.startswith("vertical, first, n=2: ") for text in result["violations"])
    assert float(result["rows"][1]["median_mm"].split("/")[0]) > 5.0


def test_a_base_that_stands_aside_is_seen_on_a_line_that_does_not_turn_it(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = ServedArm.run

    def aside(arm: ServedArm, plan: Plan, *, corrected: bool = True) -> Measured:
        off = np.array(plan.waypoints_rad) + np.eye(len(arm.arm.joints))[0] * np.radians(0.8)
        return runs(
            arm, plan.model_copy(update={"waypoints_rad": tuple(map(tuple, off.tolist()))}), corrected=corrected
        )

    identified(ARM)
    monkeypatch.setattr(ServedArm, "run", aside)
    result = first_run()
    assert any(text.startswith("vertical, first, n=2: ") for text in result["violations"])


def test_a_line_that_is_refused_is_drawn_again_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = ["TOO_HEAVY", "LINE"]
    plain = lines.first

    def choosy(*told: Any) -> None:
        if codes:
            raise RequestRefused(codes.pop(), "not this one")
        plain(*told)

    monkeypatch.setattr(lines, "first", choosy)
    [again] = first_run()["drawn_again"]
    assert again["refused"] == {"LINE": 1, "TOO_HEAVY": 1}
    assert 0.0 < again["share"] < 1.0


def test_a_motion_that_ends_by_a_fault_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    def ends(*_: Any) -> None:
        raise RequestRefused("BLOCKED", "servo 2 (shoulder) does not follow")

    monkeypatch.setattr(lines, "first", ends)
    result = first_run()
    assert any(f"arm {ARM}, vertical: " in text and "does not follow" in text for text in result["violations"])


# ------------------------------------------------------------------------------------------------------- made up


def test_outcomes_within_the_bounds_violate_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda *_: found(), monkeypatch)
    result = proved(arms=3)
    assert result["violations"] == []
    assert result["runs"] == 3 * 5 * 5
    assert len(result["rows"]) == 1 + 5 * 5
    assert all(row["held"] for row in result["rows"])
    assert result["drawn_again"][0] == {"class": "turning", "share": 0.8, "beyond": 9, "refused": {"TOO_HEAVY": 3}}


@pytest.mark.parametrize("kind", CLASSES)
@pytest.mark.parametrize("name", ["first", *map(str, lines.VIA)])
def test_every_median_counts_in_every_class(kind: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda _, c, n: found(1.3 if (c, n) == (kind, name) else 0.5), monkeypatch)
    [violation] = proved(arms=3)["violations"]
    assert violation.startswith(
        f"{kind}, {'first, n=2' if name == 'first' else f'refined, n={name}'}: median 1.30/1.50"
    )


def test_one_run_beyond_the_worst_that_may_be_is_told_where_there_is_such_a_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    outcomes(lambda trial, *_: found(most=4.5 if trial.seed == 1001 else 1.5), monkeypatch)
    told = [text.split(":")[0] for text in proved(arms=3, classes=("radial",))["violations"]]
    assert told == ["radial, refined, n=2", "radial, refined, n=stream"]


def test_one_first_run_in_twenty_may_be_worse_and_two_may_not(monkeypatch: pytest.MonkeyPatch) -> None:
    for worse, count in ((1, 0), (2, 1)):
        outcomes(lambda trial, *_: found(most=4.8 if trial.seed < 1000 + worse else 1.5), monkeypatch)  # noqa: B023
        assert len(proved(arms=20, classes=("radial",), via=())["violations"]) == count


@pytest.mark.parametrize(
    ("changes", "match"),
    [({"covered": 0.8}, "covers 0.80 of the line"), ({"late": 0.1}, "took"), ({"late": -0.1}, "took")],
)
def test_a_run_that_is_another_motion_is_told_however_straight(
    changes: dict[str, Any], match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes(lambda trial, _, n: found(**(changes if (trial.seed, n) == (1002, "8") else {})), monkeypatch)
    [violation] = proved(arms=3, classes=("slanted",))["violations"]
    assert violation.startswith("arm 1002, slanted, 8: ")
    assert match in violation


def test_a_class_without_any_line_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda *_: found(), monkeypatch, runs={}, broken=["no line is let through"])
    result = proved(arms=1, classes=("radial",))
    assert "arm 1000, radial: no line is let through" in result["violations"]
    assert not any(row["held"] for row in result["rows"])


def test_bounds_are_told_beside_the_figures() -> None:
    assert str(REFINED[2]) == "median 0.9/2.4, worst 1.6/4.2"
    assert (str(FIRST), str(FIRST_OF_ALL)) == ("median 1.2/2.8", "95 % 2/4.7")
