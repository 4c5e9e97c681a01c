"""`armctl reproduce`: JSON keys, the page, and what wrong use gets."""

from pathlib import Path

import pytest

from armctl.kinematics.errata import Erratum
from armctl.papers import errata
from tests.cli.conftest import Answer, Typed
from tests.words import missing


def test_json_holds_rows_and_errata(answer: Answer) -> None:
    found = answer("reproduce", "003", "--quick")
    assert {tuple(row) for row in found["rows"]} == {("paper", "quantity", "printed", "armctl", "unit", "verdict")}
    assert {tuple(one) for one in found["errata"]} == {("paper", "where", "printed", "true", "proof")}
    assert {row["paper"] for row in found["rows"]} == {one["paper"] for one in found["errata"]} == {"003"}
    assert found["page"] is None


def test_page_opens_without_a_network_and_keeps_3d_charts_few(tmp_path: Path, typed: Typed) -> None:
    said = typed("reproduce", "004", "--quick", "--out", tmp_path / "new")
    assert "004: a transfer robot with six degrees of freedom" in said.out
    page = (tmp_path / "new" / "reproduce.html").read_text(encoding="utf-8")
    headings = ("004: a transfer robot", "Fig. 3: Tool position", "Fig. 7", "initial position, x", "Errata")
    assert not missing(page, *headings, "prefers-color-scheme")
    assert 'src="http' not in page
    assert page.count('"type":"scatter3d"') < 16


def test_same_seed_same_rows(answer: Answer) -> None:
    first, second = (answer("reproduce", "003", "--quick", "--seed", "3")["rows"] for _ in range(2))
    assert first == second


def test_an_erratum_that_does_not_hold_is_1(monkeypatch: pytest.MonkeyPatch, typed: Typed) -> None:
    wrong = Erratum("003", "somewhere", "a", "b", "nothing", lambda: (0.0, 0.0))
    monkeypatch.setattr(errata, "errata", lambda _papers: [wrong])
    assert "1 errata, 0 of them proven" in typed("reproduce", "003", "--quick", status=1).out
