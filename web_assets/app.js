"use strict";

function toast(text, bad) {
  const line = document.createElement("p");
  line.textContent = text;
  if (bad) line.className = "bad";
  document.getElementById("toast").append(line);
  setTimeout(() => line.remove(), bad ? 9000 : 4000);
}

async function send(method, url, body) {
  const response = await fetch(url, {
    method,
    headers: body ? { "Content-Type": "application/json" } : {},
    body: body ? JSON.stringify(body) : undefined,
  });
  if (response.ok) return response.status === 204 ? null : response.json();
  const answer = await response.json().catch(() => null);
  throw new Error(answer?.error?.message ?? `The server answered ${response.status}.`);
}

async function busy(button, work) {
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

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  if (button.dataset.open) {
    busy(button, async () => {
      const session = await send("POST", "/api/v1/sessions", { kind: button.dataset.open, id: button.dataset.id });
      location.href = session.url;
    });
  } else if (button.dataset.act) {
    busy(button, async () => {
      await send("POST", `/api/v1/runs/${button.dataset.id}/${button.dataset.act}`);
      toast(button.dataset.act === "cancel" ? "Cancelling" : "Queued again");
      if (!document.getElementById("runs")) location.reload();
    });
  } else if ("help" in button.dataset) {
    document.getElementById("help").showModal();
  } else if ("close" in button.dataset) {
    button.closest("dialog").close();
  }
});

document.addEventListener("submit", (event) => {
  const form = event.target.closest("form.launch");
  if (!form) return;
  event.preventDefault();
  busy(form.querySelector("[type=submit]"), async () => {
    const fields = new FormData(form);
    const run = await send("POST", "/api/v1/runs", {
      sequences: [form.dataset.sequence],
      profile: fields.get("profile"),
      name: fields.get("name"),
    });
    toast(`Queued: ${run.name}`);
    form.reset();
  });
});

document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey) return;
  const help = document.getElementById("help");
  if (event.key === "?") help.open ? help.close() : help.showModal();
  else if (event.key === "h") location.href = "/";
  else if (event.key === "n") {
    event.preventDefault();
    document.querySelector("form.launch input")?.focus();
  }
});

function drawCurve(place) {
  const curve = JSON.parse(place.dataset.curve).filter((point) => Number.isFinite(point[1]));
  if (curve.length < 2) return;
  const data = [curve.map((point) => point[0]), curve.map((point) => point[1])];
  const grey = getComputedStyle(document.body).color;
  const axis = { stroke: grey, grid: { stroke: "rgb(128 128 128 / 20%)" }, size: 46 };
  new uPlot({
    width: place.clientWidth || 320,
    height: 150,
    legend: { show: false },
    scales: { x: { time: false }, y: { distr: data[1].every((value) => value > 0) ? 3 : 1 } },
    axes: [axis, { ...axis, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : tick.toExponential(0))), size: 56 }],
    series: [{}, { stroke: "#1f6feb", width: 2, points: { show: data[0].length < 30 } }],
  }, data, place);
}

function followProgress(section) {
  const bar = section.querySelector("progress");
  const text = section.querySelector("[data-text]");
  const source = new EventSource(section.dataset.events);
  source.addEventListener("progress", (event) => {
    const report = JSON.parse(event.data);
    bar.max = report.total;
    bar.value = report.iteration;
    const loss = report.loss === null ? "" : ` · loss ${report.loss.toPrecision(4)}`;
    text.textContent = `${report.stage.replaceAll("_", " ")} ${report.iteration}/${report.total}${loss} ${report.message}`;
  });
  const state = document.querySelector("[data-run]").dataset;
  const timer = setInterval(async () => {
    const run = await send("GET", `/api/v1/runs/${state.run}`).catch(() => null);
    if (run && run.state !== state.state) {
      clearInterval(timer);
      location.reload();
    }
  }, 2000);
}

document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll(".chart").forEach(drawCurve);
  const progress = document.getElementById("live-progress");
  if (progress && !progress.hidden) followProgress(progress);
  const scene = document.getElementById("scene");
  scene?.addEventListener("load", () => scene.contentWindow.focus());
});
