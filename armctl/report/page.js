(() => {
  // A box in space is as large as its chart has room for, its labels beside it. In this projection it grows with its
  // aspect ratio; a unit of that is .517 of the height.
  const fit = chart => {
    const {aspectratio: box, camera: {eye}} = chart.layout.scene, {w, h} = chart._fullLayout._size;
    const flat = Math.hypot(eye.x, eye.y), away = Math.hypot(flat, eye.z), [x, y] = [Math.abs(eye.x), Math.abs(eye.y)];
    const across = (y * box.x + x * box.y) / flat, up = (eye.z * (x * box.x + y * box.y) / flat + flat * box.z) / away;
    const by = Math.min((w - 100) / across, (h - 80) / up) / (.517 * h);
    Plotly.relayout(chart, {"scene.aspectratio": {x: box.x * by, y: box.y * by, z: box.z * by}});
  };
  // What paint does not set, and plotly.js would draw otherwise.
  const flat = {automargin: true, title: {standoff: 15}, zerolinewidth: 2}, deep = {showbackground: true, gridwidth: 2, ticks: ""};
  const plain = {colorbar: {outlinewidth: 0, ticks: ""}};
  const template = {
    layout: {title: {x: .05}, xaxis: flat, yaxis: flat, scene: {xaxis: deep, yaxis: deep, zaxis: deep}, autotypenumbers: "strict",
      hoverlabel: {align: "left"}, colorway: ["#636efa", "#ef553b", "#00cc96", "#ab63fa"],
      colorscale: {sequential: [[0, "#0d0887"], [.25, "#7e03a8"], [.5, "#cc4778"], [.75, "#f89540"], [1, "#f0f921"]]}},
    data: {scatter3d: [{line: plain, marker: plain}], bar: [{error_y: {color: "#2a3f5f"}, marker: {line: {color: "white", width: .5}}}]},
  };
  const config = {displaylogo: false, responsive: true};
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = (charts = document.querySelectorAll(".js-plotly-plot")) => {
    const of = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const axis = (name, key) => ({[`${name}.gridcolor`]: of("--rule"), [`${name}.zerolinecolor`]: of("--edge"),
      [`${name}.linecolor`]: of("--edge"), ...key});
    for (const chart of charts) {
      const change = {paper_bgcolor: of("--paper"), plot_bgcolor: of("--paper"), "font.color": of("--ink"),
        ...axis("xaxis"), ...axis("yaxis")};
      if (chart.layout.scene) for (const name of ["scene.xaxis", "scene.yaxis", "scene.zaxis"])
        Object.assign(change, axis(name, {[`${name}.backgroundcolor`]: of("--paper"),
          [`${name}.nticks`]: innerWidth < 700 ? 4 : 6}));
      // The legend stands 60 px below the curves, whatever their height: under the name of the axis.
      if (innerWidth < 700) Object.assign(change, {"legend.orientation": "h", "legend.x": 0, "legend.xanchor": "left",
        "legend.y": -60 / Math.max(80, (chart.layout.height || 450) - 100), "legend.yanchor": "top",
        "margin.l": chart.layout.scene ? 0 : 50, "margin.r": chart.layout.scene ? 0 : 12, "title.font.size": 14});
      // The script of a light page draws at once, and its own way.
      Plotly.relayout(chart, change)?.then(() => chart.layout.scene && fit(chart));
    }
  };
  // A chart is drawn when it is nearly in sight, and kept; the library runs when the first one is.
  const library = document.getElementById("plotly");
  const later = new IntersectionObserver(seen => seen.filter(one => one.isIntersecting).forEach(({target}) => {
    later.unobserve(target);
    if (!window.Plotly) document.head.append(Object.assign(document.createElement("script"), {text: library.text}));
    const {data, layout} = JSON.parse(target.firstElementChild.textContent);
    target.replaceChildren();
    Plotly.newPlot(target, data, {template, ...layout}, config).then(chart => paint([chart]));
  }), {rootMargin: "300px"});
  document.querySelectorAll(".later").forEach(chart => later.observe(chart));
  dark.addEventListener("change", () => paint());
})();
