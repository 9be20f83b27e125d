"use strict";

/* Sending a recording, sequence or run piece by piece; what broke off goes on where it ended. */

(() => {
  const box = document.getElementById("upload");
  if (!box) return;
  const at = (name) => box.querySelector(`[data-${name}]`);
  const RETRY_MS = 2000;
  const POLL_MS = 400;
  const KINDS = { captures: (name) => `import?folder=${encodeURIComponent(`captures/${name}`)}`, sequences: (name) => `sequences/${name}/check`, runs: (name) => `runs/${name}` };
  let isPaused = false;
  let isBusy = false;

  const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const mebibytes = (bytes) => (bytes / 2 ** 20).toLocaleString("en", { maximumFractionDigits: bytes < 2 ** 24 ? 1 : 0 });
  const isLeftOut = (path) => path.split("/").some((part) => part.startsWith(".") || ["__MACOSX", "Thumbs.db", "desktop.ini"].includes(part));

  function nameOf(files) {
    const [first] = files;
    const top = first.path.includes("/") ? first.path.split("/")[0] : first.path.replace(/\.[^.]*$/, "");
    return top.normalize("NFKD").replace(/[^A-Za-z0-9_-]+/g, "_").slice(0, 56).replace(/^_+|_+$/g, "") || "recording";
  }

  /** List what was dropped, folders with all that is in them. */
  async function filesOf(entry, path = "") {
    const here = path ? `${path}/${entry.name}` : entry.name;
    if (entry.isFile) return [{ path: here, file: await new Promise((give, fail) => entry.file(give, fail)) }];
    const reader = entry.createReader();
    const found = [];
    for (;;) {
      const some = await new Promise((give, fail) => reader.readEntries(give, fail)); // A hundred at a time.
      if (!some.length) break;
      for (const one of some) found.push(...(await filesOf(one, here)));
    }
    return found;
  }

  function show(upload, done, told) {
    const total = upload.total || 1;
    at("name").textContent = upload.name;
    at("told").textContent = told ?? `${mebibytes(done)} of ${mebibytes(upload.total)} MiB · ${Math.floor((100 * done) / total)} %`;
    const bar = box.querySelector("progress");
    if (told === undefined) [bar.max, bar.value] = [total, done];
    else bar.removeAttribute("value");
  }

  /** Find an unfinished upload of the same files, else announce a new one. */
  async function begin(files) {
    const listed = files.map(({ path, file }) => ({ path, size: file.size }));
    const key = (all) => JSON.stringify(all.map(({ path, size }) => [path, size]).sort());
    const { uploads } = await send("GET", "api/v1/uploads");
    const same = uploads.find((one) => key(one.files) === key(listed));
    if (same) return same;
    const name = nameOf(files);
    return send("POST", "api/v1/uploads", { name, files: listed });
  }

  /** Send a piece; a server that does not answer is asked again until it does. */
  async function sendPiece(upload, number, offset, piece) {
    for (;;) {
      if (isPaused) return null;
      const answer = await fetch(`api/v1/uploads/${upload.id}/files/${number}?offset=${offset}`, { method: "PUT", body: piece }).catch(() => null);
      if (answer?.ok) return (await answer.json()).received;
      if (answer) {
        const told = await answer.json().catch(() => null);
        // It may have taken the piece before the connection broke.
        const now = answer.status === 409 ? await send("GET", `api/v1/uploads/${upload.id}`) : null;
        if (now && now.files[number].received !== offset) return now.files[number].received;
        throw new Error(told?.error?.message ?? `The server answered ${answer.status}.`);
      }
      at("told").textContent = "The server does not answer; trying again …";
      await pause(RETRY_MS);
    }
  }

  async function sendAll(upload, files) {
    const byPath = new Map(files.map(({ path, file }) => [path, file]));
    let done = upload.received;
    for (const [number, { path, size, received }] of upload.files.entries()) {
      let offset = received;
      while (offset < size) {
        const next = await sendPiece(upload, number, offset, byPath.get(path).slice(offset, offset + upload.chunk));
        if (next === null) return false;
        done += next - offset;
        offset = next;
        show(upload, done);
      }
    }
    return true;
  }

  async function settle(upload, name = null) {
    await send("POST", `api/v1/uploads/${upload.id}/finish`, { name });
    for (;;) {
      const now = await send("GET", `api/v1/uploads/${upload.id}`);
      if (now.state === "done") {
        isBusy = false; // Nothing is lost by leaving now.
        return (location.href = KINDS[now.result.kind](now.result.name));
      }
      if (now.state !== "checking") throw new Error(now.reason || "The check was stopped.");
      const { stage, iteration, total } = now.progress;
      show(upload, 0, stage ? `${stage === "unpack" ? "unpacking" : "checking"} · ${iteration} of ${total}` : "checking …");
      await pause(POLL_MS);
    }
  }

  function take(found) {
    const files = found.filter(({ path }) => !isLeftOut(path));
    if (!files.length) return;
    attend(async () => {
      const upload = await begin(files);
      at("sending").hidden = false;
      show(upload, upload.received);
      if (await sendAll(upload, files)) await settle(upload);
    });
  }

  /** Do one thing at a time, and say what went wrong with it. */
  async function attend(work) {
    if (isBusy) return;
    isBusy = true;
    isPaused = false;
    at("failed").hidden = true;
    at("drop").hidden = true;
    try {
      await work();
    } catch (error) {
      at("failed").textContent = error.message;
      at("failed").hidden = false;
    } finally {
      isBusy = false;
      at("sending").hidden = true;
      at("drop").hidden = false;
      listUnfinished();
    }
  }

  async function listUnfinished() {
    const { uploads } = await send("GET", "api/v1/uploads");
    at("unfinished").replaceChildren(
      ...uploads.map((upload) => {
        const row = document.createElement("li");
        const about = document.createElement("span");
        const isWhole = upload.received === upload.total;
        const isTold = !at("failed").hidden && at("failed").textContent === upload.reason;
        about.textContent = `${upload.name}: ${mebibytes(upload.received)} of ${mebibytes(upload.total)} MiB sent. ${(!isTold && upload.reason) || (isWhole ? "" : "Choose the same folder or files again to go on.")}`;
        const remove = document.createElement("button");
        remove.className = "secondary outline";
        remove.textContent = "Remove";
        remove.setAttribute("aria-label", `Remove what was sent of ${upload.name}`);
        remove.onclick = () => busy(remove, async () => (await send("DELETE", `api/v1/uploads/${upload.id}`), listUnfinished()));
        row.append(about);
        if (isWhole) {
          const name = document.createElement("input");
          name.value = `${upload.name.slice(0, 60)}_2`;
          name.maxLength = 64;
          name.setAttribute("aria-label", `Name for ${upload.name}`);
          const again = document.createElement("button");
          again.className = "outline";
          again.textContent = "Check again under this name";
          again.onclick = () => attend(async () => (show(upload, 0, "checking …"), (at("sending").hidden = false), settle(upload, name.value.trim())));
          row.append(name, again);
        }
        row.append(remove);
        return row;
      }),
    );
  }

  for (const button of box.querySelectorAll("[data-pick]")) {
    const input = box.querySelector(`[data-of=${button.dataset.pick}]`);
    button.onclick = () => input.click();
    input.onchange = () => {
      take([...input.files].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
      input.value = "";
    };
  }
  at("pause").onclick = () => (isPaused = true);
  const drop = at("drop");
  drop.ondragover = (event) => (event.preventDefault(), drop.toggleAttribute("data-over", true));
  drop.ondragleave = () => drop.toggleAttribute("data-over", false);
  drop.ondrop = async (event) => {
    event.preventDefault();
    drop.toggleAttribute("data-over", false);
    const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry()).filter(Boolean);
    take((await Promise.all(entries.map((entry) => filesOf(entry)))).flat());
  };
  addEventListener("beforeunload", (event) => isBusy && !at("sending").hidden && event.preventDefault());
  listUnfinished().catch(() => {});
})();
