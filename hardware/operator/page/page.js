// The operator's page: hears the run, shows it, and asks. The newest wins; only the error over the run and its log are kept.
import { Alerts } from "./alerts.js";
import { Buttons } from "./buttons.js";
import { ErrorChart } from "./chart.js";
import { Drawing } from "./draw.js";
import { RunLog } from "./log.js";
import { Outlining } from "./outline.js";
import { Panes, unpacked } from "./panes.js";
import { Placing } from "./placing.js";
import { ResultView } from "./result.js";
import { SceneView } from "./scene.js";
import { Line } from "./socket.js";
import { onTheme, themeButton } from "./theme.js";
import { about, ACTIVITIES, DOES, duration, element, figure, heard, milliseconds, NEWS, newsOf, OVER, STAGES, TRACKING, upper, VERDICTS } from "./words.js";

const LARGE = ["find", "confirm"]; // stages in which the pictures are what matters
const AGED = 2; // s, after which an error is one of earlier
const CHECKED = ["check", "find", "confirm", "ready", "failed"];
const by = (id) => document.getElementById(id);
const state = { view: null, scene: null, poses: null, age: Infinity, since: 0, stale: 1, refused: 0, gone: false, full: false, chosen: null, large: null, near: true };
const placing = new Placing(by("placing"), (move, turn) => buttons.send("move", turn, { move }), (words, bad) => buttons.say(words, bad), refresh);
const panes = new Panes(by("pictures"), choose, placing);
const outlining = new Outlining(by("outlining"), by("outline"), panes, (outline, turn) => buttons.send("outline", turn, { outline }), (words, bad) => buttons.say(words, bad), show);
const course = new ErrorChart(document.querySelector("#course .chart"), document.querySelectorAll("#course [data-span]"));
const log = new RunLog(by("log"), by("opener"), by("last"));
const alerts = new Alerts(by("sound"));
const result = new ResultView(by("result"));
const space = new SceneView(by("scene"));

async function hear(message) {
  if (message instanceof ArrayBuffer) return pictures(message);
  if (message.kind === "scene") scene(message);
  else if (message.kind === "course") begun(message);
  else if (message.kind === "asked" && message.wish === "region") drawing.asked(message);
  else if (message.kind === "asked") {
    buttons.asked(message);
    placing.asked(message);
  }
  else if (message.kind === "full") state.full = true;
  else if (message.kind === "view" || message.kind === "gone") view(message);
}

function begun(message) {
  course.begin(message);
  log.add(message.log);
}

function view(message) {
  heard(state, message);
  state.refused = message.refused;
  if (state.view) {
    course.add(state.view);
    log.add(state.view.log);
  }
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
  const seen = state.view, [news, age] = newsOf(state, line.connected);
  const over = Boolean(seen && OVER.includes(seen.stage) && seen.result);
  document.body.dataset.news = news;
  document.body.dataset.over = over ? "yes" : "no";
  by("news").textContent = over ? "the run is over" : (state.refused ? `${state.refused} refused · ` : "") + NEWS[news];
  alarm(over && news !== "full" ? "live" : news, age);
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
    result.show(seen, state.scene);
    alerts.see(kind(seen, news), by("said").textContent);
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
  const at = STAGES[seen.stage], does = doing(seen), holds = does && seen.motion.activity === "holding", now = does || at;
  const same = seen.question.toLowerCase() === at.word.toLowerCase(); // it stands beside it already
  const question = outlining.on ? "Where is the wound's edge?" : (holds && "Holding until it is safe to go on.") || (seen.result && seen.result.printed >= 1 && at.say === STAGES.ended.say && "The path is printed; the run was finished before the arm was home.") || (!same && seen.question) || at.say;
  put("chip", now.word);
  document.body.dataset.tone = now.tone;
  put("question", question);
  put("reason", [why(seen, does), resting(seen)].filter(Boolean).join(" "));
  const share = seen.progress ? `${(100 * seen.progress.share).toFixed(0)} % ` : "";
  document.title = `${share}${now.word} · stillbed`;
  announce(now.word, question, holds ? seen.motion.reason : seen.reason);
  const notes = JSON.stringify(seen.notes);
  if (by("notes").dataset.notes !== notes) by("notes").replaceChildren(...seen.notes.map((note) => {
    const made = element("span", note.split(/[:;]/)[0]); // the rest is told to whoever points at it
    made.title = note;
    return made;
  }));
  by("notes").dataset.notes = notes;
  document.body.dataset.large = (state.large ?? LARGE.includes(seen.stage)) ? "yes" : "no";
  const names = [...panes.keys()];
  for (const [name, each] of panes) each.choose(name === (state.chosen ?? names[0]));
}

function put(name, words) {
  if (by(name).textContent !== words) by(name).textContent = words;
}

// what the nozzle does, where that is the news of the stage
function doing(seen) {
  const motion = seen.motion;
  if (!motion || !DOES.includes(seen.stage) || motion.activity === "resting") return null;
  return seen.stage === "approach" && motion.activity === "entering" ? STAGES.approach : ACTIVITIES[motion.activity];
}

function why(seen, does) {
  const words = (does && seen.motion.reason) || (seen.placement && seen.placement.verdict === seen.reason ? "" : seen.reason);
  return words ? `${upper(words)}.`.replace(/([.!?])\.$/, "$1") : "";
}

// what a nozzle that stands does to the tissue, and the tissue to it
function resting(seen) {
  const rest = seen.motion && seen.motion.rest;
  if (!rest) return "";
  const high = rest.height === null ? "" : Math.abs(rest.height) < 1 ? " at the surface" : ` ${rest.height.toFixed(0)} mm above its place`;
  return `The nozzle stands${high}; the surface moves ${rest.slip.toFixed(1)} mm against it.`;
}

// told to whoever does not see the page, when it changes: figures in a reason do so all the time
function announce(...words) {
  const wanted = words.map((each) => each.replace(/-?\d+(\.\d+)?/g, "…")).join("|");
  if (by("said").dataset.wanted === wanted) return;
  by("said").dataset.wanted = wanted;
  by("said").textContent = words.filter(Boolean).join(". ");
}

// what is told by sound
function kind(seen, news) {
  if (OVER.includes(seen.stage)) return "end";
  if (seen.stage === "stopped" || news === "lost" || news === "old") return "stop";
  return held(seen) ? "hold" : "";
}

// whether it would move if it could; the reason then stands at the top
function held(seen) {
  const does = doing(seen);
  return does !== null && seen.motion.activity === "holding";
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
    const line = element("tr", "", row.verdict), found = element("td", row.found);
    if (row.remedy) found.append(element("div", row.remedy, "remedy"));
    line.append(element("td", VERDICTS[row.verdict]), element("td", upper(row.name)), found);
    return line;
  }));
}

function states(seen) {
  const put = (name, about, words, cause) => {
    const row = document.querySelector(`[data-state=${name}]`);
    row.dataset.tone = about.tone;
    row.classList.toggle("cause", Boolean(cause));
    row.querySelector("b").textContent = about.word;
    row.querySelector("span").textContent = words;
  };
  const none = { word: "–", tone: "" }, { tracking, motion } = seen, caused = motion && motion.cause && motion.cause.tile === "tracking";
  put("tracking", tracking ? TRACKING[tracking.state] : none, tracking ? tracking.reason || `${tracking.tracks} tracks` : "", caused);
  put("motion", motion ? ACTIVITIES[motion.activity] : none, motion ? action(seen) : "");
}

// what the nozzle does, in words: why it stands, or how fast it goes
function action(seen) {
  const motion = seen.motion;
  if (motion.activity === "resting") return motion.arm ? `arm ${motion.arm}` : motion.reason;
  const speed = motion.speed ? `${motion.speed.toFixed(1)} mm/s` : "", arm = motion.arm.split(":")[0];
  return [held(seen) ? "" : motion.reason, speed, arm && `arm ${arm}`, motion.material].filter(Boolean).join(" · ");
}

function tiles(seen) {
  const { tracking, motion, latency } = seen, cause = motion && motion.cause, rest = motion && motion.rest;
  const put = (name, value, unit, words, over, aged) => {
    const box = document.querySelector(`[data-tile=${name}]`), caused = cause && cause.tile === name;
    if (caused && cause.got !== null) [value, unit, words] = [figure(cause.got, cause.unit === "ms" ? 0 : 2), cause.unit, `${cause.words}, limit ${+cause.limit.toPrecision(3)}`];
    box.firstElementChild.replaceChildren(value, element("small", value === "–" ? "" : unit));
    box.lastElementChild.textContent = words;
    box.classList.toggle("over", Boolean(over) && !aged);
    box.classList.toggle("cause", Boolean(caused));
    box.classList.toggle("aged", Boolean(aged) && !caused);
  };
  const beyond = (value, limit) => value !== null && limit !== null && value > limit;
  const old = motion && motion.error !== null && (motion.error_age === null || motion.error_age > AGED), ago = old && motion.error_age !== null ? `, ${duration(motion.error_age)} ago` : "";
  const known = motion && motion.sigma !== null ? `, σ ${figure(motion.sigma, 2)}/${motion.limit}` : "";
  put("error", figure(motion && motion.error, 2), "mm, 95 %", old ? `predicted${ago}` : `predicted${known}`, motion && beyond(motion.sigma, motion.limit), old);
  put("truth", figure(motion && motion.true_error, 2), "mm", old ? `true${ago}` : "true error", motion && beyond(motion.true_error, motion.error), old);
  document.querySelector("[data-tile=truth]").hidden = !motion || motion.true_error === null;
  put("sigma", figure(tracking && tracking.sigma, 3), "mm", "uncertainty");
  put("age", milliseconds(tracking && tracking.age), "ms", "age of pose");
  put("latency", latency ? `${milliseconds(latency.median)} / ${milliseconds(latency.high)}` : "–", "ms", "image to arm", latency && beyond(latency.high, latency.limit));
  put("flight", milliseconds(motion && motion.in_flight), "ms", "under way", motion && beyond(motion.in_flight, motion.most_in_flight));
  put("rest", figure(rest && rest.slip, 1), "mm", rest ? `surface moved, ${rest.seconds.toFixed(0)} s` : "", true);
  document.querySelector("[data-tile=rest]").hidden = !rest;
  put("cause", "–", "", cause ? cause.words : "", false);
  document.querySelector("[data-tile=cause]").hidden = !cause || cause.tile !== "cause";
}

function progress(seen) {
  const far = seen.progress;
  by("progress").hidden = !far || Boolean(seen.result);
  if (!far) return;
  const share = Math.min(100 * far.share, 100), bar = document.querySelector("#progress .track");
  bar.firstElementChild.style.width = `${share.toFixed(2)}%`;
  bar.setAttribute("aria-valuenow", share.toFixed(0));
  const words = [`${share.toFixed(1)} %`, `checkpoint ${Math.min(Math.floor(far.fraction) + 1, far.total)} of ${far.total}`];
  if (far.begun && CHECKED.includes(seen.stage)) words[0] = `goes on at ${words[0]}`;
  if (far.layers) words.push(`layer ${far.layer} of ${far.layers}`);
  if (far.duty !== null) words.push(`duty cycle ${(100 * far.duty).toFixed(0)} %`);
  if (far.ink !== null) words.push(`ink ${far.ink.toFixed(far.ink < 10 ? 2 : 0)} mm³`);
  by("place").textContent = words.join(" · ");
  const [low, high] = far.spread || [null, null], until = high === null ? "or more" : `to ${about(high)}`;
  const spread = far.spread ? ` (${about(low)} ${until})` : "";
  by("left").textContent = far.left === null ? "" : far.share >= 1 ? "done" : far.spread ? `about ${about(far.left)} left${spread}` : `${duration(far.left)} of path left`;
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

themeButton(by("theme"));
onTheme(refresh);
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
