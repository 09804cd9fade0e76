"""The page and the 3D viewer of the report, as text. Filled in by :mod:`acino_fte.report`.

The page loads nothing: style, script, data and images are inside, so it opens from a disk and can be mailed.
"""

from __future__ import annotations

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>@title@</title>
<style>@style@</style>
</head>
<body>
<header class="@colour@">
<h1>@title@</h1>
<p class="status">@status@</p>
<p>@advice@</p>
</header>
<main>
@body@
</main>
<script id="data" type="application/json">@data@</script>
<script>@script@</script>
</body>
</html>
"""

STYLE = """
:root { --line: #d8d8d8; --soft: #666; }
* { box-sizing: border-box; }
body { margin: 0; font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b1b1b;
  background: #fff; }
header { padding: 1.1rem max(1.2rem, calc(50vw - 36rem)); color: #fff; }
header.green { background: #00674c; } header.amber { background: #8a5a00; }
header.red { background: #a33600; }
header h1 { margin: 0; font-size: 1.4rem; font-weight: 600; overflow-wrap: anywhere; }
header p { margin: .25rem 0 0; max-width: 60rem; } header .status { font-weight: 600; font-size: 1.05rem; }
main { max-width: 74rem; margin: 0 auto; padding: 0 1.2rem 3rem; }
h2 { font-size: 1.12rem; margin: 2rem 0 .6rem; border-bottom: 1px solid var(--line); padding-bottom: .25rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(10.5rem, 1fr)); gap: .7rem;
  margin-top: 1.2rem; }
.card { border: 1px solid var(--line); border-radius: 6px; padding: .55rem .75rem; }
.card b { display: block; font-size: 1.3rem; font-weight: 600; }
.card span { color: var(--soft); font-size: .86rem; }
.tables { display: flex; flex-wrap: wrap; gap: 1rem 2.5rem; align-items: flex-start; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); padding-bottom: .3rem; }
th, td { padding: .18rem .65rem; text-align: right; border-bottom: 1px solid #eee; vertical-align: top; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.text { text-align: left; overflow-wrap: anywhere; max-width: 34rem; }
td.bad { background: #fbe3d8; }
thead th { border-bottom: 1px solid #999; font-weight: 600; }
ul.warnings { background: #fff6df; border-left: 4px solid #e69f00;
  padding: .6rem .8rem .6rem 2rem; margin: 1.2rem 0 0; }
ul.findings { background: #e8f1fa; border-left: 4px solid #0072b2;
  padding: .6rem .8rem .6rem 2rem; margin: 0; font-size: 1.02rem; }
figure { margin: 0 0 1.6rem; } figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: .86rem; }
#viewer { position: relative; border: 1px solid var(--line); border-radius: 6px; overflow: hidden; }
#scene { display: block; width: 100%; height: 30rem; touch-action: none; cursor: grab; background: #fafafa; }
#scene:active { cursor: grabbing; } #scene:focus-visible { outline: 3px solid #0072b2; outline-offset: -3px; }
.controls { display: flex; flex-wrap: wrap; gap: .5rem .9rem; align-items: center; padding: .5rem .7rem;
  border-top: 1px solid var(--line); font-size: .88rem; }
.controls input[type=range] { flex: 1 1 14rem; }
.controls output { min-width: 11rem; font-variant-numeric: tabular-nums; }
button, select { font: inherit; padding: .2rem .7rem; }
.keys { position: absolute; right: .7rem; top: .5rem; color: var(--soft); font-size: .8rem; text-align: right;
  pointer-events: none; }
.left { color: #0072b2; } .right { color: #b86e00; }
@media print { #viewer, .keys { display: none; } }
"""

VIEWER = """
<div id="viewer">
<canvas id="scene" tabindex="0" aria-label="Skeleton in three dimensions. Drag to turn, wheel to zoom,
arrow keys to step, space to play."></canvas>
<div class="keys">drag: turn · shift-drag: move · wheel: zoom · ← →: step · space: play<br>
<span class="left">left</span> · <span class="right">right</span> · grid: @grid@ m</div>
<div class="controls">
<button id="play" type="button">Play</button>
<input id="slider" type="range" min="0" value="0" aria-label="Frame">
<output id="clock"></output>
<label>Speed <select id="speed"><option value="0.05">1/20</option><option value="0.1">1/10</option>
<option value="0.25" selected>1/4</option><option value="0.5">1/2</option>
<option value="1">1</option></select></label>
<label><input id="follow" type="checkbox" checked> follow</label>
<label><input id="cameras" type="checkbox" checked> cameras</label>
<label><input id="labels" type="checkbox"> names</label>
<button id="reset" type="button">Reset view</button>
</div>
</div>
"""

SCRIPT = """
"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("scene");
  if (!canvas) { return; }
  const pen = canvas.getContext("2d");
  const element = (name) => document.getElementById(name);
  const slider = element("slider"), clock = element("clock"), play = element("play");
  const n = data.frames.length, m = data.markers.length;
  const sideColour = { left: "#0072b2", right: "#e69f00", middle: "#333333" };
  slider.max = n - 1;
  let frame = 0, playing = false, last = 0, progress = 0;
  let view;

  function point(f, i) {
    const at = 3 * (f * m + i);
    return [data.positions[at] / 1000, data.positions[at + 1] / 1000, data.positions[at + 2] / 1000];
  }
  const known = (f, i) => data.positions[3 * (f * m + i)] !== null;
  const centres = data.frames.map((_, f) => {
    const there = [...Array(m).keys()].filter((i) => known(f, i));
    const sum = [0, 0, 0];
    there.forEach((i) => { point(f, i).forEach((v, a) => { sum[a] += v / there.length; }); });
    return there.length ? sum : null;
  });
  const first = centres.find((c) => c) || [0, 0, 0];  // frames without a marker keep the last place
  for (let f = 0; f < n; f++) { centres[f] = centres[f] || (f ? centres[f - 1] : first); }
  function reset() {
    const d = [centres[n - 1][0] - centres[0][0], centres[n - 1][1] - centres[0][1]];
    const heading = Math.hypot(d[0], d[1]) > 0.3 ? Math.atan2(d[1], d[0]) : 0;
    view = { yaw: heading - 1.2, pitch: 0.28, distance: 2.6 * data.size, shift: [0, 0, 0] };
  }
  reset();

  function basis() {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw);
    const cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const back = [cy * cp, sy * cp, sp];  // from the target to the eye
    return { back: back, right: [-sy, cy, 0], up: [-cy * sp, -sy * sp, cp] };
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  let eye;
  function look() {
    const b = basis();
    const base = element("follow").checked ? centres[frame] : centres[Math.floor(n / 2)];
    const target = base.map((v, a) => v + view.shift[a]);
    eye = { b: b, at: target.map((v, a) => v + view.distance * b.back[a]), scale: 1.3 * canvas.clientHeight };
  }
  function project(p) {
    const d = [p[0] - eye.at[0], p[1] - eye.at[1], p[2] - eye.at[2]];
    const depth = -dot(d, eye.b.back);
    if (depth < 0.05) { return null; }
    const k = eye.scale / depth;
    return [canvas.clientWidth / 2 + k * dot(d, eye.b.right), canvas.clientHeight / 2 - k * dot(d, eye.b.up)];
  }
  function clip(p, q) {  // cut a segment at the plane just before the eye
    const near = 0.06, depth = (x) => -dot(x.map((v, i) => v - eye.at[i]), eye.b.back);
    const a = depth(p), c = depth(q);
    if (a < near && c < near) { return null; }
    const cut = (x, y, dx, dy) => x.map((v, i) => v + (near - dx) / (dy - dx) * (y[i] - v));
    return [a < near ? cut(p, q, a, c) : p, c < near ? cut(q, p, c, a) : q];
  }
  function line(p, q, colour, width) {
    const kept = clip(p, q);
    if (!kept) { return; }
    const a = project(kept[0]), c = project(kept[1]);
    if (!a || !c) { return; }
    pen.strokeStyle = colour; pen.lineWidth = width;
    pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(c[0], c[1]); pen.stroke();
  }
  function text(p, words, colour) {
    const a = project(p);
    if (a) { pen.fillStyle = colour; pen.fillText(words, a[0] + 5, a[1] - 4); }
  }
  function ground() {
    const g = data.grid, z = g.z;
    for (let x = g.x0; x <= g.x1 + 1e-6; x += g.step) { line([x, g.y0, z], [x, g.y1, z], "#dddddd", 1); }
    for (let y = g.y0; y <= g.y1 + 1e-6; y += g.step) { line([g.x0, y, z], [g.x1, y, z], "#dddddd", 1); }
    const o = [g.x0, g.y0, z], s = g.step;
    const axes = [["x", "#d55e00", [s, 0, 0]], ["y", "#009e73", [0, s, 0]], ["z", "#0072b2", [0, 0, s]]];
    axes.forEach((axis) => {
      const tip = o.map((v, a) => v + axis[2][a]);
      line(o, tip, axis[1], 2); text(tip, axis[0], axis[1]);
    });
  }
  function cameras() {
    const s = 0.12 * data.size;
    data.cameras.forEach((camera) => {
      const pose = camera.poses[Math.min(frame, camera.poses.length - 1)];
      const c = pose.slice(0, 3), r = pose.slice(3, 6), d = pose.slice(6, 9), f = pose.slice(9, 12);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((k) =>
        c.map((v, a) => v + s * (f[a] + 0.6 * k[0] * r[a] + 0.6 * camera.aspect * k[1] * d[a])));
      corners.forEach((q, i) => { line(c, q, "#999999", 1); line(q, corners[(i + 1) % 4], "#999999", 1); });
      text(c, camera.name, "#666666");
    });
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    pen.lineCap = "round"; pen.font = "12px system-ui, sans-serif";
    look(); ground();
    if (element("cameras").checked) { cameras(); }
    for (let f = 1; f < n; f++) { line(centres[f - 1], centres[f], f <= frame ? "#888888" : "#cccccc", 1); }
    const flat = (p) => [p[0], p[1], data.grid.z];
    const edges = data.edges.filter((e) => known(frame, e[0]) && known(frame, e[1]));
    edges.forEach((e) => { line(flat(point(frame, e[0])), flat(point(frame, e[1])), "#d0d0d0", 2); });
    edges.forEach((e) => { line(point(frame, e[0]), point(frame, e[1]), sideColour[e[2]], 2.5); });
    data.markers.forEach((marker, i) => {
      const a = known(frame, i) ? project(point(frame, i)) : null;
      if (!a) { return; }
      const views = data.views[frame * m + i];
      pen.beginPath(); pen.arc(a[0], a[1], 3.2, 0, 7);
      pen.fillStyle = views ? sideColour[marker.side] : "#ffffff"; pen.fill();
      pen.strokeStyle = sideColour[marker.side]; pen.lineWidth = 1.2; pen.stroke();
      if (element("labels").checked) { text(point(frame, i), marker.name, "#333333"); }
    });
    slider.value = frame;
    const number = data.frames[frame];
    clock.textContent = "frame " + number + " · " + (number / data.fps).toFixed(3) + " s";
  }
  function show(f) { frame = Math.max(0, Math.min(n - 1, f)); progress = frame; draw(); }
  function toggle() {
    playing = !playing; play.textContent = playing ? "Pause" : "Play";
    if (playing) { if (frame === n - 1) { show(0); } last = performance.now(); requestAnimationFrame(tick); }
  }
  function tick(now) {
    if (!playing) { return; }
    progress += (now - last) / 1000 * data.fps / data.every * Number(element("speed").value); last = now;
    if (progress > n - 1) { progress = 0; }
    frame = Math.floor(progress); draw(); requestAnimationFrame(tick);
  }
  function zoom(by) { view.distance = Math.max(0.3, Math.min(60 * data.size, view.distance * by)); draw(); }
  let grip = null;
  canvas.addEventListener("pointerdown", (e) => {
    grip = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId);
  });
  canvas.addEventListener("pointerup", () => { grip = null; });
  canvas.addEventListener("pointercancel", () => { grip = null; });
  canvas.addEventListener("pointermove", (e) => {
    if (!grip) { return; }
    const dx = e.clientX - grip[0], dy = e.clientY - grip[1];
    grip = [e.clientX, e.clientY];
    if (e.shiftKey || (e.buttons & 6)) {
      const b = basis(), k = view.distance / eye.scale;
      view.shift = view.shift.map((v, a) => v - k * dx * b.right[a] + k * dy * b.up[a]);
    } else {
      view.yaw -= 0.008 * dx;
      view.pitch = Math.max(-1.55, Math.min(1.55, view.pitch + 0.008 * dy));
    }
    draw();
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp(0.0012 * e.deltaY));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => { e.preventDefault(); });
  element("viewer").addEventListener("keydown", (e) => {
    const inSelect = e.target.tagName === "SELECT", inButton = e.target.tagName === "BUTTON";
    if (inSelect) { return; }
    const step = e.shiftKey ? 10 : 1;
    if (e.key === "ArrowRight") { show(frame + step); }
    else if (e.key === "ArrowLeft") { show(frame - step); }
    else if (e.key === "Home") { show(0); } else if (e.key === "End") { show(n - 1); }
    else if (e.key === "ArrowUp") { zoom(0.9); } else if (e.key === "ArrowDown") { zoom(1.1); }
    else if (e.key === " " && !inButton && e.target.type !== "checkbox") { toggle(); } else { return; }
    e.preventDefault();
  });
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => { show(Number(slider.value)); });
  ["follow", "cameras", "labels"].forEach((name) => { element(name).addEventListener("change", draw); });
  element("reset").addEventListener("click", () => { reset(); draw(); });
  window.addEventListener("resize", draw);
  show(Math.floor(n / 2));
})();
"""
