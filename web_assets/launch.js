"use strict";

/* Settings of a fit: what differs from the profile is shown, checked by the server and sent. */

const order = document.getElementById("order");
const rows = [...order.querySelectorAll("[data-setting]")];
const CHECK_MS = 350;

/* A number that nobody touched is the exact one, of which the field shows six digits. */
const isUntouched = (input) => input.dataset.exact !== undefined && input.value === input.defaultValue;
const numberOf = (input) => (input.value === "" ? null : Number(isUntouched(input) ? input.dataset.exact : input.value));

function valueOf(row) {
  const kind = row.dataset.kind;
  if (kind === "interval") {
    if (!row.querySelector("[data-on]").checked) return null;
    return { low: numberOf(row.querySelector("[data-low]")), high: numberOf(row.querySelector("[data-high]")), scale: row.querySelector("[data-scale]").value };
  }
  const input = row.querySelector(".field input, .field select");
  if (kind === "switch") return input.checked;
  if (kind === "choice") return input.value;
  if (input.validity.badInput) return "no number";
  return numberOf(input);
}

function setValue(row, value) {
  if (row.dataset.kind === "interval") {
    row.querySelector("[data-on]").checked = value !== null;
    if (value) for (const end of ["low", "high", "scale"]) row.querySelector(`[data-${end}]`).value = value[end];
    return;
  }
  const input = row.querySelector(".field input, .field select");
  if (row.dataset.kind === "switch") input.checked = value;
  else input.value = Number(input.dataset.exact) === value ? input.defaultValue : (value ?? "");
}

function isSame(a, b) {
  if (a === null || b === null || typeof a !== "object") return a === b;
  return a.low === b.low && a.high === b.high && a.scale === b.scale;
}

function shown(value) {
  if (value === null) return "none";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "object") return `${value.low ?? "?"} to ${value.high ?? "?"}${value.scale === "linear" ? "" : ` (${value.scale})`}`;
  return typeof value === "number" ? String(Number(value.toPrecision(6))) : value;
}

/** The values that differ from the profile, by the path of the setting. */
function changed() {
  const found = {};
  for (const row of rows) {
    const value = valueOf(row);
    if (!isSame(value, JSON.parse(row.dataset.base))) found[row.dataset.setting] = value;
  }
  return found;
}

function draft() {
  const sequences = [...order.querySelectorAll("[name=sequence]:checked")].map((box) => box.value);
  return { sequences, profile: order.dataset.profile, overrides: changed() };
}

/** Suggest an interval around the value that the search starts from. */
function suggest(row) {
  const [low, high] = ["[data-low]", "[data-high]"].map((end) => row.querySelector(end));
  if (low.value !== "" || high.value !== "") return;
  const start = rows.find((other) => other.dataset.setting === `simulation.${row.dataset.setting.split(".").at(-1)}`);
  const value = start ? valueOf(start) : null;
  if (!(value > 0)) return;
  const scale = row.querySelector("[data-scale]");
  const tidy = (number) => (scale.value === "integer" ? Math.round(number) : Number(number.toPrecision(2)));
  low.value = Math.max(tidy(value / 3), low.min === "" ? -Infinity : Number(low.min));
  high.value = Math.min(tidy(value * 3), high.max === "" ? Infinity : Number(high.max));
  if (scale.value !== "integer") scale.value = "log";
}

function mark(row, isChanged) {
  const isInterval = row.dataset.kind === "interval";
  row.classList.toggle("changed", isChanged);
  const base = row.querySelector(".base");
  base.hidden = !isChanged;
  base.textContent = isInterval && row.dataset.base === "null" ? "not searched in the profile" : `${row.dataset.baseText} in the profile`;
  if (isInterval) {
    const isOn = row.querySelector("[data-on]").checked;
    for (const input of row.querySelectorAll("[data-low], [data-high], [data-scale]")) input.disabled = !isOn;
  }
}

function show() {
  const overrides = changed();
  for (const row of rows) mark(row, row.dataset.setting in overrides);
  for (const group of order.querySelectorAll("details[data-group]")) {
    const count = group.querySelectorAll(".changed").length;
    group.querySelector("[data-count]").textContent = count ? `${count} changed` : "";
  }
  const list = order.querySelector("[data-changes]");
  list.replaceChildren(...rows.filter((row) => row.dataset.setting in overrides).map((row) => {
    const item = document.createElement("li");
    const undo = Object.assign(document.createElement("button"), { type: "button", className: "mini", textContent: "↺", title: "As in the profile" });
    undo.dataset.undo = row.dataset.setting;
    undo.setAttribute("aria-label", `${row.dataset.name} as in the profile`);
    const name = Object.assign(document.createElement("strong"), { textContent: row.dataset.name });
    const isInterval = row.dataset.kind === "interval";
    const text = (value) => (isInterval && value === null ? "not searched" : shown(value));
    const where = Object.assign(document.createElement("span"), { className: "dim", textContent: row.dataset.group });
    item.append(undo, name, ` ${text(JSON.parse(row.dataset.base))} → ${text(overrides[row.dataset.setting])}`, document.createElement("br"), where);
    return item;
  }));
  const count = Object.keys(overrides).length;
  order.querySelector("[data-title]").textContent = count ? `${count} change${count === 1 ? "" : "s"} to ${order.dataset.profile}` : `As ${order.dataset.profile} has it`;
  order.querySelector("[data-reset]").hidden = !count;
}

/* ---- what the server says ---- */

let asked = 0;
let timer = null;

/** Say beside each setting what is wrong with it, and above the button that something is. */
function complain(problems, message) {
  const known = new Map((problems ?? []).map(({ field, message: told }) => [field, told]));
  for (const row of rows) {
    const told = known.get(row.dataset.setting);
    row.classList.toggle("bad", Boolean(told));
    row.querySelector(".wrong").hidden = !told;
    // Its name stands beside it already.
    row.querySelector(".wrong").textContent = told ? told.replace(`${row.dataset.setting} `, "It ") : "";
    if (told) row.closest("details").open = true;
  }
  const problem = order.querySelector("[data-problem]");
  const text = known.size ? `${known.size} setting${known.size === 1 ? "" : "s"} cannot be used; see what is marked.` : (message ?? "");
  problem.hidden = !text;
  problem.textContent = text;
}

async function check() {
  const number = ++asked;
  const wanted = draft();
  const answer = await send("POST", "api/v1/runs/check", wanted).catch((error) => ({ problems: [], message: error.message }));
  if (number !== asked) return;
  const { problems, expected, message } = answer;
  complain(problems, message);
  showReadiness(order.querySelector("[data-readiness]"), answer, wanted.sequences);
  const place = order.querySelector("[data-expected]");
  place.textContent = !wanted.sequences.length ? "Choose at least one sequence." : expected ? `Takes ${about(expected.seconds)}, estimated ${expected.basis}.` : "";
}

function onChange() {
  show();
  clearTimeout(timer);
  timer = setTimeout(check, CHECK_MS);
}

async function submit() {
  const accept = order.querySelector("[name=accepts_missing]");
  const response = await fetch("api/v1/runs", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ ...draft(), name: order.querySelector("[name=name]").value, parent: order.dataset.parent ?? null, accepts_missing: accept.checked, priority: order.querySelector("[name=priority]").value }),
  }).catch(() => {
    throw new Error("The server does not answer. Is it still running?");
  });
  const answer = await response.json();
  if (response.ok) location.href = `runs/${answer.id}`;
  else complain(answer.error.fields, answer.error.message);
}

/* ---- start ---- */

function find(words) {
  const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
  for (const group of order.querySelectorAll("details[data-group]")) {
    let hits = 0;
    for (const row of group.querySelectorAll("[data-setting]")) {
      const text = `${row.dataset.name} ${row.dataset.group} ${row.querySelector(".about").dataset.about}`.toLowerCase();
      row.hidden = !wanted.every((word) => text.includes(word));
      if (!row.hidden) hits++;
    }
    group.hidden = hits === 0;
    if (wanted.length) group.open = hits > 0;
  }
}

order.addEventListener("input", ({ target }) => {
  if ("on" in target.dataset && target.checked) suggest(target.closest("[data-setting]"));
  if ("find" in target.dataset) find(target.value);
  else if (!["accepts_missing", "priority"].includes(target.name)) onChange();
});
order.addEventListener("change", (event) => {
  if (!("profileChoice" in event.target.dataset)) return;
  const address = new URL(location.href);
  address.searchParams.set("profile", event.target.value);
  location.href = address;
});
order.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  const undone = !button ? [] : "reset" in button.dataset ? rows : "undo" in button.dataset ? rows.filter((row) => row.dataset.setting === button.dataset.undo) : button.matches(".undo") ? [button.closest("[data-setting]")] : [];
  for (const row of undone) setValue(row, JSON.parse(row.dataset.base));
  if (undone.length) onChange();
});
order.addEventListener("submit", (event) => {
  event.preventDefault();
  busy(order.querySelector("[type=submit]"), submit);
});
document.addEventListener("DOMContentLoaded", () => {
  show();
  for (const group of order.querySelectorAll("details[data-group]")) if (group.querySelector(".changed")) group.open = true;
  check();
});
