"use strict";
// The page of `implicam label`. All that is kept is on the server; here is what is on the screen.

const by = (id) => document.getElementById(id);
const picture = by("picture"), layout = by("layout");
const CLICK = 14, TOUCH = 22;  // screen pixels from a click, or a finger, to the dot that is meant
const KEYS = {Enter: "accept", s: "skip", u: "undo", Delete: "delete", Backspace: "delete", n: "next", b: "bright",
  "+": "in", "=": "in", "-": "out", "0": "whole", r: "turn", m: "mirror", f: "finish"};

let all = null;      // the dataset: its pictures, and how many labels each has
let view = 0;        // which of them is shown
let data = null;     // its points, labels and proposal
let guess = null;    // what the search makes of the labels, as it comes
let chosen = null;   // the dot that a person chose, null for the proposed one
let turn = [[1, 0], [0, -1]], turned = false;  // of the drawing: what of its axes goes right, and down
let image = null, bright = true, closed = false;
let scale = 1, left = 0, top_ = 0, fitted = true;  // screen = (pixel + 0.5 - corner) * scale
let request = 0;

async function ask(path, body) {
  const how = body === undefined ? {} : {method: "POST", body: JSON.stringify(body)};
  let answer;
  try {
    answer = await fetch(path, how);
  } catch {
    throw {error: "implicam label does not answer.", fix: "Start it again in the terminal; every label is saved."};
  }
  const found = await answer.json().catch(() => ({error: `The server answered ${answer.status}.`}));
  if (!answer.ok) throw found;
  return found;
}

const at = () => all.pictures[view];
const query = () => `camera=${encodeURIComponent(at().camera)}&shot=${encodeURIComponent(at().shot)}`;
const wanted = () => chosen ?? data?.proposed ?? null;
const count = () => data ? Object.keys(data.marks).length : 0;
const enough = () => count() >= all.needed && guess && !guess.busy && !guess.doubt && !guess.unsure.length;
const short = (name) => data.short[name] ?? name;

function say(problem) {
  by("said").hidden = !problem;
  by("said").textContent = !problem ? "" : [problem.error, problem.why && `why: ${problem.why}`,
    problem.fix && `fix: ${problem.fix}`].filter(Boolean).join("\n");
}

// ------------------------------------------------------------------------------------------------ what is shown

async function show(index) {
  view = index;
  data = guess = image = chosen = null;
  turned = false; fitted = true;
  say(null);
  paint();
  const mine = ++request;
  try {
    const found = await ask(`api/picture?${query()}`);
    if (mine !== request) return;
    take(found);
    load();
  } catch (problem) { say(problem); }
}

function load() {
  const mine = request, next = new Image();
  next.onload = () => { if (mine === request) { image = next; if (fitted) fit(); paint(); } };
  next.onerror = () => mine === request && say({error: "The picture cannot be shown.", fix: "Check its file, and reload."});
  next.src = `picture.jpg?${query()}&bright=${bright ? 1 : 0}`;
}

/** Take over what the server says of the picture, and ask for the guess that goes with it. */
function take(found) {
  data = found;
  at().labels = Object.keys(found.marks).length;
  if (chosen !== null && chosen in found.marks && chosen !== found.kept) chosen = null;
  if (!turned) turn = found.turn;
  const mine = ++request;
  if (at().labels < all.guesses_from) { guess = null; paint(); return; }
  guess = {busy: true, dots: guess?.dots ?? {}, found: guess?.found ?? [], unsure: guess?.unsure ?? []};
  paint();
  ask(`api/guess?${query()}`).then((more) => {
    if (mine !== request) return;
    guess = more;
    guess.are = new Set(guess.found);
    data.proposed = more.proposed;
    paint();
  }, (problem) => { if (mine === request) { guess = null; say(problem); paint(); } });
}

async function act(path, body) {
  if (closed || !data) return;
  const index = view;
  try {
    const found = await ask(path, {camera: at().camera, shot: at().shot, ...body});
    if (index !== view) return;
    say(found.said ? {error: found.said} : null);
    const other = all.pictures.findIndex((one) => one.camera === found.camera && one.shot === found.shot);
    if (other !== view) { await show(other); return; }
    take(found);
  } catch (problem) { say(problem); }
}

const place = (point, uv, within) => { chosen = null; return act("api/place", {point, u: uv[0], v: uv[1], within}); };

const acts = {
  accept() {
    const name = wanted(), spot = guess?.dots?.[name];
    if (name && spot && !(name in data.marks)) place(name, spot, 3.5);
  },
  skip() { const name = wanted(); chosen = null; if (name && !(name in data.marks)) act("api/skip", {point: name}); },
  undo() { chosen = null; act("api/undo", {}); },
  delete() { const name = wanted(); if (name && name in data.marks) { chosen = null; act("api/remove", {point: name}); } },
  next() {  // one that lacks labels, where there is any
    const order = all.pictures.map((_, i) => (view + 1 + i) % all.pictures.length);
    show(order.find((i) => all.pictures[i].labels < all.needed && i !== view) ?? order[0]);
  },
  in() { zoom(1.5); }, out() { zoom(1 / 1.5); }, whole() { fit(); paint(); },
  bright() { bright = !bright; by("bright").setAttribute("aria-pressed", bright); load(); paint(); },
  turn() { turn = [turn[1].map((x) => -x), turn[0]]; turned = true; paint(); },
  mirror() { turn = [turn[0].map((x) => -x), turn[1]]; turned = true; paint(); },
  async finish() {
    try { await ask("api/finish", {}); } catch (problem) { say(problem); return; }
    closed = true;
    paint();
  },
};
for (const [id, work] of Object.entries(acts)) by(id).onclick = () => { work(); by(id).blur(); };

document.addEventListener("keydown", (event) => {
  if (event.target.tagName === "INPUT" || event.ctrlKey || event.metaKey || event.altKey || closed) return;
  if (event.key === "Enter" && event.target.tagName === "BUTTON") return;
  const step = {ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}[event.key];
  if (step && image) { move(step[0] * 60, step[1] * 60); event.preventDefault(); return; }
  const id = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
  if (!id || by(id).disabled) return;
  event.preventDefault();
  acts[id]();
});

by("by-name").onsubmit = (event) => {
  event.preventDefault();
  const name = by("name").value.trim();
  const found = data.points.find((p) => p.name === name) ?? data.points.find((p) => short(p.name) === name);
  if (!found) { say({error: `The layout has no dot ${name}.`, fix: "Take one of the list."}); return; }
  say(null); chosen = found.name; by("name").value = ""; by("name").blur(); paint();
};

// ------------------------------------------------------------------------------------------------ the picture

function fit() {
  if (!image) return;
  const {clientWidth: w, clientHeight: h} = picture;
  scale = Math.min(w / image.width, h / image.height);
  left = (image.width - w / scale) / 2; top_ = (image.height - h / scale) / 2;
  fitted = true;
}

function zoom(by_, x = picture.clientWidth / 2, y = picture.clientHeight / 2) {
  if (!image) return;
  const least = Math.min(picture.clientWidth / image.width, picture.clientHeight / image.height);
  const next = Math.min(Math.max(scale * by_, least), 24);
  left += x / scale - x / next; top_ += y / scale - y / next;
  scale = next; fitted = false;
  move(0, 0);
}

function move(dx, dy) {
  left -= dx / scale; top_ -= dy / scale;
  const keep = (corner, size, shown) => shown >= size ? (size - shown) / 2 : Math.min(Math.max(corner, 0), size - shown);
  left = keep(left, image.width, picture.clientWidth / scale);
  top_ = keep(top_, image.height, picture.clientHeight / scale);
  paint();
}

const onScreen = ([u, v]) => [(u + 0.5 - left) * scale, (v + 0.5 - top_) * scale];
const inPicture = (x, y) => [x / scale + left - 0.5, y / scale + top_ - 0.5];

function nearest(spots, x, y, within) {
  let best = null, off = within;
  for (const [name, spot] of Object.entries(spots)) {
    const [a, b] = onScreen(spot), d = Math.hypot(a - x, b - y);
    if (d < off) { best = name; off = d; }
  }
  return best;
}

function clicked(x, y, reach) {
  if (closed || !data || !image) return;
  let name = wanted();
  if (chosen === null) {  // a dot that has a name already means itself, the nearest one if there are several
    const known = guess && !guess.busy, hit = nearest(known ? {...guess.dots, ...data.marks} : data.marks, x, y, known ? reach : reach / 2);
    if (hit && hit in data.marks) { chosen = hit; say(null); paint(); return; }
    name = hit ?? name;
  }
  if (name) place(name, inPicture(x, y), reach / scale);
}

const fingers = new Map();
let far = 0, start = null;  // how far a finger has gone, and between two of them
picture.addEventListener("pointerdown", (event) => {
  picture.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  far = fingers.size > 1 ? 99 : 0;
  start = null;
});
picture.addEventListener("pointermove", (event) => {
  const was = fingers.get(event.pointerId);
  if (!was || !image) return;
  const now = [event.offsetX, event.offsetY];
  far += Math.hypot(now[0] - was[0], now[1] - was[1]);
  fingers.set(event.pointerId, now);
  if (fingers.size === 2) {
    const [a, b] = [...fingers.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (start) zoom(apart / start, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
    start = apart;
    move((now[0] - was[0]) / 2, (now[1] - was[1]) / 2);
  } else if (far > 6) move(now[0] - was[0], now[1] - was[1]);
});
function lifted(event) {
  const was = fingers.get(event.pointerId);
  fingers.delete(event.pointerId);
  if (was && event.type === "pointerup" && event.button === 0 && far <= 6)
    clicked(was[0], was[1], event.pointerType === "touch" ? TOUCH : CLICK);
}
picture.addEventListener("pointerup", lifted);
picture.addEventListener("pointercancel", lifted);
picture.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
}, {passive: false});

// ------------------------------------------------------------------------------------------------ drawing

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const MARKS = {labelled: "#ffb238", found: "#63c3ff", wanted: "#3df0a8", missing: "#ff6d5e"};  // on photographs

/** The canvas in the pixels of the screen, empty. */
function canvas(element) {
  const dense = window.devicePixelRatio || 1, {clientWidth: w, clientHeight: h} = element;
  if (element.width !== Math.round(w * dense) || element.height !== Math.round(h * dense)) {
    element.width = Math.round(w * dense); element.height = Math.round(h * dense);
  }
  const ink = element.getContext("2d");
  ink.setTransform(dense, 0, 0, dense, 0, 0);
  ink.clearRect(0, 0, w, h);
  return [ink, w, h];
}

function ring(ink, [x, y], radius, stroke, width = 2, dash = []) {
  for (const [style, thick] of stroke.rim ? [["#000a", width + 2], [stroke.colour, width]] : [[stroke.colour, width]]) {
    ink.beginPath(); ink.setLineDash(dash); ink.strokeStyle = style; ink.lineWidth = thick;
    ink.arc(x, y, radius, 0, 7); ink.stroke();
  }
  ink.setLineDash([]);
}

function cross(ink, [x, y], radius, stroke, width = 2) {
  for (const [style, thick] of stroke.rim ? [["#000a", width + 2], [stroke.colour, width]] : [[stroke.colour, width]]) {
    ink.beginPath(); ink.strokeStyle = style; ink.lineWidth = thick;
    for (const s of [1, -1]) { ink.moveTo(x - radius, y - s * radius); ink.lineTo(x + radius, y + s * radius); }
    ink.stroke();
  }
}

function write(ink, text, x, y, fill, rim, size = 13, align = "center") {
  ink.font = `600 ${size}px system-ui, sans-serif`;
  ink.textAlign = align; ink.textBaseline = "middle";
  if (rim) { ink.lineWidth = 3; ink.strokeStyle = rim; ink.lineJoin = "round"; ink.strokeText(text, x, y); }
  ink.fillStyle = fill; ink.fillText(text, x, y);
}

function paint() {
  words();
  paintPicture();
  paintLayout();
}

function paintPicture() {
  const [ink, w, h] = canvas(picture);
  if (!image) { write(ink, "loading …", w / 2, h / 2, "#ccc"); return; }
  ink.imageSmoothingEnabled = scale < 2;
  ink.drawImage(image, -left * scale, -top_ * scale, image.width * scale, image.height * scale);
  if (!data) return;
  const dots = guess?.dots ?? {}, found = new Set(guess?.found ?? []), shown = {...dots, ...data.marks};
  const step = spacing(Object.values(dots)) * scale, radius = Math.min(Math.max(step * 0.22, 5), 11);
  const name = enough() && chosen === null ? null : wanted();
  const size = Math.min(Math.max(step * 0.3, 10), 14);
  ink.font = `600 ${size}px system-ui, sans-serif`;
  const named = step > 2 * radius + size + 1 && step > ink.measureText(short(Object.keys(dots)[0] ?? "")).width + 3;
  const inView = ([x, y]) => x > -20 && y > -20 && x < w + 20 && y < h + 20;
  for (const [one, spot] of Object.entries(shown)) {
    const p = onScreen(spot);
    if (!inView(p) || one === name) continue;
    const mark = one in data.marks ? "labelled" : found.has(one) ? "found" : "missing";
    const stroke = {colour: MARKS[mark], rim: true};
    if (mark === "missing") cross(ink, p, radius * 0.7, stroke);
    else ring(ink, p, mark === "labelled" ? radius + 2 : radius, stroke, mark === "labelled" ? 3 : 1.5);
    if (mark === "labelled" || named)
      write(ink, short(one), p[0], p[1] + radius + 2 + size * 0.6, MARKS[mark], "#000c", mark === "labelled" ? 13 : size);
  }
  if (name && shown[name]) {
    const p = onScreen(shown[name]), label = name in data.marks;
    const about = !label && !found.has(name) ? Math.max(2 * (dots[name]?.[2] ?? 0) * scale, radius + 4) : radius + 4;
    ring(ink, p, about, {colour: MARKS.wanted, rim: true}, 3, label ? [] : [6, 4]);
    write(ink, short(name) + (label ? "" : "?"), p[0], p[1] - about - 11, MARKS.wanted, "#000c", 16);
  }
  for (const one of guess?.suspect ?? []) if (data.marks[one]) cross(ink, onScreen(data.marks[one]), 12, {colour: MARKS.missing, rim: true}, 3);
}

/** How far dots are from the ones next to them, in the median. */
function spacing(spots) {
  if (spots.length < 2) return 40;
  const some = spots.length > 150 ? spots.filter((_, i) => i % Math.ceil(spots.length / 150) === 0) : spots;
  const off = some.map((a) => Math.min(...spots.filter((b) => b !== a).map((b) => Math.hypot(a[0] - b[0], a[1] - b[1]))));
  return off.sort((a, b) => a - b)[off.length >> 1];
}

let drawn = [];  // [name, x, y] of the drawing, for clicks

function paintLayout() {
  const [ink, w, h] = canvas(layout);
  drawn = [];
  if (!data) return;
  const [a, b, c] = data.axes, depths = [...new Set(data.points.map((p) => p.xyz[c]))].sort((x, y) => x - y);
  const laid = data.points.map((p) => [0, 1].map((k) => turn[k][0] * p.xyz[a] + turn[k][1] * p.xyz[b]));
  const low = [0, 1].map((k) => Math.min(...laid.map((p) => p[k]))), high = [0, 1].map((k) => Math.max(...laid.map((p) => p[k])));
  const margin = 30, room = Math.min((w - 2 * margin) / (high[0] - low[0] || 1), (h - 2 * margin) / (high[1] - low[1] || 1));
  const corner = [w, h].map((size, k) => (size - (high[k] - low[k]) * room) / 2);
  const step = spacing(laid) * room, radius = Math.min(Math.max(step * 0.28, 2), 7), found = new Set(guess?.found ?? []);
  const name = enough() && chosen === null ? null : wanted(), paper = colour("panel");
  data.points.forEach((p, i) => {
    const x = corner[0] + (laid[i][0] - low[0]) * room, y = corner[1] + (laid[i][1] - low[1]) * room;
    drawn.push([p.name, x, y]);
    const mark = p.name in data.marks ? "labelled" : found.has(p.name) ? "found" : guess?.dots?.[p.name] && !guess.busy ? "missing" : "dot";
    const size = radius * (depths.length < 2 ? 1 : 0.55 + 0.45 * depths.indexOf(p.xyz[c]) / (depths.length - 1));
    ink.beginPath(); ink.fillStyle = colour(mark); ink.arc(x, y, mark === "labelled" ? radius + 1 : size, 0, 7); ink.fill();
    if (mark === "labelled" && p.name !== name) write(ink, short(p.name), x, y - radius - 9, colour("labelled"), paper);
  });
  const target = drawn.find(([one]) => one === name);
  if (target) {
    const [, x, y] = target;
    ring(ink, [x, y], radius + 5, {colour: colour("wanted")}, 3, name in data.marks ? [] : [5, 3]);
    write(ink, short(name), Math.min(Math.max(x, 20), w - 20), y < 26 ? y + radius + 15 : y - radius - 14, colour("wanted"), paper, 16);
  }
  // the axes, at the corner: which way the numbers of the layout grow
  const o = [24, h - 24];
  [[a, [turn[0][0], turn[1][0]]], [b, [turn[0][1], turn[1][1]]]].forEach(([axis, way]) => {
    const from = [way[0] < 0 ? o[0] + 26 : o[0], way[1] > 0 ? o[1] - 26 : o[1]], to = [from[0] + 20 * way[0], from[1] + 20 * way[1]];
    ink.strokeStyle = colour("soft"); ink.fillStyle = colour("soft"); ink.lineWidth = 1.5;
    ink.beginPath(); ink.moveTo(...from); ink.lineTo(...to); ink.stroke();
    ink.beginPath(); ink.arc(...to, 3, 0, 7); ink.fill();
    write(ink, "xyz"[axis], to[0] + 10 * way[0], to[1] + 10 * way[1], colour("soft"), paper, 13);
  });
  by("depths").textContent = depths.length > 1
    ? `Larger dots: larger ${"xyz"[c]} (${depths.length > 6 ? `${depths[0]} to ${depths.at(-1)}` : depths.join(", ")}${all.unit && " " + all.unit}).` : "";
}

layout.addEventListener("click", (event) => {
  let best = null, off = 24;
  for (const [name, x, y] of drawn) {
    const d = Math.hypot(x - event.offsetX, y - event.offsetY);
    if (d < off) { best = name; off = d; }
  }
  if (best) { chosen = best; say(null); paint(); }
});

// ------------------------------------------------------------------------------------------------ words

function tag(name, text, kind) {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

function words() {
  by("title").textContent = `${all.name}: label the dots`;
  document.title = `${all.name}: label the dots`;
  by("cameras").replaceChildren(...all.pictures.map((one, i) => {
    const button = tag("button", `${one.camera}${one.shot && ` ${one.shot}`} `);
    button.append(tag("span", `${one.labels} of ${all.needed}${one.labels >= all.needed ? " ✓" : ""}`, one.labels >= all.needed ? "done" : ""));
    button.setAttribute("aria-current", i === view);
    button.onclick = () => { show(i); button.blur(); };
    return button;
  }));
  by("file").replaceChildren("Every label is saved at once in ", tag("code", all.file));
  const name = wanted();
  const label = name !== null && data && name in data.marks, spot = guess?.dots?.[name];
  const unready = all.pictures.findIndex((one) => one.labels < all.needed);
  const task = by("task");
  if (closed) task.textContent = "Closed. Every label is saved; you can close this page.";
  else if (!data) task.textContent = "";
  else if (name === null) task.textContent = "Every dot has a label.";
  else if (enough() && chosen === null) task.replaceChildren(tag("b", "Enough here."), unready < 0 ? " Finish, or label more." : " Next camera, or label more.");
  else if (label) task.replaceChildren(tag("b", name), " is chosen: click where it belongs, or delete it.");
  else if (spot && guess?.are?.has(name)) task.replaceChildren("Is this ", tag("b", name), "? Accept it, or click the right dot.");
  else if (spot) task.replaceChildren("Click ", tag("b", name), ", about where the dashed ring is.");
  else task.replaceChildren("Click ", tag("b", name), " in the picture: it is ringed in the drawing.");
  by("accept").disabled = closed || label || !spot;
  by("skip").disabled = closed || !data || label || name === null;
  by("undo").disabled = closed || !data?.undo;
  by("delete").disabled = closed || !label;
  by("next").disabled = closed || all.pictures.length < 2;
  by("finish").disabled = closed;
  by("next").className = enough() && unready >= 0 ? "go" : "";
  by("finish").className = enough() && unready < 0 ? "go" : "";
  by("accept").className = enough() ? "" : "go";
  by("guess").replaceChildren(...guessed(count()));
  by("bright").firstChild.textContent = bright ? "Brightened " : "As it is ";
  if (data && by("names").childElementCount !== data.points.length)
    by("names").replaceChildren(...data.points.map((p) => { const o = document.createElement("option"); o.value = p.name; return o; }));
}

function guessed(labels) {
  if (!data) return [];
  const ready = all.pictures.every((one) => one.labels >= all.needed);
  const then = ready ? [document.createElement("br"), "Enough in all pictures. Next: ", tag("code", all.then)] : [];
  if (labels < all.guesses_from)
    return [`${labels} of ${all.needed} labels. Spread them over the target and its depths; from ${all.guesses_from} on, the others are proposed.`];
  if (!guess || guess.busy) return ["Looking for the other dots …", ...then];
  if (guess.doubt) return [`${labels} labels, but ${guess.doubt}`];
  const missing = Object.keys(guess.dots).length - guess.found.length - guess.unsure.length;
  const parts = [`${guess.found.length} of ${data.points.length} dots found`];
  if (missing) parts.push(`${missing} missing (hidden, or too faint)`);
  if (guess.unsure.length) parts.push(`${guess.unsure.length} too uncertain yet: label one among them`);
  if (guess.outside) parts.push(`${guess.outside} outside the picture`);
  if (guess.lost.length) parts.push(`no dot where ${guess.lost.join(", ")} is labelled: move or delete it`);
  const more = labels < all.needed ? ` ${all.needed - labels} more label${all.needed - labels > 1 ? "s" : ""}, please.` : "";
  return [`${parts.join("; ")}.${more}`, ...then];
}

// ------------------------------------------------------------------------------------------------ begin

new ResizeObserver(() => { if (all) { if (fitted) fit(); paint(); } }).observe(picture);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => all && paint());
ask("api/labels").then((found) => {
  all = found;
  return show(Math.max(0, all.pictures.findIndex((one) => one.labels < all.needed)));
}, say);
