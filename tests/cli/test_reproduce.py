"""`armctl reproduce`: JSON keys, the page, and what wrong use gets."""

import json
import re
from pathlib import Path

import pytest

from armctl.papers import entries
from armctl.papers.entries import Entry
from tests.cli.conftest import Answer, Typed
from tests.words import missing


def test_json_holds_rows_and_errata(answer: Answer) -> None:
    found = answer("reproduce", "003", "--quick")
    assert {tuple(row) for row in found["rows"]} == {("paper", "quantity", "printed", "armctl", "unit", "verdict")}
    assert {tuple(one) for one in found["errata"]} == {("paper", "where", "printed", "true", "proof")}
    keys = ("paper", "equation", "row", "column", "printed", "true", "verdict", "place")
    assert {tuple(one) for one in found["entries"]} == {keys}
    misprints = [(one["printed"], one["true"]) for one in found["entries"] if one["verdict"] == "misprint"]
    assert misprints == [(one["printed"], one["true"]) for one in found["errata"]]
    assert {row["paper"] for row in found["rows"]} == {one["paper"] for one in found["errata"]} == {"003"}
    assert found["page"] is None


def test_page_opens_without_a_network_and_keeps_3d_charts_few(tmp_path: Path, typed: Typed) -> None:
    said = typed("reproduce", "004", "--quick", "--out", tmp_path / "new")
    assert "004: a transfer robot with six degrees of freedom" in said.out
    page = (tmp_path / "new" / "reproduce.html").read_text(encoding="utf-8")
    headings = ("004: a transfer robot", "Fig. 3: Tool position", "Fig. 7", "004, after (3), 0T6", "004, errata: 13")
    assert not missing(page, *headings, "prefers-color-scheme")
    # Tables of parameters have the columns of print; a verdict says why, also where it is told for a whole table.
    told = ("greatest speed along x, Fig. 4, maximum [mm/s]", "3 differs: print gives nothing to compute it from")
    assert not missing(page, *(f"<th>{name}</th>" for name in ("i", "a", "alpha", "d", "theta")), *told)
    assert 'src="http' not in page
    assert 0 < page.count('"type":"scatter3d"') < 16
    # The library and the charts run when they come into sight; every link of the contents has its place.
    assert page.count('<script type="text/plain" id="plotly">') == 1
    assert max(map(len, re.findall(r"<script>(.*?)</script>", page, re.DOTALL))) < 10_000
    charts = re.findall(r'<script type="application/json">(.*?)</script>', page)
    assert len(charts) == page.count('<figure role="img"') > 10
    assert all({"data", "layout"} == json.loads(chart).keys() for chart in charts)
    places = re.findall(r'href="#([\d.]+)"', page)
    assert len(places) > 20
    assert all(f'id="{place}"' in page for place in places)
    assert 'class="misprint">d_i sα_{i-1} (misprint: -d_i sin(alpha_{i-1}))' in page


def test_same_seed_same_rows(answer: Answer) -> None:
    first, second = (answer("reproduce", "003", "--quick", "--seed", "3")["rows"] for _ in range(2))
    assert first == second


def test_an_erratum_that_does_not_hold_is_1(monkeypatch: pytest.MonkeyPatch, typed: Typed) -> None:
    wrong = Entry("003", "(1)", 1, 1, "a", "b", "misprint", "line 1", "nothing", (0.0, 0.0))
    monkeypatch.setattr(entries, "entries", lambda _papers: [wrong])
    assert "1 errata, 0 of them proven" in typed("reproduce", "003", "--quick", status=1).out
