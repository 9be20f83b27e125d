"""Processes that make the sequences of a suite and fill its cells, a few side by side."""

import itertools
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import Any

from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.data.sequence import Sequence
from physhandi.devices import card_of, only_card
from physhandi.errors import PhysHandiError, RunError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic.suite.evaluation import Fill, Order, Task
from physhandi.synthetic.suite.suite import Making

_TELL_EVERY = 0.5


def order_to_json(order: Order) -> dict[str, Any]:
    """Write an order down for another process; recordings are named by their folders."""
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
    read |= {name: tuple(about[name]) for name in ("methods", "protocols", "search_seeds")}
    return Order(**read)


class _ToldProgress(Progress):
    """Tells the parent how far the work is, a few times a second."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._last = 0.0

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002
        message: str = "",  # noqa: ARG002
    ) -> None:
        if total == 0 or time.monotonic() - self._last >= _TELL_EVERY:
            self._last = time.monotonic()
            self._channel.tell(stage=stage, iteration=iteration, total=total)


def work(channel: Channel) -> None:
    """Do what is asked for until nothing more is, on processors that no sibling uses."""
    from physhandi.synthetic.suite.evaluation import filler
    from physhandi.synthetic.suite.suite import make_recording

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(number) for number in channel.arguments[0].split(",")})
    progress = _ToldProgress(channel)
    fill: Callable[[int], None] | None = None
    for asked in channel.requests():
        if "make" in asked:
            make_recording(asked["make"], Path(asked["target"]), progress)
        elif "order" in asked:
            fill = filler(order_from_json(asked["order"]), Path(asked["out"]), progress)
        elif fill is None:
            raise UsageError("A cell was asked for before an order.")
        else:
            fill(asked["cell"])
        channel.tell(done=True)


MOST_PROCESSES = 64
"""Processes at most."""
_LISTEN = 0.2


@dataclass(frozen=True, kw_only=True)
class _Job:
    """One piece of work."""

    number: int
    label: str
    request: Mapping[str, Any]


@dataclass(eq=False, kw_only=True)
class _Worker:
    """One process, and what it is doing."""

    child: Child
    listener: threading.Thread
    order: Mapping[str, Any] | None = None
    """The order that it was sent last."""
    jobs: "deque[_Job | None]" = field(default_factory=deque["_Job | None"])
    """Requests without an answer yet, the oldest first; None stands for an order."""
    state: str = ""
    """Progress of its job, in words."""


class SuiteWorkers:
    """A few processes that share the work on a suite; they end with it.

    After an error nothing more can be asked of them: some may still work on what was asked before.
    Each has its own share of the machine's processors, and the GPUs in turn. Cells that are made
    from others (a last residual, an unseen interaction) come last, so that processes seldom wait
    for each other.
    """

    def __init__(self, count: int, progress: Progress, devices: Many[str] = ("cpu",)) -> None:
        """Start them.

        Args:
            count: How many, 2 or more.
            progress: Told what they do; may ask to stop.
            devices: Warp devices of this process. Each of them has one for itself; if that is a
                GPU, it is their `ONLY_CARD`, which orders name.

        Raises:
            UsageError: If the number makes no sense.
        """
        if not 2 <= count <= MOST_PROCESSES:
            raise UsageError(f"{count} processes make no sense; choose 2 to {MOST_PROCESSES}.")
        self._progress = progress
        self._heard: queue.Queue[tuple[int, Any]] = queue.Queue()
        self._workers = [
            self._start(number, share, devices[number % len(devices)])
            for number, share in enumerate(_shares(count))
        ]

    def __enter__(self) -> "SuiteWorkers":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        for worker in self._workers:
            worker.child.kill()
        for worker in self._workers:
            worker.listener.join()
            worker.child.close()

    def make(self, makings: Mapping[Path, Making]) -> None:
        """Make sequences of a suite.

        Raises:
            PhysHandiError: If one cannot be made; the others stay.
        """
        jobs = [
            _Job(
                number=number,
                label=target.name,
                request={"make": dict(making), "target": str(target.resolve())},
            )
            for number, (target, making) in enumerate(makings.items())
        ]
        for _ in self._done("sequences", jobs):
            pass

    def fill(self, order: Order, out: Path) -> Fill:
        """Give what fills the cells of an order, for `evaluate`.

        Args:
            order: What is evaluated.
            out: Folder of the suite.
        """
        asked = {"order": order_to_json(order), "out": str(out.resolve())}

        def fill(tasks: Many[Task]) -> Iterator[int]:
            jobs = [
                _Job(
                    number=number,
                    label=f"{tasks[number].method.name}, {tasks[number].recording.name}",
                    request={"cell": number},
                )
                for number in _in_order(tasks)
            ]
            return self._done("suite", jobs, asked)

        return fill

    def _done(
        self, stage: str, jobs: Many[_Job], order: Mapping[str, Any] | None = None
    ) -> Iterator[int]:
        """Have jobs done; yields their numbers as they are finished."""
        waiting = deque(jobs)
        finished = 0
        for worker in self._workers:
            self._give(worker, waiting, order)
        while finished < len(jobs):
            self._progress.check_cancelled()
            try:
                number, answer = self._heard.get(timeout=_LISTEN)
            except queue.Empty:
                continue
            worker = self._workers[number]
            job = worker.jobs[0] if worker.jobs else None
            if isinstance(answer, ChildEndedError):
                raise _lost(worker, answer)
            if isinstance(answer, PhysHandiError):
                raise answer
            if "done" in answer:
                worker.jobs.popleft()
                if job is not None:
                    finished += 1
                    worker.state = ""
                    self._give(worker, waiting, order)
                    yield job.number
            elif job is not None:
                worker.state = _told_of(job.label, answer)
            states = " · ".join(w.state for w in self._workers if w.state)
            self._progress.report(stage, finished, len(jobs), message=states)

    def _give(self, worker: _Worker, waiting: deque[_Job], order: Mapping[str, Any] | None) -> None:
        if not waiting:
            return
        job = waiting.popleft()
        if order is not None and worker.order is not order:
            worker.order = order
            worker.jobs.append(None)
            worker.child.send(order)
        worker.jobs.append(job)
        worker.state = job.label
        worker.child.send(job.request)

    def _start(self, number: int, share: Many[int], device: str) -> _Worker:
        processors = ",".join(str(processor) for processor in share)
        child = Child(
            "app.cli.suite_workers",
            processors,
            threads=len(share),
            environment=only_card(card_of(device)),
        )
        listener = threading.Thread(target=self._listen, args=(number, child), daemon=True)
        listener.start()
        return _Worker(child=child, listener=listener)

    def _listen(self, number: int, child: Child) -> None:
        try:
            for message in child.messages():
                self._heard.put((number, message))
        except PhysHandiError as error:
            self._heard.put((number, error))


def _told_of(label: str, report: Mapping[str, Any]) -> str:
    """Say what a process does; what is not counted has no share."""
    total = report["total"]
    share = f" {100 * report['iteration'] // total} %" if total else ""
    return f"{label} {report['stage']}{share}"


def _lost(worker: _Worker, end: ChildEndedError) -> RunError:
    """Say what the end of a process means."""
    labels = [job.label for job in worker.jobs if job is not None]
    doing = f"while it worked on {labels[0]}" if labels else "while it had nothing to do"
    return RunError(
        f"A process of the suite ended {doing} (exit code {end.code}). "
        "If memory ran out, take fewer of them (--jobs). What is finished stays; the same command "
        f"goes on. {end.last_words}".rstrip()
    )


def _in_order(tasks: Many[Task]) -> list[int]:
    """Order cells so that what others are made from comes first, method by method."""
    protocols = list(dict.fromkeys(task.protocol for task in tasks))
    methods = list(dict.fromkeys(task.method.name for task in tasks))

    def place(number: int) -> tuple[bool, bool, int, int]:
        task = tasks[number]
        rank = protocols.index(task.protocol), methods.index(task.method.name)
        return (task.fitted is not None, task.method.correction is not None, *rank)

    return sorted(range(len(tasks)), key=place)


def _shares(count: int) -> list[list[int]]:
    """Divide this machine's processors; with fewer of them than processes some share one."""
    if hasattr(os, "sched_getaffinity"):
        numbers = sorted(os.sched_getaffinity(0))
    else:
        numbers = list(range(os.cpu_count() or 1))
    bounds = [number * len(numbers) // count for number in range(count + 1)]
    return [
        numbers[low:high] or [numbers[low % len(numbers)]]
        for low, high in itertools.pairwise(bounds)
    ]


if __name__ == "__main__":
    run_child(work)
