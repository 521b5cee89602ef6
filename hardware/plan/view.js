// An interactive view of a plan: beads as ribbons at their true width, travels, the wound's bed and the restored skin.
// Plain WebGL, no network. The data stands in the page as base64 of little-endian numbers.
(function () {
  "use strict";
  const plan = JSON.parse(document.getElementById("plan-data").textContent);
  const canvas = document.getElementById("plan-canvas");
  const say = document.getElementById("plan-words");
  const at = document.getElementById("plan-at");
  const boxes = {};
  for (const name of ["travels", "bed", "skin", "alone", "tool"]) boxes[name] = document.getElementById("plan-" + name);
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    say.textContent = "This browser shows no WebGL: the pictures of the layers below show the same beads.";
    return;
  }

  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out.buffer;
  }
  const tip = new Float32Array(bytes(plan.tip)), normal = new Int8Array(bytes(plan.normal));
  const width = new Uint16Array(bytes(plan.width_um)), layer = new Uint16Array(bytes(plan.layer));
  const extrude = new Uint8Array(bytes(plan.extrude)), seconds = new Float32Array(bytes(plan.seconds));
  const count = layer.length;

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  }
  // across: -1 to 1 over a bead, and 2 where it does not matter
  const solid = program(
    `attribute vec3 place; attribute vec3 up; attribute vec4 paint; attribute float across;
     uniform mat4 view; uniform vec3 light; varying vec4 colour; varying float side;
     void main() {
       gl_Position = view * vec4(place, 1.0);
       float lit = 0.62 + 0.38 * abs(dot(normalize(up), light));
       colour = vec4(paint.rgb * lit, paint.a); side = across;
     }`,
    `precision mediump float; varying vec4 colour; varying float side;
     void main() {
       float s = abs(side);
       float round = s > 1.5 ? 1.0 : 0.45 + 0.55 * sqrt(max(0.0, 1.0 - s * s));
       gl_FragColor = vec4(colour.rgb * round * colour.a, colour.a);
     }`
  );

  function buffer(data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  }
  const STRIDE = 11; // place 3, up 3, paint 4, across 1
  function shape(floats) {
    return { data: buffer(floats), count: floats.length / STRIDE };
  }

  // Beads, six corners for each way that is printed, in order: drawing the first so many shows how far the print is.
  const drawn = new Uint32Array(count + 1), hops = new Uint32Array(count + 1);
  for (let i = 0; i < count; i++) {
    drawn[i + 1] = drawn[i] + (extrude[i] ? 1 : 0);
    hops[i + 1] = hops[i] + (i && !extrude[i] ? 1 : 0);
  }
  function ribbons() {
    const out = new Float32Array(drawn[count] * 6 * STRIDE);
    let o = 0;
    for (let i = 1; i < count; i++) {
      if (!extrude[i]) continue;
      const a = 3 * (i - 1), b = 3 * i;
      let dx = tip[b] - tip[a], dy = tip[b + 1] - tip[a + 1], dz = tip[b + 2] - tip[a + 2];
      const n = Math.hypot(dx, dy, dz) || 1;
      dx /= n; dy /= n; dz /= n;
      const ux = normal[b] / 127, uy = normal[b + 1] / 127, uz = normal[b + 2] / 127;
      let sx = dy * uz - dz * uy, sy = dz * ux - dx * uz, sz = dx * uy - dy * ux;
      const m = Math.hypot(sx, sy, sz) || 1;
      sx /= m; sy /= m; sz /= m;
      const wa = width[i - 1] / 2000, wb = width[i] / 2000, over = 0.35 * Math.min(wa, wb);
      const paint = plan.paints[plan.paint_of[layer[i]]], shade = layer[i] % 2 ? 0.88 : 1.0;
      const corners = [[a, -over, wa, -1], [a, -over, wa, 1], [b, over, wb, -1], [b, over, wb, -1], [a, -over, wa, 1], [b, over, wb, 1]];
      for (const [p, along, w, side] of corners) {
        out[o++] = tip[p] + dx * along + sx * w * side;
        out[o++] = tip[p + 1] + dy * along + sy * w * side;
        out[o++] = tip[p + 2] + dz * along + sz * w * side;
        out[o++] = ux; out[o++] = uy; out[o++] = uz;
        out[o++] = paint[0] * shade; out[o++] = paint[1] * shade; out[o++] = paint[2] * shade; out[o++] = 1;
        out[o++] = side;
      }
    }
    return shape(out);
  }
  const DASHES = 12; // of one way: lines of WebGL are a pixel wide and have no dashes of their own
  function travels() {
    const out = new Float32Array(hops[count] * 2 * DASHES * STRIDE);
    let o = 0;
    for (let i = 1; i < count; i++) {
      if (extrude[i]) continue;
      for (let k = 0; k < 2 * DASHES; k++) {
        const share = (k + (k % 2 ? -0.2 : 0.2)) / (2 * DASHES - 1), a = 3 * (i - 1), b = 3 * i;
        const at = [0, 1, 2].map((j) => tip[a + j] + share * (tip[b + j] - tip[a + j]));
        out.set([...at, 0, 0, 1, 0.84, 0, 0.42, 1, 2], o);
        o += STRIDE;
      }
    }
    return shape(out);
  }
  function legend() {
    const made = plan.legend.map(([words, paint]) => [words, "background:rgb(" + plan.paints[paint].map((v) => Math.round(255 * v)) + ")", ""]);
    for (const [words, style, kind] of [...made, ["travel, nothing is printed", "", "travel"]]) {
      const key = document.createElement("span"), swatch = document.createElement("i");
      swatch.style.cssText = style;
      swatch.className = kind;
      key.append(swatch, words);
      document.getElementById("plan-legend").append(key);
    }
  }
  legend();
  function surface(sheet, paint) {
    if (!sheet) return null;
    const z = new Float32Array(bytes(sheet.heights)), w = sheet.columns, h = sheet.rows, out = [];
    const place = (c, r) => [sheet.x + c * sheet.step, sheet.y + r * sheet.step, z[r * w + c]];
    const up = (c, r) => {
      const l = z[r * w + Math.max(c - 1, 0)], q = z[r * w + Math.min(c + 1, w - 1)];
      const d = z[Math.max(r - 1, 0) * w + c], u = z[Math.min(r + 1, h - 1) * w + c];
      return [(l - q) / (2 * sheet.step), (d - u) / (2 * sheet.step), 1];
    };
    for (let r = 0; r + 1 < h; r++)
      for (let c = 0; c + 1 < w; c++) {
        const nodes = [[c, r], [c + 1, r], [c + 1, r + 1], [c, r], [c + 1, r + 1], [c, r + 1]];
        if (nodes.some(([x, y]) => !isFinite(z[y * w + x]))) continue;
        for (const [x, y] of nodes) out.push(...place(x, y), ...up(x, y), ...paint, 2);
      }
    return shape(new Float32Array(out));
  }
  const beads = ribbons(), ways = travels();
  const bed = surface(plan.bed, [0.86, 0.66, 0.58, 1]), skin = surface(plan.skin, [0.95, 0.8, 0.7, 0.34]);

  const low = plan.low, high = plan.high, middle = low.map((v, k) => (v + high[k]) / 2);
  const size = Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
  const eye = { turn: -0.7, tilt: 0.85, far: 1.15 * size, x: 0, y: 0 };

  function product(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[k * 4 + r] * b[c * 4 + k];
      out[c * 4 + r] = sum;
    }
    return out;
  }
  function view() {
    const ct = Math.cos(eye.turn), st = Math.sin(eye.turn), cp = Math.cos(eye.tilt), sp = Math.sin(eye.tilt);
    const right = [ct, st, 0], back = [st * cp, -ct * cp, sp], up = [-st * sp, ct * sp, cp];
    const dot = (v) => -(v[0] * middle[0] + v[1] * middle[1] + v[2] * middle[2]);
    const look = [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      dot(right) + eye.x, dot(up) + eye.y, dot(back) - eye.far, 1];
    const near = Math.max(eye.far - 2 * size, eye.far / 50), far = eye.far + 2 * size, f = 1 / Math.tan(0.3);
    const lens = [f * canvas.height / canvas.width, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, 2 * far * near / (near - far), 0];
    return { matrix: product(lens, look), back };
  }
  function draw(thing, kind, first, number) {
    if (!thing || number <= 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, thing.data);
    let offset = 0;
    for (const [name, n] of [["place", 3], ["up", 3], ["paint", 4], ["across", 1]]) {
      const where = gl.getAttribLocation(solid, name);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, n, gl.FLOAT, false, 4 * STRIDE, 4 * offset);
      offset += n;
    }
    gl.drawArrays(kind, first, number);
  }
  function tool(i) {
    // A cone, its tip where the nozzle is and its axis along the tool.
    const out = [], p = [tip[3 * i], tip[3 * i + 1], tip[3 * i + 2]];
    const u = [normal[3 * i] / 127, normal[3 * i + 1] / 127, normal[3 * i + 2] / 127];
    const s = Math.abs(u[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let a = cross(u, s);
    const n = Math.hypot(...a);
    a = a.map((v) => v / n);
    const b = cross(u, a), tall = 0.16 * size, wide = 0.028 * size;
    const ring = (k) => a.map((v, j) => Math.cos(k) * v + Math.sin(k) * b[j]);
    for (let k = 0; k < 24; k++) {
      const r = ring(k * Math.PI / 12), q = ring((k + 1) * Math.PI / 12), paint = [0.35, 0.4, 0.46, 1, 2];
      const rim = (d) => d.map((v, j) => p[j] + tall * u[j] + wide * v);
      out.push(...p, ...r, ...paint, ...rim(r), ...r, ...paint, ...rim(q), ...q, ...paint);
    }
    return new Float32Array(out);
  }
  const cone = { data: gl.createBuffer(), count: 72 };

  function clock(s) {
    const whole = Math.round(s), h = Math.floor(whole / 3600), m = Math.floor(whole / 60) % 60;
    return (h ? h + " h " : "") + (h || m ? m + " min " : "") + (whole % 60) + " s";
  }
  function show() {
    const ratio = window.devicePixelRatio || 1;
    const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(solid);
    const { matrix, back } = view();
    gl.uniformMatrix4fv(gl.getUniformLocation(solid, "view"), false, matrix);
    gl.uniform3fv(gl.getUniformLocation(solid, "light"), back);
    const i = +at.value, end = i + 1;
    let first = 0;
    if (boxes.alone.checked) while (first < i && layer[first] !== layer[i]) first++;
    gl.disable(gl.BLEND);
    if (boxes.bed.checked) draw(bed, gl.TRIANGLES, 0, bed ? bed.count : 0);
    draw(beads, gl.TRIANGLES, 6 * drawn[first], 6 * (drawn[end] - drawn[first]));
    if (boxes.travels.checked) draw(ways, gl.LINES, 2 * DASHES * hops[first], 2 * DASHES * (hops[end] - hops[first]));
    if (boxes.tool.checked) {
      gl.bindBuffer(gl.ARRAY_BUFFER, cone.data);
      gl.bufferData(gl.ARRAY_BUFFER, tool(i), gl.DYNAMIC_DRAW);
      draw(cone, gl.TRIANGLES, 0, cone.count);
    }
    if (boxes.skin.checked && skin) {
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.depthMask(false);
      draw(skin, gl.TRIANGLES, 0, skin.count);
      gl.depthMask(true);
    }
    say.textContent = `layer ${layer[i] + 1} of ${plan.layers} · ${plan.names[layer[i]]} · checkpoint ${i + 1} of ${count} · ` +
      `${clock(seconds[i])} of ${clock(seconds[count - 1])}`;
  }
  let asked = false;
  function refresh() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; show(); });
  }

  at.max = count - 1;
  at.value = count - 1;
  const shown = /checkpoint=(\d+)/.exec(location.hash); // a link may name a checkpoint
  if (shown) at.value = Math.min(+shown[1], count - 1);
  at.addEventListener("input", refresh);
  for (const name in boxes) boxes[name].addEventListener("change", refresh);
  window.addEventListener("resize", refresh);
  const held = new Map(); // pointers that are down; a finger that goes up or down scrolls the page (touch-action: pan-y)
  const apart = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (e) => {
    held.set(e.pointerId, { x: e.clientX, y: e.clientY, button: e.button });
    canvas.setPointerCapture(e.pointerId);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const one = held.get(e.pointerId);
    if (!one) return;
    const dx = e.clientX - one.x, dy = e.clientY - one.y, before = held.size === 2 ? apart() : 0;
    [one.x, one.y] = [e.clientX, e.clientY];
    if (before > 0) near(before / Math.max(apart(), 1));
    if (e.shiftKey || one.button === 2) {
      const scale = eye.far * 0.62 / canvas.clientHeight;
      eye.x += dx * scale; eye.y -= dy * scale;
    } else {
      eye.turn -= dx * 0.008;
      eye.tilt = Math.min(Math.max(eye.tilt + dy * 0.008, -0.2), Math.PI / 2);
    }
    refresh();
  });
  function near(times) {
    eye.far = Math.min(Math.max(eye.far * times, 0.05 * size), 6 * size);
    refresh();
  }
  canvas.addEventListener("touchmove", (e) => e.touches.length > 1 && e.preventDefault(), { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    near(Math.exp(e.deltaY * 0.001));
  }, { passive: false });
  document.getElementById("plan-top").addEventListener("click", () => { eye.turn = 0; eye.tilt = Math.PI / 2; refresh(); });
  document.getElementById("plan-step").addEventListener("click", () => {
    let i = (+at.value + 1) % count;
    const now = layer[i];
    while (i + 1 < count && layer[i + 1] === now) i++;
    at.value = i;
    refresh();
  });
  show();
})();
