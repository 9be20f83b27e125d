"""Pieces of work on a suite that other processes do: sequences to make, and cells to fill."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physhandi.child import loading_modules
from physhandi.data.files import plain
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError
from physhandi.progress import Progress

if TYPE_CHECKING:
    from physhandi.synthetic.suite.evaluation import Fill, Order, Task
    from physhandi.synthetic.suite.suite import Making


@dataclass(frozen=True, kw_only=True)
class Piece:
    """One piece of work."""

    number: int
    """Index among its like."""
    label: str
    """Its name for people."""
    request: Mapping[str, Any]
    """The order, in plain data; see `PieceWorker`."""
    key: str
    """Stands for it in every command that wants the same."""


Done = Callable[[str, Many[Piece]], Iterator[tuple[int, str]]]
"""Has pieces of a stage done; yields their numbers as they end, with a reason if one was lost."""


def make_with(done: Done, makings: "Mapping[Path, Making]") -> None:
    """Make sequences of a suite.

    Raises:
        PhysHandiError: If one cannot be made; the others stay.
    """
    pieces = [
        Piece(
            number=number,
            label=target.name,
            request={"make": dict(making), "target": str(target.resolve())},
            key=_key([str(target.resolve()), dict(making)]),
        )
        for number, (target, making) in enumerate(makings.items())
    ]
    for number, lost in done("sequences", pieces):
        if lost:
            raise RunError(f"Sequence '{pieces[number].label}' could not be made. {lost}")


def fill_with(done: Done, order: "Order", out: Path) -> "Fill":
    """Give what fills the cells of an order, for `evaluate_suite`.

    Args:
        done: Has pieces done.
        order: What is evaluated.
        out: Folder of the suite.
    """
    place = str(out.resolve())
    about = {"order": order_to_json(order), "out": place}

    def fill(tasks: "Many[Task]") -> Iterator[tuple[int, str]]:
        pieces = [
            Piece(
                number=number,
                label=f"{tasks[number].method.name}, {tasks[number].recording.name}",
                request={**about, "cell": number},
                key=_key(_identity(tasks[number], order, place)),
            )
            for number in in_order(tasks)
        ]
        return done("suite", pieces)

    return fill


class PieceWorker:
    """Does one piece after the other; what it has read of an order serves all its cells."""

    def __init__(self, progress: Progress) -> None:
        """Prepare.

        Args:
            progress: Is told how far a piece is.
        """
        self._progress = progress
        self._order: Any = None
        self._fill: Callable[[int], None] | None = None

    def do(self, request: Mapping[str, Any]) -> None:
        """Do what a `Piece` asks for.

        Args:
            request: ``make`` and ``target``, or ``order``, ``out`` and ``cell``.

        Raises:
            PhysHandiError: If it cannot be done.
        """
        # What computes takes two seconds to import; not every process of a suite computes.
        if "make" in request:
            with loading_modules():
                from physhandi.synthetic.suite.suite import make_recording

            make_recording(request["make"], Path(request["target"]), self._progress)
            return
        asked = (request["order"], request["out"])
        if self._fill is None or self._order != asked:
            with loading_modules():
                from physhandi.synthetic.suite.evaluation import filler

            self._order = asked
            order = order_from_json(request["order"])
            self._fill = filler(order, Path(request["out"]), self._progress)
        self._fill(request["cell"])


def order_to_json(order: "Order") -> dict[str, Any]:
    """Write an order down for another process; recordings are named by their folders."""
    about = {field.name: getattr(order, field.name) for field in fields(order)}
    about |= {name: dict(about[name]) for name in ("settings", "environment")}
    return about | {"recordings": [str(r.folder.resolve()) for r in order.recordings]}


def order_from_json(about: Mapping[str, Any]) -> "Order":
    """Read an order that another process wrote down.

    Raises:
        SequenceError: If a recording is damaged or gone.
    """
    from physhandi.synthetic.suite.evaluation import Order

    read = dict(about)
    read["recordings"] = tuple(Sequence.load(Path(folder)) for folder in about["recordings"])
    read |= {name: tuple(about[name]) for name in ("methods", "protocols", "search_seeds")}
    return Order(**read)


def told_of(label: str, report: Mapping[str, Any]) -> str:
    """Say what a process does; what is not counted has no share."""
    total = report.get("total", 0)
    share = f" {100 * report['iteration'] // total:.0f} %" if total else ""
    return f"{label} {report['stage']}{share}"


def in_order(tasks: "Many[Task]") -> list[int]:
    """Order cells so that what others are made from comes first, method by method.

    Processes then seldom wait for each other.
    """
    protocols = list(dict.fromkeys(task.protocol for task in tasks))
    methods = list(dict.fromkeys(task.method.name for task in tasks))

    def place(number: int) -> tuple[bool, bool, int, int]:
        task = tasks[number]
        rank = protocols.index(task.protocol), methods.index(task.method.name)
        return (task.fitted is not None, task.method.correction is not None, *rank)

    return sorted(range(len(tasks)), key=place)


def _identity(task: "Task", order: "Order", out: str) -> list[Any]:
    """Name what decides a cell, but not which other cells are wanted beside it."""
    recordings = [str(r.folder.resolve()) for r in (task.recording, task.fitted) if r is not None]
    method = [task.method.name, dict(task.method.overrides), dict(order.settings)]
    return [out, task.protocol, task.split, method, recordings, dict(order.environment)]


def _key(identity: object) -> str:
    text = json.dumps(plain(identity), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
