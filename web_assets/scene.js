"use strict";

/* A live scene in a frame: keys that work in it and on the page around it, fields, and charts to click. */

{
  const OF_PAGE = ["?", "p", "P", "Tab", "Enter"];
  const NAMED = ["Escape", "Home", "End", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"];
  /* viser moves the camera while these are held; here they save a picture and step through frames. */
  const NOT_FOR_CAMERA = ["KeyS", "ArrowLeft", "ArrowRight"];
  const CLICK_PIXELS = 4;

  const isTyping = (event) => event.target.matches?.("input:not([type=checkbox]), textarea, select");

  /* Keys that the page around has no use for go to the scene, as if it had the focus. */
  function forward(event, scene) {
    const isCombined = event.ctrlKey || event.metaKey || event.altKey;
    if (isCombined ? event.key.toLowerCase() !== "z" : event.key.length > 1 && !NAMED.includes(event.key)) return;
    if (isTyping(event) || OF_PAGE.includes(event.key) || document.querySelector("dialog[open], details[open]")) return;
    /* A chart that has the focus has named keys of its own. */
    if (event.key.length > 1 && event.target.closest?.(".plot")) return;
    if (event.key === " " && event.target.closest?.("button, summary, a")) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    press(event, scene.contentWindow);
  }

  function press({ key, code, shiftKey, ctrlKey, metaKey, altKey }, inside) {
    const copy = new inside.KeyboardEvent("keydown", { key, code, shiftKey, ctrlKey, metaKey, altKey, bubbles: true, cancelable: true });
    inside.document.documentElement.dispatchEvent(copy);
  }

  /* viser takes a ticked box and a list that was chosen from for fields in which somebody types. Enter ends typing. */
  function keepKeys(inside, root) {
    root.addEventListener("click", (event) => event.target.closest?.("[role=option]") && inside.setTimeout(() => inside.document.activeElement?.blur()));
    root.addEventListener("keydown", (event) => {
      if (event.target.matches?.("input[type=checkbox]") && ![" ", "Tab"].includes(event.key)) press(event, inside);
      if (event.key === "Enter" && event.target.matches?.(".mantine-NumberInput-input")) inside.setTimeout(() => event.target.blur());
    });
  }

  /* The frame under a click in a chart over frames; none in any other chart, or after a drag. */
  function frameAt(event, inside, start) {
    const over = event.target.closest?.(".u-over");
    if (!over || Math.abs(event.clientX - start) > CLICK_PIXELS) return null;
    const charts = Object.values(inside.__viserTestpoints?.uplots ?? {});
    const chart = charts.map((entry) => entry.chart).find((entry) => entry.over === over);
    if (chart?.series[0].label !== "frame") return null;
    return Math.max(0, Math.round(chart.posToVal(event.clientX - over.getBoundingClientRect().left, "x")));
  }

  /* Once a number field of viser's has heard the -0 of a -0.6 that is being typed, it shows 0, and 0.6
     becomes of it. It hears of -0 only when that is entered or left, and before of what it grows into. */
  function keepSigns(root) {
    const isNegativeZero = (field) => field.matches?.(".mantine-NumberInput-input") && Object.is(Number(field.value), -0);
    const tell = ({ target }) => isNegativeZero(target) && target.dispatchEvent(new Event("input", { bubbles: true }));
    root.addEventListener("input", (event) => event.isTrusted && isNegativeZero(event.target) && event.stopPropagation(), true);
    root.addEventListener("keydown", (event) => event.key === "Enter" && tell(event), true);
    root.addEventListener("focusout", tell, true);
  }

  /* A drag, arrows while they are held, or a number that is typed is one step of undo, which the scene
     is told the end of by a key of its own (app/viewer/ui/gestures.py). viser sends the last value of a
     drag up to 50 ms late, but keys at once: they wait for it, unless the next gesture begins before. */
  const LATE_MS = 60;
  const MOVED = ".mantine-Slider-root, .mantine-NumberInput-root";
  const END = { key: "Insert", code: "Insert", ctrlKey: true, altKey: true, shiftKey: true };
  const STEPS = /^(Arrow|Page|Home$|End$|Enter$)/;

  function tellGestures(inside, root) {
    let isDown = false;
    let waiting = null;
    const tell = () => {
      if (waiting === null) return;
      inside.clearTimeout(waiting);
      waiting = null;
      root.dispatchEvent(new inside.KeyboardEvent("keydown", END));
    };
    const end = () => (waiting ??= inside.setTimeout(tell, LATE_MS));
    const isMoved = (event) => Boolean(event.target.closest?.(MOVED));
    root.addEventListener("pointerdown", (event) => { tell(); isDown = isMoved(event); }, true);
    for (const type of ["pointerup", "pointercancel"]) inside.addEventListener(type, () => { if (isDown) end(); isDown = false; }, true);
    root.addEventListener("keydown", (event) => event.isTrusted && !event.repeat && tell(), true);
    root.addEventListener("keyup", (event) => STEPS.test(event.key) && isMoved(event) && end(), true);
    root.addEventListener("focusout", (event) => isMoved(event) && end(), true);
  }

  /* Arrows on a slider and blanks on a tab are its own, and step through no frames. */
  const isOwn = ({ key, target }) => target.closest?.("[role=slider], [role=tab], [role=option]") && (key === " " || STEPS.test(key));

  /* A slider of powers of ten has factors as its marks, and its field shows and takes factors, too: ×0.2. */
  const FACTOR = "×";
  const factor = (power) => {
    const text = String(Number((10 ** power).toPrecision(3)));
    return FACTOR + (text.includes(".") || text.length > 1 ? text : `${text}.0`);
  };

  function write(field, text) {
    const inside = field.ownerDocument.defaultView;
    const { set } = Object.getOwnPropertyDescriptor(inside.HTMLInputElement.prototype, "value");
    for (const value of ["", text]) {
      set.call(field, value);
      field.dispatchEvent(new inside.Event("input", { bubbles: true }));
    }
  }

  /* viser's own field stays, out of sight, and is written into. */
  function addFactor(slider, handle) {
    const plain = slider.nextElementSibling;
    const shown = plain.cloneNode(true);
    const field = shown.querySelector("input");
    const show = () => {
      handle.setAttribute("aria-valuetext", factor(handle.ariaValueNow));
      if (field !== field.ownerDocument.activeElement) field.value = factor(handle.ariaValueNow);
    };
    field.removeAttribute("id");
    field.addEventListener("keydown", (event) => event.key === "Enter" && field.blur());
    field.addEventListener("change", () => {
      const power = Math.log10(Number(field.value.replace(FACTOR, "").trim()) || Number.NaN);
      const [low, high] = [handle.ariaValueMin, handle.ariaValueMax].map(Number);
      if (Number.isFinite(power)) write(plain.querySelector("input"), Math.min(Math.max(power, low), high).toFixed(6));
    });
    field.addEventListener("blur", show);
    plain.style.display = "none";
    slider.parentElement.append(shown);
    new MutationObserver(show).observe(handle, { attributeFilter: ["aria-valuenow"] });
    show();
  }

  /* Boxes to tick stand in two columns. */
  function halve(row) {
    const isBox = (place) => Boolean(place?.querySelector("input[type=checkbox]"));
    const place = row.parentElement;
    if (!isBox(place.previousElementSibling) && !isBox(place.nextElementSibling)) return;
    Object.assign(place.style, { display: "inline-block", width: "50%", verticalAlign: "top" });
    row.firstElementChild.style.width = "calc(100% - 1.5em)";
  }

  /* Names beside controls in a gray that can be read, unlike viser's (contrast of 4.5). On phones viser's panel
     lies over the scene; here it is a sheet below it, and the scene has the rest: all of it, once the sheet is
     folded by a tap on its head. */
  const SHEET = '.mantine-Paper-root[style*="position: fixed"][style*="min-height: 3.5em"]';
  const DRESS = `
    :root { --mantine-color-dimmed: #5f6770 !important; --mantine-color-gray-filled: #5f6770 !important; }
    :root[data-mantine-color-scheme=dark] { --mantine-color-dimmed: #a0a7b0 !important; }
    [data-dock-tab] { padding-inline: .3em !important; }
    .multi-slider-mark-label { color: var(--mantine-color-dimmed) !important; }
    @media (max-width: 36em) {
      :has(> ${SHEET}) { flex-direction: column; }
      ${SHEET} { position: relative !important; flex: none; width: 100% !important; max-height: 45% !important; border-radius: .8em .8em 0 0; }
      ${SHEET} .mantine-ScrollArea-content > div { width: 100% !important; }
      ${SHEET} .mantine-ScrollArea-content > div > div:first-child::before { content: ""; position: absolute; top: .4em; left: calc(50% - 1.2em); width: 2.4em; height: .25em; border-radius: 1em; background: var(--mantine-color-dimmed); opacity: .6; }
    }`;

  function dress(root) {
    const style = root.ownerDocument.createElement("style");
    style.textContent = DRESS;
    root.ownerDocument.head.append(style);
  }

  const ICONS = { "list-search": "All commands", adjustments: "Connection and camera", "arrow-back": "Back to the panel" };

  /* viser writes names beside its sliders and fields, and draws icons, but tells eyes alone. */
  function name(root) {
    for (const button of root.querySelectorAll(".mantine-Notification-closeButton:not([aria-label])")) button.ariaLabel = "Close";
    for (const [icon, text] of Object.entries(ICONS)) {
      root.querySelector(`button .tabler-icon-${icon}`)?.closest("button").setAttribute("aria-label", text);
    }
    for (const label of root.querySelectorAll("label[for]")) {
      const row = label.closest(".mantine-Flex-root");
      const text = label.textContent.replace(/^● (.*)$/, "$1, changed");
      for (const part of row?.querySelectorAll("[role=slider], .mantine-NumberInput-input, .mantine-TextInput-input") ?? []) {
        if (part.ariaLabel !== text) part.ariaLabel = text;
      }
      if (row?.querySelector("input[type=checkbox]")) halve(row);
      const slider = row?.querySelector(".mantine-Slider-root");
      const isOfFactors = slider?.querySelector(".mantine-Slider-markLabel")?.textContent.startsWith(FACTOR);
      if (isOfFactors && !slider.nextElementSibling.nextElementSibling) addFactor(slider, slider.querySelector("[role=slider]"));
    }
  }

  /* The tab that was open last, in this tab of the browser; at first the sliders, where there are any. */
  const TAB = "physhandi-tab";
  const tabsOf = (root) => [...(root.querySelector("[role=tablist]")?.querySelectorAll("[role=tab]") ?? [])];
  const openTab = (tab) => (tab.dispatchEvent(new tab.ownerDocument.defaultView.KeyboardEvent("keydown", { key: "Enter", bubbles: true })), tab.click());

  function openFirst(root) {
    const tabs = tabsOf(root);
    const named = (text) => tabs.find((tab) => tab.textContent.trim() === text);
    const first = named(sessionStorage.getItem(TAB)) ?? named("Physics");
    if (first && first.ariaSelected !== "true") openTab(first);
    return tabs.length > 0;
  }

  function keepNamed(inside, root) {
    let isDue = false;
    let isOpen = false;
    let known = null;
    const look = () => {
      isDue = false;
      name(root);
      const wish = root.querySelector("[data-wish]")?.dataset;
      const wished = isOpen && wish && wish.wish !== known && tabsOf(root).find((tab) => tab.textContent.trim() === wish.tab);
      known = wish?.wish;
      if (wished) openTab(wished);
      const chosen = tabsOf(root).find((tab) => tab.ariaSelected === "true");
      if (isOpen && chosen) sessionStorage.setItem(TAB, chosen.textContent.trim());
      isOpen ||= openFirst(root);
    };
    const later = () => {
      if (!isDue) inside.requestAnimationFrame(look);
      isDue = true;
    };
    new inside.MutationObserver(later).observe(root, { childList: true, characterData: true, subtree: true, attributeFilter: ["aria-selected"] });
    later();
  }

  /* To be called whenever the frame has loaded a scene. */
  globalThis.wireScene = (scene, seek) => {
    const inside = scene.contentWindow;
    const root = inside.document.documentElement;
    let start = 0;
    keepSigns(root);
    dress(root);
    tellGestures(inside, root);
    keepKeys(inside, root);
    keepNamed(inside, root);
    inside.document.body.addEventListener("keydown", (event) => isOwn(event) && event.stopPropagation());
    root.addEventListener("keydown", (event) => NOT_FOR_CAMERA.includes(event.code) && event.stopPropagation());
    inside.addEventListener("keydown", (event) => {
      if (event.key === "?" && !isTyping(event)) document.getElementById("help").showModal();
    }, true);
    root.addEventListener("pointerdown", (event) => (start = event.clientX), true);
    root.addEventListener("click", (event) => {
      const frame = frameAt(event, inside, start);
      if (frame !== null) seek(frame);
    });
  };

  /* To be called once; the frame may load other scenes later. */
  globalThis.forwardKeys = (scene) => document.addEventListener("keydown", (event) => forward(event, scene), true);
}
