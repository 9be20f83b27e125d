"""Makes heavy files in child processes, a few at a time, and keeps them in a bounded cache."""

import hashlib
import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import viser

from app.exports.request import FileRequest
from physhandi import __version__, errors
from physhandi.child import Child, ChildEndedError
from physhandi.data.files import files_by_age, sweep_temporary, temporary_name
from physhandi.data.run_folder import CURRENT
from physhandi.data.sequence_meta import FILE

logger = logging.getLogger(__name__)

AT_ONCE = 2
"""Files that are made side by side."""
MOST_WAITING = 16
"""Files that may be made or wait."""
MOST_BYTES = 2**30
"""Bytes that the cache may hold."""
MOST_SECONDS = 600.0
"""Time that making one file may take [s]."""
_VERSION = 2


class TooManyFilesError(errors.PhysHandiError):
    """No further file can be made now."""


@dataclass(eq=False)
class FileJob:
    """A file that is being made, or was."""

    path: Path
    """Path of the file."""
    future: "Future[Path]" = field(default_factory=Future[Path])
    """Ends with its path, or with what went wrong."""
    done: int = 0
    """Finished steps."""
    of: int = 0
    """All steps; 0 before that is known."""
    last_used: float = field(default_factory=time.monotonic)
    """Time of the last request for it [s, clock of `time.monotonic`]."""

    @property
    def state(self) -> Literal["making", "ready", "failed"]:
        """Whether the file is being made, is there or could not be made."""
        if not self.future.done():
            return "making"
        return "ready" if self.future.exception() is None else "failed"


class FileCache:
    """Makes files of orders; the same order is made once, and its file kept as long as fits."""

    def __init__(
        self,
        folder: Path,
        *,
        at_once: int = AT_ONCE,
        most_bytes: int = MOST_BYTES,
        seconds: float = MOST_SECONDS,
    ) -> None:
        """Prepare; nothing is started before the first order.

        Args:
            folder: Where files are kept; it may be deleted at any time.
            at_once: Files that are made side by side.
            most_bytes: What the kept files may weigh together.
            seconds: How long making one file may take [s].
        """
        self._folder = folder
        self._most_bytes, self._seconds = most_bytes, seconds
        # Processes end with the thread that started them, so these threads stay.
        self._threads = ThreadPoolExecutor(at_once, thread_name_prefix="export")
        self._lock = threading.Lock()
        self._jobs: dict[str, FileJob] = {}
        self._children: set[Child] = set()
        self._is_closed = False

    def begin(self, order: FileRequest) -> FileJob:
        """Have a file made, unless it is there or being made.

        Args:
            order: What is to be made.

        Raises:
            UsageError: If the order makes no sense.
            TooManyFilesError: If too many files are being made already.
        """
        order.check()
        path = self._folder / f"{_key(order)}.{order.suffix}"
        with self._lock:
            job = self._jobs.get(path.name)
            if job is not None and job.state == "failed":
                job = None
            if job is not None and job.state == "ready" and not path.is_file():
                job = None
            if job is None:
                job = self._start(order, path)
            job.last_used = time.monotonic()
            return job

    def make(self, order: FileRequest) -> Path:
        """Have a file made and wait for it; see `begin`.

        Raises:
            PhysHandiError: If it could not be made.
        """
        return self.begin(order).future.result()

    @contextmanager
    def once(self, order: FileRequest, prepare: Callable[[Path], None]) -> Generator[Path]:
        """Have a file made that nobody else will ask for.

        Args:
            order: What is to be made; its `rollout` is replaced.
            prepare: Puts a rollout into a folder, see `store_rollout`.

        Yields:
            The file, which is gone afterwards.
        """
        folder = self._folder / temporary_name("once")
        folder.mkdir(parents=True)
        try:
            prepare(folder)
            whole = replace(order, rollout=str(folder))
            whole.check()
            out = folder / f"file.{order.suffix}"
            with self._lock:
                job = self._put_in_line(whole, FileJob(out), out.parent.name)
            yield job.future.result()
        finally:
            with self._lock:
                self._jobs.pop(folder.name, None)
            shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """End what is being made."""
        with self._lock:
            self._is_closed = True
            children = list(self._children)
        for child in children:
            child.kill()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _start(self, order: FileRequest, path: Path) -> FileJob:
        job = FileJob(path)
        if path.is_file():
            os.utime(path)
            job.future.set_result(path)
            self._jobs[path.name] = job
            return job
        return self._put_in_line(order, job, path.name)

    def _put_in_line(self, order: FileRequest, job: FileJob, name: str) -> FileJob:
        busy = sum(other.state == "making" for other in self._jobs.values())
        if busy >= MOST_WAITING or self._is_closed:
            raise TooManyFilesError(
                f"{busy} files are being made already, the most this server allows. "
                "Try again in a moment."
            )
        self._forget()
        self._jobs[name] = job
        self._threads.submit(self._make_in_thread, order, job)
        return job

    def _forget(self) -> None:
        """Keep the list of jobs short; their files stay."""
        ended = [(w.last_used, name) for name, w in self._jobs.items() if w.state != "making"]
        for _, name in sorted(ended)[: max(0, len(ended) - 500)]:
            del self._jobs[name]

    def _make_in_thread(self, order: FileRequest, job: FileJob) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._run(order, job)
            self._make_room(job.path)
            job.future.set_result(job.path)
        except Exception as error:
            if not isinstance(error, errors.PhysHandiError):
                logger.exception("making %s failed", job.path.name)
            job.future.set_exception(error)

    def _run(self, order: FileRequest, job: FileJob) -> None:
        with self._lock:
            if self._is_closed:
                raise errors.RunError("The server is being stopped.")
            child = Child(
                "app.exports.making",
                str(job.path),
                str(self._seconds),
                threads=1,
                time_limit_s=self._seconds,
            )
            self._children.add(child)
        try:
            with child:
                child.send(asdict(order))
                child.end_requests()
                for message in child.messages():
                    job.done, job.of = message["done"], message["of"]
        except ChildEndedError as error:
            logger.error("the file of %s was not made: %s", order.folder, error)  # noqa: TRY400
            limit = f"took longer than {self._seconds:g} s"
            why = limit if error.is_late else "was ended by the system"
            raise errors.RunError(f"The file could not be made: it {why}.") from None
        finally:
            with self._lock:
                self._children.discard(child)
            sweep_temporary(job.path.parent.glob(".*.tmp*"))

    def _make_room(self, newest: Path) -> None:
        """Remove the files that were not used for longest."""
        entries = files_by_age(self._folder.iterdir())
        total = sum(size for _, size, _ in entries)
        for _, size, path in entries:
            if total <= self._most_bytes:
                return
            if path != newest:
                path.unlink(missing_ok=True)
                total -= size


def _key(order: FileRequest) -> str:
    """Name a file after its order and the state of what it shows."""
    folder = Path(order.folder)
    about = folder / (CURRENT if order.kind == "run" else FILE)
    try:
        status = about.stat()
        stamp = (status.st_mtime_ns, status.st_size)
    except OSError:
        stamp = (0, 0)
    text = f"{_VERSION}\0{__version__}\0{viser.__version__}\0{stamp}\0{order.to_text()}"
    return f"{folder.name}-{hashlib.sha256(text.encode()).hexdigest()[:20]}"
