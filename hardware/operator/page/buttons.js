// The buttons: what may be asked now, asked twice where it moves the arm from rest, and what became of it.
import { AGAIN, upper, WISHES } from "./words.js";

const GO = ["confirm", "start", "resume"]; // share the place in the middle
const BEFORE = ["check", "find", "confirm", "ready"]; // the arm has moved
const SURE = {
  start: "Let the arm move and print?", home: "Let the arm move to its home?", end: "Finish this run?",
  resume: "Let the arm move again and go on?", // only out of a stop
};
const UNTOUCHED = 700; // ms for which a button that has just come to mean something else is not pressed
const PATIENCE = 1500; // ms until a request without an answer is spoken of
const SHOWN = 6000; // ms

export class Buttons {
  // ask: given wish, turn and what a move or an outline carries, asks; returns a tag or null
  constructor(ask) {
    this.ask = ask;
    this.view = null;
    this.live = false;
    this.held = false; // what is shown is not yet what the run has: it is not to be confirmed
    this.waiting = new Map(); // tag -> { wish, number, since }
    this.pressed = new Map(); // button -> turn that was shown when it was touched
    this.bar = document.querySelector("footer");
    this.sure = document.getElementById("sure");
    this.toast = document.getElementById("toast");
    this.go = document.getElementById("go");
    this.meant = 0;
    this.answered = null;
    for (const button of this.bar.querySelectorAll("button")) this.listen(button);
    document.getElementById("sure-no").addEventListener("click", () => this.drop());
    document.getElementById("sure-yes").addEventListener("click", () => this.accept());
    for (const kind of ["keydown", "keyup"]) window.addEventListener(kind, (e) => this.key(e), true);
  }
  listen(button) {
    button.addEventListener("pointerdown", () => this.pressed.set(button, this.turn()));
    button.addEventListener("click", () => {
      const turn = this.pressed.get(button) ?? this.turn();
      this.pressed.delete(button);
      if (button === this.go && performance.now() - this.meant < UNTOUCHED) return;
      this.wish(button.dataset.wish, turn);
    });
  }
  key(event) {
    if (event.code === "Escape") this.drop();
    if (event.code !== "Space") return;
    event.preventDefault(); // else it would press whichever button is focused
    event.stopPropagation();
    if (event.type === "keydown" && !event.repeat) this.wish("stop", this.turn());
  }
  turn() {
    return this.view ? this.view.turn : 0;
  }
  wish(wish, turn) {
    if (!(wish in SURE) || (wish === "resume" && this.view.stage !== "stopped")) return this.send(wish, turn);
    this.asking = { wish, turn };
    document.getElementById("sure-words").textContent = SURE[wish];
    document.getElementById("sure-yes").textContent = `Yes, ${WISHES[wish].toLowerCase()}`;
    this.sure.hidden = false;
  }
  accept() {
    const { wish, turn } = this.asking;
    this.drop();
    this.send(wish, turn);
  }
  drop() {
    this.sure.hidden = true;
    this.asking = null;
  }
  send(wish, turn, more) {
    const tag = this.ask(wish, turn, more);
    if (tag === null) {
      this.say(`${upper(wish)} was not sent: no connection.`, true);
      return null;
    }
    this.waiting.set(tag, { wish, number: null, since: performance.now() });
    this.mark();
    return tag;
  }
  // the page's process has taken a request, or says why not
  asked(message) {
    const waiting = this.waiting.get(message.tag);
    if (!waiting) return;
    waiting.number = message.number;
    if (message.words) {
      this.waiting.delete(message.tag);
      this.say(`${upper(message.wish)} was not followed: ${message.words}.`, true);
    }
    this.settle();
  }
  show(view, live) {
    const before = this.turn();
    if (view && !this.view) this.answered = view.answer && view.answer.number; // said before this window was there
    [this.view, this.live] = [view, live];
    const offers = live && view ? view.offers : [];
    for (const button of this.bar.querySelectorAll("button")) {
      if (button === this.go) this.showGo(offers);
      else if (button.dataset.wish !== "stop") button.disabled = !offers.includes(button.dataset.wish);
    }
    const again = this.bar.querySelector("[data-wish=again]");
    again.textContent = (view && AGAIN[view.stage]) || WISHES.again;
    if (this.asking && before !== this.turn() && !(this.asking.wish === "end" && offers.includes("end"))) {
      this.say(`${upper(WISHES[this.asking.wish])} was not asked: the run has changed meanwhile.`, true);
      this.drop();
    }
    document.getElementById("sure-yes").disabled = !live;
    this.settle();
  }
  showGo(offers) {
    const wish = GO.find((each) => offers.includes(each));
    if (wish && wish !== this.go.dataset.wish) {
      this.go.dataset.wish = wish;
      this.meant = performance.now();
    }
    const soon = this.view && BEFORE.includes(this.view.stage) ? "start" : "resume";
    this.go.textContent = WISHES[wish || soon];
    this.go.disabled = !wish || (wish === "confirm" && this.held);
  }
  // compare what waits with the run's last answer
  settle() {
    const answer = this.view && this.view.answer;
    if (answer && answer.number !== this.answered) {
      this.answered = answer.number;
      const words = answer.words ? `: ${answer.words}.` : ".";
      if (answer.wish !== "move" || !answer.followed) this.say(`${upper(answer.wish)} ${answer.followed ? "was followed" : "was not followed"}${words}`, !answer.followed);
    }
    for (const [tag, each] of this.waiting) if (answer && each.number !== null && answer.number >= each.number) this.waiting.delete(tag);
    this.mark();
  }
  mark() {
    for (const button of this.bar.querySelectorAll("button"))
      button.classList.toggle("asked", [...this.waiting.values()].some((each) => each.wish === button.dataset.wish));
  }
  // called every now and then: what waits for too long is spoken of
  tick() {
    const now = performance.now();
    for (const [tag, each] of this.waiting) {
      if (now - each.since < PATIENCE) continue;
      this.waiting.delete(tag);
      this.say(each.wish === "stop" ? "STOP was not confirmed. Use the emergency stop." : `${upper(each.wish)} was not answered.`, true);
    }
    if (!this.toast.hidden && now > this.until) this.toast.hidden = true;
    this.mark();
  }
  say(words, refused) {
    this.toast.textContent = words;
    this.toast.classList.toggle("refused", Boolean(refused));
    this.toast.hidden = false;
    this.until = performance.now() + SHOWN;
  }
}
