// The log of the run: all that was said since it began, with a filter.
import { element } from "./words.js";

const MOST = 2000; // lines that are kept

export class RunLog {
  // root: the panel; opener: the button that shows it; last: where the newest line stands while the panel is closed
  constructor(root, opener, last) {
    [this.root, this.opener, this.last, this.lines, this.begun] = [root, opener, last, [], null];
    [this.list, this.filter, this.warnings, this.count] = [root.querySelector("ol"), root.querySelector("input[type=search]"), root.querySelector("input[type=checkbox]"), root.querySelector("output")];
    opener.addEventListener("click", () => this.open(root.hidden));
    root.querySelector("button").addEventListener("click", () => this.open(false));
    for (const each of [this.filter, this.warnings]) each.addEventListener("input", () => this.show());
    root.addEventListener("keydown", (event) => event.key === "Escape" && this.open(false));
  }
  open(shown) {
    this.root.hidden = !shown;
    this.opener.setAttribute("aria-expanded", String(shown));
    if (shown) {
      this.show();
      this.filter.focus();
    } else this.opener.focus();
  }
  add(lines) {
    const newest = this.lines.length ? this.lines[this.lines.length - 1].number : 0, fresh = lines.filter((line) => line.number > newest);
    if (!fresh.length) return;
    this.lines = this.lines.concat(fresh).slice(-MOST);
    this.begun ??= this.lines[0].stamp;
    const line = this.lines[this.lines.length - 1];
    this.last.textContent = line.text;
    this.last.classList.toggle("warning", line.warning);
    if (!this.root.hidden) this.show();
  }
  show() {
    const wanted = this.filter.value.trim().toLowerCase(), only = this.warnings.checked;
    const shown = this.lines.filter((line) => (!only || line.warning) && line.text.toLowerCase().includes(wanted));
    this.count.textContent = `${shown.length} of ${this.lines.length}`;
    this.list.replaceChildren(...shown.reverse().map((line) => {
      const row = element("li", "", line.warning ? "warning" : "");
      row.append(element("time", `${(line.stamp - this.begun).toFixed(1)} s`), line.text);
      return row;
    }));
  }
}
