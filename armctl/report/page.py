"""One HTML page of text, tables and charts that opens without a network."""

import html
import json
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from armctl.kinematics.transform import FloatArray
from armctl.recording.disk import writing

# What stands on pages word for word.
TEXTS: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("texts.yaml").read_text(encoding="utf-8"))
# Looks of a page.
_STYLE = Path(__file__).with_name("page.css")
# What a chart without a title has around it: its legend stands in one line above.
_ABOVE = {"orientation": "h", "y": 1.0, "yanchor": "bottom"}
CLOSE: dict[str, Any] = {"margin": {"l": 60, "r": 15, "t": 30, "b": 50}, "legend": _ABOVE}
# Seen as MATLAB's plots in space are: from the left, half from above.
CAMERA = {"eye": {"x": -0.68, "y": -0.89, "z": 0.65}, "projection": {"type": "orthographic"}}
# Draws charts in the page's colours, and on a phone with the legend below the curves.
_CHARTS = Path(__file__).with_name("page.js")
# What it draws them with: plotly.js, of which tools/packaging/page makes a file; on a light page armctl's own.
_PLOTLY, _LIGHT = (Path(__file__).with_name(name) for name in ("plotly.js", "plot.js"))


@dataclass
class Figure:
    """A chart: its layout and its traces as plotly.js takes them, except that columns may be arrays."""

    layout: dict[str, Any]
    data: list[dict[str, Any]] = field(default_factory=list)

    def add(self, kind: str, **trace: Any) -> None:
        """Add a trace of a kind that tools/packaging/page/plotly.entry.js names."""
        self.data.append({"type": kind, **trace})


def axes(x: str, y: str, height: int, **y_axis: Any) -> Figure:
    """A figure without curves, its axes named; `y_axis` as plotly.js's `layout.yaxis`."""
    named = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}, **y_axis}}
    return Figure({**named, "height": height, **CLOSE})


def curve(
    chart: Figure, x: Any, y: Any, name: str, colour: str, *, width: float = 2, dash: str = "solid", **more: Any
) -> None:
    """Add a line to a chart; `more` as plotly.js's `scatter`, among it `mode`."""
    style = {"color": colour, "width": width, "dash": dash}
    chart.add("scatter", **{"mode": "lines", "x": x, "y": y, "name": name, "line": style} | more)


def in_space(chart: Figure, points: FloatArray, unit: str = "mm") -> None:
    """Axes of a chart in space, all to one scale, close around points [unit], shape (m, 3).

    The box is as large as the chart allows, whatever its shape; no side is less than a third of the longest.
    """
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    side = np.maximum(size, max(1.0, float(size.max()) / 3.0)) * 1.08
    ratio = dict(zip("xyz", (1.7 * side / np.linalg.norm(side)).tolist(), strict=True))
    axes = {
        f"{axis}axis": {"title": {"text": f"{axis} [{unit}]"}, "range": [middle - half, middle + half], "nticks": 6}
        for axis, middle, half in zip("xyz", (low + size / 2.0).tolist(), (side / 2.0).tolist(), strict=True)
    }
    scene = {"aspectmode": "manual", "aspectratio": ratio, "camera": CAMERA, **axes}
    chart.layout |= {"scene": scene, "margin": {**chart.layout["margin"], "l": 0, "r": 0, "b": 0}}


class Marked(NamedTuple):
    """A table's cell with a look of its own: `kind` is a class of `page.css`."""

    text: str
    kind: str


class Page:
    """Collects blocks in order and writes them as one file; one with chapters begins with a list of its contents.

    The charts of a `light` one are drawn by a script of armctl's own instead of plotly.js's 1.7 MB.
    """

    def __init__(self, title: str, *, light: bool = False) -> None:
        self._title, self._light = title, light
        self._blocks: list[str] = [f"<h1>{html.escape(title)}</h1>"]
        self._has_script = False
        self._contents: list[tuple[str, list[str]]] = []

    def chapter(self, text: str) -> None:
        """A heading above others."""
        self._contents.append((text, []))
        self._blocks.append(f'<h2 class="chapter" id="{len(self._contents)}">{html.escape(text)}</h2>')

    def heading(self, text: str) -> None:
        place = ""
        if self._contents:
            headings = self._contents[-1][1]
            headings.append(text)
            place = f' id="{len(self._contents)}.{len(headings)}"'
        self._blocks.append(f"<h2{place}>{html.escape(text)}</h2>")

    def text(self, *texts: str) -> None:
        self._blocks += [f"<p>{html.escape(text)}</p>" for text in texts]

    def table(
        self, header: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "", *, words: bool = False
    ) -> None:
        """Add a table; `words`: its cells are text, set from the left, and not numbers."""

        def line(cells: Sequence[object], tag: str) -> str:
            return "<tr>" + "".join(map(cell, cells, [tag] * len(cells))) + "</tr>"

        def cell(content: object, tag: str) -> str:
            text, look = (content.text, f' class="{content.kind}"') if isinstance(content, Marked) else (content, "")
            return f"<{tag}{look}>{html.escape(str(text))}</{tag}>"

        body = "".join(line(row, "td") for row in rows)
        # Beside the table and not in it: what is wider than a phone is moved sideways, its explanation is not.
        name = f"note-{len(self._blocks)}"
        note = f'<p class="note" id="{name}">{html.escape(caption)}</p>' if caption else ""
        kind = (' class="words"' if words else "") + (f' aria-describedby="{name}"' if caption else "")
        head = f"<thead>{line(header, 'th')}</thead>"
        self._blocks.append(f'<div class="wide"><table{kind}>{head}<tbody>{body}</tbody></table></div>{note}')

    @contextmanager
    def chart(
        self, description: str, title: str, x: str, y: str, height: int = 420, heading: str = "", **y_axis: Any
    ) -> Iterator[Figure]:
        """An empty chart with a title and axes, for the caller to draw on; it is added to the page afterwards.

        Args:
            heading: Stands above it; empty: none does.
            y_axis: As plotly.js's `layout.yaxis`.
        """
        if heading:
            self.heading(heading)
        chart = axes(x, y, height, **y_axis)
        around = {"margin": {"l": 60, "r": 20, "t": 50, "b": 50}, "legend": {"font": {"size": 11}}}
        chart.layout |= {"title": {"text": title}, **around}
        yield chart
        self.figure(chart, description)

    def figures(self, views: Iterable[tuple[Figure, str]]) -> None:
        """Add figures, each with its description below, side by side where the page is wide enough."""
        self._blocks.append('<div class="views">')
        for figure, description in views:
            self.figure(figure, description, f"<figcaption>{html.escape(description)}</figcaption>")
        self._blocks.append("</div>")

    def figure(self, figure: Figure, description: str, caption: str = "") -> None:
        """Add a chart; `description` says in words what it shows."""
        # `page.js` draws it; the first one brings the library along, which runs when a chart is drawn.
        library = ""
        if not self._has_script:
            drawing = (_LIGHT if self._light else _PLOTLY).read_text(encoding="utf-8")
            library, self._has_script = f'<script type="text/plain" id="plotly">{drawing}</script>', True
        label = html.escape(description, quote=True)
        # Twice, for NaN is no JSON.
        known = json.loads(json.dumps(vars(figure), default=_column), parse_constant=lambda _: None)
        data = json.dumps(known, separators=(",", ":")).replace("<", "\\u003c")
        script = f'<script type="application/json">{data}</script>'
        chart = f'{library}<div class="later" style="height:{figure.layout["height"]}px">{script}</div>{caption}'
        self._blocks.append(f'<figure role="img" aria-label="{label}" style="margin:0">{chart}</figure>')

    def _list_of_contents(self) -> str:
        """Chapters with links to what is in them."""
        text = ""
        for number, (chapter, headings) in enumerate(self._contents, 1):
            links = "".join(f'<a href="#{number}.{k}">{html.escape(one)}</a>' for k, one in enumerate(headings, 1))
            text += f'<details><summary><a href="#{number}">{html.escape(chapter)}</a></summary>{links}</details>'
        return f'<nav aria-label="Contents">{text}</nav>' if text else ""

    def html(self) -> str:
        """The whole page."""
        script = f"<script>\n{_CHARTS.read_text(encoding='utf-8')}</script>" if self._has_script else ""
        title, style = html.escape(self._title), _STYLE.read_text(encoding="utf-8")
        body = "".join([self._blocks[0], self._list_of_contents(), *self._blocks[1:], script])
        return str(TEXTS["html"].format(title=title, style=style, body=body))

    def write(self, path: Path) -> None:
        """Write the page to `path`.

        Raises:
            LogError: it cannot be written.
        """
        with writing(path):
            path.write_text(self.html(), encoding="utf-8")


def _column(values: Any) -> Any:
    """An array or a number of numpy's as plotly.js takes it: of an array of floats its bytes."""
    if values.ndim and values.dtype.kind == "f":
        return {"dtype": f"f{values.itemsize}", "bdata": b64encode(values.tobytes()).decode()}
    return values.tolist()
