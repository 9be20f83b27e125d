"use strict";

/* Lasso and brush in a live scene that is edited: while the panel says that one of them is chosen, a drag in the
   scene draws, and what was drawn goes to the server when the pointer goes up. */

{
  const LEAST_PIXELS = 3;
  const DAB_PIXELS = 9;
  const MOST_POINTS = 2000;
  const COLOR = "rgb(255, 122, 0)";

  /* To be called whenever the frame has loaded a scene. */
  globalThis.wireDrawing = (scene, session) => {
    const inside = scene.contentWindow;
    const root = inside.document;
    const svg = (name, parent) => parent.appendChild(root.createElementNS("http://www.w3.org/2000/svg", name));
    const sheet = svg("svg", root.body);
    Object.assign(sheet.style, { position: "fixed", inset: 0, width: "100%", height: "100%", pointerEvents: "none", zIndex: 40, display: "none" });
    sheet.setAttribute("aria-hidden", "true");
    const line = svg("polyline", sheet);
    line.setAttribute("stroke", COLOR);
    line.setAttribute("stroke-linejoin", "round");
    line.setAttribute("stroke-linecap", "round");
    let drawn = null;

    const chosen = () => root.querySelector("[data-draws]")?.dataset;

    /* Places on the picture: (0, 0) is its upper left corner, (1, 1) the lower right one. */
    const placeOf = ([x, y], { left, top, width, height }) => [(x - left) / width, (y - top) / height];

    function show() {
      const { draws, points, radius } = drawn;
      sheet.style.display = "";
      line.setAttribute("points", points.map((point) => point.join(",")).join(" "));
      line.setAttribute("fill", draws === "lasso" ? "rgba(255, 122, 0, .15)" : "none");
      line.setAttribute("stroke-width", draws === "lasso" ? 2 : 2 * radius);
      line.setAttribute("stroke-opacity", draws === "lasso" ? 1 : 0.35);
    }

    function take(event) {
      event.preventDefault();
      event.stopImmediatePropagation();
    }

    function begin(event) {
      const tool = chosen();
      if (!tool || event.button !== 0 || !event.target.matches?.("canvas")) return;
      take(event);
      const box = event.target.getBoundingClientRect();
      const way = event.shiftKey ? "add" : event.ctrlKey || event.metaKey ? "remove" : "replace";
      drawn = { draws: tool.draws, way, box, radius: Number(tool.radius) * box.height, points: [[event.clientX, event.clientY]], pointer: event.pointerId };
      show();
    }

    function go(event) {
      if (drawn?.pointer !== event.pointerId) return;
      take(event);
      const [x, y] = drawn.points.at(-1);
      if (Math.hypot(event.clientX - x, event.clientY - y) < LEAST_PIXELS || drawn.points.length >= MOST_POINTS) return;
      drawn.points.push([event.clientX, event.clientY]);
      show();
    }

    async function end(event) {
      if (drawn?.pointer !== event.pointerId) return;
      take(event);
      const { draws, points, box, way, radius } = drawn;
      drawn = null;
      sheet.style.display = "none";
      if (event.type === "pointercancel") return;
      /* A lasso that was not drawn is a click. */
      const isDab = draws === "lasso" && points.length < 3;
      const shape = { tool: isDab ? "brush" : draws, way, points: points.map((point) => placeOf(point, box)), radius: (isDab ? DAB_PIXELS : radius) / box.height };
      await fetch(`viewer/${session}/shape`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(shape) });
    }

    root.addEventListener("pointerdown", begin, true);
    root.addEventListener("pointermove", go, true);
    for (const type of ["pointerup", "pointercancel"]) root.addEventListener(type, end, true);
  };
}
