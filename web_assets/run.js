"use strict";

/* The page of one run: its parts change in place, its curves and its log grow by events. */

const page = {
  run: document.getElementById("run").dataset.run,
  losses: document.getElementById("losses"),
  frames: document.getElementById("frames"),
  now: document.getElementById("now"),
  charts: new Map(),
  loaded: -1, // number of the last report that the curves were loaded with
  live: [], // points that came since
  drawn: 0, // how many of them the charts show
  report: { seq: -1 },
  estimate: null, // how long the whole fit still takes
  log: null,
};

/* ---- parts that the server renders: only what differs is touched ---- */

const KEPT = { DETAILS: ["open"] };

function morph(old, fresh) {
  if (old.isEqualNode(fresh)) return;
  if (old.nodeType !== fresh.nodeType || old.nodeName !== fresh.nodeName) {
    old.replaceWith(fresh.cloneNode(true));
    return;
  }
  if (old.nodeType !== Node.ELEMENT_NODE) {
    if (old.nodeValue !== fresh.nodeValue) old.nodeValue = fresh.nodeValue;
    return;
  }
  const kept = KEPT[old.nodeName] ?? [];
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name) && !kept.includes(name)) old.removeAttribute(name);
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value && !kept.includes(name)) old.setAttribute(name, value);
  const [before, after] = [[...old.childNodes], [...fresh.childNodes]];
  after.forEach((child, i) => (before[i] ? morph(before[i], child) : old.append(child.cloneNode(true))));
  before.slice(after.length).forEach((child) => child.remove());
}

let isRefreshing = false;
let isStale = false;

async function refreshParts() {
  isStale = true;
  if (isRefreshing) return;
  isRefreshing = true;
  try {
    while (isStale) {
      isStale = false;
      const response = await fetch(`runs/${page.run}/parts`, { headers: { Accept: "text/html" } });
      if (!response.ok) throw new Error(`The server answered ${response.status}.`);
      const fresh = new DOMParser().parseFromString(await response.text(), "text/html");
      showLocalTimes(fresh);
      for (const part of fresh.querySelectorAll("[data-part]")) morph(document.getElementById(part.id), part);
      startClock();
      await Promise.all([loadLosses(), loadFrames()]);
    }
  } catch {
    setTimeout(refreshParts, 2000);
  } finally {
    isRefreshing = false;
  }
}

/* ---- the time that the stage at work has taken ---- */

let clock = { start: 0, at: 0 };

function startClock() {
  const place = document.querySelector("[data-elapsed]");
  if (place) clock = { start: Number(place.dataset.elapsed), at: performance.now() };
}

setInterval(() => {
  const place = document.querySelector("[data-elapsed]");
  if (place) place.textContent = duration(clock.start + (performance.now() - clock.at) / 1000);
}, 1000);

/* ---- curves ---- */

function drawLoss(stage, points) {
  if (!points.length) return;
  page.losses.hidden = false;
  let chart = page.charts.get(stage);
  if (!chart) {
    chart = new Chart(page.losses.querySelector(".charts"), {
      title: stage.replaceAll("_", " "), xLabel: "iteration", canLog: true,
      series: [{ label: "loss", color: "--pico-primary" }],
    });
    chart.figure.dataset.chart = stage;
    page.charts.set(stage, chart);
  }
  return chart;
}

async function loadLosses() {
  if (!page.losses.dataset.url) return -1;
  const { losses, seq } = await send("GET", page.losses.dataset.url);
  for (const [stage, { curve }] of Object.entries(losses)) {
    drawLoss(stage, curve)?.setData([curve.map((point) => point[0]), curve.map((point) => point[1])]);
  }
  // The stream may be ahead of this answer or behind it: what it does not hold is drawn again.
  page.loaded = Math.max(page.loaded, seq);
  page.live = page.live.filter((point) => point.seq > page.loaded);
  page.drawn = 0;
  drawLive();
  return seq;
}

/** Reports come at once, the run's own summary of them with the time left a little later. */
function showReport(report) {
  if (report.seq >= page.report.seq) page.report = { ...report, eta_s: report.stage === page.report.stage ? (report.eta_s ?? page.report.eta_s) : report.eta_s };
  if (page.report.total) showProgress(document.getElementById("run"), { progress: page.report, estimate: page.estimate });
}

function onProgress(event) {
  showReport(event);
  if (!Number.isFinite(event.loss) || event.seq <= page.loaded) return;
  // Points of one frame are drawn together, however many there are.
  if (page.drawn === page.live.length) requestAnimationFrame(drawLive);
  page.live.push({ stage: event.stage, seq: event.seq, at: [event.iteration, event.loss] });
}

function drawLive() {
  const stages = Map.groupBy(page.live.slice(page.drawn), (point) => point.stage);
  page.drawn = page.live.length;
  for (const [stage, points] of stages) drawLoss(stage, points).append(points.map((point) => point.at));
}

/* ---- errors of every frame ---- */

const METHODS = [
  { key: "rollout", label: "rollout", color: "--pico-primary" },
  { key: "static", label: "static", color: "--wait", dash: [6, 4] },
  { key: "rigid_follow", label: "rigid follow", color: "--spring-line", dash: [2, 3] },
];
const QUANTITIES = [["track_error", "Track error"], ["chamfer_l2", "Chamfer distance"]];
let frameErrors = {};

async function loadFrames() {
  if (!page.frames.dataset.url) return;
  const { sequences } = await send("GET", page.frames.dataset.url);
  if (JSON.stringify(sequences) === JSON.stringify(frameErrors)) return;
  frameErrors = sequences;
  const isTold = (errors) => QUANTITIES.some(([quantity]) => METHODS.some(({ key }) => errors[key]?.[quantity]?.some(Number.isFinite)));
  const names = Object.keys(sequences).filter((name) => isTold(sequences[name]));
  page.frames.hidden = names.length === 0;
  if (!names.length) return;
  const select = page.frames.querySelector("select");
  const chosen = names.includes(select.value) ? select.value : names[0];
  select.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
  page.frames.querySelector("[data-choice]").hidden = names.length < 2;
  drawFrames(chosen);
}

function drawFrames(name) {
  const errors = frameErrors[name];
  const [factor, unit] = errors.unit === "m" ? [1000, "mm"] : [1, errors.unit];
  const place = page.frames.querySelector(".charts");
  place.replaceChildren();
  page.frames.querySelector(".held").hidden = true;
  for (const [quantity, title] of QUANTITIES) {
    const lines = METHODS.filter(({ key }) => errors[key]?.[quantity]?.some(Number.isFinite));
    if (!lines.length) continue;
    const columns = lines.map(({ key }) => errors[key][quantity].map((value) => (Number.isFinite(value) ? value * factor : null)));
    const chart = new Chart(place, {
      title, xLabel: "frame", unit, series: lines, band: errors.future_start, sync: "frames", canLog: true, height: 230,
      onPick: (index) => holdFrame(title, errors.frames[index], lines.map(({ label }, n) => `${label} ${number(columns[n][index])} ${unit}`)),
    });
    chart.isLog = false;
    chart.figure.dataset.chart = quantity;
    chart.setData([errors.frames, ...columns]);
  }
}

function holdFrame(title, frame, values) {
  const held = page.frames.querySelector(".held");
  held.hidden = false;
  held.textContent = `Frame ${frame} · ${title.toLowerCase()}: ${values.join(" · ")}`;
}

/* ---- start ---- */

/** Show how much of the whole fit is done. */
function showEstimate(estimate) {
  page.estimate = estimate;
  const share = document.querySelector("[data-whole-share]");
  if (share && estimate) share.textContent = `${Math.round(100 * estimate.share)} %`;
}

function onLoad({ machine, run }) {
  showMachine(page.now, machine);
  const takes = page.now.querySelector("[data-takes]");
  const card = run && Number.isFinite(run.card_memory) ? `, ${bytes(run.card_memory)} on the graphics card` : "";
  takes.textContent = run ? `This fit takes ${bytes(run.memory)} of memory${card} and keeps ${run.processors.toFixed(1)} of ${machine.processor.count} processors busy.` : "";
}

/** Tell in the tab how far the fit is, for whoever works in another one. */
function showInTab(run) {
  const share = run.state === "running" && run.estimate ? `${Math.round(100 * run.estimate.share)} % · ` : "";
  const isOver = document.body.dataset.wasAtWork && !["queued", "starting", "running", "stopping"].includes(run.state);
  if (run.state === "running") document.body.dataset.wasAtWork = "yes";
  const mark = isOver ? (run.state === "succeeded" ? "✓ " : "✕ ") : "";
  document.title = `${share}${mark}${run.name} · PhysHanDI`;
}

function onRun(run) {
  showInTab(run);
  page.now.hidden = !["starting", "running", "stopping"].includes(run.state);
  if (page.now.hidden) page.preview.stop();
  showEstimate(run.state === "running" ? run.estimate : null);
  const head = document.getElementById("run");
  if (run.revision !== head.dataset.revision) {
    refreshParts();
    return;
  }
  showReport(run.progress);
  const stage = run.stages.find(({ state }) => state === "at-work");
  if (Number.isFinite(stage?.seconds)) clock = { start: stage.seconds, at: performance.now() };
}

function onGone() {
  unfollow();
  cursor = null;
  toast("This run was deleted.", true);
  setTimeout(() => (location.href = "."), 2500);
}

async function begin() {
  page.log = new Log(document.getElementById("log-details"));
  startClock();
  page.frames.querySelector("select").addEventListener("change", (event) => drawFrames(event.target.value));
  listeners.run = onRun;
  listeners.progress = onProgress;
  listeners.log = (part) => page.log.add(part);
  listeners.gone = onGone;
  listeners.load = onLoad;
  page.preview = new Preview(page.now.querySelector(".preview"), `api/v1/runs/${page.run}/preview`);
  listeners.preview = ({ number }) => page.preview.load(number);
  let seq = -1;
  try {
    seq = await loadLosses();
    await loadFrames();
  } catch (error) {
    toast(error.message, true);
  }
  // From what this page shows on, so that nothing is missed or comes twice.
  cursor = `${seq}-${page.log.end}`;
  follow();
}

addEventListener("run-changed", refreshParts);
document.addEventListener("DOMContentLoaded", begin);
