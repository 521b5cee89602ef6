// Rigid motions as rows of rows, and how a point becomes a pixel: the lens of estimation/rig.py.

export function product(a, b) {
  return [0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) => a[r][0] * b[0][c] + a[r][1] * b[1][c] + a[r][2] * b[2][c] + a[r][3] * b[3][c]));
}
export function inverse(t) {
  const out = [0, 1, 2].map((r) => [t[0][r], t[1][r], t[2][r], 0]);
  for (const row of out) row[3] = -(row[0] * t[0][3] + row[1] * t[1][3] + row[2] * t[2][3]);
  return [...out, [0, 0, 0, 1]];
}
export function moved(t, x, y, z) {
  return [0, 1, 2].map((r) => t[r][0] * x + t[r][1] * y + t[r][2] * z + t[r][3]);
}

export class Lens {
  constructor(camera) {
    this.camera = camera;
    this.from_base = inverse(camera.base_from_camera);
    const m = camera.matrix;
    [this.fx, this.fy, this.cx, this.cy, this.skew] = [m[0][0], m[1][1], m[0][2], m[1][2], m[0][1]];
    // beyond the corners the polynomial of the distortion may fold back into the picture
    const [w, h] = camera.size, corner = (x, y) => ((x - this.cx) / this.fx) ** 2 + ((y - this.cy) / this.fy) ** 2;
    this.most = 1.5 * Math.max(corner(0, 0), corner(w, 0), corner(0, h), corner(w, h));
  }
  // pixel of a normalised place, null where it lies far outside
  bent(x, y) {
    const r2 = x * x + y * y;
    if (!(r2 < this.most)) return null;
    const [k1, k2, p1, p2, k3] = this.camera.distortion, radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
    const u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y;
    return [this.fx * u + this.skew * v + this.cx, this.fy * v + this.cy];
  }
  // pixel of an undistorted pixel
  distorted(px, py) {
    const y = (py - this.cy) / this.fy;
    return this.bent((px - this.cx - this.skew * y) / this.fx, y);
  }
  // the normalised place that a pixel shows: the inverse of `bent`
  straight(px, py) {
    const [k1, k2, p1, p2, k3] = this.camera.distortion, v = (py - this.cy) / this.fy, u = (px - this.cx - this.skew * v) / this.fx;
    let [x, y] = [u, v];
    for (let i = 0; i < 30; i++) {
      const r2 = x * x + y * y, radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
      [x, y] = [(u - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial, (v - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial];
    }
    return [x, y];
  }
  // the ray of a pixel in a frame whose pose in the base is given
  ray(base_from_frame, px, py) {
    const t = product(inverse(base_from_frame), this.camera.base_from_camera), [x, y] = this.straight(px, py), origin = moved(t, 0, 0, 0);
    return { origin, direction: moved(t, x, y, 1).map((v, k) => v - origin[k]) };
  }
  // a function from points, in a frame whose pose in the base is given, to pixels; null behind the camera
  from(base_from_frame) {
    const t = product(this.from_base, base_from_frame);
    return (x, y, z) => {
      const [a, b, c] = moved(t, x, y, z);
      return c > 1 ? this.bent(a / c, b / c) : null;
    };
  }
}

// How far a path is printed: the number of points done, and the place between the last of them and the next.
export function split(scene, fraction) {
  const numbers = scene.checkpoint;
  let low = 0, high = numbers.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle] <= fraction) low = middle + 1; else high = middle;
  }
  if (low === 0 || low === numbers.length) return { done: low, place: null };
  const share = (fraction - numbers[low - 1]) / (numbers[low] - numbers[low - 1]), p = scene.path, i = 3 * low;
  return { done: low, place: [0, 1, 2].map((k) => p[i - 3 + k] + share * (p[i + k] - p[i - 3 + k])) };
}

// Draws the path into a canvas: `pixel` maps points of it; printed ways in one style, those to come in another.
// only: whether nothing but the layer is drawn that is printed now
export function drawPath(g, scene, fraction, pixel, styles, only = false) {
  const { done, place } = split(scene, fraction), layer = only && scene.layer && scene.layer.length ? scene.layer[Math.min(done, scene.layer.length - 1)] : null;
  const count = scene.checkpoint.length, p = scene.path, at = new Array(count);
  for (let i = 0; i < count; i++) at[i] = pixel(p[3 * i], p[3 * i + 1], p[3 * i + 2]);
  const here = place && pixel(...place);
  const run = (first, last, extruding, begin, end) => {
    g.beginPath();
    for (let i = first; i < last; i++) {
      const a = i === first && begin ? begin : at[i - 1], b = at[i];
      if (Boolean(scene.extrude[i]) !== extruding || !a || !b || (layer !== null && scene.layer[i] !== layer)) continue;
      g.moveTo(a[0], a[1]);
      g.lineTo(b[0], b[1]);
    }
    if (end && at[last - 1] && last < count && Boolean(scene.extrude[last]) === extruding) {
      g.moveTo(...at[last - 1]);
      g.lineTo(...end);
    }
    g.stroke();
  };
  for (const [style, first, last, extruding, begin, end] of [
    [styles.hop, Math.max(done, 1), count, false, here, null],
    [styles.halo, 1, count, true, null, null],
    [styles.next, Math.max(done, 1), count, true, here, null],
    [styles.done, 1, done, true, null, here],
  ]) {
    if (!style) continue;
    g.strokeStyle = style.colour;
    g.lineWidth = style.width;
    run(first, last, extruding, begin, end);
  }
  return here;
}
