// The page of `implicam view`: what is on the screen, and the buttons; scene3d.js draws.

import {Scene3D, cividis} from "./scene3d.js";

const by = (id) => document.getElementById(id);
const SHOWN = [["cameras", "cameras", "camera"], ["pictures", "pictures", "camera"],
  ["known", "known points", "known"], ["volume", "uncertainty", ""], ["measured", "measured points", "measured"],
  ["ellipsoids", "95 % ellipsoids", "measured"], ["box", "box", "soft"]];
const TIMES = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000];
const LAST = 8, MOST_REASONS = 100, HOVER_PX = 10, TOUCH_PX = 24, USUAL_ELLIPSOID = 0.03;

const OUTSIDE = by("hint").textContent;

let world = null, scene = null, maps = null;
const points = {names: [], xyz: [], cov: [], views: [], consistency: [], reason: []};
const rows = new Map(), unmeasured = new Map();  // name -> where it is in points; name -> why not
let notShown = 0, chosen = false, ended = false;
window.implicam = {points, get scene() { return scene; }, get world() { return world; }};  // for a browser's console

const number = (value, digits = 4) => {
  if (value === null || !Number.isFinite(value)) return "–";
  const rounded = Number(value.toPrecision(digits)), size = Math.abs(rounded);
  return size !== 0 && (size < 1e-4 || size >= 1e7) ? rounded.toExponential() : String(rounded);
};
const place = (xyz, sd) => {  // two digits of the uncertainty
  const last = sd > 0 ? Math.max(0, Math.min(12, 1 - Math.floor(Math.log10(sd)))) : 3;
  return xyz.map((value) => value.toFixed(last));
};
const usual = (cov) => Math.sqrt((cov[0] + cov[3] + cov[5]) / 3);

async function ask(path, body) {
  let answer;
  try {
    answer = await fetch(path, body === undefined ? {} : {method: "POST", body: JSON.stringify(body)});
  } catch {
    throw {error: "implicam view does not answer.", fix: "Start it again in the terminal."};
  }
  const found = await answer.json().catch(() => ({error: `The server answered ${answer.status}.`}));
  if (!answer.ok) throw found;
  return found;
}

function say(problem) {
  by("said").hidden = !problem;
  by("said").textContent = !problem ? "" : [problem.error, problem.why && `why: ${problem.why}`,
    problem.fix && `fix: ${problem.fix}`].filter(Boolean).join("\n");
}

function option(select, value, text = value) {
  const one = document.createElement("option");
  one.value = value;
  one.textContent = text;
  select.append(one);
}

function look(from) {
  if (from && !scene.lookThrough(from)) {
    say({error: `${from} cannot be looked through.`, why: "too little of its picture can be drawn"});
    from = "";
  }
  if (!from) scene.aim();
  by("hint").textContent = from ? `as ${from} sees it · drag: turn · wheel: zoom · 0: the whole rig` : OUTSIDE;
  by("from").value = from;
}

// ------------------------------------------------------------------------------------------------ what can be changed

function setUp() {
  by("title").textContent = world.name ? `${world.name}` : "implicam view";
  document.title = `${world.name || "implicam"} · implicam view`;
  const cameras = world.cameras.length;
  by("subtitle").textContent = [world.method, cameras && `${cameras} cameras`,
    `${world.known.names.length} known points`].filter(Boolean).join(" · ");
  for (const text of world.notes) by("notes").append(Object.assign(document.createElement("li"), {textContent: text}));
  const there = {cameras, pictures: cameras, known: world.known.names.length, volume: world.maps, measured: true,
    ellipsoids: true, box: true};
  for (const [name, text, colour] of SHOWN) {
    if (!there[name]) continue;
    const label = document.createElement("label"), box = document.createElement("input"), dot = document.createElement("i");
    Object.assign(box, {type: "checkbox", checked: true, id: `show-${name}`});
    box.addEventListener("change", () => scene.show(name, box.checked));
    if (colour) dot.style.background = `var(--${colour})`;
    else dot.style.background = "linear-gradient(90deg, #00204c, #7d7d78, #ffe945)";
    label.append(box, dot, text);
    by("shown").append(label);
  }
  option(by("from"), "", "outside");
  for (const camera of world.cameras) option(by("from"), camera.name);
  by("from").addEventListener("change", () => look(by("from").value));
  by("look").hidden = !cameras;
  by("whole").addEventListener("click", () => look(""));
  by("pictures").hidden = !world.shots.length;
  for (const shot of world.shots) option(by("shot"), shot, shot || "the only one");
  by("shot").addEventListener("change", showPictures);
  by("source").addEventListener("change", chooseMap);
  by("threshold").addEventListener("input", threshold);
  by("magnified").addEventListener("input", () => { chosen = true; magnify(); });
  by("end").addEventListener("click", async () => {
    ended = true;
    try { await ask("api/stop", {}); } catch (problem) { say(problem); return; }
    by("note").hidden = false;
    by("note").textContent = "Ended. This page can be closed.";
    by("end").disabled = true;
  });
}

async function showPictures() {
  say(null);
  const shot = by("shot").value;
  const query = (camera) => `picture.jpg?camera=${encodeURIComponent(camera)}&shot=${encodeURIComponent(shot)}`;
  const shown = await Promise.all(world.cameras.map(({name}) =>
    scene.setPicture(name, world.pictures[name]?.includes(shot) ? query(name) : null)));
  document.body.dataset.pictures = shown.filter(Boolean).length;
  const wrong = world.cameras.find(({name}, i) => shown[i] === false && world.pictures[name]?.includes(shot));
  if (wrong) try { await ask(query(wrong.name)); } catch (problem) { say(problem); }
}

function chooseMap() {
  scene.setMap(maps.axes, maps.maps[by("source").value]);
  by("low").textContent = `${number(scene.bottom, 3)} ${world.unit}`;
  by("high").textContent = `${number(scene.top, 3)} ${world.unit} or more`;
  threshold();
}

function threshold() {
  const {sorted, missing: blind} = scene.map, part = Number(by("threshold").value) / 100;
  const at = Math.min(Math.floor(part * sorted.length), sorted.length - 1);
  const level = part >= 1 ? Infinity : sorted[at];
  scene.setThreshold(level);
  const all = sorted.length + blind, share = Math.round(100 * (sorted.length - at) / all);
  const unseen = blind ? `; grey: seen by fewer than two cameras (${Math.round(100 * blind / all)} %)` : "";
  by("level").textContent = part >= 1 ? `nothing is shown${unseen}`
    : `standard uncertainty at least ${number(level, 3)} ${world.unit}: ${share} % of the box${unseen}`;
}

function magnify() {
  const times = TIMES[Number(by("magnified").value)];
  by("times").textContent = `× ${times}`;
  scene.setMagnified(times);
}

// --------------------------------------------------------------------------------------------------- measured points

function take(chunk) {
  if (chunk.note !== undefined) {
    by("note").textContent = chunk.note;
    by("note").hidden = !chunk.note;
    return;
  }
  for (const [name, reason] of chunk.missing) unmeasured.set(name, reason);
  chunk.names.forEach((name, i) => {  // one that was measured before is where it is now
    unmeasured.delete(name);
    const at = rows.get(name) ?? points.names.length;
    rows.set(name, at);
    for (const key of Object.keys(points)) points[key][at] = chunk[key][i];
  });
  notShown += chunk.not_shown;
  scene.setMeasured(points.xyz, points.cov);
  if (!chosen && points.names.length) {
    const ideal = USUAL_ELLIPSOID / Math.max(scene.usualEllipsoid(), 1e-12);
    by("magnified").value = Math.max(TIMES.filter((times) => times <= ideal).length - 1, 0);
    magnify();
  }
  by("measured").hidden = false;
  const count = points.names.length;
  by("count").textContent = [`${count} point${count === 1 ? "" : "s"} (sd: per axis)`, unmeasured.size && `${unmeasured.size} could not be measured`,
    notShown && `${notShown} more are not shown`].filter(Boolean).join(", ");
  if (chunk.alarm) say({error: chunk.alarm});
  by("why").hidden = !unmeasured.size;
  by("reasons").replaceChildren(...[...unmeasured].slice(-MOST_REASONS).reverse().map(([name, reason]) =>
    Object.assign(document.createElement("li"), {textContent: `${name}: ${reason}`})));
  const lines = points.names.slice(-LAST).map((name, i, last) => {
    const k = points.names.length - last.length + i, sd = usual(points.cov[k]);
    return [name, ...place(points.xyz[k], sd), number(sd, 2)];
  });
  const table = document.createElement("table");  // the newest first
  for (const [cells, kind] of [[["", "x", "y", "z", `sd, ${world.unit}`], "th"],
    ...lines.reverse().map((row) => [row, "td"])]) {
    const line = table.insertRow();
    for (const text of cells) line.append(Object.assign(document.createElement(kind), {textContent: text, title: text}));
  }
  by("last").replaceChildren(table);
}

function listen() {
  const source = new EventSource("api/points");
  source.onmessage = (event) => take(JSON.parse(event.data));
  source.onopen = () => { if (document.body.dataset.lost) { delete document.body.dataset.lost; say(null); } };
  source.onerror = () => {
    if (ended) { source.close(); return; }
    document.body.dataset.lost = "yes";
    say({error: "implicam view does not answer.", fix: "Start it again in the terminal, or close this page."});
  };
}

// -------------------------------------------------------------------------------------------------- pointer and keys

function tell(event) {
  const within = event.pointerType === "touch" ? TOUCH_PX : HOVER_PX;
  const found = event.buttons && event.type === "pointermove" ? null : scene.pick(event.clientX, event.clientY, within);
  const told = by("told");
  told.hidden = !found;
  if (!found) return;
  const {kind, index} = found;
  if (kind === "known") {
    const state = world.known.state[index];
    told.textContent = [`${world.known.names[index]} (known point)`, world.known.xyz[index].map((v) => number(v, 7)).join(", ")
      + ` ${world.unit}`, state].filter(Boolean).join("\n");
  } else {
    const cov = points.cov[index], sd = [cov[0], cov[3], cov[5]].map((v) => number(Math.sqrt(v), 2));
    const agree = points.consistency[index];
    told.textContent = [points.names[index], `${place(points.xyz[index], usual(cov)).join(", ")} ${world.unit}`,
      `standard uncertainty ${sd.join(", ")}`, `${points.views[index]} views` +
      (agree === null ? "" : `, agreement p = ${number(agree, 2)}`), points.reason[index]].filter(Boolean).join("\n");
  }
  const box = by("stage").getBoundingClientRect();
  const x = event.clientX - box.left, y = event.clientY - box.top;
  told.style.left = `${Math.max(4, Math.min(x + 14, box.width - told.offsetWidth - 4))}px`;
  told.style.top = `${y + 18 + told.offsetHeight > box.height ? Math.max(4, y - told.offsetHeight - 12) : y + 18}px`;
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || ["INPUT", "SELECT"].includes(event.target.tagName)) return;
  if (event.key === "0") look("");
  const cameras = [...by("from").options].map((one) => one.value);
  const step = {"]": 1, "[": -1}[event.key];
  if (step) look(cameras[(cameras.indexOf(by("from").value) + step + cameras.length) % cameras.length]);
}

async function begin() {
  try {
    world = await ask("api/scene");
    try {
      scene = new Scene3D(by("scene"), world.placing);
    } catch (error) {
      throw {error: "This browser cannot draw in three dimensions.", why: String(error.message ?? error),
        fix: "Switch WebGL on, or use another browser."};
    }
    setUp();
    scene.setBox(world.box, world.unit, (value) => number(value, 3));
    scene.setCameras(world.cameras, world.grid[0], world.grid[1]);
    scene.setKnown(world.known.xyz, world.known.state.map((state) => state !== "not used"));
    scene.fit();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scene.theme());
    const canvas = by("scene");
    canvas.addEventListener("pointermove", tell);
    canvas.addEventListener("pointerdown", (event) => { scene.turned = true; if (event.pointerType === "touch") tell(event); });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons && scene.looking) scene.turnBy(event.movementX, event.movementY);
    });
    canvas.addEventListener("wheel", (event) => {
      scene.turned = true;
      scene.zoomBy(Math.exp(event.deltaY / 800));
    }, {passive: true});
    canvas.addEventListener("pointerleave", () => { by("told").hidden = true; });
    document.addEventListener("keydown", key);
    const pen = by("bar").getContext("2d");
    for (let x = 0; x < 256; x++) {
      pen.fillStyle = `rgb(${cividis(x / 255).map((v) => Math.round(255 * v)).join(",")})`;
      pen.fillRect(x, 0, 1, 1);
    }
    if (world.shots.length) showPictures();
    listen();
    if (world.maps) {
      by("uncertainty").hidden = false;
      maps = await ask("api/map");
      for (const name of Object.keys(maps.maps)) option(by("source"), name);
      by("computing").hidden = true;
      by("map").hidden = false;
      chooseMap();
    }
    document.body.dataset.ready = "yes";
  } catch (problem) { by("computing").hidden = true; say(problem.error ? problem : {error: String(problem)}); }
}

begin();
