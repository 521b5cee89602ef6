// Where the surface was all along: x, y and z against the first pose, the error, holds shaded, states and stages as
// ribbons, the run's log as ticks, a line where one is. The wheel or the buttons show a stretch of it.
import { colours } from "./theme.js";

const COLOURS = ["blue", "true", "green"]; // of the theme: x, y, z
const STATES = { TRACKING: "#4c9a6a", DEGRADED: "#e3b23c", COASTING: "#e58a5a", LOST: "#c8553d", INITIALISING: "#b4b9bf" };
const STAGES = { print: "#4c9a6a", paused: "#e3b23c", stopped: "#c8553d", failed: "#c8553d", ended: "#8a919a" }; // others: grey
const LEFT = 44, FOOT = 62;
const SHORTEST = 0.2; // s that are shown at least

// a line through the places [x, y] of every so many instants before `end`, with a gap where there is none
export function trace(g, end, every, place) {
  g.beginPath();
  let pen = false;
  for (let i = 0; i < end; i += every) {
    const p = place(i);
    if (p) pen ? g.lineTo(...p) : g.moveTo(...p);
    pen = Boolean(p);
  }
  g.stroke();
}

export class Timeline {
  constructor(canvas) {
    this.canvas = canvas;
    this.session = null;
    this.chosen = this.changed = () => {};
    [this.from, this.to] = [0, 1]; // s that are shown
    canvas.addEventListener("wheel", (e) => {
      if (!this.session) return;
      e.preventDefault();
      this.zoom(Math.exp(-e.deltaY * 0.002), this.at(e.offsetX));
      this.changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => {
      this.zoom(0);
      this.changed();
    });
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
    this.worst = session.off.reduce((a, b) => Math.max(a, b || 0), 0); // mm, of the error
    this.zoom(0);
    if (this.high - this.low < 0.1) [this.low, this.high] = [this.low - 0.05, this.high + 0.05];
  }
  // show so many times less, about t; 0: all of it
  zoom(times, t) {
    const { stamps } = this.session, last = stamps[stamps.length - 1] || 1;
    if (!times) [this.from, this.to] = [0, last];
    else {
      const wide = Math.min(Math.max((this.to - this.from) / times, Math.min(SHORTEST, last)), last);
      const share = (t - this.from) / (this.to - this.from);
      this.from = Math.min(Math.max(t - Math.min(Math.max(share, 0), 1) * wide, 0), last - wide);
      this.to = this.from + wide;
    }
  }
  at(x) {
    return this.from + ((x - LEFT) / Math.max(this.canvas.clientWidth - LEFT - 6, 1)) * (this.to - this.from);
  }
  nearest(x) {
    const { stamps } = this.session, t = this.at(x);
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
    const g = canvas.getContext("2d"), { stamps, states, held, off, events, stages } = this.session, last = stamps[stamps.length - 1] || 1;
    if (stamps[k] < this.from || stamps[k] > this.to) { // what is chosen stays in sight
      const wide = this.to - this.from;
      this.from = Math.min(Math.max(stamps[k] - wide / 2, 0), Math.max(last - wide, 0));
      this.to = this.from + wide;
    }
    const left = LEFT * ratio, right = w - 6 * ratio, floor = h - FOOT * ratio, top = 6 * ratio;
    const x = (t) => left + ((right - left) * (t - this.from)) / (this.to - this.from), y = (v) => floor - ((floor - top) * (v - this.low)) / (this.high - this.low);
    g.clearRect(0, 0, w, h);
    g.font = `${13 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    g.strokeStyle = colours.faint;
    g.lineWidth = ratio;
    g.strokeRect(left, top, right - left, floor - top);
    g.save();
    g.beginPath();
    g.rect(left, 0, right - left, h);
    g.clip();
    const runs = (all, paint) => {
      for (let i = 0; i < stamps.length; ) {
        let end = i;
        while (end < stamps.length && Boolean(all[end]) === Boolean(all[i]) && (typeof all[i] !== "string" || all === held || all[end] === all[i])) end++;
        const to = stamps[Math.min(end, stamps.length - 1)];
        paint(all[i], x(stamps[i]), Math.max(x(to) - x(stamps[i]), ratio));
        i = end;
      }
    };
    g.fillStyle = "rgb(200 85 61 / .18)";
    runs(held, (why, from, wide) => why && g.fillRect(from, top, wide, floor - top));
    stages.forEach(([t, name], i) => {
      g.fillStyle = STAGES[name] || colours.faint;
      const end = i + 1 < stages.length ? stages[i + 1][0] : last;
      g.fillRect(x(t), floor + 12 * ratio, Math.max(x(end) - x(t), ratio), 7 * ratio);
    });
    g.fillStyle = colours.soft;
    for (const [t] of events) g.fillRect(x(t), top, ratio, 5 * ratio);
    const every = Math.max(1, Math.floor(stamps.length / (2 * w)));
    COLOURS.forEach((colour, axis) => {
      g.strokeStyle = colours[colour];
      g.lineWidth = 1.6 * ratio;
      trace(g, stamps.length, every, (i) => this.moved[i] && [x(stamps[i]), y(this.moved[i][axis])]);
    });
    if (this.worst > 0) {
      g.strokeStyle = "#a65fb8";
      g.setLineDash([4 * ratio, 3 * ratio]);
      trace(g, stamps.length, every, (i) => off[i] !== null && [x(stamps[i]), floor - ((floor - top) * off[i]) / (1.05 * this.worst)]);
      g.setLineDash([]);
    }
    runs(states, (name, from, wide) => {
      g.fillStyle = STATES[name] || colours.faint;
      g.fillRect(from, floor + 3 * ratio, wide, 7 * ratio);
    });
    g.strokeStyle = colours.ink;
    g.lineWidth = 2 * ratio;
    g.beginPath();
    g.moveTo(x(stamps[k]), top);
    g.lineTo(x(stamps[k]), floor + 20 * ratio);
    g.stroke();
    g.restore();
    g.fillStyle = colours.soft;
    g.textAlign = "right";
    g.fillText(this.high.toFixed(1), left - 5 * ratio, top + 11 * ratio);
    g.fillText(this.low.toFixed(1).replace(/^-0\.0$/, "0.0"), left - 5 * ratio, floor);
    g.fillText(`${this.to.toFixed(1)} s`, right, floor + 34 * ratio);
    g.textAlign = "left";
    g.fillText(`${this.from.toFixed(1)} s`, left, floor + 34 * ratio);
    let at = left;
    for (const [words, colour] of [["x", COLOURS[0]], ["y", COLOURS[1]], ["z in mm, the base's axes", COLOURS[2]], ...(this.worst > 0 ? [[`error, from 0 below to ${Number(this.worst.toPrecision(2))} mm above`, ""]] : []), ...(held.some((each) => each) ? [["shaded: held", "soft"]] : [])]) {
      g.fillStyle = colours[colour] || "#a65fb8";
      g.fillText(words, at, h - 8 * ratio);
      at += g.measureText(words).width + 12 * ratio;
    }
  }
}
