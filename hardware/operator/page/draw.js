// The region, drawn over the pictures corner by corner, and sent to the run as a whole.

const MOST = 64; // corners of a camera
const ENOUGH = 3, CAMERAS = 2;

export class Drawing {
  // root: holds its buttons; panes: of the cameras, by name; line: to the run; say: words, and whether they are bad
  constructor(root, panes, line, say) {
    [this.root, this.panes, this.line, this.say, this.on] = [root, panes, line, say, false];
    this.order = []; // names of the cameras, as corners were set
    for (const button of root.querySelectorAll("button")) button.addEventListener("click", () => this[button.dataset.draw]());
  }
  // view: the run's newest; live: whether it is
  show(view, live) {
    [this.turn, this.on] = [view ? view.turn : 0, Boolean(view && live && view.draws)];
    this.root.hidden = !this.on;
    const drawn = this.drawn(), corners = Object.values(drawn), size = Math.min(CAMERAS, this.panes.size);
    const whole = corners.length >= size && corners.every((each) => each.length >= ENOUGH);
    for (const button of this.root.querySelectorAll("button")) button.disabled = button.dataset.draw === "use" ? !whole : !corners.length;
    for (const pane of this.panes.values()) pane.drawing = this.on ? (place) => this.add(pane, place) : null;
  }
  drawn() {
    return Object.fromEntries([...this.panes].filter(([, pane]) => pane.corners.length).map(([name, pane]) => [name, pane.corners]));
  }
  add(pane, place) {
    if (pane.corners.length >= MOST) return this.say(`${MOST} corners are enough.`, true);
    pane.corners.push(place);
    this.order.push(pane.name);
  }
  undo() {
    const last = this.order.pop();
    if (last) this.panes.get(last).corners.pop();
  }
  clear() {
    this.order = [];
    for (const pane of this.panes.values()) pane.corners = [];
  }
  use() {
    if (this.line.draw(this.drawn(), this.turn) === null) this.say("The region was not sent: no connection.", true);
  }
  // the page's process has taken the region, or says why not
  asked(message) {
    if (message.words) return this.say(`The region was not taken: ${message.words}.`, true);
    this.say("The region was taken.", false);
    this.clear();
  }
}
