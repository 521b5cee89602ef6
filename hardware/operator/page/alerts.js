// Sound and a notification when the nozzle is held, when the run stops, and when it ends; both can be muted.
import { keep, kept } from "./theme.js";

const KEY = "stillbed.sound";
const HELD = 1500; // ms of a hold before it is told: shorter ones are part of every print
const TONES = { hold: [[660, 0.12], [520, 0.16]], stop: [[440, 0.25], [330, 0.35]], end: [[520, 0.14], [660, 0.14], [780, 0.25]] }; // Hz, s

export class Alerts {
  // button: mutes
  constructor(button) {
    this.button = button;
    this.on = kept(KEY) !== "off";
    this.told = null; // what was told last, and is still so
    this.since = null; // of the present hold
    this.count = 0; // of what was told, for a test
    button.addEventListener("click", () => this.toggle());
    document.addEventListener("pointerdown", () => this.wake(), { once: true }); // browsers let nothing sound before
    this.mark();
  }
  toggle() {
    this.on = !this.on;
    keep(KEY, this.on ? "on" : "off");
    if (this.on) {
      this.wake();
      if (window.Notification && Notification.permission === "default") Notification.requestPermission();
    }
    this.mark();
  }
  mark() {
    this.button.setAttribute("aria-pressed", String(this.on));
    this.button.textContent = this.on ? "Sound on" : "Sound off";
  }
  wake() {
    if (this.on && window.AudioContext) (this.audio ??= new AudioContext()).resume().catch(() => {});
  }
  // kind: hold, stop, end, or "" of none; words: for the notification
  see(kind, words) {
    const now = performance.now();
    if (kind !== "hold") this.since = null;
    else if (now - (this.since ??= now) < HELD) return;
    if (kind === this.told) return;
    const first = this.told === null;
    this.told = kind;
    if (kind && !first) this.tell(kind, words);
  }
  tell(kind, words) {
    this.button.dataset.told = `${++this.count} ${kind}`;
    if (!this.on) return;
    let at = this.audio ? this.audio.currentTime : 0;
    for (const [hertz, seconds] of this.audio && this.audio.state === "running" ? TONES[kind] : []) {
      const tone = this.audio.createOscillator(), gain = this.audio.createGain();
      tone.frequency.value = hertz;
      gain.gain.setValueAtTime(0.2, at);
      gain.gain.exponentialRampToValueAtTime(0.001, at + seconds);
      tone.connect(gain).connect(this.audio.destination);
      tone.start(at);
      tone.stop(at + seconds);
      at += seconds;
    }
    if (document.hidden && window.Notification && Notification.permission === "granted") new Notification("stillbed", { body: words, tag: "stillbed" });
  }
}
