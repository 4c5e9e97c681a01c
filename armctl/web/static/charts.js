// Curves over a common axis, in the page's colours. Names stand beside the chart, in the order of their curves.

import uPlot from "/uplot.js";

// Told apart by people who see few colours too, on light and dark (after Okabe and Ito).
export const COLOURS = ["#2f8fe0", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#7fa6c9", "#a8a21d", "#9b5fd0"];
const css = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();

// A list's items: names beside the colours of their curves.
export const namesOf = (names) => names.map((name, i) => {
  const item = document.createElement("li");
  item.style.setProperty("--own", COLOURS[i % COLOURS.length]);
  item.textContent = name;
  return item;
});

export class Chart {
  // Draws into an element, which has a size of its own. `x` and `y` are what the axes say; the one of y begins at `low`,
  // where that is given, and shows no less than `span`.
  constructor(element, { x, y, log = false, low = null, span = 1e-3 }) {
    Object.assign(this, { element, x, y, log, low, span, marked: null, series: [], plot: null });
    this.names = document.createElement("ul");
    this.names.className = "names";
    this.canvas = document.createElement("div");
    element.replaceChildren(this.names, this.canvas);
    new ResizeObserver(() => this.plot && this.plot.setSize(this.size())).observe(element);
  }

  size() {
    return { width: Math.max(80, this.element.clientWidth), height: Math.max(80, this.element.clientHeight - this.names.offsetHeight) };
  }

  // Curves [{name, x, y}]; places without a value are null.
  draw(series) {
    const names = series.map((one) => one.name).join("\n"), data = this.joined(series);
    if (this.plot && names === this.shown) {
      this.plot.setData(data);
      return;
    }
    this.shown = names;
    this.series = series;
    this.names.replaceChildren(...namesOf(series.map(({ name }) => name)));
    this.make(data);
  }

  joined(series) {
    const same = series.every(({ x }) => x === series[0].x);
    return same && series.length ? [series[0].x, ...series.map(({ y }) => y)] : uPlot.join(series.map(({ x, y }) => [x, y]));
  }

  make(data) {
    if (this.plot) this.plot.destroy();
    this.element.dataset.ink = css("--ink");
    const axis = (label) => ({ label, stroke: css("--ink"), grid: { stroke: css("--edge"), width: 1 }, ticks: { stroke: css("--edge") },
      font: "12px system-ui", labelFont: "13px system-ui", labelSize: 22 });
    const { low: least, span } = this;
    const scale = this.log ? { distr: 3 } : { range: (_, low, high) => {
      const room = Math.max(0.06 * (high - low), (span - high + low) / 2);
      return [least === null ? low - room : least, high + room];
    } };
    this.plot = new uPlot({
      ...this.size(), legend: { show: false }, cursor: { y: false, drag: { x: true, y: false } },
      scales: { x: { time: false }, y: scale },
      axes: [{ ...axis(this.x), size: 34 }, { ...axis(this.y), size: 52 }],
      series: [{}, ...this.series.map(({ name }, i) => ({ label: name, stroke: COLOURS[i % COLOURS.length], width: 2, spanGaps: true, points: { show: false } }))],
      hooks: { draw: [(plot) => this.line(plot)] },
    }, data, this.canvas);
  }

  line({ ctx, bbox, valToPos }) {
    if (this.marked === null) return;
    const at = valToPos(this.marked, "x", true);
    ctx.save();
    ctx.strokeStyle = css("--red");
    ctx.lineWidth = 2 * devicePixelRatio;
    ctx.beginPath();
    ctx.moveTo(at, bbox.top);
    ctx.lineTo(at, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }

  // A line across the chart, at a place along x.
  mark(x) {
    this.marked = x;
    if (this.plot) this.plot.redraw(false);
  }

  // The page has other colours now.
  paint() {
    if (this.plot) this.make(this.plot.data);
  }
}

const charts = new Map();

// The chart of an element, made when it is first asked for.
export function chart(id, how) {
  const element = document.getElementById(id);
  if (!charts.has(id)) charts.set(id, new Chart(element, how));
  return charts.get(id);
}

export const repaint = () => charts.forEach((one) => one.paint());
