// The error over the run: what was predicted, what was true where that is known, and when the nozzle was held. Drawn by
// uPlot: pull over a stretch to see it larger, double-click to see all of what is chosen, point at it for the figures.
import { colours, onTheme } from "./theme.js";
import { duration, figure } from "./words.js";
import uPlot from "./uplot.js";

const MINUTE = 60; // s
const ROWS = 2400; // two become one when all are full, as on the other side
const ONE_DIRECTION = 1.96; // standard deviations that hold 95 %: the limit is one of a standard deviation
const ZOOM = 0.5; // of what is shown, for a key
const STAMP = 0, ERROR = 1, TRUTH = 2, LIMIT = 3, HELD = 4; // columns of a row

export class ErrorChart {
  // root: where it is drawn; spans: buttons that choose what is shown
  constructor(root, spans) {
    [this.root, this.spans] = [root, spans];
    [this.rows, this.step, this.begun] = [[], 0.1, 0];
    [this.span, this.zoomed, this.chart] = ["minute", null, null];
    for (const button of spans) button.addEventListener("click", () => this.choose(button.dataset.span));
    root.addEventListener("keydown", (event) => this.key(event));
    onTheme(() => this.rebuild());
    new ResizeObserver(() => this.fit()).observe(root);
  }
  begin(message) {
    [this.rows, this.step] = [message.rows, message.step];
  }
  add(view) {
    const motion = view.motion, rows = this.rows, last = rows[rows.length - 1];
    if (!motion || (last && last[STAMP] >= view.stamp)) return;
    const aged = motion.error_age > 1;
    this.enter([view.stamp, aged ? null : motion.error, aged ? null : motion.true_error, ONE_DIRECTION * motion.limit, motion.activity === "holding"]);
  }
  enter(row) {
    const last = this.rows[this.rows.length - 1];
    if (last && row[STAMP] - last[STAMP] < this.step) merge(last, row);
    else this.rows.push(row);
    if (this.rows.length <= ROWS) return;
    this.step *= 2;
    const rows = this.rows;
    this.rows = [];
    for (const each of rows) this.enter(each);
  }
  choose(span) {
    [this.span, this.zoomed] = [span, null];
    this.draw();
  }
  key(event) {
    const range = this.range(), wide = range[1] - range[0];
    const act = {
      "+": () => (this.zoomed = [range[1] - wide * ZOOM, range[1]]), "-": () => (this.zoomed = [range[1] - wide / ZOOM, range[1]]),
      ArrowLeft: () => (this.zoomed = range.map((t) => t - wide / 4)), ArrowRight: () => (this.zoomed = range.map((t) => t + wide / 4)),
      Escape: () => (this.zoomed = null),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    event.stopPropagation();
    act();
    this.draw();
  }
  // s since the first row, from and to
  range() {
    if (this.zoomed) return this.zoomed;
    const end = this.rows.length ? this.rows[this.rows.length - 1][STAMP] - this.rows[0][STAMP] : MINUTE;
    return this.span === "minute" ? [end - MINUTE, end] : [0, Math.max(end, 1)];
  }
  build(width, height) {
    const c = colours, font = '13px "Inter", "Segoe UI", "DejaVu Sans", system-ui, sans-serif';
    const mm = (u, value) => (value === null || value === undefined ? "–" : `${value.toFixed(2)} mm`);
    const axis = { stroke: c.soft, font, grid: { stroke: c.faint, width: 1 }, ticks: { stroke: c.faint, width: 1, size: 4 }, gap: 3 };
    return new uPlot({
      width, height, pxAlign: true, padding: [6, 8, 0, 0],
      legend: { live: true },
      cursor: { drag: { x: true, y: false, setScale: false }, y: false },
      scales: { x: { time: false, range: () => this.range() }, y: { range: (u, low, high) => [0, Math.max(2 * (this.limit() ?? 0.25), 0.1)] } },
      axes: [
        { ...axis, size: 24, values: (u, values) => values.map((v) => (v < 0 ? "" : v < 60 ? `${+v.toFixed(1)} s` : duration(v))), space: 70 },
        { ...axis, size: 34, space: 26 },
      ],
      series: [
        { label: "time", value: (u, value) => (value === null || value === undefined ? "–" : duration(value)) },
        { label: "predicted, 95 %", stroke: c.blue, width: 1.8, points: { show: false }, value: mm },
        { label: "true", stroke: c.true, width: 1.8, points: { show: false }, value: mm, show: this.rows.some((row) => row[TRUTH] !== null) },
        { label: "limit, 95 %", stroke: c.rose, width: 1.4, dash: [6, 4], points: { show: false }, value: mm },
      ],
      hooks: {
        drawClear: [(u) => this.shade(u)],
        setSelect: [(u) => {
          if (u.select.width > 4) this.zoomed = [u.select.left, u.select.left + u.select.width].map((x) => u.posToVal(x, "x"));
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          this.draw();
        }],
        ready: [(u) => u.over.addEventListener("dblclick", () => this.choose(this.span))],
      },
    }, this.data(), this.root);
  }
  limit() {
    return this.rows.length ? this.rows[this.rows.length - 1][LIMIT] : null;
  }
  data() {
    const begun = this.rows.length ? this.rows[0][STAMP] : 0;
    return [this.rows.map((row) => row[STAMP] - begun), ...[ERROR, TRUTH, LIMIT].map((column) => this.rows.map((row) => row[column]))];
  }
  // the times in which the nozzle was held
  shade(u) {
    const rows = this.rows, g = u.ctx, begun = rows.length ? rows[0][STAMP] : 0;
    g.save();
    g.fillStyle = colours.held;
    for (let i = 0; i < rows.length; i++) {
      const first = i;
      while (i < rows.length && rows[i][HELD]) i++;
      if (i === first) continue;
      const [from, to] = [rows[first][STAMP], rows[Math.min(i, rows.length - 1)][STAMP]].map((t) => u.valToPos(t - begun, "x", true));
      const left = Math.max(from, u.bbox.left), right = Math.min(Math.max(to, from + 1), u.bbox.left + u.bbox.width);
      if (right > left) g.fillRect(left, u.bbox.top, right - left, u.bbox.height);
    }
    g.restore();
  }
  fit() {
    if (this.chart && this.room()) this.chart.setSize(this.room());
  }
  // what is left for the chart beside its legend, null where that is nothing
  room() {
    const legend = this.root.querySelector(".u-legend"), width = this.root.clientWidth, height = this.root.clientHeight - (legend ? legend.offsetHeight : 26);
    return width > 80 && height > 30 ? { width, height } : null;
  }
  rebuild() {
    if (this.chart) this.chart.destroy();
    this.chart = null;
    this.draw();
  }
  draw() {
    this.root.parentElement.dataset.rows = this.rows.length;
    const room = this.room();
    if (!room || !this.rows.length) return;
    const known = this.rows.some((row) => row[TRUTH] !== null);
    if (this.chart && this.known !== known) this.chart.destroy();
    if (!this.chart || this.known !== known) [this.known, this.chart] = [known, this.build(room.width, room.height)];
    if (Math.abs(this.chart.height - this.room().height) > 1) this.fit(); // the legend has come
    else this.chart.setData(this.data());
    for (const button of this.spans) button.setAttribute("aria-pressed", String(!this.zoomed && button.dataset.span === this.span));
    const [, error, , limit] = this.rows[this.rows.length - 1];
    this.root.setAttribute("aria-label", `error over the run: predicted ${figure(error, 2)} mm (95 %) now, limit ${figure(limit, 2)} mm. Plus and minus zoom, arrow keys move, Escape shows all again`);
  }
}

function merge(row, other) {
  for (const column of [ERROR, TRUTH]) row[column] = row[column] === null ? other[column] : Math.max(row[column], other[column] ?? -Infinity);
  [row[LIMIT], row[HELD]] = [other[LIMIT], row[HELD] || other[HELD]];
}
