"use strict";

/* What a running fit has in hand: moving points on a canvas that can be turned.

   The file is safetensors: eight bytes that tell how long the header is, the header in JSON, then
   the arrays. Coordinates are whole numbers along the axes of a cube; 65535 is not known. */

const UNKNOWN = 65535;
const STEPS = 65534;
const FINGERS = [[0, 1, 2, 3, 4], [0, 5, 6, 7, 8], [5, 9, 10, 11, 12], [9, 13, 14, 15, 16], [13, 17, 18, 19, 20], [0, 17]];
const KINDS = {
  seen: { color: "--seen", size: 1.6, label: "observed points" },
  object: { color: "--node", size: 2.6, label: "object nodes" },
  control: { color: "--control", size: 1.8, label: "control nodes" },
  joints: { color: "--control", size: 3.2, label: "joints of the hand" },
};
const DEPTH = 0.2; // how much smaller what is farther away looks
const START = { turn: -0.6, tilt: 0.35 };

function readPreview(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const about = JSON.parse(header.__metadata__.about);
  const groups = {};
  for (const kind of Object.keys(header).filter((name) => KINDS[name])) {
    const { shape, data_offsets: [begin, end] } = header[kind];
    // Copied, as the header's length need not be even, where a view on these numbers must begin.
    groups[kind] = { count: shape[1], at: new Uint16Array(buffer.slice(8 + length + begin, 8 + length + end)) };
  }
  return { ...about, groups };
}

class Preview {
  constructor(figure, url) {
    this.figure = figure;
    this.url = url;
    this.canvas = figure.querySelector("canvas");
    this.text = figure.querySelector("[data-preview-text]");
    this.legend = figure.querySelector("[data-preview-legend]");
    this.waits = figure.querySelector(".waits");
    this.view = { ...START };
    this.shown = null;
    this.frame = 0;
    this.isStill = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.watchPointer();
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  async load(number) {
    this.wanted = number;
    if (this.isLoading) return;
    this.isLoading = true;
    for (let got = null; got !== this.wanted; ) {
      got = this.wanted;
      // One that does not arrive is not missed: the next one comes soon.
      const response = await fetch(`${this.url}?number=${got}`).catch(() => null);
      const content = response?.ok ? await response.arrayBuffer().catch(() => null) : null;
      if (content) this.show(readPreview(content));
    }
    this.isLoading = false;
  }

  show(preview) {
    this.waits.hidden = true;
    this.fit(preview);
    this.shown = preview;
    const { stage, sequence, loss, groups } = preview;
    const kinds = Object.keys(KINDS).filter((kind) => groups[kind]);
    this.canvas.setAttribute("aria-label", `${kinds.map((kind) => KINDS[kind].label).join(", ")} of ${sequence} in ${stage.replaceAll("_", " ")}. Arrow keys turn it, space stops it.`);
    this.legend.replaceChildren(...kinds.map((kind) => {
      const dot = Object.assign(document.createElement("span"), { textContent: "● " });
      dot.style.color = `var(${KINDS[kind].color})`;
      const part = document.createElement("span");
      part.append(dot, `${KINDS[kind].label}  `);
      return part;
    }));
    this.title = [stage.replaceAll("_", " "), Number.isFinite(loss) ? `loss ${loss.toPrecision(4)}` : ""].filter(Boolean).join(" · ");
    this.start();
  }

  /** Find the ball that holds all points of all frames; within a stage it only grows. */
  fit(preview) {
    const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    for (const { at } of Object.values(preview.groups)) {
      for (let i = 0; i < at.length; i++) {
        if (at[i] === UNKNOWN) continue;
        low[i % 3] = Math.min(low[i % 3], at[i]);
        high[i % 3] = Math.max(high[i % 3], at[i]);
      }
    }
    const metres = (value, axis) => preview.low[axis] + (value / STEPS) * preview.side;
    const corner = low.map(metres);
    const far = high.map(metres);
    const centre = corner.map((value, axis) => (value + far[axis]) / 2);
    const radius = Math.max(Math.hypot(...far.map((value, axis) => value - centre[axis])), 0.01);
    const isSame = this.shown?.stage === preview.stage && this.ball?.radius > 0.8 * radius;
    if (!isSame || radius > this.ball.radius) this.ball = { centre, radius };
  }

  start() {
    if (this.timer) return;
    const tick = () => {
      const { frames, frame_rate: rate } = this.shown;
      if (!this.isStill) this.frame = (this.frame + 1) % frames.length;
      this.draw();
      // The frames that are there last as long as the motion does; at its end it rests a little.
      const span = frames.length > 1 ? (1000 * frames.at(-1)) / rate / (frames.length - 1) : 1000;
      this.timer = setTimeout(tick, Math.max(30, span) + (this.frame === frames.length - 1 ? 700 : 0));
    };
    tick();
  }

  stop() {
    clearTimeout(this.timer);
    this.timer = null;
  }

  watchPointer() {
    let last = null;
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => {
      last = event;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (last) this.turn((event.clientX - last.clientX) * 0.01, (event.clientY - last.clientY) * 0.01);
      if (last) last = event;
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (last = null));
    canvas.addEventListener("dblclick", () => this.turn(START.turn - this.view.turn, START.tilt - this.view.tilt));
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (step) this.turn(...step);
      else if (event.key === " ") this.isStill = !this.isStill;
      else return;
      event.preventDefault();
    });
  }

  turn(turn, tilt) {
    this.view.turn += turn;
    this.view.tilt = Math.min(Math.max(this.view.tilt + tilt, -1.5), 1.5);
    this.draw();
  }

  /** Place the points of a kind in the frame on the canvas: x, y and depth, NaN where not known. */
  project({ count, at }, width, height) {
    const { turn, tilt } = this.view;
    const [ct, st, cp, sp] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const { low, side } = this.shown;
    const { centre, radius } = this.ball;
    const scale = 0.6 * Math.min(width, height);
    const along = (value, axis) => (low[axis] + (value / STEPS) * side - centre[axis]) / radius;
    const placed = new Float32Array(3 * count);
    const begin = 3 * count * this.frame;
    for (let i = 0; i < count; i++) {
      const j = begin + 3 * i;
      if (at[j] === UNKNOWN) {
        placed.fill(NaN, 3 * i, 3 * i + 3);
        continue;
      }
      const [x, y, z] = [along(at[j], 0), along(at[j + 1], 1), along(at[j + 2], 2)];
      const [right, away] = [ct * x - st * y, st * x + ct * y];
      const [up, depth] = [cp * z + sp * away, cp * away - sp * z];
      const near = scale / (1 + DEPTH * depth);
      placed.set([width / 2 + right * near, height / 2 - up * near, depth], 3 * i);
    }
    return placed;
  }

  draw() {
    if (!this.shown) return;
    const ratio = devicePixelRatio;
    const [width, height] = [this.canvas.clientWidth * ratio, this.canvas.clientHeight * ratio].map(Math.round);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const { frames, groups } = this.shown;
    this.frame = Math.min(this.frame, frames.length - 1);
    const pen = this.canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    for (const [kind, { color: name, size }] of Object.entries(KINDS)) {
      if (!groups[kind]) continue;
      const placed = this.project(groups[kind], width, height);
      pen.fillStyle = pen.strokeStyle = color(name);
      if (kind === "joints") this.drawBones(pen, placed, ratio);
      for (let i = 0; i < placed.length; i += 3) {
        if (Number.isNaN(placed[i])) continue;
        const radius = (size * ratio) / (1 + DEPTH * placed[i + 2]);
        pen.beginPath();
        pen.arc(placed[i], placed[i + 1], radius, 0, 7);
        pen.fill();
      }
    }
    this.text.textContent = `${this.title} · frame ${frames[this.frame]}`;
  }

  drawBones(pen, placed, ratio) {
    pen.lineWidth = 2.2 * ratio;
    for (let hand = 0; hand + 63 <= placed.length; hand += 63) {
      for (const finger of FINGERS) {
        pen.beginPath();
        for (const joint of finger) pen.lineTo(placed[hand + 3 * joint], placed[hand + 3 * joint + 1]);
        pen.stroke();
      }
    }
  }
}
