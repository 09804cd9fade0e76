"""The list of markers, the bar and the keyboard of the page of adjustments."""

from __future__ import annotations

CONTROLS = r"""
// --- list, bar, keyboard ---
function makeList() {
  const body = document.querySelector('#adjust-list tbody');
  body.replaceChildren(...about.markers.map((name, m) => {
    const row = document.createElement('tr');
    row.innerHTML = '<td><span class="adjust-dot"></span><span></span></td><td></td><td></td>';
    row.querySelector('.adjust-dot').style.background = COLOURS[about.sides[m]];
    row.querySelector('td span:last-child').textContent = name;
    row.dataset.marker = name;
    row.onclick = () => select(m);
    return row;
  }));
}
function refreshList() {
  document.querySelectorAll('#adjust-list tbody tr').forEach((row, m) => {
    const r = data.residual[m], d = data.moved[m], cells = row.children;
    cells[1].textContent = r === null ? (data.xyz[m] ? '–' : 'no position') : r.toFixed(1);
    cells[1].className = r !== null && r > about.large ? 'large' : '';
    cells[2].textContent = d === null ? '' : d < 0 ? 'placed' : (100 * d).toFixed(1);
    cells[2].className = 'moved';
    row.classList.toggle('chosen', m === marker);
  });
}
function select(m) {
  marker = (m + about.markers.length) % about.markers.length;
  if (!data) return;
  refreshList(); draw(); space.draw();
  reveal();
}
function reveal() {  // the chosen row of the list
  document.querySelectorAll('#adjust-list tbody tr')[marker].scrollIntoView({ block: 'nearest' });
}
function refreshBar() {
  by('adjust-slider').value = wanted;
  if (document.activeElement !== by('adjust-frame')) by('adjust-frame').value = wanted;
  const status = by('adjust-status');
  status.textContent = `${data.n_adjusted} adjusted · ${data.n_checked} checked · ` +
    (data.problem ? 'NOT SAVED' : 'saved');
  status.classList.toggle('bad', !!data.problem);
  const problem = by('adjust-problem');
  problem.textContent = data.problem; problem.style.display = data.problem ? 'block' : 'none';
  document.querySelector('.adjust-undo').classList.toggle('disabled', !data.undo);
  document.querySelector('.adjust-redo').classList.toggle('disabled', !data.redo);
  document.querySelector('.adjust-check').classList.toggle('text-positive', data.checked);
}
function act(what) {
  if (document.activeElement && document.activeElement !== document.body) document.activeElement.blur();
  if (!data) return;
  tell({ do: what, frame: data.frame, marker: about.markers[marker] });
}
function step(k) { go(wanted + k); }
function zoomActive(by_) {
  const v = views[active];
  zoom(v, v.box.clientWidth / 2, v.box.clientHeight / 2, by_);
}
const KEYS = {
  ArrowRight: () => step(1), ArrowLeft: () => step(-1), PageDown: () => step(10), PageUp: () => step(-10),
  Home: () => go(about.frames[0]), End: () => go(about.frames[1]),
  n: () => act('next'), N: () => act('previous'), r: () => act('reset'), Delete: () => act('reset'),
  c: () => act('check'), f: followAll, 0: resetZoom, '+': () => zoomActive(1.25), '-': () => zoomActive(0.8),
  v: () => { solo = !solo; arrange(); },
  d: () => { shown.detections = !shown.detections; draw(); },
};
function key(e) {
  const box = by('adjust-frame');
  if (e.target === box) { if (e.key === 'Escape') { box.value = wanted; box.blur(); } return; }
  if (e.key === 'Tab') { e.preventDefault(); select(marker + (e.shiftKey ? -1 : 1)); return; }
  const letter = e.key.toLowerCase();
  if (e.ctrlKey || e.metaKey) {
    if (letter === 'z') { e.preventDefault(); act(e.shiftKey ? 'redo' : 'undo'); }
    if (letter === 'y') { e.preventDefault(); act('redo'); }
    return;
  }
  const action = KEYS[e.key];
  if (action && !e.altKey) { e.preventDefault(); action(); }
}
function where(name, m) {  // for tests: where a marker is on the screen
  const v = views.find((x) => x.name === name), p = data.now[v.i][m];
  if (!p) return null;
  const [x, y] = toCanvas(v, p), r = v.canvas.getBoundingClientRect();
  return [r.left + x, r.top + y];
}
return { start, receive, dragged, stale, step, go, act, resetZoom, followAll, where,
  get data() { return data; }, get wanted() { return wanted; },
  get marker() { return about.markers[marker]; } };
"""
