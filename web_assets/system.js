"use strict";

/* The page of the machine: its load, what is at work and what waits. */

function cell(...content) {
  const made = document.createElement("td");
  made.append(...content);
  return made;
}

function runLink(run) {
  const link = Object.assign(document.createElement("a"), { href: `runs/${run.id}`, textContent: run.name });
  const small = Object.assign(document.createElement("div"), { className: "dim small", textContent: `${run.sequences.join(", ")} · ${run.profile || run.kind}` });
  return [link, small];
}

/** Make a cell of buttons, for who may do more than look. */
const actionCell = (...buttons) => cell(...(document.querySelector("[data-only-looks]") ? [] : buttons));

function cancelButton(run) {
  const button = Object.assign(document.createElement("button"), { className: "secondary outline", textContent: "Cancel" });
  Object.assign(button.dataset, { act: "cancel", id: run.id });
  button.disabled = run.state === "stopping";
  button.setAttribute("aria-label", `Cancel ${run.name}`);
  return button;
}

/** Offer the priorities above and below that of a run in line. */
function urgencyButtons(run) {
  const offered = { low: { normal: "▲" }, normal: { high: "▲", low: "▼" }, high: { normal: "▼" } }[run.priority] ?? {};
  return Object.entries(offered).map(([priority, sign]) => {
    const button = Object.assign(document.createElement("button"), { className: "secondary outline", textContent: sign, title: `${priority[0].toUpperCase()}${priority.slice(1)} priority` });
    Object.assign(button.dataset, { priority, id: run.id });
    button.setAttribute("aria-label", `${button.title} for ${run.name}`);
    return button;
  });
}

function numberCell(text) {
  const made = cell(text);
  made.className = "number";
  return made;
}

/** Fill a table; rows stay where they are, so that a button in focus keeps it. */
function fill(table, runs, cells) {
  const body = table.tBodies[0];
  const known = new Map([...body.rows].map((row) => [row.dataset.run, row]));
  runs.forEach((run, index) => {
    const row = known.get(run.id) ?? body.insertRow();
    known.delete(run.id);
    row.dataset.run = run.id;
    const fresh = cells(run);
    fresh.forEach((made, i) => {
      const old = row.cells[i];
      if (!old) row.append(made);
      else if (!old.isEqualNode(made)) old.replaceWith(made);
    });
    if (body.rows[index] !== row) body.insertBefore(row, body.rows[index]);
  });
  for (const row of known.values()) row.remove();
}

function showSystem({ machine, slots, running, waiting }) {
  showMachine(document, machine);
  const hasCard = machine.cards.length > 0;
  document.querySelector("[data-if-card]").hidden = !hasCard;
  document.querySelector("[data-slots]").textContent = `${slots.used} of ${slots.total} place${slots.total === 1 ? "" : "s"} for fits taken${waiting.length ? `, ${waiting.length} in line` : ""}`;
  document.getElementById("running").hidden = !running.length;
  document.getElementById("idle").hidden = running.length > 0;
  document.getElementById("line").hidden = !waiting.length;
  fill(document.getElementById("running"), running, (run) => {
    const { progress, estimate, load } = run;
    const stage = progress.total ? `${progress.stage.replaceAll("_", " ")} · ${progress.iteration} of ${progress.total}` : run.reason || run.state;
    const left = cell(estimate ? about(estimate.left_s) : "–");
    if (estimate) left.title = `Estimated ${estimate.basis}`;
    const cells = [cell(...runLink(run)), cell(stage), left, numberCell(load ? load.processors.toFixed(1) : "–"), numberCell(bytes(load?.memory))];
    if (hasCard) cells.push(numberCell(bytes(load?.card_memory)));
    return [...cells, actionCell(cancelButton(run))];
  });
  fill(document.getElementById("waiting"), waiting, (run) => [
    cell(run.place ? `No. ${run.place}` : "–"), cell(...runLink(run)), cell(run.priority ?? "normal"), cell(run.reason),
    cell(run.estimate ? `in ${about(run.estimate.starts_in_s)}` : "–"), actionCell(...urgencyButtons(run), cancelButton(run)),
  ]);
}

document.addEventListener("DOMContentLoaded", () => {
  showSystem(JSON.parse(document.getElementById("now").textContent));
  listeners.system = showSystem;
  cursor = "0";
  follow();
});
