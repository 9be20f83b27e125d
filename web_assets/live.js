"use strict";

/* The page around a live scene: its address and link, its color scheme, and its end. */

{
  const WATCH_MS = 15000;
  const FOLLOW_MS = 2000;
  const LINK_KEY = "p";
  const HINT = "physhandi.first-hint";
  const scene = document.getElementById("scene");
  const isDark = matchMedia("(prefers-color-scheme: dark)");
  let session = scene.dataset.session;

  const wish = () => send("PATCH", `api/v1/sessions/${session}`, { dark: isDark.matches }).catch(() => {});

  const seek = (frame) => send("PATCH", `api/v1/sessions/${session}`, { frame }).catch((error) => toast(error.message, true));

  /* A scene that another tab shows already is copied by the server, which sends the frame on. */
  function settle() {
    const shown = /\/viewer\/([\w-]+)\/$/.exec(scene.contentWindow.location.pathname)?.[1];
    if (!shown) return;
    if (shown !== session) {
      session = shown;
      history.replaceState(null, "", `live/${shown}`);
      toast("Another tab shows this scene too. This tab has a copy of its own now.");
    }
    for (const entry of document.querySelectorAll("[data-session-export]")) {
      entry.href = `api/v1/sessions/${session}/export?format=${entry.dataset.sessionExport}`;
    }
    scene.contentWindow.addEventListener("keydown", onKey);
    wireScene(scene, seek);
    if (scene.dataset.offers.split(" ").includes("object")) {
      wireSteering(scene, session);
      wireDrawing(scene, session);
    }
    wish();
    scene.contentWindow.focus();
  }

  /* Refused where an address would show something else. */
  async function wholeLink() {
    const link = await send("GET", `api/v1/sessions/${session}/link`);
    if (link.lost) throw new Error(link.lost);
    return link;
  }

  /* The link restores frame, camera, layers and parameters; the address bar follows it. */
  async function copyLink() {
    const link = await wholeLink();
    const address = new URL(link.url, document.baseURI).href;
    const inside = document.activeElement === scene ? scene.contentWindow : window;
    if (await copyText(address, inside)) toast(`Link copied: it opens this run as you see it now${link.lacks_path ? ", without the camera's path, which has too many key frames for a link: save that as JSON (Export)" : ""}.`, link.lacks_path);
  }

  /* What the link restores is filmed: parameters, layers and camera as they are now, or the camera's path. */
  async function film(entry) {
    const link = await wholeLink();
    const query = new URLSearchParams(entry.dataset.sessionFilm);
    if (link.camera_path && !query.has("turn") && !query.has("beside")) query.set("camera_path", link.camera_path);
    await fetchSlowFile(`api/v1/runs/${scene.dataset.target}/export?${link.query}${link.query && "&"}${query}`, "Filming");
  }

  async function share(entry) {
    const { query } = await wholeLink();
    await shareView(entry.dataset.shareView, query);
  }

  for (const [chosen, work] of [["[data-session-film]", film], ["[data-share-view]", share]]) {
    for (const entry of document.querySelectorAll(chosen)) {
      entry.addEventListener("click", (event) => {
        event.preventDefault();
        entry.closest("details").open = false;
        work(entry).catch((error) => toast(error.message, true));
      });
    }
  }

  function onKey(event) {
    const isTyping = event.target.matches?.("input:not([type=checkbox]), textarea, select");
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.key.toLowerCase() === LINK_KEY) copyLink().catch((error) => toast(error.message, true));
  }

  async function follow() {
    if (document.hidden) return;
    const link = await send("GET", `api/v1/sessions/${session}/link`).catch(() => null);
    const address = link && `live/${session}?${link.query}`;
    if (address && new URL(address, document.baseURI).href !== location.href) history.replaceState(null, "", address);
  }

  /* A closed scene says so, and why: the server renders that page at the same address. */
  async function watch() {
    if (document.hidden) return;
    const answer = await fetch(`api/v1/sessions/${session}`).catch(() => null);
    if (answer && (answer.status === 404 || answer.status === 401)) location.reload();
  }

  /* Told once in a browser. */
  function giveHint() {
    const hint = document.querySelector("[data-first-hint]");
    try {
      if (localStorage.getItem(HINT)) return;
    } catch {
      return;
    }
    hint.hidden = false;
    hint.querySelector("[data-close-hint]").addEventListener("click", () => {
      localStorage.setItem(HINT, "seen");
      hint.remove();
      scene.contentWindow.focus();
    });
  }

  giveHint();
  forwardKeys(scene);
  scene.addEventListener("load", settle);
  if (scene.contentDocument?.readyState === "complete") settle();
  isDark.addEventListener("change", wish);
  document.addEventListener("visibilitychange", watch);
  document.addEventListener("keydown", onKey);
  const button = document.querySelector("[data-copy-link]");
  button.addEventListener("click", () => busy(button, copyLink));
  setInterval(watch, WATCH_MS);
  setInterval(follow, FOLLOW_MS);
}
