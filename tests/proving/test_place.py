"""The proof of places: a small one for real, defects that it must see, and its judgement on made-up outcomes."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.errors import RequestRefused
from armctl.messages import Mode
from armctl.trajectory.lag import nominal
from armctl.trajectory.target import MoveRequest
from proving import place
from proving.place import ROWS, Trial
from proving.served_arm import Look, ServedArm

SEED, ARM = 1, 1
FEW = ("no model",)


def silent(_line: str) -> None:
    pass


def stop(later: float = 0.7, **changes: float) -> dict[str, float]:
    """How one motion ended."""
    return {"soon_mm": 1.0, "later_mm": later, "creep_mm": 0.0, "settled_s": 0.9} | changes


def outcomes(of: Callable[[Trial, str, int], dict[str, float]], patch: pytest.MonkeyPatch, **more: Any) -> None:
    def run(trial: Trial) -> dict[str, Any]:
        stops = {name: [of(trial, name, k) for k in range(trial.targets)] for name in trial.rows}
        return {"seed": trial.seed, "stops": stops, "refused": [], "broken": []} | more

    patch.setattr(place, "run", run)


def proved(**options: Any) -> dict[str, Any]:
    return place.prove(SEED, silent, workers=1, **options)


def stops(targets: int = 2, **options: Any) -> tuple[list[dict[str, float]], list[str]]:
    """Where an arm without a model comes to stand, for real, and what is broken."""
    found: dict[str, Any] = {"refused": [], "broken": []}
    model = nominal(ServedArm(ARM).arm, ServedArm(ARM).robot.chain)
    done = place._stops(Trial(ARM, targets, FEW, **options), FEW[0], model, found)
    return done, found["broken"]


# ------------------------------------------------------------------------------------------------------ for real


def test_an_arm_comes_to_stand_within_the_bounds_and_stays() -> None:
    done, broken = stops()
    assert (len(done), broken) == (2, [])
    for one in done:
        assert one["later_mm"] <= ROWS["no model"].share_mm
        assert one["creep_mm"] <= place.CREEP_MM
        assert -1.0 < one["settled_s"] <= place.LATER_S


@pytest.mark.parametrize("plain_too", [True, False])
def test_a_fault_counts_unless_the_same_arm_latches_one_without_correction(
    plain_too: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    heavy = replace(ROWS["no model"], spec=replace(ROWS["no model"].spec, tool_kg=(0.4, 0.4)))
    monkeypatch.setitem(place.ROWS, "no model", heavy)
    if not plain_too:
        monkeypatch.setattr(place, "_is_too_weak", lambda *_: False)
    found: dict[str, Any] = {"refused": [], "broken": []}
    model = nominal(ServedArm(ARM).arm, ServedArm(ARM).robot.chain)
    place._stops(Trial(ARM, 2, FEW), FEW[0], model, found)
    assert (found.get("too_weak", 0) > 0) == plain_too
    assert bool(found["broken"]) != plain_too


def test_a_place_without_correction_is_seen() -> None:
    done, _ = stops(correction=False)
    assert min(one["later_mm"] for one in done) > 5.0


def test_a_base_that_stands_aside_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    moves = ServedArm.move

    def aside(arm: ServedArm, request: MoveRequest) -> dict[str, Any]:
        assert request.point_m is not None
        x, y, z = request.point_m
        turn = np.radians(0.8)
        point = (x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z)
        return moves(arm, MoveRequest(point_m=tuple(map(float, point))))  # type: ignore[arg-type]

    straight, _ = stops()
    monkeypatch.setattr(ServedArm, "move", aside)
    done, _ = stops()
    bound_mm = ROWS["no model"].median_mm
    assert np.median([one["later_mm"] for one in straight]) <= 1.1 * bound_mm
    assert np.median([one["later_mm"] for one in done]) > 1.5 * bound_mm


def test_another_goal_within_the_minute_is_seen_and_so_is_the_tool_that_follows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits = ServedArm.wait

    def restless(arm: ServedArm, seconds: float) -> None:
        waits(arm, 20.0)
        away = list(arm.goals_rad)
        away[0] += 0.02
        looked, began = arm.asked, arm.began
        arm.move(MoveRequest(joints_rad=tuple(away)))
        arm.asked, arm.began = looked, began
        waits(arm, seconds)

    monkeypatch.setattr(ServedArm, "wait", restless)
    monkeypatch.setattr(place, "bent", lambda _: [])
    monkeypatch.setattr(place, "ended_s", lambda looks, _: looks[0].time_s + 5.0)
    _, broken = stops(1)
    assert any("other goals" in text for text in broken)
    assert any("creeps by" in text for text in broken)


def test_goals_are_held_against_the_trajectory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(place, "MOST_DEG", 0.5)
    _, broken = stops(1)
    assert any("from its trajectory (bound 0.5)" in text for text in broken)


@pytest.mark.parametrize("seed", range(3))
def test_the_goal_of_a_joint_that_is_held_keeps_its_bound(seed: int) -> None:
    assert place.held(seed) == []


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_corrected_while_a_fault_is_latched(seed: int) -> None:
    assert place.latched(seed) == []


def test_the_model_of_another_arm_is_refused() -> None:
    on = ServedArm(ARM)
    assert place.anothers(ARM, nominal(on.arm, on.robot.chain)) == []


def test_a_model_that_is_taken_or_refused_for_another_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    on = ServedArm(ARM)
    model = nominal(on.arm, on.robot.chain)
    monkeypatch.setattr(ServedArm, "use", lambda *_: None)
    assert [text.split()[-1] for text in place.anothers(ARM, model)] == ["taken", "taken"]

    def busy(*_: Any) -> None:
        raise RequestRefused("BUSY", "not now")

    monkeypatch.setattr(ServedArm, "use", busy)
    assert [text.split()[-1] for text in place.anothers(ARM, model)] == ["BUSY", "BUSY"]


def test_both_stations_of_a_transfer_are_looked_at() -> None:
    found: dict[str, Any] = {"refused": [], "broken": []}
    done = place._transfers(Trial(ARM, 1), found)
    assert (len(done), found["broken"]) == (2, [])
    assert all(one["later_mm"] < 4.0 for one in done)


@pytest.mark.parametrize(("code", "says"), [
    ("UNREACHABLE", "refused, and within reach"),
    ("BLOCKED", "refused, and within reach"),
    ("PREFLIGHT", "targets refused, only 0 of 2 gone to"),
])  # fmt: skip
def test_an_arm_that_goes_nowhere_is_told(code: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise RequestRefused(code, "refused, and within reach")

    monkeypatch.setattr(ServedArm, "move", refuse)
    monkeypatch.setattr(place, "MOST_REFUSED", 4)
    done, broken = stops()
    assert not done
    assert any(says in text for text in broken)


# ------------------------------------------------------------------------------------------------------- made up


def test_outcomes_within_the_bounds_violate_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda *_: stop(), monkeypatch)
    result = proved(arms=2, targets=10)
    assert (result["violations"], result["runs"]) == ([], 2 * 10 * len(ROWS))
    assert [row["what"] for row in result["rows"]] == [name for name in ROWS for _ in range(2)]
    assert all(row["held"] for row in result["rows"])


@pytest.mark.parametrize("name", ROWS)
def test_every_row_has_a_median_and_a_share_that_can_be_broken(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]
    outcomes(lambda _, n, k: stop(row.median_mm + 0.01) if n == name else stop(), monkeypatch)
    [violation] = proved(arms=1, targets=20)["violations"]
    assert violation.startswith(f"{name}: median ")
    for worse, count in ((1, 0), (2, 1)):
        outcomes(lambda _, n, k: stop(9.0) if n == name and k < worse else stop(), monkeypatch)  # noqa: B023
        assert len(proved(arms=1, targets=20)["violations"]) == count


def test_what_is_seen_a_second_after_the_end_is_told_and_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda *_: stop(soon_mm=8.0), monkeypatch)
    result = proved(arms=1, targets=3, rows=FEW)
    assert result["violations"] == []
    assert result["rows"][0] | {"after_s": 1.0, "median_mm": 8.0, "bound": "told"} == result["rows"][0]


def test_what_is_broken_names_its_arm_and_a_row_without_stops_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes(lambda *_: stop(), monkeypatch, stops={"no model": []}, broken=["no model, move 0: BLOCKED latched"])
    result = proved(arms=1, targets=3, rows=FEW)
    assert "arm 1000, no model, move 0: BLOCKED latched" in result["violations"]
    assert not any(row["held"] for row in result["rows"])


@pytest.mark.parametrize("legs", [1, 3])
def test_a_trajectory_ends_when_its_last_goal_is_due(legs: int) -> None:
    on = Look(0.0, (), (), None, Mode.HOLDING, ())
    progress = [*[k / 4.0 for k in range(1, 5)] * legs, 1.0, 1.0]
    looks = [replace(on, time_s=0.1 * k, progress=one, mode=Mode.MOVING) for k, one in enumerate(progress)]
    assert place.ended_s([*looks, on], 0.1) == pytest.approx(0.1 * (4 * legs - 1) + 0.1)
