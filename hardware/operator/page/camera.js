// One camera's live picture with what was found in it: outline, tracks, the path where it will lie, the nozzle.
import { circle, fitted, pairs, polygon, stroke } from "./canvas.js";
import { drawPath, Lens, product } from "./lens.js";
import { element } from "./words.js";

const OLD = 1500; // ms: they come five times a second
const NO_HAND = { drag: null, press: () => false, click: () => false, preview: () => null, still: () => null, draw() {} }; // nothing is moved

export class CameraPane {
  // hand: takes presses, pulls and clicks in css px of the picture; see Placing and Outlining
  constructor(name, chosen, hand = NO_HAND) {
    this.name = name;
    this.root = element("figure", "", "camera");
    this.root.dataset.camera = name;
    this.canvas = element("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.ariaLabel = `${name}, live picture`;
    this.canvas.setAttribute("role", "button"); // it makes its picture large; what is moved by pulling has keys of its own
    this.canvas.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      chosen(name);
    });
    const caption = element("figcaption");
    [this.title, this.fare] = [element("span", name), element("span", "", "fare")];
    caption.append(this.title, this.fare);
    this.root.append(this.canvas, caption);
    const place = (event) => {
      const box = this.canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.hand = hand;
    let dragged = false;
    const drags = (event) => this.hand.drag && this.hand.drag.camera === this && this.hand.drag.id === event.pointerId;
    this.canvas.addEventListener("pointerdown", (event) => {
      dragged = false;
      if (event.button === 0 && this.hand.press(this, place(event), event)) this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (drags(event)) this.hand.pull(place(event));
    });
    for (const kind of ["pointerup", "pointercancel"]) this.canvas.addEventListener(kind, (event) => {
      if (drags(event)) dragged = this.hand.release();
    });
    this.root.addEventListener("click", (event) => {
      if (!dragged && !this.hand.click(this, place(event)) && !this.clicked(event)) chosen(name);
    });
    this.fitted = null; // how a pixel of the camera lies on the canvas
    this.corners = []; // of the region, [x, y] px
    this.drawing = this.place = null; // takes a corner while a region is drawn; where the picture lies on the canvas
    this.image = this.close = this.found = this.lens = null;
    this.fare.hidden = true;
  }
  // pixel of the camera at a place of the canvas in css px, null beside the picture
  pixel([x, y]) {
    if (!this.fitted) return null;
    const { scale, x0, y0, left, top, across, down, ratio } = this.fitted;
    const u = (x * ratio - x0) / scale, v = (y * ratio - y0) / scale;
    return u < 0 || v < 0 || u > across || v > down ? null : [u + left - 0.5, v + top - 0.5];
  }
  // place on the canvas in css px of a pixel of the camera
  shown([u, v]) {
    const { scale, x0, y0, left, top, ratio } = this.fitted;
    return [(x0 + scale * (u - left + 0.5)) / ratio, (y0 + scale * (v - top + 0.5)) / ratio];
  }
  see(camera) {
    this.lens = new Lens(camera);
  }
  show(image, close, found) {
    for (const each of [this.image, this.close]) if (each) each.close();
    [this.image, this.close, this.found, this.since] = [image, close, found, performance.now()];
  }
  choose(on) {
    this.root.classList.toggle("chosen", on);
    this.canvas.setAttribute("aria-pressed", String(on && document.body.dataset.large === "yes"));
  }
  // whether it is small beside another, so that a click makes it large
  get small() {
    return document.body.dataset.large === "yes" && !this.root.classList.contains("chosen");
  }
  // whether a click was a corner of the region
  clicked(event) {
    if (!this.drawing || !this.place || this.small) return false;
    const { x0, y0, scale, size, ratio } = this.place, box = this.canvas.getBoundingClientRect();
    const pixel = [(event.clientX - box.left) * ratio - x0, (event.clientY - box.top) * ratio - y0];
    this.drawing(pixel.map((p, k) => Math.round(10 * Math.min(Math.max(p / scale - 0.5, 0), size[k] - 1)) / 10));
    return true;
  }
  // a picture that stands still must not be taken for a live one
  tick() {
    const age = this.image ? performance.now() - this.since : 0, old = age > OLD && !this.standing;
    this.root.classList.toggle("still", old);
    const what = [this.name, "live picture", this.fare.textContent].filter(Boolean).join(", ");
    if (this.canvas.ariaLabel !== what) this.canvas.ariaLabel = what;
    this.title.textContent = this.standing ? `${this.name}, still picture` : old ? `${this.name}, ${(age / 1000).toFixed(0)} s old` : this.name;
  }
  fares(view) {
    this.root.dataset.verdict = view ? view.verdict : "";
    const parts = [];
    if (view && view.words) parts.push(view.words);
    else if (view) {
      if (view.rate !== null) parts.push(`${view.rate.toFixed(0)} Hz`);
      if (view.tracks) parts.push(`${view.tracks} tracks`);
      if (view.sharpness !== null) parts.push(`sharp ${(100 * view.sharpness).toFixed(0)} %`);
    }
    this.fare.textContent = parts.join(" · ");
    this.fare.hidden = !parts.length;
  }
  draw(scene, pose, fraction, base_from_nozzle, near) {
    const sheet = fitted(this.canvas);
    if (!sheet) return;
    const { g, w, h, ratio } = sheet;
    const size = this.lens ? this.lens.camera.size : this.image ? [this.image.width, this.image.height] : null;
    if (!size) return;
    const still = this.hand.still(this, near); // a picture that stands while something is put right on it
    this.standing = Boolean(still);
    const crop = still ? still.crop : near && !this.drawing && this.close && this.found.crop, [left, top, across, down] = crop || [0, 0, ...size];
    const scale = Math.min(w / across, h / down), x0 = (w - scale * across) / 2, y0 = (h - scale * down) / 2;
    this.place = { x0, y0, scale, size, ratio };
    this.fitted = { scale, x0, y0, left, top, across, down, ratio };
    this.canvas.dataset.drawn = still ? "outline" : !this.image ? "" : scene && pose && this.lens ? "path" : "picture";
    const fine = still && still.image.width / size[0];
    if (still) g.drawImage(still.image, fine * left, fine * top, fine * across, fine * down, x0, y0, scale * across, scale * down);
    else if (this.image) g.drawImage(crop ? this.close : this.image, x0, y0, scale * across, scale * down);
    if (!this.lens) return;
    g.save();
    g.beginPath();
    g.rect(x0, y0, scale * across, scale * down);
    g.clip();
    const on = (p) => p && [x0 + scale * (p[0] - left + 0.5), y0 + scale * (p[1] - top + 0.5)];
    if (still) {
      this.hand.draw(g, this, on, ratio);
      g.restore();
      return;
    }
    this.found && this.overlay(g, on, ratio);
    this.region(g, on, ratio);
    if (scene && pose) {
      const shift = this.hand.preview(), pixel = this.lens.from(shift ? product(pose, shift) : pose);
      this.scan(g, scene.scan, (x, y, z) => on(pixel(x, y, z)), ratio);
      const line = this.line(on(pixel(0, 0, 0)), on(pixel(1, 0, 0)), on(pixel(0, 1, 0)), ratio);
      const here = drawPath(g, scene, fraction, (x, y, z) => on(pixel(x, y, z)), {
        halo: line > ratio && { colour: "rgb(10 18 28 / .45)", width: 2.2 * line }, next: { colour: "#9fdcff", width: 0.9 * line },
        done: { colour: "#3ddc84", width: 1.4 * line },
      });
      if (here) this.ring(g, here, ratio);
      this.hand.draw(g, this, on, ratio);
    }
    if (base_from_nozzle) this.nozzle(g, on, base_from_nozzle, ratio);
    g.restore();
  }
  // the scan's rim and lines of equal depth
  scan(g, lines, pixel, ratio) {
    if (!lines || !lines.length) return;
    g.beginPath();
    for (let i = 0; i + 5 < lines.length; i += 6) {
      const a = pixel(lines[i], lines[i + 1], lines[i + 2]), b = pixel(lines[i + 3], lines[i + 4], lines[i + 5]);
      if (!a || !b) continue;
      g.moveTo(a[0], a[1]);
      g.lineTo(b[0], b[1]);
    }
    g.lineCap = "round";
    stroke(g, ratio, ["rgb(10 18 28 / .5)", 3], ["#e3bdff", 1.6]);
  }
  // width of the path's line: a third of a millimetre of the surface, so that neighbours stay apart
  line(middle, right, up, ratio) {
    const long = (p) => (p && middle ? Math.hypot(p[0] - middle[0], p[1] - middle[1]) : 0);
    return Math.min(Math.max(0.33 * Math.max(long(right), long(up)), 0.7 * ratio), 3 * ratio);
  }
  overlay(g, on, ratio) {
    g.lineJoin = "round";
    for (const outline of this.found.outline) {
      polygon(g, pairs(outline).map(on));
      stroke(g, ratio, ["rgb(10 18 28 / .6)", 4], ["#ffd75e", 2]);
    }
    const tracks = this.found.tracks, dot = 1.5 * ratio;
    g.fillStyle = "#ffffff";
    g.beginPath();
    for (let i = 0; i + 1 < tracks.length; i += 2) {
      const p = on(this.lens.distorted(tracks[i], tracks[i + 1]));
      if (p) g.rect(p[0] - dot / 2, p[1] - dot / 2, dot, dot);
    }
    g.fill();
  }
  // the region as it has been drawn so far
  region(g, on, ratio) {
    this.canvas.dataset.corners = this.corners.length;
    if (!this.corners.length) return;
    const at = this.corners.map(on);
    polygon(g, at);
    g.fillStyle = "rgb(255 215 94 / .18)";
    g.fill();
    stroke(g, ratio, ["rgb(10 18 28 / .7)", 4], ["#ffd75e", 2]);
    g.fillStyle = "#ffffff";
    for (const [x, y] of at) g.fillRect(x - 3 * ratio, y - 3 * ratio, 6 * ratio, 6 * ratio);
  }
  ring(g, place, ratio) {
    circle(g, place, 6 * ratio);
    stroke(g, ratio, ["rgb(10 18 28 / .7)", 4], ["#ffffff", 2]);
  }
  nozzle(g, on, pose, ratio) {
    const pixel = this.lens.from(pose), tip = on(pixel(0, 0, 0)), back = on(pixel(0, 0, 12));
    if (!tip) return;
    g.lineCap = "round";
    for (const [colour, width] of [["rgb(10 18 28 / .75)", 6], ["#ff9f43", 3]]) {
      [g.strokeStyle, g.fillStyle, g.lineWidth] = [colour, colour, width * ratio];
      if (back) {
        g.beginPath();
        g.moveTo(...tip);
        g.lineTo(...back);
        g.stroke();
      }
      circle(g, tip, 0.8 * width * ratio);
      g.fill();
    }
  }
}
