// The error over the last minute: what was predicted, what was true where that is known, and when the arm was held.

const SPAN = 60; // s

export class Course {
  constructor(canvas) {
    this.canvas = canvas;
    this.rows = []; // [stamp, predicted, true, limit, held]
  }
  begin(rows) {
    this.rows = rows;
  }
  add(view) {
    const motion = view.motion, last = this.rows[this.rows.length - 1];
    if (!motion || (last && last[0] >= view.stamp)) return;
    this.rows.push([view.stamp, motion.error, motion.true_error, motion.limit, motion.activity === "holding"]);
    while (view.stamp - this.rows[0][0] > SPAN) this.rows.shift();
  }
  draw() {
    const ratio = window.devicePixelRatio || 1, canvas = this.canvas;
    const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (!w || !h) return;
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    canvas.parentElement.dataset.rows = this.rows.length;
    const g = canvas.getContext("2d"), rows = this.rows, left = 30 * ratio, foot = 17 * ratio;
    g.clearRect(0, 0, w, h);
    g.font = `${13 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    if (!rows.length) return;
    const now = rows[rows.length - 1][0], limit = rows[rows.length - 1][3];
    const most = Math.max(limit === null ? 0.5 : 2 * limit, 0.1);
    const x = (stamp) => left + (w - left) * (1 - (now - stamp) / SPAN), y = (mm) => (h - foot) * (1 - Math.min(mm, most) / most) + 1;
    g.fillStyle = "rgb(217 131 36 / .22)";
    for (let i = 0; i < rows.length; i++) {
      const first = i;
      while (i < rows.length && rows[i][4]) i++;
      if (i > first) g.fillRect(x(rows[first][0]), 0, x(rows[Math.min(i, rows.length - 1)][0]) - x(rows[first][0]), h - foot);
    }
    g.strokeStyle = "#e3e2dc";
    g.lineWidth = ratio;
    g.strokeRect(left, 1, w - left - 1, h - foot);
    if (limit !== null) {
      g.strokeStyle = "#b93a24";
      g.setLineDash([5 * ratio, 4 * ratio]);
      this.path(g, [[left, y(limit)], [w, y(limit)]]);
      g.setLineDash([]);
    }
    for (const [column, colour] of [[2, "#b8630b"], [1, "#2a6f97"]]) {
      g.strokeStyle = colour;
      g.lineWidth = 1.8 * ratio;
      this.path(g, rows.map((row) => (row[column] === null ? null : [x(row[0]), y(row[column])])));
    }
    g.fillStyle = "#4f5a66";
    g.textBaseline = "middle";
    g.textAlign = "right";
    if (limit !== null) g.fillText(limit.toFixed(1), left - 5 * ratio, y(limit));
    g.fillText("0", left - 5 * ratio, h - foot - 5 * ratio);
    g.textBaseline = "alphabetic";
    g.textAlign = "left";
    const known = rows.some((row) => row[2] !== null);
    let at = left;
    for (const [words, colour] of [["error in mm, predicted", "#2a6f97"], ...(known ? [["true", "#b8630b"]] : []), ["held", "#8f6a3c"]]) {
      g.fillStyle = colour;
      g.fillText(words, at, h - 3 * ratio);
      at += g.measureText(words).width + 14 * ratio;
    }
    g.fillStyle = "#4f5a66";
    g.textAlign = "right";
    g.fillText("last minute", w - 2, h - 3 * ratio);
  }
  path(g, places) {
    g.beginPath();
    let pen = false;
    for (const p of places) {
      if (p) pen ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1]);
      pen = p !== null;
    }
    g.stroke();
  }
}
