(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => {
    const of = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const axis = (name, key) => ({[`${name}.gridcolor`]: of("--rule"), [`${name}.zerolinecolor`]: of("--edge"),
      [`${name}.linecolor`]: of("--edge"), ...key});
    for (const chart of document.querySelectorAll(".js-plotly-plot")) {
      const change = {paper_bgcolor: of("--paper"), plot_bgcolor: of("--paper"), "font.color": of("--ink"),
        ...axis("xaxis"), ...axis("yaxis")};
      if (chart.layout.scene) for (const letter of "xyz") Object.assign(change, axis(`scene.${letter}axis`,
        {[`scene.${letter}axis.backgroundcolor`]: of("--paper")}));
      if (innerWidth < 700) Object.assign(change, {"legend.orientation": "h", "legend.x": 0, "legend.xanchor": "left",
        "legend.y": -0.3, "legend.yanchor": "top", "margin.l": 50, "margin.r": 12, "title.font.size": 14});
      Plotly.relayout(chart, change);
    }
  };
  paint();
  dark.addEventListener("change", paint);
})();
