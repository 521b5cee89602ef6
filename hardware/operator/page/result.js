// The end of a run: what was printed, how well, what held it, and where the files are.
import { fitted } from "./canvas.js";
import { colours, onTheme } from "./theme.js";
import { duration, element, figure } from "./words.js";

const GOOD = 0.5; // of the limit: up to there a bead is drawn as good

export class ResultView {
  constructor(root) {
    [this.root, this.seen, this.limit, this.report] = [root, null, null, null];
    this.canvas = root.querySelector("canvas");
    onTheme(() => this.scene && this.draw(this.scene));
    new ResizeObserver(() => this.scene && this.draw(this.scene)).observe(this.canvas);
  }
  // result: of the newest view, null while the run goes on
  show(view, scene) {
    const result = view && view.result;
    this.root.hidden = !result;
    this.scene = scene;
    if (!result) return (this.seen = null);
    if (view.motion && view.motion.limit !== null) this.limit = view.motion.limit;
    if (result.report) this.fetch();
    const wanted = JSON.stringify(result);
    if (this.seen === wanted) return;
    this.seen = wanted;
    this.tell(result);
    if (scene) this.draw(scene);
  }
  tell(result) {
    const two = (pair, what) => (pair[0] === null ? [] : [[`${figure(pair[0], 2)} / ${figure(pair[1], 2)}`, "mm", `${what} error, 95 % / largest`]]);
    const tiles = [
      [(100 * result.printed).toFixed(result.printed < 1 ? 1 : 0), "%", `printed, checkpoint ${Math.floor(result.fraction)} of ${result.total}`],
      ...two(result.true_error, "true"), ...two(result.error, "predicted"),
      [result.duty === null ? "–" : (100 * result.duty).toFixed(0), result.duty === null ? "" : "%", "duty cycle"],
      [duration(result.seconds), "", "since the approach"],
      ...(result.ink === null ? [] : [[result.ink.toFixed(result.ink < 10 ? 2 : 0), "mm³", "of ink"]]),
      ...(result.begun ? [[`${((100 * result.begun) / result.total).toFixed(0)} %`, "", "start of this run"]] : []),
    ];
    this.root.querySelector(".sums").replaceChildren(...tiles.map(([value, unit, words]) => {
      const box = element("div"), figures = element("b", value);
      figures.append(element("small", unit));
      box.append(figures, element("span", words));
      return box;
    }));
    const rows = result.holds.map((hold) => {
      const row = element("tr");
      row.append(element("td", hold.reason), element("td", `${hold.count} ×`), element("td", `${hold.seconds.toFixed(1)} s`));
      return row;
    });
    this.root.querySelector("tbody").replaceChildren(...rows);
    this.root.querySelector(".none").hidden = rows.length > 0;
    this.root.querySelector("table").hidden = !rows.length;
    this.root.querySelector(".record").textContent = result.record;
    this.root.querySelector(".again").hidden = !result.again;
    this.root.querySelector(".again code").textContent = result.again;
    this.where(result.report);
  }
  where(file) {
    const link = this.root.querySelector(".report a"), path = this.root.querySelector(".report code");
    path.textContent = file || "is being written";
    link.hidden = !this.report;
    if (this.report) [link.href, link.download] = [this.report, file.split(/[\\/]/).pop()];
  }
  // the run's process ends soon: the report is taken while it can be had
  async fetch() {
    if (this.report !== null) return;
    this.report = "";
    const answer = await fetch("report").catch(() => null);
    if (!answer || !answer.ok) return (this.report = null);
    this.report = URL.createObjectURL(await answer.blob());
    if (this.seen) this.where(JSON.parse(this.seen).report);
  }
  // the path from above, each stretch in the colour of its largest error
  draw(scene) {
    const result = this.seen && JSON.parse(this.seen), canvas = this.canvas, p = scene.path;
    const sheet = result && p.length >= 6 && fitted(canvas);
    if (!sheet) return;
    const { g, w, h, ratio } = sheet, limit = this.limit || 0.5, along = [0, 1].map((k) => p.filter((_, i) => i % 3 === k));
    const [low, high] = [along.map((v) => Math.min(...v)), along.map((v) => Math.max(...v))], margin = 8 * ratio;
    const scale = Math.min(...[w, h].map((size, k) => (size - 2 * margin) / Math.max(high[k] - low[k], 1)));
    const place = (i) => [w / 2 + scale * (p[3 * i] - (low[0] + high[0]) / 2), h / 2 - scale * (p[3 * i + 1] - (low[1] + high[1]) / 2)];
    const count = result.stretches.length, stretch = (number) => Math.min(Math.floor((number / Math.max(result.total, 1)) * count), count - 1);
    const of = (i) => { // the largest error on the way to a place, null where none was printed there
      const known = result.stretches.slice(stretch(scene.checkpoint[i - 1]), stretch(scene.checkpoint[i]) + 1).filter((error) => error !== null);
      return known.length ? Math.max(...known) : null;
    };
    g.lineCap = "round";
    g.lineWidth = Math.max(Math.min(0.4 * scale, 4 * ratio), 1.2 * ratio);
    const pieces = [];
    for (let i = 1; i < scene.checkpoint.length; i++) if (scene.extrude[i]) pieces.push([i, of(i)]);
    pieces.sort((a, b) => (a[1] ?? -1) - (b[1] ?? -1)); // the worst on top: layers lie over each other
    for (const [i, error] of pieces) {
      const before = result.begun >= scene.checkpoint[i]; // printed by a run before this one
      g.strokeStyle = error === null ? (before ? colours.soft : colours.faint) : error > limit ? colours.rose : error > GOOD * limit ? colours.amber : colours.green;
      g.beginPath();
      g.moveTo(...place(i - 1));
      g.lineTo(...place(i));
      g.stroke();
    }
    const worst = pieces.length ? pieces[pieces.length - 1][1] ?? 0 : 0;
    canvas.setAttribute("aria-label", `the beads from above, in the colour of their error: ${worst.toFixed(2)} mm at most, limit ${limit} mm`);
    this.root.querySelector("span.good").textContent = `to ${(GOOD * limit).toFixed(2)} mm`;
    this.root.querySelector("span.fair").textContent = `to ${limit} mm`;
    this.root.querySelector("span.poor").textContent = `beyond`;
    canvas.dataset.drawn = "yes";
  }
}
