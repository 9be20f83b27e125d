"use strict";

/* Line charts on uPlot: a readout that follows the cursor, zoom, log scale, both themes, keys. */

const CHART_HEIGHT = 200;

function color(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function element(tag, options = {}, ...children) {
  const made = Object.assign(document.createElement(tag), options);
  made.append(...children);
  return made;
}

const number = (value) => {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size > 0 && size < 1e-3) return value.toExponential(3);
  return size >= 1000 && size < 1e7 ? value.toFixed(0) : Number(value.toPrecision(4)).toString();
};

/** Write the ticks of an axis, all of them with an exponent if one of them needs it. */
function tickTexts(ticks) {
  const rounded = ticks.map((tick) => (tick === null ? null : Number(tick.toPrecision(3))));
  const isSmall = rounded.some((tick) => tick && (Math.abs(tick) < 1e-3 || Math.abs(tick) >= 1e6));
  return rounded.map((tick) => (tick === null ? "" : tick && isSmall ? tick.toExponential() : tick.toString()));
}

/**
 * A chart whose data can grow.
 * options: title, xLabel, unit, series [{label, color (CSS variable), dash}], band (first x of the
 * shaded part), sync (key of charts that share a cursor), onPick(index), canLog.
 */
class Chart {
  constructor(place, options) {
    this.options = options;
    this.data = [[], ...options.series.map(() => [])];
    this.isLog = null;
    this.isZoomed = false;
    this.figure = element("figure", { className: "chart" });
    this.readout = element("output", { className: "readout" });
    this.logButton = element("button", { type: "button", className: "mini", textContent: "log", title: "Logarithmic scale" });
    this.resetButton = element("button", { type: "button", className: "mini", textContent: "show all", hidden: true });
    this.stage = element("div", { className: "plot", tabIndex: 0 });
    this.stage.setAttribute("role", "img");
    this.logButton.setAttribute("aria-label", `Logarithmic scale of ${options.title}`);
    this.logButton.addEventListener("click", () => {
      this.isLog = !this.usesLog();
      this.build();
    });
    this.resetButton.addEventListener("click", () => this.reset());
    const tools = element("span", { className: "tools" }, this.resetButton, this.logButton);
    this.figure.append(element("figcaption", {}, element("strong", { textContent: options.title }), tools), this.readout, this.stage);
    place.append(this.figure);
    this.stage.addEventListener("keydown", (event) => this.onKey(event));
    this.stage.addEventListener("blur", () => this.plot.setCursor({ left: -10, top: -10 }));
    new ResizeObserver(() => this.plot?.setSize(this.size())).observe(this.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.plot && this.build());
  }

  size() {
    return { width: this.stage.clientWidth || 320, height: this.options.height ?? CHART_HEIGHT };
  }

  range() {
    const values = this.data.slice(1).flat().filter(Number.isFinite);
    return values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
  }

  usesLog() {
    const [low, high] = this.range();
    return low > 0 && (this.isLog ?? (this.options.canLog && high > 5 * low));
  }

  setData(data) {
    this.data = data;
    const isLog = this.usesLog();
    const wasDots = this.hasDots;
    this.hasDots = data[0].length < 30;
    if (!this.plot || this.plotIsLog !== isLog || wasDots !== this.hasDots) this.build();
    else {
      this.plot.setData(data, !this.isZoomed);
      if (this.isZoomed) this.plot.redraw();
    }
    this.describe();
    if (!this.isPointed()) this.read(null);
  }

  isPointed() {
    return this.plot.cursor.left >= 0;
  }

  append(points) {
    const data = this.data.map((column) => column.slice());
    for (const [x, ...ys] of points) {
      // What was started again, or goes on from an earlier checkpoint, replaces what was there.
      while (data[0].length && x <= data[0][data[0].length - 1]) data.forEach((column) => column.pop());
      [x, ...ys].forEach((value, i) => data[i].push(value));
    }
    this.setData(data);
  }

  build() {
    const zoom = this.isZoomed ? { ...this.plot.scales.x } : null;
    this.plot?.destroy();
    const { options } = this;
    const isLog = (this.plotIsLog = this.usesLog());
    this.logButton.hidden = !options.canLog || !(this.range()[0] > 0);
    this.logButton.setAttribute("aria-pressed", String(isLog));
    const axis = { stroke: color("--pico-muted-color"), grid: { stroke: color("--pico-muted-border-color"), width: 1 }, ticks: { show: false }, font: "12px system-ui" };
    const label = { labelSize: 16, labelFont: "12px system-ui" };
    this.plot = new uPlot({
      ...this.size(),
      legend: { show: false },
      cursor: { y: false, drag: { x: true, y: false }, sync: options.sync ? { key: options.sync } : undefined },
      scales: { x: { time: false }, y: isLog ? { distr: 3 } : {} },
      axes: [
        { ...axis, ...label, label: options.xLabel, size: 30, values: (_, ticks) => ticks.map((tick) => (Number.isInteger(tick) ? tick : "")) },
        { ...axis, size: 58, values: (_, ticks) => tickTexts(ticks) },
      ],
      series: [{}, ...options.series.map((line) => ({
        label: line.label, stroke: color(line.color), width: 2, dash: line.dash, spanGaps: false,
        points: { show: this.hasDots, size: 5 },
      }))],
      hooks: {
        setCursor: [(plot) => this.read(plot.cursor.left >= 0 ? plot.cursor.idx : null)],
        setSelect: [(plot) => plot.select.width > 0 && this.zoomed(true)],
        drawClear: [(plot) => this.shade(plot)],
      },
    }, this.data, this.stage);
    if (zoom) this.plot.setScale("x", { min: zoom.min, max: zoom.max });
    this.plot.over.addEventListener("dblclick", () => this.zoomed(false));
    this.plot.over.addEventListener("click", () => options.onPick && this.plot.cursor.idx != null && options.onPick(this.plot.cursor.idx));
  }

  zoomed(isZoomed) {
    this.isZoomed = isZoomed;
    this.resetButton.hidden = !isZoomed;
  }

  reset() {
    this.zoomed(false);
    this.plot.setData(this.data, true);
  }

  /** Shade what lies behind `band`, and name both sides. */
  shade(plot) {
    const { band } = this.options;
    if (band == null) return;
    const { ctx, bbox } = plot;
    const ratio = devicePixelRatio;
    const x = Math.min(Math.max(plot.valToPos(band - 0.5, "x", true), bbox.left), bbox.left + bbox.width);
    ctx.save();
    ctx.fillStyle = color("--future");
    ctx.fillRect(x, bbox.top, bbox.left + bbox.width - x, bbox.height);
    ctx.strokeStyle = color("--pico-muted-color");
    ctx.setLineDash([4 * ratio, 4 * ratio]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillStyle = color("--pico-muted-color");
    ctx.font = `${12 * ratio}px system-ui`;
    ctx.textBaseline = "top";
    if (x - bbox.left > 80 * ratio) {
      ctx.textAlign = "right";
      ctx.fillText("fitted", x - 6 * ratio, bbox.top + 4 * ratio);
    }
    if (bbox.left + bbox.width - x > 80 * ratio) {
      ctx.textAlign = "left";
      ctx.fillText("predicted", x + 6 * ratio, bbox.top + 4 * ratio);
    }
    ctx.restore();
  }

  /** Show the values at an index; without one those of the last point. */
  read(index) {
    const isLast = index == null;
    const i = isLast ? this.data[0].length - 1 : index;
    if (i < 0) return;
    const { series, xLabel, unit } = this.options;
    const parts = [element("span", { textContent: `${xLabel} ${number(this.data[0][i])}` })];
    series.forEach((line, n) => {
      const swatch = element("i", { className: line.dash ? "swatch dashed" : "swatch" });
      swatch.style.borderColor = `var(${line.color})`;
      const shown = `${line.label} ${number(this.data[n + 1][i])}${unit ? ` ${unit}` : ""}`;
      parts.push(element("span", {}, swatch, shown));
    });
    this.readout.replaceChildren(...parts);
    this.readout.classList.toggle("at-cursor", !isLast);
  }

  describe() {
    const { title, xLabel, unit, series } = this.options;
    const last = this.data[0].length - 1;
    const values = series.map((line, n) => `${line.label} ${number(this.data[n + 1][last])}${unit ? ` ${unit}` : ""}`);
    this.stage.setAttribute("aria-label", `${title}: ${last + 1} points up to ${xLabel} ${number(this.data[0][last])}, ${values.join(", ")}. Arrow keys walk along.`);
  }

  onKey(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }[event.key];
    if (event.key === "Enter" && this.options.onPick && this.isPointed()) this.options.onPick(this.plot.cursor.idx);
    if (event.key === "Escape") this.reset();
    if (step === undefined) return;
    event.preventDefault();
    const last = this.data[0].length - 1;
    const from = this.isPointed() ? this.plot.cursor.idx : step > 0 ? -1 : last + 1;
    const index = Math.min(Math.max(from + step, 0), last);
    const values = this.data.slice(1).map((column) => column[index]).filter(Number.isFinite);
    this.plot.setCursor({ left: this.plot.valToPos(this.data[0][index], "x"), top: values.length ? this.plot.valToPos(values[0], "y") : 0 });
    this.readout.setAttribute("aria-live", "polite");
  }
}
