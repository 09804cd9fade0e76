"""The 3D view beside the images: the skeleton on a grid, turned with the mouse; no library, no WebGL."""

from __future__ import annotations

SPACE = r"""
// --- the 3D view: orthographic, world z up ---
const space = (() => {
  let yaw = -0.9, pitch = 0.35, scale = 0, grip = null;
  const canvas = () => document.querySelector('#adjust-space canvas');
  function middle() {
    const known = data.xyz.filter((p) => p);
    if (!known.length) return [[0, 0, 0], 1];
    const low = [0, 1, 2].map((k) => Math.min(...known.map((p) => p[k])));
    const high = [0, 1, 2].map((k) => Math.max(...known.map((p) => p[k])));
    return [low.map((v, k) => (v + high[k]) / 2), Math.max(0.3, ...low.map((v, k) => high[k] - v)), low[2]];
  }
  function draw() {
    const c = canvas();
    if (!data || !c) return;
    const g = context(c), w = c.clientWidth, h = c.clientHeight, [at, size, floor] = middle();
    if (!scale) scale = 0.62 * Math.min(w, h) / size;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const flat = (p) => {
      if (!p) return null;
      const [x, y, z] = p.map((v, k) => v - at[k]), a = cy * x + sy * y, b = -sy * x + cy * y;
      return [w / 2 + scale * a, h / 2 - scale * (cp * z + sp * b)];
    };
    ground(g, flat, at, size, floor === undefined ? 0 : Math.abs(floor) < 0.3 ? 0 : floor);
    const now = data.xyz.map(flat), before = data.xyz_before.map(flat);
    ray(g, flat);
    bones(g, before, 'rgba(210,210,210,.35)', 1, (a, b) => data.moved[a] !== null || data.moved[b] !== null);
    bones(g, now, null, 2);
    now.forEach((p, m) => {
      if (!p) return;
      g.beginPath(); g.arc(p[0], p[1], m === marker ? 4.5 : 2.8, 0, 7);
      g.fillStyle = data.moved[m] === null ? COLOURS[about.sides[m]] : '#ff7ac8'; g.fill();
      if (m === marker) { g.strokeStyle = '#fff'; g.lineWidth = 1.6; g.stroke(); }
    });
    axes(g, h, cy, sy, cp, sp);
  }
  function ground(g, flat, at, size, z) {
    const step = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10].find((k) => size / k < 6) || 20, n = 6;
    const [x0, y0] = [0, 1].map((k) => Math.round(at[k] / step) * step);
    g.strokeStyle = 'rgba(140,155,175,.22)'; g.lineWidth = 1;
    for (let i = -n; i <= n; i++) {
      for (const [a, b] of [[[x0 + i * step, y0 - n * step, z], [x0 + i * step, y0 + n * step, z]],
        [[x0 - n * step, y0 + i * step, z], [x0 + n * step, y0 + i * step, z]]]) {
        g.beginPath(); g.moveTo(...flat(a)); g.lineTo(...flat(b)); g.stroke();
      }
    }
    g.fillStyle = '#7d8896'; g.font = '11px system-ui, sans-serif';
    const { clientWidth: w, clientHeight: h } = canvas(), text = `grid ${step} m`;
    g.fillText(text, w - g.measureText(text).width - 8, h - 8);
  }
  function ray(g, flat) {  // of the active view, through the marker
    const p = data.xyz[marker], c = data.centres[active];
    if (!p || !c) return;
    const d = Math.hypot(...p.map((v, k) => v - c[k])), reach = Math.min(0.9, 0.8 * d);
    const end = (s) => flat(p.map((v, k) => v + s * reach * (v - c[k]) / d));
    g.strokeStyle = 'rgba(255,225,77,.75)'; g.lineWidth = 1; g.setLineDash([4, 3]);
    g.beginPath(); g.moveTo(...end(-1)); g.lineTo(...end(1)); g.stroke(); g.setLineDash([]);
  }
  function axes(g, h, cy, sy, cp, sp) {
    const o = [30, h - 26], l = 20;
    const three = [['x', 1, 0, 0, '#e06c6c'], ['y', 0, 1, 0, '#7fc97f'], ['z', 0, 0, 1, '#7fa8e8']];
    for (const [name, x, y, z, colour] of three) {
      const e = [o[0] + l * (cy * x + sy * y), o[1] - l * (cp * z + sp * (-sy * x + cy * y))];
      g.strokeStyle = g.fillStyle = colour; g.lineWidth = 1.5;
      g.beginPath(); g.moveTo(...o); g.lineTo(...e); g.stroke();
      g.font = '10px system-ui, sans-serif'; g.fillText(name, e[0] + 3, e[1] + 3);
    }
  }
  function listen() {
    const c = canvas();
    c.addEventListener('pointerdown', (e) => {
      grip = [e.offsetX, e.offsetY, yaw, pitch];
      c.setPointerCapture(e.pointerId);
    });
    c.addEventListener('pointermove', (e) => {
      if (!grip) return;
      yaw = grip[2] - (e.offsetX - grip[0]) * 0.01;
      pitch = Math.max(-1.57, Math.min(1.57, grip[3] + (e.offsetY - grip[1]) * 0.01));
      draw();
    });
    c.addEventListener('pointerup', () => { grip = null; });
    c.addEventListener('dblclick', () => { scale = 0; draw(); });
    c.addEventListener('wheel', (e) => {
      e.preventDefault();
      scale *= Math.exp(-Math.max(-300, Math.min(300, e.deltaY)) * 0.0016);
      draw();
    }, { passive: false });
  }
  return { draw, listen, get angles() { return [yaw, pitch]; } };
})();
"""
