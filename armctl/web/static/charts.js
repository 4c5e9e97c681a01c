// Curves over a common axis, in the page's colours. Names stand beside the chart, in the order of their curves.

import { distance, fromTo, progressAlong } from "/geometry.js";
import uPlot from "/uplot.js";

// Told apart by people who see few colours too, on light and dark (after Okabe and Ito).
export const COLOURS = ["#2f8fe0", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#7fa6c9", "#a8a21d", "#9b5fd0"];
const css = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();

// The colour of a curve; one of the page goes by its name.
const own = ({ colour }, i) => colour ?? COLOURS[i % COLOURS.length];
const ink = (colour) => colour.startsWith("--") ? css(colour) : colour;

// A list's items: names beside the colours of their curves.
export const namesOf = (curves) => curves.map((curve, i) => {
  const item = document.createElement("li");
  const colour = own(curve, i);
  item.style.setProperty("--own", colour.startsWith("--") ? `var(${colour})` : colour);
  item.textContent = curve.name;
  return item;
});

export class Chart {
  // Draws into an element, which has a size of its own. `x` and `y` are what the axes say; the one of y begins at `low`,
  // where that is given, and shows no less than `span`; `wide` makes the range of x, where that is given.
  constructor(element, { x, y = null, log = false, low = null, span = 1e-3, wide = null }) {
    Object.assign(this, { element, x, y, log, low, span, wide, marked: null, notches: [], series: [], plot: null });
    this.names = document.createElement("ul");
    this.names.className = "names";
    this.canvas = document.createElement("div");
    element.replaceChildren(this.names, this.canvas);
    new ResizeObserver(() => this.plot && this.plot.setSize(this.size())).observe(element);
  }

  size() {
    return { width: Math.max(80, this.element.clientWidth), height: Math.max(80, this.element.clientHeight - this.names.offsetHeight) };
  }

  // Curves [{name, x, y, colour}]; places without a value are null, a colour may be left out.
  draw(series) {
    const names = series.map((one) => one.name).join("\n"), data = this.joined(series);
    if (this.plot && names === this.shown) {
      this.plot.setData(data);
      return;
    }
    this.shown = names;
    this.series = series;
    this.names.replaceChildren(...namesOf(series));
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
      font: "12px system-ui", labelFont: "13px system-ui", labelSize: 20 });
    const { low: least, span } = this;
    const scale = this.log ? { distr: 3 } : { range: (_, low, high) => {
      const room = Math.max(0.06 * (high - low), (span - high + low) / 2);
      return [least === null ? low - room : least, high + room];
    } };
    this.plot = new uPlot({
      ...this.size(), legend: { show: false }, cursor: { y: false, drag: { x: true, y: false } },
      scales: { x: { time: false, ...(this.wide && { range: this.wide }) }, y: scale },
      axes: [{ ...axis(this.x), size: 30 }, { ...axis(this.y), size: 46 }],
      series: [{}, ...this.series.map((one, i) => ({ label: one.name, stroke: ink(own(one, i)), width: 2, spanGaps: true, points: { show: false } }))],
      hooks: { draw: [(plot) => this.lines(plot)] },
    }, data, this.canvas);
  }

  lines({ ctx, bbox, valToPos }) {
    const places = this.notches.map((x) => [x, "--rule", 1]);
    if (this.marked !== null) places.push([this.marked, "--red", 2]);
    ctx.save();
    for (const [x, colour, width] of places) {
      const at = valToPos(x, "x", true);
      ctx.strokeStyle = css(colour);
      ctx.lineWidth = width * devicePixelRatio;
      ctx.beginPath();
      ctx.moveTo(at, bbox.top);
      ctx.lineTo(at, bbox.top + bbox.height);
      ctx.stroke();
    }
    ctx.restore();
  }

  // A line across the chart, at a place along x.
  mark(x) {
    this.marked = x;
    if (this.plot) this.plot.redraw(false);
  }

  // Thin lines across it, at places along x.
  notch(places) {
    this.notches = places;
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

// How far tool paths [name, places, colour] are off the line from A to B, along it.
export function drawDeviation(id, paths, A, B) {
  const curves = paths.map(([name, path, colour]) => {
    const places = fromTo(path, A, B).map((place) => [100 * progressAlong(place, A, B), distance(place, A, B)]).sort(([a], [b]) => a - b);
    return { name, colour, x: places.map(([x]) => x), y: places.map(([, y]) => y) };
  });
  chart(id, { x: "along the line, %", y: "off the line, mm", low: 0 }).draw(curves);
}
