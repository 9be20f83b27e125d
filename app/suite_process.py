"""A child process that works on a suite: ``python -m app.suite_process PARENT PROCESSORS``.

It reads one JSON object a line from standard input, and answers on what was its standard output:

* ``{"make": {…}, "target": FOLDER}`` makes a sequence of the suite,
* ``{"order": {…}, "out": FOLDER}`` tells what is evaluated,
* ``{"cell": 3}`` fills a cell of that order;

each is answered by ``{"done": true}`` or ``{"error": "…", "kind": "UsageError"}``; while it works
it tells ``{"stage": "hands", "iteration": 3, "total": 60}``.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, TextIO

from app.child_modules import die_with_parent
from physhandi.data.sequence import Sequence
from physhandi.errors import PhysHandiError, UsageError, describe
from physhandi.progress import Progress
from physhandi.synthetic.suite_tasks import Order

_TELL_EVERY = 0.5


def order_to_json(order: Order) -> dict[str, Any]:
    """Write an order down for another process; recordings are told by their folders."""
    about = {field.name: getattr(order, field.name) for field in fields(order)}
    about["settings"] = dict(order.settings)
    return about | {"recordings": [str(r.folder.resolve()) for r in order.recordings]}


def order_from_json(about: dict[str, Any]) -> Order:
    """Read an order that another process wrote down.

    Raises:
        SequenceError: If a recording is damaged or gone.
    """
    read = dict(about)
    read["recordings"] = tuple(Sequence.load(Path(folder)) for folder in about["recordings"])
    read |= {name: tuple(about[name]) for name in ("methods", "protocols")}
    return Order(**read)


class _Told(Progress):
    """Tells the parent how far the work is, a few times a second."""

    def __init__(self, tell: Callable[..., None]) -> None:
        self._tell = tell
        self._last = 0.0

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002
        message: str = "",  # noqa: ARG002
    ) -> None:
        if time.monotonic() - self._last >= _TELL_EVERY:
            self._last = time.monotonic()
            self._tell(stage=stage, iteration=iteration, total=total)


def work(requests: TextIO, answers: TextIO) -> None:
    """Do what is asked for until nothing more is."""
    from physhandi.synthetic.evaluation import filler
    from physhandi.synthetic.suite import make_recording

    def tell(**about: object) -> None:
        answers.write(json.dumps(about) + "\n")
        answers.flush()

    progress = _Told(tell)
    fill: Callable[[int], None] | None = None
    for line in requests:
        asked = json.loads(line)
        try:
            if "make" in asked:
                make_recording(asked["make"], Path(asked["target"]), progress)
            elif "order" in asked:
                fill = filler(order_from_json(asked["order"]), Path(asked["out"]), progress)
            elif fill is None:
                raise UsageError("A cell was asked for before an order.")
            else:
                fill(asked["cell"])
        except (PhysHandiError, OSError, MemoryError) as error:
            tell(error=describe(error), kind=type(error).__name__)
        else:
            tell(done=True)


def main(arguments: list[str]) -> None:
    """Work for a parent, on processors that no other of its children uses."""
    die_with_parent(int(arguments[0]))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(number) for number in arguments[1].split(",")})
    # Libraries print to standard output; answers have that place to themselves.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    work(sys.stdin, answers)


if __name__ == "__main__":
    main(sys.argv[1:])
