// The wound's outline, put right point by point on the pictures in which it was looked for, and sent to the run as a whole.
// Those pictures stand still; the run carries the outline to where the surface is when it takes it.

import { circle, pairs, polygon, stroke } from "./canvas.js";

const MOST = 64; // points of a camera
const ENOUGH = 3, CAMERAS = 2;
const GRAB = 24; // css px around a point
const LINE = 14; // css px beside the line, within which a press makes a new point
const MARGIN = 2; // of the outline's box that is shown
const LEAST = 6; // times the part that is shown is smaller than the picture, at most
const KEPT = 100; // steps that can be undone
const WAYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const COLOUR = "#5ef0d0";

export class Outlining {
  // root: its strip; opener: the button that opens it; panes: of the cameras, by name; ask: given outline and turn, asks; say:
  // told words for the operator, and whether they are bad
  constructor(root, opener, panes, ask, say, changed) {
    Object.assign(this, { root, opener, panes, ask, say, changed });
    this.view = this.sheet = this.drag = this.chosen = null;
    this.live = this.opened = false;
    opener.addEventListener("click", () => this.open());
    for (const button of root.querySelectorAll("button")) button.addEventListener("click", () => {
      this[button.dataset.outline]();
      this.changed();
    });
    window.addEventListener("keydown", (event) => this.key(event));
  }
  // the pictures, and the outline that was found in each of them
  take({ head, images }) {
    if (this.sheet && head.stamp === this.stamp) return; // the connection was made anew: what was changed stays
    this.stamp = head.stamp;
    this.sheet = new Map(head.pictures.map((each, k) => [each.camera, { image: images[k][0], found: pairs(each.outline[0] || []), frame: null }]));
    this.restart();
    this.changed();
  }
  restart() {
    this.points = new Map([...this.sheet].map(([name, each]) => [name, each.found.map((p) => [...p])]));
    this.before = []; // what the points were, newest last
    this.drag = this.chosen = null;
  }
  // whether the run would take an outline now
  get allowed() {
    return Boolean(this.sheet && this.live && this.view && this.view.offers.includes("outline"));
  }
  get on() {
    return this.opened && this.allowed;
  }
  open() {
    this.opened = true;
    this.changed();
  }
  leave() {
    this.opened = false;
    this.drag = null;
  }
  show(view, live) {
    [this.view, this.live] = [view, live];
    if (!this.allowed) this.leave();
    this.opener.hidden = !this.allowed || this.on;
    this.root.hidden = !this.on;
    document.body.dataset.outlining = this.on ? "yes" : "no";
    if (!this.on) return;
    const disabled = { undo: !this.before.length, remove: !this.chosen, found: !this.before.length, use: Boolean(this.missing()), leave: false };
    for (const button of this.root.querySelectorAll("button")) button.disabled = disabled[button.dataset.outline];
    const lost = view.placement && view.placement.moved ? " Using it loses the path's moves." : "";
    this.root.querySelector(".verdict span").textContent = this.missing() || "Drag points onto the edge, in each picture. Press the line for a new point." + lost;
  }
  // why the outline cannot be used yet, "" if it can
  missing() {
    const drawn = [...this.points].filter(([, points]) => points.length), size = Math.min(CAMERAS, this.panes.size);
    for (const [name, points] of drawn) if (points.length < ENOUGH) return `${name}: ${ENOUGH} points or more.`;
    if (!drawn.length) return "No wound was found. Touch points round it, in two pictures or more.";
    return drawn.length < size ? "Touch points round the wound in one more picture." : "";
  }

  // -- changes

  keep() {
    this.before.push(new Map([...this.points].map(([name, points]) => [name, points.map((p) => [...p])])));
    if (this.before.length > KEPT) this.before.shift();
  }
  undo() {
    if (this.before.length) this.points = this.before.pop();
    this.drag = this.chosen = null;
  }
  found() {
    this.restart();
  }
  remove() {
    if (!this.chosen) return;
    this.keep();
    const points = this.points.get(this.chosen.name);
    points.splice(this.chosen.index, 1);
    this.chosen = points.length ? { name: this.chosen.name, index: this.chosen.index % points.length } : null;
  }
  add(pane, pixel, index) {
    const points = this.points.get(pane.name);
    this.keep();
    points.splice(index, 0, inside(pane, pixel));
    this.chosen = { name: pane.name, index };
  }
  use() {
    const outline = Object.fromEntries([...this.points].filter(([, points]) => points.length));
    this.ask(outline, this.view.turn);
  }
  key(event) {
    if (!this.on || event.altKey) return;
    const way = WAYS[event.code], pane = this.chosen && this.panes.get(this.chosen.name);
    if (event.ctrlKey || event.metaKey) {
      if (event.key.toLowerCase() !== "z") return; // wherever the keyboard has it
      this.undo();
    } else if (event.code === "Escape") this.leave();
    else if (event.code === "Delete" || event.code === "Backspace") this.remove();
    else if (event.code === "Comma" || event.code === "Period") this.next(event.code === "Period" ? 1 : -1);
    else if (way && pane) {
      const points = this.points.get(pane.name), [x, y] = points[this.chosen.index], step = event.shiftKey ? 10 : 1;
      this.keep();
      points[this.chosen.index] = inside(pane, [x + step * way[0], y + step * way[1]]);
    } else return;
    event.preventDefault();
    this.changed();
  }
  // choose the next point of the picture that is large
  next(by) {
    const large = [...this.panes.values()].find((pane) => !pane.small && this.points.get(pane.name)?.length);
    if (!large) return;
    const count = this.points.get(large.name).length, same = this.chosen && this.chosen.name === large.name;
    this.chosen = { name: large.name, index: same ? (this.chosen.index + by + count) % count : by > 0 ? 0 : count - 1 };
  }

  // -- in the pictures

  // the picture that stands, and the part of it that is shown
  still(pane, near) {
    const each = this.on && this.sheet.get(pane.name);
    if (!each || !each.image || !pane.lens) return null;
    if (!each.frame) each.frame = frame(each.found, pane.lens.camera.size);
    return { image: each.image, crop: near ? each.frame : null };
  }
  preview() {
    return null;
  }
  press(pane, place, event) {
    const points = this.on && this.points.get(pane.name), pixel = pane.pixel(place);
    if (!points || !pixel || pane.small) return false;
    const shown = points.map((p) => pane.shown(p)), away = shown.map((p) => Math.hypot(p[0] - place[0], p[1] - place[1]));
    let index = away.indexOf(Math.min(...away));
    const far = !(away[index] < GRAB); // a new point
    if (far) {
      index = edge(shown, place);
      if (index === null || points.length >= MOST) return false;
      this.add(pane, pixel, index);
    } else this.chosen = { name: pane.name, index };
    const [x, y] = points[index];
    this.drag = { camera: pane, id: event.pointerId, index, off: [x - pixel[0], y - pixel[1]], place, far };
    this.changed();
    return true;
  }
  pull(place) {
    const { camera, index, off, place: first } = this.drag, pixel = camera.pixel(place);
    if (!pixel) return;
    if (!this.drag.far) {
      if (Math.hypot(place[0] - first[0], place[1] - first[1]) < 2) return;
      this.keep();
      this.drag.far = true;
    }
    this.points.get(camera.name)[index] = inside(camera, [pixel[0] + off[0], pixel[1] + off[1]]);
    this.changed();
  }
  // a press on a point is no click, whether it was pulled or not
  release() {
    this.drag = null;
    this.changed();
    return true;
  }
  // a click in a picture that has no outline yet sets its points
  click(pane, place) {
    const points = this.on && this.points.get(pane.name), pixel = pane.pixel(place);
    if (!points || pane.small) return false;
    if (points.length < ENOUGH && pixel) this.add(pane, pixel, points.length);
    this.changed();
    return true;
  }
  draw(g, pane, on, ratio) {
    const points = this.points.get(pane.name);
    pane.canvas.dataset.points = JSON.stringify(points);
    if (!points.length) return;
    const at = points.map(on);
    polygon(g, at);
    g.lineJoin = "round";
    stroke(g, ratio, ["rgb(10 18 28 / .7)", 4], [COLOUR, 2]);
    if (pane.small) return;
    at.forEach((place, index) => {
      const chosen = this.chosen && this.chosen.name === pane.name && this.chosen.index === index;
      circle(g, place, (chosen ? 9 : 6) * ratio);
      g.fillStyle = chosen ? COLOUR : "#ffffff";
      g.fill();
      stroke(g, ratio, ["rgb(10 18 28 / .85)", 2]);
    });
  }
}

// a pixel inside the picture, to a tenth
function inside(pane, pixel) {
  return pixel.map((p, k) => Math.round(10 * Math.min(Math.max(p, 0), pane.lens.camera.size[k] - 1)) / 10);
}
// the part [x, y, width, height] of a picture of a size around points, of its own shape; null for all of it
function frame(points, [width, height]) {
  if (!points.length) return null;
  const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((k) => end(...points.map((p) => p[k]))));
  const across = Math.max(MARGIN * (high[0] - low[0]), (MARGIN * (high[1] - low[1]) * width) / height, width / LEAST);
  if (across >= width) return null;
  const size = [across, (across * height) / width], whole = [width, height];
  return [...size.map((s, k) => Math.min(Math.max((low[k] + high[k] - s) / 2, 0), whole[k] - s)), ...size];
}
// before which point a new one belongs at a place near the line through points, in css px; null where it is not near
function edge(points, [x, y]) {
  let best = LINE, index = null;
  if (points.length >= ENOUGH) points.forEach(([ax, ay], k) => {
    const [bx, by] = points[(k + 1) % points.length], long = (bx - ax) ** 2 + (by - ay) ** 2;
    const share = long ? Math.min(Math.max(((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / long, 0), 1) : 0;
    const away = Math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay));
    if (away < best) [best, index] = [away, k + 1];
  });
  return index;
}
