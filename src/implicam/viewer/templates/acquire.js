// The page of a guided session: what is on the screen, and the buttons. The session is on the server; scene3d.js draws.

import {Scene3D, cividis} from "./scene3d.js";
import {drawReach} from "./reach.js";

const by = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const KEYS = {g: "go", a: "accept", r: "redo", s: "skip", u: "undo", f: "finish"};
const LABELS = {go: "Go", accept: "Accept", redo: "Redo", skip: "Skip", undo: "Undo", finish: "Finish"};
const LOST_MS = 6000, LOUPE_RADII = 4, ON_TARGET_PX = 12, GAP_PX = 8, SIDE_PX = 370, BELOW_PX = 310;

let about = null, state = null, scene = null, world = null, heard = Date.now(), dismissed = new Set();
let sceneNumber = -1, curveNumber = -1, chosen = 0, typed = null, questioned = null, listed = null, closed = false, fetching = false, lastTexts = "";
// What sessions by hand say, of a board and of a wand.
const BY_HAND = {
  board: {things: "boards", list: "Boards", auto: "take pictures by itself, when the board is held still",
    simulated: "cameras, board and the hand that holds it are simulated", points: "corners",
    none: "no calibration yet: each camera is shown what it has not seen",
    meaning: "These are predictions of the calibration, for a position measured anywhere in the volume, in the frame that fits it best; "
      + "the report at the end gives the rms error of distances between corners of boards that were held out."},
  wand: {things: "frames", list: "Frames", auto: "keep what is seen by itself, while the wand is waved",
    simulated: "cameras, wand and the hand that waves it are simulated", points: "where it was",
    none: "no calibration yet: each camera is shown what it has not seen",
    meaning: "These are what the last fit states, for a position measured anywhere in the volume, relative to where the wand was; "
      + "the held-out lengths say whether that is so."},
};
const byHand = () => BY_HAND[about.wand ? "wand" : "board"];
const goodness = (part) => `hsl(${Math.round(125 * part)}, 75%, 45%)`;  // red to green
window.implicam = {get state() { return state; }, get scene() { return scene; }, get world() { return world; }};

const number = (value, digits = 3) => Number.isFinite(value) ? String(Number(value.toPrecision(digits))) : "–";
const element = (name, attributes = {}, parent = null, text = null) => {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  parent?.append(made);
  return made;
};

async function ask(path, body) {
  let answer;
  try {
    answer = await fetch(path, body === undefined ? {} : {method: "POST", body: JSON.stringify(body)});
  } catch {
    throw {error: "implicam acquire does not answer.", fix: "Look at the terminal; what was accepted is on disk."};
  }
  const found = await answer.json().catch(() => ({error: `The server answered ${answer.status}.`}));
  if (!answer.ok) throw found;
  return found;
}

// ------------------------------------------------------------------------------------------------- what people do

const own = [];  // complaints of this page, beside those of the session
let complained = 0;
function complain(problem, word = "") {
  own.push({number: `own${complained++}`, word, ...problem});
  while (own.length > 3) own.shift();
  drawComplaints();
}

function takeBack(word) {  // what was wrong with the last try is mended by a good one
  own.splice(0, own.length, ...own.filter((one) => one.word !== word));
  drawComplaints();
}

async function press(word, more = {}) {
  if (word === "stop") {
    try { await ask("api/stop", {}); } catch (problem) { complain(problem); }
    return;
  }
  const texts = ["x", "y", "z"].map((axis) => by(axis).value);
  const corrected = word === "redo" && texts.every(Boolean) && texts.join("|") !== lastTexts;  // a typing mistake, seen late
  if (!about.moves && (corrected || (word === "go" && state.phase === "aim"))) {
    more = {xyz: texts, ...more};
    lastTexts = texts.join("|");
  }
  try {
    const answer = await ask("api/do", {word, ...more});
    takeBack(word);
    if (answer.ask) question(answer.ask, (yes) => press(word, {...more, ...yes}));
  } catch (problem) { takeBack(word); complain(problem, word); }
  drawButtons();
}

// buttons: label, what it does, and "next" for the one that has the focus: Enter must not do what cannot be undone.
function dialog(title, text, buttons, pictures = []) {
  by("ask-pictures").replaceChildren(...pictures.map(([name, url]) => {
    const figure = document.createElement("figure"), image = document.createElement("img");
    Object.assign(image, {src: url, alt: `picture of ${name}`});
    image.addEventListener("error", () => { image.remove(); figure.append(" (no picture)"); });
    figure.append(name, image);
    return figure;
  }));
  by("ask-title").textContent = title;
  by("ask-text").textContent = text;
  by("ask-buttons").replaceChildren(...buttons.map(([label, action, kind]) => {
    const button = document.createElement("button");
    button.textContent = label;
    if (kind) button.className = kind;
    button.addEventListener("click", () => { by("ask").close(); action?.(); });
    return button;
  }));
  by("ask").showModal();
  by("ask-buttons").querySelector(".next")?.focus();
}

const question = (asked, go) => dialog(asked.title, asked.text, [
  [asked.yes, () => go({yes: asked.number})], [asked.no ?? "Do not", null, "next"]]);

function skip() {
  if (about.boards) { press("skip"); return; }
  dialog("Skip this target: why?", "It is not proposed again.",
    [...about.reasons.map((reason) => [sentence(reason), () => press("skip", {reason})]), ["Do not skip", null, "next"]]);
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  if (event.key === "Escape" && about?.moves) { press("stop"); return; }
  const typing = event.target.matches("select, input:not([type=checkbox], [type=range])");
  if (by("ask").open || typing) return;
  if (event.key === "0") scene?.aim();
  const word = KEYS[event.key.toLowerCase()];
  if (word && !by(word).disabled) { event.preventDefault(); by(word).click(); }
}

// --------------------------------------------------------------------------------------------------- what is shown

function draw() {
  document.body.dataset.phase = state.phase;
  by("banner").dataset.kind = state.kind;
  by("title").textContent = state.title;
  by("detail").textContent = [state.detail, state.why && `why: ${state.why}`, state.fix && `to do: ${state.fix}`,
    state.phase === "trouble" && "Nothing is lost. Try again when it is mended.",
    state.phase === "done" && state.message].filter(Boolean).join("\n");
  const target = state.phase === "aim" && state.target;
  by("aim").hidden = !target;
  if (target) by("target").textContent = target.words ?? place(target.xyz);
  const shown = state.phase === "shown" && state.position;
  by("to-go").hidden = !state.to_go && !shown;
  by("way").textContent = state.to_go ? `${state.to_go.total} to go` : shown ? "ball at" : "";
  by("axes").textContent = "";
  const axes = state.to_go ? Object.entries(state.to_go.axes) : shown ? [["", place(state.position)]] : [];
  for (const [axis, words] of axes) by("axes").append(Object.assign(document.createElement("span"), {textContent: ` ${axis} ${words}`.trimEnd()}));
  drawButtons();
  drawPlace();
  drawHow();
  drawTiles();
  drawNumbers();
  drawComplaints();
  drawMoving();
  refreshPoints();
  if (state.scene !== sceneNumber) refreshScene();
  if (state.curve !== curveNumber) refreshCurve();
  if (state.question && state.question.number !== questioned && !by("ask").open) {
    questioned = state.question.number;
    question(state.question, (yes) => press(state.phase === "shown" ? "redo" : "go", yes));
  }
}

const sentence = (words) => words.slice(0, 1).toUpperCase() + words.slice(1);
const place = (xyz) => `${["x", "y", "z"].map((axis, i) => `${axis} ${number(xyz[i], 4)}`).join(", ")} ${about.unit}`;

function drawButtons() {
  if (!state) return;
  for (const [word, button] of Object.entries(state.buttons)) {
    const one = by(word);
    if (!one || word === "stop" || word === "auto") continue;
    one.disabled = !button.enabled;
    one.classList.toggle("next", button.next);
    const label = button.label || LABELS[word];
    if (one.dataset.label !== label) {
      one.dataset.label = label;
      one.replaceChildren(label, " ", Object.assign(document.createElement("kbd"), {textContent: one.dataset.key}));
    }
  }
  const done = state.phase === "done";
  by("finish").hidden = done;
  by("close").hidden = !done;
  by("auto").checked = state.auto;
  by("auto").disabled = !state.buttons.auto.enabled;
  by("files").hidden = !done;
}

function drawPlace() {  // beside where the target is, to be typed: where the ball really is
  by("place").hidden = about.moves || about.boards || state.phase === "done";
  if (about.moves || about.boards || !state.target || state.target.name === typed) return;
  typed = state.target.name;
  ["x", "y", "z"].forEach((axis, i) => {  // empty: what nobody typed is not known
    by(axis).value = "";
    by(axis).placeholder = number(state.target.xyz[i], 6);
  });
}

// By hand: how to get there, open until the circles in the pictures say it.
function drawHow() {
  const box = by("reach"), target = state.phase === "aim" && state.target;
  box.hidden = about.moves || about.boards || !target || !world;
  if (box.hidden) return;
  const first = state.numbers.usual || state.cameras.some((one) => one.rough) ? "known" : "first";
  if (!box.dataset.stage) {
    by("tool").value = world.levels ? "block" : "ruler";
    try { by("tool").value = localStorage.getItem("implicam-tool") ?? by("tool").value; } catch { /* not kept */ }
  }
  if (box.dataset.stage !== first) { box.dataset.stage = first; box.open = first === "first"; }
  by("steps").textContent = drawReach(by("drawing"), by("tool").value, target.xyz,
    {box: world.box, levels: world.levels, rotation: world.placing.rotation, unit: about.unit});
}

function drawComplaints() {
  const all = [...(state?.complaints ?? []), ...own].filter((one) => !dismissed.has(one.number));
  by("said").replaceChildren(...all.map((one) => {
    const line = document.createElement("div"), away = document.createElement("button");
    line.textContent = [one.error, one.why && `why: ${one.why}`, one.fix && `to do: ${one.fix}`].filter(Boolean).join("\n");
    away.textContent = "×";
    away.setAttribute("aria-label", "dismiss");
    away.addEventListener("click", () => { dismissed.add(one.number); drawComplaints(); });
    line.append(away);
    return line;
  }));
}

function makeTiles() {
  about.cameras.forEach(({name}, i) => {
    const tile = document.createElement("figure");
    tile.className = "tile";
    tile.style.margin = 0;
    const [image, svg, top, label, says, reason] = [document.createElement("img"), element("svg"), ...["div", "b", "span", "div"]
      .map((kind) => document.createElement(kind))];
    image.alt = `picture of ${name}`;
    label.textContent = name;
    top.className = "top";
    reason.className = "reason";
    top.append(label, says);
    const bar = document.createElement("i");
    bar.className = "part";
    bar.hidden = true;
    top.append(bar);
    tile.append(image, svg, top, reason);
    by("cameras").append(tile);
    const button = document.createElement("button");
    button.textContent = name;
    button.addEventListener("click", () => { chosen = i; drawTiles(); });
    by("which").append(button);
    tile.parts = {image, svg, says, reason, bar};
  });
  new ResizeObserver(layOut).observe(by("cameras"));
}

// The columns that make tiles largest.
function columnsFor(width, height, count, aspect) {
  let best = {across: 0, columns: 1};
  for (let columns = 1; columns <= count; columns++) {
    const rows = Math.ceil(count / columns);
    const across = Math.min((width - GAP_PX * (columns - 1)) / columns, (height - GAP_PX * (rows - 1)) / rows * aspect);
    if (across > best.across) best = {across, columns};
  }
  return best;
}

// On a desktop, where all else stands: below the pictures where that makes them larger, or beside them, as wide as they
// leave it. By the window alone, so that nothing jumps while somebody works.
function arrange(count, aspect) {
  const main = document.querySelector("main"), wide = innerWidth - 20, high = innerHeight - 120;
  const byHand = !about.moves && !about.boards;
  const beside = columnsFor(wide - SIDE_PX - 10, high - (about.boards ? 120 : 190), count, aspect);
  const below = columnsFor(wide, high - BELOW_PX, count, aspect);
  main.classList.toggle("below", innerWidth >= (byHand ? 1400 : 1024) && below.across > (byHand ? 1.15 : 1.08) * beside.across);
  const left = wide - 10 - beside.across * beside.columns - GAP_PX * (beside.columns - 1);
  main.style.setProperty("--side", `${Math.floor(Math.min(Math.max(left, SIDE_PX), 0.38 * wide))}px`);
}

function layOut() {
  const single = matchMedia("(max-width: 700px)").matches, count = single ? 1 : about.cameras.length;
  const aspect = Math.max(...(state?.cameras ?? []).map((one) => one.shown ? one.width / one.height : 0)) || 4 / 3;
  arrange(count, aspect);
  const {clientWidth: width, clientHeight} = by("cameras"), stacked = innerWidth < 1024;
  const height = stacked ? (single ? 0.38 : 0.48) * innerHeight : clientHeight;
  const best = columnsFor(width, height, count, aspect), rows = Math.ceil(count / best.columns);
  if (stacked) document.body.style.setProperty("--pictures", `${Math.ceil(rows * (best.across / aspect + GAP_PX))}px`);
  by("cameras").style.gridTemplateColumns = `repeat(${best.columns}, ${Math.floor(best.across)}px)`;
  for (const tile of by("cameras").children) tile.style.height = `${Math.floor(best.across / aspect)}px`;
}

function drawTiles() {
  [...by("cameras").children].forEach((tile, i) => {
    const one = state.cameras[i], {image, svg, says, reason, bar} = tile.parts;
    bar.hidden = one.part === undefined;  // how far its calibration is, red to green
    if (!bar.hidden) {
      Object.assign(bar.style, {width: `${100 * one.part}%`, background: goodness(one.part)});
      bar.title = one.told;
    }
    tile.classList.toggle("chosen", i === chosen);
    by("which").children[i].setAttribute("aria-current", i === chosen);
    tile.dataset.kind = one.kind;
    tile.classList.toggle("judged", state.phase === "shown");
    tile.classList.toggle("empty", !one.shown);
    says.textContent = one.says;
    reason.textContent = one.reason ?? "";
    reason.hidden = !one.reason;
    image.style.display = svg.style.display = one.shown ? "" : "none";
    if (!one.shown) return;
    const size = `${one.width}x${one.height}`;
    if (tile.dataset.size !== size) { tile.dataset.size = size; layOut(); }
    drawMarks(svg, one, tile);
    loadPicture(tile, image, one);
  });
}

function loadPicture(tile, image, one) {
  if (tile.dataset.picture === String(one.picture) || tile.busy) return;
  tile.busy = true;
  const number = String(one.picture), wide = Math.ceil(tile.clientWidth * Math.min(window.devicePixelRatio, 2));
  const next = new Image();
  const settled = () => { tile.busy = false; };
  next.onload = () => {
    image.src = next.src;
    tile.dataset.picture = number;
    settled();
    const loupe = tile.querySelector(".loupe image");
    if (loupe) loupe.setAttribute("href", next.src);
    if (scene && world?.cameras.some((camera) => camera.name === one.name) && !scene.looking) frustum(one.name, next.src);
  };
  next.onerror = settled;
  next.src = `picture.jpg?camera=${encodeURIComponent(one.name)}&width=${wide || 480}&n=${number}`;
}

const shownInScene = {};
function frustum(name, url) {  // not more often than twice a second: a texture is not free
  const now = Date.now();
  if (now - (shownInScene[name] ?? 0) < 500) return;
  shownInScene[name] = now;
  scene.setPicture(name, url);
}

// Marks at their sub-pixel place: the ball, the reticle, and the way from one to the other.
function drawMarks(svg, one, tile) {
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${one.width} ${one.height}`);
  svg.setAttribute("preserveAspectRatio", "xMidYMid meet");
  const pixel = one.width / Math.max(tile.clientWidth, 1);  // pixels of the picture in one of the screen
  const centre = (uv) => uv && [uv[0] + 0.5, uv[1] + 0.5];
  const stroke = (name, attributes, kind, wide = 2.5) => {
    element(name, {...attributes, class: "halo", "stroke-width": (wide + 3) * pixel}, svg);
    element(name, {...attributes, class: kind, "stroke-width": wide * pixel}, svg);
  };
  if (one.cells) drawCells(svg, one);
  if (one.hold) stroke("polygon", {points: one.hold.map(centre).map((p) => p.join()).join(" ")}, "aim", 3.5);
  for (const [u, v] of one.corners ?? [])
    element("circle", {cx: u + 0.5, cy: v + 0.5, r: 2.2 * pixel, class: "corner", "stroke-width": 0.8 * pixel}, svg);
  const radius = Math.max(16, tile.clientHeight / 16) * pixel;
  const ball = centre(one.ball), target = centre(one.target);
  if (ball) {
    let most = 0;
    for (const line of one.outlines) {
      stroke("polygon", {points: line.map(([u, v]) => `${u + 0.5},${v + 0.5}`).join(" ")}, "ball");
      for (const [u, v] of line) most = Math.max(most, Math.hypot(u + 0.5 - ball[0], v + 0.5 - ball[1]));
    }
    if (most < radius / 2) stroke("circle", {cx: ball[0], cy: ball[1], r: radius / 2}, "ball");
    if (state.phase === "shown") loupe(tile, one, ball, Math.max(most, 6));
  }
  if (state.phase !== "shown" || !ball) tile.querySelector(".loupe")?.remove();
  if (!target && one.rough) {  // somewhere in here: from four to seven points
    const [u, v, r] = one.rough;
    stroke("circle", {cx: u + 0.5, cy: v + 0.5, r, "stroke-dasharray": `${10 * pixel} ${8 * pixel}`}, "aim");
  }
  if (!target) return;
  stroke("circle", {cx: target[0], cy: target[1], r: radius}, "aim");
  for (const [x, y] of [[1, 0], [-1, 0], [0, 1], [0, -1]])
    stroke("line", {x1: target[0] + 0.35 * radius * x, y1: target[1] + 0.35 * radius * y, x2: target[0] + 1.6 * radius * x,
      y2: target[1] + 1.6 * radius * y}, "aim");
  if (!ball || state.phase !== "aim") return;
  const off = [target[0] - ball[0], target[1] - ball[1]], far = Math.hypot(...off);
  if (far <= ON_TARGET_PX || far < 1.8 * radius) return;
  const along = off.map((value) => value / far), side = [-along[1], along[0]];
  const tip = [0, 1].map((i) => target[i] - 1.1 * radius * along[i]);
  const head = [1, -1].map((sign) => [0, 1].map((i) => tip[i] + radius * (sign * 0.4 * side[i] - 0.8 * along[i])));
  stroke("polyline", {points: [[0, 1].map((i) => ball[i] + 0.7 * radius * along[i]), tip].map((p) => p.join()).join(" ")}, "go");
  stroke("polyline", {points: [head[0], tip, head[1]].map((p) => p.join()).join(" ")}, "go");
}

// What is known of the picture, in cells from red to green; the better known, the less they hide.
function drawCells(svg, one) {
  const high = one.height / one.cells.length, group = element("g", {class: "cells"}, svg);
  one.cells.forEach((row, r) => row.forEach((known, c) => {
    const wide = one.width / row.length, gap = 0.012 * one.width;
    if (known !== null) element("rect", {x: c * wide + gap / 2, y: r * high + gap / 2, width: wide - gap, height: high - gap, rx: gap,
      fill: goodness(known), opacity: 0.36 - 0.16 * known}, group);
  }));
}

function loupe(tile, one, ball, radius) {  // in the corner that is farthest from it: whether its outline is right
  let box = tile.querySelector(".loupe");
  if (!box) {
    box = document.createElement("div");
    box.className = "loupe";
    const svg = element("svg");
    element("image", {href: tile.parts.image.src}, svg);
    box.append(svg);
    tile.append(box);
  }
  const half = LOUPE_RADII * radius / 2, svg = box.firstChild, image = svg.querySelector("image");
  svg.setAttribute("viewBox", `${ball[0] - half} ${ball[1] - half} ${2 * half} ${2 * half}`);
  image.setAttribute("width", one.width);
  image.setAttribute("height", one.height);
  for (const old of svg.querySelectorAll("polygon")) old.remove();
  for (const line of one.outlines)
    element("polygon", {points: line.map(([u, v]) => `${u + 0.5},${v + 0.5}`).join(" "), class: "ball", "stroke-width": half / 60}, svg);
  Object.assign(box.style, {left: ball[0] < one.width / 2 ? "" : "8px", right: ball[0] < one.width / 2 ? "8px" : "",
    top: ball[1] < one.height / 2 ? "" : "40px", bottom: ball[1] < one.height / 2 ? "8px" : ""});
}

function drawNumbers() {
  const {points, skipped, usual, worst, progress} = state.numbers;
  const bold = (text) => Object.assign(document.createElement("b"), {textContent: text});
  const word = state.numbers.word ?? "point";
  by("numbers").replaceChildren(bold(String(points)), ` ${word}${points === 1 ? "" : "s"}${skipped ? ` · ${skipped} skipped` : ""}`,
    ...(usual ? [" · ", bold(usual), " in 95 % of the workspace, ", bold(worst), " everywhere"]
      : [about.boards ? ` · ${byHand().none}` : " · no calibration yet: the first places are spread evenly"]));
  by("meaning").hidden = !usual;
  by("rules").replaceChildren(...progress.filter(Boolean).map((words) =>
    Object.assign(document.createElement("li"), {textContent: words})));
  if (state.phase !== "done") return;
  const link = (href, text, attributes) => Object.assign(document.createElement("a"), {href, textContent: text, ...attributes});
  by("files").replaceChildren(link("calibration.implicam", "Download the calibration", {download: ""}),
    ...(state.report ? [link("report.html", "Open the report", {target: "_blank", rel: "noopener"})] : []));
}

async function refreshPoints() {
  if (!by("list").open || !state) return;
  const key = `${state.numbers.points} ${state.scene} ${state.buttons.delete.enabled}`;
  if (key === listed) return;
  listed = key;
  let rows;
  try { rows = (await ask("api/points")).points; } catch { listed = null; return; }
  if (about.boards) { listBoards(rows); return; }
  const table = document.createElement("table"), cell = (kind, text) => Object.assign(document.createElement(kind), {textContent: text});
  table.insertRow().append(...["", "x", "y", "z", "cameras", `off, ${about.unit}`].map((text) => cell("th", text)));
  for (const row of rows.reverse()) {
    const rows = table.appendChild(document.createElement("tbody")), line = rows.insertRow(), acts = Object.assign(cell("td", ""), {colSpan: 6, className: "acts"});
    line.className = "one";
    const off = cell("td", row.off === null ? "–" : number(row.off, 2));
    if (row.off > 4 * row.sd) off.className = "far";
    line.append(cell("td", row.name), ...row.xyz.map((v) => cell("td", number(v, 5))), cell("td", row.cameras), off);
    rows.insertRow().append(acts);
    for (const [label, act] of [["look", () => lookAt(row)], ["again", () => again(row)], ["delete", () => remove(row)]]) {
      const button = cell("button", label);
      button.disabled = label !== "look" && !state.buttons.delete.enabled;
      button.addEventListener("click", act);
      acts.append(button);
    }
  }
  by("points").replaceChildren(table);
}

function listBoards(rows) {
  const table = document.createElement("table"), cell = (kind, text) => Object.assign(document.createElement(kind), {textContent: text});
  table.insertRow().append(...["", about.wand ? "ends" : "corners", "cameras", ""].map((text) => cell("th", text)));
  for (const row of rows.reverse()) {
    const acts = cell("td", "");
    table.insertRow().append(cell("td", row.name), cell("td", row.corners), cell("td", row.cameras), acts);
    const look = ["look", () => lookAt({...row, words: `${row.corners} corners`})];  // of a wand no pictures are kept
    for (const [label, act] of [...(about.wand ? [] : [look]), ["delete", () => remove(row)]]) {
      const button = cell("button", label);
      button.disabled = label !== "look" && !state.buttons.delete.enabled;
      button.addEventListener("click", act);
      acts.append(button);
    }
  }
  by("points").replaceChildren(table);
}

const lookAt = (row) => dialog(row.name, row.words ?? place(row.xyz), [["Close", null, "next"]], about.cameras.map(({name}) =>
  [name, `kept.jpg?camera=${encodeURIComponent(name)}&point=${encodeURIComponent(row.name)}`]));
const remove = (row) => dialog(`Delete ${row.name}?`, "It is kept in the session as undone, and its pictures in undone/.",
  [["Delete", () => press("delete", {point: row.name})], ["Keep it", null, "next"]]);
const again = (row) => dialog(`Measure ${row.name} again?`, "It is taken back, and its place is the next target.",
  [["Measure it again", () => press("again", {point: row.name})], ["Keep it", null, "next"]]);

async function refreshCurve() {
  curveNumber = state.curve;
  let data;
  try { data = await ask("api/curve"); } catch { curveNumber = -1; return; }
  const svg = by("curve"), known = data.points.length > 0;
  svg.toggleAttribute("hidden", !known);
  if (!known) return;
  const wide = svg.clientWidth || 380, high = svg.clientHeight || 185, [left, right, top, bottom] = [52, 14, 14, 34];
  svg.setAttribute("viewBox", `0 0 ${wide} ${high}`);
  svg.replaceChildren();
  const stops = data.stops.map((one) => one.value), values = [...data.worst, ...data.usual, ...stops].filter((v) => v > 0);
  const low = Math.log10(Math.min(...values)) - 0.08, up = Math.log10(Math.max(...values)) + 0.08;
  const last = data.points.at(-1);
  let most = 15;
  while (most <= last) most *= 2;
  const x = (points) => left + points / most * (wide - left - right);
  const y = (value) => top + (up - Math.log10(value)) / Math.max(up - low, 1e-9) * (high - top - bottom);
  for (let decade = Math.floor(low); decade <= up; decade++)
    for (const step of [1, 2, 5]) {
      const value = step * 10 ** decade;
      if (Math.log10(value) < low || Math.log10(value) > up) continue;
      element("line", {x1: left, x2: wide - right, y1: y(value), y2: y(value), class: "grid"}, svg);
      element("text", {x: left - 6, y: y(value) + 4, "text-anchor": "end"}, svg, number(value));
    }
  for (let points = 0; points <= most; points += most / 5)
    element("text", {x: x(points), y: high - 18, "text-anchor": "middle"}, svg, String(points));
  element("text", {x: (left + wide - right) / 2, y: high - 4, "text-anchor": "middle"}, svg, `${about.boards ? byHand().things : "known points"}; 95 % uncertainty, ${about.unit}`);
  for (const one of data.stops) {
    element("line", {x1: left, x2: wide - right, y1: y(one.value), y2: y(one.value), class: "rule"}, svg);
    element("text", {x: wide - right, y: y(one.value) - 4, "text-anchor": "end", class: "rule-word"}, svg, "stop");
  }
  for (const points of data.budgets.filter((budget) => budget <= most))
    element("line", {x1: x(points), x2: x(points), y1: top, y2: high - bottom, class: "rule"}, svg);
  for (const [name, words] of [["worst", "everywhere"], ["usual", "in 95 %"]]) {
    const line = data[name].map((value, i) => value > 0 ? `${x(data.points[i])},${y(value)}` : "").filter(Boolean);
    element("polyline", {points: line.join(" "), class: name}, svg);
    data[name].forEach((value, i) => {
      if (value > 0) element("circle", {cx: x(data.points[i]), cy: y(value), r: 3, class: `${name} dot`}, svg);
    });
    const end = data[name].at(-1);
    if (end > 0) element("text", {x: Math.min(x(last) + 6, wide - 74), y: y(end) + (name === "worst" ? -6 : 14),
      class: `${name}-word`}, svg, words);
  }
}

// ------------------------------------------------------------------------------------------------- three dimensions

async function refreshScene() {
  if (fetching) return;
  fetching = true;
  const wanted = state.scene;
  try {
    world = await ask("api/scene");
    sceneNumber = wanted;
  } catch { return; } finally { fetching = false; }
  try {
    if (!scene) {
      scene = new Scene3D(by("scene"), world.placing);
      scene.above = [by("whole")];
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { scene.theme(); refreshScene(); });
    }
  } catch (error) {
    by("stage").replaceChildren(`This browser cannot draw in three dimensions: ${error.message ?? error}`);
    return;
  }
  scene.reset(world.placing);
  scene.setBox(world.box, about.unit, (value) => number(value, 3), world.edges);
  scene.setCameras(world.cameras, world.grid[0], world.grid[1]);
  scene.setKnown(world.known, world.known.map(() => true));
  scene.setMarks("skipped", world.skipped, "idle");
  colourCloud();
  scene.fit();
  drawMoving();
  drawHow();
  document.body.dataset.ready = "yes";
}

function colourCloud() {
  if (about.wand) {
    by("key").hidden = !world.good.length;
    by("low").textContent = "uncertain";
    by("high").textContent = "enough";
    scene.setCloud(world.judged, world.good, 0, 1, -1, goodness);
    return;
  }
  const values = world[by("colour").value], known = values.filter((value) => value !== null).sort((a, b) => a - b);
  by("key").hidden = !known.length;
  if (!known.length) return;
  const low = known[0], high = known[Math.floor(0.98 * (known.length - 1))];
  const unit = by("colour").value === "u95" ? about.unit : "times";
  by("low").textContent = number(low);
  by("high").textContent = `≥ ${number(high)} ${unit}`;
  const part = Number(by("threshold").value) / 100, level = known[Math.min(Math.floor(part * known.length), known.length - 1)];
  by("level").textContent = `${number(level)} ${unit}`;
  if (!world.volume) return scene.setCloud(world.judged, values, low, high, level);
  scene.setMap(world.volume.axes, world.volume.maps[by("colour").value]);
  Object.assign(scene, {bottom: low, top: high});
  scene.setThreshold(part >= 1 ? Infinity : level);
}

function drawMoving() {
  if (!scene || !world) return;
  const target = state.target?.xyz && ["aim", "moving", "shown"].includes(state.phase) ? [state.target.xyz] : [];
  scene.setBalls("target", target, "ask", 0.05, "target");
  const here = state.phase === "aim" ? state.measured : state.position;
  scene.setBalls("ball", here ? [here] : [], "found", 0.04);
}

// --------------------------------------------------------------------------------------------------------- beginning

function listen() {
  const source = new EventSource("api/state");
  source.onmessage = (event) => {
    heard = Date.now();
    if (document.body.dataset.lost) { delete document.body.dataset.lost; own.length = 0; }
    state = JSON.parse(event.data);
    draw();
  };
  source.addEventListener("beat", () => {
    heard = Date.now();
    if (document.body.dataset.lost && state) { delete document.body.dataset.lost; draw(); }
  });
  source.onopen = () => { heard = Date.now(); };
  source.addEventListener("closed", () => {
    closed = true;
    source.close();
    by("title").textContent = "The session is closed";
    by("detail").textContent = `Everything is in ${about.folder}. This page can be closed.`;
    for (const button of document.querySelectorAll("button")) button.disabled = true;
  });
  const lost = () => {
    if (closed || document.body.dataset.lost) return;
    document.body.dataset.lost = "yes";
    by("banner").dataset.kind = "bad";
    by("title").textContent = "The connection is lost";
    by("detail").textContent = "Is implicam acquire still running? What was accepted is on disk. This page goes on by itself.";
  };
  source.onerror = lost;
  setInterval(() => { if (Date.now() - heard > LOST_MS) lost(); }, 1000);  // a cable, or a phone out of reach
}

async function begin() {
  try { about = await ask("api/about"); } catch (problem) { complain(problem); return; }
  document.title = `${about.name} · implicam acquire`;
  by("unit").textContent = about.unit;
  by("stop").hidden = !about.moves;
  by("stop").append(" ", Object.assign(document.createElement("kbd"), {textContent: "Esc"}));
  by("by-itself").hidden = !about.auto;
  if (about.boards) {
    for (const word of ["accept", "redo"]) by(word).hidden = true;
    const told = byHand();
    if (!about.moves) by("auto").nextSibling.textContent = ` ${told.auto}${about.simulated ? ` (${told.simulated})` : ""}`;
    for (const kind of about.wand ? [] : ["wanted", "ball"]) document.querySelector(`.dots .${kind}`).parentNode.remove();
    document.querySelector(".dots .known").nextSibling.textContent = told.points;
    by("list").querySelector("summary").textContent = told.list;
    by("meaning").textContent = told.meaning;
    if (about.wand) {
      document.querySelector(".dots .wanted").nextSibling.textContent = "wave here";
      document.querySelector(".dots .ball").nextSibling.textContent = "the wand now";
      for (const id of ["colour", "least"]) by(id).hidden = true;
      by("bar").style.background = `linear-gradient(to right, ${[0, 0.25, 0.5, 0.75, 1].map(goodness).join(", ")})`;
    }
  }
  makeTiles();
  for (const word of Object.values(KEYS)) by(word).addEventListener("click", () => word === "skip" ? skip() : press(word));
  by("stop").addEventListener("click", () => press("stop"));
  by("close").addEventListener("click", () => press("close"));
  by("auto").addEventListener("change", () => {
    const on = by("auto").checked;
    by("auto").checked = state.auto;  // until the session says so
    press("auto", {on});
  });
  by("place").addEventListener("submit", (event) => event.preventDefault());
  by("place").addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target.tagName === "INPUT" && !by("go").disabled) by("go").click();
  });
  by("there").addEventListener("click", () => { for (const axis of ["x", "y", "z"]) by(axis).value = by(axis).placeholder; });
  by("tool").addEventListener("change", () => {
    try { localStorage.setItem("implicam-tool", by("tool").value); } catch { /* not kept */ }
    drawHow();
  });
  by("list").addEventListener("toggle", refreshPoints);
  by("whole").addEventListener("click", () => scene?.aim());
  by("colour").addEventListener("change", colourCloud);
  by("threshold").addEventListener("input", colourCloud);
  by("scene").addEventListener("pointerdown", () => { if (scene) scene.turned = true; });
  by("scene").addEventListener("wheel", () => { if (scene) scene.turned = true; }, {passive: true});
  document.addEventListener("keydown", key);
  const pen = by("bar").getContext("2d");
  for (let x = 0; x < 256 && !about.wand; x++) {
    pen.fillStyle = `rgb(${cividis(x / 255).map((v) => Math.round(255 * v)).join(",")})`;
    pen.fillRect(x, 0, 1, 1);
  }
  listen();
}

begin();
