"""What the page of adjustments does in the browser: views, the 3D view, mouse and keyboard.

It computes no geometry of cameras: every drag is answered by the server (:mod:`acino_fte.adjust_session`),
one question at a time, so that a slow computer skips positions and does not lag behind.
"""

from __future__ import annotations

from acino_fte.adjust_page_controls import CONTROLS
from acino_fte.adjust_page_space import SPACE

_VIEWS = r"""
const COLOURS = { left: '#3aa0e8', right: '#f0883e', middle: '#2fc79a' };
const NEAR = 11, GRASP = 16;
const by = (id) => document.getElementById(id);
let about, data = null, wanted, marker = 0, active = 0, asked = 0, shown = { detections: true };
let views = [], solo = false;
let drag = null, pending = null, answering = 0, wheel = null;
const images = new Map();

function tell(what) { emitEvent('adjust', what); }

function start(given, first) {
  about = given;
  const grid = by('adjust-views');
  grid.style.gridAutoRows = 'minmax(0, 1fr)';
  grid.replaceChildren();
  views = about.views.map((v, i) => makeView(grid, v, i));
  arrange();
  const slider = by('adjust-slider');
  [slider.min, slider.max] = about.frames;
  slider.oninput = () => go(+slider.value);
  slider.onkeydown = (e) => e.preventDefault();
  const box = by('adjust-frame');
  box.onchange = () => { const f = parseInt(box.value, 10); if (!isNaN(f)) go(f); box.blur(); refreshBar(); };
  makeList();
  addEventListener('keydown', key);
  addEventListener('resize', fitAll);
  new ResizeObserver(fitAll).observe(grid);
  new ResizeObserver(() => space.draw()).observe(by('adjust-space'));
  space.listen();
  receive(first);
}

function arrange() {  // all views, or the active one alone
  const n = solo ? 1 : views.length, columns = n === 1 ? 1 : n === 2 ? stacked() : n <= 4 ? 2 : 3;
  by('adjust-views').style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
  for (const v of views) v.box.style.display = solo && v.i !== active ? 'none' : '';
  fitAll();
}
function stacked() {  // two views: side by side, or one above the other, whichever shows them larger
  const { clientWidth: w, clientHeight: h } = by('adjust-views'), [a, b] = about.views[0].size;
  return Math.min(w / 2 / a, h / b) > Math.min(w / a, h / 2 / b) ? 2 : 1;
}

function makeView(grid, about_, i) {
  const box = document.createElement('div');
  box.className = 'adjust-view';
  box.innerHTML = '<canvas></canvas><div class="adjust-name"></div>';
  box.lastChild.textContent = about_.name;
  grid.append(box);
  const view = { i, name: about_.name, size: about_.size, box, canvas: box.firstChild, zoom: 1, cx: 0, cy: 0,
    pictures: about_.pictures };
  [view.cx, view.cy] = [about_.size[0] / 2, about_.size[1] / 2];
  const c = view.canvas;
  c.addEventListener('pointerdown', (e) => press(view, e));
  c.addEventListener('pointermove', (e) => move(view, e));
  c.addEventListener('pointerup', (e) => release(view, e));
  c.addEventListener('pointercancel', () => { drag = null; });
  c.addEventListener('wheel', (e) => turn(view, e), { passive: false });
  c.addEventListener('dblclick', (e) => place(view, e));
  return view;
}

function scaleOf(v) {
  const fit = Math.min(v.box.clientWidth / v.size[0], v.box.clientHeight / v.size[1]);
  return Math.max(fit, 1e-6) * v.zoom;
}
function toCanvas(v, p) {
  const s = scaleOf(v);
  return [(p[0] + 0.5 - v.cx) * s + v.box.clientWidth / 2, (p[1] + 0.5 - v.cy) * s + v.box.clientHeight / 2];
}
function toImage(v, x, y) {
  const s = scaleOf(v);
  return [(x - v.box.clientWidth / 2) / s + v.cx - 0.5, (y - v.box.clientHeight / 2) / s + v.cy - 0.5];
}
function fitAll() { if (data) follow(); draw(); space.draw(); }
function resetZoom() {
  for (const v of views) { v.zoom = 1; v.follow = false; [v.cx, v.cy] = [v.size[0] / 2, v.size[1] / 2]; }
  draw();
}
function followAll() { for (const v of views) { v.follow = true; v.zoom = 1; } follow(); draw(); }
function bounds(v) {  // of the animal as the run has it, which stays while a marker is dragged
  const known = data.before[v.i].filter((p) => p && p.every((x, k) => x > -v.size[k] && x < 2 * v.size[k]));
  if (known.length < 2) return null;
  const [low, high] = [Math.min, Math.max].map((f) => [0, 1].map((k) => f(...known.map((p) => p[k]))));
  return { middle: low.map((x, k) => (x + high[k]) / 2 + 0.5), extent: high.map((x, k) => x - low[k] + 8) };
}
function follow() {  // keep the animal in the middle, and its size when that changes little
  for (const v of views) {
    const b = v.follow && bounds(v);
    if (!b || !v.box.clientWidth) continue;
    [v.cx, v.cy] = b.middle;
    const fit = scaleOf(v) / v.zoom;
    const best = 0.62 * Math.min(v.box.clientWidth / b.extent[0], v.box.clientHeight / b.extent[1]) / fit;
    const least = Math.max(1, Math.min(60, best));
    if (v.zoom / least > 1.35 || least / v.zoom > 1.35) v.zoom = least;
  }
}
function usual() {  // an animal that is small in its images is followed from the start
  const small = views.filter((v) => {
    const b = bounds(v);
    return b && Math.max(b.extent[0] / v.size[0], b.extent[1] / v.size[1]) < 0.35;
  });
  if (small.length > views.length / 2) followAll();
}

// --- frames ---
function go(frame) {
  wanted = Math.min(about.frames[1], Math.max(about.frames[0], frame));
  by('adjust-slider').value = wanted;
  if (document.activeElement !== by('adjust-frame')) by('adjust-frame').value = wanted;
  ask();
}
function ask() {
  if (performance.now() - asked < 1500) return;  // one question at a time; an answer lost is asked again
  asked = performance.now();
  const mine = asked;
  tell({ do: 'frame', frame: wanted });
  setTimeout(() => { if (asked === mine) ask(); }, 1600);
}
function receive(answer, chosen) {
  const first = data === null;
  asked = 0;
  data = answer;
  if (chosen !== undefined && chosen !== null) {
    if (chosen !== 'keep') marker = chosen;
    wanted = data.frame;
  }
  if (wanted === undefined) wanted = data.frame;
  if (data.frame !== wanted) ask();
  if (first) usual();
  follow();
  drop();
  for (const v of views) picture(v, data.frame);
  if (data.frame === wanted) for (const v of views) for (const k of [1, 2, -1]) picture(v, data.frame + k);
  refreshBar(); refreshList(); draw(); space.draw();
  if (typeof chosen === 'number') reveal();
}
function stale() { asked = 0; go(wanted); }  // something changed it

function picture(v, frame) {
  if (!v.pictures || frame < about.frames[0] || frame > about.frames[1]) return null;
  const url = `/files/p${v.i}-${frame}.jpg`;
  if (images.has(url)) {
    const found = images.get(url);
    images.delete(url);
    images.set(url, found);  // the last in line to go
    return found;
  }
  const image = new Image();
  image.frame = frame;
  image.onload = () => { image.there = true; if (data && data.frame === frame) drawView(v); };
  image.src = url;
  images.set(url, image);
  if (images.size > 12 * views.length + 12) images.delete(images.keys().next().value);
  return image;
}

function drop() {  // pictures still on their way that nobody waits for any more
  for (const [url, image] of images) {
    if (image.there || Math.abs(image.frame - data.frame) < 3) continue;
    image.src = '';
    images.delete(url);
  }
}

// --- drawing ---
function context(canvas) {
  const r = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * r) || canvas.height !== Math.round(h * r)) {
    canvas.width = Math.round(w * r); canvas.height = Math.round(h * r);
  }
  const g = canvas.getContext('2d');
  g.setTransform(r, 0, 0, r, 0, 0);
  g.clearRect(0, 0, w, h);
  return g;
}
function draw() { for (const v of views) drawView(v); }
function drawView(v) {
  if (!v.box.clientWidth) return;
  const g = context(v.canvas);
  v.box.classList.toggle('active', v.i === active && views.length > 1);
  const [x0, y0] = toCanvas(v, [-0.5, -0.5]), s = scaleOf(v), [w, h] = v.size;
  g.fillStyle = '#1b2027'; g.fillRect(x0, y0, w * s, h * s);
  if (!data) return;
  const image = picture(v, data.frame);
  if (image && image.there) { g.imageSmoothingEnabled = s < 3; g.drawImage(image, x0, y0, w * s, h * s); }
  else blank(g, v, x0, y0, s);
  const now = data.now[v.i].map((p) => p && toCanvas(v, p));
  const before = data.before[v.i].map((p) => p && toCanvas(v, p));
  bones(g, before, 'rgba(210,210,210,.45)', 1, (a, b) => data.moved[a] !== null || data.moved[b] !== null);
  bones(g, now, 'rgba(0,0,0,.55)', 3.4);
  bones(g, now, null, 1.7);
  if (shown.detections) crosses(g, v);
  for (let m = 0; m < now.length; m++) if (now[m]) dot(g, now[m], before[m], m);
  chosenOn(g, v, now[marker]);
}
function blank(g, v, x0, y0, s) {
  g.strokeStyle = '#2c343f'; g.lineWidth = 1;
  const step = [10, 20, 50, 100, 200, 500].find((k) => k * s > 60) || 1000;
  g.beginPath();
  const [w, h] = [v.size[0] * s, v.size[1] * s];
  for (let x = 0; x <= w; x += step * s) { g.moveTo(x0 + x, y0); g.lineTo(x0 + x, y0 + h); }
  for (let y = 0; y <= h; y += step * s) { g.moveTo(x0, y0 + y); g.lineTo(x0 + w, y0 + y); }
  g.stroke();
}
function bones(g, points, colour, width, when) {
  g.lineWidth = width; g.lineCap = 'round';
  for (const [a, b, side] of about.edges) {
    if (!points[a] || !points[b] || (when && !when(a, b))) continue;
    g.strokeStyle = colour || COLOURS[side];
    g.beginPath(); g.moveTo(...points[a]); g.lineTo(...points[b]); g.stroke();
  }
}
function crosses(g, v) {
  for (let m = 0; m < about.markers.length; m++) {
    const p = data.detected[v.i][m];
    if (!p) continue;
    const [x, y] = toCanvas(v, p), big = m === marker, r = big ? 5 : 3;
    g.strokeStyle = big ? '#ffe14d' : 'rgba(255,225,77,.6)'; g.lineWidth = big ? 1.8 : 1;
    g.beginPath();
    g.moveTo(x - r, y - r); g.lineTo(x + r, y + r);
    g.moveTo(x - r, y + r); g.lineTo(x + r, y - r);
    g.stroke();
  }
}
function dot(g, p, before, m) {
  if (data.moved[m] !== null && before) {
    g.strokeStyle = '#f5a9d6'; g.lineWidth = 1; g.setLineDash([3, 2]);
    g.beginPath(); g.moveTo(...before); g.lineTo(...p); g.stroke(); g.setLineDash([]);
    g.beginPath(); g.arc(before[0], before[1], 3, 0, 7); g.stroke();
  }
  g.beginPath(); g.arc(p[0], p[1], 3.6, 0, 7);
  g.fillStyle = COLOURS[about.sides[m]]; g.fill();
  g.lineWidth = 1.2; g.strokeStyle = data.moved[m] === null ? 'rgba(0,0,0,.7)' : '#ff7ac8'; g.stroke();
}
function chosenOn(g, v, p) {
  const pin = data.pins[marker][v.name];
  if (pin) {
    const [x, y] = toCanvas(v, pin);
    g.strokeStyle = '#ff7ac8'; g.lineWidth = 1.5; g.strokeRect(x - 5, y - 5, 10, 10);
  }
  if (!p) return;
  g.strokeStyle = '#fff'; g.lineWidth = 1.8;
  g.beginPath(); g.arc(p[0], p[1], 7.5, 0, 7); g.stroke();
  const name = about.markers[marker];
  g.font = '600 12px system-ui, sans-serif'; g.lineWidth = 3; g.strokeStyle = 'rgba(0,0,0,.75)';
  const left = p[0] + 12 + g.measureText(name).width > v.box.clientWidth;
  g.textAlign = left ? 'right' : 'left';
  const x = p[0] + (left ? -11 : 11), y = Math.max(16, p[1] - 9);
  g.strokeText(name, x, y); g.fillStyle = '#fff'; g.fillText(name, x, y); g.textAlign = 'left';
}

// --- mouse ---
function near(v, x, y, reach) {
  let best = -1, least = reach;
  data.now[v.i].forEach((p, m) => {
    if (!p) return;
    const [a, b] = toCanvas(v, p), d = Math.hypot(a - x, b - y) - (m === marker ? 3 : 0);
    if (d < least) { least = d; best = m; }
  });
  return best;
}
function press(v, e) {
  if (!data || e.button > 1) return;
  active = v.i;
  if (document.activeElement && document.activeElement !== document.body) document.activeElement.blur();
  const m = e.button === 0 ? near(v, e.offsetX, e.offsetY, NEAR) : -1;
  v.canvas.setPointerCapture(e.pointerId);
  if (m >= 0) select(m);
  drag = { v, m, x: e.offsetX, y: e.offsetY, cx: v.cx, cy: v.cy, mode: e.shiftKey ? 'depth' : 'image',
    begin: m >= 0 ? data.now[v.i][m] : null, moved: false, frame: data.frame };
  draw();
}
function move(v, e) {
  if (!data) return;
  if (!drag) {
    v.canvas.style.cursor = near(v, e.offsetX, e.offsetY, NEAR) >= 0 ? 'move' : 'crosshair';
    return;
  }
  const dx = e.offsetX - drag.x, dy = e.offsetY - drag.y;
  if (!drag.moved && Math.hypot(dx, dy) < 2) return;
  drag.moved = true;
  const s = scaleOf(drag.v);
  if (drag.m < 0) {
    [drag.v.cx, drag.v.cy, drag.v.follow] = [drag.cx - dx / s, drag.cy - dy / s, false];
    drawView(drag.v);
    return;
  }
  send({ ...dragRequest(dx, dy, s), do: 'drag' });
}
function dragRequest(dx, dy, s) {
  const { v, m, begin } = drag;
  return { frame: drag.frame, marker: about.markers[m], view: v.name, mode: drag.mode,
    pixel: drag.mode === 'depth' ? begin : [begin[0] + dx / s, begin[1] + dy / s],
    factor: 1 - dy * 0.005 / distance(v, m) };
}
function distance(v, m) {
  const c = data.centres[v.i], p = data.xyz[m];
  return p ? Math.hypot(p[0] - c[0], p[1] - c[1], p[2] - c[2]) : 1;
}
function release(v, e) {
  const d = drag;
  if (d && d.moved && d.m >= 0) {
    const last = dragRequest(e.offsetX - d.x, e.offsetY - d.y, scaleOf(d.v));
    pending = null;
    tell({ ...last, do: 'commit' });
  }
  drag = null;
}
function send(request) {  // one question at a time, the newest position next
  if (performance.now() - answering < 400) { pending = request; return; }
  answering = performance.now();
  tell(request);
}
function dragged(answer) {
  answering = 0;
  if (pending) { const next = pending; pending = null; send(next); }
  if (!answer || !data || answer.frame !== data.frame) return;
  data.xyz[answer.marker] = answer.xyz;
  answer.now.forEach((p, i) => { data.now[i][answer.marker] = p; });
  data.pins[answer.marker] = answer.pins;
  if (data.moved[answer.marker] === null) data.moved[answer.marker] = 0;
  draw(); space.draw();
}
function turn(v, e) {
  e.preventDefault();
  if (!data) return;
  const p = data.now[v.i][marker], at = p && toCanvas(v, p), notches = -Math.sign(e.deltaY);
  if (at && !e.ctrlKey && Math.hypot(at[0] - e.offsetX, at[1] - e.offsetY) < GRASP) {
    active = v.i;
    wheel = { v, p, n: (wheel && wheel.v === v ? wheel.n : 0) + notches * (e.altKey ? 5 : 1) };
    if (!wheel.timer) wheel.timer = requestAnimationFrame(roll);
    return;
  }
  zoom(v, e.offsetX, e.offsetY, Math.exp(-Math.max(-300, Math.min(300, e.deltaY)) * 0.0016));
}
function roll() {
  const { v, p, n } = wheel;
  wheel = null;
  tell({ do: 'commit', frame: data.frame, marker: about.markers[marker], view: v.name, mode: 'depth',
    pixel: p, factor: 1 + n * 0.01 / distance(v, marker), together: true });
}
function zoom(v, x, y, by_) {
  const [u, w] = toImage(v, x, y), next = Math.min(60, Math.max(0.8, v.zoom * by_));
  v.zoom = next;
  v.follow = false;
  const s = scaleOf(v);
  v.cx = u + 0.5 - (x - v.box.clientWidth / 2) / s; v.cy = w + 0.5 - (y - v.box.clientHeight / 2) / s;
  drawView(v);
}
function place(v, e) {
  if (!data || near(v, e.offsetX, e.offsetY, NEAR) >= 0) return;
  tell({ do: 'commit', frame: data.frame, marker: about.markers[marker], view: v.name, mode: 'image',
    pixel: toImage(v, e.offsetX, e.offsetY) });
}
"""

SCRIPT = "window.adjust = (() => {\n" + _VIEWS + SPACE + CONTROLS + "})();\n"
"""Defines ``window.adjust``; ``adjust.start(about)`` begins."""
