"use strict";

/* How busy the machine is, as bars. */

const GIB = 2 ** 30;

function bytes(value) {
  if (!Number.isFinite(value)) return "–";
  return value >= GIB ? `${(value / GIB).toFixed(1)} GiB` : `${Math.round(value / 2 ** 20)} MiB`;
}

const percent = (share) => `${Math.round(100 * share)} %`;

function showMeter(place, share, text, canRunOut = true) {
  const rail = place.querySelector(".rail");
  const value = Number.isFinite(share) ? Math.min(Math.max(share, 0), 1) : 0;
  rail.setAttribute("aria-valuenow", value);
  rail.setAttribute("aria-valuetext", text);
  rail.firstElementChild.style.width = `${100 * value}%`;
  place.classList.toggle("full", canRunOut && share > 0.9);
  place.querySelector("small").textContent = text;
}

/** Show the load; graphics cards get bars of their own when there are any. */
function showMachine(root, machine) {
  const place = root.querySelector("[data-machine]");
  const meter = (name) => place.querySelector(`[data-meter="${name}"]`);
  const { processor, memory, disk, cards } = machine;
  showMeter(meter("processor"), processor.share, `${percent(processor.share)} of ${processor.count}`, false); // A fit shall use all of them.
  showMeter(meter("memory"), memory.share, `${bytes(memory.used)} of ${bytes(memory.total)}`);
  showMeter(meter("disk"), disk.share, `${bytes(disk.free)} of ${bytes(disk.total)} free`);
  for (const card of cards) {
    const marks = [["work", card.share, `${Number.isFinite(card.share) ? percent(card.share) : "–"}${card.temperature ? ` · ${card.temperature} °C` : ""}`, card.name],
      ["memory", card.memory / card.memory_total, `${bytes(card.memory)} of ${bytes(card.memory_total)}`, `GPU ${card.index} memory`]];
    for (const [kind, share, text, title] of marks) {
      const name = `card-${card.index}-${kind}`;
      if (!meter(name)) {
        const made = meter("disk").cloneNode(true);
        made.dataset.meter = name;
        made.querySelector("span").textContent = title;
        made.querySelector(".rail").setAttribute("aria-label", title);
        place.append(made);
      }
      showMeter(meter(name), share, text, kind === "memory");
    }
  }
}
