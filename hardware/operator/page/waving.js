// The page beside a calibration: live pictures with the corners that were found, what each camera still needs, the hint.
import { circle, fitted, pairs, stroke } from "./canvas.js";
import { unpacked } from "./panes.js";
import { Line } from "./socket.js";
import { themeButton } from "./theme.js";
import { element, heard, newsOf, showNews, toast, upper } from "./words.js";

const STAGES = {
  wave: { word: "Wave", tone: "wait", say: "Wave the board slowly before the cameras." },
  solve: { word: "Calibrating", tone: "wait", say: "Enough was seen. Lenses and places are being computed." },
  passed: { word: "Passed", tone: "good", say: "The cameras are calibrated." },
  failed: { word: "Not good", tone: "bad", say: "These cameras cannot be trusted yet." },
  stopped: { word: "Stopped", tone: "hold", say: "Stopped. What was seen is kept." },
};
const TILTS = [["◀", "its left side nearer"], ["▶", "its right side nearer"], ["▲", "its top nearer"], ["▼", "its bottom nearer"]];
const ENOUGH = "Enough was seen.";
const OLD = 3000; // ms: finding the board takes a while on a small machine
const by = (id) => document.getElementById(id);
const state = { view: null, age: Infinity, since: 0, stale: 1, gone: false, full: false, turn: 0 };
const boards = new Map();

// One camera: its picture, the parts that the board has been held in, and three bars.
class BoardPane {
  constructor(name) {
    this.name = name;
    this.root = element("article", "", "board");
    this.root.dataset.camera = name;
    this.figure = element("figure", "", "camera");
    this.canvas = element("canvas");
    this.figure.append(this.canvas);
    const head = element("div", "", "head"), needs = element("div", "", "needs");
    this.title = element("b", name);
    this.found = element("span");
    head.append(this.title, this.found);
    this.bars = Object.fromEntries(["where", "tilts", "depth"].map((key, k) => {
      const what = element("span", ["all over the picture", "tilted", "near and far"][k]), bar = element("div", "", "bar"), far = element("b");
      bar.append(element("i"));
      needs.append(what, bar, far);
      return [key, { what, bar, far }];
    }));
    this.ways = TILTS.map(([sign, words]) => {
      const way = element("i", sign, "way");
      way.title = words;
      this.bars.tilts.what.append(way);
      return way;
    });
    this.root.append(this.figure, head, needs);
    this.image = this.view = null;
    this.tracks = [];
  }
  show(image, tracks) {
    if (this.image) this.image.close();
    [this.image, this.tracks, this.since] = [image, tracks, performance.now()];
  }
  tells(view, next) {
    this.view = view;
    const mean = (values) => values.reduce((sum, each) => sum + each, 0) / values.length;
    fill(this.bars.where, mean(view.parts.flat()));
    fill(this.bars.tilts, mean(view.tilts));
    fill(this.bars.depth, view.depth);
    this.ways.forEach((way, k) => way.classList.toggle("full", view.tilts[k] >= 1));
    this.figure.style.aspectRatio = `${view.size[0]} / ${view.size[1]}`;
    this.found.textContent = view.corners ? `${view.corners} corners` : "no board";
    this.root.dataset.next = next ? "yes" : "no";
  }
  draw() {
    const { image } = this, sheet = image && this.view && fitted(this.canvas);
    if (!sheet) return;
    const { g, w, h, ratio } = sheet;
    const scale = Math.min(w / image.width, h / image.height), x0 = (w - scale * image.width) / 2, y0 = (h - scale * image.height) / 2;
    g.drawImage(image, x0, y0, scale * image.width, scale * image.height);
    this.parts(g, x0, y0, scale * image.width, scale * image.height, ratio);
    const shown = (scale * image.width) / this.view.size[0]; // corners are px of the camera's own size
    for (const [x, y] of pairs(this.tracks)) {
      circle(g, [x0 + shown * (x + 0.5), y0 + shown * (y + 0.5)], 3 * ratio);
      stroke(g, ratio, ["rgb(10 18 28 / .75)", 4], ["#3ddc84", 2]);
    }
    this.canvas.dataset.drawn = this.tracks.length ? "corners" : "picture";
  }
  // what lies in the shade has not seen the board often enough
  parts(g, x0, y0, w, h, ratio) {
    const rows = this.view.parts.length, columns = this.view.parts[0].length;
    this.view.parts.forEach((row, i) => row.forEach((share, j) => {
      const place = [x0 + (j * w) / columns, y0 + (i * h) / rows, w / columns, h / rows];
      g.fillStyle = `rgb(14 34 60 / ${(0.62 * (1 - share)).toFixed(3)})`;
      g.fillRect(...place);
      [g.strokeStyle, g.lineWidth] = ["rgb(255 255 255 / .35)", ratio];
      g.strokeRect(...place);
      if (share >= 1) return;
      g.fillStyle = "#ffffff";
      g.font = `600 ${13 * ratio}px system-ui, sans-serif`;
      g.textAlign = "center";
      g.fillText(`${Math.floor(100 * share)} %`, place[0] + place[2] / 2, place[1] + place[3] / 2 + 4 * ratio);
    }));
  }
  tick() {
    const age = this.image ? performance.now() - this.since : 0, old = age > OLD && state.view && state.view.stage === "wave";
    this.figure.classList.toggle("still", Boolean(old));
    this.title.textContent = old ? `${this.name}, ${(age / 1000).toFixed(0)} s old` : this.name;
  }
}

function fill({ bar, far }, share) {
  bar.firstElementChild.style.width = `${(100 * share).toFixed(1)}%`;
  bar.classList.toggle("full", share >= 1);
  far.textContent = share >= 1 ? "✓" : `${Math.floor(100 * share)} %`;
}

async function hear(message) {
  if (message instanceof ArrayBuffer) return pictures(message);
  if (message.kind === "full") state.full = true;
  else if (message.kind === "asked" && message.words) toast(`${upper(message.wish)} was not followed: ${message.words}.`, true);
  else if (message.kind === "view" || message.kind === "gone") {
    heard(state, message);
    show();
  }
}

async function pictures(data) {
  const { head, images } = await unpacked(data);
  head.pictures.forEach((each, k) => images[k][0] && pane(each.camera).show(images[k][0], each.tracks));
  for (const each of boards.values()) each.draw();
}

function pane(name) {
  if (!boards.has(name)) {
    const one = new BoardPane(name);
    boards.set(name, one);
    by("cameras").append(one.root);
  }
  return boards.get(name);
}

function show() {
  const seen = state.view, quiet = seen && seen.stage !== "wave"; // nothing is told while it computes, nor once it is over
  const [news, age] = newsOf(state, line.connected, quiet);
  showNews(news, age, "calibration", seen && !["wave", "solve"].includes(seen.stage));
  if (seen) tell(seen, news);
}

function tell(seen, news) {
  const about = STAGES[seen.stage], offers = ["live", "old"].includes(news) ? seen.offers : [];
  [document.body.dataset.stage, document.body.dataset.tone] = [seen.stage, about.tone];
  state.turn = seen.turn;
  by("chip").textContent = about.word;
  const waving = seen.stage === "wave";
  by("question").textContent = waving ? upper(seen.hints[0] || (seen.looked ? ENOUGH : about.say)) : about.say;
  by("reason").textContent = waving && seen.hints.length > 1 ? `Then: ${seen.hints[1]}` : "";
  by("looked").textContent = seen.looked ? `${seen.looked} pictures looked at` : "";
  for (const camera of seen.cameras) pane(camera.name).tells(camera, waving && (seen.hints[0] || "").startsWith(`${camera.name}:`));
  fill({ bar: document.querySelector("#together .bar"), far: document.querySelector("#together b") }, seen.together);
  by("together").hidden = seen.cameras.length < 2 || seen.words.length > 0;
  by("result").hidden = !seen.words.length;
  document.querySelector("#result pre").textContent = seen.words.join("\n");
  by("cameras").hidden = seen.words.length > 0;
  document.querySelector("[data-wish=end]").disabled = !offers.includes("end");
  document.querySelector("[data-wish=stop]").disabled = !waving;
  for (const each of boards.values()) each.draw();
}

const line = new Line(hear);
for (const button of document.querySelectorAll("footer button")) button.addEventListener("click", () => {
  if (line.ask(button.dataset.wish, state.turn) === null) toast("Nobody can be asked: no connection.", true);
});
window.addEventListener("resize", () => { for (const each of boards.values()) each.draw(); });
setInterval(() => {
  for (const each of boards.values()) each.tick();
  show();
}, 250);
themeButton(by("theme"));
