// The buttons: what may be asked now, asked twice where it moves the arm from rest, and what became of it.
import { AGAIN, KEYS, OVER, WISHES } from "./words.js";

const GO = ["confirm", "start", "resume"]; // share the place in the middle
const BEFORE = ["check", "find", "confirm", "ready"]; // the arm has moved
const SURE = {
  start: "Let the arm move and print?", home: "Let the arm move to its home?", end: "Finish this run?",
  resume: "Let the arm move again and go on?", lift: "Let the arm lift the nozzle off the surface?", look: "Move the nozzle aside to inspect the print?",
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
  // the terminal's keys; whatever has the focus, the space bar stops
  key(event) {
    const down = event.type === "keydown" && !event.repeat;
    if (event.code === "Space") {
      event.preventDefault(); // else it would press whichever button is focused
      event.stopPropagation();
      if (down) this.wish("stop", this.turn());
      return;
    }
    if (!down || event.ctrlKey || event.altKey || event.metaKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    if (event.code === "Escape") return this.drop();
    const key = event.key.toLowerCase();
    if (this.asking && (key === "y" || key === "n")) return key === "y" ? this.accept() : this.drop();
    const wish = KEYS[key];
    if (wish) this.press(wish);
  }
  // as if the button had been pressed, where there is one to press
  press(wish) {
    const button = this.bar.querySelector(`[data-wish="${wish}"]`);
    if (!button || button.disabled) return this.say(`“${WISHES[wish]}” cannot be done now.`, true);
    button.focus();
    button.click();
  }
  turn() {
    return this.view ? this.view.turn : 0;
  }
  wish(wish, turn) {
    if (!(wish in SURE)) return this.send(wish, turn);
    this.asking = { wish, turn };
    document.getElementById("sure-words").textContent = SURE[wish];
    document.getElementById("sure-yes").textContent = `Yes, ${WISHES[wish].toLowerCase()}`;
    this.sure.hidden = false;
    document.getElementById("sure-no").focus();
  }
  accept() {
    if (document.getElementById("sure-yes").disabled) return this.say("No connection to the run at the moment: answer again.", true);
    const { wish, turn } = this.asking;
    this.drop();
    this.send(wish, turn);
  }
  drop() {
    if (!this.asking) return;
    const focused = this.sure.contains(document.activeElement), { wish } = this.asking;
    this.sure.hidden = true;
    this.asking = null;
    if (focused) this.focus(this.bar.querySelector(`[data-wish="${wish}"]`));
  }
  // the focus goes to a button that can be pressed; else to Stop, and never to nothing
  focus(button) {
    (button && !button.disabled ? button : this.bar.querySelector("[data-wish=stop]")).focus();
  }
  send(wish, turn, more) {
    const tag = this.ask(wish, turn, more);
    if (tag === null) {
      this.say(`“${WISHES[wish]}” was not sent: no connection.`, true);
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
      this.say(`“${WISHES[message.wish]}” was not followed: ${message.words}.`, true);
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
    const focused = document.activeElement;
    if (focused && focused.disabled && this.bar.contains(focused)) this.focus(null);
    this.bar.classList.toggle("over", Boolean(view && OVER.includes(view.stage)));
    const again = this.bar.querySelector("[data-wish=again]");
    again.textContent = (view && AGAIN[view.stage]) || WISHES.again;
    if (this.asking && before !== this.turn() && !(this.asking.wish === "end" && offers.includes("end"))) {
      this.say(`“${WISHES[this.asking.wish]}” was not asked: the run has changed meanwhile.`, true);
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
      if (answer.wish !== "move" || !answer.followed) this.say(`“${WISHES[answer.wish]}” ${answer.followed ? "was followed" : "was not followed"}${words}`, !answer.followed);
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
      this.say(each.wish === "stop" ? "Stop was not confirmed. Use the emergency stop." : `“${WISHES[each.wish]}” was not answered.`, true);
    }
    if (this.toast.textContent && now > this.until) this.toast.textContent = "";
    this.mark();
  }
  // in a line of its own, which is always there: nothing moves and nothing is covered when it comes
  say(words, refused) {
    this.toast.textContent = words;
    this.toast.classList.toggle("refused", Boolean(refused));
    this.until = performance.now() + SHOWN;
  }
}
