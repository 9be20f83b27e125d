"use strict";

/* The shared pages of a run: their links, and how to withdraw them. */

{
  const section = document.getElementById("shares");

  const button = (text, about, work) => {
    const made = Object.assign(document.createElement("button"), { textContent: text, title: about, className: "secondary outline mini" });
    made.addEventListener("click", () => busy(made, work));
    return made;
  };

  function row(share) {
    const address = new URL(share.url, document.baseURI).href;
    const line = document.createElement("li");
    const link = Object.assign(document.createElement("a"), { href: share.url, target: "_blank", rel: "noreferrer", textContent: share.query ? "A view of the viewer" : "Replay" });
    const when = Object.assign(document.createElement("time"), { dateTime: share.created, textContent: new Date(share.created).toLocaleString("en", { dateStyle: "medium", timeStyle: "short" }) });
    const size = `${(share.bytes / 1e6).toFixed(1)} MB`;
    line.append(link, Object.assign(document.createElement("span"), { className: "dim" }));
    line.lastChild.append(" · ", when, ` · ${size}`);
    line.append(
      button("Copy link", "Copy the address", async () => {
        if (await copyText(address)) toast("Link copied.");
      }),
      ...("mayWithdraw" in section.dataset ? [button("Withdraw", "The link shows nothing any more", async () => {
        await send("DELETE", `api/v1/shares/${share.id}`);
        toast("Withdrawn: the link shows nothing any more.");
        await list();
      })] : []),
    );
    return line;
  }

  async function list() {
    const shares = await send("GET", `api/v1/shares?run=${section.dataset.run}`);
    section.hidden = !shares.length;
    section.querySelector("ul").replaceChildren(...shares.map(row));
  }

  const show = () => list().catch((error) => toast(error.message, true));
  addEventListener("shares-changed", show);
  show();
}
