// Words of the page, and formats of figures.

export const STAGES = {
  check: { word: "Checking", tone: "wait", say: "All checks run before the arm may move." },
  find: { word: "Searching", tone: "wait", say: "Searching for the wound." },
  confirm: { word: "Confirm", tone: "wait", say: "Is the path at the right place in every picture?" },
  ready: { word: "Ready", tone: "wait", say: "Ready to print. The arm waits." },
  approach: { word: "Approach", tone: "good", say: "The nozzle moves to the wound." }, // unless the nozzle does something else: DOES
  print: { word: "Printing", tone: "good", say: "The path is being printed." },
  paused: { word: "Paused", tone: "hold", say: "Paused. The arm stands and can go on." },
  stopped: { word: "Stopped", tone: "bad", say: "Stopped. Nothing is sent to the arm." },
  homing: { word: "Going home", tone: "good", say: "The arm moves to its home." },
  done: { word: "Done", tone: "good", say: "The path is printed." },
  ended: { word: "Finished", tone: "wait", say: "The run has ended. The arm is at rest." },
  failed: { word: "Failed", tone: "bad", say: "The run cannot go on. The arm is at rest." },
};
export const OVER = ["done", "ended", "failed"]; // stages after which nothing happens
export const DOES = ["approach", "print", "homing"]; // stages in which the nozzle's own activity is the news
export const TRACKING = {
  INITIALISING: { word: "Starting", tone: "hold" },
  TRACKING: { word: "Good", tone: "good" },
  DEGRADED: { word: "Weak", tone: "hold" },
  COASTING: { word: "Predicted only", tone: "hold" },
  LOST: { word: "Lost", tone: "bad" },
};
export const ACTIVITIES = {
  resting: { word: "At rest", tone: "" },
  entering: { word: "Entering", tone: "good" },
  printing: { word: "Printing", tone: "good" },
  travelling: { word: "Travelling", tone: "good" },
  holding: { word: "Holding", tone: "hold" },
  leaving: { word: "Leaving", tone: "good" },
  homing: { word: "Going home", tone: "good" },
};
export const WISHES = {
  confirm: "Yes, the path is right", move: "Move", outline: "Use this outline", again: "Look again", start: "Start", pause: "Pause", lift: "Lift", look: "Look at the print",
  resume: "Resume", stop: "Stop", home: "Home", end: "Finish",
};
export const KEYS = { p: "pause", r: "resume", l: "lift", o: "look", h: "home", y: "confirm", s: "start", a: "again", q: "end" }; // the terminal's
export const AGAIN = { check: "Check again", confirm: "No, look again" };
export const VERDICTS = { pass: "✓ good", warn: "! check", fail: "✗ fail", busy: "… busy" };

export function figure(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}
export function milliseconds(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  return (1000 * seconds).toFixed(0);
}
export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds)), h = Math.floor(whole / 3600), m = Math.floor(whole / 60) % 60, s = whole % 60;
  if (h) return `${h} h ${m} min`;
  return m ? `${m} min${s ? ` ${s} s` : ""}` : `${s} s`;
}
/** An uncertain duration, s, rounded to few digits. */
export function about(seconds) {
  const step = seconds < 60 ? 5 : seconds < 600 ? 10 : 60;
  return duration(Math.max(step * Math.round(seconds / step), step));
}
export function upper(words) {
  return words ? words[0].toUpperCase() + words.slice(1) : "";
}
/** A new element with words in it. style: its CSS class. */
export function element(kind, words = "", style = "") {
  const made = document.createElement(kind);
  made.textContent = words;
  if (style) made.className = style;
  return made;
}

/** Takes over what a message says of the run: its newest view, how old that is, and from which age on it is too old. */
export function heard(state, message) {
  [state.gone, state.full, state.stale, state.view] = [message.kind === "gone", false, message.stale, message.view];
  [state.age, state.since] = [message.age === null ? Infinity : message.age, performance.now()];
}
/** How old the newest view is, s, and in one word whether it counts. quiet: nothing newer is expected. */
export function newsOf(state, connected, quiet = false) {
  const age = state.age + (performance.now() - state.since) / 1000;
  return [state.full ? "full" : state.gone ? "gone" : !connected ? "lost" : !state.view ? "wait" : age > state.stale && !quiet ? "old" : "live", age];
}
export const NEWS = { live: "live", wait: "waiting", old: "old", gone: "ended", lost: "not connected", full: "too many windows" };
/** Shows that, on the page beside a recording or calibration (what), with an alarm where it is bad. done: it is over. */
export function showNews(news, age, what, done) {
  document.body.dataset.news = done && news !== "full" ? "live" : news;
  document.getElementById("news").textContent = done ? "over" : NEWS[news];
  const words = {
    old: `Nothing new for ${Number.isFinite(age) ? duration(age) : "a while"}.`, lost: `No connection to the ${what}.`,
    gone: `The ${what} has ended.`, full: "Too many windows show this page. Close one of them.",
  }[news], box = document.getElementById("alarm");
  [box.hidden, box.textContent] = [!words || done, words || ""];
}

/** Shows words for six seconds; refused: in the colour of a refused request. */
export function toast(words, refused) {
  const box = document.getElementById("toast");
  [box.textContent, box.hidden] = [words, false];
  box.classList.toggle("refused", Boolean(refused));
  clearTimeout(toast.timer);
  toast.timer = setTimeout(() => (box.hidden = true), 6000);
}
