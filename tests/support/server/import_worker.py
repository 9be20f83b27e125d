"""A process in the place of the one that imports, which writes down what it was told."""

import json
from pathlib import Path
from typing import Any

from app.jobs.recordings.ordered import work_on_order
from physhandi.errors import ImportFailedError
from physhandi.progress import Progress


def work(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    progress.report("import", 1, 4, None, "left")
    if "broken" in order.get("source", ""):
        raise ImportFailedError("left/color/00003.png: was cut off.")
    gate = Path(order.get("source", "")) / "gate"
    if gate.is_fifo():
        gate.read_bytes()  # Until somebody writes to it.
    out = Path(order["out"])
    out.mkdir(parents=True)
    (out / "order.json").write_text(json.dumps(order))
    return {"written": out.name}


if __name__ == "__main__":
    work_on_order(work)
