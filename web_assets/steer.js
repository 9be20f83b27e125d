"use strict";

/* Steering in a live scene: which keys are held goes to the server over a websocket of its own, and the scene
   says on the screen that they steer. Keys are told by their places on the keyboard. */

{
  const HELD = ["KeyW", "KeyS", "KeyA", "KeyD", "KeyE", "KeyQ", "KeyI", "KeyK", "KeyJ", "KeyL", "KeyU", "KeyO", "KeyR", "KeyF"];
  const AGAIN_MS = 2000;
  /* On phones the panel is below the scene. */
  const SIGN = `
    [data-sign=steer] { position: fixed; left: 1em; bottom: 1em; z-index: 50; max-width: calc(100% - 2em); padding: .5em .9em; border-radius: .5em; background: #1c50a5; color: #fff; font: 14px/1.5 system-ui, sans-serif; pointer-events: none; }
    [data-sign=steer][data-recording=yes] { background: #a61e1e; }
    [data-sign=steer][hidden] { display: none; }
    @media (max-width: 36em) { [data-sign=steer] { inset: .6em .6em auto; max-width: none; } }`;

  const isTyping = (event) => event.target.matches?.("input:not([type=checkbox]), textarea, select");
  const isCombined = (event) => event.ctrlKey || event.metaKey || event.altKey;

  /* To be called whenever the frame has loaded a scene. */
  globalThis.wireSteering = (scene, session) => {
    const inside = scene.contentWindow;
    const held = new Set();
    let state = { steering: false };
    let socket = null;
    let isOpen = true;

    const style = inside.document.head.appendChild(inside.document.createElement("style"));
    style.textContent = SIGN;
    const sign = inside.document.body.appendChild(inside.document.createElement("div"));
    sign.setAttribute("role", "status");
    sign.dataset.sign = "steer";
    sign.hidden = true;

    const say = (message) => socket?.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
    const tell = () => say({ held: [...held] });
    const release = () => {
      if (held.size === 0) return;
      held.clear();
      tell();
    };

    function show() {
      sign.hidden = !state.steering;
      /* The hint of a first visit would lie over the sign. */
      document.body.toggleAttribute("data-steering", Boolean(state.steering));
      const [it, its] = state.both ? ["them", "their"] : ["it", "its"];
      const fingers = state.curls ? `, R F close and open ${its} fingers` : "";
      const tip = state.finger ? `its arrows bend the ${state.finger}, ` : state.curls ? "a click on a fingertip bends that finger, " : "";
      const own = state.turns ? `, I K J L U O turn ${it}${fingers}, X lets go and grips` : ", X lets go of it";
      sign.textContent = state.steering ? `Steering ${state.what}: W S A D Q E move ${it}${own}, ${tip}a click on the object holds a point to pull, space records, ctrl Z takes back, G ends` : "";
      if (state.recording) sign.textContent = `● Recording. ${sign.textContent}`;
      sign.dataset.recording = state.recording ? "yes" : "";
    }

    function connect() {
      socket = new WebSocket(new URL(`viewer/${session}/keys`, document.baseURI).href.replace(/^http/, "ws"));
      socket.addEventListener("message", (event) => {
        const told = JSON.parse(event.data);
        if (told.error) {
          console.warn(told.error);
          return;
        }
        if (!told.steering) held.clear();
        state = told;
        show();
      });
      socket.addEventListener("close", () => {
        held.clear();
        state = { steering: false };
        show();
        if (isOpen) setTimeout(connect, AGAIN_MS);
      });
    }

    /* Others hear of keys that go up: these may have gone down before hands were steered. */
    function onKey(event) {
      const isHeld = HELD.includes(event.code);
      if (event.type === "keyup") {
        if (held.delete(event.code)) tell();
        return;
      }
      if (!state.steering || isTyping(event) || document.querySelector("dialog[open]")) return;
      const isUndo = (event.ctrlKey || event.metaKey) && !event.altKey && !event.shiftKey && event.code === "KeyZ";
      const isRecord = event.code === "Space" && !isCombined(event) && !event.target.closest?.("button, summary, a, [role=tab], [role=option], input");
      const isGrip = event.code === "KeyX" && !isCombined(event);
      if (!isUndo && !isRecord && !isGrip && (!isHeld || isCombined(event))) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (event.repeat) return;
      if (isUndo || isRecord || isGrip) say({ press: isUndo ? "undo" : isRecord ? "record" : "grip" });
      else {
        held.add(event.code);
        tell();
      }
    }

    for (const place of [window, inside]) {
      for (const type of ["keydown", "keyup"]) place.addEventListener(type, onKey, true);
      place.addEventListener("blur", release);
    }
    document.addEventListener("visibilitychange", release);
    /* The frame goes on to another scene, which is wired by itself. */
    inside.addEventListener("pagehide", () => {
      isOpen = false;
      held.clear();
      state = { steering: false };
      for (const type of ["keydown", "keyup"]) window.removeEventListener(type, onKey, true);
      socket?.close();
    });
    connect();
  };
}
