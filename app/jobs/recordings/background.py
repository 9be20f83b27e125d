"""Work that the server has done in a child process, one piece at a time, and told about."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from app.jobs.storage.room import Room
from physhandi.child import Child
from physhandi.errors import CancelledError, PhysHandiError, RunError, describe

_LONGEST_S = 4 * 3600.0
"""Time after which a process is not waited for any longer [s]."""


@dataclass
class BackgroundTask:
    """Progress of a piece of work."""

    state: Literal["none", "running", "done", "cancelled", "failed"] = "none"
    reason: str = ""
    """Why it failed."""
    progress: dict[str, Any] = field(default_factory=dict[str, Any])
    """The latest report: ``stage iteration total message``."""
    result: dict[str, Any] = field(default_factory=dict[str, Any])
    """Result that the process reported."""


@dataclass(frozen=True)
class Work:
    """Description of a piece of work, for other work that must not interfere with it."""

    kind: Literal["annotation", "import", "example", "upload"]
    name: str
    """Sequence or upload that it is about."""
    doing: str
    """Sentence that says what is being done."""


class _Process:
    """The process of one piece of work."""

    def __init__(self) -> None:
        self.child: Child | None = None
        self.was_begun = threading.Event()
        """Set when it is there, or could not be started."""


_NAMES = {
    "annotation": "Finding masks and tracks",
    "import": "An import",
    "example": "The example",
    "upload": "Unpacking an upload",
}


class BackgroundTasks:
    """Starts the process that works, listens to it, and ends it with the server."""

    def __init__(self, room: Room | None = None) -> None:
        """Prepare.

        Args:
            room: Tells whether there is room for what is made; None asks nobody.
        """
        self._room = room
        self._lock = threading.Lock()
        self._tasks: dict[tuple[str, str], BackgroundTask] = {}
        self._work: Work | None = None
        self._process = _Process()
        """That of the latest work."""
        self._listener: threading.Thread | None = None

    def start(self, work: Work, module: str, order: dict[str, Any]) -> BackgroundTask:
        """Begin a piece of work.

        Args:
            work: What it is.
            module: What runs in the process: calls `work_on_order`.
            order: What the process is told.

        Raises:
            RunError: If another piece is at work.
            NoRoomError: If the data folder or its disk is too full.
        """
        with self._lock:
            running = self.running
            if running is not None:
                raise RunError(f"{running.doing} Wait until that is done, or cancel it.")
            if self._room is not None:
                self._room.require(_NAMES[work.kind])
            process = self._process = _Process()
            task = self._tasks[work.kind, work.name] = BackgroundTask("running")
            self._work = work
            # The process ends with the thread that starts it, and those of requests come and go.
            self._listener = threading.Thread(
                target=_attend, args=(module, order, task, process), name=module, daemon=True
            )
            self._listener.start()
        return task

    @property
    def running(self) -> Work | None:
        """The work that is going on."""
        work = self._work
        if work is not None and self.task(work.kind, work.name).state == "running":
            return work
        return None

    def task(self, kind: str, name: str) -> BackgroundTask:
        """Tell how far a piece of work is; of one that nobody asked for, that there is none."""
        return self._tasks.get((kind, name), BackgroundTask())

    def cancel(self, kind: str, name: str) -> None:
        """Stop a piece of work; does nothing if it is not at work."""
        running = self.running
        if running is not None and (running.kind, running.name) == (kind, name):
            process = self._process
            process.was_begun.wait()
            if process.child is not None:
                process.child.send("cancel")

    def require_settled(self, sequence_ids: Iterable[str]) -> None:
        """Refuse to read recordings that are about to be replaced.

        Raises:
            RunError: If one of them is worked on.
        """
        running = self.running
        if running is not None and running.kind != "example" and running.name in sequence_ids:
            raise RunError(
                f"{running.doing} A fit would read it half old and half new. Wait until that is "
                "done, or cancel it."
            )

    def shutdown(self) -> None:
        """End what is at work."""
        process = self._process
        if self.running is not None:
            process.was_begun.wait()
        if process.child is not None:
            process.child.kill()
        if self._listener is not None:
            self._listener.join(timeout=5)


def _attend(module: str, order: dict[str, Any], task: BackgroundTask, process: _Process) -> None:
    """Start the process and listen to it until it ends."""
    try:
        with Child(module, time_limit_s=_LONGEST_S) as child:
            child.send(order)
            process.child = child
            process.was_begun.set()
            for message in child.messages():
                if "result" in message:
                    task.result = message["result"]
                else:
                    task.progress = message
        task.state = "done"
    except CancelledError:
        task.state = "cancelled"
    except (PhysHandiError, OSError) as error:
        task.reason = describe(error)
        task.state = "failed"
    finally:
        process.was_begun.set()
