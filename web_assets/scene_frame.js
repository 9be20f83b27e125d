"use strict";

/* Part of viser's page wherever we show it, live, as a replay or in a file: what it lacks for our scenes.

   Meshes of viser have one color. Where more bytes follow that, they are the colors of the vertices.
   Until the first frame is drawn and lit, the page is covered: its parts come one by one. Below that cover viser
   fades its canvas in, in five frames, and stops halfway, for good, where our light arrives meanwhile. */

{
  const LONGEST_MS = 10000;
  const UNLIT_MS = 1000;
  const LEAST_ASPECT = 1;
  const SHOWN = ["MeshMessage", "PointCloudMessage", "LineSegmentsMessage", "CameraFrustumMessage", "BatchedMeshesMessage", "GaussianSplatsMessage"];
  const LINEAR = Float32Array.from({ length: 256 }, (_, value) => (value < 10.32 ? value / 3294.6 : ((value / 255 + 0.055) / 1.055) ** 2.4));
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
  const given = new WeakMap();
  const isRecording = Boolean(window.__VISER_EMBED_CONFIG__) || new URLSearchParams(location.search).has("playbackPath");

  /* Side B of a comparison stands beside the panel, whose width on the screen the server cannot know. */
  if (!isRecording) document.cookie = `pixel_ratio=${window.devicePixelRatio}; path=${location.pathname.replace(/[^/]*\/$/, "")}; samesite=strict`;

  function meshOf(group, count) {
    let found = null;
    group.traverse((part) => {
      if (!found && part.isMesh && part.geometry.getAttribute("position")?.count === count) found = part;
    });
    return found;
  }

  /* Colors of vertices are multiplied with that of the mesh. */
  function fill(attribute, colors) {
    for (let place = 3; place < colors.length; place += 1) attribute.array[place - 3] = LINEAR[colors[place]] / LINEAR[colors[place % 3]];
    attribute.needsUpdate = true;
    given.set(attribute, colors);
  }

  function paint(group, colors) {
    const count = colors.length / 3 - 1;
    const mesh = meshOf(group, count);
    if (!mesh) return false;
    const { geometry, material } = mesh;
    const place = geometry.getAttribute("position");
    let attribute = geometry.getAttribute("color");
    if (material.vertexColors && attribute?.count === count && given.get(attribute) === colors) return false;
    if (attribute?.count !== count) {
      attribute = new place.constructor(new Float32Array(3 * count), 3);
      geometry.setAttribute("color", attribute);
    }
    if (given.get(attribute) !== colors) fill(attribute, colors);
    if (!material.vertexColors) {
      material.vertexColors = true;
      material.needsUpdate = true;
    }
    return true;
  }

  function unpaint(group) {
    let isChanged = false;
    group.traverse((part) => {
      if (!part.isMesh || !part.material.vertexColors || !part.geometry.getAttribute("color")) return;
      part.material.vertexColors = false;
      part.material.needsUpdate = true;
      isChanged = true;
    });
    return isChanged;
  }

  /* A recording's camera stands where a picture on a desk shows all; a narrower one shows as much from side to side. */
  function keepSides(viewer) {
    const { camera, cameraControl } = viewer;
    if (!camera || !cameraControl) return;
    const zoom = Math.min(1, camera.aspect / LEAST_ASPECT);
    if (Math.abs(camera.zoom - zoom) < 1e-6) return;
    cameraControl.zoomTo(zoom, false);
    viewer.requestRender();
  }

  /* viser's lamps alone show a surface brighter than its color. This much of them, and the server's light from all around, show that color.
     Without a graphics card the three maps of shadows are half of what a picture costs. */
  const LIGHT = 0.32;
  const dimmed = new WeakSet();
  let isSlow = null;

  function light(viewer) {
    if (!viewer.canvas || !viewer.scene) return;
    if (isSlow === null) {
      const context = viewer.canvas.getContext("webgl2");
      const named = context?.getExtension("WEBGL_debug_renderer_info");
      isSlow = Boolean(named) && SOFTWARE.test(context.getParameter(named.UNMASKED_RENDERER_WEBGL));
    }
    for (const part of viewer.scene.children) {
      if (!part.isLight) continue;
      if (isSlow) part.castShadow = false;
      if (!dimmed.has(part)) part.intensity *= LIGHT;
      dimmed.add(part);
    }
  }

  /* Texts are HTML over the scene, in the font of the page and sharp. The letters that viser draws are left
     out: Firefox without a graphics card shows none of them. */
  const texts = new Map();
  let letters = null;

  function hideLetters(viewer) {
    if (letters?.parent) return;
    viewer.scene.traverse((part) => {
      if (part.material?.uniforms?.uLabelData) letters = part.parent;
    });
    if (letters) letters.visible = false;
  }

  function textOf(name, viewer) {
    const known = texts.get(name);
    if (known?.isConnected) return known;
    const around = viewer.canvas.parentElement;
    const place = around.querySelector("[data-scene-texts]") ?? around.appendChild(document.createElement("div"));
    place.dataset.sceneTexts = "";
    const text = place.appendChild(document.createElement("span"));
    texts.set(name, text);
    return text;
  }

  const MOVED = { top: 0, left: 0, center: -50, bottom: -100, right: -100 };

  /* Where a label of viser's is, as large and at the same corner; nothing is in front of it. */
  function write(name, node, viewer) {
    const { camera, canvas } = viewer;
    const parent = viewer.nodeRefFromName[name.slice(0, name.lastIndexOf("/"))];
    if (!camera || !canvas?.parentElement || !parent) return;
    const { props } = node.message;
    const text = textOf(name, viewer);
    const Point = camera.position.constructor;
    const point = new Point(...(viewer.nodePoseData[name]?.position ?? [0, 0, 0])).applyMatrix4(parent.matrixWorld);
    const depth = -point.clone().applyMatrix4(camera.matrixWorldInverse).z;
    text.hidden = node.effectiveVisibility === false || depth <= camera.near;
    if (text.hidden) return;
    point.project(camera);
    const [left, top] = [(point.x + 1) / 2 * canvas.clientWidth, (1 - point.y) / 2 * canvas.clientHeight];
    const pixels = canvas.clientHeight * camera.zoom / (2 * Math.tan(camera.fov * Math.PI / 360) * depth);
    const [vertical, horizontal] = props.anchor.split("-");
    const look = {
      fontSize: `${(props.font_scene_height * pixels).toFixed(2)}px`,
      transform: `translate(${left.toFixed(1)}px, ${top.toFixed(1)}px) translate(${MOVED[horizontal]}%, ${MOVED[vertical]}%)`,
    };
    if (text.textContent !== props.text) text.textContent = props.text;
    for (const [part, value] of Object.entries(look)) if (text.style[part] !== value) text.style[part] = value;
  }

  function forget(nodes) {
    for (const [name, text] of texts) {
      if (nodes[name]) continue;
      text.remove();
      texts.delete(name);
    }
  }

  /* viser begins with surroundings of its own, in which surfaces are pale, and decodes ours when it hears of
     them: from then on they have another intensity, and the next picture of surroundings is ours. */
  const OWN_INTENSITY = 1;
  let surroundings = null;
  let isLit = false;

  function seeLight({ environment, environmentIntensity }) {
    const isOther = environment !== surroundings;
    surroundings = environment;
    isLit ||= isOther && environmentIntensity !== OWN_INTENSITY;
  }

  const painted = new Set();
  let contentCame = null;

  function follow() {
    requestAnimationFrame(follow);
    const [tree, viewer] = [window.__viserSceneTree, window.__viserMutable];
    if (!tree || !viewer) return;
    light(viewer);
    if (viewer.scene && !isLit) seeLight(viewer.scene);
    if (isRecording) keepSides(viewer);
    let [isChanged, hasContent] = [false, false];
    const nodes = tree.getState();
    for (const [name, node] of Object.entries(nodes)) {
      if (node?.message.type === "LabelMessage") write(name, node, viewer);
      const colors = node?.message.type === "MeshMessage" ? node.message.props.color : [];
      const group = viewer.nodeRefFromName[name];
      if (!group) continue;
      hasContent ||= SHOWN.includes(node.message.type);
      if (colors.length > 3) {
        painted.add(name);
        isChanged = paint(group, colors) || isChanged;
      } else if (painted.delete(name)) {
        isChanged = unpaint(group) || isChanged;
      }
    }
    if (texts.size > 0) {
      hideLetters(viewer);
      forget(nodes);
    }
    if (hasContent) contentCame ??= performance.now();
    if (isChanged) viewer.requestRender();
    else if (hasContent && (isLit || performance.now() - contentCame > UNLIT_MS)) uncover();
  }

  /* Here is no body yet, so that nothing is seen before. */
  const cover = document.documentElement.appendChild(document.createElement("div"));
  const isDark = window.__VISER_EMBED_CONFIG__?.darkMode ?? (location.search.includes("darkMode") || matchMedia("(prefers-color-scheme: dark)").matches);
  const [ground, ink] = isDark ? ["#1a1b1e", "#9aa3af"] : ["#fff", "#6b7480"];
  cover.textContent = "Opening the scene …";
  cover.style.cssText = `position:fixed;inset:0;z-index:100000;display:grid;place-items:center;background:${ground};color:${ink};font:15px system-ui,sans-serif;transition:opacity .2s`;

  function uncover() {
    if (!cover.isConnected || cover.style.opacity) return;
    /* What is in the scene now is drawn in the next frame. */
    requestAnimationFrame(() => requestAnimationFrame(() => {
      cover.style.opacity = "0";
      cover.style.pointerEvents = "none";
      setTimeout(() => cover.remove(), 250);
    }));
  }

  const sheet = new CSSStyleSheet();
  sheet.replaceSync(`
    canvas { opacity: 1 !important; }
    [data-scene-texts] { position: absolute; inset: 0; overflow: hidden; pointer-events: none; color: #16181d; font: 16px/1.2 system-ui, sans-serif; text-shadow: 0 0 .2em #fff, 0 0 .2em #fff; }
    [data-scene-texts] > span { position: absolute; top: 0; left: 0; white-space: pre; text-align: center; }
    [data-scene-texts] > [hidden] { display: none; }
    :root[data-mantine-color-scheme=dark] [data-scene-texts] { color: #e8eaed; text-shadow: 0 0 .2em #1a1b1e, 0 0 .2em #1a1b1e; }`);
  document.adoptedStyleSheets.push(sheet);

  setTimeout(uncover, LONGEST_MS);
  follow();
}
