// What all drawings on a canvas share.

/** A canvas made as many pixels large as it is shown, and cleared: its context, size in px and px of a css px; or null. */
export function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (!w || !h) return null;
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const g = canvas.getContext("2d");
  g.setTransform(1, 0, 0, 1, 0, 0);
  g.clearRect(0, 0, w, h);
  return { g, w, h, ratio };
}
/** Begins a circle. */
export function circle(g, [x, y], radius) {
  g.beginPath();
  g.arc(x, y, radius, 0, 2 * Math.PI);
}
/** Begins a polygon through places. */
export function polygon(g, places) {
  g.beginPath();
  for (const place of places) g.lineTo(...place);
  g.closePath();
}
/** Strokes what was begun once for each colour and width, css px: the halo first. */
export function stroke(g, ratio, ...lines) {
  for (const [colour, width] of lines) {
    [g.strokeStyle, g.lineWidth] = [colour, width * ratio];
    g.stroke();
  }
}
/** Places [x, y] of coordinates one after the other. */
export function pairs(flat) {
  return Array.from({ length: flat.length >> 1 }, (_, k) => [flat[2 * k], flat[2 * k + 1]]);
}
