"use strict";

/* The log: lines are added as they come; it stays at its end unless the reader scrolls up. */

const LOG_LINES = 5000;

class Log {
  constructor(details) {
    this.details = details;
    this.pre = details.querySelector("#log");
    this.button = details.querySelector("[data-log-follow]");
    this.isFollowing = true;
    this.missed = 0;
    this.pre.addEventListener("scroll", () => this.onScroll());
    this.button.addEventListener("click", () => this.follow());
    details.addEventListener("toggle", () => details.open && this.isFollowing && this.toEnd());
    details.querySelector("[data-log-copy]").addEventListener("click", () => this.copy());
    this.toEnd();
  }

  get end() {
    return this.pre.dataset.end;
  }

  add({ text, is_whole: isWhole }) {
    if (!isWhole) this.addLine("… (what came before is in the downloaded log)");
    const lines = text.endsWith("\n") ? text.slice(0, -1).split("\n") : text.split("\n");
    lines.forEach((line) => this.addLine(line));
    this.details.querySelector("[data-log-empty]").hidden = true;
    this.details.querySelectorAll("[data-log-copy], [data-log-download]").forEach((tool) => (tool.hidden = false));
    if (this.isFollowing && !this.isSelecting()) {
      while (this.pre.childElementCount > LOG_LINES) this.pre.firstElementChild.remove();
      this.toEnd();
    } else {
      this.missed += lines.length;
      this.showButton();
    }
  }

  addLine(text) {
    const line = document.createElement("span");
    line.className = `line ${Log.level(text)}`;
    line.textContent = `${text}\n`;
    this.pre.append(line);
  }

  static level(line) {
    const found = /^\S+ \S+ (ERROR|CRITICAL|WARNING) /.exec(line);
    if (found) return found[1] === "WARNING" ? "warning" : "error";
    return /^[A-Za-z_.]*(Error|Exception)\b/.test(line) ? "error" : "";
  }

  /** Whether the reader marks text in the log, which must not move away. */
  isSelecting() {
    const selection = getSelection();
    return !selection.isCollapsed && this.pre.contains(selection.anchorNode);
  }

  toEnd() {
    this.pre.scrollTop = this.pre.scrollHeight;
  }

  follow() {
    this.isFollowing = true;
    this.missed = 0;
    this.toEnd();
    this.showButton();
    this.pre.focus();
  }

  onScroll() {
    const isAtEnd = this.pre.scrollHeight - this.pre.scrollTop - this.pre.clientHeight < 8;
    if (isAtEnd) this.missed = 0;
    this.isFollowing = isAtEnd;
    this.showButton();
  }

  showButton() {
    this.button.hidden = this.isFollowing && !this.missed;
    this.button.textContent = this.missed ? `↓ ${this.missed} new line${this.missed === 1 ? "" : "s"}` : "↓ Follow the end";
  }

  async copy() {
    const text = this.pre.textContent;
    try {
      await navigator.clipboard.writeText(text);
      toast("The log was copied");
    } catch {
      // Without https, only what is selected can be copied.
      getSelection().selectAllChildren(this.pre);
      toast(document.execCommand("copy") ? "The log was copied" : "Press Ctrl+C to copy the selected log");
    }
  }
}
