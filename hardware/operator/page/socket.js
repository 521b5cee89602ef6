// The line to the page's process: opened again whenever it breaks, and a stop goes by every way there is.

const AGAIN = 700; // ms between two tries
const SILENCE = 1500; // ms without a word, after which a stop does not trust the socket alone

export class Line {
  // hear: given each message, as an object or as an ArrayBuffer; resolves once it is shown
  constructor(hear) {
    this.hear = hear;
    this.tag = 0;
    this.heard = -Infinity;
    this.open();
  }
  get connected() {
    return this.socket.readyState === WebSocket.OPEN;
  }
  open() {
    const url = new URL("socket", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    const socket = (this.socket = new WebSocket(url));
    socket.binaryType = "arraybuffer";
    let before = Promise.resolve();
    socket.addEventListener("message", (event) => {
      this.heard = performance.now();
      // words are shown at once, and overtake pictures that are being decoded; acknowledged in their order
      const message = typeof event.data === "string" ? JSON.parse(event.data) : event.data;
      const shown = message instanceof ArrayBuffer ? before.then(() => this.hear(message)) : this.now(message);
      before = Promise.all([before, shown]).then(() => this.acknowledge(socket, message)).catch((error) => console.error(error));
    });
    socket.addEventListener("close", () => setTimeout(() => this.open(), AGAIN));
  }
  async now(message) {
    return this.hear(message);
  }
  acknowledge(socket, message) {
    if (message.bundle && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ shown: message.bundle }));
  }
  // send a region, corners by camera, drawn under the turn that was shown; its tag, or null where there is no connection
  draw(region, turn) {
    if (!this.connected) return null;
    this.socket.send(JSON.stringify({ region, turn, tag: ++this.tag }));
    return this.tag;
  }
  // ask for a wish under the turn that was shown; more: { move } or { outline }; its tag, or null where nobody can be asked
  ask(wish, turn, more) {
    const tag = ++this.tag;
    if (this.connected) this.socket.send(JSON.stringify({ ask: wish, turn, tag, ...more }));
    if (wish === "stop" && (!this.connected || performance.now() - this.heard > SILENCE)) {
      fetch("stop", { method: "POST" }).catch(() => {});
    } else if (!this.connected) return null;
    return tag;
  }
}
