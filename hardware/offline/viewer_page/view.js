// The viewer: one number, the frame set that is shown; everything else is asked of the server for it, the newest only.
import { inverse, moved, product } from "./lens.js";
import { Panes } from "./panes.js";
import { SceneView } from "./scene.js";
import { onTheme, themeButton } from "./theme.js";
import { Timeline, trace } from "./timeline.js";
import { figure, TRACKING } from "./words.js";

const WAY = 4000; // points of the trajectory that are drawn
const AXES = ["#c8553d", "#4c9a6a", "#2a6f97"]; // of the surface frame: x, y, z
const GIVEN = { truth: "Truth", reference: "Reference" }; // poses that nobody estimated have no state
const by = (id) => document.getElementById(id);
const text = (tag, words) => Object.assign(document.createElement(tag), { textContent: words });
const state = { session: null, k: 0, wanted: -1, busy: false, seen: null, poses: null, first: null, playing: false, begun: 0, from: 0, chosen: null, near: true };
const panes = new Panes(by("pictures"), choose);

class Film extends SceneView {
  draw(view, fraction) {
    super.draw(view, fraction);
    if (!this.scene || !state.session) return;
    const g = this.canvas.getContext("2d"), place = this.project(this.canvas.width, this.canvas.height), all = state.session.places;
    const every = Math.max(1, Math.ceil(all.length / WAY)), ratio = window.devicePixelRatio || 1;
    for (const [end, colour] of [[all.length, "rgb(138 79 160 / .3)"], [state.k + 1, "#8a4fa0"]]) {
      g.strokeStyle = colour;
      g.lineWidth = 1.6 * ratio;
      trace(g, end, every, (i) => all[i] && place(all[i]));
    }
    if (view && view.tracking) this.axes(g, place, view.tracking.base_from_surface, ratio);
  }
  axes(g, place, pose, ratio) {
    const tip = place(moved(pose, 0, 0, 0)), long = 0.4 * this.reach.near;
    AXES.forEach((colour, k) => {
      const [x, y] = place(moved(pose, ...[0, 1, 2].map((r) => (r === k ? long : 0))));
      [g.strokeStyle, g.lineWidth] = [colour, 2.2 * ratio];
      g.beginPath();
      g.moveTo(tip[0], tip[1]);
      g.lineTo(x, y);
      g.stroke();
    });
  }
}

const space = new Film(by("scene")), timeline = new Timeline(document.querySelector("#course canvas"));

async function begin() {
  const answer = await fetch("session");
  if (!answer.ok) return alarm(await answer.text());
  const session = (state.session = await answer.json());
  for (const key of ["path", "surface"]) session.scene[key] = Float32Array.from(session.scene[key]);
  for (const camera of session.scene.cameras) panes.of(camera.name).see(camera);
  space.see(session.scene);
  timeline.see(session);
  const last = session.stamps.length - 1;
  by("time").max = last;
  document.title = `${session.title} · stillbed view`;
  by("question").textContent = session.title;
  by("reason").textContent = [`${last + 1} frame sets over ${session.stamps[last].toFixed(1)} s`, session.damage && `damaged: ${session.damage}`].filter(Boolean).join(" · ");
  by("source").textContent = session.source ? `poses: ${session.source}` : "no poses were recorded";
  for (const each of document.querySelectorAll("[data-key=path]")) each.hidden = !session.scene.checkpoint.length;
  document.querySelector("[data-tile=off]").hidden = !session.truth || Boolean(GIVEN[session.source]);
  document.querySelector("[data-tile=off] span").textContent = `off the ${session.truth}`;
  document.querySelector("[data-tile=place_on_path]").hidden = !session.scene.checkpoint.length;
  by("told").hidden = !session.events.length && !session.held.some((each) => each);
  go(Math.max(0, session.states.findIndex((s) => s)));
}

function go(k) {
  const last = state.session.stamps.length - 1;
  state.k = Math.min(Math.max(Math.round(k), 0), last);
  by("time").value = state.k;
  by("now").replaceChildren(`${state.session.stamps[state.k].toFixed(2)} s`, text("small", `${state.k + 1} of ${last + 1}`));
  state.wanted = state.k;
  fetchNewest();
  refresh();
}

// one question at a time: what was passed over while it was under way is never asked
async function fetchNewest() {
  if (state.busy) return;
  state.busy = true;
  while (state.wanted >= 0) {
    const k = state.wanted;
    state.wanted = -1;
    try {
      const [said, pictures] = await Promise.all([fetch(`at/${k}`), fetch(`pictures/${k}`)]);
      if (!said.ok) throw new Error(await said.text());
      state.seen = await said.json();
      show();
      if (!pictures.ok) throw new Error(await pictures.text());
      const head = await panes.show(await pictures.arrayBuffer());
      state.poses = head.base_from_surface;
      by("closer").hidden = !head.pictures.some((each) => each.near);
      refresh();
      alarm("");
    } catch (error) {
      alarm(error instanceof TypeError ? "No connection: stillbed view has ended." : error.message);
    }
    document.body.dataset.shown = k;
  }
  state.busy = false;
}

function choose(name) {
  state.chosen = state.chosen === name ? null : name;
  document.body.dataset.large = state.chosen ? "yes" : "no";
  for (const [each, made] of panes) made.choose(each === state.chosen);
  refresh();
}

function alarm(words) {
  by("alarm").hidden = !words;
  by("alarm").textContent = words;
}

function show() {
  const { tracking, off, fraction } = state.seen, given = GIVEN[state.session.source];
  const about = !tracking ? { word: "No pose", tone: "" } : given ? { word: given, tone: "wait" } : TRACKING[tracking.state];
  by("chip").textContent = about.word;
  document.body.dataset.tone = about.tone;
  const put = (name, value, unit) => document.querySelector(`[data-tile=${name}] b`).replaceChildren(value, text("small", value === "–" ? "" : unit));
  if (tracking && !state.first) state.first = tracking.base_from_surface;
  const change = tracking && product(inverse(state.first), tracking.base_from_surface);
  const sine = change && Math.hypot(change[2][1] - change[1][2], change[0][2] - change[2][0], change[1][0] - change[0][1]) / 2;
  put("place", figure(change && Math.hypot(...[0, 1, 2].map((r) => tracking.base_from_surface[r][3] - state.first[r][3])), 2), "mm");
  put("turn", figure(change && (Math.atan2(sine, (change[0][0] + change[1][1] + change[2][2] - 1) / 2) * 180) / Math.PI, 2), "°");
  put("sigma", figure(tracking && tracking.sigma, 3), "mm");
  document.querySelector("[data-key=sure]").hidden = !tracking || tracking.sigma === null;
  put("tracks", tracking ? String(tracking.tracks) : "–", "");
  put("off", figure(off, 3), "mm");
  put("place_on_path", fraction === null ? "–" : String(Math.floor(fraction) + 1), "");
  tell();
  refresh();
}

// the hold, the stage, and the last lines of the run's log until the instant that is shown
function tell() {
  const { stamps, held, events, stages } = state.session, now = stamps[state.k];
  const before = (all) => all.filter(([t]) => t <= now), stage = before(stages).pop();
  const lines = [held[state.k] && `held: ${held[state.k]}`, stage && `stage: ${stage[1]}`].filter(Boolean).map((words) => text("b", `${words}  `));
  const said = before(events).slice(-2).reverse().map(([t, words]) => text("div", `${t.toFixed(2)} s  ${words}`));
  by("told").replaceChildren(...lines, ...said);
}

let due = false;
function refresh() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    const seen = state.seen, fraction = seen && seen.fraction !== null ? seen.fraction : -1;
    const nozzle = seen && seen.motion && seen.motion.base_from_nozzle;
    if (state.session) for (const each of panes.values()) each.draw(state.session.scene, state.poses, fraction, nozzle, state.near);
    space.draw(seen, fraction);
    timeline.draw(state.k);
  });
}

function play(on) {
  state.playing = on;
  [state.begun, state.from] = [performance.now(), state.session ? state.session.stamps[state.k] : 0];
  by("play").querySelector("b").textContent = on ? "Pause" : "Play";
  document.body.dataset.playing = on ? "yes" : "no";
  if (on) requestAnimationFrame(tick);
}

function tick() {
  if (!state.playing) return;
  const { stamps } = state.session, now = state.from + (Number(by("speed").value) * (performance.now() - state.begun)) / 1000;
  let k = state.k;
  while (k + 1 < stamps.length && stamps[k + 1] <= now) k++;
  if (k !== state.k) go(k);
  if (k === stamps.length - 1) play(false);
  requestAnimationFrame(tick);
}

function toggle() {
  if (!state.session) return;
  if (!state.playing && state.k === state.session.stamps.length - 1) go(0);
  play(!state.playing);
}

function step(by) {
  if (!state.session) return;
  play(false);
  go(state.k + by);
}

by("play").addEventListener("click", toggle);
by("back").addEventListener("click", () => step(-1));
by("on").addEventListener("click", () => step(1));
by("speed").addEventListener("change", () => play(state.playing));
by("time").addEventListener("input", () => {
  play(false);
  go(Number(by("time").value));
});
document.addEventListener("keydown", (e) => {
  if (e.target.tagName === "SELECT" || (e.target.tagName === "CANVAS" && e.key !== " ")) return; // the scene has keys of its own
  const act = { " ": toggle, ArrowLeft: () => step(e.shiftKey ? -10 : -1), ArrowRight: () => step(e.shiftKey ? 10 : 1), Home: () => step(-Infinity), End: () => step(Infinity) }[e.key];
  if (!act) return;
  e.preventDefault();
  act();
});
by("closer").addEventListener("click", (e) => {
  const button = e.target.closest("[data-near]");
  if (!button) return;
  state.near = button.dataset.near === "yes";
  for (const each of by("closer").children) each.setAttribute("aria-pressed", String(each === button));
  refresh();
});
for (const button of document.querySelectorAll("[data-zoom]")) {
  button.addEventListener("click", () => {
    if (state.session) timeline.zoom(Number(button.dataset.zoom), state.session.stamps[state.k]);
    refresh();
  });
}
timeline.changed = refresh;
timeline.chosen = (k) => {
  play(false);
  go(k);
};
space.changed = refresh;
themeButton(by("theme"));
onTheme(refresh);
window.addEventListener("resize", refresh);
begin().catch((error) => alarm(error.message));
