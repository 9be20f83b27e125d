"use strict";

/* ---- runs chosen for a comparison: kept while the list is filtered, sorted and turned over ---- */

const MOST_CHOSEN = 5;
const STORE = "physhandi-chosen-runs";
const chosen = new Set(JSON.parse(sessionStorage.getItem(STORE) ?? "[]"));

function showChosen() {
  const bar = document.querySelector("[data-chosen]");
  if (!bar) return;
  for (const box of document.querySelectorAll("[data-choose]")) {
    box.checked = chosen.has(box.value);
    box.closest("tr").classList.toggle("is-chosen", box.checked);
  }
  const part = (name) => bar.querySelector(`[data-chosen-${name}]`);
  const [first, second] = chosen;
  const isEnough = chosen.size >= 2;
  bar.classList.toggle("is-empty", chosen.size === 0);
  part("text").textContent = chosen.size
    ? `${chosen.size} run${chosen.size === 1 ? "" : "s"} chosen${isEnough ? "" : "; choose another one to compare"}`
    : `Choose 2 to ${MOST_CHOSEN} runs to compare them.`;
  part("diff").disabled = !isEnough;
  part("scene").hidden = chosen.size !== 2;
  if (chosen.size === 2) part("scene").href = `compare?${new URLSearchParams({ a: first, b: second })}`;
  part("clear").hidden = chosen.size === 0;
  sessionStorage.setItem(STORE, JSON.stringify([...chosen]));
}

function choose(box) {
  if (box.checked && chosen.size >= MOST_CHOSEN) toast(`At most ${MOST_CHOSEN} runs can be compared at a time.`, true);
  else if (box.checked) chosen.add(box.value);
  else chosen.delete(box.value);
  showChosen();
}

document.addEventListener("change", (event) => event.target.matches("[data-choose]") && choose(event.target));

document.addEventListener("click", (event) => {
  if (!event.target.closest("[data-chosen-clear]")) return;
  chosen.clear();
  showChosen();
});

document.addEventListener("submit", (event) => {
  if (event.target.id !== "diff") return;
  event.preventDefault(); // Runs that are chosen on another page of the list count too.
  location.href = `diff?${new URLSearchParams([...chosen].map((id) => ["run", id]))}`;
});

/* ---- pictures that are still being made appear as soon as they are there ---- */

const PAUSE_MS = 1200;
const ASKED_AT_ONCE = 8;
let isAsking = false;

function image(name, address) {
  return Object.assign(new Image(384, 240), { className: name, alt: "", src: address, loading: "lazy" });
}

async function ask(place) {
  const response = await fetch(place.dataset.pending).catch(() => null);
  const picture = response?.ok ? await response.json() : { state: "none" };
  if (picture.still && !place.firstChild) place.append(image("still", picture.still));
  if (picture.state === "pending") return false;
  place.removeAttribute("data-pending");
  place.classList.remove("pending");
  if (picture.state === "ready") place.append(image("moving", picture.moving));
  else if (!place.firstChild) place.classList.add("none");
  return true;
}

async function askForPictures() {
  if (isAsking) return;
  isAsking = true;
  for (let places = []; (places = [...document.querySelectorAll("[data-pending]")]).length; ) {
    let waiting = 0;
    for (const place of document.hidden ? [] : places) {
      waiting += (await ask(place)) ? 0 : 1;
      if (waiting >= ASKED_AT_ONCE) break;
    }
    await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
  }
  isAsking = false;
}

document.addEventListener("load", (event) => {
  if (event.target.matches?.("img.moving")) event.target.closest(".shot").classList.add("is-loaded");
}, true);

/* ---- start ---- */

function settle() {
  showChosen();
  askForPictures();
}

document.addEventListener("htmx:afterSettle", settle);
document.addEventListener("DOMContentLoaded", settle);
addEventListener("pageshow", showChosen);
