"use strict";

/* ---- talking to the server ---- */

function toast(text, isBad) {
  const line = document.createElement("p");
  line.textContent = text;
  if (isBad) line.className = "bad";
  document.getElementById("toast").append(line);
  setTimeout(() => line.remove(), isBad ? 9000 : 4000);
}

async function send(method, url, body) {
  const response = await fetch(url, {
    method,
    headers: body ? { "Content-Type": "application/json" } : {},
    body: body ? JSON.stringify(body) : undefined,
  }).catch(() => {
    throw new Error("The server does not answer. Is it still running?");
  });
  if (response.ok) return response.status === 204 ? null : response.json();
  const answer = await response.json().catch(() => null);
  throw new Error(answer?.error?.message ?? `The server answered ${response.status}.`);
}

async function busy(button, work) {
  if (button.disabled) return;
  button.setAttribute("aria-busy", "true");
  button.disabled = true;
  try {
    await work();
  } catch (error) {
    toast(error.message, true);
  } finally {
    button.removeAttribute("aria-busy");
    button.disabled = false;
  }
}

const refresh = (id) => {
  const place = document.getElementById(id);
  if (place) htmx.trigger(place, "refresh");
};

/* ---- what buttons do ---- */

async function openScene(button) {
  const session = await send("POST", "/api/v1/sessions", { kind: button.dataset.open, id: button.dataset.id });
  location.href = session.url;
}

async function act(button) {
  await send("POST", `/api/v1/runs/${button.dataset.id}/${button.dataset.act}`);
  toast(button.dataset.act === "cancel" ? "Cancelling …" : "Back in line");
  refresh("runs");
  refresh("run");
}

async function remove(button) {
  if (!confirm(`Delete “${button.dataset.name}” with all its results?`)) return;
  await send("DELETE", `/api/v1/runs/${button.dataset.delete}`);
  if (document.getElementById("run")) location.href = "/";
  else refresh("runs");
}

function showForm(button) {
  const dialog = document.getElementById("new");
  if (!dialog) return;
  if (button?.dataset.sequence) dialog.querySelector("[name=sequence]").value = button.dataset.sequence;
  dialog.showModal();
}

async function launch(form) {
  const fields = new FormData(form);
  const run = await send("POST", "/api/v1/runs", {
    sequences: [fields.get("sequence")],
    profile: fields.get("profile"),
    name: fields.get("name"),
  });
  form.closest("dialog").close();
  form.reset();
  toast(`“${run.name}” is in line`);
  refresh("runs");
  document.getElementById("runs-heading").scrollIntoView({ behavior: "smooth" });
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (event.target.matches("dialog")) event.target.close();
  if (!button) return;
  const data = button.dataset;
  if ("open" in data) busy(button, () => openScene(button));
  else if ("act" in data) busy(button, () => act(button));
  else if ("delete" in data) busy(button, () => remove(button));
  else if ("new" in data) showForm(button);
  else if ("help" in data) document.getElementById("help").showModal();
  else if ("close" in data) button.closest("dialog").close();
});

document.addEventListener("submit", (event) => {
  if (event.target.id !== "launch") return;
  event.preventDefault();
  busy(event.target.querySelector("[type=submit]"), () => launch(event.target));
});

document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  const help = document.getElementById("help");
  if (event.key === "?") help.open ? help.close() : help.showModal();
  else if (document.querySelector("dialog[open]")) return;
  else if (event.key === "h") location.href = "/";
  else if (event.key === "n") showForm();
  else if (event.key === "o") document.querySelector("[data-featured], #run [data-open]")?.click();
});

/* ---- what changes while one looks: one event stream per page, closed while it is hidden ---- */

function describe(report) {
  const parts = [report.stage.replaceAll("_", " "), `${report.iteration} of ${report.total}`];
  if (Number.isFinite(report.loss)) parts.push(`loss ${report.loss.toPrecision(4)}`);
  if (Number.isFinite(report.eta_s)) {
    const seconds = Math.round(report.eta_s);
    parts.push(`${seconds < 60 ? `${seconds} s` : `${Math.floor(seconds / 60)} min ${seconds % 60} s`} left in this stage`);
  }
  return parts.join(" · ");
}

function showProgress(row, run) {
  const bar = row.querySelector("progress");
  const text = row.querySelector("[data-text]");
  if (!bar || !text || !run.progress.total) return false;
  bar.max = run.progress.total;
  bar.value = run.progress.iteration;
  text.textContent = describe(run.progress);
  return true;
}

function onRun(run) {
  const page = document.getElementById("run");
  if (page) {
    if (page.dataset.run !== run.id) return;
    const isSame = page.dataset.state === run.state && page.dataset.stage === (run.progress.stage ?? "");
    if (!isSame || (run.state === "running" && !showProgress(page, run))) refresh("run");
    if (page.dataset.state !== run.state) refresh("results");
    drawLosses();
    if (document.getElementById("log-details").open) refresh("log");
    return;
  }
  const row = [...document.querySelectorAll("#runs [data-run]")].find((line) => line.dataset.run === run.id);
  const isMoving = row && row.dataset.state === run.state && run.state === "running";
  if (!isMoving || !showProgress(row, run)) refresh("runs");
}

let stream = null;
let cursor = null;

function follow() {
  if (stream || document.hidden || !cursor) return;
  stream = new EventSource(`/api/v1/events?since=${encodeURIComponent(cursor)}`);
  const listen = (name, work) =>
    stream.addEventListener(name, (event) => {
      cursor = event.lastEventId;
      work(JSON.parse(event.data));
    });
  listen("run", onRun);
  listen("gone", () => refresh("runs"));
  listen("reset", () => ["runs", "run", "results"].forEach(refresh));
  const offline = document.querySelector("[data-offline]");
  stream.addEventListener("open", () => (offline.hidden = true));
  stream.addEventListener("error", () => (offline.hidden = false));
}

function unfollow() {
  stream?.close();
  stream = null;
}

document.addEventListener("visibilitychange", () => (document.hidden ? unfollow() : follow()));
addEventListener("pagehide", unfollow);
addEventListener("pageshow", follow);

/* ---- loss curves ---- */

const charts = new Map();
let drawing = false;

function color(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function makeChart(place, stage, data) {
  const figure = document.createElement("figure");
  const caption = document.createElement("figcaption");
  caption.textContent = stage.replaceAll("_", " ");
  figure.append(caption);
  place.append(figure);
  const axis = { stroke: color("--pico-muted-color"), grid: { stroke: color("--pico-muted-border-color"), width: 1 }, ticks: { show: false } };
  const [low, high] = [Math.min(...data[1]), Math.max(...data[1])];
  const plot = new uPlot({
    width: figure.clientWidth || 320,
    height: 190,
    cursor: { y: false },
    scales: { x: { time: false }, y: low > 0 && high > 5 * low ? { distr: 3 } : {} },
    axes: [{ ...axis, label: "iteration", labelSize: 18, size: 36 },
      { ...axis, size: 62, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : Number(tick.toPrecision(3)).toString())) }],
    series: [{ label: "iteration" }, { label: "loss", stroke: color("--pico-primary"), width: 2, points: { show: data[0].length < 30, size: 5 } }],
  }, data, figure);
  return { plot, figure };
}

async function drawLosses() {
  const section = document.getElementById("losses");
  if (!section || drawing) return;
  drawing = true;
  try {
    const { losses } = await send("GET", section.dataset.losses);
    for (const [stage, { curve }] of Object.entries(losses)) {
      if (curve.length < 2) continue;
      section.hidden = false;
      const data = [curve.map((point) => point[0]), curve.map((point) => point[1])];
      const known = charts.get(stage);
      if (known) known.plot.setData(data);
      else charts.set(stage, makeChart(section.querySelector(".charts"), stage, data));
    }
  } catch (error) {
    toast(error.message, true);
  } finally {
    setTimeout(() => (drawing = false), 1500);
  }
}

addEventListener("resize", () => charts.forEach(({ plot, figure }) => plot.setSize({ width: figure.clientWidth, height: 190 })));

/* ---- start ---- */

function showLocalTimes() {
  for (const place of document.querySelectorAll("time")) {
    place.textContent = new Date(place.dateTime).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  }
}

document.addEventListener("error", (event) => {
  if (event.target.matches?.("img[data-thumbnail]")) event.target.classList.add("missing");
}, true);

document.addEventListener("DOMContentLoaded", () => {
  cursor = document.body.dataset.since ?? null;
  showLocalTimes();
  follow();
  drawLosses();
  const log = document.getElementById("log");
  if (log) log.scrollTop = log.scrollHeight;
  const scene = document.getElementById("scene");
  scene?.addEventListener("load", () => scene.contentWindow.focus());
});

document.addEventListener("htmx:afterSettle", () => {
  showLocalTimes();
  const log = document.getElementById("log");
  if (log) log.scrollTop = log.scrollHeight;
});
