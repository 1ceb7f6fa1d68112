"use strict";
// Each figure's data stands in a JSON element beside its place. Plotly fits a figure to its place and to the theme's
// ink. Printing takes the light theme, and the browser shrinks the page as it stands: Plotly could not redraw in time.
const plots = [...document.querySelectorAll(".plot")];
const narrow = matchMedia("(max-width: 640px)");
const ink = () => getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
function recolour() { for (const plot of plots) Plotly.relayout(plot, {"font.color": ink()}); }
// On a phone Plotly cuts off what is too long: axis titles get two lines, a row of buttons becomes a list, and the scene
// is seen from farther away, beside its colours.
function fit(layout) {
  for (const name of ["xaxis", "yaxis"]) {
    const title = layout[name]?.title;
    const words = title?.text?.length > 36 && !title.text.includes("<") ? title.text.split(" ") : [];
    const half = Math.ceil(words.length / 2);
    if (half) title.text = `${words.slice(0, half).join(" ")}<br>${words.slice(half).join(" ")}`;
  }
  if (layout.yaxis3) {  // slices side by side: one below the other
    ["", "2", "3"].forEach((k, i) => {
      const low = (2 - i) * 0.36;
      layout[`xaxis${k}`].domain = [0, 0.86];
      layout[`yaxis${k}`].domain = [low, low + 0.25];
      Object.assign(layout.annotations[i], {x: 0.43, y: low + 0.25});
    });
  }
  if (layout.scene) {
    layout.scene.domain = {x: [0, 0.82], y: [0.06, 0.86]};
    const eye = layout.scene.camera?.eye ?? {x: 1.25, y: 1.25, z: 1.25};
    layout.scene.camera = {...layout.scene.camera, eye: {x: 1.7 * eye.x, y: 1.7 * eye.y, z: 1.7 * eye.z}};
  }
  for (const menu of layout.updatemenus ?? []) {
    if (menu.type === "buttons") Object.assign(menu, {type: "dropdown", direction: "down", showactive: true});
  }
}
function draw(plot) {
  const figure = JSON.parse(document.getElementById(plot.id.replace("plot-", "data-")).textContent);
  figure.layout.font.color = ink();
  if (narrow.matches) fit(figure.layout);
  Plotly.newPlot(plot, figure.data, figure.layout, {displaylogo: false, responsive: true,
    displayModeBar: !narrow.matches && "hover", scrollZoom: plot.id === "plot-scene" && !narrow.matches,
    modeBarButtonsToRemove: ["select2d", "lasso2d"]});
}
plots.forEach(draw);
narrow.addEventListener("change", () => plots.forEach(draw));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
matchMedia("print").addEventListener("change", recolour);
