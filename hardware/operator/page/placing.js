// Where the path lies, before it is confirmed: how that is known, and moving it by drag, handle, keys, buttons or three points.
// A move is told in the run's own frame on the surface (surface_from_tangent: the path's middle, z outwards); the run follows
// the surface and says where the path lies then. Until it has, the move is drawn as it would lie on a plane.
import { circle, stroke } from "./canvas.js";
import { inverse, moved, product } from "./lens.js";
import { element, upper } from "./words.js";

const STEPS = [0.1, 1, 5]; // mm and degrees
const TITLES = {
  scan: "Placed by the scan", region: "Placed by the region: a guess", truth: "Placed by the simulated world",
  "earlier run": "Placed as in the run before", hand: "Moved by hand",
};
const KEYS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", Comma: "anticlockwise", Period: "clockwise" };
const PERIOD = 230; // ms between two requests: the run takes five a second
const PATIENCE = 2000; // ms until a move without an answer is given up
const CLICK = 6; // px of a press that is no drag
const GRAB = 24; // px around the handle
const SNAP = 32; // px around a point of the path or the scan
const COLOURS = ["#5ef0d0", "#ffb35e"]; // of the points on the path, and of where they belong
const MOST = 100; // mm and, below, degrees that the run takes at once

export class Placing {
  // ask: given the move [mm, mm, degrees] and the turn, asks; returns a tag or null. say: told words for the operator
  constructor(root, ask, say, changed) {
    Object.assign(this, { root, ask, say, changed });
    this.view = this.sent = this.points = this.drag = null;
    this.live = this.aside = false; // aside: something else is put right in the pictures
    this.rest = nothing();
    this.step = 1;
    this.last = -Infinity;
    this.at = {};
    const steps = root.querySelector(".steps");
    for (const step of STEPS) {
      const made = element("button", step);
      made.type = "button";
      made.dataset.step = step;
      made.addEventListener("click", () => {
        this.step = step;
        this.mark();
      });
      steps.append(made);
    }
    for (const button of root.querySelectorAll("[data-move]")) button.addEventListener("click", () => this.nudge(button.dataset.move, this.step));
    root.querySelector(".three").addEventListener("click", () => {
      this.points = this.points ? null : { from: [], to: [] };
      this.mark();
      this.changed();
    });
    window.addEventListener("keydown", (event) => this.key(event));
  }
  // whether the path can be moved now
  get open() {
    return Boolean(this.live && !this.aside && this.view && this.view.stage === "confirm" && this.view.offers.includes("move") && this.frame);
  }
  // surface_from_tangent, null where the surface is not mapped
  get frame() {
    const placement = this.view && this.view.placement;
    return placement && placement.surface_from_tangent;
  }
  // whether what is drawn is not yet what the run has
  get busy() {
    return Boolean(this.sent || this.drag || !isNothing(this.rest));
  }
  // camera: the pane whose left and right count; scene and pose: what stands in the pictures
  sees(camera, scene, pose) {
    this.at = { camera, scene, pose };
  }
  show(view, live) {
    [this.view, this.live] = [view, live];
    if (this.sent && view && view.turn !== this.sent.turn) this.sent = null;
    const answer = view && view.answer;
    if (this.sent && answer && answer.number === this.sent.number && !answer.followed) this.forget();
    const placement = view && view.stage === "confirm" ? view.placement : null;
    this.root.hidden = !placement || this.aside;
    if (!this.open) {
      if (this.drag || this.points) this.points = this.drag = null;
      if (!placement) this.forget();
    }
    if (placement) {
      const worth = placement.confirmable ? (placement.certain ? "good" : "hand") : "open";
      this.root.dataset.worth = worth;
      this.root.querySelector("b").textContent = !view.offers.includes("move") ? "Not placed" : placement.by === "scan" && !placement.certain ? "The scan's place is not certain" : TITLES[placement.by];
      const placed = placement.by === "hand" ? "Look at it in every picture." : placement.verdict.replace(/^(placed by the (scan|region), |the scan's place is not certain, )/, "");
      this.words(this.points ? this.hint() : placed);
    }
    this.mark();
    this.flush();
  }
  words(text) {
    const shown = upper(text);
    this.root.querySelector(".verdict span").textContent = shown;
    this.root.querySelector(".verdict").title = shown;
  }
  hint() {
    const { from, to } = this.points;
    if (from.length < 3) return `Touch point ${from.length + 1} of 3 on the path or the scan's lines.`;
    return `Touch where point ${to.length + 1} of 3 belongs, in any picture.`;
  }
  mark() {
    for (const button of this.root.querySelectorAll("[data-move], .three")) button.disabled = !this.open;
    for (const button of this.root.querySelectorAll("[data-step]")) button.setAttribute("aria-pressed", String(Number(button.dataset.step) === this.step));
    this.root.querySelector(".three").setAttribute("aria-pressed", String(Boolean(this.points)));
    document.body.dataset.movable = this.open ? "yes" : "no";
  }
  // what the run has still to be told or has not yet answered, as a motion in the surface frame; null without any
  preview() {
    if (!this.frame || (!this.sent && isNothing(this.rest))) return null;
    const motion = product(matrix(this.sent || nothing()), matrix(this.rest));
    return product(product(this.frame, motion), inverse(this.frame));
  }
  // add a motion along the surface, in the frame of the path as it is drawn
  add(x, y, turn) {
    const back = this.sent ? (-this.sent.move.turn * Math.PI) / 180 : 0, c = Math.cos(back), s = Math.sin(back);
    this.rest.x += c * x - s * y;
    this.rest.y += s * x + c * y;
    this.rest.turn += turn;
    this.changed();
  }
  nudge(way, step) {
    if (!this.open) return;
    if (way.endsWith("clockwise")) {
      const seen = this.seen(), sign = (way === "clockwise" ? -1 : 1) * (seen && seen.mirrored ? -1 : 1);
      this.add(0, 0, sign * step);
    } else {
      const seen = this.seen(), [x, y] = seen ? seen.ways[way] : { left: [-1, 0], right: [1, 0], up: [0, 1], down: [0, -1] }[way];
      this.add(step * x, step * y, 0);
    }
    this.flush();
  }
  // unit steps on the surface that go left, right, up and down in the picture
  seen() {
    const { camera, pose } = this.at;
    if (!camera || !camera.lens || !pose) return null;
    const pixel = camera.lens.from(product(pose, this.frame)), o = pixel(0, 0, 0), a = pixel(1, 0, 0), b = pixel(0, 1, 0);
    if (!o || !a || !b) return null;
    const j = [a[0] - o[0], b[0] - o[0], a[1] - o[1], b[1] - o[1]], d = j[0] * j[3] - j[1] * j[2];
    const way = (u, v) => {
      const x = (j[3] * u - j[1] * v) / d, y = (j[0] * v - j[2] * u) / d, long = Math.hypot(x, y);
      return [x / long, y / long];
    };
    return { ways: { left: way(-1, 0), right: way(1, 0), up: way(0, -1), down: way(0, 1) }, mirrored: d > 0 };
  }
  key(event) {
    if (event.code === "Escape" && this.points) {
      this.points = null;
      this.changed();
      return;
    }
    const way = KEYS[event.code];
    if (!way || !this.open || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    this.nudge(way, event.shiftKey ? 0.1 : this.step);
  }
  // tell the run what has gathered; one request at a time, and not too fast
  flush() {
    const now = performance.now();
    if (this.sent && now - this.sent.since > PATIENCE) this.forget();
    if (!this.open || this.drag || this.sent || isNothing(this.rest) || now - this.last < PERIOD) return;
    const { x, y, turn } = this.rest, half = ((turn % 360) + 540) % 360 - 180;
    const move = { x: round(x), y: round(y), turn: round(half) };
    this.rest = nothing();
    if (Math.hypot(move.x, move.y) > MOST) return this.refuse(`A path is moved by ${MOST} mm at most.`);
    const tag = this.ask([move.x, move.y, move.turn], this.view.turn);
    if (tag === null) return this.changed();
    this.last = now;
    this.sent = { move, tag, number: null, turn: this.view.turn, since: now };
  }
  // the page's process has taken the request, or says why not
  asked(message) {
    if (!this.sent || message.tag !== this.sent.tag) return;
    this.sent.number = message.number;
    if (message.words) this.forget();
  }
  refuse(words) {
    this.say(words, true);
    this.forget();
  }
  forget() {
    const any = this.busy;
    this.sent = this.drag = null;
    this.rest = nothing();
    if (any) this.changed();
  }

  // -- in the pictures

  // no picture stands while the path is moved
  still() {
    return null;
  }
  // where a pixel of a camera meets the surface, in the path's frame on it; relief: whether to follow the mapped points
  meet(camera, [px, py], relief) {
    const { pose, scene } = this.at;
    if (!pose || !camera.lens) return null;
    const { origin, direction } = camera.lens.ray(product(pose, this.frame), px, py);
    const at = (height) => {
      const far = (height - origin[2]) / direction[2];
      return far > 0 && Number.isFinite(far) ? [origin[0] + far * direction[0], origin[1] + far * direction[1]] : null;
    };
    let place = at(0);
    for (let i = 0; relief && place && i < 6; i++) place = at(this.height(scene, place));
    return place;
  }
  height(scene, [x, y]) {
    const back = inverse(this.frame), points = scene ? scene.surface : [];
    let sum = 1e-9, high = 0;
    for (let i = 0; i + 2 < points.length; i += 3) {
      const [u, v, w] = moved(back, points[i], points[i + 1], points[i + 2]), weight = Math.exp(-((u - x) ** 2 + (v - y) ** 2) / 18);
      sum += weight;
      high += weight * w;
    }
    return high / sum;
  }
  // where the handle is, in the path's frame on the surface
  handle(scene) {
    const back = inverse(this.frame);
    let most = 8;
    for (let i = 0; i + 2 < scene.path.length; i += 3) {
      const [u, v] = moved(back, scene.path[i], scene.path[i + 1], scene.path[i + 2]);
      most = Math.max(most, Math.hypot(u, v));
    }
    return most + 4;
  }
  press(camera, place, event) {
    if (!this.open || this.points || this.sent) return false;
    const px = camera.pixel(place);
    const at = px && this.meet(camera, px, false);
    if (!at) return false;
    const pixel = camera.lens.from(product(this.at.pose, this.frame)), knob = pixel(this.handle(this.at.scene), 0, 0);
    const seen = knob && camera.shown(knob), turns = seen && Math.hypot(seen[0] - place[0], seen[1] - place[1]) < GRAB;
    this.drag = { camera, id: event.pointerId, from: at, place, turns, far: false };
    return true;
  }
  pull(place) {
    const { camera, from, place: first, turns } = this.drag;
    if (!this.drag.far && Math.hypot(place[0] - first[0], place[1] - first[1]) < CLICK) return;
    this.drag.far = true;
    const px = camera.pixel(place), at = px && this.meet(camera, px, false);
    if (!at) return;
    const angle = (p) => Math.atan2(p[1], p[0]);
    this.rest = turns ? { x: 0, y: 0, turn: ((angle(at) - angle(from)) * 180) / Math.PI } : { x: at[0] - from[0], y: at[1] - from[1], turn: 0 };
    this.changed();
  }
  // whether it was a drag rather than a click
  release() {
    const far = this.drag && this.drag.far;
    this.drag = null;
    this.flush();
    return Boolean(far);
  }
  // whether a click was meant for one of three points
  click(camera, place) {
    if (!this.points || !this.open || this.busy) return false;
    const { from, to } = this.points, px = camera.pixel(place);
    if (from.length < 3) {
      const found = this.nearest(camera, place);
      if (found) from.push(found);
      else this.say("Touch the path or one of the scan's lines.", true);
    } else {
      const found = px && this.meet(camera, px, true);
      if (found) to.push(found);
    }
    if (to.length === 3) this.fit();
    if (this.points) this.words(this.hint());
    this.changed();
    return true;
  }
  nearest(camera, [x, y]) {
    const { scene, pose } = this.at, pixel = camera.lens.from(pose);
    let best = SNAP, found = null;
    for (const points of [scene.path, scene.scan]) for (let i = 0; i + 2 < points.length; i += 3) {
      const p = pixel(points[i], points[i + 1], points[i + 2]), q = p && camera.shown(p), off = q ? Math.hypot(q[0] - x, q[1] - y) : Infinity;
      if (off < best) [best, found] = [off, [points[i], points[i + 1], points[i + 2]]];
    }
    return found;
  }
  // the turn and shift on the surface that bring three points nearest to where they belong
  fit() {
    const back = inverse(this.frame), from = this.points.from.map((p) => moved(back, ...p).slice(0, 2)), to = this.points.to;
    this.points = null;
    const mean = (all, k) => all.reduce((sum, p) => sum + p[k], 0) / 3, a = [mean(from, 0), mean(from, 1)], b = [mean(to, 0), mean(to, 1)];
    let dot = 0, cross = 0, spread = 0;
    from.forEach((p, i) => {
      const [u, v, s, t] = [p[0] - a[0], p[1] - a[1], to[i][0] - b[0], to[i][1] - b[1]];
      dot += u * s + v * t;
      cross += u * t - v * s;
      spread += u * u + v * v;
    });
    if (spread < 27) return this.say("The three points lie too near to each other: nothing was moved.", true);
    const turn = Math.atan2(cross, dot), c = Math.cos(turn), s = Math.sin(turn), on = ([x, y]) => [c * x - s * y, s * x + c * y];
    const [mx, my] = on(a), shift = [b[0] - mx, b[1] - my];
    const off = Math.sqrt(from.reduce((sum, p, i) => {
      const q = on(p);
      return sum + (q[0] + shift[0] - to[i][0]) ** 2 + (q[1] + shift[1] - to[i][1]) ** 2;
    }, 0) / 3);
    this.rest = { x: shift[0], y: shift[1], turn: (turn * 180) / Math.PI };
    this.say(`The three points fit to ${off.toFixed(1)} mm.`, off > 3);
    this.flush();
  }
  // the handle and the touched points, over a camera's picture
  draw(g, camera, on, ratio) {
    const { scene, pose } = this.at;
    if (!this.open || !scene || !pose || !camera.lens || !scene.path.length) return;
    const shift = this.preview(), lies = product(pose, shift ? product(shift, this.frame) : this.frame), pixel = camera.lens.from(lies);
    const middle = on(pixel(0, 0, 0)), knob = on(pixel(this.handle(scene), 0, 0));
    if (middle && knob && !this.points) {
      for (const [colour, width] of [["rgb(10 18 28 / .7)", 4], ["#ffffff", 1.8]]) {
        [g.strokeStyle, g.lineWidth] = [colour, width * ratio];
        circle(g, middle, 4 * ratio);
        g.stroke();
        g.setLineDash([5 * ratio, 5 * ratio]);
        g.beginPath();
        g.moveTo(...middle);
        g.lineTo(...knob);
        g.stroke();
        g.setLineDash([]);
        circle(g, knob, 9 * ratio);
        if (colour === "#ffffff") {
          g.fillStyle = "rgb(42 111 151 / .9)";
          g.fill();
        }
        g.stroke();
      }
    }
    if (!this.points) return;
    const flat = camera.lens.from(product(pose, this.frame)), seen = camera.lens.from(pose);
    this.points.from.forEach((p, k) => this.spot(g, on(seen(...p)), k + 1, COLOURS[0], ratio));
    this.points.to.forEach((p, k) => this.spot(g, on(flat(p[0], p[1], this.height(scene, p))), k + 1, COLOURS[1], ratio));
  }
  spot(g, place, number, colour, ratio) {
    if (!place) return;
    circle(g, place, 10 * ratio);
    g.fillStyle = colour;
    g.fill();
    stroke(g, ratio, ["rgb(10 18 28 / .8)", 2]);
    g.fillStyle = "#10181f";
    g.font = `700 ${13 * ratio}px system-ui, sans-serif`;
    [g.textAlign, g.textBaseline] = ["center", "middle"];
    g.fillText(number, place[0], place[1] + ratio);
  }
}

function nothing() {
  return { x: 0, y: 0, turn: 0 };
}
function isNothing({ x, y, turn }) {
  return !round(x) && !round(y) && !round(turn);
}
function round(value) {
  return Math.round(1000 * value) / 1000;
}
// a move as a motion in the frame on the surface
function matrix(motion) {
  const { x, y, turn } = motion.move || motion, c = Math.cos((turn * Math.PI) / 180), s = Math.sin((turn * Math.PI) / 180);
  return [[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]];
}
