"use strict";

/* Painting masks of single frames: labels are kept here until they are saved. */

{
  const brush = document.getElementById("brush");
  const COLORS = [[0, 0, 0, 0], [74, 155, 232, 255], [233, 149, 60, 255], [166, 108, 230, 255]];
  const MOST_UNDONE = 60;
  const loaded = new Map(); // By view and frame: the labels that are painted on.
  const edited = new Set();
  const undone = [];
  let stroke = null;
  let isLeaving = false;

  const tool = (name) => brush.querySelector(`[data-${name}]`);
  const isOn = () => frames.classList.contains("is-brushing");
  const keyOf = (figure) => `${figure.dataset.view}/${slider.value}`;
  const figures = () => frames.querySelectorAll("figure[data-masked]");

  function expand(runs) {
    const labels = new Uint8Array(runs.reduce((sum, value, at) => (at % 2 ? sum + value : sum), 0));
    let end = 0;
    for (let at = 0; at < runs.length; at += 2) labels.fill(runs[at], end, (end += runs[at + 1]));
    return labels;
  }

  function pack(labels) {
    const runs = [];
    for (let start = 0, end = 0; start < labels.length; start = end) {
      while (end < labels.length && labels[end] === labels[start]) end++;
      runs.push(labels[start], end - start);
    }
    return runs;
  }

  function canvasOf(figure) {
    const known = figure.querySelector("canvas");
    if (known) return known;
    const canvas = Object.assign(document.createElement("canvas"), { width: figure.dataset.width, height: figure.dataset.height });
    canvas.setAttribute("aria-label", `Mask of view ${figure.dataset.view}`);
    canvas.addEventListener("pointerdown", (event) => begin(figure, canvas, event));
    canvas.addEventListener("pointermove", (event) => stroke?.canvas === canvas && draw(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (stroke = null));
    figure.append(canvas);
    return canvas;
  }

  function paint(figure) {
    const canvas = canvasOf(figure);
    const labels = loaded.get(keyOf(figure));
    canvas.hidden = !labels;
    figure.classList.toggle("is-edited", edited.has(keyOf(figure)));
    if (!labels) return;
    const context = canvas.getContext("2d");
    const picture = context.createImageData(canvas.width, canvas.height);
    labels.forEach((label, at) => picture.data.set(COLORS[label], 4 * at));
    context.putImageData(picture, 0, 0);
  }

  async function showFigureMask(figure) {
    const key = keyOf(figure);
    if (!loaded.has(key)) {
      const [view, frame] = key.split("/");
      const mask = await send("GET", `api/v1/sequences/${frames.dataset.sequence}/views/${view}/frames/${frame}/mask`).catch((error) => toast(error.message, true));
      if (mask && !loaded.has(key)) loaded.set(key, expand(mask.runs));
    }
    if (isOn() && key === keyOf(figure)) paint(figure);
  }

  function showMasks() {
    tool("tools").hidden = !isOn();
    tool("width-shown").textContent = `${tool("size").value} px`;
    tool("undo").disabled = !undone.length;
    tool("save").disabled = tool("discard").disabled = !edited.size;
    tool("save").textContent = edited.size > 1 ? `Save ${edited.size} masks` : "Save the mask";
    for (const figure of figures()) {
      if (isOn()) showFigureMask(figure);
      else figure.querySelector("canvas")?.remove();
    }
  }

  function begin(figure, canvas, event) {
    if (event.button !== 0) return;
    isLeaving = false;
    event.preventDefault();
    canvas.setPointerCapture(event.pointerId);
    const key = keyOf(figure);
    undone.push({ key, labels: loaded.get(key).slice(), wasEdited: edited.has(key) });
    if (undone.length > MOST_UNDONE) undone.shift();
    edited.add(key);
    stroke = { figure, canvas, labels: loaded.get(key), last: null };
    draw(event);
    showMasks();
  }

  function draw(event) {
    const { canvas, labels, last } = stroke;
    const box = canvas.getBoundingClientRect();
    const at = [((event.clientX - box.left) / box.width) * canvas.width - 0.5, ((event.clientY - box.top) / box.height) * canvas.height - 0.5];
    const from = last ?? at;
    const value = Number(brush.querySelector("[name=label]:checked").value);
    const radius = Number(tool("size").value) / 2;
    const steps = Math.max(1, Math.ceil(Math.hypot(at[0] - from[0], at[1] - from[1]) / Math.max(0.5, radius / 2)));
    for (let step = 0; step <= steps; step++) {
      const x = from[0] + ((at[0] - from[0]) * step) / steps;
      const y = from[1] + ((at[1] - from[1]) * step) / steps;
      for (let row = Math.max(0, Math.ceil(y - radius)); row <= Math.min(canvas.height - 1, y + radius); row++) {
        const half = Math.sqrt(Math.max(0, radius ** 2 - (row - y) ** 2));
        const low = Math.max(0, Math.ceil(x - half));
        const high = Math.min(canvas.width - 1, Math.floor(x + half));
        if (low <= high) labels.fill(value, row * canvas.width + low, row * canvas.width + high + 1);
      }
    }
    stroke.last = at;
    paint(stroke.figure);
  }

  function undo() {
    const step = undone.pop();
    if (!step) return;
    loaded.set(step.key, step.labels);
    if (!step.wasEdited) edited.delete(step.key);
    showMasks();
  }

  function discard() {
    for (const key of edited) loaded.delete(key);
    edited.clear();
    undone.length = 0;
    showMasks();
  }

  async function save() {
    const masks = [...edited].map((key) => {
      const [view, frame] = key.split("/");
      return { view, frame: Number(frame), runs: pack(loaded.get(key)) };
    });
    const job = await send("POST", `api/v1/sequences/${frames.dataset.sequence}/correction`, { masks, carry_on: tool("carry").checked });
    isLeaving = true;
    followAnnotation(job);
  }

  function onKey(event) {
    if (!isOn() || event.altKey || document.querySelector("dialog[open]")) return;
    const size = tool("size");
    const choice = brush.querySelector(`[name=label][value="${CSS.escape(event.key)}"]`);
    if ((event.ctrlKey || event.metaKey) && event.key === "z") undo();
    else if (event.ctrlKey || event.metaKey) return;
    else if (choice) choice.checked = true;
    else if (event.key === "[" || event.key === "]") {
      size.value = Number(size.value) + (event.key === "[" ? -2 : 2);
      showMasks();
    } else return;
    event.preventDefault();
  }

  if (brush) {
    tool("brush").addEventListener("click", () => {
      if (frames.classList.contains("is-picking")) annotation.querySelector("[data-pick]").click();
      const isNow = frames.classList.toggle("is-brushing");
      tool("brush").setAttribute("aria-pressed", String(isNow));
      show();
    });
    tool("size").addEventListener("input", showMasks);
    tool("undo").addEventListener("click", undo);
    tool("discard").addEventListener("click", discard);
    tool("save").addEventListener("click", ({ target }) => busy(target, save));
    frames.addEventListener("frame-shown", showMasks);
    document.addEventListener("keydown", onKey);
    addEventListener("beforeunload", (event) => edited.size && !isLeaving && event.preventDefault());
  }
}
