"""The page about one log: complete in itself, true to the log, readable in light and dark."""

import json
import random
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from playwright.sync_api import sync_playwright

from armctl.errors import LogError
from armctl.recording import timeline
from armctl.recording.timeline import Happening, Timeline
from armctl.report import log as page
from armctl.report.log import thinned, write
from tests.recording.factory import make_records
from tests.recording.logs import write as write_log
from tests.words import missing

RECORDS = make_records(60, seed=3)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Timeline:
    return timeline.load(write_log(tmp_path_factory.mktemp("log") / "a.mcap", RECORDS))


def text(log: Timeline, folder: Path, **checked: Any) -> str:
    write(folder / "log.html", log, checked=checked or None)
    return (folder / "log.html").read_text()


def without_library(html: str) -> str:
    """The page without the library in it."""
    scripts = re.findall(r"<script.*?</script>", html, re.DOTALL)
    return html.replace(max(scripts, key=len), "")


def test_the_page_is_complete_in_itself(log: Timeline, tmp_path: Path) -> None:
    html = text(log, tmp_path)
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=", html)
    assert "prefers-color-scheme: dark" in html
    assert html.count('<figure role="img"') == 10
    assert len(html) < 200_000  # nobody's library


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


def test_what_came_before_a_fault_has_a_chapter(log: Timeline, tmp_path: Path) -> None:
    later = replace(log, time_s=log.time_s * 4, faults=((0, ""), (40, "HOT: a"), (41, "HOT: b"), (55, "")))
    times_ns = [log.start_ns + round(float(later.time_s[tick]) * 1e9) for tick in (10, 39, 59)]
    happened = tuple(Happening(at, 20, "X", f"happened {k}") for k, at in enumerate(times_ns))
    html = text(replace(later, happenings=happened), tmp_path)
    before = html[html.index("Before HOT at ") : html.index("Joints against")]
    assert html.count("<h2>Before") == 1
    assert not missing(before, "happened 1", "Distance from the goal")
    assert missing(before, "happened 0", "happened 2") == ["happened 0", "happened 2"]


def verdicts(html: str) -> dict[str, tuple[str, ...]]:
    """Verdict, figure and bounds by what is judged."""
    rows = re.findall(r'<td>([^<]*)</td><td class="\w+">(\w+)</td><td>([^<]*)</td><td>([^<]*)</td>', html)
    return {what: tuple(rest) for what, *rest in rows}


def test_a_sound_log_is_judged_good(log: Timeline, tmp_path: Path) -> None:
    found = verdicts(text(log, tmp_path))
    assert len(found) == 10
    assert found["replies lost"] == ("good", "0 % (wrist)", "&lt;= 0.1 (2)")
    assert {verdict for verdict, *_ in found.values()} == {"good"}


def where(values: np.ndarray[Any, Any], rows: slice, column: int, value: Any) -> np.ndarray[Any, Any]:
    """The same with other values in some rows of a column."""
    changed = values.copy()
    changed[rows, column] = value
    return changed


# Of 60 ticks: what is changed, and what is told of it.
JUDGED: dict[str, tuple[str, Callable[[Timeline], Any], str, str]] = {
    "replies lost": ("fresh", lambda log: where(log.fresh, slice(3), 1, False), "bad", "5 % (shoulder)"),
    "ticks with a servo asked again": ("cycle", lambda log: where(log.cycle, slice(3), 2, 1), "watch", "5 %"),
    "part of a tick until all have answered": ("cycle", lambda log: where(log.cycle, slice(60), 0, 6e4), "watch", "6"),
    "ticks that began late": ("cycle", lambda log: where(log.cycle, slice(3), 3, 1), "bad", "5 %"),
    "ticks that are not in the log": ("tick", lambda log: log.tick + 4 * (log.tick > 9), "watch", "4 "),
    "distance from the goal under torque": ("goal_rad", lambda log: log.position_rad - np.radians(7.0), "bad", "7 deg"),
    "load": ("load_ratio", lambda log: where(log.load_ratio, slice(60), 2, -0.8), "watch", "80 % (elbow)"),
    "left to the arm's limit of temperature": (
        "temperature_degC", lambda log: where(log.temperature_degC, slice(1), 0, 66.0), "bad", "-1 degC (base)",
    ),
    "left to the arm's lowest voltage": ("voltage_V", lambda log: log.voltage_V * 0 + 9.2, "watch", "0.2 V"),
}  # fmt: skip


@pytest.mark.parametrize("what", JUDGED)
def test_what_is_wrong_with_a_log_is_told_with_its_remedy(log: Timeline, tmp_path: Path, what: str) -> None:
    key, changed, verdict, figure = JUDGED[what]
    other: dict[str, Any] = {key: changed(log)}
    found = verdicts(text(replace(log, **other), tmp_path))
    told = {name: rest for name, rest in found.items() if rest[0] != "good"}
    ((name, rest),) = told.items()
    assert name.replace("&#x27;", "'").startswith(f"{what}: ")
    assert (rest[0], rest[1].startswith(figure)) == (verdict, True), rest


def test_a_page_of_an_hour_is_small(log: Timeline, tmp_path: Path) -> None:
    rng, m = np.random.default_rng(1), 36_000
    shapes = {key: values.shape[1:] for key, values in vars(log).items() if isinstance(values, np.ndarray)}
    hour: dict[str, Any] = {key: rng.normal(size=(m, *shape)) for key, shape in shapes.items()}
    hour |= {"time_s": np.arange(m) * 0.1, "tick": np.arange(m), "fresh": hour["fresh"] > 0.1}
    page.write(tmp_path / "one.html", one := replace(log, **hour, happenings=log.happenings * 100, motions=()))
    page.write(tmp_path / "two.html", one, one)
    assert (tmp_path / "one.html").stat().st_size < 2e6
    assert (tmp_path / "two.html").stat().st_size < 4e6


def test_two_logs_are_drawn_over_one_another_from_where_their_plans_begin(log: Timeline, tmp_path: Path) -> None:
    other = replace(log, path=tmp_path / "b.mcap", start_ns=log.start_ns + 5, position_rad=log.position_rad + 0.1)
    page.write(
        tmp_path / "d.html", log, other, rows=[{"quantity": "load", "a": 1.23456789, "b": None, "difference": 2}]
    )
    html = (tmp_path / "d.html").read_text()
    assert not missing(
        html, "Log a.mcap and b.mcap", "Time 0 is where", "<td>1.23457</td><td></td><td>2</td>", '"dash":"dash"'
    )
    for heading in ("Verdicts", "State and faults", "Events"):
        assert not missing(html, *(f"<h2>{heading} of {name}</h2>" for name in ("a.mcap", "b.mcap")))
    motion = log.motions[0]
    shifted = page._from_its_plan(log)
    assert shifted.time_s[log.index((motion.begin_ns - log.start_ns) / 1e9)] == pytest.approx(0.0, abs=0.1)
    assert shifted.index((motion.begin_ns - shifted.start_ns) / 1e9) == log.index(
        (motion.begin_ns - log.start_ns) / 1e9
    )


def test_text_from_the_log_is_never_markup(log: Timeline, tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    motions = tuple(motion._replace(label=evil) for motion in log.motions)
    happenings = (Happening(log.start_ns, 20, "X", evil),)
    hostile = replace(log, motions=motions, happenings=happenings, faults=((0, f"{evil}: x"),), states=((0, evil),))
    html = without_library(text(hostile, tmp_path))
    assert missing(html, "alert(1)", "<script>alert", "<img") == ["<script>alert", "<img"]


def test_an_existing_file_is_never_overwritten(log: Timeline, tmp_path: Path) -> None:
    taken = tmp_path / "log.html"
    taken.write_text("mine")
    with pytest.raises(LogError, match="exists already"):
        write(taken, log)
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


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: sudo apt install chromium")
def test_every_chart_is_drawn_and_a_stretch_of_time_is_chosen_in_all_of_them(log: Timeline, tmp_path: Path) -> None:
    html = text(replace(log, faults=((0, ""), (40, "HOT: a"))), tmp_path)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=("--no-sandbox", "--disable-gpu"))
        shown, errors = browser.new_page(viewport={"width": 390, "height": 800}), list[str]()
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.goto((tmp_path / "log.html").as_uri())
        charts = shown.locator(".later")
        for number in range(charts.count()):
            charts.nth(number).scroll_into_view_if_needed()
            charts.nth(number).locator("canvas").wait_for()
        assert charts.count() == html.count("<figure")
        assert shown.get_by_text("time, s: 0", exact=False).count() == 1  # what the path's colours mean
        assert shown.evaluate("document.documentElement.scrollWidth") == 390
        canvas = charts.nth(1).locator("canvas")
        canvas.drag_to(canvas, source_position={"x": 120, "y": 60}, target_position={"x": 240, "y": 60})
        zooms = shown.evaluate("[...document.querySelectorAll('.later')].map(one => String(one.chart.zoom))")
        over_time = [zoom for zoom in zooms if zoom != "null"]
        assert (len(over_time), len(set(over_time))) == (len(zooms) - 2, 1)  # not in space, nor along a line
        begin, end = map(float, over_time[0].split(","))
        assert 0.0 < begin < end < log.duration_s
        assert errors == []
        browser.close()


WRITTEN = """
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...at) {
  (this.canvas.told ??= []).push([this.textAlign, text]);
  write.call(this, text, ...at);
};
"""
SCALED = """stretches => {
  const found = [];
  for (const {chart} of document.querySelectorAll(".later")) {
    if (chart.layout.xaxis?.title?.text !== "time, s") continue;
    for (const zoom of stretches) {
      chart.canvas.told = [];
      chart.zoom = zoom;
      chart.draw(chart);
      const told = align => new Set(chart.canvas.told.filter(one => one[0] === align).map(one => one[1]));
      const numbers = align => [...told(align)].filter(one => isFinite(one)).length;
      found.push([zoom, numbers("center"), chart.layout.yaxis?.categoryarray ? told("right").size : numbers("right")]);
    }
  }
  return found;
}"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: sudo apt install chromium")
def test_both_axes_of_a_chart_have_a_scale_on_a_phone_whatever_stretch_is_chosen(log: Timeline, tmp_path: Path) -> None:
    text(log, tmp_path)
    rng = random.Random(1)
    stretches = [sorted((rng.uniform(-9.0, 9.0), rng.uniform(-9.0, 9.0))) for _ in range(40)] + [[-9.1, 8.9], [-4, 4.1]]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=("--no-sandbox", "--disable-gpu"))
        shown = browser.new_page(viewport={"width": 390, "height": 800})
        shown.add_init_script(WRITTEN)
        shown.goto((tmp_path / "log.html").as_uri())
        charts = shown.locator(".later")
        for number in range(charts.count()):
            charts.nth(number).scroll_into_view_if_needed()
            charts.nth(number).locator("canvas").wait_for()
        scaled = shown.evaluate(SCALED, stretches)
        browser.close()
    assert len(scaled) >= 5 * len(stretches)
    assert [one for one in scaled if min(one[1:]) < 2] == []
