"use strict";

/* Name, tags and note of a run, changed in place. */

const aboutForm = document.getElementById("about");

function edit(isOn) {
  aboutForm.hidden = !isOn;
  document.body.classList.toggle("is-editing", isOn);
  if (isOn) aboutForm.elements.name.select();
  else {
    aboutForm.reset();
    document.querySelector("[data-edit-about]")?.focus();
  }
}

async function saveAbout() {
  const { name, tags, note } = aboutForm.elements;
  const run = await send("PATCH", `api/v1/runs/${aboutForm.dataset.run}`, {
    name: name.value, tags: tags.value.split(/[\s,]+/).filter(Boolean), note: note.value,
  });
  // What was saved is what the form begins with the next time.
  name.defaultValue = run.name;
  tags.defaultValue = run.tags.join(" ");
  note.defaultValue = run.note;
  document.title = `${run.name} · PhysHanDI`;
  document.querySelector("nav[aria-label=breadcrumb] li:last-child").textContent = run.name;
  await refreshParts();
  edit(false);
}

if (aboutForm) {
  document.addEventListener("click", (event) => {
    if (event.target.closest("[data-edit-about]")) edit(true);
    else if (event.target.closest("[data-about-cancel]")) edit(false);
  });
  aboutForm.addEventListener("submit", (event) => {
    event.preventDefault();
    busy(aboutForm.querySelector("[type=submit]"), saveAbout);
  });
  aboutForm.addEventListener("keydown", (event) => {
    if (event.key === "Escape") edit(false);
    else if (event.key === "Enter" && event.ctrlKey) aboutForm.requestSubmit();
  });
}
