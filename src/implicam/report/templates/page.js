"use strict";
// Each figure's data stands in a JSON element beside its place. Plotly fits a figure to its place and to the theme's
// ink. Printing takes the light theme, and the browser shrinks the page as it stands: Plotly could not redraw in time.
const plots = [...document.querySelectorAll(".plot")];
const ink = () => getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
function recolour() { for (const plot of plots) Plotly.relayout(plot, {"font.color": ink()}); }
for (const plot of plots) {
  const figure = JSON.parse(document.getElementById(plot.id.replace("plot-", "data-")).textContent);
  figure.layout.font.color = ink();
  Plotly.newPlot(plot, figure.data, figure.layout, {displaylogo: false, responsive: true,
    scrollZoom: plot.id === "plot-scene", modeBarButtonsToRemove: ["select2d", "lasso2d"]});
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
matchMedia("print").addEventListener("change", recolour);
