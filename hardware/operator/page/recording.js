// The page beside a recording: live pictures, their rates, how sharp they are, how much is written, and a region to draw.
import { Drawing } from "./draw.js";
import { Panes } from "./panes.js";
import { Line } from "./socket.js";
import { themeButton } from "./theme.js";
import { duration, heard, newsOf, showNews, toast, upper } from "./words.js";

const STAGES = {
  record: { word: "Recording", tone: "good", say: "The cameras are being recorded." },
  ended: { word: "Recorded", tone: "wait", say: "The recording is over." },
  failed: { word: "Failed", tone: "bad", say: "The recording ended before it should." },
};
const BLUNT = 0.6; // of the sharpest picture so far
const by = (id) => document.getElementById(id);
const state = { view: null, age: Infinity, since: 0, stale: 1, gone: false, full: false };
const panes = new Panes(by("cameras"), () => {});

async function hear(message) {
  if (message instanceof ArrayBuffer) await panes.show(message);
  else if (message.kind === "scene") for (const camera of message.cameras) panes.of(camera.name).see(camera);
  else if (message.kind === "full") state.full = true;
  else if (message.kind === "asked" && message.wish === "region") drawing.asked(message);
  else if (message.kind === "asked" && message.words) toast(`${upper(message.wish)} was not followed: ${message.words}.`, true);
  else if (message.kind === "view" || message.kind === "gone") heard(state, message);
  show();
}

function show() {
  const seen = state.view, [news, age] = newsOf(state, line.connected);
  showNews(news, age, "recording", seen && seen.stage !== "record");
  drawing.show(seen, news === "live");
  if (seen) tell(seen, news);
  for (const pane of panes.values()) pane.draw(null, null, -1, null, false);
}

function tell(seen, news) {
  const about = STAGES[seen.stage], blunt = seen.cameras.filter((each) => !each.words && each.sharpness !== null && each.sharpness < BLUNT);
  [document.body.dataset.stage, document.body.dataset.tone] = [seen.stage, about.tone];
  by("chip").textContent = about.word;
  by("question").textContent = seen.draws ? "Mark the corners of the region to track, in two or more pictures." : about.say;
  const hints = blunt.map((each) => `${each.name} was sharper before: look at its focus`);
  if (seen.dropped) hints.push(`${seen.dropped} entries found no room on their way to the disk`);
  by("reason").textContent = upper(seen.words || hints[0] || "");
  by("looked").textContent = `${duration(seen.seconds)} · ${seen.sets} frame sets · ${(seen.size / 1e6).toFixed(1)} MB`;
  for (const camera of seen.cameras) panes.of(camera.name).fares(camera);
  document.querySelector("[data-wish=end]").disabled = news !== "live" || !seen.offers.includes("end");
}

const line = new Line(hear);
const drawing = new Drawing(by("draw"), panes, line, toast);
document.querySelector("[data-wish=end]").addEventListener("click", () => {
  if (line.ask("end", state.view ? state.view.turn : 0) === null) toast("Nobody can be asked: no connection.", true);
});
window.addEventListener("resize", show);
setInterval(() => {
  for (const each of panes.values()) each.tick();
  show();
}, 250);
themeButton(by("theme"));
