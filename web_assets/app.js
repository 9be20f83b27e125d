"use strict";

/* ---- talking to the server ---- */

function toast(text, isBad, link) {
  const line = document.createElement("p");
  line.textContent = text;
  if (isBad) line.className = "bad";
  if (link) line.append(" · ", Object.assign(document.createElement("a"), link));
  document.getElementById("toast").append(line);
  setTimeout(() => line.remove(), isBad || link ? 9000 : 4000);
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
  const session = await send("POST", "api/v1/sessions", { kind: button.dataset.open, id: button.dataset.id });
  location.href = session.url;
}

/* A file for which every frame is drawn is made first, with a bar. */
async function makeSlowFile(address, about) {
  const line = document.createElement("p");
  const bar = document.createElement("progress");
  line.append(about, bar);
  document.getElementById("toast").append(line);
  try {
    for (;;) {
      const file = await send("POST", address);
      if (file.state === "failed") throw new Error(file.message);
      if (file.state === "ready") return file;
      if (file.of) Object.assign(bar, { max: file.of, value: file.done });
      await new Promise((done) => setTimeout(done, 500));
    }
  } finally {
    line.remove();
  }
}

async function fetchSlowFile(address, about) {
  location.href = (await makeSlowFile(address, `${about}: the download begins when it is ready.`)).url;
}

/* Outside of localhost and https, browsers have no clipboard for pages but what is selected. */
async function copyText(text, inside = window) {
  try {
    await inside.navigator.clipboard.writeText(text);
    return true;
  } catch {
    const field = inside.document.body.appendChild(inside.document.createElement("textarea"));
    field.value = text;
    field.select();
    const isDone = inside.document.execCommand("copy");
    field.remove();
    if (!isDone) prompt("Copy this link:", text);
    return isDone;
  }
}

/* A copy of the replay gets an address that needs no token, until it is withdrawn. */
async function shareView(run, query) {
  const fields = new URLSearchParams(query);
  fields.set("format", "html");
  await makeSlowFile(`api/v1/runs/${run}/export?${fields}`, "Making the page that is shared");
  const share = await send("POST", `api/v1/runs/${run}/shares?${query}`);
  if (await copyText(new URL(share.url, document.baseURI).href)) {
    toast("Link copied: whoever has it sees this replay, and nothing else, until you withdraw it.", false, { href: `runs/${run}#shares`, textContent: "Shared pages" });
  }
  dispatchEvent(new Event("shares-changed"));
}

async function act(button) {
  const body = "afresh" in button.dataset ? { afresh: true } : undefined;
  await send("POST", `api/v1/runs/${button.dataset.id}/${button.dataset.act}`, body);
  toast(button.dataset.act === "cancel" ? "Cancelling …" : "Back in line");
  refresh("runs");
  dispatchEvent(new Event("run-changed"));
}

async function removeExpendable() {
  if (!confirm("Remove everything that is listed? It cannot be brought back.")) return;
  const { removed, bytes } = await send("POST", "api/v1/retention");
  toast(`${removed.length} removed, ${(bytes / 1048576).toFixed(1)} MiB`);
  location.reload();
}

async function setPriority(button) {
  const { id, priority } = button.dataset;
  const { place } = await send("POST", `api/v1/runs/${id}/priority`, { priority });
  toast(`${priority[0].toUpperCase()}${priority.slice(1)} priority${place ? `: no. ${place} in line` : ""}`);
  refresh("runs");
  dispatchEvent(new Event("run-changed"));
}

/* What cannot be read is kept, out of the way. */
async function moveAside(button) {
  const { aside, id, name } = button.dataset;
  if (!confirm(`Move the folder of “${name}” to damaged/${aside} of the data folder? Nothing is deleted.`)) return;
  const { moved_to } = await send("POST", `api/v1/${aside}/${id}/aside`);
  toast(`Moved to ${moved_to}`);
  if (document.getElementById("run")) location.href = "recovery";
  else location.reload();
}

async function remove(button) {
  if (!confirm(`Delete “${button.dataset.name}” with all its results?`)) return;
  await send("DELETE", `api/v1/runs/${button.dataset.delete}`);
  if (document.getElementById("run")) location.href = ".";
  else refresh("runs");
}

function showForm(button) {
  const dialog = document.getElementById("new");
  if (!dialog) return;
  if (button?.dataset.sequence) dialog.querySelector("[name=sequence]").value = button.dataset.sequence;
  dialog.showModal();
  askReadiness(dialog);
}

/** Ask which stages a fit of the chosen sequence would run. */
async function askReadiness(dialog) {
  const sequence = dialog.querySelector("[name=sequence]")?.value;
  if (!sequence) return;
  const place = dialog.querySelector("[data-readiness]");
  place.hidden = true;
  const answer = await send("POST", "api/v1/runs/check", { sequences: [sequence] }).catch(() => null);
  if (dialog.querySelector("[name=sequence]").value === sequence) showReadiness(place, answer, [sequence]);
}

/** Say which stages will run and which will be skipped and why, and ask before the object is left out. */
function showReadiness(place, answer, sequences) {
  const stages = Object.entries(answer?.stages ?? {});
  place.hidden = !stages.length;
  const skipped = stages.filter(([, stage]) => !stage.ready);
  const summary = place.querySelector("[data-summary]");
  const link = (id) => Object.assign(document.createElement("a"), { href: `sequences/${id}/check`, textContent: sequences.length > 1 ? `Check ${id}` : "Check the recording" });
  summary.className = answer?.nothing_to_fit ? "problem" : answer?.skips_object ? "doubt" : "dim";
  summary.textContent = answer?.nothing_to_fit ?? answer?.skips_object ?? (skipped.length ? "These stages have nothing to do; the others will run:" : "All stages will run.");
  for (const id of sequences) summary.append(" ", link(id));
  const groups = new Map();
  for (const [name, stage] of answer?.nothing_to_fit ? [] : skipped) {
    if (!groups.has(stage.why)) groups.set(stage.why, { state: stage.state, names: [] });
    groups.get(stage.why).names.push(name.replaceAll("_", " "));
  }
  place.querySelector("[data-lights]").replaceChildren(...[...groups].map(([why, { state, names }]) => {
    const item = Object.assign(document.createElement("li"), { className: state.replace(" ", "-") });
    item.append(Object.assign(document.createElement("strong"), { textContent: names.join(", ") }), ` – skipped: ${why}`);
    return item;
  }));
  const accept = place.querySelector("[data-accept]");
  accept.hidden = !answer?.skips_object;
  const box = accept.querySelector("input");
  box.required = !accept.hidden;
  if (accept.hidden) box.checked = false;
}

async function launch(form) {
  const fields = new FormData(form);
  const run = await send("POST", "api/v1/runs", {
    sequences: [fields.get("sequence")],
    profile: fields.get("profile"),
    name: fields.get("name"),
    accepts_missing: fields.has("accepts_missing"),
    priority: fields.get("priority"),
  });
  form.closest("dialog").close();
  form.reset();
  toast(`“${run.name}” is in line`, false, { href: `runs/${run.id}`, textContent: "Watch it" });
  refresh("runs");
  const heading = document.getElementById("runs-heading");
  if (heading) heading.scrollIntoView({ behavior: "smooth" });
  else location.href = "runs";
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (event.target.matches("dialog")) event.target.close();
  const slow = event.target.closest("a[data-slow-file]");
  if (slow) {
    event.preventDefault();
    fetchSlowFile(slow.href, slow.dataset.slowFile).catch((error) => toast(error.message, true));
  }
  if (!button) return;
  const data = button.dataset;
  if ("open" in data) busy(button, () => openScene(button));
  else if ("act" in data) busy(button, () => act(button));
  else if ("removeExpendable" in data) busy(button, removeExpendable);
  else if ("priority" in data) busy(button, () => setPriority(button));
  else if ("aside" in data) busy(button, () => moveAside(button));
  else if ("delete" in data) busy(button, () => remove(button));
  else if ("share" in data) busy(button, () => shareView(data.share, ""));
  else if ("new" in data) showForm(button);
  else if ("help" in data) document.getElementById("help").showModal();
  else if ("close" in data) button.closest("dialog").close();
});

/* Addresses of a page are relative to its base; a place on the page is not. */
document.addEventListener("click", (event) => {
  const link = event.target.closest("a[href^='#']");
  if (!link || event.defaultPrevented) return;
  event.preventDefault();
  if (link.hash) location.hash = link.hash;
});

document.addEventListener("change", (event) => {
  if (event.target.matches("#launch [name=sequence]")) askReadiness(event.target.closest("dialog"));
});

document.addEventListener("submit", (event) => {
  if (event.target.id !== "launch" || event.submitter?.matches("[data-more]")) return;
  event.preventDefault();
  busy(event.target.querySelector("[type=submit]"), () => launch(event.target));
});

document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  const help = document.getElementById("help");
  if (event.key === "?") help.open ? help.close() : help.showModal();
  else if (document.querySelector("dialog[open]")) return;
  else if (event.key === "h") location.href = ".";
  else if (event.key === "/" && document.querySelector("[data-filter]")) {
    event.preventDefault();
    document.querySelector("[data-filter]").select();
  }
  else if (event.key === "n") showForm();
  else if (event.key === "o") document.querySelector("[data-featured], #run [data-open]")?.click();
});

/* ---- what changes while one looks: one event stream per page, closed while it is hidden ---- */

function duration(seconds) {
  if (seconds > 0 && seconds < 9.95) return `${seconds.toFixed(1)} s`;
  const [hours, minutes, rest] = [Math.floor(seconds / 3600), Math.floor((seconds % 3600) / 60), Math.floor(seconds % 60)];
  if (hours) return `${hours} h ${minutes} min`;
  return minutes ? `${minutes} min ${rest} s` : `${rest} s`;
}

/** Write a time that is only estimated. */
function about(seconds) {
  if (seconds < 5) return "a few seconds";
  const step = seconds < 60 ? 5 : seconds < 600 ? 10 : 60;
  const rounded = Math.max(step, Math.round(seconds / step) * step);
  return `about ${rounded < 60 ? `${rounded} s` : duration(rounded)}`;
}

function describe(report, estimate) {
  const parts = [report.stage.replaceAll("_", " "), `${report.iteration} of ${report.total}`];
  if (Number.isFinite(report.loss)) parts.push(`loss ${report.loss.toPrecision(4)}`);
  if (Number.isFinite(estimate?.left_s)) parts.push(`${about(estimate.left_s)} left`);
  else if (report.eta_s > 0) parts.push(`${about(report.eta_s)} left in this stage`);
  return parts.join(" · ");
}

function showProgress(row, run) {
  const bar = row.querySelector("progress");
  const text = row.querySelector("[data-text]");
  if (!bar || !text || !run.progress.total) return false;
  bar.max = run.progress.total;
  bar.value = run.progress.iteration;
  text.textContent = describe(run.progress, run.estimate);
  return true;
}

function onListedRun(run) {
  const row = [...document.querySelectorAll("#runs [data-run]")].find((line) => line.dataset.run === run.id);
  const isMoving = row && row.dataset.state === run.state && run.state === "running";
  if (!isMoving || !showProgress(row, run)) refresh("runs");
}

/* What a page does on each kind of event; a page with another stream puts its own here. */
const listeners = {
  run: onListedRun,
  gone: () => refresh("runs"),
  reset: () => refresh("runs"),
};
const RETRY_MS = 5000;
let stream = null;
let cursor = null;

function follow() {
  if (stream || document.hidden || !cursor) return;
  const address = document.body.dataset.stream ?? "api/v1/events";
  stream = new EventSource(`${address}?since=${encodeURIComponent(cursor)}`);
  for (const name of Object.keys(listeners)) {
    stream.addEventListener(name, (event) => {
      cursor = event.lastEventId;
      listeners[name](JSON.parse(event.data));
    });
  }
  const offline = document.querySelector("[data-offline]");
  stream.addEventListener("open", () => (offline.hidden = true));
  stream.addEventListener("error", () => {
    offline.hidden = false;
    if (stream?.readyState !== EventSource.CLOSED) return; // The browser comes back by itself.
    unfollow();
    setTimeout(follow, RETRY_MS);
  });
}

function unfollow() {
  stream?.close();
  stream = null;
}

document.addEventListener("visibilitychange", () => (document.hidden ? unfollow() : follow()));
addEventListener("pagehide", unfollow);
addEventListener("pageshow", follow);

/* ---- what a word means: shown beside it while it is pointed at or in focus ---- */

function explain(place) {
  const tip = document.getElementById("tip") ?? document.body.appendChild(Object.assign(document.createElement("div"), { id: "tip", role: "tooltip" }));
  tip.hidden = !place;
  document.querySelector("[aria-describedby=tip]")?.removeAttribute("aria-describedby");
  if (!place) return;
  tip.textContent = place.dataset.about;
  place.setAttribute("aria-describedby", "tip");
  const box = place.getBoundingClientRect();
  const above = box.top - tip.offsetHeight - 6;
  tip.style.left = `${Math.max(8, Math.min(box.left, innerWidth - tip.offsetWidth - 8))}px`;
  tip.style.top = `${above > 8 ? above : box.bottom + 6}px`;
}

for (const [begin, end] of [["mouseover", "mouseout"], ["focusin", "focusout"]]) {
  document.addEventListener(begin, (event) => event.target.dataset?.about && explain(event.target));
  document.addEventListener(end, (event) => event.target.dataset?.about && explain(null));
}
addEventListener("scroll", () => explain(null), { capture: true, passive: true });
addEventListener("keydown", (event) => event.key === "Escape" && explain(null));

/* ---- start ---- */

function showLocalTimes(root = document) {
  for (const place of root.querySelectorAll("time")) {
    place.textContent = new Date(place.dateTime).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  }
}

document.addEventListener("error", (event) => {
  if (event.target.matches?.("img[data-thumbnail]")) event.target.classList.add("missing");
}, true);

document.addEventListener("DOMContentLoaded", () => {
  for (const link of document.querySelectorAll(".bar nav a")) {
    if (`${location.pathname}/`.startsWith(`${link.pathname}/`)) link.setAttribute("aria-current", "page");
  }
  cursor = document.body.dataset.since ?? null;
  showLocalTimes();
  follow();
});

document.addEventListener("htmx:afterSettle", () => showLocalTimes());
