"""`reach`, `transfer` and `run --refine` as typed; the daemon is a stand-in, the cycle runs in virtual time."""

from pathlib import Path
from typing import Any

import pytest

from armctl import client
from armctl.trajectory.plan import plan_to_text
from tests.cli.conftest import Answer, StandIn, Typed
from tests.trajectory.test_plan import make_plan

ANSWER = {"recording": "run-reach-1", "position_error_mm": 1.5, "position_m": [0.2, 0.05, 0.06], "gripped": True}
REACH = ("reach", "--xyz", "0.2,0.05,0.06")


class Daemon(StandIn):
    """Answers one method; `asked` is what it was asked."""

    asked: dict[str, Any]
    answer: dict[str, Any] = ANSWER

    def __init__(self, socket: str | None) -> None:
        assert socket is None

    def call(self, method: str, *, on_progress: object = None, **params: Any) -> dict[str, Any]:
        assert method == "reach"
        Daemon.asked = params
        return Daemon.answer


@pytest.fixture(autouse=True)
def daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Client", Daemon)


def test_reach_asks_for_the_point_and_answers_with_one_object(answer: Answer) -> None:
    assert answer(*REACH, "--method", "ga", "--seed", "4") == ANSWER
    how = {"gripper": "stay", "ik": "ga", "seed": 4, "off_m": 0.05, "along": "above"}
    assert Daemon.asked == {"point_m": (0.2, 0.05, 0.06), **how}


@pytest.mark.parametrize(("gripped", "status"), [(True, 0), (False, 1)])
def test_a_grip_of_nothing_fails(typed: Typed, monkeypatch: pytest.MonkeyPatch, gripped: bool, status: int) -> None:
    monkeypatch.setattr(Daemon, "answer", {**ANSWER, "gripped": gripped})
    said = typed(*REACH, "--grip", status=status)
    assert Daemon.asked["gripper"] == "grip"
    assert ("gripped: yes" if gripped else "gripped: nothing") in said.out


def test_a_virtual_transfer_leaves_a_log_a_page_and_a_table(tmp_path: Path, typed: Typed, answer: Answer) -> None:
    log, page = tmp_path / "cycle.mcap", tmp_path / "cycle.html"
    command = ("transfer", "--virtual", "transfer-6dof", "--log", log, "--out", page, "--lift", "1.5")
    result = answer(*command)
    assert [row["figure"] for row in result["rows"]] == [f"Fig. {number}" for number in range(3, 8)]
    assert (result["cycle"]["lift_s"], Path(result["log"]), Path(result["report"])) == (1.5, log, page)
    assert log.stat().st_size > 10_000
    assert page.stat().st_size > 100_000
    typed(*command, status=1)  # nothing is overwritten


class Refining(StandIn):
    """Tells a refinement run by run."""

    plan: str | None = "/best.json"

    def __init__(self, socket: str | None) -> None:
        assert socket is None

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        assert (method, params["refine"]) == ("run" if self.plan else "path", 2)
        errors = {"mean_error_mm": 1.234, "max_error_mm": 3.456}
        rounds = [{"round": number, **errors, "kept": number == 0} for number in range(2)]
        params["on_progress"]({"runs": 1, "of": 3, "round": rounds[0]})
        done = {
            **errors,
            "recording": "run-1",
            "duration_s": 5.0,
            "ended": None,
            "rounds": rounds,
            "plan": self.plan,
        }
        ways = ("predicted", "path")
        return done | {f"{way}_{key}": 0.1 for way in ways for key in errors}


def test_a_refinement_is_told_in_words_that_need_no_manual(
    typed: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "Client", Refining)
    (tmp_path / "plan.json").write_text(plan_to_text(make_plan()), encoding="utf-8")
    said = typed("run", str(tmp_path / "plan.json"), "--refine", "2")
    assert "after 1 of at most 3 runs, as it was: 1.23 mm mean and 3.46 mm at most off the wanted line" in said.err
    assert (
        "correction 1: 1.23 mm mean and 3.46 mm at most off the wanted line, not better by more than noise" in said.out
    )
    assert "the best one: armctl run /best.json\n" in said.out


def test_a_path_that_no_correction_made_better_is_said_to_have_no_new_file(
    typed: Typed, answer: Answer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "Client", Refining)
    monkeypatch.setattr(Refining, "plan", None)
    (tmp_path / "path.csv").write_text("x_m,y_m,z_m\n0.18,0,0.1\n0.2,0,0.1\n", encoding="utf-8")
    command = ("path", str(tmp_path / "path.csv"), "--refine", "2")
    said = typed(*command).out
    assert "no correction was kept: no file is written" in said.splitlines()
    assert "best one" not in said
    assert answer(*command)["plan"] is None
