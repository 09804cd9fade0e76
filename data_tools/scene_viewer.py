"""The 3D viewer of a report, as text: tracks, cameras and a point cloud that turn under the mouse.

Matchings and scenes share it. It needs no network. What it shows is JSON in the element ``data``
(:func:`acino_fte.data_tools.page_parts.script_json`, which packs arrays):

==================  ========================================================================================
tracks              pieces: group, frames (n,), xyz (n, 3), style (``-``; ``--`` or ``:`` for less certain)
colours, names      of the groups; without names their numbers are shown
cameras             name, aspect (height / width), frames (k,), pose (k, 12): centre, right, down, forward; a
                    camera with one pose stands still
cloud               xyz (q, 3) and rgb (q, 3) or null; null without a cloud
first, last, fps    frames of the slider, included; fps may be null
grid                x0, x1, y0, y1, step, z
middle, size        of the scene
frustum             length of the cameras' frusta; without it a share of the size
==================  ========================================================================================
"""

from __future__ import annotations

VIEWER = """
<div id="viewer">
<canvas id="scene" tabindex="0" aria-label="Tracks in three dimensions. Drag to turn, wheel to zoom,
arrow keys to step, space to play."></canvas>
<div class="keys">drag: turn · shift-drag: move · wheel: zoom · ← →: step · space: play<br>
grid: @grid@</div>
<div class="controls">
<button id="play" type="button">Play</button>
<input id="slider" type="range" min="0" value="0" aria-label="Frame">
<output id="clock"></output>
<label>Speed <select id="speed"><option value="0.25">1/4</option><option value="1" selected>1</option>
<option value="4">4</option><option value="16">16</option></select></label>
<label>Trail <select id="trail"><option value="15">15 frames</option><option value="60">60</option>
<option value="300">300</option><option value="1e9" selected>all</option></select></label>
<label><input id="follow" type="checkbox"> follow</label>
<label><input id="cameras" type="checkbox" checked> cameras</label>
@cloud@<label><input id="labels" type="checkbox"> names</label>
<button id="reset" type="button">Reset view</button>
</div>
</div>
"""

CLOUD = """<label><input id="cloud" type="checkbox" checked> cloud</label>
"""


def viewer_html(grid: str, cloud: bool = False) -> str:
    """The viewer's elements.

    Parameters
    ----------
    grid : str
        The width of the grid's meshes, with its unit.
    cloud : bool
        Whether there is a cloud to switch on and off.
    """
    return VIEWER.replace("@grid@", grid).replace("@cloud@", CLOUD if cloud else "")


SCRIPT = """
"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent, unpack);
  const canvas = document.getElementById("scene");
  if (!canvas) { return; }
  const pen = canvas.getContext("2d");
  const element = (name) => document.getElementById(name);
  const slider = element("slider"), clock = element("clock"), play = element("play");
  const ticked = (name) => { const box = element(name); return box !== null && box.checked; };
  slider.min = data.first; slider.max = data.last;
  let frame = data.last, playing = false, begun = 0, from = 0, view, eye;
  const clouds = shades();
  function unpack(key, value) {
    if (!value || typeof value.packed !== "string") { return value; }
    const bytes = Uint8Array.from(atob(value.packed), (letter) => letter.charCodeAt(0));
    const kinds = { f4: Float32Array, i4: Int32Array, u1: Uint8Array };
    return new kinds[value.type](bytes.buffer);
  }
  function shades() {  // the cloud's points by colour, a few tones each, as drawing wants them
    if (!data.cloud) { return []; }
    const groups = new Map(), rgb = data.cloud.rgb;
    for (let i = 0; 3 * i < data.cloud.xyz.length; i += 1) {
      const tone = rgb ? [0, 1, 2].map((a) => 32 * (rgb[3 * i + a] >> 5) + 16).join(",") : "150,150,150";
      if (!groups.has(tone)) { groups.set(tone, []); }
      groups.get(tone).push(i);
    }
    return Array.from(groups, ([tone, points]) => ["rgb(" + tone + ")", points]);
  }
  function reset() {
    view = { yaw: -1.05, pitch: 0.42, distance: 1.1 * data.size, target: data.middle.slice() };
  }
  reset();
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const at = (xyz, i) => [xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]];
  function upto(frames, value) {  // how many of the rising frames are not after the value
    let low = 0, high = frames.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (frames[middle] <= value) { low = middle + 1; } else { high = middle; }
    }
    return low;
  }
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
  function trace(count, point, colour, width, style) {
    pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
    pen.setLineDash(style === "--" ? [4, 3] : style === ":" ? [1, 3] : []);
    let down = false;
    for (let i = 0; i < count; i += 1) {
      const a = project(point(i));
      if (a && down) { pen.lineTo(a[0], a[1]); } else if (a) { pen.moveTo(a[0], a[1]); }
      down = a !== null;
    }
    pen.stroke();
  }
  const path = (points, colour, width) => trace(points.length, (i) => points[i], colour, width, "-");
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
    const s = data.frustum || 0.06 * data.size;
    data.cameras.forEach((camera) => {
      const poses = camera.pose, n = camera.frames.length, still = n === 1;
      if (!still) {
        let first = 0;  // not joined where the pose is not known
        for (let i = 1; i <= n; i += 1) {
          if (i < n && camera.frames[i] - camera.frames[i - 1] <= camera.every) { continue; }
          const from = first;
          trace(i - from, (k) => poses.subarray(12 * (from + k), 12 * (from + k) + 3), "#b5b5b5", 0.7, "-");
          first = i;
        }
      }
      const now = still ? 0 : Math.max(upto(camera.frames, frame) - 1, 0);
      if (!still && Math.abs(camera.frames[now] - frame) > camera.every) { return; }
      const pose = poses.subarray(12 * now, 12 * now + 12);
      const c = at(pose, 0), r = at(pose, 1), d = at(pose, 2), f = at(pose, 3);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((k) =>
        c.map((v, a) => v + s * (f[a] + 0.6 * k[0] * r[a] + 0.6 * camera.aspect * k[1] * d[a])));
      corners.forEach((q, i) => { path([c, q, corners[(i + 1) % 4]], "#777777", 1); });
      text(c, camera.name, "#555555");
    });
  }
  function cloud() {
    const xyz = data.cloud.xyz;
    clouds.forEach(([colour, points]) => {
      pen.fillStyle = colour;
      points.forEach((i) => {
        const a = project(at(xyz, i));
        if (a) { pen.fillRect(a[0], a[1], 1.4, 1.4); }
      });
    });
  }
  function follow() {
    const here = [];
    data.tracks.forEach((track) => {
      const i = upto(track.frames, frame) - 1;
      if (i >= 0 && track.frames[i] === frame) { here.push(at(track.xyz, i)); }
    });
    if (here.length) {
      view.target = [0, 1, 2].map((a) => here.reduce((sum, p) => sum + p[a], 0) / here.length);
    }
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    pen.lineJoin = "round"; pen.font = "12px system-ui, sans-serif";
    if (ticked("follow")) { follow(); }
    look(); ground();
    if (ticked("cloud")) { cloud(); }
    if (ticked("cameras")) { cameras(); }
    const trail = Number(element("trail").value), names = ticked("labels");
    data.tracks.forEach((track) => {
      const frames = track.frames, stop = upto(frames, frame), start = upto(frames, frame - trail - 1);
      if (start >= stop) { return; }
      const colour = data.colours[track.group], width = track.style === "-" ? 1.4 : 1;
      trace(stop - start, (i) => at(track.xyz, start + i), colour, width, track.style);
      const there = frames[frames.length - 1] >= frame, last = at(track.xyz, stop - 1);
      const a = there ? project(last) : null;
      if (a) { pen.beginPath(); pen.arc(a[0], a[1], 3.2, 0, 7); pen.fillStyle = colour; pen.fill(); }
      if (a && names) { text(last, data.names ? data.names[track.group] : String(track.group), "#333333"); }
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
    const rate = Math.min(data.fps || 30, 60) * Number(element("speed").value);
    show(from + Math.floor((now - begun) / 1000 * rate));
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
  ["trail", "follow", "cameras", "cloud", "labels"].forEach((name) => {
    if (element(name)) { element(name).addEventListener("change", draw); }
  });
  element("speed").addEventListener("change", () => { begun = performance.now(); from = frame; });
  element("reset").addEventListener("click", () => { reset(); draw(); });
  window.addEventListener("resize", draw);
  draw();
})();
"""
