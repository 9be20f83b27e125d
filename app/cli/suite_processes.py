"""A suite's pieces of work on this machine: threads of a pool, each with a process of its own.

``python -m app.cli.suite_processes`` is such a process.
"""

import itertools
import os
import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Many
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from app.cli.suite_work import Piece, PieceWorker, fill_with, make_with, told_of
from app.jobs.ticket import MOST_STARTS
from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.devices import card_of, only_card
from physhandi.errors import CancelledError
from physhandi.progress import Progress, ToldProgress

if TYPE_CHECKING:
    from physhandi.synthetic.suite.evaluation import Fill, Order
    from physhandi.synthetic.suite.suite import Making

_LISTEN_S = 0.2
_TELL_EVERY_S = 0.5


class SuiteProcesses:
    """A few processes that share the work on a suite; they end with it.

    Each has its own share of the machine's processors, and the GPUs in turn. A piece whose process
    is lost is done once more, by a new one; if that is lost too, the piece is.
    """

    def __init__(self, count: int, progress: Progress, devices: Many[str] = ("cpu",)) -> None:
        """Prepare; a process is started with its first piece of work.

        Args:
            count: How many.
            progress: Told what they do; may ask to stop.
            devices: Warp devices of this process. Each of them has one for itself; if that is a
                GPU, it is their `ONLY_CARD`, which orders name.
        """
        self._progress = progress
        # What was free last comes first: a start costs seconds, and few pieces need few of them.
        self._free: queue.LifoQueue[_Process] = queue.LifoQueue()
        self._all = [
            _Process(share, only_card(card_of(devices[number % len(devices)])))
            for number, share in enumerate(_shares(count))
        ]
        for process in reversed(self._all):
            self._free.put(process)
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="suite")

    def __enter__(self) -> "SuiteProcesses":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._all:
            process.kill()
        self._pool.shutdown()
        for process in self._all:
            process.close()

    def make(self, makings: "Mapping[Path, Making]") -> None:
        """Make sequences of a suite; see `make_with`."""
        make_with(self._done, makings)

    def fill(self, order: "Order", out: Path) -> "Fill":
        """Give what fills the cells of an order; see `fill_with`."""
        return fill_with(self._done, order, out)

    def _done(self, stage: str, pieces: Many[Piece]) -> Iterator[tuple[int, str]]:
        """Have pieces done; see `Done`."""
        heard: queue.SimpleQueue[Future[str] | tuple[int, str]] = queue.SimpleQueue()
        futures = {self._pool.submit(self._do, piece, heard): piece for piece in pieces}
        for future in futures:
            future.add_done_callback(heard.put)
        states: dict[int, str] = {}
        finished = 0
        try:
            while finished < len(pieces):
                self._progress.check_cancelled()
                try:
                    message = heard.get(timeout=_LISTEN_S)
                except queue.Empty:
                    continue
                if isinstance(message, Future):
                    piece, lost = futures[message], message.result()
                    finished += 1
                    states.pop(piece.number, None)
                    yield piece.number, lost
                else:
                    states[message[0]] = message[1]
                text = " · ".join(states.values())
                self._progress.report(stage, finished, len(pieces), message=text)
        finally:
            for future in futures:
                future.cancel()

    def _do(self, piece: Piece, heard: "queue.SimpleQueue[Any]") -> str:
        """Have a piece done by a process; returns why it was lost, nothing if it was not."""
        process = self._free.get()
        lost = ""
        try:
            for _ in range(MOST_STARTS):
                heard.put((piece.number, piece.label))
                try:
                    process.do(piece.request, partial(_tell, heard, piece))
                except ChildEndedError as end:
                    lost = (
                        f"The process that worked on it ended, {MOST_STARTS} times (exit code "
                        f"{end.code}). If memory ran out, take fewer of them (--jobs). "
                        f"{end.last_words}"
                    ).rstrip()
                else:
                    return ""
            return lost
        finally:
            self._free.put(process)


def _tell(heard: "queue.SimpleQueue[Any]", piece: Piece, report: Mapping[str, Any]) -> None:
    heard.put((piece.number, told_of(piece.label, report)))


class _Process:
    """A process with its share of the machine; a new one takes its place when it has ended."""

    def __init__(self, share: Many[int], environment: Mapping[str, str]) -> None:
        self._share = share
        self._environment = environment
        self._lock = threading.Lock()
        self._is_closed = False
        self._child: Child | None = None
        self._messages: Iterator[dict[str, Any]] = iter(())

    def do(self, request: Mapping[str, Any], tell: Callable[[Mapping[str, Any]], None]) -> None:
        """Have something done.

        Raises:
            ChildEndedError: If the process ended meanwhile without a word.
            CancelledError: If it was closed meanwhile.
            PhysHandiError: What the process found wrong.
        """
        child = self._started()
        child.send(request)
        try:
            self._hear(tell)
        except BaseException:
            with self._lock:
                self._child = None
            child.close()
            if self._is_closed:
                raise CancelledError("The work on the suite was ended.") from None
            raise

    def kill(self) -> None:
        """Kill the process; whoever waits for it is told that it was closed."""
        with self._lock:
            self._is_closed = True
            if self._child is not None:
                self._child.kill()

    def close(self) -> None:
        """Clear away what is left of the process; nobody waits for it any more."""
        if self._child is not None:
            self._child.close()

    def _hear(self, tell: Callable[[Mapping[str, Any]], None]) -> None:
        for message in self._messages:
            if "done" in message:
                return
            tell(message)
        raise ChildEndedError(__name__, 0, "")

    def _started(self) -> Child:
        with self._lock:
            if self._is_closed:
                raise CancelledError("The work on the suite was ended.")
            if self._child is None:
                self._child = Child(
                    "app.cli.suite_processes",
                    ",".join(str(processor) for processor in self._share),
                    threads=len(self._share),
                    environment=self._environment,
                )
                self._messages = self._child.messages()
            return self._child


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


def _work(channel: Channel) -> None:
    """Do what is asked for until nothing more is, on processors that no sibling uses."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(number) for number in channel.arguments[0].split(",")})
    worker = PieceWorker(ToldProgress(channel.tell, _TELL_EVERY_S))
    for request in channel.requests():
        worker.do(request)
        channel.tell(done=True)


if __name__ == "__main__":
    run_child(_work)
