// The kinds of charts that reports draw (curves come with the core); build.js makes armctl/report/plotly.js of it.
import Plotly from "plotly.js/lib/core";
import bar from "plotly.js/lib/bar";
import scatter3d from "plotly.js/lib/scatter3d";

Plotly.register([bar, scatter3d]);
window.Plotly = Plotly;
