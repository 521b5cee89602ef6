// The scene in three dimensions on a plain canvas: cheap without a graphics card, and there in every browser.
import { circle, fitted, stroke } from "./canvas.js";
import Delaunator from "./delaunator.js";
import { drawPath, moved } from "./lens.js";
import { colours, dark, onTheme } from "./theme.js";
import { element } from "./words.js";

const SIGMAS = 20; // the uncertainty is drawn so many times as large: 0.05 mm would not be seen
const TOOL = { long: 0.55, wide: 0.06 }; // shares of what the view near the wound reaches
const TURN = 0.12; // rad of a key
const STEP = 0.1; // of what the view reaches, of a key
const MAX_TILT = Math.PI / 2;
const LONG = 4; // times the median edge of the landmarks' mesh: longer ones bridge what was not seen
const LOOKED = [[0.6, "#c0392b", "a gap"], [0.8, "#e67e22", "too little or much"], [1.25, "#27ae60", "laid as planned"], [1.6, "#e67e22", "too little or much"], [Infinity, "#8e44ad", "a blob"]]; // shares of what was planned, up to
const UNSEEN = [null, "#999", "not seen"];
const PYRAMID = 0.2; // of a camera, as a share of what the view reaches

const looked = (share) => (share === null ? UNSEEN : LOOKED.find(([most]) => share < most));

export class SceneView {
  constructor(root) {
    this.canvas = root.querySelector("canvas");
    this.scale = root.querySelector(".scale");
    this.legend = root.querySelector(".legend");
    this.fit = "near";
    this.eye = { turn: -0.6, tilt: 0.75, near: 1 };
    this.pan = [0, 0, 0]; // mm, of the middle of the view
    this.layers = false; // whether only the present layer is drawn
    this.scene = this.middle = null;
    this.pose = null;
    this.fingers = new Map();
    this.changed = () => {};
    this.listen(root);
  }
  see(scene) {
    if (!scene.triangles.length && scene.surface.length > 9) scene.triangles = meshed(scene.surface);
    this.scene = scene;
    this.middle = null;
    this.explain(scene.share || []);
    const places = scene.cameras.map((c) => [0, 1, 2].map((r) => c.base_from_camera[r][3])), one = places[0] || [0, 0, 0];
    const apart = Math.max(...places.map((p) => Math.hypot(...p.map((v, k) => v - one[k]))), ...places.map((p) => Math.hypot(...p)), 1);
    this.reach = { all: 0.5 * apart, near: this.radius(scene) };
  }
  radius(scene) {
    const points = scene.surface.length ? scene.surface : scene.path;
    let most = 0;
    for (let i = 0; i + 2 < points.length; i += 3) most = Math.max(most, Math.hypot(points[i], points[i + 1], points[i + 2]));
    return Math.max(most, 10) * 0.8; // seen aslant, and what stands at the corners may leave the picture
  }
  listen(root) {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (e) => {
      this.fingers.set(e.pointerId, [e.clientX, e.clientY]);
      canvas.setPointerCapture(e.pointerId);
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (e) => this.fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => this.drag(e));
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(e.deltaY * 0.001));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault()); // the right button pulls the view along
    canvas.addEventListener("keydown", (e) => this.key(e));
    for (const button of root.querySelectorAll("[data-eye]")) button.addEventListener("click", () => this.top());
    for (const button of root.querySelectorAll("[data-layers]")) button.addEventListener("click", () => {
      this.layers = !this.layers;
      button.setAttribute("aria-pressed", String(this.layers));
      this.changed();
    });
    onTheme(() => this.changed());
    for (const button of root.querySelectorAll("[data-fit]")) button.addEventListener("click", () => {
      this.fit = button.dataset.fit;
      this.eye.near = 1;
      this.pan = [0, 0, 0];
      for (const each of root.querySelectorAll("[data-fit]")) each.setAttribute("aria-pressed", String(each === button));
      this.changed();
    });
  }
  drag(e) {
    const before = this.fingers.get(e.pointerId);
    if (!before) return;
    const others = [...this.fingers].filter(([id]) => id !== e.pointerId).map(([, place]) => place);
    this.fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (others.length) {
      const far = (p) => Math.hypot(p[0] - others[0][0], p[1] - others[0][1]) || 1;
      return this.zoom(far(before) / far([e.clientX, e.clientY]));
    }
    if (e.shiftKey || e.buttons & 6) return this.shift(e.clientX - before[0], e.clientY - before[1]);
    this.turn((e.clientX - before[0]) * 0.008, (e.clientY - before[1]) * 0.008);
  }
  turn(right, down) {
    this.eye.turn -= right;
    this.eye.tilt = Math.min(Math.max(this.eye.tilt + down, 0.05), MAX_TILT);
    this.changed();
  }
  // pull the view by so many css px
  shift(right, down) {
    if (!this.px) return;
    const { turn, tilt } = this.eye, by = window.devicePixelRatio / this.px, st = Math.sin(turn), ct = Math.cos(turn), sp = Math.sin(tilt);
    const axes = [[ct, st, 0], [-st * sp, ct * sp, Math.cos(tilt)]];
    this.pan = this.pan.map((v, k) => v - by * right * axes[0][k] + by * down * axes[1][k]);
    this.changed();
  }
  // from above, the base's y upwards
  top() {
    this.eye = { turn: 0, tilt: MAX_TILT, near: this.eye.near };
    this.pan = [0, 0, 0];
    this.changed();
  }
  key(e) {
    const step = STEP * Math.min(this.canvas.clientWidth, this.canvas.clientHeight), way = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (way) e.shiftKey ? this.shift(step * way[0], step * way[1]) : this.turn(TURN * way[0], TURN * way[1]);
    else if (e.key === "+" || e.key === "-") this.zoom(e.key === "+" ? 0.85 : 1 / 0.85);
    else if (e.key === "t") this.top();
    else return;
    e.preventDefault();
    e.stopPropagation();
  }
  zoom(factor) {
    this.eye.near = Math.min(Math.max(this.eye.near * factor, 0.1), 4);
    this.changed();
  }
  // from a place in the base, mm, to canvas px and depth
  project(w, h) {
    const { turn, tilt, near } = this.eye, ct = Math.cos(turn), st = Math.sin(turn), cp = Math.cos(tilt), sp = Math.sin(tilt);
    const right = [ct, st, 0], up = [-st * sp, ct * sp, cp], back = [st * cp, -ct * cp, sp], m = this.middle.map((v, k) => v + this.pan[k]);
    const reach = this.reach[this.fit] * near, scale = (0.5 * Math.min(0.8 * w, h)) / reach, eye = 6 * reach;
    this.px = scale;
    return ([x, y, z]) => {
      const d = [x - m[0], y - m[1], z - m[2]], dot = (v) => v[0] * d[0] + v[1] * d[1] + v[2] * d[2];
      const depth = dot(back), k = (scale * eye) / Math.max(eye - depth, 0.1 * eye);
      return [w / 2 + k * dot(right), h / 2 - k * dot(up), depth];
    };
  }
  draw(view, fraction) {
    const sheet = fitted(this.canvas);
    if (!sheet || !this.scene) return;
    const { g, w, h, ratio } = sheet;
    const pose = view && view.tracking && view.tracking.state !== "INITIALISING" ? view.tracking.base_from_surface : null;
    this.follow(pose);
    const place = this.project(w, h);
    g.lineJoin = g.lineCap = "round";
    if (pose) {
      this.surface(g, place, pose);
      const here = drawPath(g, this.scene, fraction, (x, y, z) => place(moved(pose, x, y, z)), {
        hop: { colour: dark() ? "rgb(120 180 215 / .22)" : "rgb(42 111 151 / .18)", width: ratio }, next: { colour: colours.path, width: 1.4 * ratio },
        done: { colour: colours.done, width: 3 * ratio },
      }, this.layers);
      this.laid(g, (x, y, z) => place(moved(pose, x, y, z)), ratio);
      if (here) this.mark(g, here, ratio);
      this.uncertainty(g, place, pose, view.tracking.covariance, ratio);
    }
    this.cameras(g, place, ratio);
    if (view && view.motion && view.motion.base_from_nozzle) this.tool(g, place, view.motion.base_from_nozzle);
    this.ruler(ratio);
  }
  // the colours of what the last look found, as far as they are there
  explain(share) {
    for (const each of this.legend.querySelectorAll(".look")) each.remove();
    const found = new Map(share.map((s) => looked(s).slice(1)));
    for (const [colour, words] of found) {
      const line = element("span", "", "look"), mark = element("i");
      mark.style.background = colour;
      line.append(mark, words);
      this.legend.append(line);
    }
  }
  laid(g, at, ratio) {
    const { laid, share } = this.scene;
    g.lineWidth = 5 * ratio;
    for (let i = 0; share && i < share.length; i += 1) {
      g.strokeStyle = looked(share[i])[1];
      g.beginPath();
      g.moveTo(...at(...laid.slice(6 * i, 6 * i + 3)));
      g.lineTo(...at(...laid.slice(6 * i + 3, 6 * i + 6)));
      g.stroke();
    }
  }
  // the place that is printed next, or where a run goes on
  mark(g, place, ratio) {
    circle(g, place, 6 * ratio);
    stroke(g, ratio, [colours.card, 5], [colours.ink, 2]);
  }
  // the middle stays where it is, so that the wound is seen to move, unless it leaves
  follow(pose) {
    const at = pose ? [pose[0][3], pose[1][3], pose[2][3]] : [0, 0, 0];
    const off = this.middle ? Math.hypot(...at.map((v, k) => v - this.middle[k])) : Infinity;
    if (this.fit === "all") this.middle = at.map((v, k) => 0.5 * (v + this.average(k)));
    else if (!(off < 0.6 * this.reach.near) || this.last !== this.fit) this.middle = at;
    this.last = this.fit;
  }
  average(k) {
    const cameras = this.scene.cameras;
    return cameras.reduce((sum, c) => sum + c.base_from_camera[k][3], 0) / Math.max(cameras.length, 1);
  }
  surface(g, place, pose) {
    const { surface, triangles } = this.scene, at = [], seen = [];
    for (let i = 0; i + 2 < surface.length; i += 3) {
      at.push(moved(pose, surface[i], surface[i + 1], surface[i + 2]));
      seen.push(place(at[at.length - 1]));
    }
    if (!triangles.length) {
      g.fillStyle = "rgb(176 122 100 / .7)";
      for (const [x, y] of seen) g.fillRect(x - 1, y - 1, 2, 2);
      return;
    }
    const faces = [];
    for (let i = 0; i + 2 < triangles.length; i += 3) {
      const [a, b, c] = [triangles[i], triangles[i + 1], triangles[i + 2]];
      faces.push([seen[a][2] + seen[b][2] + seen[c][2], a, b, c]);
    }
    faces.sort((p, q) => p[0] - q[0]);
    for (const [, a, b, c] of faces) {
      const u = at[b].map((v, k) => v - at[a][k]), v = at[c].map((t, k) => t - at[a][k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const lit = (dark() ? 0.5 : 0.72) + 0.28 * Math.abs((0.35 * n[0] - 0.25 * n[1] + 0.9 * n[2]) / (Math.hypot(...n) || 1));
      g.fillStyle = g.strokeStyle = `rgb(${(240 * lit) | 0} ${(212 * lit) | 0} ${(198 * lit) | 0})`;
      g.lineWidth = 1; // hides the seams between neighbours
      g.beginPath();
      for (const k of [a, b, c]) g.lineTo(seen[k][0], seen[k][1]);
      g.closePath();
      g.fill();
      g.stroke();
    }
  }
  uncertainty(g, place, pose, covariance, ratio) {
    const root = cholesky(covariance);
    if (!root) return;
    g.strokeStyle = "#7a5ea8";
    g.fillStyle = "rgb(122 94 168 / .12)";
    g.lineWidth = 1.5 * ratio;
    for (const [i, j] of [[0, 1], [1, 2], [2, 0]]) {
      g.beginPath();
      for (let k = 0; k <= 32; k++) {
        const v = [0, 0, 0];
        v[i] = SIGMAS * Math.cos((k * Math.PI) / 16);
        v[j] = SIGMAS * Math.sin((k * Math.PI) / 16);
        const p = root.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
        const [x, y] = place(moved(pose, ...p));
        g.lineTo(x, y);
      }
      g.fill();
      g.stroke();
    }
  }
  cameras(g, place, ratio) {
    g.font = `${14 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    for (const camera of this.scene.cameras) {
      const t = camera.base_from_camera, [w, h] = camera.size, f = camera.matrix[0][0];
      const long = PYRAMID * this.reach[this.fit];
      const corner = (x, y) => place(moved(t, (long * x * w) / (2 * f), (long * y * h) / (2 * f), long));
      const tip = place(moved(t, 0, 0, 0)), rim = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
      g.strokeStyle = g.fillStyle = colours.soft;
      g.lineWidth = 1.5 * ratio;
      g.beginPath();
      for (const p of rim) {
        g.moveTo(tip[0], tip[1]);
        g.lineTo(p[0], p[1]);
      }
      g.moveTo(rim[3][0], rim[3][1]);
      for (const p of rim) g.lineTo(p[0], p[1]);
      g.stroke();
      g.fillText(camera.name, tip[0] + 8 * ratio, tip[1] - 6 * ratio);
    }
  }
  tool(g, place, pose) {
    const tip = place(moved(pose, 0, 0, 0)), rim = [], long = TOOL.long * this.reach.near, wide = TOOL.wide * this.reach.near;
    for (let k = 0; k < 16; k++) {
      const a = (k * Math.PI) / 8;
      rim.push(place(moved(pose, wide * Math.cos(a), wide * Math.sin(a), long)));
    }
    const sides = rim.map((p, k) => [p, rim[(k + 1) % 16], k]).sort((p, q) => p[0][2] - q[0][2]);
    for (const [p, q, k] of sides) {
      const shade = 0.75 + 0.25 * Math.cos((k * Math.PI) / 8);
      g.fillStyle = g.strokeStyle = `rgb(${(217 * shade) | 0} ${(131 * shade) | 0} ${(50 * shade) | 0})`;
      g.lineWidth = 0.7;
      g.beginPath();
      for (const [x, y] of [tip, p, q]) g.lineTo(x, y);
      g.closePath();
      g.fill();
      g.stroke();
    }
    g.fillStyle = "#a5621d";
    g.beginPath();
    for (const [x, y] of rim) g.lineTo(x, y);
    g.fill();
  }
  ruler(ratio) {
    const wanted = (70 * ratio) / this.px, power = 10 ** Math.floor(Math.log10(wanted));
    const mm = [5, 2, 1].map((k) => k * power).find((k) => k <= wanted);
    this.scale.firstElementChild.style.width = `${((mm * this.px) / ratio).toFixed(1)}px`;
    this.scale.lastElementChild.textContent = `${mm} mm`;
  }
}

// triangles over landmarks, seen along the direction in which they spread least; none over gaps
function meshed(points) {
  const count = points.length / 3, mean = [0, 1, 2].map((k) => sum(count, (i) => points[3 * i + k]) / count), off = (i, k) => points[3 * i + k] - mean[k];
  const spread = [0, 1, 2].map((k) => sum(count, (i) => off(i, k) ** 2)), flat = spread.indexOf(Math.min(...spread)), [a, b] = [0, 1, 2].filter((k) => k !== flat);
  const made = new Delaunator(Float64Array.from({ length: 2 * count }, (_, i) => points[3 * (i >> 1) + (i & 1 ? b : a)])).triangles;
  const edge = (i, j) => Math.hypot(...[0, 1, 2].map((k) => points[3 * i + k] - points[3 * j + k]));
  const longest = [];
  for (let i = 0; i < made.length; i += 3) longest.push(Math.max(edge(made[i], made[i + 1]), edge(made[i + 1], made[i + 2]), edge(made[i + 2], made[i])));
  const most = LONG * [...longest].sort((p, q) => p - q)[longest.length >> 1];
  return Array.from(made).filter((_, i) => longest[Math.floor(i / 3)] <= most);
}
function sum(count, value) {
  let total = 0;
  for (let i = 0; i < count; i++) total += value(i);
  return total;
}

// lower triangle of a covariance (3, 3); null where it is none
function cholesky(c) {
  const l = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < 3; i++)
    for (let j = 0; j <= i; j++) {
      let sum = c[i][j];
      if (sum === null) return null;
      for (let k = 0; k < j; k++) sum -= l[i][k] * l[j][k];
      if (i !== j) l[i][j] = l[j][j] > 0 ? sum / l[j][j] : 0;
      else if (sum < -1e-12) return null;
      else l[i][i] = Math.sqrt(Math.max(sum, 0));
    }
  return l;
}
