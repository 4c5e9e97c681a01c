"""One HTML page of text, tables and plotly figures that opens without a network."""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.recording.disk import writing

if TYPE_CHECKING:
    import plotly.graph_objects as go

# A chart; plotly itself is imported by `plotly`, when the first one is drawn.
Figure: TypeAlias = "go.Figure"

# Looks of a page.
_STYLE = Path(__file__).with_name("page.css")
# What a chart without a title has around it: its legend stands in one line above.
_ABOVE = {"orientation": "h", "y": 1.0, "yanchor": "bottom"}
CLOSE: dict[str, Any] = {"margin": {"l": 60, "r": 15, "t": 30, "b": 50}, "legend": _ABOVE}
# Seen as MATLAB's plots in space are: from the left, half from above.
CAMERA = {"eye": {"x": -0.68, "y": -0.89, "z": 0.65}, "projection": {"type": "orthographic"}}
# Charts are drawn light and wide; this gives them the page's colours, and a phone the legend below the curves.
_CHART_COLOURS = Path(__file__).with_name("page.js")
# Draws the few kinds of charts of a light page.
_LIGHT_CHARTS = Path(__file__).with_name("plot.js")


def plotly() -> type[Figure]:
    """plotly's Figure class, imported when the first picture is drawn: it takes a while."""
    from plotly import graph_objects

    figure: type[Figure] = graph_objects.Figure
    return figure


def axes(x: str, y: str, height: int, **more: Any) -> Figure:
    """A figure without curves, its axes named."""
    figure = plotly()()
    figure.update_layout(xaxis_title=x, yaxis_title=y, height=height, **CLOSE | more)
    return figure


def curve(
    chart: Any, x: Any, y: Any, name: str, colour: str, *, width: float = 2, dash: str = "solid", **more: Any
) -> None:
    """Add a line to a chart; `more` as plotly's `add_scatter`, among it `mode`."""
    style = {"color": colour, "width": width, "dash": dash}
    chart.add_scatter(**{"mode": "lines", "x": x, "y": y, "name": name, "line": style} | more)


def in_space(chart: Any, points: FloatArray, unit: str = "mm") -> None:
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
    chart.update_layout(scene=scene, margin_l=0, margin_r=0, margin_b=0)


class Marked(str):
    """A table's cell with a look of its own: `kind` is a class of `page.css`."""

    kind: str

    def __new__(cls, text: str, kind: str) -> Marked:
        marked = super().__new__(cls, text)
        marked.kind = kind
        return marked


class Page:
    """Collects blocks in order and writes them as one file; one with chapters begins with a list of its contents.

    The charts of a `light` one are drawn by a script of armctl's own instead of plotly's 4.8 MB.
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
            kind = f' class="{content.kind}"' if isinstance(content, Marked) else ""
            return f"<{tag}{kind}>{html.escape(str(content))}</{tag}>"

        body = "".join(line(row, "td") for row in rows)
        # Beside the table and not in it: what is wider than a phone is moved sideways, its explanation is not.
        name = f"note-{len(self._blocks)}"
        note = f'<p class="note" id="{name}">{html.escape(caption)}</p>' if caption else ""
        kind = (' class="words"' if words else "") + (f' aria-describedby="{name}"' if caption else "")
        head = f"<thead>{line(header, 'th')}</thead>"
        self._blocks.append(f'<div class="wide"><table{kind}>{head}<tbody>{body}</tbody></table></div>{note}')

    @contextmanager
    def chart(self, description: str, title: str, x: str, y: str, height: int = 420, **more: Any) -> Iterator[Any]:
        """An empty chart with a title and axes, for the caller to draw on; it is added to the page afterwards.

        Args:
            more: As plotly's `update_layout`.
        """
        chart = plotly()()
        usual = {"margin": {"l": 60, "r": 20, "t": 50, "b": 50}, "legend": {"font": {"size": 11}}}
        labels = {"title": title, "xaxis_title": x, "yaxis_title": y}
        chart.update_layout(template=None if self._light else "plotly_white", height=height, **labels, **usual | more)
        yield chart
        self.figure(chart, description)

    def figures(self, views: Iterable[tuple[Figure, str]]) -> None:
        """Add figures, each with its description below, side by side where the page is wide enough."""
        self._blocks.append('<div class="views">')
        for figure, description in views:
            self.figure(figure, description, f"<figcaption>{html.escape(description)}</figcaption>")
        self._blocks.append("</div>")

    def figure(self, figure: Figure, description: str, caption: str = "") -> None:
        """Add a plotly figure; `description` says in words what it shows."""
        from plotly.offline import get_plotlyjs

        # `page.js` draws it; the first one brings the library along, which runs when a chart is drawn.
        drawing = _LIGHT_CHARTS.read_text(encoding="utf-8") if self._light else get_plotlyjs()
        library = "" if self._has_script else f'<script type="text/plain" id="plotly">{drawing}</script>'
        self._has_script = True
        label = html.escape(description, quote=True)
        data = f'{{"config":{{"displaylogo":false,"responsive":true}},{figure.to_json()[1:]}'.replace("<", "\\u003c")
        height = figure.layout.height or 450
        script = f'<script type="application/json">{data}</script>'
        chart = f'{library}<div class="later" style="height:{height}px">{script}</div>{caption}'
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
        script = f"<script>\n{_CHART_COLOURS.read_text(encoding='utf-8')}</script>" if self._has_script else ""
        style = _STYLE.read_text(encoding="utf-8")
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(self._title)}</title>'
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>\n{style}</style></head>'
            f"<body>{self._blocks[0]}{self._list_of_contents()}{''.join(self._blocks[1:])}{script}</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page to `path`.

        Raises:
            LogError: it cannot be written.
        """
        with writing(path):
            path.write_text(self.html(), encoding="utf-8")
