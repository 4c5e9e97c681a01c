"""`armctl reproduce`: JSON keys, the page, and what wrong use gets."""

import json
from pathlib import Path

import pytest

from armctl.cli import main
from armctl.kinematics.errata import Erratum
from armctl.papers import errata


def test_json_holds_rows_and_errata(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "003", "--quick", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {tuple(row) for row in found["rows"]} == {("paper", "quantity", "printed", "armctl", "unit", "verdict")}
    assert {tuple(one) for one in found["errata"]} == {("paper", "where", "printed", "true", "proof")}
    assert {row["paper"] for row in found["rows"]} == {one["paper"] for one in found["errata"]} == {"003"}
    assert found["page"] is None


def test_page_opens_without_a_network_and_keeps_3d_charts_few(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reproduce", "004", "--quick", "--out", str(tmp_path / "new")]) == 0
    assert "004: a transfer robot with six degrees of freedom" in capsys.readouterr().out
    page = (tmp_path / "new" / "reproduce.html").read_text(encoding="utf-8")
    for words in (
        "004: a transfer robot",
        "Fig. 3: Tool position",
        "Fig. 7",
        "initial position, x",
        "Errata",
        "prefers-color-scheme",
    ):
        assert words in page
    assert 'src="http' not in page
    assert page.count('"type":"scatter3d"') < 16


def test_same_seed_same_rows(capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    for _ in range(2):
        assert main(["reproduce", "003", "--quick", "--seed", "3", "--json"]) == 0
        rows.append(json.loads(capsys.readouterr().out)["rows"])
    assert rows[0] == rows[1]


def test_an_erratum_that_does_not_hold_is_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = Erratum("003", "somewhere", "a", "b", "nothing", lambda: (0.0, 0.0))
    monkeypatch.setattr(errata, "errata", lambda _papers: [wrong])
    assert main(["reproduce", "003", "--quick"]) == 1
    assert "1 errata, 0 of them proven" in capsys.readouterr().out


def test_unknown_paper_is_2_and_the_message_lists_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "005"]) == 2
    assert "'000', '001', '002', '003', '004', 'all'" in capsys.readouterr().err
