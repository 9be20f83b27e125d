"use strict";

/* Importing a recording: the example, and the form below what a folder holds. */

const POLL_MS = 400;

/** Follow work of the server until it ends. */
async function watch(box, address, onDone, job) {
  const at = (name) => box.querySelector(`[data-${name}]`);
  const stop = at("stop");
  const begin = box.querySelector("[type=submit], [data-example]");
  stop.onclick = () => busy(stop, () => send("DELETE", address));
  for (;;) {
    const isRunning = job.state === "running";
    at("work").hidden = stop.hidden = !isRunning;
    begin.hidden = isRunning;
    at("failed").hidden = job.state !== "failed";
    at("failed").textContent = job.reason;
    if (at("stopped")) at("stopped").hidden = job.state !== "cancelled";
    if (job.state === "done") return onDone(job.result);
    if (!isRunning) return null;
    const { stage, iteration, total, message } = job.progress;
    const bar = box.querySelector("progress");
    if (total) [bar.max, bar.value] = [total, iteration];
    else bar.removeAttribute("value");
    at("progress").textContent = stage ? `${stage.replaceAll("_", " ")} · ${iteration} of ${total}${message ? ` · ${message}` : ""}` : at("progress").dataset.waiting;
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    job = await send("GET", address).catch(() => job);
  }
}

function orderOf(form) {
  const fields = new FormData(form);
  const order = { source: form.dataset.source, hands: fields.getAll("hands"), overwrite: fields.has("overwrite"), by_table: fields.has("by_table") };
  for (const name of ["name", "charuco", "april_grid", "intrinsics"]) order[name] = fields.get(name).trim();
  for (const name of ["depth_scale", "start", "stop", "every", "frame_rate"]) if (fields.get(name) !== "") order[name] = Number(fields.get(name));
  return order;
}

document.addEventListener("submit", (event) => {
  if (event.target.id !== "import") return;
  event.preventDefault();
  const form = event.target;
  busy(form.querySelector("[type=submit]"), async () => {
    const order = orderOf(form);
    const job = await send("POST", "api/v1/imports", order);
    await watch(form, `api/v1/imports/${order.name}`, () => (location.href = `sequences/${order.name}/check`), job);
  });
});

/* A look at a recording that failed is told in its place. */
document.addEventListener("htmx:responseError", ({ detail }) => {
  if (detail.target.id !== "survey") return;
  let message = `The server answered ${detail.xhr.status}.`;
  try {
    message = JSON.parse(detail.xhr.responseText).error.message;
  } catch {} // Not one of its own answers.
  const place = detail.target.querySelector("p");
  place.className = "problem";
  place.removeAttribute("aria-busy");
  place.textContent = message;
});

const example = document.getElementById("example");
if (example) {
  const choose = () => (location.href = `import?folder=${encodeURIComponent(example.dataset.place)}`);
  const address = "api/v1/captures/example";
  example.querySelector("[data-example]").addEventListener("click", ({ target }) => {
    if ("there" in example.dataset) choose();
    else busy(target, async () => watch(example, address, choose, await send("POST", address)));
  });
  document.addEventListener("DOMContentLoaded", async () => {
    const job = await send("GET", address);
    if (job.state === "running") watch(example, address, choose, job);
  });
}
