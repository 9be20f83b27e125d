"use strict";

/* The check of a recording: one frame of all views, with the layers that are chosen. */

const frames = document.getElementById("frames");
const slider = frames?.querySelector("[data-frame-slider]");
const last = frames ? Number(frames.dataset.count) - 1 : 0;
const PLAY_MS = 90;
let playing = null;

function address(view, frame) {
  const isPainted = (layer) => layer === "mask" && frames.classList.contains("is-brushing");
  const layers = [...frames.querySelectorAll("[name=layer]:checked")].map((box) => box.value).filter((layer) => !isPainted(layer)).join(",");
  const depth = frames.querySelector("[data-depth]")?.checked ? "&depth=true" : "";
  return `sequences/${frames.dataset.sequence}/views/${view}/frames/${frame}?layers=${layers}${depth}&v=${frames.dataset.version}`;
}

/** Show what the slider says; a picture that is still coming is not interrupted, the latest one is. */
function showFigure(figure) {
  const image = figure.querySelector("img");
  const wanted = address(figure.dataset.view, slider.value);
  if (figure.dataset.coming || figure.dataset.shown === wanted) return;
  figure.dataset.coming = wanted;
  const next = new Image();
  const finish = () => {
    figure.dataset.shown = figure.dataset.coming;
    delete figure.dataset.coming;
    showFigure(figure);
  };
  next.onload = () => {
    image.src = next.src;
    image.hidden = false;
    figure.querySelector("[role=alert]").hidden = true;
    finish();
  };
  next.onerror = async () => {
    const place = figure.querySelector("[role=alert]");
    place.textContent = await send("GET", wanted).then(() => "This frame cannot be shown.", (error) => error.message);
    place.hidden = false;
    image.hidden = true;
    finish();
  };
  next.src = wanted;
}

function show() {
  frames.querySelector("[data-frame-number]").textContent = `frame ${slider.value} of ${last}`;
  frames.querySelectorAll("figure").forEach(showFigure);
  showPicks();
  frames.dispatchEvent(new Event("frame-shown"));
  const here = new URL(location.href);
  here.searchParams.set("frame", slider.value);
  history.replaceState(null, "", here);
}

function go(frame) {
  slider.value = Math.min(Math.max(frame, 0), last);
  show();
}

function play(isOn) {
  clearInterval(playing);
  playing = isOn ? setInterval(() => {
    // Never ahead of the pictures.
    if (frames.querySelector("[data-coming]")) return;
    go(Number(slider.value) >= last ? 0 : Number(slider.value) + 1);
  }, PLAY_MS) : null;
  const button = frames.querySelector("[data-play]");
  button.setAttribute("aria-pressed", String(isOn));
  button.textContent = isOn ? "Pause" : "Play";
}

if (frames) {
  slider.addEventListener("input", show);
  frames.addEventListener("change", (event) => event.target !== slider && show());
  frames.querySelector("[data-play]").addEventListener("click", () => play(playing === null));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) go(Number(slider.value) + step * (event.shiftKey ? 10 : 1));
    else if (event.key === "Home") go(0);
    else if (event.key === "End") go(last);
    else if (event.key === " " && !event.target.matches("button, a, input[type=checkbox]")) play(playing === null);
    else return;
    event.preventDefault();
  });
  frames.addEventListener("click", (event) => {
    const figure = event.target.closest("figure");
    if (!figure || frames.classList.contains("is-brushing")) return;
    if (!frames.classList.contains("is-picking")) figure.classList.toggle("is-large");
  });
  document.addEventListener("DOMContentLoaded", show);
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-go]");
  if (!button || !frames) return;
  go(Number(button.dataset.go));
  frames.scrollIntoView({ behavior: "smooth", block: "start" });
});

/* ---- masks and tracks from a click ---- */

const annotation = document.getElementById("annotation");
const part = (name) => annotation.querySelector(`[data-${name}]`);
const POLL_MS = 600;
let picks = [];

const DRAG = 8; // From so many pixels on, a click has become a box.
let pressed = null;

/** Pixels of the recording, which count from their middles. */
function placeOf(figure, event) {
  const box = figure.querySelector("img").getBoundingClientRect();
  const tidy = (value, size) => Math.min(Math.max(0, Math.round(value * 10) / 10), size - 1);
  return [
    tidy(((event.clientX - box.left) / box.width) * figure.dataset.width - 0.5, figure.dataset.width),
    tidy(((event.clientY - box.top) / box.height) * figure.dataset.height - 0.5, figure.dataset.height),
  ];
}

function pickOf({ figure, from, start }, event) {
  const to = placeOf(figure, event);
  const place = { view: figure.dataset.view, frame: Number(slider.value) };
  if (Math.hypot(event.clientX - start[0], event.clientY - start[1]) < DRAG) return { ...place, x: to[0], y: to[1] };
  const middle = (at) => Math.round((from[at] + to[at]) * 5) / 10;
  const size = (at) => Math.round(Math.abs(from[at] - to[at]) * 10) / 10;
  return { ...place, x: middle(0), y: middle(1), width: size(0), height: size(1) };
}

if (frames) {
  frames.addEventListener("pointerdown", (event) => {
    const figure = event.target.closest("figure");
    if (event.button !== 0 || !figure || !event.target.matches("img") || !frames.classList.contains("is-picking")) return;
    event.preventDefault();
    pressed = { figure, from: placeOf(figure, event), start: [event.clientX, event.clientY] };
    figure.setPointerCapture(event.pointerId);
  });
  frames.addEventListener("dragstart", (event) => frames.classList.contains("is-picking") && event.preventDefault());
  frames.addEventListener("pointermove", (event) => pressed && showPicks([...picks, pickOf(pressed, event)]));
  frames.addEventListener("pointercancel", () => { pressed = null; showPicks(); });
  frames.addEventListener("pointerup", (event) => {
    if (!pressed) return;
    picks.push(pickOf(pressed, event));
    pressed = null;
    showPicks();
  });
}

function showPicks(shown = picks) {
  if (!annotation) return;
  frames.querySelectorAll(".pick").forEach((dot) => dot.remove());
  for (const { view, frame, x, y, width = 0, height = 0 } of shown) {
    if (frame !== Number(slider.value)) continue;
    const figure = frames.querySelector(`[data-view="${view}"]`);
    const image = figure.querySelector("img");
    const dot = Object.assign(document.createElement("span"), { className: "pick" });
    dot.style.left = `${((x + 0.5) / figure.dataset.width) * image.clientWidth}px`;
    dot.style.top = `${((y + 0.5) / figure.dataset.height) * image.clientHeight}px`;
    if (width || height) {
      dot.classList.add("box");
      dot.style.width = `${(width / figure.dataset.width) * image.clientWidth}px`;
      dot.style.height = `${(height / figure.dataset.height) * image.clientHeight}px`;
    }
    figure.append(dot);
  }
  part("picks").replaceChildren(...picks.map(({ view, frame, x, y, width, height }, number) => {
    const item = Object.assign(document.createElement("li"), { textContent: `${view}, frame ${frame}: ${Math.round(x)}, ${Math.round(y)}${width ? `, box ${Math.round(width)} × ${Math.round(height)}` : ""} ` });
    const undo = Object.assign(document.createElement("button"), { type: "button", className: "mini", textContent: "✕", title: "Take it back" });
    undo.setAttribute("aria-label", `Take back the click in ${view}, frame ${frame}`);
    undo.addEventListener("click", () => { picks.splice(number, 1); showPicks(); });
    item.append(undo);
    return item;
  }));
  part("annotate").disabled = !picks.length;
}

/** The network that finds masks or tracks in the place of what is built in; empty for none. */
const chosen = (finds) => annotation.querySelector(`[data-model=${finds}]`)?.value ?? "";

const own = () => `api/v1/sequences/${annotation.dataset.sequence}/annotation`;

/** Follow the work until it ends; what was found is then shown by the page itself. */
function followAnnotation(job, was) {
  const isRunning = job.state === "running";
  if (job.state === "done" && was === "running") location.reload();
  part("finding").hidden = part("stop").hidden = !isRunning;
  part("annotate").hidden = isRunning;
  part("unfound").hidden = job.state !== "failed";
  part("unfound").textContent = job.reason;
  const { stage, iteration, total } = job.progress;
  const bar = annotation.querySelector("progress");
  [bar.max, bar.value] = total ? [total, iteration] : [1, 0]; // Or it would show the job before.
  part("found").textContent = stage ? `${stage.replaceAll("_", " ")} · ${iteration} of ${total}` : "starting …";
  if (isRunning) setTimeout(async () => followAnnotation(await send("GET", own()).catch(() => job), "running"), POLL_MS);
}

if (annotation) {
  part("pick").addEventListener("click", () => {
    if (frames.classList.contains("is-brushing")) part("brush").click();
    const isOn = frames.classList.toggle("is-picking");
    part("pick").setAttribute("aria-pressed", String(isOn));
  });
  part("annotate").addEventListener("click", ({ target }) => busy(target, async () => {
    if (frames.classList.contains("is-picking")) part("pick").click();
    const order = { clicks: picks, overwrite: Boolean(part("overwrite")?.checked), mask_model: chosen("masks"), track_model: chosen("tracks"), trusts_model_code: Boolean(part("trusts")?.checked) };
    followAnnotation(await send("POST", own(), order));
  }));
  part("stop").addEventListener("click", ({ target }) => busy(target, () => send("DELETE", own())));
  annotation.querySelector("[data-model=tracks]")?.addEventListener("change", () => {
    // Trust is in one folder: another one is looked at anew.
    part("trust").hidden = !chosen("tracks");
    part("trusts").checked = false;
  });
  addEventListener("resize", () => showPicks());
  document.addEventListener("DOMContentLoaded", async () => followAnnotation(await send("GET", own())));
}
