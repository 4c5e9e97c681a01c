"""`armctl reach` and `armctl transfer` as they are typed; the daemon is a stand-in, the cycle runs in virtual time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from armctl import client
from armctl.cli import main

ANSWER = {
    "recording": "run-reach-1",
    "position_error_mm": 1.5,
    "position_m": [0.2, 0.05, 0.06],
    "gripped": True,
}


class Daemon:
    """Answers one method; `asked` is what it was asked."""

    asked: dict[str, Any]
    answer: dict[str, Any] = ANSWER

    def __init__(self, socket: str | None) -> None:
        assert socket is None

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        assert method == "reach"
        Daemon.asked = params
        return Daemon.answer


@pytest.fixture(autouse=True)
def daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Client", Daemon)


def test_reach_asks_for_the_point_and_answers_with_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reach", "--xyz", "0.2,0.05,0.06", "--method", "ga", "--seed", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == ANSWER
    assert Daemon.asked == {
        "point_m": (0.2, 0.05, 0.06),
        "gripper": "stay",
        "ik": "ga",
        "seed": 4,
        "off_m": 0.05,
        "along": "above",
    }


@pytest.mark.parametrize(("gripped", "status"), [(True, 0), (False, 1)])
def test_a_grip_that_found_nothing_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, gripped: bool, status: int
) -> None:
    monkeypatch.setattr(Daemon, "answer", {**ANSWER, "gripped": gripped})
    assert main(["reach", "--xyz", "0.2,0.05,0.06", "--grip"]) == status
    assert Daemon.asked["gripper"] == "grip"
    assert ("gripped: yes" if gripped else "gripped: nothing") in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["reach"],
        ["reach", "--xyz", "0.2,0.05"],
        ["reach", "--xyz", "0.2,0.05,0.06", "--grip", "--let-go"],
        ["reach", "--xyz", "0.2,0.05,0.06", "--method", "guess"],
        ["reach", "--xyz", "0.2,0.05,0.06", "--off", "0"],
        ["transfer", "--virtual", "transfer-6dof"],
        ["transfer", "--log", "x.mcap"],
        ["transfer", "--pick", "nan,0,0"],
        ["transfer", "--virtual", "no-such-arm", "--log", "x.mcap"],
    ],
)
def test_wrong_usage_is_told_with_status_2(arguments: list[str], tmp_path: Path) -> None:
    assert main(arguments) == 2


def test_a_virtual_transfer_leaves_a_log_a_page_and_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, page = tmp_path / "cycle.mcap", tmp_path / "cycle.html"
    arguments = ["transfer", "--virtual", "transfer-6dof", "--log", str(log), "--out", str(page), "--lift", "1.5"]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["figure"] for row in result["rows"]] == [f"Fig. {number}" for number in range(3, 8)]
    assert result["cycle"]["lift_s"] == 1.5
    assert (Path(result["log"]), Path(result["report"])) == (log, page)
    assert log.stat().st_size > 10_000
    assert page.stat().st_size > 100_000
    assert main(arguments) == 1  # nothing is overwritten
