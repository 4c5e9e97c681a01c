// uPlot and its style sheet, which becomes a file of its own.
import "uplot/dist/uPlot.min.css";
export { default } from "uplot";
