"use strict";

/* The page around a live scene: its address, its color scheme, and its end. */

{
  const WATCH_MS = 15000;
  const scene = document.getElementById("scene");
  const isDark = matchMedia("(prefers-color-scheme: dark)");
  let session = scene.dataset.session;

  const wish = () => send("PATCH", `/api/v1/sessions/${session}`, { dark: isDark.matches }).catch(() => {});

  /* A scene that another tab shows already is copied by the server, which sends the frame on. */
  function settle() {
    const shown = /^\/viewer\/([\w-]+)\/$/.exec(scene.contentWindow.location.pathname)?.[1];
    if (!shown) return;
    if (shown !== session) {
      session = shown;
      history.replaceState(null, "", `/live/${shown}`);
      toast("Another tab shows this scene too. This tab has a copy of its own now.");
    }
    wish();
    scene.contentWindow.focus();
  }

  /* A closed scene says so, and why: the server renders that page at the same address. */
  async function watch() {
    if (document.hidden) return;
    const answer = await fetch(`/api/v1/sessions/${session}`).catch(() => null);
    if (answer && (answer.status === 404 || answer.status === 401)) location.reload();
  }

  scene.addEventListener("load", settle);
  if (scene.contentDocument?.readyState === "complete") settle();
  isDark.addEventListener("change", wish);
  document.addEventListener("visibilitychange", watch);
  setInterval(watch, WATCH_MS);
}
