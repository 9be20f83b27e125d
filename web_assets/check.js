"use strict";

/* The check of a recording: one frame of all views, with the layers that are chosen. */

const frames = document.getElementById("frames");
const slider = frames?.querySelector("[data-frame-slider]");
const last = frames ? Number(frames.dataset.count) - 1 : 0;
const PLAY_MS = 90;
let playing = null;

function address(view, frame) {
  const layers = [...frames.querySelectorAll("[name=layer]:checked")].map((box) => box.value).join(",");
  const depth = frames.querySelector("[data-depth]")?.checked ? "&depth=true" : "";
  return `/sequences/${frames.dataset.sequence}/views/${view}/frames/${frame}?layers=${layers}${depth}&v=${frames.dataset.version}`;
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
  frames.addEventListener("click", (event) => event.target.closest("figure")?.classList.toggle("is-large"));
  document.addEventListener("DOMContentLoaded", show);
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-go]");
  if (!button || !frames) return;
  go(Number(button.dataset.go));
  frames.scrollIntoView({ behavior: "smooth", block: "start" });
});
