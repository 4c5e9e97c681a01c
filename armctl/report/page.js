(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = (charts = document.querySelectorAll(".js-plotly-plot")) => {
    const of = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const axis = (name, key) => ({[`${name}.gridcolor`]: of("--rule"), [`${name}.zerolinecolor`]: of("--edge"),
      [`${name}.linecolor`]: of("--edge"), ...key});
    for (const chart of charts) {
      const change = {paper_bgcolor: of("--paper"), plot_bgcolor: of("--paper"), "font.color": of("--ink"),
        ...axis("xaxis"), ...axis("yaxis")};
      if (chart.layout.scene) for (const letter of "xyz") Object.assign(change, axis(`scene.${letter}axis`,
        {[`scene.${letter}axis.backgroundcolor`]: of("--paper")}));
      // The legend stands 60 px below the curves, whatever their height: under the name of the axis.
      if (innerWidth < 700) Object.assign(change, {"legend.orientation": "h", "legend.x": 0, "legend.xanchor": "left",
        "legend.y": -60 / Math.max(80, (chart.layout.height || 450) - 100), "legend.yanchor": "top", "margin.l": 50,
        "margin.r": 12, "title.font.size": 14}, chart.layout.scene && {"scene.camera.eye": {x: -.85, y: -1.11, z: .81}});
      Plotly.relayout(chart, change);
    }
  };
  // A chart is drawn when it is nearly in sight, and kept; the library runs when the first one is.
  const library = document.getElementById("plotly");
  const later = new IntersectionObserver(seen => seen.filter(one => one.isIntersecting).forEach(({target}) => {
    later.unobserve(target);
    if (!window.Plotly) document.head.append(Object.assign(document.createElement("script"), {text: library.text}));
    const {data, layout, config} = JSON.parse(target.firstElementChild.textContent);
    target.replaceChildren();
    Plotly.newPlot(target, data, layout, config).then(chart => paint([chart]));
  }), {rootMargin: "300px"});
  document.querySelectorAll(".later").forEach(chart => later.observe(chart));
  dark.addEventListener("change", () => paint());
})();
