"""The 3D viewer of a matching's report, as text: tracks that turn under the mouse. Needs no network."""

from __future__ import annotations

VIEWER = """
<div id="viewer">
<canvas id="scene" tabindex="0" aria-label="Tracks in three dimensions. Drag to turn, wheel to zoom,
arrow keys to step, space to play."></canvas>
<div class="keys">drag: turn · shift-drag: move · wheel: zoom · ← →: step · space: play<br>
grid: @grid@ m</div>
<div class="controls">
<button id="play" type="button">Play</button>
<input id="slider" type="range" min="0" value="0" aria-label="Frame">
<output id="clock"></output>
<label>Trail <select id="trail"><option value="15">15 frames</option><option value="60">60</option>
<option value="300">300</option><option value="1e9" selected>all</option></select></label>
<label><input id="cameras" type="checkbox" checked> cameras</label>
<label><input id="labels" type="checkbox"> numbers</label>
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
  slider.min = data.first; slider.max = data.last;
  let frame = data.last, playing = false, begun = 0, from = 0, view, eye;
  function reset() {
    view = { yaw: -1.05, pitch: 0.42, distance: 1.1 * data.size, target: data.middle.slice() };
  }
  reset();
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  function look() {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw);
    const cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const back = [cy * cp, sy * cp, sp];
    eye = { back: back, right: [-sy, cy, 0], up: [-cy * sp, -sy * sp, cp],
      at: view.target.map((v, a) => v + view.distance * back[a]), scale: 1.2 * canvas.clientHeight };
  }
  function project(p) {
    const d = [p[0] - eye.at[0], p[1] - eye.at[1], p[2] - eye.at[2]], depth = -dot(d, eye.back);
    if (depth < 0.01 * data.size) { return null; }
    const k = eye.scale / depth;
    return [canvas.clientWidth / 2 + k * dot(d, eye.right), canvas.clientHeight / 2 - k * dot(d, eye.up)];
  }
  function path(points, colour, width) {
    pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
    let down = false;
    points.forEach((p) => {
      const a = project(p);
      if (a && down) { pen.lineTo(a[0], a[1]); } else if (a) { pen.moveTo(a[0], a[1]); }
      down = a !== null;
    });
    pen.stroke();
  }
  function text(p, words, colour) {
    const a = project(p);
    if (a) { pen.fillStyle = colour; pen.fillText(words, a[0] + 5, a[1] - 4); }
  }
  function ground() {
    const g = data.grid, z = g.z;
    for (let x = g.x0; x <= g.x1 + 1e-9; x += g.step) { path([[x, g.y0, z], [x, g.y1, z]], "#dddddd", 1); }
    for (let y = g.y0; y <= g.y1 + 1e-9; y += g.step) { path([[g.x0, y, z], [g.x1, y, z]], "#dddddd", 1); }
    const o = [g.x0, g.y0, z];
    ["x", "y", "z"].forEach((name, a) => {
      const tip = o.map((v, i) => v + (i === a ? g.step : 0));
      path([o, tip], "#777777", 2); text(tip, name, "#777777");
    });
  }
  function cameras() {
    const s = 0.06 * data.size;
    data.cameras.forEach((camera) => {
      const c = camera.pose.slice(0, 3), r = camera.pose.slice(3, 6), d = camera.pose.slice(6, 9);
      const f = camera.pose.slice(9, 12);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((k) =>
        c.map((v, a) => v + s * (f[a] + 0.6 * k[0] * r[a] + 0.6 * camera.aspect * k[1] * d[a])));
      corners.forEach((q, i) => { path([c, q, corners[(i + 1) % 4]], "#999999", 1); });
      text(c, camera.name, "#666666");
    });
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    pen.lineJoin = "round"; pen.font = "12px system-ui, sans-serif";
    look(); ground();
    if (element("cameras").checked) { cameras(); }
    const trail = Number(element("trail").value), numbers = element("labels").checked;
    data.tracks.forEach((track) => {
      if (track.frames[0] > frame) { return; }
      let stop = 0;
      while (stop < track.frames.length && track.frames[stop] <= frame) { stop += 1; }
      let start = 0;
      while (start < stop && track.frames[start] < frame - trail) { start += 1; }
      const shown = track.xyz.slice(start, stop);
      if (!shown.length) { return; }
      const colour = data.colours[track.group];
      path(shown, colour, 1.4);
      const there = track.frames[track.frames.length - 1] >= frame, last = shown[shown.length - 1];
      const a = there ? project(last) : null;
      if (a) { pen.beginPath(); pen.arc(a[0], a[1], 3.2, 0, 7); pen.fillStyle = colour; pen.fill(); }
      if (a && numbers) { text(last, String(track.group), "#333333"); }
    });
    slider.value = frame;
    clock.textContent = "frame " + frame + (data.fps ? " · " + (frame / data.fps).toFixed(3) + " s" : "");
  }
  function show(f) { frame = Math.max(data.first, Math.min(data.last, f)); draw(); }
  function toggle() {
    playing = !playing; play.textContent = playing ? "Pause" : "Play";
    if (!playing) { return; }
    if (frame >= data.last) { frame = data.first; }
    begun = performance.now(); from = frame; requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!playing) { return; }
    show(from + Math.floor((now - begun) / 1000 * Math.min(data.fps || 30, 60)));
    if (frame >= data.last) { toggle(); } else { requestAnimationFrame(tick); }
  }
  function zoom(by) {
    view.distance = Math.max(0.02 * data.size, Math.min(30 * data.size, view.distance * by)); draw();
  }
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
      const k = view.distance / eye.scale;
      view.target = view.target.map((v, a) => v - k * dx * eye.right[a] + k * dy * eye.up[a]);
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
    if (e.target.tagName === "SELECT") { return; }
    const step = e.shiftKey ? 10 : 1, inButton = e.target.tagName === "BUTTON";
    if (e.key === "ArrowRight") { show(frame + step); }
    else if (e.key === "ArrowLeft") { show(frame - step); }
    else if (e.key === "Home") { show(data.first); } else if (e.key === "End") { show(data.last); }
    else if (e.key === "ArrowUp") { zoom(0.9); } else if (e.key === "ArrowDown") { zoom(1.1); }
    else if (e.key === " " && !inButton && e.target.type !== "checkbox") { toggle(); } else { return; }
    e.preventDefault();
  });
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => { show(Number(slider.value)); });
  ["trail", "cameras", "labels"].forEach((name) => { element(name).addEventListener("change", draw); });
  element("reset").addEventListener("click", () => { reset(); draw(); });
  window.addEventListener("resize", draw);
  draw();
})();
"""
