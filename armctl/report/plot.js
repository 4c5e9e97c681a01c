// Draws the charts of a log's page: lines, bars over time, and a path in space. It takes figures as plotly.js takes them,
// and is a hundredth of its size.
// Drag across a chart: zoom, in all charts over time at once. Twice: all of it again. A name in the legend: shown or not.
window.Plotly = (() => {
  const KINDS = {f4: Float32Array, f8: Float64Array};
  const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const DASHES = {dot: [1.5, 3], dash: [7, 4]};
  const LEFT = 64, RIGHT = 12, TOP = 8, BOTTOM = 36;
  // Steps go by 1, 2, 5: what is cut into so many parts has at least two numbers beside it.
  const LEAST = 5;
  const charts = [];

  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const numbers = column => column?.bdata === undefined ? column || [] :
    new KINDS[column.dtype](Uint8Array.from(atob(column.bdata), one => one.charCodeAt(0)).buffer);
  const viridis = ratio => {
    const at = Math.min(3.999, Math.max(0, ratio * 4)), low = VIRIDIS[Math.floor(at)], high = VIRIDIS[Math.floor(at) + 1];
    return `rgb(${low.map((one, i) => Math.round(one + (high[i] - one) * (at % 1)))})`;
  };
  const extremes = columns => {
    let low = Infinity, high = -Infinity;
    for (const column of columns) for (const one of column) if (one === one) [low, high] = [Math.min(low, one), Math.max(high, one)];
    return low <= high ? [low, high] : [0, 1];
  };
  const ticks = ([low, high], most) => {
    const raw = (high - low) / most, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].find(one => one * power >= raw) * power, found = [];
    for (let at = Math.ceil(low / step) * step; at <= high + step * 1e-9; at += step) found.push(at);
    return found.map(one => [one, one.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))]);
  };
  const element = (parent, tag, text = "", style = "") => {
    const made = parent.appendChild(document.createElement(tag));
    [made.textContent, made.style.cssText] = [text, style];
    return made;
  };

  function newPlot(target, data, layout) {
    const chart = {target, layout, traces: data, hidden: new Set(), zoom: null, yaw: -0.95, pitch: 0.45};
    for (const trace of chart.traces) for (const key of ["x", "y", "z", "base"]) trace[key] = numbers(trace[key]);
    target.classList.add("js-plotly-plot");
    target.style.height = "auto";
    Object.assign(target, {layout, chart});
    element(target, "div", layout.title?.text, "font-size:15px;margin:.4rem 0 .2rem");
    legend(chart);
    const place = element(target, "div", "", "position:relative");
    chart.canvas = element(place, "canvas", "", "display:block;width:100%;touch-action:pan-y");
    chart.canvas.style.height = `${Math.max(160, (layout.height || 450) - 70)}px`;
    chart.told = element(place, "div", "", "position:absolute;top:4px;pointer-events:none;font-size:12px;padding:.2rem .4rem;" +
      "background:var(--paper);border:1px solid var(--rule);white-space:pre;display:none");
    chart.draw = layout.scene ? space : plane;
    chart.full = layout.scene ? null : extremes(chart.traces.flatMap(one => one.base.length ?
      [one.base, one.base.map((begin, i) => begin + one.x[i])] : [one.x]));
    (layout.scene ? turning : zooming)(chart);
    charts.push(chart);
    new ResizeObserver(() => chart.draw(chart)).observe(chart.canvas);
    return Promise.resolve(target);
  }

  function legend(chart) {
    const box = element(chart.target, "div", "", "display:flex;flex-wrap:wrap;gap:.1rem .3rem");
    for (const trace of chart.traces.filter(one => one.showlegend !== false && one.name)) {
      const group = trace.legendgroup || trace.name;
      const button = element(box, "button", "", "font:12px system-ui;color:inherit;background:none;border:0;padding:.15rem .3rem;cursor:pointer");
      const line = trace.line || {}, paint = trace.marker?.color || line.color;
      if (typeof paint !== "string") { scale(element(box, "span"), chart, line); button.remove(); continue; }
      element(button, "span", "", `display:inline-block;width:1.3em;margin-right:.35em;vertical-align:middle;border-top:3px ` +
        `${{dash: "dashed", dot: "dotted"}[line.dash] || "solid"} ${paint}`);
      button.append(trace.name);
      button.setAttribute("aria-pressed", "true");
      button.onclick = () => {
        const shown = chart.hidden.delete(group) || !chart.hidden.add(group);
        button.setAttribute("aria-pressed", shown);
        button.style.opacity = shown ? 1 : 0.4;
        chart.draw(chart);
      };
    }
  }

  // What the colours of a path mean.
  function scale(box, chart, line) {
    const [low, high] = extremes([numbers(line.color)]);
    box.style.cssText = "font-size:12px";
    box.append(`${line.colorbar?.title?.text || ""}: ${low.toFixed(0)} `);
    element(box, "span", "", `display:inline-block;width:8em;height:.7em;background:linear-gradient(90deg,${
      [0, .25, .5, .75, 1].map(viridis)})`);
    box.append(` ${high.toFixed(0)}`);
  }

  const shown = chart => chart.traces.filter(one => !chart.hidden.has(one.legendgroup || one.name));

  function paper(chart) {
    const {canvas} = chart, ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = "12px system-ui, sans-serif";
    pen.lineJoin = "round";
    return [pen, width, height];
  }

  // Lines over a number, or bars over time.
  function plane(chart) {
    const [pen, width, height] = paper(chart), {layout} = chart, [left, right] = chart.zoom || chart.full;
    const rows = layout.yaxis?.categoryarray, margin = rows ? 44 : LEFT;
    const X = x => margin + (x - left) / (right - left || 1) * (width - margin - RIGHT);
    chart.time = pixel => left + (pixel - margin) / (width - margin - RIGHT) * (right - left);
    let [low, high] = rows ? [-0.5, rows.length - 0.5] : extremes(shown(chart).map(one =>
      chart.zoom ? one.y.filter((_, i) => one.x[i] >= left && one.x[i] <= right) : one.y));
    if (!rows) [low, high] = [low - 0.05 * (high - low || 1), high + 0.05 * (high - low || 1)];
    const Y = y => height - BOTTOM - (y - low) / (high - low) * (height - TOP - BOTTOM);
    pen.fillStyle = colour("--ink");
    pen.strokeStyle = colour("--rule");
    pen.textAlign = "center";
    for (const [at, text] of ticks([left, right], Math.max(LEAST, width / 110))) {
      pen.beginPath(); pen.moveTo(X(at), TOP); pen.lineTo(X(at), height - BOTTOM); pen.stroke();
      pen.fillText(text, X(at), height - BOTTOM + 15);
    }
    pen.fillText(layout.xaxis?.title?.text || "", margin + (width - margin) / 2, height - 4);
    pen.textAlign = "right";
    for (const [at, text] of rows ? rows.map((row, i) => [i, row]) : ticks([low, high], Math.max(LEAST, height / 55))) {
      if (!rows) { pen.beginPath(); pen.moveTo(margin, Y(at)); pen.lineTo(width - RIGHT, Y(at)); pen.stroke(); }
      pen.fillText(text, margin - 6, Y(at) + 4);
    }
    pen.save();
    pen.translate(11, height / 2 - 10); pen.rotate(-Math.PI / 2); pen.textAlign = "center";
    pen.fillText(layout.yaxis?.title?.text || "", 0, 0);
    pen.restore();
    pen.save();
    pen.beginPath(); pen.rect(margin, TOP, width - margin - RIGHT, height - TOP - BOTTOM); pen.clip();
    for (const trace of shown(chart)) {
      if (trace.base.length) {
        const half = 0.36 * (Y(0) - Y(1)), top = Y(rows.indexOf(trace.y[0])) - half;
        pen.fillStyle = trace.marker.color;
        trace.base.forEach((begin, i) => pen.fillRect(X(begin), top, Math.max(1, X(begin + trace.x[i]) - X(begin)), 2 * half));
        continue;
      }
      pen.strokeStyle = trace.line.color;
      pen.lineWidth = Math.min(1.5, trace.line.width || 1.5);
      pen.setLineDash(DASHES[trace.line.dash] || []);
      pen.beginPath();
      for (let i = 0, down = false; i < trace.x.length; i++) {
        const known = trace.y[i] === trace.y[i] && trace.y[i] !== null;
        if (known) down ? pen.lineTo(X(trace.x[i]), Y(trace.y[i])) : pen.moveTo(X(trace.x[i]), Y(trace.y[i]));
        down = known;
      }
      pen.stroke();
    }
    pen.restore();
    if (chart.band) {
      pen.globalAlpha = 0.2;
      pen.fillRect(chart.band[0], TOP, chart.band[1] - chart.band[0], height - TOP - BOTTOM);
    }
  }

  function zooming(chart) {
    const {canvas, told} = chart, time = chart.layout.xaxis?.title?.text;
    const all = zoom => charts.forEach(one => {
      if (one === chart || (time === "time, s" && one.layout.xaxis?.title?.text === time)) { one.zoom = zoom; one.draw(one); }
    });
    canvas.onpointerdown = event => { chart.band = [event.offsetX, event.offsetX]; canvas.setPointerCapture(event.pointerId); };
    canvas.onpointermove = event => {
      if (chart.band) { chart.band[1] = event.offsetX; plane(chart); }
      tell(chart, event.offsetX);
    };
    canvas.onpointerup = () => {
      const [from, to] = [...(chart.band || [0, 0])].sort((a, b) => a - b);
      chart.band = null;
      to - from > 6 ? all([chart.time(from), chart.time(to)]) : plane(chart);
    };
    canvas.onpointercancel = canvas.onpointerleave = () => { chart.band = null; told.style.display = "none"; plane(chart); };
    canvas.ondblclick = () => all(null);
  }

  // The values beside the pointer.
  function tell(chart, pixel) {
    const at = chart.time(pixel), lines = [];
    for (const trace of shown(chart)) {
      if (trace.base.length) {
        const i = trace.base.findIndex((begin, i) => begin <= at && at < begin + trace.x[i]), begin = trace.base[i];
        if (i >= 0) lines.push(`${trace.name}, ${begin.toFixed(1)} to ${(begin + trace.x[i]).toFixed(1)} s`);
      } else if (trace.x.length) {
        let best = 0;
        for (let i = 1; i < trace.x.length; i++) if (Math.abs(trace.x[i] - at) < Math.abs(trace.x[best] - at)) best = i;
        if (trace.y[best] === trace.y[best]) lines.push(`${trace.name}  ${Number(trace.y[best]).toFixed(2)}`);
      }
    }
    const {told, canvas} = chart, right = pixel > canvas.clientWidth / 2;
    told.textContent = [at.toFixed(1), ...lines.slice(0, 14)].join("\n");
    told.style.display = lines.length ? "block" : "none";
    [told.style.left, told.style.right] = right ? ["auto", `${canvas.clientWidth - pixel + 12}px`] : [`${pixel + 12}px`, "auto"];
  }

  // A path in space, seen from afar.
  function space(chart) {
    const [pen, width, height] = paper(chart), {scene} = chart.layout;
    const ranges = ["xaxis", "yaxis", "zaxis"].map(axis => scene[axis].range);
    const middle = ranges.map(([low, high]) => (low + high) / 2), half = Math.hypot(...ranges.map(([low, high]) => (high - low) / 2)) / Math.sqrt(3);
    const [s, c, t, u] = [Math.sin(chart.yaw), Math.cos(chart.yaw), Math.sin(chart.pitch), Math.cos(chart.pitch)];
    const size = Math.min(width, 1.2 * height) / (3.8 * half);
    const at = point => {
      const [x, y, z] = point.map((one, i) => (one - middle[i]) * size);
      return [width / 2 - s * x + c * y, height / 2 + t * (c * x + s * y) - u * z];
    };
    const line = (a, b) => { pen.beginPath(); pen.moveTo(...at(a)); pen.lineTo(...at(b)); pen.stroke(); };
    pen.strokeStyle = colour("--rule");
    pen.fillStyle = colour("--ink");
    pen.textAlign = "center";
    const [xs, ys, zs] = ranges, floor = zs[0], farX = c > 0 ? xs[0] : xs[1], farY = s > 0 ? ys[0] : ys[1];
    const nearX = c > 0 ? xs[1] : xs[0], nearY = s > 0 ? ys[1] : ys[0];
    const label = (text, point, [dx, dy]) => { const [x, y] = at(point); pen.fillText(text, x + dx, y + dy); };
    for (const [x, text] of ticks(xs, 5)) {
      line([x, ys[0], floor], [x, ys[1], floor]); line([x, farY, floor], [x, farY, zs[1]]); label(text, [x, nearY, floor], [0, 16]);
    }
    for (const [y, text] of ticks(ys, 5)) {
      line([xs[0], y, floor], [xs[1], y, floor]); line([farX, y, floor], [farX, y, zs[1]]); label(text, [nearX, y, floor], [0, 16]);
    }
    const side = at([farX, nearY, floor])[0] < at([nearX, farY, floor])[0] ? [farX, nearY] : [nearX, farY];
    for (const [z, text] of ticks(zs, 5)) {
      line([xs[0], farY, z], [xs[1], farY, z]); line([farX, ys[0], z], [farX, ys[1], z]); label(text, [...side, z], [-20, 4]);
    }
    label("x, mm", [middle[0], nearY, floor], [-34, 30]);
    label("y, mm", [nearX, middle[1], floor], [26, 32]);
    label("z, mm", [...side, middle[2]], [-44, 22]);
    for (const {x, y, z, line: style} of shown(chart)) {
      const shades = typeof style.color === "string" ? null : numbers(style.color), [low, high] = shades ? extremes([shades]) : [0, 1];
      pen.lineWidth = 2;
      for (let i = 1; i < x.length; i++) {
        pen.strokeStyle = shades ? viridis((shades[i] - low) / (high - low || 1)) : style.color;
        line([x[i - 1], y[i - 1], z[i - 1]], [x[i], y[i], z[i]]);
      }
    }
  }

  function turning(chart) {
    chart.canvas.style.cursor = "grab";
    chart.canvas.onpointerdown = event => chart.canvas.setPointerCapture(event.pointerId);
    chart.canvas.onpointermove = event => {
      if (!event.buttons) return;
      chart.yaw -= event.movementX / 120;
      chart.pitch = Math.min(1.55, Math.max(0, chart.pitch + event.movementY / 120));
      space(chart);
    };
  }

  return {newPlot, relayout: target => target.chart.draw(target.chart)};
})();
