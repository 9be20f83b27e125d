"use strict";

/* Two runs in one live scene, with their numbers below: opens the scene, follows it, draws charts. */

{
  const FOLLOW_MS = 2000;
  const STORE = "physhandi-comparison";
  const place = document.querySelector("[data-compare]");
  const ask = JSON.parse(place.dataset.compare);
  const scene = document.getElementById("scene");
  const waiting = document.querySelector("[data-waiting]");
  const isDark = matchMedia("(prefers-color-scheme: dark)");
  let session = null;

  const given = (fields) => Object.fromEntries(Object.entries(fields).filter(([, value]) => value !== null));
  const wish = (wishes) => send("PATCH", `api/v1/sessions/${session}`, wishes).catch((error) => toast(error.message, true));
  const dress = () => session && wish({ dark: isDark.matches });

  /* A page that is loaded again goes on with its scene, if that still shows these runs. */
  async function known() {
    if (performance.getEntriesByType("navigation")[0]?.type === "navigate") return null;
    const kept = JSON.parse(sessionStorage.getItem(STORE) ?? "null");
    if (!kept || kept.pair !== JSON.stringify([ask.a, ask.b, ask.sequence])) return null;
    return send("GET", `api/v1/sessions/${kept.session}`).then(() => kept.session, () => null);
  }

  async function open() {
    try {
      session = (await known()) ?? (await send("POST", "api/v1/sessions", { kind: "comparison", ...given(ask) })).id;
    } catch (error) {
      waiting.removeAttribute("aria-busy");
      waiting.textContent = error.message;
      waiting.className = "waiting problem";
      return;
    }
    scene.src = `viewer/${session}/`;
    scene.hidden = false;
  }

  /* A scene that another tab shows already is copied by the server, which sends the frame on. */
  function settle() {
    const shown = /\/viewer\/([\w-]+)\/$/.exec(scene.contentWindow.location.pathname)?.[1];
    if (!shown) return;
    session = shown;
    sessionStorage.setItem(STORE, JSON.stringify({ session, pair: JSON.stringify([ask.a, ask.b, ask.sequence]) }));
    waiting.hidden = true;
    scene.contentWindow.addEventListener("keydown", onKey);
    wireScene(scene, (frame) => wish({ frame }));
    dress();
    scene.contentWindow.focus({ preventScroll: true });
  }

  const link = () => send("GET", `api/v1/sessions/${session}/link`);

  async function copyLink() {
    const address = new URL((await link()).url, document.baseURI).href;
    const inside = document.activeElement === scene ? scene.contentWindow : window;
    if (await copyText(address, inside)) toast("Link copied: it opens this comparison as you see it now.");
  }

  function onKey(event) {
    const isTyping = event.target.matches?.("input:not([type=checkbox]), textarea, select");
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.key.toLowerCase() === "p") copyLink().catch((error) => toast(error.message, true));
  }

  /* The address bar follows what is seen; a scene that was closed says so. */
  async function follow() {
    if (document.hidden || !session) return;
    const answer = await fetch(`api/v1/sessions/${session}/link`).catch(() => null);
    if (answer?.ok) history.replaceState(null, "", (await answer.json()).url + location.hash);
    else if (answer && !scene.hidden) {
      scene.hidden = true;
      scene.removeAttribute("src");
      waiting.hidden = false;
      waiting.removeAttribute("aria-busy");
      const again = element("button", { textContent: "Open it again" });
      again.addEventListener("click", () => location.reload());
      waiting.replaceChildren("This live scene was closed. ", again);
    }
  }

  /* ---- numbers ---- */

  const TITLES = { track_error: "Track error", chamfer_l2: "Chamfer distance" };

  function draw(charts, title, series, columns, numbers) {
    const [factor, unit] = numbers.unit === "m" ? [1000, "mm"] : [1, numbers.unit];
    const scaled = columns.map((column) => column.map((value) => (Number.isFinite(value) ? value * factor : null)));
    const chart = new Chart(charts, {
      title, xLabel: "frame", unit, series, band: numbers.future_start, sync: "compare", canLog: true, height: 230,
      onPick: (frame) => {
        if (session) wish({ frame });
        scene.scrollIntoView({ behavior: "smooth", block: "end" });
      },
    });
    chart.isLog = false;
    chart.setData([numbers.frames.map((_, tick) => tick), ...scaled]);
  }

  async function loadNumbers() {
    const query = new URLSearchParams(given({ a: ask.a, b: ask.b, sequence: ask.sequence }));
    const numbers = await send("GET", `api/v1/comparison?${query}`);
    const part = document.querySelector("[data-per-frame]");
    const charts = part.querySelector(".charts");
    const notes = part.querySelector("[data-notes]");
    part.hidden = false;
    notes.textContent = numbers.notes.join(" ");
    notes.hidden = !numbers.notes.length;
    const { difference } = numbers;
    if (difference) {
      const lines = [{ label: "mean", color: "--pico-primary" }, { label: "max", color: "--wait", dash: [6, 4] }];
      draw(charts, "Difference of A and B", lines, [difference.mean, difference.largest], numbers);
    }
    for (const [quantity, sides] of Object.entries(numbers.errors)) {
      const lines = ["a", "b"].filter((side) => sides[side]?.some(Number.isFinite));
      if (!lines.length) continue;
      const series = lines.map((side) => ({ label: side.toUpperCase(), color: `--side-${side}` }));
      draw(charts, TITLES[quantity], series, lines.map((side) => sides[side]), numbers);
    }
  }

  /* ---- start ---- */

  function go(changes) {
    location.href = `compare?${new URLSearchParams(given({ ...ask, f: 0, ...changes }))}`;
  }

  forwardKeys(scene);
  scene.addEventListener("load", settle);
  isDark.addEventListener("change", dress);
  document.addEventListener("keydown", onKey);
  document.addEventListener("visibilitychange", follow);
  const button = document.querySelector("[data-copy-link]");
  button.addEventListener("click", () => busy(button, copyLink));
  document.querySelector("[data-exchange]").addEventListener("click", () => go({ a: ask.b, b: ask.a }));
  document.querySelector("[data-sequence]")?.addEventListener("change", (event) => go({ sequence: event.target.value }));
  document.querySelector("[data-all]").addEventListener("change", (event) => document.querySelectorAll(".diff.only").forEach((table) => table.classList.toggle("all", event.target.checked)));
  setInterval(follow, FOLLOW_MS);
  open();
  loadNumbers().catch((error) => toast(error.message, true));
}
