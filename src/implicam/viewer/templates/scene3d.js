// A rig in three dimensions: cameras and their pictures, points, ellipsoids, and the region where the uncertainty is
// above a threshold. It draws what it is given, in the world of the calibration; a page around it has the buttons.

import * as THREE from "three";
import {OrbitControls} from "orbit";

const FOV_DEGREES = 40, FILLED = 0.84, POINT_PX = 6, LABEL_PX = 14, NARROW_PX = 600;
const ELLIPSOID_95 = Math.sqrt(7.814728);  // 95 % of a normal distribution in three dimensions are within
const BESIDE = 1.4, WIDEST_DEGREES = 110;    // what is shown from a camera's place: beside the points, and at most
const MAX_ELLIPSOIDS = 5000;
const FINER = 3;                           // steps between two places of the map, for the surface
const CIVIDIS = [[0, 32, 76], [0, 49, 111], [57, 72, 107], [87, 92, 109], [112, 113, 115], [138, 134, 120],
  [165, 157, 116], [195, 181, 105], [226, 206, 84], [255, 233, 69]];

const GROUPS = ["box", "cameras", "pictures", "known", "volume", "measured", "ellipsoids", "cloud", "skipped", "target", "ball"];

// Where a label may stand beside its place, the best first: which part of it is at the place, from its lower left corner.
const LABEL_ANCHORS = [[0.5, 0.5], [0.5, -0.4], [0.5, 1.4], [-0.15, 0.5], [1.15, 0.5], [0, -0.4], [1, -0.4], [0, 1.4], [1, 1.4]];

export const cividis = (part) => {
  const at = Math.min(Math.max(part, 0), 1) * (CIVIDIS.length - 1), k = Math.min(Math.floor(at), CIVIDIS.length - 2);
  return CIVIDIS[k].map((value, i) => (value + (at - k) * (CIVIDIS[k + 1][i] - value)) / 255);
};

export class Scene3D {
  // placing: centre, scale and rotation (rows) from the world to the scene, which is two units across, z up.
  constructor(canvas, placing) {
    this.canvas = canvas;
    this.placing = placing;
    this.renderer = new THREE.WebGLRenderer({canvas, antialias: true, preserveDrawingBuffer: true});
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8890a0, 2.6));
    const sun = new THREE.DirectionalLight(0xffffff, 1.2);
    sun.position.set(1, -2, 3);
    this.scene.add(sun);
    this.camera = new THREE.PerspectiveCamera(FOV_DEGREES, 1, 0.01, 200);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.redraw());
    this.groups = {};
    for (const name of GROUPS) {
      this.groups[name] = new THREE.Group();
      this.scene.add(this.groups[name]);
    }
    this.wanted = {};
    this.magnified = 1;
    this.reset(placing);
    this.theme();
    new ResizeObserver(() => this.fit()).observe(canvas.parentElement);
  }

  // Everything away; what is drawn then is placed anew.
  reset(placing) {
    this.placing = placing;
    for (const group of Object.values(this.groups)) this.empty(group);
    this.pictures = {};
    this.centres = {};
    this.extent = [];
    this.labels = [];
    this.known = null;
    this.measured = {xyz: [], cov: []};
  }

  empty(group) {
    group.traverse((one) => {
      one.geometry?.dispose();
      one.material?.map?.dispose?.();
      one.material?.dispose();
    });
    group.clear();
  }

  place([x, y, z]) {
    const {centre, scale, rotation} = this.placing;
    const off = [x - centre[0], y - centre[1], z - centre[2]];
    return new THREE.Vector3(...rotation.map((row) => scale * (row[0] * off[0] + row[1] * off[1] + row[2] * off[2])));
  }

  // ---------------------------------------------------------------------------------------------- colours, size, draw

  theme() {
    const style = getComputedStyle(document.documentElement);
    this.colour = (name) => new THREE.Color(style.getPropertyValue(`--${name}`).trim());
    this.scene.background = this.colour("paper");
    for (const label of this.labels) this.write(label);
    this.scene.traverse((one) => {
      if (one.userData.colour) one.material.color.copy(this.colour(one.userData.colour));
    });
    this.redraw();
  }

  fit() {
    const {clientWidth, clientHeight} = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    if (this.looking) this.lookThrough(this.looking);
    else if (!this.turned) this.aim();
    this.camera.updateProjectionMatrix();
    for (const label of this.labels) this.write(label);
    this.redraw();
  }

  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.spread();
      this.renderer.render(this.scene, this.camera);
      this.drawn = (this.drawn ?? 0) + 1;
    });
  }

  show(name, yes) {
    this.wanted[name] = yes;
    this.groups[name].visible = yes && !(name === "cameras" && this.hidden);
    this.redraw();
  }

  // Everything in view, from behind the cameras and a little above, from the side.
  aim() {
    this.looking = null;
    this.controls.enabled = true;
    this.hideOthers(null);
    this.setFov(FOV_DEGREES);
    this.camera.up.set(0, 0, 1);
    const places = this.extent.length ? this.extent : [new THREE.Vector3(1, 1, 1), new THREE.Vector3(-1, -1, -1)];
    const middle = new THREE.Box3().setFromPoints(places).getCenter(new THREE.Vector3());
    const behind = new THREE.Vector3();
    const centres = Object.values(this.centres);
    for (const one of centres) behind.addScaledVector(one.clone().normalize(), 1 / centres.length);
    behind.z = 0;
    const back = behind.length() > 0.3 ? behind.normalize() : new THREE.Vector3(-0.55, -0.83, 0);
    const side = new THREE.Vector3(-back.y, back.x, 0);
    const high = Math.tan(FOV_DEGREES * Math.PI / 360) * FILLED, wide = high * this.camera.aspect;
    let best = null;
    for (const across of [-1.5, -1, -0.6, 0.6, 1, 1.5]) {
      const way = back.clone().addScaledVector(side, across).add(new THREE.Vector3(0, 0, 0.6)).normalize();
      const right = new THREE.Vector3(0, 0, 1).cross(way).normalize(), up = way.clone().cross(right);
      let distance = 0;
      for (const place of places) {
        const off = place.clone().sub(middle);
        distance = Math.max(distance, off.dot(way) + Math.max(Math.abs(off.dot(right)) / wide,
          Math.abs(off.dot(up)) / high));
      }
      if (!best || distance < best.distance) best = {distance, way};
    }
    this.camera.position.copy(middle).addScaledVector(best.way, best.distance);
    this.controls.target.copy(middle);
    this.camera.near = best.distance / 500;
    this.camera.far = best.distance * 20;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.turned = false;
    this.redraw();
  }

  // As a camera sees it: its picture is bent as its lens bends it, so that points lie on their images.
  lookThrough(name) {
    const one = this.pictures[name];
    if (!one || !this.centres[name]) return false;
    const {rows, columns, at} = one;
    const cell = (r, c) => at[r * (columns + 1) + c];
    const r = rows >> 1, c = columns >> 1;
    const [middle, above, below] = [cell(r, c), cell(0, c) ?? cell(1, c), cell(rows, c) ?? cell(rows - 1, c)];
    const [left, right] = [cell(r, 0) ?? cell(r, 1), cell(r, columns) ?? cell(r, columns - 1)];
    if (!middle || !above || !below || !left || !right) return false;
    const centre = this.centres[name], ahead = middle.clone().sub(centre).normalize();
    const half = (a, way) => {  // tangent of the angle from where it looks
      const off = a.clone().sub(centre), deep = off.dot(way);
      return off.addScaledVector(way, -deep).length() / Math.max(deep, 1e-6);
    };
    const box = this.corners?.reduce((sum, one) => sum.addScaledVector(one, 1 / 8), new THREE.Vector3());
    const seen = box && box.clone().sub(centre).dot(ahead) > 0;
    const way = seen ? box.clone().sub(centre).normalize() : ahead;  // of a fisheye, only where the points are
    const wide = Math.max(half(above, ahead), half(below, ahead),
      Math.max(half(left, ahead), half(right, ahead)) / this.camera.aspect);
    const narrow = seen ? BESIDE * Math.max(...this.corners.map((one) => half(one, way))) : wide;
    this.looking = name;
    this.hideOthers(name);
    this.setFov(Math.min(2 * Math.atan(Math.min(1.05 * wide, narrow)) * 180 / Math.PI, WIDEST_DEGREES));
    this.camera.up.copy(above.clone().sub(below).normalize());
    this.camera.position.copy(centre);
    const reach = middle.distanceTo(centre);
    this.camera.near = reach / 10;
    this.camera.far = 2 * centre.length() + 20;
    this.camera.lookAt(centre.clone().addScaledVector(narrow < wide ? way : ahead, reach));
    this.controls.enabled = false;  // turning about the points would leave the camera's place
    this.camera.updateProjectionMatrix();
    this.redraw();
    return true;
  }

  // From a camera's place: the wheel zooms, dragging turns the head.
  zoomBy(factor) {
    if (!this.looking) return;
    this.setFov(Math.min(Math.max(this.camera.fov * factor, 0.2), WIDEST_DEGREES));
    this.redraw();
  }

  turnBy(right, down) {
    if (!this.looking) return;
    const pixel = this.camera.fov * Math.PI / 180 / Math.max(this.canvas.clientHeight, 1);
    this.camera.rotateY(right * pixel);
    this.camera.rotateX(down * pixel);
    this.redraw();
  }

  // From a camera's place only its own picture is there, behind all else.
  hideOthers(name) {
    this.hidden = name !== null;
    this.groups.cameras.visible = !this.hidden && this.wanted.cameras !== false;
    for (const [own, {mesh}] of Object.entries(this.pictures)) {
      mesh.visible = !this.hidden || own === name;
      mesh.material.depthWrite = !this.hidden;
      mesh.material.transparent = !this.hidden || !mesh.material.map;  // what is not transparent is drawn first
      mesh.material.needsUpdate = true;
      mesh.renderOrder = this.hidden ? -1 : 0;
    }
  }

  // -------------------------------------------------------------------------------------------------------- lettering

  // spare: left out where the window is narrow.
  label(text, at, group, colour = "ink", spare = false) {
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({sizeAttenuation: false, depthTest: false}));
    sprite.position.copy(at);
    sprite.renderOrder = 5;
    const label = {sprite, text, colour, spare, group};
    this.labels.push(label);
    this.write(label);
    group.add(sprite);
  }

  // Labels beside one another and inside the window, those that matter most first; what finds no room is left out.
  spread() {
    const {clientWidth: wide, clientHeight: high} = this.canvas, {target, box} = this.groups;
    const corner = this.canvas.getBoundingClientRect();
    const taken = (this.above ?? []).map((one) => one.getBoundingClientRect())
      .map(({left, top, right, bottom}) => [left - corner.left, top - corner.top, right - corner.left, bottom - corner.top]);
    const rank = ({group, spare}) => spare ? 3 : group === target ? 0 : group === box ? 1 : 2;
    for (const label of [...this.labels].sort((a, b) => rank(a) - rank(b))) {
      const {sprite, spare, group} = label;
      sprite.visible = false;
      const at = sprite.position.clone().project(this.camera);
      if (!group.visible || Math.abs(at.z) > 1 || (spare && wide < NARROW_PX)) continue;
      const [across, up] = sprite.userData.pixels, x = (at.x + 1) / 2 * wide, y = (1 - at.y) / 2 * high;
      for (const [right, above] of LABEL_ANCHORS) {
        const [left, top] = [x - right * across, y - (1 - above) * up];
        if (left < 0 || top < 0 || left + across > wide || top + up > high) continue;
        if (taken.some(([l, t, r, b]) => left < r && l < left + across && top + 3 < b && t < top + up - 3)) continue;
        taken.push([left, top, left + across, top + up]);
        sprite.center.set(right, above);
        sprite.visible = true;
        break;
      }
    }
  }

  write({sprite, text, colour}) {
    const ratio = 2, canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
    const font = `600 ${LABEL_PX * ratio}px system-ui, sans-serif`;
    pen.font = font;
    canvas.width = Math.ceil(pen.measureText(text).width) + 8 * ratio;
    canvas.height = Math.ceil(1.5 * LABEL_PX * ratio);
    pen.font = font;
    pen.textBaseline = "middle";
    pen.lineJoin = "round";
    pen.lineWidth = 3 * ratio;
    pen.strokeStyle = `#${this.colour("paper").getHexString()}`;
    pen.fillStyle = `#${this.colour(colour).getHexString()}`;
    pen.strokeText(text, 4 * ratio, canvas.height / 2);
    pen.fillText(text, 4 * ratio, canvas.height / 2);
    sprite.material.map?.dispose();
    sprite.material.map = new THREE.CanvasTexture(canvas);
    sprite.material.map.colorSpace = THREE.SRGBColorSpace;
    sprite.material.needsUpdate = true;
    sprite.userData.pixels = [canvas.width / ratio, canvas.height / ratio];
    this.size(sprite);
  }

  size(sprite) {  // without attenuation a sprite of height h covers h / (2 tan(fov / 2)) of the window
    const pixel = 2 * Math.tan(this.camera.fov * Math.PI / 360) / Math.max(this.canvas.clientHeight, 1);
    sprite.scale.set(...sprite.userData.pixels.map((value) => value * pixel), 1);
  }

  setFov(degrees) {
    this.camera.fov = degrees;
    this.camera.updateProjectionMatrix();
    for (const {sprite} of this.labels) this.size(sprite);
  }

  lines(pairs, colour, group, opacity = 1) {
    const geometry = new THREE.BufferGeometry().setFromPoints(pairs);
    const material = new THREE.LineBasicMaterial({color: this.colour(colour), transparent: opacity < 1, opacity});
    const drawn = new THREE.LineSegments(geometry, material);
    drawn.userData.colour = colour;
    group.add(drawn);
    return drawn;
  }

  // ---------------------------------------------------------------------------------------------- what is in the scene

  // edges: pairs of places, where the workspace is no box.
  setBox([low, high], unit, number, edges = null) {
    const corner = (i) => this.place([0, 1, 2].map((axis) => (i >> axis & 1 ? high : low)[axis]));
    const corners = [...Array(8).keys()].map(corner);
    const pairs = [];
    for (let i = 0; i < 8; i++)
      for (const bit of [1, 2, 4]) if (!(i & bit)) pairs.push(corners[i], corners[i | bit]);
    const hull = edges?.flat().map((place) => this.place(place));
    this.lines(hull ?? pairs, "soft", this.groups.box, 0.7);
    ["x", "y", "z"].forEach((name, axis) => {
      const a = [...low], b = [...low], m = [...low], away = [0, 0, 0];
      b[axis] = high[axis];
      m[axis] = (low[axis] + high[axis]) / 2;
      for (const other of [0, 1, 2]) if (other !== axis) away[other] = -0.06 * (high[other] - low[other]);
      const beside = (p) => this.place(p.map((value, i) => value + away[i]));
      this.label(`${name}, ${unit}`, beside(m), this.groups.box, `axis-${name}`);
      const inward = (p, part) => beside(p.map((v, i) => i === axis ? v + part * (high[i] - low[i]) : v));
      this.label(number(a[axis]), inward(a, 0.1), this.groups.box, "soft", true);
      this.label(number(b[axis]), inward(b, -0.03), this.groups.box, "soft", true);
      this.lines([this.place(a), this.place(b)], `axis-${name}`, this.groups.box);
    });
    this.extent.push(...corners);
    this.corners = corners;
  }

  // cameras: name, centre, whether it is too far to be drawn, and the places of a grid of (rows + 1) x (columns + 1) over the picture.
  setCameras(cameras, rows, columns) {
    for (const camera of cameras) {
      const at = camera.picture.map((place) => place.includes(null) ? null : this.place(place));
      const corner = (r, c) => r * (columns + 1) + c;
      const index = [], edges = new Map();
      for (let r = 0; r < rows; r++)
        for (let c = 0; c < columns; c++) {
          const [a, b, d, e] = [corner(r, c), corner(r, c + 1), corner(r + 1, c), corner(r + 1, c + 1)];
          if ([a, b, d, e].some((k) => !at[k])) continue;
          index.push(a, d, b, b, d, e);
          for (const [p, q] of [[a, b], [d, e], [a, d], [b, e]]) {
            const key = `${p},${q}`;
            edges.set(key, (edges.get(key) ?? 0) + 1);
          }
        }
      const uv = at.map((_, k) => [k % (columns + 1) / columns, 1 - Math.floor(k / (columns + 1)) / rows]);
      const geometry = new THREE.BufferGeometry().setFromPoints(at.map((place) => place ?? new THREE.Vector3()));
      geometry.setAttribute("uv", new THREE.Float32BufferAttribute(uv.flat(), 2));
      geometry.setIndex(index);
      const material = new THREE.MeshBasicMaterial({color: this.colour("camera"), side: THREE.DoubleSide,
        transparent: true, opacity: 0.16});
      const mesh = new THREE.Mesh(geometry, material);
      mesh.userData.colour = "camera";
      this.groups.pictures.add(mesh);
      this.pictures[camera.name] = {mesh, at, rows, columns};
      const outline = [];
      for (const [key, count] of edges)
        if (count === 1) outline.push(...key.split(",").map((k) => at[k]));
      const good = at.map((place, k) => [place, k]).filter(([place]) => place);
      const centre = camera.far ? null : this.place(camera.centre);
      this.centres[camera.name] = this.place(camera.centre);
      if (centre && good.length) {
        for (const [right, down] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
          const size = ([, k]) => right * (uv[k][0] - 0.5) - down * (uv[k][1] - 0.5);
          const [place] = good.reduce((a, b) => size(b) > size(a) ? b : a);
          outline.push(centre, place);
        }
        this.extent.push(centre);
      }
      this.lines(outline, "camera", this.groups.cameras);
      const top = centre ?? at[corner(0, columns >> 1)] ?? good[0]?.[0];
      if (top) this.label(camera.name, top.clone().add(new THREE.Vector3(0, 0, 0.06)), this.groups.cameras, "camera");
      this.extent.push(...[0, columns, corner(rows, 0), corner(rows, columns)].map((k) => at[k]).filter(Boolean));
    }
  }

  setPicture(name, url) {
    const {mesh} = this.pictures[name];
    const plain = () => {
      mesh.material.map = null;
      mesh.userData.colour = "camera";
      mesh.material.color.copy(this.colour("camera"));
      mesh.material.opacity = 0.16;
      mesh.material.needsUpdate = true;
      this.redraw();
    };
    if (!url) return plain();
    return new Promise((done) => new THREE.TextureLoader().load(url, (texture) => {
      texture.colorSpace = THREE.SRGBColorSpace;
      mesh.material.map?.dispose();
      Object.assign(mesh.material, {map: texture, opacity: 1, needsUpdate: true});
      mesh.userData.colour = "";
      mesh.material.color.set(0xffffff);
      this.redraw();
      done(true);
    }, undefined, () => { plain(); done(false); }));
  }

  disc() {
    if (!this.round) {
      const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
      canvas.width = canvas.height = 32;
      pen.fillStyle = "#fff";
      pen.arc(16, 16, 15, 0, 2 * Math.PI);
      pen.fill();
      this.round = new THREE.CanvasTexture(canvas);
    }
    return this.round;
  }

  points(places, colour, group, size = POINT_PX) {
    const geometry = new THREE.BufferGeometry().setFromPoints(places);
    const pixels = size * this.renderer.getPixelRatio();
    const material = new THREE.PointsMaterial({color: this.colour(colour), size: pixels, sizeAttenuation: false,
      map: this.disc(), alphaTest: 0.5});
    const drawn = new THREE.Points(geometry, material);
    drawn.userData.colour = colour;
    group.add(drawn);
    return drawn;
  }

  // used: which of them the calibration uses.
  setKnown(xyz, used) {
    this.known = xyz.map((place) => place.includes(null) ? null : this.place(place));
    const some = (yes) => this.known.filter((place, i) => place && used[i] === yes);
    this.points(some(true), "known", this.groups.known, POINT_PX - 1);
    if (some(false).length) this.points(some(false), "bad", this.groups.known);
  }

  setMarks(name, xyz, colour) {
    this.empty(this.groups[name]);
    if (xyz.length) this.points(xyz.map((place) => this.place(place)), colour, this.groups[name], POINT_PX + 1);
    this.redraw();
  }

  // Balls of a size of the scene, with a halo and a word where one is given: depth is hard to see else.
  setBalls(name, xyz, colour, radius, word = "") {
    const key = JSON.stringify([xyz, this.placing]);
    if (this.balls?.[name] === key && this.groups[name].children.length) return;
    this.balls = {...this.balls, [name]: key};
    const group = this.groups[name];
    this.labels = this.labels.filter((label) => label.sprite.parent !== group);
    this.empty(group);
    for (const place of xyz) {
      const at = this.place(place);
      for (const [times, opacity] of word ? [[1, 1], [2.2, 0.3]] : [[1, 1]]) {
        const material = new THREE.MeshLambertMaterial({color: this.colour(colour), transparent: opacity < 1, opacity});
        const ball = new THREE.Mesh(new THREE.SphereGeometry(times * radius, 24, 16), material);
        ball.position.copy(at);
        ball.userData.colour = colour;
        group.add(ball);
      }
      if (word) this.label(word, at.clone().add(new THREE.Vector3(0, 0, 3 * radius)), group, colour);
    }
    this.redraw();
  }

  // ------------------------------------------------------------------------------------- the region of the uncertainty

  // Places coloured by a value, those from a level on; grey where there is none. colour: of a part from 0 to 1, CSS.
  setCloud(xyz, values, low, high, level, colour = null) {
    const group = this.groups.cloud;
    this.empty(group);
    const shown = xyz.map((_, i) => i).filter((i) => values[i] === null || values[i] >= level);
    if (shown.length) {
      const drawn = this.points(shown.map((i) => this.place(xyz[i])), "soft", group, POINT_PX);
      const grey = this.colour("soft");
      const colours = shown.flatMap((i) => values[i] === null ? [grey.r, grey.g, grey.b]
        : [...(colour ? new THREE.Color(colour((values[i] - low) / Math.max(high - low, 1e-300)))
          : new THREE.Color().setRGB(...cividis((values[i] - low) / Math.max(high - low, 1e-300)), THREE.SRGBColorSpace))]);
      drawn.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
      Object.assign(drawn.material, {vertexColors: true, transparent: true, opacity: 0.8});
      drawn.material.color.set(0xffffff);
      drawn.userData.colour = "";
    }
    this.redraw();
  }

  // axes: x, y and z; values: x slowest, null where there is none.
  setMap(axes, values) {
    const size = axes.map((axis) => axis.length);
    const at = (i, j, k) => values[(i * size[1] + j) * size[2] + k];
    const fine = size.map((n) => n > 1 ? FINER * (n - 1) + 1 : 1);
    const field = new Float64Array(fine[0] * fine[1] * fine[2]);
    const split = (n, i) => n > 1 ? [Math.min(Math.floor(i / FINER), n - 2), 0] : [0, 0];
    let put = 0;
    for (let i = 0; i < fine[0]; i++)
      for (let j = 0; j < fine[1]; j++)
        for (let k = 0; k < fine[2]; k++) {
          const [a, b, c] = [split(size[0], i)[0], split(size[1], j)[0], split(size[2], k)[0]];
          const part = [i - FINER * a, j - FINER * b, k - FINER * c].map((value) => value / FINER);
          let sum = 0;
          for (let corner = 0; corner < 8; corner++) {
            const bits = [corner & 1, corner >> 1 & 1, corner >> 2];
            const weight = bits.reduce((w, bit, n) => w * (bit ? part[n] : 1 - part[n]), 1);
            if (weight === 0) continue;
            const value = at(a + bits[0], b + bits[1], c + bits[2]);
            sum += weight * (value ?? NaN);
          }
          field[put++] = sum;
        }
    const sorted = values.filter((value) => value !== null).sort((a, b) => a - b);
    this.map = {axes, fine, field, sorted, missing: values.length - sorted.length};
    this.top = sorted.length ? sorted[Math.floor(0.98 * (sorted.length - 1))] : 1;
    this.bottom = sorted[0] ?? 0;
  }

  // The boundary of where the map is at least `level`, or has no value: dual vertices, one in each cell that it crosses.
  setThreshold(level) {
    const group = this.groups.volume;
    this.empty(group);
    if (!this.map) return;
    const {axes, fine, field} = this.map;
    const padded = fine.map((n) => n + 2);
    const value = (i, j, k) => {  // outside the box there is nothing: the region is closed on its faces
      if (i < 1 || j < 1 || k < 1 || i > fine[0] || j > fine[1] || k > fine[2]) return null;
      return field[((i - 1) * fine[1] + j - 1) * fine[2] + k - 1];
    };
    const inside = (v) => v !== null && !(v < level);
    const vertex = new Int32Array(padded[0] * padded[1] * padded[2]).fill(-1);
    const cell = (i, j, k) => (i * padded[1] + j) * padded[2] + k;
    const places = [], colours = [], index = [];
    const grey = this.colour("soft");
    const real = (axis, at) => {  // from the fine grid's steps, kept within the box
      const line = axes[axis], n = line.length;
      if (n === 1) return line[0];
      const steps = Math.min(Math.max(at - 1, 0), fine[axis] - 1) / FINER, a = Math.min(Math.floor(steps), n - 2);
      return line[a] + (steps - a) * (line[a + 1] - line[a]);
    };
    for (let i = 0; i < padded[0] - 1; i++)
      for (let j = 0; j < padded[1] - 1; j++)
        for (let k = 0; k < padded[2] - 1; k++) {
          const v = [], is = [];
          for (let corner = 0; corner < 8; corner++) {
            v.push(value(i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)));
            is.push(inside(v[corner]));
          }
          if (is.every(Boolean) || !is.some(Boolean)) continue;
          const sum = [0, 0, 0];
          let count = 0, highest = -Infinity, unknown = false;
          for (let corner = 0; corner < 8; corner++) {
            if (is[corner]) {
              if (Number.isNaN(v[corner])) unknown = true;
              else highest = Math.max(highest, v[corner]);
            }
            for (const bit of [1, 2, 4]) {
              const other = corner | bit;
              if (corner & bit || is[corner] === is[other]) continue;
              const [a, b] = [v[corner], v[other]];
              const whole = a === null || b === null || Number.isNaN(a) || Number.isNaN(b);
              const part = whole ? (is[corner] ? 0 : 1) : (level - a) / (b - a);
              [1, 2, 4].forEach((axis, n) => { sum[n] += (corner & axis ? 1 : 0) + (axis === bit ? part : 0); });
              count++;
            }
          }
          vertex[cell(i, j, k)] = places.length;
          const grid = [i + sum[0] / count, j + sum[1] / count, k + sum[2] / count];
          places.push(this.place(grid.map((at, axis) => real(axis, at))));
          const shown = unknown ? null : v.includes(null) ? highest : level;
          const span = Math.max(this.top - this.bottom, 1e-300);
          const rgb = shown === null ? [grey.r, grey.g, grey.b] : cividis((shown - this.bottom) / span);
          colours.push(...new THREE.Color().setRGB(...rgb, shown === null ? undefined : THREE.SRGBColorSpace));
        }
    for (let i = 1; i < padded[0] - 1; i++)
      for (let j = 1; j < padded[1] - 1; j++)
        for (let k = 1; k < padded[2] - 1; k++) {
          const here = inside(value(i, j, k));
          for (const [di, dj, dk, e, f] of [[1, 0, 0, [0, 1, 0], [0, 0, 1]], [0, 1, 0, [0, 0, 1], [1, 0, 0]],
            [0, 0, 1, [1, 0, 0], [0, 1, 0]], [-1, 0, 0, [0, 1, 0], [0, 0, 1]], [0, -1, 0, [0, 0, 1], [1, 0, 0]],
            [0, 0, -1, [1, 0, 0], [0, 1, 0]]]) {
            if (!here || inside(value(i + di, j + dj, k + dk))) continue;
            const [a, b, c] = [i + Math.min(di, 0), j + Math.min(dj, 0), k + Math.min(dk, 0)];
            const corner = (x, y) => vertex[cell(a - x * e[0] - y * f[0], b - x * e[1] - y * f[1],
              c - x * e[2] - y * f[2])];
            const four = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            if (di + dj + dk < 0) four.reverse();
            index.push(four[0], four[1], four[2], four[0], four[2], four[3]);
          }
        }
    if (!index.length) return this.redraw();
    const geometry = new THREE.BufferGeometry().setFromPoints(places);
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
    geometry.setIndex(index);
    geometry.computeVertexNormals();
    const material = new THREE.MeshLambertMaterial({vertexColors: true, side: THREE.DoubleSide, transparent: true,
      opacity: 0.62, depthWrite: false});
    group.add(new THREE.Mesh(geometry, material));
    this.redraw();
  }

  // --------------------------------------------------------------------------------------------------- measured points

  // All of them. xyz: positions; cov: xx, xy, xz, yy, yz, zz of each.
  setMeasured(xyz, cov) {
    this.measured = {xyz: xyz.map((place) => this.place(place)), cov: [...cov]};
    const group = this.groups.measured;
    this.empty(group);
    this.points(this.measured.xyz, "measured", group);
    this.setMagnified(this.magnified);
  }

  // Ellipsoids that hold 95 %, so many times larger; the last ones, where there are more than can be drawn.
  setMagnified(times) {
    this.magnified = times;
    const group = this.groups.ellipsoids, {xyz, cov} = this.measured;
    this.empty(group);
    const first = Math.max(xyz.length - MAX_ELLIPSOIDS, 0), count = xyz.length - first;
    if (!count) return this.redraw();
    const sphere = new THREE.SphereGeometry(1, 16, 12);
    const material = new THREE.MeshLambertMaterial({color: this.colour("measured"), transparent: true, opacity: 0.35,
      depthWrite: false});
    const drawn = new THREE.InstancedMesh(sphere, material, count);
    drawn.userData.colour = "measured";
    const {scale, rotation} = this.placing;
    const turn = new THREE.Matrix4().set(...rotation[0], 0, ...rotation[1], 0, ...rotation[2], 0, 0, 0, 0, 1);
    for (let i = 0; i < count; i++) {
      const root = factor(cov[first + i]).map((value) => value * scale * ELLIPSOID_95 * times);
      const [a, b, c, d, e, f] = root;  // lower triangle: aa, ba, bb, ca, cb, cc
      const shape = new THREE.Matrix4().set(a, 0, 0, 0, b, c, 0, 0, d, e, f, 0, 0, 0, 0, 1);
      drawn.setMatrixAt(i, new THREE.Matrix4().multiplyMatrices(turn, shape).setPosition(xyz[first + i]));
    }
    drawn.frustumCulled = false;
    group.add(drawn);
    this.redraw();
  }

  // The usual size of an ellipsoid's longest half axis, in the scene.
  usualEllipsoid() {
    const sizes = this.measured.cov.map((c) => Math.sqrt(c[0] + c[3] + c[5])).sort((a, b) => a - b);
    return sizes.length ? sizes[sizes.length >> 1] * ELLIPSOID_95 * this.placing.scale : 0;
  }

  // The point under the pointer: {kind, index}, or null. x, y: of the page; within: pixels.
  pick(x, y, within) {
    const box = this.canvas.getBoundingClientRect();
    let best = null, nearest = within;
    const look = (kind, places) => places.forEach((place, index) => {
      if (!place) return;
      const at = place.clone().project(this.camera);
      if (at.z > 1) return;
      const off = Math.hypot((at.x + 1) / 2 * box.width + box.left - x, (1 - at.y) / 2 * box.height + box.top - y);
      if (off < nearest) { nearest = off; best = {kind, index}; }
    });
    if (this.groups.known.visible && this.known) look("known", this.known);
    if (this.groups.measured.visible) look("measured", this.measured.xyz);
    return best;
  }
}

// A lower triangle L with L L' the covariance: the unit sphere becomes the ellipsoid of one standard deviation.
function factor([xx, xy, xz, yy, yz, zz]) {
  const a = Math.sqrt(Math.max(xx, 0)) || 1e-12, b = xy / a, d = xz / a;
  const c = Math.sqrt(Math.max(yy - b * b, 0)) || 1e-12, e = (yz - b * d) / c;
  return [a, b, c, d, e, Math.sqrt(Math.max(zz - d * d - e * e, 0)) || 1e-12];
}
