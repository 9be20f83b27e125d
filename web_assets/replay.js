"use strict";

/* The page of a replay: has it recorded, says how far that is, and plays it. */

{
  const POLL_MS = 300;
  const place = document.querySelector("[data-replay]");
  const { replay, sequence, camera } = place.dataset;
  const isDark = matchMedia("(prefers-color-scheme: dark)");
  const theme = place.dataset.theme || (isDark.matches ? "dark" : "light");
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));

  function play(file) {
    const query = new URLSearchParams(camera);
    query.set("playbackPath", file.url);
    if (theme === "dark") query.set("darkMode", "");
    const frame = document.createElement("iframe");
    frame.id = "scene";
    frame.title = `Replay of ${document.title}`;
    frame.allow = "fullscreen";
    frame.src = `viewer/replay/?${query}`;
    frame.addEventListener("load", () => frame.contentWindow.focus());
    place.replaceChildren(frame);
    const link = document.querySelector("[data-replay-file]");
    link.href = file.url;
    link.append(`, ${(file.bytes / 1e6).toFixed(1)} MB`);
  }

  function tell(file) {
    const bar = place.querySelector("[data-replay-progress]");
    if (file.of) {
      bar.max = file.of;
      bar.value = file.done;
      place.querySelector("[data-replay-text]").textContent = `Recording frame ${file.done} of ${file.of} …`;
    }
  }

  function fail(message) {
    place.querySelector("[data-replay-progress]").remove();
    const text = place.querySelector("[data-replay-text]");
    text.className = "problem";
    text.setAttribute("role", "alert");
    text.textContent = `There is no replay: ${message}`;
    place.querySelector(".dim").remove();
  }

  async function prepare() {
    const address = `${replay}?${new URLSearchParams({ sequence, theme })}`;
    for (;;) {
      const file = await send("POST", address);
      if (file.state === "ready") return play(file);
      if (file.state === "failed") return fail(file.message);
      tell(file);
      await wait(POLL_MS);
    }
  }

  document.querySelector("[data-submit]")?.addEventListener("change", (event) => event.target.form.submit());
  prepare().catch((error) => fail(error.message));
}
