"""What the page of adjustments looks like: its elements and their style."""

from __future__ import annotations

CSS = """
.nicegui-content { padding: 0; gap: 0; height: 100vh; }
body { background: #15181d; color: #e6e8eb; font: 13px/1.4 system-ui, "Segoe UI", Roboto, sans-serif; }
#adjust { display: grid; grid-template: 46px 1fr 26px / 1fr 330px; width: 100vw; height: 100vh; }
#adjust-bar { grid-column: 1 / 3; display: flex; align-items: center; gap: 6px; padding: 0 10px;
  background: #1f242c; border-bottom: 1px solid #2e3540; }
#adjust-bar .q-btn { color: #d5dae1; }
.adjust-run { font-weight: 600; max-width: 190px; overflow: hidden; text-overflow: ellipsis;
  white-space: nowrap; }
#adjust-slider { flex: 1; min-width: 80px; accent-color: #56b4e9; }
#adjust-frame { width: 58px; background: #12151a; color: inherit; border: 1px solid #3a424e;
  border-radius: 4px; padding: 2px 6px; text-align: right; font-variant-numeric: tabular-nums; }
.adjust-gap { width: 1px; height: 22px; background: #39414d; margin: 0 3px; }
#adjust-status { min-width: 150px; text-align: right; color: #9aa4b1; white-space: nowrap; }
#adjust-status.bad { color: #ff8a70; font-weight: 600; }
#adjust-views { display: grid; gap: 3px; padding: 3px; overflow: hidden; min-height: 0; min-width: 0; }
.adjust-view { position: relative; background: #0b0d10; overflow: hidden; min-height: 0; min-width: 0;
  border: 1px solid #262c35; border-radius: 3px; }
.adjust-view.active { border-color: #56b4e9; }
.adjust-view canvas { position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none; }
.adjust-name { position: absolute; left: 8px; top: 5px; font-weight: 600; color: #fff;
  text-shadow: 0 0 4px #000; pointer-events: none; }
#adjust-side { display: flex; flex-direction: column; min-height: 0; border-left: 1px solid #2e3540; }
#adjust-space { position: relative; flex: 0 0 42%; background: #0f1216; border-bottom: 1px solid #2e3540; }
#adjust-space canvas { position: absolute; inset: 0; width: 100%; height: 100%; cursor: grab;
  touch-action: none; }
#adjust-list { flex: 1; overflow-y: auto; min-height: 0; scrollbar-width: thin;
  scrollbar-color: #444c58 #15181d; }
#adjust-list table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
#adjust-list th { position: sticky; top: 0; background: #1f242c; color: #9aa4b1; font-weight: 500;
  text-align: right; padding: 3px 8px; }
#adjust-list td { padding: 1px 8px; text-align: right; cursor: pointer; white-space: nowrap; }
#adjust-list th:first-child, #adjust-list td:first-child { text-align: left; }
#adjust-list tr.chosen td { background: #2d4156; }
#adjust-list tr:hover td { background: #232a33; }
#adjust-list tr.chosen:hover td { background: #2d4156; }
#adjust-list .large { color: #ff9f7a; }
#adjust-list .moved { color: #f5a9d6; }
.adjust-dot { display: inline-block; width: 9px; height: 9px; border-radius: 50%; margin-right: 7px; }
#adjust-keys { grid-column: 1 / 3; background: #1f242c; color: #9aa4b1; padding: 3px 10px; font-size: 11.5px;
  white-space: nowrap; overflow: hidden; text-overflow: ellipsis; border-top: 1px solid #2e3540; }
#adjust-keys b { color: #d5dae1; font-weight: 600; }
#adjust-problem { position: fixed; left: 50%; top: 58px; transform: translateX(-50%); z-index: 50;
  display: none; max-width: 70vw; background: #7c2410; color: #fff; padding: 8px 14px; border-radius: 6px;
  white-space: pre-line; }
"""

VIEWS = """<div id="adjust-views"></div>"""
SIDE = """
<div id="adjust-side"><div id="adjust-space"><canvas></canvas><div class="adjust-name">3D</div></div>
<div id="adjust-list"><table><thead><tr><th>Marker</th><th>residual (px)</th><th>moved (cm)</th></tr></thead>
<tbody></tbody></table></div></div>
"""
KEYS = """
<div id="adjust-keys"><b>drag</b> in the image · <b>shift+drag</b>, <b>wheel</b> on it: depth ·
<b>wheel</b> beside: zoom · <b>double click</b>: put it there · <b>← → PgUp PgDn</b> · <b>Tab</b> marker ·
<b>N</b> large residual · <b>Ctrl Z Y</b> · <b>R</b> reset · <b>C</b> checked · <b>F</b> follow ·
<b>0</b> whole · <b>V</b> one view · <b>D</b> crosses</div><div id="adjust-problem"></div>
"""
FRAME = """<input id="adjust-frame" type="text" inputmode="numeric" aria-label="frame" title="Frame">"""
SLIDER = """<input id="adjust-slider" type="range" step="1" aria-label="frame" tabindex="-1">"""
STATUS = """<div id="adjust-status"></div>"""
