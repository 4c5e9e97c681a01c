"""Charts as a browser gets them: every kind that armctl draws is in the library, and numbers arrive as they are."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import sync_playwright

from armctl.report.page import Figure, Page

ROOT = Path(__file__).resolve().parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
KIND = re.compile(r'\.add\(\s*"(\w+)"|"type": "(scatter\w*)"')
# What the library made of the first trace of each chart, columns as plain lists.
MADE = "one => { const {type, y} = one._fullData[0]; return [type, Array.from(y)]; }"


def kinds() -> list[str]:
    """Those that the package names."""
    rooms = [ROOT / "armctl" / room for room in ("report", "papers", "lab")]
    texts = [path.read_text() for room in rooms for path in room.rglob("*.py")]
    return sorted({one or other for text in texts for one, other in KIND.findall(text)} - {"text"})


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: sudo apt install chromium")
def test_every_kind_that_is_drawn_is_in_the_library_and_gets_its_numbers(tmp_path: Path) -> None:
    wanted = kinds()
    assert {"bar", "scatter", "scatter3d"} <= set(wanted)
    page, y = Page("Kinds"), np.array([0.1, math.nan, 1.0 / 3.0])
    for kind in wanted:
        figure = Figure({"height": 300})
        figure.add(kind, x=np.arange(3), y=y, **({"z": [1, 2, 3]} if kind.endswith("3d") else {}))
        page.figure(figure, kind)
    page.write(tmp_path / "page.html")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        shown = browser.new_page()
        shown.goto((tmp_path / "page.html").as_uri())
        for kind, chart in zip(wanted, shown.locator(".later").all(), strict=True):
            chart.scroll_into_view_if_needed()
            chart.locator(".main-svg").first.wait_for(state="attached")
            made, values = chart.evaluate(MADE)
            assert made == kind
            np.testing.assert_array_equal(values, y)
        browser.close()


def test_a_page_holds_json_whatever_the_numbers(tmp_path: Path) -> None:
    figure = Figure({"height": 300, "xaxis": {"range": [math.nan, np.float32(0.5)]}})
    figure.add("scatter", x=[1, math.inf], y=(math.nan, 2.0), name="</script><b>")
    page = Page("Numbers")
    page.figure(figure, "numbers")
    page.write(tmp_path / "page.html")
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', (tmp_path / "page.html").read_text())
    (trace,) = json.loads(text, parse_constant=pytest.fail)["data"]
    assert (trace["x"], trace["y"], trace["name"]) == ([1, None], [None, 2.0], "</script><b>")
    assert json.loads(text)["layout"]["xaxis"]["range"] == [None, 0.5]
