// Where the surface was all along: x, y and z against the first pose, the state as a ribbon, a line where one is.
import { colours } from "./theme.js";

const COLOURS = ["blue", "true", "green"]; // of the theme: x, y, z
const STATES = { TRACKING: "#4c9a6a", DEGRADED: "#e3b23c", COASTING: "#e58a5a", LOST: "#c8553d", INITIALISING: "#b4b9bf" };
const LEFT = 44, FOOT = 40;

export class Timeline {
  constructor(canvas) {
    this.canvas = canvas;
    this.session = null;
    this.chosen = () => {};
    const pick = (e) => this.session && e.buttons && this.chosen(this.nearest(e.offsetX));
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      pick(e);
    });
    canvas.addEventListener("pointermove", pick);
  }
  see(session) {
    this.session = session;
    const first = session.places.find((p) => p) || [0, 0, 0];
    this.moved = session.places.map((p) => p && p.map((v, i) => v - first[i]));
    const all = this.moved.flatMap((p) => p || []);
    this.low = all.reduce((a, b) => Math.min(a, b), 0);
    this.high = all.reduce((a, b) => Math.max(a, b), 0);
    if (this.high - this.low < 0.1) [this.low, this.high] = [this.low - 0.05, this.high + 0.05];
  }
  nearest(x) {
    const { stamps } = this.session, last = stamps[stamps.length - 1] || 1;
    const t = ((x - LEFT) / Math.max(this.canvas.clientWidth - LEFT - 6, 1)) * last;
    let low = 0, high = stamps.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (stamps[middle] < t) low = middle + 1; else high = middle;
    }
    return low > 0 && t - stamps[low - 1] < stamps[low] - t ? low - 1 : low;
  }
  draw(k) {
    const ratio = window.devicePixelRatio || 1, canvas = this.canvas, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (!w || !h || !this.session) return;
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    const g = canvas.getContext("2d"), { stamps, states } = this.session, last = stamps[stamps.length - 1] || 1;
    const left = LEFT * ratio, right = w - 6 * ratio, floor = h - FOOT * ratio, top = 6 * ratio;
    const x = (t) => left + ((right - left) * t) / last, y = (v) => floor - ((floor - top) * (v - this.low)) / (this.high - this.low);
    g.clearRect(0, 0, w, h);
    g.font = `${13 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    g.strokeStyle = colours.faint;
    g.lineWidth = ratio;
    g.strokeRect(left, top, right - left, floor - top);
    const every = Math.max(1, Math.floor(stamps.length / (2 * w)));
    COLOURS.forEach((colour, axis) => {
      g.strokeStyle = colours[colour];
      g.lineWidth = 1.6 * ratio;
      g.beginPath();
      let pen = false;
      for (let i = 0; i < stamps.length; i += every) {
        const p = this.moved[i];
        if (p) pen ? g.lineTo(x(stamps[i]), y(p[axis])) : g.moveTo(x(stamps[i]), y(p[axis]));
        pen = p !== null;
      }
      g.stroke();
    });
    for (let i = 0; i < stamps.length; ) {
      let end = i;
      while (end < stamps.length && states[end] === states[i]) end++;
      g.fillStyle = STATES[states[i]] || colours.faint;
      g.fillRect(x(stamps[i]), floor + 3 * ratio, Math.max(x(stamps[Math.min(end, stamps.length - 1)]) - x(stamps[i]), ratio), 7 * ratio);
      i = end;
    }
    g.strokeStyle = colours.ink;
    g.lineWidth = 2 * ratio;
    g.beginPath();
    g.moveTo(x(stamps[k]), top);
    g.lineTo(x(stamps[k]), floor + 11 * ratio);
    g.stroke();
    g.fillStyle = colours.soft;
    g.textAlign = "right";
    g.fillText(this.high.toFixed(1), left - 5 * ratio, top + 11 * ratio);
    g.fillText(this.low.toFixed(1).replace(/^-0\.0$/, "0.0"), left - 5 * ratio, floor);
    g.fillText(`${last.toFixed(1)} s`, right, h - 8 * ratio);
    g.textAlign = "left";
    let at = left;
    for (const [words, colour] of [["x", COLOURS[0]], ["y", COLOURS[1]], ["z in mm, the base's axes", COLOURS[2]]]) {
      g.fillStyle = colours[colour];
      g.fillText(words, at, h - 8 * ratio);
      at += g.measureText(words).width + 12 * ratio;
    }
  }
}
