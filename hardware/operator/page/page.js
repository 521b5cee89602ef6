// The operator's page: hears the run, shows it, and asks. The newest wins; nothing is kept but the last minute's error.
import { Buttons } from "./buttons.js";
import { Course } from "./course.js";
import { Drawing } from "./draw.js";
import { Outlining } from "./outline.js";
import { Panes, unpacked } from "./panes.js";
import { Placing } from "./placing.js";
import { SceneView } from "./scene.js";
import { Line } from "./socket.js";
import { ACTIVITIES, duration, figure, milliseconds, STAGES, TRACKING, upper, VERDICTS } from "./words.js";

const LARGE = ["find", "confirm"]; // stages in which the pictures are what matters
const EVENTS = 2; // of the last ones that there is room for
const CHECKED = ["check", "find", "confirm", "ready", "failed"];
const by = (id) => document.getElementById(id);
const state = { view: null, scene: null, poses: null, age: Infinity, since: 0, stale: 1, refused: 0, gone: false, full: false, chosen: null, large: null, near: true };
const placing = new Placing(by("placing"), (move, turn) => buttons.send("move", turn, { move }), (words, bad) => buttons.say(words, bad), refresh);
const panes = new Panes(by("pictures"), choose, placing);
const outlining = new Outlining(by("outlining"), by("outline"), panes, (outline, turn) => buttons.send("outline", turn, { outline }), (words, bad) => buttons.say(words, bad), show);
const course = new Course(document.querySelector("#course canvas"));
const space = new SceneView(by("scene"));

async function hear(message) {
  if (message instanceof ArrayBuffer) return pictures(message);
  if (message.kind === "scene") scene(message);
  else if (message.kind === "course") course.begin(message.rows);
  else if (message.kind === "asked" && message.wish === "region") drawing.asked(message);
  else if (message.kind === "asked") {
    buttons.asked(message);
    placing.asked(message);
  }
  else if (message.kind === "full") state.full = true;
  else if (message.kind === "view" || message.kind === "gone") view(message);
}

function view(message) {
  state.gone = message.kind === "gone";
  state.full = false;
  [state.stale, state.refused] = [message.stale, message.refused];
  state.age = message.age === null ? Infinity : message.age;
  state.since = performance.now();
  state.view = message.view;
  if (state.view) course.add(state.view);
  show();
}

function scene(message) {
  for (const key of ["path", "surface", "scan"]) message[key] = Float32Array.from(message[key]);
  state.scene = message;
  for (const camera of message.cameras) panes.of(camera.name).see(camera);
  space.see(message);
  refresh();
}

async function pictures(data) {
  const came = await unpacked(data);
  if (came.head.kind === "sheet") return outlining.take(came);
  const head = panes.put(came);
  by("closer").hidden = !head.pictures.some((each) => each.crop);
  state.poses = head.base_from_surface;
  refresh();
}

// what a move by hand is meant in: the large picture
function sees() {
  placing.sees(panes.get(state.chosen ?? [...panes.keys()][0]), state.scene, state.poses);
}

function choose(name) {
  const large = document.body.dataset.large === "yes";
  state.large = !(large && state.chosen === name);
  if (large && state.chosen !== name) state.large = true;
  state.chosen = name;
  show();
}

function show() {
  const seen = state.view, age = state.age + (performance.now() - state.since) / 1000;
  const news = state.full ? "full" : state.gone ? "gone" : !line.connected ? "lost" : !seen ? "wait" : age > state.stale ? "old" : "live";
  document.body.dataset.news = news;
  by("news").textContent = (state.refused ? `${state.refused} refused · ` : "") + { live: "live", wait: "waiting", old: "old", gone: "ended", lost: "not connected", full: "too many windows" }[news];
  alarm(news, age);
  if (seen) stage(seen);
  sees();
  outlining.show(seen, news === "live");
  placing.aside = outlining.on;
  placing.show(seen, news === "live");
  panes.hand = outlining.on ? outlining : placing;
  for (const each of panes.values()) each.hand = panes.hand;
  buttons.held = placing.busy || outlining.on;
  buttons.show(seen, news === "live");
  drawing.show(seen, news === "live");
  if (seen) {
    checks(seen.checks);
    states(seen);
    tiles(seen);
    progress(seen);
    events(seen.events);
    for (const camera of seen.cameras) panes.of(camera.name).fares(camera);
  }
  refresh();
}

function alarm(news, age) {
  const words = {
    old: `No news from the run for ${Number.isFinite(age) ? duration(age) : "a while"}. What is shown is old.`,
    gone: "The run has ended. Nothing is connected to this page.",
    lost: "No connection to the run. What is shown is old. To stop, use the emergency stop.",
    full: "Too many windows show this page. Close one of them.",
  }[news];
  by("alarm").hidden = !words;
  if (words) by("alarm").textContent = words;
}

function stage(seen) {
  if (document.body.dataset.stage !== seen.stage) state.large = null;
  document.body.dataset.stage = seen.stage;
  document.body.dataset.turn = seen.turn;
  const about = STAGES[seen.stage], holds = held(seen);
  by("chip").textContent = holds ? "Holding" : about.word;
  document.body.dataset.tone = holds ? "hold" : about.tone;
  const same = seen.question.toLowerCase() === about.word.toLowerCase(); // it stands beside it already
  by("question").textContent = outlining.on ? "Where is the wound's edge?" : (!same && seen.question) || (holds ? "Holding until it is safe to print." : about.say);
  by("reason").textContent = upper((holds && seen.motion.reason) || (seen.placement && seen.placement.verdict === seen.reason ? "" : seen.reason));
  by("notes").replaceChildren(...seen.notes.map((note) => {
    const made = text("span", note.split(/[:;]/)[0]); // the rest is told to whoever points at it
    made.title = note;
    return made;
  }));
  document.body.dataset.large = (state.large ?? LARGE.includes(seen.stage)) ? "yes" : "no";
  const names = [...panes.keys()];
  for (const [name, each] of panes) each.root.classList.toggle("chosen", name === (state.chosen ?? names[0]));
}

// whether it would print if it could; the reason then stands at the top
function held(seen) {
  return seen.stage === "print" && seen.motion !== null && seen.motion.activity === "holding";
}

function text(kind, words, style) {
  const made = document.createElement(kind);
  made.textContent = words;
  if (style) made.className = style;
  return made;
}

// all rows while it checks; later, while nothing is printed, those that are not good
function checks(all) {
  const rows = state.view.stage === "check" ? all : all.filter((row) => row.verdict === "warn" || row.verdict === "fail");
  document.body.dataset.checks = rows.length && CHECKED.includes(state.view.stage) ? "yes" : "no";
  const body = document.querySelector("#checks tbody");
  const wanted = JSON.stringify(rows);
  if (body.dataset.rows === wanted) return;
  body.dataset.rows = wanted;
  body.replaceChildren(...rows.map((row) => {
    const line = document.createElement("tr"), found = text("td", row.found);
    line.className = row.verdict;
    if (row.remedy) found.append(text("div", row.remedy, "remedy"));
    line.append(text("td", VERDICTS[row.verdict]), text("td", upper(row.name)), found);
    return line;
  }));
}

function states(seen) {
  const put = (name, about, words) => {
    const row = document.querySelector(`[data-state=${name}]`);
    row.dataset.tone = about.tone;
    row.querySelector("b").textContent = about.word;
    row.querySelector("span").textContent = words;
  };
  const none = { word: "–", tone: "" }, { tracking, motion } = seen;
  put("tracking", tracking ? TRACKING[tracking.state] : none, tracking ? tracking.reason || `${tracking.tracks} tracks` : "");
  put("motion", motion ? ACTIVITIES[motion.activity] : none, motion ? doing(seen) : "");
}

// what the nozzle does, in words: why it stands, or how fast it goes
function doing(seen) {
  const motion = seen.motion;
  if (motion.activity === "resting") return motion.arm ? `arm ${motion.arm}` : motion.reason;
  const speed = motion.speed ? `${motion.speed.toFixed(1)} mm/s` : "", arm = motion.arm.split(":")[0];
  return [held(seen) ? "" : motion.reason, speed, arm && `arm ${arm}`, motion.material].filter(Boolean).join(" · ");
}

function events(all) {
  const list = by("events"), wanted = all.slice(-EVENTS);
  list.hidden = !wanted.length;
  if (list.textContent !== wanted.join("")) list.replaceChildren(...wanted.map((words) => text("li", words)));
}

function tiles(seen) {
  const { tracking, motion, latency } = seen;
  const put = (name, value, unit, words, over) => {
    const box = document.querySelector(`[data-tile=${name}]`);
    box.firstElementChild.replaceChildren(value, text("small", value === "–" ? "" : unit));
    box.lastElementChild.textContent = words;
    box.classList.toggle("over", Boolean(over));
  };
  const beyond = (value, limit) => value !== null && limit !== null && value > limit;
  put("error", figure(motion && motion.error, 2), motion && motion.limit !== null ? `mm, limit ${motion.limit}` : "mm", "predicted error", motion && beyond(motion.error, motion.limit));
  put("truth", figure(motion && motion.true_error, 2), "mm", "true error", motion && beyond(motion.true_error, motion.limit));
  document.querySelector("[data-tile=truth]").hidden = !motion || motion.true_error === null;
  put("sigma", figure(tracking && tracking.sigma, 3), "mm", "uncertainty");
  put("age", milliseconds(tracking && tracking.age), "ms", "age of pose");
  put("latency", latency ? `${milliseconds(latency.median)} / ${milliseconds(latency.high)}` : "–", "ms", "image to arm", latency && beyond(latency.high, latency.limit));
  put("flight", milliseconds(motion && motion.in_flight), "ms", "under way", motion && beyond(motion.in_flight, motion.most_in_flight));
}

function progress(seen) {
  const far = seen.progress;
  by("progress").hidden = !far;
  if (!far) return;
  document.querySelector("#progress i").style.width = `${(100 * far.share).toFixed(2)}%`;
  const words = [`${(100 * far.share).toFixed(1)} %`, `checkpoint ${Math.floor(far.fraction) + 1} of ${far.total}`];
  if (far.layers) words.push(`layer ${far.layer} of ${far.layers}`);
  if (far.duty !== null) words.push(`printing ${(100 * far.duty).toFixed(0)} % of the time`);
  by("place").textContent = words.join(" · ");
  by("left").textContent = far.left === null ? "" : far.share >= 1 ? "done" : `${duration(far.left)} left`;
}

let due = false;
function refresh() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    const seen = state.view, fraction = seen && seen.progress ? seen.progress.fraction : -1;
    sees();
    const nozzle = seen && seen.motion && seen.motion.base_from_nozzle;
    for (const each of panes.values()) each.draw(state.scene, state.poses, fraction, nozzle, state.near);
    space.draw(seen, fraction);
    course.draw();
  });
}

// a screen that goes dark in the middle of a print helps nobody; browsers ask for a touch first
async function stayAwake() {
  if (document.visibilityState === "visible" && navigator.wakeLock) await navigator.wakeLock.request("screen").catch(() => {});
}
document.addEventListener("visibilitychange", stayAwake);
document.addEventListener("pointerdown", stayAwake, { once: true });

for (const button of by("closer").querySelectorAll("button")) button.addEventListener("click", () => {
  state.near = button.dataset.near === "yes";
  for (const each of by("closer").querySelectorAll("button")) each.setAttribute("aria-pressed", String(each === button));
  refresh();
});
space.changed = refresh;
window.addEventListener("resize", refresh);
const line = new Line(hear);
const buttons = new Buttons((wish, turn, more) => line.ask(wish, turn, more));
const drawing = new Drawing(by("draw"), panes, line, (words, bad) => buttons.say(words, bad));
setInterval(() => {
  for (const each of panes.values()) each.tick();
  show();
  buttons.tick();
}, 200);
