// The point cloud of the calibration page: it turns, zooms, and gives the point under the cursor.
// Drawn in software, point by point with a depth buffer: what can be seen can be picked, any
// laptop and remote desktop can do it, and 100,000 points take a few milliseconds.
// World: the frame of the lidar, m (x forward, y left, z up). View: x right, y down, z forward.

const CLICK = 4, REACH = 14, NEAR = 0.05; // px a click may wander; px from which a point is picked; m
const HIDDEN = [0.1, 0.005]; // m, and share of the depth: farther behind what is drawn, a point is hidden
const ALL_ROUND = 0.75; // length of the mean direction, below which a cloud surrounds the lidar
const MOVING = 400000; // points drawn while the view moves
const BACK = 0xff1c1815; // little endian: alpha, blue, green, red
const STOPS = { // colour maps: red, green, blue
  intensity: [[40, 30, 90], [60, 80, 170], [40, 150, 160], [90, 200, 110], [250, 230, 60], [255, 255, 240]],
  range: [[230, 60, 50], [245, 170, 50], [200, 230, 80], [70, 210, 140], [50, 150, 220], [110, 80, 200]],
  height: [[70, 60, 160], [50, 140, 190], [80, 190, 120], [220, 210, 80], [240, 130, 60], [240, 240, 240]],
};
const COLOURS = { used: "#ffd23f", open: "#4de1ff", dropped: "#9aa0a6", chosen: "#ff5d8f" };

const ends = (clip) => [clip?.min ?? -Infinity, clip?.max ?? Infinity];

export default {
  template: `<div class="pick-view cloud-view">
    <canvas ref="canvas" tabindex="0"
      aria-label="Point cloud. Click: pick. Drag: turn. Shift-drag: move. Wheel: zoom."></canvas>
    <div ref="readout" class="readout"></div><div v-if="!ready" class="waiting">loading the cloud …</div></div>`,
  props: { source: String, marks: Array, colour: String, range: Object, intensity: Object, size: Number },
  data: () => ({ ready: false }),
  mounted() {
    this.$el.view = this; // for tests, and for the curious
    const canvas = this.$refs.canvas;
    canvas.addEventListener("wheel", this.wheel, { passive: false });
    canvas.addEventListener("pointerdown", this.down);
    canvas.addEventListener("pointermove", this.move);
    canvas.addEventListener("pointerup", this.up);
    canvas.addEventListener("pointerleave", this.leave);
    canvas.addEventListener("pointerenter", this.enter);
    canvas.addEventListener("keydown", this.key);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    this.watcher = new ResizeObserver(() => this.resized());
    this.watcher.observe(this.$el);
    this.load();
  },
  beforeUnmount() {
    this.watcher.disconnect();
  },
  watch: {
    source() { this.load(); },
    marks: { handler() { this.redraw(); }, deep: true },
    colour() { this.paint(); },
    range: { handler() { this.choose(); }, deep: true },
    intensity: { handler() { this.choose(); }, deep: true },
    size() { this.redraw(); },
  },
  methods: {
    async load() { // xyz (k, 3), then intensity (k,): float32
      this.ready = false;
      this.xyz = null;
      const wanted = this.source;
      const numbers = new Float32Array(await (await fetch(wanted)).arrayBuffer());
      if (wanted !== this.source) { return; }
      this.count = numbers.length / 4;
      this.xyz = numbers.subarray(0, 3 * this.count);
      this.value = numbers.subarray(3 * this.count);
      this.distance = new Float32Array(this.count);
      for (let i = 0; i < this.count; i++) {
        this.distance[i] = Math.hypot(this.xyz[3 * i], this.xyz[3 * i + 1], this.xyz[3 * i + 2]);
      }
      this.screen = new Float32Array(3 * this.count); // x, y in px of the canvas and depth; depth 0: not drawn
      this.ready = true;
      this.choose();
      this.from_lidar();
    },
    choose() { // the points inside both clips
      if (!this.xyz) { return; }
      const [near, far] = ends(this.range), [dark, bright] = ends(this.intensity);
      const chosen = new Uint32Array(this.count);
      let n = 0;
      for (let i = 0; i < this.count; i++) {
        const d = this.distance[i], value = this.value[i];
        if (d >= near && d <= far && value >= dark && value <= bright) { chosen[n++] = i; }
      }
      this.chosen = chosen.subarray(0, n);
      this.paint();
    },
    paint() { // a colour for every chosen point, spread over the middle 96 % of their values
      if (!this.xyz) { return; }
      const kind = this.colour || "intensity", stops = STOPS[kind];
      const of = { intensity: (i) => this.value[i], range: (i) => this.distance[i], height: (i) => this.xyz[3 * i + 2] }[kind];
      const some = [], stride = Math.max(1, Math.floor(this.chosen.length / 5000));
      for (let k = 0; k < this.chosen.length; k += stride) { some.push(of(this.chosen[k])); }
      some.sort((a, b) => a - b);
      const low = some[Math.floor(0.02 * some.length)] || 0, high = some[Math.floor(0.98 * some.length)] || 1;
      const table = new Uint32Array(256);
      for (let k = 0; k < 256; k++) {
        const at = (k / 255) * (stops.length - 1), a = Math.min(stops.length - 2, Math.floor(at)), t = at - a;
        const [red, green, blue] = [0, 1, 2].map((c) => Math.round(stops[a][c] * (1 - t) + stops[a + 1][c] * t));
        table[k] = (255 << 24) | (blue << 16) | (green << 8) | red;
      }
      this.tint = new Uint32Array(this.count);
      const gain = 255 / (high - low || 1);
      for (const i of this.chosen) { this.tint[i] = table[Math.max(0, Math.min(255, Math.round((of(i) - low) * gain)))]; }
      this.redraw();
    },
    resized() {
      const canvas = this.$refs.canvas, ratio = window.devicePixelRatio || 1;
      canvas.width = Math.max(1, Math.round(this.$el.clientWidth * ratio));
      canvas.height = Math.max(1, Math.round(this.$el.clientHeight * ratio));
      this.picture = canvas.getContext("2d").createImageData(canvas.width, canvas.height);
      this.ink = new Uint32Array(this.picture.data.buffer);
      this.depth = new Float32Array(canvas.width * canvas.height);
      if (this.xyz && !this.moved_by_hand) { this.from_lidar(); } else { this.redraw(); }
    },
    // -- the view ---------------------------------------------------------------------------------------
    axes() { // rows: right, down, forward in the world
      const cy = Math.cos(this.yaw), sy = Math.sin(this.yaw), cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
      return [[sy, -cy, 0], [cy * sp, sy * sp, -cp], [cy * cp, sy * cp, sp]];
    },
    middle() { // median of the chosen points
      const stride = Math.max(1, Math.floor(this.chosen.length / 3000)), sides = [[], [], []];
      for (let k = 0; k < this.chosen.length; k += stride) {
        for (let c = 0; c < 3; c++) { sides[c].push(this.xyz[3 * this.chosen[k] + c]); }
      }
      return sides.map((side) => side.sort((a, b) => a - b)[side.length >> 1] ?? (0));
    },
    from_lidar() { // all of it; of a lidar that sees all round, what is before it
      let sum = [0, 0], n = 0;
      for (let k = 0; k < (this.chosen?.length || 0); k += Math.max(1, Math.floor(this.chosen.length / 5000))) {
        const [x, y] = this.xyz.subarray(3 * this.chosen[k], 3 * this.chosen[k] + 2), r = Math.hypot(x, y) || 1;
        sum = [sum[0] + x / r, sum[1] + y / r];
        n++;
      }
      this.look([0, 0, 0], false);
      if (n && Math.hypot(...sum) / n < ALL_ROUND) {
        const { width, height } = this.$refs.canvas;
        [this.yaw, this.pitch, this.focal, this.cx, this.cy] = [0, -0.03, 0.75 * width, width / 2, height / 2];
        this.redraw();
      }
    },
    from_above() {
      const [x, y, z] = this.middle(), away = Math.max(5, Math.hypot(x, y, z));
      this.yaw = Math.atan2(y, x);
      this.look([x, y, z + away], true);
    },
    from_side() {
      const [x, y, z] = this.middle(), away = Math.max(5, Math.hypot(x, y, z)), yaw = Math.atan2(y, x);
      this.look([x + away * Math.sin(yaw), y - away * Math.cos(yaw), z], false);
    },
    look(eye, down) { // at the middle, as large as fits the middle 96 % of the points
      if (!this.xyz || !this.chosen.length) { this.redraw(); return; }
      const at = this.middle(), d = [0, 1, 2].map((c) => at[c] - eye[c]);
      this.eye = eye;
      this.pivot = at;
      if (!down) { this.yaw = Math.atan2(d[1], d[0]); }
      this.pitch = down ? -Math.PI / 2 : Math.atan2(d[2], Math.hypot(d[0], d[1]));
      const rows = this.axes(), xs = [], ys = [], stride = Math.max(1, Math.floor(this.chosen.length / 5000));
      for (let k = 0; k < this.chosen.length; k += stride) {
        const i = 3 * this.chosen[k], p = [0, 1, 2].map((c) => this.xyz[i + c] - eye[c]);
        const [x, y, z] = rows.map((row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
        if (z > NEAR) { xs.push(x / z); ys.push(y / z); }
      }
      const ends = [xs, ys].map((side) => {
        side.sort((a, b) => a - b);
        return [side[Math.floor(0.02 * side.length)] ?? -0.5, side[Math.floor(0.98 * side.length)] ?? 0.5];
      });
      const { width, height } = this.$refs.canvas;
      const spans = ends.map(([a, b]) => Math.max(1e-3, b - a));
      this.focal = Math.min((0.9 * width) / spans[0], (0.9 * height) / spans[1], 2 * width / 0.05);
      this.cx = width / 2 - (this.focal * (ends[0][0] + ends[0][1])) / 2;
      this.cy = height / 2 - (this.focal * (ends[1][0] + ends[1][1])) / 2;
      this.moved_by_hand = false;
      this.redraw();
    },
    zoom(factor, x = this.$refs.canvas.width / 2, y = this.$refs.canvas.height / 2) {
      this.focal *= factor;
      this.cx = x - (x - this.cx) * factor;
      this.cy = y - (y - this.cy) * factor;
      this.moved_by_hand = true;
      this.redraw(true);
    },
    turn(dx, dy) { // about the pivot: it stays where it is in the view
      const before = this.axes();
      const arm = before.map((row) => row[0] * (this.pivot[0] - this.eye[0]) + row[1] * (this.pivot[1] - this.eye[1]) + row[2] * (this.pivot[2] - this.eye[2]));
      this.yaw += dx;
      this.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, this.pitch + dy));
      const after = this.axes();
      this.eye = [0, 1, 2].map((c) => this.pivot[c] - (after[0][c] * arm[0] + after[1][c] * arm[1] + after[2][c] * arm[2]));
      this.moved_by_hand = true;
      this.redraw(true);
    },
    project(x, y, z) { // canvas px and depth
      const rows = this.axes(), p = [x - this.eye[0], y - this.eye[1], z - this.eye[2]];
      const [right, down, forward] = rows.map((row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
      return [this.cx + (this.focal * right) / forward, this.cy + (this.focal * down) / forward, forward];
    },
    to_client(x, y, z) { // for tests: where a point is in the window
      const box = this.$refs.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
      const [px, py] = this.project(x, y, z);
      return [box.left + px / ratio, box.top + py / ratio];
    },
    show_point(x, y, z) { // bring it into the middle unless it can be seen
      const [px, py, depth] = this.project(x, y, z), { width, height } = this.$refs.canvas;
      if (depth > NEAR && px > 20 && py > 20 && px < width - 20 && py < height - 20) { return; }
      if (depth <= NEAR) { this.from_lidar(); return; }
      this.cx += width / 2 - px;
      this.cy += height / 2 - py;
      this.moved_by_hand = true;
      this.redraw();
    },
    // -- drawing ----------------------------------------------------------------------------------------
    redraw(moving = false) {
      this.moving = moving;
      if (this.pending) { return; }
      this.pending = true;
      requestAnimationFrame(() => {
        this.pending = false;
        if (!this.$refs.canvas || !this.xyz || !this.picture || !this.eye) { return; }
        const coarse = this.moving && this.chosen.length > MOVING;
        this.draw(coarse ? Math.ceil(this.chosen.length / MOVING) : 1);
        clearTimeout(this.later);
        if (coarse) { this.later = setTimeout(() => this.redraw(), 150); }
      });
    },
    draw(stride) {
      const { width, height } = this.$refs.canvas, pen = this.$refs.canvas.getContext("2d");
      const { xyz, ink, depth, screen, tint, chosen, focal, cx, cy } = this, [a, b, c] = this.axes(), [ex, ey, ez] = this.eye;
      const size = Math.max(1, Math.round((this.size || 2) * (window.devicePixelRatio || 1))), half = size >> 1;
      ink.fill(BACK);
      depth.fill(Infinity);
      screen.fill(0);
      for (let k = 0; k < chosen.length; k += stride) {
        const i = chosen[k], x = xyz[3 * i] - ex, y = xyz[3 * i + 1] - ey, z = xyz[3 * i + 2] - ez;
        const forward = c[0] * x + c[1] * y + c[2] * z;
        if (forward < NEAR) { continue; }
        const px = cx + (focal * (a[0] * x + a[1] * y + a[2] * z)) / forward;
        const py = cy + (focal * (b[0] * x + b[1] * y + b[2] * z)) / forward;
        if (!(px >= 0 && py >= 0 && px < width && py < height)) { continue; }
        screen[3 * i] = px;
        screen[3 * i + 1] = py;
        screen[3 * i + 2] = forward;
        const left = Math.max(0, (px | 0) - half), top = Math.max(0, (py | 0) - half);
        const right = Math.min(width, left + size), bottom = Math.min(height, top + size);
        for (let row = top; row < bottom; row++) {
          for (let at = row * width + left, end = row * width + right; at < end; at++) {
            if (forward < depth[at]) {
              depth[at] = forward;
              ink[at] = tint[i];
            }
          }
        }
      }
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.putImageData(this.picture, 0, 0);
      this.draw_marks(pen);
      this.draw_hover(pen);
    },
    draw_marks(pen) {
      const ratio = window.devicePixelRatio || 1;
      for (const mark of this.marks || []) {
        const [x, y, depth] = this.project(mark.x, mark.y, mark.z);
        if (depth < NEAR) { continue; }
        const colour = COLOURS[mark.chosen ? "chosen" : mark.state];
        for (const [width, ink] of [[4.5, "rgba(0,0,0,.7)"], [2, colour]]) {
          pen.strokeStyle = ink;
          pen.lineWidth = width * ratio;
          pen.beginPath();
          pen.arc(x, y, 7 * ratio, 0, 2 * Math.PI);
          pen.stroke();
        }
        pen.font = `600 ${13 * ratio}px system-ui, sans-serif`;
        pen.lineWidth = 3.5 * ratio;
        pen.strokeStyle = "rgba(0,0,0,.85)";
        pen.strokeText(mark.text, x + 10 * ratio, y - 8 * ratio);
        pen.fillStyle = colour;
        pen.fillText(mark.text, x + 10 * ratio, y - 8 * ratio);
      }
    },
    draw_hover(pen) {
      const ratio = window.devicePixelRatio || 1;
      const i = this.cursor && !this.grip?.dragged ? this.nearest(...this.cursor) : -1;
      this.$refs.canvas.style.cursor = this.grip?.dragged ? "grabbing" : i >= 0 ? "crosshair" : "grab";
      if (i < 0) {
        this.$refs.readout.textContent = `${this.chosen.length.toLocaleString("en-GB")} of ${this.count.toLocaleString("en-GB")} points`;
        return;
      }
      pen.strokeStyle = "#fff";
      pen.lineWidth = 1.5 * ratio;
      pen.beginPath();
      pen.arc(this.screen[3 * i], this.screen[3 * i + 1], 5 * ratio, 0, 2 * Math.PI);
      pen.stroke();
      const [x, y, z] = this.xyz.subarray(3 * i, 3 * i + 3);
      this.$refs.readout.textContent =
        `x ${x.toFixed(2)}  y ${y.toFixed(2)}  z ${z.toFixed(2)} m · range ${this.distance[i].toFixed(2)} m · intensity ${this.value[i].toFixed(this.value[i] % 1 ? 2 : 0)}`;
    },
    nearest(x, y) { // the point nearest in the view among those that nothing hides, or else of all; -1: none
      const reach = REACH * (window.devicePixelRatio || 1), { width } = this.$refs.canvas, { screen, depth } = this;
      let best = -1, least = reach * reach, any = -1, least_of_any = reach * reach;
      for (const i of this.chosen) {
        const z = screen[3 * i + 2];
        if (z === 0) { continue; }
        const px = screen[3 * i], py = screen[3 * i + 1], d = (px - x) ** 2 + (py - y) ** 2;
        if (d >= least_of_any && d >= least) { continue; }
        if (d < least_of_any) {
          any = i;
          least_of_any = d;
        }
        // a slanted surface lies a little before itself
        if (d < least && z <= depth[(py | 0) * width + (px | 0)] + HIDDEN[0] + HIDDEN[1] * z) {
          best = i;
          least = d;
        }
      }
      return best >= 0 ? best : any;
    },
    // -- hands ------------------------------------------------------------------------------------------
    place(event) {
      const box = this.$refs.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
      return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
    },
    wheel(event) {
      event.preventDefault();
      if (this.xyz) { this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...this.place(event)); }
    },
    down(event) {
      if (!this.xyz) { return; }
      this.$refs.canvas.focus();
      this.$refs.canvas.setPointerCapture(event.pointerId);
      const at = this.place(event), i = this.nearest(...at);
      if (i >= 0) { this.pivot = Array.from(this.xyz.subarray(3 * i, 3 * i + 3)); }
      this.grip = { from: at, last: at, dragged: false, button: event.button, shift: event.shiftKey };
    },
    move(event) {
      this.cursor = this.place(event);
      const grip = this.grip;
      if (grip) {
        grip.dragged ||= Math.hypot(this.cursor[0] - grip.from[0], this.cursor[1] - grip.from[1]) > CLICK;
        if (grip.dragged) {
          const dx = this.cursor[0] - grip.last[0], dy = this.cursor[1] - grip.last[1];
          grip.last = this.cursor;
          if (grip.shift || grip.button) {
            this.cx += dx;
            this.cy += dy;
            this.moved_by_hand = true;
          } else {
            const speed = 3 / Math.max(300, this.$refs.canvas.height);
            this.turn(-dx * speed, -dy * speed);
          }
        }
      }
      this.redraw(Boolean(grip?.dragged));
    },
    up(event) {
      const grip = this.grip;
      this.grip = null;
      if (grip && !grip.dragged && grip.button === 0) {
        const i = this.nearest(...this.place(event));
        if (i >= 0) { this.$emit("pick", { index: i }); }
      }
      this.redraw();
    },
    enter() { // keys go to the view under the cursor, unless somebody is typing
      const active = document.activeElement;
      if (!active || !["INPUT", "TEXTAREA", "SELECT"].includes(active.tagName)) {
        this.$refs.canvas.focus({ preventScroll: true });
      }
    },
    key(event) {
      const zooms = { "+": 1.25, "=": 1.25, "-": 0.8 };
      if (event.ctrlKey || event.metaKey || event.altKey) { return; }
      if (zooms[event.key]) { this.zoom(zooms[event.key], ...(this.cursor || [])); }
      if (event.key === "0") { this.from_lidar(); }
    },
    leave() {
      this.cursor = null;
      this.redraw();
    },
  },
};
