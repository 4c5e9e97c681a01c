"""Charts in space, drawn in a browser: whatever their shape they fill their place, and nothing is cut off."""

import base64
import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from playwright.sync_api import Locator, sync_playwright

from armctl.report.page import CLOSE, Figure, Page, in_space

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Sides of what is drawn.
SHAPES = {"cube": (300.0, 300.0, 300.0), "long": (100.0, 800.0, 200.0), "flat": (500.0, 60.0, 90.0), "tall": (9, 9, 90)}
# Columns and rows of a picture between which something is drawn, and its size.
DRAWN = """async picture => {
  const image = await createImageBitmap(await (await fetch(picture)).blob());
  const {width, height} = image, canvas = new OffscreenCanvas(width, height).getContext("2d");
  canvas.drawImage(image, 0, 0);
  const dots = new Uint32Array(canvas.getImageData(0, 0, width, height).data.buffer), columns = [], rows = [];
  dots.forEach((dot, i) => { if (dot !== dots[0]) { columns[i % width] = 1; rows[Math.floor(i / width)] = 1; } });
  const ends = [columns, rows].map(seen => [seen.indexOf(1), seen.lastIndexOf(1)]);
  return [...ends, [width, height]];
}"""

# A chart begins with a box of this size, whatever its place.
FITTED = "one => Math.abs(Math.hypot(...Object.values(one.layout.scene.aspectratio)) - 1.7) > 1e-9"


def drawn(chart: Locator) -> np.ndarray:
    """First and last column and row of a chart that differ from its ground, and its width and height, shape (3, 2)."""
    picture = base64.b64encode(chart.screenshot()).decode()
    return np.array(chart.page.evaluate(DRAWN, f"data:image/png;base64,{picture}"))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: sudo apt install chromium")
@pytest.mark.parametrize("width", [390, 1440])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_chart_in_space_fills_its_place_and_no_label_is_cut_off(
    width: int, scheme: Literal["light", "dark"], tmp_path: Path
) -> None:
    page = Page("Shapes")
    for name, sides in SHAPES.items():
        figure = Figure({**CLOSE, "height": 440, "showlegend": False})
        x, y, z = ends = np.array([-0.5, 0.5]) * np.array(sides)[:, None]
        figure.add("scatter3d", x=x, y=y, z=z, mode="lines+markers", line={"width": 6})
        in_space(figure, ends.T)
        page.figures([(figure, name)])
    page.write(tmp_path / "page.html")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        shown = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        shown.goto((tmp_path / "page.html").as_uri())
        for name, chart in zip(SHAPES, shown.locator(".later").all(), strict=True):
            chart.scroll_into_view_if_needed()
            chart.locator("canvas").wait_for()
            shown.wait_for_function(FITTED, arg=chart.element_handle())
            shown.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
            columns, rows, size = drawn(chart)
            assert min(columns[0], rows[0]) > 0, name
            assert columns[1] < size[0] - 1, name
            assert rows[1] < size[1] - 1, name
            assert max(np.ptp(columns) / size[0], np.ptp(rows) / size[1]) > 0.7, name
        browser.close()
