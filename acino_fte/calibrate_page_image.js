// The image of the calibration page: zoom, pan, a loupe, numbered picks, residuals and the projected cloud.
// Pixel centres are at integers: the pixel (u, v) covers [u - 0.5, u + 0.5) on both axes.

const LOUPE = 168, MAGNIFIED = 8, CLICK = 4; // px of the loupe, its magnification, px that a click may wander
const COLOURS = { used: "#ffd23f", open: "#4de1ff", dropped: "#9aa0a6", chosen: "#ff5d8f", projected: "#7dff8a" };

export default {
  template: `<div class="pick-view image-view">
    <canvas ref="canvas" tabindex="0" aria-label="Image. Click: pick. Drag: move. Wheel: zoom."></canvas>
    <canvas ref="loupe" class="loupe" width="${LOUPE}" height="${LOUPE}"></canvas>
    <div ref="readout" class="readout"></div><div v-if="!ready" class="waiting">loading the image …</div></div>`,
  props: { source: String, marks: Array, overlay: Object, dim: Boolean },
  data: () => ({ ready: false }),
  mounted() {
    this.scale = 1;
    this.x0 = this.y0 = 0; // of the image's corner in the canvas, CSS px
    this.cursor = null;
    this.$el.view = this; // for tests, and for the curious
    const canvas = this.$refs.canvas;
    canvas.addEventListener("wheel", this.wheel, { passive: false });
    canvas.addEventListener("pointerdown", this.down);
    canvas.addEventListener("pointermove", this.move);
    canvas.addEventListener("pointerup", this.up);
    canvas.addEventListener("pointerleave", this.leave);
    canvas.addEventListener("pointerenter", this.enter);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", this.key);
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
    overlay() { this.load_overlay(); },
    dim() { this.redraw(); },
  },
  methods: {
    load() {
      this.ready = false;
      const picture = new Image();
      picture.onload = () => {
        if (picture.src.endsWith(this.source)) {
          this.picture = picture;
          this.ready = true;
          this.fit();
          this.load_overlay();
        }
      };
      picture.onerror = () => this.$emit("failed", "The image cannot be shown by this browser.");
      picture.src = this.source;
    },
    async load_overlay() { // pixels (k, 2) and range (k,), float32; then drawn once, and again when it zooms
      const wanted = this.overlay?.source;
      this.dots = null;
      if (wanted) {
        const numbers = new Float32Array(await (await fetch(wanted)).arrayBuffer());
        if (wanted !== this.overlay?.source) { return; }
        this.dots = numbers;
      }
      this.redraw();
    },
    resized() {
      const canvas = this.$refs.canvas, ratio = window.devicePixelRatio || 1;
      canvas.width = Math.round(this.$el.clientWidth * ratio);
      canvas.height = Math.round(this.$el.clientHeight * ratio);
      if (!this.moved_by_hand) { this.fit(); } else { this.redraw(); }
    },
    fit() {
      if (!this.picture) { return; }
      const { clientWidth: w, clientHeight: h } = this.$el, { naturalWidth: W, naturalHeight: H } = this.picture;
      this.scale = Math.min(w / W, h / H);
      this.x0 = (w - W * this.scale) / 2;
      this.y0 = (h - H * this.scale) / 2;
      this.moved_by_hand = false;
      this.redraw();
    },
    zoom(factor, x = this.$el.clientWidth / 2, y = this.$el.clientHeight / 2) {
      const least = 0.5 * Math.min(this.$el.clientWidth / this.picture.naturalWidth, 1);
      const scale = Math.min(64, Math.max(least, this.scale * factor));
      this.x0 = x - (x - this.x0) * (scale / this.scale);
      this.y0 = y - (y - this.y0) * (scale / this.scale);
      this.scale = scale;
      this.moved_by_hand = true;
      this.redraw();
    },
    show_pixel(u, v) { // bring it into the middle unless it can be seen
      const [x, y] = this.to_view(u, v), { clientWidth: w, clientHeight: h } = this.$el;
      if (x > 20 && y > 20 && x < w - 20 && y < h - 20) { return; }
      this.x0 += w / 2 - x;
      this.y0 += h / 2 - y;
      this.moved_by_hand = true;
      this.redraw();
    },
    to_view(u, v) { return [this.x0 + (u + 0.5) * this.scale, this.y0 + (v + 0.5) * this.scale]; },
    to_pixel(x, y) { return [(x - this.x0) / this.scale - 0.5, (y - this.y0) / this.scale - 0.5]; },
    to_client(u, v) { // for tests: where a pixel is in the window
      const box = this.$refs.canvas.getBoundingClientRect(), [x, y] = this.to_view(u, v);
      return [box.left + x, box.top + y];
    },
    pixel_at(x, y) { // the other way
      const box = this.$refs.canvas.getBoundingClientRect();
      return this.to_pixel(x - box.left, y - box.top);
    },
    inside(u, v) {
      return u >= -0.5 && v >= -0.5 && u < this.picture.naturalWidth - 0.5 && v < this.picture.naturalHeight - 0.5;
    },
    place(event) {
      const box = this.$refs.canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    },
    wheel(event) {
      event.preventDefault();
      if (this.picture) { this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...this.place(event)); }
    },
    down(event) {
      this.$refs.canvas.focus();
      this.$refs.canvas.setPointerCapture(event.pointerId);
      this.grip = { from: this.place(event), x0: this.x0, y0: this.y0, dragged: false, button: event.button };
    },
    move(event) {
      this.cursor = this.place(event);
      const grip = this.grip;
      if (grip) {
        const dx = this.cursor[0] - grip.from[0], dy = this.cursor[1] - grip.from[1];
        grip.dragged ||= Math.hypot(dx, dy) > CLICK;
        if (grip.dragged) {
          this.x0 = grip.x0 + dx;
          this.y0 = grip.y0 + dy;
          this.moved_by_hand = true;
        }
      }
      this.$refs.canvas.style.cursor = grip?.dragged ? "grabbing" : "crosshair";
      this.redraw();
    },
    up(event) {
      const grip = this.grip;
      this.grip = null;
      if (grip && !grip.dragged && grip.button === 0 && this.picture) {
        const [u, v] = this.to_pixel(...this.place(event));
        if (this.inside(u, v)) { this.$emit("pick", { u, v }); }
      }
      this.redraw();
    },
    enter() { // keys go to the view under the cursor, unless somebody is typing
      const active = document.activeElement;
      if (!active || !["INPUT", "TEXTAREA", "SELECT"].includes(active.tagName)) {
        this.$refs.canvas.focus({ preventScroll: true });
      }
    },
    leave() {
      this.cursor = null;
      this.redraw();
    },
    key(event) {
      const zooms = { "+": 1.25, "=": 1.25, "-": 0.8 };
      if (event.ctrlKey || event.metaKey || event.altKey) { return; }
      if (zooms[event.key]) { this.zoom(zooms[event.key], ...(this.cursor || [])); }
      if (event.key === "0") { this.fit(); }
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (steps[event.key]) {
        event.preventDefault();
        const size = event.shiftKey ? 2 : 0.25; // px
        this.$emit("nudge", { du: steps[event.key][0] * size, dv: steps[event.key][1] * size });
      }
    },
    redraw() {
      if (!this.pending) {
        this.pending = true;
        requestAnimationFrame(() => {
          this.pending = false;
          if (this.$refs.canvas) { this.draw(); }
        });
      }
    },
    draw() {
      const canvas = this.$refs.canvas, pen = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.fillStyle = "#15181c";
      pen.fillRect(0, 0, canvas.width, canvas.height);
      if (!this.picture) { return; }
      pen.imageSmoothingEnabled = this.scale < 2;
      pen.globalAlpha = this.dim ? 0.55 : 1;
      pen.drawImage(this.picture, this.x0, this.y0,
        this.picture.naturalWidth * this.scale, this.picture.naturalHeight * this.scale);
      pen.globalAlpha = 1;
      this.draw_dots(pen);
      for (const mark of this.marks || []) { this.draw_mark(pen, mark); }
      this.draw_loupe();
      this.say();
    },
    draw_dots(pen) {
      if (!this.dots) { return; }
      const count = this.dots.length / 3, size = Math.max(1.5, Math.min(5, this.scale * 2));
      const { near, far } = this.overlay, { clientWidth: w, clientHeight: h } = this.$el;
      for (let i = 0; i < count; i++) {
        const [x, y] = this.to_view(this.dots[2 * i], this.dots[2 * i + 1]);
        if (x < 0 || y < 0 || x > w || y > h) { continue; }
        const share = (this.dots[2 * count + i] - near) / (far - near || 1);
        pen.fillStyle = `hsl(${Math.round(250 * Math.min(1, Math.max(0, share)))} 100% 55%)`;
        pen.fillRect(x - size / 2, y - size / 2, size, size);
      }
    },
    draw_mark(pen, mark) {
      const [x, y] = this.to_view(mark.u, mark.v), colour = COLOURS[mark.chosen ? "chosen" : mark.state];
      if (mark.projected) { // the residual: from the pick to where the solution has its point
        const [px, py] = this.to_view(...mark.projected);
        pen.strokeStyle = COLOURS.projected;
        pen.lineWidth = 1.5;
        pen.beginPath();
        pen.moveTo(x, y);
        pen.lineTo(px, py);
        pen.moveTo(px - 4, py - 4);
        pen.lineTo(px + 4, py + 4);
        pen.moveTo(px - 4, py + 4);
        pen.lineTo(px + 4, py - 4);
        pen.stroke();
      }
      for (const [width, ink] of [[4, "rgba(0,0,0,.65)"], [1.75, colour]]) {
        pen.strokeStyle = ink;
        pen.lineWidth = width;
        pen.beginPath();
        pen.arc(x, y, 8, 0, 2 * Math.PI);
        for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
          pen.moveTo(x + 3 * dx, y + 3 * dy);
          pen.lineTo(x + 8 * dx, y + 8 * dy);
        }
        pen.stroke();
      }
      pen.font = "600 13px system-ui, sans-serif";
      pen.lineWidth = 3.5;
      pen.strokeStyle = "rgba(0,0,0,.8)";
      pen.strokeText(mark.text, x + 11, y - 8);
      pen.fillStyle = colour;
      pen.fillText(mark.text, x + 11, y - 8);
    },
    draw_loupe() {
      const loupe = this.$refs.loupe, pen = loupe.getContext("2d");
      const magnified = Math.max(MAGNIFIED, 2 * this.scale);
      const at = this.cursor && !this.grip?.dragged ? this.to_pixel(...this.cursor) : null;
      loupe.style.display = at && this.inside(...at) ? "block" : "none";
      if (loupe.style.display === "none") { return; }
      const [x, y] = this.cursor, { clientWidth: w } = this.$el;
      loupe.style.left = `${x + 28 + LOUPE < w ? x + 28 : x - 28 - LOUPE}px`;
      loupe.style.top = `${y - 28 - LOUPE > 0 ? y - 28 - LOUPE : y + 28}px`;
      pen.fillStyle = "#15181c";
      pen.fillRect(0, 0, LOUPE, LOUPE);
      pen.imageSmoothingEnabled = false;
      const span = LOUPE / magnified;
      pen.drawImage(this.picture, at[0] + 0.5 - span / 2, at[1] + 0.5 - span / 2, span, span, 0, 0, LOUPE, LOUPE);
      for (const mark of this.marks || []) {
        const mx = LOUPE / 2 + (mark.u - at[0]) * magnified, my = LOUPE / 2 + (mark.v - at[1]) * magnified;
        pen.strokeStyle = COLOURS[mark.chosen ? "chosen" : mark.state];
        pen.strokeRect(mx - 3, my - 3, 6, 6);
      }
      for (const [width, ink] of [[3, "rgba(255,255,255,.8)"], [1, "#e0002a"]]) {
        pen.strokeStyle = ink;
        pen.lineWidth = width;
        pen.beginPath();
        for (const sign of [-1, 1]) {
          pen.moveTo(LOUPE / 2 + 4 * sign, LOUPE / 2);
          pen.lineTo(LOUPE / 2 + 30 * sign, LOUPE / 2);
          pen.moveTo(LOUPE / 2, LOUPE / 2 + 4 * sign);
          pen.lineTo(LOUPE / 2, LOUPE / 2 + 30 * sign);
        }
        pen.stroke();
      }
    },
    say() {
      const at = this.cursor ? this.to_pixel(...this.cursor) : null;
      const zoom = `${this.scale < 10 ? (100 * this.scale).toFixed(0) : Math.round(100 * this.scale)} %`;
      this.$refs.readout.textContent =
        at && this.inside(...at) ? `u ${at[0].toFixed(1)}  v ${at[1].toFixed(1)} px · ${zoom}` : zoom;
    },
  },
};
