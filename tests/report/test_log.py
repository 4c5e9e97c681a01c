"""The page about one log: complete in itself, true to the log, readable in light and dark."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from armctl.errors import LogError
from armctl.recording import timeline
from armctl.recording.timeline import Happening, Timeline
from armctl.report import log as page
from armctl.report.log import thinned, write
from tests.recording.factory import make_records
from tests.recording.logs import write as write_log
from tests.words import missing

RECORDS = make_records(60, seed=3)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Timeline:
    return timeline.load(write_log(tmp_path_factory.mktemp("log") / "a.mcap", RECORDS))


def text(log: Timeline, folder: Path, **checked: Any) -> str:
    write(log, folder / "log.html", checked or None)
    return (folder / "log.html").read_text()


def without_plotly(html: str) -> str:
    """The page without the library in it."""
    scripts = re.findall(r"<script.*?</script>", html, re.DOTALL)
    return html.replace(max(scripts, key=len), "")


def test_the_page_is_complete_in_itself(log: Timeline, tmp_path: Path) -> None:
    html = text(log, tmp_path)
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=", html)
    assert "prefers-color-scheme: dark" in html
    assert html.count('<figure role="img"') == 8


def test_without_a_run_there_is_no_straightness(log: Timeline, tmp_path: Path) -> None:
    assert "Straightness" in text(log, tmp_path)
    (tmp_path / "log.html").unlink()
    assert "Straightness" not in text(replace(log, motions=()), tmp_path)


def test_every_event_stands_in_the_table(log: Timeline, tmp_path: Path) -> None:
    html = text(log, tmp_path, ticks=59, messages=200, mismatches=0)
    events = [f"{event.code}: {event.text}" for record in RECORDS for event in record.outputs.events]
    escaped = [event.replace(">", "&gt;") for event in events]
    assert not missing(html, *escaped, "59 ticks, 200 messages, 0 mismatches")


def test_a_long_table_says_what_it_leaves_out(log: Timeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "EVENTS", 3)
    left_out = len(log.happenings) - 3
    assert f"{left_out} more stand in the log" in text(log, tmp_path)


def test_a_fault_is_told_with_its_time(log: Timeline, tmp_path: Path) -> None:
    faulty = replace(log, faults=((0, ""), (20, "HOT: servo 3 (elbow): 66 degC"), (30, "")))
    html = text(faulty, tmp_path)
    assert f"<td>{log.time_s[20]:.1f} to {log.time_s[30]:.1f}</td><td>HOT: servo 3 (elbow): 66 degC</td>" in html


def test_text_from_the_log_is_never_markup(log: Timeline, tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    motions = tuple(replace(motion, label=evil) for motion in log.motions)
    happenings = (Happening(log.start_ns, 20, "X", evil),)
    hostile = replace(log, motions=motions, happenings=happenings, faults=((0, f"{evil}: x"),), states=((0, evil),))
    html = without_plotly(text(hostile, tmp_path))
    assert missing(html, "alert(1)", "<script>alert", "<img") == ["<script>alert", "<img"]


def test_an_existing_file_is_never_overwritten(log: Timeline, tmp_path: Path) -> None:
    taken = tmp_path / "log.html"
    taken.write_text("mine")
    with pytest.raises(LogError, match="exists already"):
        write(log, taken)
    assert taken.read_text() == "mine"


def test_a_log_in_which_nothing_is_known_has_a_page_as_well(log: Timeline, tmp_path: Path) -> None:
    nothing = {name: np.full_like(getattr(log, name), np.nan) for name in ("position_rad", "goal_rad", "tool")}
    html = text(replace(log, **nothing, motions=(), complete=False), tmp_path)
    assert "Tool in space" not in html
    assert "what is intact is shown" in html


COLUMNS = arrays(np.float64, st.integers(1, 400), elements=st.floats(-1e6, 1e6) | st.just(float("nan")))


@given(values=COLUMNS, most=st.integers(4, 60))
def test_thinning_keeps_order_ends_and_extremes(values: np.ndarray[Any, Any], most: int) -> None:
    rows = thinned(values, most)
    assert (np.diff(rows) > 0).all()
    assert (rows[0], rows[-1]) == (0, len(values) - 1)
    known = values[~np.isnan(values)]
    if len(known):
        assert (np.nanmin(values[rows]), np.nanmax(values[rows])) == (known.min(), known.max())
    gaps = np.isnan(values)
    assert np.isnan(values[rows]).any() == gaps.any()
    if not gaps.any():
        assert len(rows) <= most + 4


def test_a_short_column_is_drawn_whole() -> None:
    assert thinned(np.arange(10.0), 10).tolist() == list(range(10))


def test_numbers_are_those_of_the_log(log: Timeline, tmp_path: Path) -> None:
    told = (json.dumps(log.arm.joint_names[0]), f"{log.duration_s:.1f} s, {len(log.time_s)} ticks")
    assert not missing(text(log, tmp_path), *told)
