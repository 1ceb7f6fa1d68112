// How to reach x, y, z by hand: a ruler, a block with holes, a slide with slots, each drawn with the target's numbers.

const SVG = "http://www.w3.org/2000/svg", AXES = ["x", "y", "z"];
const WIDE = 380, HIGH = 236, FAR = 4;  // an origin so many sizes of the workspace away is not drawn

const text = (value) => String(Number(value.toPrecision(6))).replace("-", "−");
const put = (parent, name, attributes, words = null) => {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (words !== null) made.textContent = words;
  parent.append(made);
  return made;
};

// The drawing, and what to do in words. kind: ruler, block, or slide-x, -y, -z. space: box [low, high], levels (three
// lists, or null), rotation (rows: from the world to where the third is up), unit.
export function drawReach(svg, kind, target, space) {
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${WIDE} ${HIGH}`);
  put(put(put(svg, "defs", {}), "marker", {id: "tip", viewBox: "0 0 8 8", refX: 6, refY: 4, markerWidth: 5, markerHeight: 5,
    orient: "auto-start-reverse"}), "path", {d: "M0 0 L8 4 L0 8 z", fill: "context-stroke"});
  if (kind === "block") return drawBlock(svg, target, space);
  if (kind.startsWith("slide")) return drawSlide(svg, target, space, AXES.indexOf(kind.at(-1)));
  return drawRuler(svg, target, space);
}

// ------------------------------------------------------------------------------------------------------------- ruler

function drawRuler(svg, target, {box: [low, high], rotation, unit}) {
  const size = Math.hypot(...high.map((value, i) => value - low[i]));
  const middle = low.map((value, i) => (value + high[i]) / 2);
  const near = Math.hypot(...middle) < FAR * size, origin = near ? [0, 0, 0] : low;
  const turn = -65 * Math.PI / 180, tilt = 24 * Math.PI / 180;
  const right = [-Math.sin(turn), Math.cos(turn), 0];
  const upward = [-Math.cos(turn) * Math.sin(tilt), -Math.sin(turn) * Math.sin(tilt), Math.cos(tilt)];
  const flat = (xyz) => {
    const there = rotation.map((row) => row.reduce((sum, value, i) => sum + value * (xyz[i] - middle[i]), 0));
    return [right, upward].map((along) => along.reduce((sum, value, i) => sum + value * there[i], 0));
  };
  const corners = [...Array(8).keys()].map((k) => low.map((value, axis) => k >> axis & 1 ? high[axis] : value));
  const ends = AXES.map((_, axis) => origin.map((value, i) =>
    i === axis ? Math.max(value, high[i]) + 0.16 * size : value));
  const starts = AXES.map((_, axis) => origin.map((value, i) => i === axis ? Math.min(value, low[i]) : value));
  const all = [...corners, ...ends, ...starts, origin, target].map(flat);
  const [left, top] = [Math.min(...all.map((p) => p[0])), Math.max(...all.map((p) => p[1]))];
  const [wide, high2] = [Math.max(...all.map((p) => p[0])) - left, top - Math.min(...all.map((p) => p[1]))];
  const scale = Math.min((WIDE - 96) / wide, (HIGH - 44) / high2);
  const at = (xyz) => { const p = flat(xyz); return [(WIDE - scale * wide) / 2 + scale * (p[0] - left), 22 + scale * (top - p[1])]; };
  const line = (a, b, kind, more = {}) => {
    const [p, q] = [at(a), at(b)];
    return put(svg, "line", {x1: p[0], y1: p[1], x2: q[0], y2: q[1], class: kind, ...more});
  };
  for (let k = 0; k < 8; k++)
    for (const bit of [1, 2, 4]) if (!(k & bit)) line(corners[k], corners[k | bit], "edge");
  const names = [];
  AXES.forEach((name, axis) => {
    line(starts[axis], ends[axis], `axis ${name}`, {"marker-end": "url(#tip)"});
    const [x, y] = at(ends[axis]), [x0, y0] = at(origin), far = Math.hypot(x - x0, y - y0) || 1;
    names.push({x: x + 11 * (x - x0) / far, y: y + 5 + 11 * (y - y0) / far, words: name, kind: `name ${name}`});
  });
  let here = [...origin];
  const labels = [];
  AXES.forEach((name, axis) => {
    const next = here.map((value, i) => i === axis ? target[axis] : value);
    line(here, next, `way ${name}`);
    const [p, q] = [at(here), at(next)], middle2 = [0, 1].map((i) => (p[i] + q[i]) / 2);
    const along = Math.abs(q[0] - p[0]) > Math.abs(q[1] - p[1]);  // below what lies, beside what stands
    labels.push({x: middle2[0] + (along ? 0 : 30), y: middle2[1] + (along ? 19 : 5), words: `${name} ${text(target[axis])}`,
      kind: `length ${name}`});
    here = next;
  });
  const [bx, by] = at(target), [ox, oy] = at(origin);
  put(svg, "circle", {cx: bx, cy: by, r: 8, class: "ball"});
  put(svg, "circle", {cx: ox, cy: oy, r: 4, class: "origin"});
  labels.push({x: ox - 14, y: oy + 14, words: near ? "0" : `(${low.map(text).join(", ")})`, kind: "name", anchor: near ? "middle" : "start"});
  spread([...labels, ...names]);
  for (const {x, y, words, kind, anchor} of [...names, ...labels])
    put(svg, "text", {x: Math.min(Math.max(x, 22), WIDE - 30), y: Math.min(Math.max(y, 14), HIGH - 4), class: kind, "text-anchor": anchor ?? "middle"}, words);
  const from = near ? "From the origin, where x, y and z are 0," : `From the corner x ${text(low[0])}, y ${text(low[1])}, z ${text(low[2])}`;
  const step = (axis) => `${text(near ? target[axis] : target[axis] - low[axis])} ${unit} along ${AXES[axis]}`;
  return `${from} measure ${step(0)}, then ${step(1)}, then ${step(2)}.${target.some((v) => v < 0) && near ? " A minus is against the arrow." : ""}`;
}

// Labels that lie on each other are moved apart, down the page.
function spread(labels) {
  const half = ({words}) => 5 + 4.6 * words.length;
  for (let round = 0; round < 6; round++)
    for (const a of labels)
      for (const b of labels) {
        if (a === b || Math.abs(a.x - b.x) > half(a) + half(b) || Math.abs(a.y - b.y) >= 17) continue;
        const [upper, lower] = a.y <= b.y ? [a, b] : [b, a], more = (17 - (lower.y - upper.y)) / 2;
        upper.y -= more;
        lower.y += more;
      }
}

// ------------------------------------------------------------------------------------------------------ block and slide

// Which axis of the world is up, and whether it points up or down.
function upAxis(rotation) {
  const up = rotation[2], axis = up.reduce((best, value, i) => Math.abs(value) > Math.abs(up[best]) ? i : best, 0);
  return {axis, sign: Math.sign(up[axis])};
}

// Seen from where an axis points (sign 1) or from its other end: which axes go right and up, and whether that is their
// positive direction. right = up x towards the eye; what is up in the world is up here, where it can be.
function facing(axis, sign, up) {
  const v = up.axis === axis ? (axis + 2) % 3 : up.axis, h = 3 - axis - v, turn = sign * ((v + 1) % 3 === axis ? 1 : -1);
  const vSign = up.axis === axis ? turn : up.sign;
  return {h, v, hSign: vSign * turn, vSign};
}

function marks(low, high) {  // round numbers, about six
  const rough = (high - low) / 6, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((times) => times * power >= rough * 0.999), found = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9 * step; value += step) found.push(Number(value.toPrecision(10)));
  return found;
}

const nth = (levels, value) => {
  if (!levels) return "";
  const nearest = levels.reduce((best, one, i) => Math.abs(one - value) < Math.abs(levels[best] - value) ? i : best, 0);
  return ` (${nearest + 1} of ${levels.length})`;
};

// A view along one axis, into the rectangle [x0, y0, wide, high] of the drawing: holes or lines, the target, its numbers.
function panel(svg, [x0, y0, wide, high], {h, v, hSign, vSign}, target, {box: [low, top], levels}, holes) {
  const scale = Math.min(wide / (top[h] - low[h]), high / (top[v] - low[v]));
  const [w, t] = [scale * (top[h] - low[h]), scale * (top[v] - low[v])], left = x0 + (wide - w) / 2, bottom = y0 + (high + t) / 2;
  const X = (value) => left + scale * (hSign > 0 ? value - low[h] : top[h] - value);
  const Y = (value) => bottom - scale * (vSign > 0 ? value - low[v] : top[v] - value);
  put(svg, "rect", {x: left - 9, y: bottom - t - 9, width: w + 18, height: t + 18, rx: 5, class: "body"});
  const [hs, vs] = [h, v].map((axis) => levels?.[axis] ?? marks(low[axis], top[axis]));
  if (holes) {
    const r = Math.max(1.5, Math.min(6, 0.3 * Math.min(w / Math.max(hs.length - 1, 1), t / Math.max(vs.length - 1, 1))));
    for (const a of hs) for (const b of vs) put(svg, "circle", {cx: X(a), cy: Y(b), r, class: "hole"});
  } else {
    for (const a of hs) put(svg, "line", {x1: X(a), x2: X(a), y1: bottom - t, y2: bottom, class: "edge"});
    for (const b of vs) put(svg, "line", {x1: left, x2: left + w, y1: Y(b), y2: Y(b), class: "edge"});
  }
  const [hName, vName] = [AXES[h], AXES[v]], [tx, ty] = [X(target[h]), Y(target[v])];
  put(svg, "line", {x1: tx, x2: tx, y1: bottom + 9, y2: ty, class: `dash ${hName}`});
  put(svg, "line", {x1: left - 9, x2: tx, y1: ty, y2: ty, class: `dash ${vName}`});
  put(svg, "circle", {cx: tx, cy: ty, r: 8, class: "ball"});
  put(svg, "text", {x: Math.max(tx, 30), y: bottom + 25, class: `length ${hName}`, "text-anchor": "middle"}, `${hName} ${text(target[h])}`);
  put(svg, "text", {x: left - 14, y: ty + 5, class: `length ${vName}`, "text-anchor": "end"}, `${vName} ${text(target[v])}`);
  const arrow = (x1, y1, x2, y2, name) => put(svg, "line", {x1, y1, x2, y2, class: `axis ${name}`, "marker-end": "url(#tip)"});
  const [ax, ay] = [left + w + 16, bottom - t - 14];
  hSign > 0 ? arrow(left + w - 34, ay, left + w, ay, hName) : arrow(left + w, ay, left + w - 34, ay, hName);
  vSign > 0 ? arrow(ax, ay + 40, ax, ay + 6, vName) : arrow(ax, ay + 6, ax, ay + 40, vName);
  put(svg, "text", {x: left + w - 44, y: ay + 5, class: `name ${hName}`, "text-anchor": "middle"}, hName);
  put(svg, "text", {x: ax, y: ay + 57, class: `name ${vName}`, "text-anchor": "middle"}, vName);
}

function drawBlock(svg, target, space) {
  const up = upAxis(space.rotation), {axis} = up, name = AXES[axis], {box: [low, high], levels, unit} = space;
  put(svg, "text", {x: 4, y: 14, class: "note"}, "seen from above");
  put(svg, "text", {x: WIDE - 4, y: 14, class: "note", "text-anchor": "end"}, "from the side");
  const across = facing(axis, up.sign, up);
  panel(svg, [72, 34, 176, 156], across, target, space, levels !== null);
  const x = 322, [y0, y1] = [200, 40];
  const Y = (value) => y0 + (y1 - y0) * (up.sign > 0 ? value - low[axis] : high[axis] - value) / (high[axis] - low[axis]);
  put(svg, "line", {x1: x, x2: x, y1: y0 + 12, y2: y1 - 16, class: `axis ${name}`, ...{[up.sign > 0 ? "marker-end" : "marker-start"]: "url(#tip)"}});
  for (const value of levels?.[axis] ?? marks(low[axis], high[axis])) {
    put(svg, "line", {x1: x - 6, x2: x + 6, y1: Y(value), y2: Y(value), class: "tick"});
    put(svg, "text", {x: x + 11, y: Y(value) + 4, class: "small"}, text(value));
  }
  const ground = put(svg, "line", {x1: x - 30, x2: x + 20, y1: y0 + 16, y2: y0 + 16, class: "ground"});
  ground.setAttribute("aria-hidden", "true");
  put(svg, "line", {x1: x - 18, x2: x - 18, y1: y0 + 14, y2: Y(target[axis]), class: `way ${name}`});
  put(svg, "circle", {cx: x - 18, cy: Y(target[axis]), r: 8, class: "ball"});
  put(svg, "text", {x: x - 14, y: HIGH - 3, class: `length ${name}`, "text-anchor": "middle"}, `${name} ${text(target[axis])}`);
  const say = (k) => `${AXES[k]} ${text(target[k])}${nth(levels?.[k], target[k])}`;
  const where = `${say(across.h)}, ${say(across.v)}; the ball's middle at the height ${say(axis)}, in ${unit}.`;
  return levels ? `The hole at ${where}` : `At ${where} Which holes there are is not known: begin the session with, for example, ` +
    '--workspace "x=0,50,100 y=0:80:20 z=0,40", and each target is one of them.';
}

function drawSlide(svg, target, space, axis) {
  const {box: [low, high], levels, unit, rotation} = space, name = AXES[axis], up = upAxis(rotation);
  const face = facing(axis, 1, up);
  put(svg, "text", {x: 4, y: 14, class: "note"}, `the plate, from where ${name} points`);
  panel(svg, [92, 34, 190, 92], face, target, space, false);
  const [x0, x1, y] = [40, WIDE - 48, 196], X = (value) => x0 + (x1 - x0) * (value - low[axis]) / (high[axis] - low[axis]);
  put(svg, "rect", {x: x0 - 14, y: y - 4, width: x1 - x0 + 28, height: 12, rx: 3, class: "body"});
  put(svg, "line", {x1: x1 + 6, x2: x1 + 30, y1: y + 2, y2: y + 2, class: `axis ${name}`, "marker-end": "url(#tip)"});
  put(svg, "text", {x: x1 + 40, y: y + 7, class: `name ${name}`, "text-anchor": "middle"}, name);
  const values = levels?.[axis] ?? marks(low[axis], high[axis]);
  values.forEach((value, i) => {
    put(svg, "line", {x1: X(value), x2: X(value), y1: y - 4, y2: y + 8, class: levels ? "slot" : "tick"});
    if (values.length <= 9 || i % Math.ceil(values.length / 8) === 0)
      put(svg, "text", {x: X(value), y: y + 24, class: "small", "text-anchor": "middle"}, text(value));
  });
  const at = X(target[axis]);
  put(svg, "line", {x1: at, x2: at, y1: y - 30, y2: y + 6, class: `plate ${name}`});
  put(svg, "circle", {cx: at, cy: y - 20, r: 7, class: "ball"});
  const right = at < WIDE / 2;
  put(svg, "text", {x: at + (right ? 13 : -13), y: y - 14, class: `length ${name}`, "text-anchor": right ? "start" : "end"}, `${name} ${text(target[axis])}`);
  const say = (k) => `${AXES[k]} ${text(target[k])}${nth(levels?.[k], target[k])}`;
  return `The slide at ${say(axis)}; on its plate ${say(face.h)} and ${say(face.v)}, in ${unit}.`;
}
