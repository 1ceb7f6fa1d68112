"""Style and script of the page."""

STYLE = """
:root { --paper: #ffffff; --panel: #f4f6f8; --ink: #1d2733; --soft: #5a6675; --rule: #d9dfe6;
  --good: #00795a; --bad: #b84300; --careful: #005f96; --unknown: #5a6675; color-scheme: light dark; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #14181d; --panel: #1d232b; --ink: #e4e9ef;
  --soft: #9aa7b5; --rule: #343d48; --good: #35c79b; --bad: #ff8a4a; --careful: #62b8ee; --unknown: #9aa7b5; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); line-height: 1.5;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 32px 56px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 44px 0 12px; padding-top: 14px; border-top: 1px solid var(--rule); }
.kind { margin: 0 0 6px; font-size: 13px; letter-spacing: .08em; text-transform: uppercase; color: var(--soft); }
.subtitle { margin: 4px 0 0; color: var(--soft); font-size: 17px; }
dl, dd, dt, figure { margin: 0; }
.facts { display: flex; flex-wrap: wrap; gap: 10px 22px; margin-top: 20px; }
.facts dt, .tile dt { font-size: 13px; color: var(--soft); }
.facts dd { overflow-wrap: anywhere; }
.headline { font-size: 25px; line-height: 1.35; font-weight: 600; margin: 34px 0 18px; max-width: 42em;
  text-wrap: pretty; }
.verdict { border-left: 5px solid var(--unknown); background: var(--panel); padding: 12px 18px;
  border-radius: 0 6px 6px 0; text-wrap: pretty; }
.verdict strong { color: var(--unknown); }
.verdict.good { border-color: var(--good); } .verdict.good strong { color: var(--good); }
.verdict.bad { border-color: var(--bad); } .verdict.bad strong { color: var(--bad); }
.verdict.careful { border-color: var(--careful); } .verdict.careful strong { color: var(--careful); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(290px, 100%), 1fr)); gap: 14px;
  margin-top: 20px; }
.tile { border: 1px solid var(--rule); border-radius: 6px; padding: 12px 16px; }
.tile dd { font-size: 13px; color: var(--soft); }
.tile .value { font-size: 22px; font-weight: 600; color: var(--ink); font-variant-numeric: tabular-nums; }
.plot { width: 100%; height: 400px; }
#plot-scene { height: 600px; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(430px, 100%), 1fr)); gap: 28px; }
.pair > figure { min-width: 0; }
figcaption { font-size: 14px; color: var(--soft); margin-top: 6px; max-width: 60em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; vertical-align: bottom; color: var(--soft); font-size: 13px; }
th, td { padding: 6px 9px; border-bottom: 1px solid var(--rule); }
.numbers th:not(:first-child), .numbers td:not(:first-child) { text-align: right; }
.numbers td { white-space: nowrap; }
.numbers tbody tr:first-child { font-weight: 600; }
.text td { overflow-wrap: anywhere; } .text td:first-child { width: 30%; }
summary { cursor: pointer; font-weight: 600; padding: 6px 0; }
#method ul { padding-left: 20px; } #method ul:empty, #left-out p:empty { display: none; }
.terms { font-size: 14px; } .terms > div { display: grid; grid-template-columns: 11em 1fr; gap: 14px; padding: 4px 0; }
.terms dt { font-weight: 600; } .terms dd { color: var(--soft); }
footer { margin-top: 40px; font-size: 13px; color: var(--soft); }
@media (max-width: 640px) { main { padding: 24px 16px; } .headline { font-size: 21px; } #plot-scene { height: 440px; }
  .terms > div { grid-template-columns: 1fr; gap: 0; } }
@media print { @page { margin: 14mm; } main { padding: 0; max-width: none; } body { font-size: 11pt; }
  h2 { break-after: avoid; } figure, .tile, .verdict, tr { break-inside: avoid; }
  .pair { grid-template-columns: 1fr 1fr; } th, td { padding: 3px 5px; font-size: 9pt; } .wide { overflow: visible; }
  .verdict, .tile { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""

# Each figure's data stands in a JSON element beside its place. Plotly fits a figure to its place and to the theme's
# ink. Printing takes the light theme, and the browser shrinks the page as it stands: Plotly could not redraw in time.
SCRIPT = """
"use strict";
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
"""
