"""`armctl optimize` on files, without a daemon: both profiles, every objective, and what is refused."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from armctl.cli import jobs
from armctl.genetic.algorithm import DEFAULT, PAPER
from tests.cli.conftest import Answer, Typed

LINE = ["--from", "0.18,-0.125,0.10", "--to", "0.18,0.125,0.10"]


def test_the_default_profile_sets_genes_free_unlike_the_paper_s(
    takes: list[str], tmp_path: Path, answer: Answer
) -> None:
    ours = answer("optimize", *takes, *LINE, "--out", tmp_path / "ours.json")
    paper = answer("optimize", *takes, *LINE, "--profile", "paper", "--out", tmp_path / "paper.json")
    assert (ours["ga"]["generations"], paper["ga"]["generations"]) == (DEFAULT.generations, PAPER.generations)
    assert paper["free"] is None
    assert ours["free"]["mean_error_mm"] < 0.1 * ours["ga"]["mean_error_mm"]
    assert ours["plan"]["predicted_mean_error_mm"] < paper["plan"]["predicted_mean_error_mm"]
    assert ours["gap_ratio"] <= 0.01


def test_a_file_of_the_current_folder_is_found_as_play_finds_it(
    takes: list[str], tmp_path: Path, answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(takes[0]).parent)
    names = [Path(take).name for take in takes]
    assert answer("optimize", *names, *LINE, "--out", tmp_path / "plan.json")["plan"]["via"] == 2


def test_a_plan_that_cannot_be_written_is_told_before_the_work(
    takes: list[str], typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_optimize_here", Mock(side_effect=AssertionError))
    assert "/proc/x.json: cannot be written" in typed("optimize", *takes, *LINE, "--out", "/proc/x.json", status=1).err


@pytest.mark.parametrize("objective", ["mean", "mix", "max"])
def test_every_objective_makes_a_plan(objective: str, takes: list[str], tmp_path: Path, answer: Answer) -> None:
    found = answer("optimize", *takes, *LINE, "--objective", objective, "--via", "1", "--out", tmp_path / "plan.json")
    assert found["plan"]["via"] == 1


@pytest.mark.parametrize(
    ("changes", "code", "match"),
    [
        (["--to", "0.18,-0.125,0.10"], "BAD_LINE", "0.0 mm apart, at least 10 mm"),
        (["--to", "0.18,0.525,0.10"], "BAD_RECORDINGS", "out of reach; the nearest point within the joint limits is"),
        (["--from", "0.05,-0.20,0.10"], "BAD_RECORDINGS", "ask for the line it leads along, from"),
        (["--duration", "0.6"], "LIMITS", "s or more"),
        (["--to", "0.18,0.125,-0.10"], "BAD_REQUEST", "below the floor"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_nearest_that_can(
    changes: list[str], code: str, match: str, takes: list[str], tmp_path: Path, answer: Answer
) -> None:
    found = answer("optimize", *takes, *LINE, *changes, "--out", tmp_path / "plan.json", status=1)
    assert found["error"]["code"] == code
    assert match in found["error"]["message"]
    assert not (tmp_path / "plan.json").exists()
